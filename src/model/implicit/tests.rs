use super::*;
use crate::env::{Env, Feature, Task};
use crate::nn::two_hot::symexp;
use crate::nn::{Parameters, ops, tensor, values, values_mut};
use crate::replay::SequenceBatch;
use crate::rng;

/// Planning's fast path gives the returns of the model itself, for counts that fill no panel.
#[test]
fn frozen_returns_are_those_of_the_model() {
    [false, true].into_iter().for_each(frozen_returns);
}

fn frozen_returns(residual: bool) {
    let mut env = Task::Cartpole.make();
    let config = ImplicitConfig {
        latent: 24,
        group: 4,
        units: 33,
        critics: 3,
        bins: 51,
        bin_limit: 5.0,
        terminates: true,
        residual,
        ..ImplicitConfig::default()
    };
    let mut rng = rng::stream(0, "frozen model");
    let mut model = ImplicitModel::new(env.spec(), &config, &mut rng);
    let mut policy = PolicyPrior::new(model.device(), 24, 33, 1, &mut rng);
    let parameters = model.parameters_mut().into_iter().chain(policy.parameters_mut());
    for (_, parameter) in parameters {
        let moved: Vec<f32> = values(parameter).iter().map(|w| w + 0.2 * rng::normal(&mut rng) as f32).collect();
        parameter.copy_from(&moved);
    }
    let (count, horizon, discount, pair) = (45, 4, 0.9, [2, 0]);
    let z = model.encode(&env.reset(0));
    let sequences: Vec<f32> = rng::normals(count * horizon, &mut rng).iter().map(|a| a.tanh()).collect();
    let noise = rng::normals(count, &mut rng);
    let column = |t: usize| {
        let actions = sequences.iter().skip(t).step_by(horizon).copied().collect();
        tensor(&device(), actions, (1, count, 1))
    };
    let start = tensor(model.device(), values(&z).repeat(count), (1, count, 24));
    // Moves the head so that half of the rollouts end at some step.
    let ends = |model: &ImplicitModel, z: &Tensor3| {
        values(&model.termination.as_ref().expect("a head").forward(z.clone(), Grad::Input)).to_vec()
    };
    let (mut state, mut highest) = (start.clone(), vec![f32::NEG_INFINITY; count]);
    for t in 0..horizon {
        state = model.next(&mut NoneTape, &state, &column(t));
        highest.iter_mut().zip(ends(&model, &state)).for_each(|(highest, logit)| *highest = highest.max(logit));
    }
    highest.sort_by(f32::total_cmp);
    let mut heads = model.termination.parameters_mut();
    values_mut(heads.last_mut().expect("the last bias").1)[0] -= 0.5 * (highest[count / 2 - 1] + highest[count / 2]);
    let frozen = FrozenModel::new(&model, &policy);
    let found = frozen.returns(values(&z), &sequences, horizon, &noise, pair, discount);
    assert_eq!(found.len(), count);

    let mut state = start.clone();
    let (mut expected, mut alive) = (vec![0.0; count], vec![1.0; count]);
    for t in 0..=horizon {
        let (actions, values_of) = if t < horizon {
            (column(t), model.rewards(&state, &column(t)))
        } else {
            let actions = policy.sample_on(&mut NoneTape, &state, &noise, EntropyBonus::Gaussian).0;
            let critics = model.critics().subset(model.device(), &pair);
            let q = model.values(&critics, &state, &actions);
            (actions, (0..count).map(|i| 0.5 * (q[i] + q[count + i])).collect())
        };
        for i in 0..count {
            expected[i] += alive[i] * discount.powi(t as i32) * values_of[i];
        }
        if t < horizon {
            state = model.next(&mut NoneTape, &state, &actions);
            let ends = ends(&model, &state);
            (0..count).filter(|i| ends[*i] > 0.0).for_each(|i| alive[i] = 0.0);
        }
    }
    assert!(alive.contains(&0.0) && alive.contains(&1.0), "some end and some do not");
    for (i, (found, expected)) in found.iter().zip(&expected).enumerate() {
        assert!((found - expected).abs() < 1e-3 * expected.abs().max(1.0), "{i}: {found}, expected {expected}");
    }

    // The policy's first actions, too.
    let noise = rng::normals(count * horizon, &mut rng);
    let proposed = frozen.policy_sequences(values(&z), horizon, &noise);
    let first: Vec<f32> = noise.iter().step_by(horizon).copied().collect();
    let expected = policy.sample_on(&mut NoneTape, &start, &first, EntropyBonus::Gaussian).0;
    for (found, expected) in proposed.iter().step_by(horizon).zip(values(&expected)) {
        assert!((found - expected).abs() < 1e-4, "{found}, expected {expected}");
    }
}

