//! DreamerV3 (Hafner et al. 2023) in its smallest size: a latent world model is learned from replayed sequences, and an actor
//! and a critic from rollouts imagined in it. With a planner it is PlaNet (Hafner et al. 2019): the same world model, in which
//! actions are planned.
//!
//! [`Dreamer`] wires the parts: the world model is in [`crate::model`], actor and critic are in [`ActorCritic`], planners in
//! [`crate::plan`], one update in `update.rs`. Losses, networks and constants are those of the published code, in its newest
//! version. Deviations: there is one environment, the first actions are random (`warm_up`), the replay buffer is smaller, its
//! sequences start with a latent state of zeros, new experience has no precedence in it, positions are seen as differences
//! ([`LatentFeatures`](crate::model::LatentFeatures)), and in evaluation the policy acts by its mean. Optional: rollouts from a part of
//! the states (`dreams`), decisions of several time steps, updates owed for the warm-up, exploration with coloured noise, an actor gradient through
//! the dynamics, centred advantages, a penalty on the mean action, an entropy coefficient tuned towards a target entropy, a group lasso
//! on the encoder's inputs, with a probe that reconstructs what it prunes. PlaNet has Gaussian states, the KL divergence in its loss
//! once, no critic at the end of a plan, and Gaussian noise on planned actions while it collects experience; here plans are executed
//! without noise.
//!
//! ```
//! use handful::agent::dreamer::DreamerConfig;
//! use handful::agent::{Agent, Dreamer, Mode};
//! use handful::env::{Env, Task};
//!
//! let env = Task::Pendulum.make();
//! let mut agent = Dreamer::new(env.spec(), DreamerConfig::default(), 0)?;
//! agent.begin_episode();
//! let action = agent.act(&[1.0, 0.0, 0.0], Mode::Evaluate);
//! assert!(action.len() == 1 && action[0].abs() <= 1.0);
//! # Ok::<(), handful::error::Error>(())
//! ```

mod actor_critic;
mod config;
mod dynamics_gradient;
mod planner;
mod policy_state;
mod returns;
mod update;

use rayon::prelude::*;

pub use actor_critic::{ActorCritic, ActorCriticLoss, ImaginedRollout, TargetCritic};
pub use config::{ActorCriticConfig, ActorGradient, DreamerConfig};
pub use planner::LatentObjective;
use policy_state::PolicyState;
pub use returns::{ReturnScale, lambda_returns, replay_lambda_returns};
use update::Networks;

use super::decision::{Decision, Over, check_decisions, in_decisions, most_observed};
use super::temperature::Temperature;
use super::warm_up::RandomActions;
use super::{Agent, Checkpoint, Diagnostics, ImaginedTrajectory, Losses, Mode, Slot, Slots, ValueEstimate};
use crate::checkpoint::Weights;
use crate::env::Spec;
use crate::error::{Error, Result};
use crate::model::WorldModel;
use crate::model::open_loop::{OpenLoop, WithActionRepeat, open_loop};
use crate::nn::{Adam, AdamConfig};
use crate::replay::{Episode, SequenceReplay, Transition};
use crate::rng::{self, Rng};
use crate::settings::Ranges;

/// Imagined rollouts that explain an action.
const SHOWN: usize = 12;

/// The agent: world model, actor, critic and target network, and the replay buffer that they learn from.
#[doc(alias = "DreamerV3")]
#[doc(alias = "PlaNet")]
pub struct Dreamer {
    config: DreamerConfig,
    spec: Spec,
    networks: Networks,
    optimiser: Adam,
    scale: ReturnScale,
    temperature: Temperature,
    replay: SequenceReplay,
    observed: usize,
    /// Updates that are due by the replay ratio (`train_ratio`).
    update_credit: f32,
    random: RandomActions,
    /// Exploration noise about the policy's mean.
    noise: RandomActions,
    /// Of the training environment.
    policy_state: PolicyState,
    decision: Decision,
    /// Of the environments of an evaluation.
    slots: Slots<PolicyState>,
    rng: Rng,
}

impl std::fmt::Debug for Dreamer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Dreamer")
            .field("config", &self.config)
            .field("observed", &self.observed)
            .field("scale", &self.scale)
            .finish_non_exhaustive()
    }
}

