//! Multi-layer perceptrons with runtime shapes, several networks side by side.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use serde::{Deserialize, Serialize};

use super::ops::{self, Learning, Tensor3, values};
use super::{Activation, kernels};
use crate::rng::{self, Rng};

/// Something with named parameters, each `[members, rows, columns]`.
pub trait Parameters {
    /// The parameters, in a fixed order.
    fn parameters(&self) -> Vec<(String, &Tensor3)>;
    /// The same, to be changed.
    fn parameters_mut(&mut self) -> Vec<(String, &mut Tensor3)>;
}

/// Moves `target` towards `source`: `target <- (1 - rate) target + rate source`.
pub fn polyak<P: Parameters>(target: &mut P, source: &P, rate: f32) {
    for ((_, target), (_, source)) in target.parameters_mut().into_iter().zip(source.parameters()) {
        let mut mixed = values(target).to_vec();
        kernels::vectorised(|| {
            for (t, s) in mixed.iter_mut().zip(values(source)) {
                *t += rate * (s - *t);
            }
        });
        target.copy_from(&mixed);
    }
}

/// Gives `target` the parameters of `source`.
pub fn copy_parameters<P: Parameters>(target: &mut P, source: &P) {
    polyak(target, source, 1.0);
}

/// The shape of an [`Mlp`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MlpConfig {
    /// Networks side by side.
    pub members: usize,
    /// Input features.
    pub input: usize,
    /// Width of each hidden layer.
    pub hidden: Vec<usize>,
    /// Output features.
    pub output: usize,
    /// Whether hidden layers are normalised before their activation.
    pub layer_norm: bool,
}

/// ReLU networks: affine, optional layer normalisation, ReLU; the last layer is affine.
#[derive(Clone, Debug)]
pub struct Mlp {
    layers: Vec<Layer>,
}

#[derive(Clone, Debug)]
struct Layer {
    weight: Tensor3,
    bias: Tensor3,
    /// Gain and shift.
    norm: Option<(Tensor3, Tensor3)>,
}

impl Mlp {
    /// New networks. Weights and biases are uniform in +-1/sqrt(inputs), as in PyTorch.
    pub fn new(cpu: &Cpu, config: &MlpConfig, rng: &mut Rng) -> Self {
        let sizes: Vec<usize> = [config.input].iter().chain(&config.hidden).chain([&config.output]).copied().collect();
        let members = config.members;
        let mut layers = Vec::with_capacity(sizes.len() - 1);
        for (i, size) in sizes.windows(2).enumerate() {
            let (input, output) = (size[0], size[1]);
            let bound = 1.0 / (input as f64).sqrt();
            let mut draw = |rows: usize| {
                let count = members * rows * output;
                let numbers = (0..count).map(|_| rng::uniform(rng, -bound, bound) as f32).collect();
                super::tensor(cpu, numbers, (members, rows, output))
            };
            let (weight, bias) = (draw(input), draw(1));
            let hidden = i + 2 < sizes.len();
            let norm = (hidden && config.layer_norm).then(|| {
                let filled = |x: f32| super::tensor(cpu, vec![x; members * output], (members, 1, output));
                (filled(1.0), filled(0.0))
            });
            layers.push(Layer { weight, bias, norm });
        }
        Self { layers }
    }

    /// The outputs for `x` (`[members or 1, batch, input]`).
    pub fn forward<T: Tape<f32, Cpu>>(&self, x: Tensor3<T>, learning: Learning) -> Tensor3<T> {
        let last = self.layers.len() - 1;
        self.layers.iter().enumerate().fold(x, |x, (i, Layer { weight, bias, norm })| {
            let relu = if i < last { Activation::Relu } else { Activation::Identity };
            match norm {
                None => ops::dense(x, weight, bias, relu, learning),
                Some((gain, shift)) => {
                    let x = ops::dense(x, weight, bias, Activation::Identity, learning);
                    ops::layer_norm(x, gain, shift, relu, learning)
                }
            }
        })
    }
}

impl Parameters for Mlp {
    fn parameters(&self) -> Vec<(String, &Tensor3)> {
        let mut all = Vec::new();
        for (i, layer) in self.layers.iter().enumerate() {
            all.push((format!("{i}.weight"), &layer.weight));
            all.push((format!("{i}.bias"), &layer.bias));
            if let Some((gain, shift)) = &layer.norm {
                all.push((format!("{i}.gain"), gain));
                all.push((format!("{i}.shift"), shift));
            }
        }
        all
    }

    fn parameters_mut(&mut self) -> Vec<(String, &mut Tensor3)> {
        let mut all = Vec::new();
        for (i, layer) in self.layers.iter_mut().enumerate() {
            all.push((format!("{i}.weight"), &mut layer.weight));
            all.push((format!("{i}.bias"), &mut layer.bias));
            if let Some((gain, shift)) = &mut layer.norm {
                all.push((format!("{i}.gain"), gain));
                all.push((format!("{i}.shift"), shift));
            }
        }
        all
    }
}
