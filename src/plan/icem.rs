//! The improved cross-entropy method.

use serde::{Deserialize, Serialize};

use super::cem::refit;
use super::noise::ColoredNoise;
use super::{ActionSequences, Iteration, Objective, Plan, PlanObserver, Planner, as_actions, best, shifted};
use crate::rng::Rng;
use crate::settings::{must_hold, ranges};

/// Settings of [`Icem`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IcemConfig {
    /// The planning horizon, in actions.
    pub horizon: usize,
    /// Fresh candidates in the first iteration.
    pub population: usize,
    /// The factor gamma by which the population shrinks from iteration to iteration, down to twice the elites.
    pub decay: f64,
    /// The best candidates, to which the distribution is refitted.
    pub elites: usize,
    /// Iterations.
    pub iterations: usize,
    /// Weight of the old mean and variance in a refit.
    pub momentum: f64,
    /// Exponent beta of the noise ([`ColoredNoise`]): 2 to 4 for slow manipulation, below 1 for fast locomotion. 0 is white
    /// noise.
    pub noise_beta: f64,
    /// Standard deviation of the search distribution at the start of every plan; actions span [-1, 1].
    #[doc(alias = "standard deviation")]
    pub start_deviation: f64,
    /// Share of the elites that is kept as candidates of the next iteration, and shifted to the next plan.
    pub kept: f64,
    /// Executes the mean of the last distribution instead of the best candidate of the last iteration, whose predicted
    /// return is the most likely one to be too high.
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

ranges!(IcemConfig {
    horizon: 2..=1000,
    population: 1..=1_000_000,
    decay: 1.0..=1e6,
    elites: 1..=1_000_000,
    iterations: 1..=10_000,
    momentum: 0.0..=1.0,
    noise_beta: 0.0..=10.0,
    start_deviation: 0.0..=100.0,
    kept: 0.0..=1.0,
    execute_mean: Any,
}
require elites <= population => "`elites` must not exceed `population`";
);

/// The improved cross-entropy method (iCEM; Pinneri et al. 2020, Algorithm 1): CEM with
/// - coloured noise of exponent beta along the horizon, clipped to the bounds,
/// - elites that are kept from iteration to iteration, and shifted from plan to plan,
/// - a population that decays: N_i = max(N_{i-1} / gamma, 2K),
/// - the mean among the candidates of the last iteration, and the best candidate as the plan to execute.
///
/// Deviations: kept elites are evaluated again with the other candidates, since the return that a stochastic model
/// predicted for them may have been a favourable draw; a shifted elite repeats its last action instead of drawing a new
/// one; the momentum averages variances, as in CEM, where the authors' code averages standard deviations; the mean comes on
/// top of the samples, where it takes the place of one; `execute_mean` executes the mean, as PETS does.
#[doc(alias = "iCEM")]
#[doc(alias = "cross-entropy method")]
#[derive(Clone, Debug)]
pub struct Icem {
    config: IcemConfig,
    action_size: usize,
    noise: ColoredNoise,
    /// Mean of the search distribution, `[horizon, actions]`.
    mean: Vec<f64>,
    /// Elites of the last iteration, best first, each `[horizon, actions]`.
    elites: Vec<Vec<f32>>,
}

impl Icem {
    /// A planner for `action_size`-dimensional actions.
    ///
    /// # Panics
    /// If a setting lies outside its range; [`PlannerConfig::try_build`](super::PlannerConfig::try_build) returns an error instead.
    pub fn new(config: IcemConfig, action_size: usize) -> Self {
        must_hold(&config, "icem");
        let noise = ColoredNoise::new(config.noise_beta, config.horizon);
        Self { mean: vec![0.0; config.horizon * action_size], elites: Vec::new(), noise, action_size, config }
    }

    /// Fresh candidates in each iteration: N_i = max(N_{i-1} / gamma, 2K).
    pub fn sizes(config: &IcemConfig) -> Vec<usize> {
        let next = |size: &usize| Some(((*size as f64 / config.decay) as usize).max(2 * config.elites));
        std::iter::successors(Some(config.population), next).take(config.iterations).collect()
    }

    /// Puts a better plan before its elites.
    pub(super) fn adopt(&mut self, actions: &[f32]) {
        self.elites.insert(0, actions.to_vec());
        self.elites.truncate(self.config.elites);
    }

    /// One candidate: clip(mean + deviation * coloured noise).
    fn sample(&self, variance: &[f64], rng: &mut Rng) -> Vec<f32> {
        let noise = self.noise.sample_actions(self.action_size, rng);
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
            // Sample: fresh candidates, the kept elites, and in the last iteration the mean.
            let mut candidates = ActionSequences::new(config.horizon, self.action_size);
            for _ in 0..*size {
                candidates.values.extend(self.sample(&variance, rng));
            }
            self.elites.iter().take(kept).for_each(|elite| candidates.values.extend(elite));
            if index + 1 == sizes.len() {
                candidates.values.extend(self.mean.iter().map(|a| *a as f32));
            }
            // Evaluate.
            let returns = objective.returns(&candidates);
            // Refit to the elites.
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
        let last = self.mean[self.mean.len() - self.action_size..].to_vec();
        shifted(&mut self.mean, steps, self.action_size, &last);
        for elite in &mut self.elites {
            let last = elite[elite.len() - self.action_size..].to_vec();
            shifted(elite, steps, self.action_size, &last);
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
