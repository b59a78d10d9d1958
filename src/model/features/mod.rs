//! Feature maps: which features of an observation networks read and predict, and on which scale.
//!
//! [`FeatureMap`] serves the ensembles, [`LatentFeatures`] the latent models (autoencoder and RSSM). Both read the
//! [`crate::env::Role`] of each feature: `Dynamic` features are predicted, `Constant` ones (a goal) are not, and a
//! `Difference` is recomputed from the two features that it is the difference of. [`Cube`] reduces the orientation of a
//! cube by its 24 rotational symmetries, [`Distances`] are the lengths of displacement vectors, and [`Normaliser`]
//! standardises inputs and targets.
//!
//! ```
//! use handful::model::features::FeatureMap;
//! use handful::prelude::*;
//!
//! let mut world = Task::Reach.make();
//! let map = FeatureMap::new(world.spec())?;
//! let mut obs = world.reset(0);
//! // The goal is constant, and the vector to it follows from the hand's position, so neither is predicted.
//! assert!(map.predicted.len() < map.width);
//! assert_eq!(map.inputs(&obs).count(), map.input_size());
//! let unchanged = obs.clone();
//! map.recompute_derived(&mut obs);
//! assert!(obs.iter().zip(unchanged).all(|(a, b)| (a - b).abs() < 1e-6));
//! # Ok::<(), handful::error::Error>(())
//! ```

mod cube;
mod distances;
mod feature_map;
mod latent;
mod normaliser;

pub use cube::Cube;
pub use distances::Distances;
pub use feature_map::FeatureMap;
pub use latent::LatentFeatures;
pub use normaliser::Normaliser;

use self::feature_map::NEAR;
use crate::nn::kernels::{symlog, tanh, vectorised_fn};

/// Appends one row of network inputs: `push_scaled` appends scaled features, which `squash` turns into inputs in place.
pub(crate) fn push_row(
    inputs: &mut Vec<f32>,
    push_scaled: impl FnOnce(&mut Vec<f32>),
    squash: impl FnOnce(&mut [f32]),
) {
    let first = inputs.len();
    push_scaled(inputs);
    squash(&mut inputs[first..]);
}

vectorised_fn! {
    /// Turns scaled features into network inputs, in place: `raw` through symlog, `near` through the tanh.
    fn squash(raw: &'a mut [f32], near: &'a mut [f32]) {
        raw.iter_mut().for_each(|x| *x = symlog(*x));
        near.iter_mut().for_each(|x| *x = tanh(NEAR * *x));
    }
}
