//! What is saved of SAC, and how good its critics are.

use dfdx::prelude::*;

use super::Sac;
use crate::agent::decision::{in_decisions, most_observed};
use crate::agent::{Checkpoint, Diagnostics, ValueEstimate};
use crate::checkpoint::{MAX_COUNT, Weights};
use crate::error::Result;
use crate::nn::{Grad, copy_parameters, ops, tensor};
use crate::replay::Episode;

impl Diagnostics for Sac {
    fn updates(&self) -> u64 {
        self.critic_optimiser.steps()
    }

    fn value_estimates(&self, episodes: &[Episode]) -> Vec<ValueEstimate> {
        let of_episode = |episode: &Episode| {
            let episode = &in_decisions(episode, self.config.action_repeat);
            let observations = episode.observations.concat();
            let actions = self.deterministic_actions(&observations).concat();
            let actions = tensor(&self.cpu, actions, (1, episode.observations.len(), self.action_size));
            let q = self.critics.forward(ops::join(self.observations(&observations), actions), Grad::Input);
            let values = q.min::<(usize, usize), Axis<0>>().as_vec();
            ValueEstimate::of_episode(&values, episode, self.discount)
        };
        episodes.iter().flat_map(of_episode).collect()
    }
}

impl Checkpoint for Sac {
    fn weights(&self) -> Weights {
        let mut weights = Weights::default();
        weights.insert_module("policy", &self.policy);
        weights.insert_module("critics", &self.critics);
        weights.insert("temperature", vec![self.temperature.log], [1, 1, 1]);
        weights
    }

    fn load_weights(&mut self, weights: &Weights) -> Result<()> {
        let log = weights.get("temperature", [1, 1, 1])?[0];
        weights.load_module("policy", &mut self.policy)?;
        weights.load_module("critics", &mut self.critics)?;
        copy_parameters(&mut self.target_critics, &self.critics);
        self.temperature.log = log;
        Ok(())
    }

    fn training_state(&self) -> Weights {
        let mut state = Weights::default();
        state.insert_module("target", &self.target_critics);
        self.policy_optimiser.save(&mut state, "policy");
        self.critic_optimiser.save(&mut state, "critics");
        self.replay.save(&mut state, "replay");
        state.insert_counts("counts", &[self.observed as u64, self.updates as u64]);
        state.insert_rng("rng", &self.rng);
        self.temperature.save_optimiser(&mut state);
        state
    }

    fn load_training_state(&mut self, state: &Weights) -> Result<()> {
        let rng = state.rng("rng")?;
        self.temperature.load_optimiser(state)?;
        state.load_module("target", &mut self.target_critics)?;
        self.policy_optimiser.load(state, "policy", &self.policy)?;
        self.critic_optimiser.load(state, "critics", &self.critics)?;
        self.replay.load(state, "replay")?;
        let (held, most) = self.replay.pushes().into_inner();
        let most = most_observed(most, self.config.action_repeat);
        let counts = state.counts_within("counts", &[held..=most, 0..=MAX_COUNT])?;
        self.observed = counts[0] as usize;
        self.updates = counts[1] as usize;
        self.rng = rng;
        self.forget_episode();
        Ok(())
    }
}
