//! Distances: the lengths of the displacement vectors in an observation.

use std::ops::Range;

use super::{push_row, squash};
use crate::env::{Role, Spec};

/// The distances in an observation, such as that from the hand to a cube: the lengths of its displacement vectors.
///
/// The components of a vector are consecutive features of [`Role::Difference`] with one scale whose minuends, and whose
/// subtrahends, are consecutive, too (and none is both). A difference on its own is a vector of one component. Many rewards
/// depend on distances alone. A network that reads only the components has to learn the length of a vector from the directions
/// in its data, and with one goal in an episode there are few of them.
///
/// As [`LatentFeatures`](super::LatentFeatures) do with differences, the networks of a learned reward read each distance, in
/// units of its scale, through symlog, and a second time through a tanh.
#[derive(Clone, Debug)]
pub struct Distances {
    /// For each vector, the indices of its components, and its scale.
    vectors: Vec<(Range<usize>, f32)>,
}

impl Distances {
    /// The distances in an environment's observations.
    pub fn new(spec: &Spec) -> Self {
        // Minuend and subtrahend of a difference.
        let pair = |i: usize| match &spec.observation[i].role {
            Role::Difference { minuend, subtrahend } => Some([spec.index_of(minuend)?, spec.index_of(subtrahend)?]),
            _ => None,
        };
        let mut vectors: Vec<(Range<usize>, f32)> = Vec::new();
        for (i, feature) in spec.observation.iter().enumerate() {
            let Some([a, b]) = pair(i) else { continue };
            let continues = |components: &Range<usize>, scale: f32| {
                pair(components.start).is_some_and(|[a0, b0]| {
                    let consecutive = i == components.end && [a, b] == [a0, b0].map(|index| index + components.len());
                    // Otherwise a chain of pairs, from A to B and from B to C, would be one vector.
                    consecutive && (a < b0 || b < a0) && scale == feature.scale
                })
            };
            match vectors.last_mut() {
                Some((components, scale)) if continues(components, *scale) => components.end += 1,
                _ => vectors.push((i..i + 1, feature.scale)),
            }
        }
        Self { vectors }
    }

    /// Inputs per observation: two for each distance.
    pub fn width(&self) -> usize {
        2 * self.vectors.len()
    }

    /// Appends the inputs of one observation.
    pub fn push(&self, obs: &[f32], inputs: &mut Vec<f32>) {
        push_row(inputs, |inputs| self.push_scaled(obs, inputs), |row| self.squash(row));
    }

    /// Appends what [`Distances::squash`] turns into the inputs of one observation: each distance in units of its scale, twice.
    pub(crate) fn push_scaled(&self, obs: &[f32], scaled: &mut Vec<f32>) {
        for (components, scale) in &self.vectors {
            let square: f32 = obs[components.clone()].iter().map(|x| x * x).sum();
            scaled.extend([square.sqrt() / scale; 2]);
        }
    }

    /// Turns scaled distances into network inputs, in place, `[width, rows]`.
    pub(crate) fn squash(&self, scaled: &mut [f32]) {
        let rows = scaled.len() / self.width().max(1);
        for distance in scaled.chunks_exact_mut(2 * rows.max(1)) {
            let (raw, near) = distance.split_at_mut(rows);
            squash(raw, near);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::feature_map::NEAR;
    use super::*;
    use crate::env::{Env, Feature, Task};

    fn vectors(spec: &Spec) -> Vec<Vec<&str>> {
        let names = |range: &Range<usize>| spec.observation[range.clone()].iter().map(|f| f.name.as_str()).collect();
        Distances::new(spec).vectors.iter().map(|(range, _)| names(range)).collect()
    }

    #[test]
    fn components_of_one_pair_of_places_are_one_vector() {
        let names = |pairs: &[&str]| -> Vec<[String; 3]> {
            pairs.iter().map(|pair| ["x", "y", "z"].map(|axis| format!("{pair} {axis}"))).collect()
        };
        for (task, pairs) in [
            (Task::Push, &["hand to cube", "cube to goal"][..]),
            (Task::Stack, &["hand to cube", "cube to base"]),
            (Task::Door, &["hand to door", "hand to handle"]),
            (Task::Pendulum, &[]),
        ] {
            assert_eq!(vectors(task.make().spec()), names(pairs), "{}", task.name());
        }
    }

    /// Places declared one after the other, and the ways from each to the next; places and velocities.
    #[test]
    fn adjacent_vectors_stay_apart() {
        let feature = |name: &str| Feature::new(name);
        let places = ["hand x", "hand y", "puck x", "puck y", "goal x", "goal y"].map(feature);
        let way = |name: &str, to: &str, from: &str| feature(name).difference(to, from);
        let ways = [
            way("x to puck", "puck x", "hand x"),
            way("y to puck", "puck y", "hand y"),
            way("x to goal", "goal x", "puck x"),
            way("y to goal", "goal y", "puck y"),
        ];
        let chain = Spec::new("chain", places.into_iter().chain(ways), 2, 50, 0.1);
        assert_eq!(vectors(&chain), [["x to puck", "y to puck"], ["x to goal", "y to goal"]]);

        let moving = [
            feature("x"),
            feature("v").around(0.0, 0.2),
            feature("other x"),
            feature("other v").around(0.0, 0.2),
            way("way", "other x", "x"),
            way("speed", "other v", "v").around(0.0, 0.2),
        ];
        assert_eq!(vectors(&Spec::new("moving", moving, 1, 50, 0.1)), [["way"], ["speed"]]);
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
