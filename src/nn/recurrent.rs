//! DreamerV3's block GRU: a gated recurrent unit whose large matrices are block-diagonal, so that its memory can be wide
//! at little cost.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use super::kernels::{self, Matrix, sigmoid, tanh, vectorised_fn};
use super::layers::Init;
use super::ops::{Tensor3, take, values};
use super::parameters::Parameters;
use crate::rng::Rng;

/// An affine layer whose weight is block-diagonal, and which may add a full layer of a second input:
/// `y = x blockdiag(w) + beside v + bias`.
#[derive(Clone, Debug)]
pub struct BlockDense {
    /// `[blocks, input / blocks, output / blocks]`.
    weight: Tensor3,
    /// `[1, beside, output]`, if there is a second input.
    beside: Option<Tensor3>,
    /// `[1, 1, output]`.
    bias: Tensor3,
}

impl BlockDense {
    /// A new layer. Weights are drawn as for a full layer of `input` and `beside` together, as the reference does.
    ///
    /// # Panics
    /// If the blocks do not divide input and output evenly.
    pub fn new(cpu: &Cpu, blocks: usize, input: usize, beside: usize, output: usize, rng: &mut Rng) -> Self {
        assert!(input.is_multiple_of(blocks) && output.is_multiple_of(blocks), "blocks of equal size");
        let (rows, columns) = (input / blocks, output / blocks);
        let mut weight =
            |count, shape| super::tensor(cpu, Init::Lecun.draw(count, input + blocks * beside, false, rng), shape);
        Self {
            weight: weight(blocks * rows * columns, (blocks, rows, columns)),
            beside: (beside > 0).then(|| weight(beside * output, (1, beside, output))),
            bias: super::tensor(cpu, vec![0.0; output], (1, 1, output)),
        }
    }

