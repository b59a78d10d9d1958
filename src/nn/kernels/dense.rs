//! A dense layer over several networks at once, and its gradients.

use rayon::prelude::*;

use super::activation::{activate_all, add_and_activate};
use super::matrix::sums_over_lanes;
use super::{Activation, Matrix, matmul, vectorised};

/// The sizes of a dense layer over several networks at once.
#[derive(Clone, Copy, Debug)]
pub struct DenseShape {
    /// Networks.
    pub members: usize,
    /// Rows of each network's input.
    pub batch: usize,
    /// Columns of the input.
    pub input: usize,
    /// Columns of the output.
    pub output: usize,
    /// Whether all networks have the same input, which is then stored only once.
    pub shared_input: bool,
}

/// Below this many multiplications a second core costs more than it saves.
const ENOUGH: usize = 2_000_000;

impl DenseShape {
    /// Whether a product of matrices of these sizes is worth a second core.
    pub(crate) fn is_large(&self) -> bool {
        self.members * self.batch * self.input * self.output >= ENOUGH
    }

    /// Networks, or parts of them, that one thread takes at least: all of them if there is little work.
    fn least_tasks(&self) -> usize {
        if self.is_large() { 1 } else { usize::MAX }
    }

    /// Rows handed to one thread at a time, so that every core has work.
    fn rows_per_task(&self, rows: usize) -> usize {
        // A network is one task if networks divide evenly among threads; otherwise it is cut so that its parts do.
        let threads = rayon::current_num_threads();
        let tasks = (1..=threads).find(|tasks| (tasks * self.members).is_multiple_of(threads)).unwrap_or(1);
        let enough = ENOUGH / (self.input * self.output).max(1);
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
/// w `[members, input, output]`, b `[members, output]`, y `[members, batch, output]`. `before`, if given, receives `x w + b`.
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
    let parts = shape.tasks(y, rows).into_par_iter().with_min_len(shape.least_tasks());
    match before.map(|before| shape.tasks(before, rows)) {
        Some(kept) => parts.zip(kept).enumerate().for_each(|(task, (y, before))| work(task, y, Some(before))),
        None => parts.enumerate().for_each(|(task, y)| work(task, y, None)),
    }
}

/// Adds the gradient of x: `dx += dz w'`. A shared input collects from all networks.
pub fn dense_input_gradient(dx: &mut [f32], dz: &[f32], w: &[f32], shape: DenseShape) {
    let dz_of = |member: usize| {
        Matrix::new(&dz[member * shape.batch * shape.output..][..shape.batch * shape.output], shape.output)
    };
    // No task may be so small that its sums are in another order, unless the whole product is: bits would depend on the threads.
    let small = |rows: usize| sums_over_lanes(rows, shape.input);
    let suits = |rows: &usize| !small(*rows) && (shape.batch.is_multiple_of(*rows) || !small(shape.batch % rows));
    let rows = (shape.rows_per_task(shape.batch)..shape.batch).find(suits).unwrap_or(shape.batch.max(1));
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
        let members = dx.par_chunks_mut(shape.batch * shape.input).with_min_len(shape.least_tasks());
        members.enumerate().for_each(|(member, dx)| one(member, dx));
    }
}

/// Adds the gradients of the parameters: `dw += x' dz` and `db += ` column sums of dz.
pub fn dense_parameter_gradients(dw: &mut [f32], db: &mut [f32], x: &[f32], dz: &[f32], shape: DenseShape) {
    // Columns of x are rows of dw.
    let rows = shape.rows_per_task(shape.input);
    let members = dw.par_chunks_mut(shape.input * shape.output).zip(db.par_chunks_mut(shape.output));
    members.with_min_len(shape.least_tasks()).enumerate().for_each(|(member, (dw, db))| {
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
