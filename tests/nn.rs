//! The learning core: gradients against finite differences, distributions and optimiser against
//! numbers computed elsewhere in float64 (with numpy, scipy and PyTorch).

use dfdx::prelude::*;
use handful::nn::kernels::{self, DenseShape, Matrix};
use handful::nn::{
    Activation, Adam, AdamConfig, BlockDense, Grad, GroupLasso, Init, Mlp, MlpConfig, Norm, Parameters,
    SquashedGaussian, SymexpBins, SymlogBins, Tensor3, Weights, copy_parameters, device, norm, ops, polyak, recurrent,
    simnorm, tensor, values,
};
use handful::rng::{self, Rng};

fn numbers(count: usize, rng: &mut Rng) -> Vec<f32> {
    (0..count).map(|_| rng::normal(rng) as f32).collect()
}

fn random(shape: (usize, usize, usize), rng: &mut Rng) -> Tensor3 {
    tensor(&device(), numbers(shape.0 * shape.1 * shape.2, rng), shape)
}

fn near(what: &str, ours: f32, theirs: f64, tolerance: f64) {
    assert!((f64::from(ours) - theirs).abs() <= tolerance * theirs.abs().max(1.0), "{what}: {ours}, expected {theirs}");
}

/// Checks the gradient of `loss` (a function of several tensors) against extrapolated central differences, for a
/// sample of the numbers of each tensor.
fn check_gradients(
    inputs: Vec<Tensor3>,
    loss: impl Fn(&[Tensor3], bool) -> (f32, Option<dfdx::tensor::Gradients<f32, Cpu>>),
) {
    const H: f32 = 2e-2;
    let (_, gradients) = loss(&inputs, true);
    let mut gradients = gradients.expect("a taped loss has gradients");
    for (which, input) in inputs.iter().enumerate() {
        let exact = gradients.get_or_alloc_mut(input).expect("memory").to_vec();
        let count = exact.len();
        for at in (0..count).step_by(count.div_ceil(11)) {
            let moved = |by: f32| {
                let mut inputs = inputs.clone();
                let mut numbers = values(&inputs[which]).to_vec();
                numbers[at] += by;
                inputs[which].copy_from(&numbers);
                f64::from(loss(&inputs, false).0)
            };
            let central = |h: f32| (moved(h) - moved(-h)) / f64::from(2.0 * h);
            // Richardson's extrapolation: where a loss bends sharply, the error of a single difference exceeds the bound.
            let difference = (4.0 * central(H / 2.0) - central(H)) / 3.0;
            let scale = exact.iter().fold(0.0_f32, |a, g| a.max(g.abs()));
            let error = (f64::from(exact[at]) - difference).abs() / f64::from(scale.max(1e-3));
            assert!(error < 2e-2, "input {which}, number {at}: {} by the tape, {difference} by differences", exact[at]);
        }
    }
}

/// A smooth scalar of a tensor that treats every number differently.
fn scalar<T: Tape<f32, Cpu>>(y: Tensor3<T>, weights: &Tensor3) -> Tensor<Rank0, f32, Cpu, T> {
    (y.sin() * weights.clone()).sum()
}

#[test]
fn matmul_reads_transposed_matrices() {
    // [[1, 2, 3], [4, 5, 6]] and its transposed.
    let a = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
    let mut square = [0.0; 4];
    kernels::matmul(&mut square, Matrix::new(&a, 3), Matrix::new(&a, 3).t(), false);
    assert_eq!(square, [14.0, 32.0, 32.0, 77.0]);
    let mut outer = [1.0; 9];
    kernels::matmul(&mut outer, Matrix::new(&a, 3).t(), Matrix::new(&a, 3), true);
    assert_eq!(outer, [18.0, 23.0, 28.0, 23.0, 30.0, 37.0, 28.0, 37.0, 46.0]);
}

