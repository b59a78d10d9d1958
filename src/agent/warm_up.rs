//! Random actions for as long as there is nothing better to go by.

use crate::plan::noise::ColoredNoise;
use crate::rng::Rng;

/// Coloured noise, an episode's worth at a time: actions by itself, or what moves a policy's actions about their mean.
pub(super) struct RandomActions {
    noise: ColoredNoise,
    /// Numbers in an action.
    size: usize,
    /// What is left of the episode's.
    ahead: Vec<f32>,
}

impl RandomActions {
    /// For episodes of so many steps.
    pub(super) fn new(noise_beta: f64, horizon: usize, size: usize) -> Self {
        Self { noise: ColoredNoise::new(noise_beta, horizon.max(2)), size, ahead: Vec::new() }
    }

    /// A new episode begins.
    pub(super) fn reset(&mut self) {
        self.ahead.clear();
    }

    /// The next action, each number in [-1, 1].
    pub(super) fn next(&mut self, rng: &mut Rng) -> Vec<f32> {
        self.deviates(rng).into_iter().map(|a| a.clamp(-1.0, 1.0)).collect()
    }

    /// The same, not clamped: each number by itself is standard normal.
    pub(super) fn deviates(&mut self, rng: &mut Rng) -> Vec<f32> {
        if self.ahead.is_empty() {
            self.ahead = self.noise.sample_actions(self.size, rng).iter().map(|a| *a as f32).collect();
        }
        self.ahead.drain(..self.size).collect()
    }
}
