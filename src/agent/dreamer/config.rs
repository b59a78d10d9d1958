//! Settings of Dreamer.

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::model::WorldModelConfig;
use crate::plan::{ControlConfig, PlannerConfig};

/// Parts of a batch, whose gradients are computed in parallel and averaged. A fixed number: results do not depend on the
/// machine.
pub(super) const PARTS: usize = 2;

/// Settings of [`super::Dreamer`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DreamerConfig {
    /// Settings of the world model.
    pub world: WorldModelConfig,
    /// Settings of actor and critic.
    pub behaviour: ActorCriticConfig,
    /// Plans in the latent space of the world model instead of asking the policy, if there is a planner (PlaNet).
    pub planner: Option<PlannerConfig>,
    /// How often it replans, and how long each action is repeated.
    pub control: ControlConfig,
    /// Learning rate of all networks.
    pub learning_rate: f32,
    /// Updates over which the learning rate grows to that.
    pub learning_warm_up: u32,
    /// Sequences of an update.
    pub batch: usize,
    /// Time steps of each sequence.
    pub length: usize,
    /// Time steps of each sequence from which rollouts are imagined: the last ones, whose latent states have seen most; all
    /// of them if left out. Imagination is most of an update's cost.
    pub dreams: Option<usize>,
    /// The replay ratio: replayed time steps for each step in the environment, so that there are
    /// `train_ratio / (batch x length)` updates a step.
    #[doc(alias = "replay ratio")]
    #[doc(alias = "update-to-data ratio")]
    pub train_ratio: f32,
    /// Steps of random actions before the first update.
    pub warm_up: usize,
    /// Exponent beta of the coloured noise that random actions are made of: 0 is white.
    pub warm_up_noise_beta: f64,
    /// Exponent beta of the coloured noise by which actions are drawn from the policy while it explores: 0 is white, as in
    /// the published code. Temporally correlated noise moves a hand farther (Eberhard et al. 2023).
    pub exploration_noise_beta: f64,
    /// Capacity of the replay buffer, in time steps.
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
    /// # Errors
    /// If a setting cannot be used.
    pub(super) fn check(&self) -> Result<()> {
        self.world.check()?;
        self.behaviour.check()?;
        if let Some(planner) = &self.planner {
            self.control.check(planner)?;
        }
        if !self.batch.is_multiple_of(PARTS) || self.batch == 0 || self.length < 2 {
            return Err(Error::Config(format!("dreamer: `batch` must be a multiple of {PARTS}, `length` at least 2")));
        }
        if self.dreams.is_some_and(|dreams| dreams < 2 || dreams > self.length) {
            return Err(Error::Config("dreamer: `dreams` must lie between 2 and `length`".into()));
        }
        if self.warm_up <= self.length || self.train_ratio <= 0.0 {
            return Err(Error::Config(
                "dreamer: `warm_up` must be more than `length`, `train_ratio` more than 0".into(),
            ));
        }
        Ok(())
    }
}

/// Settings of an [`super::ActorCritic`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ActorCriticConfig {
    /// Units of each hidden layer of actor and critic.
    pub units: usize,
    /// Hidden layers of actor and critic.
    pub layers: usize,
    /// Time steps of an imagined rollout, H.
    pub horizon: usize,
    /// Lambda of the [lambda-returns](super::lambda_returns): 0 bootstraps after one step, 1 at the end of the rollout.
    pub lambda: f32,
    /// Coefficient of the policy's entropy bonus, per nat, in units of the return scale.
    pub entropy: f32,
    /// The smallest standard deviation of the policy.
    pub min_std: f32,
    /// Rate of the target network's exponential moving average, per update.
    #[doc(alias = "target network")]
    pub slow_rate: f32,
    /// Weight of the critic's loss on replayed experience.
    pub replayed: f32,
}

impl Default for ActorCriticConfig {
    fn default() -> Self {
        Self {
            units: 64,
            layers: 3,
            horizon: 15,
            lambda: 0.95,
            entropy: 3e-4,
            min_std: 0.1,
            slow_rate: 0.02,
            replayed: 0.3,
        }
    }
}

impl ActorCriticConfig {
    /// # Errors
    /// If a setting cannot be used.
    pub(crate) fn check(&self) -> Result<()> {
        if self.units == 0 || self.layers == 0 || self.horizon == 0 {
            return Err(Error::Config("dreamer: `units`, `layers` and `horizon` must be at least 1".into()));
        }
        if !(0.0..=1.0).contains(&self.lambda) || !(0.0..1.0).contains(&self.min_std) || self.min_std <= 0.0 {
            return Err(Error::Config("dreamer: `lambda` must lie in [0, 1], `min_std` between 0 and 1".into()));
        }
        Ok(())
    }
}
