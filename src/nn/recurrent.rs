//! DreamerV3's block GRU: a gated recurrent unit whose large matrices are block-diagonal, so that a wide deterministic state
//! costs little.
//!
//! ```
//! use handful::nn::dfdx::prelude::NoneTape;
//! use handful::nn::{BlockDense, device, recurrent::gru, tensor, values};
//!
//! // A state of 8 numbers in two blocks; the gates read the state and 3 inputs.
//! let mut rng = handful::rng::stream(0, "example");
//! let gates_of = BlockDense::new(&device(), 2, 8, 3, 3 * 8, &mut rng);
//! let h = tensor(&device(), vec![0.0; 8], (1, 1, 8));
//! let input = tensor(&device(), vec![1.0, 0.0, -1.0], (1, 1, 3));
//! let gates = gates_of.on(&mut NoneTape, &h, Some(&input));
//! let next = gru(&mut NoneTape, &gates, &h, 2);
//! assert!(values(&next).iter().all(|h| h.abs() < 1.0));
//! ```

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use super::kernels::{self, Matrix, sigmoid, tanh, vectorised_fn};
use super::layers::Init;
use super::ops::{Tensor3, take, values};
use super::parameters::Parameters;
use super::tape::TapeOps;
use crate::rng::Rng;

/// An affine layer whose weight is block-diagonal, and which may add a full layer of a second input:
/// `y = x blockdiag(w) + second v + bias`.
#[derive(Clone, Debug)]
pub struct BlockDense {
    /// `[blocks, input / blocks, output / blocks]`.
    weight: Tensor3,
    /// `[1, second, output]`, if there is a second input.
    second: Option<Tensor3>,
    /// `[1, 1, output]`.
    bias: Tensor3,
}

impl BlockDense {
    /// A new layer for `input` features, `second` features of a second input (0 for none) and `output` features. Weights are
    /// drawn by [`Init::Lecun`] for the fan-in of a full layer of both inputs, as the published code does.
    ///
    /// # Panics
    /// If the blocks do not divide input and output evenly.
    pub fn new(cpu: &Cpu, blocks: usize, input: usize, second: usize, output: usize, rng: &mut Rng) -> Self {
        assert!(input.is_multiple_of(blocks) && output.is_multiple_of(blocks), "blocks of equal size");
        let (rows, columns) = (input / blocks, output / blocks);
        let mut weight =
            |count, shape| super::tensor(cpu, Init::Lecun.draw(count, input + blocks * second, false, rng), shape);
        Self {
            weight: weight(blocks * rows * columns, (blocks, rows, columns)),
            second: (second > 0).then(|| weight(second * output, (1, second, output))),
            bias: super::tensor(cpu, vec![0.0; output], (1, 1, output)),
        }
    }

    /// The output `[1, batch, output]` for `x` `[1, batch, input]` and the second input `[1, batch, second]`, whose
    /// gradient goes onto the tape of `x`.
    ///
    /// # Panics
    /// If the sizes are others, or a second input is missing.
    pub fn forward<T: Tape<f32, Cpu>>(&self, x: Tensor3<T>, second: Option<&Tensor3>) -> Tensor3<T> {
        let (x, mut tape) = x.split_tape();
        let &(blocks, rows, columns) = self.weight.shape();
        let (input, output, batch) = (blocks * rows, blocks * columns, x.shape().1);
        assert_eq!(*x.shape(), (1, batch, input), "the layer's input");
        assert_eq!(second.is_some(), self.second.is_some(), "a second input, if the layer has one");

        let mut y: Vec<f32> = values(&self.bias).repeat(batch);
        if let (Some(second), Some(weight)) = (second, &self.second) {
            let wide = second.shape().2;
            kernels::matmul(&mut y, Matrix::new(values(second), wide), Matrix::new(values(weight), output), true);
        }
        for (block, weight) in values(&self.weight).chunks_exact(rows * columns).enumerate() {
            let x = Matrix::new(values(&x), input).columns(block * rows, (block + 1) * rows);
            kernels::matmul_into(&mut y[block * columns..], output, x, Matrix::new(weight, columns), true);
        }
        let y = x.device().tensor_from_vec(y, (1, batch, output));

        if T::OWNS_TAPE {
            let (layer, second, y) = (self.clone(), second.cloned(), y.clone());
            tape.add_backward_op(move |gradients| {
                let dy = take(gradients, &y)?;
                let whole = Matrix::new(&dy, output);
                let db = gradients.get_or_alloc_mut(&layer.bias)?;
                for row in dy.chunks_exact(output) {
                    db.iter_mut().zip(row).for_each(|(db, dy)| *db += dy);
                }
                if let (Some(second), Some(weight)) = (&second, &layer.second) {
                    let x = Matrix::new(values(second), second.shape().2);
                    kernels::matmul(gradients.get_or_alloc_mut(weight)?, x.t(), whole, true);
                    let d = gradients.get_or_alloc_mut(second)?;
                    kernels::matmul(d, whole, Matrix::new(values(weight), output).t(), true);
                }
                let mut dw = take(gradients, &layer.weight)?;
                let dx = gradients.get_or_alloc_mut(&x)?;
                let weights = values(&layer.weight).chunks_exact(rows * columns);
                for (block, (dw, weight)) in dw.chunks_exact_mut(rows * columns).zip(weights).enumerate() {
                    let dy = whole.columns(block * columns, (block + 1) * columns);
                    let x = Matrix::new(values(&x), input).columns(block * rows, (block + 1) * rows);
                    kernels::matmul(dw, x.t(), dy, true);
                    let weight = Matrix::new(weight, columns).t();
                    kernels::matmul_into(&mut dx[block * rows..], input, dy, weight, true);
                }
                **gradients.get_or_alloc_mut(&layer.weight)? = dw;
                Ok(())
            });
        }
        y.put_tape(tape)
    }
}

