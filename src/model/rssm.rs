//! The recurrent state-space model (RSSM) of PlaNet (Hafner et al. 2019) as DreamerV3 (Hafner et al. 2023) has it: a latent
//! state with a deterministic part h (`deter`) and a stochastic part z (`stoch`).
//!
//! ```text
//! sequence model  h_t = f(h_{t-1}, z_{t-1}, a_{t-1})
//! prior           z_t ~ p(z_t | h_t)            used in imagination, without observations
//! posterior       z_t ~ q(z_t | h_t, x_t)       used where there is an observation x_t
//! ```
//!
//! (arXiv v1, eq. 3.) Layers, sizes and initialisation follow the published code. Deviation: a replayed sequence starts with
//! a state of zeros, where the published code stores latent states in its replay buffer.
//!
//! ```
//! use handful::model::{Rssm, RssmConfig};
//! use handful::nn::dfdx::prelude::NoneTape;
//! use handful::nn::{device, tensor};
//!
//! // Actions of 2 numbers; encoded observations ("tokens") of 5.
//! let config = RssmConfig { deter: 16, blocks: 2, hidden: 8, stoch: 4, classes: 4, unimix: 0.01 };
//! let mut rng = handful::rng::stream(0, "example");
//! let rssm = Rssm::new(&device(), &config, 2, 5, &mut rng);
//! let action = tensor(&device(), vec![0.5, -0.5], (1, 1, 2));
//! let token = tensor(&device(), vec![0.1; 5], (1, 1, 5));
//! // One step with an observation, then one without.
//! let (seen, _posterior) = rssm.observe(&mut NoneTape, &rssm.initial(1), &action, &token, &mut rng);
//! let imagined = rssm.imagine(&mut NoneTape, &seen, &action, &mut rng);
//! assert_eq!(imagined.rows(), 1);
//! assert_eq!(config.features(), 16 + 4 * 4);
//! ```

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use serde::{Deserialize, Serialize};

use crate::nn::norm::RmsNorm;
use crate::nn::recurrent::gru;
use crate::nn::{BlockDense, Categorical, Grad, Mlp, TapeOps, Tensor3, ops, parameters_of_fields, tensor, values};
use crate::rng::Rng;
use crate::settings::{fits, must_hold, ranges};

/// Sizes of an [`Rssm`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RssmConfig {
    /// Dimension of the deterministic state h.
    #[doc(alias = "recurrent state")]
    pub deter: usize,
    /// Diagonal blocks in the weights of the sequence model; they must divide `deter`.
    pub blocks: usize,
    /// Units of every hidden layer.
    pub hidden: usize,
    /// Categorical variables that make up the stochastic state z.
    pub stoch: usize,
    /// Classes of each variable.
    pub classes: usize,
    /// Share of the uniform distribution in the probabilities of each variable.
    pub unimix: f32,
}

impl Default for RssmConfig {
    /// The smallest published size, `size1m`.
    fn default() -> Self {
        Self { deter: 512, blocks: 8, hidden: 64, stoch: 32, classes: 4, unimix: 0.01 }
    }
}

ranges!(RssmConfig {
    deter: 1..=16_384,
    blocks: 1..=16_384,
    hidden: 1..=4096,
    stoch: 1..=1024,
    classes: 2..=1024,
    unimix: 0.0..=0.999,
}
require deter.is_multiple_of(*blocks) => "`deter` must be a multiple of `blocks`";
require fits(&[3, *deter, deter / blocks]) => "`deter` times `deter / blocks` are too many weights";
require fits(&[*hidden, 3 * deter + stoch * classes]) => "`hidden` times the numbers of a latent state are too many weights";
);

impl RssmConfig {
    /// Dimension of the stochastic state, `stoch x classes`.
    pub fn stoch_size(&self) -> usize {
        self.stoch * self.classes
    }

    /// Dimension of the features that the heads read: deterministic and stochastic state side by side.
    pub fn features(&self) -> usize {
        self.deter + self.stoch_size()
    }
}

/// Latent states of several environments or sequences at once, one in each row.
#[derive(Clone, Debug)]
pub struct Latent {
    /// The deterministic state h, `[1, rows, deter]`.
    #[doc(alias = "deterministic state")]
    pub deter: Tensor3,
    /// The stochastic state z, one-hot for each categorical variable, `[1, rows, stoch x classes]`.
    #[doc(alias = "stochastic state")]
    pub stoch: Tensor3,
}

impl Latent {
    /// How many latent states there are.
    pub fn rows(&self) -> usize {
        self.deter.shape().1
    }

    /// Both parts side by side, `[1, rows, features]`: what all heads read.
    pub fn features(&self) -> Tensor3 {
        ops::join(self.deter.clone(), self.stoch.clone())
    }

    /// Each row times `keep`: rows where it is 0 are reset to the initial state.
    pub fn masked<T: Tape<f32, Cpu>>(&self, tape: &mut T, keep: &[f32]) -> Self {
        Self { deter: tape.scale_rows(&self.deter, keep), stoch: tape.scale_rows(&self.stoch, keep) }
    }

    /// The last `count` rows.
    pub fn last(&self, count: usize) -> Self {
        let last = |x: &Tensor3| ops::rows(x.clone(), x.shape().1 - count, count);
        Self { deter: last(&self.deter), stoch: last(&self.stoch) }
    }

