//! The episodes that a report shows in 3D: of each method's median seed, the test episode with the median return and the one with
//! the lowest. Weights are not in a study's tables, so the episodes are recorded when the study ends, next to the tables.

use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use flate2::read::GzDecoder;
use rayon::iter::{IntoParallelIterator, ParallelIterator};
use serde::{Deserialize, Serialize};

use super::config::RunConfig;
use super::evaluate::{ENVS, EpisodeResult};
use super::folder::{is_complete, read_summary};
use super::names::{check_name, excerpt};
use super::page::gzip;
use super::records::write_csv;
use super::registry::Registry;
use super::tables::Tables;
use super::verdict::listed;
use crate::error::{Error, Result};
use crate::files;
use crate::watch::Recording;

const TABLE: &str = "replays.csv";
/// Where the recordings are, beside the table.
pub(super) const FOLDER: &str = "replays";
const COLUMNS: [&str; 8] = ["task", "method", "seed", "which", "episode", "return", "success", "file"];
/// More bytes than a recording has when it is unpacked.
const LARGEST: u64 = 1 << 28;

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

impl Replay {
    /// What the recording is called.
    fn title(&self) -> String {
        format!("{}, {}, seed {}, test episode {}", self.task, self.method, self.seed, self.episode)
    }

    /// Whether this is the return of the episode, apart from rounding.
    fn has_return(&self, total: f64) -> bool {
        (total - self.total).abs() <= 1e-6 * (1.0 + self.total.abs())
    }

    /// Reads the recording of this episode from the folder of the table.
    ///
    /// # Errors
    /// If the file cannot be read, or is another recording.
    fn recorded(&self, folder: &Path) -> Result<Vec<u8>> {
        #[derive(Deserialize)]
        struct Recorded {
            title: String,
            frames: Vec<Frame>,
        }
        #[derive(Deserialize)]
        struct Frame {
            reward: f32,
        }
        let path = folder.join(&self.file);
        let bytes = std::fs::read(&path).map_err(Error::io("read", &path))?;
        let mut json = Vec::new();
        GzDecoder::new(bytes.as_slice()).take(LARGEST).read_to_end(&mut json).map_err(Error::io("unpack", &path))?;
        let there: Recorded = serde_json::from_slice(&json).map_err(Error::data(&path))?;
        let total: f64 = there.frames.iter().map(|frame| f64::from(frame.reward)).sum();
        if there.title != self.title() || !self.has_return(total) {
            let (title, wanted) = (excerpt(&there.title), self.title());
            return Err(Error::data(&path)(format!(
                "this is a recording of `{title}` with the return {total}, not of `{wanted}` with {}",
                self.total
            )));
        }
        Ok(bytes)
    }
}

