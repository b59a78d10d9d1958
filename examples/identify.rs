//! System identification from one push, recorded in rapier3d: how well does a simulator that is fitted to it predict that push
//! and others, and how well does an ensemble? Both are given the hand's true path and predict the cube. `data/identify.csv`.
//!
//! `cargo run --example identify` (a minute).

use std::error::Error;

use handful::diff::{Pusher, RecordedPush};
use handful::env::{Env, Task};
use handful::model::{Ensemble, EnsembleConfig, FeatureMap};
use handful::plan::noise::ColoredNoise;
use handful::replay::{ReplayBuffer, Transition};
use handful::rng;
use handful::study::statistics::mean;

/// Recorded pushes; each in turn is the one that is learned from, and the others are predicted.
const PUSHES: usize = 8;
/// How far a push must have moved the cube, m.
const FAR: f64 = 0.05;
/// Indices in an observation: the cube's position, and the direction of its x-axis.
const CUBE: usize = 6;
const AXIS: usize = 9;
/// The prior: the hand's two fingers are known, and rough; mass and friction are guesses (the truth is 0.064 kg and 0.5).
const GUESS: Pusher<f64> = Pusher { mass: 0.1, friction: 0.3, grip: 1.0, stiffness: 2000.0, spread: 0.0095 };
/// Half the cube's edge, m: how far a radian moves the middle of an edge.
const HALF: f64 = 0.02;

/// A push from the time step on at which the hand is down and near the cube.
struct Push {
    observations: Vec<Vec<f32>>,
    actions: Vec<Vec<f32>>,
}

impl Push {
    fn record(seed: u64) -> Result<Self, Box<dyn Error>> {
        const SHAKE: f64 = 0.3;
        let mut world = Task::Push.make();
        let policy = Task::Push.scripted_policy(Default::default()).ok_or("a scripted policy")?;
        let horizon = world.spec().horizon;
        let mut rng = rng::stream(seed, "identify");
        let noise = ColoredNoise::new(2.0, horizon).sample_actions(3, &mut rng);
        let mut obs = world.reset(seed);
        let mut push = Self { observations: Vec::new(), actions: Vec::new() };
        for noise in noise.chunks_exact(3) {
            let mut action = policy(&obs);
            // Sideways only: it must stay down.
            (0..2).for_each(|i| action[i] = (action[i] + (SHAKE * noise[i]) as f32).clamp(-1.0, 1.0));
            let [to_x, to_y, to_z] = [0, 1, 2].map(|i| obs[CUBE + i] - obs[i]);
            let down = to_z.abs() < 0.012 && to_x.hypot(to_y) < 0.07;
            if !down && !push.actions.is_empty() {
                break;
            }
            let before = std::mem::replace(&mut obs, world.step(&action)?.observation);
            if down {
                push.observations.push(before);
                push.actions.push(action);
            }
        }
        push.observations.push(obs);
        Ok(push)
    }

    fn seen(&self) -> RecordedPush {
        let numbers = |obs: &Vec<f32>, i: usize| f64::from(obs[i]);
        RecordedPush {
            hand: self.observations.iter().map(|obs| [numbers(obs, 0), numbers(obs, 1)]).collect(),
            block: self.observations.iter().map(|obs| pose(obs)).collect(),
        }
    }

    /// Distance that the cube moved, m.
    fn moved(&self) -> f64 {
        let [first, last] = [&self.observations[0], &self.observations[self.actions.len()]].map(|obs| pose(obs));
        (last[0] - first[0]).hypot(last[1] - first[1])
    }

    /// Root-mean-square error of predicted poses, m.
    fn error(&self, predicted: &[[f64; 3]]) -> f64 {
        let square = |(a, b): (&[f64; 3], [f64; 3])| {
            let turn = (a[2] - b[2] + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU) - std::f64::consts::PI;
            (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2) + (HALF * turn).powi(2)
        };
        let squares: Vec<f64> =
            predicted.iter().zip(self.observations.iter().map(|obs| pose(obs))).skip(1).map(square).collect();
        mean(&squares).sqrt()
    }

    /// The poses that an ensemble predicts, open loop but for the hand.
    fn predicted_by(&self, ensemble: &Ensemble, layout: &FeatureMap) -> Vec<[f64; 3]> {
        let dynamics = ensemble.dynamics();
        let mut obs = self.observations[0].clone();
        let mut poses = vec![pose(&obs)];
        for (action, seen) in self.actions.iter().zip(&self.observations[1..]) {
            let prediction = dynamics.predict(&obs, action);
            for ((i, _), change) in dynamics.typical_changes().zip(&prediction.mean) {
                obs[i] = *change as f32;
            }
            obs[..CUBE].copy_from_slice(&seen[..CUBE]);
            layout.recompute_derived(&mut obs);
            poses.push(pose(&obs));
        }
        poses
    }
}

