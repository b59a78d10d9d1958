//! Planning: finding an action sequence that maximises an objective.
//!
//! A planner knows nothing of environments or models. It proposes action sequences, is told the return of each, and
//! keeps what helps the next search, when the environment has moved on by a step ([`Planner::shift`]).
//! [`RecedingHorizon`] turns a planner into a controller (model predictive control, MPC). An observer may watch every
//! iteration. Actions lie in [-1, 1].
//!
//! | planner | search |
//! | --- | --- |
//! | [`RandomShooting`] | the best of many uniform random sequences |
//! | [`Cem`] | the cross-entropy method, as in PETS |
//! | [`Icem`] | CEM with coloured noise; elites are kept between iterations and plans |
//! | [`Mppi`] | model predictive path integral control: an average of all samples, weighted by exp(return) |
//! | [`GuidedMppi`] | MPPI over the best candidates, among them a policy's proposals, as in TD-MPC2 |
//! | [`Gradient`] | gradient ascent on the actions (gradient shooting) |
//! | [`Hybrid`] | iCEM, refined by gradient ascent |
//!
//! ```
//! use handful::plan::{ActionSequences, Icem, IcemConfig, Planner};
//! use handful::rng;
//!
//! // Five time steps, two numbers in each action; the closer they all are to 0.5, the higher the return.
//! let mut objective = |candidates: &ActionSequences| -> Vec<f32> {
//!     candidates.rows().map(|row| -row.iter().map(|a| (a - 0.5).powi(2)).sum::<f32>()).collect()
//! };
//! let mut planner = Icem::new(IcemConfig { horizon: 5, iterations: 6, ..IcemConfig::default() }, 2);
//! let mut best = Vec::new();
//! let plan = planner.plan(
//!     &mut objective,
//!     &mut |iteration| best.push(iteration.returns.iter().copied().fold(f32::MIN, f32::max)),
//!     &mut rng::stream(0, "example"),
//! );
//! assert_eq!(plan.actions.len(), 5 * 2);
//! assert!(plan.best_return > best[0], "later iterations find better sequences");
//! ```
//!
//! A planner of one's own implements [`Planner`]. It then enters everything that plans: [`RecedingHorizon`],
//! [`Pets::with_planner`](crate::agent::Pets::with_planner), [`Oracle::with_planner`](crate::agent::Oracle::with_planner).

mod cem;
mod config;
mod control;
mod costs;
mod gradient;
mod guided;
mod hybrid;
mod icem;
mod mppi;
pub mod noise;
mod shooting;

pub use cem::{Cem, CemConfig};
pub use config::PlannerConfig;
pub use control::{ControlConfig, Interpolation, RecedingHorizon};
pub(crate) use costs::{ActionCosts, WithCosts};
pub use gradient::{Gradient, GradientConfig};
pub use guided::{GuidedConfig, GuidedMppi};
pub use hybrid::{Hybrid, HybridConfig};
pub use icem::{Icem, IcemConfig};
pub use mppi::{Mppi, MppiConfig};
pub use shooting::{RandomShooting, ShootingConfig};

use crate::rng::Rng;

/// A batch of action sequences, `[count, horizon, actions]`, all of one length.
#[derive(Clone, Debug, PartialEq)]
pub struct ActionSequences {
    /// Time steps in each sequence.
    pub horizon: usize,
    /// Dimension of an action.
    pub actions: usize,
    /// All numbers, sequence after sequence, time step after time step.
    pub values: Vec<f32>,
}

impl ActionSequences {
    /// An empty batch, for sequences of `horizon` `action_size`-dimensional actions.
    pub fn new(horizon: usize, action_size: usize) -> Self {
        Self { horizon, actions: action_size, values: Vec::new() }
    }

    /// The number of sequences.
    pub fn count(&self) -> usize {
        self.values.len() / self.width()
    }

    /// The sequence `i`, `[horizon, actions]`.
    ///
    /// # Panics
    /// If there is no such sequence.
    pub fn row(&self, i: usize) -> &[f32] {
        &self.values[i * self.width()..][..self.width()]
    }

    /// All sequences, each `[horizon, actions]`.
    pub fn rows(&self) -> impl Iterator<Item = &[f32]> {
        self.values.chunks_exact(self.width())
    }

    /// Numbers in a sequence: horizon times dimension of an action.
    fn width(&self) -> usize {
        self.horizon * self.actions
    }
}

/// What a planner maximises. Any closure from sequences to returns is an objective.
pub trait Objective {
    /// The return of each sequence, `[count]`. NaN counts as the worst.
    fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32>;

