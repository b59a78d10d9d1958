//! A latent world model: an [`Rssm`] between an encoder that looks and heads that tell, from what is believed, what would
//! be observed, which reward was received, and whether the episode goes on.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use serde::{Deserialize, Serialize};

use super::open_loop::{Episode, OpenLoopModel, actions_from};
use super::rssm::{Latent, Rssm, RssmConfig};
use super::view::LatentFeatures;
use crate::env::Spec;
use crate::error::{Error, Result};
use crate::nn::categorical::Side;
use crate::nn::kernels::{sigmoid, softplus};
use crate::nn::ops::{self, mean, record};
use crate::nn::{Adam, Grad, Mlp, SymexpBins, Tensor3, device, parameters_of_fields, tensor, values};
use crate::replay::SequenceBatch;
use crate::rng::Rng;

/// ImaginedReturns of each start when the model is judged.
const PARTICLES: usize = 8;
/// When it is judged, the model has looked at so many moments before it closes its eyes, if there were so many.
const CONTEXT: usize = 16;

/// Settings of a [`WorldModel`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WorldModelConfig {
    /// The recurrent core.
    pub rssm: RssmConfig,
    /// Width of encoder, decoder and heads.
    pub units: usize,
    /// Hidden layers of encoder and decoder.
    pub layers: usize,
    /// Bins of the rewards' distribution.
    pub bins: usize,
    /// The bins reach to symexp of this.
    pub bin_limit: f64,
    /// Nats by which the posterior may differ from the prior for nothing.
    pub free_nats: f32,
    /// Weight of the loss that has the state tell what was observed. More than 1 buys precision in small things.
    pub reconstruction: f32,
    /// Weight of the loss that teaches the prior what the posterior says.
    pub dynamics: f32,
    /// Weight of the loss that keeps the posterior predictable.
    pub representation: f32,
    /// The future is discounted by 1 - 1/`discount_horizon` a step; the head that foresees an episode's end learns that
    /// along.
    pub discount_horizon: f32,
}

impl Default for WorldModelConfig {
    /// The smallest published size, `size1m`.
    fn default() -> Self {
        Self {
            rssm: RssmConfig::default(),
            units: 64,
            layers: 3,
            bins: 255,
            bin_limit: 20.0,
            free_nats: 1.0,
            reconstruction: 1.0,
            dynamics: 1.0,
            representation: 0.1,
            discount_horizon: 333.0,
        }
    }
}

impl WorldModelConfig {
    /// # Errors
    /// If a setting cannot be used.
    pub(crate) fn check(&self) -> Result<()> {
        self.rssm.check()?;
        if self.units == 0 || self.layers == 0 || self.bins < 3 || self.bins.is_multiple_of(2) {
            return Err(Error::BadSetting(
                "world model: `units` and `layers` must be at least 1, `bins` odd and at least 3".into(),
            ));
        }
        if self.discount_horizon <= 1.0 {
            return Err(Error::BadSetting("world model: `discount_horizon` must be more than 1".into()));
        }
        Ok(())
    }

    /// The discount of a step.
    pub fn discount(&self) -> f32 {
        1.0 - 1.0 / self.discount_horizon
    }
}

/// The model of a world.
#[derive(Clone, Debug)]
pub struct WorldModel {
    config: WorldModelConfig,
    cpu: Cpu,
    view: LatentFeatures,
    bins: SymexpBins,
    encoder: Mlp,
    rssm: Rssm,
    decoder: Mlp,
    reward: Mlp,
    continues: Mlp,
}

parameters_of_fields!(WorldModel: encoder, rssm, decoder, reward, continues);

/// What a world model says of a batch of experience, and how wrong it was.
pub struct WorldModelLoss {
    /// What it believed at each moment, rows as in [`SequenceBatch`].
    pub latent: Latent,
    /// The features of those beliefs, on the way of the gradients: `[1, length x sequences, features]`.
    pub features: Tensor3,
    /// Each loss: its name, its weight, and its value at each moment, `[1, length x sequences, 1]`.
    pub losses: Vec<(&'static str, f32, Tensor3)>,
    /// Mean entropy of the posterior and of the prior, nats.
    pub entropies: [f32; 2],
}

impl WorldModel {
    /// A new model of a world.
    pub fn new(spec: &Spec, config: &WorldModelConfig, rng: &mut Rng) -> Self {
        let cpu = device();
        let hidden = vec![config.units; config.layers];
        let features = config.rssm.features();
        let view = LatentFeatures::new(spec);
        let mut mlp = |input, hidden: &[usize], output| Mlp::dreamer(&cpu, input, hidden, output, rng);
        let encoder = mlp(view.width(), &hidden, None);
        let decoder = mlp(features, &hidden, Some(view.width()));
        let reward = mlp(features, &hidden[..1], Some(config.bins)).scale_output(0.0);
        let continues = mlp(features, &hidden[..1], Some(1));
        Self {
            rssm: Rssm::new(&cpu, &config.rssm, spec.action_size, config.units, rng),
            view,
            bins: SymexpBins::new(config.bins, config.bin_limit),
            config: config.clone(),
            cpu,
            encoder,
            decoder,
            reward,
            continues,
        }
    }

