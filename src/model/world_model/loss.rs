//! The world model's loss, and the pass over a batch of sequences that it is computed on.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use super::{WorldModel, WorldModelConfig};
use crate::model::Latent;
use crate::nn::ops::{self, mean};
use crate::nn::{Adam, Grad, TapeOps, Tensor3, tensor, values};
use crate::replay::SequenceBatch;
use crate::rng::Rng;

/// The loss of a [`WorldModel`] on a batch of sequences, term by term (Hafner et al. 2023, arXiv v1, eq. 4 and 5). As in the
/// published code, it is a mean over time steps, where eq. 4 has their sum.
///
/// Each term is `[1, length x sequences, 1]`: its value at each time step, rows as in [`SequenceBatch`], not yet weighted.
#[derive(Clone, Debug)]
pub struct WorldModelLoss {
    /// The squared error of the decoded observation, summed over its numbers, in the networks' units (symlog and scaled);
    /// without the factor 1/2 of eq. 1, as in the published code. Without the numbers that the probe reconstructs.
    pub reconstruction: Tensor3,
    /// The same for the probe, if there is one ([`WorldModelConfig::lasso`]).
    pub probe: Option<Tensor3>,
    /// The cross-entropy of the reward's two-hot distribution. At the first time step of an episode its target is 0, as in
    /// the published code, although a sequence that begins within an episode starts from the same blank state with a reward.
    /// Nothing reads the prediction there: imagined returns begin with the reward of the next state.
    pub reward: Tensor3,
    /// The binary cross-entropy of the continuation, whose target is the discount, or 0 where the task ended.
    pub continuation: Tensor3,
    /// `max(free nats, KL[sg(posterior) || prior])`.
    pub dynamics: Tensor3,
    /// `max(free nats, KL[posterior || sg(prior)])`.
    pub representation: Tensor3,
    /// The weights of the five terms, in this order.
    weights: [f32; 5],
    /// The latent state at each time step, drawn from the posterior.
    pub latent: Latent,
    /// The features of those states, through which gradients flow back: `[1, length x sequences, features]`.
    pub features: Tensor3,
    /// Mean entropy of the posterior, in nats.
    pub posterior_entropy: f32,
    /// Mean entropy of the prior, in nats.
    pub prior_entropy: f32,
}