    /// Returns, `[count]`, and their gradients with respect to the actions, `[count, horizon, actions]`. The default takes
    /// central differences (0.001 to either side, also beyond the bounds), at the price of two more returns for each number. A
    /// differentiable objective overrides it, and may differentiate an approximation: planners compare sequences by `returns`.
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

    /// Up to `count` sequences worth trying, of the horizon and action size of the empty batch `like`: those of a learned
    /// policy, for example. The default knows none.
    fn proposals(&mut self, _count: usize, like: &ActionSequences) -> ActionSequences {
        like.clone()
    }
}

impl<F: FnMut(&ActionSequences) -> Vec<f32>> Objective for F {
    fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32> {
        self(sequences)
    }
}

/// One iteration of a planner, as an observer sees it.
#[derive(Clone, Copy, Debug)]
pub struct Iteration<'a> {
    /// Its index, from 0.
    pub index: usize,
    /// The candidates.
    pub candidates: &'a ActionSequences,
    /// The return of each candidate.
    pub returns: &'a [f32],
    /// The mean of the search distribution after the iteration, `[horizon, actions]`. For planners without a
    /// distribution: the best sequence so far.
    pub mean: &'a [f64],
}

/// Is called after every iteration of a planner. `&mut |_| {}` ignores them.
pub type PlanObserver<'a> = dyn FnMut(&Iteration) + 'a;

/// The result of a search.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// The sequence to execute, `[horizon, actions]`.
    pub actions: Vec<f32>,
    /// The best return among the candidates. A maximum over estimates is biased upwards, and the sequence to execute
    /// need not be the one that it belongs to: some planners execute a mean.
    pub best_return: f32,
}

/// A search over action sequences, with what it keeps from one time step to the next (a warm start).
///
/// A planner of one's own, which improves on one sequence by trying random changes:
///
/// ```
/// use handful::plan::{ActionSequences, ControlConfig, Iteration, Objective, Plan, PlanObserver, Planner, RecedingHorizon};
/// use handful::rng::{self, Rng};
///
/// struct HillClimber { sequence: Vec<f32>, action_size: usize }
///
/// impl Planner for HillClimber {
///     fn reset(&mut self) {
///         self.sequence.fill(0.0);
///     }
///
///     fn plan(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, rng: &mut Rng) -> Plan {
///         let horizon = self.sequence.len() / self.action_size;
///         let mut best_return = f32::NEG_INFINITY;
///         for index in 0..50 {
///             let mut candidates = ActionSequences::new(horizon, self.action_size);
///             candidates.values.extend(&self.sequence);
///             let changed = self.sequence.iter().map(|a| (a + 0.2 * rng::normal(rng) as f32).clamp(-1.0, 1.0));
///             candidates.values.extend(changed);
///             let returns = objective.returns(&candidates);
///             let winner = usize::from(returns[1] > returns[0]);
///             self.sequence = candidates.row(winner).to_vec();
///             best_return = returns[winner];
///             let mean: Vec<f64> = self.sequence.iter().map(|a| f64::from(*a)).collect();
///             observer(&Iteration { index, candidates: &candidates, returns: &returns, mean: &mean });
///         }
///         Plan { actions: self.sequence.clone(), best_return }
///     }
///
///     fn shift(&mut self, steps: usize) {
///         self.sequence.rotate_left(steps * self.action_size);
///     }
/// }
///
/// let planner = HillClimber { sequence: vec![0.0; 4], action_size: 1 };
/// let mut controller = RecedingHorizon::new(Box::new(planner), 1, &ControlConfig::default());
/// let mut right = |c: &ActionSequences| -> Vec<f32> { c.rows().map(|row| row.iter().sum()).collect() };
/// let action = controller.act(&mut right, &mut |_| {}, &mut rng::stream(0, "example"));
/// assert!(action[0] > 0.5);
/// ```
pub trait Planner: Send {
    /// Forgets everything: a new episode begins.
    fn reset(&mut self);

    /// Searches for the sequence with the highest return. Calls `observer` after every iteration.
    fn plan(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, rng: &mut Rng) -> Plan;

    /// The first `steps` actions of the plan were executed: what is kept moves on by as many time steps, so that the next
    /// search starts from the rest of this plan (a warm start).
    fn shift(&mut self, steps: usize);
}

impl<P: Planner + ?Sized> Planner for Box<P> {
    fn reset(&mut self) {
        (**self).reset();
    }

    fn plan(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, rng: &mut Rng) -> Plan {
        (**self).plan(objective, observer, rng)
    }

    fn shift(&mut self, steps: usize) {
        (**self).shift(steps);
    }
}

