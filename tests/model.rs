//! What a learned model must be: right where it has seen enough, unsure where it has not, and honest about chance.

use handful::env::{Env, Feature, KnownReward, Spec, Task};
use handful::model::calibration::{GaussianForecast, coverage};
use handful::model::open_loop::{OpenLoop, Propagated, open_loop};
use handful::model::{
    Autoencoder, AutoencoderConfig, Differentiable, Ensemble, EnsembleConfig, Imagination, ImplicitConfig,
    ImplicitModel, Propagation, Reward, RssmConfig, WorldModel, WorldModelConfig,
};
use handful::nn::{Adam, AdamConfig, tensor, values};
use handful::replay::{Episode, ReplayBuffer, SequenceReplay, Transition};
use handful::rng::{self, Rng};
use nalgebra::Vector3;
use rayon::prelude::*;

/// Two numbers: the first is moved by the action and by chance, the second turns with the first and is left alone by
/// both. A third stands still, a fourth is the difference of the two.
const CHANCE: f64 = 0.02;

fn spec() -> Spec {
    let observation = [
        Feature::new("moved"),
        Feature::new("turned"),
        Feature::new("still"),
        Feature::new("apart").difference("turned", "moved"),
    ];
    Spec::new("test", observation, 1, 50, 0.1)
}

fn expected(obs: &[f32], action: f32) -> [f32; 3] {
    [0.9 * obs[0] + 0.3 * action, obs[1] + 0.2 * (2.0 * obs[0]).sin(), obs[2]]
}

fn seen(moved: f32, turned: f32) -> Vec<f32> {
    vec![moved, turned, 7.0, turned - moved]
}

fn step(obs: &[f32], action: f32, rng: &mut Rng) -> Vec<f32> {
    let [moved, turned, _] = expected(obs, action);
    seen(moved + (CHANCE * rng::normal(rng)) as f32, turned)
}

struct Reach;

impl KnownReward for Reach {
    fn reward(&self, _obs: &[f32], action: &[f32], next_obs: &[f32]) -> f32 {
        -(next_obs[0] - 0.5).powi(2) - 0.1 * next_obs[1] - 0.01 * action[0].powi(2)
    }
}

fn experience(count: usize, rng: &mut Rng) -> (ReplayBuffer, Vec<Episode>) {
    let mut data = ReplayBuffer::new(4, 1, count);
    let mut episodes = Vec::new();
    while data.len() < count {
        let mut obs = seen(rng::uniform(rng, -1.0, 1.0) as f32, rng::uniform(rng, -1.0, 1.0) as f32);
        let mut episode = Episode { observations: vec![obs.clone()], ..Episode::default() };
        for _ in 0..spec().horizon {
            let action = vec![rng::uniform(rng, -1.0, 1.0) as f32];
            let next_obs = step(&obs, action[0], rng);
            let reward = Reach.reward(&obs, &action, &next_obs);
            episode.observations.push(next_obs.clone());
            episode.actions.push(action.clone());
            let terminated = false;
            data.push(&Transition { obs, action, reward, next_obs: next_obs.clone(), terminated, truncated: false });
            obs = next_obs;
        }
        episodes.push(episode);
    }
    (data, episodes)
}

fn config() -> EnsembleConfig {
    EnsembleConfig { hidden: vec![48, 48], first_steps: 1500, batch: 128, ..EnsembleConfig::default() }
}

fn fitted(config: EnsembleConfig) -> Ensemble {
    fitted_from(0, config)
}

fn fitted_from(seed: u64, config: EnsembleConfig) -> Ensemble {
    let mut rng = rng::stream(seed, "model");
    let (data, _) = experience(2000, &mut rng);
    let mut ensemble = Ensemble::new(&spec(), config, &mut rng).expect("usable settings");
    let fit = ensemble.fit(&data, &mut rng);
    assert!(fit.steps > 0 && fit.loss.is_finite());
    ensemble
}

#[test]
fn an_ensemble_learns_what_is_law_and_what_is_chance() {
    for learn_bounds in [false, true] {
        let ensemble = fitted(EnsembleConfig { learn_bounds, ..config() });
        let dynamics = ensemble.dynamics();
        let mut rng = rng::stream(1, "test");
        let mut measured = Vec::new();
        for _ in 0..500 {
            let obs = seen(rng::uniform(&mut rng, -0.8, 0.8) as f32, rng::uniform(&mut rng, -0.8, 0.8) as f32);
            let action = rng::uniform(&mut rng, -1.0, 1.0) as f32;
            let said = dynamics.predict(&obs, &[action]);
            let law = expected(&obs, action);
            for (i, (said, law)) in said.mean.iter().zip(law).enumerate() {
                assert!((said - f64::from(law)).abs() < 0.02, "number {i}: {said} for {law}");
            }
            let deviation = said.aleatoric[0].sqrt();
            assert!((0.5 * CHANCE..2.0 * CHANCE).contains(&deviation), "chance is {CHANCE}, not {deviation}");
            assert!(said.epistemic[0] < said.aleatoric[0], "with so much data, chance is the greater part");
            let total = (said.aleatoric[0] + said.epistemic[0]).sqrt();
            let outcome = f64::from(step(&obs, action, &mut rng)[0]);
            measured.push(GaussianForecast { mean: said.mean[0], std: total, outcome });
        }
        let inside = coverage(&measured, 0.9);
        assert!((0.84..0.97).contains(&inside), "{inside} of the outcomes lie in the interval of 90 %");
    }
}

