//! What a run has learned, as a folder of its own.

use std::path::Path;

use super::completed::SUMMARY;
use super::folder::{CHECKPOINT, CONFIG, WEIGHTS, check_run, is_open, read_config, read_weights};
use crate::checkpoint::Weights;
use crate::error::{Error, Result};
use crate::files;

/// Writes what is needed to act as the run in `folder` has learned to, into the folder `out`: its configuration, and its weights,
/// with matrices in half precision ([`Weights::round_to_half`]). Returns the size of the weights' file in bytes.
///
/// # Errors
/// If there is no run in `folder`, it learns nothing, or its weights are missing, damaged, or those of another run; if `out` holds
/// another run, was made by carrying out this one, or has weights that were not exported; or if a file cannot be written.
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
    let is_run = [CHECKPOINT, SUMMARY].iter().any(|file| out.join(file).exists()) || is_open(out);
    if is_run || files::same_folder(out, folder) {
        return Err(Error::Config(format!(
            "{}: this folder holds the run itself; choose another --out",
            out.display()
        )));
    }
    let path = out.join(WEIGHTS);
    if path.exists() && !Weights::read(&path).is_ok_and(|there| there.is_rounded()) {
        let advice = "there are weights that were not exported; choose another --out, or remove them";
        return Err(Error::Config(format!("{}: {advice}", path.display())));
    }
    weights.round_to_half();
    weights.write(&path)?;
    // Last, so that a folder without weights is never taken for a run.
    files::write(&out.join(CONFIG), config.to_toml().as_bytes())?;
    Ok(path.metadata().map_err(Error::io("read", &path))?.len())
}
