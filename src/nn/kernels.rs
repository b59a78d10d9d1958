//! The inner loops, on plain slices: matrix products by `gemm`, elementwise work vectorised for the
//! processor at hand by `pulp`. No tape, no tensor; [`super::ops`] puts them on dfdx's tape.
//!
//! Matrices are row-major. Work is split over the cores by network and by rows, never within a sum,
//! so results do not depend on the number of threads.

use rayon::prelude::*;

/// What follows a layer's affine part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    /// Nothing.
    Identity,
    /// max(0, x).
    Relu,
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
}

/// `out = a b`, or `out += a b`; `out` is row-major and contiguous. Single-threaded.
pub fn matmul(out: &mut [f32], a: Matrix, b: Matrix, accumulate: bool) {
    assert_eq!(a.cols, b.rows, "inner sizes agree");
    assert_eq!(out.len(), a.rows * b.cols, "the product fits");
    if out.is_empty() {
        return;
    }
    // SAFETY: both views lie within their slices (see `Matrix::new`, `t`, `rows`), `out` holds
    // exactly the product, and it is borrowed mutably, so nothing aliases it.
    unsafe {
        gemm::gemm(
            a.rows,
            b.cols,
            a.cols,
            out.as_mut_ptr(),
            1,
            b.cols as isize,
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

/// Runs a loop compiled for the widest vectors that this processor has.
pub fn vectorised<R>(work: impl FnOnce() -> R) -> R {
    pulp::Arch::new().dispatch(work)
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
        let tasks = rayon::current_num_threads().div_ceil(self.members);
        // Below this much work a second core costs more than it brings.
        let enough = 2_000_000 / (self.input * self.output).max(1);
        rows.div_ceil(tasks).max(enough).min(rows).max(1)
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
/// w `[members, input, output]`, b `[members, output]`, y `[members, batch, output]`.
pub fn dense(y: &mut [f32], x: &[f32], w: &[f32], b: &[f32], shape: DenseShape, activation: Activation) {
    let rows = shape.rows_per_task(shape.batch);
    let members = y.par_chunks_mut(shape.batch * shape.output).enumerate();
    members.for_each(|(member, y)| {
        let x = Matrix::new(shape.input_of(x, member), shape.input);
        let w = shape.weight_of(w, member);
        let b = &b[member * shape.output..][..shape.output];
        y.par_chunks_mut(rows * shape.output).enumerate().for_each(|(task, y)| {
            let first = task * rows;
            let count = y.len() / shape.output;
            matmul(y, x.rows(first, first + count), w, false);
            vectorised(|| {
                for row in y.chunks_exact_mut(shape.output) {
                    for (y, b) in row.iter_mut().zip(b) {
                        *y += b;
                        if activation == Activation::Relu {
                            *y = y.max(0.0);
                        }
                    }
                }
            });
        });
    });
}

/// From the gradient of y to the gradient of `x w + b`, in place.
pub fn through_activation(dy: &mut [f32], y: &[f32], activation: Activation) {
    if activation == Activation::Relu {
        let chunk = dy.len().div_ceil(rayon::current_num_threads()).max(16_384);
        dy.par_chunks_mut(chunk).zip(y.par_chunks(chunk)).for_each(|(dy, y)| {
            vectorised(|| {
                for (dy, y) in dy.iter_mut().zip(y) {
                    *dy = if *y > 0.0 { *dy } else { 0.0 };
                }
            });
        });
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