/// A step size that falls brings the networks to rest: closer to the law than one that keeps them trembling to the end.
#[test]
fn networks_whose_steps_shorten_come_closer_to_the_law() {
    let error = |seed: u64, final_learning_rate_fraction: f32| -> f64 {
        let config = EnsembleConfig {
            final_learning_rate_fraction,
            held_out: 0.0,
            members: 1,
            elites: 1,
            learning_rate: 1e-2,
            ..config()
        };
        let dynamics = fitted_from(seed, config).dynamics();
        let mut rng = rng::stream(2, "test");
        let mut square = || {
            let obs = seen(rng::uniform(&mut rng, -0.8, 0.8) as f32, rng::uniform(&mut rng, -0.8, 0.8) as f32);
            let action = rng::uniform(&mut rng, -1.0, 1.0) as f32;
            let pairs = dynamics.predict(&obs, &[action]).mean.into_iter().zip(expected(&obs, action));
            pairs.map(|(said, law)| (said - f64::from(law)).powi(2)).sum::<f64>()
        };
        (0..500).map(|_| square()).sum::<f64>().sqrt()
    };
    let [kept, shortened] = [1.0, 0.05].map(|fraction| (0..4).map(|seed| error(seed, fraction)).sum::<f64>());
    assert!(shortened < 0.8 * kept, "errors {shortened:.4} and {kept:.4}");
}

/// The same bits, however many cores the networks learn on.
#[test]
fn what_is_learned_does_not_depend_on_threads() {
    let said = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        let dynamics = pool.install(|| fitted(EnsembleConfig { first_steps: 60, ..config() })).dynamics();
        dynamics.predict(&seen(0.3, 0.1), &[0.4])
    };
    assert_eq!(said(1), said(3));
}

#[test]
fn members_disagree_where_nothing_was_seen() {
    let dynamics = fitted(config()).dynamics();
    let unsure = |x: f32| dynamics.predict(&seen(x, 0.0), &[0.0]).epistemic[1].sqrt();
    assert!(unsure(6.0) > 5.0 * unsure(0.2), "{} far away, {} at home", unsure(6.0), unsure(0.2));
}

#[test]
fn the_best_members_predict_and_all_survive_a_save() {
    let mut rng = rng::stream(0, "model");
    let (data, _) = experience(600, &mut rng);
    let config = EnsembleConfig { members: 4, elites: 2, first_steps: 300, ..config() };
    let mut ensemble = Ensemble::new(&spec(), config.clone(), &mut rng).expect("usable settings");
    let errors = ensemble.fit(&data, &mut rng).errors;
    assert_eq!((errors.len(), ensemble.dynamics().members()), (4, 2));
    let mut copy = Ensemble::new(&spec(), config, &mut rng).expect("usable settings");
    copy.load_weights(&ensemble.weights()).expect("its own weights");
    let (obs, action) = (seen(0.3, 0.1), [0.4]);
    assert_eq!(copy.dynamics().predict(&obs, &action), ensemble.dynamics().predict(&obs, &action));
    let before = ensemble.dynamics().predict(&obs, &action);
    ensemble.fit(&data, &mut rng);
    let after = ensemble.dynamics().predict(&obs, &action);
    assert!((before.mean[0] - after.mean[0]).abs() < 0.05, "a second fit goes on from the first");
}

