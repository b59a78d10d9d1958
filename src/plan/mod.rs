//! Planning: finding a sequence of actions that maximises what a closure says of it.
//!
//! A planner knows nothing of environments or models. It proposes sequences, is told what each is
//! worth, and keeps what is worth keeping for the next time, when the world has moved on a step
//! ([`Planner::shift`]): receding-horizon control. An observer may watch every iteration.
//!
//! Actions lie in [-1, 1].

mod cem;
mod icem;
mod mppi;
pub mod noise;
mod shooting;

pub use cem::{Cem, CemConfig};
pub use icem::{Icem, IcemConfig};
pub use mppi::{Mppi, MppiConfig};
pub use shooting::{RandomShooting, ShootingConfig};

use serde::{Deserialize, Serialize};

use crate::rng::Rng;

/// A batch of action sequences, `[count, horizon, actions]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Sequences {
    /// Steps in each.
    pub horizon: usize,
    /// Numbers in an action.
    pub actions: usize,
    /// All numbers, sequence after sequence, step after step.
    pub values: Vec<f32>,
}

impl Sequences {
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

/// What sequences are worth: one return for each. Not a number counts as worst.
pub type Objective<'a> = dyn FnMut(&Sequences) -> Vec<f32> + 'a;

/// One iteration of a planner, for those who watch.
pub struct Iteration<'a> {
    /// Its number, from 0.
    pub index: usize,
    /// What was tried.
    pub candidates: &'a Sequences,
    /// What each was worth.
    pub returns: &'a [f32],
    /// The mean of the search distribution afterwards, `[horizon, actions]`.
    pub mean: &'a [f64],
}

/// Watches iterations.
pub type Observer<'a> = dyn FnMut(&Iteration) + 'a;

/// What a planner proposes.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// The sequence, `[horizon, actions]`.
    pub actions: Vec<f32>,
    /// The best return that was seen on the way: what the objective promises, rather too much than too
    /// little.
    pub promised: f32,
}

/// A planner with its memory from step to step.
pub trait Planner: Send {
    /// Forgets everything: a new episode.
    fn reset(&mut self);

    /// Searches for the best sequence.
    fn plan(&mut self, objective: &mut Objective, observer: &mut Observer, rng: &mut Rng) -> Plan;

    /// The first `steps` actions of the plan were executed: the memory moves on with the world.
    fn shift(&mut self, steps: usize);
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
}

impl PlannerConfig {
    /// A planner for actions of so many numbers.
    pub fn build(&self, actions: usize) -> Box<dyn Planner> {
        match self {
            PlannerConfig::Shooting(config) => Box::new(RandomShooting::new(config.clone(), actions)),
            PlannerConfig::Cem(config) => Box::new(Cem::new(config.clone(), actions)),
            PlannerConfig::Icem(config) => Box::new(Icem::new(config.clone(), actions)),
            PlannerConfig::Mppi(config) => Box::new(Mppi::new(config.clone(), actions)),
        }
    }

    /// Steps that it looks ahead.
    pub fn horizon(&self) -> usize {
        match self {
            PlannerConfig::Shooting(config) => config.horizon,
            PlannerConfig::Cem(config) => config.horizon,
            PlannerConfig::Icem(config) => config.horizon,
            PlannerConfig::Mppi(config) => config.horizon,
        }
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