impl Dreamer {
    /// A fresh agent for an environment.
    ///
    /// # Errors
    /// If a setting cannot be used.
    pub fn new(spec: &Spec, config: DreamerConfig, seed: u64) -> Result<Self> {
        config.check_at("dreamer")?;
        spec.check()?;
        check_decisions("dreamer", spec, config.action_repeat, 1)?;
        let mut rng = rng::stream(seed, "dreamer");
        let world = WorldModel::new(spec, &config.world, &mut rng);
        let (behaviour, target) = ActorCritic::new(&world, spec.action_size, &config.behaviour, &mut rng);
        let optimiser = AdamConfig { warm_up: config.learning_warm_up, ..AdamConfig::laprop(config.learning_rate) };
        let decisions = spec.horizon.div_ceil(config.action_repeat);
        let mut agent = Self {
            spec: spec.clone(),
            policy_state: PolicyState::new(&world, &config, spec.action_size, rng::stream(seed, "dreamer mind")),
            decision: Decision::default(),
            networks: Networks { world, behaviour, target },
            optimiser: Adam::new(optimiser),
            scale: ReturnScale::default(),
            temperature: Temperature::new(config.behaviour.entropy, config.behaviour.entropy_rate),
            replay: SequenceReplay::new(spec.observation_size(), spec.action_size, config.replay),
            observed: 0,
            update_credit: 0.0,
            random: RandomActions::new(config.warm_up_noise_beta, decisions, spec.action_size),
            noise: RandomActions::new(config.exploration_noise_beta, decisions, spec.action_size),
            slots: Slots::default(),
            rng,
            config,
        };
        agent.policy_state.reset(&agent.networks.world);
        Ok(agent)
    }

    /// The model of the world.
    pub fn world(&self) -> &WorldModel {
        &self.networks.world
    }

    /// Actor and critic.
    pub fn behaviour(&self) -> &ActorCritic {
        &self.networks.behaviour
    }

    fn forget_episode(&mut self) {
        self.policy_state.reset(&self.networks.world);
        self.decision.reset();
        self.random.reset();
        self.noise.reset();
    }
}

impl Agent for Dreamer {
    fn begin_episode(&mut self) {
        self.replay.abandon();
        self.forget_episode();
        self.slots.clear(0);
    }

    fn act(&mut self, obs: &[f32], mode: Mode) -> Vec<f32> {
        let Self { config, networks, spec, observed, random, noise, policy_state, slots, rng, .. } = self;
        match mode {
            Mode::Explore if *observed < config.warm_up => {
                policy_state.held.next(config.action_repeat, || random.next(rng))
            }
            Mode::Explore => policy_state.act(networks, obs, || Some(noise.deviates(rng))),
            Mode::Evaluate => {
                let fresh = |i| PolicyState::of_slot(&networks.world, config, spec.action_size, i);
                slots.state(0, fresh).act(networks, obs, || None)
            }
        }
    }

    fn act_batch(&mut self, slots: &[Slot]) -> Vec<Vec<f32>> {
        let Self { slots: states, config, networks, spec, .. } = self;
        let fresh = |i| PolicyState::of_slot(&networks.world, config, spec.action_size, i);
        let observations: Vec<&[f32]> = slots.iter().map(|slot| slot.obs).collect();
        let each = states.states(slots, fresh).into_par_iter().zip(observations);
        each.map(|(state, obs)| state.act(networks, obs, || None)).collect()
    }

    fn act_and_explain(&mut self, slot: &Slot) -> (Vec<f32>, Vec<ImaginedTrajectory>) {
        let decided = slot.first || self.slots.existing(slot.index).is_none_or(|state| state.held.is_due());
        let action = self.act_batch(&[*slot]).remove(0);
        // An action that is held, or that is planned, was not chosen by the actor now.
        if !decided || self.config.planner.is_some() {
            return (action, Vec::new());
        }
        let Networks { world, behaviour, .. } = &self.networks;
        let fresh = |i| PolicyState::of_slot(world, &self.config, self.spec.action_size, i);
        let start = self.slots.state(slot.index, fresh).latent.repeated(0, SHOWN);
        let rollout = behaviour.imagine(world, &start, &mut rng::stream(0, "dreamer imagined"));
        let decoded: Vec<Vec<f32>> = rollout.features.iter().map(|features| world.decode(features)).collect();
        let width = slot.obs.len();
        let trajectories = (0..SHOWN).map(|i| ImaginedTrajectory {
            observations: decoded.iter().map(|rows| rows[i * width..][..width].to_vec()).collect(),
            value: rollout.returns[0][i],
            disagreement: 0.0,
        });
        (action, trajectories.collect())
    }

    fn observe(&mut self, transition: &Transition) {
        match self.decision.join(transition, self.config.action_repeat) {
            Some(Over::Whole(decision)) => self.replay.push(&decision),
            Some(Over::Short(obs)) => self.replay.close(&obs, false),
            None => {}
        }
        self.observed += 1;
        if transition.terminated || transition.truncated {
            self.forget_episode();
        }
    }

