//! Whether predicted uncertainties are true: coverage, the probability integral transform, calibration error, CRPS.

use std::f64::consts::{FRAC_1_SQRT_2, PI, TAU};

/// A Gaussian prediction of one number, and what came.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GaussianForecast {
    /// The predicted mean.
    pub mean: f64,
    /// The predicted standard deviation.
    pub deviation: f64,
    /// What came.
    pub outcome: f64,
}

impl GaussianForecast {
    /// How many deviations the outcome lies above the mean.
    pub fn z(&self) -> f64 {
        (self.outcome - self.mean) / self.deviation
    }

    /// The probability integral transform: the predicted probability of an outcome at most this large. Uniform in
    /// [0, 1] if predictions are calibrated; heaped at both ends if they are too sure, in the middle if not sure enough.
    pub fn pit(&self) -> f64 {
        normal_cdf(self.z())
    }

    /// The negative log-likelihood of the outcome.
    pub fn nll(&self) -> f64 {
        0.5 * ((TAU * self.deviation.powi(2)).ln() + self.z().powi(2))
    }

    /// The continuous ranked probability score, in the outcome's unit: an absolute error that also judges the
    /// deviation.
    pub fn crps(&self) -> f64 {
        let z = self.z();
        let density = (-0.5 * z * z).exp() / TAU.sqrt();
        self.deviation * (z * (2.0 * normal_cdf(z) - 1.0) + 2.0 * density - 1.0 / PI.sqrt())
    }
}

/// The share of outcomes inside the central interval that should hold a share `level` of them.
pub fn coverage(judged: &[GaussianForecast], level: f64) -> f64 {
    let inside = judged.iter().filter(|j| (2.0 * j.pit() - 1.0).abs() <= level).count();
    inside as f64 / judged.len() as f64
}

/// The expected calibration error of regression (Kuleshov et al. 2018): over the levels 0.1, 0.2, ... 0.9 the mean
/// distance between a level and the share of outcomes whose predicted probability is at most that.
pub fn expected_calibration_error(judged: &[GaussianForecast]) -> f64 {
    let pit: Vec<f64> = judged.iter().map(GaussianForecast::pit).collect();
    let distance = |level: f64| {
        let below = pit.iter().filter(|u| **u <= level).count();
        (below as f64 / pit.len() as f64 - level).abs()
    };
    (1..10).map(|i| distance(f64::from(i) / 10.0)).sum::<f64>() / 9.0
}

/// What all deviations must be multiplied by so that outcomes lie as far off as was predicted: the root mean square
/// of z.
pub fn temperature(judged: &[GaussianForecast]) -> f64 {
    (judged.iter().map(|j| j.z().powi(2)).sum::<f64>() / judged.len() as f64).sqrt()
}

/// The probability that a standard normal number is at most `z`.
fn normal_cdf(z: f64) -> f64 {
    0.5 * libm::erfc(-z * FRAC_1_SQRT_2)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(found: f64, expected: f64) {
        assert!((found - expected).abs() < 1e-7, "{found}, expected {expected}");
    }

    #[test]
    fn calibration_is_that_of_the_reference() {
        let means = [0.0, 1.0, -0.5, 2.0, 0.3, 0.0, -1.0, 0.5];
        let deviations = [1.0, 0.5, 0.8, 1.5, 0.2, 2.0, 1.0, 0.7];
        let outcomes = [0.5, 1.9, -0.4, -0.5, 0.35, -1.0, -2.5, 0.4];
        let judged: Vec<GaussianForecast> = (0..8)
            .map(|i| GaussianForecast { mean: means[i], deviation: deviations[i], outcome: outcomes[i] })
            .collect();
        let pit = [
            0.691_462_46,
            0.964_069_68,
            0.549_738_22,
            0.047_790_35,
            0.598_706_33,
            0.308_537_54,
            0.066_807_20,
            0.443_201_50,
        ];
        let crps = [
            0.331_403_53,
            0.632_180_79,
            0.191_936_28,
            1.713_195_28,
            0.051_699_96,
            0.662_807_06,
            0.994_424_00,
            0.169_275_99,
        ];
        for i in 0..8 {
            near(judged[i].pit(), pit[i]);
            near(judged[i].crps(), crps[i]);
        }
        for (level, expected) in [(0.5, 0.625), (0.8, 0.625), (0.9, 0.75), (0.95, 1.0)] {
            near(coverage(&judged, level), expected);
        }
        near(expected_calibration_error(&judged), 0.077_777_78);
        near(judged.iter().map(GaussianForecast::nll).sum::<f64>() / 8.0, 1.250_109_05);
        near(temperature(&judged), 1.052_752_99);
    }
}
