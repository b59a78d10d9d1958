//! Receding-horizon control in the learned model: one controller for each environment that PETS acts in.

use super::objective::{EnsembleObjective, PlanningModel};
use crate::agent::decision::Held;
use crate::plan::{ControlConfig, MakePlanner, PlanObserver, RecedingHorizon};
use crate::rng::{self, Rng};

/// Makes controllers.
pub(super) struct MakeController {
    pub(super) planner: Box<dyn MakePlanner>,
    pub(super) config: ControlConfig,
    pub(super) explore_with_costs: bool,
    pub(super) action_size: usize,
}

impl MakeController {
    /// The controller that explores.
    pub(super) fn explorer(&self, rng: Rng) -> Controller {
        let free = ControlConfig { effort_penalty: 0.0, change_penalty: 0.0, ..self.config.clone() };
        self.make(if self.explore_with_costs { &self.config } else { &free }, rng)
    }

    /// The controller of a slot, for evaluations. It depends on nothing but the slot's index.
    pub(super) fn of_slot(&self, index: usize) -> Controller {
        self.make(&self.config, rng::stream(index as u64, "pets seat"))
    }

    fn make(&self, config: &ControlConfig, rng: Rng) -> Controller {
        let planner = self.planner.make(self.action_size);
        Controller { control: RecedingHorizon::new(planner, self.action_size, config), held: Held::default(), rng }
    }
}

/// A controller with its own random numbers.
pub(super) struct Controller {
    control: RecedingHorizon,
    /// The action that is held.
    pub(super) held: Held,
    pub(super) rng: Rng,
}

impl Controller {
    /// Forgets everything: a new episode begins.
    pub(super) fn reset(&mut self) {
        self.control.reset();
        self.held.reset();
    }

    /// The next action from `obs`; decides anew when the last action has been held long enough.
    pub(super) fn act(
        &mut self,
        model: &PlanningModel,
        obs: &[f32],
        disagreement_bonus: f32,
        observer: &mut PlanObserver,
    ) -> Vec<f32> {
        if self.held.is_due() {
            let action = self.decide(model, obs, disagreement_bonus, observer);
            self.held.begin(action, model.config.action_repeat);
        }
        self.held.advance()
    }

    /// The next decision from `obs`; plans in `model` when the last plan is used up.
    pub(super) fn decide(
        &mut self,
        model: &PlanningModel,
        obs: &[f32],
        disagreement_bonus: f32,
        observer: &mut PlanObserver,
    ) -> Vec<f32> {
        let mut objective = EnsembleObjective {
            imagination: model.imagination(),
            obs,
            risk: model.config.risk,
            disagreement: disagreement_bonus - model.config.disagreement_penalty,
            rng: rng::fork(&mut self.rng),
            differentiable: None,
        };
        self.control.act(&mut objective, observer, &mut self.rng)
    }

    /// The plan behind the last decision, `[decisions, action]`; empty if that went on with an earlier one.
    pub(super) fn last_plan(&self) -> &[f32] {
        self.control.last_plan()
    }
}
