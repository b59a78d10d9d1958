//! Networks for inference only: plain weights, no tape. A panel of rows passes through all layers while it stays in the
//! processor's first-level cache, so that only the result is written to memory.

use pulp::Simd;

use super::Activation;
use super::kernels::{activate, vectorised_fn};
use super::norm::LAYER_NORM_EPSILON;

/// Rows that pass through a network together: two of the widest vectors.
pub const PANEL: usize = 32;

/// Outputs that are accumulated at once. With two vectors each, they fill the registers of processors with the widest vectors.
const BLOCK: usize = 10;

/// One feature of all rows of a panel, on cache lines of its own.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub struct Feature(pub [f32; PANEL]);

// SAFETY: nothing but numbers, and no padding between them: two cache lines are `PANEL` of them.
unsafe impl bytemuck::Zeroable for Feature {}
unsafe impl bytemuck::Pod for Feature {}

/// Reusable buffers of a forward pass. They only grow.
#[derive(Debug, Default)]
pub struct Panels {
    x: Vec<Feature>,
    y: Vec<Feature>,
}

impl Panels {
    /// Where a network's input goes. Rows that are not filled hold arbitrary numbers.
    pub fn input(&mut self, features: usize) -> &mut [Feature] {
        grow(&mut self.x, features);
        &mut self.x[..features]
    }
}

fn grow(panel: &mut Vec<Feature>, features: usize) {
    if panel.len() < features {
        panel.resize(features, Feature([0.0; PANEL]));
    }
}

/// A multi-layer perceptron for inference.
#[derive(Clone, Debug)]
pub struct FrozenMlp {
    layers: Vec<Layer>,
}

/// What follows the affine part of a layer.
#[derive(Clone, Debug)]
pub enum After {
    /// An activation.
    Activation(Activation),
    /// Layer normalisation over a row's features, then an activation: [`super::norm::layer_norm`].
    LayerNorm { gain: Vec<f32>, shift: Vec<f32>, activation: Activation },
}

/// Weights and biases in blocks of outputs, padded with zeros.
#[derive(Clone, Debug)]
struct Layer {
    input: usize,
    output: usize,
    /// `[output / BLOCK, input]`
    weight: Vec<[f32; BLOCK]>,
    bias: Vec<[f32; BLOCK]>,
    after: After,
}

impl FrozenMlp {
    /// A network of the given layers, weight `[input, output]` and bias `[output]` each; `activation` follows all but
    /// the last.
    pub fn new<'a>(layers: impl Iterator<Item = (&'a [f32], &'a [f32])>, activation: Activation) -> Self {
        let hidden = layers.map(|(weight, bias)| (weight, bias, After::Activation(activation)));
        let mut network = Self::of_layers(hidden);
        network.layers.last_mut().expect("a layer").after = After::Activation(Activation::Identity);
        network
    }

    /// A network of the given layers, each with what follows it.
    pub fn of_layers<'a>(layers: impl Iterator<Item = (&'a [f32], &'a [f32], After)>) -> Self {
        let layers: Vec<Layer> = layers.map(|(weight, bias, after)| Layer::new(weight, bias, after)).collect();
        assert!(!layers.is_empty(), "a network has layers");
        Self { layers }
    }

    /// Input features.
    pub fn inputs(&self) -> usize {
        self.layers[0].input
    }

    /// Output features.
    pub fn outputs(&self) -> usize {
        self.layers[self.layers.len() - 1].output
    }

    /// The layers as they were given.
    pub fn layers(&self) -> impl Iterator<Item = (Vec<f32>, Vec<f32>)> + '_ {
        self.layers.iter().map(|layer| (layer.weight(), layer.bias.as_flattened()[..layer.output].to_vec()))
    }

    /// The network's output for the [input](Panels::input). It may be overwritten.
    pub fn forward<'a>(&self, panels: &'a mut Panels) -> &'a mut [Feature] {
        let Panels { x, y } = panels;
        for (i, layer) in self.layers.iter().enumerate() {
            if i > 0 {
                std::mem::swap(x, y);
            }
            layer.forward(x, y);
        }
        &mut y[..self.outputs()]
    }
}

