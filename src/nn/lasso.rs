//! A group lasso on the inputs of networks (Yuan & Lin 2006).

use dfdx::prelude::HasShape;

use super::{Mlp, values_mut};

/// A penalty on the length of the vector of weights that leave an input, for each input of a network. Unlike weight decay, it
/// makes the weights of inputs that are not needed exactly zero.
#[doc(alias = "feature selection")]
#[derive(Clone, Debug)]
pub struct GroupLasso {
    /// The coefficient of each input's penalty; 0 leaves an input alone.
    pub coefficients: Vec<f32>,
}

impl GroupLasso {
    /// Its proximal step, after a gradient step of this learning rate: the vector of weights that leave input `i` becomes
    /// shorter by `learning_rate * coefficients[i]`, or zero.
    ///
    /// # Panics
    /// If there is not one coefficient for each input.
    #[doc(alias = "proximal gradient")]
    pub fn step(&self, networks: &mut Mlp, learning_rate: f32) {
        let weight = networks.first_weight_mut();
        let (_, inputs, outputs) = *weight.shape();
        assert_eq!(self.coefficients.len(), inputs, "one coefficient for each input");
        let rows = values_mut(weight).chunks_exact_mut(outputs).zip(self.coefficients.iter().cycle());
        for (row, coefficient) in rows.filter(|(_, coefficient)| **coefficient > 0.0) {
            let threshold = learning_rate * coefficient;
            let norm = row.iter().map(|w| w * w).sum::<f32>().sqrt();
            let kept = if norm > threshold { 1.0 - threshold / norm } else { 0.0 };
            row.iter_mut().for_each(|w| *w *= kept);
        }
    }
}