/// On few and noisy data an ensemble memorises noise, fit after fit. Its validation error must tell: it is the error on
/// transitions that it has never seen.
#[test]
fn the_validation_set_stays_unseen() {
    // The validation error and the true one, for one ensemble on data of its own.
    let errors = |seed: u64| -> (f64, f64) {
        let mut rng = rng::stream(seed, "model");
        let mut transition = || {
            let mut noise = || rng::uniform(&mut rng, -1.0, 1.0) as f32;
            let ([x, v], action) = ([noise(), noise()], noise());
            let next_obs = seen(x + 0.5 * v + 0.5 * noise(), v + 0.5 * action + 0.5 * noise());
            Transition {
                obs: seen(x, v),
                action: vec![action],
                reward: 0.0,
                next_obs,
                terminated: false,
                truncated: false,
            }
        };
        let mut data = ReplayBuffer::new(4, 1, 400);
        (0..400).for_each(|_| data.push(&transition()));
        let unseen: Vec<Transition> = (0..400).map(|_| transition()).collect();
        let config = EnsembleConfig {
            hidden: vec![64, 64],
            first_steps: 300,
            steps: 300,
            check_every: 300,
            held_out: 0.3,
            ..config()
        };
        let mut ensemble = Ensemble::new(&spec(), config, &mut rng).expect("usable settings");
        let fit = (0..8).map(|_| ensemble.fit(&data, &mut rng)).last().expect("eight fits");
        let claimed = fit.errors.iter().sum::<f64>() / fit.errors.len() as f64;
        // The same error on other transitions: of each member, over the features that change.
        let dynamics = ensemble.dynamics();
        let of = |t: &Transition| {
            let (means, _) = dynamics.member_predictions(&t.obs, &t.action);
            let square = |mean: &Vec<f64>| {
                let errors = dynamics.typical_changes().zip(mean);
                errors
                    .map(|((i, unit), mean)| ((mean - f64::from(t.next_obs[i])) / f64::from(unit)).powi(2))
                    .sum::<f64>()
            };
            means.iter().map(square).sum::<f64>() / (3 * means.len()) as f64
        };
        (claimed, unseen.iter().map(of).sum::<f64>() / unseen.len() as f64)
    };
    let all: Vec<(f64, f64)> = (11..19).into_par_iter().map(errors).collect();
    let ratio = all.iter().map(|(claimed, truth)| claimed / truth).sum::<f64>() / all.len() as f64;
    assert!(ratio > 0.85, "a validation error is {ratio:.2} of the error on other transitions");
}

/// A flag that flips once in three hundred steps: its change is 17 standard deviations, and yet it is predicted in full.
#[test]
fn rare_flips_of_a_flag_are_predicted_in_full() {
    let spec = Spec::new("test", [Feature::new("x"), Feature::new("touches").flag()], 1, 50, 0.1);
    let mut rng = rng::stream(12, "model");
    let mut data = ReplayBuffer::new(2, 1, 3000);
    for i in 0..3000 {
        let (x, flips) = (rng::uniform(&mut rng, -1.0, 1.0) as f32, i % 300 == 0);
        let action = if flips { 0.9 } else { rng::uniform(&mut rng, -1.0, 0.5) as f32 };
        let (obs, next_obs) = (vec![x, 0.0], vec![x + 0.1 * action, f32::from(flips)]);
        data.push(&Transition {
            obs,
            action: vec![action],
            reward: 0.0,
            next_obs,
            terminated: false,
            truncated: false,
        });
    }
    // Hardly any of the ten flips would be in a validation set; and the likelihood's own weights would explain them as noise
    // at first.
    let config = EnsembleConfig { held_out: 0.0, beta: 1.0, ..config() };
    let mut ensemble = Ensemble::new(&spec, config, &mut rng).expect("usable settings");
    ensemble.fit(&data, &mut rng);
    let dynamics = ensemble.dynamics();
    let touches = |action: f32| dynamics.predict(&[0.2, 0.0], &[action]).mean[1];
    assert!(touches(0.9) > 0.9 && touches(0.3).abs() < 0.1, "{} and {}", touches(0.9), touches(0.3));
}

#[test]
fn a_model_is_judged_over_many_steps() {
    let mut rng = rng::stream(5, "model");
    let (data, _) = experience(2000, &mut rng);
    let (_, unseen) = experience(2000, &mut rng);
    let mut ensemble = Ensemble::new(&spec(), config(), &mut rng).expect("usable settings");
    ensemble.fit(&data, &mut rng);
    let measured = open_loop(
        &Propagated { dynamics: &ensemble.dynamics(), propagation: Propagation::TsInf },
        &spec(),
        &unseen,
        &mut rng,
    );
    let horizons: Vec<usize> = measured.iter().map(|row| row.horizon).collect();
    assert_eq!(horizons, [1, 2, 5, 10, 15, 25]);
    for row in measured {
        assert!(row.rmse < 0.5, "better than predicting no change: {row:?}");
        // One step ahead 0.9; over many steps errors accumulate, and members agree more than they should.
        assert!(row.coverage90.is_some_and(|share| (0.6..=1.0).contains(&share)), "{row:?}");
    }
}

/// The same experience for models that read it in order.
fn moments(episodes: &[Episode]) -> SequenceReplay {
    let mut moments = SequenceReplay::new(4, 1, 100_000);
    for episode in episodes {
        for (t, action) in episode.actions.iter().enumerate() {
            moments.push(&Transition {
                obs: episode.observations[t].clone(),
                action: action.clone(),
                reward: Reach.reward(&episode.observations[t], action, &episode.observations[t + 1]),
                next_obs: episode.observations[t + 1].clone(),
                terminated: false,
                truncated: t + 1 == episode.actions.len(),
            });
        }
    }
    moments
}

