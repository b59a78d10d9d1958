use super::*;
use crate::model::{FeatureMap, Normaliser};
use crate::nn::Activation;
use crate::nn::frozen::FrozenMlp;
use crate::rng;

/// A model of one feature and one action with two members: the feature changes by the action, plus `drift` with the first
/// member, minus `drift` with the second, with standard deviation `std`.
fn disagreeing(drift: f32, std: f32) -> Dynamics {
    let layer = |drift: f32| {
        // Inputs: feature, action; outputs: mean, raw log-variance.
        (vec![0.0, 0.0, 1.0, 0.0], vec![drift, 2.0 * std.ln()])
    };
    let members = [layer(drift), layer(-drift)];
    let members = members.iter().map(|(weight, bias)| {
        let network = FrozenMlp::new(std::iter::once((&weight[..], &bias[..])), Activation::Silu);
        (network, [&[5.0][..], &[-40.0]])
    });
    let identity = Normaliser::identity;
    let features =
        FeatureMap { width: 1, raw: vec![0], near: vec![], predicted: vec![0], differences: vec![], cubes: vec![] };
    Dynamics::new(members, features, 1, identity(2), identity(1), vec![1.0])
}

struct Position;

impl KnownReward for Position {
    fn reward(&self, _obs: &[f32], _action: &[f32], next_obs: &[f32]) -> f32 {
        next_obs[0]
    }

    fn terminated(&self, next_obs: &[f32]) -> bool {
        next_obs[0] > 4.5
    }
}

/// A task that goes on for ever.
struct Endless;

impl KnownReward for Endless {
    fn reward(&self, _obs: &[f32], _action: &[f32], next_obs: &[f32]) -> f32 {
        next_obs[0]
    }
}

fn imagine(dynamics: &Dynamics, propagation: Propagation, particles: usize) -> Imagination<'_> {
    Imagination { dynamics, reward: Reward::Known(&Position), propagation, particles, value: None }
}

fn mean_and_std(states: &[f32]) -> (f32, f32) {
    let n = states.len() as f32;
    let mean = states.iter().sum::<f32>() / n;
    (mean, (states.iter().map(|x| (x - mean).powi(2)).sum::<f32>() / n).sqrt())
}

/// Disagreement accumulates where particles stay with their member, and averages out where they change it.
#[test]
fn disagreement_accumulates_with_ts_inf_only() {
    let dynamics = disagreeing(1.0, 1e-3);
    let run = |propagation, particles| {
        let mut rng = rng::stream(0, "propagation");
        let imagination = Imagination { reward: Reward::Known(&Endless), ..imagine(&dynamics, propagation, particles) };
        let (trajectories, imagined) = imagination.trajectories(&[0.0], &[0.0; 16], 16, &mut rng);
        (mean_and_std(&trajectories[16]), imagined.disagreement[0])
    };
    let ((mean, std), disagreement) = run(Propagation::TsInf, 400);
    assert!(mean.abs() < 0.01 && (std - 16.0).abs() < 0.01, "{mean} {std}");
    assert!((disagreement - 136.0).abs() < 0.1, "1 + 2 + ... + 16: {disagreement}");
    for propagation in [Propagation::Ts1, Propagation::MomentMatching] {
        // Moment matching estimates the standard deviation anew at each step: its errors add up.
        let ((mean, std), _) = run(propagation, 4000);
        assert!(mean.abs() < 2.5 && (std - 4.0).abs() < 0.8, "{propagation:?}: {mean} {std}");
    }
    let ((mean, std), disagreement) = run(Propagation::Expectation, 400);
    assert!(mean.abs() < 1e-5 && std == 0.0 && (disagreement - 16.0).abs() < 1e-3, "{mean} {std} {disagreement}");
}

#[test]
fn the_std_of_noise_grows_with_the_root_of_time() {
    let dynamics = disagreeing(0.0, 0.5);
    for propagation in [Propagation::TsInf, Propagation::Ts1, Propagation::MomentMatching] {
        let mut rng = rng::stream(1, "chance");
        let (trajectories, _) = imagine(&dynamics, propagation, 4000).trajectories(&[0.0], &[0.0; 9], 9, &mut rng);
        let (_, std) = mean_and_std(&trajectories[9]);
        assert!((std - 1.5).abs() < 0.2, "{propagation:?}: {std}");
    }
}

/// Rewards are 1, 2, 3, 4 and 5, where the task terminates: that reward still counts, nothing after it, nor the terminal
/// value, nor what the members disagree on.
#[test]
fn no_reward_counts_after_termination() {
    let dynamics = disagreeing(0.0, 1e-8);
    let value = |_: &[f32], values: &mut [f32]| values.fill(100.0);
    let mut imagination = imagine(&dynamics, Propagation::TsInf, 2);
    imagination.value = Some(&value);
    let imagined =
        imagination.imagined_returns(&[0.0], &[vec![1.0; 8], vec![0.5; 8]].concat(), 8, &mut rng::stream(2, "end"));
    let near = |found: f32, expected: f32| assert!((found - expected).abs() < 1e-3, "{found}, expected {expected}");
    near(imagined.returns[0], 15.0);
    near(imagined.returns[2], 18.0 + 100.0);
    let dynamics = disagreeing(0.01, 1e-8);
    for propagation in
        [Propagation::TsInf, Propagation::TsInfMean, Propagation::Expectation, Propagation::MomentMatching]
    {
        let until = |horizon: usize, action: f32| {
            let imagination = imagine(&dynamics, propagation, 2);
            let actions = vec![action; horizon];
            imagination.imagined_returns(&[0.0], &actions, horizon, &mut rng::stream(2, "end")).disagreement[0]
        };
        near(until(8, 1.0), until(5, 1.0));
        assert!(until(8, 0.5) > until(5, 0.5) + 0.02, "{propagation:?}");
    }
}

/// The same bits from one thread and from several, and for a candidate alone and among others.
#[test]
fn imagined_returns_depend_on_the_seed_alone() {
    let dynamics = disagreeing(0.3, 0.2);
    let actions: Vec<f32> = (0..300).map(|i| (i as f32 * 0.7).sin()).collect();
    for propagation in [
        Propagation::TsInf,
        Propagation::Ts1,
        Propagation::TsInfMean,
        Propagation::Expectation,
        Propagation::MomentMatching,
    ] {
        let run = |threads: usize, actions: &[f32]| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            let imagination = imagine(&dynamics, propagation, 4);
            pool.install(|| imagination.imagined_returns(&[0.1], actions, 5, &mut rng::stream(3, "threads")))
        };
        let one = run(1, &actions);
        assert_eq!(one, run(3, &actions), "{propagation:?}");
        let first = run(1, &actions[..5]);
        assert_eq!(first.returns[..], one.returns[..first.returns.len()], "{propagation:?}");
    }
}
