//! DreamerV3 (Hafner et al. 2023), small: learn a latent world model, and in it, asleep, an actor and a critic.
//!
//! Only wiring: the world is in [`crate::model`], actor and critic are in [`ActorCritic`], planners in [`crate::plan`].
//! Losses, networks and constants are the reference implementation's. Deviations: stretches of experience start with a
//! blank memory, new experience is not given precedence in the replay, places are seen as the way there
//! (`model/view.rs`), and when it is judged the policy acts by its mean.

mod actor_critic;
mod planner;
mod returns;

use dfdx::prelude::*;
use dfdx::tensor::{Cpu, Gradients};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use actor_critic::{ActorCritic, ActorCriticConfig, Dream, SlowCritic};
pub use planner::LatentObjective;
pub use returns::{ReturnScale, lambda_returns, replayed_returns};

use super::warm_up::RandomActions;
use super::{Agent, Checkpoint, Diagnostics, ImaginedTrajectory, Losses, Mode, Slot, Slots, ValueEstimate};
use crate::env::Spec;
use crate::error::{Error, Result};
use crate::model::open_loop::{Episode, OpenLoop, open_loop};
use crate::model::{Latent, WorldModel, WorldModelConfig};
use crate::nn::ops::{self, record};
use crate::nn::{Adam, AdamConfig, Parameters, Weights, parameters_of_fields, tensor};
use crate::plan::{ControlConfig, PlannerConfig, RecedingHorizon};
use crate::replay::{SequenceBatch, SequenceReplay, Transition};
use crate::rng::{self, Rng};

/// Each update is cut into so many parts, which learn side by side. A fixed number: results do not depend on the machine.
const PARTS: usize = 2;

/// Dreams that are shown of a moment.
const SHOWN: usize = 12;

/// Settings of [`Dreamer`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DreamerConfig {
    /// The world model.
    pub world: WorldModelConfig,
    /// Actor and critic.
    pub behaviour: ActorCriticConfig,
    /// Plans in the latent world instead of asking the policy, if there is a planner.
    pub planner: Option<PlannerConfig>,
    /// How plans become control.
    pub control: ControlConfig,
    /// Step size of everything.
    pub learning_rate: f32,
    /// Updates over which the step size grows to that.
    pub learning_warm_up: u32,
    /// Stretches of experience in an update.
    pub batch: usize,
    /// Moments in each.
    pub length: usize,
    /// Moments of each from which it dreams: the last ones, which have the most to look back on; from all if left out.
    /// Dreams are what costs most.
    pub dreams: Option<usize>,
    /// Moments that are learned from for each moment that is lived through.
    pub train_ratio: f32,
    /// Random steps before the first update.
    pub warm_up: usize,
    /// Exponent of the noise of which random actions are made: 0 is white.
    pub warm_up_noise_beta: f64,
    /// Exponent of the noise that moves actions about the policy's mean while it explores: 0 is white, as in the reference.
    /// Slower noise takes a hand somewhere (Eberhard et al. 2023).
    pub exploration_noise_beta: f64,
    /// Moments remembered.
    pub replay: usize,
}

impl Default for DreamerConfig {
    /// The smallest published size, `size1m`, as it is run on state observations.
    fn default() -> Self {
        Self {
            world: WorldModelConfig::default(),
            behaviour: ActorCriticConfig::default(),
            planner: None,
            control: ControlConfig::default(),
            learning_rate: 4e-5,
            learning_warm_up: 1000,
            batch: 16,
            length: 64,
            dreams: None,
            train_ratio: 1024.0,
            warm_up: 1024,
            warm_up_noise_beta: 0.0,
            exploration_noise_beta: 0.0,
            replay: 1_000_000,
        }
    }
}

impl DreamerConfig {
    fn check(&self) -> Result<()> {
        self.world.check()?;
        self.behaviour.check()?;
        if let Some(planner) = &self.planner {
            self.control.check(planner)?;
        }
        if !self.batch.is_multiple_of(PARTS) || self.batch == 0 || self.length < 2 {
            return Err(Error::BadSetting(format!(
                "dreamer: `batch` must be a multiple of {PARTS}, `length` at least 2"
            )));
        }
        if self.dreams.is_some_and(|dreams| dreams < 2 || dreams > self.length) {
            return Err(Error::BadSetting("dreamer: `dreams` must lie between 2 and `length`".into()));
        }
        if self.warm_up <= self.length || self.train_ratio <= 0.0 {
            return Err(Error::BadSetting(
                "dreamer: `warm_up` must be more than `length`, `train_ratio` more than 0".into(),
            ));
        }
        Ok(())
    }
}

