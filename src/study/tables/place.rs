//! Whether tables can be written into a folder without a loss.

use std::path::Path;
#[cfg(feature = "cli")]
use std::path::PathBuf;

use super::runs::{RunName, run_names};
use super::{Tables, inside, read};
use crate::error::{Error, Result};
#[cfg(feature = "cli")]
use crate::study::config::RunConfig;

impl Tables {
    /// # Errors
    /// If the folder holds the tables of a study with a run that these do not have: nothing could restore them.
    pub(in crate::study) fn check_place(&self, folder: &Path) -> Result<()> {
        let ours = run_names(&self.tests).map_err(inside)?;
        check(folder, |run| ours.contains(run))
    }
}

/// The same before a study of these runs. The tables of runs that are in the folder themselves can be made again.
///
/// # Errors
/// If the folder holds the tables of a study with a run that is neither one of these nor in the folder.
#[cfg(feature = "cli")]
pub(crate) fn check_place(folder: &Path, runs: &[(RunConfig, PathBuf)]) -> Result<()> {
    let ours = |(task, method, seed): &RunName| {
        runs.iter().any(|(run, _)| run.task == *task && run.method == *method && run.seed == *seed)
    };
    let there = |(task, method, seed): &RunName| folder.join(task).join(method).join(format!("seed{seed}")).is_dir();
    check(folder, |run| ours(run) || there(run))
}

fn check(folder: &Path, is_safe: impl Fn(&RunName) -> bool) -> Result<()> {
    let path = folder.join("tests.csv");
    if !path.exists() {
        return Ok(());
    }
    let theirs = run_names(&read::of_study(&path, &read::TESTS)?).map_err(inside)?;
    match theirs.iter().find(|run| !is_safe(run)) {
        None => Ok(()),
        Some((task, method, seed)) => Err(Error::Config(format!(
            "{}: this folder holds the tables of another study (with `{method}` on `{task}`, seed {seed}); choose another --out",
            folder.display()
        ))),
    }
}
