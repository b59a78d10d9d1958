//! Settings of [`Sac`](super::Sac).

use serde::{Deserialize, Serialize};

use crate::agent::discount_for;
use crate::settings::{fits, ranges, weights_between};

/// Settings of [`Sac`](super::Sac). [`Preset`](crate::agent::Preset) has tuned ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SacConfig {
    /// Width of each hidden layer of policy and critics.
    pub hidden: Vec<usize>,
    /// Whether the critics' hidden layers have layer normalisation, which makes several updates for each time step stable.
    pub layer_norm: bool,
    /// Probability with which each number of the critics' hidden layers is dropped in an update: DroQ (Hiraoka et al. 2022),
    /// which takes 0.0001 to 0.1 for 20 updates per time step.
    #[doc(alias = "DroQ")]
    pub critic_dropout: f32,
    /// Critics. The smallest of their values is used: with two, clipped double Q-learning (Fujimoto et al. 2018).
    #[doc(alias = "clipped double Q")]
    #[doc(alias = "twin critics")]
    pub critics: usize,
    /// Step size of policy and critics (Adam).
    pub learning_rate: f32,
    /// Step size of the temperature's logarithm (Adam).
    pub temperature_rate: f32,
    /// Temperature alpha at the start: the weight of entropy against reward.
    #[doc(alias = "alpha")]
    pub initial_temperature: f32,
    /// Target entropy in nats, for each number of an action: -1 gives the usual -dim(A).
    pub target_entropy: f32,
    /// Time steps for which each action is held: a decision. Transitions, the discount and n-step returns are of decisions; their
    /// rewards are means, with zeros after the end of the task.
    #[doc(alias = "frame skip")]
    pub action_repeat: usize,
    /// Transitions in a minibatch.
    pub batch: usize,
    /// Discount factor gamma, per decision.
    #[doc(alias = "gamma")]
    pub discount: f32,
    /// Whether the discount factor follows from the length of an episode instead: [`SacConfig::discount_for`].
    pub discount_from_horizon: bool,
    /// Polyak averaging rate of the target critics (the target network), per critic update.
    #[doc(alias = "tau")]
    #[doc(alias = "target network")]
    pub target_rate: f32,
    /// Capacity of the replay buffer, in decisions.
    pub replay: usize,
    /// Time steps of random actions before the first update.
    pub warm_up: usize,
    /// Exponent of those actions' coloured noise, as the methods that plan have it; uniform white noise if absent.
    #[doc(alias = "pink noise")]
    pub warm_up_noise_beta: Option<f64>,
    /// Exponent of the noise with which the policy explores (1: pink noise, Eberhard et al. 2023); white if absent. The losses
    /// are the same.
    #[doc(alias = "pink noise")]
    pub exploration_noise_beta: Option<f64>,
    /// Whether the networks read what latent models read ([`LatentFeatures`](crate::model::features::LatentFeatures)): positions
    /// relative to the hand, small distances magnified, cubes in canonical orientation.
    pub latent_features: bool,
    /// Group lasso on the inputs of policy and critics, except actions and differences, such as the vector from the hand to a
    /// goal: each step shortens the weights that leave an input, as one vector, by `learning_rate * lasso`. See
    /// [`EnsembleConfig::reward_lasso`](crate::model::EnsembleConfig::reward_lasso). It needs `latent_features`.
    #[doc(alias = "group lasso")]
    pub lasso: f32,
    /// Decisions whose rewards are in a target: n-step returns. The entropy of those between is left out.
    #[doc(alias = "multi-step return")]
    pub n_step: usize,
    /// Share of a minibatch whose goals are replaced by what the same episode achieved later: hindsight experience replay
    /// (Andrychowicz et al. 2017, who take 0.8). The environment needs a goal, and the agent the reward as a function of
    /// observations: [`Sac::with_reward`](super::Sac::with_reward). All rewards of the minibatch are then those of that function, as if
    /// a decision were one time step.
    #[doc(alias = "HER")]
    pub hindsight: f32,
    /// Critic updates for each time step. Times `action_repeat`, this is the update-to-data ratio: updates for each stored decision.
    #[doc(alias = "UTD")]
    pub updates_per_step: usize,
    /// Critic updates for each update of policy and temperature.
    pub critic_updates_per_policy_update: usize,
    /// Gradients of policy and critics with a larger global norm are scaled down to it.
    pub max_gradient_norm: Option<f32>,
}

