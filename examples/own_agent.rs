//! An agent of one's own, from its equations to the command line: augmented random search (ARS; Mania, Guy & Recht 2018, arXiv:1803.07055,
//! Algorithm 1, version V1-t). A linear policy tries random changes of its weights in whole episodes, and moves towards those that earned
//! more. Unlike the paper, it reads features scaled as the environment's spec says.
//!
//! `cargo run --example own_agent -- study --out runs/ars` compares it with SAC on `reach`;
//! `cargo run --example own_agent -- train --task pendulum --method ars` trains it on another task.

use handful::checkpoint::Weights;
use handful::prelude::*;
use handful::rng::{self, Rng};
use serde::{Deserialize, Serialize};

/// Its settings, in the table `[ars]` of presets and of files given with `--config`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ArsConfig {
    /// Directions in an iteration (N), each tried in two episodes.
    pub directions: usize,
    /// The best of them, of which the update is made (b).
    pub best: usize,
    /// Length of a try along a direction (ν).
    pub noise: f32,
    /// Step size (α).
    pub step_size: f32,
}

impl Default for ArsConfig {
    fn default() -> Self {
        Self { directions: 8, best: 4, noise: 0.3, step_size: 0.1 }
    }
}

pub struct Ars {
    config: ArsConfig,
    spec: Spec,
    /// The policy, M: a row of weights for each component of an action.
    weights: Vec<f32>,
    /// The directions of this iteration, δ, each as long as `weights`.
    directions: Vec<Vec<f32>>,
    /// The returns of its finished episodes: of the first direction forwards, backwards, of the second, ...
    returns: Vec<f32>,
    total: f32,
    updates: u64,
    rng: Rng,
}

impl Ars {
    /// # Errors
    /// If a setting cannot be used.
    pub fn new(spec: &Spec, config: ArsConfig, seed: u64) -> Result<Self> {
        let ArsConfig { directions, best, noise, step_size } = config;
        let refuse = |problem: String| Err(Error::Config(problem));
        if !(1..=10_000).contains(&directions) {
            return refuse(format!("ars.directions is {directions}; it must lie in 1..=10000"));
        }
        if !(1..=directions).contains(&best) {
            return refuse(format!("ars.best is {best}; it must lie in 1..={directions}, the number of directions"));
        }
        for (name, value) in [("noise", noise), ("step_size", step_size)] {
            if !(value > 0.0 && value.is_finite()) {
                return refuse(format!("ars.{name} is {value}; it must be positive and finite"));
            }
        }
        let size = spec.action_size * spec.observation_size();
        let mut rng = rng::stream(seed, "ars");
        let directions = drawn(&config, size, &mut rng);
        let (spec, weights) = (spec.clone(), vec![0.0; size]);
        Ok(Self { config, spec, weights, directions, returns: Vec::new(), total: 0.0, updates: 0, rng })
    }

    /// The weights that this episode tries: M + ν δ or M - ν δ.
    fn tried(&self) -> Vec<f32> {
        let episode = self.returns.len();
        let noise = if episode.is_multiple_of(2) { self.config.noise } else { -self.config.noise };
        self.weights.iter().zip(&self.directions[episode / 2]).map(|(weight, delta)| weight + noise * delta).collect()
    }

    /// M += α / (b σ) Σ (r(M + ν δ) - r(M - ν δ)) δ, over the best b directions; σ is the standard deviation of their returns.
    fn improve(&mut self) {
        let ArsConfig { directions, best, step_size, .. } = self.config;
        let mut pairs: Vec<(usize, [f32; 2])> =
            (0..directions).map(|i| (i, [self.returns[2 * i], self.returns[2 * i + 1]])).collect();
        pairs.sort_by(|(_, a), (_, b)| b[0].max(b[1]).total_cmp(&a[0].max(a[1])));
        pairs.truncate(best);
        let returns: Vec<f32> = pairs.iter().flat_map(|(_, pair)| *pair).collect();
        let mean = returns.iter().sum::<f32>() / returns.len() as f32;
        let variance = returns.iter().map(|r| (r - mean).powi(2)).sum::<f32>() / returns.len() as f32;
        let step = step_size / (best as f32 * variance.sqrt().max(1e-6));
        for (i, [forwards, backwards]) in pairs {
            for (weight, delta) in self.weights.iter_mut().zip(&self.directions[i]) {
                *weight += step * (forwards - backwards) * delta;
            }
        }
        self.returns.clear();
        self.directions = drawn(&self.config, self.weights.len(), &mut self.rng);
        self.updates += 1;
    }
}

