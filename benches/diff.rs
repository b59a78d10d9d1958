//! The time of a gradient next to that of its roll-out: forward mode, reverse mode (adjoint method) and central differences, on
//! the planar pusher, as the horizon grows. Two numbers in an action.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use handful::diff::derivatives::{gradient, gradient_by_differences, gradient_forward};
use handful::diff::pusher::STATE;
use handful::diff::{Pusher, PusherTask, roll_out};
use nalgebra::SVector;

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
        group.bench_function(BenchmarkId::new("roll-out", horizon), |b| {
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

criterion_group!(benches, gradients);
criterion_main!(benches);
