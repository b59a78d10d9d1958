//! Open-loop error of learned models over the prediction horizon. Records episodes, trains an ensemble, an autoencoder and a
//! recurrent state-space model on the same ones, and evaluates all three on others: `data/open_loop/TASK.csv` and
//! `TASK.svg`.
//!
//! `cargo run --example open_loop` (a few minutes); with names of tasks as arguments, only those;
//! with `-- draw`, only the figures, from the tables that are there; with `-- calibration`, instead of all this, how well the
//! uncertainty of ensembles is calibrated that is propagated in different ways: `data/open_loop/calibration.csv`.

use std::error::Error;
use std::path::Path;

use handful::agent::{DreamerConfig, Preset};
use handful::chart::{Chart, PALETTE, Panels};
use handful::env::{Env, Spec, Task, World};
use handful::model::open_loop::{HORIZONS, OpenLoop, OpenLoopModel, Propagated, open_loop};
use handful::model::{Autoencoder, AutoencoderConfig, Ensemble, EnsembleConfig, Propagation, WorldModel};
use handful::nn::{Adam, AdamConfig};
use handful::plan::noise::ColoredNoise;
use handful::replay::{Episode, ReplayBuffer, SequenceReplay, Transition};
use handful::rng::{self, Rng};
use plotters::prelude::SeriesLabelPosition;

/// Episodes for training.
const TRAINING: u64 = 60;
/// Episodes for evaluation.
const HELD_OUT: u64 = 20;
/// Gradient steps of each model.
const STEPS: usize = 4000;
/// Ensembles whose calibration is measured, for each task.
const SEEDS: u64 = 5;
/// Weight of the scripted policy's action, for one episode after the other; noise has 1.2 minus that.
const POLICY_WEIGHTS: [f64; 3] = [1.0, 0.7, 0.0];

/// Episodes of the scripted policy, of the policy with noise, and of noise alone.
struct Dataset {
    episodes: Vec<Episode>,
    transitions: ReplayBuffer,
    sequences: SequenceReplay,
}

fn record(task: Task, seeds: std::ops::Range<u64>, rng: &mut Rng) -> Result<Dataset, Box<dyn Error>> {
    let mut world: World = task.make();
    let Spec { horizon, action_size, .. } = *world.spec();
    let size = world.spec().observation_size();
    let policy = task.scripted_policy(Default::default()).ok_or("a task with a scripted policy")?;
    let mut dataset = Dataset {
        episodes: Vec::new(),
        transitions: ReplayBuffer::new(size, action_size, usize::MAX),
        sequences: SequenceReplay::new(size, action_size, usize::MAX),
    };
    for seed in seeds {
        let weight = POLICY_WEIGHTS[seed as usize % POLICY_WEIGHTS.len()];
        let noise = ColoredNoise::new(2.0, horizon).sample_actions(action_size, rng);
        let mut obs = world.reset(seed);
        let mut episode = Episode { observations: vec![obs.clone()], ..Episode::default() };
        for noise in noise.chunks_exact(action_size) {
            let mixed = policy(&obs)
                .into_iter()
                .zip(noise)
                .map(|(scripted, noise)| weight * f64::from(scripted) + (1.2 - weight) * noise);
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
            dataset.transitions.push(&transition);
            dataset.sequences.push(&transition);
            if done {
                break;
            }
        }
        dataset.episodes.push(episode);
    }
    Ok(dataset)
}

/// A row of `TASK.csv`: see [`handful::model::open_loop::OpenLoop`].
#[derive(serde::Deserialize, serde::Serialize)]
struct Row {
    model: String,
    horizon: usize,
    rmse: f64,
    rmse_p90: f64,
    coverage90: Option<f64>,
}

/// Open-loop errors from the same start times for every model.
fn errors(model: &impl OpenLoopModel, spec: &Spec, episodes: &[Episode]) -> Vec<OpenLoop> {
    open_loop(model, spec, episodes, &mut rng::stream(0, "judge"))
}

fn evaluate(name: &'static str, model: &impl OpenLoopModel, spec: &Spec, episodes: &[Episode], rows: &mut Vec<Row>) {
    for row in errors(model, spec, episodes) {
        let (horizon, rmse, rmse_p90, coverage90) = (row.horizon, row.rmse, row.rmse_p90, row.coverage90);
        println!("  {name:12} {horizon:3} steps: error {rmse:.3}, 90th percentile {rmse_p90:.3}");
        rows.push(Row { model: name.into(), horizon, rmse, rmse_p90, coverage90 });
    }
}

fn ensemble_config() -> EnsembleConfig {
    EnsembleConfig { hidden: vec![200, 200], first_steps: STEPS, ..EnsembleConfig::default() }
}

fn compare(task: Task, folder: &Path) -> Result<(), Box<dyn Error>> {
    let mut rng = rng::stream(0, "foresight");
    let training = record(task, 0..TRAINING, &mut rng)?;
    let held_out = record(task, 1000..1000 + HELD_OUT, &mut rng)?.episodes;
    println!("{}: {} training transitions", task.name(), training.transitions.len());
    let world = task.make();
    let spec = world.spec();
    let mut rows = Vec::new();

    let mut ensemble = Ensemble::new(spec, ensemble_config(), &mut rng)?;
    ensemble.fit(&training.transitions, &mut rng);
    let dynamics = &ensemble.dynamics();
    evaluate("ensemble", &Propagated { dynamics, propagation: Propagation::TsInf }, spec, &held_out, &mut rows);

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
    draw(task, folder)
}

/// Ways of propagating uncertainty, and their names in the figure. `Expectation` predicts one trajectory and no uncertainty.
const PROPAGATIONS: [(Propagation, &str); 5] = [
    (Propagation::TsInf, "TS-inf"),
    (Propagation::Ts1, "TS1"),
    (Propagation::MomentMatching, "moment matching"),
    (Propagation::TsInfMean, "TS-inf, means only"),
    (Propagation::Expectation, "expectation"),
];

