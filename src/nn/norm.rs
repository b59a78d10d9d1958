//! Normalisation over the features of each row, with the activation that follows it: one step on the tape.
//!
//! ```
//! use handful::nn::{Activation, Grad, device, norm, tensor, values};
//!
//! let x = tensor(&device(), vec![3.0, -4.0], (1, 1, 2));
//! let gain = tensor(&device(), vec![1.0, 1.0], (1, 1, 2));
//! let y = norm::rms_norm(x, &gain, Activation::Identity, Grad::Input);
//! let square: f32 = values(&y).iter().map(|y| y * y).sum();
//! assert!((square / 2.0 - 1.0).abs() < 1e-4);
//! ```

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use super::kernels::{Activation, mish, mish_slope, relu, silu, silu_slope, vectorised_fn};
use super::ops::{Grad, Tensor3, take, values};
use super::parameters::Parameters;
use super::tape::TapeOps;

pub(crate) const LAYER_NORM_EPSILON: f32 = 1e-5;

/// Layer normalisation (Ba et al. 2016), then the activation:
/// `activation(gain (x - mean) / sqrt(variance + 1e-5) + shift)`; x `[members, batch, features]`, gain and shift
/// `[members, 1, features]`. Gradients flow to the input always, to gain and shift unless `grad` is [`Grad::Input`].
#[doc(alias = "LayerNorm")]
pub fn layer_norm<T: Tape<f32, Cpu>>(
    x: Tensor3<T>,
    gain: &Tensor3,
    shift: &Tensor3,
    activation: Activation,
    grad: Grad,
) -> Tensor3<T> {
    normalised(x, gain, Some(shift), Rule { centred: true, epsilon: LAYER_NORM_EPSILON, activation }, grad)
}

/// Root-mean-square normalisation (Zhang & Sennrich 2019), then the activation:
/// `activation(gain x / sqrt(mean(x^2) + 1e-4))`; x `[members, batch, features]`, gain `[members, 1, features]`. The epsilon
/// is DreamerV3's. Gradients flow as in [`layer_norm`].
#[doc(alias = "RMSNorm")]
pub fn rms_norm<T: Tape<f32, Cpu>>(x: Tensor3<T>, gain: &Tensor3, activation: Activation, grad: Grad) -> Tensor3<T> {
    normalised(x, gain, None, Rule { centred: false, epsilon: 1e-4, activation }, grad)
}

/// A learned [`rms_norm`] with a SiLU after it, for layers outside an [`super::Mlp`].
#[derive(Clone, Debug)]
pub struct RmsNorm {
    gain: Tensor3,
}

impl RmsNorm {
    /// A new layer: all gains are one.
    pub fn new(cpu: &Cpu, features: usize) -> Self {
        Self { gain: super::tensor(cpu, vec![1.0; features], (1, 1, features)) }
    }

    /// The output for `x` `[1, batch, features]`.
    pub fn forward<T: Tape<f32, Cpu>>(&self, x: Tensor3<T>) -> Tensor3<T> {
        rms_norm(x, &self.gain, Activation::Silu, Grad::Both)
    }

    /// [`RmsNorm::forward`] on a tape that is handed on, see [`super::tape`].
    pub fn on<T: Tape<f32, Cpu>>(&self, tape: &mut T, x: &Tensor3) -> Tensor3 {
        tape.record(x, |x| self.forward(x))
    }
}

impl Parameters for RmsNorm {
    fn parameters(&self) -> Vec<(String, &Tensor3)> {
        vec![("gain".into(), &self.gain)]
    }

    fn parameters_mut(&mut self) -> Vec<(String, &mut Tensor3)> {
        vec![("gain".into(), &mut self.gain)]
    }
}

/// What is done to each row.
#[derive(Clone, Copy)]
struct Rule {
    /// Whether the mean is taken out.
    centred: bool,
    epsilon: f32,
    activation: Activation,
}

fn normalised<T: Tape<f32, Cpu>>(
    x: Tensor3<T>,
    gain: &Tensor3,
    shift: Option<&Tensor3>,
    rule: Rule,
    grad: Grad,
) -> Tensor3<T> {
    let (x, mut tape) = x.split_tape();
    let &(members, batch, features) = x.shape();
    assert_eq!(*gain.shape(), (members, 1, features), "the gain's shape");
    assert!(shift.is_none_or(|shift| shift.shape() == gain.shape()), "the shift's shape");
    let zeros = vec![0.0; features];
    let of_member = move |gain: &Tensor3, member: usize| values(gain)[member * features..][..features].to_vec();

    let mut y = vec![0.0; members * batch * features];
    // Mean and 1 / standard deviation of each row, from which the gradient computes everything else again.
    let mut statistics = vec![[0.0; 2]; members * batch];
    if !y.is_empty() {
        let rows = values(&x).chunks_exact(batch * features).zip(y.chunks_exact_mut(batch * features));
        for (member, ((x, y), statistics)) in rows.zip(statistics.chunks_exact_mut(batch)).enumerate() {
            let shift = shift.map_or_else(|| zeros.clone(), |shift| of_member(shift, member));
            forward(y, statistics, x, &of_member(gain, member), &shift, rule);
        }
    }
    let y = x.device().tensor_from_vec(y, (members, batch, features));

    if T::OWNS_TAPE {
        let (gain, shift, y) = (gain.clone(), shift.cloned(), y.clone());
        tape.add_backward_op(move |gradients| {
            let dy = take(gradients, &y)?;
            let mut d_gain = take(gradients, &gain)?;
            let mut d_shift = match &shift {
                Some(shift) if grad != Grad::Input => take(gradients, shift)?,
                _ => vec![0.0; members * features],
            };
            let dx = gradients.get_or_alloc_mut(&x)?;
            for (member, dx) in dx.chunks_exact_mut(batch * features).enumerate() {
                let rows = member * batch * features..(member + 1) * batch * features;
                let own = member * features..(member + 1) * features;
                backward(
                    dx,
                    if grad == Grad::Input { &mut [] } else { &mut d_gain[own.clone()] },
                    &mut d_shift[own],
                    &dy[rows.clone()],
                    &values(&x)[rows],
                    &statistics[member * batch..][..batch],
                    &of_member(&gain, member),
                    &shift.as_ref().map_or_else(|| zeros.clone(), |shift| of_member(shift, member)),
                    rule,
                );
            }
            **gradients.get_or_alloc_mut(&gain)? = d_gain;
            if let Some(shift) = &shift
                && grad != Grad::Input
            {
                **gradients.get_or_alloc_mut(shift)? = d_shift;
            }
            Ok(())
        });
    }
    y.put_tape(tape)
}

