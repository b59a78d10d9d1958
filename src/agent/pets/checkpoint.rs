//! What is saved of PETS.

use super::Pets;
use crate::agent::Checkpoint;
use crate::agent::decision::most_observed;
use crate::checkpoint::Weights;
use crate::error::Result;

impl Checkpoint for Pets {
    fn weights(&self) -> Weights {
        self.ensemble.weights()
    }

    fn load_weights(&mut self, weights: &Weights) -> Result<()> {
        self.ensemble.load_weights(weights)?;
        self.dynamics = self.ensemble.is_fitted().then(|| self.ensemble.dynamics());
        self.sampled = None;
        Ok(())
    }

    fn training_state(&self) -> Weights {
        let mut state = Weights::default();
        self.ensemble.save_training_state(&mut state);
        self.replay.save(&mut state, "replay");
        state.insert_counts("counts", &[self.observed as u64]);
        state.insert_rng("rng", &self.rng);
        state.insert_rng("planner rng", &self.controller.rng);
        state
    }

    fn load_training_state(&mut self, state: &Weights) -> Result<()> {
        let (own, planner) = (state.rng("rng")?, state.rng("planner rng")?);
        self.ensemble.load_training_state(state)?;
        self.replay.load(state, "replay")?;
        let (held, most) = self.replay.pushes().into_inner();
        let most = most_observed(most, self.config.action_repeat);
        self.observed = state.count("counts", held..=most)? as usize;
        self.rng = own;
        self.controller = self.controllers.explorer(planner);
        self.decision.reset();
        self.random.reset();
        self.sampled = None;
        Ok(())
    }
}
