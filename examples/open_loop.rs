//! How far ahead do learned models predict? Records episodes, trains an ensemble, an autoencoder and a recurrent state-space
//! model on them, and measures the open-loop error of all three on held-out episodes: `data/open_loop/TASK.csv` and `TASK.svg`.
//!
//! `cargo run --example open_loop` (a few minutes) runs `reach` and `push`; give names of tasks to run others.

use std::error::Error;
use std::path::Path;

use handful::agent::{DreamerConfig, Preset};
use handful::env::{Env, Spec, Task, World};
use handful::model::open_loop::{Episode, OpenLoopModel, open_loop};
use handful::model::{Autoencoder, AutoencoderConfig, Ensemble, EnsembleConfig, WorldModel};
use handful::nn::{Adam, AdamConfig};
use handful::plan::noise::ColoredNoise;
use handful::replay::{ReplayBuffer, SequenceReplay, Transition};
use handful::rng::{self, Rng};

use plotters::prelude::*;

const TRAINING: u64 = 60;
const HELD_OUT: u64 = 20;
/// Gradient steps for each model.
const STEPS: usize = 4000;
/// The weight of the scripted policy in the actions of an episode, in turn; the rest is noise.
const SKILL: [f64; 3] = [1.0, 0.7, 0.0];

/// Episodes of the scripted policy, of a noisy version of it, and of noise alone.
struct Recording {
    episodes: Vec<Episode>,
    transitions: ReplayBuffer,
    sequences: SequenceReplay,
}

fn record(task: Task, seeds: std::ops::Range<u64>, rng: &mut Rng) -> Result<Recording, Box<dyn Error>> {
    let mut world: World = task.make();
    let Spec { horizon, action_size, .. } = *world.spec();
    let size = world.spec().observation_size();
    let policy = task.scripted_policy(Default::default()).ok_or("a task with a scripted policy")?;
    let mut recording = Recording {
        episodes: Vec::new(),
        transitions: ReplayBuffer::new(size, action_size, usize::MAX),
        sequences: SequenceReplay::new(size, action_size, usize::MAX),
    };
    for seed in seeds {
        let skill = SKILL[seed as usize % SKILL.len()];
        let noise = ColoredNoise::new(2.0, horizon).sample_actions(action_size, rng);
        let mut obs = world.reset(seed);
        let mut episode = Episode { observations: vec![obs.clone()], ..Episode::default() };
        for noise in noise.chunks_exact(action_size) {
            let mixed =
                policy(&obs).into_iter().zip(noise).map(|(scripted, noise)| skill * f64::from(scripted) + (1.2 - skill) * noise);
            let action: Vec<f32> = mixed.map(|a| a.clamp(-1.0, 1.0) as f32).collect();
            let step = world.step(&action)?;
            episode.actions.push(action.clone());
            episode.observations.push(step.observation.clone());
            episode.rewards.push(step.reward);
            let done = step.done();
            let transition = Transition {
                obs: std::mem::replace(&mut obs, step.observation.clone()),
                action,
                reward: step.reward,
                next_obs: step.observation,
                terminated: step.terminated,
                truncated: step.truncated,
            };
            recording.transitions.push(&transition);
            recording.sequences.push(&transition);
            if done {
                break;
            }
        }
        recording.episodes.push(episode);
    }
    Ok(recording)
}

/// A row of the table.
#[derive(serde::Serialize)]
struct Row {
    model: &'static str,
    horizon: usize,
    rmse: f64,
    rmse_p90: f64,
    coverage90: f64,
}

/// Restricts a model to the features that all models predict in the same form. The latent models do not predict the
/// orientation of a cube in the form in which it is observed.
struct Comparable<'a, Model> {
    model: &'a Model,
    spec: &'a Spec,
}

impl<Model: OpenLoopModel> OpenLoopModel for Comparable<'_, Model> {
    fn predicted(&self) -> Vec<(usize, f32)> {
        self.model.predicted().into_iter().filter(|(i, _)| self.spec.observation[*i].cube.is_none()).collect()
    }

    fn open_loop_predictions(&self, starts: &[(&Episode, usize)], ahead: usize, rng: &mut Rng) -> Vec<Vec<f32>> {
        self.model.open_loop_predictions(starts, ahead, rng)
    }
}

fn evaluate(name: &'static str, model: &impl OpenLoopModel, spec: &Spec, episodes: &[Episode], rows: &mut Vec<Row>) {
    for row in open_loop(&Comparable { model, spec }, episodes, &mut rng::stream(0, "judge")) {
        let (horizon, rmse, rmse_p90, coverage90) = (row.horizon, row.rmse, row.rmse_p90, row.coverage90);
        println!("  {name:12} {horizon:3} steps: error {rmse:.3}, 90th percentile {rmse_p90:.3}");
        rows.push(Row { model: name, horizon, rmse, rmse_p90, coverage90 });
    }
}

