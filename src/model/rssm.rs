//! The recurrent state-space model of DreamerV3 (Hafner et al. 2023): a memory that is certain, and a state that is drawn.
//!
//! The memory h carries what has happened; from it the *prior* says what the next state z may be, before anything is seen.
//! The *posterior* says it after a look at the observation. Imagination uses the prior, step after step, with its eyes
//! closed.
//!
//! Layers, sizes and initialisation follow the reference implementation. Deviation: a stretch of experience starts with
//! blank memory, where the reference stores its memory with the experience.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::nn::norm::RmsNorm;
use crate::nn::ops::{self, record};
use crate::nn::recurrent::gru;
use crate::nn::{BlockDense, Categorical, Grad, Mlp, Tensor3, parameters_of_fields, tensor, values};
use crate::rng::Rng;

/// Sizes of an [`Rssm`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RssmConfig {
    /// Numbers in the memory.
    pub deter: usize,
    /// Blocks of the memory's weights.
    pub blocks: usize,
    /// Width of the hidden layers.
    pub hidden: usize,
    /// Categorical distributions that make up the state.
    pub stoch: usize,
    /// Classes of each.
    pub classes: usize,
    /// Share of the uniform distribution in each.
    pub unimix: f32,
}

impl Default for RssmConfig {
    /// The smallest published size, `size1m`.
    fn default() -> Self {
        Self { deter: 512, blocks: 8, hidden: 64, stoch: 32, classes: 4, unimix: 0.01 }
    }
}

impl RssmConfig {
    /// # Errors
    /// If the sizes do not fit together.
    pub(crate) fn check(&self) -> Result<()> {
        if self.blocks == 0 || !self.deter.is_multiple_of(self.blocks) || self.deter == 0 {
            return Err(Error::BadSetting(format!(
                "rssm: `deter` ({}) must be a multiple of `blocks` ({})",
                self.deter, self.blocks
            )));
        }
        if self.hidden == 0 || self.stoch == 0 || self.classes < 2 || !(0.0..1.0).contains(&self.unimix) {
            return Err(Error::BadSetting(
                "rssm: `hidden` and `stoch` must be at least 1, `classes` at least 2, `unimix` in [0, 1)".into(),
            ));
        }
        Ok(())
    }

    /// Numbers in the state.
    pub fn stoch_size(&self) -> usize {
        self.stoch * self.classes
    }

    /// Numbers that memory and state give to those who read them.
    pub fn features(&self) -> usize {
        self.deter + self.stoch_size()
    }
}

/// What the model believes, for several worlds at once.
#[derive(Clone, Debug)]
pub struct Latent {
    /// The memory h, `[1, rows, memory]`.
    pub deter: Tensor3,
    /// The state z, one-hot for each categorical, `[1, rows, categoricals x classes]`.
    pub stoch: Tensor3,
}

impl Latent {
    /// Memory and state side by side, `[1, rows, features]`: what all heads read.
    pub fn features(&self) -> Tensor3 {
        ops::join(self.deter.clone(), self.stoch.clone())
    }

    /// The same belief, forgotten where `keep` is 0.
    pub fn masked<T: Tape<f32, Cpu>>(&self, tape: &mut T, keep: &[f32]) -> Self {
        Self {
            deter: record(tape, &self.deter, |deter| ops::scale_rows(deter, keep)),
            stoch: record(tape, &self.stoch, |stoch| ops::scale_rows(stoch, keep)),
        }
    }

    /// The beliefs of the last `count` rows.
    pub fn last(&self, count: usize) -> Self {
        let last = |x: &Tensor3| ops::rows(x.clone(), x.shape().1 - count, count);
        Self { deter: last(&self.deter), stoch: last(&self.stoch) }
    }

    /// The belief of one row, `times` times.
    pub fn repeated(&self, row: usize, times: usize) -> Self {
        let repeat = |x: &Tensor3| {
            let width = x.shape().2;
            tensor(x.device(), values(x)[row * width..][..width].repeat(times), (1, times, width))
        };
        Self { deter: repeat(&self.deter), stoch: repeat(&self.stoch) }
    }
}

/// The model.
#[derive(Clone, Debug)]
pub struct Rssm {
    config: RssmConfig,
    cpu: Cpu,
    from_memory: Mlp,
    from_state: Mlp,
    from_action: Mlp,
    mix: BlockDense,
    mix_norm: RmsNorm,
    gates: BlockDense,
    prior: Mlp,
    posterior: Mlp,
}

