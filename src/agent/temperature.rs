//! The temperature alpha, tuned automatically so that the policy keeps a target entropy.

use crate::checkpoint::Weights;
use crate::error::Result;
use crate::nn::adam_step;

/// The temperature, with the state of its optimiser (Adam). What is learned is its logarithm.
#[derive(Clone, Copy, Debug)]
pub(in crate::agent) struct Temperature {
    /// ln(alpha).
    pub(in crate::agent) log: f32,
    rate: f32,
    moments: [f32; 2],
    steps: i32,
}

impl Temperature {
    pub(in crate::agent) fn new(start: f32, rate: f32) -> Self {
        Self { log: start.ln(), rate, moments: [0.0; 2], steps: 0 }
    }

    /// alpha.
    pub(in crate::agent) fn alpha(&self) -> f32 {
        self.log.exp()
    }

    /// Adds the state of the optimiser to what is saved.
    pub(in crate::agent) fn save_optimiser(&self, state: &mut Weights) {
        let [first, second] = self.moments;
        state.insert("temperature", vec![first, second, self.steps as f32], [1, 1, 3]);
    }

    /// Takes over what [`Temperature::save_optimiser`] saved.
    pub(in crate::agent) fn load_optimiser(&mut self, state: &Weights) -> Result<()> {
        let &[first, second, steps] = state.get_within("temperature", [1, 1, 3], -1e9..=1e9)? else {
            unreachable!("three numbers")
        };
        self.moments = [first, second];
        self.steps = steps.max(0.0) as i32;
        Ok(())
    }

    /// One step on the temperature loss (Haarnoja et al. 2018, equation 18)
    ///
    /// ```text
    /// J(alpha) = E[-alpha log pi(a|s) - alpha H] = -alpha * entropy_gap,   entropy_gap = E[log pi(a|s)] + H
    /// ```
    ///
    /// where H is the target entropy and `entropy_gap` is how far the entropy is below it: too little entropy raises the
    /// temperature. As in Stable-Baselines3, ln(alpha) stands for alpha: the loss is -ln(alpha) * entropy_gap, and its
    /// gradient with respect to ln(alpha) is -entropy_gap.
    pub(in crate::agent) fn step(&mut self, entropy_gap: f32) {
        let gradient = -entropy_gap;
        self.steps += 1;
        let corrections = [0.9_f32, 0.999].map(|beta| 1.0 - beta.powi(self.steps));
        let unbiased = |[m, v]: [f32; 2]| [m / corrections[0], v / corrections[1]];
        let [m, v] = adam_step(gradient, self.moments.each_mut(), [0.1, 0.001], unbiased);
        self.log -= self.rate * m / (v.sqrt() + 1e-8);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn too_much_entropy_cools() {
        let log_densities = [2.259_301, -0.8, 0.5, 1.0_f32];
        let mean = log_densities.iter().sum::<f32>() / 4.0;
        let mut temperature = Temperature::new(1.0, 3e-4);
        temperature.step(mean - 2.0);
        assert!((temperature.log + 3e-4).abs() < 1e-8, "{}", temperature.log);
        let mut temperature = Temperature::new(1.0, 3e-4);
        temperature.step(3.0 - 2.0);
        assert!(temperature.log > 0.0, "too little entropy heats");
    }
}
