//! Settings of [`ImplicitModel`](super::ImplicitModel).

use serde::{Deserialize, Serialize};

use crate::settings::{fits, ranges};

/// Settings of [`ImplicitModel`](super::ImplicitModel). The sizes are small enough for two cores; the weights of the losses are
/// those of TD-MPC2.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ImplicitConfig {
    /// Dimension of a latent state.
    pub latent: usize,
    /// Dimension of each of its groups, the softmaxes of [`sim_norm`](crate::nn::simnorm::sim_norm).
    pub group: usize,
    /// Units of the encoder's hidden layer.
    pub encoder: usize,
    /// Units of each of the two hidden layers of every other network.
    pub units: usize,
    /// Whether the latent dynamics predict changes, `z' = SimNorm(ln z + d(z, a))`, so that a new model predicts that nothing
    /// changes; otherwise `z' = SimNorm(d(z, a))`, as published.
    pub residual: bool,
    /// Members of the ensemble of Q functions.
    pub critics: usize,
    /// Bins of the two-hot distributions of rewards and values, an odd number.
    pub bins: usize,
    /// The outermost bins, in symlog space. They have to hold every value, up to reward / (1 - discount): 5 reaches to 147, 10 to
    /// 22,025. Targets beyond them are clipped, so that larger values cannot be told apart.
    pub bin_limit: f32,
    /// Whether to learn when the task itself ends. Without it, imagined rollouts never terminate, which is right if only the time limit
    /// ends episodes.
    pub terminates: bool,
    /// The weight of each step of a rollout relative to the step before it (rho).
    #[doc(alias = "rho")]
    pub decay: f32,
    /// Weight of the consistency of latent states.
    pub consistency: f32,
    /// Weight of the rewards' cross-entropy.
    pub reward: f32,
    /// Weight of the values' cross-entropy.
    pub value: f32,
}

impl Default for ImplicitConfig {
    fn default() -> Self {
        Self {
            latent: 64,
            group: 8,
            encoder: 128,
            units: 128,
            residual: false,
            critics: 2,
            bins: 101,
            bin_limit: 10.0,
            terminates: false,
            decay: 0.5,
            consistency: 20.0,
            reward: 0.1,
            value: 0.1,
        }
    }
}

ranges!(ImplicitConfig {
    latent: 2..=4096,
    group: 2..=4096,
    encoder: 1..=4096,
    units: 1..=4096,
    residual: Any,
    critics: 2..=32,
    bins: 3..=1001,
    bin_limit: 0.1..=20.0,
    terminates: Any,
    decay: 0.0..=1.0,
    consistency: 0.0..=1e6,
    reward: 0.0..=1e6,
    value: 0.0..=1e6,
}
require latent % group == 0 => "`group` must divide `latent`";
require bins % 2 == 1 => "`bins` must be odd: one of them is zero";
require fits(&[*critics, *units, units + latent + bins]) => "`critics` times the weights of `units` does not fit into memory";
);