impl Default for SacConfig {
    fn default() -> Self {
        Self {
            hidden: vec![256, 256],
            layer_norm: false,
            critic_dropout: 0.0,
            critics: 2,
            learning_rate: 3e-4,
            temperature_rate: 3e-4,
            initial_temperature: 1.0,
            target_entropy: -1.0,
            action_repeat: 1,
            batch: 256,
            discount: 0.99,
            discount_from_horizon: false,
            target_rate: 0.005,
            replay: 1_000_000,
            warm_up: 1000,
            warm_up_noise_beta: None,
            exploration_noise_beta: None,
            latent_features: false,
            lasso: 0.0,
            n_step: 1,
            hindsight: 0.0,
            updates_per_step: 1,
            critic_updates_per_policy_update: 1,
            max_gradient_norm: None,
        }
    }
}

impl SacConfig {
    /// The discount for episodes of `steps` time steps: [`discount_for`], TD-MPC2's rule, or the setting.
    pub fn discount_for(&self, steps: usize) -> f32 {
        if self.discount_from_horizon { discount_for(steps as f32 / self.action_repeat as f32) } else { self.discount }
    }
}

ranges!(SacConfig {
    hidden: 1..=4096,
    layer_norm: Any,
    critic_dropout: 0.0..=0.9,
    critics: 1..=32,
    learning_rate: 0.0..=1.0,
    temperature_rate: 0.0..=1.0,
    initial_temperature: 1e-6..=1e4,
    target_entropy: -100.0..=100.0,
    action_repeat: 1..=1000,
    batch: 1..=65_536,
    discount: 0.0..=1.0,
    discount_from_horizon: Any,
    target_rate: 0.0..=1.0,
    replay: 1..=100_000_000,
    warm_up: 0..=1_000_000_000,
    warm_up_noise_beta: 0.0..=10.0,
    exploration_noise_beta: 0.0..=10.0,
    latent_features: Any,
    lasso: 0.0..=1e3,
    n_step: 1..=1000,
    hindsight: 0.0..=1.0,
    updates_per_step: 1..=1000,
    critic_updates_per_policy_update: 1..=1_000_000,
    max_gradient_norm: 1e-6..=1e9,
}
require *lasso == 0.0 || *latent_features => "`lasso` needs `latent_features`";
require fits(&[*critics, weights_between(hidden)]) => "`critics` with the layers of `hidden` have too many weights";
require fits(&[*critics, *batch, hidden.iter().sum()]) => "`critics` times `batch` times `hidden` does not fit into memory";
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_discount_is_a_setting_or_follows_from_the_length_of_an_episode() {
        let set = SacConfig { discount: 0.9, ..SacConfig::default() };
        assert_eq!(set.discount_for(150), 0.9);
        let by_length = SacConfig { discount_from_horizon: true, ..set };
        assert!((by_length.discount_for(150) - 29.0 / 30.0).abs() < 1e-6);
        assert_eq!(by_length.discount_for(100), 0.95);
    }

    /// Settings of runs from before the later ones were added mean what they meant.
    #[test]
    fn old_settings_load() {
        let old: SacConfig = toml::from_str("layer_norm = true\ndiscount = 0.95\nwarm_up = 500").expect("old settings");
        assert_eq!(old, SacConfig { layer_norm: true, discount: 0.95, warm_up: 500, ..SacConfig::default() });
        assert_eq!((old.n_step, old.hindsight, old.critic_dropout, old.latent_features), (1, 0.0, 0.0, false));
    }
}
