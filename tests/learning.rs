//! Agents learn what they should, and a run that was stopped goes on as if it had not been.

use std::path::Path;
use std::sync::{Arc, Mutex};

use handful::agent::dreamer::ActorCriticConfig;
use handful::agent::{
    Agent, Diagnostics, Dreamer, DreamerConfig, Learner, Mode, Oracle, OracleConfig, Pets, PetsConfig, Policy, Preset,
    Sac, SacConfig, Slot, TdMpc2, TdMpc2Config,
};
use handful::checkpoint::Weights;
use handful::env::{Env, Snapshot, Step, Task, World};
use handful::error::{Error, Result};
use handful::model::uncertainty::Risk;
use handful::model::{EnsembleConfig, Imagination, ImplicitConfig, Propagation, Reward, RssmConfig, WorldModelConfig};
use handful::plan::{
    ActionSequences, ControlConfig, GuidedConfig, IcemConfig, Objective, Plan, PlanObserver, Planner, PlannerConfig,
};
use handful::replay::{ReplayBuffer, SequenceReplay, Transition};
use handful::rng;
use handful::study::config::RunConfig;
use handful::study::evaluate::{EvalSeeds, Evaluator};
use handful::study::registry::Registry;
use handful::study::run::{Event, Run, is_complete};
use rayon::prelude::*;

/// As in the program.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// An episode of learning; its return.
fn episode(env: &mut World, agent: &mut dyn Agent, seed: u64) -> f32 {
    let (mut obs, mut total) = (env.reset(seed), 0.0);
    agent.begin_episode();
    loop {
        let action = agent.act(&obs, Mode::Explore);
        let Step { observation, reward, terminated, truncated, .. } = env.step(&action).expect("a valid action");
        total += reward;
        agent.observe(&Transition { obs, action, reward, next_obs: observation.clone(), terminated, truncated });
        agent.update();
        if terminated || truncated {
            return total;
        }
        obs = observation;
    }
}

/// Random torques bring about -1200; the best possible is about -135.
#[test]
fn sac_swings_the_pendulum_up() {
    let mut env = Task::Pendulum.make();
    let config = SacConfig {
        hidden: vec![64, 64],
        batch: 128,
        learning_rate: 2e-3,
        temperature_rate: 2e-3,
        n_step: 3,
        ..SacConfig::default()
    };
    let mut agent = Sac::new(env.spec(), config, 0).expect("usable settings");
    for seed in 0..40 {
        episode(&mut env, &mut agent, seed);
    }
    let mut evaluator = Evaluator::new(|| Ok(Task::Pendulum.make())).expect("a pendulum");
    let summary = evaluator.evaluate(&mut agent, 20, EvalSeeds::Test).expect("valid actions").summary();
    // Random torques earn about -1200; the worst of a hundred seeds earned -236. (After 30 episodes, and with returns of one step,
    // three of fifty-one earned less than -450.)
    assert!(summary.return_mean > -400.0, "mean return {}", summary.return_mean);
}

/// After one random episode the model is good enough to plan in: the next return makes up for most of the distance to the
/// oracle's.
#[test]
fn pets_swings_the_pendulum_up_after_one_random_episode() {
    let mut env = Task::Pendulum.make();
    let config = PetsConfig::preset_for("pets", "pendulum").expect("a preset");
    let mut pets = Pets::new(env.spec(), Some(Arc::new(Task::Pendulum.make())), config, 1).expect("usable settings");
    let config = OracleConfig::preset_for("oracle", "pendulum").expect("a preset");
    let mut oracle = Oracle::new(|| Ok(Task::Pendulum.make()), config, 1).expect("usable settings");
    const START: u64 = (1 << 20) + 1;
    let random = episode(&mut env, &mut pets, START - 1);
    let planned = episode(&mut env, &mut pets, START);

    let mut best = 0.0;
    env.reset(START);
    loop {
        let action = oracle.plan(0, &env.snapshot()).expect("a plan");
        let outcome = env.step(&action).expect("a valid action");
        best += outcome.reward;
        if outcome.done() {
            break;
        }
    }
    assert!(random < best - 500.0, "random actions do not swing it up: {random}, oracle {best}");
    assert!(
        planned - random > 0.5 * (best - random),
        "planning in the model does: {planned}, random {random}, oracle {best}"
    );
}

/// A world is learned, and in it, asleep, how to swing the pendulum up. (Random torques bring -1200; the preset, with larger
/// networks and three more thousand steps, -145.)
#[test]
fn dreamer_swings_the_pendulum_up() {
    let mut config = DreamerConfig::preset_for("dreamer", "pendulum").expect("a preset");
    (config.world.units, config.behaviour.units) = (64, 64);
    (config.world.rssm.deter, config.world.rssm.hidden, config.world.rssm.stoch) = (64, 32, 8);
    let mut env = Task::Pendulum.make();
    let mut agent = Dreamer::new(env.spec(), config, 0).expect("usable settings");
    for seed in 0..25 {
        episode(&mut env, &mut agent, seed);
    }
    assert_swings_up(&mut agent, -700.0);
}