vectorised_fn! {
    fn forward(
        y: &'a mut [f32],
        statistics: &'a mut [[f32; 2]],
        x: &'a [f32],
        gain: &'a [f32],
        shift: &'a [f32],
        rule: Rule,
    ) {
        match rule.activation {
            Activation::Identity => forward_rows(y, statistics, x, gain, shift, rule, |z| z),
            Activation::Relu => forward_rows(y, statistics, x, gain, shift, rule, relu),
            Activation::Silu => forward_rows(y, statistics, x, gain, shift, rule, silu),
            Activation::Mish => forward_rows(y, statistics, x, gain, shift, rule, mish),
        }
    }
}

#[inline(always)]
fn forward_rows(
    y: &mut [f32],
    statistics: &mut [[f32; 2]],
    x: &[f32],
    gain: &[f32],
    shift: &[f32],
    rule: Rule,
    activation: impl Fn(f32) -> f32,
) {
    let n = gain.len();
    for ((y, x), statistics) in y.chunks_exact_mut(n).zip(x.chunks_exact(n)).zip(statistics) {
        let mean = if rule.centred { sum(x, x, |x, _| x) / n as f32 } else { 0.0 };
        let variance = sum(x, x, |x, _| (x - mean) * (x - mean)) / n as f32;
        let scale = 1.0 / (variance + rule.epsilon).sqrt();
        *statistics = [mean, scale];
        for (((y, x), gain), shift) in y.iter_mut().zip(x).zip(gain).zip(shift) {
            *y = activation(gain * (x - mean) * scale + shift);
        }
    }
}

vectorised_fn! {
    #[expect(clippy::too_many_arguments, reason = "all that a row's gradient depends on, and goes to")]
    fn backward(
        dx: &'a mut [f32],
        d_gain: &'a mut [f32],
        d_shift: &'a mut [f32],
        dy: &'a [f32],
        x: &'a [f32],
        statistics: &'a [[f32; 2]],
        gain: &'a [f32],
        shift: &'a [f32],
        rule: Rule,
    ) {
        let n = gain.len();
        // Of one row: x normalised, and the gradient before the activation.
        let (mut normal, mut g) = (vec![0.0; n], vec![0.0; n]);
        let rows = dx.chunks_exact_mut(n).zip(dy.chunks_exact(n)).zip(x.chunks_exact(n)).zip(statistics);
        for (((dx, dy), x), [mean, scale]) in rows {
            for (normal, x) in normal.iter_mut().zip(x) {
                *normal = (x - mean) * scale;
            }
            let before = normal.iter().zip(gain).zip(shift).map(|((x, gain), shift)| gain * x + shift);
            let pairs = g.iter_mut().zip(dy).zip(before);
            match rule.activation {
                Activation::Identity => pairs.for_each(|((g, dy), _)| *g = *dy),
                Activation::Relu => pairs.for_each(|((g, dy), z)| *g = if z > 0.0 { *dy } else { 0.0 }),
                Activation::Silu => pairs.for_each(|((g, dy), z)| *g = dy * silu_slope(z)),
                Activation::Mish => pairs.for_each(|((g, dy), z)| *g = dy * mish_slope(z)),
            }
            for ((d_gain, g), x) in d_gain.iter_mut().zip(&g).zip(&normal) {
                *d_gain += g * x;
            }
            if rule.centred {
                for (d_shift, g) in d_shift.iter_mut().zip(&g) {
                    *d_shift += g;
                }
            }
            // dx = (g' - mean(g') - x mean(g' x)) scale, with g' = gain g and x normalised.
            for (g, gain) in g.iter_mut().zip(gain) {
                *g *= gain;
            }
            let mean_g = if rule.centred { sum(&g, &g, |g, _| g) / n as f32 } else { 0.0 };
            let mean_gx = sum(&g, &normal, |g, x| g * x) / n as f32;
            for ((dx, g), x) in dx.iter_mut().zip(&g).zip(&normal) {
                *dx += (g - mean_g - x * mean_gx) * scale;
            }
        }
    }
}

/// A sum over two slices of one length in sixteen lanes, which vectorises (floating-point addition may not be reordered
/// otherwise).
#[inline(always)]
fn sum(a: &[f32], b: &[f32], f: impl Fn(f32, f32) -> f32) -> f32 {
    let mut lanes = [0.0; 16];
    let (a, b) = (a.chunks_exact(16), b.chunks_exact(16));
    let rest: f32 = a.remainder().iter().zip(b.remainder()).map(|(a, b)| f(*a, *b)).sum();
    for (a, b) in a.zip(b) {
        for i in 0..16 {
            lanes[i] += f(a[i], b[i]);
        }
    }
    rest + lanes.iter().sum::<f32>()
}