fn study(task: Task, folder: &Path) -> Result<(), Box<dyn Error>> {
    let mut rng = rng::stream(0, "foresight");
    let training = record(task, 0..TRAINING, &mut rng)?;
    let held_out = record(task, 1000..1000 + HELD_OUT, &mut rng)?.episodes;
    println!("{}: {} training steps", task.name(), training.transitions.len());
    let world = task.make();
    let spec = world.spec();
    let mut rows = Vec::new();

    let config = EnsembleConfig { hidden: vec![200, 200], first_steps: STEPS, ..EnsembleConfig::default() };
    let mut ensemble = Ensemble::new(spec, config, &mut rng)?;
    ensemble.fit(&training.transitions, &mut rng);
    evaluate("ensemble", &ensemble.dynamics(), spec, &held_out, &mut rows);

    let mut autoencoder = Autoencoder::new(spec, &AutoencoderConfig::default(), &mut rng);
    let mut optimiser = Adam::new(AdamConfig { max_norm: Some(10.0), ..AdamConfig::new(1e-3) });
    for _ in 0..STEPS {
        autoencoder.learn(&training.sequences.sample(16, 16, &mut rng), &mut optimiser);
    }
    evaluate("autoencoder", &autoencoder, spec, &held_out, &mut rows);

    let DreamerConfig { world: config, learning_rate, batch, length, .. } =
        DreamerConfig::preset_for("dreamer", task.name())?;
    let mut rssm = WorldModel::new(spec, &config, &mut rng);
    let mut optimiser = Adam::new(AdamConfig { warm_up: 100, ..AdamConfig::laprop(learning_rate) });
    for _ in 0..STEPS {
        rssm.learn(&training.sequences.sample(batch, length, &mut rng), &mut optimiser, &mut rng);
    }
    evaluate("rssm", &rssm, spec, &held_out, &mut rows);

    std::fs::create_dir_all(folder)?;
    let mut writer = csv::Writer::from_path(folder.join(format!("{}.csv", task.name())))?;
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    writer.flush()?;
    draw(task, &rows, &folder.join(format!("{}.svg", task.name())))
}

fn draw(task: Task, rows: &[Row], path: &Path) -> Result<(), Box<dyn Error>> {
    let area = SVGBackend::new(path, (640, 400)).into_drawing_area();
    area.fill(&WHITE)?;
    let worst = rows.iter().map(|row| row.rmse).fold(1.1, f64::max).min(2.0);
    let mut chart = ChartBuilder::on(&area)
        .caption(format!("{}: open-loop error of learned models", task.name()), ("sans-serif", 20))
        .margin(14)
        .x_label_area_size(44)
        .y_label_area_size(54)
        .build_cartesian_2d(0.0..25.5, 0.0..worst)?;
    chart
        .configure_mesh()
        .light_line_style(WHITE)
        .x_desc("steps ahead, open loop")
        .y_desc("error (1: predicting no change)")
        .label_style(("sans-serif", 14))
        .draw()?;
    chart.draw_series(DashedLineSeries::new(
        [(0.0, 1.0), (25.0, 1.0)],
        7,
        5,
        RGBColor(110, 110, 110).stroke_width(1),
    ))?;
    let colours = [RGBColor(0, 114, 178), RGBColor(230, 159, 0), RGBColor(204, 121, 167)];
    for (model, colour) in ["ensemble", "autoencoder", "rssm"].into_iter().zip(colours) {
        let line = rows.iter().filter(|row| row.model == model).map(|row| (row.horizon as f64, row.rmse));
        chart
            .draw_series(LineSeries::new(line, colour.stroke_width(3)))?
            .label(model)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 22, y)], colour.stroke_width(3)));
    }
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperRight)
        .background_style(WHITE.mix(0.85))
        .border_style(RGBColor(180, 180, 180))
        .label_font(("sans-serif", 14))
        .draw()?;
    area.present()?;
    Ok(())
}

fn main() -> Result<(), Box<dyn Error>> {
    let named: Result<Vec<Task>, _> = std::env::args().skip(1).map(|name| name.parse()).collect();
    let tasks = Some(named?).filter(|tasks| !tasks.is_empty()).unwrap_or_else(|| vec![Task::Reach, Task::Push]);
    tasks.into_iter().try_for_each(|task| study(task, Path::new("data/open_loop")))
}
