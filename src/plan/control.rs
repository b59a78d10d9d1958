//! Receding-horizon control: plan far ahead, act for a little, plan again from where that led.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use super::{Iteration, Objective, Observer, Planner, PlannerConfig, Sequences};
use crate::error::{Error, Result};
use crate::rng::Rng;

/// How plans become control.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ControlConfig {
    /// Control steps for which each planned action is held: the planner decides less often, and so farther ahead.
    pub hold: usize,
    /// Planned actions that are executed before the next plan is made.
    pub replan_every: usize,
}

impl Default for ControlConfig {
    fn default() -> Self {
        Self { hold: 1, replan_every: 1 }
    }
}

impl ControlConfig {
    /// # Errors
    /// If there is nothing to execute between two plans.
    pub(crate) fn check(&self, planner: &PlannerConfig) -> Result<()> {
        planner.check()?;
        if self.hold == 0 || self.replan_every == 0 || self.replan_every > planner.horizon() {
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
    pub fn new(planner: &PlannerConfig, actions: usize, config: &ControlConfig) -> Self {
        Self { config: config.clone(), planner: planner.build(actions), actions, ahead: VecDeque::new() }
    }

    /// Forgets everything: a new episode.
    pub fn reset(&mut self) {
        self.planner.reset();
        self.ahead.clear();
    }

    /// The next action. The objective, which is asked about sequences of control steps, is asked only when it is time to
    /// plan; and then the observer sees what was tried, in control steps too.
    pub fn act(&mut self, objective: &mut dyn Objective, observer: &mut Observer, rng: &mut Rng) -> Vec<f32> {
        if self.ahead.is_empty() {
            let ControlConfig { hold, replan_every } = self.config;
            let mut watch = |iteration: &Iteration| {
                let Iteration { index, candidates, returns, mean } = *iteration;
                let mean: Vec<f64> = held(mean, self.actions, hold);
                observer(&Iteration { index, candidates: &stretched(candidates, hold), returns, mean: &mean });
            };
            let plan = self.planner.plan(&mut Held { objective, hold }, &mut watch, rng);
            self.planner.shift(replan_every);
            self.ahead.extend(held(&plan.actions[..replan_every * self.actions], self.actions, hold));
        }
        self.ahead.drain(..self.actions).collect()
    }
}

/// An objective of control steps, asked about actions that are each held for several.
struct Held<'a> {
    objective: &'a mut dyn Objective,
    hold: usize,
}

impl Objective for Held<'_> {
    fn returns(&mut self, sequences: &Sequences) -> Vec<f32> {
        self.objective.returns(&stretched(sequences, self.hold))
    }

    fn gradients(&mut self, sequences: &Sequences) -> (Vec<f32>, Vec<f32>) {
        let (returns, slopes) = self.objective.gradients(&stretched(sequences, self.hold));
        // A held action acts in all of its steps.
        let of_actions = slopes.chunks_exact(self.hold * sequences.actions).flat_map(|steps| {
            (0..sequences.actions).map(|i| steps.iter().skip(i).step_by(sequences.actions).sum::<f32>())
        });
        (returns, of_actions.collect())
    }
}

fn stretched(sequences: &Sequences, hold: usize) -> Sequences {
    Sequences {
        horizon: sequences.horizon * hold,
        actions: sequences.actions,
        values: held(&sequences.values, sequences.actions, hold),
    }
}

/// Each action so many times in a row.
fn held<T: Copy>(values: &[T], actions: usize, hold: usize) -> Vec<T> {
    values.chunks_exact(actions).flat_map(|action| action.repeat(hold)).collect()
}
