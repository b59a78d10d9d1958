//! The protocol by which every agent is judged: the same starts for all, deterministic actions.

use std::time::Instant;

use serde::{Deserialize, Serialize};

use super::smoothness;
use super::statistics::{deviation, mean, wilson};
use crate::agent::{Agent, Slot};
use crate::env::vector::VectorEnv;
use crate::env::{Env, World};
use crate::error::{Error, Result};
use crate::model::open_loop::Episode;

/// Worlds that are stepped side by side; agents answer for all of them in one pass.
const WORLDS: usize = 20;

/// Which starts an evaluation has. No training episode shares them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EvalSeeds {
    /// Those of the evaluations during training.
    Training,
    /// Those of the test at the end: never seen before.
    Test,
    /// Those that follow from a seed of the user's.
    Seed(u64),
}

impl EvalSeeds {
    fn seed(self, episode: usize) -> u64 {
        let base = match self {
            EvalSeeds::Training => 1 << 40,
            EvalSeeds::Test => 2 << 40,
            EvalSeeds::Seed(seed) => (3 << 40) + (seed << 20),
        };
        base + episode as u64
    }
}

/// What came of one episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
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
}

/// What an evaluation has found so far.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// The episodes, in the order of their starts.
    #[serde(rename = "episodes")]
    pub results: Vec<EpisodeResult>,
    /// Time to choose one action at the start of an episode, ms, when asked for one at a time.
    pub action_ms: f64,
    /// The episodes themselves, for those who judge models by them; not kept on disk.
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
    /// Wilson interval of the success rate, 95 %.
    pub success_low: f64,
    /// Its upper end.
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

/// Worlds of one kind, kept for many evaluations.
pub struct Evaluator {
    worlds: VectorEnv<World>,
}

impl Evaluator {
    /// A judge with worlds made by `make`.
    ///
    /// # Errors
    /// What `make` answers.
    pub fn new(make: impl Fn() -> Result<World> + Sync) -> Result<Self> {
        make()?;
        Ok(Self { worlds: VectorEnv::new(WORLDS, || make().expect("what was made once can be made again")) })
    }

    /// Lets the agent act in `episodes` episodes from the given starts.
    ///
    /// # Errors
    /// If there are no episodes, or the agent's actions cannot be taken.
    pub fn evaluate(&mut self, agent: &mut dyn Agent, episodes: usize, starts: EvalSeeds) -> Result<Evaluation> {
        let mut evaluation = Evaluation::default();
        while !self.next_batch(&mut evaluation, agent, episodes, starts)? {}
        Ok(evaluation)
    }

    /// Adds to an evaluation of so many episodes the next group of those that are played side by side, and answers whether
    /// these were the last: for whoever wants to see, or to keep, what there is before the end.
    ///
    /// # Errors
    /// As for [`Evaluator::evaluate`].
    pub fn next_batch(
        &mut self,
        evaluation: &mut Evaluation,
        agent: &mut dyn Agent,
        episodes: usize,
        starts: EvalSeeds,
    ) -> Result<bool> {
        if episodes == 0 {
            return Err(Error::BadSetting("an evaluation needs at least one episode".into()));
        }
        let done = evaluation.results.len();
        let seeds: Vec<u64> = (done..episodes.min(done + WORLDS)).map(|i| starts.seed(i)).collect();
        if !seeds.is_empty() {
            self.side_by_side(evaluation, agent, &seeds)?;
        }
        Ok(evaluation.results.len() >= episodes)
    }

    fn side_by_side(&mut self, evaluation: &mut Evaluation, agent: &mut dyn Agent, seeds: &[u64]) -> Result<()> {
        let dt = self.worlds.env(0).spec().dt;
        let mut observations = self.worlds.reset(seeds)?;
        let mut paths: Vec<Vec<[f64; 3]>> =
            self.worlds.envs().take(seeds.len()).map(|world| world.hand().into_iter().collect()).collect();
        let blank = EpisodeResult { total: 0.0, success: false, length: 0, stage: 0, sparc: None, ldlj: None };
        let mut results = vec![blank; seeds.len()];
        let mut running: Vec<usize> = (0..seeds.len()).collect();
        let starts = observations.iter().map(|obs| Episode { observations: vec![obs.clone()], ..Episode::default() });
        let mut recorded: Vec<Episode> = starts.collect();
        let slot = Slot { index: 0, first: true, obs: &observations[0], world: self.worlds.env(0) };
        evaluation.action_ms = time_of_action(agent, slot);
        let mut first = true;
        while !running.is_empty() {
            let slots =
                running.iter().map(|&i| Slot { index: i, first, obs: &observations[i], world: self.worlds.env(i) });
            let slots: Vec<Slot> = slots.collect();
            let mut actions = vec![None; self.worlds.len()];
            for (&i, action) in running.iter().zip(agent.act_all(&slots)) {
                actions[i] = Some(action);
            }
            first = false;
            for (i, step) in self.worlds.step(&actions)?.into_iter().enumerate() {
                let Some(step) = step else { continue };
                let result = &mut results[i];
                result.total += f64::from(step.reward);
                result.success = step.success;
                result.length += 1;
                result.stage = result.stage.max(step.stage);
                paths[i].extend(self.worlds.env(i).hand());
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
        for (result, path) in results.iter_mut().zip(&paths) {
            if let Some((sparc, ldlj)) = smoothness::of_path(path, dt) {
                (result.sparc, result.ldlj) = (Some(sparc), Some(ldlj));
            }
        }
        evaluation.results.extend(results);
        evaluation.episodes.extend(recorded);
        Ok(())
    }
}

/// Milliseconds that one action takes at the start of an episode: the median of a few.
fn time_of_action(agent: &mut dyn Agent, slot: Slot) -> f64 {
    let mut times: Vec<f64> = (0..5)
        .map(|_| {
            let start = Instant::now();
            std::hint::black_box(agent.act_all(&[slot]));
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[2]
}
