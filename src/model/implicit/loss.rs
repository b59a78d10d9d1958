//! The model's losses on slices of experience (Hansen et al. 2024, section 3.1, "Model objective").

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use super::{ImplicitConfig, ImplicitModel};
use crate::nn::{Grad, TapeOps, Tensor3, tensor, values};
use crate::replay::SequenceBatch;

/// The losses along a rollout of H steps, `[1, H x sequences, 1]` each, step after step; the weights `decay^t` are in.
#[derive(Clone, Debug)]
pub struct ImplicitLoss {
    /// Squared distance of rolled-out latent states from encoded ones, mean over their numbers.
    pub consistency: Tensor3,
    /// Cross-entropy of the rewards.
    pub reward: Tensor3,
    /// Cross-entropy of the values, mean over the critics.
    pub value: Tensor3,
    /// Cross-entropy of the ends of the task, if the model learns them; not weighted by `decay^t`.
    pub termination: Option<Tensor3>,
    /// The latent states of the rollout, H + 1 of `[1, sequences, latent]`.
    pub latents: Vec<Tensor3>,
}

impl ImplicitLoss {
    /// The losses with their weights: what [`total`](crate::nn::ops::total) sums up.
    pub fn weighted(&self, config: &ImplicitConfig) -> Vec<(f32, Tensor3)> {
        let mut all = vec![
            (config.consistency, self.consistency.clone()),
            (config.reward, self.reward.clone()),
            (config.value, self.value.clone()),
        ];
        all.extend(self.termination.iter().map(|loss| (1.0, loss.clone())));
        all
    }

    /// Squared distance of the rollouts' last latent states from the encoded ones, as a fraction of the squared distance that the latter
    /// have moved from the start: 0 is perfect, 1 is as good as predicting no change. Unlike the loss it does not fall when latent states
    /// collapse.
    pub fn drift(&self, encoded: &Tensor3) -> f32 {
        let (Some(first), Some(last)) = (self.latents.first(), self.latents.last()) else { return 0.0 };
        let truth = &values(encoded)[values(encoded).len() - values(last).len()..];
        let squares =
            |from: &Tensor3| values(from).iter().zip(truth).map(|(z, truth)| (z - truth).powi(2)).sum::<f32>();
        squares(last) / squares(first).max(f32::MIN_POSITIVE)
    }
}

/// The weights `decay^t` of `steps` time steps of `sequences` rows each, `[steps x sequences]`.
pub fn step_weights(decay: f32, steps: usize, sequences: usize) -> Vec<f32> {
    (0..steps as i32).flat_map(|t| std::iter::repeat_n(decay.powi(t), sequences)).collect()
}

impl ImplicitModel {
    /// The losses on slices of H + 1 time steps, each within an episode:
    ///
    /// ```text
    /// z_0 = h(o_0),  z_t+1 = d(z_t, a_t)
    /// L = 1/H sum_t decay^t [ 20 |z_t+1 - sg(h(o_t+1))|^2 / D + 0.1 CE(R(z_t, a_t), r_t) + 0.1 CE(Q_i(z_t, a_t), y_t) ]
    /// ```
    ///
    /// averaged over the critics Q_i, with the default weights; the cross-entropy of the task's ends, if learned, is added.
    ///
    /// `encoded` are the latent states of the last H observations, sg(h(o_t+1)), `[1, H x sequences, latent]`, and `targets` the
    /// value targets y_t, `[H x sequences]`. Gradients flow through the whole rollout.
    pub fn loss<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        batch: &SequenceBatch,
        encoded: &Tensor3,
        targets: &[f32],
    ) -> ImplicitLoss {
        let (sequences, steps) = (batch.sequences, batch.length - 1);
        let obs_size = batch.obs.len() / (sequences * batch.length);
        let action_size = batch.actions.len() / (sequences * batch.length);
        let actions_of = |from: usize, count: usize| {
            let numbers = &batch.actions[from * sequences * action_size..][..count * sequences * action_size];
            tensor(self.device(), numbers.to_vec(), (1, count * sequences, action_size))
        };
        // The rollout.
        let mut latents = vec![self.encode_on(tape, &batch.obs[..sequences * obs_size])];
        for t in 0..steps {
            latents.push(self.next(tape, &latents[t], &actions_of(t, 1)));
        }
        let weights = step_weights(self.config.decay, steps, sequences);
        let ahead = tape.stack(&latents[1..]);
        // Consistency: the mean over a latent state's numbers is their sum, scaled.
        let distance = tape.squared_distance(&ahead, encoded);
        let share = 1.0 / self.config.latent as f32;
        let consistency = tape.scale_rows(&distance, &weights.iter().map(|w| share * w).collect::<Vec<f32>>());
        // Reward and values at rolled-out latent states.
        let state = tape.stack(&latents[..steps]);
        let inputs = tape.join(&state, &actions_of(0, steps));
        let logits = self.reward.on(tape, &inputs, Grad::Both);
        // A time step of the batch holds the reward for arriving there.
        let reward = self.bins.loss(tape, &logits, &batch.rewards[sequences..]);
        let logits = self.critics.on(tape, &inputs, Grad::Both);
        let of_members = self.bins.loss(tape, &logits, targets);
        let value = tape.mean_of_members(&of_members);
        ImplicitLoss {
            consistency,
            reward: tape.scale_rows(&reward, &weights),
            value: tape.scale_rows(&value, &weights),
            termination: self.termination.as_ref().map(|head| {
                let logits = head.on(tape, &ahead, Grad::Both);
                tape.binary_cross_entropy(&logits, |row| f32::from(batch.terminal[sequences + row]))
            }),
            latents,
        }
    }
}