#[test]
fn a_layer_does_not_depend_on_the_number_of_threads() {
    let mut rng = rng::stream(0, "threads");
    // With 203 rows in tasks of 201, two would be left over.
    for batch in [301, 203] {
        let shape = DenseShape { members: 1, batch, input: 77, output: 129, shared_input: true };
        let (x, w, b) = (numbers(batch * 77, &mut rng), numbers(77 * 129, &mut rng), numbers(129, &mut rng));
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| {
                let (mut y, mut before, mut dx) =
                    (vec![0.0; batch * 129], vec![0.0; batch * 129], vec![0.0; batch * 77]);
                let (mut dw, mut db) = (vec![0.0; 77 * 129], vec![0.0; 129]);
                kernels::dense(&mut y, Some(&mut before), &x, &w, &b, shape, Activation::Relu);
                assert!(y.iter().zip(&before).all(|(y, before)| *y == before.max(0.0)));
                kernels::dense(&mut before, None, &x, &w, &b, shape, Activation::Relu);
                assert_eq!(y, before);
                kernels::dense_input_gradient(&mut dx, &y, &w, shape);
                kernels::dense_parameter_gradients(&mut dw, &mut db, &x, &y, shape);
                [y, dx, dw, db].concat().iter().map(|v: &f32| v.to_bits()).collect::<Vec<u32>>()
            })
        };
        assert_eq!(with(1), with(2));
        assert_eq!(with(1), with(5));
    }
}

/// Two networks, two rows each: the loss of a network is its mean over the rows, and those of both are added.
#[test]
fn networks_learn_as_if_they_were_alone() {
    let two = tensor(&device(), vec![1.0, 3.0, 5.0, 7.0], (2, 2, 1));
    let total = ops::total(OwnedTape::default(), &[(1.0, two.clone())]);
    assert_eq!(total.array(), 2.0 + 6.0);
    assert_eq!(**total.backward().get_or_alloc_mut(&two).expect("memory"), [0.5; 4]);
}

#[test]
fn what_is_not_a_number_stays_so() {
    for activation in [Activation::Identity, Activation::Relu, Activation::Silu, Activation::Mish] {
        let mut y = [f32::NAN, -1.0];
        kernels::add_and_activate(&mut y, &[0.0, 0.0], activation);
        assert!(y[0].is_nan() && !y[1].is_nan(), "{activation:?}: {y:?}");
    }
}

#[test]
fn gradients_of_a_dense_layer() {
    let mut rng = rng::stream(1, "dense");
    for (x_members, activation) in [
        (1, Activation::Identity),
        (3, Activation::Identity),
        (3, Activation::Relu),
        (3, Activation::Silu),
        (3, Activation::Mish),
    ] {
        let mut draw = || [(x_members, 7, 5), (3, 5, 4), (3, 1, 4)].map(|shape| random(shape, &mut rng));
        let mut inputs = draw();
        // A difference across the kink of a ReLU is no derivative, so these stay away from it.
        let near_kink = |[x, w, b]: &[Tensor3; 3]| {
            let before = ops::dense(x.clone(), w, b, Activation::Identity, Grad::Both);
            values(&before).iter().any(|z| z.abs() < 0.15)
        };
        while activation == Activation::Relu && near_kink(&inputs) {
            inputs = draw();
        }
        let inputs = inputs.to_vec();
        let weights = random((3, 7, 4), &mut rng);
        check_gradients(inputs, |inputs, taped| {
            let [x, w, b] = inputs else { unreachable!() };
            if taped {
                let y = ops::dense(x.clone().leaky_traced(), w, b, activation, Grad::Both);
                let loss = scalar(y, &weights);
                (loss.array(), Some(loss.backward()))
            } else {
                (scalar(ops::dense(x.clone(), w, b, activation, Grad::Both), &weights).array(), None)
            }
        });
    }
}

