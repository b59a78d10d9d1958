//! Trajectories with and without gradients: iLQR, gradient shooting, CEM and iCEM on the same problems, by the steps that they
//! simulate, the time that they take, and what they find: `data/trajectories.csv`.
//!
//! `cargo run --example trajectories` (two minutes).

use std::error::Error;
use std::f64::consts::PI;
use std::time::Instant;

use handful::diff::pusher::STATE;
use handful::diff::{CartPoleSwing, Ilqr, IlqrConfig, PendulumSwing, Pusher, PusherTask, Simulated, System, roll_out};
use handful::plan::{CemConfig, GradientConfig, IcemConfig, PlannerConfig};
use handful::rng::{self, uniform};
use nalgebra::SVector;

#[derive(serde::Serialize)]
struct Row {
    problem: &'static str,
    method: &'static str,
    start: usize,
    steps: usize,
    milliseconds: f64,
    cost: f64,
    success: bool,
}

/// One problem from one start, by every method.
fn compare<const N: usize, const M: usize>(
    problem: &'static str,
    start: usize,
    system: &impl System<N, M>,
    from: &SVector<f64, N>,
    guess: &[SVector<f64, M>],
    success: impl Fn(&SVector<f64, N>) -> bool,
    rows: &mut Vec<Row>,
) {
    let horizon = guess.len();
    let clock = Instant::now();
    let found =
        Ilqr::new(IlqrConfig { iterations: 200, tolerance: 1e-5, ..IlqrConfig::default() }).solve(system, from, guess);
    let mut note = |method, steps, clock: Instant, actions: &[SVector<f64, M>]| {
        let milliseconds = clock.elapsed().as_secs_f64() * 1e3;
        let (states, cost) = roll_out(system, from, actions);
        rows.push(Row { problem, method, start, steps, milliseconds, cost, success: success(&states[horizon]) });
    };
    note("ilqr", found.steps, clock, &found.actions);
    let planners = [
        (
            "gradient",
            PlannerConfig::Gradient(GradientConfig { horizon, iterations: 300, rate: 0.05, ..Default::default() }),
        ),
        ("cem", PlannerConfig::Cem(CemConfig { horizon, iterations: 40, ..Default::default() })),
        (
            "icem",
            PlannerConfig::Icem(IcemConfig {
                horizon,
                population: 400,
                elites: 40,
                iterations: 40,
                decay: 1.05,
                noise_beta: 2.0,
                ..Default::default()
            }),
        ),
    ];
    for (method, planner) in planners {
        let clock = Instant::now();
        let mut objective = Simulated::new(system, *from);
        let plan = planner.build(M).plan(&mut objective, &mut |_| {}, &mut rng::stream(start as u64, method));
        let actions: Vec<SVector<f64, M>> =
            plan.actions.chunks_exact(M).map(|a| SVector::from_fn(|i, _| f64::from(a[i]).clamp(-1.0, 1.0))).collect();
        note(method, objective.steps, clock, &actions);
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    const STARTS: usize = 10;
    let mut rows = Vec::new();
    let mut rng = rng::stream(0, "trajectories");
    for start in 0..STARTS {
        let nudges: Vec<SVector<f64, 1>> = (0..150).map(|_| SVector::from([0.1 * rng::normal(&mut rng)])).collect();
        let from = SVector::from([PI + uniform(&mut rng, -0.3, 0.3), uniform(&mut rng, -0.3, 0.3)]);
        let upright = |end: &SVector<f64, 2>| end[0].cos() > 0.98 && end[1].abs() < 0.5;
        compare("pendulum", start, &PendulumSwing, &from, &nudges[..100], upright, &mut rows);

        let from = SVector::from([0.0, 0.0, PI + uniform(&mut rng, -0.3, 0.3), 0.0]);
        let upright = |end: &SVector<f64, 4>| end[2].cos() > 0.98 && end[3].abs() < 0.5;
        compare("cart-pole", start, &CartPoleSwing, &from, &nudges, upright, &mut rows);

        let (direction, distance) = (uniform(&mut rng, -PI, PI), uniform(&mut rng, 0.05, 0.15));
        let task =
            PusherTask { pusher: Pusher::default(), goal: [distance * direction.cos(), distance * direction.sin()] };
        let around = uniform(&mut rng, -PI, PI);
        let mut from = SVector::<f64, STATE>::zeros();
        (from[0], from[1], from[4]) = (0.07 * around.cos(), 0.07 * around.sin(), uniform(&mut rng, -0.78, 0.78));
        let there = |end: &SVector<f64, STATE>| task.distance(end) < 0.01;
        compare("pusher", start, &task, &from, &task.guess(&from, 60), there, &mut rows);
    }
    println!("| problem | method | success | simulated steps | ms | cost |\n| --- | --- | --- | --- | --- | --- |");
    for problem in ["pendulum", "cart-pole", "pusher"] {
        for method in ["ilqr", "gradient", "cem", "icem"] {
            let own: Vec<&Row> = rows.iter().filter(|row| row.problem == problem && row.method == method).collect();
            let mean = |of: &dyn Fn(&Row) -> f64| own.iter().map(|row| of(row)).sum::<f64>() / own.len() as f64;
            let success = own.iter().filter(|row| row.success).count();
            println!(
                "| {problem} | {method} | {success} of {STARTS} | {:.0} | {:.0} | {:.2} |",
                mean(&|row| row.steps as f64),
                mean(&|row| row.milliseconds),
                mean(&|row| row.cost)
            );
        }
    }
    let mut writer = csv::Writer::from_path("data/trajectories.csv")?;
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    Ok(writer.flush()?)
}
