//! The implicit world model of TD-MPC2 (Hansen et al. 2024, section 3.1): latent states that predict rewards, values and their
//! own future, and nothing else. There is no decoder: what does not matter for the return need not be represented.
//!
//! ```text
//! encoder          z  = h(o)
//! latent dynamics  z' = d(z, a)
//! reward           r  = R(z, a)
//! values           q  = Q_i(z, a),  i = 1 ... `critics`
//! policy prior     a  ~ p(z)
//! ```
//!
//! Every hidden layer has layer normalisation and Mish; latent states are simplices ([`sim_norm`]); rewards and values are
//! two-hot regressions ([`SymlogBins`]). Deviations: no dropout in the first layer of Q (0.01 in the published code); the dynamics may
//! predict changes ([`ImplicitConfig::residual`]).
//!
//! ```
//! use handful::env::{Env, Task};
//! use handful::model::{ImplicitConfig, ImplicitModel};
//! use handful::nn::dfdx::prelude::NoneTape;
//! use handful::nn::{tensor, values};
//! use handful::rng;
//!
//! let mut env = Task::Pendulum.make();
//! let model = ImplicitModel::new(env.spec(), &ImplicitConfig::default(), &mut rng::stream(0, "example"));
//! let z = model.encode(&env.reset(0));
//! let action = tensor(model.device(), vec![0.5], (1, 1, 1));
//! let next = model.next(&mut NoneTape, &z, &action);
//! assert_eq!(values(&next).len(), 64);
//! assert_eq!(model.rewards(&z, &action), [0.0]);
//! ```

mod config;
mod frozen;
mod loss;
mod policy;
mod probe;

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

pub use config::ImplicitConfig;
pub(crate) use frozen::FrozenModel;
pub use loss::{ImplicitLoss, step_weights};
pub use policy::{EntropyBonus, PolicyPrior};
pub use probe::{Probe, Probed};

use super::features::LatentFeatures;
use crate::env::Spec;
use crate::error::Result;
use crate::nn::simnorm::sim_norm;
use crate::nn::{Activation, Grad, GroupLasso, Mlp, SymlogBins, TapeOps, Tensor3, device, parameters_of_fields};
use crate::rng::Rng;
use crate::settings::{Ranges, must_hold};

/// What residual latent dynamics take for numbers of a latent state below it, which could not grow again.
const SMALLEST: f32 = 1e-6;

/// Encoder, latent dynamics, reward head, an ensemble of Q functions, and the head that says when the task ends.
#[doc(alias = "TD-MPC2")]
#[doc(alias = "TOLD")]
#[derive(Clone, Debug)]
pub struct ImplicitModel {
    config: ImplicitConfig,
    cpu: Cpu,
    features: LatentFeatures,
    bins: SymlogBins,
    encoder: Mlp,
    dynamics: Mlp,
    reward: Mlp,
    critics: Mlp,
    termination: Option<Mlp>,
}

parameters_of_fields!(ImplicitModel: encoder, dynamics, reward, critics, termination);

impl ImplicitModel {
    /// A new model of environments with this specification. At first it predicts rewards and values of zero.
    ///
    /// # Errors
    /// If a setting lies outside its range, or something is wrong with the specification.
    pub fn try_new(spec: &Spec, config: &ImplicitConfig, rng: &mut Rng) -> Result<Self> {
        config.check_at("model")?;
        spec.check()?;
        Ok(Self::new(spec, config, rng))
    }

