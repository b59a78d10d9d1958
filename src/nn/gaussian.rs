//! The squashed Gaussian of SAC: `a = tanh(u)`, `u ~ N(mean, std^2)`.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use super::{Tensor2, Tensor3};

/// Log standard deviations are squashed into this range, so that their gradient never dies as it
/// does at a hard clamp (as CleanRL does; SB3 clamps to [-20, 2]).
const LOG_STD: [f32; 2] = [-5.0, 2.0];

/// The distribution that a policy network's output describes.
pub struct SquashedGaussian<T: Tape<f32, Cpu>> {
    /// Mean of u, `[1, batch, actions]`.
    pub mean: Tensor3<T>,
    /// Logarithm of the standard deviation of u, same shape.
    pub log_std: Tensor3<T>,
}

impl<T: Tape<f32, Cpu>> SquashedGaussian<T> {
    /// Reads the head of a policy: `[1, batch, 2 actions]`, means first.
    pub fn from_head(head: Tensor3<T>) -> Self {
        let &(_, _, width) = head.shape();
        let actions = width / 2;
        let mean = head.with_empty_tape().slice((.., .., ..actions));
        let raw = head.slice((.., .., actions..));
        let [low, high] = LOG_STD;
        let log_std = (raw.tanh() + 1.0) * (0.5 * (high - low)) + low;
        Self { mean, log_std }
    }

    /// The action for standard normal `noise` (`[1, batch, actions]`), and its log-density summed over
    /// the action's numbers, `[1, batch]`. Differentiable in the head (reparameterised).
    ///
    /// The log-density carries the tape back to the head; the action's own tape begins at u. A loss in which
    /// both occur has all of it.
    ///
    /// ln(1 - tanh(u)^2) is computed as 2 (ln 2 - u - softplus(-2u)), which is exact where the usual
    /// ln(1 - a^2 + 1e-6) saturates.
    pub fn sample(self, noise: Tensor3) -> (Tensor3<T>, Tensor2<T>) {
        let std = self.log_std.with_empty_tape().exp();
        let u = self.mean + std * noise.clone();
        let action = u.with_empty_tape().tanh();
        let half_log_tau = 0.5 * (2.0 * std::f32::consts::PI).ln();
        let gaussian = -(self.log_std + (noise.square() * 0.5 + half_log_tau));
        let doubled = u.with_empty_tape() * -2.0;
        let softplus = doubled.with_empty_tape().relu() + ((-doubled.abs()).exp() + 1.0).ln();
        let squash = (-(u + softplus) + std::f32::consts::LN_2) * 2.0;
        (action, (gaussian - squash).sum::<(usize, usize), Axis<2>>())
    }

    /// The action at the mean: what a policy does when it is judged.
    pub fn mode(self) -> Tensor3<T> {
        self.mean.tanh()
    }
}
