//! The evaluation protocol: the same initial states for every method, no exploration noise.
//!
//! ```
//! use handful::prelude::*;
//!
//! let mut evaluator = Evaluator::new(|| Ok(Task::Pendulum.make()))?;
//! let mut random = Random::new(Task::Pendulum.make().spec(), 0);
//! let evaluation = evaluator.evaluate(&mut random, 5, EvalSeeds::Test)?;
//! assert_eq!(evaluation.results.len(), 5);
//! let summary = evaluation.summary();
//! assert!(summary.success_low <= summary.success && summary.return_mean < -500.0);
//! # Ok::<(), Error>(())
//! ```

use std::time::Instant;

use serde::{Deserialize, Serialize};

use super::smoothness;
pub use super::starts::EvalSeeds;
use super::statistics::{deviation, mean, wilson};
use crate::agent::{Policy, Slot};
use crate::env::Env;
use crate::env::vector::VectorEnv;
use crate::error::{Error, Result};
use crate::replay::Episode;

/// Environments that are stepped side by side; agents act in all of them in one forward pass.
pub(super) const ENVS: usize = 20;

/// What came of one episode.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EpisodeResult {
    /// Sum of rewards.
    #[serde(rename = "return")]
    pub total: f64,
    /// Whether the task was fulfilled at the last step.
    pub success: bool,
    /// Steps.
    pub length: usize,
    /// The highest stage that was fulfilled at any step.
    pub stage: usize,
    /// Spectral arc length of the hand's speed, if there is a hand and it moved.
    pub sparc: Option<f64>,
    /// Log dimensionless jerk of the hand.
    pub ldlj: Option<f64>,
    /// [`action_change`](smoothness::action_change) over the episode; none where there is one action only.
    #[serde(default)]
    pub action_change: Option<f64>,
}

/// What an evaluation has found so far.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// The episodes, in the order of their starts.
    #[serde(rename = "episodes")]
    pub results: Vec<EpisodeResult>,
    /// Time to choose one action at the start of an episode, ms, when asked for one at a time.
    pub action_ms: f64,
    /// The episodes themselves, for the diagnostics of models; not kept on disk.
    #[serde(skip)]
    pub episodes: Vec<Episode>,
}

/// The numbers of an [`Evaluation`], as they stand in tables.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Episodes.
    pub episodes: usize,
    /// Success rate.
    pub success: f64,
    /// Lower end of the 95 % Wilson interval of this one agent's success rate. Its episodes are independent of each other, but for
    /// the random numbers of a planner, which episodes that are 20 apart share; those of agents trained with several seeds are not,
    /// and [`two_level_bootstrap`](super::statistics::two_level_bootstrap) is for them. Not a number in what earlier versions
    /// recorded during training.
    #[serde(default = "unknown")]
    pub success_low: f64,
    /// Its upper end.
    #[serde(default = "unknown")]
    pub success_high: f64,
    /// Mean return.
    pub return_mean: f64,
    /// Standard deviation of the return.
    pub return_std: f64,
    /// Mean spectral arc length of the hand's speed.
    pub smoothness_sparc: Option<f64>,
    /// Mean log dimensionless jerk of the hand.
    pub smoothness_ldlj: Option<f64>,
    /// Milliseconds to choose an action.
    pub action_ms: f64,
}

fn unknown() -> f64 {
    f64::NAN
}

impl Evaluation {
    /// The evaluation in numbers.
    pub fn summary(&self) -> Summary {
        let successes = self.results.iter().filter(|result| result.success).count();
        let [success_low, success_high] = wilson(successes, self.results.len());
        let returns: Vec<f64> = self.results.iter().map(|result| result.total).collect();
        let mean_of = |values: Vec<f64>| (!values.is_empty()).then(|| mean(&values));
        Summary {
            episodes: self.results.len(),
            success: successes as f64 / self.results.len() as f64,
            success_low,
            success_high,
            return_mean: mean(&returns),
            return_std: deviation(&returns),
            smoothness_sparc: mean_of(self.results.iter().filter_map(|result| result.sparc).collect()),
            smoothness_ldlj: mean_of(self.results.iter().filter_map(|result| result.ldlj).collect()),
            action_ms: self.action_ms,
        }
    }
}

/// Evaluates policies in environments of one kind, which are kept for many evaluations.
#[derive(Debug)]
pub struct Evaluator<E> {
    envs: VectorEnv<E>,
}

impl<E: Env> Evaluator<E> {
    /// An evaluator with 20 environments made by `make`.
    ///
    /// # Errors
    /// Any error of `make`, or what is wrong with the environment's spec.
    pub fn new(make: impl Fn() -> Result<E> + Sync) -> Result<Self> {
        let envs = VectorEnv::try_new(ENVS, make)?;
        envs.env(0).spec().check()?;
        Ok(Self { envs })
    }

