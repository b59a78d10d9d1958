//! What of an observation a model reads, what it predicts, and what follows from the rest.
//!
//! A goal does not move, and the way from the hand to a cube is the difference of two positions: a network that had to
//! learn that would find it true only about, and would take a goal for the reason of what happened near it.

use super::cube::Cube;
use crate::env::{Role, Spec};
use crate::error::{Error, Result};
use crate::nn::kernels::tanh;

/// What counts as near: a difference's scale divided by this.
pub(super) const NEAR: f32 = 4.0;

/// Which numbers of an observation are which.
#[derive(Clone, Debug, PartialEq)]
pub struct FeatureMap {
    /// Numbers in an observation.
    pub width: usize,
    /// Those that networks read: what has a course of its own, and differences of such.
    pub inputs: Vec<usize>,
    /// Those that networks read once more, through a tanh, each with the factor before it: the differences among them. Near
    /// zero it shows as large what is small, and millimetres decide between a hand that touches and one that does not.
    pub near: Vec<(usize, f32)>,
    /// Those that networks predict: what has a course of its own.
    pub predicted: Vec<usize>,
    /// Those that are the difference of two others: `[itself, minuend, subtrahend]`.
    pub differences: Vec<[usize; 3]>,
    /// Cubes, which networks see and foretell as if each lay upright and looked ahead.
    pub cubes: Vec<Cube>,
}

impl FeatureMap {
    /// The layout of an environment's observations.
    ///
    /// # Errors
    /// If a difference names a feature that does not exist or is itself a difference.
    pub fn new(spec: &Spec) -> Result<Self> {
        let features = &spec.observation;
        let (mut inputs, mut predicted, mut differences) = (Vec::new(), Vec::new(), Vec::new());
        let mut near = Vec::new();
        let find = |name: &str| {
            let known = features.iter().position(|f| f.name == name && !matches!(f.role, Role::Difference { .. }));
            known
                .ok_or_else(|| Error::BadSetting(format!("{}: no feature `{name}` to take a difference of", spec.name)))
        };
        for (i, feature) in features.iter().enumerate() {
            match &feature.role {
                Role::Dynamic => {
                    inputs.push(i);
                    predicted.push(i);
                }
                Role::Constant => {}
                Role::Difference { minuend, subtrahend } => {
                    let (a, b) = (find(minuend)?, find(subtrahend)?);
                    differences.push([i, a, b]);
                    if [a, b].iter().all(|part| features[*part].role == Role::Dynamic) {
                        inputs.push(i);
                        near.push((i, NEAR / feature.scale));
                    }
                }
            }
        }
        if predicted.is_empty() {
            return Err(Error::BadSetting(format!("{}: nothing in an observation has a course of its own", spec.name)));
        }
        let cubes = Cube::find(spec, &predicted);
        Ok(Self { width: features.len(), inputs, near, predicted, differences, cubes })
    }

    /// How many numbers networks read of an observation.
    pub fn reads(&self) -> usize {
        self.inputs.len() + self.near.len()
    }

    /// What networks read of an observation.
    pub fn read<'a>(&'a self, obs: &'a [f32]) -> impl Iterator<Item = f32> + 'a {
        let near = self.near.iter().map(|(i, factor)| tanh(factor * obs[*i]));
        self.inputs.iter().map(|i| obs[*i]).chain(near)
    }

    /// Names the axes of each cube so that it lies upright and looks ahead; and those in `after` (what came next) alike.
    pub fn canonicalize(&self, obs: &mut [f32], mut after: Option<&mut [f32]>) {
        for cube in &self.cubes {
            let names = cube.canonicalize(obs);
            cube.rename(names, obs);
            if let Some(after) = &mut after {
                cube.rename(names, after);
            }
        }
    }

    /// Takes what is foretold of an upright `obs` back to the names that it has: changes of all that is predicted, and
    /// their standard deviations.
    pub fn decanonicalize(&self, obs: &[f32], changes: &mut [f32], deviations: &mut [f32]) {
        self.cubes.iter().for_each(|cube| cube.decanonicalize(cube.canonicalize(obs), obs, changes, deviations));
    }

    /// Puts right, in an observation whose predicted numbers are new, what follows from them: differences; and that the axes
    /// of a cube are axes.
    pub fn complete(&self, obs: &mut [f32]) {
        for &[i, a, b] in &self.differences {
            obs[i] = obs[a] - obs[b];
        }
        self.cubes.iter().for_each(|cube| cube.orthonormalize(obs));
    }
}
