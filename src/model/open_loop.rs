//! Open-loop evaluation: how far predictions over several time steps, without observations in between, are from what
//! happened. The actions of recorded episodes are replayed in the model, from many start times.
//!
//! ```
//! use handful::env::{Feature, Spec};
//! use handful::model::open_loop::{OpenLoopModel, open_loop};
//! use handful::replay::Episode;
//! use handful::rng::{self, Rng};
//!
//! /// Predicts that nothing ever changes.
//! struct Persistence;
//!
//! impl OpenLoopModel for Persistence {
//!     fn open_loop_predictions(&self, starts: &[(&Episode, usize)], horizon: usize, _rng: &mut Rng) -> Vec<Vec<f32>> {
//!         let now = starts.iter().flat_map(|(episode, t)| episode.observations[*t].clone()).collect();
//!         vec![now; horizon + 1]
//!     }
//! }
//!
//! let episode = Episode {
//!     observations: (0..=40).map(|t| vec![(0.3 * t as f32).sin()]).collect(),
//!     actions: vec![vec![0.0]; 40],
//!     ..Episode::default()
//! };
//! let spec = Spec::new("swing", [Feature::new("angle")], 1, 40, 0.1);
//! let rows = open_loop(&Persistence, &spec, &[episode], &mut rng::stream(0, "example"));
//! assert_eq!(rows.iter().map(|row| row.horizon).collect::<Vec<_>>(), [1, 2, 5, 10, 15, 25]);
//! // The unit of the error is the standard deviation of the change.
//! assert!(rows.iter().all(|row| (0.5..2.0).contains(&row.rmse)));
//! ```

use rand::seq::IndexedRandom;
use serde::{Deserialize, Serialize};

use super::calibration::{GaussianForecast, coverage};
use super::{Dynamics, Imagination, Propagation, Reward};
use crate::env::{KnownReward, Role, Spec};
use crate::replay::Episode;
use crate::rng::Rng;

/// Numbers of time steps over which predictions are evaluated.
pub const HORIZONS: [usize; 6] = [1, 2, 5, 10, 15, 25];

/// Start times, drawn from all episodes.
const STARTS: usize = 200;
/// Particles for each member and start time.
const PARTICLES_PER_MEMBER: usize = 4;
/// Features whose displacement has a standard deviation below this fraction of their scale are left out: they are constant in
/// these episodes.
const MIN_DISPLACEMENT: f64 = 1e-4;

/// The quality of a model's predictions over a number of time steps: a row of a run's `model.csv`.
///
/// Every kind of model is measured on the same features: those of [`Role::Dynamic`], except the orientation of a cube, which
/// latent models predict in canonical form only. Its particles are those that its agent plans with, so that `nll` and
/// `coverage90` say how far the plans' uncertainty can be trusted: with [`Propagation::TsInfMean`] particles carry epistemic
/// uncertainty alone and cover less than the outcomes, whose noise is left out on purpose.
#[doc(alias = "open-loop evaluation")]
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OpenLoop {
    /// Time steps ahead.
    pub horizon: usize,
    /// Error of the predicted mean: root mean square over the features, each in units of the standard deviation of
    /// its displacement over `horizon` time steps; median over start times. Predicting no change has a root mean square of
    /// about 1 over start times, and a smaller median if little moves at many of them.
    #[doc(alias = "RMSE")]
    pub rmse: f64,
    /// Negative log-likelihood in nats, mean over features (in those units) and start times. The predicted distribution is a
    /// Gaussian with mean and variance of the particles. None for a model that predicts one outcome and no uncertainty.
    pub nll: Option<f64>,
    /// Coverage of the 90 % prediction interval, a fraction. None for the same.
    pub coverage90: Option<f64>,
    /// 90th percentile over start times of the error whose median is `rmse`.
    pub rmse_p90: f64,
}

/// A model that predicts several time steps ahead from actions alone.
pub trait OpenLoopModel {
    /// Predicted observations after 0 to `horizon` time steps of each start's recorded actions: `horizon + 1` arrays
    /// `[particles, starts, observation]`. A start is an episode and a time step in it; the model may read observations up
    /// to that time step as context, not later ones.
    fn open_loop_predictions(&self, starts: &[(&Episode, usize)], horizon: usize, rng: &mut Rng) -> Vec<Vec<f32>>;
}

