//! Coloured noise (Timmer and Koenig 1995; for planning, Pinneri et al. 2020): random sequences whose power
//! spectral density falls with frequency f as f^-beta. Beta 0 is white noise, 1 pink, 2 red (Brownian); the larger beta,
//! the more successive actions agree, and the further an arm gets with them.
//!
//! ```
//! use handful::plan::noise::ColoredNoise;
//! use handful::rng;
//!
//! // How much successive time steps differ.
//! let roughness = |beta: f64| -> f64 {
//!     let sequence = ColoredNoise::new(beta, 100).sample(&mut rng::stream(0, "example"));
//!     sequence.windows(2).map(|pair| (pair[1] - pair[0]).powi(2)).sum()
//! };
//! assert!(roughness(2.0) < 0.2 * roughness(0.0));
//! ```

use std::f64::consts::TAU;

use crate::rng::{self, Rng};

/// Samples noise of one exponent over one length.
#[doc(alias = "colored noise")]
#[doc(alias = "pink noise")]
#[derive(Clone, Debug)]
pub struct ColoredNoise {
    length: usize,
    /// Standard deviation of each Fourier coefficient, from frequency zero up.
    scales: Vec<f64>,
    /// The standard deviation of what the inverse transform gives (without its constant part); it is divided out.
    sigma: f64,
}

impl ColoredNoise {
    /// Noise of exponent `beta` over `length` time steps.
    ///
    /// # Panics
    /// If `length` is less than 2.
    pub fn new(beta: f64, length: usize) -> Self {
        assert!(length >= 2, "a sequence has at least two time steps");
        let n = length as f64;
        let bins = length / 2 + 1;
        let scale = |k: usize| (k.max(1) as f64 / n).powf(-beta / 2.0);
        let scales: Vec<f64> = (0..bins).map(scale).collect();
        let mut counted = scales[1..].to_vec();
        if length.is_multiple_of(2) {
            *counted.last_mut().expect("at least one frequency") /= 2.0;
        }
        let sigma = 2.0 / n * counted.iter().map(|w| w * w).sum::<f64>().sqrt();
        Self { length, scales, sigma }
    }

    /// One sequence, `[length]`, of mean 0 and standard deviation about 1 (a little above for large beta: the constant part
    /// is not counted in the normalisation, as in the reference).
    pub fn sample(&self, rng: &mut Rng) -> Vec<f64> {
        let n = self.length;
        let nyquist = n.is_multiple_of(2).then_some(n / 2);
        let coefficients: Vec<(f64, f64)> = self
            .scales
            .iter()
            .enumerate()
            .map(|(k, scale)| {
                let (real, imaginary) = (scale * rng::normal(rng), scale * rng::normal(rng));
                (real, if k == 0 || Some(k) == nyquist { 0.0 } else { imaginary })
            })
            .collect();
        // The inverse real Fourier transform, summed directly: horizons are short.
        (0..n)
            .map(|t| {
                let terms = coefficients.iter().enumerate().map(|(k, (real, imaginary))| {
                    let (sin, cos) = (TAU * (k * t % n) as f64 / n as f64).sin_cos();
                    let twice = if k == 0 || Some(k) == nyquist { 1.0 } else { 2.0 };
                    twice * (real * cos - imaginary * sin)
                });
                terms.sum::<f64>() / n as f64 / self.sigma
            })
            .collect()
    }

    /// An independent sequence for each number of an action: `[length, actions]`.
    pub fn sample_actions(&self, action_size: usize, rng: &mut Rng) -> Vec<f64> {
        let columns: Vec<Vec<f64>> = (0..action_size).map(|_| self.sample(rng)).collect();
        (0..self.length).flat_map(|t| columns.iter().map(move |column| column[t])).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_are_those_of_the_reference() {
        for (beta, length, sigma) in
            [(0.0, 8, 0.450_693_91), (2.0, 8, 2.346_687_97), (2.0, 30, 2.511_658_38), (3.0, 25, 10.949_255_70)]
        {
            let noise = ColoredNoise::new(beta, length);
            assert!((noise.sigma - sigma).abs() < 1e-7, "beta {beta}, length {length}: {}", noise.sigma);
        }
        let expected = [125.0, 125.0, 44.194_173_82, 24.056_261_22];
        for (scale, expected) in ColoredNoise::new(3.0, 25).scales.iter().zip(expected) {
            assert!((scale - expected).abs() < 1e-7);
        }
    }

    /// Variance and circular autocorrelation at lags 1 and 2, over 20,000 sequences.
    #[test]
    fn sequences_have_the_right_colour() {
        for (beta, length, expected) in [
            (0.0, 8, [1.076_923_08, 0.0, -0.142_857_14]),
            (2.0, 8, [1.181_588_90, 0.530_457_49, 0.009_605_12]),
            (2.0, 30, [1.158_518_10, 0.867_961_63, 0.698_884_91]),
            (3.0, 25, [1.208_531_09, 0.939_993_91, 0.811_048_28]),
        ] {
            let noise = ColoredNoise::new(beta, length);
            let mut rng = rng::stream(0, "colour");
            let mut sums = [0.0; 3];
            for _ in 0..20_000 {
                let y = noise.sample(&mut rng);
                for (lag, sum) in sums.iter_mut().enumerate() {
                    *sum += (0..length).map(|t| y[t] * y[(t + lag) % length]).sum::<f64>() / length as f64;
                }
            }
            let variance = sums[0] / 20_000.0;
            // The constant part is not counted in the autocorrelation of the reference.
            let found = [variance, sums[1] / sums[0], sums[2] / sums[0]];
            for (found, expected) in found.iter().zip(expected) {
                assert!((found - expected).abs() < 0.03, "beta {beta}, length {length}: {found}, expected {expected}");
            }
        }
    }
}
