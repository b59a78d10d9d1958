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

/// The same before a study of these runs. The tables of runs that are in the folder themselves can be made again.
///
/// # Errors
/// If the folder holds the tables of a study with a run that is neither one of these nor in the folder; or if there are only damaged
/// tables, and no run.
#[cfg(feature = "cli")]
pub(crate) fn check_place(folder: &Path, runs: &[(RunConfig, PathBuf)]) -> Result<()> {
    let ours = |(task, method, seed): &RunName| {
        runs.iter().any(|(run, _)| run.task == *task && run.method == *method && run.seed == *seed)
    };
    let there = |(task, method, seed): &RunName| run_folder(folder, task, method, *seed).is_dir();
    // One of the tables may be lost or damaged.
    let formats = [("tests.csv", &read::TESTS), ("runs.csv", &read::RUNS), ("evaluations.csv", &read::EVALUATIONS)];
    let (mut known, mut problem) = (Vec::new(), None);
    for (file, format) in formats {
        match runs_in_table(&folder.join(file), format) {
            Ok(runs) => known.extend(runs),
            Err(damage) => problem = problem.or(Some(damage)),
        }
    }
    match problem {
        Some(problem) if known.is_empty() && !runs.iter().any(|(_, run)| run.is_dir()) => Err(problem),
        _ => check(folder, &known, |run| ours(run) || there(run)),
    }
}

/// The runs in the tables of a folder.
fn runs_in(folder: &Path) -> Result<Vec<RunName>> {
    runs_in_table(&folder.join("tests.csv"), &read::TESTS)
}

fn runs_in_table(path: &Path, format: &read::TableFormat) -> Result<Vec<RunName>> {
    if !path.exists() {
        return Ok(Vec::new());
    }
    run_names(&read::of_study(path, format)?).map_err(inside)
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
