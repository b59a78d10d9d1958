//! Two ways to a policy: SAC, which only sees rewards, and gradients through the simulator itself. Both learn to swing up the
//! pendulum; returns over simulated steps and over seconds: `data/policies.csv`, `data/policies.svg`.
//!
//! `cargo run --example policies` (three minutes).

use std::error::Error;
use std::time::{Duration, Instant};

use handful::agent::Mode;
use handful::diff::{AnalyticPolicyGradient, AnalyticPolicyGradientConfig, PendulumSwing};
use handful::env::pendulum::Pendulum;
use handful::prelude::*;
use handful::rng;

use nalgebra::SVector;
use plotters::prelude::*;

const SEEDS: u64 = 3;
const EPISODES: u64 = 20;

#[derive(serde::Serialize)]
struct Row {
    method: &'static str,
    seed: u64,
    /// Simulated steps so far.
    steps: usize,
    /// Seconds of learning so far, judging left out.
    seconds: f64,
    /// Mean return of 20 episodes.
    #[serde(rename = "return")]
    total: f64,
}

/// The mean return of what chooses actions, in the environment.
fn judge(mut act: impl FnMut(&[f32]) -> f32) -> Result<f64, Box<dyn Error>> {
    let mut world = Pendulum::default();
    let mut total = 0.0;
    for episode in 0..EPISODES {
        let mut obs = world.reset((1 << 40) + episode);
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
        let total = judge(|obs| search.act(&SVector::from_column_slice(obs))[0])?;
        rows.push(Row { method: "gradients", seed, steps: search.steps, seconds: spent.as_secs_f64(), total });
    }
    Ok(())
}

fn by_sac(seed: u64, rows: &mut Vec<Row>) -> Result<(), Box<dyn Error>> {
    const STEPS: usize = 10_000;
    let mut world = Pendulum::default();
    let mut agent = Sac::new(world.spec(), SacConfig::preset_for("sac", "pendulum")?, seed)?;
    let mut obs = world.reset(seed << 20);
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
            obs = world.reset((seed << 20) + episodes);
            episodes += 1;
        }
        agent.update();
        spent += clock.elapsed();
        if steps.is_multiple_of(500) {
            let total = judge(|obs| agent.act(obs, Mode::Evaluate)[0])?;
            rows.push(Row { method: "sac", seed, steps, seconds: spent.as_secs_f64(), total });
        }
    }
    Ok(())
}

fn draw(rows: &[Row]) -> Result<(), Box<dyn Error>> {
    let area = SVGBackend::new("data/policies.svg", (820, 360)).into_drawing_area();
    area.fill(&WHITE)?;
    type Reading = fn(&Row) -> f64;
    let about: [(&str, Reading, std::ops::Range<f64>); 2] = [
        ("simulated steps", |row| row.steps as f64, 400.0..250_000.0),
        ("seconds of learning", |row| row.seconds, 0.03..120.0),
    ];
    for (panel, (title, reading, range)) in area.split_evenly((1, 2)).iter().zip(about) {
        let mut chart = ChartBuilder::on(panel)
            .margin(12)
            .x_label_area_size(42)
            .y_label_area_size(60)
            .build_cartesian_2d(range.log_scale(), -1700.0..0.0)?;
        chart
            .configure_mesh()
            .light_line_style(WHITE)
            .x_desc(title)
            .y_desc("return of 20 episodes")
            .x_label_formatter(&|x| x.to_string())
            .y_label_formatter(&|y| format!("{y:.0}"))
            .label_style(("sans-serif", 13))
            .draw()?;
        for (method, name, colour) in
            [("gradients", "through the simulator", RGBColor(0, 114, 178)), ("sac", "SAC", RGBColor(213, 94, 0))]
        {
            for seed in 0..SEEDS {
                let own = rows.iter().filter(|row| row.method == method && row.seed == seed);
                let line = LineSeries::new(own.map(|row| (reading(row), row.total)), colour.stroke_width(2));
                let series = chart.draw_series(line)?;
                if seed == 0 {
                    series
                        .label(name)
                        .legend(move |(x, y)| PathElement::new([(x, y), (x + 22, y)], colour.stroke_width(3)));
                }
            }
        }
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::LowerRight)
            .background_style(WHITE.mix(0.85))
            .border_style(RGBColor(180, 180, 180))
            .label_font(("sans-serif", 13))
            .draw()?;
    }
    Ok(area.present()?)
}

fn main() -> Result<(), Box<dyn Error>> {
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
    draw(&rows)
}
