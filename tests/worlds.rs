//! The tasks: they can be solved, they can be restored, they survive anything.

use handful::env::tabletop::helpers::{log_reaching_reward, reaching_reward};
use handful::env::tabletop::{ActionKind, ObservationKind, RewardKind, TableOptions};
use handful::env::vector::VectorEnv;
use handful::env::{Env, KnownReward, Snapshot, Step, Task, World};
use handful::error::Error;
use handful::rng;
use rayon::prelude::*;

/// Outcome of a scripted episode: success at the end, step of the first success, return.
fn scripted(task: Task, seed: u64, horizon: usize) -> (bool, Option<usize>, f32) {
    let options = TableOptions { horizon: Some(horizon), ..TableOptions::default() };
    let mut env = task.make_with(options).expect("an arm task");
    let policy = task.scripted_policy(options).expect("an arm task has one");
    let mut obs = env.reset(seed);
    let (mut first, mut total) = (None, 0.0);
    for i in 1.. {
        let step = env.step(&policy(&obs)).expect("a valid action");
        total += step.reward;
        if step.success && first.is_none() {
            first = Some(i);
        }
        if step.done() {
            return (step.success, first, total);
        }
        obs = step.observation;
    }
    unreachable!("episodes end")
}

fn hundred(task: Task, horizon: usize) -> Vec<(bool, Option<usize>, f32)> {
    (0..100).into_par_iter().map(|seed| scripted(task, seed, horizon)).collect()
}

#[test]
fn scripted_reach_always_succeeds() {
    let wins = hundred(Task::Reach, 100).iter().filter(|(success, ..)| *success).count();
    assert_eq!(wins, 100);
}

#[test]
fn scripted_push_succeeds() {
    let wins = hundred(Task::Push, 150).iter().filter(|(success, ..)| *success).count();
    assert!(wins >= 95, "{wins} of 100");
}

#[test]
fn scripted_lift_succeeds_with_robosuites_return() {
    let episodes = hundred(Task::Lift, 500);
    let wins = episodes.iter().filter(|(_, first, _)| first.is_some_and(|step| step <= 45)).count();
    assert!(wins >= 98, "{wins} of 100 by step 45");
    let held = episodes.iter().filter(|(success, ..)| *success).count();
    assert!(held >= 98, "{held} of 100 held to the end");
    let mean = episodes.iter().map(|(.., total)| total).sum::<f32>() / 100.0;
    assert!((465.0..485.0).contains(&mean), "mean return {mean}");
}

#[test]
fn scripted_stack_succeeds() {
    let wins = hundred(Task::Stack, 300).iter().filter(|(success, ..)| *success).count();
    // 92 to 98 over other sets of starts.
    assert!(wins >= 85, "{wins} of 100");
}

#[test]
fn scripted_door_opens_and_stays_open() {
    let episodes = hundred(Task::Door, 200);
    let opened = episodes.iter().filter(|(_, first, _)| first.is_some_and(|step| step <= 80)).count();
    assert!(opened >= 95, "{opened} of 100 by step 80");
    let held = episodes.iter().filter(|(success, ..)| *success).count();
    assert!(held >= 95, "{held} of 100 held to the end");
}

/// A bolt that rubs on its frame while a finger presses on the handle has contacts whose history matters.
#[test]
fn a_restored_door_steps_on_bit_for_bit() {
    let mut env = Task::Door.make();
    let policy = Task::Door.scripted_policy(TableOptions::default()).expect("the door has one");
    let mut obs = env.reset(0);
    for moment in [34, 8] {
        for _ in 0..moment {
            obs = env.step(&policy(&obs)).expect("a valid action").observation;
        }
        let state = env.snapshot();
        let run = |env: &mut World| -> Vec<Vec<u32>> {
            let mut obs = obs.clone();
            let mut rows = Vec::new();
            for _ in 0..40 {
                let step = env.step(&policy(&obs)).expect("a valid action");
                rows.push(bits(&step));
                obs = step.observation;
            }
            rows
        };
        let first = run(&mut env);
        env.restore(&state);
        assert_eq!(run(&mut env), first, "after {moment} more steps");
        env.restore(&state);
    }
}

