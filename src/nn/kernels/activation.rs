//! Activations and their gradients, over slices.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::math::{mish, mish_slope, relu, silu, silu_slope};
use super::vectorised_fn;

/// The activation after a layer's affine part.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Activation {
    /// Nothing.
    Identity,
    /// max(0, x).
    Relu,
    /// x sigmoid(x), also called swish. It is smooth, so that a learned model has smooth gradients.
    Silu,
    /// x tanh(ln(1 + exp(x))) (Misra 2020): smooth as SiLU is, TD-MPC2's choice.
    Mish,
}

vectorised_fn! {
    /// `y = activation(y + b)` for rows of y, with b the same in each.
    pub fn add_and_activate(y: &'a mut [f32], b: &'a [f32], activation: Activation) {
        match activation {
            Activation::Identity => for_rows(y, b, |x| x),
            Activation::Relu => for_rows(y, b, relu),
            Activation::Silu => for_rows(y, b, silu),
            Activation::Mish => for_rows(y, b, mish),
        }
    }
}

#[inline(always)]
fn for_rows(y: &mut [f32], b: &[f32], f: impl Fn(f32) -> f32) {
    for row in y.chunks_exact_mut(b.len()) {
        for (y, b) in row.iter_mut().zip(b) {
            *y = f(*y + b);
        }
    }
}

vectorised_fn! {
    pub(super) fn activate_all(y: &'a mut [f32], activation: Activation) {
        activate(y, activation);
    }
}

/// `y = activation(y)`, to be inlined where vectors are in use.
#[inline(always)]
pub(crate) fn activate(y: &mut [f32], activation: Activation) {
    match activation {
        Activation::Identity => {}
        Activation::Relu => y.iter_mut().for_each(|y| *y = relu(*y)),
        Activation::Silu => y.iter_mut().for_each(|y| *y = silu(*y)),
        Activation::Mish => y.iter_mut().for_each(|y| *y = mish(*y)),
    }
}

/// From the gradient of `activation(z)` to the gradient of z, in place. For ReLU, where only the sign of z matters, `z` may be
/// its activation.
pub fn through_activation(dy: &mut [f32], z: &[f32], activation: Activation) {
    if activation != Activation::Identity {
        let chunk = dy.len().div_ceil(rayon::current_num_threads()).max(16_384);
        dy.par_chunks_mut(chunk).zip(z.par_chunks(chunk)).for_each(|(dy, z)| multiply_by_slope(dy, z, activation));
    }
}

vectorised_fn! {
    fn multiply_by_slope(dy: &'a mut [f32], z: &'a [f32], activation: Activation) {
        let pairs = dy.iter_mut().zip(z);
        match activation {
            Activation::Identity => {}
            Activation::Relu => pairs.for_each(|(dy, z)| *dy = if *z > 0.0 { *dy } else { 0.0 }),
            Activation::Silu => pairs.for_each(|(dy, z)| *dy *= silu_slope(*z)),
            Activation::Mish => pairs.for_each(|(dy, z)| *dy *= mish_slope(*z)),
        }
    }
}