/// The reference's losses of three time steps, in two slices that are alike. Untrained heads say the same of every state, so that
/// their biases and the targets set the cross-entropies.
#[test]
fn later_steps_of_a_rollout_count_less() {
    let spec = Spec::new("reference", [Feature::new("place")], 1, 100, 0.05);
    let config = ImplicitConfig { bins: 5, bin_limit: 2.0, ..ImplicitConfig::default() };
    let mut model = ImplicitModel::new(&spec, &config, &mut rng::stream(0, "losses"));
    // Of the bins -1, 0 and 1, in symlog space. The outermost share the rest of the probability.
    let logits = |losses: [f32; 3]| {
        let [one, two, three] = losses.map(|loss| -loss);
        let rest = (0.5 * (1.0 - one.exp() - two.exp() - three.exp())).ln();
        [rest, one, two, three, rest]
    };
    for (name, parameter) in model.parameters_mut() {
        match name.as_str() {
            "reward.2.bias" => parameter.copy_from(&logits([1.2, 0.8, 3.0])),
            "critics.2.bias" => parameter.copy_from(&[logits([4.0, 3.0, 2.0]), logits([4.4, 3.2, 2.2])].concat()),
            _ => {}
        }
    }
    let rows = |numbers: [f32; 3]| numbers.map(|x| [symexp(x); 2]).concat();
    let batch = SequenceBatch {
        sequences: 2,
        length: 4,
        obs: vec![0.3; 8],
        actions: vec![0.5; 8],
        // Halfway between two bins, the loss is the mean of theirs.
        rewards: [vec![0.0; 2], rows([-1.0, -0.5, 0.0])].concat(),
        ..SequenceBatch::default()
    };
    let loss = |encoded: Vec<f32>| {
        let encoded = tensor(&device(), encoded, (1, 6, config.latent));
        model.loss(&mut NoneTape, &batch, &encoded, &rows([-1.0, 0.0, 1.0]))
    };
    // The rollout does not depend on what it is compared with: states at these squared distances from it, per number.
    let rollout = loss(vec![0.0; 6 * config.latent]).latents;
    let beside = rollout[1..].iter().zip([0.004_f32, 0.003, 0.002]);
    let beside = beside.flat_map(|(z, square)| values(z).iter().map(move |z| z + square.sqrt()));
    let loss = loss(beside.collect());
    for (found, expected) in [
        (ops::mean(&loss.consistency), 0.002),
        (ops::mean(&loss.reward), 0.633_333),
        (ops::mean(&loss.value), 2.091_667),
        (ops::total(NoneTape, &loss.weighted(&config)).array(), 0.312_5),
    ] {
        assert!((found - expected).abs() < 1e-5 * expected, "{found}, expected {expected}");
    }
}

/// No gradient reaches the encoder's targets, and a model that does not change predicts no change.
#[test]
fn drift_is_one_for_a_model_that_predicts_no_change() {
    let cpu = device();
    let (first, truth) = (tensor(&cpu, vec![0.5, 0.5], (1, 1, 2)), tensor(&cpu, vec![0.2, 0.8, 0.1, 0.9], (1, 2, 2)));
    let none = ops::scale_rows(first.clone(), &[0.0]);
    let loss = |latents: Vec<Tensor3>| ImplicitLoss {
        consistency: none.clone(),
        reward: none.clone(),
        value: none.clone(),
        termination: None,
        latents,
    };
    assert_eq!(loss(vec![first.clone(), first.clone(), first.clone()]).drift(&truth), 1.0);
    assert_eq!(loss(vec![first.clone(), first, tensor(&cpu, vec![0.1, 0.9], (1, 1, 2))]).drift(&truth), 0.0);
}
