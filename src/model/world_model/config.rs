//! Settings of the world model.

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::model::RssmConfig;

/// Settings of a [`WorldModel`].
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
            dynamics: 1.0,
            representation: 0.1,
            discount_horizon: 333.0,
        }
    }
}

impl WorldModelConfig {
    /// # Errors
    /// If a setting cannot be used.
    pub(crate) fn check(&self) -> Result<()> {
        self.rssm.check()?;
        if self.units == 0 || self.layers == 0 || self.bins < 3 || self.bins.is_multiple_of(2) {
            return Err(Error::BadSetting(
                "world model: `units` and `layers` must be at least 1, `bins` odd and at least 3".into(),
            ));
        }
        if self.discount_horizon <= 1.0 {
            return Err(Error::BadSetting("world model: `discount_horizon` must be more than 1".into()));
        }
        Ok(())
    }

    /// The discount of a step.
    pub fn discount(&self) -> f32 {
        1.0 - 1.0 / self.discount_horizon
    }
}
