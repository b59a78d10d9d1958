//! The time of a gradient next to that of its rollout: forward mode, reverse mode (adjoint method) and central differences, on
//! the planar pusher, as the horizon grows. Two numbers in an action.
//!
//! The time of the Jacobians of a control step next to that of the step, on the arm: columns one at a time, as `linearise` has them,
//! and all at once, in numbers that carry 17 derivatives.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use handful::diff::derivatives::{gradient, gradient_by_differences, gradient_forward, linearise};
use handful::diff::pusher::STATE;
use handful::diff::{FreeArm, Pusher, PusherTask, ReachTask, System, roll_out};
use handful::env::arm::ArmDescription;
use nalgebra::{SVector, Vector3};
use num_dual::DualSVec64;

/// As in the program itself.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn gradients(c: &mut Criterion) {
    let mut group = c.benchmark_group("pusher");
    group.sample_size(10);
    let task = PusherTask { pusher: Pusher::default(), goal: [0.1, 0.02] };
    let mut start = SVector::<f64, STATE>::zeros();
    (start[0], start[1]) = (-0.04, 0.004);
    for horizon in [5, 20, 80] {
        let actions = vec![SVector::from([0.4, 0.05]); horizon];
        group.bench_function(BenchmarkId::new("rollout", horizon), |b| {
            b.iter(|| black_box(roll_out(&task, &start, &actions)))
        });
        group.bench_function(BenchmarkId::new("reverse", horizon), |b| {
            b.iter(|| black_box(gradient(&task, &start, &actions)))
        });
        group.bench_function(BenchmarkId::new("forward", horizon), |b| {
            b.iter(|| black_box(gradient_forward(&task, &start, &actions)))
        });
        group.bench_function(BenchmarkId::new("differences", horizon), |b| {
            b.iter(|| black_box(gradient_by_differences(&task, &start, &actions, 1e-5)))
        });
    }
    group.finish();
}

fn jacobians(c: &mut Criterion) {
    let mut group = c.benchmark_group("arm");
    group.sample_size(10);
    let panda = ArmDescription::panda();
    let task = ReachTask { arm: FreeArm::new(&panda, &panda.home), goal: Vector3::new(0.1, 0.0, 1.0) };
    let (state, action) = (task.arm.at_rest(&panda.home), Vector3::new(0.5, 0.2, -0.1));
    let state = task.step(&state, &action);
    group.bench_function("step", |b| b.iter(|| black_box(task.step(&state, &action))));
    group.bench_function("columns", |b| b.iter(|| black_box(linearise(&task, &state, &action))));
    group.bench_function("at once", |b| {
        b.iter(|| {
            let by_state = num_dual::jacobian(|state| task.step(&state, &action.map(DualSVec64::from_re)), &state);
            let by_action = num_dual::jacobian(|action| task.step(&state.map(DualSVec64::from_re), &action), &action);
            black_box((by_state, by_action))
        })
    });
    group.finish();
}

criterion_group!(benches, gradients, jacobians);
criterion_main!(benches);
