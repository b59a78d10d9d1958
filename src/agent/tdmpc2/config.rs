//! Settings of [`TdMpc2`](super::TdMpc2).

use serde::{Deserialize, Serialize};

use crate::agent::discount_for;
use crate::model::{EntropyBonus, ImplicitConfig};
use crate::plan::GuidedConfig;
use crate::settings::{fits, ranges};

/// Settings of [`TdMpc2`](super::TdMpc2). [`Preset`](crate::agent::Preset) has tuned ones. The defaults are the published
/// constants, except for the batch (128; published 256), smaller networks, the number of critics (2; published 5) and the warm-up
/// (1,000 steps; published five episodes, if that is more).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TdMpc2Config {
    /// Sequences in a minibatch.
    pub batch: usize,
    /// Steps that the model is rolled out for when it learns.
    pub horizon: usize,
    /// Time steps for which each action is held: a decision. The model's steps, and those of a plan, are decisions; their rewards
    /// are means, with zeros after the end of the task.
    #[doc(alias = "frame skip")]
    pub action_repeat: usize,
    /// Updates for each time step; those of the warm-up are made up for at its end.
    #[doc(alias = "UTD")]
    pub updates_per_step: f32,
    /// Time steps of random actions before the first update.
    pub warm_up: usize,
    /// Exponent of the spectrum of the random actions, which are normal deviates clamped to [-1, 1]: 0 is white noise, 1 pink noise. The
    /// published code draws uniform ones.
    pub warm_up_noise_beta: f64,
    /// Exponent of the spectrum of the noise around a plan while it explores; white if absent.
    #[doc(alias = "pink noise")]
    pub exploration_noise_beta: Option<f64>,
    /// In evaluations, execute the mean of a plan's last elites instead of one that is drawn from them: more precise, while
    /// exploration keeps the variety of the elites.
    pub evaluate_mean: bool,
    /// In evaluations, subtracted from a plan's return, times the sum of its squared actions, over decisions.
    #[doc(alias = "control cost")]
    pub effort_penalty: f32,
    /// In evaluations, subtracted from a plan's return, times the sum of the squared changes from one action to the next, over
    /// decisions, the first from the last executed action: what makes planned motion smooth.
    #[doc(alias = "smoothness")]
    pub change_penalty: f32,
    /// Capacity of the replay buffer, in decisions.
    pub replay: usize,
    /// Discount factor gamma, per decision. Without one it follows from the length of an episode:
    /// [`TdMpc2Config::discount_for`].
    #[doc(alias = "gamma")]
    pub discount: Option<f32>,
    /// Decisions of reward in a value target, as far as the slice of experience goes: n-step returns. Values need some 1 / (1 -
    /// discount) times 1 / `target_rate` updates to become those of far rewards; with n steps, n times fewer.
    #[doc(alias = "multi-step return")]
    pub n_step: usize,
    /// Rewards are learned as multiples of this, and so are values. The bins next to zero lie at about the unit times `bin_limit /
    /// (bins / 2)`; of rewards much smaller than that, little is learned. The policy's loss and the planner's temperature suit values
    /// of one unit or more.
    #[doc(alias = "reward scale")]
    pub reward_unit: f32,
    /// Step size (Adam).
    pub learning_rate: f32,
    /// The encoder's step size, as a fraction of the others'.
    pub encoder_rate: f32,
    /// Group lasso on the encoder's inputs, except differences, such as the vector from the hand to a goal: each step shortens
    /// the weights that leave an input, as one vector, by `learning_rate * lasso`. See
    /// [`EnsembleConfig::reward_lasso`](crate::model::EnsembleConfig::reward_lasso).
    #[doc(alias = "group lasso")]
    pub lasso: f32,
    /// Gradients of the model, and of the policy, with a larger global norm are scaled down to it.
    pub max_gradient_norm: f32,
    /// Rate at which the target critics follow the critics, per update.
    #[doc(alias = "tau")]
    #[doc(alias = "target network")]
    pub target_rate: f32,
    /// Weight of the entropy bonus in the policy's loss.
    pub entropy: f32,
    /// Which entropy: that of the Gaussian before the tanh, or of the squashed action.
    pub entropy_bonus: EntropyBonus,
    /// The world model.
    pub model: ImplicitConfig,
    /// The planner.
    pub planner: GuidedConfig,
}

impl Default for TdMpc2Config {
    fn default() -> Self {
        Self {
            batch: 128,
            horizon: 3,
            action_repeat: 1,
            updates_per_step: 1.0,
            warm_up: 1000,
            warm_up_noise_beta: 0.0,
            exploration_noise_beta: None,
            evaluate_mean: false,
            effort_penalty: 0.0,
            change_penalty: 0.0,
            replay: 1_000_000,
            discount: None,
            n_step: 1,
            reward_unit: 1.0,
            learning_rate: 3e-4,
            encoder_rate: 0.3,
            lasso: 0.0,
            max_gradient_norm: 20.0,
            target_rate: 0.01,
            entropy: 1e-4,
            entropy_bonus: EntropyBonus::default(),
            model: ImplicitConfig::default(),
            planner: GuidedConfig::default(),
        }
    }
}

impl TdMpc2Config {
    /// The discount for episodes of `steps` time steps: the setting, or else the published rule, [`discount_for`] their
    /// decisions.
    pub fn discount_for(&self, steps: usize) -> f32 {
        self.discount.unwrap_or_else(|| discount_for(steps as f32 / self.action_repeat as f32))
    }
}

ranges!(TdMpc2Config {
    batch: 1..=65_536,
    horizon: 1..=1000,
    action_repeat: 1..=1000,
    updates_per_step: 0.0..=1000.0,
    warm_up: 0..=1_000_000_000,
    warm_up_noise_beta: 0.0..=10.0,
    exploration_noise_beta: 0.0..=10.0,
    evaluate_mean: Any,
    effort_penalty: 0.0..=1e6,
    change_penalty: 0.0..=1e6,
    replay: 2..=100_000_000,
    discount: 0.0..=1.0,
    n_step: 1..=1000,
    reward_unit: 1e-9..=1e9,
    learning_rate: 0.0..=1.0,
    encoder_rate: 0.0..=1e3,
    lasso: 0.0..=1e3,
    max_gradient_norm: 1e-6..=1e9,
    target_rate: 0.0..=1.0,
    entropy: 0.0..=1e6,
    entropy_bonus: Any,
    model: Nested,
    planner: Nested,
}
require *replay > *horizon => "`replay` must hold more decisions than `horizon`";
require fits(&[*batch, horizon + 1, model.critics, model.units + model.latent + model.bins]) =>
    "`batch` times `horizon` times the numbers in `model`'s layers does not fit into memory";
require fits(&[planner.population, planner.horizon, 16]) =>
    "the planner's `population` times `horizon` does not fit into memory";
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_discount_follows_from_the_length_of_an_episode() {
        let of = |steps| TdMpc2Config::default().discount_for(steps);
        for (steps, expected) in [(1, 0.95), (100, 0.95), (200, 0.975), (500, 0.99), (1000, 0.995), (5000, 0.995)] {
            assert!((of(steps) - expected).abs() < 1e-6, "{steps}: {}", of(steps));
        }
        assert_eq!(TdMpc2Config { discount: Some(0.5), ..TdMpc2Config::default() }.discount_for(100), 0.5);
    }
}
