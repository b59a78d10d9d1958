//! The reward, learned by networks of its own.
//!
//! A reward is a function of the transition, so its networks read observation, action and next observation, observations as
//! [`LatentFeatures`]: displacements instead of goals, because a few hundred episodes contain only a few hundred goals; and
//! the lengths of displacements, [`Distances`]. They share no weights with the networks of the dynamics, so that neither
//! disturbs the other's training. There is one for each member of the ensemble; all learn from the same transitions, each in
//! its own order.

use super::data::Data;
use super::fit::{Fit, Split};
use super::networks::Networks;
use super::{EnsembleConfig, MIN_STD};
use crate::checkpoint::Weights;
use crate::env::{KnownReward, Spec};
use crate::error::Result;
use crate::model::features::push_row;
use crate::model::{Distances, LatentFeatures, Normaliser};
use crate::nn::GroupLasso;
use crate::nn::frozen::{Feature, FrozenMlp, PANEL, Panels};
use crate::nn::two_hot::{symexp, symlog};
use crate::replay::ReplayBuffer;
use crate::rng::Rng;

/// Normalised inputs are clipped to this. Where a cube is seldom hit, its velocity after a hit can be forty standard deviations
/// from the mean; if one such transition is held out, its error decides when every fit stops.
const MAX_INPUT: f32 = 10.0;
/// Prefix of its arrays in a checkpoint.
const NAME: &str = "reward.";

/// The networks in training.
#[derive(Clone, Debug)]
pub(super) struct RewardModel {
    networks: Networks,
    inputs: Inputs,
    /// [`EnsembleConfig::reward_unit`]
    unit: f32,
    /// The smallest and the largest reward that it has learned from, as the networks predict them.
    range: [f32; 2],
}

impl RewardModel {
    pub fn new(spec: &Spec, config: &EnsembleConfig, rng: &mut Rng) -> Self {
        let inputs =
            Inputs { features: LatentFeatures::new(spec), distances: Distances::new(spec), actions: spec.action_size };
        let mut networks = Networks::new(config, [inputs.width(), 1], &config.reward_hidden, false, rng);
        networks.lasso = inputs.lasso(config.reward_lasso);
        Self { networks, inputs, unit: config.reward_unit, range: [0.0; 2] }
    }

    pub fn fit(
        &mut self,
        config: &EnsembleConfig,
        replay: &ReplayBuffer,
        split: &Split,
        limit: usize,
        rng: &mut Rng,
    ) -> Fit {
        let (mut inputs, mut targets) = (Vec::new(), Vec::with_capacity(replay.len()));
        for i in 0..replay.len() {
            let row = replay.row(i);
            self.inputs.push([row.obs, row.action, row.next_obs], &mut inputs);
            targets.push(symlog(row.reward / self.unit));
        }
        self.range = targets
            .iter()
            .fold([f32::INFINITY, f32::NEG_INFINITY], |[low, high], target| [low.min(*target), high.max(*target)]);
        let floors = vec![MIN_STD; self.inputs.width()];
        let data =
            Data::new(&mut self.networks, [inputs, targets], [&floors, &[MIN_STD]], [MAX_INPUT, config.max_target]);
        self.networks.fit(config, &data, split, limit, rng)
    }

    /// A snapshot of the elites.
    pub fn learned(&self) -> LearnedReward {
        let Networks { members, inputs, targets, elites, .. } = &self.networks;
        LearnedReward {
            members: elites.iter().map(|&member| members[member].learner.frozen().0).collect(),
            inputs: self.inputs.clone(),
            normaliser: inputs.clone(),
            mean: targets.mean[0],
            scale: targets.scale[0],
            unit: self.unit,
            range: self.range,
        }
    }

    pub fn save(&self, weights: &mut Weights) {
        self.networks.save(weights, NAME);
        weights.insert(format!("{NAME}range"), self.range.to_vec(), [1, 1, 2]);
    }

    pub fn load(&mut self, weights: &Weights) -> Result<()> {
        let range = weights.get_within(&format!("{NAME}range"), [1, 1, 2], f32::MIN..=f32::MAX)?;
        let range = [range[0].min(range[1]), range[0].max(range[1])];
        self.networks.load(weights, NAME)?;
        self.range = range;
        Ok(())
    }

    pub fn save_training_state(&self, state: &mut Weights) {
        self.networks.save_training_state(state, NAME);
    }

    pub fn load_training_state(&mut self, state: &Weights) -> Result<()> {
        self.networks.load_training_state(state, NAME)
    }
}

/// What the networks read.
#[derive(Clone, Debug)]
struct Inputs {
    features: LatentFeatures,
    distances: Distances,
    actions: usize,
}

impl Inputs {
    fn width(&self) -> usize {
        2 * (self.features.width() + self.distances.width()) + self.actions
    }

    /// The group lasso of [`EnsembleConfig::reward_lasso`].
    fn lasso(&self, coefficient: f32) -> Option<GroupLasso> {
        let mut of_observation = self.features.lasso(coefficient)?;
        of_observation.resize(of_observation.len() + self.distances.width(), 0.0);
        let of_action = vec![coefficient; self.actions];
        Some(GroupLasso { coefficients: [&of_observation[..], &of_action, &of_observation].concat() })
    }

