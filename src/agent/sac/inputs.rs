//! What the networks read of an observation.

use dfdx::tensor::Cpu;

use crate::env::Spec;
use crate::model::features::LatentFeatures;
use crate::nn::{Tensor3, tensor};

/// Scaled features are clamped to this.
const MAX_INPUT: f32 = 10.0;

/// How observations become the inputs of policy and critics.
pub(super) enum Inputs {
    /// Each feature shifted by its centre and divided by its scale, as the environment declares them.
    Scaled {
        /// Centre of each feature.
        centre: Vec<f32>,
        /// Scale of each feature.
        scale: Vec<f32>,
    },
    /// What latent world models read.
    Latent(LatentFeatures),
}

impl Inputs {
    pub(super) fn new(spec: &Spec, latent: bool) -> Self {
        if latent {
            return Self::Latent(LatentFeatures::new(spec));
        }
        Self::Scaled {
            centre: spec.observation.iter().map(|feature| feature.centre).collect(),
            scale: spec.observation.iter().map(|feature| feature.scale).collect(),
        }
    }

    /// Inputs per observation.
    pub(super) fn width(&self) -> usize {
        match self {
            Self::Scaled { centre, .. } => centre.len(),
            Self::Latent(features) => features.width(),
        }
    }

    /// Coefficients of a group lasso on the inputs, if there is one.
    pub(super) fn lasso(&self, coefficient: f32) -> Option<Vec<f32>> {
        match self {
            Self::Scaled { .. } => None,
            Self::Latent(features) => features.lasso(coefficient),
        }
    }

    /// The inputs `[1, rows, width]` of observations `[rows, observation]`.
    pub(super) fn of(&self, cpu: &Cpu, observations: &[f32]) -> Tensor3 {
        match self {
            Self::Scaled { centre, scale } => {
                let features = centre.iter().zip(scale).cycle();
                // A cube that fell off the table is far away; the networks need not know how far.
                let scaled = observations
                    .iter()
                    .zip(features)
                    .map(|(x, (centre, scale))| ((x - centre) / scale).clamp(-MAX_INPUT, MAX_INPUT));
                tensor(cpu, scaled.collect(), (1, observations.len() / centre.len(), centre.len()))
            }
            Self::Latent(features) => features.encode(cpu, observations),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::env::Feature;
    use crate::nn::{device, values};

    /// A hand at 0.5, an object at 0.7, and the way between them, which the latent features read twice and the object not at all.
    #[test]
    fn inputs_are_scaled_or_those_of_latent_models() {
        let features = [
            Feature::new("hand").around(0.5, 0.1),
            Feature::new("object").around(0.5, 0.001),
            Feature::new("way").around(0.0, 0.1).difference("object", "hand"),
        ];
        let spec = Spec::new("line", features, 1, 10, 0.1);
        let read = |latent| {
            let inputs = Inputs::new(&spec, latent);
            let read = inputs.of(&device(), &[0.5, 0.7, 0.2, 0.4, 0.5, 0.1]);
            assert_eq!(values(&read).len(), 2 * inputs.width());
            values(&read).to_vec()
        };
        let near = |found: &[f32], expected: &[f32]| {
            assert_eq!(found.len(), expected.len());
            assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5), "{found:?}, not {expected:?}");
        };
        // Two metres' worth of scales beyond the table are clamped.
        near(&read(false), &[0.0, 10.0, 2.0, -1.0, 0.0, 1.0]);
        let (symlog, tanh) = (|x: f32| x.signum() * x.abs().ln_1p(), f32::tanh);
        near(&read(true), &[0.0, symlog(2.0), tanh(8.0), symlog(-1.0), symlog(1.0), tanh(4.0)]);
    }
}