/// Records the episodes of a study's complete runs into `folder`, several at a time. What is recorded already, with the same return, stays.
/// Returns what could not be recorded, each with the reason. If `stop` becomes true, no further recording is begun.
///
/// # Errors
/// If a file cannot be written; [`Error::Interrupted`] if it was stopped.
pub fn record(
    registry: &Registry,
    runs: &[(RunConfig, PathBuf)],
    folder: &Path,
    stop: &AtomicBool,
) -> Result<Vec<String>> {
    // A table that cannot be read is written anew.
    let recorded = read(folder).unwrap_or_default();
    let episodes: Vec<(Replay, &Path)> = chosen(runs);
    let outcomes: Vec<Result<Option<Replay>>> = episodes
        .into_par_iter()
        .map(|(replay, run)| {
            if !recorded.contains(&replay) || replay.recorded(folder).is_err() {
                if stop.load(Ordering::Relaxed) {
                    return Err(Error::Interrupted);
                }
                let Some(bytes) = recording(registry, &replay, run)? else { return Ok(None) };
                files::write(&folder.join(&replay.file), &bytes)?;
            }
            Ok(Some(replay))
        })
        .collect();
    let (mut rows, mut problems) = (Vec::new(), Vec::new());
    for outcome in outcomes {
        match outcome {
            Ok(replay) => rows.extend(replay),
            Err(problem @ (Error::Io { .. } | Error::Interrupted)) => return Err(problem),
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
fn read(folder: &Path) -> Result<Vec<Replay>> {
    let path = folder.join(TABLE);
    if !path.exists() {
        return Ok(Vec::new());
    }
    let mut reader = csv::Reader::from_path(&path).map_err(Error::data(&path))?;
    let header = reader.headers().map_err(Error::data(&path))?.clone();
    let mut replays = Vec::new();
    for row in reader.records() {
        let row = row.map_err(Error::data(&path))?;
        let line = row.position().map_or(0, csv::Position::line);
        let replay: Replay = row.deserialize(Some(&header)).map_err(Error::data(&path))?;
        check(&replay).map_err(|problem| Error::data(&path)(format!("line {line}: {problem}")))?;
        replays.push(replay);
    }
    Ok(replays)
}

/// # Errors
/// If the names could do harm: they become text of the report, and the file is read and written.
fn check(replay: &Replay) -> Result<()> {
    check_name("a task", &replay.task)?;
    check_name("a method", &replay.method)?;
    let name = replay.file.strip_prefix(FOLDER).and_then(|file| file.strip_prefix('/')?.strip_suffix(".json.gz"));
    let plain = |name: &str| name.chars().all(|c| c.is_ascii_alphanumeric() || c == '-' || c == '_');
    if name.is_some_and(|name| !name.is_empty() && plain(name)) {
        return Ok(());
    }
    Err(Error::Config(format!(
        "`file` is `{}`; it must be `replays/NAME.json.gz`, with letters (A to Z), digits, `-` and `_` in the name",
        excerpt(&replay.file)
    )))
}

/// The recordings of a study in the folder of its report, to which they are copied if that is another. Returns which are there, and what is
/// wrong with the others.
///
/// # Errors
/// If the table of recordings is damaged, or a file cannot be written.
pub(super) fn of_report(tables: &Tables, from: &Path, to: &Path) -> Result<(Vec<Replay>, Vec<String>)> {
    let (mut tested, mut problems) = (Vec::new(), Vec::new());
    for replay in read(from)? {
        let total = tables.test_return(&replay.task, &replay.method, replay.seed, replay.episode)?;
        if total.is_some_and(|total| replay.has_return(total)) {
            tested.push(replay);
        } else {
            problems.push(format!("{}: `{}` is not in the tests", from.join(TABLE).display(), replay.title()));
        }
    }
    let (there, others) = copy(tested, from, to)?;
    problems.extend(others);
    Ok((there, problems))
}

/// Copies the recordings to another folder, if it is another. Returns which are there, and what is wrong with the others.
///
/// # Errors
/// If a file cannot be written.
fn copy(replays: Vec<Replay>, from: &Path, to: &Path) -> Result<(Vec<Replay>, Vec<String>)> {
    let (mut there, mut problems) = (Vec::new(), Vec::new());
    for replay in replays {
        match replay.recorded(from) {
            Err(problem) => problems.push(problem.to_string()),
            Ok(bytes) => {
                if to != from {
                    files::write(&to.join(&replay.file), &bytes)?;
                }
                there.push(replay);
            }
        }
    }
    Ok((there, problems))
}

/// Joins the recordings of several studies in the folder `to`, except those of methods that more than one of them has: the median seed of
/// all is not known without the weights. Returns what is wrong with recordings that cannot be used.
///
/// # Errors
/// If a table of recordings is damaged, or a file cannot be written.
pub(super) fn join(folders: &[PathBuf], to: &Path) -> Result<Vec<String>> {
    let mut studies = Vec::new();
    for folder in folders {
        studies.push((folder, Tables::read(folder)?.tasks_and_methods()?, read(folder)?));
    }
    let with = |replay: &Replay| {
        let method = (replay.task.clone(), replay.method.clone());
        studies.iter().filter(|(_, methods, _)| methods.contains(&method)).count()
    };
    let (mut rows, mut problems) = (Vec::new(), Vec::new());
    for (folder, _, replays) in &studies {
        let own = replays.iter().filter(|replay| with(replay) == 1).cloned().collect();
        let (there, others) = copy(own, folder, to)?;
        rows.extend(there);
        problems.extend(others);
    }
    write_csv(&to.join(TABLE), &COLUMNS, rows.iter())?;
    Ok(problems)
}

/// The recorded episodes of a task, a row for each of these methods that has any.
pub(super) fn table(replays: &[Replay], task: &str, methods: &[String]) -> String {
    let of_task: Vec<&Replay> = replays.iter().filter(|replay| replay.task == task).collect();
    let link = |replay: &Replay| {
        let outcome = if replay.success { "success" } else { "no success" };
        let Replay { method, seed, episode, total, file, .. } = replay;
        format!("[{total:.1}, {outcome}]({file} \"{method} on {task}, seed {seed}, test episode {episode}\")")
    };
    // One of the two may be missing.
    let first_of_method =
        |(i, replay): &(usize, &&Replay)| of_task[..*i].iter().all(|other| other.method != replay.method);
    let rows = of_task.iter().enumerate().filter(first_of_method).map(|(_, Replay { method, seed, .. })| {
        let [median, worst] = [Which::Median, Which::Worst].map(|which| {
            let replay = of_task.iter().find(|other| other.which == which && other.method == *method);
            replay.map_or("-".into(), |replay| link(replay))
        });
        format!("| {method} | {seed} | {median} | {worst} |\n")
    });
    let rows: String = rows.collect();
    if rows.is_empty() {
        return rows;
    }
    let without = methods.iter().filter(|method| of_task.iter().all(|replay| replay.method != **method));
    let without: Vec<String> = without.map(|method| format!("`{method}`")).collect();
    let without =
        if without.is_empty() { String::new() } else { format!(" There is no replay of {}.", listed(&without)) };
    format!(
        "\nTwo test episodes of the median seed (by success, then return) of each method below, which play in 3D in `report.html`: the one \
         with the median return and the one with the lowest. Lines from the hand are plans that the method compares.{without}\n\n\
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
        seeds.sort_by(|a, b| a.quality.partial_cmp(&b.quality).expect("means of a complete run are finite"));
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
                file: format!("{FOLDER}/{}-{}-{name}.json.gz", config.task, config.method),
            };
            episodes.push((replay, folder));
        }
    }
    episodes
}

/// Lets the run's agent act in the episode again, and compresses the recording. None if it shows nothing.
///
/// # Errors
/// If the agent cannot be read, or does not get the return that stands in the run's test.
fn recording(registry: &Registry, replay: &Replay, run: &Path) -> Result<Option<Vec<u8>>> {
    let (config, mut method) = registry.trained_method(run)?;
    let (env, episode) = (registry.make_env(&config)?, replay.episode - 1);
    let seed = config.starts.test().seed(episode)?;
    // In the place among the test's environments that it had: the random numbers of a planner depend on it.
    let recording = Recording::of_slot(replay.title(), env, &mut method, seed, episode % ENVS)?;
    let total = recording.total();
    if !replay.has_return(total) {
        return Err(Error::Config(format!(
            "{}: test episode {} has a return of {total} when it is recorded, and {} in `test.csv`; is this the program that made the run?",
            run.display(),
            replay.episode,
            replay.total
        )));
    }
    Ok(recording.is_visible().then(|| gzip(&recording.to_json())))
}
