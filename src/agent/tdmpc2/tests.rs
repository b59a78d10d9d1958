use dfdx::prelude::*;
use dfdx::tensor::Gradients;

use super::*;
use crate::agent::Diagnostics;
use crate::env::{Feature, Task};
use crate::model::{EntropyBonus, ImplicitConfig};
use crate::nn::two_hot::symexp;
use crate::nn::{Parameters, TapeOps, Tensor3, device, ops, tensor, values, values_mut};
use crate::plan::GuidedConfig;
use crate::replay::{Episode, SequenceBatch};

const O: usize = 4;
const A: usize = 2;
const SIZE: usize = 8;

/// The networks of the end-to-end reference: weight k is 0.4 sin(1.3 k + 0.5), biases 0, gains 1; the target critics have 0.9
/// times every number of the critics.
fn reference() -> Networks {
    let spec = Spec::new("reference", (0..O).map(|i| Feature::new(i.to_string())), A, 100, 0.05);
    let model = ImplicitConfig {
        latent: SIZE,
        encoder: SIZE,
        units: SIZE,
        critics: 3,
        bins: 101,
        bin_limit: 10.0,
        ..ImplicitConfig::default()
    };
    let config = TdMpc2Config { model, ..TdMpc2Config::default() };
    let mut networks = Networks::new(&spec, &config, &mut rng::stream(0, "reference"));
    let mut k = 0;
    // The reference counts critic by critic, and stores matrices `[output, input]`.
    let mut fill = |name: &str, parameter: &mut Tensor3, member: usize| {
        let &(members, inputs, outputs) = parameter.shape();
        let numbers = &mut values_mut(parameter)[member * inputs * outputs..][..inputs * outputs];
        assert!(member < members);
        if name.ends_with("weight") {
            for (o, i) in (0..outputs).flat_map(|o| (0..inputs).map(move |i| (o, i))) {
                numbers[i * outputs + o] = (0.4 * (1.3 * f64::from(k) + 0.5).sin()) as f32;
                k += 1;
            }
        } else {
            numbers.fill(if name.ends_with("gain") { 1.0 } else { 0.0 });
        }
    };
    let Networks { model, policy, target, .. } = &mut networks;
    for part in ["encoder.", "dynamics.", "reward."] {
        let own = model.parameters_mut().into_iter().filter(|(name, _)| name.starts_with(part));
        own.for_each(|(name, parameter)| fill(&name, parameter, 0));
    }
    policy.parameters_mut().into_iter().for_each(|(name, parameter)| fill(&name, parameter, 0));
    for member in 0..3 {
        let own = model.parameters_mut().into_iter().filter(|(name, _)| name.starts_with("critics."));
        own.for_each(|(name, parameter)| fill(&name, parameter, member));
    }
    assert_eq!(k, 4272);
    copy_parameters(target, model.critics());
    for (_, parameter) in target.parameters_mut() {
        values_mut(parameter).iter_mut().for_each(|number| *number *= 0.9);
    }
    networks
}

fn batch() -> SequenceBatch {
    let (sequences, length) = (2, 3);
    let numbers = |count: usize, f: fn(f64) -> f64| (0..count).map(|j| f(j as f64) as f32).collect::<Vec<f32>>();
    let mut rewards = vec![0.0; sequences];
    rewards.extend(numbers(sequences * (length - 1), |j| 0.5 + 0.5 * (1.7 * j).cos()));
    let mut actions = numbers(sequences * (length - 1) * A, |j| (2.1 * j + 1.0).sin());
    actions.extend([0.0; 2 * A]);
    SequenceBatch {
        sequences,
        length,
        // The networks read the symlog of observations.
        obs: numbers(sequences * length * O, |j| (0.9 * j).cos()).into_iter().map(symexp).collect(),
        actions,
        rewards,
        first: vec![false; sequences * length],
        last: vec![false; sequences * length],
        terminal: vec![false; sequences * length],
    }
}

fn near(what: &str, found: f32, expected: f64) {
    let error = (f64::from(found) - expected).abs();
    assert!(error < 2e-5 * expected.abs().max(1.0), "{what}: {found}, expected {expected}");
}

fn norm<'a>(gradients: &Gradients<f32, Cpu>, parameters: impl Iterator<Item = &'a Tensor3>) -> f32 {
    let squares = parameters.map(|parameter| gradients.get(parameter).as_vec().iter().map(|g| g * g).sum::<f32>());
    squares.sum::<f32>().sqrt()
}

