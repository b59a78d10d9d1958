//! Several categorical distributions side by side, as DreamerV3's latents are: a little of the uniform distribution is
//! mixed in, so that nothing is ever impossible, and samples pass gradients straight through.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use rand::RngExt;
use serde::{Deserialize, Serialize};

use super::kernels::{exp, vectorised_fn};
use super::ops::{self, Tensor3, take, values};
use crate::rng::Rng;

/// How many distributions, of how many classes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Categorical {
    /// Distributions side by side.
    pub count: usize,
    /// Classes of each.
    pub classes: usize,
    /// Share of the uniform distribution in each.
    pub unimix: f32,
}

/// Which of two distributions a divergence teaches.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// q of KL(q || p): the posterior, made easier to predict.
    First,
    /// p of KL(q || p): the prior, made to predict.
    Second,
}

impl Categorical {
    /// Numbers in a row of logits or of samples.
    pub fn width(&self) -> usize {
        self.count * self.classes
    }

    /// The softmax of each distribution's logits, nothing mixed in.
    fn softmax(&self, logits: &[f32]) -> Vec<f32> {
        let mut shares = logits.to_vec();
        softmax(&mut shares, self.classes);
        shares
    }

    fn mixed(&self, share: f32) -> f32 {
        (1.0 - self.unimix) * share + self.unimix / self.classes as f32
    }

    /// The probabilities of each class, for rows of logits.
    pub fn probabilities(&self, logits: &[f32]) -> Vec<f32> {
        self.softmax(logits).into_iter().map(|share| self.mixed(share)).collect()
    }

    /// Takes a gradient with respect to a distribution's probabilities to one with respect to its logits, in place.
    fn through_softmax(&self, gradient: &mut [f32], shares: &[f32]) {
        let groups = gradient.chunks_exact_mut(self.classes).zip(shares.chunks_exact(self.classes));
        for (gradient, shares) in groups {
            let mean: f32 = gradient.iter().zip(shares).map(|(g, share)| g * share).sum();
            for (g, share) in gradient.iter_mut().zip(shares) {
                *g = (1.0 - self.unimix) * share * (*g - mean);
            }
        }
    }

    /// Draws one class of each distribution: rows of ones and zeros, `[1, batch, width]`. Gradients go to the
    /// probabilities as if the sample were they (straight-through: Bengio et al. 2013).
    pub fn sample<T: Tape<f32, Cpu>>(self, logits: Tensor3<T>, rng: &mut Rng) -> Tensor3<T> {
        let (logits, mut tape) = logits.split_tape();
        let shape = *logits.shape();
        assert_eq!(shape.2, self.width(), "a logit for each class");
        let shares = self.softmax(values(&logits));
        let mut drawn = vec![0.0; shares.len()];
        for (drawn, shares) in drawn.chunks_exact_mut(self.classes).zip(shares.chunks_exact(self.classes)) {
            let mut left: f32 = rng.random();
            let class = shares.iter().position(|share| {
                left -= self.mixed(*share);
                left < 0.0
            });
            drawn[class.unwrap_or(self.classes - 1)] = 1.0;
        }
        let drawn = logits.device().tensor_from_vec(drawn, shape);
        if T::OWNS_TAPE {
            let drawn = drawn.clone();
            tape.add_backward_op(move |gradients| {
                let mut d = take(gradients, &drawn)?;
                self.through_softmax(&mut d, &shares);
                gradients.get_or_alloc_mut(&logits)?.iter_mut().zip(d).for_each(|(dl, d)| *dl += d);
                Ok(())
            });
        }
        drawn.put_tape(tape)
    }

    /// The likeliest class of each distribution, as ones and zeros.
    pub fn mode(&self, logits: &Tensor3) -> Tensor3 {
        let mut ones = vec![0.0; values(logits).len()];
        for (ones, logits) in ones.chunks_exact_mut(self.classes).zip(values(logits).chunks_exact(self.classes)) {
            let likeliest = (0..self.classes).max_by(|a, b| logits[*a].total_cmp(&logits[*b]));
            ones[likeliest.expect("a class")] = 1.0;
        }
        logits.device().tensor_from_vec(ones, *logits.shape())
    }

    /// KL(q || p) of each row, summed over the distributions, `[1, batch, 1]`; but at least `free`, and without gradient
    /// there: so much may be said for nothing. `learner` are the logits of the side that learns, `fixed` those of the other.
    pub fn divergence<T: Tape<f32, Cpu>>(
        &self,
        side: Side,
        learner: Tensor3<T>,
        fixed: &Tensor3,
        free: f32,
    ) -> Tensor3<T> {
        assert_eq!(learner.shape(), fixed.shape(), "logits of two kinds of one thing");
        let fixed = self.probabilities(values(fixed));
        let width = self.width();
        ops::rowwise(learner, |row, logits, slope| {
            let shares = self.softmax(logits);
            let fixed = &fixed[row * width..][..width];
            let mut divergence = 0.0;
            for ((slope, share), fixed) in slope.iter_mut().zip(&shares).zip(fixed) {
                let own = self.mixed(*share);
                let (q, p) = if side == Side::First { (own, *fixed) } else { (*fixed, own) };
                let ratio = (q / p).ln();
                divergence += q * ratio;
                *slope = if side == Side::First { ratio + 1.0 } else { -q / p };
            }
            if divergence > free {
                self.through_softmax(slope, &shares);
            } else {
                slope.fill(0.0);
            }
            divergence.max(free)
        })
    }