fn random_action(size: usize, rng: &mut rng::Rng) -> Vec<f32> {
    (0..size).map(|_| rng::uniform(rng, -1.0, 1.0) as f32).collect()
}

fn bits(step: &Step) -> Vec<u32> {
    step.observation.iter().chain([&step.reward]).map(|x| x.to_bits()).collect()
}

#[test]
fn a_restored_world_steps_on_bit_for_bit() {
    for task in Task::ALL {
        let mut env = task.make();
        let mut other = task.make();
        let mut rng = rng::stream(7, "actions");
        let size = env.spec().action_size;
        env.reset(3);
        other.reset(4);
        for _ in 0..30 {
            env.step(&random_action(size, &mut rng)).expect("a valid action");
        }
        let state = env.snapshot();
        let actions: Vec<Vec<f32>> = (0..60).map(|_| random_action(size, &mut rng)).collect();
        let run = |env: &mut World| -> Vec<Vec<u32>> {
            actions.iter().map(|action| bits(&env.step(action).expect("a valid action"))).collect()
        };
        let first = run(&mut env);
        env.restore(&state);
        assert_eq!(run(&mut env), first, "{task}: the same world again");
        other.restore(&state);
        assert_eq!(run(&mut other), first, "{task}: another world of the kind");
    }
}

/// A grasp has contacts whose history matters; it must survive a snapshot too.
#[test]
fn a_restored_grasp_steps_on_bit_for_bit() {
    let mut env = Task::Lift.make();
    let policy = Task::Lift.scripted_policy(TableOptions::default()).expect("lift has one");
    let mut obs = env.reset(0);
    for _ in 0..24 {
        obs = env.step(&policy(&obs)).expect("a valid action").observation;
    }
    let state = env.snapshot();
    let run = |env: &mut World, mut obs: Vec<f32>| -> Vec<Vec<u32>> {
        (0..40)
            .map(|_| {
                let step = env.step(&policy(&obs)).expect("a valid action");
                obs.clone_from(&step.observation);
                bits(&step)
            })
            .collect()
    };
    let first = run(&mut env, obs.clone());
    env.restore(&state);
    assert_eq!(run(&mut env, obs), first);
}

#[test]
fn a_seed_fixes_an_episode() {
    for task in Task::ALL {
        let run = |seed: u64| -> Vec<Vec<u32>> {
            let mut env = task.make();
            let mut rng = rng::stream(1, "actions");
            let mut rows = vec![env.reset(seed).iter().map(|x| x.to_bits()).collect()];
            for _ in 0..40 {
                rows.push(bits(&env.step(&random_action(env.spec().action_size, &mut rng)).expect("valid")));
            }
            rows
        };
        assert_eq!(run(5), run(5), "{task}");
        assert_ne!(run(5), run(6), "{task}");
    }
}

#[test]
fn many_worlds_at_once_are_the_same_worlds() {
    let seeds: Vec<u64> = (0..6).collect();
    let mut many = VectorEnv::new(6, || Task::Lift.make());
    let mut observations = many.reset(&seeds).expect("one seed for each");
    let mut alone: Vec<World> = seeds.iter().map(|_| Task::Lift.make()).collect();
    let first: Vec<Vec<f32>> = alone.iter_mut().zip(&seeds).map(|(env, seed)| env.reset(*seed)).collect();
    assert_eq!(observations, first);
    let mut rng = rng::stream(2, "actions");
    for round in 0..20 {
        // Every third world rests in every round.
        let actions: Vec<Option<Vec<f32>>> =
            (0..6).map(|i| ((i + round) % 3 != 0).then(|| random_action(4, &mut rng))).collect();
        let steps = many.step(&actions).expect("valid actions");
        for (i, (step, action)) in steps.iter().zip(&actions).enumerate() {
            assert_eq!(step.is_some(), action.is_some());
            if let (Some(step), Some(action)) = (step, action) {
                assert_eq!(bits(step), bits(&alone[i].step(action).expect("valid")));
                observations[i].clone_from(&step.observation);
            }
        }
    }
}

