//! How well a model foresees several steps: the actions of real episodes are replayed in it, from many starts.

use rand::seq::IndexedRandom;
use serde::{Deserialize, Serialize};

use super::calibration::{GaussianForecast, coverage};
use super::{Dynamics, Imagination, Propagation, Reward};
use crate::env::KnownReward;
pub use crate::replay::Episode;
use crate::rng::Rng;

/// How far ahead models are judged, in steps.
pub const HORIZONS: [usize; 6] = [1, 2, 5, 10, 15, 25];

/// EvalSeeds from which a model is judged.
const STARTS: usize = 200;
/// ImaginedReturns for each member and start.
const PARTICLES_PER_MEMBER: usize = 4;
/// Numbers whose displacement varies less than this share of its typical step are not judged: they stand still.
const STILL: f64 = 1e-3;

/// How well a model foresees a number of steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OpenLoop {
    /// Steps ahead.
    pub horizon: usize,
    /// Error of the expected observation: the root mean square over the predicted numbers, each in units of the standard
    /// deviation of its displacement over so many steps; the median over starts. One who foresees no change has about 1.
    pub rmse: f64,
    /// Mean negative log-likelihood of one number in those units.
    pub nll: f64,
    /// Share of numbers inside the interval that should hold 90 % of them.
    pub coverage90: f64,
    /// The error that a tenth of the starts exceed.
    pub rmse_p90: f64,
}

/// Something that foresees what comes of actions.
pub trait OpenLoopModel {
    /// The numbers of an observation that it foresees, and by how much each typically changes in a step.
    fn predicted(&self) -> Vec<(usize, f32)>;

    /// What may be observed after each of 0 to `ahead` steps, if from each start its episode's actions are repeated:
    /// `[particles, starts, observation]` each. Of an episode it may look at all up to its start.
    fn open_loop_predictions(&self, starts: &[(&Episode, usize)], ahead: usize, rng: &mut Rng) -> Vec<Vec<f32>>;
}

/// Judges a model on episodes that it has not learned from. Horizons longer than the episodes are left out.
pub fn open_loop(model: &impl OpenLoopModel, episodes: &[Episode], rng: &mut Rng) -> Vec<OpenLoop> {
    let longest = episodes.iter().map(|episode| episode.actions.len()).max().unwrap_or(0);
    let horizons: Vec<usize> = HORIZONS.into_iter().filter(|k| *k <= longest).collect();
    let Some(&ahead) = horizons.last() else { return Vec::new() };
    let all: Vec<(&Episode, usize)> = episodes
        .iter()
        .flat_map(|episode| (0..(episode.actions.len() + 1).saturating_sub(ahead)).map(move |t| (episode, t)))
        .collect();
    let starts: Vec<(&Episode, usize)> = all.sample(rng, STARTS).copied().collect();
    let futures = model.open_loop_predictions(&starts, ahead, rng);
    let foreseen = model.predicted();
    horizons.into_iter().map(|k| judge(&foreseen, &starts, &futures[k], k)).collect()
}

/// The actions that follow a start.
pub(crate) fn actions_from<'a>((episode, t): (&'a Episode, usize), ahead: usize) -> impl Iterator<Item = f32> + 'a {
    episode.actions[t..t + ahead].iter().flatten().copied()
}

impl OpenLoopModel for Dynamics {
    fn predicted(&self) -> Vec<(usize, f32)> {
        self.typical_changes().collect()
    }

    fn open_loop_predictions(&self, starts: &[(&Episode, usize)], ahead: usize, rng: &mut Rng) -> Vec<Vec<f32>> {
        let obs: Vec<f32> = starts.iter().flat_map(|(episode, t)| episode.observations[*t].iter().copied()).collect();
        let actions: Vec<f32> = starts.iter().flat_map(|start| actions_from(*start, ahead)).collect();
        let imagination = Imagination {
            dynamics: self,
            reward: Reward::Known(&Indifferent),
            propagation: Propagation::TsInf,
            particles: PARTICLES_PER_MEMBER * self.members(),
            value: None,
        };
        imagination.trajectories(&obs, &actions, ahead, rng).0
    }
}

/// Judges the states after `k` steps, `[particles, starts, observation]`.
fn judge(foreseen: &[(usize, f32)], starts: &[(&Episode, usize)], states: &[f32], k: usize) -> OpenLoop {
    let width = starts[0].0.observations[0].len();
    // What follows from other numbers is not judged twice.
    let mut squares = vec![0.0; starts.len()];
    let mut numbers = 0;
    let mut judged = Vec::new();
    let mut log_units = 0.0;
    for &(i, typical) in foreseen {
        let displacement = |(episode, t): &(&Episode, usize)| {
            f64::from(episode.observations[t + k][i]) - f64::from(episode.observations[*t][i])
        };
        let unit = deviation(starts.iter().map(displacement));
        if unit < STILL * f64::from(typical) {
            continue;
        }
        numbers += 1;
        for (s, (episode, t)) in starts.iter().enumerate() {
            let particles = states.chunks_exact(width).skip(s).step_by(starts.len()).map(|state| f64::from(state[i]));
            let count = states.len() / width / starts.len();
            let mean = particles.clone().sum::<f64>() / count as f64;
            let outcome = f64::from(episode.observations[t + k][i]);
            squares[s] += ((mean - outcome) / unit).powi(2);
            judged.push(GaussianForecast { mean, deviation: deviation(particles).max(1e-9), outcome });
            log_units += unit.ln();
        }
    }
    let mut errors: Vec<f64> = squares.iter().map(|square| (square / f64::from(numbers.max(1))).sqrt()).collect();
    errors.sort_by(f64::total_cmp);
    let quantile = |q: f64| errors[(q * (errors.len() - 1) as f64).round() as usize];
    let count = judged.len().max(1) as f64;
    OpenLoop {
        horizon: k,
        rmse: quantile(0.5),
        nll: (judged.iter().map(GaussianForecast::nll).sum::<f64>() - log_units) / count,
        coverage90: coverage(&judged, 0.9),
        rmse_p90: quantile(0.9),
    }
}

fn deviation(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let n = values.clone().count() as f64;
    let mean = values.clone().sum::<f64>() / n;
    (values.map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt()
}

/// Rewards do not matter here.
struct Indifferent;

impl KnownReward for Indifferent {
    fn reward(&self, _obs: &[f32], _action: &[f32], _next_obs: &[f32]) -> f32 {
        0.0
    }
}
