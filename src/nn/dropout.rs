//! Dropout, a regulariser.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use rand::RngExt;

use super::Tensor3;
use crate::rng::Rng;

/// Dropout (Srivastava et al. 2014): each number becomes zero with probability `rate`, below 1, and the others are divided by
/// 1 - `rate`, which keeps the mean. With a rate of zero nothing is drawn.
pub fn dropout<T: Tape<f32, Cpu>>(x: Tensor3<T>, rate: f32, rng: &mut Rng) -> Tensor3<T> {
    if rate == 0.0 {
        return x;
    }
    let kept = 1.0 / (1.0 - rate);
    let &(members, batch, features) = x.shape();
    let mask = (0..members * batch * features).map(|_| if rng.random::<f32>() < rate { 0.0 } else { kept }).collect();
    let mask = super::tensor(x.device(), mask, (members, batch, features));
    x * mask
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{device, tensor, values};
    use crate::rng;

    /// As many as the rate says are dropped, the mean stays, and the gradient is that of the numbers that were kept.
    #[test]
    fn numbers_are_dropped_and_the_mean_stays() {
        const N: usize = 40_000;
        let x = tensor(&device(), vec![2.0; N], (1, 4, N / 4));
        let y = dropout(x.clone().leaky_traced(), 0.2, &mut rng::stream(0, "dropout"));
        let out = values(&y).to_vec();
        let dropped = out.iter().filter(|y| **y == 0.0).count() as f32 / N as f32;
        assert!((dropped - 0.2).abs() < 0.01, "{dropped}");
        assert!(out.iter().all(|y| *y == 0.0 || (*y - 2.5).abs() < 1e-6));
        let gradients = y.sum::<Rank0, _>().backward();
        let dx = gradients.get(&x).as_vec();
        assert!(dx.iter().zip(&out).all(|(dx, y)| (dx - y / 2.0).abs() < 1e-6));

        let mut rng = rng::stream(0, "dropout");
        assert_eq!(values(&dropout(x.clone(), 0.0, &mut rng)), values(&x));
        assert_eq!(rng::uniform(&mut rng, 0.0, 1.0), rng::uniform(&mut rng::stream(0, "dropout"), 0.0, 1.0));
    }
}