#[test]
fn the_reward_is_a_function_of_observations() {
    for task in Task::ALL {
        let mut env = task.make();
        let mut rng = rng::stream(3, "actions");
        let mut obs = env.reset(1);
        let (mut before, mut actions, mut after, mut told) = (vec![], vec![], vec![], vec![]);
        for _ in 0..50 {
            let action = random_action(env.spec().action_size, &mut rng);
            let step = env.step(&action).expect("a valid action");
            before.extend(&obs);
            actions.extend(&action);
            after.extend(&step.observation);
            told.push(step.reward);
            obs = step.observation;
        }
        let mut computed = vec![0.0; 50];
        env.rewards(&before, &actions, &after, &mut computed);
        for (computed, told) in computed.iter().zip(&told) {
            assert!((computed - told).abs() <= 1e-5 * told.abs().max(1.0), "{task}: {computed} and {told}");
        }
    }
}

#[test]
fn the_clock_truncates_and_never_terminates() {
    for task in [Task::Reach, Task::Push, Task::Lift, Task::Stack, Task::Door, Task::Pendulum] {
        let mut env = task.make();
        env.reset(0);
        let (size, horizon) = (env.spec().action_size, env.spec().horizon);
        for i in 1..=horizon {
            let step = env.step(&vec![0.0; size]).expect("a valid action");
            assert!(!step.terminated);
            assert_eq!(step.truncated, i == horizon, "{task}, step {i}");
        }
    }
}

#[test]
fn a_fallen_pole_terminates() {
    let mut env = Task::Cartpole.make();
    env.reset(0);
    let mut steps = 0;
    let last = loop {
        let step = env.step(&[1.0]).expect("a valid action");
        steps += 1;
        if step.done() {
            break step;
        }
    };
    assert!(last.terminated && !last.truncated && last.reward == 0.0);
    assert!(steps < 30, "pushed one way, the pole falls soon; it took {steps} steps");
}

#[test]
fn options_change_what_they_say() {
    let sparse = TableOptions { reward: RewardKind::Sparse, ..TableOptions::default() };
    let mut env = Task::Reach.make_with(sparse).expect("an arm task");
    let policy = Task::Reach.scripted_policy(sparse).expect("reach has one");
    let mut obs = env.reset(0);
    for _ in 0..100 {
        let step = env.step(&policy(&obs)).expect("a valid action");
        assert_eq!(step.reward, f32::from(step.success));
        obs = step.observation;
    }
    // robosuite's vectors: object state, then 50 numbers of the robot.
    let robosuite =
        TableOptions { observation: ObservationKind::Robosuite, action: ActionKind::Pose, ..TableOptions::default() };
    for (task, objects) in [(Task::Lift, 10), (Task::Stack, 23), (Task::Door, 14)] {
        let mut env = task.make_with(robosuite).expect("an arm task");
        assert_eq!((env.reset(0).len(), env.spec().action_size), (objects + 50, 7));
        assert_eq!(env.spec().observation_size(), objects + 50);
    }
    assert!(matches!(Task::Pendulum.make_with(sparse), Err(Error::Config(_))));
}

/// The logarithm of the shaped reward, where that is one distance; on all tasks, more at success than at the start, and a pull
/// towards the goal from afar, where the shaped reward has none.
#[test]
fn the_reward_in_logarithm_pulls_from_afar() {
    let log = TableOptions { reward: RewardKind::Log, ..TableOptions::default() };
    for task in [Task::Reach, Task::Push, Task::Lift, Task::Stack, Task::Door] {
        let (mut shaped, mut env) = (task.make(), task.make_with(log).expect("an arm task"));
        let policy = task.scripted_policy(log).expect("each has one");
        // Of some starts, the one that is farthest from success: near it, there is little to gain.
        let start = |env: &mut World, seed: u64| {
            let obs = env.reset(seed);
            (env.reward(&obs, &[0.0; 4], &obs), obs)
        };
        let far = (0..5).min_by(|&a, &b| start(&mut env, a).0.total_cmp(&start(&mut env, b).0)).expect("five starts");
        let (first, mut obs) = start(&mut env, far);
        shaped.reset(far);
        let mut last = None;
        for _ in 0..env.spec().horizon {
            let action = policy(&obs);
            let (paid, step) = (shaped.step(&action).expect("valid"), env.step(&action).expect("valid"));
            assert_eq!(env.reward(&obs, &action, &step.observation), step.reward);
            if task == Task::Reach {
                assert!((step.reward - paid.reward.ln()).abs() < 1e-3, "{} and {}", step.reward, paid.reward);
            }
            if task == Task::Push {
                assert_eq!(step.reward == 0.0, step.success, "as much as there is at success, and less elsewhere");
            }
            obs = step.observation;
            last = Some((step.reward, step.success));
        }
        let (reward, success) = last.expect("an episode has steps");
        assert!(!success || reward > first + 0.5, "{task}: {first} at the start, {reward} at success");
    }
    let slope = |distance: f64| log_reaching_reward(distance) - log_reaching_reward(distance + 0.01);
    assert!((slope(0.5) - 0.2).abs() < 1e-3 && reaching_reward(0.5) - reaching_reward(0.51) < 1e-4);
}

