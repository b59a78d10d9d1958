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
    /// What follows each hidden layer.
    pub activation: Activation,
    /// How parameters are drawn.
    pub init: Init,
}

/// How the parameters of a layer of n inputs are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Init {
    /// Weights and biases uniform in +-1/sqrt(n), as in PyTorch.
    Uniform,
    /// Weights normal with deviation 1 / (2 sqrt(n)), cut off at two deviations; biases zero: as in PETS.
    TruncatedNormal,
}

/// Fully connected networks: affine, optional layer normalisation, activation; the last layer is affine.
#[derive(Clone, Debug)]
pub struct Mlp {
    layers: Vec<Layer>,
    activation: Activation,
}

#[derive(Clone, Debug)]
struct Layer {
    weight: Tensor3,
    bias: Tensor3,
    /// Gain and shift.
    norm: Option<(Tensor3, Tensor3)>,
}

impl Mlp {
    /// New networks.
    pub fn new(cpu: &Cpu, config: &MlpConfig, rng: &mut Rng) -> Self {
        let sizes: Vec<usize> = [config.input].iter().chain(&config.hidden).chain([&config.output]).copied().collect();
        let members = config.members;
        let mut layers = Vec::with_capacity(sizes.len() - 1);
        for (i, size) in sizes.windows(2).enumerate() {
            let (input, output) = (size[0], size[1]);
            let bound = 1.0 / (input as f64).sqrt();
            let mut draw = |rows: usize| {
                let number = |_| match config.init {
                    Init::Uniform => rng::uniform(rng, -bound, bound),
                    Init::TruncatedNormal if rows == 1 => 0.0,
                    Init::TruncatedNormal => 0.5 * bound * rng::truncated_normal(rng),
                };
                let numbers = (0..members * rows * output).map(number).map(|x| x as f32).collect();
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
        Self { layers, activation: config.activation }
    }

    /// Networks of the given layers, each a weight `[input, output]` and a bias `[output]`, for each member.
    ///
    /// # Panics
    /// If the members' layers are not of the same sizes.
    pub fn from_layers(cpu: &Cpu, members: &[Vec<(&[f32], &[f32])>], activation: Activation) -> Self {
        let layer = |i: usize| {
            let weights: Vec<f32> = members.iter().flat_map(|layers| layers[i].0).copied().collect();
            let biases: Vec<f32> = members.iter().flat_map(|layers| layers[i].1).copied().collect();
            let output = biases.len() / members.len();
            let input = weights.len() / biases.len();
            let weight = super::tensor(cpu, weights, (members.len(), input, output));
            Layer { weight, bias: super::tensor(cpu, biases, (members.len(), 1, output)), norm: None }
        };
        Self { layers: (0..members[0].len()).map(layer).collect(), activation }
    }

    /// Weight `[input, output]` and bias `[output]` of each layer of one network, without tape: what planners run on.
    /// Layer normalisation is not among them.
    pub fn layers_of(&self, member: usize) -> impl Iterator<Item = (&[f32], &[f32])> {
        let of_member = move |parameter| {
            let numbers = values(parameter);
            let size = numbers.len() / parameter.shape().0;
            &numbers[member * size..][..size]
        };
        self.layers.iter().map(move |layer| (of_member(&layer.weight), of_member(&layer.bias)))
    }

    /// The outputs for `x` (`[members or 1, batch, input]`).
    pub fn forward<T: Tape<f32, Cpu>>(&self, x: Tensor3<T>, learning: Learning) -> Tensor3<T> {
        let last = self.layers.len() - 1;
        self.layers.iter().enumerate().fold(x, |x, (i, Layer { weight, bias, norm })| {
            let activation = if i < last { self.activation } else { Activation::Identity };
            match norm {
                None => ops::dense(x, weight, bias, activation, learning),
                Some((gain, shift)) => {
                    let x = ops::dense(x, weight, bias, Activation::Identity, learning);
                    ops::layer_norm(x, gain, shift, activation, learning)
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