    fn update(&mut self) -> Option<Losses> {
        if self.observed < self.config.warm_up || self.replay.len() < self.config.length {
            return None;
        }
        let DreamerConfig { batch, length, train_ratio, warm_up, warm_up_updates, .. } = self.config;
        let paid_now = if warm_up_updates && self.observed == warm_up { warm_up } else { 1 };
        self.update_credit += paid_now as f32 * train_ratio / (batch * length) as f32;
        let mut losses = None;
        while self.update_credit >= 1.0 {
            self.update_credit -= 1.0;
            losses = Some(self.learn());
        }
        losses
    }
}

impl Diagnostics for Dreamer {
    fn updates(&self) -> u64 {
        self.optimiser.steps()
    }

    fn open_loop(&self, episodes: &[Episode]) -> Vec<OpenLoop> {
        let model = WithActionRepeat { model: &self.networks.world, action_repeat: self.config.action_repeat };
        open_loop(&model, &self.spec, episodes, &mut rng::stream(0, "open loop"))
    }

    fn value_estimates(&self, episodes: &[Episode]) -> Vec<ValueEstimate> {
        let Self { networks: Networks { world, behaviour, .. }, config, spec, .. } = self;
        let discount = config.world.discount();
        let of_episode = |(i, episode): (usize, &Episode)| {
            let episode = &in_decisions(episode, config.action_repeat);
            let mut policy_state =
                PolicyState::new(world, config, spec.action_size, rng::stream(i as u64, "dreamer values"));
            let values = episode.observations.iter().enumerate().map(|(t, obs)| {
                policy_state.observe(world, obs);
                if let Some(action) = episode.actions.get(t) {
                    policy_state.action.clone_from(action);
                }
                behaviour.values(world, &policy_state.latent.features())[0]
            });
            let values: Vec<f32> = values.collect();
            ValueEstimate::of_episode(&values, episode, discount)
        };
        episodes.par_iter().enumerate().flat_map_iter(of_episode).collect()
    }
}

impl Checkpoint for Dreamer {
    fn weights(&self) -> Weights {
        let mut weights = Weights::default();
        weights.insert_module("dreamer", &self.networks);
        weights
    }

    fn load_weights(&mut self, weights: &Weights) -> Result<()> {
        weights.load_module("dreamer", &mut self.networks)?;
        self.networks.target = self.networks.behaviour.target_critic();
        Ok(())
    }

    fn training_state(&self) -> Weights {
        let mut state = Weights::default();
        state.insert_module("target", &self.networks.target);
        self.optimiser.save(&mut state, "optimiser");
        self.replay.save(&mut state, "replay");
        let [low, high] = self.scale.range();
        state.insert("progress", vec![low, high, self.update_credit], [1, 1, 3]);
        if self.config.behaviour.target_entropy.is_some() {
            state.insert("log temperature", vec![self.temperature.log], [1, 1, 1]);
            self.temperature.save_optimiser(&mut state);
        }
        state.insert_counts("counts", &[self.observed as u64]);
        state.insert_rng("rng", &self.rng);
        state.insert_rng("mind rng", &self.policy_state.rng);
        state
    }

    fn load_training_state(&mut self, state: &Weights) -> Result<()> {
        let (own, policy_state) = (state.rng("rng")?, state.rng("mind rng")?);
        let &[low, high, update_credit] = state.get("progress", [1, 1, 3])? else { unreachable!("three numbers") };
        if !(0.0..1.0).contains(&update_credit) {
            return Err(Error::Config(format!("the credit of updates is {update_credit}; it must lie in 0..1")));
        }
        if self.config.behaviour.target_entropy.is_some() {
            self.temperature.log = state.get_within("log temperature", [1, 1, 1], -1e9..=1e9)?[0];
            self.temperature.load_optimiser(state)?;
            self.networks.behaviour.entropy = self.temperature.alpha();
        }
        state.load_module("target", &mut self.networks.target)?;
        self.optimiser.load(state, "optimiser", &self.networks)?;
        self.replay.load(state, "replay")?;
        let most = most_observed(self.replay.most_pushes(), self.config.action_repeat);
        self.observed = state.count("counts", 0..=most)? as usize;
        self.scale = ReturnScale::from_range(low, high);
        self.update_credit = update_credit;
        self.rng = own;
        self.policy_state = PolicyState::new(&self.networks.world, &self.config, self.spec.action_size, policy_state);
        self.forget_episode();
        Ok(())
    }
}

#[cfg(test)]
mod tests;
