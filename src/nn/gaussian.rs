//! The Gaussian policies: SAC's, squashed by a tanh (`a = tanh(u)`, `u ~ N(mean, std^2)`), and DreamerV3's, bounded.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use super::kernels::{sigmoid, tanh};
use super::{Tensor2, Tensor3};

/// Log standard deviations are squashed into this range, so that their gradient does not vanish as it does at a hard clamp (as
/// CleanRL does; SB3 clamps to [-20, 2]).
const LOG_STD: [f32; 2] = [-5.0, 2.0];

/// SAC's policy distribution (Haarnoja et al. 2018, appendix C): a Gaussian squashed by a tanh.
#[doc(alias = "tanh Gaussian")]
#[derive(Clone, Debug)]
pub struct SquashedGaussian<T: Tape<f32, Cpu>> {
    /// Mean of u, `[1, batch, actions]`.
    pub mean: Tensor3<T>,
    /// Logarithm of the standard deviation of u, same shape.
    pub log_std: Tensor3<T>,
}

impl<T: Tape<f32, Cpu>> SquashedGaussian<T> {
    /// The distribution of a policy's head `[1, batch, 2 actions]`, means first.
    pub fn from_head(head: Tensor3<T>) -> Self {
        let &(_, _, width) = head.shape();
        let actions = width / 2;
        let mean = head.with_empty_tape().slice((.., .., ..actions));
        let raw = head.slice((.., .., actions..));
        let [low, high] = LOG_STD;
        let log_std = (raw.tanh() + 1.0) * (0.5 * (high - low)) + low;
        Self { mean, log_std }
    }

    /// The action `[1, batch, actions]` for standard normal `noise` (`[1, batch, actions]`), and its log-density summed over
    /// the action's numbers, `[1, batch]`. Differentiable in the head (reparameterisation trick).
    ///
    /// The log-density carries the tape back to the head; the action's own tape begins at u. A loss that contains both has
    /// the whole gradient.
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

    /// The action at the mean, `[1, batch, actions]`: the deterministic policy of evaluations.
    pub fn mode(self) -> Tensor3<T> {
        self.mean.tanh()
    }
}

/// DreamerV3's policy distribution for one number of an action: a Gaussian with its mean in (-1, 1) and its standard deviation
/// between two bounds. Samples are not squashed; the environment clips them to [-1, 1].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoundedNormal {
    /// The mean, `tanh(raw)`.
    pub mean: f32,
    /// The standard deviation, `(high - low) sigmoid(raw + 2) + low`.
    pub std: f32,
    /// The derivatives of mean and standard deviation with respect to the raw numbers.
    slopes: [f32; 2],
}

impl BoundedNormal {
    /// The largest standard deviation.
    const HIGH: f32 = 1.0;

    /// The distribution of two raw numbers of a policy's head; `low` is the smallest standard deviation.
    pub fn new(raw_mean: f32, raw_std: f32, low: f32) -> Self {
        let mean = tanh(raw_mean);
        let share = sigmoid(raw_std + 2.0);
        let range = Self::HIGH - low;
        Self { mean, std: range * share + low, slopes: [1.0 - mean * mean, range * share * (1.0 - share)] }
    }

    /// The log-density at `action`.
    pub fn log_density(&self, action: f32) -> f32 {
        let z = (action - self.mean) / self.std;
        -0.5 * (z * z + (2.0 * std::f32::consts::PI).ln()) - self.std.ln()
    }

    /// The derivatives of mean and standard deviation with respect to their raw numbers.
    pub fn derivatives(&self) -> [f32; 2] {
        self.slopes
    }

    /// Entropy, in nats.
    pub fn entropy(&self) -> f32 {
        0.5 * (1.0 + (2.0 * std::f32::consts::PI).ln()) + self.std.ln()
    }

    /// The derivatives of `of_density * log_density(action) + of_entropy * entropy` with respect to the raw mean and the raw
    /// standard deviation.
    pub fn slopes(&self, action: f32, of_density: f32, of_entropy: f32) -> [f32; 2] {
        let z = (action - self.mean) / self.std;
        let [mean, std] = self.slopes;
        [of_density * z / self.std * mean, (of_density * (z * z - 1.0) + of_entropy) / self.std * std]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers from the reference's formulas, in float64.
    #[test]
    fn the_bounded_normal_is_the_references() {
        let near =
            |found: f32, expected: f64| assert!((f64::from(found) - expected).abs() < 2e-6, "{found} {expected}");
        for (raw, std, entropy) in [
            (0.0, 0.892_717_37, 1.305_453_29),
            (1.0, 0.957_316_71, 1.375_317_54),
            (-2.0, 0.55, 0.821_101_53),
            (-6.0, 0.116_187_59, -0.733_610_71),
        ] {
            let normal = BoundedNormal::new(0.0, raw, 0.1);
            near(normal.std, std);
            near(normal.entropy(), entropy);
        }
        let pair = [BoundedNormal::new(0.5, 0.2, 0.1), BoundedNormal::new(-0.3, -1.0, 0.1)];
        near(pair[0].mean, 0.462_117_16);
        near(pair[1].mean, -0.291_312_61);
        near(pair[0].log_density(0.9), -0.940_589_35);
        near(pair[1].log_density(-1.4), -1.711_607_69);
        near(pair[0].entropy() + pair[1].entropy(), 2.466_678_86);
    }

    #[test]
    fn its_slopes_agree_with_differences() {
        let (raw_mean, raw_std, action) = (0.4, -0.7, 1.1);
        let value = |m: f32, s: f32| {
            let normal = BoundedNormal::new(m, s, 0.1);
            f64::from(2.0 * normal.log_density(action) + 0.5 * normal.entropy())
        };
        const H: f32 = 1e-2;
        let [of_mean, of_std] = BoundedNormal::new(raw_mean, raw_std, 0.1).slopes(action, 2.0, 0.5);
        let by_mean = (value(raw_mean + H, raw_std) - value(raw_mean - H, raw_std)) / f64::from(2.0 * H);
        let by_std = (value(raw_mean, raw_std + H) - value(raw_mean, raw_std - H)) / f64::from(2.0 * H);
        assert!((f64::from(of_mean) - by_mean).abs() < 1e-3 && (f64::from(of_std) - by_std).abs() < 1e-3);
    }
}
