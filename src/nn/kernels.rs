//! The inner loops, on plain slices: matrix products by `gemm`, elementwise work vectorised for the
//! processor at hand by `pulp`. No tape, no tensor; [`super::ops`] puts them on dfdx's tape.
//!
//! Matrices are row-major. Work is split over the cores by network and by rows, never within a sum,
//! so results do not depend on the number of threads.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// What follows a layer's affine part.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Activation {
    /// Nothing.
    Identity,
    /// max(0, x).
    Relu,
    /// x sigmoid(x), also called swish: smooth, so that a model of a smooth world has smooth gradients.
    Silu,
}

/// A row-major matrix, read as it stands or transposed.
#[derive(Clone, Copy)]
pub struct Matrix<'a> {
    data: &'a [f32],
    rows: usize,
    cols: usize,
    row_stride: isize,
    col_stride: isize,
}

impl<'a> Matrix<'a> {
    /// `data` as a matrix of so many columns.
    pub fn new(data: &'a [f32], cols: usize) -> Self {
        assert!(cols > 0 && data.len().is_multiple_of(cols), "rows of equal length");
        Self { data, rows: data.len() / cols, cols, row_stride: cols as isize, col_stride: 1 }
    }

    /// The transposed matrix; nothing is copied.
    pub fn t(self) -> Self {
        Self { rows: self.cols, cols: self.rows, row_stride: self.col_stride, col_stride: self.row_stride, ..self }
    }

    /// The rows `from..to`.
    fn rows(self, from: usize, to: usize) -> Self {
        assert!(from <= to && to <= self.rows);
        Self { data: &self.data[from * self.row_stride as usize..], rows: to - from, ..self }
    }

    /// The columns `from..to`.
    pub fn columns(self, from: usize, to: usize) -> Self {
        self.t().rows(from, to).t()
    }
}

/// `out = a b`, or `out += a b`; `out` is row-major and contiguous. Single-threaded.
pub fn matmul(out: &mut [f32], a: Matrix, b: Matrix, accumulate: bool) {
    assert_eq!(out.len(), a.rows * b.cols, "the product fits");
    matmul_into(out, b.cols, a, b, accumulate);
}

/// The same, into some columns of a wider matrix: `out` begins at the product's first number, and its rows lie
/// `row_stride` apart.
pub fn matmul_into(out: &mut [f32], row_stride: usize, a: Matrix, b: Matrix, accumulate: bool) {
    assert_eq!(a.cols, b.rows, "inner sizes agree");
    if a.rows == 0 || b.cols == 0 {
        return;
    }
    assert!(row_stride >= b.cols && out.len() >= (a.rows - 1) * row_stride + b.cols, "the product fits");
    // SAFETY: both views lie within their slices (see `Matrix::new`, `t`, `rows`, `columns`), `out` holds the product
    // (just asserted), and it is borrowed mutably, so nothing aliases it.
    unsafe {
        gemm::gemm(
            a.rows,
            b.cols,
            a.cols,
            out.as_mut_ptr(),
            1,
            row_stride as isize,
            accumulate,
            a.data.as_ptr(),
            a.col_stride,
            a.row_stride,
            b.data.as_ptr(),
            b.col_stride,
            b.row_stride,
            1.0,
            1.0,
            false,
            false,
            false,
            gemm::Parallelism::None,
        );
    }
}

/// Runs a loop compiled for the widest vectors that this processor has, if the compiler sees fit to inline it.
pub fn vectorised<R>(work: impl FnOnce() -> R) -> R {
    pulp::Arch::new().dispatch(work)
}

/// Defines a function of slices whose loops are compiled for the widest vectors that this processor has. (Of a closure,
/// which cannot be told to be inlined, the compiler makes a function for the oldest processors once it is long.)
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

/// 1 / (1 + exp(-x)).
#[inline(always)]
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// The exponential function to a relative 3e-7, written so that a loop over it vectorises, which a call of the standard
/// library's does not. Beyond +-87 it stays at the values there.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    // x = n ln 2 + r with a whole n and |r| <= ln 2 / 2; exp(r) by its series; 2^n through the exponent's bits.
    const LN_2_HIGH: f32 = 0.693_359_4;
    const LN_2_LOW: f32 = -2.121_944_4e-4;
    // Adding 1.5 * 2^23 leaves the nearest whole number in a float's lowest bits.
    const ROUND: f32 = 12_582_912.0;
    let x = x.clamp(-87.0, 87.0);
    let rounded = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let n = rounded - ROUND;
    let r = n.mul_add(-LN_2_LOW, n.mul_add(-LN_2_HIGH, x));
    let mut series: f32 = 1.0 / 720.0;
    for coefficient in [1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        series = series.mul_add(r, coefficient);
    }
    series * f32::from_bits((rounded.to_bits() << 23).wrapping_add(1.0_f32.to_bits()))
}

