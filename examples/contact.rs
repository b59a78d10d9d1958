//! Where gradients mislead: through contact. Compares the exact gradient of a push's cost with the gradient of its expected cost
//! under a little action noise (randomised smoothing), for softer and stiffer contact and for shorter and longer pushes; and
//! with finite differences in rapier3d, whose contact is not smooth. `data/contact.csv`, `data/contact-rapier.csv`,
//! `data/contact.svg`.
//!
//! `cargo run --example contact` (three minutes); with `-- draw`, only the figure, from the tables that are there.

use std::error::Error;

use handful::chart::{Chart, PALETTE, Panels};
use handful::diff::derivatives::gradient;
use handful::diff::pusher::STATE;
use handful::diff::{Pusher, PusherTask};
use handful::env::{Env, Snapshot, Task};
use handful::rng::{self, Rng, uniform};
use nalgebra::SVector;
use plotters::chart::SeriesLabelPosition;
use rayon::prelude::*;

const STIFFNESS: [f64; 5] = [50.0, 150.0, 500.0, 1500.0, 5000.0];
const HORIZONS: [usize; 4] = [5, 10, 20, 40];
/// Pushes for each pair of stiffness and horizon.
const PUSHES: usize = 16;
/// Noisy copies of each push, and the standard deviation of the noise on each number of an action.
const COPIES: usize = 200;
const SHAKE: f64 = 0.1;

/// A row of the first table; gradients are those of the cost with respect to all actions, means over the pushes.
#[derive(Clone, serde::Deserialize, serde::Serialize)]
struct Row {
    stiffness: f64,
    horizon: usize,
    /// Norm of the exact gradient.
    exact: f64,
    /// Norm of the gradient of the expected cost.
    smoothed: f64,
    /// Norm of their difference, relative to the second.
    bias: f64,
    /// Cosine of the angle between the two.
    cosine: f64,
    /// Standard deviation of the first-order estimate (the exact gradient of one noisy copy), relative to the second.
    first_order_deviation: f64,
    /// The same of the zeroth-order estimate, from the cost of one noisy copy alone.
    zeroth_order_deviation: f64,
}

type Actions = Vec<SVector<f64, 2>>;

fn flat(actions: &[SVector<f64, 2>]) -> Vec<f64> {
    actions.iter().flat_map(|action| [action.x, action.y]).collect()
}

fn norm(x: &[f64]) -> f64 {
    x.iter().map(|x| x * x).sum::<f64>().sqrt()
}

fn mean(rows: &[Vec<f64>]) -> Vec<f64> {
    (0..rows[0].len()).map(|i| rows.iter().map(|row| row[i]).sum::<f64>() / rows.len() as f64).collect()
}

/// Root of the mean squared distance from the mean.
fn deviation(rows: &[Vec<f64>], centre: &[f64]) -> f64 {
    let square = |row: &Vec<f64>| row.iter().zip(centre).map(|(x, c)| (x - c).powi(2)).sum::<f64>();
    (rows.iter().map(square).sum::<f64>() / rows.len() as f64).sqrt()
}

/// A push that meets the block somewhere on its side, or just misses its corner.
fn push(stiffness: f64, horizon: usize, rng: &mut Rng) -> (PusherTask, SVector<f64, STATE>, Actions) {
    let pusher = Pusher { stiffness, ..Pusher::default() };
    let mut start = SVector::<f64, STATE>::zeros();
    (start[0], start[1]) = (-0.034, uniform(rng, -0.03, 0.03));
    let actions = (0..horizon).map(|_| SVector::from([uniform(rng, 0.2, 0.6), uniform(rng, -0.2, 0.2)])).collect();
    (PusherTask { pusher, goal: [0.1, uniform(rng, -0.05, 0.05)] }, start, actions)
}

fn study(stiffness: f64, horizon: usize) -> Row {
    let one = |seed: u64| {
        let mut rng = rng::stream(seed, "contact");
        let (task, start, actions) = push(stiffness, horizon, &mut rng);
        let (cost, exact, _) = gradient(&task, &start, &actions);
        let exact = flat(&exact);
        let (mut first, mut zeroth) = (Vec::new(), Vec::new());
        for _ in 0..COPIES {
            let shake: Actions =
                actions.iter().map(|_| SVector::from([rng::normal(&mut rng), rng::normal(&mut rng)])).collect();
            let shaken: Actions = actions.iter().zip(&shake).map(|(action, shake)| action + shake * SHAKE).collect();
            let (higher, slopes, _) = gradient(&task, &start, &shaken);
            first.push(flat(&slopes));
            zeroth.push(flat(&shake).iter().map(|e| (higher - cost) * e / SHAKE).collect());
        }
        let smoothed = mean(&first);
        let difference: Vec<f64> = exact.iter().zip(&smoothed).map(|(e, s)| e - s).collect();
        let product: f64 = exact.iter().zip(&smoothed).map(|(e, s)| e * s).sum();
        let size = norm(&smoothed).max(1e-9);
        [
            norm(&exact),
            size,
            norm(&difference) / size,
            product / (size * norm(&exact).max(1e-9)),
            deviation(&first, &smoothed) / size,
            deviation(&zeroth, &mean(&zeroth)) / size,
        ]
    };
    let all: Vec<[f64; 6]> = (0..PUSHES as u64).into_par_iter().map(one).collect();
    // The median: a push that misses has next to no gradient to be compared with.
    let median = |i: usize| {
        let mut column: Vec<f64> = all.iter().map(|row| row[i]).collect();
        column.sort_by(f64::total_cmp);
        column[column.len() / 2]
    };
    Row {
        stiffness,
        horizon,
        exact: median(0),
        smoothed: median(1),
        bias: median(2),
        cosine: median(3),
        first_order_deviation: median(4),
        zeroth_order_deviation: median(5),
    }
}

