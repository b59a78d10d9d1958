//! What is saved of TD-MPC2, and how good its model and values are.

use rayon::prelude::*;

use super::{Controller, Networks, RunningScale, TdMpc2};
use crate::agent::decision::{in_decisions, most_observed};
use crate::agent::{Checkpoint, Diagnostics, ValueEstimate};
use crate::checkpoint::Weights;
use crate::error::Result;
use crate::model::Probed;
use crate::model::open_loop::{OpenLoop, WithActionRepeat, open_loop};
use crate::nn::copy_parameters;
use crate::replay::Episode;
use crate::rng;

impl Diagnostics for TdMpc2 {
    fn updates(&self) -> u64 {
        self.model_optimiser.steps()
    }

    /// Predictions are those of the latent dynamics, read out by the probe.
    fn open_loop(&self, episodes: &[Episode]) -> Vec<OpenLoop> {
        let Networks { model, probe, .. } = &self.networks;
        let predictor = WithActionRepeat { model: Probed { model, probe }, action_repeat: self.config.action_repeat };
        open_loop(&predictor, &self.spec, episodes, &mut rng::stream(0, "open loop"))
    }

    /// The mean of the critics at the policy's most likely action.
    fn value_estimates(&self, episodes: &[Episode]) -> Vec<ValueEstimate> {
        let Networks { model, policy, .. } = &self.networks;
        let of_episode = |episode: &Episode| {
            let episode = &in_decisions(episode, self.config.action_repeat);
            let z = model.encode(&episode.observations.concat());
            let q = model.values(model.critics(), &z, &policy.mode(&z));
            let steps = episode.observations.len();
            let critics = q.len() / steps;
            let unit = self.config.reward_unit;
            let mean = |t: usize| unit * (0..critics).map(|i| q[i * steps + t]).sum::<f32>() / critics as f32;
            let values: Vec<f32> = (0..steps).map(mean).collect();
            ValueEstimate::of_episode(&values, episode, self.discount)
        };
        episodes.par_iter().flat_map_iter(of_episode).collect()
    }
}

impl Checkpoint for TdMpc2 {
    fn weights(&self) -> Weights {
        let mut weights = Weights::default();
        weights.insert_module("tdmpc2", &self.networks);
        weights
    }

    fn load_weights(&mut self, weights: &Weights) -> Result<()> {
        weights.load_module("tdmpc2", &mut self.networks)?;
        copy_parameters(&mut self.networks.target, self.networks.model.critics());
        self.frozen = None;
        Ok(())
    }

    fn training_state(&self) -> Weights {
        let mut state = Weights::default();
        state.insert_module("target", &self.networks.target);
        self.model_optimiser.save(&mut state, "model");
        self.policy_optimiser.save(&mut state, "policy");
        self.probe_optimiser.save(&mut state, "probe");
        self.replay.save(&mut state, "replay");
        state.insert("scale", vec![self.scale.scale()], [1, 1, 1]);
        state.insert("update_credit", vec![self.update_credit], [1, 1, 1]);
        state.insert_counts("counts", &[self.observed as u64]);
        state.insert_rng("rng", &self.rng);
        state.insert_rng("planner rng", &self.controller.rng);
        state
    }

    fn load_training_state(&mut self, state: &Weights) -> Result<()> {
        let (own, planner) = (state.rng("rng")?, state.rng("planner rng")?);
        let &[scale] = state.get_within("scale", [1, 1, 1], 0.0..=f32::MAX)? else { unreachable!("one number") };
        state.load_module("target", &mut self.networks.target)?;
        self.model_optimiser.load(state, "model", &self.networks.model)?;
        self.policy_optimiser.load(state, "policy", &self.networks.policy)?;
        self.probe_optimiser.load(state, "probe", &self.networks.probe)?;
        self.replay.load(state, "replay")?;
        let most = most_observed(self.replay.most_pushes(), self.config.action_repeat);
        self.observed = state.count("counts", 0..=most)? as usize;
        // At most the updates for all time steps are due, one more for the rounding of their sum.
        let due = self.observed as f32 * self.config.updates_per_step * 1.01 + 1.0;
        let &[update_credit] = state.get_within("update_credit", [1, 1, 1], 0.0..=due)? else {
            unreachable!("one number")
        };
        self.scale = RunningScale::new(scale.max(f32::MIN_POSITIVE));
        self.update_credit = update_credit;
        self.rng = own;
        self.controller = Controller::explorer(&self.config, &self.spec, planner);
        self.decision.reset();
        self.random.reset();
        Ok(())
    }
}
