//! The inner loops, on plain slices: matrix products by `gemm`, elementwise work vectorised for the
//! processor at hand by `pulp`. No tape, no tensor; [`super::ops`] puts them on dfdx's tape.
//!
//! Matrices are row-major. Work is split over the cores by network and by rows, never within a sum,
//! so results do not depend on the number of threads.
//!
//! ```
//! use handful::nn::kernels::{Matrix, matmul};
//!
//! let (a, b) = (Matrix::new(&[1.0, 2.0, 3.0, 4.0], 2), Matrix::new(&[1.0, 0.0, 0.0, -1.0], 2));
//! let mut product = [0.0; 4];
//! matmul(&mut product, a, b, false);
//! assert_eq!(product, [1.0, -2.0, 3.0, -4.0]);
//! ```

mod activation;
mod dense;
mod math;
mod matrix;

pub(crate) use activation::activate;
pub use activation::{Activation, add_and_activate, through_activation};
pub use dense::{DenseShape, dense, dense_input_gradient, dense_parameter_gradients};
pub use math::{exp, sigmoid, softplus, symlog, tanh};
pub(crate) use math::{mish, mish_slope, relu, silu, silu_slope};
pub use matrix::{Matrix, matmul, matmul_into};

/// Runs a loop compiled for the widest vectors of this processor, if the compiler inlines it.
pub fn vectorised<R>(work: impl FnOnce() -> R) -> R {
    pulp::Arch::new().dispatch(work)
}

/// Defines a function of slices whose loops are compiled for the widest vectors of this processor. (A long closure is not
/// inlined, and then compiled for the oldest processors.)
macro_rules! vectorised_fn {
    ($(#[$meta:meta])* $vis:vis fn $name:ident($($arg:ident: $ty:ty),* $(,)?) $body:block) => {
        $(#[$meta])*
        $vis fn $name<'a>($($arg: $ty),*) {
            struct Work<'a> {
                $($arg: $ty,)*
                borrows: std::marker::PhantomData<&'a ()>,
            }
            impl<'a> pulp::NullaryFnOnce for Work<'a> {
                type Output = ();
                #[inline(always)]
                fn call(self) {
                    let Work { $($arg,)* .. } = self;
                    $body
                }
            }
            pulp::Arch::new().dispatch(Work { $($arg,)* borrows: std::marker::PhantomData });
        }
    };
}
pub(crate) use vectorised_fn;
