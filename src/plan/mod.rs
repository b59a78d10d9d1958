//! Planning: finding a sequence of actions that maximises what a closure says of it.
//!
//! A planner knows nothing of environments or models. It proposes sequences, is told what each is
//! worth, and keeps what is worth keeping for the next time, when the world has moved on a step
//! ([`Planner::shift`]). [`RecedingHorizon`] makes a controller of it. An observer may watch every iteration.
//!
//! Actions lie in [-1, 1].

mod cem;
mod control;
mod gradient;
mod hybrid;
mod icem;
mod mppi;
pub mod noise;
mod shooting;
mod simulated;

pub use cem::{Cem, CemConfig};
pub use control::{ControlConfig, RecedingHorizon};
pub use gradient::{Gradient, GradientConfig};
pub use hybrid::{Hybrid, HybridConfig};
pub use icem::{Icem, IcemConfig};
pub use mppi::{Mppi, MppiConfig};
pub use shooting::{RandomShooting, ShootingConfig};
pub use simulated::Simulated;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::rng::Rng;

/// A batch of action sequences, `[count, horizon, actions]`.
#[derive(Clone, Debug, PartialEq)]
pub struct ActionSequences {
    /// Steps in each.
    pub horizon: usize,
    /// Numbers in an action.
    pub actions: usize,
    /// All numbers, sequence after sequence, step after step.
    pub values: Vec<f32>,
}

impl ActionSequences {
    /// None yet.
    pub fn new(horizon: usize, actions: usize) -> Self {
        Self { horizon, actions, values: Vec::new() }
    }

    /// How many there are.
    pub fn count(&self) -> usize {
        self.values.len() / self.width()
    }

    /// One of them, `[horizon, actions]`.
    pub fn row(&self, i: usize) -> &[f32] {
        &self.values[i * self.width()..][..self.width()]
    }

    /// All of them.
    pub fn rows(&self) -> impl Iterator<Item = &[f32]> {
        self.values.chunks_exact(self.width())
    }

    fn width(&self) -> usize {
        self.horizon * self.actions
    }
}

/// What a planner maximises. Any closure from sequences to returns is an objective.
pub trait Objective {
    /// What sequences are worth: one return for each. Not a number counts as worst.
    fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32>;

    /// Returns, and how they change with every number of every sequence (`[count, horizon, actions]`). Unless an
    /// objective knows better, central differences: two more returns for each number.
    fn gradients(&mut self, sequences: &ActionSequences) -> (Vec<f32>, Vec<f32>) {
        const STEP: f32 = 1e-3;
        let width = sequences.width();
        let mut around = ActionSequences::new(sequences.horizon, sequences.actions);
        for row in sequences.rows() {
            for (i, step) in (0..width).flat_map(|i| [(i, STEP), (i, -STEP)]) {
                around.values.extend(row);
                let start = around.values.len() - width;
                around.values[start + i] += step;
            }
        }
        let differences = self.returns(&around);
        let slopes = differences.chunks(2).map(|pair| (pair[0] - pair[1]) / (2.0 * STEP)).collect();
        (self.returns(sequences), slopes)
    }
}

impl<F: FnMut(&ActionSequences) -> Vec<f32>> Objective for F {
    fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32> {
        self(sequences)
    }
}

/// One iteration of a planner, for those who watch.
pub struct Iteration<'a> {
    /// Its number, from 0.
    pub index: usize,
    /// What was tried.
    pub candidates: &'a ActionSequences,
    /// What each was worth.
    pub returns: &'a [f32],
    /// The mean of the search distribution afterwards, `[horizon, actions]`.
    pub mean: &'a [f64],
}

/// Watches iterations.
pub type PlanObserver<'a> = dyn FnMut(&Iteration) + 'a;

/// What a planner proposes.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// The sequence, `[horizon, actions]`.
    pub actions: Vec<f32>,
    /// The best return that was seen on the way: what the objective promises, rather too much than too
    /// little.
    pub best_return: f32,
}

/// A planner with its memory from step to step.
pub trait Planner: Send {
    /// Forgets everything: a new episode.
    fn reset(&mut self);

    /// Searches for the best sequence.
    fn plan(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, rng: &mut Rng) -> Plan;

    /// The first `steps` actions of the plan were executed: the memory moves on with the world.
    fn shift(&mut self, steps: usize);
}

/// Makes planners: a [`PlannerConfig`], or a closure from the numbers of an action to a planner.
pub trait MakePlanner: Send + Sync {
    /// A planner for actions of `action_size` numbers.
    fn make(&self, action_size: usize) -> Box<dyn Planner>;
}

impl MakePlanner for PlannerConfig {
    fn make(&self, action_size: usize) -> Box<dyn Planner> {
        self.build(action_size)
    }
}

