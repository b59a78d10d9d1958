//! iCEM finds the right valley, gradients its bottom: a few steps of ascent from the plan that iCEM found, kept only
//! if a fresh evaluation agrees that it became better.

use serde::{Deserialize, Serialize};

use super::gradient::ascend;
use super::{ActionSequences, GradientConfig, Icem, IcemConfig, Objective, Plan, PlanObserver, Planner};
use crate::rng::Rng;

/// Settings of [`Hybrid`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HybridConfig {
    /// The search.
    pub icem: IcemConfig,
    /// Steps of ascent afterwards.
    pub iterations: usize,
    /// Their size.
    pub rate: f64,
}

impl Default for HybridConfig {
    fn default() -> Self {
        Self { icem: IcemConfig::default(), iterations: 5, rate: 0.05 }
    }
}

/// The planner.
pub struct Hybrid {
    icem: Icem,
    ascent: GradientConfig,
    actions: usize,
}

impl Hybrid {
    /// For actions of so many numbers.
    pub fn new(config: HybridConfig, actions: usize) -> Self {
        let HybridConfig { icem, iterations, rate } = config;
        let ascent = GradientConfig { horizon: icem.horizon, starts: 1, iterations, rate, ..GradientConfig::default() };
        Self { icem: Icem::new(icem, actions), ascent, actions }
    }
}

impl Planner for Hybrid {
    fn reset(&mut self) {
        self.icem.reset();
    }

    fn plan(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, rng: &mut Rng) -> Plan {
        let found = self.icem.plan(objective, observer, rng);
        let sequence =
            |values: Vec<f32>| ActionSequences { horizon: self.ascent.horizon, actions: self.actions, values };
        let climbed = ascend(sequence(found.actions.clone()), &self.ascent, objective, observer);
        // Both again, under the same luck.
        let returns = objective.returns(&sequence([found.actions.clone(), climbed.actions.clone()].concat()));
        if returns[1] > returns[0] {
            self.icem.adopt(&climbed.actions);
            return Plan { best_return: returns[1], ..climbed };
        }
        found
    }

    fn shift(&mut self, steps: usize) {
        self.icem.shift(steps);
    }
}