    /// Lets the policy act in `episodes` episodes with the given seeds.
    ///
    /// # Errors
    /// If there are no episodes or more than there are seeds, the environment cannot take the policy's actions, or it breaks
    /// its contract.
    pub fn evaluate<P: Policy + ?Sized>(
        &mut self,
        policy: &mut P,
        episodes: usize,
        seeds: EvalSeeds,
    ) -> Result<Evaluation> {
        let mut evaluation = Evaluation::default();
        while !self.next_batch(&mut evaluation, policy, episodes, seeds)? {}
        Ok(evaluation)
    }

    /// Adds to an evaluation of `episodes` episodes the next batch of those that run side by side, and returns whether
    /// that was the last: for a caller that wants to show, or to save, the results so far.
    ///
    /// # Errors
    /// As for [`Evaluator::evaluate`].
    pub fn next_batch<P: Policy + ?Sized>(
        &mut self,
        evaluation: &mut Evaluation,
        policy: &mut P,
        episodes: usize,
        seeds: EvalSeeds,
    ) -> Result<bool> {
        if episodes == 0 {
            return Err(Error::Config("an evaluation needs at least one episode".into()));
        }
        // Before the first episode, not after a million of them.
        seeds.seed(episodes - 1)?;
        let done = evaluation.results.len();
        let seeds = (done..episodes.min(done + ENVS)).map(|i| seeds.seed(i)).collect::<Result<Vec<u64>>>()?;
        if !seeds.is_empty() {
            self.side_by_side(evaluation, policy, &seeds)?;
        }
        Ok(evaluation.results.len() >= episodes)
    }

    fn side_by_side<P: Policy + ?Sized>(
        &mut self,
        evaluation: &mut Evaluation,
        policy: &mut P,
        seeds: &[u64],
    ) -> Result<()> {
        let mut observations = self.envs.reset(seeds)?;
        let count = seeds.len();
        let mut paths: Vec<Vec<[f64; 3]>> = (0..count).map(|i| self.envs.env(i).hand().into_iter().collect()).collect();
        let mut results = vec![EpisodeResult::default(); count];
        let recorded = observations.iter().map(|obs| Episode { observations: vec![obs.clone()], ..Episode::default() });
        let mut recorded: Vec<Episode> = recorded.collect();
        evaluation.action_ms = time_of_action(policy, Slot::single(true, &observations[0], self.envs.env(0)))?;
        let mut running: Vec<usize> = (0..count).collect();
        let mut first = true;
        while !running.is_empty() {
            let slot = |&index: &usize| Slot { index, first, obs: &observations[index], env: self.envs.env(index) };
            let slots: Vec<Slot> = running.iter().map(slot).collect();
            let mut actions = vec![None; self.envs.len()];
            for (&i, action) in running.iter().zip(actions_of(policy, &slots)?) {
                actions[i] = Some(action);
            }
            first = false;
            for (i, step) in self.envs.step(&actions)?.into_iter().enumerate() {
                let Some(step) = step else { continue };
                let result = &mut results[i];
                result.total += f64::from(step.reward);
                result.success = step.success;
                result.length += 1;
                result.stage = result.stage.max(step.stage);
                paths[i].extend(self.envs.env(i).hand());
                recorded[i].observations.push(step.observation.clone());
                recorded[i].actions.extend(actions[i].clone());
                recorded[i].rewards.push(step.reward);
                recorded[i].terminated = step.terminated;
                if step.done() {
                    running.retain(|&other| other != i);
                }
                observations[i] = step.observation;
            }
        }
        let dt = self.envs.env(0).spec().dt;
        for ((result, path), episode) in results.iter_mut().zip(&paths).zip(&recorded) {
            result.action_change = smoothness::action_change(&episode.actions);
            if let Some((sparc, ldlj)) = smoothness::of_path(path, dt) {
                (result.sparc, result.ldlj) = (Some(sparc), Some(ldlj));
            }
        }
        evaluation.results.extend(results);
        evaluation.episodes.extend(recorded);
        Ok(())
    }
}

/// # Errors
/// Any error of the policy, or if it has not one action for each slot.
fn actions_of<P: Policy + ?Sized>(policy: &mut P, slots: &[Slot]) -> Result<Vec<Vec<f32>>> {
    let actions = policy.actions(slots)?;
    if actions.len() != slots.len() {
        let (given, wanted) = (actions.len(), slots.len());
        return Err(Error::Config(format!(
            "the policy gave {given} actions for {wanted} environments; it must give one for each"
        )));
    }
    Ok(actions)
}

/// Milliseconds that one action takes at the start of an episode: the median of five.
fn time_of_action<P: Policy + ?Sized>(policy: &mut P, slot: Slot) -> Result<f64> {
    let mut times = [0.0; 5];
    for time in &mut times {
        let start = Instant::now();
        std::hint::black_box(actions_of(policy, &[slot])?);
        *time = start.elapsed().as_secs_f64() * 1e3;
    }
    times.sort_by(f64::total_cmp);
    Ok(times[2])
}
