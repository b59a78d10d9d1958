//! Common random numbers: one draw of noise for all candidates.

use rand::seq::SliceRandom;

use super::{Imagination, Propagation};
use crate::rng::{self, Rng};

/// All random numbers of a rollout, shared by all candidates. Since all candidates see the same noise, differences between
/// their returns are due to their actions, and ranking them takes fewer particles.
#[doc(alias = "CRN")]
pub(super) struct CommonRandomNumbers {
    particles: usize,
    /// Standard normal numbers, `[horizon, draws, outputs]`.
    noise: Vec<f32>,
    /// `draws * outputs`
    noise_per_step: usize,
    /// For each time step the particles, grouped by the member that they are assigned to, `[horizon, particles]`.
    order: Vec<usize>,
}

/// [`CommonRandomNumbers`] of one time step.
#[derive(Clone, Copy)]
pub(super) struct StepNoise<'a> {
    /// `[draws, outputs]`
    pub noise: &'a [f32],
    /// The particles, grouped by member.
    pub order: &'a [usize],
}

impl CommonRandomNumbers {
    pub fn draw(imagination: &Imagination, horizon: usize, rng: &mut Rng) -> Self {
        let Imagination { dynamics, propagation, .. } = *imagination;
        let particles = imagination.particles();
        let draws = match propagation {
            Propagation::TsInf | Propagation::Ts1 => {
                assert!(particles.is_multiple_of(dynamics.members()), "particles: a multiple of the members");
                particles
            }
            Propagation::TsInfMean => particles,
            Propagation::Expectation => 0,
            // Once for the step itself, once for resampling.
            Propagation::MomentMatching => 2 * particles,
        };
        let noise_per_step = draws * dynamics.outputs();
        let noise = if propagation == Propagation::TsInfMean {
            vec![0.0; horizon * noise_per_step]
        } else {
            rng::normals(horizon * noise_per_step, rng)
        };
        let mut order = Vec::with_capacity(horizon * particles);
        for _ in 0..horizon {
            let start = order.len();
            order.extend(0..particles);
            if propagation == Propagation::Ts1 {
                order[start..].shuffle(rng);
            }
        }
        Self { particles, noise, noise_per_step, order }
    }

    pub fn at(&self, t: usize) -> StepNoise<'_> {
        StepNoise {
            noise: &self.noise[t * self.noise_per_step..][..self.noise_per_step],
            order: &self.order[t * self.particles..][..self.particles],
        }
    }
}
