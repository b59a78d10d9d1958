//! The likelihood of a Gaussian whose log-variance is softly bounded: the loss of PETS (Chua et al. 2018).

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use rayon::prelude::*;

use super::Parameters;
use super::kernels::{self, vectorised_fn};
use super::ops::{Grad, Tensor3, take, values};

/// Weight of the penalty that draws learned bounds together.
const BOUND_PENALTY: f32 = 0.01;

/// The range of log-variances, for each output: `[1, 1, outputs]`, the same for all networks of a loss.
#[derive(Clone, Debug)]
pub struct LogVarianceBounds {
    /// Upper bounds.
    pub max: Tensor3,
    /// Lower bounds.
    pub min: Tensor3,
}

impl LogVarianceBounds {
    /// The bounds of PETS: 0.5 and -10.
    pub fn new(cpu: &Cpu, outputs: usize) -> Self {
        let filled = |x| super::tensor(cpu, vec![x; outputs], (1, 1, outputs));
        Self { max: filled(0.5), min: filled(-10.0) }
    }
}

impl Parameters for LogVarianceBounds {
    fn parameters(&self) -> Vec<(String, &Tensor3)> {
        vec![("max".into(), &self.max), ("min".into(), &self.min)]
    }

    fn parameters_mut(&mut self) -> Vec<(String, &mut Tensor3)> {
        vec![("max".into(), &mut self.max), ("min".into(), &mut self.min)]
    }
}

/// A raw log-variance bounded softly: `min + sp(max - sp(max - raw) - min)` with the softplus sp.
#[inline(always)]
pub fn bounded(raw: f32, max: f32, min: f32) -> f32 {
    let below = max - kernels::softplus(max - raw);
    min + kernels::softplus(below - min)
}

/// The variance that a [`bounded`] log-variance stands for, in closed form and so cheaper: a softplus is the logarithm of a
/// sum, so the bounds add `exp(-max)` to the precision and then `exp(min)` to the variance.
#[inline(always)]
pub(crate) fn bounded_variance(raw: f32, least_precision: f32, least_variance: f32) -> f32 {
    least_variance + 1.0 / (least_precision + kernels::exp(-raw))
}

/// The loss of an ensemble: over its networks the sum of
/// `mean over batch and outputs of (mean - target)^2 exp(-v) + v`, v the bounded log-variance.
/// If the bounds are trained, `0.01 (sum(max) - sum(min))` comes on top.
///
/// With `beta` above zero each number's loss is weighed by its own predicted variance to that power, as a constant
/// (beta-NLL, Seitzer et al. 2022). Without, a network may call what it cannot yet predict chance, and then learns
/// no more about it, because a large variance takes the weight from the error.
///
/// `head` is `[members, batch, 2 outputs]`, means first; `targets` `[members, batch, outputs]`. The answer is
/// `[1, 1, 1]`.
pub fn bounded_nll<T: Tape<f32, Cpu>>(
    head: Tensor3<T>,
    targets: &Tensor3,
    bounds: &LogVarianceBounds,
    beta: f32,
    grad: Grad,
) -> Tensor3<T> {
    let (head, mut tape) = head.split_tape();
    let &(_, batch, width) = head.shape();
    let outputs = width / 2;
    let (max, min) = (bounds.max.clone(), bounds.min.clone());
    assert_eq!(*targets.shape(), (head.shape().0, batch, outputs), "a target for each mean");
    assert_eq!(*max.shape(), (1, 1, outputs), "a bound for each output");

    // The loss, and its gradients in the same pass: they share everything that is costly.
    let share = 1.0 / (batch * outputs) as f32;
    let mut d_head = vec![0.0; values(&head).len()];
    let (maxima, minima) = (values(&max), values(&min));
    let networks = values(&head).par_chunks_exact(batch * width).zip(values(targets).par_chunks_exact(batch * outputs));
    let of_networks: Vec<[Vec<f32>; 3]> = networks
        .zip(d_head.par_chunks_exact_mut(batch * width))
        .map(|((head, targets), d_head)| {
            let mut sums = [0; 3].map(|_| vec![0.0; outputs]);
            let [losses, d_max, d_min] = &mut sums;
            nll_rows([head, targets, maxima, minima], share, beta, losses, d_head, d_max, d_min);
            sums
        })
        .collect();
    let [losses, mut d_max, mut d_min]: [Vec<f32>; 3] =
        std::array::from_fn(|k| (0..outputs).map(|i| of_networks.iter().map(|sums| sums[k][i]).sum()).collect());
    let mut loss = losses.iter().map(|loss| f64::from(*loss)).sum::<f64>();
    if grad == Grad::Both {
        loss += f64::from(BOUND_PENALTY * maxima.iter().zip(minima).map(|(max, min)| max - min).sum::<f32>());
        d_max.iter_mut().for_each(|d| *d += BOUND_PENALTY);
        d_min.iter_mut().for_each(|d| *d -= BOUND_PENALTY);
    }
    let loss = head.device().tensor_from_vec(vec![loss as f32], (1, 1, 1));

    if T::OWNS_TAPE {
        let loss = loss.clone();
        tape.add_backward_op(move |gradients| {
            let scale = take(gradients, &loss)?[0];
            let mut parts = vec![(&head, &d_head)];
            if grad == Grad::Both {
                parts.extend([(&max, &d_max), (&min, &d_min)]);
            }
            for (of, d) in parts {
                let sum = gradients.get_or_alloc_mut(of)?;
                sum.iter_mut().zip(d).for_each(|(sum, d)| *sum += scale * d);
            }
            Ok(())
        });
    }
    loss.put_tape(tape)
}

