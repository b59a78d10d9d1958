//! One run: a method learns a task, is evaluated on the way and tested at the end; all of it in a folder that survives
//! crashes and can be resumed.
//!
//! The folder holds `config.toml`, the tables of [`records`](super::records), `weights.safetensors`, and
//! `checkpoint/state.safetensors`, the one file that a resumed run starts from. Every file is written under a temporary
//! name and renamed; checkpoint and weights know whose they are, and have a checksum. One process at a time has the folder
//! open.
//!
//! ```
//! use handful::prelude::*;
//! use handful::study::run::Event;
//!
//! let registry = Registry::standard();
//! let config = registry.config("pendulum", "debug", 0, None, None)?;
//! let folder = tempfile::tempdir().expect("a folder");
//! // The same call resumes the run, should it have been stopped.
//! let mut run = registry.open_run(&config, folder.path())?;
//! while !matches!(run.step()?, Event::Tested(_)) {}
//! let (_, mut method) = registry.trained_method(folder.path())?;
//! assert!(method.as_learner().is_some());
//! # Ok::<(), Error>(())
//! ```

use std::path::Path;
use std::time::{Duration, Instant};

use super::config::RunConfig;
use super::evaluate::{Evaluation, Evaluator};
pub use super::export::export;
use super::folder::RunFolder;
#[cfg(feature = "cli")]
pub(crate) use super::folder::check_run;
#[cfg(feature = "cli")]
pub(crate) use super::folder::is_unfinished;
pub use super::folder::{is_complete, read_summary};
use super::records::{EpisodeRow, EvaluationRow, ModelRow, Progress, ValueRow};
use super::starts::training_seed;
use super::version::SOURCE;
use crate::agent::{Method, Mode};
use crate::checkpoint::Weights;
use crate::env::Env;
use crate::env::contract::Checked;
use crate::error::{Error, Result};
use crate::replay::Transition;

/// A checkpoint is due after this many times as long as it takes to write one, so that a crash loses little and writing costs
/// little; but not before the first of these durations, and at the latest after the second.
const SAVING_SHARE: u32 = 50;
const CHECKPOINT_EVERY: [Duration; 2] = [Duration::from_secs(1), Duration::from_secs(30)];

/// What happened in a [`Run::step`].
#[derive(Clone, Debug)]
pub enum Event {
    /// A time step after which neither an episode ended nor an evaluation followed.
    Stepped,
    /// A training episode ended.
    EpisodeEnded(EpisodeRow),
    /// An evaluation during training.
    Evaluated(EvaluationRow),
    /// This many episodes of the test at the end are done and saved; more are to come.
    Testing(usize),
    /// The whole test; the run is complete.
    Tested(Evaluation),
}

/// A run in progress. Its owner decides when to step, to save, and to stop.
pub struct Run<E> {
    config: RunConfig,
    folder: RunFolder,
    env: Checked<E>,
    evaluator: Evaluator<E>,
    method: Method,
    progress: Progress,
    obs: Vec<f32>,
    episode_return: f64,
    episode_length: usize,
    evaluated_at: Option<usize>,
    clock: Instant,
    last_save: Instant,
    /// How long the last save took.
    saving: Duration,
}

impl<E> std::fmt::Debug for Run<E> {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let Self { config, progress, .. } = self;
        let mut run = f.debug_struct("Run");
        run.field("config", config).field("step", &progress.step).finish_non_exhaustive()
    }
}

impl<E: Env> Run<E> {
    /// Starts a run of a method in `folder`, in environments that `make` makes; or resumes the one that is there.
    ///
    /// # Errors
    /// If the folder holds a run with other settings, another run's checkpoint or a damaged one, another process (or this
    /// one) has it open, or it cannot be written.
    pub fn open(
        config: RunConfig,
        mut method: Method,
        make: impl Fn() -> Result<E> + Sync,
        folder: &Path,
    ) -> Result<Self> {
        config.check()?;
        // Whatever is wrong with the environment shows before anything is written.
        let (env, evaluator) = (Checked::new(make()?), Evaluator::new(make)?);
        let folder = RunFolder::claim(folder, &config)?;
        let mut progress = folder.load(&config, &mut method)?.unwrap_or_default();
        if progress.step > 0 && progress.versions.is_empty() {
            // Its checkpoint does not say which.
            progress.versions.insert("an earlier version".into());
        }
        progress.versions.insert(SOURCE.clone());
        let mut run = Self {
            env,
            evaluator,
            method,
            obs: Vec::new(),
            episode_return: 0.0,
            episode_length: 0,
            evaluated_at: progress.evaluations.last().map(|row| row.step),
            progress,
            folder,
            clock: Instant::now(),
            last_save: Instant::now(),
            saving: Duration::ZERO,
            config,
        };
        run.start_episode()?;
        Ok(run)
    }

