//! Statistics for few runs: intervals, robust means, learning curves.
//!
//! ```
//! use handful::rng;
//! use handful::study::statistics::{bootstrap, interquartile_mean, wilson};
//!
//! // 18 of 20 test episodes succeed: the success rate may be as low as 70 %.
//! let [low, high] = wilson(18, 20);
//! assert!((low - 0.699).abs() < 1e-3 && (high - 0.972).abs() < 1e-3);
//!
//! // Success rates of five seeds, one of which failed.
//! let seeds = [0.95, 0.9, 0.1, 1.0, 0.85];
//! let iqm = interquartile_mean(&seeds);
//! let [low, high] = bootstrap(&seeds, interquartile_mean, &mut rng::stream(0, "an example"));
//! assert!((iqm - 0.9).abs() < 1e-12 && low < iqm && iqm < high);
//! ```

use rand::RngExt;

use crate::rng::Rng;

/// The 95 % Wilson score interval, `[low, high]`, of a success rate: `successes` out of `n` independent trials.
/// `[0, 1]` without trials.
///
/// Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22 (1927). Unlike the normal
/// approximation it stays within `[0, 1]` and has a width at 0 and 100 %.
#[doc(alias = "Wilson interval")]
#[doc(alias = "confidence interval")]
#[doc(alias = "binomial proportion")]
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

/// The interquartile mean: the mean of the middle half. A quarter of the values, rounded down, is dropped at each end;
/// not a number without values.
///
/// Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", NeurIPS 2021, who recommend
/// it over the median for few runs. They pool runs of several tasks; here it is taken over the seeds of one task.
#[doc(alias = "IQM")]
#[doc(alias = "interquartile mean")]
#[doc(alias = "trimmed mean")]
pub fn interquartile_mean(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let drop = sorted.len() / 4;
    mean(&sorted[drop..sorted.len() - drop])
}

/// The arithmetic mean; not a number without values.
#[doc(alias = "average")]
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// The standard deviation of the values themselves: divided by `n`, not by `n - 1`.
#[doc(alias = "standard deviation")]
#[doc(alias = "std")]
pub fn deviation(values: &[f64]) -> f64 {
    let centre = mean(values);
    (values.iter().map(|v| (v - centre).powi(2)).sum::<f64>() / values.len() as f64).sqrt()
}

/// Pearson's correlation coefficient of two lists of the same length; 0 if one of them is constant.
#[doc(alias = "Pearson")]
#[doc(alias = "correlation coefficient")]
pub fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let (centre_a, centre_b) = (mean(a), mean(b));
    let products: Vec<f64> = a.iter().zip(b).map(|(a, b)| (a - centre_a) * (b - centre_b)).collect();
    let spread = deviation(a) * deviation(b);
    if spread > 0.0 { mean(&products) / spread } else { 0.0 }
}

/// The 95 % percentile-bootstrap interval, `[low, high]`, of a statistic over runs: its 2.5 % and 97.5 % quantiles over
/// 5000 samples drawn from `values` with replacement.
///
/// Efron, "Bootstrap methods: another look at the jackknife", Annals of Statistics 7 (1979); for reinforcement learning,
/// Agarwal et al. (NeurIPS 2021). With fewer than five values the interval is too narrow.
#[doc(alias = "bootstrap confidence interval")]
#[doc(alias = "confidence interval")]
#[doc(alias = "resampling")]
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

/// The area under a success curve (trapezoidal rule) divided by its length in environment steps: the mean success rate
/// during training.
#[doc(alias = "AUC")]
#[doc(alias = "learning curve")]
#[doc(alias = "sample efficiency")]
pub fn area_under_curve(steps: &[f64], success: &[f64]) -> f64 {
    let pieces = steps.windows(2).zip(success.windows(2));
    let area: f64 = pieces.map(|(x, y)| (x[1] - x[0]) * (y[0] + y[1]) / 2.0).sum();
    area / (steps.last().unwrap_or(&0.0) - steps.first().unwrap_or(&0.0))
}

/// The number of environment steps after which a success curve first reaches `level`, linear between two evaluations;
/// `None` if it never does.
#[doc(alias = "sample efficiency")]
#[doc(alias = "steps to threshold")]
pub fn steps_to(level: f64, steps: &[f64], success: &[f64]) -> Option<f64> {
    let reached = success.iter().position(|s| *s >= level)?;
    if reached == 0 {
        return Some(steps[0]);
    }
    let (x0, x1, y0, y1) = (steps[reached - 1], steps[reached], success[reached - 1], success[reached]);
    Some(x0 + (x1 - x0) * (level - y0) / (y1 - y0))
}
