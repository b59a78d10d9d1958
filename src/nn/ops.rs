//! Operations that dfdx's tape records as one step each, with gradients of our own.
//!
//! dfdx differentiates; these kernels calculate. A fused layer saves dfdx's separate elementwise
//! passes and uses all cores. Every gradient here is checked against finite differences.
//!
//! ```
//! use handful::nn::dfdx::prelude::*;
//! use handful::nn::{Activation, Grad, device, ops, tensor, values};
//!
//! // relu(x w + b), differentiated with respect to w and b but not to x.
//! let x = tensor(&device(), vec![1.0, 2.0], (1, 1, 2));
//! let (w, b) = (tensor(&device(), vec![0.5, 0.25], (1, 2, 1)), tensor(&device(), vec![0.0], (1, 1, 1)));
//! let y = ops::dense(x.clone().leaky_traced(), &w, &b, Activation::Relu, Grad::Params);
//! assert_eq!(values(&y), [1.0]);
//! let mut gradients = y.sum::<Rank0, _>().backward();
//! assert_eq!(**gradients.get_or_alloc_mut(&w)?, [1.0, 2.0]);
//! assert_eq!(**gradients.get_or_alloc_mut(&x)?, [0.0, 0.0]);
//! # Ok::<(), dfdx::tensor::CpuError>(())
//! ```

use dfdx::prelude::*;
use dfdx::tensor::{Cpu, CpuError, Gradients};

use super::kernels::{self, Activation, DenseShape};
pub use super::tensors::{Tensor2, Tensor3, values, values_mut};

/// Takes the gradient of an operation's result out of the store; nothing else will need it.
pub(crate) fn take(gradients: &mut Gradients<f32, Cpu>, of: &Tensor3) -> Result<Vec<f32>, CpuError> {
    Ok(std::mem::take(gradients.get_or_alloc_mut(of)?))
}

/// Which gradients flow out of an operation: the place of the papers' stop-gradient operator sg(.).
#[doc(alias = "stop-gradient")]
#[doc(alias = "stop_gradient")]
#[doc(alias = "detach")]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Grad {
    /// Into the parameters, and through to the input.
    Both,
    /// Into the parameters only: f(sg(x)). The input is data, or belongs to another loss.
    Params,
    /// Through to the input only: the parameters are frozen, as a critic's are in the loss of its actor.
    Input,
}