/// Values, a latent model and a planner together swing the pendulum up. (Random torques bring -1200; after 3,000 steps, which
/// are few, one start in ten may still fail.)
#[test]
fn tdmpc2_swings_the_pendulum_up() {
    let mut config = TdMpc2Config::preset_for("tdmpc2", "pendulum").expect("a preset");
    config.batch = 64;
    config.model = ImplicitConfig { encoder: 64, units: 64, ..config.model };
    let mut env = Task::Pendulum.make();
    let mut agent = TdMpc2::new(env.spec(), config, 0).expect("usable settings");
    for seed in 0..15 {
        episode(&mut env, &mut agent, seed);
    }
    assert_swings_up(&mut agent, -800.0);
}

/// The agent earns more than `least` per episode, and its model predicts the pendulum five steps ahead.
#[track_caller]
fn assert_swings_up(agent: &mut (impl Agent + Diagnostics), least: f64) {
    let mut evaluator = Evaluator::new(|| Ok(Task::Pendulum.make())).expect("a pendulum");
    let evaluation = evaluator.evaluate(agent, 20, EvalSeeds::Test).expect("valid actions");
    let mean = evaluation.summary().return_mean;
    assert!(mean > least, "mean return {mean}");
    let five_steps = &agent.open_loop(&evaluation.episodes)[2];
    assert!(five_steps.rmse < 0.8, "{five_steps:?}: 1 is as good as predicting no change");
}

/// The planner before any model is learned: on the true simulator it must be good.
#[test]
fn the_oracle_swings_the_pendulum_up() {
    let config = OracleConfig::preset_for("oracle", "pendulum").expect("a preset");
    let mut oracle = Oracle::new(|| Ok(Task::Pendulum.make()), config, 0).expect("usable settings");
    let mut evaluator = Evaluator::new(|| Ok(Task::Pendulum.make())).expect("a pendulum");
    let summary = evaluator.evaluate(&mut oracle, 20, EvalSeeds::Test).expect("valid actions").summary();
    // The optimum depends on the start, from 0 to -400: the mean over 20 starts varies by 20.
    assert!(summary.return_mean > -250.0, "mean return {}", summary.return_mean);
    assert_eq!(summary.success, 1.0, "upright at the end, always");
}

/// Planning on the simulator must leave the world in which the agent acts as it was.
#[test]
fn the_oracle_does_not_disturb_the_world() {
    let mut world = Task::Reach.make();
    let obs = world.reset(0);
    let mut untouched = Task::Reach.make();
    untouched.reset(0);
    let config = OracleConfig::preset_for("oracle", "reach").expect("a preset");
    let mut oracle = Oracle::new(|| Ok(Task::Reach.make()), config, 0).expect("usable settings");
    for step in 0..3 {
        let slot = Slot::single(step == 0, &obs, &world);
        let action = oracle.actions(&[slot]).expect("the oracle's own kind of world").remove(0);
        let (a, b) = (world.step(&action).expect("valid"), untouched.step(&action).expect("valid"));
        assert_eq!(a.observation, b.observation);
    }
}

#[test]
fn an_oracle_refuses_another_kind_of_environment() {
    let mut oracle = Oracle::new(|| Ok(Task::Reach.make()), OracleConfig::default(), 0).expect("usable settings");
    let mut pendulum = handful::env::pendulum::Pendulum::default();
    let obs = pendulum.reset(0);
    let problem = oracle.actions(&[Slot::single(true, &obs, &pendulum)]).expect_err("a pendulum is no table");
    assert!(problem.to_string().contains("`reach`") && problem.to_string().contains("`pendulum`"), "{problem}");
}

/// What `act` does in evaluation is what the evaluator measures: a loop of `begin_episode` and `act` brings the same
/// return as the evaluator's batch, to the last bit, also for agents with a memory; and training is not disturbed.
#[test]
fn acting_alone_is_acting_in_an_evaluation() {
    let registry = Registry::standard();
    for config in [debug_run(7), small_pets(7), small_dreamer(7), small_tdmpc2(7)] {
        let mut method = registry.method(&config).expect("a method");
        let agent = method.as_learner().expect("it learns");
        let mut env = Task::Reach.make();
        for seed in 0..4 {
            episode(&mut env, agent, seed);
        }
        let training_state = |agent: &dyn handful::agent::Learner| format!("{:?}", agent.training_state());
        let before = training_state(agent);
        for start in [EvalSeeds::Test, EvalSeeds::Seed(5)] {
            let mut evaluator = Evaluator::new(|| Ok(Task::Reach.make())).expect("a world");
            let batch = evaluator.evaluate(agent, 1, start).expect("valid actions");
            let mut obs = env.reset(start.seed(0).expect("a seed in range"));
            agent.begin_episode();
            let mut rewards = Vec::new();
            loop {
                let step = env.step(&agent.act(&obs, Mode::Evaluate)).expect("a valid action");
                rewards.push(step.reward);
                if step.done() {
                    break;
                }
                obs = step.observation;
            }
            assert_eq!(rewards, batch.episodes[0].rewards, "{}", config.method);
        }
        assert_eq!(training_state(agent), before, "{}", config.method);
    }
}

