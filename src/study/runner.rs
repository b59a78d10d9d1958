//! A study: every method on every task with every seed, side by side, resumable.

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use super::config::RunConfig;
use super::registry::{QuickStudy, Registry};
use super::run::{Event, is_complete};
use super::starts::{LIMIT, check_below};
use crate::error::{Error, Result};

/// The largest number of runs in a study: guards against a mistyped range of seeds.
pub const MOST_RUNS: u64 = 100_000;

/// The size of a study.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Profile {
    /// A few minutes: what [`Registry::quick_study`] says, two seeds.
    Quick,
    /// The whole comparison: hours.
    Full,
}

/// The size of every run: limits on what its preset says, and an evaluation interval in place of the preset's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// Environment steps of a run, at most.
    pub steps: usize,
    /// Environment steps from one evaluation to the next, whatever the preset says.
    pub evaluate_every: usize,
    /// Episodes of an evaluation, at most.
    pub evaluation_episodes: usize,
    /// Episodes of the test, at most.
    pub test_episodes: usize,
}

/// What is compared.
#[derive(Clone, Debug)]
pub struct StudyPlan {
    /// The tasks.
    pub tasks: Vec<String>,
    /// The methods, by the names of their presets.
    pub methods: Vec<String>,
    /// The seeds of each.
    pub seeds: std::ops::Range<u64>,
    /// A budget for all runs; without one, each has that of its preset.
    pub budget: Option<Budget>,
    /// Where everything is written.
    pub folder: PathBuf,
}

impl StudyPlan {
    /// What a profile takes on.
    pub fn new(registry: &Registry, profile: Profile, folder: PathBuf) -> Self {
        let named = |names: &[&str]| names.iter().map(ToString::to_string).collect();
        match profile {
            Profile::Quick => {
                let QuickStudy { tasks, methods, budget } = registry.quick_study.clone();
                Self { tasks, methods, seeds: 0..2, budget, folder }
            }
            Profile::Full => Self {
                tasks: named(&["reach", "push", "lift"]),
                methods: named(&["random", "scripted", "oracle", "pets", "pets-learned", "dreamer", "tdmpc2", "sac"]),
                seeds: 0..5,
                budget: None,
                folder,
            },
        }
    }

    /// The same plan for other tasks. Its budget falls away: a profile's is one for its own tasks.
    #[must_use]
    pub fn with_tasks(self, tasks: Vec<String>) -> Self {
        Self { tasks, budget: None, ..self }
    }

    /// The runs, each with its folder. A method that does not learn runs once.
    ///
    /// # Errors
    /// If there is nothing to run, something is to be run twice, there are more than [`MOST_RUNS`], a seed is not below [`LIMIT`],
    /// or a method or task is unknown.
    pub fn runs(&self, registry: &Registry) -> Result<Vec<(RunConfig, PathBuf)>> {
        if self.seeds.is_empty() {
            return Err(Error::Config(format!(
                "no seeds in {}..{}; give a number of seeds, or a range like 0..5",
                self.seeds.start, self.seeds.end
            )));
        }
        check_below("seed", self.seeds.end - 1, LIMIT)?;
        if self.tasks.is_empty() || self.methods.is_empty() {
            return Err(Error::Config("a study needs at least one task and one method".into()));
        }
        for (what, names) in [("task", &self.tasks), ("method", &self.methods)] {
            if let Some(twice) =
                names.iter().enumerate().find_map(|(i, name)| names[..i].contains(name).then_some(name))
            {
                return Err(Error::Config(format!("the {what} `{twice}` is named twice; name it once")));
            }
        }
        let pairs = self.tasks.len() * self.methods.len();
        let most = pairs as u64 * (self.seeds.end - self.seeds.start);
        if most > MOST_RUNS {
            return Err(Error::Config(format!(
                "{} tasks, {} methods and {} seeds are {most} runs; a study has at most {MOST_RUNS}: take fewer seeds",
                self.tasks.len(),
                self.methods.len(),
                self.seeds.end - self.seeds.start
            )));
        }
        let mut runs = Vec::new();
        for (task, method) in self.tasks.iter().flat_map(|task| self.methods.iter().map(move |method| (task, method))) {
            let mut config = registry.config(task, method, self.seeds.start, None, None)?;
            if let Some(Budget { steps, evaluate_every, evaluation_episodes, test_episodes }) = self.budget {
                config.steps = config.steps.min(steps);
                config.evaluate_every = evaluate_every;
                config.evaluation_episodes = config.evaluation_episodes.min(evaluation_episodes);
                config.test_episodes = config.test_episodes.min(test_episodes);
                config.check()?;
            }
            // Finds out now, not hours later, whether the method can be used for the task.
            registry.method(&config)?;
            let seeds = if config.learns() { self.seeds.clone() } else { self.seeds.start..self.seeds.start + 1 };
            runs.extend(seeds.map(|seed| {
                let folder = run_folder(&self.folder, task, method, seed);
                (RunConfig { seed, ..config.clone() }, folder)
            }));
        }
        Ok(runs)
    }
}