/// The gradient of any operation on several tensors, of which the first carries the tape.
macro_rules! check_operation {
    ($inputs:expr, |$x:ident, $rest:pat_param| $operation:expr) => {{
        let inputs: Vec<Tensor3> = $inputs;
        let result = |$x: Tensor3, rest: &[Tensor3]| {
            let $rest = rest else { unreachable!() };
            $operation
        };
        let &shape = result(inputs[0].clone(), &inputs[1..]).shape();
        let weights = random(shape, &mut rng::stream(99, "weights"));
        check_gradients(inputs, |inputs, taped| {
            let $rest = &inputs[1..] else { unreachable!() };
            if taped {
                let $x = inputs[0].clone().leaky_traced();
                let loss = scalar($operation, &weights);
                (loss.array(), Some(loss.backward()))
            } else {
                let $x = inputs[0].clone();
                (scalar($operation, &weights).array(), None)
            }
        });
    }};
}

#[test]
fn gradients_of_normalisation() {
    let mut rng = rng::stream(2, "norm");
    // Nineteen features: one full vector and a rest.
    let mut draw = |rows: usize| random((2, rows, 19), &mut rng);
    for activation in [Activation::Identity, Activation::Silu, Activation::Mish] {
        check_operation!(vec![draw(6), draw(1), draw(1)], |x, [gain, shift]| norm::layer_norm(
            x,
            gain,
            shift,
            activation,
            Grad::Both
        ));
        check_operation!(vec![draw(6), draw(1)], |x, [gain]| norm::rms_norm(x, gain, activation, Grad::Both));
    }
}

/// For one draw of what is dropped, the gradients of normalised critics with dropout (DroQ) are those of the function that is left.
#[test]
fn gradients_of_a_network_with_dropout() {
    let config = MlpConfig {
        members: 2,
        input: 3,
        hidden: vec![12, 12],
        output: Some(1),
        norm: Norm::Layer,
        activation: Activation::Mish,
        init: Init::Uniform,
    };
    let network = Mlp::new(&device(), &config, &mut rng::stream(4, "network"));
    let mut parameters: Vec<Tensor3> = network.parameters().into_iter().map(|(_, p)| p.clone()).collect();
    parameters.insert(0, random((1, 5, 3), &mut rng::stream(4, "x")));
    let weights = random((2, 5, 1), &mut rng::stream(4, "weights"));
    check_gradients(parameters, |given, taped| {
        let mut network = network.clone();
        network.parameters_mut().into_iter().zip(&given[1..]).for_each(|((_, p), given)| *p = given.clone());
        let dropped = &mut rng::stream(4, "dropout");
        if taped {
            let x = given[0].clone().leaky_traced();
            let loss = scalar(network.forward_with_dropout(x, Grad::Both, 0.3, dropped), &weights);
            (loss.array(), Some(loss.backward()))
        } else {
            let y = network.forward_with_dropout(given[0].clone(), Grad::Both, 0.3, dropped);
            (scalar(y, &weights).array(), None)
        }
    });
}

/// Numbers computed in float64 from the reference's formula.
#[test]
fn root_mean_square_normalisation_is_the_references() {
    let x = tensor(&device(), vec![1.0, -2.0, 0.5, 3.0], (1, 1, 4));
    let gain = tensor(&device(), vec![1.0; 4], (1, 1, 4));
    for (activation, expected) in [
        (Activation::Identity, [0.529_805_51, -1.059_611_01, 0.264_902_75, 1.589_416_52]),
        (Activation::Silu, [0.333_479_59, -0.272_726_71, 0.149_892_87, 1.320_064_45]),
    ] {
        let y = norm::rms_norm(x.clone(), &gain, activation, Grad::Input);
        values(&y).iter().zip(expected).for_each(|(y, expected)| near("normalised", *y, expected, 1e-6));
    }
}

