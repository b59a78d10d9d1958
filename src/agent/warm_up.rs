//! Random actions for the warm-up, and correlated exploration noise.

use crate::plan::noise::ColoredNoise;
use crate::rng::Rng;

/// The noise of longer episodes is drawn in several pieces: the time that it takes to draw one is quadratic in its length.
const LONGEST: usize = 1000;

/// Coloured noise, drawn for a whole episode at a time: random actions, or the noise around a policy's actions.
#[derive(Debug)]
pub(super) struct RandomActions {
    noise: ColoredNoise,
    action_size: usize,
    /// What is left of the episode's noise, `[steps left, actions]`.
    queue: Vec<f32>,
}

impl RandomActions {
    /// Noise of exponent `noise_beta` for episodes of `horizon` time steps.
    pub(super) fn new(noise_beta: f64, horizon: usize, action_size: usize) -> Self {
        Self { noise: ColoredNoise::new(noise_beta, horizon.clamp(2, LONGEST)), action_size, queue: Vec::new() }
    }

    /// A new episode begins.
    pub(super) fn reset(&mut self) {
        self.queue.clear();
    }

    /// The next action, each component in [-1, 1].
    pub(super) fn next(&mut self, rng: &mut Rng) -> Vec<f32> {
        self.deviates(rng).into_iter().map(|a| a.clamp(-1.0, 1.0)).collect()
    }

    /// The next time step of the noise, not clamped: each number has a standard deviation of about 1.
    pub(super) fn deviates(&mut self, rng: &mut Rng) -> Vec<f32> {
        if self.queue.is_empty() {
            self.queue = self.noise.sample_actions(self.action_size, rng).iter().map(|a| *a as f32).collect();
        }
        self.queue.drain(..self.action_size).collect()
    }
}
