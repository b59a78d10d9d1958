//! Receding-horizon control (model predictive control, MPC): plan over a horizon, execute the first actions, plan again
//! from where they led.

use std::collections::VecDeque;

use nalgebra::{RealField, convert};
use serde::{Deserialize, Serialize};

use super::costs::{ActionCosts, WithCosts};
use super::{ActionSequences, Iteration, Objective, PlanObserver, Planner, PlannerConfig};
use crate::rng::Rng;
use crate::settings::ranges;

/// How plans become control.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ControlConfig {
    /// Control steps for which each planned action is repeated. The planner then decides less often, and with the same
    /// horizon looks further ahead.
    #[doc(alias = "frame skip")]
    pub action_repeat: usize,
    /// Planned actions that are executed before the next plan is made.
    pub replan_every: usize,
    /// The actions between one planned action and the next, if `action_repeat` is more than 1.
    pub interpolation: Interpolation,
    /// A plan's return is reduced by this times the sum of its squared actions over all control steps: where the reward is
    /// indifferent, the arm rests.
    #[doc(alias = "control cost")]
    pub effort_penalty: f32,
    /// A plan's return is reduced by this times the sum of the squared changes from one action to the next over all control steps,
    /// the first from the last executed action: what makes planned motion smooth.
    #[doc(alias = "jerk")]
    #[doc(alias = "smoothness")]
    pub change_penalty: f32,
}

/// How a plan of few actions becomes one of more control steps: a spline whose knots are the planned actions.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Interpolation {
    /// Each planned action is held until the next (a spline of order zero).
    #[default]
    #[doc(alias = "zero-order hold")]
    Hold,
    /// From the last executed action in a straight line to the first planned one, which is reached after `action_repeat`
    /// control steps, and so on: the hand's motion has no jumps between planned actions.
    Linear,
}

impl Default for ControlConfig {
    fn default() -> Self {
        Self {
            action_repeat: 1,
            replan_every: 1,
            interpolation: Interpolation::Hold,
            effort_penalty: 0.0,
            change_penalty: 0.0,
        }
    }
}

ranges!(ControlConfig {
    action_repeat: 1..=1000,
    replan_every: 1..=1000,
    interpolation: Any,
    effort_penalty: 0.0..=1e6,
    change_penalty: 0.0..=1e6,
});

impl ControlConfig {
    fn costs(&self) -> ActionCosts {
        ActionCosts { effort: self.effort_penalty, change: self.change_penalty }
    }

    /// Whether a plan holds what is executed of it.
    pub(crate) fn suits(&self, planner: &PlannerConfig) -> bool {
        self.replan_every <= planner.horizon()
    }
}

/// A planner as a controller: it plans, executes the first `replan_every` actions, and plans again.
///
/// ```
/// use handful::plan::{ActionSequences, Cem, CemConfig, ControlConfig, RecedingHorizon};
/// use handful::rng;
///
/// // A point on a line moves by 0.1 * action in each time step, and should come to 0.
/// let planner = Cem::new(CemConfig { horizon: 5, population: 50, elites: 5, ..CemConfig::default() }, 1);
/// let mut controller = RecedingHorizon::new(Box::new(planner), 1, &ControlConfig::default());
/// let mut rng = rng::stream(0, "example");
/// let mut x = 0.8;
/// for _ in 0..15 {
///     let mut objective = |candidates: &ActionSequences| -> Vec<f32> {
///         let imagined_return = |actions: &[f32]| {
///             let (mut x, mut total) = (x, 0.0);
///             for action in actions {
///                 x += 0.1 * action;
///                 total -= x * x;
///             }
///             total
///         };
///         candidates.rows().map(imagined_return).collect()
///     };
///     x += 0.1 * controller.act(&mut objective, &mut |_| {}, &mut rng)[0];
/// }
/// assert!(x.abs() < 0.1);
/// ```
#[doc(alias = "MPC")]
#[doc(alias = "model predictive control")]
#[doc(alias = "receding horizon")]
pub struct RecedingHorizon {
    config: ControlConfig,
    planner: Box<dyn Planner>,
    action_size: usize,
    /// The plan that the last call of [`RecedingHorizon::act`] made, in control steps; empty if it made none.
    plan: Vec<f32>,
    /// What is left to execute of the last plan, in control steps.
    queue: VecDeque<f32>,
    /// The last executed action; zeros before the first.
    last: Vec<f32>,
}