/// The folder of a run in that of its study.
pub(crate) fn run_folder(study: &Path, task: &str, method: &str, seed: u64) -> PathBuf {
    study.join(task).join(method).join(format!("seed{seed}"))
}

/// Receives the progress of the runs; `&()` ignores it. Calls come from several threads.
pub trait StudyObserver: Sync {
    /// A run begins, or goes on after `done` steps.
    fn started(&self, _run: usize, _config: &RunConfig, _done: usize) {}
    /// Something happened in a run, after `done` environment steps.
    fn happened(&self, _run: usize, _config: &RunConfig, _done: usize, _event: &Event) {}
    /// A run has failed for a reason of its own, and the others go on.
    fn failed(&self, _run: usize, _problem: &Error) {}
}

impl StudyObserver for () {}

/// Carries one run to its end, or until `stop` is set: then the present episode is finished, the run is
/// saved, and [`Error::Interrupted`] is returned.
///
/// # Errors
/// Any error of the run, and [`Error::Interrupted`].
pub fn carry_out(
    registry: &Registry,
    index: usize,
    config: &RunConfig,
    folder: &Path,
    observer: &dyn StudyObserver,
    stop: &AtomicBool,
) -> Result<()> {
    let mut run = registry.open_run(config, folder)?;
    observer.started(index, config, run.steps_done());
    loop {
        if stop.load(Ordering::Relaxed) && run.between_episodes() {
            run.save()?;
            return Err(Error::Interrupted);
        }
        let event = match run.step() {
            Ok(event) => event,
            Err(problem) => {
                // What was learned so far is kept, if it can be; the first error is the one to tell.
                let _ = run.save();
                return Err(problem);
            }
        };
        observer.happened(index, config, run.steps_done(), &event);
        if matches!(event, Event::Tested(_)) {
            return Ok(());
        }
    }
}

/// Carries out all runs that are not complete yet, `jobs` at a time, each with its share of the cores. If a run fails for a reason of its
/// own, the others go on: if it diverges, its environment fails or breaks its contract, or its agent acts in a way that is refused.
///
/// # Errors
/// [`Error::Run`] for the first run that failed so, when the others are complete. Any other error of a run, such as a full disk; `stop`
/// is then set, and stays set: the other runs end with their episode and are saved.
pub fn carry_out_all(
    registry: &Registry,
    runs: &[(RunConfig, PathBuf)],
    jobs: usize,
    observer: &dyn StudyObserver,
    stop: &AtomicBool,
) -> Result<()> {
    let jobs = jobs.clamp(1, runs.len().max(1));
    let next = AtomicUsize::new(0);
    let (failure, failed_run) = (Mutex::new(None), Mutex::new(None));
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        for _ in 0..jobs {
            scope.spawn(|| {
                let fail = |error: Error| {
                    // First the reason, then the signal: the others will answer that they were interrupted.
                    failure.lock().expect("no panic holds it").get_or_insert(error);
                    stop.store(true, Ordering::Relaxed);
                };
                let pool = rayon::ThreadPoolBuilder::new().num_threads((cores / jobs).max(1)).build();
                let pool = match pool {
                    Ok(pool) => pool,
                    Err(problem) => return fail(Error::Config(format!("cannot start threads for a run: {problem}"))),
                };
                loop {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    let Some((config, folder)) = runs.get(index) else { break };
                    if is_complete(folder, &registry.as_begun(config, folder)) {
                        continue;
                    }
                    match pool.install(|| carry_out(registry, index, config, folder, observer, stop)) {
                        Ok(()) => {}
                        Err(problem) if is_its_own(&problem) => {
                            observer.failed(index, &problem);
                            let error = Error::Run { folder: folder.clone(), source: Box::new(problem) };
                            failed_run.lock().expect("no panic holds it").get_or_insert(error);
                        }
                        Err(problem) => return fail(problem),
                    }
                }
            });
        }
    });
    let [failure, failed_run] = [failure, failed_run].map(|error| error.into_inner().expect("no panic holds it"));
    failure.or(failed_run).map_or(Ok(()), Err)
}

/// Whether an error says nothing about the other runs of a study.
fn is_its_own(problem: &Error) -> bool {
    use Error::{Action, Contract, Diverged, Environment};
    matches!(problem, Diverged { .. } | Contract { .. } | Environment { .. } | Action { .. })
}
