//! Operations that dfdx's tape records as one step each, with gradients of our own.
//!
//! dfdx differentiates; these kernels calculate. A fused layer saves dfdx's separate elementwise
//! passes and uses both cores. Every gradient here is checked against finite differences.

use dfdx::prelude::*;
use dfdx::tensor::{Cpu, CpuError, Gradients};

use super::kernels::{self, Activation, DenseShape};

/// Features of several networks, `[members, batch, features]`; also parameters, see [`dense`].
pub type Tensor3<T = NoneTape> = Tensor<(usize, usize, usize), f32, Cpu, T>;
/// One number for each row of each network, `[members, batch]`.
pub type Tensor2<T = NoneTape> = Tensor<(usize, usize), f32, Cpu, T>;
/// The numbers of a tensor, in row-major order, without copying them.
///
/// # Panics
/// If the tensor is a broadcast or permuted view.
pub fn values<T>(tensor: &Tensor3<T>) -> &[f32] {
    let &(members, batch, features) = tensor.shape();
    let len = members * batch * features;
    if len == 0 {
        return &[];
    }
    let at = |index: [usize; 3]| std::ptr::from_ref(&tensor[index]);
    let (first, last) = (at([0; 3]), at([members - 1, batch - 1, features - 1]));
    let second_row = if batch > 1 { features } else { 0 };
    assert!(
        last == first.wrapping_add(len - 1) && at([0, batch.min(2) - 1, 0]) == first.wrapping_add(second_row),
        "a contiguous tensor"
    );
    // SAFETY: a dfdx tensor on the Cpu keeps its numbers in one `Vec<f32>` (`CachableVec`), which it
    // hands out by element only. The assertion has just shown that the first and the last of `len`
    // elements stand `len - 1` apart in it; the tensor is borrowed as long as the slice.
    unsafe { std::slice::from_raw_parts(first, len) }
}

/// Takes the gradient of an operation's result out of the store; nothing else will need it.
pub(crate) fn take(gradients: &mut Gradients<f32, Cpu>, of: &Tensor3) -> Result<Vec<f32>, CpuError> {
    Ok(std::mem::take(gradients.get_or_alloc_mut(of)?))
}

/// Whether an operation's parameters learn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Learning {
    /// Gradients flow into the parameters and through to the input.
    Trained,
    /// Gradients flow through to the input only.
    Frozen,
}

/// Activates `y`; returns what it was before. The gradient of a ReLU can be told from its result, that of a SiLU cannot.
fn before_activation(y: &mut [f32], activation: Activation) -> Vec<f32> {
    let before = y.to_vec();
    kernels::activate(y, activation);
    before
}

/// `activation(x w + b)`: x `[members or 1, batch, input]`, w `[members, input, output]`,
/// b `[members, 1, output]`. An input of one member is given to all networks.
pub fn dense<T: Tape<f32, Cpu>>(
    x: Tensor3<T>,
    w: &Tensor3,
    b: &Tensor3,
    activation: Activation,
    learning: Learning,
) -> Tensor3<T> {
    let (x, mut tape) = x.split_tape();
    let &(x_members, batch, input) = x.shape();
    let &(members, rows, output) = w.shape();
    assert_eq!(rows, input, "the layer's input size");
    assert_eq!(*b.shape(), (members, 1, output), "the layer's bias");
    assert!(x_members == members || x_members == 1, "one input for each network, or one for all");
    let shape = DenseShape { members, batch, input, output, shared_input: x_members == 1 };

    let mut y = vec![0.0; members * batch * output];
    let keeps = T::OWNS_TAPE && activation == Activation::Silu;
    let fused = if keeps { Activation::Identity } else { activation };
    kernels::dense(&mut y, values(&x), values(w), values(b), shape, fused);
    let before = keeps.then(|| before_activation(&mut y, activation));
    let y = x.device().tensor_from_vec(y, (members, batch, output));

    if T::OWNS_TAPE {
        let (w, b, y) = (w.clone(), b.clone(), y.clone());
        tape.add_backward_op(move |gradients| {
            let mut dz = take(gradients, &y)?;
            kernels::through_activation(&mut dz, before.as_deref().unwrap_or(values(&y)), activation);
            if learning == Learning::Trained {
                let mut db = take(gradients, &b)?;
                let dw = gradients.get_or_alloc_mut(&w)?;
                kernels::dense_parameter_gradients(dw, &mut db, values(&x), &dz, shape);
                **gradients.get_or_alloc_mut(&b)? = db;
            }
            let dx = gradients.get_or_alloc_mut(&x)?;
            kernels::dense_input_gradient(dx, &dz, values(&w), shape);
            Ok(())
        });
    }
    y.put_tape(tape)
}