    /// The entropy of each row, summed over the distributions.
    pub fn entropies(&self, logits: &Tensor3) -> Vec<f32> {
        let probabilities = self.probabilities(values(logits));
        let rows = probabilities.chunks_exact(self.width());
        rows.map(|row| row.iter().map(|p| -p * p.ln()).sum()).collect()
    }
}

vectorised_fn! {
    /// The softmax of every `group` numbers, in place.
    pub(crate) fn softmax(logits: &'a mut [f32], group: usize) {
        for group in logits.chunks_exact_mut(group) {
            let highest = group.iter().fold(f32::NEG_INFINITY, |a, b| a.max(*b));
            let mut total = 0.0;
            for logit in group.iter_mut() {
                *logit = exp(*logit - highest);
                total += *logit;
            }
            for share in group {
                *share /= total;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use dfdx::tensor::Gradients;

    use super::*;
    use crate::nn::{device, tensor};

    const TWO: Categorical = Categorical { count: 2, classes: 4, unimix: 0.01 };
    const POSTERIOR: [f32; 8] = [2.0, 0.0, -1.0, 0.5, 0.1, 0.2, 0.3, 5.0];
    const PRIOR: [f32; 8] = [0.5, 0.5, 0.0, -0.5, 1.0, -1.0, 0.0, 2.0];

    fn near(what: &str, found: &[f32], expected: &[f64], tolerance: f64) {
        assert_eq!(found.len(), expected.len(), "{what}");
        for (found, expected) in found.iter().zip(expected) {
            assert!((f64::from(*found) - expected).abs() < tolerance, "{what}: {found}, expected {expected}");
        }
    }

    fn gradient(gradients: &mut Gradients<f32, Cpu>, of: &Tensor3) -> Vec<f32> {
        gradients.get_or_alloc_mut(of).expect("memory").to_vec()
    }

    /// Numbers computed in float64 with PyTorch.
    #[test]
    fn divergences_and_their_gradients_are_the_references() {
        let cpu = device();
        let q = [
            0.705_498_92,
            0.097_640_56,
            0.037_500_26,
            0.159_360_26,
            0.009_693_91,
            0.010_450_5,
            0.011_286_66,
            0.968_568_92,
        ];
        near("q", &TWO.probabilities(&POSTERIOR), &q, 1e-6);
        let [posterior, prior] = [POSTERIOR, PRIOR].map(|logits| tensor(&cpu, logits.to_vec(), (1, 1, 8)));
        let entropy = 0.889_078_14 + 0.174_152_09;
        near("entropy", &TWO.entropies(&posterior), &[entropy], 1e-5);

        let dynamics = TWO.divergence(Side::Second, prior.leaky_trace(), &posterior, 0.0);
        near("divergence", values(&dynamics), &[0.714_133_96], 1e-6);
        let expected = [
            -0.367_277_46,
            0.236_049_24,
            0.164_910_04,
            -0.033_681_82,
            0.226_114_61,
            0.022_211_95,
            0.075_742_68,
            -0.324_069_23,
        ];
        near("of the prior", &gradient(&mut dynamics.sum::<Rank0, _>().backward(), &prior), &expected, 1e-6);

        let representation = TWO.divergence(Side::First, posterior.leaky_trace(), &prior, 0.0) * 0.1;
        let expected = [
            0.024_997_89,
            -0.015_432_02,
            -0.007_293_33,
            -0.002_272_55,
            -0.002_553_79,
            -0.001_224_37,
            -0.002_122_66,
            0.005_900_82,
        ];
        near(
            "of the posterior",
            &gradient(&mut representation.sum::<Rank0, _>().backward(), &posterior),
            &expected,
            1e-6,
        );

        let free = TWO.divergence(Side::Second, prior.leaky_trace(), &posterior, 1.0);
        near("free nats", values(&free), &[1.0], 1e-9);
        near("of what is free", &gradient(&mut free.sum::<Rank0, _>().backward(), &prior), &[0.0; 8], 1e-9);
        let without = Categorical { unimix: 0.0, ..TWO }.divergence(Side::Second, prior, &posterior, 0.0);
        near("nothing mixed in", values(&without), &[0.387_886_16 + 0.348_961_19], 1e-5);
    }

    #[test]
    fn samples_pass_gradients_straight_through() {
        let one = Categorical { count: 1, ..TWO };
        let logits = tensor(&device(), vec![2.0, 0.0, -1.0, 0.5], (1, 1, 4));
        let weights = tensor(&device(), vec![1.0, -0.5, 2.0, 0.3], (1, 1, 4));
        let sample = one.sample(logits.leaky_trace(), &mut crate::rng::stream(0, "sample"));
        assert_eq!(values(&sample).iter().sum::<f32>(), 1.0);
        let found = gradient(&mut (sample * weights).sum::<Rank0, _>().backward(), &logits);
        near("gradient", &found, &[0.154_455_8, -0.121_807_52, 0.042_690_16, -0.075_338_44], 1e-6);
    }

    #[test]
    fn samples_come_as_often_as_they_should() {
        let logits = tensor(&device(), PRIOR.repeat(20_000), (1, 20_000, 8));
        let sample = TWO.sample(logits, &mut crate::rng::stream(1, "sample"));
        for (i, p) in TWO.probabilities(&PRIOR).iter().enumerate() {
            let share = values(&sample).iter().skip(i).step_by(8).sum::<f32>() / 20_000.0;
            assert!((share - p).abs() < 0.012, "class {i}: {share}, expected {p}");
        }
    }
}
