//! Two-hot symexp regression (DreamerV3): a number of any size is learned as a categorical distribution over exponentially
//! spaced bins, with a cross-entropy whose gradients do not grow with the number.
//!
//! ```
//! use handful::nn::dfdx::prelude::NoneTape;
//! use handful::nn::{SymexpBins, device, tensor, values};
//!
//! let bins = SymexpBins::new(255, 20.0);
//! // Between which bins 1.5 lies, and how its weight is split between them.
//! let (lower, weights) = bins.encode(1.5);
//! assert_eq!((lower, weights[0] + weights[1]), (132, 1.0));
//! // Zero logits predict exactly zero, at a loss of ln 255 for any target.
//! let logits = tensor(&device(), vec![0.0; 255], (1, 1, 255));
//! assert_eq!(bins.decode(&logits), [0.0]);
//! let loss = bins.loss(&mut NoneTape, &logits, &[&[1.5]]);
//! assert!((values(&loss)[0] - 255_f32.ln()).abs() < 1e-4);
//! ```

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use super::categorical::softmax;
use super::ops::{Tensor3, values};
use super::tape::TapeOps;

pub use super::kernels::symlog;

/// `sign(x) (exp(|x|) - 1)`, the inverse of [`symlog`].
pub fn symexp(x: f32) -> f32 {
    x.signum() * x.abs().exp_m1()
}

/// Bins whose distance grows exponentially to both sides of zero, `b_i = symexp(x_i)` for evenly spaced `x_i`.
///
/// Targets are split linearly between two bins, in raw space, as the published code does. (The paper's first version had
/// evenly spaced bins in symlog space.)
#[doc(alias = "two-hot")]
#[doc(alias = "twohot")]
#[doc(alias = "distributional critic")]
#[derive(Clone, Debug, PartialEq)]
pub struct SymexpBins {
    bins: Vec<f32>,
}

impl SymexpBins {
    /// `count` bins (odd, at least 3) from `-symexp(limit)` to `symexp(limit)`; the middle one is exactly zero.
    ///
    /// # Panics
    /// If the count is even or below 3, or `limit` is not positive or too large for an f32.
    pub fn new(count: usize, limit: f64) -> Self {
        assert!(count >= 3 && count % 2 == 1, "`count` must be odd and at least 3");
        assert!(
            limit > 0.0 && (limit.exp_m1() as f32).is_finite(),
            "`limit` must be positive, and symexp of it finite"
        );
        let half = count / 2;
        let upper = |i: usize| (limit * i as f64 / half as f64).exp_m1() as f32;
        Self { bins: (0..count).map(|i| if i < half { -upper(half - i) } else { upper(i - half) }).collect() }
    }

    /// How many bins there are.
    pub fn count(&self) -> usize {
        self.bins.len()
    }

    /// Whether `y` lies between the outermost bins, so that its code decodes to it.
    pub fn contains(&self, y: f32) -> bool {
        y.abs() <= self.bins[self.bins.len() - 1]
    }

    /// The two-hot code of `y`: a bin's index, and the weights of that bin and the next one, linear between the two. Numbers
    /// beyond the outermost bins get all their weight there.
    pub fn encode(&self, y: f32) -> (usize, [f32; 2]) {
        let last = self.bins.len() - 1;
        let y = y.clamp(self.bins[0], self.bins[last]);
        let lower = (self.bins.partition_point(|bin| *bin <= y).max(1) - 1).min(last - 1);
        let upper = (y - self.bins[lower]) / (self.bins[lower + 1] - self.bins[lower]);
        (lower, [1.0 - upper, upper])
    }

    /// The expected bin under a row of probabilities. Summed in pairs of opposite bins, so that uniform probabilities give
    /// exactly zero, which a sum from left to right loses among bins of 1e8.
    fn expected(&self, probabilities: &[f32]) -> f32 {
        let half = self.bins.len() / 2;
        let (left, right) = probabilities.split_at(half);
        let pairs = left.iter().rev().zip(&right[1..]).zip(&self.bins[half + 1..]);
        pairs.map(|((minus, plus), bin)| (plus - minus) * bin).sum()
    }

    /// The prediction of each row of logits `[1, batch, bins]`: the expected bin, `[batch]`.
    pub fn decode(&self, logits: &Tensor3) -> Vec<f32> {
        let mut probabilities = values(logits).to_vec();
        softmax(&mut probabilities, self.bins.len());
        probabilities.chunks_exact(self.bins.len()).map(|row| self.expected(row)).collect()
    }

    /// [`SymexpBins::decode`] with a gradient: `[1, batch, 1]`.
    pub fn decode_on<T: Tape<f32, Cpu>>(&self, tape: &mut T, logits: &Tensor3) -> Tensor3 {
        tape.rowwise(logits, |_, logits, slope| {
            slope.copy_from_slice(logits);
            softmax(slope, self.bins.len());
            let expected = self.expected(slope);
            slope.iter_mut().zip(&self.bins).for_each(|(p, bin)| *p *= bin - expected);
            expected
        })
    }