parameters_of_fields!(Rssm: from_memory, from_state, from_action, mix, mix_norm, gates, prior, posterior);

impl Rssm {
    /// A new model of worlds with so many numbers in an action, for tokens (encoded observations) of so many numbers.
    pub fn new(cpu: &Cpu, config: &RssmConfig, actions: usize, token: usize, rng: &mut Rng) -> Self {
        let RssmConfig { deter, blocks, hidden, .. } = *config;
        let stoch = config.stoch_size();
        let mut mlp = |input, layers: usize, output| Mlp::dreamer(cpu, input, &vec![hidden; layers], output, rng);
        let (from_memory, from_state) = (mlp(deter, 1, None), mlp(stoch, 1, None));
        let from_action = mlp(actions, 1, None);
        let (prior, posterior) = (mlp(deter, 2, Some(stoch)), mlp(deter + token, 1, Some(stoch)));
        Self {
            mix: BlockDense::new(cpu, blocks, deter, 3 * hidden, deter, rng),
            mix_norm: RmsNorm::new(cpu, deter),
            gates: BlockDense::new(cpu, blocks, deter, 0, 3 * deter, rng),
            config: config.clone(),
            cpu: cpu.clone(),
            from_memory,
            from_state,
            from_action,
            prior,
            posterior,
        }
    }

    /// The distributions that a state is drawn from.
    pub fn categorical(&self) -> Categorical {
        let RssmConfig { stoch: count, classes, unimix, .. } = self.config;
        Categorical { count, classes, unimix }
    }

    /// What is believed before anything has happened: nothing.
    pub fn initial(&self, rows: usize) -> Latent {
        let zeros = |width: usize| tensor(&self.cpu, vec![0.0; rows * width], (1, rows, width));
        Latent { deter: zeros(self.config.deter), stoch: zeros(self.config.stoch_size()) }
    }

    /// One step with open eyes: what is believed after `action` (`[1, rows, actions]`, each in [-1, 1]) has led to what is
    /// now seen, `token` (`[1, rows, token]`). Also the logits that the state was drawn from.
    pub fn observe<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        before: &Latent,
        action: &Tensor3,
        token: &Tensor3,
        rng: &mut Rng,
    ) -> (Latent, Tensor3) {
        let deter = self.sequence_model(tape, before, action);
        let seen = record(tape, &deter, |deter| ops::join(deter, token.clone()));
        let logits = record(tape, &seen, |seen| self.posterior.forward(seen, Grad::Both));
        let stoch = record(tape, &logits, |logits| self.categorical().sample(logits, rng));
        (Latent { deter, stoch }, logits)
    }

    /// One step with closed eyes: what is believed to come of `action`.
    pub fn imagine<T: Tape<f32, Cpu>>(&self, tape: &mut T, before: &Latent, action: &Tensor3, rng: &mut Rng) -> Latent {
        let deter = self.sequence_model(tape, before, action);
        let logits = self.prior(tape, &deter);
        let stoch = record(tape, &logits, |logits| self.categorical().sample(logits, rng));
        Latent { deter, stoch }
    }

    /// The prior's logits for the states that may come with these memories.
    pub fn prior<T: Tape<f32, Cpu>>(&self, tape: &mut T, deter: &Tensor3) -> Tensor3 {
        record(tape, deter, |deter| self.prior.forward(deter, Grad::Both))
    }

    /// The memory after an action.
    fn sequence_model<T: Tape<f32, Cpu>>(&self, tape: &mut T, before: &Latent, action: &Tensor3) -> Tensor3 {
        let memory = record(tape, &before.deter, |memory| self.from_memory.forward(memory, Grad::Both));
        let state = record(tape, &before.stoch, |state| self.from_state.forward(state, Grad::Both));
        let action = record(tape, action, |action| self.from_action.forward(action, Grad::Params));
        let happened = record(tape, &memory, |memory| ops::join(memory, state));
        let happened = record(tape, &happened, |happened| ops::join(happened, action));
        let mixed = record(tape, &before.deter, |memory| self.mix.forward(memory, Some(&happened)));
        let mixed = record(tape, &mixed, |mixed| self.mix_norm.forward(mixed));
        let gates = record(tape, &mixed, |mixed| self.gates.forward(mixed, None));
        record(tape, &gates, |gates| gru(gates, &before.deter, self.config.blocks))
    }
}
