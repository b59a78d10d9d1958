//! Statistics for few runs: intervals, robust means, learning curves.
//!
//! ```
//! use handful::rng;
//! use handful::study::statistics::{two_level_bootstrap, wilson};
//!
//! // 18 of 20 test episodes of one agent succeed: its success rate may be as low as 70 %.
//! let [low, high] = wilson(18, 20);
//! assert!((low - 0.699).abs() < 1e-3 && (high - 0.972).abs() < 1e-3);
//!
//! // Five agents of one method, trained with five seeds, one of which failed. What another seed would bring is far less
//! // certain than the 80 of 100 episodes, were they independent, would make it.
//! let agent = |successes: usize| (0..20).map(|i| f64::from(i < successes)).collect::<Vec<f64>>();
//! let seeds = [20, 20, 20, 0, 20].map(agent);
//! let [low, high] = two_level_bootstrap(&[&seeds], &mut rng::stream(0, "an example"));
//! assert!(low < 0.5 && high == 1.0 && wilson(80, 100)[0] > 0.7);
//! ```

mod improvement;

use rand::RngExt;

use crate::rng::Rng;
pub use improvement::{Time, probability_of_being_earlier, probability_of_improvement};

/// The 97.5 % quantile of the standard normal distribution.
const Z: f64 = 1.959_963_984_540_054;

/// The 95 % Wilson score interval, `[low, high]`, of a success rate: `successes` out of `n` independent trials, like the
/// episodes of one agent. Episodes of several seeds are not independent: see [`two_level_bootstrap`]. `[0, 1]` without trials.
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
/// it over the median for few runs. They pool runs of several tasks; here it is taken over the seeds of one task. With
/// fewer than [`IQM_RUNS`] values it is the mean.
#[doc(alias = "IQM")]
#[doc(alias = "interquartile mean")]
#[doc(alias = "trimmed mean")]
pub fn interquartile_mean(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let drop = sorted.len() / 4;
    mean(&sorted[drop..sorted.len() - drop])
}

/// The fewest values of which the interquartile mean drops any. Below, it is the mean under another name, and its bootstrap
/// interval runs from the smallest value to the largest.
pub const IQM_RUNS: usize = 4;

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

/// How often the bootstraps draw.
const DRAWS: usize = 10_000;

/// The 2.5 % and 97.5 % quantiles of what the bootstrap drew: the smallest values that as large a share does not exceed.
fn percentiles(mut draw: impl FnMut() -> f64) -> [f64; 2] {
    let mut drawn: Vec<f64> = (0..DRAWS).map(|_| draw()).collect();
    drawn.sort_by(f64::total_cmp);
    [0.025, 0.975].map(|q| drawn[(q * DRAWS as f64).ceil() as usize - 1])
}

/// As many of the values as there are, drawn with replacement.
fn resample<'a, T>(values: &'a [T], rng: &mut Rng) -> impl Iterator<Item = &'a T> {
    (0..values.len()).map(move |_| &values[rng.random_range(0..values.len())])
}

/// The 95 % percentile-bootstrap interval, `[low, high]`, of a statistic over runs: its 2.5 % and 97.5 % quantiles over
/// 10,000 samples drawn from `values` with replacement.
///
/// Efron, "Bootstrap methods: another look at the jackknife", Annals of Statistics 7 (1979); for reinforcement learning,
/// Agarwal et al. (NeurIPS 2021). With fewer than ten values the interval is too narrow.
///
/// # Panics
/// Without values.
#[doc(alias = "bootstrap confidence interval")]
#[doc(alias = "confidence interval")]
#[doc(alias = "resampling")]
pub fn bootstrap(values: &[f64], statistic: impl Fn(&[f64]) -> f64, rng: &mut Rng) -> [f64; 2] {
    assert!(!values.is_empty(), "values to resample");
    percentiles(|| statistic(&resample(values, rng).copied().collect::<Vec<f64>>()))
}