    /// Its settings.
    pub fn config(&self) -> &WorldModelConfig {
        &self.config
    }

    /// Where its tensors live.
    pub fn device(&self) -> &Cpu {
        &self.cpu
    }

    /// The bins of rewards and values.
    pub fn bins(&self) -> &SymexpBins {
        &self.bins
    }

    /// What is believed before anything has been seen.
    pub fn initial(&self, rows: usize) -> Latent {
        self.rssm.initial(rows)
    }

    /// What is believed after `action` (`[1, rows, actions]`) has led to `obs`, in rows.
    pub fn observe(&self, before: &Latent, action: &Tensor3, obs: &[f32], rng: &mut Rng) -> Latent {
        let token = self.encoder.forward(self.view.seen(&self.cpu, obs), Grad::Input);
        self.rssm.observe(&mut NoneTape, before, action, &token, rng).0
    }

    /// What is believed to come of `action`.
    pub fn imagine(&self, before: &Latent, action: &Tensor3, rng: &mut Rng) -> Latent {
        self.rssm.imagine(&mut NoneTape, before, action, rng)
    }

    /// The observations that go with features, in physical units, row by row.
    pub fn decode(&self, features: &Tensor3) -> Vec<f32> {
        self.view.told(&self.decoder.forward(features.clone(), Grad::Input))
    }

    /// The rewards for having arrived where the features say.
    pub fn rewards(&self, features: &Tensor3) -> Vec<f32> {
        self.bins.read(&self.reward.forward(features.clone(), Grad::Input))
    }

    /// How much the future counts there: the chance that the episode goes on, times the discount.
    pub fn continues(&self, features: &Tensor3) -> Vec<f32> {
        let logits = self.continues.forward(features.clone(), Grad::Input);
        values(&logits).iter().map(|logit| sigmoid(*logit)).collect()
    }

    /// How wrong the model is about a batch of experience; everything is recorded on `tape`.
    pub fn loss<T: Tape<f32, Cpu>>(&self, tape: &mut T, batch: &SequenceBatch, rng: &mut Rng) -> WorldModelLoss {
        let seen = self.view.seen(&self.cpu, &batch.obs);
        let (latent, logits) = self.observe_sequence(tape, batch, &seen, rng);
        let expected = self.rssm.prior(tape, &latent.deter);
        let features = record(tape, &latent.deter, |memory| ops::join(memory, latent.stoch.clone()));

        let told = record(tape, &features, |features| self.decoder.forward(features, Grad::Both));
        let reconstruction = record(tape, &told, |told| ops::squared_distance(told, &seen));
        let reward = record(tape, &features, |features| {
            self.bins.loss(self.reward.forward(features, Grad::Both), &[&batch.rewards])
        });
        let continues = record(tape, &features, |features| {
            let logits = self.continues.forward(features, Grad::Both);
            ops::rowwise(logits, |row, logit, slope| {
                let target = if batch.terminal[row] { 0.0 } else { self.config.discount() };
                slope[0] = sigmoid(logit[0]) - target;
                softplus(logit[0]) - target * logit[0]
            })
        });
        let (categorical, free) = (self.rssm.categorical(), self.config.free_nats);
        let dynamics =
            record(tape, &expected, |expected| categorical.divergence(Side::Second, expected, &logits, free));
        let representation =
            record(tape, &logits, |logits| categorical.divergence(Side::First, logits, &expected, free));
        let mean_entropy = |logits| {
            let entropies = categorical.entropies(logits);
            entropies.iter().sum::<f32>() / entropies.len() as f32
        };
        WorldModelLoss {
            entropies: [mean_entropy(&logits), mean_entropy(&expected)],
            losses: vec![
                ("reconstruction", self.config.reconstruction, reconstruction),
                ("reward", 1.0, reward),
                ("continue", 1.0, continues),
                ("dynamics", self.config.dynamics, dynamics),
                ("representation", self.config.representation, representation),
            ],
            latent,
            features,
        }
    }

