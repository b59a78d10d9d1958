//! SAC at the sizes of the usual comparison: observation 24, action 4, 256 x 256, batch 256.

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use handful::nn::kernels::{Matrix, matmul};
use handful::prelude::*;
use handful::rng;

/// As in the program itself.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn agent(config: SacConfig) -> Sac {
    let observation = (0..24).map(|i| Feature::new(i.to_string()));
    let spec = Spec::new("bench", observation, 4, 100, 0.05);
    let mut agent = Sac::new(&spec, config, 0).expect("usable settings");
    let mut rng = rng::stream(0, "bench");
    let mut numbers = |count: usize| -> Vec<f32> { (0..count).map(|_| rng::normal(&mut rng) as f32).collect() };
    for i in 0..20_000 {
        agent.observe(&Transition {
            obs: numbers(24),
            action: numbers(4).iter().map(|a| a.tanh()).collect(),
            reward: numbers(1)[0],
            next_obs: numbers(24),
            terminated: i % 100 == 0,
            truncated: false,
        });
    }
    agent
}

fn updates(c: &mut Criterion) {
    let mut group = c.benchmark_group("SAC");
    group.sample_size(20).throughput(Throughput::Elements(1));
    let mut plain = agent(SacConfig::default());
    group.bench_function("update, 256x256, batch 256", |b| b.iter(|| black_box(plain.update())));
    let mut normalised = agent(SacConfig { layer_norm: true, ..SacConfig::default() });
    group.bench_function("update with normalised critics", |b| b.iter(|| black_box(normalised.update())));
    let obs = vec![0.1; 24];
    group.bench_function("action", |b| b.iter(|| black_box(plain.act(&obs, Mode::Evaluate))));
    group.finish();
}

/// A matrix product at these sizes: the upper bound on the throughput of everything above.
fn products(c: &mut Criterion) {
    const N: usize = 256;
    let mut group = c.benchmark_group("matrix product");
    group.throughput(Throughput::Elements(2 * (N * N * N) as u64));
    let (a, b) = (vec![0.5; N * N], vec![0.25; N * N]);
    let mut out = vec![0.0; N * N];
    group.bench_function("256 x 256 x 256, one core, FLOP", |bench| {
        bench.iter(|| matmul(black_box(&mut out), Matrix::new(&a, N), Matrix::new(&b, N), false));
    });
    group.finish();
}

criterion_group!(benches, updates, products);
criterion_main!(benches);