/// The 95 % interval, `[low, high]`, of a method's mean over seeds and episodes, by the two-level bootstrap: seeds are drawn
/// with replacement, then episodes within each drawn seed. `tasks[i][k]` holds the outcomes of the episodes of seed `k` on
/// task `i` (1 for a success). Tasks are not drawn; each counts the same, however many episodes it has.
///
/// Davison & Hinkley, "Bootstrap methods and their application" (1997), section 3.8. With five seeds it covers the truth in
/// 85 to 95 % of cases, the less the more the seeds differ, and with fewer seeds less often: [`t_interval`] is the wider
/// companion. With one seed it says nothing about other seeds.
///
/// # Panics
/// If there is no task, a task has no seeds, or a seed no episodes.
#[doc(alias = "hierarchical bootstrap")]
#[doc(alias = "stratified bootstrap")]
#[doc(alias = "confidence interval")]
pub fn two_level_bootstrap(tasks: &[&[Vec<f64>]], rng: &mut Rng) -> [f64; 2] {
    let complete = |seeds: &&[Vec<f64>]| !seeds.is_empty() && seeds.iter().all(|episodes| !episodes.is_empty());
    assert!(!tasks.is_empty() && tasks.iter().all(complete), "tasks with seeds, and seeds with episodes");
    percentiles(|| {
        let mut of_tasks = 0.0;
        for seeds in tasks {
            for _ in 0..seeds.len() {
                let episodes = &seeds[rng.random_range(0..seeds.len())];
                let sum: f64 = resample(episodes, rng).sum();
                of_tasks += sum / episodes.len() as f64 / seeds.len() as f64;
            }
        }
        of_tasks / tasks.len() as f64
    })
}

/// The 95 % t interval, `[low, high]`, of the mean over two or more seeds; `None` for fewer. With few seeds it
/// covers the truth more reliably than a bootstrap, but it may leave the range of possible values.
///
/// Student, "The probable error of a mean", Biometrika 6 (1908).
#[doc(alias = "Student t")]
#[doc(alias = "confidence interval")]
pub fn t_interval(means: &[f64]) -> Option<[f64; 2]> {
    let half = t_quantile(means.len())? * squared_error(means).sqrt();
    Some([mean(means) - half, mean(means) + half])
}

/// The 95 % t interval, `[low, high]`, of the difference of two means over independent seeds, first minus second; `None` if
/// one has fewer than two seeds. Like [`t_interval`], safer than a bootstrap with few seeds.
///
/// Welch, "The generalization of 'Student's' problem", Biometrika 34 (1947). Deviation: the degrees of freedom are the smaller
/// of the two numbers of seeds, less one, which makes the interval wider.
#[doc(alias = "Welch t test")]
#[doc(alias = "confidence interval")]
pub fn welch_interval(first: &[f64], second: &[f64]) -> Option<[f64; 2]> {
    let quantile = t_quantile(first.len())?.max(t_quantile(second.len())?);
    let half = quantile * (squared_error(first) + squared_error(second)).sqrt();
    let difference = mean(first) - mean(second);
    Some([difference - half, difference + half])
}

/// The same for the ratio of two positive means, first over second: the t interval of the difference of their logarithms, whose
/// standard errors are those of the means over the means (the delta method).
#[doc(alias = "confidence interval")]
#[doc(alias = "sample efficiency")]
pub fn ratio_t_interval(first: &[f64], second: &[f64]) -> Option<[f64; 2]> {
    let quantile = t_quantile(first.len())?.max(t_quantile(second.len())?);
    let relative = |values: &[f64]| squared_error(values) / mean(values).powi(2);
    let factor = (quantile * (relative(first) + relative(second)).sqrt()).exp();
    let ratio = mean(first) / mean(second);
    Some([ratio / factor, ratio * factor])
}

