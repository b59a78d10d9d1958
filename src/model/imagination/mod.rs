//! Imagination: rollouts of a learned model along many candidate action sequences, with several particles each
//! (Chua et al. 2018, PETS, section 5 and Algorithm 1).
//!
//! All candidates are evaluated with common random numbers (the same noise, the same assignment of particles to members),
//! so that differences between their returns are due to their actions. A candidate's particles depend on the seed alone,
//! neither on the other candidates nor on the number of threads.
//!
//! ```
//! use handful::model::{Ensemble, EnsembleConfig, Imagination, Propagation, Reward};
//! use handful::prelude::*;
//! use handful::rng;
//!
//! # let mut world = Task::Pendulum.make();
//! # let mut rng = rng::stream(0, "example");
//! # let mut replay = ReplayBuffer::new(world.spec().observation_size(), world.spec().action_size, 1000);
//! # let start = world.reset(0);
//! # let mut obs = start.clone();
//! # for _ in 0..200 {
//! #     let action = vec![rng::uniform(&mut rng, -1.0, 1.0) as f32];
//! #     let Step { observation: next_obs, reward, terminated, truncated, .. } = world.step(&action)?;
//! #     let transition = Transition { obs, action, reward, next_obs: next_obs.clone(), terminated, truncated };
//! #     replay.push(&transition);
//! #     obs = next_obs;
//! # }
//! # let config = EnsembleConfig { hidden: vec![16], first_steps: 20, ..EnsembleConfig::default() };
//! // `world` is a pendulum, `replay` holds random transitions of it.
//! let mut ensemble = Ensemble::new(world.spec(), config, &mut rng)?;
//! ensemble.fit(&replay, &mut rng);
//! let dynamics = ensemble.dynamics();
//! let imagination = Imagination {
//!     dynamics: &dynamics,
//!     reward: Reward::Known(&world),
//!     propagation: Propagation::TsInf,
//!     particles: 20,
//!     value: None,
//! };
//! // Two candidates of 15 time steps: full torque one way, and the other way.
//! let actions = [vec![1.0; 15], vec![-1.0; 15]].concat();
//! let imagined = imagination.imagined_returns(&start, &actions, 15, &mut rng);
//! assert_eq!((imagined.returns.len(), imagined.disagreement.len()), (2 * 20, 2));
//! # Ok::<(), handful::error::Error>(())
//! ```

mod moment_matching;
mod noise;
mod rollout;
#[cfg(test)]
mod tests;
mod trajectory_sampling;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use self::noise::CommonRandomNumbers;
use self::rollout::Rollout;
use super::Dynamics;
use crate::env::KnownReward;
use crate::nn::frozen::PANEL;
use crate::rng::Rng;

/// What is wrong if a model has to predict rewards that it has not learned.
pub(super) const NO_REWARD: &str = "`Reward::Learned` needs a model that has learned rewards";

/// Rows that one thread puts through a network at a time: few enough for its cache.
const ROWS: usize = 12 * PANEL;

/// How uncertainty is propagated from time step to time step (Chua et al. 2018, section 5).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Propagation {
    /// TS-inf, trajectory sampling: a particle stays with one member over the whole horizon, so that epistemic uncertainty
    /// accumulates.
    #[doc(alias = "TS-inf")]
    #[doc(alias = "TSinf")]
    #[doc(alias = "trajectory sampling")]
    #[default]
    TsInf,
    /// TS1, trajectory sampling: particles are assigned to members anew at every time step.
    #[doc(alias = "TS1")]
    Ts1,
    /// TS-inf without noise: one particle per member, which follows that member's mean. What is left is epistemic
    /// uncertainty. For deterministic environments, where a planner would exploit favourable noise samples. Not in PETS.
    #[serde(alias = "members")]
    TsInfMean,
    /// E, expectation: one particle, which follows the mean of the members' means, without noise.
    #[doc(alias = "mean propagation")]
    #[serde(alias = "mean")]
    Expectation,
    /// MM, moment matching: particles are drawn from a Gaussian with mean and variance of the ensemble, then resampled at
    /// every time step from a Gaussian with independent components fitted to a candidate's particles.
    #[doc(alias = "MM")]
    MomentMatching,
}

/// Source of the rewards in imagination.
#[derive(Clone, Copy)]
pub enum Reward<'a> {
    /// A known function of observations and action, which also says when the task terminates.
    Known(&'a (dyn KnownReward + Sync)),
    /// What the model has learned of them, [`Dynamics::learned_reward`]. Trajectories never terminate then.
    Learned,
}

impl std::fmt::Debug for Reward<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.write_str(match self {
            Reward::Known(_) => "Known(..)",
            Reward::Learned => "Learned",
        })
    }
}

/// A terminal value function: writes the value of each observation (`[rows, observation]`), in units of return.
pub type Value<'a> = dyn Fn(&[f32], &mut [f32]) + Sync + 'a;

/// Rollouts of a model.
#[doc(alias = "rollout")]
#[derive(Clone, Copy)]
pub struct Imagination<'a> {
    /// The model.
    pub dynamics: &'a Dynamics,
    /// Source of the rewards.
    pub reward: Reward<'a>,
    /// How uncertainty is propagated.
    pub propagation: Propagation,
    /// Particles per candidate. With [`Propagation::TsInf`] and [`Propagation::Ts1`] a multiple of the members;
    /// [`Propagation::TsInfMean`] and [`Propagation::Expectation`] ignore it: see [`Imagination::particles`].
    pub particles: usize,
    /// Value of the last observation, added to the return unless the task has terminated.
    #[doc(alias = "bootstrap value")]
    pub value: Option<&'a Value<'a>>,
}

