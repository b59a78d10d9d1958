//! Settings of Dreamer.

use serde::{Deserialize, Serialize};

use crate::model::WorldModelConfig;
use crate::plan::{ControlConfig, PlannerConfig};
use crate::settings::{fits, ranges};

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
    /// Plans in the latent space of the world model instead of asking the policy, if there is a planner (PlaNet). Not `gradient` or
    /// `hybrid`: every sequence is imagined with random numbers of its own.
    pub planner: Option<PlannerConfig>,
    /// How often it replans, and how long each action is repeated.
    pub control: ControlConfig,
    /// Time steps for which each action of the policy is held: a decision. The world model's steps, rewards (means, with zeros after
    /// the end of the task) and discount are of decisions.
    #[doc(alias = "frame skip")]
    pub action_repeat: usize,
    /// Learning rate of all networks.
    pub learning_rate: f32,
    /// Updates over which the learning rate grows to that.
    pub learning_warm_up: u32,
    /// Sequences of an update.
    pub batch: usize,
    /// Decisions in each sequence.
    pub length: usize,
    /// Decisions of each sequence from which rollouts are imagined: the last ones, whose latent states have seen most; all
    /// of them if left out. Imagination is most of an update's cost.
    pub dreams: Option<usize>,
    /// The replay ratio: replayed decisions for each time step in the environment, so that there are
    /// `train_ratio / (batch x length)` updates a step.
    #[doc(alias = "replay ratio")]
    #[doc(alias = "update-to-data ratio")]
    pub train_ratio: f32,
    /// Steps of random actions before the first update.
    pub warm_up: usize,
    /// Whether the steps of the warm-up owe updates by the replay ratio, too; all of them are made at its end.
    pub warm_up_updates: bool,
    /// Exponent beta of the spectrum of the random actions, which are normal deviates clamped to [-1, 1]: 0 is white noise.
    pub warm_up_noise_beta: f64,
    /// Exponent beta of the coloured noise by which actions are drawn from the policy while it explores: 0 is white, as in
    /// the published code. Temporally correlated noise moves a hand farther (Eberhard et al. 2023). Without effect with a planner.
    pub exploration_noise_beta: f64,
    /// Capacity of the replay buffer, in decisions.
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
            action_repeat: 1,
            learning_rate: 4e-5,
            learning_warm_up: 1000,
            batch: 16,
            length: 64,
            dreams: None,
            train_ratio: 1024.0,
            warm_up: 1024,
            warm_up_updates: false,
            warm_up_noise_beta: 0.0,
            exploration_noise_beta: 0.0,
            replay: 1_000_000,
        }
    }
}

ranges!(DreamerConfig {
    world: Nested,
    behaviour: Nested,
    planner: Nested,
    control: Nested,
    action_repeat: 1..=1000,
    learning_rate: 0.0..=1.0,
    learning_warm_up: 0..=1_000_000_000,
    batch: 2..=65_536,
    length: 2..=10_000,
    dreams: 2..=10_000,
    train_ratio: 1e-6..=1e6,
    warm_up: 3..=1_000_000_000,
    warm_up_updates: Any,
    warm_up_noise_beta: 0.0..=10.0,
    exploration_noise_beta: 0.0..=10.0,
    replay: 2..=100_000_000,
}
require batch.is_multiple_of(PARTS) => "`batch` must be even";
require dreams.is_none_or(|dreams| dreams <= *length) => "`dreams` must not exceed `length`";
require *warm_up > length * action_repeat => "`warm_up` must be more than `length` decisions";
require replay >= length => "`replay` must hold at least `length` decisions";
require *train_ratio <= (100 * batch * length) as f32 => "`train_ratio` must not exceed 100 times `batch` times `length`";
require planner.as_ref().is_none_or(|planner| control.suits(planner)) =>
    "`control.replan_every` must not exceed the planner's `horizon`";
require !matches!(planner, Some(PlannerConfig::Gradient(_) | PlannerConfig::Hybrid(_))) =>
    "`planner` must not be `gradient` or `hybrid`: every sequence is imagined with random numbers of its own, so differences of returns \
     are no gradients";
require planner.as_ref().is_none_or(|planner| {
    fits(&[planner.candidates(), planner.horizon() * control.action_repeat + world.widest()])
}) => "the planner's candidates do not fit into memory";
require fits(&[*batch, *length, world.widest().max(behaviour.units)]) =>
    "`batch` times `length` times the widest layer does not fit into memory";
require fits(&[*batch, dreams.unwrap_or(*length), behaviour.horizon, world.widest().max(behaviour.units)]) =>
    "`batch` times `dreams` times `behaviour.horizon` times the widest layer does not fit into memory";
);