/// Numbers computed in float64 from the reference's formula.
#[test]
fn layer_normalisation_with_mish_is_the_references() {
    let x = tensor(&device(), vec![1.0, 2.0, -1.0, 0.5], (1, 1, 4));
    let [gain, shift] = [1.0, 0.0].map(|number| tensor(&device(), vec![number; 4], (1, 1, 4)));
    for (activation, expected) in [
        (Activation::Identity, [0.346_409, 1.270_165, -1.501_104, -0.115_470]),
        (Activation::Mish, [0.244_931, 1.153_672, -0.298_029, -0.064_999]),
    ] {
        let y = norm::layer_norm(x.clone(), &gain, &shift, activation, Grad::Input);
        values(&y).iter().zip(expected).for_each(|(y, expected)| near("normalised", *y, expected, 1e-5));
    }
}

#[test]
fn gradients_of_simplicial_normalisation() {
    check_operation!(vec![random((2, 3, 8), &mut rng::stream(13, "simplices"))], |x, []| simnorm::sim_norm(x, 4));
}

#[test]
fn gradients_of_rows() {
    let mut rng = rng::stream(10, "rows");
    let mut draw = |rows: usize| random((1, rows, 3), &mut rng);
    check_operation!(vec![draw(5)], |x, []| ops::rows(x, 1, 3));
    check_operation!(vec![draw(4)], |x, []| ops::scale_rows(x, &[0.5, 0.0, -2.0, 1.0]));
    check_operation!(vec![draw(4)], |x, []| ops::rowwise(x, |row, x, slope| {
        let factor = 1.0 + row as f32;
        slope.iter_mut().zip(x).for_each(|(slope, x)| *slope = 2.0 * factor * x);
        factor * x.iter().map(|x| x * x).sum::<f32>()
    }));
    check_operation!(vec![random((3, 4, 2), &mut rng::stream(14, "mean"))], |x, []| ops::mean_of_members(x));
    check_operation!(vec![draw(2), draw(3)], |x, [other]| {
        let (x, tape) = x.split_tape();
        ops::stack(tape, &[x, other.clone()])
    });
    check_operation!(vec![random((2, 4, 6), &mut rng::stream(11, "gates"))], |x, []| ops::gated(x));
}

#[test]
fn a_total_is_a_weighted_sum_of_means() {
    let (a, b) = (tensor(&device(), vec![1.0, 3.0], (1, 2, 1)), tensor(&device(), vec![5.0], (1, 1, 1)));
    let total = ops::total(OwnedTape::default(), &[(2.0, a.clone()), (0.5, b.clone())]);
    assert_eq!(total.array(), 6.5);
    let mut gradients = total.backward();
    assert_eq!(**gradients.get_or_alloc_mut(&a).expect("memory"), [1.0, 1.0]);
    assert_eq!(**gradients.get_or_alloc_mut(&b).expect("memory"), [0.5]);
}

#[test]
fn gradients_of_the_block_gru() {
    let mut rng = rng::stream(11, "gru");
    let (blocks, state, second) = (2, 6, 4);
    let layer = BlockDense::new(&device(), blocks, state, second, 3 * state, &mut rng);
    let parameters: Vec<Tensor3> = layer.parameters().into_iter().map(|(_, p)| p.clone()).collect();
    let inputs: Vec<Tensor3> = [random((1, 5, state), &mut rng), random((1, 5, second), &mut rng)]
        .into_iter()
        .chain(parameters.iter().map(|p| random(*p.shape(), &mut rng)))
        .collect();
    let with = |parameters: &[Tensor3]| {
        let mut layer = layer.clone();
        layer.parameters_mut().into_iter().zip(parameters).for_each(|((_, own), given)| *own = given.clone());
        layer
    };
    check_operation!(inputs, |x, [second, weight, bias, of_second]| {
        let (state, mut tape) = x.split_tape();
        let layer = with(&[weight.clone(), bias.clone(), of_second.clone()]);
        let gates = layer.on(&mut tape, &state, Some(second));
        recurrent::gru(&mut tape, &gates, &state, blocks).put_tape(tape)
    });
}