/// The 97.5 % quantile of Student's t distribution for the mean of two or more values.
fn t_quantile(values: usize) -> Option<f64> {
    /// For 1 to 11 degrees of freedom.
    const QUANTILES: [f64; 11] =
        [12.7062, 4.3027, 3.1824, 2.7764, 2.5706, 2.4469, 2.3646, 2.3060, 2.2622, 2.2281, 2.2010];
    let freedom = values.checked_sub(1).filter(|freedom| *freedom > 0)?;
    // From twelve on, the first terms of its expansion in their reciprocal (Abramowitz & Stegun 1964, 26.7.5) are exact to 1e-4.
    let (n, z) = (freedom as f64, Z);
    let expansion = z
        + (z.powi(3) + z) / (4.0 * n)
        + (5.0 * z.powi(5) + 16.0 * z.powi(3) + 3.0 * z) / (96.0 * n.powi(2))
        + (3.0 * z.powi(7) + 19.0 * z.powi(5) + 17.0 * z.powi(3) - 15.0 * z) / (384.0 * n.powi(3));
    Some(QUANTILES.get(freedom - 1).copied().unwrap_or(expansion))
}

/// The square of the standard error of a mean.
fn squared_error(values: &[f64]) -> f64 {
    // The deviation divides by n: over n - 1 roots, that is the standard error.
    deviation(values).powi(2) / (values.len() - 1) as f64
}

/// The difference of the means of two methods that met the same starts, first minus second, and its 95 % interval by the
/// crossed ("pigeonhole") bootstrap: the seeds of the first, the seeds of the second, and the starts are drawn independently,
/// with replacement. `first[k][i]` is the outcome of seed `k` from start `i`. Starts that only one of them met are left out.
///
/// Owen, "The pigeonhole bootstrap", Annals of Applied Statistics 1 (2007). Mildly conservative.
///
/// # Panics
/// If one has no seeds, or they have no starts in common.
#[doc(alias = "paired comparison")]
#[doc(alias = "pigeonhole bootstrap")]
pub fn paired_difference(first: &[Vec<f64>], second: &[Vec<f64>], rng: &mut Rng) -> (f64, [f64; 2]) {
    let starts = first.iter().chain(second).map(Vec::len).min().unwrap_or(0);
    assert!(!first.is_empty() && !second.is_empty() && starts > 0, "seeds with starts in common");
    let all: Vec<usize> = (0..starts).collect();
    let mean_of = |seeds: &[&Vec<f64>], starts: &[&usize]| {
        let sum: f64 = seeds.iter().map(|seed| starts.iter().map(|start| seed[**start]).sum::<f64>()).sum();
        sum / (seeds.len() * starts.len()) as f64
    };
    let difference =
        |first: &[&Vec<f64>], second: &[&Vec<f64>], starts: &[&usize]| mean_of(first, starts) - mean_of(second, starts);
    let every: Vec<&usize> = all.iter().collect();
    let observed = difference(&first.iter().collect::<Vec<_>>(), &second.iter().collect::<Vec<_>>(), &every);
    let interval = percentiles(|| {
        let a: Vec<&Vec<f64>> = resample(first, rng).collect();
        let b: Vec<&Vec<f64>> = resample(second, rng).collect();
        difference(&a, &b, &resample(&all, rng).collect::<Vec<_>>())
    });
    (observed, interval)
}

/// The performance profile: for each threshold, the share of runs with a larger value.
///
/// Dolan & Moré, "Benchmarking optimization software with performance profiles", Mathematical Programming 91 (2002); of scores
/// and not of times as in Agarwal et al. (NeurIPS 2021).
///
/// ```
/// use handful::study::statistics::performance_profile;
///
/// assert_eq!(performance_profile(&[0.2, 0.9, 1.0, 0.9], &[0.0, 0.5, 0.9]), [1.0, 0.75, 0.25]);
/// ```
#[doc(alias = "score distribution")]
pub fn performance_profile(values: &[f64], thresholds: &[f64]) -> Vec<f64> {
    let share = |threshold: &f64| values.iter().filter(|value| *value > threshold).count() as f64 / values.len() as f64;
    thresholds.iter().map(share).collect()
}