/// `activation(x w + b)`: x `[members or 1, batch, input]`, w `[members, input, output]`,
/// b `[members, 1, output]`. An input of one member is given to all networks.
pub fn dense<T: Tape<f32, Cpu>>(
    x: Tensor3<T>,
    w: &Tensor3,
    b: &Tensor3,
    activation: Activation,
    grad: Grad,
) -> Tensor3<T> {
    let (x, mut tape) = x.split_tape();
    let &(x_members, batch, input) = x.shape();
    let &(members, rows, output) = w.shape();
    assert_eq!(rows, input, "the layer's input size");
    assert_eq!(*b.shape(), (members, 1, output), "the layer's bias");
    assert!(x_members == members || x_members == 1, "one input for each network, or one for all");
    let shape = DenseShape { members, batch, input, output, shared_input: x_members == 1 };

    let mut y = vec![0.0; members * batch * output];
    // The gradient of a ReLU follows from its result, that of a SiLU or Mish does not.
    let smooth = matches!(activation, Activation::Silu | Activation::Mish);
    let mut before = (T::OWNS_TAPE && smooth).then(|| vec![0.0; y.len()]);
    kernels::dense(&mut y, before.as_deref_mut(), values(&x), values(w), values(b), shape, activation);
    let y = x.device().tensor_from_vec(y, (members, batch, output));

    if T::OWNS_TAPE {
        let (w, b, y) = (w.clone(), b.clone(), y.clone());
        tape.add_backward_op(move |gradients| {
            let mut dz = take(gradients, &y)?;
            kernels::through_activation(&mut dz, before.as_deref().unwrap_or(values(&y)), activation);
            let (to_parameters, to_input) = (grad != Grad::Input, grad != Grad::Params);
            let mut of_parameters =
                to_parameters.then(|| Ok((take(gradients, &w)?, take(gradients, &b)?))).transpose()?;
            let mut of_input = to_input.then(|| take(gradients, &x)).transpose()?;
            let mut parameters = || {
                if let Some((dw, db)) = &mut of_parameters {
                    kernels::dense_parameter_gradients(dw, db, values(&x), &dz, shape);
                }
            };
            let mut inputs = || {
                if let Some(dx) = &mut of_input {
                    kernels::dense_input_gradient(dx, &dz, values(&w), shape);
                }
            };
            if shape.is_large() {
                // Both at once: neither waits for the other's last task.
                rayon::join(parameters, inputs);
            } else {
                parameters();
                inputs();
            }
            if let Some((dw, db)) = of_parameters {
                **gradients.get_or_alloc_mut(&w)? = dw;
                **gradients.get_or_alloc_mut(&b)? = db;
            }
            if let Some(dx) = of_input {
                **gradients.get_or_alloc_mut(&x)? = dx;
            }
            Ok(())
        });
    }
    y.put_tape(tape)
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

/// Records an operation on a tape that is handed on from one operation to the next, see [`super::tape`].
pub fn record<T: Tape<f32, Cpu>>(
    tape: &mut T,
    x: &Tensor3,
    operation: impl FnOnce(Tensor3<T>) -> Tensor3<T>,
) -> Tensor3 {
    let (y, recorded) = operation(x.clone().put_tape(std::mem::take(tape))).split_tape();
    *tape = recorded;
    y
}

/// The rows `from..from + count` of a single network's tensor.
pub fn rows<T: Tape<f32, Cpu>>(x: Tensor3<T>, from: usize, count: usize) -> Tensor3<T> {
    let (x, mut tape) = x.split_tape();
    let &(members, _, features) = x.shape();
    assert_eq!(members, 1, "rows of one network");
    let part = values(&x)[from * features..][..count * features].to_vec();
    let y = x.device().tensor_from_vec(part, (1, count, features));
    if T::OWNS_TAPE {
        let y = y.clone();
        tape.add_backward_op(move |gradients| {
            let dy = take(gradients, &y)?;
            let dx = &mut gradients.get_or_alloc_mut(&x)?[from * features..][..count * features];
            dx.iter_mut().zip(dy).for_each(|(dx, dy)| *dx += dy);
            Ok(())
        });
    }
    y.put_tape(tape)
}

/// Puts the rows of several tensors of a single network one below the other.
pub fn stack<T: Tape<f32, Cpu>>(mut tape: T, parts: &[Tensor3]) -> Tensor3<T> {
    let &(_, _, features) = parts[0].shape();
    let stacked: Vec<f32> = parts.iter().flat_map(values).copied().collect();
    let y = parts[0].device().tensor_from_vec(stacked, (1, parts.iter().map(|part| part.shape().1).sum(), features));
    if T::OWNS_TAPE {
        let (y, parts) = (y.clone(), parts.to_vec());
        tape.add_backward_op(move |gradients| {
            let mut dy = &take(gradients, &y)?[..];
            for part in &parts {
                let d = gradients.get_or_alloc_mut(part)?;
                let (own, rest) = dy.split_at(d.len());
                d.iter_mut().zip(own).for_each(|(d, dy)| *d += dy);
                dy = rest;
            }
            Ok(())
        });
    }
    y.put_tape(tape)
}

/// Multiplies each row of a single network's tensor `[1, batch, features]` by its own factor.
pub fn scale_rows<T: Tape<f32, Cpu>>(x: Tensor3<T>, factors: &[f32]) -> Tensor3<T> {
    let (x, mut tape) = x.split_tape();
    let &(_, batch, features) = x.shape();
    assert_eq!(factors.len(), batch, "a factor for each row");
    let factors = factors.to_vec();
    let scaled = move |numbers: &[f32]| -> Vec<f32> {
        let rows = numbers.chunks_exact(features).zip(&factors);
        rows.flat_map(|(row, factor)| row.iter().map(move |x| x * factor)).collect()
    };
    let y = x.device().tensor_from_vec(scaled(values(&x)), (1, batch, features));
    if T::OWNS_TAPE {
        let y = y.clone();
        tape.add_backward_op(move |gradients| {
            let dy = scaled(&take(gradients, &y)?);
            gradients.get_or_alloc_mut(&x)?.iter_mut().zip(dy).for_each(|(dx, dy)| *dx += dy);
            Ok(())
        });
    }
    y.put_tape(tape)
}

/// The mean over the networks, row by row: `[members, batch, features]` becomes `[1, batch, features]`.
pub fn mean_of_members<T: Tape<f32, Cpu>>(x: Tensor3<T>) -> Tensor3<T> {
    let (x, mut tape) = x.split_tape();
    let &(members, batch, features) = x.shape();
    let share = 1.0 / members as f32;
    let mut mean = vec![0.0; batch * features];
    for of_member in values(&x).chunks_exact(batch * features) {
        mean.iter_mut().zip(of_member).for_each(|(mean, x)| *mean += share * x);
    }
    let y = x.device().tensor_from_vec(mean, (1, batch, features));
    if T::OWNS_TAPE {
        let y = y.clone();
        tape.add_backward_op(move |gradients| {
            let dy = take(gradients, &y)?;
            for dx in gradients.get_or_alloc_mut(&x)?.chunks_exact_mut(batch * features) {
                dx.iter_mut().zip(&dy).for_each(|(dx, dy)| *dx += share * dy);
            }
            Ok(())
        });
    }
    y.put_tape(tape)
}

/// A function of each row, `[members, batch, outputs]`: `f(row's index, row, value, jacobian)` writes its value and its
/// Jacobian `[outputs, features]`. For functions that know their own derivatives: a loss, or a simulator.
pub fn map_rows<T: Tape<f32, Cpu>>(
    x: Tensor3<T>,
    outputs: usize,
    mut f: impl FnMut(usize, &[f32], &mut [f32], &mut [f32]),
) -> Tensor3<T> {
    let (x, mut tape) = x.split_tape();
    let &(members, batch, features) = x.shape();
    let mut mapped = vec![0.0; members * batch * outputs];
    let mut jacobians = vec![0.0; mapped.len() * features];
    let answers = mapped.chunks_exact_mut(outputs).zip(jacobians.chunks_exact_mut(outputs * features));
    for (i, (row, (value, jacobian))) in values(&x).chunks_exact(features).zip(answers).enumerate() {
        f(i, row, value, jacobian);
    }
    let y = x.device().tensor_from_vec(mapped, (members, batch, outputs));
    if T::OWNS_TAPE {
        let y = y.clone();
        tape.add_backward_op(move |gradients| {
            let dy = take(gradients, &y)?;
            let dx = gradients.get_or_alloc_mut(&x)?.chunks_exact_mut(features);
            let jacobians = jacobians.chunks_exact(outputs * features);
            for (dx, (jacobian, dy)) in dx.zip(jacobians.zip(dy.chunks_exact(outputs))) {
                for (slopes, dy) in jacobian.chunks_exact(features).zip(dy) {
                    dx.iter_mut().zip(slopes).for_each(|(dx, slope)| *dx += dy * slope);
                }
            }
            Ok(())
        });
    }
    y.put_tape(tape)
}

/// Multiplies the first third of each row `[members, batch, 3 n]` by the sigmoid of the last third; the second third stays as
/// it is: `[members, batch, 2 n]`.
pub fn gated<T: Tape<f32, Cpu>>(x: Tensor3<T>) -> Tensor3<T> {
    let (x, mut tape) = x.split_tape();
    let &(members, batch, width) = x.shape();
    let n = width / 3;
    let mut rows = values(&x).to_vec();
    gate_rows(&mut rows, n);
    let y = x.device().tensor_from_vec(rows, (members, batch, 2 * n));
    if T::OWNS_TAPE {
        let y = y.clone();
        tape.add_backward_op(move |gradients| {
            let dy = take(gradients, &y)?;
            let dx = gradients.get_or_alloc_mut(&x)?.chunks_exact_mut(width);
            for ((row, dx), dy) in values(&x).chunks_exact(width).zip(dx).zip(dy.chunks_exact(2 * n)) {
                for i in 0..n {
                    let open = kernels::sigmoid(row[2 * n + i]);
                    dx[i] += dy[i] * open;
                    dx[n + i] += dy[n + i];
                    dx[2 * n + i] += dy[i] * row[i] * open * (1.0 - open);
                }
            }
            Ok(())
        });
    }
    y.put_tape(tape)
}

/// The same for plain rows, in place: `3 n` numbers each become `2 n`.
fn gate_rows(rows: &mut Vec<f32>, n: usize) {
    let count = rows.len() / (3 * n);
    for row in 0..count {
        // What is read has not been written over yet: rows only move towards the front.
        let (from, to) = (3 * n * row, 2 * n * row);
        (0..n).for_each(|i| rows[to + i] = rows[from + i] * kernels::sigmoid(rows[from + 2 * n + i]));
        rows.copy_within(from + n..from + 2 * n, to + n);
    }
    rows.truncate(2 * n * count);
}

/// A loss of each row, `[members, batch, 1]`: `loss(row's index, row, slope)` returns it and writes its gradient with respect
/// to the row into `slope`.
pub fn rowwise<T: Tape<f32, Cpu>>(x: Tensor3<T>, mut loss: impl FnMut(usize, &[f32], &mut [f32]) -> f32) -> Tensor3<T> {
    map_rows(x, 1, |i, row, value, slope| value[0] = loss(i, row, slope))
}

/// The squared distance of each row from the same row of `target`, summed over features: `[members, batch, 1]`.
pub fn squared_distance<T: Tape<f32, Cpu>>(x: Tensor3<T>, target: &Tensor3) -> Tensor3<T> {
    assert_eq!(x.shape(), target.shape(), "a target for each number");
    let (target, width) = (values(target), target.shape().2);
    rowwise(x, |row, x, slope| {
        let differences = x.iter().zip(&target[row * width..]).map(|(x, target)| x - target);
        slope.iter_mut().zip(differences.clone()).for_each(|(slope, d)| *slope = 2.0 * d);
        differences.map(|d| d * d).sum()
    })
}

/// The mean over all numbers.
pub fn mean(x: &Tensor3) -> f32 {
    let numbers = values(x);
    numbers.iter().sum::<f32>() / numbers.len() as f32
}

/// The sum of several losses `[members, batch, 1]`, each times a weight: what is differentiated. The loss of a network is its mean over
/// the batch; those of several networks are added, so that the gradient of each is the same as if it were alone.
pub fn total<T: Tape<f32, Cpu>>(mut tape: T, losses: &[(f32, Tensor3)]) -> Tensor<Rank0, f32, Cpu, T> {
    let of_networks = |loss: &Tensor3| values(loss).iter().sum::<f32>() / loss.shape().1 as f32;
    let sum: f32 = losses.iter().map(|(weight, loss)| weight * of_networks(loss)).sum();
    let y = super::device().tensor(sum);
    if T::OWNS_TAPE {
        let (y, losses) = (y.clone(), losses.to_vec());
        tape.add_backward_op(move |gradients| {
            let dy = gradients.get_or_alloc_mut(&y)?[0];
            for (weight, loss) in &losses {
                let each = dy * weight / loss.shape().1 as f32;
                gradients.get_or_alloc_mut(loss)?.iter_mut().for_each(|d| *d += each);
            }
            Ok(())
        });
    }
    y.put_tape(tape)
}