/// A row of the second table: how far two finite differences of rapier3d's push agree that differ in their step only.
#[derive(serde::Serialize)]
struct RapierRow {
    horizon: usize,
    step: f32,
    /// Mean norm of the gradient of the cube's distance from its goal (m) with respect to all actions.
    norm: f64,
    /// Mean cosine of the angle to the gradient with the largest step.
    cosine: f64,
}

/// Central differences over snapshots of the `push` world, with the hand at the cube.
fn rapier() -> Result<Vec<RapierRow>, Box<dyn Error>> {
    const STEPS: [f32; 4] = [0.3, 0.1, 0.03, 0.01];
    let policy = Task::Push.scripted_policy(Default::default()).ok_or("a scripted policy")?;
    let mut rows = Vec::new();
    for horizon in [5, 10, 20] {
        let gradients: Vec<Vec<Vec<f64>>> = (0..8_u64)
            .into_par_iter()
            .map(|seed| {
                let mut world = Task::Push.make();
                let names: Vec<String> = world.spec().observation.iter().map(|feature| feature.name.clone()).collect();
                let at = names.iter().position(|name| name == "cube to goal x").expect("a way to go");
                let distance = |obs: &[f32]| f64::from(obs[at]).hypot(obs[at + 1].into());
                let mut obs = world.reset(seed);
                let first = distance(&obs);
                // Until the cube has begun to move.
                while distance(&obs) > first - 0.01 {
                    obs = world.step(&policy(&obs)).expect("a valid action").observation;
                }
                let state = world.snapshot();
                let mut actions = Vec::new();
                for _ in 0..horizon {
                    let action = policy(&obs);
                    obs = world.step(&action).expect("a valid action").observation;
                    actions.push([0, 1, 2, 3].map(|i| action[i].clamp(-0.7, 0.7)));
                }
                let mut outcome = |actions: &[[f32; 4]]| {
                    world.restore(&state);
                    let mut last = 0.0;
                    for action in actions {
                        last = distance(&world.step(action).expect("a valid action").observation);
                    }
                    last
                };
                let of_step = |step: f32, outcome: &mut dyn FnMut(&[[f32; 4]]) -> f64| -> Vec<f64> {
                    let mut slopes = Vec::new();
                    for t in 0..horizon {
                        for i in 0..3 {
                            let mut moved = actions.clone();
                            moved[t][i] += step;
                            let above = outcome(&moved);
                            moved[t][i] -= 2.0 * step;
                            slopes.push((above - outcome(&moved)) / f64::from(2.0 * step));
                        }
                    }
                    slopes
                };
                STEPS.map(|step| of_step(step, &mut outcome)).to_vec()
            })
            .collect();
        for (i, step) in STEPS.into_iter().enumerate() {
            let average =
                |of: &dyn Fn(&Vec<Vec<f64>>) -> f64| gradients.iter().map(of).sum::<f64>() / gradients.len() as f64;
            let cosine = |all: &Vec<Vec<f64>>| {
                let product: f64 = all[i].iter().zip(&all[0]).map(|(a, b)| a * b).sum();
                product / (norm(&all[i]) * norm(&all[0])).max(1e-12)
            };
            rows.push(RapierRow { horizon, step, norm: average(&|all| norm(&all[i])), cosine: average(&cosine) });
        }
    }
    Ok(rows)
}

/// Draws the first table.
fn draw() -> Result<(), Box<dyn Error>> {
    let rows = csv::Reader::from_path("data/contact.csv")?.into_deserialize().collect::<Result<Vec<Row>, _>>()?;
    let chart = |title: &str, reading: fn(&Row) -> f64, top: f64| {
        let mut chart = Chart::new("contact stiffness, N/m", "share of the smoothed gradient")
            .titled(title)
            .log_x()
            .x_between(40.0, 6000.0)
            .between(0.0, top)
            .legend(SeriesLabelPosition::UpperRight);
        for (horizon, colour) in HORIZONS.into_iter().zip([0, 2, 4, 1].map(|i| PALETTE[i])) {
            let line = rows.iter().filter(|row| row.horizon == horizon).map(|row| (row.stiffness, reading(row)));
            chart = chart.line(&format!("{horizon} steps"), line).coloured(colour);
        }
        chart
    };
    let panels = Panels::new("Gradients of a push through contact")
        .panel(chart("bias: distance from the smoothed gradient", |row| row.bias, 0.8))
        .panel(chart("standard deviation of one noisy gradient", |row| row.first_order_deviation, 2.4));
    Ok(std::fs::write("data/contact.svg", panels.svg()?)?)
}

fn main() -> Result<(), Box<dyn Error>> {
    if std::env::args().nth(1).as_deref() == Some("draw") {
        return draw();
    }
    let mut rows = Vec::new();
    for horizon in HORIZONS {
        for stiffness in STIFFNESS {
            let row = study(stiffness, horizon);
            println!(
                "{horizon:3} steps, {stiffness:5} N/m: exact {:.3}, smoothed {:.3}, bias {:.2}, cosine {:.2}, deviation {:.2} by gradients, {:.2} by costs",
                row.exact, row.smoothed, row.bias, row.cosine, row.first_order_deviation, row.zeroth_order_deviation
            );
            rows.push(row);
        }
    }
    let mut writer = csv::Writer::from_path("data/contact.csv")?;
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    writer.flush()?;
    let mut writer = csv::Writer::from_path("data/contact-rapier.csv")?;
    for row in rapier()? {
        println!(
            "rapier, {:2} steps, differences of {:4}: norm {:.4}, cosine {:.2}",
            row.horizon, row.step, row.norm, row.cosine
        );
        writer.serialize(row)?;
    }
    writer.flush()?;
    draw()
}
