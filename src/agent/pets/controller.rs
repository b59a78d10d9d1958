//! Receding-horizon control in the learned model: one controller for each environment that PETS acts in.

use super::objective::{EnsembleObjective, PlanningModel};
use crate::plan::{ControlConfig, MakePlanner, PlanObserver, RecedingHorizon};
use crate::rng::{self, Rng};

/// Makes controllers.
pub(super) struct MakeController {
    pub(super) planner: Box<dyn MakePlanner>,
    pub(super) config: ControlConfig,
    pub(super) action_size: usize,
}

impl MakeController {
    pub(super) fn make(&self, rng: Rng) -> Controller {
        let planner = self.planner.make(self.action_size);
        Controller { control: RecedingHorizon::new(planner, self.action_size, &self.config), rng }
    }

    /// The controller of a slot, which depends on nothing but the slot's index.
    pub(super) fn of_slot(&self, index: usize) -> Controller {
        self.make(rng::stream(index as u64, "pets seat"))
    }
}

/// A controller with its own random numbers.
pub(super) struct Controller {
    pub(super) control: RecedingHorizon,
    pub(super) rng: Rng,
}

impl Controller {
    /// The next action from `obs`; plans in `model` when the last plan is used up.
    pub(super) fn act(
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
}
