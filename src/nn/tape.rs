//! Operations as methods of a tape.
//!
//! dfdx's tensors carry their tape with them, which suits a chain of layers. In a loop over time, where one result enters
//! several others, it is simpler to hand one tape on: `tape.join(&h, &z)` records the operation and returns a plain tensor.
//! With a [`dfdx::tensor::NoneTape`] nothing is recorded.
//!
//! ```
//! use handful::nn::dfdx::prelude::*;
//! use handful::nn::tape::TapeOps;
//! use handful::nn::{device, ops, tensor};
//!
//! let x = tensor(&device(), vec![1.0, 2.0], (1, 2, 1));
//! let target = tensor(&device(), vec![0.0, 0.0], (1, 2, 1));
//! let mut tape = OwnedTape::default();
//! let loss = tape.squared_distance(&x, &target);
//! let mut gradients = ops::total(tape, &[(1.0, loss)]).backward();
//! assert_eq!(**gradients.get_or_alloc_mut(&x)?, [1.0, 2.0]);
//! # Ok::<(), dfdx::tensor::CpuError>(())
//! ```

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use super::kernels::{sigmoid, softplus};
use super::ops::{self, Tensor3};

/// The operations of [`super::ops`] as methods of any tape. Inputs are tensors without a tape, or results of the same tape.
pub trait TapeOps: Tape<f32, Cpu> + Sized {
    /// Records any operation that takes its tape along with its input.
    fn record(&mut self, x: &Tensor3, operation: impl FnOnce(Tensor3<Self>) -> Tensor3<Self>) -> Tensor3 {
        ops::record(self, x, operation)
    }

    /// [`ops::join`]: `[members, batch, a]` and `[members, batch, b]` side by side.
    fn join(&mut self, a: &Tensor3, b: &Tensor3) -> Tensor3 {
        self.record(a, |a| ops::join(a, b.clone()))
    }

    /// [`ops::rows`]: the rows `from..from + count`.
    fn rows(&mut self, x: &Tensor3, from: usize, count: usize) -> Tensor3 {
        self.record(x, |x| ops::rows(x, from, count))
    }

    /// [`ops::stack`]: the rows of all parts, one part below the other.
    fn stack(&mut self, parts: &[Tensor3]) -> Tensor3 {
        let (stacked, tape) = ops::stack(std::mem::take(self), parts).split_tape();
        *self = tape;
        stacked
    }

    /// [`ops::scale_rows`]: each row times a factor of its own.
    fn scale_rows(&mut self, x: &Tensor3, factors: &[f32]) -> Tensor3 {
        self.record(x, |x| ops::scale_rows(x, factors))
    }

    /// [`ops::mean_of_members`]: `[1, batch, features]`.
    fn mean_of_members(&mut self, x: &Tensor3) -> Tensor3 {
        self.record(x, ops::mean_of_members)
    }

    /// [`ops::squared_distance`]: of each row from the same row of `target`, `[members, batch, 1]`.
    fn squared_distance(&mut self, x: &Tensor3, target: &Tensor3) -> Tensor3 {
        self.record(x, |x| ops::squared_distance(x, target))
    }

    /// [`ops::rowwise`]: a loss of each row that knows its own gradient, `[members, batch, 1]`.
    fn rowwise(&mut self, x: &Tensor3, loss: impl FnMut(usize, &[f32], &mut [f32]) -> f32) -> Tensor3 {
        self.record(x, |x| ops::rowwise(x, loss))
    }

    /// The binary cross-entropy between logits `[1, rows, 1]` and the target probability of each row, `softplus(logit) - target logit`:
    /// `[1, rows, 1]`.
    fn binary_cross_entropy(&mut self, logits: &Tensor3, target: impl Fn(usize) -> f32) -> Tensor3 {
        self.rowwise(logits, |row, logit, slope| {
            let target = target(row);
            slope[0] = sigmoid(logit[0]) - target;
            softplus(logit[0]) - target * logit[0]
        })
    }
}

impl<T: Tape<f32, Cpu>> TapeOps for T {}
