//! A run's folder: who may write in it, whose run it holds, and what a resumed run starts from.

use std::fs::{File, OpenOptions, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::LazyLock;
use std::time::Duration;

use super::completed::{Completed, SUMMARY, checksum};
use super::config::{RunConfig, bad_config};
use super::evaluate::Summary;
use super::records::{Progress, TABLES, write_test};
use super::version::SOURCE;
use super::{tensorboard, version};
use crate::agent::Method;
use crate::checkpoint::Weights;
use crate::error::{Error, Result};
use crate::files;

pub(super) const CONFIG: &str = "config.toml";
pub(super) const CHECKPOINT: &str = "checkpoint/state.safetensors";
pub(super) const WEIGHTS: &str = "weights.safetensors";
pub(super) const LOCK: &str = ".lock";

/// The note in a checkpoint, and in weights, that holds the run's configuration.
const RUN: &str = "run";

/// The folder of a run that is open. It is locked: no other process, and no other [`RunFolder`] in this one, writes there.
pub(super) struct RunFolder {
    path: PathBuf,
    /// The system releases it when the process ends, however it ends.
    _lock: File,
}

impl RunFolder {
    /// Opens the folder for a run, new or begun.
    ///
    /// # Errors
    /// If it is open elsewhere, holds another run or weights without a checkpoint to go on from, or cannot be written.
    pub fn claim(path: &Path, config: &RunConfig) -> Result<Self> {
        // Before the sources can change under a run of hours.
        LazyLock::force(&SOURCE);
        let folder = Self { path: path.into(), _lock: lock(path)? };
        check_run(path, config)?;
        let [file, checkpoint, weights] = [CONFIG, CHECKPOINT, WEIGHTS].map(|file| path.join(file));
        if !checkpoint.exists() && weights.exists() {
            return Err(Error::Config(format!(
                "{}: trained weights without a checkpoint to go on from; choose another --out, or remove the folder to start anew",
                weights.display()
            )));
        }
        if !file.exists() {
            if checkpoint.exists() {
                check_own(&Weights::read(&checkpoint)?, &checkpoint, config)?;
            }
            files::write(&file, config.to_toml().as_bytes())?;
        }
        for place in [path.to_path_buf(), path.join("checkpoint")] {
            files::sweep(&place, Duration::ZERO);
        }
        Ok(folder)
    }

    /// Gives the method of this run its saved state, and returns how far the run had come. None if nothing was saved.
    ///
    /// # Errors
    /// If the checkpoint is damaged, or another run's.
    pub fn load(&self, config: &RunConfig, method: &mut Method) -> Result<Option<Progress>> {
        let path = self.path.join(CHECKPOINT);
        if !path.exists() {
            return Ok(None);
        }
        let state = Weights::read(&path)?;
        check_own(&state, &path, config)?;
        let foreign = |problem: Error| {
            let advice = format!("not a checkpoint of this run ({problem}); remove the folder to start anew");
            Error::checkpoint(&path, advice, Some(problem.into()))
        };
        let progress = state.note("progress").ok_or_else(|| foreign(Error::Config("it tells no progress".into())))?;
        let progress = toml::from_str(progress)
            .map_err(|problem| foreign(Error::Config(format!("its progress: {}", problem.message()))))?;
        if config.learns() {
            check_saved(&state, &path)?;
        }
        let checkpoint = method.checkpoint_mut();
        checkpoint.load_weights(&state.extract("weights.")).map_err(foreign)?;
        checkpoint.load_training_state(&state).map_err(foreign)?;
        Ok(Some(progress))
    }

    /// Writes the checkpoint, the weights of a method that learns, and the tables.
    ///
    /// # Errors
    /// If a file cannot be written; what was written before is then still there.
    pub fn save(
        &self,
        config: &RunConfig,
        mut weights: Weights,
        mut state: Weights,
        progress: &Progress,
    ) -> Result<()> {
        state.absorb("weights.", &weights);
        // TOML, since JSON has no word for a likelihood or a loss that is not a number.
        state.set_note("progress", toml::to_string(progress).expect("progress is TOML"));
        state.set_note(RUN, config.to_toml());
        state.write(&self.path.join(CHECKPOINT))?;
        if config.learns() {
            weights.set_note(RUN, config.to_toml());
            weights.write(&self.path.join(WEIGHTS))?;
        }
        progress.write_tables(&self.path)?;
        tensorboard::write(&self.path, progress)
    }

    /// Writes the results of the test, which complete the run.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn complete(&self, config: &RunConfig, progress: &Progress) -> Result<()> {
        let test = &progress.test;
        write_test(&self.path, test)?;
        let files = TABLES.into_iter().chain(config.learns().then_some(WEIGHTS));
        let checksums = files.map(|file| Ok((file.into(), checksum(&self.path.join(file))?)));
        let checksums = checksums.collect::<Result<_>>()?;
        // What is lost of a complete run may be written anew by a later version, which has not made it.
        let made_by = Completed::read(&self.path).ok().map(|run| run.version).filter(|version| !version.is_empty());
        let version = made_by.unwrap_or_else(|| version::joined(&progress.versions));
        let completed = Completed { version, summary: test.summary(), checksums };
        let completed = toml::to_string(&completed).expect("a summary is TOML");
        files::write(&self.path.join(SUMMARY), completed.as_bytes())
    }
}