/// How the actor learns from imagined rollouts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ActorGradient {
    /// Log-probabilities of actions are weighted by their advantages, as in the published code.
    #[default]
    Reinforce,
    /// Returns are differentiated with respect to actions, through the learned dynamics, as in DreamerV1 and V2.
    Dynamics,
}

/// Settings of an [`super::ActorCritic`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ActorCriticConfig {
    /// Units of each hidden layer of actor and critic.
    pub units: usize,
    /// Hidden layers of actor and critic.
    pub layers: usize,
    /// Decisions of an imagined rollout, H.
    pub horizon: usize,
    /// Lambda of the [lambda-returns](super::lambda_returns): 0 bootstraps after one step, 1 at the end of the rollout.
    pub lambda: f32,
    /// Coefficient of the policy's entropy bonus, per nat, in units of the return scale.
    pub entropy: f32,
    /// The policy's target entropy in nats, for each number of an action: if there is one, the coefficient starts at `entropy` and
    /// is tuned towards it, as SAC's temperature is. 1.42 is the most, with a standard deviation of 1. The published coefficient is
    /// constant.
    #[doc(alias = "automatic temperature")]
    pub target_entropy: Option<f32>,
    /// Step size of the coefficient's logarithm (Adam), with a target entropy.
    pub entropy_rate: f32,
    /// Weight of the policy's squared mean actions in the actor's loss, in units of the return scale. Where nothing is to be gained
    /// by moving, for example with a lifted cube, the mean is otherwise arbitrary. Soft actor-critic's first code has such a term
    /// (for the mean before its tanh); the published Dreamer has none.
    #[doc(alias = "policy_mean_reg_weight")]
    #[doc(alias = "control cost")]
    pub mean_penalty: f32,
    /// How many components of an action the penalty counts, from the first; all of them if left out. On the arm, the first three move
    /// the hand. The fourth moves the fingers: with a mean a little below zero, they open slowly, so that what is held falls.
    pub penalised_components: Option<usize>,
    /// How the actor learns.
    pub gradient: ActorGradient,
    /// Whether, for REINFORCE, the mean advantage of an update is subtracted from all of them. While values grow, the critic lags
    /// behind and almost every advantage is positive, which adds variance: each update makes nearly all drawn actions likelier.
    pub center_advantages: bool,
    /// The smallest standard deviation of the policy.
    pub min_std: f32,
    /// Rate of the target network's exponential moving average, per update.
    #[doc(alias = "target network")]
    pub target_rate: f32,
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
            target_entropy: None,
            entropy_rate: 1e-3,
            mean_penalty: 0.0,
            penalised_components: None,
            gradient: ActorGradient::default(),
            center_advantages: false,
            min_std: 0.1,
            target_rate: 0.02,
            replayed: 0.3,
        }
    }
}

ranges!(ActorCriticConfig {
    units: 1..=4096,
    layers: 1..=16,
    horizon: 1..=1000,
    lambda: 0.0..=1.0,
    entropy: 0.0..=1e3,
    target_entropy: -100.0..=100.0,
    entropy_rate: 0.0..=1.0,
    mean_penalty: 0.0..=1e3,
    penalised_components: 1..=4096,
    gradient: Any,
    center_advantages: Any,
    min_std: 1e-4..=0.999,
    target_rate: 0.0..=1.0,
    replayed: 0.0..=1e3,
}
require target_entropy.is_none() || *entropy > 0.0 => "with a `target_entropy`, `entropy` must not be 0";
);
