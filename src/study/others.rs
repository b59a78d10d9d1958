//! What lies in the folder of a study besides its runs.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::config::RunConfig;
use super::folder::CONFIG;
use super::replays;

/// Runs lie in `TASK/METHOD/seedN`.
const LEVELS: usize = 3;

/// Why something is left out.
const NOT_ASKED_FOR: &str = "this command did not ask for it; to include it, name its task, method and seed";
const NO_RUN: &str = "it is not a run, and was not read";

/// What lies among the runs of a study and is none of them, each with the reason why it is left out: other runs, and what is no run. Hidden
/// files do not count, since systems leave them in every folder, and neither does what the study itself writes.
pub(crate) fn others_among(study: &Path, runs: &[(RunConfig, PathBuf)]) -> Vec<(String, String)> {
    let ours: BTreeSet<&Path> = runs.iter().flat_map(|(_, run)| run.ancestors()).collect();
    let others = others_in(study, LEVELS, &ours).into_iter();
    others.map(|(path, reason)| (path.display().to_string(), reason.into())).collect()
}

/// The same in a directory that is `levels` above the run directories. `ours` are the study's run directories and their ancestors.
fn others_in(folder: &Path, levels: usize, ours: &BTreeSet<&Path>) -> Vec<(PathBuf, &'static str)> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let shown = entries.filter(|entry| !entry.file_name().to_string_lossy().starts_with('.'));
    let paths: BTreeSet<PathBuf> = shown.map(|entry| entry.path()).collect();
    let among_runs = ours.contains(folder);
    let mut others = Vec::new();
    for path in paths {
        let is_ours = ours.contains(path.as_path());
        if !is_ours && path.join(CONFIG).is_file() {
            others.push((path, NOT_ASKED_FOR));
            continue;
        }
        // Tables, figures and recordings lie beside the folders of the tasks.
        let is_written = levels == LEVELS && (path.is_file() || path.ends_with(replays::FOLDER));
        let below = if levels > 1 { others_in(&path, levels - 1, ours) } else { Vec::new() };
        if among_runs && !is_ours && !is_written && below.is_empty() {
            others.push((path, NO_RUN));
        }
        others.extend(below);
    }
    others
}
