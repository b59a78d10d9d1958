//! Settings of an ensemble.

use serde::{Deserialize, Serialize};

use crate::settings::{fits, ranges, weights_between};

/// Settings of an [`Ensemble`](super::Ensemble).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EnsembleConfig {
    /// Number of networks.
    #[doc(alias = "ensemble size")]
    #[doc(alias = "bootstraps")]
    pub members: usize,
    /// Number of members, the best on the validation set, that predict.
    pub elites: usize,
    /// Width of each hidden layer.
    pub hidden: Vec<usize>,
    /// Learning rate of AdamW.
    pub learning_rate: f32,
    /// Learning rate at the end of a fit, as a fraction of `learning_rate`; it decays linearly. 1 keeps it constant. With
    /// decay the final weights, which plans are made with, depend less on the last minibatches.
    pub final_learning_rate_fraction: f32,
    /// Decoupled weight decay of AdamW: each step scales the weights by `1 - learning_rate * weight_decay`.
    pub weight_decay: f32,
    /// Transitions in each minibatch; every member has its own.
    pub batch: usize,
    /// Whether each member trains on a bootstrap sample (drawn with replacement) of the training set; otherwise on all of
    /// it, in its own order.
    #[doc(alias = "bagging")]
    pub bootstrap: bool,
    /// Fraction of the transitions held out as validation set: for early stopping, the choice of elites and the temperature
    /// of the predicted standard deviations. Which transitions these are is settled when they enter the replay buffer, so
    /// that no fit ever trains on them.
    #[doc(alias = "validation ratio")]
    pub held_out: f64,
    /// Gradient steps of the first fit, at most.
    pub first_steps: usize,
    /// Gradient steps of each later fit, at most.
    pub steps: usize,
    /// Gradient steps between two evaluations on the validation set.
    pub check_every: usize,
    /// Early stopping: a fit ends after this many evaluations in a row in which no member has improved by 1 %. It has an
    /// effect on later fits only if it is well below `steps / check_every`. Whether it does or not, each member ends with
    /// the weights of its best evaluation.
    #[doc(alias = "early stopping")]
    pub patience: usize,
    /// Whether the bounds of the log-variance are learned (as in PETS) or constant (as in mbrl-lib's default).
    pub learn_bounds: bool,
    /// Exponent of the beta-NLL (Seitzer et al. 2022), from 0, the plain negative log-likelihood as in PETS, to 1: see
    /// [`bounded_nll`](crate::nn::bounded_nll).
    #[doc(alias = "beta-NLL")]
    pub beta: f32,
    /// Targets are clipped to this many standard deviations, so that rare large changes (a cube that tips over) do not
    /// dominate the loss. The change of a [flag](crate::env::Feature::flag) is never clipped: its unit is at least
    /// `1 / max_target`.
    pub max_target: f32,
    /// Whether the reward is learned too, by networks of its own; otherwise a known reward function is needed for planning.
    pub learn_reward: bool,
    /// Width of each hidden layer of the networks that learn the reward.
    pub reward_hidden: Vec<usize>,
    /// A learned reward is predicted as symlog(reward / `reward_unit`): where rewards are much larger than the unit, relative
    /// errors count, below it absolute ones. A small unit tells small rewards apart, such as those far from a goal.
    #[doc(alias = "symlog")]
    pub reward_unit: f32,
    /// Group lasso on the inputs of the networks that learn the reward, except differences, such as the vector from the hand to
    /// a goal, and [distances](crate::model::Distances): each step shortens the weights that leave an input, as one vector, by
    /// `learning_rate * reward_lasso`. Without it, networks tell a few episodes apart by what is constant in each, such as the
    /// place of the goal, and are wrong in the next one. It has no effect where no feature is a
    /// [difference](crate::env::Feature::difference).
    #[doc(alias = "group lasso")]
    pub reward_lasso: f32,
    /// Whether each predicted change is multiplied by a learned gate, a sigmoid with its own output, which can close over
    /// whole regions of the input: a cube that is not touched stays where it is. Without gates its predicted position
    /// drifts slightly, and planners exploit that.
    pub gated: bool,
}

impl Default for EnsembleConfig {
    fn default() -> Self {
        Self {
            members: 5,
            elites: 5,
            hidden: vec![200; 3],
            learning_rate: 1e-3,
            final_learning_rate_fraction: 1.0,
            weight_decay: 1e-2,
            batch: 256,
            bootstrap: false,
            held_out: 0.1,
            first_steps: 2000,
            steps: 500,
            check_every: 50,
            patience: 5,
            learn_bounds: false,
            beta: 0.5,
            max_target: 10.0,
            learn_reward: false,
            reward_hidden: vec![64; 2],
            reward_unit: 1.0,
            reward_lasso: 0.0,
            gated: false,
        }
    }
}

ranges!(EnsembleConfig {
    members: 1..=100,
    elites: 1..=100,
    hidden: 1..=4096,
    learning_rate: 0.0..=1.0,
    final_learning_rate_fraction: 0.0..=1.0,
    weight_decay: 0.0..=100.0,
    batch: 1..=65_536,
    bootstrap: Any,
    held_out: 0.0..=0.9,
    first_steps: 0..=1_000_000,
    steps: 0..=1_000_000,
    check_every: 1..=1_000_000,
    patience: 1..=1_000_000,
    learn_bounds: Any,
    beta: 0.0..=1.0,
    max_target: 1e-3..=1e6,
    learn_reward: Any,
    reward_hidden: 1..=4096,
    reward_unit: 1e-9..=1e9,
    reward_lasso: 0.0..=1e3,
    gated: Any,
}
require elites <= members => "`elites` must not exceed `members`";
require fits(&[*members, weights_between(reward_hidden)]) =>
    "`members` with the layers of `reward_hidden` have too many weights";
require fits(&[*members, weights_between(hidden)]) => "`members` with the layers of `hidden` have too many weights";
require fits(&[*members, *batch, hidden.iter().sum()]) => "`members` times `batch` times `hidden` does not fit into memory";
require fits(&[*members, *batch, *check_every.min(first_steps.max(steps))]) =>
    "`members` times `batch` times `check_every` does not fit into memory";
);

impl EnsembleConfig {
    /// The learning rate at `step` of a fit of `steps`.
    pub(super) fn learning_rate_at(&self, step: usize, steps: usize) -> f32 {
        self.learning_rate * (1.0 - (1.0 - self.final_learning_rate_fraction) * step as f32 / steps as f32)
    }
}