/// Evaluates a model on held-out episodes of the environment with this `spec`, one row for each of the [`HORIZONS`] for which
/// at least half of the episodes are long enough, and over which some feature moves differently from start to start; no rows
/// without episodes.
#[doc(alias = "open loop")]
pub fn open_loop(model: &impl OpenLoopModel, spec: &Spec, episodes: &[Episode], rng: &mut Rng) -> Vec<OpenLoop> {
    let mut lengths: Vec<usize> = episodes.iter().map(|episode| episode.actions.len()).collect();
    lengths.sort_unstable();
    let Some(&median) = lengths.get(lengths.len().saturating_sub(1) / 2) else { return Vec::new() };
    let horizons: Vec<usize> = HORIZONS.into_iter().filter(|k| *k <= median).collect();
    let Some(&furthest) = horizons.last() else { return Vec::new() };
    let all: Vec<(&Episode, usize)> = episodes
        .iter()
        .flat_map(|episode| (0..(episode.actions.len() + 1).saturating_sub(furthest)).map(move |t| (episode, t)))
        .collect();
    let starts: Vec<(&Episode, usize)> = all.sample(rng, STARTS).copied().collect();
    let predictions = model.open_loop_predictions(&starts, furthest, rng);
    let features: Vec<(usize, f32)> = spec
        .observation
        .iter()
        .enumerate()
        .filter(|(_, feature)| feature.role == Role::Dynamic && feature.cube.is_none())
        .map(|(i, feature)| (i, feature.scale))
        .collect();
    horizons.into_iter().filter_map(|k| evaluate(&features, &starts, &predictions[k], k)).collect()
}

/// The recorded actions of `horizon` time steps from a start, one after the other.
pub(crate) fn actions_from<'a>((episode, t): (&'a Episode, usize), horizon: usize) -> impl Iterator<Item = f32> + 'a {
    episode.actions[t..t + horizon].iter().flatten().copied()
}

impl<M: OpenLoopModel> OpenLoopModel for &M {
    fn open_loop_predictions(&self, starts: &[(&Episode, usize)], horizon: usize, rng: &mut Rng) -> Vec<Vec<f32>> {
        (*self).open_loop_predictions(starts, horizon, rng)
    }
}

/// A model whose steps are decisions of `action_repeat` time steps each, for which an action is held.
#[derive(Clone, Copy, Debug)]
pub struct WithActionRepeat<M> {
    /// The model of decisions.
    pub model: M,
    /// Time steps of a decision.
    pub action_repeat: usize,
}

impl<M: OpenLoopModel> OpenLoopModel for WithActionRepeat<M> {
    /// Actions that differ within a decision are averaged, and observations within it interpolated.
    fn open_loop_predictions(&self, starts: &[(&Episode, usize)], horizon: usize, rng: &mut Rng) -> Vec<Vec<f32>> {
        let repeat = self.action_repeat;
        if repeat == 1 {
            return self.model.open_loop_predictions(starts, horizon, rng);
        }
        let mean = |held: &[Vec<f32>]| -> Vec<f32> {
            (0..held[0].len()).map(|i| held.iter().map(|a| a[i]).sum::<f32>() / held.len() as f32).collect()
        };
        // The decisions of each episode, one of which begins at the start.
        let coarse = starts.iter().map(|(episode, t)| {
            let (first, last) = (t % repeat, t + horizon);
            let observations = episode.observations[first..=last].iter().step_by(repeat).cloned().collect();
            let actions = episode.actions[first..last].chunks(repeat).map(mean).collect();
            (Episode { observations, actions, ..Episode::default() }, t / repeat)
        });
        let coarse: Vec<(Episode, usize)> = coarse.collect();
        let starts: Vec<(&Episode, usize)> = coarse.iter().map(|(episode, t)| (episode, *t)).collect();
        let futures = self.model.open_loop_predictions(&starts, horizon.div_ceil(repeat), rng);
        let at = |t: usize| -> Vec<f32> {
            let share = (t % repeat) as f32 / repeat as f32;
            let (before, after) = (&futures[t / repeat], &futures[t.div_ceil(repeat)]);
            before.iter().zip(after).map(|(before, after)| before + share * (after - before)).collect()
        };
        (0..=horizon).map(at).collect()
    }
}

