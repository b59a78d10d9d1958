//! Random actions for as long as there is nothing better to go by.

use crate::plan::noise::ColoredNoise;
use crate::rng::Rng;

/// Coloured noise, an episode's worth at a time.
pub(super) struct RandomActions {
    noise: ColoredNoise,
    /// Numbers in an action.
    size: usize,
    /// What is left of the episode's.
    ahead: Vec<f32>,
}

impl RandomActions {
    /// For episodes of so many steps.
    pub(super) fn new(colour: f64, horizon: usize, size: usize) -> Self {
        Self { noise: ColoredNoise::new(colour, horizon.max(2)), size, ahead: Vec::new() }
    }

    /// A new episode begins.
    pub(super) fn reset(&mut self) {
        self.ahead.clear();
    }

    /// The next action, each number in [-1, 1].
    pub(super) fn next(&mut self, rng: &mut Rng) -> Vec<f32> {
        if self.ahead.is_empty() {
            let actions = self.noise.sample_actions(self.size, rng);
            self.ahead = actions.iter().map(|a| a.clamp(-1.0, 1.0) as f32).collect();
        }
        self.ahead.drain(..self.size).collect()
    }
}