impl BlockDense {
    /// [`BlockDense::forward`] on a tape that is handed on, see [`super::tape`].
    pub fn on<T: Tape<f32, Cpu>>(&self, tape: &mut T, x: &Tensor3, second: Option<&Tensor3>) -> Tensor3 {
        tape.record(x, |x| self.forward(x, second))
    }
}

impl Parameters for BlockDense {
    fn parameters(&self) -> Vec<(String, &Tensor3)> {
        let second = self.second.iter().map(|weight| ("beside.weight".into(), weight));
        [("weight".into(), &self.weight), ("bias".into(), &self.bias)].into_iter().chain(second).collect()
    }

    fn parameters_mut(&mut self) -> Vec<(String, &mut Tensor3)> {
        let second = self.second.iter_mut().map(|weight| ("beside.weight".into(), weight));
        [("weight".into(), &mut self.weight), ("bias".into(), &mut self.bias)].into_iter().chain(second).collect()
    }
}

/// A step of a gated recurrent unit: from the gates `[1, batch, 3 size]` (in each block: reset, candidate, update) and the
/// state h `[1, batch, size]` to the new state `[1, batch, size]`,
///
/// `h' = u c + (1 - u) h` with `c = tanh(sigmoid(reset) candidate)` and `u = sigmoid(update - 1)`.
///
/// The -1 keeps most of the state at initialisation. Other than in the textbook's GRU, the reset gate acts on the
/// candidate (as in the published code of DreamerV3).
#[doc(alias = "gated recurrent unit")]
pub fn gru<T: Tape<f32, Cpu>>(tape: &mut T, gates: &Tensor3, state: &Tensor3, blocks: usize) -> Tensor3 {
    let &(_, batch, size) = state.shape();
    assert_eq!(*gates.shape(), (1, batch, 3 * size), "three gates for each number of the state");
    let block = size / blocks;
    tape.record(gates, |gates| {
        let (gates, mut tape) = gates.split_tape();
        let mut new = vec![0.0; batch * size];
        gru_forward(&mut new, values(&gates), values(state), block);
        let new = state.device().tensor_from_vec(new, (1, batch, size));
        if T::OWNS_TAPE {
            let (state, new) = (state.clone(), new.clone());
            tape.add_backward_op(move |gradients| {
                let d_new = take(gradients, &new)?;
                let mut d_gates = take(gradients, &gates)?;
                let d_state = gradients.get_or_alloc_mut(&state)?;
                gru_backward(&mut d_gates, d_state, &d_new, values(&gates), values(&state), block);
                **gradients.get_or_alloc_mut(&gates)? = d_gates;
                Ok(())
            });
        }
        new.put_tape(tape)
    })
}

/// The three gates of a block.
#[inline(always)]
fn gates_of(block: &[f32]) -> [&[f32]; 3] {
    let size = block.len() / 3;
    [&block[..size], &block[size..2 * size], &block[2 * size..]]
}

vectorised_fn! {
    fn gru_forward(new: &'a mut [f32], gates: &'a [f32], state: &'a [f32], block: usize) {
        let blocks = new.chunks_exact_mut(block).zip(gates.chunks_exact(3 * block)).zip(state.chunks_exact(block));
        for ((new, gates), state) in blocks {
            let [reset, candidate, update] = gates_of(gates);
            for i in 0..block {
                let c = tanh(sigmoid(reset[i]) * candidate[i]);
                let u = sigmoid(update[i] - 1.0);
                new[i] = u * c + (1.0 - u) * state[i];
            }
        }
    }
}

vectorised_fn! {
    fn gru_backward(
        d_gates: &'a mut [f32],
        d_state: &'a mut [f32],
        d_new: &'a [f32],
        gates: &'a [f32],
        state: &'a [f32],
        block: usize,
    ) {
        let inputs = d_new.chunks_exact(block).zip(gates.chunks_exact(3 * block)).zip(state.chunks_exact(block));
        let outputs = d_gates.chunks_exact_mut(3 * block).zip(d_state.chunks_exact_mut(block));
        for (((d_new, gates), state), (d_gates, d_state)) in inputs.zip(outputs) {
            let [reset, candidate, update] = gates_of(gates);
            let (d_reset, rest) = d_gates.split_at_mut(block);
            let (d_candidate, d_update) = rest.split_at_mut(block);
            for i in 0..block {
                let r = sigmoid(reset[i]);
                let c = tanh(r * candidate[i]);
                let u = sigmoid(update[i] - 1.0);
                let d = d_new[i];
                let d_inner = d * u * (1.0 - c * c);
                d_candidate[i] += d_inner * r;
                d_reset[i] += d_inner * candidate[i] * r * (1.0 - r);
                d_update[i] += d * (c - state[i]) * u * (1.0 - u);
                d_state[i] += d * (1.0 - u);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{device, tensor};

    /// Numbers from the reference's formula, in float64.
    #[test]
    fn the_gate_keeps_and_renews() {
        let cpu = device();
        let gates = tensor(&cpu, vec![1.0, -1.0, 0.8, 2.0, 0.5, 3.0], (1, 1, 6));
        let state = tensor(&cpu, vec![0.2, -0.5], (1, 1, 2));
        let new = gru(&mut NoneTape, &gates, &state, 1);
        for (found, expected) in values(&new).iter().zip([0.323_145_95, 0.373_207_85]) {
            assert!((found - expected).abs() < 1e-6, "{found} {expected}");
        }
    }
}