/// The area under a success curve (trapezoidal rule) up to `budget` environment steps, divided by its length: the mean
/// success rate until then. Methods are compared over the same budget. Not a number for a curve that does not reach it.
#[doc(alias = "AUC")]
#[doc(alias = "learning curve")]
#[doc(alias = "sample efficiency")]
pub fn area_under_curve(steps: &[f64], success: &[f64], budget: f64) -> f64 {
    let (Some(first), Some(last)) = (steps.first(), steps.last()) else { return f64::NAN };
    if *last < budget {
        return f64::NAN;
    }
    let pieces = steps.windows(2).zip(success.windows(2)).filter(|(x, _)| x[0] < budget);
    let area: f64 = pieces
        .map(|(x, y)| {
            let share = ((budget - x[0]) / (x[1] - x[0])).min(1.0);
            share * (x[1] - x[0]) * (y[0] + share * (y[1] - y[0]) / 2.0)
        })
        .sum();
    area / (budget - first)
}

/// The environment steps of the first evaluation at which the success rate is at least `level`, there and at the next evaluation.
/// `None` if there is none: the run is right-censored at its budget. So is one that reaches the level at its last evaluation only.
///
/// What lies between two evaluations is not known, so this is the step *by* which the level is reached. Two evaluations have
/// to agree because each has few episodes: with 20, a policy whose true success rate is 70 % scores at least 80 % with probability
/// 0.24, and a learning curve repeats that test many times.
#[doc(alias = "sample efficiency")]
#[doc(alias = "steps to threshold")]
pub fn steps_to(level: f64, steps: &[f64], success: &[f64]) -> Option<f64> {
    let reached = success.windows(2).position(|pair| pair.iter().all(|rate| *rate >= level));
    reached.map(|i| steps[i])
}

/// Whether the success rate is below `level` again at an evaluation after the step that [`steps_to`] gives.
pub fn falls_below_again(level: f64, steps: &[f64], success: &[f64]) -> bool {
    let Some(by) = steps_to(level, steps, success) else { return false };
    steps.iter().zip(success).any(|(step, rate)| *step > by && *rate < level)
}

/// The median of times of which some are right-censored (`None`), all at the same budget, as Kaplan & Meier (JASA 53, 1958)
/// estimate it; between the middle two for an even number. `None` if it is censored itself.
#[doc(alias = "Kaplan-Meier")]
pub fn censored_median(times: &[Option<f64>]) -> Option<f64> {
    let mut known: Vec<f64> = times.iter().flatten().copied().collect();
    known.sort_by(f64::total_cmp);
    let (low, high) = (known.get(times.len().checked_sub(1)? / 2)?, known.get(times.len() / 2)?);
    Some((low + high) / 2.0)
}

/// The mean of times of which those that are censored (`None`) count as the budget: a lower bound of the mean time.
#[doc(alias = "restricted mean survival time")]
pub fn restricted_mean(times: &[Option<f64>], budget: f64) -> f64 {
    mean(&times.iter().map(|time| time.map_or(budget, |time| time.min(budget))).collect::<Vec<f64>>())
}

/// The ratio of two means, first over second, and its 95 % bootstrap interval over the runs of both: for restricted means of
/// [`steps_to`], how many times as many steps the first method needs.
///
/// # Panics
/// If one has no runs.
#[doc(alias = "sample efficiency")]
pub fn ratio_of_means(first: &[f64], second: &[f64], rng: &mut Rng) -> (f64, [f64; 2]) {
    assert!(!first.is_empty() && !second.is_empty(), "runs of both");
    let interval = percentiles(|| {
        let drawn: f64 = resample(first, rng).sum();
        drawn / first.len() as f64 / (resample(second, rng).sum::<f64>() / second.len() as f64)
    });
    (mean(first) / mean(second), interval)
}