/// Target networks are not among the weights; where there is nothing else to go on with, they begin as copies of the critics.
#[test]
fn with_weights_alone_target_networks_equal_the_critics() {
    let registry = Registry::standard();
    let critics = ["critics.", "dreamer.behaviour.critic.", "tdmpc2.model.critics."];
    for (config, critics) in [debug_run, small_dreamer, small_tdmpc2].into_iter().zip(critics) {
        let mut method = registry.method(&config(7)).expect("a method");
        let agent = method.as_learner().expect("it learns");
        let mut env = Task::Reach.make();
        for seed in 0..4 {
            episode(&mut env, agent, seed);
        }
        let weights = agent.weights();
        let target = |state: Weights| state.extract("target.");
        assert_ne!(target(agent.training_state()), weights.extract(critics), "{critics} lag behind");

        let mut method = registry.method(&config(8)).expect("a method");
        let other = method.as_learner().expect("it learns");
        other.load_weights(&weights).expect("weights of the same settings");
        assert_eq!(target(other.training_state()), weights.extract(critics));
    }
}

fn transition(number: f32, truncated: bool) -> Transition {
    Transition {
        obs: vec![number, 0.0],
        action: vec![0.5],
        reward: number,
        next_obs: vec![number + 1.0, 0.0],
        terminated: false,
        truncated,
    }
}

#[test]
fn the_replay_buffer_is_a_ring_and_keeps_truncated_futures() {
    let mut buffer = ReplayBuffer::new(2, 1, 10);
    (0..25).for_each(|i| buffer.push(&transition(i as f32, i % 5 == 4)));
    assert_eq!(buffer.len(), 10);
    let batch = buffer.sample(500, &mut rng::stream(0, "replay"));
    let mut seen: Vec<i32> = batch.rewards.iter().map(|r| *r as i32).collect();
    seen.sort_unstable();
    seen.dedup();
    assert_eq!(seen, (15..25).collect::<Vec<i32>>(), "the last ten, and all of them");
    for i in 0..500 {
        assert_eq!(batch.next_obs[2 * i], batch.obs[2 * i] + 1.0, "the observation after the very same step");
        assert_eq!(batch.terminated[i], 0.0, "an end by the clock is no end");
    }
}

#[test]
fn pieces_of_episodes_keep_what_belongs_together() {
    let mut buffer = SequenceReplay::new(2, 1, 1000);
    (0..20).for_each(|i| buffer.push(&transition(i as f32, i % 5 == 4)));
    assert_eq!(buffer.len(), 24, "each episode has one moment more than steps");
    let batch = buffer.sample(100, 8, &mut rng::stream(0, "replay"));
    for i in 0..700 {
        let (obs, after) = (batch.obs[2 * i], i + 100);
        assert_eq!(batch.last[i], batch.first[after], "what follows a last moment is a first one");
        if !batch.last[i] {
            assert_eq!(batch.obs[2 * after], obs + 1.0, "the next moment of the same episode");
            assert_eq!(batch.rewards[after], obs, "the reward for arriving there");
            assert_eq!(batch.actions[i], 0.5);
        } else {
            assert_eq!((batch.actions[i], batch.rewards[after], batch.terminal[i]), (0.0, 0.0, false));
        }
    }
    assert!(batch.last.contains(&true));
}