#[test]
fn latent_models_predict_too() {
    let mut rng = rng::stream(6, "model");
    let (_, episodes) = experience(2000, &mut rng);
    let (_, unseen) = experience(500, &mut rng);
    let data = moments(&episodes);
    let better = |name: &str, measured: Vec<OpenLoop>| {
        let five = measured.iter().find(|row| row.horizon == 5).expect("five steps");
        assert!(five.rmse < 0.8, "{name}: better than predicting no change: {five:?}");
    };

    let config = AutoencoderConfig { code: 8, hidden: vec![32, 32] };
    let mut autoencoder = Autoencoder::new(&spec(), &config, &mut rng);
    let mut optimiser = Adam::new(AdamConfig::new(2e-3));
    for _ in 0..600 {
        autoencoder.learn(&data.sample(16, 8, &mut rng), &mut optimiser);
    }
    better("autoencoder", open_loop(&autoencoder, &spec(), &unseen, &mut rng));

    let rssm = RssmConfig { deter: 32, blocks: 2, hidden: 32, stoch: 8, classes: 8, unimix: 0.01 };
    let config =
        WorldModelConfig { rssm, units: 32, layers: 2, bins: 41, bin_limit: 5.0, ..WorldModelConfig::default() };
    let mut world = WorldModel::new(&spec(), &config, &mut rng);
    let mut optimiser = Adam::new(AdamConfig { warm_up: 50, ..AdamConfig::laprop(1e-3) });
    for _ in 0..800 {
        world.learn(&data.sample(16, 16, &mut rng), &mut optimiser, &mut rng);
    }
    better("world model", open_loop(&world, &spec(), &unseen, &mut rng));

    // The rewards that it predicts after observing each step.
    let cpu = handful::nn::device();
    let mut belief = world.initial(1);
    let mut errors = Vec::new();
    for episode in &unseen {
        let nothing = tensor(&cpu, vec![0.0], (1, 1, 1));
        belief = world.observe(&world.initial(1), &nothing, &episode.observations[0], &mut rng);
        for (t, action) in episode.actions.iter().enumerate() {
            let done = tensor(&cpu, action.clone(), (1, 1, 1));
            belief = world.observe(&belief, &done, &episode.observations[t + 1], &mut rng);
            let told = world.rewards(&belief.features())[0];
            let truth = Reach.reward(&episode.observations[t], action, &episode.observations[t + 1]);
            errors.push((told - truth).abs());
        }
    }
    let error = errors.iter().sum::<f32>() / errors.len() as f32;
    assert!(error < 0.15, "rewards between -3 and 0 are told to {error}");
    assert!((world.continuations(&belief.features())[0] - config.discount()).abs() < 0.02, "episodes here never end");
}

/// The tape's gradients against central differences, for known and for learned rewards.
#[test]
fn gradients_of_imagined_returns_are_exact() {
    let known = fitted(config()).dynamics();
    let learned = fitted(EnsembleConfig { learn_reward: true, ..config() }).dynamics();
    assert!(learned.learned_reward().is_some() && known.learned_reward().is_none());
    let actions: Vec<f32> = (0..12).map(|i| 0.8 * (i as f32).sin()).collect();
    let obs = seen(0.2, -0.1);
    let gated = fitted(EnsembleConfig { gated: true, ..config() }).dynamics();
    let known_reward = Reward::Known(&Reach);
    for (dynamics, reward) in [(&known, known_reward), (&gated, known_reward), (&learned, Reward::Learned)] {
        let model = Differentiable::new(dynamics);
        for disagreement_penalty in [0.0, 0.5] {
            let (returns, slopes) = model.gradients(reward, &obs, &actions, 6, disagreement_penalty);
            assert_eq!((returns.len(), slopes.len()), (2, 12));
            let largest = slopes.iter().fold(0.0_f32, |a, s| a.max(s.abs()));
            for i in 0..12 {
                let at = |by: f32| {
                    let mut moved = actions.clone();
                    moved[i] += by;
                    f64::from(model.gradients(reward, &obs, &moved, 6, disagreement_penalty).0[i / 6])
                };
                let difference = (at(1e-2) - at(-1e-2)) / 2e-2;
                let error = (f64::from(slopes[i]) - difference).abs() / f64::from(largest);
                assert!(error < 0.03, "action {i}: {} by the tape, {difference} by differences", slopes[i]);
            }
        }
    }
}

/// A learned reward agrees with the known one that it was learned from.
#[test]
fn rewards_can_be_learned() {
    let dynamics = fitted(EnsembleConfig { learn_reward: true, ..config() }).dynamics();
    let actions: Vec<f32> = (0..40).map(|i| (i as f32 * 1.3).sin()).collect();
    let returns = |reward| {
        let propagation = Propagation::Expectation;
        let imagination = Imagination { dynamics: &dynamics, reward, propagation, particles: 5, value: None };
        imagination.imagined_returns(&seen(0.1, 0.0), &actions, 10, &mut rng::stream(3, "luck")).returns
    };
    let (known, learned) = (returns(Reward::Known(&Reach)), returns(Reward::Learned));
    for (known, learned) in known.iter().zip(&learned) {
        assert!((known - learned).abs() < 0.15, "{learned} learned, {known} known");
    }
}