fn drawn(config: &ArsConfig, size: usize, rng: &mut Rng) -> Vec<Vec<f32>> {
    (0..config.directions).map(|_| (0..size).map(|_| rng::normal(rng) as f32).collect()).collect()
}

impl Agent for Ars {
    fn begin_episode(&mut self) {
        self.total = 0.0;
    }

    fn act(&mut self, obs: &[f32], mode: Mode) -> Vec<f32> {
        let weights = if mode == Mode::Explore { self.tried() } else { self.weights.clone() };
        let scaled = || obs.iter().zip(&self.spec.observation).map(|(x, feature)| (x - feature.centre) / feature.scale);
        let action = |row: &[f32]| row.iter().zip(scaled()).map(|(weight, x)| weight * x).sum::<f32>().clamp(-1.0, 1.0);
        weights.chunks(obs.len()).map(action).collect()
    }

    fn observe(&mut self, transition: &Transition) {
        self.total += transition.reward;
        if transition.terminated || transition.truncated {
            self.returns.push(self.total);
        }
    }

    fn update(&mut self) -> Option<Losses> {
        if self.returns.len() < 2 * self.config.directions {
            return None;
        }
        let mean = self.returns.iter().sum::<f32>() / self.returns.len() as f32;
        self.improve();
        Some(Losses::from([("return", mean)]))
    }
}

/// With the weights it can act; with the rest it goes on as if it had never stopped. Runs are saved between episodes.
impl Checkpoint for Ars {
    fn weights(&self) -> Weights {
        let mut saved = Weights::default();
        saved.insert("policy", self.weights.clone(), [1, self.spec.action_size, self.spec.observation_size()]);
        saved
    }

    fn load_weights(&mut self, weights: &Weights) -> Result<()> {
        self.weights = weights.get("policy", [1, self.spec.action_size, self.spec.observation_size()])?.to_vec();
        Ok(())
    }

    fn training_state(&self) -> Weights {
        let mut saved = Weights::default();
        let directions = self.config.directions;
        saved.insert("directions", self.directions.concat(), [1, directions, self.weights.len()]);
        let mut returns = self.returns.clone();
        returns.resize(2 * directions, 0.0);
        saved.insert("returns", returns, [1, directions, 2]);
        saved.insert_counts("counts", &[self.returns.len() as u64, self.updates]);
        saved.insert_rng("rng", &self.rng);
        saved
    }

    fn load_training_state(&mut self, state: &Weights) -> Result<()> {
        let directions = self.config.directions;
        let most = 2 * directions as u64 - 1;
        let counts = state.counts_within("counts", &[0..=most, 0..=handful::checkpoint::MAX_COUNT])?;
        let rows = state.get("directions", [1, directions, self.weights.len()])?.chunks(self.weights.len());
        self.directions = rows.map(<[f32]>::to_vec).collect();
        self.returns = state.get("returns", [1, directions, 2])?[..counts[0] as usize].to_vec();
        (self.updates, self.rng) = (counts[1], state.rng("rng")?);
        Ok(())
    }
}

impl Diagnostics for Ars {
    fn updates(&self) -> u64 {
        self.updates
    }
}

/// Our tasks and agents, and this one. A method is a preset: settings of an agent, and a budget.
pub fn registry() -> Registry {
    Registry::standard()
        .agent("ars", |context, config| Ars::new(context.spec, config, context.seed))
        .preset("ars", "agent = \"ars\"\nsteps = 30000\nevaluate_every = 1000\n")
        .quick_study(&["reach"], &["random", "ars", "sac"], None)
}

fn main() -> std::process::ExitCode {
    handful::cli::main(&registry())
}
