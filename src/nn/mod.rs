//! The learning core on dfdx: layers with runtime shapes, Adam, a squashed Gaussian, weights in and
//! out.
//!
//! Everything is built for several networks at once: a tensor is `[members, batch, features]`. A
//! single network has one member, twin critics have two, an ensemble as many as it likes, and all
//! run through the same code.

mod adam;
pub mod categorical;
pub(crate) mod frozen;
mod gaussian;
pub mod kernels;
pub(crate) mod layers;
mod likelihood;
pub mod norm;
pub mod ops;
pub(crate) mod parameters;
pub mod recurrent;
pub mod tape;
pub mod two_hot;

pub use crate::checkpoint::Weights;
pub(crate) use adam::adam_step;
pub use adam::{Adam, AdamConfig};
pub use categorical::Categorical;
pub use dfdx;
pub use gaussian::{BoundedNormal, SquashedGaussian};
pub use kernels::Activation;
pub use layers::{Init, Mlp, MlpConfig, Norm};
pub(crate) use likelihood::bounded_variance;
pub use likelihood::{LogVarianceBounds, bounded, bounded_nll};
pub use ops::{Grad, Tensor2, Tensor3, values, values_mut};
pub(crate) use parameters::parameters_of_fields;
pub use parameters::{Parameters, copy_parameters, polyak};
pub use recurrent::BlockDense;
pub use tape::TapeOps;
pub use two_hot::SymexpBins;

use dfdx::tensor::{Cache, Cpu, TensorFrom};

/// The device that tensors live on. Its allocation cache is off: buffers made here would only ever
/// enter it.
pub fn device() -> Cpu {
    let cpu = Cpu::default();
    cpu.disable_cache();
    cpu
}

/// A tensor `[members, batch, features]` of the given numbers.
pub fn tensor(cpu: &Cpu, values: Vec<f32>, shape: (usize, usize, usize)) -> Tensor3 {
    cpu.tensor((values, shape))
}