/// A member alone predicts what it predicts among the others, and so does its reward.
#[test]
fn a_member_can_stand_alone() {
    let dynamics = fitted(EnsembleConfig { learn_reward: true, ..config() }).dynamics();
    let (obs, action) = (seen(0.1, 0.0), [0.5]);
    let (means, variances) = dynamics.member_predictions(&obs, &action);
    for i in 0..dynamics.members() {
        let alone = dynamics.member(i);
        assert_eq!(alone.members(), 1);
        assert_eq!(alone.member_predictions(&obs, &action), (vec![means[i].clone()], vec![variances[i].clone()]));
        let mut among = [0.0];
        dynamics.learned_reward().expect("learned").of_member(i, &obs, &action, &obs, &mut among);
        assert_eq!(alone.learned_reward().expect("learned").reward(&obs, &action, &obs), among[0]);
    }
    assert_ne!(means[0], means[1], "members differ");
}

/// A hand, and a block that it pushes along when it runs into it from the left: how far do models let the block creep where
/// nobody touches it?
#[test]
fn gates_keep_still_what_nobody_touches() {
    let features = vec![
        Feature::new("hand"),
        Feature::new("block"),
        Feature::new("hand to block").around(0.0, 0.2).difference("block", "hand"),
    ];
    let spec = Spec::new("test", features, 1, 50, 0.1);
    let seen = |hand: f32, block: f32| vec![hand, block, block - hand];
    let step = |obs: &[f32], action: f32| {
        let (hand, block) = (obs[0] + 0.1 * action, obs[1]);
        seen(hand, if obs[0] <= block { block.max(hand) } else { block })
    };
    // How far the block creeps where nobody touches it, in the median, for one data set and one training.
    let creeping = |seed: u64, gated: bool| {
        let mut rng = rng::stream(seed, "model");
        let mut anywhere = || rng::uniform(&mut rng, -1.0, 1.0) as f32;
        let mut data = ReplayBuffer::new(3, 1, 3000);
        for _ in 0..3000 {
            let (obs, action) = (seen(anywhere(), anywhere()), vec![anywhere()]);
            let next_obs = step(&obs, action[0]);
            data.push(&Transition { obs, action, reward: 0.0, next_obs, terminated: false, truncated: false });
        }
        let untouched: Vec<(Vec<f32>, f32)> = (0..500)
            .map(|_| (seen(anywhere(), anywhere()), anywhere()))
            .filter(|(obs, action)| step(obs, *action)[1] == obs[1])
            .collect();
        let mut ensemble =
            Ensemble::new(&spec, EnsembleConfig { gated, ..config() }, &mut rng).expect("usable settings");
        ensemble.fit(&data, &mut rng);
        let dynamics = ensemble.dynamics();
        let creep =
            |(obs, action): &(Vec<f32>, f32)| (dynamics.predict(obs, &[*action]).mean[1] - f64::from(obs[1])).abs();
        let mut creeps: Vec<f64> = untouched.iter().map(creep).collect();
        creeps.sort_by(f64::total_cmp);
        creeps[creeps.len() / 2]
    };
    // Now and then a gate stays open.
    let median = |gated| {
        let mut creeps: Vec<f64> = (20..31).into_par_iter().map(|seed| creeping(seed, gated)).collect();
        creeps.sort_by(f64::total_cmp);
        creeps[5]
    };
    let [plain, gated] = [false, true].map(median);
    assert!(gated < 0.3 * plain, "it creeps by {gated:.6} with gates, by {plain:.6} without");
}

