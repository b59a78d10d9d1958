//! Observations as latent models see and tell them.

use dfdx::tensor::Cpu;

use crate::env::{Role, Spec};
use crate::nn::two_hot::{symexp, symlog};
use crate::nn::{Tensor3, tensor, values};

/// Shifts and scales observations by the world's own [`crate::env::Feature`]s, and tames large numbers ([`symlog`]); and
/// back.
#[derive(Clone, Debug)]
pub struct View {
    centre: Vec<f32>,
    scale: Vec<f32>,
    /// The numbers that have a course of their own.
    lively: Vec<usize>,
}

impl View {
    /// The view of a world's observations.
    pub fn new(spec: &Spec) -> Self {
        Self {
            centre: spec.observation.iter().map(|feature| feature.centre).collect(),
            scale: spec.observation.iter().map(|feature| feature.scale).collect(),
            lively: (0..spec.observation_size()).filter(|i| spec.observation[*i].role == Role::State).collect(),
        }
    }

    /// Rows of observations as networks see them, `[1, rows, observation]`.
    pub fn seen(&self, cpu: &Cpu, obs: &[f32]) -> Tensor3 {
        let size = self.centre.len();
        let mut seen = Vec::with_capacity(obs.len());
        for row in obs.chunks_exact(size) {
            let features = row.iter().zip(self.centre.iter().zip(&self.scale));
            seen.extend(features.map(|(x, (centre, scale))| symlog((x - centre) / scale)));
        }
        tensor(cpu, seen, (1, obs.len() / size, size))
    }

    /// What networks tell, in physical units, row by row.
    pub fn told(&self, told: &Tensor3) -> Vec<f32> {
        let mut obs = Vec::with_capacity(values(told).len());
        for row in values(told).chunks_exact(self.centre.len()) {
            let features = row.iter().zip(self.centre.iter().zip(&self.scale));
            obs.extend(features.map(|(x, (centre, scale))| symexp(*x) * scale + centre));
        }
        obs
    }

    /// The numbers that a model is judged by, with what is a noticeable change of each.
    pub fn lively(&self) -> Vec<(usize, f32)> {
        self.lively.iter().map(|&i| (i, 0.1 * self.scale[i])).collect()
    }
}
