//! The loop over time steps: one rollout of several candidates on one thread.

use super::noise::CommonRandomNumbers;
use super::{Imagination, NO_REWARD, Propagation, Reward};
use crate::env::KnownReward;
use crate::model::dynamics::Scratch;
use crate::model::ensemble::LearnedReward;

/// Candidates in imagination, with the buffers of one time step. A row is one particle of one candidate; rows are ordered
/// `[particles, candidates]`.
pub(super) struct Rollout<'a> {
    pub imagination: &'a Imagination<'a>,
    /// Candidates, `[candidates, horizon, action]`.
    candidate_actions: &'a [f32],
    pub particles: usize,
    pub candidates: usize,
    /// Observations at the current time step, `[particles, candidates, observation]`.
    pub states: Vec<f32>,
    /// Observations at the next one.
    pub next: Vec<f32>,
    /// Actions of the current time step, `[particles, candidates, action]`.
    pub actions: Vec<f32>,
    /// Rewards of the current time step, `[particles, candidates]`.
    pub rewards: Vec<f32>,
    /// Whether the task has not terminated yet, `[particles, candidates]`.
    pub alive: Vec<bool>,
    /// Sums of rewards, `[candidates, particles]`.
    returns: &'a mut [f32],
    /// Sums of the members' disagreement, `[candidates]`.
    pub disagreement: &'a mut [f32],
    pub scratch: Scratch,
}

impl<'a> Rollout<'a> {
    /// Candidates at their first observations `obs`, `[candidates, observation]`.
    pub fn new(
        imagination: &'a Imagination<'a>,
        obs: &[f32],
        candidate_actions: &'a [f32],
        returns: &'a mut [f32],
        disagreement: &'a mut [f32],
    ) -> Self {
        let (particles, candidates) = (imagination.particles(), disagreement.len());
        let (rows, states) = (particles * candidates, obs.repeat(particles));
        Self {
            imagination,
            candidate_actions,
            particles,
            candidates,
            next: states.clone(),
            states,
            actions: vec![0.0; rows * imagination.dynamics.action_size()],
            rewards: vec![0.0; rows],
            alive: vec![true; rows],
            returns,
            disagreement,
            scratch: Scratch::default(),
        }
    }

    /// Runs all time steps. `visit` receives the observations before the first and after each.
    pub fn run(mut self, horizon: usize, noise: &CommonRandomNumbers, mut visit: impl FnMut(&[f32])) {
        visit(&self.states);
        for t in 0..horizon {
            let width = self.imagination.dynamics.action_size();
            for (row, action) in self.actions.chunks_exact_mut(width).enumerate() {
                let start = (row % self.candidates * horizon + t) * width;
                action.copy_from_slice(&self.candidate_actions[start..][..width]);
            }
            let noise = noise.at(t);
            match self.imagination.propagation {
                Propagation::TsInf | Propagation::Ts1 | Propagation::TsInfMean => {
                    self.trajectory_sampling(t == 0, noise);
                    self.add_member_disagreement(noise);
                }
                Propagation::Expectation => self.expectation(),
                Propagation::MomentMatching => self.moment_matching(noise),
            }
            self.add_rewards();
            std::mem::swap(&mut self.states, &mut self.next);
            visit(&self.states);
        }
        self.add_terminal_values();
    }

    /// Adds the rewards of the time step from `states` to `next` to the returns.
    fn add_rewards(&mut self) {
        let Imagination { dynamics, reward, .. } = *self.imagination;
        match reward {
            Reward::Known(known) => known.rewards(&self.states, &self.actions, &self.next, &mut self.rewards),
            Reward::Learned => self.learned_rewards(dynamics.learned_reward().expect(NO_REWARD)),
        }
        let width = dynamics.observation_size();
        for (row, (reward_of_row, alive)) in self.rewards.iter().zip(&mut self.alive).enumerate() {
            if *alive {
                self.returns[row % self.candidates * self.particles + row / self.candidates] += reward_of_row;
                if let Reward::Known(known) = reward {
                    *alive = !known.terminated(&self.next[row * width..][..width]);
                }
            }
        }
    }

    /// The rewards of the time step as the model has learned them. Each particle keeps to one member, so that the mean over
    /// particles is that over members; a single particle gets the latter.
    fn learned_rewards(&mut self, learned: &LearnedReward) {
        if self.particles == 1 {
            return learned.rewards(&self.states, &self.actions, &self.next, &mut self.rewards);
        }
        let dynamics = self.imagination.dynamics;
        let (width, actions) = (dynamics.observation_size(), dynamics.action_size());
        for p in 0..self.particles {
            let rows = p * self.candidates..(p + 1) * self.candidates;
            let of = |width: usize| rows.start * width..rows.end * width;
            learned.of_member(
                p * learned.members() / self.particles,
                &self.states[of(width)],
                &self.actions[of(actions)],
                &self.next[of(width)],
                &mut self.rewards[rows.clone()],
            );
        }
    }

    /// Adds the value of the last observations where the task has not terminated.
    fn add_terminal_values(&mut self) {
        let Some(value) = self.imagination.value else { return };
        let mut values = vec![0.0; self.alive.len()];
        value(&self.states, &mut values);
        for (row, value) in values.into_iter().enumerate() {
            if self.alive[row] {
                self.returns[row % self.candidates * self.particles + row / self.candidates] += value;
            }
        }
    }
}