impl Layer {
    fn new(weight: &[f32], bias: &[f32], after: After) -> Self {
        let (input, output) = (weight.len() / bias.len(), bias.len());
        let block =
            |row: &[f32], first: usize| std::array::from_fn(|o| row[..output].get(first + o).copied().unwrap_or(0.0));
        let firsts = (0..output).step_by(BLOCK);
        Self {
            input,
            output,
            weight: firsts.clone().flat_map(|o| weight.chunks_exact(output).map(move |row| block(row, o))).collect(),
            bias: firsts.map(|o| block(bias, o)).collect(),
            after,
        }
    }

    /// The weight as it was given.
    fn weight(&self) -> Vec<f32> {
        let at = |i: usize, o: usize| self.weight[o / BLOCK * self.input + i][o % BLOCK];
        (0..self.input).flat_map(|i| (0..self.output).map(move |o| at(i, o))).collect()
    }

    fn forward(&self, x: &[Feature], y: &mut Vec<Feature>) {
        grow(y, self.bias.len() * BLOCK);
        let x = &x[..self.input];
        match &self.after {
            After::Activation(activation) => {
                pulp::Arch::new().dispatch(Product { layer: self, x, y, activation: *activation });
            }
            After::LayerNorm { gain, shift, activation } => {
                pulp::Arch::new().dispatch(Product { layer: self, x, y, activation: Activation::Identity });
                layer_norm(&mut y[..self.output], gain, shift, *activation);
            }
        }
    }
}

vectorised_fn! {
    /// [`super::norm::layer_norm`] of each row of a panel, in place.
    fn layer_norm(y: &'a mut [Feature], gain: &'a [f32], shift: &'a [f32], activation: Activation) {
        let share = 1.0 / y.len() as f32;
        let mut mean = [0.0; PANEL];
        for Feature(y) in y.iter() {
            (0..PANEL).for_each(|i| mean[i] += share * y[i]);
        }
        let mut variance = [0.0; PANEL];
        for Feature(y) in y.iter() {
            (0..PANEL).for_each(|i| variance[i] += share * (y[i] - mean[i]) * (y[i] - mean[i]));
        }
        let scale = variance.map(|variance| 1.0 / (variance + LAYER_NORM_EPSILON).sqrt());
        for ((Feature(y), gain), shift) in y.iter_mut().zip(gain).zip(shift) {
            (0..PANEL).for_each(|i| y[i] = gain * (y[i] - mean[i]) * scale[i] + shift);
        }
        activate(bytemuck::cast_slice_mut(y), activation);
    }
}

/// `y = activation(w' x + b)` for a panel.
struct Product<'a> {
    layer: &'a Layer,
    x: &'a [Feature],
    y: &'a mut [Feature],
    activation: Activation,
}

impl pulp::WithSimd for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { layer: Layer { input, weight, bias, .. }, x, y, activation } = self;
        for ((y, weight), bias) in y.chunks_exact_mut(BLOCK).zip(weight.chunks_exact(*input)).zip(bias) {
            // With half as many registers, half a block at a time.
            if S::REGISTER_COUNT >= 32 {
                sums::<S, BLOCK>(simd, y, x, weight, bias, 0);
            } else {
                sums::<S, { BLOCK / 2 }>(simd, y, x, weight, bias, 0);
                sums::<S, { BLOCK / 2 }>(simd, y, x, weight, bias, BLOCK / 2);
            }
            activate(bytemuck::cast_slice_mut(y), activation);
        }
    }
}

