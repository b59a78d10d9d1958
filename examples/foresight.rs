//! How far do learned models see? Records episodes, lets an ensemble, an autoencoder and a recurrent state-space model learn
//! from the same ones, and judges all three on others: `data/foresight/TASK.csv` and `TASK.svg`.
//!
//! `cargo run --example foresight` (a few minutes); with names of tasks, only for those; with `draw` before them, only the figures,
//! from the tables that are there.

use std::error::Error;
use std::path::Path;

use handful::agent::{DreamerConfig, Preset};
use handful::chart::{Chart, PALETTE, Panels};
use handful::env::{Env, Spec, Task, World};
use handful::model::open_loop::{Episode, OpenLoopModel, open_loop};
use handful::model::{Autoencoder, AutoencoderConfig, Ensemble, EnsembleConfig, WorldModel};
use handful::nn::{Adam, AdamConfig};
use handful::plan::noise::ColoredNoise;
use handful::replay::{ReplayBuffer, SequenceReplay, Transition};
use handful::rng::{self, Rng};

use plotters::chart::SeriesLabelPosition;

const TRAINING: u64 = 60;
const HELD_OUT: u64 = 20;
/// Steps of learning of each model.
const STEPS: usize = 4000;
/// How many episodes' worth of the scripted policy is in an action, by turns; the rest is noise.
const SKILL: [f64; 3] = [1.0, 0.7, 0.0];

/// Episodes of the scripted policy, of a noisy one, and of noise alone.
struct Recording {
    episodes: Vec<Episode>,
    transitions: ReplayBuffer,
    moments: SequenceReplay,
}

fn record(task: Task, seeds: std::ops::Range<u64>, rng: &mut Rng) -> Result<Recording, Box<dyn Error>> {
    let mut world: World = task.make();
    let Spec { horizon, action_size, .. } = *world.spec();
    let size = world.spec().observation_size();
    let policy = task.scripted_policy(Default::default()).ok_or("a task with a scripted policy")?;
    let mut recording = Recording {
        episodes: Vec::new(),
        transitions: ReplayBuffer::new(size, action_size, usize::MAX),
        moments: SequenceReplay::new(size, action_size, usize::MAX),
    };
    for seed in seeds {
        let skill = SKILL[seed as usize % SKILL.len()];
        let noise = ColoredNoise::new(2.0, horizon).sample_actions(action_size, rng);
        let mut obs = world.reset(seed);
        let mut episode = Episode { observations: vec![obs.clone()], ..Episode::default() };
        for noise in noise.chunks_exact(action_size) {
            let mixed =
                policy(&obs).into_iter().zip(noise).map(|(wise, wild)| skill * f64::from(wise) + (1.2 - skill) * wild);
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
            recording.moments.push(&transition);
            if done {
                break;
            }
        }
        recording.episodes.push(episode);
    }
    Ok(recording)
}

/// A row of the table.
#[derive(serde::Deserialize, serde::Serialize)]
struct Row {
    model: String,
    horizon: usize,
    rmse: f64,
    rmse_p90: f64,
    coverage90: f64,
}

/// A model that is asked only for what all models tell alike: how a cube lies, latent ones tell under other names.
struct Alike<'a, Model> {
    model: &'a Model,
    spec: &'a Spec,
}

impl<Model: OpenLoopModel> OpenLoopModel for Alike<'_, Model> {
    fn predicted(&self) -> Vec<(usize, f32)> {
        self.model.predicted().into_iter().filter(|(i, _)| self.spec.observation[*i].cube.is_none()).collect()
    }

    fn open_loop_predictions(&self, starts: &[(&Episode, usize)], ahead: usize, rng: &mut Rng) -> Vec<Vec<f32>> {
        self.model.open_loop_predictions(starts, ahead, rng)
    }
}

fn judge(name: &str, model: &impl OpenLoopModel, spec: &Spec, episodes: &[Episode], rows: &mut Vec<Row>) {
    for row in open_loop(&Alike { model, spec }, episodes, &mut rng::stream(0, "judge")) {
        let (horizon, rmse, rmse_p90, coverage90) = (row.horizon, row.rmse, row.rmse_p90, row.coverage90);
        println!("  {name:12} {horizon:3} steps: error {rmse:.3}, 90th percentile {rmse_p90:.3}");
        rows.push(Row { model: name.into(), horizon, rmse, rmse_p90, coverage90 });
    }
}