#[test]
fn bad_actions_are_refused_and_change_nothing() {
    for task in Task::ALL {
        let (mut env, mut untouched) = (task.make(), task.make());
        assert_eq!(env.scene().len(), env.poses().len(), "{task}: also before the first reset");
        env.reset(0);
        untouched.reset(0);
        let size = env.spec().action_size;
        let mut with = vec![0.0; size];
        for bad in [f32::NAN, f32::INFINITY] {
            with[size - 1] = bad;
            assert!(matches!(env.step(&with), Err(Error::Action { .. })));
        }
        assert!(matches!(env.step(&vec![0.0; size + 1]), Err(Error::Action { .. })));
        let good = vec![0.5; size];
        assert_eq!(bits(&env.step(&good).expect("valid")), bits(&untouched.step(&good).expect("valid")), "{task}");
    }
}

#[test]
fn the_arm_does_not_move_before_the_first_reset() {
    for task in [Task::Reach, Task::Push, Task::Lift, Task::Stack, Task::Door] {
        let said = task.make().step(&[0.0; 4]).expect_err("no episode").to_string();
        assert!(said.contains("before the first reset"), "{said}");
    }
}

/// Random actions, some of which hold a bound for a second, so that the arm is pressed into the table, stretched out and folded
/// up: 20,000 on each task, or as many as `PROPTEST_CASES` says. Nothing may become infinite, and nothing may gain much speed.
#[test]
fn the_simulator_survives_random_actions() {
    const LENGTH: u64 = 2_500;
    let asked = std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok());
    let episodes = asked.unwrap_or(20_000_u64).div_ceil(LENGTH);
    let options = TableOptions { action: ActionKind::Pose, horizon: Some(LENGTH as usize), ..TableOptions::default() };
    for task in [Task::Reach, Task::Push, Task::Lift, Task::Stack, Task::Door] {
        let begin = std::time::Instant::now();
        let fastest = (0..episodes).into_par_iter().map(|seed| {
            let mut env = task.make_with(options).expect("an arm task");
            let mut rng = rng::stream(seed, "abuse");
            env.reset(seed);
            let mut fastest = 0.0_f32;
            let mut action = random_action(7, &mut rng);
            for i in 0..LENGTH {
                // A few episodes press straight down throughout.
                if seed % 8 == 0 {
                    action = vec![0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0];
                } else if i % 20 == 0 {
                    action = random_action(7, &mut rng).iter().map(|a| a.signum()).collect();
                } else if (i / 20) % 2 == 0 {
                    action = random_action(7, &mut rng);
                }
                let step = env.step(&action).expect("a valid action");
                assert!(step.observation.iter().all(|x| x.is_finite()), "{task}, seed {seed}, step {i}");
                let speed = step.observation[3..6].iter().map(|v| v * v).sum::<f32>().sqrt();
                fastest = fastest.max(speed);
            }
            fastest
        });
        let fastest = fastest.reduce(|| 0.0, f32::max);
        println!("{task}: {} actions in {:.1?}, at most {fastest:.2} m/s", episodes * LENGTH, begin.elapsed());
        // In free space the hand reaches 2 to 4 m/s; what explodes is faster by orders of magnitude.
        assert!(fastest < 7.0, "{task}: the hand reached {fastest} m/s");
    }
}