    /// The same from settings that were checked, as those of an agent are.
    ///
    /// # Panics
    /// If a setting lies outside its range.
    pub fn new(spec: &Spec, config: &ImplicitConfig, rng: &mut Rng) -> Self {
        must_hold(config, "model");
        let cpu = device();
        let ImplicitConfig { latent, units, bins, .. } = *config;
        let features = LatentFeatures::new(spec);
        let mut mlp = |members, input, hidden: &[usize], output| Mlp::tdmpc(&cpu, members, input, hidden, output, rng);
        let (hidden, state_action) = ([units; 2], latent + spec.action_size);
        // The last layers of encoder and dynamics are normalised, too; SimNorm takes the place of their activation.
        let encoder = mlp(1, features.width(), &[config.encoder, latent], None).ending_in(Activation::Identity);
        let dynamics = if config.residual {
            mlp(1, state_action, &hidden, Some(latent)).scale_output(0.0)
        } else {
            mlp(1, state_action, &[units, units, latent], None).ending_in(Activation::Identity)
        };
        let reward = mlp(1, state_action, &hidden, Some(bins)).scale_output(0.0);
        let critics = mlp(config.critics, state_action, &hidden, Some(bins)).scale_output(0.0);
        let termination = config.terminates.then(|| mlp(1, latent, &hidden, Some(1)));
        let bins = SymlogBins::new(bins, config.bin_limit);
        Self { config: config.clone(), features, bins, encoder, dynamics, reward, critics, termination, cpu }
    }

    /// Its settings.
    pub fn config(&self) -> &ImplicitConfig {
        &self.config
    }

    /// The device that its tensors live on.
    pub fn device(&self) -> &Cpu {
        &self.cpu
    }

    /// The bins of the two-hot distributions of rewards and values.
    pub fn bins(&self) -> &SymlogBins {
        &self.bins
    }

    /// The features of observations that it reads.
    pub fn features(&self) -> &LatentFeatures {
        &self.features
    }

    /// The proximal step of a [`GroupLasso`] on the encoder's inputs except differences, after a gradient step.
    pub(crate) fn select_inputs(&mut self, learning_rate: f32, coefficient: f32) {
        if let Some(coefficients) = self.features.lasso(coefficient) {
            GroupLasso { coefficients }.step(&mut self.encoder, learning_rate);
        }
    }

    /// The ensemble of Q functions: from `[z, a]` to logits `[critics, rows, bins]`.
    pub fn critics(&self) -> &Mlp {
        &self.critics
    }

    /// The latent states of observations (`[rows, observation]`, physical units): `[1, rows, latent]`.
    pub fn encode(&self, obs: &[f32]) -> Tensor3 {
        self.encode_on(&mut NoneTape, obs)
    }

    /// [`ImplicitModel::encode`] with a gradient for the encoder.
    pub fn encode_on<T: Tape<f32, Cpu>>(&self, tape: &mut T, obs: &[f32]) -> Tensor3 {
        let inputs = self.features.encode(&self.cpu, obs);
        let z = self.encoder.on(tape, &inputs, Grad::Params);
        tape.record(&z, |z| sim_norm(z, self.config.group))
    }

    /// The latent states after actions `[1, rows, actions]` in `z`, `[1, rows, latent]`.
    pub fn next<T: Tape<f32, Cpu>>(&self, tape: &mut T, z: &Tensor3, actions: &Tensor3) -> Tensor3 {
        let inputs = tape.join(z, actions);
        let ahead = self.dynamics.on(tape, &inputs, Grad::Both);
        tape.record(&ahead, |ahead| {
            let (ahead, tape) = ahead.split_tape();
            let logits = if self.config.residual {
                z.clone().put_tape(tape).clamp(SMALLEST, 1.0).ln() + ahead
            } else {
                ahead.put_tape(tape)
            };
            sim_norm(logits, self.config.group)
        })
    }

    /// The predicted rewards of actions `[1, rows, actions]` in `z`: `[rows]`.
    pub fn rewards(&self, z: &Tensor3, actions: &Tensor3) -> Vec<f32> {
        let inputs = NoneTape.join(z, actions);
        self.bins.decode(&self.reward.forward(inputs, Grad::Input))
    }

    /// The values of actions `[1, rows, actions]` in `z` under some critics, `[members, rows]`: those of the model, or of its
    /// target network.
    pub fn values(&self, critics: &Mlp, z: &Tensor3, actions: &Tensor3) -> Vec<f32> {
        let inputs = NoneTape.join(z, actions);
        self.bins.decode(&critics.forward(inputs, Grad::Input))
    }
}

#[cfg(test)]
mod tests;