/// Numbers computed in float64 from the published code: latent states, value targets, losses and gradients of one update, with
/// all noise 0.3 and the critics 1 and 2.
#[test]
fn an_update_is_the_references() {
    let networks = reference();
    let Networks { model, policy, target, .. } = &networks;
    let (batch, noise) = (batch(), [0.3; 12]);
    let pair = [0, 1];
    let expected = [0.022_674, 0.188_015, 0.133_075, 0.023_650, 0.232_114, 0.100_721, 0.026_185, 0.273_565];
    let z = model.encode(&batch.obs);
    values(&z).iter().zip(expected).for_each(|(z, expected)| near("z", *z, expected));

    let encoded = NoneTape.rows(&z, 2, 4);
    let actions = policy.sample_on(&mut NoneTape, &encoded, &noise[..8], EntropyBonus::Gaussian).0;
    let q = model.values(&target.subset(&device(), &pair), &encoded, &actions);
    let targets = update::bootstrapped(&batch, &q, 0.95, 1);
    targets.iter().zip([0.981_567, 0.452_613, 0.030_633, 0.663_528]).for_each(|(y, expected)| near("y", *y, expected));

    let mut tape = OwnedTape::default();
    let loss = model.loss(&mut tape, &batch, &encoded, &targets);
    near("consistency", ops::mean(&loss.consistency), 0.017_519);
    near("reward", ops::mean(&loss.reward), 3.555_890);
    near("value", ops::mean(&loss.value), 3.554_769);
    let total = ops::total(tape, &loss.weighted(model.config()));
    near("total", total.array(), 1.061_453);
    let gradients = total.backward();
    let of = |part: &'static str| {
        let own = model.parameters().into_iter().filter(move |(name, _)| name.starts_with(part));
        norm(&gradients, own.map(|(_, parameter)| parameter))
    };
    for (part, expected) in [
        ("encoder", 0.227_024),
        ("dynamics", 3.295_909),
        ("reward", 0.106_624),
        ("critics", 0.059_289),
        ("", 3.305_970),
    ] {
        near(part, of(part), expected);
    }

    let mut tape = OwnedTape::default();
    let latents = NoneTape.stack(&loss.latents);
    let mut scale = RunningScale::default();
    let loss = networks.climb(&mut tape, &latents, &noise, pair, 2, &TdMpc2Config::default(), &mut scale);
    near("policy", ops::mean(&loss.climb) + ops::mean(&loss.entropy), -0.000_994);
    let gradients = ops::total(tape, &[(1.0, loss.climb), (1.0, loss.entropy)]).backward();
    near("policy's gradient", norm(&gradients, policy.parameters().into_iter().map(|(_, p)| p)), 0.310_840);
}

/// The reference's values and entropies, row by row: untrained critics give every state the value that their bias says, and with an
/// untrained policy, whose deviation is e^-4 for a state of zeros, the entropy follows from the noise.
#[test]
fn the_policys_loss_is_the_references() {
    let spec = Spec::new("reference", [Feature::new("place")], 1, 100, 0.05);
    let model = ImplicitConfig { bins: 3, bin_limit: 4.0, ..ImplicitConfig::default() };
    let config = TdMpc2Config { model, ..TdMpc2Config::default() };
    let mut networks = Networks::new(&spec, &config, &mut rng::stream(0, "policy's loss"));
    let z = tensor(&device(), vec![0.0; 8 * config.model.latent], (1, 8, config.model.latent));
    let entropies = [-3.0_f32, -1.0, -2.0, -2.0, 0.0, 1.0, 2.0, 4.0];
    let noise = entropies.map(|nats| (2.0 * (nats + 4.0) - std::f32::consts::TAU.ln()).sqrt());
    let (mut climb, mut entropy) = (0.0, 0.0);
    for (row, q) in [10.0, 14.0, 11.0, 13.0, 9.0, 15.0, 12.0, 12.0].into_iter().enumerate() {
        let (_, [middle, last]) = networks.model.bins().encode(q);
        let logits = [-1e9, middle.ln(), last.ln()].repeat(2);
        let biases = networks.model.parameters_mut().into_iter().filter(|(name, _)| name == "critics.2.bias");
        biases.for_each(|(_, bias)| bias.copy_from(&logits));
        // Values that are all alike move the scale towards 1: to 2.5.
        let mut scale = RunningScale::new((2.5 - 0.01) / 0.99);
        let loss = networks.climb(&mut OwnedTape::default(), &z, &noise, [0, 1], 2, &config, &mut scale);
        climb += values(&loss.climb)[row] / 8.0;
        entropy += values(&loss.entropy)[row] / 8.0;
    }
    assert!((climb + entropy + 2.249_937).abs() < 1e-5, "{climb} and {entropy}");
    // Entropy is a small part of it.
    assert!((entropy - 6.25e-5).abs() < 1e-9, "{entropy}");
}

