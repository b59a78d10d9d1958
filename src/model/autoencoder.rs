//! The simplest latent model: an autoencoder with a network that predicts the next code. It is deterministic, and has no
//! recurrent state: the step between a model of observations and an [`super::Rssm`].

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use serde::{Deserialize, Serialize};

use super::features::LatentFeatures;
use super::open_loop::{OpenLoopModel, actions_from};
use crate::env::Spec;
use crate::nn::{Adam, Grad, Mlp, TapeOps, Tensor3, device, ops, parameters_of_fields, tensor};
use crate::replay::{Episode, SequenceBatch};
use crate::rng::Rng;

/// Sizes of an [`Autoencoder`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AutoencoderConfig {
    /// Dimension of a code, the latent state.
    pub code: usize,
    /// Width of each hidden layer of encoder, decoder and dynamics.
    pub hidden: Vec<usize>,
}

impl Default for AutoencoderConfig {
    fn default() -> Self {
        Self { code: 32, hidden: vec![128, 128] }
    }
}

/// Encoder `z = e(x)`, decoder `x = d(z)`, and latent dynamics `z' = z + f(z, action)`.
#[derive(Clone, Debug)]
pub struct Autoencoder {
    cpu: Cpu,
    obs_features: LatentFeatures,
    encoder: Mlp,
    decoder: Mlp,
    dynamics: Mlp,
}

parameters_of_fields!(Autoencoder: encoder, decoder, dynamics);

impl Autoencoder {
    /// A new model of environments with this specification.
    pub fn new(spec: &Spec, config: &AutoencoderConfig, rng: &mut Rng) -> Self {
        let cpu = device();
        let AutoencoderConfig { code, hidden } = config;
        let obs_features = LatentFeatures::new(spec);
        let mut mlp = |input, output| Mlp::dreamer(&cpu, input, hidden, Some(output), rng);
        Self {
            encoder: mlp(obs_features.width(), *code),
            decoder: mlp(*code, obs_features.width()),
            // At first it predicts that nothing moves.
            dynamics: mlp(code + spec.action_size, *code).scale_output(0.0),
            obs_features,
            cpu,
        }
    }

    /// The codes `[1, rows, code]` of observations `[rows, observation]`.
    pub fn encode(&self, obs: &[f32]) -> Tensor3 {
        self.encoder.forward(self.obs_features.encode(&self.cpu, obs), Grad::Input)
    }

    /// The observations `[rows, observation]` of codes `[1, rows, code]`, in physical units.
    pub fn decode(&self, codes: &Tensor3) -> Vec<f32> {
        self.obs_features.decode(&self.decoder.forward(codes.clone(), Grad::Input))
    }

    /// The predicted codes after `actions` (`[1, rows, actions]`).
    pub fn advance<T: Tape<f32, Cpu>>(&self, tape: &mut T, codes: &Tensor3, actions: &Tensor3) -> Tensor3 {
        let input = tape.join(codes, actions);
        let change = self.dynamics.on(tape, &input, Grad::Both);
        tape.record(codes, |codes| codes + change)
    }

    /// One update: the first observation of each sequence is encoded, the latent dynamics predict all later codes open loop,
    /// and the loss is the squared error of what the decoder makes of them, up to the end of the episode. Returns the mean
    /// over time steps, in the networks' units.
    pub fn learn(&mut self, batch: &SequenceBatch, optimiser: &mut Adam) -> f32 {
        let rows = batch.sequences;
        let (width, size) = (batch.actions.len() / (rows * batch.length), batch.obs.len() / (rows * batch.length));
        let at = |t: usize| self.obs_features.encode(&self.cpu, &batch.obs[t * rows * size..][..rows * size]);
        let mut tape = OwnedTape::default();
        let mut codes = self.encoder.on(&mut tape, &at(0), Grad::Params);
        let mut counts = vec![1.0; rows];
        let mut losses = Vec::with_capacity(batch.length);
        for t in 0..batch.length {
            if t > 0 {
                let actions = batch.actions[(t - 1) * rows * width..][..rows * width].to_vec();
                codes = self.advance(&mut tape, &codes, &tensor(&self.cpu, actions, (1, rows, width)));
                let ended = batch.first[t * rows..][..rows].iter();
                counts.iter_mut().zip(ended).for_each(|(count, first)| *count *= f32::from(!first));
            }
            let decoded = self.decoder.on(&mut tape, &codes, Grad::Both);
            let loss = tape.squared_distance(&decoded, &at(t));
            let loss = tape.scale_rows(&loss, &counts);
            losses.push((1.0 / batch.length as f32, loss));
        }
        let loss = ops::total(tape, &losses);
        let value = loss.array();
        optimiser.step(self, &mut loss.backward());
        value
    }
}

impl OpenLoopModel for Autoencoder {
    fn open_loop_predictions(&self, starts: &[(&Episode, usize)], ahead: usize, _rng: &mut Rng) -> Vec<Vec<f32>> {
        let obs: Vec<f32> = starts.iter().flat_map(|(episode, t)| episode.observations[*t].iter().copied()).collect();
        let actions: Vec<Vec<f32>> = starts.iter().map(|start| actions_from(*start, ahead).collect()).collect();
        let width = actions[0].len() / ahead;
        let mut codes = self.encode(&obs);
        let mut futures = vec![self.decode(&codes)];
        for k in 0..ahead {
            let taken = actions.iter().flat_map(|actions| &actions[k * width..][..width]).copied().collect();
            codes = self.advance(&mut NoneTape, &codes, &tensor(&self.cpu, taken, (1, starts.len(), width)));
            futures.push(self.decode(&codes));
        }
        futures
    }
}