/// The affine part of the outputs `first..first + OUTPUTS` of a block.
#[inline(always)]
fn sums<S: Simd, const OUTPUTS: usize>(
    simd: S,
    y: &mut [Feature],
    x: &[Feature],
    weight: &[[f32; BLOCK]],
    bias: &[f32; BLOCK],
    first: usize,
) {
    let vectors = PANEL / S::F32_LANES;
    let x = S::as_simd_f32s(bytemuck::cast_slice(x)).0;
    let y = S::as_mut_simd_f32s(bytemuck::cast_slice_mut(&mut y[first..first + OUTPUTS])).0;
    for row in (0..vectors).step_by(2) {
        let mut sums: [[S::f32s; 2]; OUTPUTS] = std::array::from_fn(|o| [simd.splat_f32s(bias[first + o]); 2]);
        for (weight, x) in weight.iter().zip(x.chunks_exact(vectors)) {
            let (low, high) = (x[row], x[row + 1]);
            for o in 0..OUTPUTS {
                let weight = simd.splat_f32s(weight[first + o]);
                let [sum_low, sum_high] = sums[o];
                sums[o] = [simd.mul_add_f32s(weight, low, sum_low), simd.mul_add_f32s(weight, high, sum_high)];
            }
        }
        for (y, sum) in y.chunks_exact_mut(vectors).zip(&sums) {
            (y[row], y[row + 1]) = (sum[0], sum[1]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::kernels::{DenseShape, dense};
    use crate::nn::{Grad, Mlp, Parameters, device, tensor, values};
    use crate::rng;

    /// The same answers as the network that was frozen: each layer normalised, with an activation after the last one, too.
    #[test]
    fn a_normalised_network_answers_as_before() {
        let cpu = device();
        let mut rng = rng::stream(1, "frozen");
        let mut draw = |count: usize| -> Vec<f32> { (0..count).map(|_| rng::normal(&mut rng) as f32).collect() };
        for output in [None, Some(13)] {
            let mut networks = Mlp::tdmpc(&cpu, 2, 9, &[33, 24], output, &mut rng::stream(2, "frozen"));
            for (_, parameter) in networks.parameters_mut() {
                let numbers = values(parameter).iter().zip(draw(values(parameter).len()));
                let moved: Vec<f32> = numbers.map(|(number, by)| number + 0.2 * by).collect();
                parameter.copy_from(&moved);
            }
            let x = draw(PANEL * 9);
            let expected = networks.forward(tensor(&cpu, x.clone(), (1, PANEL, 9)), Grad::Input);
            for member in 0..2 {
                let frozen = networks.frozen(member);
                let mut panels = Panels::default();
                for (i, feature) in panels.input(9).iter_mut().enumerate() {
                    feature.0 = std::array::from_fn(|row| x[row * 9 + i]);
                }
                let y = frozen.forward(&mut panels);
                for (o, y) in y.iter().enumerate() {
                    for (row, y) in y.0.iter().enumerate() {
                        let expected = expected[[member, row, o]];
                        assert!((y - expected).abs() < 2e-5, "{member}, {row}, {o}: {y}, expected {expected}");
                    }
                }
            }
        }
    }

    /// The same answers as layer by layer, for sizes that fill no block.
    #[test]
    fn a_panel_gets_the_answers_of_each_row() {
        let mut rng = rng::stream(0, "frozen");
        let mut draw = |count: usize| -> Vec<f32> { (0..count).map(|_| rng::normal(&mut rng) as f32 * 0.3).collect() };
        for activation in [Activation::Identity, Activation::Relu, Activation::Silu, Activation::Mish] {
            let sizes = [7, 23, 40, 11];
            let layers: Vec<_> = sizes.windows(2).map(|s| (draw(s[0] * s[1]), draw(s[1]))).collect();
            let network = FrozenMlp::new(layers.iter().map(|(w, b)| (&w[..], &b[..])), activation);
            assert_eq!((network.inputs(), network.outputs()), (7, 11));
            assert_eq!(network.layers().collect::<Vec<_>>(), layers);

            let rows = draw(PANEL * sizes[0]);
            let mut panels = Panels::default();
            for (i, x) in panels.input(sizes[0]).iter_mut().enumerate() {
                x.0 = std::array::from_fn(|row| rows[row * sizes[0] + i]);
            }
            let y = network.forward(&mut panels).to_vec();

            let mut expected = rows;
            for (i, (w, b)) in layers.iter().enumerate() {
                let (input, output) = (sizes[i], sizes[i + 1]);
                let shape = DenseShape { members: 1, batch: PANEL, input, output, shared_input: false };
                let activation = if i + 1 < layers.len() { activation } else { Activation::Identity };
                let mut next = vec![0.0; PANEL * output];
                dense(&mut next, None, &expected, w, b, shape, activation);
                expected = next;
            }
            for (o, y) in y.iter().enumerate() {
                for (row, y) in y.0.iter().enumerate() {
                    let expected = expected[row * sizes[3] + o];
                    assert!((y - expected).abs() < 1e-5, "row {row}, output {o}: {y}, expected {expected}");
                }
            }
        }
    }
}