impl WorldModelLoss {
    fn terms(&self) -> [(&'static str, &Tensor3); 5] {
        [
            ("reconstruction", &self.reconstruction),
            ("reward", &self.reward),
            ("continue", &self.continuation),
            ("dynamics", &self.dynamics),
            ("representation", &self.representation),
        ]
    }

    /// The terms with their weights from [`WorldModelConfig`]: what [`ops::total`] sums up.
    pub fn weighted(&self) -> Vec<(f32, Tensor3)> {
        let terms = self.weights.into_iter().zip(self.terms()).map(|(weight, (_, term))| (weight, term));
        terms.chain(self.probe.iter().map(|loss| (1.0, loss))).map(|(weight, term)| (weight, term.clone())).collect()
    }

    /// The mean of each term over the batch, not weighted, under the name that logs use.
    pub fn means(&self) -> [(&'static str, f32); 5] {
        self.terms().map(|(name, term)| (name, mean(term)))
    }
}

impl WorldModel {
    /// The loss on a batch of sequences, recorded on `tape` (Hafner et al. 2023, arXiv v1, eq. 5).
    pub fn loss<T: Tape<f32, Cpu>>(&self, tape: &mut T, batch: &SequenceBatch, rng: &mut Rng) -> WorldModelLoss {
        let WorldModelConfig { free_nats, reconstruction, dynamics, representation, .. } = self.config;
        let weights = [reconstruction, 1.0, 1.0, dynamics, representation];
        let obs = self.obs_features.encode(&self.cpu, &batch.obs);
        let (latent, posterior) = self.observe_sequence(tape, batch, &obs, rng);
        let prior = self.rssm.prior(tape, &latent.deter);
        let features = tape.join(&latent.deter, &latent.stoch);

        let decoded = self.decoder.on(tape, &features, Grad::Both);
        let reconstruction = self.reconstruction(tape, &decoded, &obs, false);
        let probe = self.probe.as_ref().map(|probe| {
            let probed = probe.on(tape, &features, Grad::Params);
            self.reconstruction(tape, &probed, &obs, true)
        });
        let reward_logits = self.reward.on(tape, &features, Grad::Both);
        let reward = self.bins.loss(tape, &reward_logits, &[&batch.rewards]);
        let continuation_logits = self.continuation.on(tape, &features, Grad::Both);
        let discount = self.config.discount();
        let continues = |row: usize| if batch.terminal[row] { 0.0 } else { discount };
        let continuation = tape.binary_cross_entropy(&continuation_logits, continues);
        let z = self.rssm.categorical();
        let dynamics = z.dynamics_kl(tape, &posterior, &prior, free_nats);
        let representation = z.representation_kl(tape, &posterior, &prior, free_nats);
        let mean_entropy = |logits| {
            let entropies = z.entropies(logits);
            entropies.iter().sum::<f32>() / entropies.len() as f32
        };
        WorldModelLoss {
            posterior_entropy: mean_entropy(&posterior),
            prior_entropy: mean_entropy(&prior),
            reconstruction,
            probe,
            reward,
            continuation,
            dynamics,
            representation,
            weights,
            latent,
            features,
        }
    }

    /// The squared error of decoded observations, over the inputs that are `penalised` by the lasso, or over the others.
    fn reconstruction<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        decoded: &Tensor3,
        obs: &Tensor3,
        penalised: bool,
    ) -> Tensor3 {
        let (obs, width) = (values(obs), self.obs_features.width());
        tape.rowwise(decoded, |row, decoded, slope| {
            let mut squares = 0.0;
            for i in (0..width).filter(|i| self.penalised(*i) == penalised) {
                let error = decoded[i] - obs[row * width + i];
                slope[i] = 2.0 * error;
                squares += error * error;
            }
            squares
        })
    }

    /// One update of the world model alone, without actor and critic. Returns the mean of each term of the loss.
    pub fn learn(&mut self, batch: &SequenceBatch, optimiser: &mut Adam, rng: &mut Rng) -> [(&'static str, f32); 5] {
        let mut tape = OwnedTape::default();
        let loss = self.loss(&mut tape, batch, rng);
        optimiser.step(self, &mut ops::total(tape, &loss.weighted()).backward());
        self.select_inputs(optimiser.learning_rate());
        loss.means()
    }

    /// The latent state at each time step of a batch, rows as in [`SequenceBatch`], and the posterior's logits. `obs` are
    /// the observations as the networks read them.
    fn observe_sequence<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        batch: &SequenceBatch,
        obs: &Tensor3,
        rng: &mut Rng,
    ) -> (Latent, Tensor3) {
        let rows = batch.sequences;
        let tokens = self.encoder.on(tape, obs, Grad::Params);
        let width = batch.actions.len() / (rows * batch.length);
        let mut latent = self.rssm.initial(rows);
        // The action that led to a time step was taken at the one before.
        let mut action = vec![0.0; rows * width];
        let (mut deters, mut stochs, mut posteriors) = (Vec::new(), Vec::new(), Vec::new());
        for t in 0..batch.length {
            let first = &batch.first[t * rows..][..rows];
            if t > 0 && first.contains(&true) {
                let keep: Vec<f32> = first.iter().map(|first| f32::from(!first)).collect();
                latent = latent.masked(tape, &keep);
                action.chunks_exact_mut(width).zip(&keep).for_each(|(action, keep)| {
                    action.iter_mut().for_each(|a| *a *= keep);
                });
            }
            let previous_action = tensor(&self.cpu, std::mem::take(&mut action), (1, rows, width));
            let token = tape.rows(&tokens, t * rows, rows);
            let (next, posterior) = self.rssm.observe(tape, &latent, &previous_action, &token, rng);
            deters.push(next.deter.clone());
            stochs.push(next.stoch.clone());
            posteriors.push(posterior);
            latent = next;
            action = batch.actions[t * rows * width..][..rows * width].iter().map(|a| a.clamp(-1.0, 1.0)).collect();
        }
        (Latent { deter: tape.stack(&deters), stoch: tape.stack(&stochs) }, tape.stack(&posteriors))
    }
}