impl RecedingHorizon {
    /// A controller for `action_size`-dimensional actions.
    ///
    /// # Panics
    /// If `action_repeat` or `replan_every` is 0.
    pub fn new(planner: Box<dyn Planner>, action_size: usize, config: &ControlConfig) -> Self {
        let ControlConfig { action_repeat, replan_every, .. } = *config;
        assert!(action_repeat > 0 && replan_every > 0, "`action_repeat` and `replan_every` must be at least 1");
        let last = vec![0.0; action_size];
        Self { config: config.clone(), planner, action_size, plan: Vec::new(), queue: VecDeque::new(), last }
    }

    /// Forgets everything: a new episode begins.
    pub fn reset(&mut self) {
        self.planner.reset();
        self.plan.clear();
        self.queue.clear();
        self.last.fill(0.0);
    }

    /// The next action. Plans if nothing is left of the last plan. The objective is asked about sequences of control steps,
    /// between the planned actions as [`Interpolation`] says; the observer sees control steps, too.
    ///
    /// # Panics
    /// If the planner's plan is shorter than `replan_every` actions.
    // On a method: the search of rustdoc does not find aliases of re-exported items.
    #[doc(alias = "MPC")]
    #[doc(alias = "model predictive control")]
    pub fn act(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, rng: &mut Rng) -> Vec<f32> {
        self.plan.clear();
        if self.queue.is_empty() {
            let replan_every = self.config.replan_every;
            let spline = Spline { config: &self.config, start: &self.last };
            let mut observe = |iteration: &Iteration| {
                let Iteration { index, candidates, returns, mean } = *iteration;
                let mean: Vec<f64> = spline.interpolate(mean);
                let candidates = &spline.in_control_steps(candidates);
                observer(&Iteration { index, candidates, returns, mean: &mean });
            };
            let mut objective = WithCosts { objective, costs: self.config.costs(), before: &self.last };
            let plan = self.planner.plan(&mut Interpolated { objective: &mut objective, spline }, &mut observe, rng);
            let (numbers, executed) = (plan.actions.len(), replan_every * self.action_size);
            assert!(
                executed <= numbers,
                "`replan_every` is {replan_every}, but the planner's plan has {numbers} numbers only"
            );
            self.planner.shift(replan_every);
            self.plan = spline.interpolate(&plan.actions);
            self.queue.extend(&self.plan[..executed * self.config.action_repeat]);
        }
        self.last = self.queue.drain(..self.action_size).collect();
        self.last.clone()
    }

    /// The whole plan that the last call of [`RecedingHorizon::act`] made, `[control steps, action]`, of which it executes the first
    /// actions; empty if it went on with an earlier one.
    pub fn last_plan(&self) -> &[f32] {
        &self.plan
    }
}

impl std::fmt::Debug for RecedingHorizon {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let Self { config, action_size, queue, .. } = self;
        f.debug_struct("RecedingHorizon")
            .field("config", config)
            .field("action_size", action_size)
            .field("queue", queue)
            .finish_non_exhaustive()
    }
}

/// The control steps of planned actions.
#[derive(Clone, Copy)]
struct Spline<'a> {
    config: &'a ControlConfig,
    /// The action before the first planned one.
    start: &'a [f32],
}

impl Spline<'_> {
    /// `action_repeat` control steps for each planned action.
    fn interpolate<T: RealField + Copy>(&self, actions: &[T]) -> Vec<T> {
        let start: Vec<T> = self.start.iter().map(|&a| convert(f64::from(a))).collect();
        let mut steps = Vec::with_capacity(actions.len() * self.config.action_repeat);
        let mut before = start.as_slice();
        for action in actions.chunks_exact(self.start.len()) {
            for step in 1..=self.config.action_repeat {
                match self.config.interpolation {
                    Interpolation::Hold => steps.extend(action),
                    Interpolation::Linear => {
                        let weight = convert(self.weight(step));
                        steps.extend(before.iter().zip(action).map(|(&b, &a)| b + (a - b) * weight));
                    }
                }
            }
            before = action;
        }
        steps
    }

    /// The part that a planned action has in the control step `step` (from 1) of those that lead to it; the action before
    /// has the rest.
    fn weight(&self, step: usize) -> f64 {
        match self.config.interpolation {
            Interpolation::Hold => 1.0,
            Interpolation::Linear => step as f64 / self.config.action_repeat as f64,
        }
    }

    fn in_control_steps(&self, sequences: &ActionSequences) -> ActionSequences {
        ActionSequences {
            horizon: sequences.horizon * self.config.action_repeat,
            actions: sequences.actions,
            values: sequences.rows().flat_map(|row| self.interpolate(row)).collect(),
        }
    }
}

