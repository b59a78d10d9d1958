//! The episodes that a report shows in 3D: of each method's median seed, the test episode with the median return and the one with
//! the lowest. Weights are not in a study's tables, so the episodes are recorded when the study ends, next to the tables.

use std::path::{Path, PathBuf};

use rayon::iter::{IntoParallelIterator, ParallelIterator};
use serde::{Deserialize, Serialize};

use super::config::RunConfig;
use super::evaluate::{ENVS, EpisodeResult};
use super::folder::{is_complete, read_summary};
use super::page::gzip;
use super::records::write_csv;
use super::registry::Registry;
use crate::error::{Error, Result};
use crate::files;
use crate::watch::Recording;

const TABLE: &str = "replays.csv";
const COLUMNS: [&str; 8] = ["task", "method", "seed", "which", "episode", "return", "success", "file"];

/// A row of `replays.csv`: one recorded episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Replay {
    pub(super) task: String,
    pub(super) method: String,
    pub(super) seed: u64,
    pub(super) which: Which,
    /// Its number in the test, from 1, as in `tests.csv`.
    pub(super) episode: usize,
    /// Sum of rewards.
    #[serde(rename = "return")]
    pub(super) total: f64,
    /// Whether the task was fulfilled at the last step.
    pub(super) success: bool,
    /// The recording: JSON for the page of [`crate::watch`], compressed by gzip; relative to the table.
    pub(super) file: String,
}

/// Which episode of a test, by return.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Which {
    Median,
    Worst,
}

/// Records the episodes of a study's complete runs into `folder`, several at a time. What is there already, with the same return, stays.
/// Answers what could not be recorded, each with the reason.
///
/// # Errors
/// If a file cannot be written.
pub fn record(registry: &Registry, runs: &[(RunConfig, PathBuf)], folder: &Path) -> Result<Vec<String>> {
    // A table that cannot be read is written anew.
    let recorded = read(folder).unwrap_or_default();
    let episodes: Vec<(Replay, &Path)> = chosen(runs);
    let outcomes: Vec<Result<Replay>> = episodes
        .into_par_iter()
        .map(|(replay, run)| {
            let path = folder.join(&replay.file);
            if !(recorded.contains(&replay) && path.is_file()) {
                files::write(&path, &recording(registry, &replay, run)?)?;
            }
            Ok(replay)
        })
        .collect();
    let (mut rows, mut problems) = (Vec::new(), Vec::new());
    for outcome in outcomes {
        match outcome {
            Ok(replay) => rows.push(replay),
            Err(problem @ Error::Io { .. }) => return Err(problem),
            Err(problem) => problems.push(problem.to_string()),
        }
    }
    write_csv(&folder.join(TABLE), &COLUMNS, rows.iter())?;
    Ok(problems)
}

/// The recorded episodes of the study in a folder; none if it has no table of them.
///
/// # Errors
/// If the table is damaged.
pub(super) fn read(folder: &Path) -> Result<Vec<Replay>> {
    let path = folder.join(TABLE);
    if !path.exists() {
        return Ok(Vec::new());
    }
    rows(&path)
}

/// Copies the recordings to the folder of a report, if that is another.
///
/// # Errors
/// If a file cannot be read or written.
pub(super) fn copy(replays: &[Replay], from: &Path, to: &Path) -> Result<()> {
    for replay in replays.iter().filter(|_| to != from) {
        let there = from.join(&replay.file);
        files::write(&to.join(&replay.file), &std::fs::read(&there).map_err(Error::io("read", &there))?)?;
    }
    Ok(())
}

/// Joins the recordings of several studies in the folder `to`, except those of methods that more than one of them has: the median seed of
/// all is not known without the weights.
///
/// # Errors
/// If a file cannot be read or written.
pub(super) fn join(folders: &[PathBuf], to: &Path) -> Result<()> {
    let mut studies = Vec::new();
    for folder in folders {
        studies.push((folder, read(folder)?));
    }
    let alike = |a: &Replay, b: &Replay| (&a.task, &a.method) == (&b.task, &b.method);
    let with = |replay: &Replay| studies.iter().filter(|(_, of)| of.iter().any(|other| alike(other, replay))).count();
    let mut rows = Vec::new();
    for (folder, replays) in &studies {
        let own: Vec<Replay> = replays.iter().filter(|replay| with(replay) == 1).cloned().collect();
        copy(&own, folder, to)?;
        rows.extend(own);
    }
    write_csv(&to.join(TABLE), &COLUMNS, rows.iter())
}