    /// The cross-entropy between each row of logits `[1, batch, bins]` and the two-hot codes of its targets, summed over the
    /// lists of targets, `[batch]` each: `[1, batch, 1]`.
    ///
    /// # Panics
    /// If there is not one list of targets as long as the batch for each.
    #[doc(alias = "cross-entropy")]
    pub fn loss<T: Tape<f32, Cpu>>(&self, tape: &mut T, logits: &Tensor3, targets: &[&[f32]]) -> Tensor3 {
        let &(_, batch, width) = logits.shape();
        assert_eq!(width, self.bins.len(), "a logit for each bin");
        assert!(targets.iter().all(|each| each.len() == batch), "targets for each row");
        tape.rowwise(logits, |row, logits, slope| {
            // -sum t ln softmax(l), with slope sum(t) softmax(l) - t.
            slope.copy_from_slice(logits);
            softmax(slope, width);
            // The softmax is exp(l - normaliser); read it off where it is largest.
            let (likeliest, highest) =
                slope.iter().enumerate().fold((0, 0.0), |best, (i, p)| if *p > best.1 { (i, *p) } else { best });
            let normaliser = logits[likeliest] - highest.ln();
            slope.iter_mut().for_each(|p| *p *= targets.len() as f32);
            let mut loss = 0.0;
            for target in targets {
                let (lower, weights) = self.encode(target[row]);
                for (i, weight) in weights.into_iter().enumerate() {
                    slope[lower + i] -= weight;
                    loss += weight * (normaliser - logits[lower + i]);
                }
            }
            loss
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{device, tensor};

    fn near(what: &str, found: f32, expected: f64, tolerance: f64) {
        let error = (f64::from(found) - expected).abs();
        assert!(error <= tolerance * expected.abs().max(1.0), "{what}: {found}, expected {expected}");
    }

    #[test]
    fn symlog_and_back() {
        let pairs = [(-1000.0, -6.908_754_78), (-0.1, -0.095_310_18), (0.0, 0.0), (3.0, 1.386_294_36)];
        for (x, y) in pairs {
            near("symlog", symlog(x), y, 1e-6);
        }
        for (y, x) in [(-5.0, -147.413_159_1), (0.25, 0.284_025_42), (7.0, 1_095.633_158_43)] {
            near("symexp", symexp(y), x, 1e-6);
        }
    }

    /// Numbers computed in float64 from the reference's formulas.
    #[test]
    fn two_hot_codes_are_the_references() {
        let bins = SymexpBins::new(255, 20.0);
        for (i, bin) in
            [(0, -4.851_651_94e8), (100, -69.243_554), (127, 0.0), (128, 0.170_557_72), (254, 4.851_651_94e8)]
        {
            near("bin", bins.bins[i], bin, 1e-6);
        }
        for (y, lower, weight) in [
            (0.0, 127, 1.0),
            (0.1, 127, 0.413_688_21),
            (1.5, 132, 0.193_445_89),
            (-7.3, 113, 0.418_910_66),
            (1234.5, 172, 0.805_610_6),
            (-0.02, 126, 0.117_262_36),
            (1e9, 253, 0.0),
        ] {
            let (found, [below, above]) = bins.encode(y);
            assert_eq!(found, lower, "{y}");
            near("weight", below, weight, 1e-4);
            near("both", below + above, 1.0, 1e-6);
        }
        let cpu = device();
        let blank = tensor(&cpu, vec![0.0; 255], (1, 1, 255));
        assert_eq!(bins.decode(&blank), [0.0]);
        near("blank", values(&bins.loss(&mut NoneTape, &blank, &[&[3.0]]))[0], 5.541_263_55, 1e-6);
        let logits: Vec<f32> = (0..255).map(|i| -0.5 * ((i as f32 - 130.0) / 3.0).powi(2)).collect();
        let logits = tensor(&cpu, logits, (1, 1, 255));
        near("decode", bins.decode(&logits)[0], 0.775_887_2, 1e-4);
        for (y, loss) in [(1.5, 2.463_815_85), (0.0, 2.517_550_82), (-0.02, 2.563_152_85)] {
            near("loss", values(&bins.loss(&mut NoneTape, &logits, &[&[y]]))[0], loss, 1e-5);
        }
    }
    #[test]
    fn predictions_have_the_slopes_of_differences() {
        let (cpu, bins) = (device(), SymexpBins::new(9, 2.0));
        let numbers = [0.3, -1.0, 0.5, 0.2, 0.0, 1.1, -0.4, 0.9, 0.1];
        let logits = tensor(&cpu, numbers.to_vec(), (1, 1, 9));
        let mut tape = OwnedTape::default();
        let decoded = bins.decode_on(&mut tape, &logits);
        assert_eq!(values(&decoded), bins.decode(&logits));
        let mut gradients = crate::nn::ops::total(tape, &[(1.0, decoded)]).backward();
        let slopes = gradients.get_or_alloc_mut(&logits).expect("memory");
        for (i, slope) in slopes.iter().enumerate() {
            let moved = |by: f32| {
                let mut numbers = numbers;
                numbers[i] += by;
                bins.decode(&tensor(&cpu, numbers.to_vec(), (1, 1, 9)))[0]
            };
            near("slope", *slope, f64::from((moved(1e-2) - moved(-1e-2)) / 2e-2), 1e-3);
        }
    }
}
