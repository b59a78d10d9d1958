//! Receding-horizon control (model predictive control, MPC): plan over a horizon, execute the first actions, plan again
//! from where they led.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

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
}

impl Default for ControlConfig {
    fn default() -> Self {
        Self { action_repeat: 1, replan_every: 1 }
    }
}

ranges!(ControlConfig { action_repeat: 1..=1000, replan_every: 1..=1000 });

impl ControlConfig {
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
    /// What is left to execute of the plan, in control steps.
    queue: VecDeque<f32>,
}

impl RecedingHorizon {
    /// A controller for actions of `action_size` numbers.
    ///
    /// # Panics
    /// If `action_repeat` or `replan_every` is 0.
    pub fn new(planner: Box<dyn Planner>, action_size: usize, config: &ControlConfig) -> Self {
        let ControlConfig { action_repeat, replan_every } = *config;
        assert!(action_repeat > 0 && replan_every > 0, "`action_repeat` and `replan_every` must be at least 1");
        Self { config: config.clone(), planner, action_size, queue: VecDeque::new() }
    }

    /// Forgets everything: a new episode begins.
    pub fn reset(&mut self) {
        self.planner.reset();
        self.queue.clear();
    }

    /// The next action. Plans if nothing is left of the last plan. The objective is asked about sequences of control steps,
    /// in which each planned action is repeated; the observer sees control steps, too.
    ///
    /// # Panics
    /// If the planner's plan is shorter than `replan_every` actions.
    // On a method: the search of rustdoc does not find aliases of re-exported items.
    #[doc(alias = "MPC")]
    #[doc(alias = "model predictive control")]
    pub fn act(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, rng: &mut Rng) -> Vec<f32> {
        if self.queue.is_empty() {
            let ControlConfig { action_repeat, replan_every } = self.config;
            let mut observe = |iteration: &Iteration| {
                let Iteration { index, candidates, returns, mean } = *iteration;
                let mean: Vec<f64> = repeated(mean, self.action_size, action_repeat);
                let candidates = &in_control_steps(candidates, action_repeat);
                observer(&Iteration { index, candidates, returns, mean: &mean });
            };
            let plan = self.planner.plan(&mut Repeated { objective, action_repeat }, &mut observe, rng);
            self.planner.shift(replan_every);
            let executed = plan.actions.get(..replan_every * self.action_size).unwrap_or_else(|| {
                let numbers = plan.actions.len();
                panic!("`replan_every` is {replan_every}, but the planner's plan has {numbers} numbers only")
            });
            self.queue.extend(repeated(executed, self.action_size, action_repeat));
        }
        self.queue.drain(..self.action_size).collect()
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

/// An objective of control steps, asked about actions that are each repeated.
struct Repeated<'a> {
    objective: &'a mut dyn Objective,
    action_repeat: usize,
}

impl Objective for Repeated<'_> {
    fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32> {
        self.objective.returns(&in_control_steps(sequences, self.action_repeat))
    }

    fn gradients(&mut self, sequences: &ActionSequences) -> (Vec<f32>, Vec<f32>) {
        let (returns, gradients) = self.objective.gradients(&in_control_steps(sequences, self.action_repeat));
        // By the chain rule, the gradient of a repeated action is the sum over its repetitions.
        let of_actions = gradients.chunks_exact(self.action_repeat * sequences.actions).flat_map(|steps| {
            (0..sequences.actions).map(|i| steps.iter().skip(i).step_by(sequences.actions).sum::<f32>())
        });
        (returns, of_actions.collect())
    }

    fn proposals(&mut self, count: usize, like: &ActionSequences) -> ActionSequences {
        let ActionSequences { horizon, actions, .. } = *like;
        let proposed = self.objective.proposals(count, &ActionSequences::new(horizon * self.action_repeat, actions));
        // The first of the steps for which an action is held.
        let held = proposed.values.chunks_exact(actions).step_by(self.action_repeat);
        ActionSequences { values: held.flatten().copied().collect(), ..like.clone() }
    }
}

fn in_control_steps(sequences: &ActionSequences, action_repeat: usize) -> ActionSequences {
    ActionSequences {
        horizon: sequences.horizon * action_repeat,
        actions: sequences.actions,
        values: repeated(&sequences.values, sequences.actions, action_repeat),
    }
}

/// Each action `action_repeat` times in a row.
fn repeated<T: Copy>(values: &[T], action_size: usize, action_repeat: usize) -> Vec<T> {
    values.chunks_exact(action_size).flat_map(|action| action.repeat(action_repeat)).collect()
}
