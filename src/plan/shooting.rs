//! Random shooting: the best of many uniform random sequences.

use serde::{Deserialize, Serialize};

use super::{ActionSequences, Iteration, Objective, Plan, PlanObserver, Planner, best};
use crate::rng::{self, Rng};

/// Settings of [`RandomShooting`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ShootingConfig {
    /// Steps that it looks ahead.
    pub horizon: usize,
    /// ActionSequences tried.
    pub population: usize,
}

impl Default for ShootingConfig {
    fn default() -> Self {
        Self { horizon: 15, population: 500 }
    }
}

/// The planner that everything else has to beat. It remembers nothing.
pub struct RandomShooting {
    config: ShootingConfig,
    actions: usize,
}

impl RandomShooting {
    /// For actions of so many numbers.
    pub fn new(config: ShootingConfig, actions: usize) -> Self {
        Self { config, actions }
    }
}

impl Planner for RandomShooting {
    fn reset(&mut self) {}

    fn plan(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, rng: &mut Rng) -> Plan {
        let mut candidates = ActionSequences::new(self.config.horizon, self.actions);
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