/// An ensemble whose particles are propagated in one of several ways: that in which its agent plans.
#[derive(Clone, Copy, Debug)]
pub struct Propagated<'a> {
    /// The ensemble.
    pub dynamics: &'a Dynamics,
    /// How uncertainty is propagated.
    pub propagation: Propagation,
}

impl OpenLoopModel for Propagated<'_> {
    fn open_loop_predictions(&self, starts: &[(&Episode, usize)], horizon: usize, rng: &mut Rng) -> Vec<Vec<f32>> {
        let obs: Vec<f32> = starts.iter().flat_map(|(episode, t)| episode.observations[*t].iter().copied()).collect();
        let actions: Vec<f32> = starts.iter().flat_map(|start| actions_from(*start, horizon)).collect();
        let imagination = Imagination {
            dynamics: self.dynamics,
            reward: Reward::Known(&ZeroReward),
            propagation: self.propagation,
            particles: PARTICLES_PER_MEMBER * self.dynamics.members(),
            value: None,
        };
        imagination.trajectories(&obs, &actions, horizon, rng).0
    }
}

/// Compares predictions over `k` time steps, `[particles, starts, observation]`, with the episodes. None if there is nothing to compare.
fn evaluate(
    features: &[(usize, f32)],
    starts: &[(&Episode, usize)],
    predictions: &[f32],
    k: usize,
) -> Option<OpenLoop> {
    let width = starts[0].0.observations[0].len();
    let particles_of_each = predictions.len() / width / starts.len();
    let mut squares = vec![0.0; starts.len()];
    let mut compared = 0;
    let mut forecasts = Vec::new();
    let mut log_units = 0.0;
    for &(i, scale) in features {
        let displacement = |(episode, t): &(&Episode, usize)| {
            f64::from(episode.observations[t + k][i]) - f64::from(episode.observations[*t][i])
        };
        let unit = std(starts.iter().map(displacement));
        if unit < MIN_DISPLACEMENT * f64::from(scale) {
            continue;
        }
        compared += 1;
        for (s, (episode, t)) in starts.iter().enumerate() {
            let particles =
                predictions.chunks_exact(width).skip(s).step_by(starts.len()).map(|state| f64::from(state[i]));
            let mean = particles.clone().sum::<f64>() / particles_of_each as f64;
            let outcome = f64::from(episode.observations[t + k][i]);
            squares[s] += ((mean - outcome) / unit).powi(2);
            forecasts.push(GaussianForecast { mean, std: std(particles).max(1e-9), outcome });
            log_units += unit.ln();
        }
    }
    if compared == 0 {
        return None;
    }
    let mut errors: Vec<f64> = squares.iter().map(|square| (square / f64::from(compared)).sqrt()).collect();
    errors.sort_by(f64::total_cmp);
    let quantile = |q: f64| errors[(q * (errors.len() - 1) as f64).round() as usize];
    let count = forecasts.len() as f64;
    let uncertain = particles_of_each > 1;
    Some(OpenLoop {
        horizon: k,
        rmse: quantile(0.5),
        nll: uncertain.then(|| (forecasts.iter().map(GaussianForecast::nll).sum::<f64>() - log_units) / count),
        coverage90: uncertain.then(|| coverage(&forecasts, 0.9)),
        rmse_p90: quantile(0.9),
    })
}

