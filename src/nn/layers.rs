//! Multi-layer perceptrons with runtime shapes, several networks side by side.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use serde::{Deserialize, Serialize};

use super::dropout::dropout;
use super::frozen::{After, FrozenMlp};
use super::ops::{self, Grad, Tensor3, values, values_mut};
use super::parameters::Parameters;
use super::tape::TapeOps;
use super::{Activation, norm};
use crate::rng::{self, Rng};

/// The shape of an [`Mlp`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MlpConfig {
    /// Networks in parallel.
    pub members: usize,
    /// Input features.
    pub input: usize,
    /// Units of each hidden layer.
    pub hidden: Vec<usize>,
    /// Output features of the last, affine layer; without one, the last hidden layer is the output.
    pub output: Option<usize>,
    /// How hidden layers are normalised before their activation.
    pub norm: Norm,
    /// What follows each hidden layer.
    pub activation: Activation,
    /// How parameters are drawn.
    pub init: Init,
}

/// How each row of a hidden layer is normalised.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Norm {
    /// Not at all.
    None,
    /// To mean 0 and standard deviation 1: [`norm::layer_norm`].
    Layer,
    /// To a root mean square of 1: [`norm::rms_norm`].
    Rms,
}

/// How the parameters of a layer of n inputs are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Init {
    /// Weights and biases uniform in +-1/sqrt(n), as in PyTorch.
    Uniform,
    /// Weights normal with standard deviation 1 / (2 sqrt(n)), truncated at two standard deviations; biases zero: as in PETS.
    TruncatedNormal,
    /// Weights normal and truncated at two standard deviations, with standard deviation 1 / sqrt(n) after truncation; biases
    /// zero: as in DreamerV3.
    Lecun,
    /// Weights normal with standard deviation 0.02, biases zero: as in TD-MPC2, where layers are normalised.
    Small,
}

impl Init {
    /// The numbers of a weight of `inputs` rows, or of a bias.
    pub(crate) fn draw(self, count: usize, inputs: usize, is_bias: bool, rng: &mut Rng) -> Vec<f32> {
        // The standard deviation of a standard normal number that is truncated at +-2.
        const TRUNCATED: f64 = 0.879_625_661_034_239_8;
        let bound = 1.0 / (inputs as f64).sqrt();
        let number = |_| match self {
            Self::Uniform => rng::uniform(rng, -bound, bound),
            _ if is_bias => 0.0,
            Self::TruncatedNormal => 0.5 * bound * rng::truncated_normal(rng),
            Self::Lecun => bound / TRUNCATED * rng::truncated_normal(rng),
            Self::Small => 0.02 * rng::normal(rng),
        };
        (0..count).map(number).map(|x| x as f32).collect()
    }
}

/// Fully connected networks: affine, optional normalisation, activation; the last layer is affine.
#[derive(Clone, Debug)]
pub struct Mlp {
    layers: Vec<Layer>,
}

#[derive(Clone, Debug)]
struct Layer {
    weight: Tensor3,
    bias: Tensor3,
    norm: NormParameters,
    activation: Activation,
}

#[derive(Clone, Debug)]
enum NormParameters {
    None,
    Layer { gain: Tensor3, shift: Tensor3 },
    Rms { gain: Tensor3 },
}

impl Mlp {
    /// New networks with random parameters.
    pub fn new(cpu: &Cpu, config: &MlpConfig, rng: &mut Rng) -> Self {
        let sizes: Vec<usize> =
            [config.input].into_iter().chain(config.hidden.iter().copied()).chain(config.output).collect();
        let members = config.members;
        let layer = |(i, size): (usize, &[usize])| {
            let (input, output) = (size[0], size[1]);
            let weight = config.init.draw(members * input * output, input, false, rng);
            let bias = config.init.draw(members * output, input, true, rng);
            let filled = |x: f32| super::tensor(cpu, vec![x; members * output], (members, 1, output));
            let hidden = i < config.hidden.len();
            let norm = match config.norm {
                Norm::Layer if hidden => NormParameters::Layer { gain: filled(1.0), shift: filled(0.0) },
                Norm::Rms if hidden => NormParameters::Rms { gain: filled(1.0) },
                _ => NormParameters::None,
            };
            Layer {
                weight: super::tensor(cpu, weight, (members, input, output)),
                bias: super::tensor(cpu, bias, (members, 1, output)),
                norm,
                activation: if hidden { config.activation } else { Activation::Identity },
            }
        };
        Self { layers: sizes.windows(2).enumerate().map(layer).collect() }
    }

