//! Matrix products on slices, by `gemm`, in an order of summation that is the same on every processor.
//!
//! `gemm` adds up the terms of each entry one after another with fused multiply-adds, whatever the width of the vectors, with
//! two exceptions: it cuts long sums into pieces whose length depends on the caches, and it splits those of small products and
//! of matrix-vector products over the lanes of a vector. So sums are cut here, at a fixed length that is below all of its own,
//! and [`dots`] takes the products of the second kind. Then processors with AVX2 and with AVX-512 agree on every bit.

use super::vectorised_fn;

/// A row-major matrix, read as it stands or transposed.
#[derive(Clone, Copy, Debug)]
pub struct Matrix<'a> {
    data: &'a [f32],
    rows: usize,
    cols: usize,
    row_stride: isize,
    col_stride: isize,
}

impl<'a> Matrix<'a> {
    /// `data` as a matrix of `cols` columns.
    ///
    /// # Panics
    /// If rows would not be of equal length.
    pub fn new(data: &'a [f32], cols: usize) -> Self {
        assert!(cols > 0 && data.len().is_multiple_of(cols), "rows of equal length");
        Self { data, rows: data.len() / cols, cols, row_stride: cols as isize, col_stride: 1 }
    }

    /// The transposed matrix; nothing is copied.
    pub fn t(self) -> Self {
        Self { rows: self.cols, cols: self.rows, row_stride: self.col_stride, col_stride: self.row_stride, ..self }
    }

    /// The rows `from..to`.
    pub(super) fn rows(self, from: usize, to: usize) -> Self {
        assert!(from <= to && to <= self.rows);
        Self { data: &self.data[from * self.row_stride as usize..], rows: to - from, ..self }
    }

    /// The columns `from..to`.
    pub fn columns(self, from: usize, to: usize) -> Self {
        self.t().rows(from, to).t()
    }
}

/// Numbers of a product that `gemm` computes as sums over lanes, in another order than those of a larger one.
const SMALL_PRODUCT: usize = 256;

/// Whether `gemm` would split the sums of a product of this size over lanes, where both factors are contiguous along them.
pub(super) fn sums_over_lanes(rows: usize, cols: usize) -> bool {
    rows * cols <= SMALL_PRODUCT || rows == 1 || cols == 1
}

/// `out = a b`, or `out += a b`; `out` is row-major and contiguous. Single-threaded.
pub fn matmul(out: &mut [f32], a: Matrix, b: Matrix, accumulate: bool) {
    assert_eq!(out.len(), a.rows * b.cols, "the product fits");
    matmul_into(out, b.cols, a, b, accumulate);
}

