//! Two-hot regression over bins that are evenly spaced in symlog space, as in TD-MPC2 (and DreamerV3's first version): a
//! number's symlog is split between its two neighbours, and the expectation is taken before the logarithm is undone.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use super::categorical::softmax;
use super::frozen::{Feature, PANEL};
use super::kernels::{exp, vectorised_fn};
use super::ops::{Tensor3, values};
use super::tape::TapeOps;
use super::two_hot::{symexp, symlog};

/// Bins `b_i`, evenly spaced over `-limit..=limit`: a distribution over them stands for the number `symexp(sum p_i b_i)`.
///
/// ```
/// use handful::nn::{SymlogBins, device, tensor};
///
/// let bins = SymlogBins::new(101, 10.0);
/// // ln 2 = 0.693 lies between the bins 0.6 and 0.8.
/// assert_eq!(bins.encode(1.0).0, 53);
/// assert_eq!(bins.decode(&tensor(&device(), vec![0.0; 101], (1, 1, 101))), [0.0]);
/// ```
#[doc(alias = "two-hot")]
#[doc(alias = "discrete regression")]
#[derive(Clone, Debug, PartialEq)]
pub struct SymlogBins {
    count: usize,
    limit: f32,
}

impl SymlogBins {
    /// `count` bins (odd, at least 3) from `-limit` to `limit`, in symlog space; the middle one is zero.
    ///
    /// # Panics
    /// If the count is even or below 3, or `limit` is not positive or too large for an f32.
    pub fn new(count: usize, limit: f32) -> Self {
        assert!(count >= 3 && count % 2 == 1, "`count` must be odd and at least 3");
        assert!(limit > 0.0 && limit.exp_m1().is_finite(), "`limit` must be positive, and symexp of it finite");
        Self { count, limit }
    }

    /// How many bins there are.
    pub fn count(&self) -> usize {
        self.count
    }

    fn width(&self) -> f32 {
        2.0 * self.limit / (self.count - 1) as f32
    }

    /// Whether `x` lies within the outermost bins, so that it can be represented.
    pub fn contains(&self, x: f32) -> bool {
        symlog(x).abs() <= self.limit
    }

    /// The two-hot code of `x`: a bin's index, and the weights of that bin and the next one. Numbers beyond the outermost
    /// bins get all their weight there; the weights of NaN are NaN.
    pub fn encode(&self, x: f32) -> (usize, [f32; 2]) {
        let position = (symlog(x).clamp(-self.limit, self.limit) + self.limit) / self.width();
        let lower = (position.floor() as usize).min(self.count - 2);
        let upper = position - lower as f32;
        (lower, [1.0 - upper, upper])
    }

    /// The expected bin under a row of probabilities, in symlog space. Opposite bins are summed in pairs, so that uniform
    /// probabilities give exactly zero.
    fn expected(&self, probabilities: &[f32]) -> f32 {
        let half = self.count / 2;
        let (left, right) = probabilities.split_at(half);
        let pairs = left.iter().rev().zip(&right[1..]).enumerate();
        self.width() * pairs.map(|(i, (minus, plus))| (plus - minus) * (i + 1) as f32).sum::<f32>()
    }

    /// The prediction of each row of logits `[members, batch, bins]`: `[members x batch]`.
    pub fn decode(&self, logits: &Tensor3) -> Vec<f32> {
        let mut probabilities = values(logits).to_vec();
        softmax(&mut probabilities, self.count);
        probabilities.chunks_exact(self.count).map(|row| symexp(self.expected(row))).collect()
    }

    /// [`SymlogBins::decode`] with a gradient: `[members, batch, 1]`.
    pub fn decode_on<T: Tape<f32, Cpu>>(&self, tape: &mut T, logits: &Tensor3) -> Tensor3 {
        tape.rowwise(logits, |_, logits, slope| {
            slope.copy_from_slice(logits);
            softmax(slope, self.count);
            let expected = self.expected(slope);
            // d symexp(m) / dm = exp(|m|), and dm / dlogit_i = p_i (b_i - m).
            let steepness = exp(expected.abs());
            for (i, p) in slope.iter_mut().enumerate() {
                *p *= steepness * (i as f32 * self.width() - self.limit - expected);
            }
            symexp(expected)
        })
    }

