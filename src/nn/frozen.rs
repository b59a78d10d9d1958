//! Networks for inference only: plain weights, no tape. A panel of rows passes through all layers while it stays in the
//! processor's first-level cache, so that only the result is written to memory.

use pulp::Simd;

use super::Activation;
use super::kernels::activate;

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
    activation: Activation,
}

/// Weights and biases in blocks of outputs, padded with zeros.
#[derive(Clone, Debug)]
struct Layer {
    input: usize,
    output: usize,
    /// `[output / BLOCK, input]`
    weight: Vec<[f32; BLOCK]>,
    bias: Vec<[f32; BLOCK]>,
}

impl FrozenMlp {
    /// A network of the given layers, weight `[input, output]` and bias `[output]` each; `activation` follows all but
    /// the last.
    pub fn new<'a>(layers: impl Iterator<Item = (&'a [f32], &'a [f32])>, activation: Activation) -> Self {
        let layers: Vec<Layer> = layers.map(|(weight, bias)| Layer::new(weight, bias)).collect();
        assert!(!layers.is_empty(), "a network has layers");
        Self { layers, activation }
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

    /// The network's output for the [input](Panels::input).
    pub fn forward<'a>(&self, panels: &'a mut Panels) -> &'a [Feature] {
        let Panels { x, y } = panels;
        let (head, hidden) = self.layers.split_last().expect("a network has layers");
        for layer in hidden {
            layer.forward(x, y, self.activation);
            std::mem::swap(x, y);
        }
        head.forward(x, y, Activation::Identity);
        &y[..head.output]
    }
}

impl Layer {
    fn new(weight: &[f32], bias: &[f32]) -> Self {
        let (input, output) = (weight.len() / bias.len(), bias.len());
        let block =
            |row: &[f32], first: usize| std::array::from_fn(|o| row[..output].get(first + o).copied().unwrap_or(0.0));
        let firsts = (0..output).step_by(BLOCK);
        Self {
            input,
            output,
            weight: firsts.clone().flat_map(|o| weight.chunks_exact(output).map(move |row| block(row, o))).collect(),
            bias: firsts.map(|o| block(bias, o)).collect(),
        }
    }

    /// The weight as it was given.
    fn weight(&self) -> Vec<f32> {
        let at = |i: usize, o: usize| self.weight[o / BLOCK * self.input + i][o % BLOCK];
        (0..self.input).flat_map(|i| (0..self.output).map(move |o| at(i, o))).collect()
    }

    fn forward(&self, x: &[Feature], y: &mut Vec<Feature>, activation: Activation) {
        grow(y, self.bias.len() * BLOCK);
        pulp::Arch::new().dispatch(Product { layer: self, x: &x[..self.input], y, activation });
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
    use crate::rng;

    /// The same answers as layer by layer, for sizes that fill no block.
    #[test]
    fn a_panel_gets_the_answers_of_each_row() {
        let mut rng = rng::stream(0, "frozen");
        let mut draw = |count: usize| -> Vec<f32> { (0..count).map(|_| rng::normal(&mut rng) as f32 * 0.3).collect() };
        for activation in [Activation::Identity, Activation::Relu, Activation::Silu] {
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