/// A planner with its settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PlannerConfig {
    /// Random shooting.
    Shooting(ShootingConfig),
    /// The cross-entropy method as in PETS.
    Cem(CemConfig),
    /// Its improved form.
    Icem(IcemConfig),
    /// Model-predictive path integrals.
    Mppi(MppiConfig),
    /// Gradient ascent from several starts.
    Gradient(GradientConfig),
    /// iCEM, then gradient ascent from what it found.
    Hybrid(HybridConfig),
}

impl PlannerConfig {
    /// A planner for actions of so many numbers.
    pub fn build(&self, actions: usize) -> Box<dyn Planner> {
        match self {
            PlannerConfig::Shooting(config) => Box::new(RandomShooting::new(config.clone(), actions)),
            PlannerConfig::Cem(config) => Box::new(Cem::new(config.clone(), actions)),
            PlannerConfig::Icem(config) => Box::new(Icem::new(config.clone(), actions)),
            PlannerConfig::Mppi(config) => Box::new(Mppi::new(config.clone(), actions)),
            PlannerConfig::Gradient(config) => Box::new(Gradient::new(config.clone(), actions)),
            PlannerConfig::Hybrid(config) => Box::new(Hybrid::new(config.clone(), actions)),
        }
    }

    /// Steps that it looks ahead.
    pub fn horizon(&self) -> usize {
        match self {
            PlannerConfig::Shooting(config) => config.horizon,
            PlannerConfig::Cem(config) => config.horizon,
            PlannerConfig::Icem(config) => config.horizon,
            PlannerConfig::Mppi(config) => config.horizon,
            PlannerConfig::Gradient(config) => config.horizon,
            PlannerConfig::Hybrid(config) => config.icem.horizon,
        }
    }

    /// # Errors
    /// If the horizon is shorter than two steps, or nothing would be tried.
    pub(crate) fn check(&self) -> Result<()> {
        let tried = match self {
            PlannerConfig::Shooting(config) => config.population,
            PlannerConfig::Cem(config) => config.population.min(config.elites).min(config.iterations),
            PlannerConfig::Icem(config) => config.population.min(config.elites).min(config.iterations),
            PlannerConfig::Mppi(config) => config.population.min(config.iterations),
            PlannerConfig::Gradient(config) => config.starts,
            PlannerConfig::Hybrid(HybridConfig { icem, .. }) => icem.population.min(icem.elites).min(icem.iterations),
        };
        if self.horizon() < 2 {
            return Err(Error::BadSetting("planner: `horizon` must be at least 2".into()));
        }
        if tried == 0 {
            return Err(Error::BadSetting(
                "planner: population, elites, iterations, starts: at least 1 of each".into(),
            ));
        }
        Ok(())
    }
}

// What planners share.

/// The indices of the `count` best returns, best first.
fn best(returns: &[f32], count: usize) -> Vec<usize> {
    let worth = |i: usize| if returns[i].is_nan() { f32::NEG_INFINITY } else { returns[i] };
    let mut order: Vec<usize> = (0..returns.len()).collect();
    order.sort_by(|a, b| worth(*b).total_cmp(&worth(*a)));
    order.truncate(count.max(1));
    order
}

/// Moves mean and variance to those of the elites: `new = momentum old + (1 - momentum) elites`, with
/// the population variance.
fn refit(mean: &mut [f64], variance: &mut [f64], elites: &[&[f32]], momentum: f64) {
    let n = elites.len() as f64;
    for (i, (mean, variance)) in mean.iter_mut().zip(variance).enumerate() {
        let centre = elites.iter().map(|row| f64::from(row[i])).sum::<f64>() / n;
        let spread = elites.iter().map(|row| (f64::from(row[i]) - centre).powi(2)).sum::<f64>() / n;
        *mean = momentum * *mean + (1.0 - momentum) * centre;
        *variance = momentum * *variance + (1.0 - momentum) * spread;
    }
}

/// Drops the first `steps` actions of a sequence and repeats `last` at its end.
fn shifted<T: Copy>(sequence: &mut Vec<T>, steps: usize, actions: usize, last: &[T]) {
    for _ in 0..steps {
        sequence.drain(..actions);
        sequence.extend_from_slice(last);
    }
}

fn as_actions(mean: &[f64]) -> Vec<f32> {
    mean.iter().map(|a| a.clamp(-1.0, 1.0) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elites_are_refitted_with_momentum() {
        let elites: [&[f32]; 3] = [&[0.2, -0.4], &[0.6, 0.0], &[0.4, 0.1]];
        let (mut mean, mut variance) = ([0.0, 0.0], [0.25, 0.25]);
        refit(&mut mean, &mut variance, &elites, 0.1);
        let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-7, "{a}, expected {b}");
        near(mean[0], 0.36);
        near(mean[1], -0.09);
        near(variance[0], 0.049);
        near(variance[1], 0.067);
    }

    #[test]
    fn the_best_come_first_and_no_number_comes_last() {
        assert_eq!(best(&[1.0, f32::NAN, 3.0, 2.0], 2), [2, 3]);
        assert_eq!(best(&[f32::NAN, f32::NEG_INFINITY, 0.0], 1), [2]);
    }
}