/// Population standard deviation.
fn std(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let n = values.clone().count() as f64;
    let mean = values.clone().sum::<f64>() / n;
    (values.map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt()
}

/// Rewards do not matter here.
struct ZeroReward;

impl KnownReward for ZeroReward {
    fn reward(&self, _obs: &[f32], _action: &[f32], _next_obs: &[f32]) -> f32 {
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::env::Feature;
    use crate::rng;

    /// Knows the first feature, and is wrong about all others.
    struct KnowsTheFirst;

    impl OpenLoopModel for KnowsTheFirst {
        fn open_loop_predictions(&self, starts: &[(&Episode, usize)], horizon: usize, _rng: &mut Rng) -> Vec<Vec<f32>> {
            let at = |k: usize| {
                starts
                    .iter()
                    .flat_map(move |(episode, t)| [vec![episode.observations[t + k][0]], vec![9.0; 8]].concat())
            };
            (0..=horizon).map(|k| at(k).collect()).collect()
        }
    }

    /// Where it started, and what it was told to do: the sums of the actions.
    struct Adds;

    impl OpenLoopModel for Adds {
        fn open_loop_predictions(&self, starts: &[(&Episode, usize)], horizon: usize, _rng: &mut Rng) -> Vec<Vec<f32>> {
            let at = |k: usize| {
                starts
                    .iter()
                    .map(move |start| start.0.observations[start.1][0] + 3.0 * actions_from(*start, k).sum::<f32>())
            };
            (0..=horizon).map(|k| at(k).collect()).collect()
        }
    }

    /// A model of decisions of three time steps, in each of which the sum grows by the mean of the three actions three times:
    /// right at the end of each decision from any start, and between them where the action is held.
    #[test]
    fn decisions_are_predicted_from_any_start() {
        let actions: Vec<Vec<f32>> = (0..20_u8).map(|t| vec![f32::from(t / 3)]).collect();
        let sum = |t: usize| actions[..t].iter().map(|a| a[0]).sum::<f32>();
        let observations = (0..=20).map(|t| vec![sum(t)]).collect();
        let episode = Episode { observations, actions: actions.clone(), ..Episode::default() };
        let starts = [(&episode, 3), (&episode, 7)];
        let model = WithActionRepeat { model: Adds, action_repeat: 3 };
        let futures = model.open_loop_predictions(&starts, 11, &mut rng::stream(0, "decisions"));
        for (k, future) in futures.iter().enumerate() {
            let expected = [sum(3 + k), sum(7 + k)];
            assert!((future[0] - expected[0]).abs() < 1e-4, "after {k} steps {future:?}, expected {expected:?}");
            assert!(
                k % 3 > 0 || (future[1] - expected[1]).abs() < 1e-4,
                "after {k} steps {future:?}, not {expected:?}"
            );
        }
    }

    /// Of one start, every displacement is the same.
    #[test]
    fn nothing_is_said_where_nothing_differs() {
        let spec = Spec::new("test", [Feature::new("x")], 1, 5, 0.1);
        let observations = (0..=5).map(|t| vec![t as f32]).collect();
        let episode = Episode { observations, actions: vec![vec![0.0]; 5], ..Episode::default() };
        let rows = open_loop(&KnowsTheFirst, &spec, &[episode], &mut rng::stream(0, "starts"));
        assert!(rows.is_empty(), "{rows:?}");
    }

    /// With one long episode among short ones, all start times would come from the long one.
    #[test]
    fn horizons_suit_half_of_the_episodes() {
        let spec = Spec::new("test", [Feature::new("x")], 1, 30, 0.1);
        let of_length = |length: usize| Episode {
            observations: (0..=length).map(|t| vec![(t * t) as f32]).collect(),
            actions: vec![vec![0.0]; length],
            ..Episode::default()
        };
        let rows = open_loop(&KnowsTheFirst, &spec, &[26, 6, 7].map(of_length), &mut rng::stream(0, "starts"));
        assert_eq!(rows.iter().map(|row| row.horizon).collect::<Vec<_>>(), [1, 2, 5]);
    }

    #[test]
    fn goals_differences_and_orientations_do_not_count() {
        let axes = (0..6).map(|i| Feature::new(format!("axis {i}")).axis_of_cube("cube"));
        let features =
            [Feature::new("x"), Feature::new("goal").constant(), Feature::new("way").difference("goal", "x")];
        let spec = Spec::new("test", features.into_iter().chain(axes), 1, 30, 0.1);
        let mut rng = rng::stream(0, "open loop test");
        let mut obs = || (0..9).map(|_| rng::normal(&mut rng) as f32).collect::<Vec<f32>>();
        let observations = (0..=30).map(|_| obs()).collect();
        let episode = Episode { observations, actions: vec![vec![0.0]; 30], ..Episode::default() };
        let rows = open_loop(&KnowsTheFirst, &spec, &[episode], &mut rng::stream(0, "starts"));
        assert!(rows.len() == HORIZONS.len() && rows.iter().all(|row| row.rmse == 0.0), "{rows:?}");
        // It predicts one outcome, without an uncertainty that could be right or wrong.
        assert!(rows.iter().all(|row| row.nll.is_none() && row.coverage90.is_none()), "{rows:?}");
    }
}