/// An environment may be reset in the middle of an episode.
#[test]
fn a_step_does_not_follow_on_an_episode_that_was_given_up() {
    let mut buffer = SequenceReplay::new(2, 1, 0);
    buffer.push(&transition(0.0, false));
    assert_eq!(buffer.len(), 1, "room for one at least");
    let mut buffer = SequenceReplay::new(2, 1, 10);
    buffer.push(&transition(1.0, false));
    buffer.abandon();
    buffer.push(&transition(7.0, false));
    let batch = buffer.sample(1, 2, &mut rng::stream(0, "replay"));
    assert_eq!((batch.obs[0], batch.obs[2]), (1.0, 7.0));
    assert_eq!((batch.first, batch.rewards), (vec![true; 2], vec![0.0; 2]));
    assert!(batch.last[0]);
    // Both agents that learn from sequences give up what `begin_episode` interrupts.
    let mut config = DreamerConfig::preset_for("dreamer", "pendulum").expect("a preset");
    config.warm_up = 300;
    let mut env = Task::Pendulum.make();
    let dreamer = Dreamer::new(env.spec(), config, 0).expect("usable settings");
    let tdmpc2 = TdMpc2::new(env.spec(), TdMpc2Config::preset_for("tdmpc2", "pendulum").expect("a preset"), 0);
    let agents: [Box<dyn Learner>; 2] = [Box::new(dreamer), Box::new(tdmpc2.expect("usable settings"))];
    for mut agent in agents {
        for seed in 0..2 {
            let obs = env.reset(seed);
            agent.begin_episode();
            let action = agent.act(&obs, Mode::Explore);
            let Step { observation: next_obs, reward, .. } = env.step(&action).expect("a valid action");
            agent.observe(&Transition { obs, action, reward, next_obs, terminated: false, truncated: false });
        }
        let mut replay = SequenceReplay::new(3, 1, 10);
        replay.load(&agent.training_state(), "replay").expect("two time steps");
        assert_eq!(replay.sample(1, 2, &mut rng::stream(0, "replay")).first, [true, true]);
    }
}

/// Slices within episodes, also where episodes are so short that most starts lead out of them, and of an episode that was cut
/// short by a crash.
#[test]
fn slices_stay_within_their_episodes() {
    let mut buffer = SequenceReplay::new(2, 1, 60);
    assert!(buffer.sample_within_episodes(4, 4, &mut rng::stream(0, "slices")).is_none());
    (0..90).for_each(|i| buffer.push(&transition(i as f32, i % 3 == 2)));
    assert!(buffer.sample_within_episodes(4, 5, &mut rng::stream(0, "slices")).is_none(), "none is that long");
    let mut resumed = SequenceReplay::new(2, 1, 60);
    let mut state = handful::checkpoint::Weights::default();
    (90..92).for_each(|i| buffer.push(&transition(i as f32, false)));
    buffer.save(&mut state, "replay");
    resumed.load(&state, "replay").expect("what was saved");
    (93..100).for_each(|i| resumed.push(&transition(i as f32, i == 99)));
    let batch = resumed.sample_within_episodes(300, 4, &mut rng::stream(0, "slices")).expect("long enough");
    assert_eq!((batch.sequences, batch.length), (300, 4));
    for i in 0..900 {
        assert!(!batch.last[i] && !batch.first[i + 300], "no end within");
        assert_eq!(batch.obs[2 * (i + 300)], batch.obs[2 * i] + 1.0, "the next moment of the same episode");
    }
    let starts: std::collections::BTreeSet<u32> = (0..300).map(|i| batch.obs[2 * i] as u32).collect();
    assert!(
        starts.contains(&93) && starts.contains(&96) && starts.iter().all(|s| *s >= 93 || s % 3 == 0),
        "{starts:?}"
    );
}

/// SAC shrunk to seconds.
fn debug_run(seed: u64) -> RunConfig {
    Registry::standard().config("reach", "debug", seed, None, None).expect("a preset")
}

/// PETS shrunk to seconds.
fn small_pets(seed: u64) -> RunConfig {
    let mut config = Registry::standard().config("reach", "pets", seed, Some(600), None).expect("a preset");
    (config.evaluate_every, config.evaluation_episodes, config.test_episodes) = (300, 2, 2);
    let mut pets: PetsConfig = config.settings().expect("PETS's settings");
    pets.warm_up = 200;
    pets.ensemble =
        EnsembleConfig { hidden: vec![16], first_steps: 50, steps: 20, check_every: 10, ..pets.ensemble.clone() };
    pets.planner = PlannerConfig::Icem(IcemConfig {
        horizon: 4,
        population: 10,
        elites: 4,
        iterations: 2,
        ..IcemConfig::default()
    });
    config.with_settings(&pets)
}

/// Dreamer shrunk to seconds.
fn small_dreamer(seed: u64) -> RunConfig {
    let mut config = Registry::standard().config("reach", "dreamer", seed, Some(600), None).expect("a preset");
    (config.evaluate_every, config.evaluation_episodes, config.test_episodes) = (300, 2, 2);
    let mut dreamer: DreamerConfig = config.settings().expect("Dreamer's settings");
    (dreamer.batch, dreamer.length, dreamer.dreams, dreamer.train_ratio, dreamer.warm_up) = (2, 8, None, 1.0, 200);
    dreamer.world = WorldModelConfig { units: 16, layers: 1, ..dreamer.world.clone() };
    dreamer.world.rssm = RssmConfig { deter: 16, blocks: 2, hidden: 8, stoch: 4, classes: 4, ..RssmConfig::default() };
    dreamer.behaviour = ActorCriticConfig { units: 16, layers: 1, horizon: 5, ..ActorCriticConfig::default() };
    config.with_settings(&dreamer)
}

