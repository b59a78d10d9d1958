//! The two shapes of tensor that networks use, and their numbers as slices.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

/// Features of several networks, `[members, batch, features]`; also parameters, see [`super::ops::dense`].
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

/// The same, to be changed. Numbers that the tensor shares with its clones are copied first.
///
/// # Panics
/// If the tensor is a broadcast or permuted view.
pub fn values_mut(tensor: &mut Tensor3) -> &mut [f32] {
    let len = values(tensor).len();
    if len == 0 {
        return &mut [];
    }
    let first = std::ptr::from_mut(&mut tensor[[0; 3]]);
    // SAFETY: as in `values`; dfdx's `IndexMut` has just made the tensor the only owner of its numbers.
    unsafe { std::slice::from_raw_parts_mut(first, len) }
}
