//! iCEM, refined by gradient ascent.

use serde::{Deserialize, Serialize};

use super::gradient::ascend;
use super::{
    ActionSequences, GradientConfig, Icem, IcemConfig, Iteration, Objective, Plan, PlanObserver, Planner, best,
};
use crate::rng::Rng;
use crate::settings::{must_hold, ranges};

/// Settings of [`Hybrid`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HybridConfig {
    /// The global search.
    pub icem: IcemConfig,
    /// Steps of gradient ascent afterwards.
    pub iterations: usize,
    /// Step size of the ascent (Adam).
    pub rate: f64,
}

impl Default for HybridConfig {
    fn default() -> Self {
        Self { icem: IcemConfig::default(), iterations: 5, rate: 0.05 }
    }
}

ranges!(HybridConfig { icem: Nested, iterations: 1..=10_000, rate: 1e-6..=10.0 });

/// iCEM, refined by gradient ascent: iCEM searches globally, a few steps of gradient ascent refine its plan,
/// and the refined plan is kept only if it is better when both are evaluated again, side by side. (In the spirit of
/// Bharadhwaj et al. 2020, who take gradient steps on the samples of every CEM iteration.)
#[derive(Clone, Debug)]
pub struct Hybrid {
    icem: Icem,
    ascent: GradientConfig,
    action_size: usize,
}

impl Hybrid {
    /// A planner for `action_size`-dimensional actions.
    ///
    /// # Panics
    /// If a setting lies outside its range; [`PlannerConfig::try_build`](super::PlannerConfig::try_build) returns an error instead.
    pub fn new(config: HybridConfig, action_size: usize) -> Self {
        must_hold(&config, "hybrid");
        let HybridConfig { icem, iterations, rate } = config;
        let ascent = GradientConfig { horizon: icem.horizon, starts: 1, iterations, rate, ..GradientConfig::default() };
        Self { icem: Icem::new(icem, action_size), ascent, action_size }
    }
}

impl Planner for Hybrid {
    fn reset(&mut self) {
        self.icem.reset();
    }

    fn plan(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, rng: &mut Rng) -> Plan {
        let mut searched = 0;
        let mut searching = |iteration: &Iteration| {
            searched = iteration.index + 1;
            observer(iteration);
        };
        let found = self.icem.plan(objective, &mut searching, rng);
        let sequence =
            |values: Vec<f32>| ActionSequences { horizon: self.ascent.horizon, actions: self.action_size, values };
        let climbed = ascend(sequence(found.actions.clone()), &self.ascent, objective, &mut |iteration| {
            observer(&Iteration { index: searched + iteration.index, ..*iteration });
        });
        // Both again in one batch, and so with common random numbers.
        let returns = objective.returns(&sequence([found.actions.clone(), climbed.actions.clone()].concat()));
        if best(&returns, 1)[0] == 1 {
            self.icem.adopt(&climbed.actions);
            return Plan { best_return: returns[1], ..climbed };
        }
        found
    }

    fn shift(&mut self, steps: usize) {
        self.icem.shift(steps);
    }
}