    /// One row, `times` times.
    pub fn repeated(&self, row: usize, times: usize) -> Self {
        let repeat = |x: &Tensor3| {
            let width = x.shape().2;
            tensor(x.device(), values(x)[row * width..][..width].repeat(times), (1, times, width))
        };
        Self { deter: repeat(&self.deter), stoch: repeat(&self.stoch) }
    }
}

/// The recurrent state-space model: sequence model, prior and posterior.
#[doc(alias = "recurrent state-space model")]
#[derive(Clone, Debug)]
pub struct Rssm {
    config: RssmConfig,
    cpu: Cpu,
    deter_in: Mlp,
    stoch_in: Mlp,
    action_in: Mlp,
    hidden: BlockDense,
    hidden_norm: RmsNorm,
    gates: BlockDense,
    prior: Mlp,
    posterior: Mlp,
}

parameters_of_fields!(
    Rssm: deter_in as "from_memory", stoch_in as "from_state", action_in as "from_action", hidden as "mix",
    hidden_norm as "mix_norm", gates, prior, posterior
);

impl Rssm {
    /// A new model for actions of dimension `actions` and encoded observations of dimension `token`.
    ///
    /// # Panics
    /// If a setting lies outside its range.
    pub fn new(cpu: &Cpu, config: &RssmConfig, actions: usize, token: usize, rng: &mut Rng) -> Self {
        must_hold(config, "rssm");
        let RssmConfig { deter, blocks, hidden, .. } = *config;
        let stoch = config.stoch_size();
        let mut mlp = |input, layers: usize, output| Mlp::dreamer(cpu, input, &vec![hidden; layers], output, rng);
        let (deter_in, stoch_in, action_in) = (mlp(deter, 1, None), mlp(stoch, 1, None), mlp(actions, 1, None));
        let (prior, posterior) = (mlp(deter, 2, Some(stoch)), mlp(deter + token, 1, Some(stoch)));
        Self {
            hidden: BlockDense::new(cpu, blocks, deter, 3 * hidden, deter, rng),
            hidden_norm: RmsNorm::new(cpu, deter),
            gates: BlockDense::new(cpu, blocks, deter, 0, 3 * deter, rng),
            config: config.clone(),
            cpu: cpu.clone(),
            deter_in,
            stoch_in,
            action_in,
            prior,
            posterior,
        }
    }

    /// The categorical variables of the stochastic state.
    pub fn categorical(&self) -> Categorical {
        let RssmConfig { stoch: count, classes, unimix, .. } = self.config;
        Categorical { count, classes, unimix }
    }

    /// The latent state at the start of an episode: zeros.
    pub fn initial(&self, rows: usize) -> Latent {
        let zeros = |width: usize| tensor(&self.cpu, vec![0.0; rows * width], (1, rows, width));
        Latent { deter: zeros(self.config.deter), stoch: zeros(self.config.stoch_size()) }
    }

    /// One step with an observation: the latent state after `action` (`[1, rows, actions]`, each component in [-1, 1]) has led
    /// to the encoded observation `token` (`[1, rows, token]`), drawn from the posterior. Also the posterior's logits.
    pub fn observe<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        before: &Latent,
        action: &Tensor3,
        token: &Tensor3,
        rng: &mut Rng,
    ) -> (Latent, Tensor3) {
        let deter = self.sequence_model(tape, before, action);
        let posterior = self.posterior(tape, &deter, token);
        let stoch = self.categorical().sample(tape, &posterior, rng);
        (Latent { deter, stoch }, posterior)
    }

    /// One step of imagination: the latent state after `action`, drawn from the prior.
    pub fn imagine<T: Tape<f32, Cpu>>(&self, tape: &mut T, before: &Latent, action: &Tensor3, rng: &mut Rng) -> Latent {
        let deter = self.sequence_model(tape, before, action);
        let prior = self.prior(tape, &deter);
        let stoch = self.categorical().sample(tape, &prior, rng);
        Latent { deter, stoch }
    }

    /// The prior p(z | h): logits `[1, rows, stoch x classes]` for deterministic states.
    #[doc(alias = "dynamics predictor")]
    pub fn prior<T: Tape<f32, Cpu>>(&self, tape: &mut T, deter: &Tensor3) -> Tensor3 {
        self.prior.on(tape, deter, Grad::Both)
    }

    /// The posterior q(z | h, x): logits `[1, rows, stoch x classes]` for deterministic states and encoded observations.
    #[doc(alias = "representation model")]
    pub fn posterior<T: Tape<f32, Cpu>>(&self, tape: &mut T, deter: &Tensor3, token: &Tensor3) -> Tensor3 {
        let joined = tape.join(deter, token);
        self.posterior.on(tape, &joined, Grad::Both)
    }

    /// The sequence model h' = f(h, z, a): a block GRU, whose gates read state and action through one hidden layer.
    fn sequence_model<T: Tape<f32, Cpu>>(&self, tape: &mut T, before: &Latent, action: &Tensor3) -> Tensor3 {
        let deter = self.deter_in.on(tape, &before.deter, Grad::Both);
        let stoch = self.stoch_in.on(tape, &before.stoch, Grad::Both);
        let action = self.action_in.on(tape, action, Grad::Both);
        let inputs = tape.join(&deter, &stoch);
        let inputs = tape.join(&inputs, &action);
        let hidden = self.hidden.on(tape, &before.deter, Some(&inputs));
        let hidden = self.hidden_norm.on(tape, &hidden);
        let gates = self.gates.on(tape, &hidden, None);
        gru(tape, &gates, &before.deter, self.config.blocks)
    }
}