/// TD-MPC2 shrunk to seconds.
fn small_tdmpc2(seed: u64) -> RunConfig {
    let mut config = Registry::standard().config("reach", "tdmpc2", seed, Some(600), None).expect("a preset");
    (config.evaluate_every, config.evaluation_episodes, config.test_episodes) = (300, 2, 2);
    let mut tdmpc2: TdMpc2Config = config.settings().expect("TD-MPC2's settings");
    (tdmpc2.batch, tdmpc2.warm_up, tdmpc2.updates_per_step, tdmpc2.action_repeat) = (8, 200, 0.3, 3);
    tdmpc2.model = ImplicitConfig { latent: 16, encoder: 16, units: 16, critics: 3, bins: 21, ..tdmpc2.model };
    tdmpc2.planner = GuidedConfig { population: 20, proposals: 5, elites: 5, iterations: 2, ..tdmpc2.planner };
    config.with_settings(&tdmpc2)
}

fn open(config: &RunConfig, folder: &Path) -> Result<Run<Box<dyn Env>>> {
    Registry::standard().open_run(config, folder)
}

fn finish(run: &mut Run<Box<dyn Env>>) {
    while !matches!(run.step().expect("a healthy run"), Event::Tested(_)) {}
}

/// A CSV without its columns of wall-clock times.
fn without_times(path: &Path) -> String {
    let text = std::fs::read_to_string(path).expect("a file of the run");
    let head: Vec<&str> = text.lines().next().expect("a header").split(',').collect();
    let kept = |line: &str| -> String {
        let cells = line.split(',').zip(&head).filter(|(_, name)| !["seconds", "action_ms"].contains(name));
        cells.map(|(cell, _)| cell).collect::<Vec<_>>().join(",")
    };
    text.lines().map(kept).collect::<Vec<_>>().join("\n")
}

#[test]
fn a_resumed_run_ends_as_if_it_had_never_stopped() {
    ends_as_if_it_had_never_stopped(&debug_run(1), &["episodes.csv", "evaluations.csv", "losses.csv", "test.csv"]);
}

#[test]
fn a_resumed_run_with_all_that_sac_can_do_ends_as_if_it_had_never_stopped() {
    let config = debug_run(1);
    let sac = SacConfig {
        latent_features: true,
        layer_norm: true,
        critic_dropout: 0.01,
        action_repeat: 2,
        n_step: 3,
        hindsight: 0.8,
        warm_up_noise_beta: Some(1.0),
        exploration_noise_beta: Some(1.0),
        discount_from_horizon: true,
        ..config.settings().expect("SAC's settings")
    };
    let files = ["episodes.csv", "evaluations.csv", "losses.csv", "test.csv"];
    ends_as_if_it_had_never_stopped(&config.with_settings(&sac), &files);
}

#[test]
fn so_does_one_that_plans() {
    let files = ["episodes.csv", "evaluations.csv", "losses.csv", "model.csv", "test.csv"];
    ends_as_if_it_had_never_stopped(&small_pets(1), &files);
    // And if the steps of its model are decisions, the last of which the time limit cuts short, and each episode has a member of its own.
    let slow = small_pets(2);
    let pets = PetsConfig { action_repeat: 7, posterior_sampling: true, ..slow.settings().expect("PETS's settings") };
    ends_as_if_it_had_never_stopped(&slow.with_settings(&pets), &files);
}

#[test]
fn so_does_one_that_dreams() {
    let files = ["episodes.csv", "evaluations.csv", "losses.csv", "model.csv", "values.csv", "test.csv"];
    ends_as_if_it_had_never_stopped(&small_dreamer(1), &files);
    // And if it plans in its dreams, and has a target entropy.
    let planning = small_dreamer(2);
    let mut dreamer: DreamerConfig = planning.settings().expect("Dreamer's settings");
    let planner = IcemConfig { horizon: 4, population: 10, elites: 4, iterations: 2, ..IcemConfig::default() };
    dreamer.planner = Some(PlannerConfig::Icem(planner));
    dreamer.behaviour.target_entropy = Some(0.5);
    ends_as_if_it_had_never_stopped(&planning.with_settings(&dreamer), &files);
}

#[test]
fn so_does_one_that_plans_to_a_learned_value() {
    let files = ["episodes.csv", "evaluations.csv", "losses.csv", "model.csv", "values.csv", "test.csv"];
    ends_as_if_it_had_never_stopped(&small_tdmpc2(1), &files);
}