/// Layer normalisation (Ba et al. 2016) over the last axis, then the activation:
/// `activation(gain (x - mean) / sqrt(variance + 1e-5) + shift)`; gain and shift `[members, 1, features]`.
pub fn layer_norm<T: Tape<f32, Cpu>>(
    x: Tensor3<T>,
    gain: &Tensor3,
    shift: &Tensor3,
    activation: Activation,
    learning: Learning,
) -> Tensor3<T> {
    const EPSILON: f32 = 1e-5;
    let (x, mut tape) = x.split_tape();
    let &(members, batch, features) = x.shape();
    assert_eq!(*gain.shape(), (members, 1, features), "the gain's shape");
    assert_eq!(*shift.shape(), (members, 1, features), "the shift's shape");

    // Normalised values and 1/std are what the gradient needs.
    let mut normal = values(&x).to_vec();
    let mut inverse_std = vec![0.0; members * batch];
    let mut y = vec![0.0; normal.len()];
    let n = features as f32;
    for (row, normal) in normal.chunks_exact_mut(features).enumerate() {
        let of_member = row / batch * features..;
        let (gain, shift) = (&values(gain)[of_member.clone()][..features], &values(shift)[of_member][..features]);
        let y = &mut y[row * features..][..features];
        kernels::vectorised(|| {
            let mean = sum(normal.iter().copied()) / n;
            let variance = sum(normal.iter().map(|x| (x - mean) * (x - mean))) / n;
            let scale = 1.0 / (variance + EPSILON).sqrt();
            inverse_std[row] = scale;
            for (((x, y), gain), shift) in normal.iter_mut().zip(y).zip(gain).zip(shift) {
                *x = (*x - mean) * scale;
                *y = gain * *x + shift;
            }
        });
    }
    let before = before_activation(&mut y, activation);
    let y = x.device().tensor_from_vec(y, (members, batch, features));

    if T::OWNS_TAPE {
        let (gain, shift, y) = (gain.clone(), shift.clone(), y.clone());
        tape.add_backward_op(move |gradients| {
            let mut dz = take(gradients, &y)?;
            kernels::through_activation(&mut dz, &before, activation);
            if learning == Learning::Trained {
                let mut d_gain = take(gradients, &gain)?;
                let d_shift = gradients.get_or_alloc_mut(&shift)?;
                for (row, (dz, x)) in dz.chunks_exact(features).zip(normal.chunks_exact(features)).enumerate() {
                    let of_member = row / batch * features..;
                    let (d_gain, d_shift) =
                        (&mut d_gain[of_member.clone()][..features], &mut d_shift[of_member][..features]);
                    kernels::vectorised(|| {
                        for (((d_gain, d_shift), dz), x) in d_gain.iter_mut().zip(d_shift).zip(dz).zip(x) {
                            *d_gain += dz * x;
                            *d_shift += dz;
                        }
                    });
                }
                **gradients.get_or_alloc_mut(&gain)? = d_gain;
            }
            // dx = (g - mean(g) - x mean(g x)) / std, with g = gain dz and x normalised.
            let dx = gradients.get_or_alloc_mut(&x)?;
            for (row, dx) in dx.chunks_exact_mut(features).enumerate() {
                let gain = &values(&gain)[row / batch * features..][..features];
                let (dz, x) = (&dz[row * features..][..features], &normal[row * features..][..features]);
                kernels::vectorised(|| {
                    let g = || gain.iter().zip(dz).map(|(gain, dz)| gain * dz);
                    let mean_g = sum(g()) / n;
                    let mean_gx = sum(g().zip(x).map(|(g, x)| g * x)) / n;
                    for ((dx, g), x) in dx.iter_mut().zip(g()).zip(x) {
                        *dx += (g - mean_g - x * mean_gx) * inverse_std[row];
                    }
                });
            }
            Ok(())
        });
    }
    y.put_tape(tape)
}

/// A sum in eight lanes, which vectorises (floating-point addition may not be reordered otherwise).
#[inline(always)]
fn sum(values: impl Iterator<Item = f32>) -> f32 {
    let mut lanes = [0.0; 8];
    for (i, value) in values.enumerate() {
        lanes[i % 8] += value;
    }
    lanes.iter().sum()
}

/// Joins two tensors along their last axis: `[members, batch, a]` and `[members, batch, b]`.
pub fn join<T: Tape<f32, Cpu> + Merge<R>, R: Tape<f32, Cpu>>(a: Tensor3<T>, b: Tensor3<R>) -> Tensor3<T> {
    let (a, tape) = a.split_tape();
    let (b, other) = b.split_tape();
    let mut tape = tape.merge(other);
    let (&(members, batch, wide_a), &(_, _, wide_b)) = (a.shape(), b.shape());
    assert_eq!((members, batch), (b.shape().0, b.shape().1), "the same rows on both sides");
    let wide = wide_a + wide_b;
    let mut joined = Vec::with_capacity(members * batch * wide);
    for (a, b) in values(&a).chunks_exact(wide_a).zip(values(&b).chunks_exact(wide_b)) {
        joined.extend_from_slice(a);
        joined.extend_from_slice(b);
    }
    let y = a.device().tensor_from_vec(joined, (members, batch, wide));
    if T::OWNS_TAPE {
        let y = y.clone();
        tape.add_backward_op(move |gradients| {
            let dy = take(gradients, &y)?;
            for (part, from, width) in [(&a, 0, wide_a), (&b, wide_a, wide_b)] {
                let d = gradients.get_or_alloc_mut(part)?;
                for (d, dy) in d.chunks_exact_mut(width).zip(dy.chunks_exact(wide)) {
                    d.iter_mut().zip(&dy[from..from + width]).for_each(|(d, dy)| *d += dy);
                }
            }
            Ok(())
        });
    }
    y.put_tape(tape)
}
