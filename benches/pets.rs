//! PETS at the sizes common in the literature (5 members of 28-3x200-48 with SiLU; 350 candidates, 15 time steps, 20
//! particles, 5 CEM iterations) and at those of the presets. Matrix products of the same sizes give the upper bound.

use std::hint::black_box;
use std::sync::Arc;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use handful::model::{Ensemble, EnsembleConfig, Propagation};
use handful::nn::kernels::{Matrix, matmul};
use handful::plan::{CemConfig, PlannerConfig};
use handful::prelude::*;
use handful::rng::{self, Rng};

use rayon::prelude::*;

/// The allocator of the binary `handful`.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const ROWS: usize = 10_240;
const BATCH: usize = 256;

fn spec() -> Spec {
    let observation = (0..24).map(|i| Feature::new(i.to_string()));
    Spec::new("bench", observation, 4, 100, 0.05)
}

/// -||next_obs[..3]||
struct Distance;

impl KnownReward for Distance {
    fn reward(&self, _obs: &[f32], _action: &[f32], next_obs: &[f32]) -> f32 {
        -next_obs[..3].iter().map(|x| x * x).sum::<f32>().sqrt()
    }
}

fn transition(rng: &mut Rng, observations: usize, actions: usize) -> Transition {
    let mut numbers = |count: usize| -> Vec<f32> { (0..count).map(|_| rng::normal(rng) as f32).collect() };
    let (obs, action) = (numbers(observations), numbers(actions).iter().map(|a| a.tanh()).collect());
    let next_obs = obs.iter().zip(numbers(observations)).map(|(x, change)| x + 0.1 * change).collect();
    Transition { obs, action, reward: 0.0, next_obs, terminated: false, truncated: false }
}

fn data(rng: &mut Rng) -> ReplayBuffer {
    let mut data = ReplayBuffer::new(24, 4, ROWS);
    (0..ROWS).for_each(|_| data.push(&transition(rng, 24, 4)));
    data
}

fn pets(spec: &Spec, reward: Arc<dyn KnownReward + Send + Sync>, config: PetsConfig) -> Pets {
    let mut rng = rng::stream(0, "bench");
    let mut agent = Pets::new(spec, Some(reward), config, 0).expect("usable settings");
    (0..1000).for_each(|_| agent.observe(&transition(&mut rng, spec.observation_size(), spec.action_size)));
    agent.fit();
    agent
}

fn plans(c: &mut Criterion) {
    let mut group = c.benchmark_group("PETS");
    group.sample_size(10);
    let cem = CemConfig { horizon: 15, population: 350, elites: 35, iterations: 5, momentum: 0.1 };
    let ensemble = EnsembleConfig { first_steps: 20, ..EnsembleConfig::default() };
    for propagation in [Propagation::TsInf, Propagation::Ts1] {
        let config = PetsConfig {
            ensemble: ensemble.clone(),
            planner: PlannerConfig::Cem(cem.clone()),
            propagation,
            particles: 20,
            ..PetsConfig::default()
        };
        let mut agent = pets(&spec(), Arc::new(Distance), config);
        let obs = vec![0.5; 24];
        // 350 x 5 candidates, 15 time steps, 20 particles, 95,200 multiply-adds each: the networks' part of an action.
        group.throughput(Throughput::Elements(2 * 350 * 5 * 15 * 20 * (28 * 200 + 2 * 200 * 200 + 200 * 48)));
        group.bench_function(
            BenchmarkId::new("one CEM action (throughput: FLOP of products)", format!("{propagation:?}")),
            |b| {
                b.iter(|| black_box(agent.act(&obs, Mode::Evaluate)));
            },
        );
    }
    group.throughput(Throughput::Elements(1));
    for task in [Task::Reach, Task::Push, Task::Lift, Task::Pendulum] {
        let mut config = PetsConfig::preset_for("pets", task.name()).expect("a preset");
        config.ensemble.first_steps = 20;
        let world = task.make();
        let spec = world.spec().clone();
        let mut agent = pets(&spec, Arc::new(task.make()), config);
        let obs = task.make().reset(0);
        group.bench_function(BenchmarkId::new("one action of the preset", task), |b| {
            b.iter(|| black_box(agent.act(&obs, Mode::Evaluate)));
        });
    }
    group.finish();
}

fn training(c: &mut Criterion) {
    let mut group = c.benchmark_group("ensemble");
    let mut rng = rng::stream(1, "bench");
    let data = data(&mut rng);
    let steps = ROWS / BATCH;
    let config = EnsembleConfig {
        held_out: 0.0,
        bootstrap: true,
        first_steps: steps,
        steps,
        batch: BATCH,
        beta: 0.0,
        ..EnsembleConfig::default()
    };
    let mut ensemble = Ensemble::new(&spec(), config, &mut rng).expect("usable settings");
    group.sample_size(10).throughput(Throughput::Elements(steps as u64));
    group.bench_function("gradient steps of 5 members, batch 256 each", |b| {
        b.iter(|| rayon::scope(|_| black_box(ensemble.fit(&data, &mut rng))));
    });
    group.finish();
}

/// Matrix products at these sizes on all cores: the upper bound for everything above.
fn products(c: &mut Criterion) {
    let mut group = c.benchmark_group("matrix product");
    for (rows, inner, columns) in [(100, 200, 200), (256, 256, 256)] {
        let threads = rayon::current_num_threads();
        let (a, b) = (vec![0.5; rows * inner], vec![0.25; inner * columns]);
        let mut outs = vec![vec![0.0; rows * columns]; threads];
        group.throughput(Throughput::Elements((2 * 50 * threads * rows * inner * columns) as u64));
        group.bench_function(format!("{rows} x {inner} x {columns}, {threads} cores, FLOP"), |bench| {
            bench.iter(|| {
                outs.par_iter_mut().for_each(|out| {
                    (0..50)
                        .for_each(|_| matmul(black_box(out), Matrix::new(&a, inner), Matrix::new(&b, columns), false));
                });
            });
        });
    }
    group.finish();
}

criterion_group!(benches, products, plans, training);
criterion_main!(benches);