/// With any number of threads. The digests that this test prints are also the same for the kernels with and without AVX-512,
/// which `.ci/run` compares.
#[test]
fn training_computes_the_same_bits_with_any_number_of_threads() {
    let mut dreamer = small_dreamer(9);
    let mut settings: DreamerConfig = dreamer.settings().expect("Dreamer's settings");
    // Sums over the rows of a batch that are longer than those that a matrix product adds up in one go.
    (settings.batch, settings.length, settings.train_ratio) = (16, 40, 20.0);
    dreamer = dreamer.with_settings(&settings);
    for config in [debug_run(9), small_pets(9), dreamer, small_tdmpc2(9)] {
        let weights = [1, 2, 4].map(|threads| {
            let folder = tempfile::tempdir().expect("a folder");
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
            pool.install(|| finish(&mut open(&config, folder.path()).expect("a new run")));
            std::fs::read(folder.path().join("weights.safetensors")).expect("weights")
        });
        assert!(weights[0] == weights[1] && weights[0] == weights[2], "{}: 1, 2 and 4 threads", config.method);
        let mix = |hash: u64, byte: &u8| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
        println!("bits of {}: {:016x}", config.method, weights[0].iter().fold(0xcbf2_9ce4_8422_2325, mix));
    }
}

fn ends_as_if_it_had_never_stopped(config: &RunConfig, files: &[&str]) {
    let folder = tempfile::tempdir().expect("a folder");
    let (whole, halves) = (folder.path().join("whole"), folder.path().join("halves"));
    finish(&mut open(config, &whole).expect("a new run"));
    {
        let mut run = open(config, &halves).expect("a new run");
        while run.steps_done() < 300 || !run.between_episodes() {
            run.step().expect("a healthy run");
        }
        run.save().expect("a writable folder");
        // What happens after the last save is lost, as in a crash.
        (0..150).for_each(|_| drop(run.step().expect("a healthy run")));
    }
    let mut run = open(config, &halves).expect("a run to go on with");
    assert!(run.steps_done() >= 300);
    finish(&mut run);
    drop(run);
    for file in files {
        assert_eq!(without_times(&whole.join(file)), without_times(&halves.join(file)), "{file}");
    }
    let bytes = |folder: &Path| std::fs::read(folder.join("weights.safetensors")).expect("weights");
    assert!(bytes(&whole) == bytes(&halves), "the same weights to the last bit");
    assert!(is_complete(&whole, config) && is_complete(&halves, config));
}

/// Also for those who need no training, but long to be tested.
#[test]
fn a_test_goes_on_where_it_stopped() {
    for method in ["random", "oracle"] {
        let mut config = Registry::standard().config("pendulum", method, 0, None, None).expect("a preset");
        config.test_episodes = 21;
        if method == "oracle" {
            let mut oracle: OracleConfig = config.settings().expect("the oracle's settings");
            let quick = IcemConfig { horizon: 2, population: 4, elites: 2, iterations: 1, ..IcemConfig::default() };
            oracle.planner = PlannerConfig::Icem(quick);
            config = config.with_settings(&oracle);
        }
        let folder = tempfile::tempdir().expect("a folder");
        let (whole, halves) = (folder.path().join("whole"), folder.path().join("halves"));
        finish(&mut open(&config, &whole).expect("a new run"));
        let first = open(&config, &halves).expect("a new run").step().expect("a healthy run");
        assert!(matches!(first, Event::Testing(20)), "{first:?}");
        let last = open(&config, &halves).expect("a run to go on with").step().expect("a healthy run");
        assert!(matches!(&last, Event::Tested(test) if test.results.len() == 21), "{last:?}");
        let [whole, halves] = [whole, halves].map(|run| std::fs::read_to_string(run.join("test.csv")).expect("a test"));
        assert_eq!(whole, halves, "{method}");
    }
}

#[test]
fn a_trained_agent_comes_back_from_its_folder() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut run = open(&debug_run(2), folder.path()).expect("a new run");
    finish(&mut run);
    let (config, mut method) = Registry::standard().trained_method(folder.path()).expect("a complete run");
    assert_eq!(config, debug_run(2));
    let mut evaluator = Evaluator::new(|| Registry::standard().make_env(&config)).expect("a world");
    let again = evaluator.evaluate(&mut method, config.test_episodes, EvalSeeds::Test).expect("valid actions");
    let tested = std::fs::read_to_string(folder.path().join("summary.toml")).expect("a summary");
    let tested: toml::Table = toml::from_str(&tested).expect("TOML");
    assert_eq!(tested["return_mean"].as_float(), Some(again.summary().return_mean));
}

