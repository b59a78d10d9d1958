//! Whether tables can be written into a folder without a loss.

use std::path::Path;
#[cfg(feature = "cli")]
use std::path::PathBuf;

use super::runs::{RunName, run_names};
use super::{Tables, inside, read};
use crate::error::{Error, Result};
#[cfg(feature = "cli")]
use crate::study::{config::RunConfig, runner::run_folder};

impl Tables {
    /// # Errors
    /// If the folder holds the tables of a study with a run that these do not have: nothing could restore them.
    pub(in crate::study) fn check_place(&self, folder: &Path) -> Result<()> {
        let ours = run_names(&self.tests).map_err(inside)?;
        check(folder, &runs_in(folder)?, |run| ours.contains(run))
    }
}

/// The same before a study of these runs. The tables of runs that are in the folder themselves can be made again, and a table that cannot
/// be read is made anew.
///
/// # Errors
/// If the folder holds the tables of a study with a run that is neither one of these nor in the folder.
#[cfg(feature = "cli")]
pub(crate) fn check_place(folder: &Path, runs: &[(RunConfig, PathBuf)]) -> Result<()> {
    let ours = |(task, method, seed): &RunName| {
        runs.iter().any(|(run, _)| run.task == *task && run.method == *method && run.seed == *seed)
    };
    let there = |(task, method, seed): &RunName| run_folder(folder, task, method, *seed).is_dir();
    check(folder, &runs_in(folder).unwrap_or_default(), |run| ours(run) || there(run))
}

/// The runs in the tables of a folder.
fn runs_in(folder: &Path) -> Result<Vec<RunName>> {
    let path = folder.join("tests.csv");
    if !path.exists() {
        return Ok(Vec::new());
    }
    run_names(&read::of_study(&path, &read::TESTS)?).map_err(inside)
}

fn check(folder: &Path, theirs: &[RunName], is_safe: impl Fn(&RunName) -> bool) -> Result<()> {
    match theirs.iter().find(|run| !is_safe(run)) {
        None => Ok(()),
        Some((task, method, seed)) => Err(Error::Config(format!(
            "{}: this folder holds the tables of another study (with `{method}` on `{task}`, seed {seed}); choose another --out",
            folder.display()
        ))),
    }
}
