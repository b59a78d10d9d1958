//! Propagation by the moments of the ensemble: expectation and moment matching.

use super::noise::StepNoise;
use super::rollout::Rollout;

/// Mean and variance of the ensemble's mixture of Gaussians, `[rows, outputs]` each.
struct MixtureMoments {
    means: Vec<f32>,
    /// Mean of the squares of the members' means.
    squares: Vec<f32>,
    /// Aleatoric variance: the mean of the members' variances.
    aleatoric: Vec<f32>,
}

impl MixtureMoments {
    /// Epistemic variance: the variance of the members' means.
    fn epistemic(&self, j: usize) -> f32 {
        (self.squares[j] - self.means[j] * self.means[j]).max(0.0)
    }

    fn std(&self, j: usize) -> f32 {
        (self.aleatoric[j] + self.epistemic(j)).sqrt()
    }
}

impl Rollout<'_> {
    /// E, expectation: every row moves by the mean of the members' means.
    pub(super) fn expectation(&mut self) {
        self.mixture_step(None);
    }

    /// MM, moment matching: particles are drawn from the Gaussian with the ensemble's mean and variance ("distribution
    /// sampling"), then replaced by samples from a Gaussian with independent components fitted to each candidate's
    /// particles.
    #[doc(alias = "MM")]
    #[doc(alias = "distribution sampling")]
    pub(super) fn moment_matching(&mut self, noise: StepNoise) {
        let (sampling, resampling) = noise.noise.split_at(self.particles * self.imagination.dynamics.outputs());
        self.mixture_step(Some(sampling));
        self.resample(resampling);
    }

    /// One time step of all rows by the mixture of all members: its mean, or, with standard normal `noise`
    /// (`[particles, outputs]`), a sample of the Gaussian with its mean and variance. Adds the members' disagreement.
    fn mixture_step(&mut self, noise: Option<&[f32]>) {
        let dynamics = self.imagination.dynamics;
        let (width, outputs) = (dynamics.observation_size(), dynamics.outputs());
        let (rows, candidates, particles) = (self.rewards.len(), self.candidates, self.particles);
        let moments = self.mixture_moments();
        let predicted = &dynamics.features.predicted;
        for row in 0..rows {
            let drawn = |j: usize| {
                let deviation =
                    noise.map_or(0.0, |noise| moments.std(j) * noise[row / candidates * outputs + j % outputs]);
                moments.means[j] + deviation
            };
            let next = &mut self.next[row * width..][..width];
            next.copy_from_slice(&self.states[row * width..][..width]);
            let mut variance = 0.0;
            for (j, (i, typical)) in (row * outputs..).zip(dynamics.typical_changes()) {
                next[i] += drawn(j);
                variance += moments.epistemic(j) / (typical * typical);
            }
            dynamics.features.recompute_derived(next);
            if self.alive[row] {
                self.disagreement[row % candidates] += (variance / predicted.len() as f32).sqrt() / particles as f32;
            }
        }
    }

    fn mixture_moments(&mut self) -> MixtureMoments {
        let dynamics = self.imagination.dynamics;
        let (rows, outputs, members) = (self.rewards.len(), dynamics.outputs(), dynamics.members());
        let share = 1.0 / members as f32;
        let [mut means, mut squares, mut aleatoric] = [0; 3].map(|_| vec![0.0; rows * outputs]);
        for member in 0..members {
            let head = dynamics.forward(member, 0..rows, &self.states, &self.actions, &mut self.scratch);
            for (row, head) in head.chunks_exact(2 * outputs).enumerate() {
                let (change, std) = head.split_at(outputs);
                for i in 0..outputs {
                    means[row * outputs + i] += share * change[i];
                    squares[row * outputs + i] += share * change[i] * change[i];
                    aleatoric[row * outputs + i] += share * std[i] * std[i];
                }
            }
        }
        MixtureMoments { means, squares, aleatoric }
    }

    /// Replaces each candidate's particles by samples from a Gaussian with independent components fitted to them, also to those
    /// whose task has terminated. `noise` is `[particles, outputs]`.
    fn resample(&mut self, noise: &[f32]) {
        let dynamics = self.imagination.dynamics;
        let (width, outputs) = (dynamics.observation_size(), dynamics.outputs());
        let (candidates, particles, next) = (self.candidates, self.particles, &mut self.next);
        for c in 0..candidates {
            for (j, &i) in dynamics.features.predicted.iter().enumerate() {
                let at = |p: usize| (p * candidates + c) * width + i;
                let mean = (0..particles).map(|p| next[at(p)]).sum::<f32>() / particles as f32;
                let variance = (0..particles).map(|p| (next[at(p)] - mean).powi(2)).sum::<f32>() / particles as f32;
                (0..particles).for_each(|p| next[at(p)] = mean + variance.sqrt() * noise[p * outputs + j]);
            }
        }
        next.chunks_exact_mut(width).for_each(|next| dynamics.features.recompute_derived(next));
    }
}