    /// One network in DreamerV3's manner, for `input` features: hidden layers normalised by their root mean square, SiLU,
    /// weights drawn by [`Init::Lecun`], and an affine layer at the end if there is an `output` size.
    pub fn dreamer(cpu: &Cpu, input: usize, hidden: &[usize], output: Option<usize>, rng: &mut Rng) -> Self {
        let config = MlpConfig {
            members: 1,
            input,
            hidden: hidden.to_vec(),
            output,
            norm: Norm::Rms,
            activation: Activation::Silu,
            init: Init::Lecun,
        };
        Self::new(cpu, &config, rng)
    }

    /// Networks in TD-MPC2's manner: hidden layers have layer normalisation and Mish, weights are drawn by [`Init::Small`], and
    /// an affine layer follows if there is an `output` size.
    pub fn tdmpc(
        cpu: &Cpu,
        members: usize,
        input: usize,
        hidden: &[usize],
        output: Option<usize>,
        rng: &mut Rng,
    ) -> Self {
        let (norm, activation, init) = (Norm::Layer, Activation::Mish, Init::Small);
        let hidden = hidden.to_vec();
        Self::new(cpu, &MlpConfig { members, input, hidden, output, norm, activation, init }, rng)
    }

    /// The same networks with another activation after the last layer.
    #[must_use]
    pub fn ending_in(mut self, activation: Activation) -> Self {
        self.layers.last_mut().expect("a layer").activation = activation;
        self
    }

    /// Some of the networks, with tensors of their own.
    pub fn subset(&self, cpu: &Cpu, members: &[usize]) -> Self {
        let taken = |parameter: &Tensor3| {
            let &(all, rows, columns) = parameter.shape();
            let own: Vec<&[f32]> = values(parameter).chunks_exact(values(parameter).len() / all).collect();
            let numbers = members.iter().flat_map(|member| own[*member]).copied().collect();
            super::tensor(cpu, numbers, (members.len(), rows, columns))
        };
        let layer = |layer: &Layer| Layer {
            weight: taken(&layer.weight),
            bias: taken(&layer.bias),
            norm: match &layer.norm {
                NormParameters::None => NormParameters::None,
                NormParameters::Layer { gain, shift } => {
                    NormParameters::Layer { gain: taken(gain), shift: taken(shift) }
                }
                NormParameters::Rms { gain } => NormParameters::Rms { gain: taken(gain) },
            },
            activation: layer.activation,
        };
        Self { layers: self.layers.iter().map(layer).collect() }
    }

    /// Multiplies the weights of the last layer by `factor`: with 0, the output is the same for every input at first.
    pub fn scale_output(mut self, factor: f32) -> Self {
        let last = self.layers.last_mut().expect("a layer");
        values_mut(&mut last.weight).iter_mut().for_each(|w| *w *= factor);
        self
    }

    /// The weights of the first layer, `[members, input, output]`.
    pub(super) fn first_weight_mut(&mut self) -> &mut Tensor3 {
        &mut self.layers[0].weight
    }

    /// Networks of the given layers, each a weight `[input, output]` and a bias `[output]`, for each member.
    ///
    /// # Panics
    /// If the members' layers are not of the same sizes.
    pub fn from_layers(cpu: &Cpu, members: &[Vec<(Vec<f32>, Vec<f32>)>], activation: Activation) -> Self {
        let layer = |i: usize| {
            let weights: Vec<f32> = members.iter().flat_map(|layers| &layers[i].0).copied().collect();
            let biases: Vec<f32> = members.iter().flat_map(|layers| &layers[i].1).copied().collect();
            let output = biases.len() / members.len();
            let input = weights.len() / biases.len();
            let weight = super::tensor(cpu, weights, (members.len(), input, output));
            let activation = if i + 1 < members[0].len() { activation } else { Activation::Identity };
            let bias = super::tensor(cpu, biases, (members.len(), 1, output));
            Layer { weight, bias, norm: NormParameters::None, activation }
        };
        Self { layers: (0..members[0].len()).map(layer).collect() }
    }

    /// Weight `[input, output]` and bias `[output]` of each layer of one network, without normalisation: what planners run
    /// on.
    pub fn layers_of(&self, member: usize) -> impl Iterator<Item = (&[f32], &[f32])> {
        let of_member = move |parameter| {
            let numbers = values(parameter);
            let size = numbers.len() / parameter.shape().0;
            &numbers[member * size..][..size]
        };
        self.layers.iter().map(move |layer| (of_member(&layer.weight), of_member(&layer.bias)))
    }

    /// One of the networks on its own, without normalisation.
    pub fn member(&self, cpu: &Cpu, member: usize) -> Self {
        let layers = self.layers_of(member).map(|(weight, bias)| (weight.to_vec(), bias.to_vec())).collect();
        Self::from_layers(cpu, &[layers], self.layers[0].activation)
    }

