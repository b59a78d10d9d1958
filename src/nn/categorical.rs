//! Vectors of categorical variables, DreamerV3's stochastic state: probabilities with 1 % of the uniform distribution mixed
//! in (unimix), samples with straight-through gradients, and the two KL losses of KL balancing.
//!
//! ```
//! use handful::nn::dfdx::prelude::NoneTape;
//! use handful::nn::{Categorical, device, tensor, values};
//!
//! // Two variables of three classes.
//! let z = Categorical { count: 2, classes: 3, unimix: 0.01 };
//! let logits = |numbers: [f32; 6]| tensor(&device(), numbers.to_vec(), (1, 1, 6));
//! let posterior = logits([1.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
//! let prior = logits([0.0; 6]);
//! let sample = z.sample(&mut NoneTape, &posterior, &mut handful::rng::stream(0, "example"));
//! assert_eq!(values(&sample).iter().sum::<f32>(), 2.0);
//!
//! let kl = |free_nats| values(&z.dynamics_kl(&mut NoneTape, &posterior, &prior, free_nats))[0];
//! assert!(kl(0.0) > 0.0 && kl(0.0) < 1.0);
//! assert_eq!(kl(1.0), 1.0);
//! ```

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use rand::RngExt;
use serde::{Deserialize, Serialize};

use super::kernels::{exp, vectorised_fn};
use super::ops::{Tensor3, take, values};
use super::tape::TapeOps;
use crate::rng::Rng;

/// A vector of independent categorical variables, given by logits `[1, batch, count x classes]`.
#[doc(alias = "unimix")]
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Categorical {
    /// Categorical variables.
    pub count: usize,
    /// Classes of each.
    pub classes: usize,
    /// Share of the uniform distribution in each: probabilities are `(1 - unimix) softmax(logits) + unimix / classes`, so
    /// that no class is impossible and no KL infinite. DreamerV3 uses 0.01.
    pub unimix: f32,
}

impl Categorical {
    /// Width of a row of logits or of samples, `count x classes`.
    pub fn width(&self) -> usize {
        self.count * self.classes
    }

    /// The softmax of each variable's logits, without unimix.
    fn softmax(&self, logits: &[f32]) -> Vec<f32> {
        let mut softmaxed = logits.to_vec();
        softmax(&mut softmaxed, self.classes);
        softmaxed
    }

    fn unimix(&self, softmaxed: f32) -> f32 {
        (1.0 - self.unimix) * softmaxed + self.unimix / self.classes as f32
    }

    /// The probability of each class, unimix included, for rows of logits.
    pub fn probabilities(&self, logits: &[f32]) -> Vec<f32> {
        self.softmax(logits).into_iter().map(|softmaxed| self.unimix(softmaxed)).collect()
    }

    /// From the gradient with respect to the probabilities to the gradient with respect to the logits, in place.
    fn through_softmax(&self, gradient: &mut [f32], softmaxed: &[f32]) {
        let groups = gradient.chunks_exact_mut(self.classes).zip(softmaxed.chunks_exact(self.classes));
        for (gradient, softmaxed) in groups {
            let mean: f32 = gradient.iter().zip(softmaxed).map(|(g, s)| g * s).sum();
            for (g, s) in gradient.iter_mut().zip(softmaxed) {
                *g = (1.0 - self.unimix) * s * (*g - mean);
            }
        }
    }

    /// Draws a class for each variable: one-hot vectors, `[1, batch, count x classes]`.
    ///
    /// Gradients are straight-through (Bengio et al. 2013): those of the sample pass to the probabilities, as if the sample
    /// were `onehot + p - sg(p)`.
    #[doc(alias = "straight-through")]
    #[doc(alias = "one-hot")]
    pub fn sample<T: Tape<f32, Cpu>>(self, tape: &mut T, logits: &Tensor3, rng: &mut Rng) -> Tensor3 {
        tape.record(logits, |logits| self.straight_through_sample(logits, rng))
    }