#[test]
fn gradients_of_two_hot_losses() {
    let bins = SymexpBins::new(15, 3.0);
    let mut rng = rng::stream(12, "two-hot");
    let (one, other) = ([0.3, -5.0, 40.0, 0.0], [1.0, 2.0, -3.0, 0.1]);
    check_operation!(vec![random((1, 4, 15), &mut rng)], |x, []| {
        let (x, mut tape) = x.split_tape();
        bins.loss(&mut tape, &x, &[&one, &other]).put_tape(tape)
    });
}

#[test]
fn gradients_of_regression_over_symlog_bins() {
    let bins = SymlogBins::new(15, 3.0);
    let logits = || vec![random((2, 4, 15), &mut rng::stream(15, "symlog"))];
    check_operation!(logits(), |x, []| {
        let (x, mut tape) = x.split_tape();
        bins.loss(&mut tape, &x, &[0.3, -5.0, 40.0, 0.0]).put_tape(tape)
    });
    check_operation!(logits(), |x, []| {
        let (x, mut tape) = x.split_tape();
        bins.decode_on(&mut tape, &x).put_tape(tape)
    });
}

/// TD-MPC2's encoder learns more slowly than the rest, under the same clipped norm.
#[test]
fn a_part_of_a_module_learns_more_slowly() {
    let mut module = Mlp::tdmpc(&device(), 1, 2, &[3], Some(1), &mut rng::stream(16, "slower"));
    let before: Vec<Vec<f32>> = module.parameters().iter().map(|(_, p)| values(p).to_vec()).collect();
    let mut gradients = dfdx::tensor::Gradients::leaky();
    for (_, parameter) in module.parameters() {
        gradients.get_or_alloc_mut(parameter).expect("memory").fill(3.0);
    }
    let config = AdamConfig { max_norm: Some(1.0), ..AdamConfig::new(0.01) };
    Adam::new(config).with_slower("0.", 0.3).step(&mut module, &mut gradients);
    for ((name, after), before) in module.parameters().into_iter().zip(before) {
        let step = if name.starts_with("0.") { 0.003 } else { 0.01 };
        for (after, before) in values(after).iter().zip(before) {
            near(&name, before - after, step, 1e-5);
        }
    }
}

/// Numbers computed in float64 from the reference's formulas: three steps of LaProp after adaptive clipping.
#[test]
fn laprop_steps_as_the_reference() {
    let mut module = norm::RmsNorm::new(&device(), 3);
    module.parameters_mut()[0].1.copy_from(&[0.5, -0.3, 0.2]);
    let mut optimiser = Adam::new(AdamConfig { warm_up: 0, ..AdamConfig::laprop(0.01) });
    let steps = [
        ([1.0, -0.2, 0.05], [0.49, -0.29, 0.19]),
        ([-0.3, 0.01, 0.02], [0.490_503_71, -0.286_476_93, 0.179_327_44]),
        ([0.0, 0.1, -0.04], [0.490_821_55, -0.290_251_31, 0.178_574_43]),
    ];
    for (gradient, expected) in steps {
        let mut gradients = dfdx::tensor::Gradients::leaky();
        gradients.get_or_alloc_mut(module.parameters()[0].1).expect("memory").copy_from_slice(&gradient);
        optimiser.step(&mut module, &mut gradients);
        let found = values(module.parameters()[0].1).to_vec();
        found.iter().zip(expected).for_each(|(w, expected)| near("weight", *w, expected, 1e-6));
    }
}

#[test]
fn gradients_of_joining() {
    let mut rng = rng::stream(3, "join");
    let inputs = vec![random((2, 4, 3), &mut rng), random((2, 4, 2), &mut rng)];
    let weights = random((2, 4, 5), &mut rng);
    check_gradients(inputs, |inputs, taped| {
        let [a, b] = inputs else { unreachable!() };
        if taped {
            let loss = scalar(ops::join(a.clone().leaky_traced(), b.clone()), &weights);
            (loss.array(), Some(loss.backward()))
        } else {
            (scalar(ops::join(a.clone(), b.clone()), &weights).array(), None)
        }
    });
}