    /// The output `[1, batch, output]` for `x` `[1, batch, input]` and the second input `[1, batch, beside]`, whose
    /// gradient goes onto the tape of `x`.
    ///
    /// # Panics
    /// If the sizes are others, or a second input is missing.
    pub fn forward<T: Tape<f32, Cpu>>(&self, x: Tensor3<T>, beside: Option<&Tensor3>) -> Tensor3<T> {
        let (x, mut tape) = x.split_tape();
        let &(blocks, rows, columns) = self.weight.shape();
        let (input, output, batch) = (blocks * rows, blocks * columns, x.shape().1);
        assert_eq!(*x.shape(), (1, batch, input), "the layer's input");
        assert_eq!(beside.is_some(), self.beside.is_some(), "a second input, if the layer has one");

        let mut y: Vec<f32> = values(&self.bias).repeat(batch);
        if let (Some(beside), Some(weight)) = (beside, &self.beside) {
            let wide = beside.shape().2;
            kernels::matmul(&mut y, Matrix::new(values(beside), wide), Matrix::new(values(weight), output), true);
        }
        for (block, weight) in values(&self.weight).chunks_exact(rows * columns).enumerate() {
            let x = Matrix::new(values(&x), input).columns(block * rows, (block + 1) * rows);
            kernels::matmul_into(&mut y[block * columns..], output, x, Matrix::new(weight, columns), true);
        }
        let y = x.device().tensor_from_vec(y, (1, batch, output));

        if T::OWNS_TAPE {
            let (layer, beside, y) = (self.clone(), beside.cloned(), y.clone());
            tape.add_backward_op(move |gradients| {
                let dy = take(gradients, &y)?;
                let whole = Matrix::new(&dy, output);
                let db = gradients.get_or_alloc_mut(&layer.bias)?;
                for row in dy.chunks_exact(output) {
                    db.iter_mut().zip(row).for_each(|(db, dy)| *db += dy);
                }
                if let (Some(beside), Some(weight)) = (&beside, &layer.beside) {
                    let seen = Matrix::new(values(beside), beside.shape().2);
                    kernels::matmul(gradients.get_or_alloc_mut(weight)?, seen.t(), whole, true);
                    let d = gradients.get_or_alloc_mut(beside)?;
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

impl Parameters for BlockDense {
    fn parameters(&self) -> Vec<(String, &Tensor3)> {
        let beside = self.beside.iter().map(|weight| ("beside.weight".into(), weight));
        [("weight".into(), &self.weight), ("bias".into(), &self.bias)].into_iter().chain(beside).collect()
    }

    fn parameters_mut(&mut self) -> Vec<(String, &mut Tensor3)> {
        let beside = self.beside.iter_mut().map(|weight| ("beside.weight".into(), weight));
        [("weight".into(), &mut self.weight), ("bias".into(), &mut self.bias)].into_iter().chain(beside).collect()
    }
}

/// A GRU's step: from the gates `[1, batch, 3 memory]` (in each block: reset, candidate, update) and the memory
/// `[1, batch, memory]` to the new memory
///
/// `u c + (1 - u) h` with `c = tanh(sigmoid(reset) candidate)` and `u = sigmoid(update - 1)`.
///
/// The -1 keeps most of the memory at first. Other than in the textbook's GRU, the reset gate acts on the candidate.
pub fn gru<T: Tape<f32, Cpu>>(gates: Tensor3<T>, memory: &Tensor3, blocks: usize) -> Tensor3<T> {
    let (gates, mut tape) = gates.split_tape();
    let &(_, batch, size) = memory.shape();
    assert_eq!(*gates.shape(), (1, batch, 3 * size), "three gates for each number of the memory");
    let block = size / blocks;
    let mut new = vec![0.0; batch * size];
    gru_forward(&mut new, values(&gates), values(memory), block);
    let new = memory.device().tensor_from_vec(new, (1, batch, size));
    if T::OWNS_TAPE {
        let (memory, new) = (memory.clone(), new.clone());
        tape.add_backward_op(move |gradients| {
            let d_new = take(gradients, &new)?;
            let mut d_gates = take(gradients, &gates)?;
            let d_memory = gradients.get_or_alloc_mut(&memory)?;
            gru_backward(&mut d_gates, d_memory, &d_new, values(&gates), values(&memory), block);
            **gradients.get_or_alloc_mut(&gates)? = d_gates;
            Ok(())
        });
    }
    new.put_tape(tape)
}

/// The three gates of a block.
#[inline(always)]
fn gates_of(block: &[f32]) -> [&[f32]; 3] {
    let size = block.len() / 3;
    [&block[..size], &block[size..2 * size], &block[2 * size..]]
}

vectorised_fn! {
    fn gru_forward(new: &'a mut [f32], gates: &'a [f32], memory: &'a [f32], block: usize) {
        let blocks = new.chunks_exact_mut(block).zip(gates.chunks_exact(3 * block)).zip(memory.chunks_exact(block));
        for ((new, gates), memory) in blocks {
            let [reset, candidate, update] = gates_of(gates);
            for ((((new, h), reset), candidate), update) in new.iter_mut().zip(memory).zip(reset).zip(candidate).zip(update) {
                let c = tanh(sigmoid(*reset) * candidate);
                let u = sigmoid(update - 1.0);
                *new = u * c + (1.0 - u) * h;
            }
        }
    }
}

vectorised_fn! {
    fn gru_backward(
        d_gates: &'a mut [f32],
        d_memory: &'a mut [f32],
        d_new: &'a [f32],
        gates: &'a [f32],
        memory: &'a [f32],
        block: usize,
    ) {
        let inputs = d_new.chunks_exact(block).zip(gates.chunks_exact(3 * block)).zip(memory.chunks_exact(block));
        let outputs = d_gates.chunks_exact_mut(3 * block).zip(d_memory.chunks_exact_mut(block));
        for (((d_new, gates), memory), (d_gates, d_memory)) in inputs.zip(outputs) {
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
                d_update[i] += d * (c - memory[i]) * u * (1.0 - u);
                d_memory[i] += d * (1.0 - u);
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
        let memory = tensor(&cpu, vec![0.2, -0.5], (1, 1, 2));
        let new = gru(gates, &memory, 1);
        for (found, expected) in values(&new).iter().zip([0.323_145_95, 0.373_207_85]) {
            assert!((found - expected).abs() < 1e-6, "{found} {expected}");
        }
    }
}