    fn straight_through_sample<T: Tape<f32, Cpu>>(self, logits: Tensor3<T>, rng: &mut Rng) -> Tensor3<T> {
        let (logits, mut tape) = logits.split_tape();
        let shape = *logits.shape();
        assert_eq!(shape.2, self.width(), "a logit for each class");
        let softmaxed = self.softmax(values(&logits));
        let mut one_hot = vec![0.0; softmaxed.len()];
        for (one_hot, softmaxed) in one_hot.chunks_exact_mut(self.classes).zip(softmaxed.chunks_exact(self.classes)) {
            let mut left: f32 = rng.random();
            let class = softmaxed.iter().position(|softmaxed| {
                left -= self.unimix(*softmaxed);
                left < 0.0
            });
            one_hot[class.unwrap_or(self.classes - 1)] = 1.0;
        }
        let sample = logits.device().tensor_from_vec(one_hot, shape);
        if T::OWNS_TAPE {
            let sample = sample.clone();
            tape.add_backward_op(move |gradients| {
                let mut d = take(gradients, &sample)?;
                self.through_softmax(&mut d, &softmaxed);
                gradients.get_or_alloc_mut(&logits)?.iter_mut().zip(d).for_each(|(dl, d)| *dl += d);
                Ok(())
            });
        }
        sample.put_tape(tape)
    }

    /// The likeliest class of each variable, one-hot: `[1, batch, count x classes]`.
    pub fn mode(&self, logits: &Tensor3) -> Tensor3 {
        let mut ones = vec![0.0; values(logits).len()];
        for (ones, logits) in ones.chunks_exact_mut(self.classes).zip(values(logits).chunks_exact(self.classes)) {
            let likeliest = (0..self.classes).max_by(|a, b| logits[*a].total_cmp(&logits[*b]));
            ones[likeliest.expect("a class")] = 1.0;
        }
        logits.device().tensor_from_vec(ones, *logits.shape())
    }