/// A run is resumed by a later edition, whose settings have grown: what is new has its default.
#[test]
fn a_run_from_before_a_setting_existed_is_resumed() {
    let folder = tempfile::tempdir().expect("a folder");
    let config = debug_run(3);
    let mut old = config.clone();
    old.settings.remove("n_step").expect("a setting");
    let mut run = open(&old, folder.path()).expect("a new run");
    while !matches!(run.step().expect("a healthy run"), Event::Evaluated(_)) {}
    run.save().expect("a writable folder");
    let step = run.steps_done();
    drop(run);
    let mut run = open(&config, folder.path()).expect("the same run");
    assert_eq!(run.steps_done(), step);
    finish(&mut run);
    drop(run);
    let longer = config.settings().map(|sac| SacConfig { n_step: 2, ..sac }).expect("SAC's settings");
    let Err(problem) = open(&config.with_settings(&longer), folder.path()) else { panic!("another run") };
    assert!(problem.to_string().contains("`sac.n_step` is nothing, not 2"), "{problem}");
}

#[test]
fn a_folder_with_another_run_is_left_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    drop(open(&debug_run(3), folder.path()).expect("a new run"));
    let before = std::fs::read(folder.path().join("config.toml")).expect("a config");
    let Err(problem) = open(&debug_run(4), folder.path()) else { panic!("another seed is another run") };
    assert!(problem.to_string().contains("`seed` is 3, not 4"), "{problem}");
    let other = debug_run(3);
    let sac = SacConfig { discount: 0.5, ..other.settings().expect("SAC's settings") };
    let other = other.with_settings(&sac);
    let Err(problem) = open(&other, folder.path()) else { panic!("another discount is another run") };
    assert!(problem.to_string().contains("`sac.discount` is "), "{problem}");
    assert_eq!(std::fs::read(folder.path().join("config.toml")).expect("a config"), before);
}

#[test]
fn a_damaged_checkpoint_is_named_and_kept() {
    let folder = tempfile::tempdir().expect("a folder");
    finish(&mut open(&debug_run(5), folder.path()).expect("a new run"));
    let checkpoint = folder.path().join("checkpoint/state.safetensors");
    let whole = std::fs::read(&checkpoint).expect("a checkpoint");
    std::fs::write(&checkpoint, &whole[..whole.len() / 2]).expect("a writable folder");
    let Err(problem) = open(&debug_run(5), folder.path()) else { panic!("half a checkpoint is none") };
    assert!(matches!(problem, Error::Checkpoint { .. }), "{problem}");
    assert!(problem.to_string().contains("state.safetensors"), "{problem}");
    assert_eq!(std::fs::read(&checkpoint).expect("still there").len(), whole.len() / 2);
}

/// With `explore_with_costs = false`, costs on effort and changes shape the motion in evaluations, and no bit of the training.
#[test]
fn costs_in_evaluations_only_leave_training_alone() {
    let run_with = |explore_with_costs: bool, change_penalty: f32| {
        let config = small_pets(0);
        let mut pets: PetsConfig = config.settings().expect("PETS's settings");
        pets.explore_with_costs = explore_with_costs;
        pets.control.change_penalty = change_penalty;
        let folder = tempfile::tempdir().expect("a folder");
        finish(&mut open(&config.with_settings(&pets), folder.path()).expect("a new run"));
        ["episodes.csv", "evaluations.csv"].map(|file| without_times(&folder.path().join(file)))
    };
    let [free, costly, costly_everywhere] = [(false, 0.0), (false, 1.0), (true, 1.0)].map(|(e, c)| run_with(e, c));
    assert_eq!(free[0], costly[0], "the same episodes in training");
    assert_ne!(free[1], costly[1], "other evaluations");
    assert_ne!(free[0], costly_everywhere[0], "with costs, exploration differs");
}

/// Returns that a planner was told of resting, in the order of its plans.
#[derive(Clone, Default)]
struct Rests(Arc<Mutex<Vec<f32>>>);

impl Planner for Rests {
    fn reset(&mut self) {}

    fn plan(&mut self, objective: &mut dyn Objective, _: &mut PlanObserver, _: &mut rng::Rng) -> Plan {
        let mut rest = ActionSequences::new(3, 4);
        rest.values = vec![0.0; 12];
        self.0.lock().expect("no panic holds it").extend(objective.returns(&rest));
        Plan { actions: rest.values, best_return: 0.0 }
    }

    fn shift(&mut self, _: usize) {}
}

