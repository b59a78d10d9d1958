//! What says that a run is complete, and what its files were then.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::evaluate::Summary;
use crate::error::{Error, Result};

pub(super) const SUMMARY: &str = "summary.toml";

/// What a run's `summary.toml` holds.
#[derive(Serialize, Deserialize)]
pub(super) struct Completed {
    /// The versions of the program that made it; earlier ones did not say.
    #[serde(default)]
    pub version: String,
    #[serde(flatten)]
    pub summary: Summary,
    /// CRC-32 of each other file that it ended with; the first edition wrote none.
    #[serde(default)]
    pub checksums: BTreeMap<String, u32>,
}

impl Completed {
    /// # Errors
    /// If the file cannot be read, or cannot be what was written.
    pub fn read(folder: &Path) -> Result<Self> {
        let path = folder.join(SUMMARY);
        let text = std::fs::read_to_string(&path).map_err(Error::io("read", &path))?;
        let bad =
            |problem: &str| Error::data(&path)(format!("{problem}; restore the file, or carry the run out again"));
        let run: Self = toml::from_str(&text).map_err(|problem: toml::de::Error| bad(problem.message()))?;
        let Summary { success, return_mean, .. } = run.summary;
        if success.is_finite() && return_mean.is_finite() {
            Ok(run)
        } else {
            Err(bad("a mean of the test is not finite"))
        }
    }

    /// The first file, of those with this ending, that is not what it was when the run ended.
    pub fn changed(&self, folder: &Path, ending: &str) -> Option<PathBuf> {
        let files = self.checksums.iter().filter(|(file, _)| file.ends_with(ending));
        let mut files = files.map(|(file, checksum)| (folder.join(file), checksum));
        files.find_map(|(path, expected)| (checksum(&path).ok() != Some(*expected)).then_some(path))
    }
}

pub(super) fn checksum(path: &Path) -> Result<u32> {
    Ok(crc32fast::hash(&std::fs::read(path).map_err(Error::io("read", path))?))
}
