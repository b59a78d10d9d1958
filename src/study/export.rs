//! What a run has learned, as a folder of its own.

use std::path::Path;

use super::folder::{CHECKPOINT, CONFIG, LOCK, SUMMARY, WEIGHTS, check_run, read_config, read_weights};
#[cfg(doc)]
use crate::checkpoint::Weights;
use crate::error::{Error, Result};
use crate::files;

/// Writes what is needed to act as the run in `folder` has learned to, into the folder `out`: its configuration, and its weights,
/// with matrices in half precision ([`Weights::round_to_half`]). Returns the size of the weights' file in bytes.
///
/// # Errors
/// If there is no run in `folder`, it learns nothing, or its weights are missing, damaged, or those of another run; if `out` holds
/// another run, or was made by carrying out this one; or if a file cannot be written.
pub fn export(folder: &Path, out: &Path) -> Result<u64> {
    let (_, config) = read_config(folder)?;
    if !config.learns() {
        return Err(Error::Config(format!(
            "{}: {} learns nothing; there are no weights",
            folder.display(),
            config.method
        )));
    }
    let (_, mut weights) = read_weights(folder, &config)?;
    check_run(out, &config)?;
    if files::same_folder(out, folder) || [CHECKPOINT, SUMMARY, LOCK].iter().any(|file| out.join(file).exists()) {
        return Err(Error::Config(format!(
            "{}: this folder holds the run itself; choose another --out",
            out.display()
        )));
    }
    weights.round_to_half();
    let path = out.join(WEIGHTS);
    weights.write(&path)?;
    // Last, so that a folder without weights is never taken for a run.
    files::write(&out.join(CONFIG), config.to_toml().as_bytes())?;
    Ok(path.metadata().map_err(Error::io("read", &path))?.len())
}
