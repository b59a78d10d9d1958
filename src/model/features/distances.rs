//! Distances: the lengths of the displacement vectors in an observation.

use std::ops::Range;

use super::feature_map::NEAR;
use crate::env::{Role, Spec};
use crate::nn::kernels::tanh;
use crate::nn::two_hot::symlog;

/// The distances in an observation, such as that from the hand to a cube: the lengths of its displacement vectors.
///
/// The components of a vector are consecutive features of [`Role::Difference`] whose minuends, and whose subtrahends, are
/// consecutive, too. Many rewards depend on distances alone. A network that reads only the components has to learn the
/// length of a vector from the directions in its data, and with one goal in an episode there are few of them.
///
/// As [`LatentFeatures`](super::LatentFeatures) do with differences, networks read each distance, in units of the scale of its
/// components (the largest), through symlog, and a second time through a tanh.
#[derive(Clone, Debug)]
pub struct Distances {
    /// For each vector, the indices of its components, and its scale.
    vectors: Vec<(Range<usize>, f32)>,
}

impl Distances {
    /// The distances in an environment's observations.
    pub fn new(spec: &Spec) -> Self {
        let mut vectors: Vec<(Range<usize>, f32)> = Vec::new();
        // The feature, its minuend and its subtrahend that would be the next component of the last vector.
        let mut next = None;
        for (i, feature) in spec.observation.iter().enumerate() {
            let Role::Difference { minuend, subtrahend } = &feature.role else { continue };
            let (Some(a), Some(b)) = (spec.index_of(minuend), spec.index_of(subtrahend)) else { continue };
            match vectors.last_mut() {
                Some((components, scale)) if next == Some([i, a, b]) => {
                    components.end = i + 1;
                    *scale = scale.max(feature.scale);
                }
                _ => vectors.push((i..i + 1, feature.scale)),
            }
            next = Some([i + 1, a + 1, b + 1]);
        }
        Self { vectors }
    }

    /// Inputs per observation: two for each distance.
    pub fn width(&self) -> usize {
        2 * self.vectors.len()
    }

    /// Appends the inputs of one observation.
    pub fn push(&self, obs: &[f32], inputs: &mut Vec<f32>) {
        for (components, scale) in &self.vectors {
            let square: f32 = obs[components.clone()].iter().map(|x| x * x).sum();
            let distance = square.sqrt() / scale;
            inputs.extend([symlog(distance), tanh(NEAR * distance)]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::env::{Env, Task};

    #[test]
    fn components_of_one_pair_of_places_are_one_vector() {
        let components = |task: Task| -> Vec<Vec<String>> {
            let world = task.make();
            let names = |range: &Range<usize>| world.spec().observation[range.clone()].iter().map(|f| f.name.clone());
            Distances::new(world.spec()).vectors.iter().map(|(range, _)| names(range).collect()).collect()
        };
        let vector = |name: &str| ["x", "y", "z"].map(|axis| format!("{name} {axis}")).to_vec();
        assert_eq!(components(Task::Push), [vector("hand to cube"), vector("cube to goal")]);
        assert_eq!(components(Task::Pendulum), [[""; 0]; 0]);
    }

    #[test]
    fn inputs_are_lengths_in_units_of_the_scale() {
        let mut world = Task::Reach.make();
        let obs = world.reset(0);
        let way = world.spec().index_of("hand to goal x").expect("a difference");
        let (mut inputs, scale) = (Vec::new(), world.spec().observation[way].scale);
        let distances = Distances::new(world.spec());
        distances.push(&obs, &mut inputs);
        let length = obs[way..way + 3].iter().map(|x| x * x).sum::<f32>().sqrt() / scale;
        assert_eq!(inputs.len(), distances.width());
        assert!((inputs[0] - length.ln_1p()).abs() < 1e-6 && (inputs[1] - (NEAR * length).tanh()).abs() < 1e-6);
    }
}