    /// The run's settings.
    pub fn config(&self) -> &RunConfig {
        &self.config
    }

    /// Environment steps so far.
    pub fn steps_done(&self) -> usize {
        self.progress.step
    }

    /// Whether the run is at the start of an episode, where it can be saved.
    pub fn between_episodes(&self) -> bool {
        self.episode_length == 0
    }

    /// Acts and learns for one step; at the end of the budget, goes on with the test. Saves when it is time.
    ///
    /// # Errors
    /// If an action cannot be taken, a loss or a weight is NaN, or a file cannot be written.
    pub fn step(&mut self) -> Result<Event> {
        let step = self.progress.step;
        let budget = if self.config.learns() { self.config.steps } else { 0 };
        if self.config.learns()
            && (step.is_multiple_of(self.config.evaluate_every) || step == budget)
            && self.evaluated_at != Some(step)
        {
            return self.evaluate();
        }
        if step >= budget {
            return self.test();
        }
        let Some(agent) = self.method.as_learner() else {
            return Err(Error::Config(format!("{} does not learn: its `steps` must be 0", self.config.agent)));
        };
        let action = agent.act(&self.obs, Mode::Explore);
        if action.iter().any(|a| a.is_nan()) {
            check_weights(&agent.weights(), step)?;
        }
        let outcome = self.env.step(&action)?;
        agent.observe(&Transition {
            obs: std::mem::take(&mut self.obs),
            action,
            reward: outcome.reward,
            next_obs: outcome.observation.clone(),
            terminated: outcome.terminated,
            truncated: outcome.truncated,
        });
        let losses = agent.update().unwrap_or_default();
        self.obs.clone_from(&outcome.observation);
        self.progress.step += 1;
        self.episode_return += f64::from(outcome.reward);
        self.episode_length += 1;
        self.progress.note(losses)?;
        if !outcome.done() {
            return Ok(Event::Stepped);
        }
        let row = EpisodeRow {
            step: self.progress.step,
            episode: self.progress.episodes.len() + 1,
            total: self.episode_return,
            success: outcome.success,
            length: self.episode_length,
            seconds: self.seconds(),
        };
        self.progress.episodes.push(row.clone());
        self.start_episode()?;
        let [soonest, latest] = CHECKPOINT_EVERY;
        if self.last_save.elapsed() > (SAVING_SHARE * self.saving).clamp(soonest, latest) {
            self.save()?;
        }
        Ok(Event::EpisodeEnded(row))
    }

    fn start_episode(&mut self) -> Result<()> {
        self.obs = self.env.reset(training_seed(self.config.seed, self.progress.episodes.len())?)?;
        if let Some(agent) = self.method.as_learner() {
            agent.begin_episode();
        }
        (self.episode_return, self.episode_length) = (0.0, 0);
        Ok(())
    }

    fn seconds(&self) -> f64 {
        self.progress.seconds + self.clock.elapsed().as_secs_f64()
    }

    fn evaluate(&mut self) -> Result<Event> {
        let (step, episodes) = (self.progress.step, self.config.evaluation_episodes);
        check_weights(&self.method.checkpoint().weights(), step)?;
        let evaluation = self.evaluator.evaluate(&mut self.method, episodes, self.config.starts.curve())?;
        let mut row = EvaluationRow { step, summary: evaluation.summary(), updates: 0 };
        if let Some(agent) = self.method.as_learner() {
            row.updates = agent.updates();
            let open_loop = agent.open_loop(&evaluation.episodes).into_iter();
            self.progress.model.extend(open_loop.map(|open_loop| ModelRow { step, open_loop }));
            self.progress.values.extend(ValueRow::new(step, &agent.value_estimates(&evaluation.episodes)));
        }
        self.evaluated_at = Some(self.progress.step);
        self.progress.evaluations.push(row.clone());
        Ok(Event::Evaluated(row))
    }

