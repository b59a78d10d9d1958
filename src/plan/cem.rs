//! The cross-entropy method.

use serde::{Deserialize, Serialize};

use super::{ActionSequences, Iteration, Objective, Plan, PlanObserver, Planner, as_actions, best, shifted};
use crate::rng::{self, Rng};
use crate::settings::{must_hold, ranges};

/// Variance of the search distribution at the start of every plan: (upper - lower)^2 / 16.
const START_VARIANCE: f64 = 0.25;
/// The search ends when no variance is above this.
const CONVERGED: f64 = 1e-3;

/// Settings of [`Cem`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CemConfig {
    /// The planning horizon, in actions.
    pub horizon: usize,
    /// Candidates in an iteration.
    pub population: usize,
    /// The best candidates, to which the distribution is refitted.
    pub elites: usize,
    /// Iterations, at most.
    pub iterations: usize,
    /// Weight of the old mean and variance in a refit.
    pub momentum: f64,
}

impl Default for CemConfig {
    fn default() -> Self {
        Self { horizon: 25, population: 400, elites: 40, iterations: 5, momentum: 0.1 }
    }
}

ranges!(CemConfig {
    horizon: 2..=1000,
    population: 1..=1_000_000,
    elites: 1..=1_000_000,
    iterations: 1..=10_000,
    momentum: 0.0..=1.0,
}
require elites <= population => "`elites` must not exceed `population`";
);

/// The cross-entropy method (CEM; Rubinstein 1999, de Boer et al. 2005) as PETS uses it for planning (Chua et al. 2018,
/// section 5 and Algorithm 1): sample sequences from a diagonal Gaussian, refit it to the best of them, repeat.
///
/// As in the PETS authors' code: samples are truncated to two standard deviations, the variance is constrained so
/// that they stay within the bounds, the refit is smoothed, and the mean is executed and kept as the next warm start. The best
/// sample is not executed, because its return may be an outlier of the model's noise.
#[doc(alias = "CEM")]
#[doc(alias = "cross-entropy method")]
#[derive(Clone, Debug)]
pub struct Cem {
    config: CemConfig,
    action_size: usize,
    /// Mean of the search distribution, `[horizon, actions]`: the warm start of the next search.
    mean: Vec<f64>,
}

impl Cem {
    /// A planner for `action_size`-dimensional actions.
    ///
    /// # Panics
    /// If a setting lies outside its range; [`PlannerConfig::try_build`](super::PlannerConfig::try_build) returns an error instead.
    pub fn new(config: CemConfig, action_size: usize) -> Self {
        must_hold(&config, "cem");
        let mean = vec![0.0; config.horizon * action_size];
        Self { config, action_size, mean }
    }
}

impl Planner for Cem {
    fn reset(&mut self) {
        self.mean.fill(0.0);
    }

    fn plan(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, rng: &mut Rng) -> Plan {
        let CemConfig { horizon, population, elites, iterations, momentum } = self.config;
        let mut variance = vec![START_VARIANCE; self.mean.len()];
        let mut best_return = f32::NEG_INFINITY;
        for index in 0..iterations {
            if variance.iter().all(|v| *v < CONVERGED) {
                break;
            }
            // Sample: a ~ N(mean, variance), truncated.
            let mut candidates = ActionSequences::new(horizon, self.action_size);
            for _ in 0..population {
                let row = self.mean.iter().zip(&variance);
                candidates
                    .values
                    .extend(row.map(|(m, v)| (m + constrained(*v, *m).sqrt() * rng::truncated_normal(rng)) as f32));
            }
            // Evaluate.
            let returns = objective.returns(&candidates);
            // Refit to the elites.
            let order = best(&returns, elites);
            best_return = best_return.max(returns[order[0]]);
            let elites: Vec<&[f32]> = order.iter().map(|&i| candidates.row(i)).collect();
            refit(&mut self.mean, &mut variance, &elites, momentum);
            observer(&Iteration { index, candidates: &candidates, returns: &returns, mean: &self.mean });
        }
        Plan { actions: as_actions(&self.mean), best_return }
    }

    fn shift(&mut self, steps: usize) {
        shifted(&mut self.mean, steps, self.action_size, &vec![0.0; self.action_size]);
    }
}

/// CEM's refit: mean and variance of the search distribution move to those of the elites (the maximum-likelihood fit, so
/// the population variance), smoothed (de Boer et al. 2005, "smoothed updating"):
///
/// ```text
/// mean     <- momentum mean     + (1 - momentum) mean(elites)
/// variance <- momentum variance + (1 - momentum) var(elites)
/// ```
///
/// `mean`, `variance` and each of the elites are `[horizon, actions]`.
pub(super) fn refit(mean: &mut [f64], variance: &mut [f64], elites: &[&[f32]], momentum: f64) {
    let n = elites.len() as f64;
    for (i, (mean, variance)) in mean.iter_mut().zip(variance).enumerate() {
        let elite_mean = elites.iter().map(|row| f64::from(row[i])).sum::<f64>() / n;
        let elite_variance = elites.iter().map(|row| (f64::from(row[i]) - elite_mean).powi(2)).sum::<f64>() / n;
        *mean = momentum * *mean + (1.0 - momentum) * elite_mean;
        *variance = momentum * *variance + (1.0 - momentum) * elite_variance;
    }
}

/// The variance with which two standard deviations stay within [-1, 1].
fn constrained(variance: f64, mean: f64) -> f64 {
    variance.min(((mean + 1.0) / 2.0).powi(2)).min(((1.0 - mean) / 2.0).powi(2))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elites_are_refitted_with_momentum() {
        let elites: [&[f32]; 3] = [&[0.2, -0.4], &[0.6, 0.0], &[0.4, 0.1]];
        let (mut mean, mut variance) = ([0.0, 0.0], [0.25, 0.25]);
        refit(&mut mean, &mut variance, &elites, 0.1);
        let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-7, "{a}, expected {b}");
        near(mean[0], 0.36);
        near(mean[1], -0.09);
        near(variance[0], 0.049);
        near(variance[1], 0.067);
    }

    #[test]
    fn the_spread_shrinks_near_the_bounds() {
        for (mean, expected) in [(0.0, 0.25), (0.6, 0.04), (-0.95, 0.000_625)] {
            assert!((constrained(0.25, mean) - expected).abs() < 1e-12, "mean {mean}");
        }
    }

    #[test]
    fn truncated_numbers_have_the_right_spread() {
        let mut rng = rng::stream(0, "truncated");
        let n = 200_000;
        let squares: f64 = (0..n).map(|_| rng::truncated_normal(&mut rng).powi(2)).sum();
        let deviation = (squares / f64::from(n)).sqrt();
        // Five standard errors.
        assert!((deviation - 0.879_625_66).abs() < 6e-3, "{deviation}");
    }
}
