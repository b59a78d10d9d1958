//! Matrix products on slices, by `gemm`.

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