    /// The cross-entropy between rows of logits `[members, batch, bins]` and the two-hot codes of the targets, `[batch]`, the
    /// same for all members: `[members, batch, 1]`.
    ///
    /// # Panics
    /// If there is not one target for each row.
    #[doc(alias = "cross-entropy")]
    pub fn loss<T: Tape<f32, Cpu>>(&self, tape: &mut T, logits: &Tensor3, targets: &[f32]) -> Tensor3 {
        let &(_, batch, width) = logits.shape();
        assert!(width == self.count && targets.len() == batch, "a logit for each bin, and a target for each row");
        let codes: Vec<(usize, [f32; 2])> = targets.iter().map(|target| self.encode(*target)).collect();
        tape.rowwise(logits, |row, logits, slope| {
            // -sum t ln softmax(l), with slope softmax(l) - t.
            let (lower, weights) = codes[row % batch];
            let highest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
            slope.copy_from_slice(logits);
            softmax(slope, width);
            // The softmax is exp(l - normaliser); that of the highest logit is at least 1 / bins.
            let likeliest = slope.iter().copied().fold(0.0, f32::max);
            let normaliser = highest - likeliest.ln();
            let mut loss = 0.0;
            for (i, weight) in weights.into_iter().enumerate() {
                slope[lower + i] -= weight;
                loss += weight * (normaliser - logits[lower + i]);
            }
            loss
        })
    }

    /// The predictions of a panel of rows of logits.
    pub(crate) fn decode_panel(&self, logits: &[Feature]) -> [f32; PANEL] {
        let mut decoded = [0.0; PANEL];
        expected_panel(&mut decoded, logits, self.width());
        decoded.map(symexp)
    }
}

vectorised_fn! {
    fn expected_panel(expected: &'a mut [f32; PANEL], logits: &'a [Feature], width: f32) {
        let mut highest = [f32::NEG_INFINITY; PANEL];
        for Feature(rows) in logits {
            (0..PANEL).for_each(|i| highest[i] = highest[i].max(rows[i]));
        }
        let (mut total, mut sum) = ([0.0; PANEL], [0.0; PANEL]);
        let middle = (logits.len() / 2) as f32;
        for (k, Feature(rows)) in logits.iter().enumerate() {
            let bin = width * (k as f32 - middle);
            for i in 0..PANEL {
                let weight = exp(rows[i] - highest[i]);
                total[i] += weight;
                sum[i] += weight * bin;
            }
        }
        (0..PANEL).for_each(|i| expected[i] = sum[i] / total[i]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{device, tensor};

    /// Numbers computed in float64 from the reference's formulas.
    #[test]
    fn codes_losses_and_predictions_are_the_references() {
        let bins = SymlogBins::new(101, 10.0);
        for (x, lower, weight, back) in [
            (0.0, 50, 1.0, 0.0),
            (0.5, 52, 0.972_674, 0.5),
            (1.0, 53, 0.534_264, 1.0),
            (-2.0, 44, 0.493_061, -2.0),
            (20.0, 65, 0.777_388, 20.0),
            (30_000.0, 99, 0.0, 22_025.465),
        ] {
            let (found, [below, above]) = bins.encode(x);
            assert_eq!(found, lower, "{x}");
            assert!((below - weight).abs() < 2e-5 && (below + above - 1.0).abs() < 1e-6, "{x}: {below}");
            let mut logits = vec![-1e9; 101];
            logits[lower] = below.ln();
            logits[lower + 1] = above.ln();
            let panel: Vec<Feature> = logits.iter().map(|l| Feature([*l; PANEL])).collect();
            let decoded = bins.decode(&tensor(&device(), logits, (1, 1, 101)))[0];
            for decoded in [decoded, bins.decode_panel(&panel)[3]] {
                assert!((decoded - back).abs() < 2e-5 * back.abs().max(1.0), "{x}: {decoded}, expected {back}");
            }
        }
        assert!(bins.contains(-22_000.0) && !bins.contains(22_100.0));
        assert!(bins.encode(f32::NAN).1[0].is_nan());
        let logits = (0..101).map(|k| -((k - 55) as f32).powi(2) / 8.0).collect();
        let logits = tensor(&device(), logits, (1, 1, 101));
        assert!((bins.decode(&logits)[0] - 1.718_282).abs() < 1e-5);
        for (x, loss) in [(0.5, 2.720_007), (2.0, 1.673_718), (0.0, 4.737_086)] {
            let found = values(&bins.loss(&mut NoneTape, &logits, &[x]))[0];
            assert!((found - loss).abs() < 2e-5, "{x}: {found}, expected {loss}");
        }
        let blank = tensor(&device(), vec![0.0; 101], (1, 1, 101));
        assert!((values(&bins.loss(&mut NoneTape, &blank, &[3.0]))[0] - 4.615_121).abs() < 1e-5);
        let mut tape = OwnedTape::default();
        let loss = bins.loss(&mut tape, &logits, &[2.0]);
        let mut gradients = crate::nn::ops::total(tape, &[(1.0, loss)]).backward();
        let slope = gradients.get_or_alloc_mut(&logits).expect("memory");
        for (found, expected) in slope[53..58].iter().zip([0.120_985, 0.176_033, -0.307_467, -0.317_029, 0.120_985]) {
            assert!((found - expected).abs() < 1e-5, "{found}, expected {expected}");
        }
    }
}