/// An objective of control steps, asked about planned actions.
struct Interpolated<'a> {
    objective: &'a mut dyn Objective,
    spline: Spline<'a>,
}

impl Objective for Interpolated<'_> {
    fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32> {
        self.objective.returns(&self.spline.in_control_steps(sequences))
    }

    fn gradients(&mut self, sequences: &ActionSequences) -> (Vec<f32>, Vec<f32>) {
        let (returns, gradients) = self.objective.gradients(&self.spline.in_control_steps(sequences));
        // By the chain rule: a planned action has a part in the steps that lead to it, and in those that lead from it.
        let ActionSequences { horizon, actions, .. } = *sequences;
        let repeat = self.spline.config.action_repeat;
        let mut planned = vec![0.0; sequences.values.len()];
        for (planned, steps) in
            planned.chunks_exact_mut(horizon * actions).zip(gradients.chunks_exact(repeat * horizon * actions))
        {
            for (t, gradient) in steps.chunks_exact(actions).enumerate() {
                let (knot, weight) = (t / repeat, self.spline.weight(t % repeat + 1) as f32);
                for (i, g) in gradient.iter().enumerate() {
                    planned[knot * actions + i] += weight * g;
                    if knot > 0 {
                        planned[(knot - 1) * actions + i] += (1.0 - weight) * g;
                    }
                }
            }
        }
        (returns, planned)
    }

    fn proposals(&mut self, count: usize, like: &ActionSequences) -> ActionSequences {
        let ActionSequences { horizon, actions, .. } = *like;
        let repeat = self.spline.config.action_repeat;
        let proposed = self.objective.proposals(count, &ActionSequences::new(horizon * repeat, actions));
        // The step at which a planned action is reached.
        let reached = match self.spline.config.interpolation {
            Interpolation::Hold => 0,
            Interpolation::Linear => repeat - 1,
        };
        let planned = proposed.values.chunks_exact(actions).skip(reached).step_by(repeat);
        ActionSequences { values: planned.flatten().copied().collect(), ..like.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spline(interpolation: Interpolation) -> ControlConfig {
        ControlConfig { action_repeat: 2, interpolation, ..ControlConfig::default() }
    }

    #[test]
    fn planned_actions_are_held_or_reached_in_a_straight_line() {
        let of = |interpolation| Spline { config: &spline(interpolation), start: &[0.5] }.interpolate(&[1.0_f32, 0.0]);
        assert_eq!(of(Interpolation::Hold), [1.0, 1.0, 0.0, 0.0]);
        assert_eq!(of(Interpolation::Linear), [0.75, 1.0, 0.5, 0.0]);
    }

    #[test]
    fn gradients_are_those_of_the_planned_actions() {
        for interpolation in [Interpolation::Hold, Interpolation::Linear] {
            let config = ControlConfig { effort_penalty: 0.2, change_penalty: 0.3, ..spline(interpolation) };
            let mut rng = crate::rng::stream(0, "interpolation");
            let weights: Vec<f32> = (0..12).map(|_| crate::rng::normal(&mut rng) as f32).collect();
            let mut linear = |c: &ActionSequences| -> Vec<f32> {
                c.rows().map(|row| row.iter().zip(&weights).map(|(a, w)| a * w).sum()).collect()
            };
            // Central differences of what is quadratic in the actions are exact.
            let before = [0.1, 0.2];
            let mut objective = WithCosts { objective: &mut linear, costs: config.costs(), before: &before };
            let mut objective =
                Interpolated { objective: &mut objective, spline: Spline { config: &config, start: &before } };
            let plans = ActionSequences { horizon: 3, actions: 2, values: vec![0.3, -0.2, 0.1, 0.5, -0.6, 0.4] };
            let (_, gradients) = objective.gradients(&plans);
            for (i, gradient) in gradients.iter().enumerate() {
                let mut at = |step: f32| {
                    let mut plans = plans.clone();
                    plans.values[i] += step;
                    objective.returns(&plans)[0]
                };
                let difference = at(0.5) - at(-0.5);
                assert!((difference - gradient).abs() < 1e-3, "{interpolation:?}: {difference}, {gradient}");
            }
        }
    }
}
