//! The policy prior: a squashed Gaussian over latent states, which proposes actions to the planner and supplies those of the
//! value targets.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use serde::{Deserialize, Serialize};

use crate::nn::kernels::{softplus, tanh};
use crate::nn::{Grad, Mlp, TapeOps, Tensor3, ops, parameters_of_fields, tensor, values};
use crate::rng::{self, Rng};

/// Bounds of the logarithm of the standard deviation.
const LOG_STD: [f32; 2] = [-10.0, 2.0];

/// Whose entropy the policy's bonus is, with `u = m + std noise` and `a = tanh(u)`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EntropyBonus {
    /// Of u, `-ln N(u; m, std)`, as in the newest published code. Its gradient is constant in `ln std`, and none pulls m back, so
    /// with a weight far above the published 1e-4 the policy saturates: std grows to its bound, and actions to -1 or 1.
    #[default]
    Gaussian,
    /// Of the action, `-ln N(u; m, std) + sum ln(1 - a^2)`, which is largest for actions that are spread evenly over the box. (The
    /// published code of 2023 has the second term, too, but multiplies only the first by the number of actions.)
    Squashed,
}

/// The policy prior `a = tanh(m + std noise)`. At first its standard deviation is e^-4, so that the planner explores, not the
/// policy.
#[derive(Clone, Debug)]
pub struct PolicyPrior {
    pub(super) head: Mlp,
    pub(super) actions: usize,
}

parameters_of_fields!(PolicyPrior: head);

impl PolicyPrior {
    /// A new policy for latent states of `latent` numbers, with two hidden layers of `units`.
    pub fn new(cpu: &Cpu, latent: usize, units: usize, actions: usize, rng: &mut Rng) -> Self {
        Self { head: Mlp::tdmpc(cpu, 1, latent, &[units; 2], Some(2 * actions), rng), actions }
    }

    /// The most likely actions tanh(m) in latent states `[1, rows, latent]`: `[1, rows, actions]`.
    pub fn mode(&self, z: &Tensor3) -> Tensor3 {
        let head = self.head.forward(z.clone(), Grad::Input);
        let rows = values(&head).chunks_exact(2 * self.actions);
        let modes = rows.flat_map(|row| row[..self.actions].iter().map(|m| tanh(*m))).collect();
        tensor(head.device(), modes, (1, z.shape().1, self.actions))
    }

    /// Actions drawn in latent states `[1, rows, latent]`: `[1, rows, actions]`.
    pub fn sample(&self, z: &Tensor3, rng: &mut Rng) -> Tensor3 {
        let noise = rng::normals(z.shape().1 * self.actions, rng);
        squashed(self.head.on(&mut NoneTape, z, Grad::Params), &noise)
    }

    /// Actions for standard normal `noise` (`[rows, actions]`) in latent states that are data, `[1, rows, actions]`, and the entropy
    /// bonus of each, `[1, rows, 1]`. Differentiable in the policy's parameters.
    pub fn sample_on<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        z: &Tensor3,
        noise: &[f32],
        entropy: EntropyBonus,
    ) -> (Tensor3, Tensor3) {
        let head = self.head.on(tape, z, Grad::Params);
        (tape.record(&head, |head| squashed(head, noise)), entropy_bonus(tape, &head, noise, entropy))
    }
}

/// The logarithm of the standard deviation, from a number of the head.
pub(super) fn log_std(raw: f32) -> f32 {
    let [low, high] = LOG_STD;
    low + 0.5 * (high - low) * (tanh(raw) + 1.0)
}

fn log_std_slope(raw: f32) -> f32 {
    let [low, high] = LOG_STD;
    0.5 * (high - low) * (1.0 - tanh(raw).powi(2))
}

/// `tanh(m + std noise)` for heads `[1, rows, 2 actions]`, means first, and standard normal noise `[rows, actions]`.
fn squashed<T: Tape<f32, Cpu>>(head: Tensor3<T>, noise: &[f32]) -> Tensor3<T> {
    let actions = head.shape().2 / 2;
    ops::map_rows(head, actions, |row, head, action, jacobian| {
        for i in 0..actions {
            let deviation = log_std(head[actions + i]).exp() * noise[row * actions + i];
            action[i] = tanh(head[i] + deviation);
            let slope = 1.0 - action[i] * action[i];
            jacobian[i * 2 * actions + i] = slope;
            jacobian[i * 2 * actions + actions + i] = slope * deviation * log_std_slope(head[actions + i]);
        }
    })
}