/// The recorded episodes of a task, a row for each method.
pub(super) fn table(replays: &[Replay], task: &str) -> String {
    let of_task: Vec<&Replay> = replays.iter().filter(|replay| replay.task == task).collect();
    let link = |replay: &Replay| {
        let outcome = if replay.success { "success" } else { "no success" };
        let Replay { method, seed, episode, total, file, .. } = replay;
        format!("[{total:.1}, {outcome}]({file} \"{method} on {task}, seed {seed}, test episode {episode}\")")
    };
    let rows = of_task.iter().filter(|replay| replay.which == Which::Median).map(|median| {
        let worst = of_task.iter().find(|other| other.which == Which::Worst && other.method == median.method);
        let worst = worst.map_or("-".into(), |worst| link(worst));
        format!("| {} | {} | {} | {worst} |\n", median.method, median.seed, link(median))
    });
    let rows: String = rows.collect();
    if rows.is_empty() {
        return rows;
    }
    format!(
        "\nTwo test episodes of each method's median seed (by success, then return), which play in 3D in `report.html`: the one with the \
         median return and the one with the lowest. Lines from the hand are plans that the method compares.\n\n\
         | method | seed | median return | lowest return |\n| --- | --- | --- | --- |\n{rows}"
    )
}

fn rows<T: serde::de::DeserializeOwned>(path: &Path) -> Result<Vec<T>> {
    let mut reader = csv::Reader::from_path(path).map_err(Error::data(path))?;
    reader.deserialize().collect::<Result<_, _>>().map_err(Error::data(path))
}

/// The episodes to record, each with the folder of its run.
fn chosen(runs: &[(RunConfig, PathBuf)]) -> Vec<(Replay, &Path)> {
    struct Tested<'a> {
        config: &'a RunConfig,
        folder: &'a Path,
        /// Success rate, then mean return.
        quality: [f64; 2],
        results: Vec<EpisodeResult>,
    }
    let tested = runs.iter().filter(|(config, folder)| is_complete(folder, config)).filter_map(|(config, folder)| {
        let results = rows::<EpisodeResult>(&folder.join("test.csv")).ok()?;
        let summary = read_summary(folder).ok()?;
        let quality = [summary.success, summary.return_mean];
        (!results.is_empty()).then_some(Tested { config, folder, quality, results })
    });
    let mut methods: Vec<Vec<Tested>> = Vec::new();
    for run in tested {
        let key = |run: &Tested| (run.config.task.clone(), run.config.method.clone());
        match methods.iter_mut().find(|seeds| key(&seeds[0]) == key(&run)) {
            Some(seeds) => seeds.push(run),
            None => methods.push(vec![run]),
        }
    }
    let mut episodes = Vec::new();
    for mut seeds in methods {
        let middle = (seeds.len() - 1) / 2;
        seeds.sort_by(|a, b| a.quality.partial_cmp(&b.quality).expect("returns are finite"));
        let Tested { config, folder, results, .. } = seeds.swap_remove(middle);
        let mut order: Vec<usize> = (0..results.len()).collect();
        order.sort_by(|&a, &b| results[a].total.total_cmp(&results[b].total));
        for (which, name, at) in [(Which::Median, "median", (order.len() - 1) / 2), (Which::Worst, "worst", 0)] {
            let result = &results[order[at]];
            let replay = Replay {
                task: config.task.clone(),
                method: config.method.clone(),
                seed: config.seed,
                which,
                episode: order[at] + 1,
                total: result.total,
                success: result.success,
                file: format!("replays/{}-{}-{name}.json.gz", config.task, config.method),
            };
            episodes.push((replay, folder));
        }
    }
    episodes
}

/// Lets the run's agent act in the episode again, and compresses the recording.
///
/// # Errors
/// If the agent cannot be read, or does not get the return that stands in the run's test.
fn recording(registry: &Registry, replay: &Replay, run: &Path) -> Result<Vec<u8>> {
    let (config, mut method) = registry.trained_method(run)?;
    let (env, episode) = (registry.make_env(&config)?, replay.episode - 1);
    let title = format!("{}, {}, seed {}, test episode {}", replay.task, replay.method, replay.seed, replay.episode);
    let seed = config.starts.test().seed(episode)?;
    // In the place among the test's environments that it had: the random numbers of a planner depend on it.
    let recording = Recording::of_slot(title, env, &mut method, seed, episode % ENVS)?;
    let total = recording.total();
    if (total - replay.total).abs() > 1e-6 * (1.0 + replay.total.abs()) {
        return Err(Error::Config(format!(
            "{}: test episode {} has a return of {total} when it is recorded, and {} in `test.csv`; is this the program that made the run?",
            run.display(),
            replay.episode,
            replay.total
        )));
    }
    Ok(gzip(&recording.to_json()))
}