/// A cube that has tipped over is still a cube: whichever side is up, an ensemble foretells the same motion, and a latent
/// model sees the same thing.
#[test]
fn a_cube_may_lie_on_any_side() {
    let mut world = Task::Push.make();
    let spec = world.spec().clone();
    let axis = spec.observation.iter().position(|feature| feature.name == "cube x-axis x").expect("a cube is seen");
    // The axes x, y, z become z, x, y; and the other way about.
    let tipped = |obs: &[f32]| {
        let mut tipped = obs.to_vec();
        let (x, z) = (Vector3::from_column_slice(&obs[axis..axis + 3]), &obs[axis + 3..axis + 6]);
        let y = Vector3::from_column_slice(z).cross(&x);
        tipped[axis..axis + 3].copy_from_slice(z);
        tipped[axis + 3..axis + 6].copy_from_slice(y.as_slice());
        tipped
    };
    let mut rng = rng::stream(9, "model");
    let (mut data, mut obs) = (ReplayBuffer::new(spec.observation_size(), 4, 100), world.reset(1));
    for _ in 0..100 {
        let action: Vec<f32> = (0..4).map(|_| rng::uniform(&mut rng, -1.0, 1.0) as f32).collect();
        let next_obs = world.step(&action).expect("a proper action").observation;
        let transition =
            Transition { obs, action, reward: 0.0, next_obs: next_obs.clone(), terminated: false, truncated: false };
        data.push(&transition);
        obs = next_obs;
    }
    let settings = EnsembleConfig { first_steps: 20, gated: true, ..config() };
    let mut ensemble = Ensemble::new(&spec, settings, &mut rng).expect("usable settings");
    ensemble.fit(&data, &mut rng);
    let dynamics = ensemble.dynamics();
    let latent = WorldModel::new(&spec, &WorldModelConfig::default(), &mut rng);
    let still = tensor(latent.device(), vec![0.0; 4], (1, 1, 4));
    for i in (0..100).step_by(7) {
        let row = data.row(i);
        // With the first steps the changes are wild, so that a wrong name could not hide.
        let [(as_it_lies, _), (on_its_side, _)] =
            [row.obs.to_vec(), tipped(row.obs)].map(|obs| dynamics.member_predictions(&obs, row.action));
        for (one, other) in as_it_lies.iter().zip(&on_its_side) {
            let after = |means: &[f64]| {
                let mut after = row.obs.to_vec();
                dynamics.typical_changes().zip(means).for_each(|((i, _), mean)| after[i] = *mean as f32);
                after
            };
            let (expected, other) = (tipped(&after(one)), after(other));
            // To first order: the axes that are predicted need not be exactly orthogonal.
            for (k, (a, b)) in expected.iter().zip(&other).enumerate() {
                assert!((a - b).abs() < 2e-3, "{}: {a} as it lies, {b} on its side", spec.observation[k].name);
            }
        }
        let [one, other] = [row.obs.to_vec(), tipped(row.obs)].map(|obs| {
            let mut rng = rng::stream(10, "model");
            latent.observe(&latent.initial(1), &still, &obs, &mut rng).features()
        });
        assert_eq!(values(&one), values(&other), "what is believed");
    }
}

/// The observation on a line with a goal.
fn at(x: f32, goal: f32) -> Vec<f32> {
    vec![x, goal, goal - x]
}

/// A point on a line, and a goal.
fn line() -> Spec {
    let features = [Feature::new("x"), Feature::new("goal").constant(), Feature::new("way").difference("goal", "x")];
    Spec::new("line", features, 1, 50, 0.1)
}

/// The reward: minus the distance to a place beside the goal, so that its direction counts.
fn beside_the_goal(way: f32) -> f32 {
    -(way - 0.2).abs()
}

/// An ensemble that has learned the reward from 2000 transitions with these goals; and the transitions.
fn with_goals(goals: &[f32], config: EnsembleConfig) -> (Ensemble, ReplayBuffer) {
    let mut rng = rng::stream(0, "goals");
    let mut data = ReplayBuffer::new(3, 1, 2000);
    for goal in goals.iter().cycle().take(2000) {
        let [x, action] = [0; 2].map(|_| rng::uniform(&mut rng, -1.0, 1.0) as f32);
        let next = x + 0.1 * action;
        data.push(&Transition {
            obs: at(x, *goal),
            action: vec![action],
            reward: beside_the_goal(goal - next),
            next_obs: at(next, *goal),
            terminated: false,
            truncated: false,
        });
    }
    let config = EnsembleConfig { learn_reward: true, ..config };
    let mut ensemble = Ensemble::new(&line(), config, &mut rng).expect("usable settings");
    assert_eq!(ensemble.fit(&data, &mut rng).reward_errors.len(), ensemble.dynamics().members());
    (ensemble, data)
}

