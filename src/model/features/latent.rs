//! Observations as latent models (autoencoder, RSSM) encode and reconstruct them.

use dfdx::tensor::Cpu;

use super::{Cube, push_row, squash};
use crate::env::{Role, Spec};
use crate::nn::two_hot::symexp;
use crate::nn::{Tensor3, tensor, values};

/// Maps observations to encoder inputs and decoder outputs back to observations: `symlog((x - centre) / scale)` with the
/// centre and scale of each [`crate::env::Feature`] (symlog: Hafner et al. 2023, DreamerV3).
///
/// Positions are given relative to the hand: the minuend of a difference is left out, and reconstructed as the sum of
/// subtrahend and difference. A few hundred episodes contain only a few hundred goals, but the vector to a goal changes
/// at every time step. Differences are read, and reconstructed, a second time through a tanh, which magnifies values
/// near zero, where a centimetre decides whether the hand touches an object. Cubes are given in canonical orientation
/// (see [`Cube`]).
#[derive(Clone, Debug)]
pub struct LatentFeatures {
    centre: Vec<f32>,
    scale: Vec<f32>,
    /// Features that networks read through symlog.
    raw: Vec<usize>,
    /// The differences, read a second time through a tanh.
    near: Vec<usize>,
    /// Features that are left out and reconstructed, in this order: `[index, subtrahend, difference]`.
    derived: Vec<[usize; 3]>,
    /// Cubes, which are read and reconstructed in canonical orientation.
    cubes: Vec<Cube>,
}

impl LatentFeatures {
    /// The features of an environment's observations.
    pub fn new(spec: &Spec) -> Self {
        let features = &spec.observation;
        let (mut near, mut derived) = (Vec::new(), Vec::<[usize; 3]>::new());
        for (i, feature) in features.iter().enumerate() {
            let Role::Difference { minuend, subtrahend } = &feature.role else { continue };
            near.push(i);
            if let (Some(minuend), Some(subtrahend)) = (spec.index_of(minuend), spec.index_of(subtrahend))
                // Each once, and none that another is derived from.
                && derived.iter().all(|[index, subtrahend, _]| ![*index, *subtrahend].contains(&minuend))
            {
                derived.push([minuend, subtrahend, i]);
            }
        }
        let dynamic: Vec<usize> = (0..features.len()).filter(|i| features[*i].role == Role::Dynamic).collect();
        Self {
            cubes: Cube::find(spec, &dynamic),
            centre: features.iter().map(|feature| feature.centre).collect(),
            scale: features.iter().map(|feature| feature.scale).collect(),
            raw: (0..features.len()).filter(|i| derived.iter().all(|[index, ..]| index != i)).collect(),
            near,
            derived,
        }
    }

    /// Encoder inputs, and decoder outputs, per observation.
    pub fn width(&self) -> usize {
        self.raw.len() + self.near.len()
    }

    /// Coefficients of a [group lasso](crate::nn::GroupLasso) on the encoder inputs: 0 for differences. None if nothing is to be
    /// penalised, or no feature is a difference.
    pub(crate) fn lasso(&self, coefficient: f32) -> Option<Vec<f32>> {
        let coefficient_of = |feature| if self.near.contains(feature) { 0.0 } else { coefficient };
        let penalised = coefficient > 0.0 && !self.near.is_empty();
        penalised.then(|| self.raw.iter().chain(&self.near).map(coefficient_of).collect())
    }

    /// Features in an observation.
    pub fn observation_size(&self) -> usize {
        self.centre.len()
    }

    /// Encoder inputs of observations (`[rows, observation]`, physical units): `[1, rows, width]`.
    pub fn encode(&self, cpu: &Cpu, obs: &[f32]) -> Tensor3 {
        let rows = obs.len() / self.observation_size();
        let mut inputs = Vec::with_capacity(rows * self.width());
        obs.chunks_exact(self.observation_size()).for_each(|obs| self.push(obs, &mut inputs));
        tensor(cpu, inputs, (1, rows, self.width()))
    }

    /// Appends the encoder inputs of one observation.
    pub(crate) fn push(&self, obs: &[f32], inputs: &mut Vec<f32>) {
        push_row(inputs, |inputs| self.push_scaled(obs, inputs), |row| self.squash(row));
    }

    /// Appends what [`LatentFeatures::squash`] turns into the encoder inputs of one observation.
    pub(crate) fn push_scaled(&self, obs: &[f32], scaled: &mut Vec<f32>) {
        let mut canonical = Vec::new();
        let obs = if self.cubes.is_empty() {
            obs
        } else {
            canonical.extend_from_slice(obs);
            self.cubes.iter().for_each(|cube| cube.apply(cube.to_canonical(obs), &mut canonical));
            &canonical
        };
        scaled.extend(self.raw.iter().chain(&self.near).map(|i| (obs[*i] - self.centre[*i]) / self.scale[*i]));
    }

    /// Turns scaled features into encoder inputs, in place, `[width, rows]`.
    pub(crate) fn squash(&self, scaled: &mut [f32]) {
        let rows = scaled.len() / self.width();
        let (raw, near) = scaled.split_at_mut(self.raw.len() * rows);
        squash(raw, near);
    }

    /// Observations (`[rows, observation]`, physical units) of decoder outputs, `[1, rows, width]`.
    pub fn decode(&self, outputs: &Tensor3) -> Vec<f32> {
        let size = self.centre.len();
        let mut obs = vec![0.0; values(outputs).len() / self.width() * size];
        for (obs, outputs) in obs.chunks_exact_mut(size).zip(values(outputs).chunks_exact(self.width())) {
            for (&i, output) in self.raw.iter().zip(outputs) {
                obs[i] = symexp(*output) * self.scale[i] + self.centre[i];
            }
            for &[index, subtrahend, difference] in &self.derived {
                obs[index] = obs[subtrahend] + obs[difference];
            }
        }
        obs
    }
}

#[cfg(test)]
mod tests {
    use dfdx::prelude::HasShape;

    use super::*;
    use crate::env::{Env, Task};
    use crate::nn::device;

    #[test]
    fn decoding_inverts_encoding() {
        for task in Task::ALL {
            let mut world = task.make();
            let mut obs = world.reset(3);
            let features = LatentFeatures::new(world.spec());
            features.cubes.iter().for_each(|cube| cube.apply(cube.to_canonical(&obs), &mut obs));
            let encoded = features.encode(&device(), &[obs.clone(), obs.clone()].concat());
            assert_eq!(*encoded.shape(), (1, 2, features.width()));
            let decoded = features.decode(&encoded);
            for (i, (decoded, obs)) in decoded.iter().zip(obs.iter().cycle()).enumerate() {
                let scale = features.scale[i % features.scale.len()];
                assert!((decoded - obs).abs() < 1e-4 * scale, "{} {i}: {decoded}, not {obs}", task.name());
            }
        }
        let push = LatentFeatures::new(Task::Push.make().spec());
        assert_eq!(push.derived.len(), 6, "cube and goal are reconstructed from the differences");
    }
}
