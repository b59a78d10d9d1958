//! A study: every method on every task with every seed, side by side, resumable.

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use super::config::RunConfig;
use super::run::{self, Event, Run};
use crate::env::Task;
use crate::error::{Error, Result};

/// How much a study takes on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Profile {
    /// A few minutes: `reach`, two seeds.
    Quick,
    /// The whole comparison: hours.
    Full,
}

/// What is compared.
#[derive(Clone, Debug)]
pub struct StudyPlan {
    /// The tasks.
    pub tasks: Vec<Task>,
    /// The methods, by the names of their presets.
    pub methods: Vec<String>,
    /// The seeds of each.
    pub seeds: std::ops::Range<u64>,
    /// Where everything is written.
    pub folder: PathBuf,
}

impl StudyPlan {
    /// What a profile takes on, unless told otherwise.
    pub fn new(profile: Profile, folder: PathBuf) -> Self {
        let named = |methods: &[&str]| methods.iter().map(ToString::to_string).collect();
        match profile {
            Profile::Quick => Self {
                tasks: vec![Task::Reach],
                methods: named(&["random", "scripted", "oracle", "pets", "dreamer", "sac"]),
                seeds: 0..2,
                folder,
            },
            Profile::Full => Self {
                tasks: vec![Task::Reach, Task::Push, Task::Lift],
                methods: named(&["random", "scripted", "oracle", "pets", "dreamer", "sac"]),
                seeds: 0..5,
                folder,
            },
        }
    }

    /// The runs, each with its folder. A method that does not learn runs once.
    ///
    /// # Errors
    /// If there is nothing to run, or a method or task is unknown.
    pub fn runs(&self) -> Result<Vec<(RunConfig, PathBuf)>> {
        if self.seeds.is_empty() {
            return Err(Error::BadSetting(format!(
                "no seeds in {}..{}; give a number of seeds, or a range like 0..5",
                self.seeds.start, self.seeds.end
            )));
        }
        if self.tasks.is_empty() || self.methods.is_empty() {
            return Err(Error::BadSetting("a study needs at least one task and one method".into()));
        }
        let mut runs = Vec::new();
        for &task in &self.tasks {
            for method in &self.methods {
                for seed in self.seeds.clone() {
                    let config = RunConfig::new(task, method, seed, None, None)?;
                    // Finds out now, not hours later, whether the method can be used for the task.
                    config.agent()?;
                    let folder = self.folder.join(task.name()).join(method).join(format!("seed{seed}"));
                    let learns = config.learns();
                    runs.push((config, folder));
                    if !learns {
                        break;
                    }
                }
            }
        }
        Ok(runs)
    }
}

/// Someone who wants to know how the runs go. Calls come from several threads.
pub trait Observer: Sync {
    /// A run begins, or goes on after `done` steps.
    fn started(&self, run: usize, config: &RunConfig, done: usize);
    /// Something happened in a run that has done so many steps.
    fn happened(&self, run: usize, config: &RunConfig, done: usize, event: &Event);
}

/// Carries one run to its end, or until `stop` is set: then the present episode is finished, the run is
/// saved, and the answer is [`Error::Interrupted`].
///
/// # Errors
/// What the run answers, and [`Error::Interrupted`].
pub fn carry_out(
    index: usize,
    config: &RunConfig,
    folder: &Path,
    observer: &dyn Observer,
    stop: &AtomicBool,
) -> Result<()> {
    let mut run = Run::open(config.clone(), folder)?;
    observer.started(index, config, run.steps_done());
    loop {
        if stop.load(Ordering::Relaxed) && run.between_episodes() {
            run.save()?;
            return Err(Error::Interrupted);
        }
        let event = run.step()?;
        observer.happened(index, config, run.steps_done(), &event);
        if matches!(event, Event::Tested(_)) {
            return Ok(());
        }
    }
}

/// Carries out all runs that are not complete yet, `jobs` at a time, each with its share of the cores.
///
/// # Errors
/// The first error of a run; the others are then stopped and saved.
pub fn carry_out_all(
    runs: &[(RunConfig, PathBuf)],
    jobs: usize,
    observer: &dyn Observer,
    stop: &AtomicBool,
) -> Result<()> {
    let next = AtomicUsize::new(0);
    let failure = Mutex::new(None);
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        for _ in 0..jobs.clamp(1, runs.len().max(1)) {
            scope.spawn(|| {
                let pool = rayon::ThreadPoolBuilder::new()
                    .num_threads((cores / jobs).max(1))
                    .build()
                    .expect("threads for a run");
                while let Some((config, folder)) = runs.get(next.fetch_add(1, Ordering::SeqCst)) {
                    if run::is_complete(folder)
                        && RunConfig::read(&folder.join("config.toml")).is_ok_and(|c| c == *config)
                    {
                        continue;
                    }
                    let index = runs.iter().position(|(_, other)| other == folder).expect("a run of this study");
                    if let Err(error) = pool.install(|| carry_out(index, config, folder, observer, stop)) {
                        // First the reason, then the signal: the others will answer that they were interrupted.
                        failure.lock().expect("no panic holds it").get_or_insert(error);
                        stop.store(true, Ordering::Relaxed);
                        return;
                    }
                }
            });
        }
    });
    failure.into_inner().expect("no panic holds it").map_or(Ok(()), Err)
}