/// The hyperbolic tangent, to 3e-7.
#[inline(always)]
pub fn tanh(x: f32) -> f32 {
    2.0 * sigmoid(2.0 * x) - 1.0
}

/// ln(1 + exp(x)), to 1e-7 of itself or of one.
#[inline(always)]
pub fn softplus(x: f32) -> f32 {
    // ln(1 + u) = 2 artanh(u / (2 + u)) for u = exp(-|x|), by its series.
    let u = exp(-x.abs());
    let z = u / (2.0 + u);
    let square = z * z;
    let mut series: f32 = 1.0 / 13.0;
    for coefficient in [1.0 / 11.0, 1.0 / 9.0, 1.0 / 7.0, 1.0 / 5.0, 1.0 / 3.0, 1.0] {
        series = series.mul_add(square, coefficient);
    }
    x.max(0.0) + 2.0 * z * series
}

#[inline(always)]
pub(super) fn silu(x: f32) -> f32 {
    x / (1.0 + exp(-x))
}

#[inline(always)]
pub(super) fn silu_slope(x: f32) -> f32 {
    let s = sigmoid(x);
    s * (1.0 + x * (1.0 - s))
}

/// The sizes of a dense layer over several networks at once.
#[derive(Clone, Copy, Debug)]
pub struct DenseShape {
    /// Networks.
    pub members: usize,
    /// Rows that each network is given.
    pub batch: usize,
    /// Columns of the input.
    pub input: usize,
    /// Columns of the output.
    pub output: usize,
    /// Whether all networks are given the same input, which then stands in memory only once.
    pub shared_input: bool,
}

impl DenseShape {
    /// Rows handed to one thread at a time, so that every core has work.
    fn rows_per_task(&self, rows: usize) -> usize {
        // Each network is one task if networks can be dealt out evenly; otherwise it is cut into so many that its parts can.
        let threads = rayon::current_num_threads();
        let tasks = (1..=threads).find(|tasks| (tasks * self.members).is_multiple_of(threads)).unwrap_or(1);
        // Below this much work a second core costs more than it brings.
        let enough = 2_000_000 / (self.input * self.output).max(1);
        rows.div_ceil(tasks).max(enough).min(rows).max(1)
    }

    /// The rows of all networks, `[members, batch, output]`, as they are handed out.
    fn tasks<'a>(&self, y: &'a mut [f32], rows: usize) -> Vec<&'a mut [f32]> {
        let members = y.chunks_mut(self.batch * self.output);
        members.flat_map(|y| y.chunks_mut(rows * self.output)).collect()
    }

    fn input_of<'a>(&self, x: &'a [f32], member: usize) -> &'a [f32] {
        let size = self.batch * self.input;
        if self.shared_input { x } else { &x[member * size..][..size] }
    }

    fn weight_of<'a>(&self, w: &'a [f32], member: usize) -> Matrix<'a> {
        let size = self.input * self.output;
        Matrix::new(&w[member * size..][..size], self.output)
    }
}

/// `y = activation(x w + b)` for every network: x `[members or 1, batch, input]`,
/// w `[members, input, output]`, b `[members, output]`, y `[members, batch, output]`. What is activated is kept in
/// `before`, if that is given.
pub fn dense(
    y: &mut [f32],
    before: Option<&mut [f32]>,
    x: &[f32],
    w: &[f32],
    b: &[f32],
    shape: DenseShape,
    activation: Activation,
) {
    let rows = shape.rows_per_task(shape.batch);
    let tasks = shape.batch.div_ceil(rows);
    let work = |task: usize, y: &mut [f32], before: Option<&mut [f32]>| {
        let (member, first) = (task / tasks, task % tasks * rows);
        let x = Matrix::new(shape.input_of(x, member), shape.input);
        let b = &b[member * shape.output..][..shape.output];
        matmul(y, x.rows(first, first + y.len() / shape.output), shape.weight_of(w, member), false);
        if let Some(before) = before {
            add_and_activate(y, b, Activation::Identity);
            before.copy_from_slice(y);
            activate_all(y, activation);
        } else {
            add_and_activate(y, b, activation);
        }
    };
    let parts = shape.tasks(y, rows).into_par_iter();
    match before.map(|before| shape.tasks(before, rows)) {
        Some(kept) => parts.zip(kept).enumerate().for_each(|(task, (y, before))| work(task, y, Some(before))),
        None => parts.enumerate().for_each(|(task, y)| work(task, y, None)),
    }
}

