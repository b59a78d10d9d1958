//! How far the runs of a study are, from what they have saved. Nothing is written, so runs that are under way go on undisturbed.
//!
//! ```
//! use handful::prelude::*;
//! use handful::study::runner::StudyPlan;
//! use handful::study::status::{RunState, status, time_left};
//!
//! let plan = StudyPlan {
//!     tasks: vec!["pendulum".into()],
//!     methods: vec!["random".into(), "sac".into()],
//!     seeds: 0..2,
//!     budget: None,
//!     folder: "runs/not-begun".into(),
//! };
//! let runs = status(&plan.runs(&Registry::standard())?);
//! assert!(runs.len() == 3 && runs.iter().all(|run| run.state == RunState::Waiting));
//! assert_eq!(time_left(&runs, 2), None);
//! # Ok::<(), Error>(())
//! ```

use std::path::{Path, PathBuf};

use super::config::RunConfig;
use super::folder::{is_complete, is_open};

/// The present state of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RunState {
    /// Not begun.
    Waiting,
    /// Begun; no process is running it.
    Stopped,
    /// A process works on it.
    Running,
    /// Trained and tested.
    Complete,
}

/// How far a run is.
#[derive(Clone, Debug, PartialEq)]
pub struct RunStatus {
    /// The task.
    pub task: String,
    /// The method.
    pub method: String,
    /// The seed.
    pub seed: u64,
    /// Its state.
    pub state: RunState,
    /// Environment steps that have been saved; a running one is some seconds ahead of that.
    pub step: usize,
    /// Environment steps that it is to have.
    pub steps: usize,
    /// Seconds that the saved steps took.
    pub seconds: f64,
}

impl RunStatus {
    fn of(config: &RunConfig, folder: &Path) -> Self {
        let (step, seconds) = last_episode(&folder.join("episodes.csv")).unwrap_or((0, 0.0));
        let complete = is_complete(folder, config);
        let state = match (complete, is_open(folder), folder.join("config.toml").exists()) {
            (true, ..) => RunState::Complete,
            (_, true, _) => RunState::Running,
            (_, _, true) => RunState::Stopped,
            _ => RunState::Waiting,
        };
        let step = if complete { config.steps } else { step.min(config.steps) };
        let RunConfig { task, method, seed, steps, .. } = config.clone();
        Self { task, method, seed, state, step, steps, seconds }
    }
}

/// How far each run is. What cannot be read counts as nothing saved.
pub fn status(runs: &[(RunConfig, PathBuf)]) -> Vec<RunStatus> {
    runs.iter().map(|(config, folder)| RunStatus::of(config, folder)).collect()
}

/// Seconds until all runs are trained, `jobs` at a time: the steps that are missing, at the pace of the same method on the same task so
/// far. None if nothing is missing, or if no such pace is known for some of them. Tests are not counted.
pub fn time_left(runs: &[RunStatus], jobs: usize) -> Option<f64> {
    let left: Option<Vec<f64>> = runs.iter().filter(|run| run.step < run.steps).map(|run| left_of(run, runs)).collect();
    let left = left.filter(|left| !left.is_empty())?;
    // No run is shared among jobs.
    let longest = left.iter().copied().fold(0.0, f64::max);
    Some(longest.max(left.iter().sum::<f64>() / jobs.max(1) as f64))
}

fn left_of(run: &RunStatus, runs: &[RunStatus]) -> Option<f64> {
    let alike = runs.iter().filter(|other| (&other.task, &other.method) == (&run.task, &run.method));
    let (seconds, steps) = alike.fold((0.0, 0), |(seconds, steps), run| (seconds + run.seconds, steps + run.step));
    (steps > 0).then(|| (run.steps - run.step) as f64 * seconds / steps as f64)
}

/// Steps and seconds of training at the end of the last episode in `episodes.csv`.
fn last_episode(path: &Path) -> Option<(usize, f64)> {
    let mut reader = csv::Reader::from_path(path).ok()?;
    let headers = reader.headers().ok()?.clone();
    let column = |name| headers.iter().position(|header| header == name);
    let (step, seconds) = (column("step")?, column("seconds")?);
    let last = reader.records().filter_map(Result::ok).last()?;
    let seconds: f64 = last.get(seconds)?.parse().ok()?;
    Some((last.get(step)?.parse().ok()?, if seconds.is_finite() { seconds.max(0.0) } else { 0.0 }))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(method: &str, step: usize, seconds: f64) -> RunStatus {
        let state = if step == 1000 { RunState::Complete } else { RunState::Running };
        RunStatus { task: "reach".into(), method: method.into(), seed: 0, state, step, steps: 1000, seconds }
    }

    #[test]
    fn time_left_is_missing_steps_at_the_pace_of_the_same_method() {
        let runs = [run("sac", 1000, 20.0), run("sac", 500, 10.0), run("sac", 0, 0.0), run("pets", 900, 90.0)];
        // 10 and 20 s of SAC, 10 s of PETS.
        assert_eq!(time_left(&runs, 1), Some(40.0));
        assert_eq!(time_left(&runs, 4), Some(20.0), "the longest run is not shared");
        assert_eq!(time_left(&[run("sac", 0, 0.0), run("pets", 900, 90.0)], 1), None, "no pace of SAC is known");
        assert_eq!(time_left(&runs[..1], 1), None, "nothing is missing");
    }

    #[test]
    fn seconds_that_cannot_be_true_are_none() {
        let file = tempfile::NamedTempFile::new().expect("a file");
        for (seconds, expected) in [("2.5", 2.5), ("inf", 0.0), ("NaN", 0.0), ("-5", 0.0)] {
            std::fs::write(file.path(), format!("step,seconds\n100,{seconds}\n")).expect("a writable file");
            assert_eq!(last_episode(file.path()), Some((100, expected)), "{seconds}");
        }
    }
}