/// # Errors
/// If the folder holds another run.
pub(crate) fn check_run(folder: &Path, config: &RunConfig) -> Result<()> {
    let file = folder.join(CONFIG);
    let there = if file.exists() { RunConfig::read(&file)? } else { return Ok(()) };
    match difference(&there.to_table(), &config.to_table()) {
        None => Ok(()),
        Some(difference) => Err(Error::Config(format!(
            "{}: this folder holds another run ({difference}); choose another --out, or remove it",
            file.display()
        ))),
    }
}

/// Whether a folder holds this run, complete with its tables and weights. What is lost or damaged can be written anew from the
/// checkpoint, by opening the run; without a checkpoint the run has ended as it is.
pub fn is_complete(folder: &Path, config: &RunConfig) -> bool {
    let this_run = RunConfig::read(&folder.join(CONFIG)).is_ok_and(|there| there == *config);
    let intact = |run: Completed| !folder.join(CHECKPOINT).is_file() || run.changed(folder, "").is_none();
    this_run && Completed::read(folder).is_ok_and(intact)
}

/// The results of a complete run's test.
///
/// # Errors
/// If there are none, or they are damaged.
pub fn read_summary(folder: &Path) -> Result<Summary> {
    Ok(Completed::read(folder)?.summary)
}

/// The version of the program that completed the run in a folder; empty if that is not known.
#[cfg(feature = "study")]
pub(super) fn version(folder: &Path) -> String {
    Completed::read(folder).map(|run| run.version).unwrap_or_default()
}

/// # Errors
/// If the tables of a complete run are not those that it ended with.
#[cfg(feature = "study")]
pub(super) fn check_tables(folder: &Path) -> Result<()> {
    match Completed::read(folder).ok().and_then(|run| run.changed(folder, ".csv")) {
        None => Ok(()),
        Some(path) => {
            let advice = match folder.join(CHECKPOINT).is_file() {
                true => "the command that made the run writes it anew",
                false => "restore it, or remove the run's folder and carry the run out again",
            };
            Err(Error::data(&path)(format!("it was lost or changed after the run had ended; {advice}")))
        }
    }
}

/// The configuration of the run in a folder.
///
/// # Errors
/// If there is none, or it is damaged.
pub(super) fn read_config(folder: &Path) -> Result<(PathBuf, RunConfig)> {
    let path = folder.join(CONFIG);
    if folder.is_file() || !path.try_exists().map_err(Error::io("read", &path))? {
        let advice = "there is no run; give a folder that has a config.toml, such as runs/quick/reach/sac/seed0";
        return Err(Error::Config(format!("cannot read {}: {advice}", folder.display())));
    }
    let config = RunConfig::read(&path)?;
    Ok((path, config))
}

/// Gives a method what the run in a folder has learned.
///
/// # Errors
/// If the weights are missing, damaged, or those of another run.
pub(super) fn load_weights(folder: &Path, config: &RunConfig, method: &mut Method) -> Result<()> {
    let (path, weights) = read_weights(folder, config)?;
    let loaded = method.checkpoint_mut().load_weights(&weights);
    loaded.map_err(|problem| Error::checkpoint(&path, problem.to_string(), Some(problem.into())))
}

