//! How probably a run of one method is better than a run of another.

use super::{percentiles, resample};
use crate::rng::Rng;

/// The probability of improvement: that a run of the first method has a larger value than one of the second, over all pairs of
/// runs, a tie counting half; and its 95 % bootstrap interval over the runs of both.
///
/// Agarwal et al. (NeurIPS 2021), who average it over tasks. It is Mann & Whitney's U over the number of pairs.
///
/// # Panics
/// If one has no runs.
#[doc(alias = "Mann-Whitney")]
#[doc(alias = "common language effect size")]
pub fn probability_of_improvement(first: &[f64], second: &[f64], rng: &mut Rng) -> (f64, [f64; 2]) {
    probability_of_winning(first, second, |a, b| a > b, rng)
}

/// When a run reached a level: its environment steps, or those of its budget if it did not.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Time {
    /// By this step.
    Reached(f64),
    /// Right-censored: not before this step. It may have been reached there, if no later evaluation could confirm it.
    Censored(f64),
}

/// The probability that a run of the first method reaches the level by an earlier step than one of the second, over all pairs of
/// runs, and its 95 % bootstrap interval. Ties, and pairs whose order censoring hides, count half: a run that did not reach the level
/// within its budget is later than one that did within the same budget, but may be earlier than one that did after it.
///
/// Gehan, "A generalized Wilcoxon test for comparing arbitrarily singly-censored samples", Biometrika 52 (1965).
///
/// # Panics
/// If one has no runs.
#[doc(alias = "Gehan")]
#[doc(alias = "sample efficiency")]
pub fn probability_of_being_earlier(first: &[Time], second: &[Time], rng: &mut Rng) -> (f64, [f64; 2]) {
    let is_earlier = |a: &Time, b: &Time| match (a, b) {
        (Time::Reached(a), Time::Reached(b)) => a < b,
        (Time::Reached(a), Time::Censored(budget)) => a < budget,
        (Time::Censored(_), _) => false,
    };
    probability_of_winning(first, second, is_earlier, rng)
}

/// The share of pairs that the first wins, a draw counting half, and its bootstrap interval over both.
fn probability_of_winning<T: Copy>(
    first: &[T],
    second: &[T],
    wins: impl Fn(&T, &T) -> bool,
    rng: &mut Rng,
) -> (f64, [f64; 2]) {
    assert!(!first.is_empty() && !second.is_empty(), "runs of both");
    let share = |first: &[T], second: &[T]| {
        let score = |a: &T, b: &T| (1.0 + f64::from(wins(a, b)) - f64::from(wins(b, a))) / 2.0;
        let won = |a: &T| second.iter().map(|b| score(a, b)).sum::<f64>();
        first.iter().map(won).sum::<f64>() / (first.len() * second.len()) as f64
    };
    let interval = percentiles(|| {
        let drawn = |values: &[T], rng: &mut Rng| resample(values, rng).copied().collect::<Vec<T>>();
        share(&drawn(first, rng), &drawn(second, rng))
    });
    (share(first, second), interval)
}