/// Two slices of three steps, the second with the end of its task; by hand.
#[test]
fn targets_of_several_steps_end_with_the_slice() {
    let batch = SequenceBatch {
        sequences: 2,
        length: 4,
        rewards: vec![0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
        terminal: [vec![false; 7], vec![true]].concat(),
        ..SequenceBatch::default()
    };
    // The smaller of two critics.
    let q = [[10.0, 20.0, 30.0, 40.0, 50.0, 60.0], [90.0; 6]].concat();
    for (n_step, expected) in [
        (1, [6.0, 12.0, 18.0, 24.0, 30.0, 6.0]),
        (2, [1.0 + 1.5 + 7.5, 2.0 + 2.0 + 10.0, 3.0 + 2.5 + 12.5, 4.0 + 3.0, 30.0, 6.0]),
        (9, [1.0 + 1.5 + 1.25 + 6.25, 2.0 + 2.0 + 1.5, 3.0 + 2.5 + 12.5, 4.0 + 3.0, 30.0, 6.0]),
    ] {
        assert_eq!(update::bootstrapped(&batch, &q, 0.5, n_step), expected, "{n_step} steps");
    }
}

/// What follows from holding an action is not told by a decision that the time limit cut short.
#[test]
fn a_decision_that_was_cut_short_is_not_learned_from() {
    let spec = Spec::new("seven", [Feature::new("time")], 1, 7, 0.05);
    let config = TdMpc2Config { action_repeat: 3, horizon: 2, ..TdMpc2Config::default() };
    let mut agent = TdMpc2::new(&spec, config, 0).expect("usable settings");
    for i in (0..7_u8).chain(0..7) {
        let (now, next) = (f32::from(i), f32::from(i) + 1.0);
        let (obs, next_obs, action) = (vec![now], vec![next], vec![0.0]);
        agent.observe(&Transition { obs, action, reward: next, next_obs, terminated: false, truncated: i == 6 });
    }
    assert_eq!(agent.replay.len(), 6);
    let batch = agent.replay.sample_within_episodes(20, 3, &mut rng::stream(0, "slices")).expect("two whole episodes");
    for (t, (obs, reward)) in [(0.0, 0.0), (3.0, 2.0), (6.0, 5.0)].into_iter().enumerate() {
        let rows = t * 20..(t + 1) * 20;
        assert!(batch.obs[rows.clone()] == [obs; 20] && batch.rewards[rows.clone()] == [reward; 20]);
        assert_eq!(batch.last[rows], [t == 2; 20]);
    }
}

/// Plans go on beyond ends that the model does not predict, and the losses say that there are some.
#[test]
fn ends_that_are_not_modelled_are_counted() {
    let spec = Spec::new("fall", [Feature::new("height")], 1, 4, 0.05);
    for terminates in [false, true] {
        let model = ImplicitConfig { terminates, ..ImplicitConfig::default() };
        let config = TdMpc2Config { model, horizon: 2, batch: 8, ..TdMpc2Config::default() };
        let mut agent = TdMpc2::new(&spec, config, 0).expect("usable settings");
        for i in (0..2_u8).chain(0..2) {
            let [obs, next_obs] = [i, i + 1].map(|height| vec![f32::from(height)]);
            let action = vec![0.0];
            agent.observe(&Transition { obs, action, reward: 0.0, next_obs, terminated: i == 1, truncated: false });
        }
        let losses = agent.learn().expect("two episodes");
        // Every slice of two steps has an end.
        assert_eq!(losses.get("ends_not_modelled").copied(), (!terminates).then_some(1.0));
    }
}

/// An agent that counts quarter rewards in quarters learns and plans as one that counts whole rewards, and its estimates are in
/// the unit of the rewards.
#[test]
fn rewards_are_multiples_of_their_unit() {
    let spec = Spec::new("walk", [Feature::new("place")], 1, 8, 0.05);
    let [mut whole, mut quarters] = [1.0, 0.25].map(|reward_unit| {
        let planner =
            GuidedConfig { population: 16, proposals: 4, elites: 4, iterations: 2, ..GuidedConfig::default() };
        let config = TdMpc2Config { reward_unit, batch: 4, warm_up: 8, planner, ..TdMpc2Config::default() };
        let mut agent = TdMpc2::new(&spec, config, 0).expect("usable settings");
        let mut actions = Vec::<f32>::new();
        for i in 0..16_u8 {
            let (obs, place) = (vec![f32::from(i % 8)], f32::from(i % 8 + 1));
            let action = agent.act(&obs, Mode::Explore);
            let (reward, next_obs) = (reward_unit * place * action[0], vec![place]);
            actions.extend(&action);
            agent.observe(&Transition { obs, action, reward, next_obs, terminated: false, truncated: i % 8 == 7 });
            agent.update();
        }
        (agent, actions)
    });
    assert_eq!(whole.1, quarters.1);
    let slot = Slot { index: 0, first: true, obs: &[3.0], env: &Task::Pendulum.make() };
    let [planned, planned_quarters] = [&mut whole, &mut quarters].map(|(agent, _)| agent.act_and_explain(&slot));
    assert_eq!(planned.0, planned_quarters.0);
    assert!(planned.1.iter().zip(&planned_quarters.1).all(|(one, quarter)| quarter.value == 0.25 * one.value));
    let episode = |rewards: Vec<f32>| Episode {
        observations: vec![vec![0.0], vec![1.0]],
        actions: vec![vec![0.5]],
        rewards,
        terminated: false,
    };
    let [one, quarter] = [(&whole.0, 1.0), (&quarters.0, 0.25)]
        .map(|(agent, reward)| agent.value_estimates(&[episode(vec![reward])])[0]);
    assert_ne!(one.expected, 0.0);
    assert_eq!((quarter.expected, quarter.realised), (0.25 * one.expected, 0.25 * one.realised));
}

/// The mean of a plan is executed in evaluations, and the search, and exploration, are the same.
#[test]
fn the_mean_is_for_evaluations() {
    let spec = Spec::new("seven", [Feature::new("time")], 1, 7, 0.05);
    let agent = |evaluate_mean| {
        let config = TdMpc2Config { evaluate_mean, warm_up: 0, ..TdMpc2Config::default() };
        TdMpc2::new(&spec, config, 0).expect("usable settings")
    };
    let [mut drawn, mut mean] = [agent(false), agent(true)];
    let obs = [0.3];
    assert_eq!(drawn.act(&obs, Mode::Explore), mean.act(&obs, Mode::Explore));
    let [drawn_action, mean_action] = [&mut drawn, &mut mean].map(|agent| agent.act(&obs, Mode::Evaluate));
    assert_ne!(drawn_action, mean_action);
    let planned = |agent: &mut TdMpc2| {
        let (_, _, slots, fresh) = agent.imagined();
        slots.state(0, fresh).planner().mean().to_vec()
    };
    // One action further: what was executed has been shifted out of the mean, which is otherwise the same.
    assert_eq!(planned(&mut drawn), planned(&mut mean));
}

/// Costs of actions make plans of evaluations smaller, over several agents (one may rest anyway), and leave exploration alone.
#[test]
fn costs_are_for_evaluations() {
    let spec = Spec::new("seven", [Feature::new("time")], 1, 7, 0.05);
    let plain = TdMpc2Config { evaluate_mean: true, warm_up: 0, ..TdMpc2Config::default() };
    let sizes = [
        plain.clone(),
        TdMpc2Config { effort_penalty: 100.0, ..plain.clone() },
        TdMpc2Config { change_penalty: 100.0, ..plain.clone() },
    ]
    .map(|config| {
        let size = |seed| {
            let [mut agent, mut free] =
                [&config, &plain].map(|c| TdMpc2::new(&spec, c.clone(), seed).expect("usable settings"));
            assert_eq!(agent.act(&[0.3], Mode::Explore), free.act(&[0.3], Mode::Explore));
            agent.act(&[0.3], Mode::Evaluate).iter().map(|a| a * a).sum::<f32>()
        };
        (0..20).map(size).sum::<f32>()
    });
    println!("{sizes:?}");
    assert!(sizes[1..].iter().all(|size| *size < 0.5 * sizes[0]), "{sizes:?}");
}

/// The values that a pair of critics are asked for are never those of one critic twice, and all pairs are drawn.
#[test]
fn two_critics_are_two() {
    let mut rng = rng::stream(0, "pairs");
    let pairs: std::collections::BTreeSet<[usize; 2]> = (0..500).map(|_| planning::two_of(3, &mut rng)).collect();
    assert_eq!(pairs.len(), 6);
    assert!(pairs.iter().all(|[one, other]| one != other));
}

/// No gradient flows from the policy's loss into the critics, nor into the model.
#[test]
fn the_policy_leaves_the_model_alone() {
    let networks = reference();
    let z = networks.model.encode(&batch().obs);
    let mut tape = OwnedTape::default();
    let mut scale = RunningScale::default();
    let loss =
        networks.policy_loss(&mut tape, &z, 2, &TdMpc2Config::default(), &mut scale, &mut rng::stream(0, "alone"));
    let mut gradients = ops::total(tape, &[(1.0, loss.climb), (1.0, loss.entropy)]).backward();
    for (name, parameter) in networks.model.parameters() {
        assert!(gradients.get_or_alloc_mut(parameter).expect("memory").iter().all(|g| *g == 0.0), "{name}");
    }
}