/// The entropy bonus of actions with this noise, `[1, rows, 1]`: a sample of the entropy, times the number of actions.
fn entropy_bonus<T: Tape<f32, Cpu>>(tape: &mut T, head: &Tensor3, noise: &[f32], entropy: EntropyBonus) -> Tensor3 {
    let actions = head.shape().2 / 2;
    let half_log_tau = 0.5 * std::f32::consts::TAU.ln();
    tape.rowwise(head, |row, head, slope| {
        let mut bonus = 0.0;
        for i in 0..actions {
            let (raw, noise) = (head[actions + i], noise[row * actions + i]);
            bonus += 0.5 * noise.powi(2) + log_std(raw) + half_log_tau;
            slope[actions + i] = actions as f32 * log_std_slope(raw);
            if entropy == EntropyBonus::Squashed {
                let deviation = log_std(raw).exp() * noise;
                let u = head[i] + deviation;
                // ln(1 - tanh(u)^2), also where the tanh is 1.
                bonus += 2.0 * (std::f32::consts::LN_2 - u - softplus(-2.0 * u));
                slope[i] = -2.0 * tanh(u) * actions as f32;
                slope[actions + i] += slope[i] * deviation * log_std_slope(raw);
            }
        }
        actions as f32 * bonus
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::device;

    fn near(found: &[f32], expected: &[f32]) {
        assert!(found.iter().zip(expected).all(|(f, e)| (f - e).abs() < 2e-5), "{found:?}, expected {expected:?}");
    }

    /// Numbers computed in float64 from the published code.
    #[test]
    fn actions_and_entropy_are_the_references() {
        near(&[0.0, 1.0, -1.0].map(log_std), &[-4.0, 0.569_565, -8.569_565]);
        // Logarithms of the standard deviation of -1 and -0.5.
        let raw = [-1.0_f32, -0.5].map(|log: f32| ((log + 10.0) / 6.0 - 1.0).atanh());
        near(&raw.map(log_std), &[-1.0, -0.5]);
        let head = tensor(&device(), vec![0.3, -0.8, raw[0], raw[1]], (1, 1, 4));
        let noise = [0.6, -1.1];
        near(values(&squashed(head.clone(), &noise)), &[0.478_261, -0.899_039]);
        let mut tape = OwnedTape::default();
        let bonus = entropy_bonus(&mut tape, &head, &noise, EntropyBonus::Gaussian);
        let gaussian = values(&bonus)[0];
        near(&[gaussian], &[2.245_754]);
        let mut gradients = ops::total(tape, &[(1.0, bonus)]).backward();
        let slope = gradients.get_or_alloc_mut(&head).expect("memory").to_vec();
        near(&slope, &[0.0, 0.0, 2.0 * log_std_slope(raw[0]), 2.0 * log_std_slope(raw[1])]);
        // Twice minus the log-density with the tanh's correction.
        let squashed = values(&entropy_bonus(&mut NoneTape, &head, &noise, EntropyBonus::Squashed))[0];
        near(&[squashed], &[-2.0 * 0.788_510]);
        // The published code of 2023 does not double the correction, and counts the density's constant, ln(2 pi) / 2, for one
        // action instead of two before it doubles that. We have no such bonus, but its parts are those of ours.
        near(&[gaussian - std::f32::consts::TAU.ln() + (squashed - gaussian) / 2.0], &[-1.503_51]);
    }

    #[test]
    fn slopes_of_the_squashed_entropy_agree_with_differences() {
        const NOISE: [f32; 4] = [0.6, -1.1, 0.3, 2.0];
        let head = [0.3, -0.8, 0.5, 0.7, -0.2, 0.1, 0.6, 0.4];
        let at = |tape: &mut OwnedTape<f32, Cpu>, head: [f32; 8]| {
            let head = tensor(&device(), head.to_vec(), (1, 2, 4));
            (entropy_bonus(tape, &head, &NOISE, EntropyBonus::Squashed), head)
        };
        let mut tape = OwnedTape::default();
        let (bonus, x) = at(&mut tape, head);
        let mut gradients = ops::total(tape, &[(2.0, bonus)]).backward();
        for (i, slope) in gradients.get_or_alloc_mut(&x).expect("memory").iter().enumerate() {
            let moved = |by: f32| {
                let mut head = head;
                head[i] += by;
                values(&at(&mut OwnedTape::default(), head).0).iter().sum::<f32>()
            };
            let difference = (moved(1e-2) - moved(-1e-2)) / 2e-2;
            assert!(
                (slope - difference).abs() < 2e-2 * slope.abs().max(1.0),
                "{i}: {slope}, {difference} by differences"
            );
        }
    }

    /// The entropy of an action has no maximum at the corners: there, both m and std are pulled back.
    #[test]
    fn the_squashed_entropy_pulls_saturated_actions_back() {
        let head = tensor(&device(), vec![4.0, -4.0, 0.9, 0.9], (1, 1, 4));
        let slopes = |entropy| {
            let mut tape = OwnedTape::default();
            let bonus = entropy_bonus(&mut tape, &head, &[0.1, -0.1], entropy);
            ops::total(tape, &[(1.0, bonus)]).backward().get_or_alloc_mut(&head).expect("memory").to_vec()
        };
        let squashed = slopes(EntropyBonus::Squashed);
        assert!(squashed[0] < -1.0 && squashed[1] > 1.0, "{squashed:?}");
        assert_eq!(slopes(EntropyBonus::Gaussian)[..2], [0.0; 2]);
    }

    #[test]
    fn slopes_of_actions_agree_with_differences() {
        let at = |head: &[f32]| values(&squashed(tensor(&device(), head.to_vec(), (1, 2, 4)), &NOISE)).to_vec();
        const NOISE: [f32; 4] = [0.6, -1.1, 0.3, 2.0];
        let head = [0.3, -0.8, 0.5, 0.7, -0.2, 0.1, 0.6, 0.4];
        let x = tensor(&device(), head.to_vec(), (1, 2, 4));
        let mut gradients = squashed(x.clone().leaky_traced(), &NOISE).sum::<Rank0, _>().backward();
        for (i, slope) in gradients.get_or_alloc_mut(&x).expect("memory").iter().enumerate() {
            let moved = |by: f32| {
                let mut head = head;
                head[i] += by;
                at(&head).iter().sum::<f32>()
            };
            let difference = (moved(1e-2) - moved(-1e-2)) / 2e-2;
            assert!((slope - difference).abs() < 5e-3, "{i}: {slope}, {difference} by differences");
        }
    }
}
