//! Statistics over a few runs: intervals, interquartile mean, learning-curve summaries.

use rand::RngExt;

use crate::rng::Rng;

/// The 95 % Wilson interval of a success rate, from `successes` in `n` trials.
pub fn wilson(successes: usize, n: usize) -> [f64; 2] {
    if n == 0 {
        return [0.0, 1.0];
    }
    const Z: f64 = 1.959_963_984_540_054;
    let (n, p) = (n as f64, successes as f64 / n as f64);
    let centre = (p + Z * Z / (2.0 * n)) / (1.0 + Z * Z / n);
    let half = Z / (1.0 + Z * Z / n) * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
    // In exact arithmetic neither end ever leaves [0, 1].
    [(centre - half).max(0.0), (centre + half).min(1.0)]
}

/// The interquartile mean (IQM): the mean after dropping a quarter of the values, rounded down, at each end.
#[doc(alias = "IQM")]
pub fn interquartile_mean(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let drop = sorted.len() / 4;
    mean(&sorted[drop..sorted.len() - drop])
}

/// The mean; NaN if there are no values.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// The population standard deviation (division by n).
#[doc(alias = "standard deviation")]
pub fn deviation(values: &[f64]) -> f64 {
    let centre = mean(values);
    (values.iter().map(|v| (v - centre).powi(2)).sum::<f64>() / values.len() as f64).sqrt()
}

/// The Pearson correlation of two lists; 0 if one of them is constant.
pub fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let (centre_a, centre_b) = (mean(a), mean(b));
    let products: Vec<f64> = a.iter().zip(b).map(|(a, b)| (a - centre_a) * (b - centre_b)).collect();
    let spread = deviation(a) * deviation(b);
    if spread > 0.0 { mean(&products) / spread } else { 0.0 }
}

/// A 95 % percentile bootstrap interval of a statistic over runs.
pub fn bootstrap(values: &[f64], statistic: impl Fn(&[f64]) -> f64, rng: &mut Rng) -> [f64; 2] {
    const DRAWS: usize = 5000;
    let mut drawn: Vec<f64> = (0..DRAWS)
        .map(|_| {
            let again: Vec<f64> = values.iter().map(|_| values[rng.random_range(0..values.len())]).collect();
            statistic(&again)
        })
        .collect();
    drawn.sort_by(f64::total_cmp);
    [0.025, 0.975].map(|q| drawn[(q * (DRAWS - 1) as f64).round() as usize])
}

/// The area under a success curve divided by its length in steps: the mean success during training.
pub fn area_under_curve(steps: &[f64], success: &[f64]) -> f64 {
    let pieces = steps.windows(2).zip(success.windows(2));
    let area: f64 = pieces.map(|(x, y)| (x[1] - x[0]) * (y[0] + y[1]) / 2.0).sum();
    area / (steps.last().unwrap_or(&0.0) - steps.first().unwrap_or(&0.0))
}

/// The step at which a success curve, interpolated linearly, first reaches `level`; `None` if it never does.
pub fn steps_to(level: f64, steps: &[f64], success: &[f64]) -> Option<f64> {
    let reached = success.iter().position(|s| *s >= level)?;
    if reached == 0 {
        return Some(steps[0]);
    }
    let (x0, x1, y0, y1) = (steps[reached - 1], steps[reached], success[reached - 1], success[reached]);
    Some(x0 + (x1 - x0) * (level - y0) / (y1 - y0))
}
