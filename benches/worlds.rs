//! Control steps per second of the environments: on one core, and of many environments on 1, 2, ... threads.
//!
//! Random actions touch table and cube now and then; with the cube in the hand, every step is contact.

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use handful::env::tabletop::{ActionKind, TableOptions};
use handful::env::vector::VectorEnv;
use handful::env::{Env, Snapshot, Task, World};
use handful::rng;
use rayon::ThreadPoolBuilder;

const STEPS: usize = 50;

fn random_actions(size: usize, count: usize) -> Vec<Vec<f32>> {
    let mut rng = rng::stream(0, "bench");
    let mut action = || (0..size).map(|_| rng::uniform(&mut rng, -1.0, 1.0) as f32).collect();
    (0..count).map(|_| action()).collect()
}

fn endless(task: Task, action: ActionKind) -> World {
    let options = TableOptions { action, horizon: Some(10_000), ..TableOptions::default() };
    task.make_with(options).expect("an arm task")
}

fn steps(c: &mut Criterion) {
    let mut group = c.benchmark_group("control steps");
    group.throughput(Throughput::Elements(STEPS as u64)).sample_size(20);
    for task in [Task::Reach, Task::Push, Task::Lift, Task::Stack, Task::Door] {
        // robosuite's own action of seven numbers, so that the figures can be compared with robosuite's.
        let mut world = endless(task, ActionKind::Pose);
        world.reset(0);
        let actions = random_actions(7, 1000);
        let mut next = actions.iter().cycle();
        group.bench_function(format!("{task}, random actions"), |b| {
            b.iter(|| {
                for action in next.by_ref().take(STEPS) {
                    black_box(world.step(action).expect("a valid action"));
                }
            });
        });
    }
    let mut world = endless(Task::Lift, ActionKind::Hand);
    let policy = Task::Lift.scripted_policy(TableOptions::default()).expect("lift has one");
    let mut obs = world.reset(0);
    for _ in 0..60 {
        obs = world.step(&policy(&obs)).expect("a valid action").observation;
    }
    group.bench_function("lift, cube in hand", |b| {
        b.iter(|| {
            for _ in 0..STEPS {
                obs = world.step(&policy(&obs)).expect("a valid action").observation;
            }
        });
    });
    group.finish();
}

/// 64 environments in lockstep: each step waits for the slowest.
fn side_by_side(c: &mut Criterion) {
    const ENVS: usize = 64;
    let mut group = c.benchmark_group("64 lift environments");
    group.throughput(Throughput::Elements((ENVS * STEPS) as u64)).sample_size(10);
    let actions = random_actions(7, 100 * ENVS);
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    for threads in (0..).map(|i| 1 << i).take_while(|threads| *threads <= cores) {
        let pool = ThreadPoolBuilder::new().num_threads(threads).build().expect("a thread pool");
        let mut envs = VectorEnv::new(ENVS, || endless(Task::Lift, ActionKind::Pose));
        let seeds: Vec<u64> = (0..ENVS as u64).collect();
        envs.reset(&seeds).expect("as many seeds as environments");
        let mut steps = actions.chunks_exact(ENVS).cycle();
        group.bench_function(format!("{threads} threads"), |b| {
            b.iter(|| {
                for actions in steps.by_ref().take(STEPS) {
                    let actions: Vec<_> = actions.iter().cloned().map(Some).collect();
                    pool.install(|| black_box(envs.step(&actions).expect("valid actions")));
                }
            });
        });
    }
    group.finish();
}

fn states(c: &mut Criterion) {
    let mut group = c.benchmark_group("states");
    let mut world = Task::Lift.make();
    world.reset(0);
    group.bench_function("snapshot and restore lift", |b| {
        b.iter(|| {
            let state = world.snapshot();
            world.restore(black_box(&state));
        });
    });
    group.bench_function("reset lift", |b| {
        let mut seed = 0;
        b.iter(|| {
            seed += 1;
            black_box(world.reset(seed))
        });
    });
    group.finish();
}

criterion_group!(benches, steps, side_by_side, states);
criterion_main!(benches);
