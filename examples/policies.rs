//! Two ways to a policy: SAC, which only sees rewards, and analytic policy gradients, through the simulator itself. Both learn to
//! swing up the pendulum; returns over simulated steps and over seconds: `data/policies.csv`, `data/policies.svg`.
//!
//! `cargo run --example policies` (three minutes); with `-- draw`, only the figure, from the table that is there.

use std::error::Error;
use std::time::{Duration, Instant};

use handful::agent::Mode;
use handful::chart::{Chart, PALETTE, Panels};
use handful::diff::{AnalyticPolicyGradient, AnalyticPolicyGradientConfig, PendulumSwing};
use handful::env::pendulum::Pendulum;
use handful::prelude::*;
use handful::rng;
use handful::study::starts::training_seed;

use nalgebra::SVector;
use plotters::chart::SeriesLabelPosition;

const SEEDS: u64 = 3;
const EPISODES: usize = 20;

#[derive(serde::Deserialize, serde::Serialize)]
struct Row {
    method: String,
    seed: u64,
    /// Simulated steps so far.
    steps: usize,
    /// Seconds of training so far, without evaluation.
    seconds: f64,
    /// Mean return of 20 episodes.
    #[serde(rename = "return")]
    total: f64,
}

/// The mean return of a policy in the environment.
fn evaluate(mut act: impl FnMut(&[f32]) -> f32) -> Result<f64, Box<dyn Error>> {
    let mut world = Pendulum::default();
    let mut total = 0.0;
    for episode in 0..EPISODES {
        let mut obs = world.reset(EvalSeeds::Curve.seed(episode)?);
        loop {
            let step = world.step(&[act(&obs)])?;
            total += f64::from(step.reward) / EPISODES as f64;
            if step.done() {
                break;
            }
            obs = step.observation;
        }
    }
    Ok(total)
}

fn by_gradients(seed: u64, rows: &mut Vec<Row>) -> Result<(), Box<dyn Error>> {
    const STEPS: usize = 200_000;
    let mut rng = rng::stream(seed, "policies");
    let mut search = AnalyticPolicyGradient::new(&PendulumSwing, AnalyticPolicyGradientConfig::default(), &mut rng);
    let mut spent = Duration::ZERO;
    while search.steps < STEPS {
        let clock = Instant::now();
        for _ in 0..40 {
            search.update(&PendulumSwing, &mut rng);
        }
        spent += clock.elapsed();
        let total = evaluate(|obs| search.act(&SVector::from_column_slice(obs))[0])?;
        rows.push(Row { method: "gradients".into(), seed, steps: search.steps, seconds: spent.as_secs_f64(), total });
    }
    Ok(())
}

fn by_sac(seed: u64, rows: &mut Vec<Row>) -> Result<(), Box<dyn Error>> {
    const STEPS: usize = 10_000;
    let mut world = Pendulum::default();
    let mut agent = Sac::new(world.spec(), SacConfig::preset_for("sac", "pendulum")?, seed)?;
    let mut obs = world.reset(training_seed(seed, 0)?);
    let mut spent = Duration::ZERO;
    let mut episodes = 1;
    for steps in 1..=STEPS {
        let clock = Instant::now();
        let action = agent.act(&obs, Mode::Explore);
        let step = world.step(&action)?;
        let done = step.done();
        agent.observe(&Transition {
            obs: std::mem::replace(&mut obs, step.observation.clone()),
            action,
            reward: step.reward,
            next_obs: step.observation,
            terminated: step.terminated,
            truncated: step.truncated,
        });
        if done {
            obs = world.reset(training_seed(seed, episodes)?);
            episodes += 1;
        }
        agent.update();
        spent += clock.elapsed();
        if steps.is_multiple_of(500) {
            let total = evaluate(|obs| agent.act(obs, Mode::Evaluate)[0])?;
            rows.push(Row { method: "sac".into(), seed, steps, seconds: spent.as_secs_f64(), total });
        }
    }
    Ok(())
}

/// Draws the table.
fn draw() -> Result<(), Box<dyn Error>> {
    let rows = csv::Reader::from_path("data/policies.csv")?.into_deserialize().collect::<Result<Vec<Row>, _>>()?;
    let chart = |label: &str, reading: fn(&Row) -> f64, [first, last]: [f64; 2]| {
        let mut chart = Chart::new(label, "mean return of 20 episodes")
            .log_x()
            .x_between(first, last)
            .between(-1700.0, 0.0)
            .legend(SeriesLabelPosition::LowerRight);
        for (method, name, colour) in [("gradients", "through the simulator", PALETTE[0]), ("sac", "SAC", PALETTE[1])] {
            for seed in 0..SEEDS {
                let own = rows.iter().filter(|row| row.method == method && row.seed == seed);
                let name = if seed == 0 { name } else { "" };
                chart = chart.line(name, own.map(|row| (reading(row), row.total))).coloured(colour);
            }
        }
        chart
    };
    let panels = Panels::new("Pendulum: gradients through the simulator, and SAC")
        .panel(chart("simulated steps", |row| row.steps as f64, [400.0, 250_000.0]))
        .panel(chart("seconds of learning", |row| row.seconds, [0.03, 120.0]));
    Ok(std::fs::write("data/policies.svg", panels.svg()?)?)
}

fn main() -> Result<(), Box<dyn Error>> {
    if std::env::args().nth(1).as_deref() == Some("draw") {
        return draw();
    }
    let mut rows = Vec::new();
    for seed in 0..SEEDS {
        by_gradients(seed, &mut rows)?;
        by_sac(seed, &mut rows)?;
    }
    for method in ["gradients", "sac"] {
        for seed in 0..SEEDS {
            let own: Vec<&Row> = rows.iter().filter(|row| row.method == method && row.seed == seed).collect();
            let last = own.last().ok_or("rows of every seed")?;
            let there = own.iter().find(|row| row.total > -160.0);
            let there = there.map_or("never".into(), |row| format!("{} steps, {:.1} s", row.steps, row.seconds));
            println!(
                "{method:9} seed {seed}: above -160 after {there}; at the end {:.0} ({} steps, {:.1} s)",
                last.total, last.steps, last.seconds
            );
        }
    }
    let mut writer = csv::Writer::from_path("data/policies.csv")?;
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    writer.flush()?;
    draw()
}
