//! The simplest latent model: an autoencoder whose code moves on by a network. Everything in it is certain: it has no memory
//! and knows no chance. The step between a model of observations and an [`super::Rssm`].

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use serde::{Deserialize, Serialize};

use super::open_loop::{Episode, OpenLoopModel, actions_from};
use super::view::LatentFeatures;
use crate::env::Spec;
use crate::nn::ops::{self, record};
use crate::nn::{Adam, Grad, Mlp, Tensor3, device, parameters_of_fields, tensor};
use crate::replay::SequenceBatch;
use crate::rng::Rng;

/// Sizes of an [`Autoencoder`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AutoencoderConfig {
    /// Numbers in a code.
    pub code: usize,
    /// Width of each hidden layer of encoder, decoder and dynamics.
    pub hidden: Vec<usize>,
}

impl Default for AutoencoderConfig {
    fn default() -> Self {
        Self { code: 32, hidden: vec![128, 128] }
    }
}

/// Encoder, decoder, and the dynamics of codes: `z' = z + f(z, action)`.
#[derive(Clone, Debug)]
pub struct Autoencoder {
    cpu: Cpu,
    view: LatentFeatures,
    encoder: Mlp,
    decoder: Mlp,
    dynamics: Mlp,
}

parameters_of_fields!(Autoencoder: encoder, decoder, dynamics);

impl Autoencoder {
    /// A new model of a world.
    pub fn new(spec: &Spec, config: &AutoencoderConfig, rng: &mut Rng) -> Self {
        let cpu = device();
        let AutoencoderConfig { code, hidden } = config;
        let view = LatentFeatures::new(spec);
        let mut mlp = |input, output| Mlp::dreamer(&cpu, input, hidden, Some(output), rng);
        Self {
            encoder: mlp(view.width(), *code),
            decoder: mlp(*code, view.width()),
            // At first, nothing moves.
            dynamics: mlp(code + spec.action_size, *code).scale_output(0.0),
            view,
            cpu,
        }
    }

    /// The codes of observations, in rows: `[1, rows, code]`.
    pub fn encode(&self, obs: &[f32]) -> Tensor3 {
        self.encoder.forward(self.view.seen(&self.cpu, obs), Grad::Input)
    }

    /// The observations of codes, in rows.
    pub fn decode(&self, codes: &Tensor3) -> Vec<f32> {
        self.view.told(&self.decoder.forward(codes.clone(), Grad::Input))
    }

    /// The codes after `actions` (`[1, rows, actions]`).
    pub fn advance<T: Tape<f32, Cpu>>(&self, tape: &mut T, codes: &Tensor3, actions: &Tensor3) -> Tensor3 {
        let input = record(tape, codes, |codes| ops::join(codes, actions.clone()));
        let change = record(tape, &input, |input| self.dynamics.forward(input, Grad::Both));
        record(tape, codes, |codes| codes + change)
    }

    /// One step of learning: from the first moment of each stretch the code is led along by the actions, and must tell at
    /// every moment what was observed there. What lies behind an episode's end is not asked for. Returns the mean squared
    /// error of a moment, in the networks' units.
    pub fn learn(&mut self, batch: &SequenceBatch, optimiser: &mut Adam) -> f32 {
        let rows = batch.sequences;
        let (width, size) = (batch.actions.len() / (rows * batch.length), batch.obs.len() / (rows * batch.length));
        let at = |t: usize| self.view.seen(&self.cpu, &batch.obs[t * rows * size..][..rows * size]);
        let mut tape = OwnedTape::default();
        let mut codes = record(&mut tape, &at(0), |obs| self.encoder.forward(obs, Grad::Params));
        let mut counts = vec![1.0; rows];
        let mut losses = Vec::with_capacity(batch.length);
        for t in 0..batch.length {
            if t > 0 {
                let done = batch.actions[(t - 1) * rows * width..][..rows * width].to_vec();
                codes = self.advance(&mut tape, &codes, &tensor(&self.cpu, done, (1, rows, width)));
                let ended = batch.first[t * rows..][..rows].iter();
                counts.iter_mut().zip(ended).for_each(|(count, first)| *count *= f32::from(!first));
            }
            let told = record(&mut tape, &codes, |codes| self.decoder.forward(codes, Grad::Both));
            let seen = at(t);
            let loss = record(&mut tape, &told, |told| ops::squared_distance(told, &seen));
            let loss = record(&mut tape, &loss, |loss| ops::scale_rows(loss, &counts));
            losses.push((1.0 / batch.length as f32, loss));
        }
        let loss = ops::total(tape, &losses);
        let value = loss.array();
        optimiser.step(self, &mut loss.backward());
        value
    }
}

impl OpenLoopModel for Autoencoder {
    fn predicted(&self) -> Vec<(usize, f32)> {
        self.view.lively()
    }

    fn open_loop_predictions(&self, starts: &[(&Episode, usize)], ahead: usize, _rng: &mut Rng) -> Vec<Vec<f32>> {
        let obs: Vec<f32> = starts.iter().flat_map(|(episode, t)| episode.observations[*t].iter().copied()).collect();
        let actions: Vec<Vec<f32>> = starts.iter().map(|start| actions_from(*start, ahead).collect()).collect();
        let width = actions[0].len() / ahead;
        let mut codes = self.encode(&obs);
        let mut futures = vec![self.decode(&codes)];
        for k in 0..ahead {
            let done = actions.iter().flat_map(|actions| &actions[k * width..][..width]).copied().collect();
            codes = self.advance(&mut NoneTape, &codes, &tensor(&self.cpu, done, (1, starts.len(), width)));
            futures.push(self.decode(&codes));
        }
        futures
    }
}