    fn test(&mut self) -> Result<Event> {
        let (test, episodes) = (&mut self.progress.test, self.config.test_episodes);
        let complete = self.evaluator.next_batch(test, &mut self.method, episodes, self.config.starts.test())?;
        self.save()?;
        if !complete {
            return Ok(Event::Testing(self.progress.test.results.len()));
        }
        self.folder.complete(&self.config, &self.progress)?;
        Ok(Event::Tested(self.progress.test.clone()))
    }

    /// Writes the checkpoint, the weights and the CSV files. A run that is resumed starts its
    /// present episode anew.
    ///
    /// # Errors
    /// If weights or the training state hold NaN, or a file cannot be written; what was written before is then still there.
    pub fn save(&mut self) -> Result<()> {
        self.progress.seconds += self.clock.elapsed().as_secs_f64();
        self.clock = Instant::now();
        let checkpoint = self.method.checkpoint();
        let weights = checkpoint.weights();
        let training_state = checkpoint.training_state();
        // A checkpoint with NaN in it cannot be read.
        check_weights(&weights, self.progress.step)?;
        check_numbers("the training state's", &training_state, self.progress.step)?;
        self.folder.save(&self.config, weights, training_state, &self.progress)?;
        (self.last_save, self.saving) = (Instant::now(), self.clock.elapsed());
        Ok(())
    }
}

/// # Errors
/// If an array holds NaN: nothing can be learned from there on, and no plan or action is worth anything.
fn check_weights(weights: &Weights, step: usize) -> Result<()> {
    check_numbers("a weight of", weights, step)
}

fn check_numbers(what: &str, arrays: &Weights, step: usize) -> Result<()> {
    match arrays.with_nan() {
        Some(name) => Err(Error::Diverged { what: format!("{what} `{name}`"), step }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use crate::model::open_loop::OpenLoop;
    use crate::study::records::{EvaluationRow, LossRow, ModelRow};
    use crate::study::registry::Registry;

    /// Checkpoints of earlier versions keep no interval of an evaluation's success rate.
    #[test]
    fn evaluations_of_earlier_versions_are_read() {
        let old = "step = 500\nepisodes = 20\nsuccess = 0.9\nreturn_mean = 86.9\nreturn_std = 4.6\naction_ms = 2.6\n";
        let row: EvaluationRow = toml::from_str(old).expect("an old row");
        assert_eq!((row.step, row.summary.episodes, row.summary.success), (500, 20, 0.9));
        assert!(row.summary.smoothness_sparc.is_none() && row.summary.success_low.is_nan());
        let again: EvaluationRow = toml::from_str(&toml::to_string(&row).expect("TOML")).expect("a row");
        assert!(again.summary.success_high.is_nan() && again.summary.return_mean == 86.9);
    }

    #[test]
    fn a_run_resumes_from_what_is_not_a_number() {
        let folder = tempfile::tempdir().expect("a folder");
        let registry = Registry::standard();
        let config = registry.config("pendulum", "debug", 0, None, None).expect("a preset");
        let mut run = registry.open_run(&config, folder.path()).expect("a new run");
        let loss = LossRow { step: 1, name: "critic".into(), value: f32::NAN };
        let of_particles =
            OpenLoop { horizon: 1, rmse: 0.1, nll: Some(f64::INFINITY), coverage90: Some(0.9), rmse_p90: 0.3 };
        let of_one = OpenLoop { horizon: 2, nll: None, coverage90: None, ..of_particles.clone() };
        let model = [of_particles, of_one].map(|open_loop| ModelRow { step: 1, open_loop });
        run.progress.losses.push(loss);
        run.progress.model.extend(model.clone());
        run.save().expect("a writable folder");
        drop(run);
        let again = registry.open_run(&config, folder.path()).expect("a run to go on with").progress;
        assert!(again.losses[0].value.is_nan());
        assert_eq!(again.model, model);
        let table = std::fs::read_to_string(folder.path().join("model.csv")).expect("a table");
        assert_eq!(table.lines().skip(1).collect::<Vec<_>>(), ["1,1,0.1,inf,0.9,0.3", "1,2,0.1,,,0.3"]);
    }
}
