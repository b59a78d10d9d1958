//! TD-MPC2's updates and actions in the presets' two sizes: observation 24, action 4. An action has to fit into a control step of
//! 50 ms, and leave time for learning.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use handful::prelude::*;
use handful::rng;

/// As in the program itself.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn agent(config: TdMpc2Config) -> TdMpc2 {
    let observation = (0..24).map(|i| Feature::new(i.to_string()));
    let spec = Spec::new("bench", observation, 4, 100, 0.05);
    let mut agent = TdMpc2::new(&spec, config, 0).expect("usable settings");
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

fn updates_and_actions(c: &mut Criterion) {
    let mut group = c.benchmark_group("TD-MPC2");
    group.sample_size(10);
    let obs = vec![0.1; 24];
    for task in ["reach", "push"] {
        let mut agent = agent(TdMpc2Config::preset_for("tdmpc2", task).expect("a preset"));
        group.bench_function(format!("update, {task}"), |b| b.iter(|| black_box(agent.learn())));
        group.bench_function(format!("action, {task}"), |b| b.iter(|| black_box(agent.act(&obs, Mode::Evaluate))));
    }
    group.finish();
}

criterion_group!(benches, updates_and_actions);
criterion_main!(benches);
