//! Receding-horizon control: plan far ahead, act for a little, plan again from where that led.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use super::{ActionSequences, Iteration, Objective, PlanObserver, Planner, PlannerConfig};
use crate::error::{Error, Result};
use crate::rng::Rng;

/// How plans become control.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ControlConfig {
    /// Control steps for which each planned action is held: the planner decides less often, and so farther ahead.
    pub action_repeat: usize,
    /// Planned actions that are executed before the next plan is made.
    pub replan_every: usize,
}

impl Default for ControlConfig {
    fn default() -> Self {
        Self { action_repeat: 1, replan_every: 1 }
    }
}

impl ControlConfig {
    /// # Errors
    /// If there is nothing to execute between two plans.
    pub(crate) fn check(&self, planner: &PlannerConfig) -> Result<()> {
        planner.check()?;
        if self.action_repeat == 0 || self.replan_every == 0 || self.replan_every > planner.horizon() {
            return Err(Error::BadSetting(
                "control: `hold` and `replan_every` must be at least 1, and `replan_every` no longer than the horizon"
                    .into(),
            ));
        }
        Ok(())
    }
}

/// A planner that is asked again every few steps.
pub struct RecedingHorizon {
    config: ControlConfig,
    planner: Box<dyn Planner>,
    actions: usize,
    /// What is left to execute before the next plan.
    ahead: VecDeque<f32>,
}

impl RecedingHorizon {
    /// A controller for actions of so many numbers.
    pub fn new(planner: Box<dyn Planner>, actions: usize, config: &ControlConfig) -> Self {
        Self { config: config.clone(), planner, actions, ahead: VecDeque::new() }
    }

    /// Forgets everything: a new episode.
    pub fn reset(&mut self) {
        self.planner.reset();
        self.ahead.clear();
    }

    /// The next action. The objective, which is asked about sequences of control steps, is asked only when it is time to
    /// plan; and then the observer sees what was tried, in control steps too.
    pub fn act(&mut self, objective: &mut dyn Objective, observer: &mut PlanObserver, rng: &mut Rng) -> Vec<f32> {
        if self.ahead.is_empty() {
            let ControlConfig { action_repeat, replan_every } = self.config;
            let mut watch = |iteration: &Iteration| {
                let Iteration { index, candidates, returns, mean } = *iteration;
                let mean: Vec<f64> = held(mean, self.actions, action_repeat);
                observer(&Iteration { index, candidates: &stretched(candidates, action_repeat), returns, mean: &mean });
            };
            let plan = self.planner.plan(&mut Held { objective, action_repeat }, &mut watch, rng);
            self.planner.shift(replan_every);
            self.ahead.extend(held(&plan.actions[..replan_every * self.actions], self.actions, action_repeat));
        }
        self.ahead.drain(..self.actions).collect()
    }
}

/// An objective of control steps, asked about actions that are each held for several.
struct Held<'a> {
    objective: &'a mut dyn Objective,
    action_repeat: usize,
}

impl Objective for Held<'_> {
    fn returns(&mut self, sequences: &ActionSequences) -> Vec<f32> {
        self.objective.returns(&stretched(sequences, self.action_repeat))
    }

    fn gradients(&mut self, sequences: &ActionSequences) -> (Vec<f32>, Vec<f32>) {
        let (returns, slopes) = self.objective.gradients(&stretched(sequences, self.action_repeat));
        // A held action acts in all of its steps.
        let of_actions = slopes.chunks_exact(self.action_repeat * sequences.actions).flat_map(|steps| {
            (0..sequences.actions).map(|i| steps.iter().skip(i).step_by(sequences.actions).sum::<f32>())
        });
        (returns, of_actions.collect())
    }
}

fn stretched(sequences: &ActionSequences, action_repeat: usize) -> ActionSequences {
    ActionSequences {
        horizon: sequences.horizon * action_repeat,
        actions: sequences.actions,
        values: held(&sequences.values, sequences.actions, action_repeat),
    }
}

/// Each action so many times in a row.
fn held<T: Copy>(values: &[T], actions: usize, action_repeat: usize) -> Vec<T> {
    values.chunks_exact(actions).flat_map(|action| action.repeat(action_repeat)).collect()
}