vectorised_fn! {
    /// Adds up the loss of each output, and its gradients, over rows. `parts` are head, targets, and the upper and lower
    /// bounds.
    fn nll_rows(
        parts: [&'a [f32]; 4],
        share: f32,
        beta: f32,
        losses: &'a mut [f32],
        d_head: &'a mut [f32],
        d_max: &'a mut [f32],
        d_min: &'a mut [f32],
    ) {
        let [head, targets, max, min] = parts;
        let n = losses.len();
        let (max, min, d_max, d_min) = (&max[..n], &min[..n], &mut d_max[..n], &mut d_min[..n]);
        let rows = head.chunks_exact(2 * n).zip(targets.chunks_exact(n)).zip(d_head.chunks_exact_mut(2 * n));
        for ((head, target), d_head) in rows {
            let (mean, raw) = head.split_at(n);
            let (d_mean, d_raw) = d_head.split_at_mut(n);
            let (raw, d_raw) = (&raw[..n], &mut d_raw[..n]);
            for i in 0..n {
                let below = max[i] - kernels::softplus(max[i] - raw[i]);
                let log_variance = min[i] + kernels::softplus(below - min[i]);
                let precision = kernels::exp(-log_variance);
                let error = mean[i] - target[i];
                let weight = share * kernels::exp(beta * log_variance);
                losses[i] += weight * (error * error * precision + log_variance);
                let d_log_variance = weight * (1.0 - error * error * precision);
                let above_min = kernels::sigmoid(below - min[i]);
                let below_max = kernels::sigmoid(max[i] - raw[i]);
                d_mean[i] = weight * 2.0 * error * precision;
                d_raw[i] = d_log_variance * above_min * below_max;
                d_max[i] += d_log_variance * above_min * (1.0 - below_max);
                d_min[i] += d_log_variance * (1.0 - above_min);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{device, tensor};

    fn near(found: &[f32], expected: &[f64]) {
        assert_eq!(found.len(), expected.len());
        for (found, expected) in found.iter().zip(expected) {
            let off = (f64::from(*found) - expected).abs();
            assert!(off < 2e-6 * expected.abs().max(0.05), "{found}, expected {expected}");
        }
    }

    #[test]
    fn bounds_are_soft() {
        let raw = [-20.0, -10.0, -5.0, 0.0, 0.5, 2.0, 10.0];
        let found = raw.map(|raw| bounded(raw, 0.5, -10.0));
        let expected =
            [-9.999_954_60, -9.306_866_59, -4.997_335_74, -0.474_004_05, -0.193_092_11, 0.298_620_40, 0.499_952_69];
        near(&found, &expected);
        let variances = raw.map(|raw| bounded_variance(raw, (-0.5_f32).exp(), (-10.0_f32).exp()));
        near(&variances, &expected.map(f64::exp));
    }

    #[test]
    fn loss_and_gradients_are_those_of_the_reference() {
        let cpu = device();
        let head = tensor(&cpu, vec![0.1, -0.2, -1.0, 0.3, 0.4, 0.0, -4.0, 1.0], (1, 2, 4));
        let targets = tensor(&cpu, vec![0.0, 0.1, 0.5, -0.6], (1, 2, 2));
        let bounds = LogVarianceBounds::new(&cpu, 2);
        let frozen = bounded_nll(head.clone(), &targets, &bounds, 0.0, Grad::Input);
        near(values(&frozen), &[-1.106_495_37]);
        let loss = bounded_nll(head.leaky_trace(), &targets, &bounds, 0.0, Grad::Both);
        near(values(&loss), &[-0.896_495_37]);
        let mut gradients = loss.sum().backward();
        near(
            gradients.get_or_alloc_mut(&head).unwrap(),
            &[
                0.166_215_53,
                -0.202_089_97,
                0.197_569_12,
                0.120_783_72,
                -2.753_333_39,
                0.292_310_10,
                0.110_821_38,
                0.061_274_77,
            ],
        );
        near(gradients.get_or_alloc_mut(&bounds.max).unwrap(), &[0.055_314_74, 0.209_914_37]);
        near(gradients.get_or_alloc_mut(&bounds.min).unwrap(), &[-0.009_682_69, -0.009_979_38]);
    }
}