    /// One of the networks for inference, with its normalisation.
    ///
    /// # Panics
    /// If it is normalised by the root mean square.
    pub(crate) fn frozen(&self, member: usize) -> FrozenMlp {
        let affine = self.layers_of(member).zip(&self.layers);
        FrozenMlp::of_layers(affine.map(|((weight, bias), layer)| {
            let own = |parameter: &Tensor3| values(parameter)[member * bias.len()..][..bias.len()].to_vec();
            let after = match &layer.norm {
                NormParameters::None => After::Activation(layer.activation),
                NormParameters::Layer { gain, shift } => {
                    After::LayerNorm { gain: own(gain), shift: own(shift), activation: layer.activation }
                }
                NormParameters::Rms { .. } => panic!("root-mean-square normalisation has no fast path"),
            };
            (weight, bias, after)
        }))
    }

    /// The outputs `[members, batch, output]` for `x` (`[members or 1, batch, input]`), whose tape they take over. An input
    /// of one member is given to all networks.
    pub fn forward<T: Tape<f32, Cpu>>(&self, x: Tensor3<T>, grad: Grad) -> Tensor3<T> {
        self.forward_through(x, grad, |hidden| hidden)
    }

    /// [`Mlp::forward`] with [`dropout`] at `rate` in each hidden layer, before its normalisation; without normalisation, after
    /// its activation.
    pub fn forward_with_dropout<T: Tape<f32, Cpu>>(
        &self,
        x: Tensor3<T>,
        grad: Grad,
        rate: f32,
        rng: &mut Rng,
    ) -> Tensor3<T> {
        self.forward_through(x, grad, |hidden| dropout(hidden, rate, rng))
    }

    /// [`Mlp::forward`], with what each hidden layer hands to its normalisation going through `hidden`.
    fn forward_through<T: Tape<f32, Cpu>>(
        &self,
        x: Tensor3<T>,
        grad: Grad,
        mut hidden: impl FnMut(Tensor3<T>) -> Tensor3<T>,
    ) -> Tensor3<T> {
        let last = self.layers.len() - 1;
        self.layers.iter().enumerate().fold(x, |x, (i, Layer { weight, bias, norm, activation })| {
            // Only the first layer stops gradients on its way to the input; to the others they must come through it.
            let of_norm = if grad == Grad::Input { Grad::Input } else { Grad::Both };
            let of_dense = if i == 0 { grad } else { of_norm };
            let affine = |activation| {
                let y = ops::dense(x, weight, bias, activation, of_dense);
                if i == last { y } else { hidden(y) }
            };
            match norm {
                NormParameters::None => affine(*activation),
                NormParameters::Layer { gain, shift } => {
                    norm::layer_norm(affine(Activation::Identity), gain, shift, *activation, of_norm)
                }
                NormParameters::Rms { gain } => {
                    norm::rms_norm(affine(Activation::Identity), gain, *activation, of_norm)
                }
            }
        })
    }

    /// [`Mlp::forward`] on a tape that is handed on, see [`super::tape`].
    pub fn on<T: Tape<f32, Cpu>>(&self, tape: &mut T, x: &Tensor3, grad: Grad) -> Tensor3 {
        tape.record(x, |x| self.forward(x, grad))
    }
}

impl Parameters for Mlp {
    fn parameters(&self) -> Vec<(String, &Tensor3)> {
        let mut all = Vec::new();
        for (i, Layer { weight, bias, norm, .. }) in self.layers.iter().enumerate() {
            all.extend([(format!("{i}.weight"), weight), (format!("{i}.bias"), bias)]);
            match norm {
                NormParameters::None => {}
                NormParameters::Layer { gain, shift } => {
                    all.extend([(format!("{i}.gain"), gain), (format!("{i}.shift"), shift)]);
                }
                NormParameters::Rms { gain } => all.push((format!("{i}.gain"), gain)),
            }
        }
        all
    }

    fn parameters_mut(&mut self) -> Vec<(String, &mut Tensor3)> {
        let mut all = Vec::new();
        for (i, Layer { weight, bias, norm, .. }) in self.layers.iter_mut().enumerate() {
            all.extend([(format!("{i}.weight"), weight), (format!("{i}.bias"), bias)]);
            match norm {
                NormParameters::None => {}
                NormParameters::Layer { gain, shift } => {
                    all.extend([(format!("{i}.gain"), gain), (format!("{i}.shift"), shift)]);
                }
                NormParameters::Rms { gain } => all.push((format!("{i}.gain"), gain)),
            }
        }
        all
    }
}