impl std::fmt::Debug for Imagination<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.debug_struct("Imagination")
            .field("dynamics", self.dynamics)
            .field("reward", &self.reward)
            .field("propagation", &self.propagation)
            .field("particles", &self.particles)
            .field("value", &self.value.map(|_| "Fn"))
            .finish()
    }
}

/// Imagined returns of candidate action sequences.
#[derive(Clone, Debug, PartialEq)]
pub struct ImaginedReturns {
    /// Particles per candidate.
    pub particles: usize,
    /// Undiscounted sums of rewards, plus the terminal value if there is one, `[candidates, particles]`.
    pub returns: Vec<f32>,
    /// Disagreement of the members (epistemic uncertainty) along each candidate, `[candidates]`, summed over time steps: the
    /// standard deviation between members in units of the typical change per time step, root mean square over the
    /// predicted features, times the share of particles whose task has not terminated. With [`Propagation::TsInf`] and
    /// [`Propagation::Ts1`] it compares means of sampled particles, so that their aleatoric noise adds to it.
    #[doc(alias = "epistemic uncertainty")]
    pub disagreement: Vec<f32>,
}

impl Imagination<'_> {
    /// Particles per candidate in effect: one with [`Propagation::Expectation`], one per member with
    /// [`Propagation::TsInfMean`], otherwise the setting.
    pub fn particles(&self) -> usize {
        match self.propagation {
            Propagation::Expectation => 1,
            Propagation::TsInfMean => self.dynamics.members(),
            _ => self.particles,
        }
    }

    /// Returns of the candidates `actions` (`[candidates, horizon, action]`), starting from `obs`: one observation, or one
    /// for each candidate (`[candidates, observation]`). Candidates share their random numbers, and are distributed over
    /// threads.
    ///
    /// # Panics
    /// If there is no horizon or no particle, the sizes do not fit together, the particles are not a multiple of the members, or the
    /// reward is [`Reward::Learned`] and the model has not learned rewards.
    #[doc(alias = "CRN")]
    #[doc(alias = "common random numbers")]
    pub fn imagined_returns(&self, obs: &[f32], actions: &[f32], horizon: usize, rng: &mut Rng) -> ImaginedReturns {
        let (count, particles) = (self.candidates(actions, horizon), self.particles());
        let width = horizon * self.dynamics.action_size();
        let noise = CommonRandomNumbers::draw(self, horizon, rng);
        let mut returns = vec![0.0; count * particles];
        let mut disagreement = vec![0.0; count];
        let share = self.candidates_per_task(count);
        let parts = returns.par_chunks_mut(share * particles).zip(disagreement.par_chunks_mut(share));
        let parts = parts.zip(actions.par_chunks(share * width)).enumerate();
        parts.for_each(|(part, ((returns, disagreement), actions))| {
            let obs = self.start_observations(obs, part * share, returns.len() / particles);
            Rollout::new(self, &obs, actions, returns, disagreement).run(horizon, &noise, |_| {});
        });
        ImaginedReturns { particles, returns, disagreement }
    }

    /// The trajectories of all particles, `[horizon + 1][particles, candidates, observation]`, with their returns.
    /// Arguments as in [`Imagination::imagined_returns`].
    ///
    /// # Panics
    /// As [`Imagination::imagined_returns`].
    pub fn trajectories(
        &self,
        obs: &[f32],
        actions: &[f32],
        horizon: usize,
        rng: &mut Rng,
    ) -> (Vec<Vec<f32>>, ImaginedReturns) {
        let (count, particles) = (self.candidates(actions, horizon), self.particles());
        let noise = CommonRandomNumbers::draw(self, horizon, rng);
        let (mut returns, mut disagreement) = (vec![0.0; count * particles], vec![0.0; count]);
        let mut trajectories = Vec::with_capacity(horizon + 1);
        let obs = self.start_observations(obs, 0, count);
        Rollout::new(self, &obs, actions, &mut returns, &mut disagreement)
            .run(horizon, &noise, |states| trajectories.push(states.to_vec()));
        (trajectories, ImaginedReturns { particles, returns, disagreement })
    }

    /// How many candidates `actions` holds.
    fn candidates(&self, actions: &[f32], horizon: usize) -> usize {
        let width = horizon * self.dynamics.action_size();
        assert!(width > 0 && self.particles() > 0, "`horizon` and `particles` must be at least 1");
        assert!(actions.len().is_multiple_of(width), "`actions` must hold whole sequences of `horizon` actions");
        actions.len() / width
    }

    /// Candidates in one parallel task.
    fn candidates_per_task(&self, count: usize) -> usize {
        let rows = match self.propagation {
            Propagation::TsInf | Propagation::Ts1 | Propagation::TsInfMean => {
                count * self.particles() / self.dynamics.members()
            }
            Propagation::Expectation | Propagation::MomentMatching => count * self.particles(),
        };
        let parts = rows.div_ceil(ROWS).max(1).next_multiple_of(rayon::current_num_threads());
        count.div_ceil(parts).max(1)
    }

    /// The first observation of `count` candidates from candidate `first` on, `[count, observation]`.
    fn start_observations(&self, obs: &[f32], first: usize, count: usize) -> Vec<f32> {
        let width = self.dynamics.observation_size();
        if obs.len() == width { obs.repeat(count) } else { obs[first * width..][..count * width].to_vec() }
    }
}