fn study(task: Task, folder: &Path) -> Result<(), Box<dyn Error>> {
    let mut rng = rng::stream(0, "foresight");
    let training = record(task, 0..TRAINING, &mut rng)?;
    let held_out = record(task, 1000..1000 + HELD_OUT, &mut rng)?.episodes;
    println!("{}: {} steps to learn from", task.name(), training.transitions.len());
    let world = task.make();
    let spec = world.spec();
    let mut rows = Vec::new();

    let config = EnsembleConfig { hidden: vec![200, 200], first_steps: STEPS, ..EnsembleConfig::default() };
    let mut ensemble = Ensemble::new(spec, config, &mut rng)?;
    ensemble.fit(&training.transitions, &mut rng);
    judge("ensemble", &ensemble.dynamics(), spec, &held_out, &mut rows);

    let mut autoencoder = Autoencoder::new(spec, &AutoencoderConfig::default(), &mut rng);
    let mut optimiser = Adam::new(AdamConfig { max_norm: Some(10.0), ..AdamConfig::new(1e-3) });
    for _ in 0..STEPS {
        autoencoder.learn(&training.moments.sample(16, 16, &mut rng), &mut optimiser);
    }
    judge("autoencoder", &autoencoder, spec, &held_out, &mut rows);

    let DreamerConfig { world: config, learning_rate, batch, length, .. } =
        DreamerConfig::preset_for("dreamer", task.name())?;
    let mut rssm = WorldModel::new(spec, &config, &mut rng);
    let mut optimiser = Adam::new(AdamConfig { warm_up: 100, ..AdamConfig::laprop(learning_rate) });
    for _ in 0..STEPS {
        rssm.learn(&training.moments.sample(batch, length, &mut rng), &mut optimiser, &mut rng);
    }
    judge("rssm", &rssm, spec, &held_out, &mut rows);

    std::fs::create_dir_all(folder)?;
    let mut writer = csv::Writer::from_path(folder.join(format!("{}.csv", task.name())))?;
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    writer.flush()?;
    draw(task, folder)
}

/// Draws a task's table.
fn draw(task: Task, folder: &Path) -> Result<(), Box<dyn Error>> {
    let table = folder.join(format!("{}.csv", task.name()));
    let rows = csv::Reader::from_path(table)?.into_deserialize().collect::<Result<Vec<Row>, _>>()?;
    let worst = rows.iter().map(|row| row.rmse).fold(1.1, f64::max).min(2.0);
    let mut chart = Chart::new("steps ahead", "open-loop prediction error (1: predicting no change)")
        .x_between(0.0, 25.5)
        .between(0.0, worst)
        .mark(1.0)
        .legend(SeriesLabelPosition::UpperRight);
    for (model, colour) in ["ensemble", "autoencoder", "rssm"].into_iter().zip([0, 4, 3].map(|i| PALETTE[i])) {
        let line = rows.iter().filter(|row| row.model == model).map(|row| (row.horizon as f64, row.rmse));
        chart = chart.line(model, line).coloured(colour);
    }
    let panels = Panels::new(&format!("{}: open-loop prediction error of learned models", task.name())).panel(chart);
    Ok(std::fs::write(folder.join(format!("{}.svg", task.name())), panels.svg()?)?)
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut names: Vec<String> = std::env::args().skip(1).collect();
    let only_draw = names.first().is_some_and(|name| name == "draw");
    names.drain(..usize::from(only_draw));
    let named: Result<Vec<Task>, _> = names.iter().map(|name| name.parse()).collect();
    let tasks = Some(named?).filter(|tasks| !tasks.is_empty()).unwrap_or_else(|| vec![Task::Reach, Task::Push]);
    let folder = Path::new("data/foresight");
    tasks.into_iter().try_for_each(|task| if only_draw { draw(task, folder) } else { study(task, folder) })
}
