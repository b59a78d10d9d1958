//! Dreamer's updates at the published smallest size and in the small preset, and its actions: observation 24, action 4.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use handful::agent::{Dreamer, DreamerConfig};
use handful::prelude::*;
use handful::rng;

/// As in the program itself.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn agent(config: DreamerConfig) -> Dreamer {
    let observation = (0..24).map(|i| Feature::new(i.to_string()));
    let spec = Spec::new("bench", observation, 4, 100, 0.05);
    let mut agent = Dreamer::new(&spec, config, 0).expect("usable settings");
    let mut rng = rng::stream(0, "bench");
    let mut numbers = |count: usize| -> Vec<f32> { (0..count).map(|_| rng::normal(&mut rng) as f32).collect() };
    for i in 1..=5_000 {
        agent.observe(&Transition {
            obs: numbers(24),
            action: numbers(4).iter().map(|a| a.tanh()).collect(),
            reward: numbers(1)[0],
            next_obs: numbers(24),
            terminated: false,
            truncated: i % 100 == 0,
        });
    }
    agent
}

/// The settings of the preset.
fn preset() -> DreamerConfig {
    DreamerConfig::preset_for("dreamer", "reach").expect("a preset")
}

fn updates(c: &mut Criterion) {
    let mut group = c.benchmark_group("Dreamer");
    group.sample_size(10);
    let size1m = DreamerConfig::default();
    let small_batch = DreamerConfig { batch: 8, length: 32, ..size1m.clone() };
    for (name, config) in [("size1m, 16 x 64", size1m), ("size1m, 8 x 32", small_batch), ("preset, 8 x 32", preset())] {
        let mut agent = agent(config);
        group.bench_function(format!("update, {name}"), |b| b.iter(|| black_box(agent.learn())));
    }
    let mut agent = agent(preset());
    let obs = vec![0.1; 24];
    group.bench_function("action, preset", |b| b.iter(|| black_box(agent.act(&obs, Mode::Evaluate))));
    group.finish();
}

criterion_group!(benches, updates);
criterion_main!(benches);
