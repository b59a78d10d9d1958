//! Neural networks on dfdx: layers with runtime shapes, distributions, losses, optimisers.
//!
//! Everything is built for several networks at once: a tensor is `[members, batch, features]`. A single network has one
//! member, twin critics have two, an ensemble has several, and all run through the same code.
//!
//! ```
//! use handful::nn::dfdx::prelude::*;
//! use handful::nn::{Activation, Adam, AdamConfig, Grad, Init, Mlp, MlpConfig, Norm, device, ops, tensor, values};
//! use handful::rng;
//!
//! // Fits x -> 2 x with two networks at once.
//! let config = MlpConfig {
//!     members: 2,
//!     input: 1,
//!     hidden: vec![16],
//!     output: Some(1),
//!     norm: Norm::None,
//!     activation: Activation::Silu,
//!     init: Init::Uniform,
//! };
//! let mut networks = Mlp::new(&device(), &config, &mut rng::stream(0, "example"));
//! let mut adam = Adam::new(AdamConfig::new(1e-2));
//! let x = tensor(&device(), vec![-1.0, 0.0, 1.0], (1, 3, 1));
//! let target = tensor(&device(), [-2.0, 0.0, 2.0].repeat(2), (2, 3, 1));
//! let mut losses = Vec::new();
//! for _ in 0..200 {
//!     let mut tape = OwnedTape::default();
//!     let y = networks.on(&mut tape, &x, Grad::Params);
//!     let (loss, tape) = ops::squared_distance(y.put_tape(tape), &target).split_tape();
//!     losses.push(ops::mean(&loss));
//!     adam.step(&mut networks, &mut ops::total(tape, &[(1.0, loss)]).backward());
//! }
//! assert!(losses[199] < 0.01 * losses[0]);
//! assert_eq!(values(&networks.forward(x, Grad::Input)).len(), 2 * 3);
//! ```

mod adam;
pub mod categorical;
mod dropout;
pub(crate) mod frozen;
mod gaussian;
pub mod kernels;
mod lasso;
pub(crate) mod layers;
mod likelihood;
pub mod norm;
pub mod ops;
pub(crate) mod parameters;
pub mod recurrent;
pub mod simnorm;
mod symlog_bins;
pub mod tape;
mod tensors;
pub mod two_hot;

pub use crate::checkpoint::Weights;
pub(crate) use adam::adam_step;
pub use adam::{Adam, AdamConfig};
pub use categorical::Categorical;
pub use dfdx;
pub use dropout::dropout;
pub use gaussian::{BoundedNormal, SquashedGaussian};
pub use kernels::Activation;
pub use lasso::GroupLasso;
pub use layers::{Init, Mlp, MlpConfig, Norm};
pub(crate) use likelihood::bounded_variance;
pub use likelihood::{LogVarianceBounds, bounded, bounded_nll};
pub use ops::{Grad, Tensor2, Tensor3, values, values_mut};
pub(crate) use parameters::parameters_of_fields;
pub use parameters::{Parameters, copy_parameters, polyak};
pub use recurrent::BlockDense;
pub use symlog_bins::SymlogBins;
pub use tape::TapeOps;
pub use two_hot::SymexpBins;

use dfdx::tensor::{Cache, Cpu, TensorFrom};

/// The device that tensors live on. Its allocation cache is off: our buffers are made elsewhere, so it would only grow.
pub fn device() -> Cpu {
    let cpu = Cpu::default();
    cpu.disable_cache();
    cpu
}

/// A tensor `[members, batch, features]` of the given numbers, in row-major order.
///
/// # Panics
/// If their count is not that of the shape.
pub fn tensor(cpu: &Cpu, values: Vec<f32>, shape: (usize, usize, usize)) -> Tensor3 {
    cpu.tensor((values, shape))
}