/// # Errors
/// If the weights are missing, damaged, or those of another run.
pub(super) fn read_weights(folder: &Path, config: &RunConfig) -> Result<(PathBuf, Weights)> {
    let path = folder.join(WEIGHTS);
    if !path.exists() {
        let advice = "there are no weights; if the run has saved none yet, let it train for longer";
        return Err(Error::Config(format!("{}: {advice}", folder.display())));
    }
    let weights = Weights::read(&path).map_err(|problem| match problem {
        // Checkpoints hold the weights, too.
        Error::Checkpoint { .. } if folder.join(CHECKPOINT).is_file() => {
            Error::checkpoint(&path, "damaged; the command that made the run writes it anew", Some(problem.into()))
        }
        problem => problem,
    })?;
    check_own(&weights, &path, config)?;
    check_saved(&weights, &path)?;
    Ok((path, weights))
}

/// # Errors
/// If an agent that learns has saved nothing: it could only act as if it had learned nothing.
fn check_saved(weights: &Weights, path: &Path) -> Result<()> {
    if weights.is_empty() {
        let advice = "this agent saves nothing, so its run can neither be resumed nor used; \
                      implement its `Checkpoint`, and remove the folder to start anew";
        return Err(Error::checkpoint(path, advice, None));
    }
    Ok(())
}

/// # Errors
/// If a checkpoint or weights are another run's. (Those of the first edition do not say whose they are.)
fn check_own(weights: &Weights, path: &Path, config: &RunConfig) -> Result<()> {
    if let Some(text) = weights.note(RUN) {
        let theirs = RunConfig::from_toml(text).map_err(|problem| bad_config(path, &problem))?;
        if let Some(difference) = difference(&theirs.to_table(), &config.to_table()) {
            let advice = format!(
                "it belongs to another run ({difference}), or {CONFIG} was changed since; put back what belongs to this run"
            );
            return Err(Error::checkpoint(path, advice, None));
        }
    }
    Ok(())
}

/// # Errors
/// If another holds the lock, or the folder cannot be written.
fn lock(folder: &Path) -> Result<File> {
    if folder.is_symlink() && !folder.exists() || folder.is_file() {
        return Err(Error::Config(format!("{}: this is not a folder; choose another --out", folder.display())));
    }
    std::fs::create_dir_all(folder).map_err(Error::io("create", folder))?;
    let path = folder.join(LOCK);
    let file = OpenOptions::new().create(true).append(true).open(&path).map_err(Error::io("write", &path))?;
    let mut locked = file.try_lock();
    for _ in 0..5 {
        if !matches!(locked, Err(TryLockError::WouldBlock)) {
            break;
        }
        // `is_open` takes the lock for a moment.
        std::thread::sleep(Duration::from_millis(10));
        locked = file.try_lock();
    }
    match locked {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(Error::Config(format!(
            "{}: this run is being carried out elsewhere; wait until that ends, or choose another --out",
            folder.display()
        ))),
        // Some network file systems have no locks.
        Err(TryLockError::Error(problem)) if problem.kind() == std::io::ErrorKind::Unsupported => Ok(file),
        Err(TryLockError::Error(problem)) => Err(Error::io("lock", &path)(problem)),
    }
}

/// Whether a process has the run in a folder open.
pub(super) fn is_open(folder: &Path) -> bool {
    File::open(folder.join(LOCK)).is_ok_and(|file| matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock)))
}

/// Whether a folder holds a run that has begun and not ended.
#[cfg(feature = "cli")]
pub(crate) fn is_unfinished(folder: &Path) -> bool {
    folder.join(CHECKPOINT).exists() && !folder.join(SUMMARY).exists()
}

/// The first setting in which two configurations differ.
pub(super) fn difference(there: &toml::Table, wanted: &toml::Table) -> Option<String> {
    difference_in("", there, wanted)
}

/// The same for settings whose names begin with `path`.
pub(super) fn difference_in(path: &str, there: &toml::Table, wanted: &toml::Table) -> Option<String> {
    let key = there.keys().chain(wanted.keys()).find(|key| there.get(*key) != wanted.get(*key))?;
    let name = format!("{path}{key}");
    match (there.get(key), wanted.get(key)) {
        (Some(toml::Value::Table(there)), Some(toml::Value::Table(wanted))) => {
            difference_in(&format!("{name}."), there, wanted)
        }
        (there, wanted) => {
            let show = |value: Option<&toml::Value>| value.map_or("nothing".into(), ToString::to_string);
            Some(format!("its `{name}` is {}, not {}", show(there), show(wanted)))
        }
    }
}
