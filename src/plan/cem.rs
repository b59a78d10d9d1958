//! The cross-entropy method as PETS uses it (Chua et al. 2018): truncated normal samples whose spread shrinks near
//! the bounds, momentum, and a mean that is kept from step to step.

use serde::{Deserialize, Serialize};

use super::{ActionSequences, Iteration, Objective, Plan, PlanObserver, Planner, as_actions, best, refit, shifted};
use crate::rng::{self, Rng};

/// Variance of the search at the start of every plan: (upper - lower)^2 / 16.
const START_VARIANCE: f64 = 0.25;
/// The search ends when no variance is above this.
const CONVERGED: f64 = 1e-3;

/// Settings of [`Cem`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CemConfig {
    /// Steps that it looks ahead.
    pub horizon: usize,
    /// ActionSequences tried in an iteration.
    pub population: usize,
    /// The best of them, which shape the next iteration.
    pub elites: usize,
    /// Iterations.
    pub iterations: usize,
    /// Weight of the old mean and variance.
    pub momentum: f64,
}

impl Default for CemConfig {
    fn default() -> Self {
        Self { horizon: 25, population: 400, elites: 40, iterations: 5, momentum: 0.1 }
    }
}

/// The planner of PETS. It executes the mean of its last distribution, which a lucky sample cannot
/// mislead.
pub struct Cem {
    config: CemConfig,
    actions: usize,
    mean: Vec<f64>,
}

impl Cem {
    /// For actions of so many numbers.
    pub fn new(config: CemConfig, actions: usize) -> Self {
        let mean = vec![0.0; config.horizon * actions];
        Self { config, actions, mean }
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
            // Sample.
            let mut candidates = ActionSequences::new(horizon, self.actions);
            for _ in 0..population {
                let row = self.mean.iter().zip(&variance);
                candidates
                    .values
                    .extend(row.map(|(m, v)| (m + constrained(*v, *m).sqrt() * rng::truncated_normal(rng)) as f32));
            }
            // Score.
            let returns = objective.returns(&candidates);
            // Refit.
            let order = best(&returns, elites);
            best_return = best_return.max(returns[order[0]]);
            let elites: Vec<&[f32]> = order.iter().map(|&i| candidates.row(i)).collect();
            refit(&mut self.mean, &mut variance, &elites, momentum);
            observer(&Iteration { index, candidates: &candidates, returns: &returns, mean: &self.mean });
        }
        Plan { actions: as_actions(&self.mean), best_return }
    }

    fn shift(&mut self, steps: usize) {
        shifted(&mut self.mean, steps, self.actions, &vec![0.0; self.actions]);
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
        assert!((deviation - 0.879_625_66).abs() < 3e-3, "{deviation}");
    }
}