    /// The dynamics loss of KL balancing, `max(free_nats, KL[sg(posterior) || prior])`: trains the prior to predict the
    /// posterior. For rows of logits; `[1, batch, 1]`.
    ///
    /// *KL balancing* splits one KL divergence into two losses of the same value, each with a stop-gradient sg(.) on one
    /// side, so that the prior can be pulled towards the posterior harder than the posterior towards the prior (Hafner et
    /// al. 2023, arXiv v1, eq. 5; with weights 0.5 and 0.1 there, 1 and 0.1 in the published code). *Free nats* (free bits): a
    /// KL, summed over the variables of a row, below `free_nats` counts as that much and has no gradient.
    #[doc(alias = "KL balancing")]
    #[doc(alias = "stop-gradient")]
    #[doc(alias = "free bits")]
    #[doc(alias = "free nats")]
    pub fn dynamics_kl<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        posterior: &Tensor3,
        prior: &Tensor3,
        free_nats: f32,
    ) -> Tensor3 {
        // d KL[q || p] / dp = -q / p.
        self.kl_with_free_nats(tape, prior, posterior, free_nats, |p, q| (q * (q / p).ln(), -q / p))
    }

    /// The representation loss of KL balancing, `max(free_nats, KL[posterior || sg(prior)])`: keeps the posterior
    /// predictable. See [`Categorical::dynamics_kl`].
    #[doc(alias = "KL balancing")]
    #[doc(alias = "stop-gradient")]
    #[doc(alias = "free bits")]
    #[doc(alias = "free nats")]
    pub fn representation_kl<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        posterior: &Tensor3,
        prior: &Tensor3,
        free_nats: f32,
    ) -> Tensor3 {
        // d KL[q || p] / dq = ln(q / p) + 1.
        self.kl_with_free_nats(tape, posterior, prior, free_nats, |q, p| {
            let log_ratio = (q / p).ln();
            (q * log_ratio, log_ratio + 1.0)
        })
    }

    /// A KL divergence whose gradient flows into the logits of `learner` only: `term(learner, fixed)` is the part of one
    /// class and its derivative with respect to the learner's probability.
    fn kl_with_free_nats<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        learner: &Tensor3,
        fixed: &Tensor3,
        free_nats: f32,
        term: impl Fn(f32, f32) -> (f32, f32),
    ) -> Tensor3 {
        assert_eq!(learner.shape(), fixed.shape(), "logits of the same variables");
        let fixed = self.probabilities(values(fixed));
        let width = self.width();
        tape.rowwise(learner, |row, logits, slope| {
            let softmaxed = self.softmax(logits);
            let fixed = &fixed[row * width..][..width];
            let mut kl = 0.0;
            for i in 0..width {
                let (part, derivative) = term(self.unimix(softmaxed[i]), fixed[i]);
                kl += part;
                slope[i] = derivative;
            }
            if kl > free_nats {
                self.through_softmax(slope, &softmaxed);
            } else {
                slope.fill(0.0);
            }
            kl.max(free_nats)
        })
    }

    /// The entropy of each row of logits, summed over the variables, in nats: `[batch]`.
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
    fn kl_losses_and_their_gradients_are_the_references() {
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

        let mut tape = OwnedTape::default();
        let dynamics = TWO.dynamics_kl(&mut tape, &posterior, &prior, 0.0).put_tape(tape);
        near("KL", values(&dynamics), &[0.714_133_96], 1e-6);
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
        let mut gradients = dynamics.sum::<Rank0, _>().backward();
        near("of the prior", &gradient(&mut gradients, &prior), &expected, 1e-6);
        near("of the posterior", &gradient(&mut gradients, &posterior), &[0.0; 8], 1e-9);

        let mut tape = OwnedTape::default();
        let representation = TWO.representation_kl(&mut tape, &posterior, &prior, 0.0).put_tape(tape) * 0.1;
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
        let mut gradients = representation.sum::<Rank0, _>().backward();
        near("of the posterior", &gradient(&mut gradients, &posterior), &expected, 1e-6);
        near("of the prior", &gradient(&mut gradients, &prior), &[0.0; 8], 1e-9);

        let mut tape = OwnedTape::default();
        let free = TWO.dynamics_kl(&mut tape, &posterior, &prior, 1.0).put_tape(tape);
        near("free nats", values(&free), &[1.0], 1e-9);
        near("of what is free", &gradient(&mut free.sum::<Rank0, _>().backward(), &prior), &[0.0; 8], 1e-9);
        let without = Categorical { unimix: 0.0, ..TWO }.dynamics_kl(&mut NoneTape, &posterior, &prior, 0.0);
        near("without unimix", values(&without), &[0.387_886_16 + 0.348_961_19], 1e-5);
    }

    #[test]
    fn samples_pass_gradients_straight_through() {
        let one = Categorical { count: 1, ..TWO };
        let logits = tensor(&device(), vec![2.0, 0.0, -1.0, 0.5], (1, 1, 4));
        let weights = tensor(&device(), vec![1.0, -0.5, 2.0, 0.3], (1, 1, 4));
        let mut tape = OwnedTape::default();
        let sample = one.sample(&mut tape, &logits, &mut crate::rng::stream(0, "sample")).put_tape(tape);
        assert_eq!(values(&sample).iter().sum::<f32>(), 1.0);
        let found = gradient(&mut (sample * weights).sum::<Rank0, _>().backward(), &logits);
        near("gradient", &found, &[0.154_455_8, -0.121_807_52, 0.042_690_16, -0.075_338_44], 1e-6);
    }

    #[test]
    fn samples_come_as_often_as_they_should() {
        let logits = tensor(&device(), PRIOR.repeat(20_000), (1, 20_000, 8));
        let sample = TWO.sample(&mut NoneTape, &logits, &mut crate::rng::stream(1, "sample"));
        for (i, p) in TWO.probabilities(&PRIOR).iter().enumerate() {
            let share = values(&sample).iter().skip(i).step_by(8).sum::<f32>() / 20_000.0;
            assert!((share - p).abs() < 0.012, "class {i}: {share}, expected {p}");
        }
    }
}