/// Makes planners, one for each environment that is planned in: a [`PlannerConfig`], or any closure from the numbers in
/// an action to a planner.
///
/// ```
/// use handful::plan::{Cem, CemConfig, MakePlanner, PlannerConfig};
///
/// let by_name: &dyn MakePlanner = &PlannerConfig::Cem(CemConfig::default());
/// let by_closure: &dyn MakePlanner = &|action_size| Cem::new(CemConfig::default(), action_size);
/// let planners = [by_name.make(3), by_closure.make(3)];
/// ```
pub trait MakePlanner: Send + Sync {
    /// A planner for `action_size`-dimensional actions.
    fn make(&self, action_size: usize) -> Box<dyn Planner>;
}

impl<F, P> MakePlanner for F
where
    F: Fn(usize) -> P + Send + Sync,
    P: Planner + 'static,
{
    fn make(&self, action_size: usize) -> Box<dyn Planner> {
        Box::new(self(action_size))
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

/// w_i = exp((R_i - max R) / temperature), divided by their sum: the weights of MPPI. A return that is not finite weighs nothing;
/// if none is finite, all weigh the same.
fn weights(returns: &[f32], temperature: f64) -> Vec<f64> {
    let top = returns.iter().copied().filter(|r| r.is_finite()).fold(f32::NEG_INFINITY, f32::max);
    let weigh = |r: &f32| if r.is_finite() { (f64::from(r - top) / temperature).exp() } else { 0.0 };
    let weights: Vec<f64> = returns.iter().map(weigh).collect();
    let sum: f64 = weights.iter().sum();
    let equal = 1.0 / weights.len() as f64;
    weights.iter().map(|w| if sum > 0.0 { w / sum } else { equal }).collect()
}

/// Drops the first `steps` actions of a sequence, and appends `last` as many times.
fn shifted<T: Copy>(sequence: &mut Vec<T>, steps: usize, action_size: usize, last: &[T]) {
    for _ in 0..steps {
        sequence.drain(..action_size);
        sequence.extend_from_slice(last);
    }
}

/// About `count` of an iteration's candidates to show, evenly spaced in the order of their returns, best first.
pub(crate) fn spread(iteration: &Iteration, count: usize) -> Vec<usize> {
    let all = iteration.returns.len();
    best(iteration.returns, all).into_iter().step_by((all / count).max(1)).collect()
}

/// The mean of a search distribution as actions within the bounds.
fn as_actions(mean: &[f64]) -> Vec<f32> {
    mean.iter().map(|a| a.clamp(-1.0, 1.0) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_best_come_first_and_no_number_comes_last() {
        assert_eq!(best(&[1.0, f32::NAN, 3.0, 2.0], 2), [2, 3]);
        assert_eq!(best(&[f32::NAN, f32::NEG_INFINITY, 0.0], 1), [2]);
    }

    #[test]
    fn weights_are_those_of_the_reference() {
        for (temperature, expected) in
            [(1.0, [0.705_384_51, 0.259_496_46, 0.035_119_03]), (2.0, [0.546_549_39, 0.331_498_96, 0.121_951_65])]
        {
            for (found, expected) in weights(&[10.0, 9.0, 7.0], temperature).iter().zip(expected) {
                assert!((found - expected).abs() < 1e-7, "{found}, expected {expected}");
            }
        }
        let mean: f64 = weights(&[10.0, 9.0, 7.0], 1.0).iter().zip([0.2, -0.1, 0.9]).map(|(w, a)| w * a).sum();
        assert!((mean - 0.146_734_38).abs() < 1e-7);
    }

    #[test]
    fn returns_that_are_not_finite_weigh_nothing() {
        assert_eq!(weights(&[f32::NAN, 1.0, f32::INFINITY, 1.0], 1.0), [0.0, 0.5, 0.0, 0.5]);
        assert_eq!(weights(&[f32::NAN; 2], 1.0), [0.5, 0.5]);
        assert_eq!(weights(&[f32::NEG_INFINITY; 2], 1.0), [0.5, 0.5]);
    }

    #[test]
    fn candidates_are_shown_from_the_best_to_the_worst() {
        let candidates = ActionSequences { values: vec![0.0; 6], ..ActionSequences::new(1, 1) };
        let returns = [1.0, f32::NAN, 3.0, 2.0, 5.0, 4.0];
        let iteration = Iteration { index: 0, candidates: &candidates, returns: &returns, mean: &[0.0] };
        assert_eq!(spread(&iteration, 3), [4, 2, 0]);
        assert_eq!(spread(&iteration, 10), [4, 5, 2, 3, 0, 1]);
    }
}
