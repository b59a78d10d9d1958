//! Simplicial normalisation (SimNorm; Hansen et al. 2024, "TD-MPC2", section 3.1): a row is cut into groups, and each group passes
//! through a softmax. Latent states are then bounded and softly sparse, however long a model is rolled out.
//!
//! ```
//! use handful::nn::{device, simnorm::sim_norm, tensor, values};
//!
//! let z = sim_norm(tensor(&device(), vec![2.0, 2.0, 0.0, 100.0], (1, 1, 4)), 2);
//! assert_eq!(values(&z)[..2], [0.5, 0.5]);
//! assert_eq!(values(&z)[3], 1.0);
//! ```

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use super::categorical::softmax;
use super::frozen::{Feature, PANEL};
use super::kernels::{exp, vectorised_fn};
use super::ops::{Tensor3, take, values};

/// The softmax of each `group` of consecutive features: x `[members, batch, features]`.
///
/// # Panics
/// If the features are no whole number of groups.
#[doc(alias = "SimNorm")]
#[doc(alias = "simplicial normalization")]
pub fn sim_norm<T: Tape<f32, Cpu>>(x: Tensor3<T>, group: usize) -> Tensor3<T> {
    let (x, mut tape) = x.split_tape();
    let shape = *x.shape();
    assert!(shape.2.is_multiple_of(group), "whole groups");
    let mut normalised = values(&x).to_vec();
    softmax(&mut normalised, group);
    let y = x.device().tensor_from_vec(normalised, shape);
    if T::OWNS_TAPE {
        let y = y.clone();
        tape.add_backward_op(move |gradients| {
            let dy = take(gradients, &y)?;
            backward(gradients.get_or_alloc_mut(&x)?, &dy, values(&y), group);
            Ok(())
        });
    }
    y.put_tape(tape)
}

vectorised_fn! {
    /// dx += y (dy - sum(y dy)), group by group.
    fn backward(dx: &'a mut [f32], dy: &'a [f32], y: &'a [f32], group: usize) {
        let groups = dx.chunks_exact_mut(group).zip(dy.chunks_exact(group)).zip(y.chunks_exact(group));
        for ((dx, dy), y) in groups {
            let mean: f32 = dy.iter().zip(y).map(|(dy, y)| dy * y).sum();
            for ((dx, dy), y) in dx.iter_mut().zip(dy).zip(y) {
                *dx += y * (dy - mean);
            }
        }
    }
}

vectorised_fn! {
    /// The same for a panel of rows, in place.
    pub(crate) fn sim_norm_panel(panel: &'a mut [Feature], group: usize) {
        for group in panel.chunks_exact_mut(group) {
            let mut highest = [f32::NEG_INFINITY; PANEL];
            for Feature(rows) in group.iter() {
                (0..PANEL).for_each(|i| highest[i] = highest[i].max(rows[i]));
            }
            let mut total = [0.0; PANEL];
            for Feature(rows) in group.iter_mut() {
                for i in 0..PANEL {
                    rows[i] = exp(rows[i] - highest[i]);
                    total[i] += rows[i];
                }
            }
            for Feature(rows) in group {
                (0..PANEL).for_each(|i| rows[i] /= total[i]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{device, tensor};

    #[test]
    fn groups_are_those_of_the_reference() {
        let x = [0.5, -1.0, 2.0, 0.0, 1.0, -0.5, 0.25, 3.0];
        let expected = [0.046_972, 0.010_481, 0.210_514, 0.028_490, 0.077_444, 0.017_280, 0.036_582, 0.572_237];
        let mut panel: Vec<Feature> = x.iter().map(|x| Feature([*x; PANEL])).collect();
        sim_norm_panel(&mut panel, 8);
        let y = sim_norm(tensor(&device(), x.to_vec(), (1, 1, 8)), 8);
        for ((y, panel), expected) in values(&y).iter().zip(panel).zip(expected) {
            assert!((y - expected).abs() < 1e-6 && (panel.0[7] - expected).abs() < 1e-6, "{y}, expected {expected}");
        }
    }
}