    /// Appends the inputs of a transition: observation, action, next observation.
    fn push(&self, transition: [&[f32]; 3], inputs: &mut Vec<f32>) {
        push_row(inputs, |inputs| self.push_scaled(transition, inputs), |row| self.squash(row));
    }

    /// Writes the inputs of some transitions to a panel.
    fn fill(&self, transitions: &[[&[f32]; 3]], panel: &mut [Feature]) {
        let mut scaled = Vec::with_capacity(self.width());
        for (place, transition) in transitions.iter().enumerate() {
            scaled.clear();
            self.push_scaled(*transition, &mut scaled);
            panel.iter_mut().zip(&scaled).for_each(|(x, scaled)| x.0[place] = *scaled);
        }
        self.squash(bytemuck::cast_slice_mut(panel));
    }

    /// Appends what [`Inputs::squash`] turns into the inputs of a transition.
    fn push_scaled(&self, [obs, action, next_obs]: [&[f32]; 3], scaled: &mut Vec<f32>) {
        self.features.push_scaled(obs, scaled);
        self.distances.push_scaled(obs, scaled);
        scaled.extend_from_slice(action);
        self.features.push_scaled(next_obs, scaled);
        self.distances.push_scaled(next_obs, scaled);
    }

    /// Turns scaled features into inputs, in place, `[width, rows]`.
    fn squash(&self, scaled: &mut [f32]) {
        let rows = scaled.len() / self.width();
        let of_observation = (self.features.width() + self.distances.width()) * rows;
        let (obs, others) = scaled.split_at_mut(of_observation);
        let (_action, next_obs) = others.split_at_mut(self.actions * rows);
        for observation in [obs, next_obs] {
            let (features, distances) = observation.split_at_mut(self.features.width() * rows);
            self.features.squash(features);
            self.distances.squash(distances);
        }
    }
}

/// A learned reward function with fixed weights.
///
/// As a [`KnownReward`] it gives the mean of its members. Predictions stay within the rewards that it has learned from, so
/// that a planner finds none that is better than all that were received.
#[doc(alias = "reward model")]
#[derive(Clone, Debug)]
pub struct LearnedReward {
    members: Vec<FrozenMlp>,
    inputs: Inputs,
    normaliser: Normaliser,
    mean: f32,
    scale: f32,
    unit: f32,
    range: [f32; 2],
}

impl LearnedReward {
    /// Number of members.
    pub fn members(&self) -> usize {
        self.members.len()
    }

    /// One member alone.
    ///
    /// # Panics
    /// If there is no such member.
    #[must_use]
    pub fn member(&self, member: usize) -> Self {
        Self {
            members: vec![self.members[member].clone()],
            inputs: self.inputs.clone(),
            normaliser: self.normaliser.clone(),
            ..*self
        }
    }

    /// The rewards of transitions as one member predicts them: `obs` and `next_obs` hold `rewards.len()` rows, one after the
    /// other, as does `actions`.
    ///
    /// # Panics
    /// If the lengths do not fit together, or there is no such member.
    pub fn of_member(&self, member: usize, obs: &[f32], actions: &[f32], next_obs: &[f32], rewards: &mut [f32]) {
        let (network, width) = (&self.members[member], self.inputs.width());
        let observation = self.inputs.features.observation_size();
        let rows = obs
            .chunks_exact(observation)
            .zip(actions.chunks_exact(self.inputs.actions))
            .zip(next_obs.chunks_exact(observation));
        assert_eq!(rows.len(), rewards.len(), "one reward for each transition");
        let rows: Vec<_> = rows.map(|((obs, action), next_obs)| [obs, action, next_obs]).collect();
        let mut panels = Panels::default();
        for (rows, rewards) in rows.chunks(PANEL).zip(rewards.chunks_mut(PANEL)) {
            let x = panels.input(width);
            self.inputs.fill(rows, x);
            self.normaliser.normalise_panel(x);
            x.iter_mut().for_each(|x| x.0.iter_mut().for_each(|x| *x = x.clamp(-MAX_INPUT, MAX_INPUT)));
            let y = &network.forward(&mut panels)[0];
            for (reward, y) in rewards.iter_mut().zip(&y.0) {
                *reward = self.unit * symexp((self.mean + self.scale * y).clamp(self.range[0], self.range[1]));
            }
        }
    }
}

impl KnownReward for LearnedReward {
    fn reward(&self, obs: &[f32], action: &[f32], next_obs: &[f32]) -> f32 {
        let mut reward = [0.0];
        self.rewards(obs, action, next_obs, &mut reward);
        reward[0]
    }

    fn rewards(&self, obs: &[f32], actions: &[f32], next_obs: &[f32], rewards: &mut [f32]) {
        let mut of_member = vec![0.0; rewards.len()];
        rewards.fill(0.0);
        for member in 0..self.members() {
            self.of_member(member, obs, actions, next_obs, &mut of_member);
            let share = 1.0 / self.members() as f32;
            rewards.iter_mut().zip(&of_member).for_each(|(mean, reward)| *mean += share * reward);
        }
    }
}
