//! Which features of an observation an ensemble reads, which it predicts, and which follow from the others.
//!
//! A goal is constant, and the vector from the hand to a cube is the difference of two positions. A network that had to
//! learn such identities would satisfy them only approximately, and would explain motion near a goal by the goal.

use super::Cube;
use crate::env::{Role, Spec};
use crate::error::{Error, Result};
use crate::nn::kernels::tanh;

/// Resolution of the tanh features: a difference counts as near below its scale divided by this.
pub(super) const NEAR: f32 = 4.0;

/// Indices of the features of an observation that networks read and predict.
#[derive(Clone, Debug, PartialEq)]
pub struct FeatureMap {
    /// Features in an observation.
    pub width: usize,
    /// Features that networks read: those of [`Role::Dynamic`], and the differences of two such.
    pub raw: Vec<usize>,
    /// Features that networks read a second time as `tanh(factor x)`, each with its factor: the differences among `raw`.
    /// The tanh magnifies values near zero, where millimetres decide whether the hand touches an object.
    pub near: Vec<(usize, f32)>,
    /// Features that networks predict: those of [`Role::Dynamic`].
    pub predicted: Vec<usize>,
    /// Features that are the difference of two others: `[index, minuend, subtrahend]`.
    pub differences: Vec<[usize; 3]>,
    /// Cubes, whose orientation networks read and predict in its canonical form.
    pub cubes: Vec<Cube>,
}

impl FeatureMap {
    /// The feature map of an environment's observations.
    ///
    /// # Errors
    /// [`Error::Config`] if [`Spec::check`] refuses the specification, or if no feature is dynamic.
    pub fn new(spec: &Spec) -> Result<Self> {
        spec.check()?;
        let features = &spec.observation;
        let (mut raw, mut predicted, mut differences) = (Vec::new(), Vec::new(), Vec::new());
        let mut near = Vec::new();
        let index_of = |name: &str| spec.index_of(name).expect("a checked spec");
        for (i, feature) in features.iter().enumerate() {
            match &feature.role {
                Role::Dynamic => {
                    raw.push(i);
                    predicted.push(i);
                }
                Role::Constant => {}
                Role::Difference { minuend, subtrahend } => {
                    let (a, b) = (index_of(minuend), index_of(subtrahend));
                    differences.push([i, a, b]);
                    if [a, b].iter().all(|part| features[*part].role == Role::Dynamic) {
                        raw.push(i);
                        near.push((i, NEAR / feature.scale));
                    }
                }
            }
        }
        if predicted.is_empty() {
            return Err(Error::Config(format!(
                "{}: a model needs at least one observation feature with the role `Dynamic`",
                spec.name
            )));
        }
        let cubes = Cube::find(spec, &predicted);
        Ok(Self { width: features.len(), raw, near, predicted, differences, cubes })
    }

    /// Network inputs per observation.
    pub fn input_size(&self) -> usize {
        self.raw.len() + self.near.len()
    }

    /// The network inputs of one observation: raw features, then tanh features, in physical units (not normalised).
    pub fn inputs<'a>(&'a self, obs: &'a [f32]) -> impl Iterator<Item = f32> + 'a {
        let raw = self.raw.len();
        self.linear_inputs(obs).enumerate().map(move |(i, x)| if i < raw { x } else { tanh(x) })
    }

    /// [`FeatureMap::inputs`] before the tanh.
    pub(crate) fn linear_inputs<'a>(&'a self, obs: &'a [f32]) -> impl Iterator<Item = f32> + 'a {
        let near = self.near.iter().map(|(i, factor)| factor * obs[*i]);
        self.raw.iter().map(|i| obs[*i]).chain(near)
    }

    /// Rotates each cube in `obs` by one of its symmetries into canonical orientation (see [`Cube`]), and the cubes in
    /// `next_obs`, the observation one time step later, by the same symmetry.
    pub fn canonicalize(&self, obs: &mut [f32], mut next_obs: Option<&mut [f32]>) {
        for cube in &self.cubes {
            let symmetry = cube.to_canonical(obs);
            cube.apply(symmetry, obs);
            if let Some(next_obs) = &mut next_obs {
                cube.apply(symmetry, next_obs);
            }
        }
    }

    /// Undoes [`FeatureMap::canonicalize`] on a prediction: `changes` of the predicted features and their standard
    /// deviations `stds`, predicted for the canonical form of `obs`, become those of `obs` itself.
    pub fn decanonicalize(&self, obs: &[f32], changes: &mut [f32], stds: &mut [f32]) {
        self.cubes.iter().for_each(|cube| cube.decanonicalize(cube.to_canonical(obs), obs, changes, stds));
    }

    /// Recomputes what follows from the predicted features of an observation: differences, and the axes of each cube,
    /// which are orthonormalized (Gram-Schmidt).
    #[doc(alias = "Gram-Schmidt")]
    #[doc(alias = "orthonormalize")]
    pub fn recompute_derived(&self, obs: &mut [f32]) {
        for &[i, a, b] in &self.differences {
            obs[i] = obs[a] - obs[b];
        }
        self.cubes.iter().for_each(|cube| cube.orthonormalize(obs));
    }
}