    /// One step of learning by itself, without actor and critic. Returns the mean of each loss.
    pub fn learn(&mut self, batch: &SequenceBatch, optimiser: &mut Adam, rng: &mut Rng) -> Vec<(&'static str, f32)> {
        let mut tape = OwnedTape::default();
        let loss = self.loss(&mut tape, batch, rng);
        let means = loss.losses.iter().map(|(name, _, loss)| (*name, mean(loss))).collect();
        let losses: Vec<_> = loss.losses.into_iter().map(|(_, weight, loss)| (weight, loss)).collect();
        optimiser.step(self, &mut ops::total(tape, &losses).backward());
        means
    }

    /// What is believed at each moment of a batch, moments one after the other, and the posterior's logits.
    fn observe_sequence<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        batch: &SequenceBatch,
        seen: &Tensor3,
        rng: &mut Rng,
    ) -> (Latent, Tensor3) {
        let rows = batch.sequences;
        let tokens = record(tape, seen, |seen| self.encoder.forward(seen, Grad::Params));
        let width = batch.actions.len() / (rows * batch.length);
        let mut latent = self.rssm.initial(rows);
        // What led to a moment was done at the one before.
        let mut action = vec![0.0; rows * width];
        let (mut deters, mut stochs, mut all_logits) = (Vec::new(), Vec::new(), Vec::new());
        for t in 0..batch.length {
            let first = &batch.first[t * rows..][..rows];
            if t > 0 && first.contains(&true) {
                let keep: Vec<f32> = first.iter().map(|first| f32::from(!first)).collect();
                latent = latent.masked(tape, &keep);
                action.chunks_exact_mut(width).zip(&keep).for_each(|(action, keep)| {
                    action.iter_mut().for_each(|a| *a *= keep);
                });
            }
            let done = tensor(&self.cpu, std::mem::take(&mut action), (1, rows, width));
            let token = record(tape, &tokens, |tokens| ops::rows(tokens, t * rows, rows));
            let (next, logits) = self.rssm.observe(tape, &latent, &done, &token, rng);
            deters.push(next.deter.clone());
            stochs.push(next.stoch.clone());
            all_logits.push(logits);
            latent = next;
            action = batch.actions[t * rows * width..][..rows * width].iter().map(|a| a.clamp(-1.0, 1.0)).collect();
        }
        let mut stack = |parts: &[Tensor3]| {
            let (stacked, recorded) = ops::stack(std::mem::take(tape), parts).split_tape();
            *tape = recorded;
            stacked
        };
        (Latent { deter: stack(&deters), stoch: stack(&stochs) }, stack(&all_logits))
    }
}

impl OpenLoopModel for WorldModel {
    fn predicted(&self) -> Vec<(usize, f32)> {
        self.view.lively()
    }

    fn open_loop_predictions(&self, starts: &[(&Episode, usize)], ahead: usize, rng: &mut Rng) -> Vec<Vec<f32>> {
        // Each particle looks back on its own: what is believed is drawn too.
        let rows: Vec<(&Episode, usize)> = starts.repeat(PARTICLES);
        let width = starts[0].0.actions[0].len();
        let mut latent = self.initial(rows.len());
        for back in (0..CONTEXT).rev() {
            // Those whose episode has not begun yet wait, and forget what they have seen while they did.
            let begun = |t: usize| t.checked_sub(back);
            let keep: Vec<f32> = rows.iter().map(|(_, t)| f32::from(begun(*t).is_some_and(|now| now > 0))).collect();
            let before = latent.masked(&mut NoneTape, &keep);
            let actions = rows.iter().flat_map(|(episode, t)| match begun(*t) {
                Some(now) if now > 0 => episode.actions[now - 1].clone(),
                _ => vec![0.0; width],
            });
            let actions = tensor(&self.cpu, actions.collect(), (1, rows.len(), width));
            let obs: Vec<f32> = rows
                .iter()
                .flat_map(|(episode, t)| episode.observations[begun(*t).unwrap_or(0)].iter().copied())
                .collect();
            latent = self.observe(&before, &actions, &obs, rng);
        }
        let actions: Vec<Vec<f32>> = rows.iter().map(|start| actions_from(*start, ahead).collect()).collect();
        let mut futures = vec![self.decode(&latent.features())];
        for k in 0..ahead {
            let done = actions.iter().flat_map(|actions| &actions[k * width..][..width]).copied().collect();
            latent = self.imagine(&latent, &tensor(&self.cpu, done, (1, rows.len(), width)), rng);
            futures.push(self.decode(&latent.features()));
        }
        futures
    }
}