/// A goal does not move, so the dynamics need not see it; but a learned reward must, also where it has never been.
#[test]
fn a_learned_reward_knows_goals_that_it_has_not_seen() {
    let (ensemble, data) = with_goals(&[-0.7, -0.5, -0.3, -0.1, 0.1, 0.3, 0.5, 0.7], config());
    let dynamics = ensemble.dynamics();
    let learned = dynamics.learned_reward().expect("a learned reward");
    let reward = |x: f32, goal: f32| learned.reward(&at(x, goal), &[0.0], &at(x, goal));
    for (x, goal) in [(0.6, 0.6), (-0.5, 0.6), (0.6, -0.4), (-0.8, 0.0)] {
        let (predicted, truth) = (reward(x, goal), beside_the_goal(goal - x));
        assert!((predicted - truth).abs() < 0.15, "at {x}, goal {goal}: {predicted}, not {truth}");
    }

    // It is the mean of the members, for each row of a batch.
    let (here, there) = ([at(0.1, 0.5), at(-0.2, 0.3)].concat(), [at(0.2, 0.5), at(-0.3, 0.3)].concat());
    let rewards_of = |member: usize| {
        let mut rewards = [0.0; 2];
        learned.of_member(member, &here, &[1.0, -1.0], &there, &mut rewards);
        rewards
    };
    let of_members: Vec<[f32; 2]> = (0..learned.members()).map(rewards_of).collect();
    for row in 0..2 {
        let mean = of_members.iter().map(|rewards| rewards[row]).sum::<f32>() / learned.members() as f32;
        let transition = [&here[3 * row..][..3], &there[3 * row..][..3]];
        let reward = learned.reward(transition[0], &[[1.0, -1.0][row]], transition[1]);
        assert!((reward - mean).abs() < 1e-6, "{reward}, not {mean}");
    }
    // Far from all data its inputs are clipped, and its predictions stay within the rewards that were received.
    assert!([-1.0, 1.0].iter().all(|side| reward(side * 30.0, 0.3) == reward(side * 1e6, 0.3)));
    let received: Vec<f32> = (0..data.len()).map(|i| data.row(i).reward).collect();
    let (low, high) = received.iter().fold((f32::MAX, f32::MIN), |(low, high), r| (low.min(*r), high.max(*r)));
    for x in [-1e6, -30.0, 30.0, 1e6] {
        let predicted = reward(x, 0.3);
        assert!((low - 1e-4..=high + 1e-4).contains(&predicted), "at {x}: {predicted}, received {low} to {high}");
    }
}

/// A point in a plane, seen along the axes from its goal only, and then along the diagonals. With the components of the way next to each
/// other, a learned reward reads its length; with another feature in between, it reads the lengths of the two components instead, whose sum
/// is the distance along the axes only.
#[test]
fn a_learned_reward_knows_distances_in_directions_that_it_has_not_seen() {
    let mean_error = |order: [usize; 7]| {
        let features = [
            Feature::new("x"),
            Feature::new("y"),
            Feature::new("goal x").constant(),
            Feature::new("goal y").constant(),
            Feature::new("way x").difference("goal x", "x"),
            Feature::new("way y").difference("goal y", "y"),
            Feature::new("nothing").constant(),
        ];
        let spec = Spec::new("plane", order.map(|i| features[i].clone()), 2, 50, 0.1);
        let observation = |[x, y]: [f32; 2]| {
            let all = [0.0, 0.0, x, y, x, y, 0.0];
            order.map(|i| all[i]).to_vec()
        };
        let mut rng = rng::stream(0, "directions");
        let mut data = ReplayBuffer::new(7, 2, 2000);
        for i in 0..2000 {
            let distance = rng::uniform(&mut rng, -1.0, 1.0) as f32;
            let obs = observation(if i % 2 == 0 { [distance, 0.0] } else { [0.0, distance] });
            data.push(&Transition {
                obs: obs.clone(),
                action: vec![0.0; 2],
                reward: -distance.abs(),
                next_obs: obs,
                terminated: false,
                truncated: false,
            });
        }
        let config = EnsembleConfig { learn_reward: true, reward_lasso: 10.0, ..config() };
        let mut ensemble = Ensemble::new(&spec, config, &mut rng).expect("usable settings");
        ensemble.fit(&data, &mut rng);
        let dynamics = ensemble.dynamics();
        let learned = dynamics.learned_reward().expect("a learned reward");
        let ways = [[0.2, 0.2], [-0.4, 0.4], [0.5, -0.5], [-0.6, -0.6]];
        let error = |way: [f32; 2]| {
            let obs = observation(way);
            (learned.reward(&obs, &[0.0; 2], &obs) + way[0].hypot(way[1])).abs()
        };
        ways.map(error).iter().sum::<f32>() / ways.len() as f32
    };
    let (read, inferred) = (mean_error([0, 1, 2, 3, 4, 5, 6]), mean_error([0, 1, 2, 3, 4, 6, 5]));
    assert!(read < 0.1 && read < 0.5 * inferred, "mean error {read} with the length of the way, {inferred} without");
}

/// Two goals can be told apart by their places, and nothing in the data says that the next goal has the same reward around it.
#[test]
fn with_a_group_lasso_a_learned_reward_depends_on_differences_and_distances_alone() {
    let predictions = |reward_lasso: f32| {
        let (ensemble, _) = with_goals(&[-0.5, 0.5], EnsembleConfig { reward_lasso, ..config() });
        let dynamics = ensemble.dynamics();
        let learned = dynamics.learned_reward().expect("a learned reward").clone();
        move |x: f32, goal: f32| learned.reward(&at(x, goal), &[0.0], &at(x, goal))
    };
    let (lasso, none) = (predictions(10.0), predictions(0.0));
    let mut moved = 0.0_f32;
    for way in [-0.75, -0.25, 0.125, 0.5] {
        let [here, there] =
            [0.5, -0.125].map(|goal| [&lasso as &dyn Fn(f32, f32) -> f32, &none].map(|f| f(goal - way, goal)));
        assert!((here[0] - beside_the_goal(way)).abs() < 0.1, "{way} from the goal: {}", here[0]);
        assert!((here[0] - there[0]).abs() < 1e-5, "{way} from the goal, wherever it is: {} and {}", here[0], there[0]);
        moved = moved.max((here[1] - there[1]).abs());
    }
    assert!(moved > 1e-3, "without it, predictions depend on the place of the goal: {moved}");
}