/// All that learns; and the slow critic, which follows.
struct Networks {
    world: WorldModel,
    behaviour: ActorCritic,
    slow: SlowCritic,
}

parameters_of_fields!(Networks: world, behaviour);

/// World model, actor and critic, and the experience that they learn from.
pub struct Dreamer {
    config: DreamerConfig,
    action_size: usize,
    networks: Networks,
    optimiser: Adam,
    scale: ReturnScale,
    replay: SequenceReplay,
    observed: usize,
    /// Updates that are update_credit for what was lived through.
    update_credit: f32,
    random: RandomActions,
    /// Moves its actions while it explores.
    noise: RandomActions,
    /// Acts where it learns.
    policy_state: PolicyState,
    /// Act where it is evaluated.
    slots: Slots<PolicyState>,
    rng: Rng,
}

/// What is believed in one world, and what was done there last.
struct PolicyState {
    belief: Latent,
    action: Vec<f32>,
    control: Option<RecedingHorizon>,
    rng: Rng,
}

/// What a part of an update has found out.
struct Part {
    gradients: Gradients<f32, Cpu>,
    losses: Losses,
    dream: Dream,
}

impl Dreamer {
    /// A fresh agent for an environment.
    ///
    /// # Errors
    /// If a setting cannot be used.
    pub fn new(spec: &Spec, config: DreamerConfig, seed: u64) -> Result<Self> {
        config.check()?;
        spec.check()?;
        let mut rng = rng::stream(seed, "dreamer");
        let world = WorldModel::new(spec, &config.world, &mut rng);
        let (behaviour, slow) = ActorCritic::new(&world, spec.action_size, &config.behaviour, &mut rng);
        let optimiser = AdamConfig { warm_up: config.learning_warm_up, ..AdamConfig::laprop(config.learning_rate) };
        let mut agent = Self {
            action_size: spec.action_size,
            policy_state: PolicyState::new(&world, &config, spec.action_size, rng::stream(seed, "dreamer mind")),
            networks: Networks { world, behaviour, slow },
            optimiser: Adam::new(optimiser),
            scale: ReturnScale::default(),
            replay: SequenceReplay::new(spec.observation_size(), spec.action_size, config.replay),
            observed: 0,
            update_credit: 0.0,
            random: RandomActions::new(config.warm_up_noise_beta, spec.horizon, spec.action_size),
            noise: RandomActions::new(config.exploration_noise_beta, spec.horizon, spec.action_size),
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

    /// One update of everything, on stretches of experience drawn anew.
    pub fn learn(&mut self) -> Losses {
        let DreamerConfig { batch, length, .. } = self.config;
        let shares: Vec<(SequenceBatch, Rng)> = (0..PARTS)
            .map(|_| (self.replay.sample(batch / PARTS, length, &mut self.rng), rng::fork(&mut self.rng)))
            .collect();
        let networks = &self.networks;
        let dreams = self.config.dreams.unwrap_or(length);
        let parts: Vec<Part> =
            shares.into_par_iter().map(|(batch, rng)| networks.world_model_update(&batch, dreams, rng)).collect();
        let mut returns: Vec<f32> = parts.iter().flat_map(|part| part.dream.returns.concat()).collect();
        self.scale.update(&mut returns);
        let scale = self.scale.scale();
        let parts: Vec<Part> = parts.into_par_iter().map(|part| networks.actor_critic_update(part, scale)).collect();

        let mut losses = Losses::new();
        let mut gradients = Gradients::leaky();
        for mut part in parts {
            for (name, value) in part.losses {
                *losses.entry(name).or_default() += value / PARTS as f32;
            }
            for (_, parameter) in self.networks.parameters() {
                let own = std::mem::take(&mut **part.gradients.get_or_alloc_mut(parameter).expect("memory"));
                let sum = gradients.get_or_alloc_mut(parameter).expect("memory");
                sum.iter_mut().zip(own).for_each(|(sum, own)| *sum += own / PARTS as f32);
            }
        }
        losses.insert("gradient", self.optimiser.step(&mut self.networks, &mut gradients));
        losses.insert("return_scale", scale);
        let Networks { behaviour, slow, .. } = &mut self.networks;
        behaviour.update_target(slow);
        losses
    }
}

impl Networks {
    /// The first half of a part of an update: the world model's losses, and dreams of where its last beliefs may lead.
    fn world_model_update(&self, batch: &SequenceBatch, dreams: usize, mut rng: Rng) -> Part {
        let Self { world, behaviour, slow } = self;
        let mut tape = OwnedTape::default();
        let loss = world.loss(&mut tape, batch, &mut rng);
        let batch = batch.last(dreams);
        let rows = dreams * batch.sequences;
        let dream = behaviour.dream(world, &loss.latent.last(rows), &mut rng);
        let last = record(&mut tape, &loss.features, |all| {
            let count = all.shape().1;
            ops::rows(all, count - rows, rows)
        });
        let replayed = behaviour.replayed_loss(&mut tape, world, slow, &batch, &last, &dream.returns[0]);
        let mut losses: Losses = loss.losses.iter().map(|(name, _, loss)| (*name, ops::mean(loss))).collect();
        losses.insert("replayed_value", ops::mean(&replayed.1));
        losses.insert("posterior_entropy", loss.entropies[0]);
        losses.insert("prior_entropy", loss.entropies[1]);
        let mut all: Vec<_> = loss.losses.into_iter().map(|(_, weight, loss)| (weight, loss)).collect();
        all.push(replayed);
        Part { gradients: ops::total(tape, &all).backward(), losses, dream }
    }

    /// The second half: actor and critic learn from the dreams.
    fn actor_critic_update(&self, part: Part, scale: f32) -> Part {
        let Part { gradients, mut losses, dream } = part;
        let Self { world, behaviour, slow } = self;
        // Onto the gradients that are there already.
        let (_, mut tape) = dream.features[0].clone().traced(gradients).split_tape();
        let (all, report) = behaviour.losses(&mut tape, world, slow, &dream, scale);
        losses.extend(report);
        Part { gradients: ops::total(tape, &all).backward(), losses, dream }
    }
}

impl PolicyState {
    /// The state of a slot, which depends on nothing but the slot's index.
    fn of_slot(world: &WorldModel, config: &DreamerConfig, action_size: usize, index: usize) -> Self {
        Self::new(world, config, action_size, rng::stream(index as u64, "dreamer seat"))
    }

    fn new(world: &WorldModel, config: &DreamerConfig, actions: usize, rng: Rng) -> Self {
        let control = config
            .planner
            .as_ref()
            .map(|planner| RecedingHorizon::new(planner.build(actions), actions, &config.control));
        Self { belief: world.initial(1), action: vec![0.0; actions], control, rng }
    }

    /// A new episode begins.
    fn reset(&mut self, world: &WorldModel) {
        self.belief = world.initial(1);
        self.action.fill(0.0);
        if let Some(control) = &mut self.control {
            control.reset();
        }
    }

    /// Takes in what is to be seen.
    fn look(&mut self, world: &WorldModel, obs: &[f32]) {
        let before = tensor(world.device(), self.action.clone(), (1, 1, self.action.len()));
        self.belief = world.observe(&self.belief, &before, obs, &mut self.rng);
    }

    /// Looks, and acts; by the policy's mean, or so many of its deviations away from it.
    fn act(&mut self, networks: &Networks, obs: &[f32], noise: Option<&[f32]>) -> Vec<f32> {
        let Networks { world, behaviour, .. } = networks;
        self.look(world, obs);
        let action = match &mut self.control {
            Some(control) => {
                let rng = rng::fork(&mut self.rng);
                let mut objective = LatentObjective { world, critic: behaviour, belief: &self.belief, rng };
                control.act(&mut objective, &mut |_| {}, &mut self.rng)
            }
            None => behaviour.act(&self.belief.features(), noise),
        };
        self.action = action.iter().map(|a| a.clamp(-1.0, 1.0)).collect();
        self.action.clone()
    }
}

impl Agent for Dreamer {
    fn begin_episode(&mut self) {
        self.policy_state.reset(&self.networks.world);
        self.random.reset();
        self.noise.reset();
        self.slots.clear(0);
    }

    fn act(&mut self, obs: &[f32], mode: Mode) -> Vec<f32> {
        let Self { config, networks, action_size, observed, random, noise, policy_state, slots, rng, .. } = self;
        match mode {
            Mode::Explore if *observed < config.warm_up => random.next(rng),
            Mode::Explore => policy_state.act(networks, obs, Some(&noise.deviates(rng))),
            Mode::Evaluate => {
                let fresh = |i| PolicyState::of_slot(&networks.world, config, *action_size, i);
                slots.state(0, fresh).act(networks, obs, None)
            }
        }
    }

    fn act_batch(&mut self, slots: &[Slot]) -> Vec<Vec<f32>> {
        let Self { slots: states, config, networks, action_size, .. } = self;
        let fresh = |i| PolicyState::of_slot(&networks.world, config, *action_size, i);
        let observations: Vec<&[f32]> = slots.iter().map(|slot| slot.obs).collect();
        let each = states.states(slots, fresh).into_par_iter().zip(observations);
        each.map(|(state, obs)| state.act(networks, obs, None)).collect()
    }

    fn act_and_explain(&mut self, slot: &Slot) -> (Vec<f32>, Vec<ImaginedTrajectory>) {
        let action = self.act_batch(&[*slot]).remove(0);
        let Networks { world, behaviour, .. } = &self.networks;
        let fresh = |i| PolicyState::of_slot(world, &self.config, self.action_size, i);
        let start = self.slots.state(slot.index, fresh).belief.repeated(0, SHOWN);
        let dream = behaviour.dream(world, &start, &mut rng::stream(0, "dreamer foresight"));
        let decoded: Vec<Vec<f32>> = dream.features.iter().map(|features| world.decode(features)).collect();
        let width = slot.obs.len();
        let trajectories = (0..SHOWN).map(|i| ImaginedTrajectory {
            observations: decoded.iter().map(|rows| rows[i * width..][..width].to_vec()).collect(),
            value: dream.returns[0][i],
            disagreement: 0.0,
        });
        (action, trajectories.collect())
    }

    fn observe(&mut self, transition: &Transition) {
        self.replay.push(transition);
        self.observed += 1;
        if transition.terminated || transition.truncated {
            self.policy_state.reset(&self.networks.world);
            self.random.reset();
            self.noise.reset();
        }
    }

    fn update(&mut self) -> Option<Losses> {
        if self.observed < self.config.warm_up {
            return None;
        }
        self.update_credit += self.config.train_ratio / (self.config.batch * self.config.length) as f32;
        let mut losses = None;
        while self.update_credit >= 1.0 {
            self.update_credit -= 1.0;
            losses = Some(self.learn());
        }
        losses
    }
}

impl Diagnostics for Dreamer {
    fn open_loop(&self, episodes: &[Episode]) -> Vec<OpenLoop> {
        open_loop(&self.networks.world, episodes, &mut rng::stream(0, "open loop"))
    }

    fn value_estimates(&self, episodes: &[Episode]) -> Vec<ValueEstimate> {
        let Self { networks: Networks { world, behaviour, .. }, config, action_size, .. } = self;
        let discount = config.world.discount();
        let of_episode = |(i, episode): (usize, &Episode)| {
            let mut policy_state =
                PolicyState::new(world, config, *action_size, rng::stream(i as u64, "dreamer values"));
            let values = episode.observations.iter().enumerate().map(|(t, obs)| {
                policy_state.look(world, obs);
                if let Some(action) = episode.actions.get(t) {
                    policy_state.action.clone_from(action);
                }
                behaviour.values(world, &policy_state.belief.features())[0]
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
        weights.load_module("dreamer", &mut self.networks)
    }

    fn training_state(&self) -> Weights {
        let mut state = Weights::default();
        state.insert_module("slow", &self.networks.slow);
        self.optimiser.save(&mut state, "optimiser");
        self.replay.save(&mut state, "replay");
        let [low, high] = self.scale.range();
        state.insert("progress", vec![low, high, self.update_credit], [1, 1, 3]);
        state.insert_counts("counts", &[self.observed as u64]);
        state.insert_counts("rng", &rng::state(&self.rng));
        state.insert_counts("mind rng", &rng::state(&self.policy_state.rng));
        state
    }

    fn load_training_state(&mut self, state: &Weights) -> Result<()> {
        let counts = state.counts("counts", 1)?;
        let (own, policy_state) = (state.counts("rng", 4)?, state.counts("mind rng", 4)?);
        let &[low, high, update_credit] = state.get("progress", [1, 1, 3])? else { unreachable!("three numbers") };
        state.load_module("slow", &mut self.networks.slow)?;
        self.optimiser.load(state, "optimiser", &self.networks)?;
        self.replay.load(state, "replay")?;
        self.observed = counts[0] as usize;
        self.scale = ReturnScale::from_range(low, high);
        self.update_credit = update_credit;
        self.rng = rng::from_state(&own);
        self.policy_state =
            PolicyState::new(&self.networks.world, &self.config, self.action_size, rng::from_state(&policy_state));
        self.random.reset();
        self.noise.reset();
        Ok(())
    }
}
