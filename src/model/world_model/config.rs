//! Settings of the world model.

use serde::{Deserialize, Serialize};

use crate::model::RssmConfig;
use crate::settings::{fits, ranges};

/// Settings of a [`super::WorldModel`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WorldModelConfig {
    /// The recurrent state-space model.
    pub rssm: RssmConfig,
    /// Units of each hidden layer of encoder, decoder and heads.
    pub units: usize,
    /// Hidden layers of encoder and decoder; the other heads have one.
    pub layers: usize,
    /// Bins of the two-hot distributions of rewards and values.
    pub bins: usize,
    /// The outermost bins are at +-symexp of this.
    pub bin_limit: f64,
    /// Free nats: a KL loss below this has no gradient.
    #[doc(alias = "free bits")]
    pub free_nats: f32,
    /// Weight of the reconstruction loss. More than the published 1 makes small differences in observations count.
    pub reconstruction: f32,
    /// Group lasso on the encoder's inputs, except differences, such as the vector from the hand to a goal: each step shortens
    /// the weights that leave an input, as one vector, by `learning_rate * lasso`. See
    /// [`EnsembleConfig::reward_lasso`](crate::model::EnsembleConfig::reward_lasso). The decoder does not
    /// reconstruct these inputs; a probe does, whose gradient does not reach the latent states.
    #[doc(alias = "group lasso")]
    pub lasso: f32,
    /// Weight of the dynamics loss, [`Categorical::dynamics_kl`](crate::nn::Categorical::dynamics_kl).
    #[doc(alias = "KL balancing")]
    pub dynamics: f32,
    /// Weight of the representation loss, [`Categorical::representation_kl`](crate::nn::Categorical::representation_kl).
    #[doc(alias = "KL balancing")]
    pub representation: f32,
    /// The discount of a step is 1 - 1/`discount_horizon`; the continuation head learns it along with the episode's end.
    pub discount_horizon: f32,
}

impl Default for WorldModelConfig {
    /// The smallest published size, `size1m`.
    fn default() -> Self {
        Self {
            rssm: RssmConfig::default(),
            units: 64,
            layers: 3,
            bins: 255,
            bin_limit: 20.0,
            free_nats: 1.0,
            reconstruction: 1.0,
            lasso: 0.0,
            dynamics: 1.0,
            representation: 0.1,
            discount_horizon: 333.0,
        }
    }
}

ranges!(WorldModelConfig {
    rssm: Nested,
    units: 1..=4096,
    layers: 1..=16,
    bins: 3..=4095,
    bin_limit: 0.1..=80.0,
    free_nats: 0.0..=1e3,
    reconstruction: 0.0..=1e6,
    lasso: 0.0..=1e3,
    dynamics: 0.0..=1e3,
    representation: 0.0..=1e3,
    discount_horizon: 1.01..=1e6,
}
require !bins.is_multiple_of(2) => "`bins` must be odd";
require fits(&[*units, rssm.features()]) => "`units` times the numbers of a latent state are too many weights";
);

impl WorldModelConfig {
    /// Width of the widest layer.
    pub(crate) fn widest(&self) -> usize {
        self.units.max(self.bins).max(self.rssm.features()).max(3 * self.rssm.deter)
    }

    /// The discount of a step.
    pub fn discount(&self) -> f32 {
        1.0 - 1.0 / self.discount_horizon
    }
}
