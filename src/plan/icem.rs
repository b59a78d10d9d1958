//! iCEM (Pinneri et al. 2020): the cross-entropy method with coloured noise, elites kept from iteration to
//! iteration and from step to step, and a population that shrinks.
//!
//! Deviations: elites kept within a plan are scored again with the others, since a model may answer with
//! luck; and the plan that is executed is the best of the last iteration, in which the mean takes part.

use serde::{Deserialize, Serialize};

use super::noise::ColoredNoise;
use super::{ActionSequences, Iteration, Objective, Plan, PlanObserver, Planner, as_actions, best, refit, shifted};
use crate::rng::Rng;

/// Settings of [`Icem`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IcemConfig {
    /// Steps that it looks ahead.
    pub horizon: usize,
    /// ActionSequences tried in the first iteration.
    pub population: usize,
    /// Each iteration tries so many times fewer than the one before, but twice the elites at least.
    pub decay: f64,
    /// The best, which shape the next iteration.
    pub elites: usize,
    /// Iterations.
    pub iterations: usize,
    /// Weight of the old mean and variance.
    pub momentum: f64,
    /// Exponent of the noise: 2 to 4 for slow arms, below 1 for fast legs.
    pub noise_beta: f64,
    /// Standard deviation at the start of every plan.
    pub start_deviation: f64,
    /// Share of the elites that is kept.
    pub kept: f64,
    /// Executes the mean of the last distribution rather than the best sequence that was seen, which a model may
    /// have flattered.
    pub execute_mean: bool,
}

impl Default for IcemConfig {
    fn default() -> Self {
        Self {
            horizon: 15,
            population: 64,
            decay: 1.25,
            elites: 10,
            iterations: 3,
            momentum: 0.1,
            noise_beta: 2.5,
            start_deviation: 0.5,
            kept: 0.3,
            execute_mean: false,
        }
    }
}

/// The planner.
pub struct Icem {
    config: IcemConfig,
    actions: usize,
    noise: ColoredNoise,
    mean: Vec<f64>,
    /// Elites of the plan before, best first.
    elites: Vec<Vec<f32>>,
}

impl Icem {
    /// For actions of so many numbers.
    pub fn new(config: IcemConfig, actions: usize) -> Self {
        let noise = ColoredNoise::new(config.noise_beta, config.horizon);
        Self { mean: vec![0.0; config.horizon * actions], elites: Vec::new(), noise, actions, config }
    }

    /// ActionSequences tried in each iteration.
    pub fn sizes(config: &IcemConfig) -> Vec<usize> {
        let next = |size: &usize| Some(((*size as f64 / config.decay) as usize).max(2 * config.elites));
        std::iter::successors(Some(config.population), next).take(config.iterations).collect()
    }

    /// Takes a better plan for the best of its elites.
    pub(super) fn adopt(&mut self, actions: &[f32]) {
        self.elites.insert(0, actions.to_vec());
        self.elites.truncate(self.config.elites);
    }

    fn sample(&self, variance: &[f64], rng: &mut Rng) -> Vec<f32> {
        let noise = self.noise.sample_actions(self.actions, rng);
        let noisy = self.mean.iter().zip(variance).zip(noise).map(|((m, v), noise)| m + v.sqrt() * noise);
        noisy.map(|a| a.clamp(-1.0, 1.0) as f32).collect()
    }
}

impl Planner for Icem {
    fn reset(&mut self) {
        self.mean.fill(0.0);
        self.elites.clear();
    }

    fn plan(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, rng: &mut Rng) -> Plan {
        let config = self.config.clone();
        let kept = (config.kept * config.elites as f64).ceil() as usize;
        let mut variance = vec![config.start_deviation.powi(2); self.mean.len()];
        let mut plan = Plan { actions: Vec::new(), best_return: f32::NEG_INFINITY };
        let sizes = Self::sizes(&config);
        for (index, size) in sizes.iter().enumerate() {
            // Sample: fresh noise, the best of before, and at last the mean itself.
            let mut candidates = ActionSequences::new(config.horizon, self.actions);
            for _ in 0..*size {
                candidates.values.extend(self.sample(&variance, rng));
            }
            self.elites.iter().take(kept).for_each(|elite| candidates.values.extend(elite));
            if index + 1 == sizes.len() {
                candidates.values.extend(self.mean.iter().map(|a| *a as f32));
            }
            // Score.
            let returns = objective.returns(&candidates);
            // Refit.
            let order = best(&returns, config.elites);
            self.elites = order.iter().map(|&i| candidates.row(i).to_vec()).collect();
            let elites: Vec<&[f32]> = self.elites.iter().map(Vec::as_slice).collect();
            refit(&mut self.mean, &mut variance, &elites, config.momentum);
            plan = Plan { actions: self.elites[0].clone(), best_return: returns[order[0]] };
            if config.execute_mean {
                plan.actions = as_actions(&self.mean);
            }
            observer(&Iteration { index, candidates: &candidates, returns: &returns, mean: &self.mean });
        }
        plan
    }

    fn shift(&mut self, steps: usize) {
        let last = self.mean[self.mean.len() - self.actions..].to_vec();
        shifted(&mut self.mean, steps, self.actions, &last);
        for elite in &mut self.elites {
            let last = elite[elite.len() - self.actions..].to_vec();
            shifted(elite, steps, self.actions, &last);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn populations_shrink_as_in_the_paper() {
        let sizes = |population, elites, iterations| {
            Icem::sizes(&IcemConfig { population, elites, iterations, ..IcemConfig::default() })
        };
        assert_eq!(sizes(40, 10, 3), [40, 32, 25]);
        assert_eq!(sizes(100, 10, 5), [100, 80, 64, 51, 40]);
        assert_eq!(sizes(400, 40, 5), [400, 320, 256, 204, 163]);
        assert_eq!(sizes(30, 10, 3), [30, 24, 20]);
    }

    #[test]
    fn memory_moves_on_with_the_world() {
        let mut icem = Icem::new(IcemConfig { horizon: 4, ..IcemConfig::default() }, 1);
        icem.mean = vec![0.1, 0.2, 0.3, 0.4];
        icem.elites = vec![vec![1.0, 0.5, 0.0, -0.5]];
        icem.shift(1);
        assert_eq!(icem.mean, [0.2, 0.3, 0.4, 0.4]);
        assert_eq!(icem.elites, [[0.5, 0.0, -0.5, -0.5]]);
        icem.reset();
        assert!(icem.mean.iter().all(|m| *m == 0.0) && icem.elites.is_empty());
    }
}
