//! Gradient shooting.

use serde::{Deserialize, Serialize};

use super::noise::ColoredNoise;
use super::{ActionSequences, Iteration, Objective, Plan, PlanObserver, Planner, best, shifted};
use crate::nn::adam_step;
use crate::rng::Rng;
use crate::settings::{must_hold, ranges};

/// Settings of [`Gradient`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GradientConfig {
    /// The planning horizon, in actions.
    pub horizon: usize,
    /// Sequences that are improved side by side: the last plan (the warm start), and random ones.
    pub starts: usize,
    /// Steps of gradient ascent.
    pub iterations: usize,
    /// Step size (Adam).
    pub rate: f64,
    /// A gradient of a sequence with a larger norm is scaled down to this norm.
    pub max_norm: f64,
    /// Standard deviation of the random starts.
    #[doc(alias = "standard deviation")]
    pub deviation: f64,
    /// Exponent beta of the random starts' noise ([`ColoredNoise`]).
    pub noise_beta: f64,
}

impl Default for GradientConfig {
    fn default() -> Self {
        Self { horizon: 15, starts: 8, iterations: 20, rate: 0.1, max_norm: 10.0, deviation: 0.5, noise_beta: 2.0 }
    }
}

ranges!(GradientConfig {
    horizon: 2..=1000,
    starts: 1..=100_000,
    iterations: 1..=10_000,
    rate: 1e-6..=10.0,
    max_norm: 1e-6..=1e9,
    deviation: 0.0..=100.0,
    noise_beta: 0.0..=10.0,
});

/// Gradient shooting: gradient ascent on the actions themselves, by Adam through the unrolled objective.
///
/// Gradients exploit the errors of a learned model more effectively than sampling does, they are zero or misleading
/// across contacts, and they explode over long horizons; so there are several starts, clipped gradients, and few steps.
#[doc(alias = "gradient shooting")]
#[derive(Clone, Debug)]
pub struct Gradient {
    config: GradientConfig,
    action_size: usize,
    noise: ColoredNoise,
    /// The last plan, `[horizon, actions]`.
    before: Vec<f64>,
}

impl Gradient {
    /// A planner for `action_size`-dimensional actions.
    ///
    /// # Panics
    /// If a setting lies outside its range; [`PlannerConfig::try_build`](super::PlannerConfig::try_build) returns an error instead.
    pub fn new(config: GradientConfig, action_size: usize) -> Self {
        must_hold(&config, "gradient");
        let noise = ColoredNoise::new(config.noise_beta, config.horizon);
        Self { before: vec![0.0; config.horizon * action_size], noise, action_size, config }
    }
}

impl Planner for Gradient {
    fn reset(&mut self) {
        self.before.fill(0.0);
    }

    fn plan(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, rng: &mut Rng) -> Plan {
        let GradientConfig { horizon, starts, deviation, .. } = self.config;
        let mut sequences = ActionSequences::new(horizon, self.action_size);
        sequences.values.extend(self.before.iter().map(|a| *a as f32));
        for _ in 1..starts {
            let noise = self.noise.sample_actions(self.action_size, rng);
            sequences.values.extend(noise.iter().map(|noise| (deviation * noise).clamp(-1.0, 1.0) as f32));
        }
        let plan = ascend(sequences, &self.config, objective, observer);
        self.before = plan.actions.iter().map(|a| f64::from(*a)).collect();
        plan
    }

    fn shift(&mut self, steps: usize) {
        let last = self.before[self.before.len() - self.action_size..].to_vec();
        shifted(&mut self.before, steps, self.action_size, &last);
    }
}

/// Improves the given sequences by gradient ascent (Adam, projected onto the bounds). Returns the best of the sequences
/// that they arrive at and of the best one on the way.
pub(super) fn ascend(
    mut sequences: ActionSequences,
    config: &GradientConfig,
    objective: &mut dyn Objective,
    observer: &mut PlanObserver,
) -> Plan {
    let width = sequences.width();
    let mut moments = vec![[0.0; 2]; sequences.values.len()];
    let mut plan = Plan { actions: sequences.row(0).to_vec(), best_return: f32::NEG_INFINITY };
    for index in 0..config.iterations {
        let (returns, gradients) = objective.gradients(&sequences);
        let winner = best(&returns, 1)[0];
        if returns[winner] > plan.best_return {
            plan = Plan { actions: sequences.row(winner).to_vec(), best_return: returns[winner] };
        }
        let mean: Vec<f64> = plan.actions.iter().map(|a| f64::from(*a)).collect();
        observer(&Iteration { index, candidates: &sequences, returns: &returns, mean: &mean });
        // a <- clip(a + rate * Adam(clipped gradient))
        let corrections = [0.9_f64, 0.999].map(|beta| 1.0 - beta.powi(index as i32 + 1));
        for (row, gradient) in gradients.chunks_exact(width).enumerate() {
            let norm = gradient.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt();
            if !norm.is_finite() {
                continue;
            }
            let clip = (config.max_norm / norm.max(f64::MIN_POSITIVE)).min(1.0);
            for (i, g) in gradient.iter().enumerate() {
                let g = clip * f64::from(*g);
                let unbiased = |[m, v]: [f64; 2]| [m / corrections[0], v / corrections[1]];
                let [m, v] = adam_step(g, moments[row * width + i].each_mut(), [0.1, 0.001], unbiased);
                let step = m / (v.sqrt() + 1e-8);
                let action = &mut sequences.values[row * width + i];
                *action = (f64::from(*action) + config.rate * step).clamp(-1.0, 1.0) as f32;
            }
        }
    }
    // What an objective differentiates need not be all that it measures: evaluate once more.
    sequences.values.extend(plan.actions);
    let returns = objective.returns(&sequences);
    let winner = best(&returns, 1)[0];
    Plan { actions: sequences.row(winner).to_vec(), best_return: returns[winner] }
}