/// Position and angle of the cube.
fn pose(obs: &[f32]) -> [f64; 3] {
    [obs[CUBE].into(), obs[CUBE + 1].into(), f64::from(obs[AXIS + 1]).atan2(obs[AXIS].into())]
}

#[derive(serde::Serialize)]
struct Row {
    learned_from: usize,
    model: &'static str,
    /// Root-mean-square error, m: on the push itself, and the mean over the others.
    same: f64,
    others: f64,
    /// Estimates, kg and dimensionless, and the standard deviations of their logarithms.
    mass: Option<f64>,
    friction: Option<f64>,
    mass_deviation: Option<f64>,
    friction_deviation: Option<f64>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut pushes = Vec::new();
    for seed in 0.. {
        pushes.extend(Some(Push::record(seed)?).filter(|push| push.moved() > FAR));
        if pushes.len() == PUSHES {
            break;
        }
    }
    let spec = Task::Push.make().spec().clone();
    let layout = FeatureMap::new(&spec)?;
    let mut rows = Vec::new();
    for (i, push) in pushes.iter().enumerate() {
        println!("push {i}: {} steps, moved {:.3} m", push.actions.len(), push.moved());
        let others = |error: &dyn Fn(&Push) -> f64| {
            let errors: Vec<f64> =
                pushes.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, push)| error(push)).collect();
            mean(&errors)
        };
        let found = push.seen().identify(GUESS)?;
        let error = |push: &Push| push.error(&push.seen().play(&found.pusher));
        rows.push(Row {
            learned_from: i,
            model: "simulator",
            same: error(push),
            others: others(&error),
            mass: Some(found.pusher.mass),
            friction: Some(found.pusher.friction),
            mass_deviation: Some(found.deviations[0]),
            friction_deviation: Some(found.deviations[1]),
        });
        let mut rng = rng::stream(i as u64, "identify ensemble");
        let mut ensemble =
            Ensemble::new(&spec, EnsembleConfig { hidden: vec![200; 2], ..EnsembleConfig::default() }, &mut rng)?;
        let mut data = ReplayBuffer::new(spec.observation_size(), spec.action_size, usize::MAX);
        for (action, pair) in push.actions.iter().zip(push.observations.windows(2)) {
            data.push(&Transition {
                obs: pair[0].clone(),
                action: action.clone(),
                reward: 0.0,
                next_obs: pair[1].clone(),
                terminated: false,
                truncated: false,
            });
        }
        ensemble.fit(&data, &mut rng);
        let error = |push: &Push| push.error(&push.predicted_by(&ensemble, &layout));
        let nothing = |push: &Push| push.error(&vec![pose(&push.observations[0]); push.observations.len()]);
        let (mass, friction, mass_deviation, friction_deviation) = (None, None, None, None);
        for (model, error) in [("ensemble", &error as &dyn Fn(&Push) -> f64), ("nothing moves", &nothing)] {
            let (same, others) = (error(push), others(error));
            rows.push(Row { learned_from: i, model, same, others, mass, friction, mass_deviation, friction_deviation });
        }
        for Row { model, same, others, mass, friction, .. } in &rows[3 * i..] {
            let found = mass.zip(*friction).map(|(mass, friction)| format!("; {mass:.3} kg, friction {friction:.2}"));
            let [same, others] = [same, others].map(|error| error * 1e3);
            println!("  {model:13} itself {same:.1} mm, others {others:.1} mm{}", found.unwrap_or_default());
        }
    }
    for model in ["simulator", "ensemble", "nothing moves"] {
        let median = |of: &dyn Fn(&Row) -> f64| {
            let mut column: Vec<f64> = rows.iter().filter(|row| row.model == model).map(of).collect();
            column.sort_by(f64::total_cmp);
            (column[(column.len() - 1) / 2] + column[column.len() / 2]) / 2.0 * 1e3
        };
        println!(
            "{model:13} median: itself {:.1} mm, others {:.1} mm",
            median(&|row| row.same),
            median(&|row| row.others)
        );
    }
    let mut writer = csv::Writer::from_path("data/identify.csv")?;
    rows.iter().try_for_each(|row| writer.serialize(row))?;
    Ok(writer.flush()?)
}
