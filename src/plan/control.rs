//! Receding-horizon control: plan far ahead, act for a little, plan again from where that led.

use std::collections::VecDeque;

use super::{Objective, Observer, Planner, PlannerConfig};
use crate::rng::Rng;

/// A planner that is asked again every few steps.
pub struct RecedingHorizon {
    planner: Box<dyn Planner>,
    actions: usize,
    replan_every: usize,
    /// What is left to execute before the next plan.
    ahead: VecDeque<f32>,
    /// What the last plan promised.
    promised: f32,
}

impl RecedingHorizon {
    /// Plans anew after `replan_every` actions (at least one; at most the planner's horizon).
    pub fn new(planner: &PlannerConfig, actions: usize, replan_every: usize) -> Self {
        Self {
            replan_every: replan_every.clamp(1, planner.horizon()),
            planner: planner.build(actions),
            actions,
            ahead: VecDeque::new(),
            promised: f32::NEG_INFINITY,
        }
    }

    /// Forgets everything: a new episode.
    pub fn reset(&mut self) {
        self.planner.reset();
        self.ahead.clear();
    }

    /// The next action. The objective is asked only when it is time to plan.
    pub fn act(&mut self, objective: &mut dyn Objective, observer: &mut Observer, rng: &mut Rng) -> Vec<f32> {
        if self.ahead.is_empty() {
            let plan = self.planner.plan(objective, observer, rng);
            self.planner.shift(self.replan_every);
            self.promised = plan.promised;
            self.ahead.extend(&plan.actions[..self.replan_every * self.actions]);
        }
        self.ahead.drain(..self.actions).collect()
    }

    /// What the last plan promised: the return of the horizon that lay before it.
    pub fn promised(&self) -> f32 {
        self.promised
    }
}