/// [`matmul`] into some columns of a wider matrix: `out` begins at the product's first number, and its rows are `row_stride`
/// apart.
pub fn matmul_into(out: &mut [f32], row_stride: usize, a: Matrix, b: Matrix, accumulate: bool) {
    assert_eq!(a.cols, b.rows, "inner sizes agree");
    if a.rows == 0 || b.cols == 0 {
        return;
    }
    assert!(row_stride >= b.cols && out.len() >= (a.rows - 1) * row_stride + b.cols, "the product fits");
    if a.col_stride == 1 && b.row_stride == 1 && sums_over_lanes(a.rows, b.cols) {
        dots(out, row_stride, a, b, accumulate);
        return;
    }
    for first in (0..a.cols).step_by(LONGEST_SUM) {
        let depth = LONGEST_SUM.min(a.cols - first);
        // SAFETY: both views lie within their slices (see `Matrix::new`, `t`, `rows`, `columns`) and stay there for a part of
        // the columns of one and the rows of the other; `out` holds the product (just asserted), and it is borrowed mutably,
        // so nothing aliases it.
        unsafe {
            gemm::gemm(
                a.rows,
                b.cols,
                depth,
                out.as_mut_ptr(),
                1,
                row_stride as isize,
                accumulate || first > 0,
                a.data.as_ptr().offset(first as isize * a.col_stride),
                a.col_stride,
                a.row_stride,
                b.data.as_ptr().offset(first as isize * b.row_stride),
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
}

/// Terms of a sum that `gemm` adds up in one go: it never cuts shorter ones.
const LONGEST_SUM: usize = 512;

/// Partial sums of [`dot`], a whole number of vectors on every processor.
const LANES: usize = 32;

vectorised_fn! {
    /// [`matmul_into`] for contiguous rows of `a` and columns of `b`: each entry is a scalar product.
    fn dots(out: &'a mut [f32], row_stride: usize, a: Matrix<'a>, b: Matrix<'a>, accumulate: bool) {
        for i in 0..a.rows {
            let row = &a.data[i * a.row_stride as usize..][..a.cols];
            for j in 0..b.cols {
                let column = &b.data[j * b.col_stride as usize..][..a.cols];
                let entry = &mut out[i * row_stride + j];
                *entry = if accumulate { *entry } else { 0.0 } + dot(row, column);
            }
        }
    }
}

/// The scalar product, as [`LANES`] partial sums.
#[inline(always)]
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0_f32; LANES];
    let (a_chunks, b_chunks) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    let rest = a_chunks.remainder().iter().zip(b_chunks.remainder());
    for (a, b) in a_chunks.zip(b_chunks) {
        for lane in 0..LANES {
            sums[lane] = a[lane].mul_add(b[lane], sums[lane]);
        }
    }
    for (sum, (a, b)) in sums.iter_mut().zip(rest) {
        *sum = a.mul_add(*b, *sum);
    }
    let mut width = LANES / 2;
    while width > 0 {
        for lane in 0..width {
            sums[lane] += sums[lane + width];
        }
        width /= 2;
    }
    sums[0]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng;

    fn product(rows: usize, inner: usize, cols: usize, layout: usize, a: &[f32], b: &[f32]) -> Vec<f32> {
        let a = if layout & 1 == 0 { Matrix::new(a, inner) } else { Matrix::new(a, rows).t() };
        let b = if layout & 2 == 0 { Matrix::new(b, cols) } else { Matrix::new(b, inner).t() };
        let accumulate = layout & 4 != 0;
        let mut out = vec![if accumulate { 1.0 } else { f32::NAN }; rows * cols];
        matmul(&mut out, a, b, accumulate);
        out
    }

    /// Matrices and vectors of all kinds of sizes, stored by rows and by columns, written and added.
    fn for_all_shapes(mut each: impl FnMut(usize, usize, usize, usize)) {
        for inner in [1, 2, 3, 8, 31, 64, 512, 513, 1300] {
            for (rows, cols) in
                [(1, 1), (1, 7), (1, 300), (5, 1), (300, 1), (3, 5), (16, 16), (17, 9), (33, 70), (128, 48)]
            {
                (0..8).for_each(|layout| each(rows, inner, cols, layout));
            }
        }
    }

    #[test]
    fn products_of_all_shapes_are_right() {
        let mut rng = rng::stream(0, "products");
        let numbers: Vec<f32> = (0..1300 * 300 + 1000).map(|_| rng::normal(&mut rng) as f32).collect();
        for_all_shapes(|rows, inner, cols, layout| {
            let (a, b) = (&numbers[..rows * inner], &numbers[1000..][..inner * cols]);
            let out = product(rows, inner, cols, layout, a, b);
            for (i, j) in [(0, 0), (rows / 2, cols / 2), (rows - 1, cols - 1)] {
                let entry = |k: usize| {
                    let a = if layout & 1 == 0 { a[i * inner + k] } else { a[k * rows + i] };
                    let b = if layout & 2 == 0 { b[k * cols + j] } else { b[j * inner + k] };
                    f64::from(a) * f64::from(b)
                };
                let truth = (0..inner).map(entry).sum::<f64>() + if layout & 4 != 0 { 1.0 } else { 0.0 };
                let error = (f64::from(out[i * cols + j]) - truth).abs();
                assert!(error < 1e-6 * (inner as f64 + 10.0), "{rows} x {inner} x {cols}, {layout}: off by {error:e}");
            }
        });
    }

    /// What makes results the same on processors with AVX2 and with AVX-512: the digest was computed with both.
    #[cfg(target_arch = "x86_64")]
    #[test]
    fn products_have_the_same_bits_on_every_processor() {
        // Without fused multiply-adds every step of a sum is rounded twice.
        if !std::arch::is_x86_feature_detected!("fma") {
            return;
        }
        let mut state = 1_u32;
        let mut number = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            state as f32 / 2.0_f32.powi(31) - 1.0
        };
        let numbers: Vec<f32> = (0..1300 * 300 + 1000).map(|_| number()).collect();
        let mut digest = 0xcbf2_9ce4_8422_2325_u64;
        for_all_shapes(|rows, inner, cols, layout| {
            let out = product(rows, inner, cols, layout, &numbers[..rows * inner], &numbers[1000..][..inner * cols]);
            for entry in out {
                digest = (digest ^ u64::from(entry.to_bits())).wrapping_mul(0x0100_0000_01b3);
            }
        });
        assert_eq!(digest, 0xb070_37c1_a8ac_9074, "{digest:#x}");
    }
}