#[test]
fn frozen_parameters_get_no_gradient() {
    let mut rng = rng::stream(4, "frozen");
    let (x, w, b) = (random((1, 7, 5), &mut rng), random((2, 5, 4), &mut rng), random((2, 1, 4), &mut rng));
    let y = ops::dense(x.clone().leaky_traced(), &w, &b, Activation::Relu, Grad::Input);
    let mut gradients = y.square().sum::<Rank0, _>().backward();
    assert!(gradients.get_or_alloc_mut(&w).expect("memory").iter().all(|g| *g == 0.0));
    assert!(gradients.get_or_alloc_mut(&b).expect("memory").iter().all(|g| *g == 0.0));
    assert!(gradients.get_or_alloc_mut(&x).expect("memory").iter().any(|g| *g != 0.0));
}

/// mu = [0.3, -1.2], log std = [-0.5, 0.2], eps = [0.7, -1.5].
#[test]
fn the_squashed_gaussian_has_the_right_density() {
    let cpu = device();
    let mean = tensor(&cpu, vec![0.3, -1.2], (1, 1, 2));
    let log_std = tensor(&cpu, vec![-0.5, 0.2], (1, 1, 2));
    let noise = tensor(&cpu, vec![0.7, -1.5], (1, 1, 2));
    let distribution = SquashedGaussian { mean: mean.leaky_trace(), log_std: log_std.leaky_trace() };
    let (action, log_density) = distribution.sample(noise);
    near("action", values(&action)[0], 0.619_732_99, 1e-6);
    near("action", values(&action)[1], -0.995_361_59, 1e-6);
    near("log density", log_density.as_vec()[0], 2.259_300_94, 1e-5);
    let mut gradients = log_density.sum::<Rank0, _>().backward();
    let mut check = |of: &Tensor3, expected: [f64; 2]| {
        let found = gradients.get_or_alloc_mut(of).expect("memory").to_vec();
        found.iter().zip(expected).for_each(|(g, e)| near("gradient", *g, e, 1e-5));
    };
    check(&mean, [1.239_465_98, -1.990_723_17]);
    check(&log_std, [-0.473_758_12, 2.647_212_16]);
}

/// ln(1 - tanh(u)^2), where the form ln(1 - a^2 + 1e-6) has long saturated.
#[test]
fn the_density_is_exact_far_out() {
    let cpu = device();
    for (u, expected) in [
        (0.0, 0.0),
        (1.0, -0.867_561_66),
        (-3.0, -4.618_657_01),
        (8.0, -14.613_705_86),
        (20.0, -38.613_705_64),
        (-20.0, -38.613_705_64),
    ] {
        // With std = 1 and eps = 0 the Gaussian part is -ln(2 pi) / 2.
        let zero = tensor(&cpu, vec![0.0], (1, 1, 1));
        let mean = tensor(&cpu, vec![u], (1, 1, 1));
        let (_, log_density) = SquashedGaussian { mean, log_std: zero.clone() }.sample(zero);
        let squash = -0.5 * (2.0 * std::f64::consts::PI).ln() - f64::from(log_density.as_vec()[0]);
        near(&format!("u = {u}"), squash as f32, expected, 2e-6);
    }
}

#[test]
fn log_std_stays_in_its_range_with_a_gradient() {
    let head = tensor(&device(), vec![0.0, 0.0, -2.0, 2.0], (1, 1, 4));
    let distribution = SquashedGaussian::from_head(head.leaky_trace());
    let log_std = values(&distribution.log_std).to_vec();
    assert!(log_std.iter().all(|x| (-5.0..=2.0).contains(x)), "{log_std:?}");
    let mut gradients = distribution.log_std.sum::<Rank0, _>().backward();
    let gradient = gradients.get_or_alloc_mut(&head).expect("memory").to_vec();
    assert!(gradient[2] > 0.1 && gradient[3] > 0.1 && gradient[..2] == [0.0; 2], "{gradient:?}");
}

