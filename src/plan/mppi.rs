//! Model predictive path integral control.

use serde::{Deserialize, Serialize};

use super::{ActionSequences, Iteration, Objective, Plan, PlanObserver, Planner, as_actions, shifted, weights};
use crate::rng::{self, Rng};
use crate::settings::{must_hold, ranges};

/// Settings of [`Mppi`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MppiConfig {
    /// The planning horizon, in actions.
    pub horizon: usize,
    /// Candidates in an iteration.
    pub population: usize,
    /// Iterations.
    pub iterations: usize,
    /// Standard deviation of the noise; it does not shrink.
    #[doc(alias = "standard deviation")]
    pub deviation: f64,
    /// Weight (PDDM's beta) of a sampled action against the action before it; 1 does not smooth.
    pub smoothing: f64,
    /// The temperature lambda, in standard deviations of the candidates' returns, so that the scale of rewards does not
    /// matter. PDDM's gamma is its inverse.
    pub temperature: f64,
}

impl Default for MppiConfig {
    fn default() -> Self {
        Self { horizon: 15, population: 200, iterations: 2, deviation: 0.8, smoothing: 0.6, temperature: 0.3 }
    }
}

ranges!(MppiConfig {
    horizon: 2..=1000,
    population: 1..=1_000_000,
    iterations: 1..=10_000,
    deviation: 0.0..=100.0,
    smoothing: 1e-3..=1.0,
    temperature: 1e-6..=1e6,
});

/// Model predictive path integral control (MPPI; Williams et al. 2017) in the form of PDDM (Nagabandi et
/// al. 2019, "Filtering and Reward-Weighted Refinement"): the new mean is the average of all samples, weighted by the
/// exponential of their returns, and the samples are low-pass filtered along the horizon.
///
/// Deviations: several iterations for each plan; the temperature is relative to the standard deviation of the returns;
/// MPPI's term for the control cost of the noise is left out, as in PDDM; and the filter runs over mean plus noise,
/// starting from the action executed last, as in the PDDM authors' code (the paper filters the noise alone), and is clipped to
/// the bounds at each step (in their code, at the end).
#[doc(alias = "MPPI")]
#[doc(alias = "PDDM")]
#[doc(alias = "model predictive path integral")]
#[derive(Clone, Debug)]
pub struct Mppi {
    config: MppiConfig,
    action_size: usize,
    /// `[horizon, actions]`.
    mean: Vec<f64>,
    /// The action executed last.
    before: Vec<f64>,
}

impl Mppi {
    /// A planner for `action_size`-dimensional actions.
    ///
    /// # Panics
    /// If a setting lies outside its range; [`PlannerConfig::try_build`](super::PlannerConfig::try_build) returns an error instead.
    pub fn new(config: MppiConfig, action_size: usize) -> Self {
        must_hold(&config, "mppi");
        Self { mean: vec![0.0; config.horizon * action_size], before: vec![0.0; action_size], action_size, config }
    }

    /// One candidate, low-pass filtered along the horizon: a_t = beta (mean_t + noise_t) + (1 - beta) a_{t-1}.
    fn sample(&self, rng: &mut Rng) -> Vec<f32> {
        let MppiConfig { deviation, smoothing, .. } = self.config;
        let mut before = self.before.clone();
        let mut sequence = Vec::with_capacity(self.mean.len());
        for (i, mean) in self.mean.iter().enumerate() {
            let before = &mut before[i % self.action_size];
            let noisy = mean + deviation * rng::normal(rng);
            *before = (smoothing * noisy + (1.0 - smoothing) * *before).clamp(-1.0, 1.0);
            sequence.push(*before as f32);
        }
        sequence
    }
}

impl Planner for Mppi {
    fn reset(&mut self) {
        self.mean.fill(0.0);
        self.before.fill(0.0);
    }

    fn plan(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, rng: &mut Rng) -> Plan {
        let mut best_return = f32::NEG_INFINITY;
        for index in 0..self.config.iterations {
            // Sample.
            let mut candidates = ActionSequences::new(self.config.horizon, self.action_size);
            for _ in 0..self.config.population {
                candidates.values.extend(self.sample(rng));
            }
            // Evaluate.
            let returns = objective.returns(&candidates);
            best_return = returns.iter().copied().fold(best_return, f32::max);
            // The reward-weighted mean of all candidates.
            let weights = weights(&returns, self.config.temperature * standard_deviation(&returns));
            self.mean.fill(0.0);
            for (row, weight) in candidates.rows().zip(&weights) {
                self.mean.iter_mut().zip(row).for_each(|(m, a)| *m += weight * f64::from(*a));
            }
            observer(&Iteration { index, candidates: &candidates, returns: &returns, mean: &self.mean });
        }
        Plan { actions: as_actions(&self.mean), best_return }
    }

    fn shift(&mut self, steps: usize) {
        let executed = (steps.max(1) - 1) * self.action_size;
        self.before = self.mean[executed..executed + self.action_size].to_vec();
        let last = self.mean[self.mean.len() - self.action_size..].to_vec();
        shifted(&mut self.mean, steps, self.action_size, &last);
    }
}

/// The standard deviation of the finite returns; a little above zero if all are equal.
fn standard_deviation(returns: &[f32]) -> f64 {
    let known: Vec<f64> = returns.iter().filter(|r| r.is_finite()).map(|r| f64::from(*r)).collect();
    let mean = known.iter().sum::<f64>() / known.len().max(1) as f64;
    let variance = known.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / known.len().max(1) as f64;
    variance.sqrt().max(1e-6)
}