/// A latent state that is not asked for places does not hold them, and still tells how far the goal is.
#[test]
fn with_a_group_lasso_latent_states_depend_on_differences_alone() {
    let mut rng = rng::stream(0, "places");
    let mut replay = SequenceReplay::new(3, 1, 2000);
    for _ in 0..50 {
        let [mut x, goal] = [0; 2].map(|_| rng::uniform(&mut rng, -1.0, 1.0) as f32);
        for t in 0..20 {
            let action = rng::uniform(&mut rng, -1.0, 1.0) as f32;
            let next = x + 0.1 * action;
            replay.push(&Transition {
                obs: at(x, goal),
                action: vec![action],
                reward: -(goal - next).abs(),
                next_obs: at(next, goal),
                terminated: false,
                truncated: t == 19,
            });
            x = next;
        }
    }
    let rssm = RssmConfig { deter: 32, blocks: 1, hidden: 32, stoch: 8, classes: 8, unimix: 0.01 };
    let mut latent_states = |lasso: f32| {
        let config = WorldModelConfig {
            rssm: rssm.clone(),
            units: 32,
            layers: 1,
            bins: 41,
            bin_limit: 5.0,
            reconstruction: 10.0,
            lasso,
            ..WorldModelConfig::default()
        };
        let mut world = WorldModel::new(&line(), &config, &mut rng);
        let mut optimiser = Adam::new(AdamConfig { warm_up: 50, ..AdamConfig::laprop(1e-3) });
        for _ in 0..500 {
            world.learn(&replay.sample(16, 8, &mut rng), &mut optimiser, &mut rng);
        }
        // Latent states drawn for an observation, and the mean of the ways that are decoded from them.
        move |x: f32, goal: f32| {
            const DRAWS: usize = 32;
            let still = tensor(world.device(), vec![0.0; DRAWS], (1, DRAWS, 1));
            let obs = at(x, goal).repeat(DRAWS);
            let features = world.observe(&world.initial(DRAWS), &still, &obs, &mut rng::stream(0, "draws")).features();
            let way = world.decode(&features).chunks(3).map(|obs| obs[2]).sum::<f32>() / DRAWS as f32;
            (values(&features).to_vec(), way)
        }
    };
    let (lasso, none) = (latent_states(10.0), latent_states(0.0));
    let mut wrong = 0.0;
    for way in [-0.75, -0.25, 0.125, 0.5] {
        let [here, there] = [0.5, -0.125].map(|goal| lasso(goal - way, goal));
        assert_eq!(here.0, there.0, "{way} from the goal, wherever it is");
        wrong += (here.1 - way).abs() / 4.0;
        assert_ne!(none(0.5 - way, 0.5).0, none(-0.125 - way, -0.125).0, "without it, they hold the place");
    }
    assert!(wrong < 0.2, "the way to the goal is known to {wrong}");
}

#[test]
fn a_learned_reward_is_saved_and_loaded() {
    let learned = fitted(EnsembleConfig { learn_reward: true, ..config() });
    let (obs, action) = (seen(0.3, 0.1), [0.4]);
    let mut copy =
        Ensemble::new(&spec(), EnsembleConfig { learn_reward: true, ..config() }, &mut rng::stream(9, "copy"))
            .expect("usable settings");
    copy.load_weights(&learned.weights()).expect("the same settings");
    let reward = |of: &Ensemble| of.dynamics().learned_reward().expect("a learned reward").reward(&obs, &action, &obs);
    assert_eq!(reward(&copy), reward(&learned));
}

#[test]
fn latent_models_refuse_settings_out_of_range() {
    let config = ImplicitConfig { latent: 0, ..ImplicitConfig::default() };
    let problem = ImplicitModel::try_new(&spec(), &config, &mut rng::stream(0, "ranges")).expect_err("no latent state");
    assert!(problem.to_string().starts_with("`model.latent` is 0; it must lie in"), "{problem}");
    for (config, expected) in [
        (WorldModelConfig { units: 0, ..WorldModelConfig::default() }, "`world.units` is 0; it must lie in 1..=4096"),
        (WorldModelConfig { bins: 40, ..WorldModelConfig::default() }, "`world`: `bins` must be odd"),
    ] {
        let problem = WorldModel::try_new(&spec(), &config, &mut rng::stream(0, "ranges")).expect_err(expected);
        assert_eq!(problem.to_string(), expected);
    }
}