fn network(members: usize, norm: Norm, seed: u64) -> Mlp {
    let config = MlpConfig {
        members,
        input: 3,
        hidden: vec![16, 16],
        output: Some(2),
        norm,
        activation: Activation::Relu,
        init: Init::Uniform,
    };
    Mlp::new(&device(), &config, &mut rng::stream(seed, "network"))
}

/// One member of several is the same network as it would be alone.
#[test]
fn members_do_not_mix() {
    let both = network(2, Norm::Layer, 0);
    let x = random((1, 5, 3), &mut rng::stream(5, "x"));
    let y = both.forward(x.clone(), Grad::Input);
    let mut alone = network(1, Norm::Layer, 1);
    for member in 0..2 {
        for ((_, mine), (_, ours)) in alone.parameters_mut().into_iter().zip(both.parameters()) {
            let size = values(ours).len() / 2;
            mine.copy_from(&values(ours)[member * size..][..size]);
        }
        let own = alone.forward(x.clone(), Grad::Input);
        assert_eq!(values(&own), &values(&y)[member * 10..][..10]);
    }
}

/// Adam against PyTorch's formula, spelt out for one number over three steps.
#[test]
fn adam_steps_as_in_the_paper() {
    let mut module = network(1, Norm::None, 2);
    let start = values(module.parameters()[0].1)[0];
    let mut adam = Adam::new(AdamConfig::new(1e-2));
    let (mut m, mut v, mut expected) = (0.0, 0.0, f64::from(start));
    for (t, g) in [(1, 0.5), (2, -0.2), (3, 0.05)] {
        let mut gradients = dfdx::tensor::Gradients::leaky();
        for (_, parameter) in module.parameters() {
            gradients.get_or_alloc_mut(parameter).expect("memory").fill(g as f32);
        }
        adam.step(&mut module, &mut gradients);
        m = 0.9 * m + 0.1 * g;
        v = 0.999 * v + 0.001 * g * g;
        expected -= 1e-2 * (m / (1.0 - 0.9_f64.powi(t))) / ((v / (1.0 - 0.999_f64.powi(t))).sqrt() + 1e-8);
        near("parameter", values(module.parameters()[0].1)[0], expected, 1e-6);
    }
}

#[test]
fn clipping_scales_the_whole_gradient() {
    let mut module = network(1, Norm::None, 3);
    let config = AdamConfig { max_norm: Some(1.0), epsilon: 1.0, ..AdamConfig::new(1.0) };
    let mut gradients = dfdx::tensor::Gradients::leaky();
    let mut count = 0;
    for (_, parameter) in module.parameters() {
        let gradient = gradients.get_or_alloc_mut(parameter).expect("memory");
        gradient.fill(2.0);
        count += gradient.len();
    }
    let before = values(module.parameters()[0].1)[0];
    let norm = Adam::new(config).step(&mut module, &mut gradients);
    near("norm", norm, 2.0 * (count as f64).sqrt(), 1e-5);
    // With epsilon 1, the first step is g / (|g| + 1).
    let clipped = 1.0 / (count as f64).sqrt();
    near("step", before - values(module.parameters()[0].1)[0], clipped / (clipped + 1.0), 1e-4);
}

/// TD-MPC2's limit: a gradient of norm 50 is multiplied by 0.4.
#[test]
fn a_gradient_of_norm_50_is_clipped_to_20() {
    let mut module = norm::RmsNorm::new(&device(), 2);
    module.parameters_mut()[0].1.copy_from(&[0.0, 0.0]);
    let mut gradients = dfdx::tensor::Gradients::leaky();
    gradients.get_or_alloc_mut(module.parameters()[0].1).expect("memory").copy_from_slice(&[30.0, -40.0]);
    let config = AdamConfig { max_norm: Some(20.0), epsilon: 1.0, ..AdamConfig::new(1.0) };
    near("norm", Adam::new(config).step(&mut module, &mut gradients), 50.0, 1e-6);
    // With epsilon 1, the first step is g / (|g| + 1).
    let found = values(module.parameters()[0].1).to_vec();
    near("step", -found[0], 12.0 / 13.0, 1e-5);
    near("step", -found[1], -16.0 / 17.0, 1e-5);
}

