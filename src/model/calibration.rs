//! Calibration of predicted uncertainties: coverage, probability integral transform, expected calibration error, CRPS.
//!
//! ```
//! use handful::model::calibration::{GaussianForecast, coverage, temperature};
//!
//! // Errors are twice as large as predicted.
//! let forecasts: Vec<GaussianForecast> = (0..100)
//!     .map(|i| GaussianForecast { mean: 0.0, std: 1.0, outcome: if i % 2 == 0 { 2.0 } else { -2.0 } })
//!     .collect();
//! assert_eq!(coverage(&forecasts, 0.9), 0.0);
//! assert_eq!(temperature(&forecasts), 2.0);
//! ```

use std::f64::consts::{FRAC_1_SQRT_2, PI, TAU};

/// A Gaussian prediction of a scalar, with its outcome.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GaussianForecast {
    /// Predicted mean.
    pub mean: f64,
    /// Predicted standard deviation, in the unit of the mean.
    #[doc(alias = "standard deviation")]
    pub std: f64,
    /// Observed outcome, in the unit of the mean.
    pub outcome: f64,
}

impl GaussianForecast {
    /// Standard score: how many standard deviations the outcome lies above the mean.
    #[doc(alias = "z-score")]
    pub fn z(&self) -> f64 {
        (self.outcome - self.mean) / self.std
    }

    /// Probability integral transform: the predicted probability of an outcome at most this large. Over many forecasts it is
    /// uniform in [0, 1] if predictions are calibrated, U-shaped if they are overconfident, and hump-shaped if they are
    /// underconfident.
    #[doc(alias = "PIT")]
    pub fn pit(&self) -> f64 {
        normal_cdf(self.z())
    }

    /// Negative log-likelihood of the outcome, in nats.
    #[doc(alias = "negative log-likelihood")]
    pub fn nll(&self) -> f64 {
        0.5 * ((TAU * self.std.powi(2)).ln() + self.z().powi(2))
    }

    /// Continuous ranked probability score, in the unit of the outcome; lower is better. It generalises the absolute error to
    /// predicted distributions.
    #[doc(alias = "CRPS")]
    pub fn crps(&self) -> f64 {
        let z = self.z();
        let density = (-0.5 * z * z).exp() / TAU.sqrt();
        self.std * (z * (2.0 * normal_cdf(z) - 1.0) + 2.0 * density - 1.0 / PI.sqrt())
    }
}

/// Coverage: the fraction of outcomes inside the central prediction interval of probability `level` (0.9 for the 90 %
/// interval). NaN without forecasts.
#[doc(alias = "prediction interval")]
pub fn coverage(forecasts: &[GaussianForecast], level: f64) -> f64 {
    let inside = forecasts.iter().filter(|j| (2.0 * j.pit() - 1.0).abs() <= level).count();
    inside as f64 / forecasts.len() as f64
}

/// Expected calibration error of regression (after Kuleshov et al. 2018, who sum squared differences): over the levels 0.1,
/// 0.2, ... 0.9 the mean absolute difference between a level and the fraction of outcomes whose
/// [PIT](GaussianForecast::pit) is at most that level.
#[doc(alias = "ECE")]
pub fn expected_calibration_error(forecasts: &[GaussianForecast]) -> f64 {
    let pit: Vec<f64> = forecasts.iter().map(GaussianForecast::pit).collect();
    let distance = |level: f64| {
        let below = pit.iter().filter(|u| **u <= level).count();
        (below as f64 / pit.len() as f64 - level).abs()
    };
    (1..10).map(|i| distance(f64::from(i) / 10.0)).sum::<f64>() / 9.0
}

/// Temperature: the factor that calibrates all predicted standard deviations, the root mean square of
/// [z](GaussianForecast::z).
#[doc(alias = "recalibration")]
pub fn temperature(forecasts: &[GaussianForecast]) -> f64 {
    (forecasts.iter().map(|j| j.z().powi(2)).sum::<f64>() / forecasts.len() as f64).sqrt()
}

/// Cumulative distribution function of the standard normal distribution.
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
        let stds = [1.0, 0.5, 0.8, 1.5, 0.2, 2.0, 1.0, 0.7];
        let outcomes = [0.5, 1.9, -0.4, -0.5, 0.35, -1.0, -2.5, 0.4];
        let forecasts: Vec<GaussianForecast> =
            (0..8).map(|i| GaussianForecast { mean: means[i], std: stds[i], outcome: outcomes[i] }).collect();
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
            near(forecasts[i].pit(), pit[i]);
            near(forecasts[i].crps(), crps[i]);
        }
        for (level, expected) in [(0.5, 0.625), (0.8, 0.625), (0.9, 0.75), (0.95, 1.0)] {
            near(coverage(&forecasts, level), expected);
        }
        near(expected_calibration_error(&forecasts), 0.077_777_78);
        near(forecasts.iter().map(GaussianForecast::nll).sum::<f64>() / 8.0, 1.250_109_05);
        near(temperature(&forecasts), 1.052_752_99);
    }
}