vectorised_fn! {
    /// `y = activation(y + b)` for rows of y, with b the same in each.
    pub fn add_and_activate(y: &'a mut [f32], b: &'a [f32], activation: Activation) {
        match activation {
            Activation::Identity => for_rows(y, b, |x| x),
            Activation::Relu => for_rows(y, b, |x| x.max(0.0)),
            Activation::Silu => for_rows(y, b, silu),
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
    fn activate_all(y: &'a mut [f32], activation: Activation) {
        activate(y, activation);
    }
}

/// `y = activation(y)`, to be inlined where vectors are in use.
#[inline(always)]
pub(super) fn activate(y: &mut [f32], activation: Activation) {
    match activation {
        Activation::Identity => {}
        Activation::Relu => y.iter_mut().for_each(|y| *y = y.max(0.0)),
        Activation::Silu => y.iter_mut().for_each(|y| *y = silu(*y)),
    }
}

/// From the gradient of `activation(z)` to the gradient of z, in place. Where only the sign of z matters (ReLU),
/// `z` may be its activation.
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
        }
    }
}

/// Adds the gradient of x: `dx += dz w'`. A shared input collects from all networks.
pub fn dense_input_gradient(dx: &mut [f32], dz: &[f32], w: &[f32], shape: DenseShape) {
    let dz_of = |member: usize| {
        Matrix::new(&dz[member * shape.batch * shape.output..][..shape.batch * shape.output], shape.output)
    };
    let rows = shape.rows_per_task(shape.batch);
    let one = |member: usize, dx: &mut [f32]| {
        dx.par_chunks_mut(rows * shape.input).enumerate().for_each(|(task, dx)| {
            let first = task * rows;
            let count = dx.len() / shape.input;
            matmul(dx, dz_of(member).rows(first, first + count), shape.weight_of(w, member).t(), true);
        });
    };
    if shape.shared_input {
        (0..shape.members).for_each(|member| one(member, dx));
    } else {
        dx.par_chunks_mut(shape.batch * shape.input).enumerate().for_each(|(member, dx)| one(member, dx));
    }
}

/// Adds the gradients of the parameters: `dw += x' dz` and `db += ` column sums of dz.
pub fn dense_parameter_gradients(dw: &mut [f32], db: &mut [f32], x: &[f32], dz: &[f32], shape: DenseShape) {
    // Columns of x are rows of dw.
    let rows = shape.rows_per_task(shape.input);
    let members = dw.par_chunks_mut(shape.input * shape.output).zip(db.par_chunks_mut(shape.output));
    members.enumerate().for_each(|(member, (dw, db))| {
        let x = shape.input_of(x, member);
        let dz = &dz[member * shape.batch * shape.output..][..shape.batch * shape.output];
        dw.par_chunks_mut(rows * shape.output).enumerate().for_each(|(task, dw)| {
            let first = task * rows;
            let count = dw.len() / shape.output;
            let x_t = Matrix::new(x, shape.input).t().rows(first, first + count);
            matmul(dw, x_t, Matrix::new(dz, shape.output), true);
        });
        vectorised(|| {
            for row in dz.chunks_exact(shape.output) {
                for (db, dz) in db.iter_mut().zip(row) {
                    *db += dz;
                }
            }
        });
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fast_exponential_is_exact_enough() {
        for i in -8700..=8700 {
            let x = i as f32 / 100.0;
            let truth = f64::from(x).exp();
            let error = (f64::from(exp(x)) - truth).abs() / truth;
            assert!(error < 3e-7, "exp({x}) is off by {error:e}");
        }
        for i in -200..=200 {
            let x = i as f32 / 10.0;
            let truth = f64::from(x).exp().ln_1p();
            assert!((f64::from(softplus(x)) - truth).abs() < 2e-7 * truth.max(1.0), "softplus({x})");
        }
        assert!(exp(-1e9) > 0.0 && exp(1e9).is_finite());
        assert!((sigmoid(0.0) - 0.5).abs() < 1e-7 && sigmoid(-100.0) < 1e-30 && sigmoid(100.0) == 1.0);
    }
}