/// A row of `calibration.csv`.
#[derive(serde::Deserialize, serde::Serialize)]
struct CalibrationRow {
    task: String,
    propagation: Propagation,
    seed: u64,
    horizon: usize,
    rmse: f64,
    nll: Option<f64>,
    coverage90: Option<f64>,
}

/// Ensembles of five seeds, each trained on its own episodes, whose uncertainty is propagated in every way.
fn calibrate(task: Task, writer: &mut csv::Writer<std::fs::File>) -> Result<(), Box<dyn Error>> {
    let world = task.make();
    let spec = world.spec();
    for seed in 0..SEEDS {
        let mut rng = rng::stream(seed, "calibration");
        let training = record(task, 100 * seed..100 * seed + TRAINING, &mut rng)?;
        let held_out = record(task, 1000..1000 + HELD_OUT, &mut rng)?.episodes;
        let mut ensemble = Ensemble::new(spec, ensemble_config(), &mut rng)?;
        ensemble.fit(&training.transitions, &mut rng);
        let dynamics = &ensemble.dynamics();
        for (propagation, _) in PROPAGATIONS {
            for row in errors(&Propagated { dynamics, propagation }, spec, &held_out) {
                let (horizon, rmse, nll, coverage90) = (row.horizon, row.rmse, row.nll, row.coverage90);
                writer.serialize(CalibrationRow {
                    task: task.name().into(),
                    propagation,
                    seed,
                    horizon,
                    rmse,
                    nll,
                    coverage90,
                })?;
            }
        }
        println!("{task}, seed {seed}");
    }
    Ok(writer.flush()?)
}

/// Draws `calibration.csv`: a panel for each task, thin lines for seeds.
fn draw_calibration(folder: &Path) -> Result<(), Box<dyn Error>> {
    let table = csv::Reader::from_path(folder.join("calibration.csv"))?;
    let rows = table.into_deserialize().collect::<Result<Vec<CalibrationRow>, _>>()?;
    let panel = |task: Task| {
        let chart = Chart::new("time steps ahead, open loop", "coverage of the 90 % interval")
            .titled(task.name())
            .between(0.0, 1.0)
            .mark(0.9)
            .legend(SeriesLabelPosition::LowerRight);
        PALETTE.into_iter().zip(&PROPAGATIONS[..4]).fold(chart, |chart, (colour, (propagation, name))| {
            let of_way = || rows.iter().filter(|row| row.task == task.name() && row.propagation == *propagation);
            let curve = |seed: u64| {
                let of_seed = of_way().filter(move |row| row.seed == seed);
                of_seed.filter_map(|row| Some((row.horizon as f64, row.coverage90?))).collect::<Vec<_>>()
            };
            let chart = (0..SEEDS).fold(chart, |chart, seed| chart.thin(curve(seed)).coloured(colour));
            let mean = HORIZONS.map(|horizon| {
                let of_seeds = of_way().filter(|row| row.horizon == horizon).filter_map(|row| row.coverage90);
                (horizon as f64, of_seeds.sum::<f64>() / SEEDS as f64)
            });
            chart.line(name, mean).coloured(colour)
        })
    };
    let panels = [Task::Reach, Task::Lift, Task::Push].into_iter().map(panel);
    let title = "Calibration of an ensemble's uncertainty (thin: each seed)";
    std::fs::write(folder.join("calibration.svg"), panels.fold(Panels::new(title), Panels::panel).svg()?)?;
    Ok(())
}

/// Draws `TASK.csv`.
fn draw(task: Task, folder: &Path) -> Result<(), Box<dyn Error>> {
    let table = csv::Reader::from_path(folder.join(format!("{}.csv", task.name())))?;
    let rows = table.into_deserialize().collect::<Result<Vec<Row>, _>>()?;
    std::fs::write(folder.join(format!("{}.svg", task.name())), chart(task, &rows).svg()?)?;
    Ok(())
}

fn chart(task: Task, rows: &[Row]) -> Chart {
    let largest = rows.iter().map(|row| row.rmse).fold(1.1, f64::max).min(2.0);
    let chart = Chart::new("time steps ahead, open loop", "error (predicting no change: 1)")
        .titled(&format!("{task}: open-loop prediction error"))
        .between(0.0, largest)
        .legend(SeriesLabelPosition::UpperRight)
        .mark(1.0);
    ["ensemble", "autoencoder", "rssm"].into_iter().fold(chart, |chart, model| {
        let of_model = rows.iter().filter(|row| row.model == model);
        chart.line(model, of_model.map(|row| (row.horizon as f64, row.rmse)))
    })
}

fn main() -> Result<(), Box<dyn Error>> {
    let folder = Path::new("data/open_loop");
    match std::env::args().nth(1).as_deref() {
        Some("draw") => {
            draw_calibration(folder)?;
            return [Task::Reach, Task::Push].into_iter().try_for_each(|task| draw(task, folder));
        }
        Some("calibration") => {
            let mut writer = csv::Writer::from_path(folder.join("calibration.csv"))?;
            [Task::Reach, Task::Lift, Task::Push].into_iter().try_for_each(|task| calibrate(task, &mut writer))?;
            return draw_calibration(folder);
        }
        _ => {}
    }
    let named: Result<Vec<Task>, _> = std::env::args().skip(1).map(|name| name.parse()).collect();
    let tasks = Some(named?).filter(|tasks| !tasks.is_empty()).unwrap_or_else(|| vec![Task::Reach, Task::Push]);
    tasks.into_iter().try_for_each(|task| compare(task, folder))
}