/// With posterior sampling, each episode of exploration plans in one member, and in the course of time in each of them; evaluations plan in
/// all of them.
#[test]
fn posterior_sampling_explores_with_one_member_at_a_time() {
    let mut pets: PetsConfig = small_pets(0).settings().expect("PETS's settings");
    (pets.posterior_sampling, pets.propagation, pets.warm_up) = (true, Propagation::TsInfMean, 30);
    pets.control = ControlConfig::default();
    let (mut env, told) = (Task::Reach.make(), Rests::default());
    let planner = told.clone();
    let agent = Pets::new(env.spec(), Some(Arc::new(Task::Reach.make())), pets, 0).expect("usable settings");
    let mut agent = agent.with_planner(move |_| planner.clone());
    episode(&mut env, &mut agent, 0);

    let obs = env.reset(1);
    let dynamics = agent.dynamics().expect("fitted").clone();
    let world = Task::Reach.make();
    let (reward, propagation) = (Reward::Known(&world), Propagation::TsInfMean);
    let imagination = Imagination { dynamics: &dynamics, reward, propagation, particles: 5, value: None };
    let members = imagination.imagined_returns(&obs, &[0.0; 12], 3, &mut rng::stream(0, "unused")).returns;
    let mut returns_of = |mode: Mode| {
        told.0.lock().expect("no panic holds it").clear();
        agent.begin_episode();
        (0..4).for_each(|_| drop(agent.act(&obs, mode)));
        told.0.lock().expect("no panic holds it").clone()
    };
    let mut seen: Vec<f32> = (0..60)
        .map(|_| {
            let returns = returns_of(Mode::Explore);
            assert!(returns.len() > 1 && returns.iter().all(|told| *told == returns[0]), "one member: {returns:?}");
            returns[0]
        })
        .collect();
    seen.sort_by(f32::total_cmp);
    seen.dedup();
    let mut sorted = members.clone();
    sorted.sort_by(f32::total_cmp);
    assert_eq!(seen, sorted, "each member in its turn");
    let together = Risk::Neutral.of(&members);
    assert!(returns_of(Mode::Evaluate).iter().all(|told| (told - together).abs() < 1e-6));
}

/// A folder that an earlier version began is resumed: its keys had other names.
#[test]
fn renamed_keys_are_understood() {
    let registry = Registry::standard();
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("old.toml");
    let old = "[pets]\ntail = 3.0\ncaution = 0.25\ncuriosity = 0.5\nwarm_up_colour = 1.5\npropagation = \"members\"\n\
               [pets.ensemble]\nanneal = 0.5\n[pets.control]\nhold = 2\n[pets.planner.icem]\ncolour = 1.25\n";
    std::fs::write(&file, old).expect("a writable folder");
    let config = registry.config("push", "pets", 0, None, Some(&file)).expect("old keys have new names");
    let pets: PetsConfig = config.settings().expect("PETS's settings");
    let PlannerConfig::Icem(icem) = &pets.planner else { panic!("the preset plans with iCEM") };
    let numbers = [pets.terminal_weight, pets.disagreement_penalty, pets.disagreement_bonus];
    assert_eq!(numbers, [3.0, 0.25, 0.5]);
    assert_eq!((pets.warm_up_noise_beta, icem.noise_beta, pets.control.action_repeat), (1.5, 1.25, 2));
    assert_eq!(pets.ensemble.final_learning_rate_fraction, 0.5);
    assert_eq!(pets.propagation, handful::model::Propagation::TsInfMean);
    // As an earlier version wrote it: the same run.
    let run = folder.path().join("run");
    drop(open(&config, &run).expect("a new run"));
    let text = std::fs::read_to_string(run.join("config.toml")).expect("a configuration");
    assert!(text.contains("disagreement_penalty = 0.25"), "{text}");
    let names = [
        ("terminal_weight", "tail"),
        ("disagreement_penalty", "caution"),
        ("disagreement_bonus", "curiosity"),
        ("warm_up_noise_beta", "warm_up_colour"),
        ("noise_beta", "colour"),
        ("[pets.control]\naction_repeat", "[pets.control]\nhold"),
        ("final_learning_rate_fraction", "anneal"),
        ("\"ts-inf-mean\"", "\"members\""),
    ];
    let text = names.iter().fold(text, |text, (new, old)| text.replace(new, old));
    std::fs::write(run.join("config.toml"), text).expect("a writable folder");
    open(&config, &run).expect("the same run");
}

/// The agents that ship with the repository succeed from most of other starts than those of their test.
#[test]
fn trained_agents_that_ship_still_succeed() {
    let registry = Registry::standard();
    let folders = std::fs::read_dir("data/trained").expect("a folder");
    let folders: Vec<_> = folders.map(|folder| folder.expect("an entry").path()).collect();
    assert_eq!(folders.len(), 13);
    folders.into_par_iter().for_each(|folder| {
        let (config, mut method) = registry.trained_method(&folder).expect("a trained agent");
        let mut evaluator = Evaluator::new(|| registry.make_env(&config)).expect("a world");
        let mut successes = |episodes: usize| {
            let evaluation = evaluator.evaluate(&mut method, episodes, EvalSeeds::Seed(1)).expect("valid actions");
            (evaluation.summary().success * episodes as f64).round()
        };
        // Seven in the first seven are seven of ten. Of ten, an agent that succeeds in 86 % has fewer in one case of 25; of sixty, it has
        // fewer than seven tenths in one of several thousand.
        let enough = successes(7) == 7.0 || successes(10) >= 7.0 || successes(60) >= 42.0;
        assert!(enough, "{}", folder.display());
    });
}
