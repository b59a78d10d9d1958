//! Random shooting.

use serde::{Deserialize, Serialize};

use super::{ActionSequences, Iteration, Objective, Plan, PlanObserver, Planner, best};
use crate::rng::{self, Rng};
use crate::settings::{must_hold, ranges};

/// Settings of [`RandomShooting`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ShootingConfig {
    /// The planning horizon, in actions.
    pub horizon: usize,
    /// Candidates.
    pub population: usize,
}

impl Default for ShootingConfig {
    fn default() -> Self {
        Self { horizon: 15, population: 500 }
    }
}

ranges!(ShootingConfig { horizon: 2..=1000, population: 1..=1_000_000 });

/// Random shooting: the best of many uniform random sequences (as in Nagabandi et al. 2018, section IV.C), the baseline of planners. It
/// keeps nothing from one plan to the next.
#[doc(alias = "random shooting")]
#[derive(Clone, Debug)]
pub struct RandomShooting {
    config: ShootingConfig,
    action_size: usize,
}

impl RandomShooting {
    /// A planner for `action_size`-dimensional actions.
    ///
    /// # Panics
    /// If a setting lies outside its range; [`PlannerConfig::try_build`](super::PlannerConfig::try_build) returns an error instead.
    pub fn new(config: ShootingConfig, action_size: usize) -> Self {
        must_hold(&config, "shooting");
        Self { config, action_size }
    }
}

impl Planner for RandomShooting {
    fn reset(&mut self) {}

    fn plan(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, rng: &mut Rng) -> Plan {
        let mut candidates = ActionSequences::new(self.config.horizon, self.action_size);
        let count = self.config.population * candidates.width();
        candidates.values = (0..count).map(|_| rng::uniform(rng, -1.0, 1.0) as f32).collect();
        let returns = objective.returns(&candidates);
        let winner = best(&returns, 1)[0];
        let actions = candidates.row(winner).to_vec();
        let mean: Vec<f64> = actions.iter().map(|a| f64::from(*a)).collect();
        observer(&Iteration { index: 0, candidates: &candidates, returns: &returns, mean: &mean });
        Plan { actions, best_return: returns[winner] }
    }

    fn shift(&mut self, _steps: usize) {}
}