#[test]
fn a_group_lasso_shortens_the_weights_of_an_input() {
    let before = network(2, Norm::None, 5);
    let mut after = before.clone();
    let norms = |network: &Mlp, member: usize| -> Vec<f32> {
        let (weight, bias) = network.layers_of(member).next().expect("a layer");
        weight.chunks_exact(bias.len()).map(|row| row.iter().map(|w| w * w).sum::<f32>().sqrt()).collect()
    };
    let inputs = norms(&before, 0).len();
    let mut coefficients = vec![0.0; inputs];
    (coefficients[0], coefficients[1]) = (2.5, 1e4);
    GroupLasso { coefficients }.step(&mut after, 0.1);
    for member in 0..2 {
        let (before, after) = (norms(&before, member), norms(&after, member));
        assert!((before[0] - after[0] - 0.25).abs() < 1e-5, "{} to {}", before[0], after[0]);
        assert_eq!(after[1], 0.0);
        assert_eq!(before[2..], after[2..]);
    }
}

#[test]
fn targets_follow_by_polyak() {
    let (mut target, mut source) = (network(1, Norm::None, 4), network(1, Norm::None, 5));
    target.parameters_mut().into_iter().for_each(|(_, p)| p.copy_from(&vec![1.0; values(p).len()]));
    source.parameters_mut().into_iter().for_each(|(_, p)| p.copy_from(&vec![2.0; values(p).len()]));
    polyak(&mut target, &source, 0.005);
    near("one step", values(target.parameters()[0].1)[0], 1.005, 1e-6);
    (1..100).for_each(|_| polyak(&mut target, &source, 0.005));
    near("a hundred steps", values(target.parameters()[0].1)[0], 1.394_229_56, 1e-5);
    copy_parameters(&mut target, &source);
    assert_eq!(values(target.parameters()[0].1)[0], 2.0);
}

#[test]
fn weights_survive_a_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("deep/weights.safetensors");
    let (saved, mut loaded) = (network(2, Norm::Layer, 6), network(2, Norm::Layer, 7));
    let mut weights = Weights::default();
    weights.insert_module("critics", &saved);
    weights.insert_counts("counts", &[u64::MAX, 0, 123_456_789_012_345]);
    weights.set_note("progress", "{}".into());
    weights.write(&path).expect("a writable folder");
    let read = Weights::read(&path).expect("what was just written");
    read.load_module("critics", &mut loaded).expect("the same shapes");
    for ((_, a), (_, b)) in saved.parameters().iter().zip(loaded.parameters()) {
        assert_eq!(values(a), values(b));
    }
    assert_eq!(read.counts("counts", 3).expect("three"), [u64::MAX, 0, 123_456_789_012_345]);
    assert_eq!(read.note("progress"), Some("{}"));
}

#[test]
fn foreign_weights_are_refused_and_change_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("weights.safetensors");
    std::fs::write(&path, b"no weights at all").expect("a writable folder");
    let problem = Weights::read(&path).expect_err("a damaged file").to_string();
    assert!(problem.contains("weights.safetensors") && problem.contains("damaged"), "{problem}");
    // Another shape.
    let mut weights = Weights::default();
    weights.insert_module("critics", &network(2, Norm::None, 8));
    let mut other = network(1, Norm::None, 9);
    let before = values(other.parameters()[0].1).to_vec();
    let problem = weights.load_module("critics", &mut other).expect_err("other shapes").to_string();
    assert!(problem.contains("critics.0.weight"), "{problem}");
    assert_eq!(values(other.parameters()[0].1), before);
}
