//! A decoder for diagnostics: what the latent states of a decoder-free model know of the observation.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use super::ImplicitModel;
use crate::model::open_loop::{OpenLoopModel, actions_from};
use crate::nn::{Grad, Mlp, TapeOps, Tensor3, parameters_of_fields, tensor};
use crate::replay::Episode;
use crate::rng::Rng;

/// Reconstructs observations from the latent states of an [`ImplicitModel`], for replays and diagnostics. It is fitted to latent
/// states as they are: no gradient flows from it into the model, and nothing is decided by it.
#[derive(Clone, Debug)]
pub struct Probe {
    network: Mlp,
}

parameters_of_fields!(Probe: network);

impl Probe {
    /// A new probe for a model's latent states, with one hidden layer.
    pub fn new(model: &ImplicitModel, rng: &mut Rng) -> Self {
        let (latent, units) = (model.config().latent, model.config().units);
        Self { network: Mlp::tdmpc(model.device(), 1, latent, &[units], Some(model.features().width()), rng) }
    }

    /// The squared error of each reconstruction, `[1, rows, 1]`, from latent states `[1, rows, latent]` of observations
    /// (`[rows, observation]`, physical units).
    pub fn loss<T: Tape<f32, Cpu>>(&self, tape: &mut T, model: &ImplicitModel, z: &Tensor3, obs: &[f32]) -> Tensor3 {
        let outputs = self.network.on(tape, z, Grad::Params);
        tape.squared_distance(&outputs, &model.features().encode(model.device(), obs))
    }

    /// The observations (`[rows, observation]`, physical units) of latent states `[1, rows, latent]`.
    pub fn decode(&self, model: &ImplicitModel, z: &Tensor3) -> Vec<f32> {
        model.features().decode(&self.network.forward(z.clone(), Grad::Input))
    }

    /// The observations along action sequences (`[rows, horizon, actions]`) from latent states `[1, rows, latent]`: `horizon + 1`
    /// arrays `[rows, observation]`.
    pub fn rollout(&self, model: &ImplicitModel, z: &Tensor3, sequences: &[f32], horizon: usize) -> Vec<Vec<f32>> {
        let rows = z.shape().1;
        let size = sequences.len() / (rows * horizon);
        let mut z = z.clone();
        let mut futures = vec![self.decode(model, &z)];
        for t in 0..horizon {
            let taken = sequences.chunks_exact(horizon * size).flat_map(|row| &row[t * size..][..size]).copied();
            z = model.next(&mut NoneTape, &z, &tensor(model.device(), taken.collect(), (1, rows, size)));
            futures.push(self.decode(model, &z));
        }
        futures
    }
}

/// A model that predicts observations by its probe.
#[derive(Clone, Copy, Debug)]
pub struct Probed<'a> {
    /// The model.
    pub model: &'a ImplicitModel,
    /// Its probe.
    pub probe: &'a Probe,
}

impl OpenLoopModel for Probed<'_> {
    fn open_loop_predictions(&self, starts: &[(&Episode, usize)], horizon: usize, _rng: &mut Rng) -> Vec<Vec<f32>> {
        let obs: Vec<f32> = starts.iter().flat_map(|(episode, t)| episode.observations[*t].iter().copied()).collect();
        let actions: Vec<f32> = starts.iter().flat_map(|start| actions_from(*start, horizon)).collect();
        self.probe.rollout(self.model, &self.model.encode(&obs), &actions, horizon)
    }
}
