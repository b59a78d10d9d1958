//! The world model of DreamerV3.

mod config;
mod loss;

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

pub use config::WorldModelConfig;
pub use loss::WorldModelLoss;

use super::features::LatentFeatures;
use super::open_loop::{OpenLoopModel, actions_from};
use super::rssm::{Latent, Rssm};
use crate::env::Spec;
use crate::error::Result;
use crate::nn::kernels::sigmoid;
use crate::nn::{Grad, GroupLasso, Mlp, SymexpBins, Tensor3, device, parameters_of_fields, tensor, values, values_mut};
use crate::replay::Episode;
use crate::rng::Rng;
use crate::settings::{Ranges, must_hold};

/// Particles for each start of an open-loop prediction.
const PARTICLES: usize = 8;
/// Observations that an open-loop prediction may look at before its start, if the episode has as many.
const CONTEXT: usize = 16;

/// Encoder, RSSM, decoder, reward head and continuation head.
///
/// The world model of DreamerV3 (Hafner et al. 2023): an encoder, an [`Rssm`], and heads that predict from its latent state
/// the observation (decoder), the reward, and whether the episode continues.
///
/// ```
/// use handful::env::{Env, Task};
/// use handful::model::{RssmConfig, WorldModel, WorldModelConfig};
/// use handful::nn::{Adam, AdamConfig, tensor};
/// use handful::replay::{SequenceReplay, Transition};
/// use handful::rng;
///
/// // Thirty steps of a pendulum on which nobody acts.
/// let mut env = Task::Pendulum.make();
/// let mut replay = SequenceReplay::new(3, 1, 1000);
/// let mut obs = env.reset(0);
/// for i in 0..30 {
///     let step = env.step(&[0.0])?;
///     let next_obs = step.observation.clone();
///     let truncated = i == 29;
///     replay.push(&Transition {
///         obs, action: vec![0.0], reward: step.reward, next_obs: next_obs.clone(), terminated: false, truncated,
///     });
///     obs = next_obs;
/// }
///
/// let mut rng = rng::stream(0, "example");
/// let rssm = RssmConfig { deter: 16, blocks: 1, hidden: 16, stoch: 4, classes: 4, unimix: 0.01 };
/// let config = WorldModelConfig { rssm, units: 16, layers: 1, bins: 41, ..WorldModelConfig::default() };
/// let mut model = WorldModel::new(env.spec(), &config, &mut rng);
/// let mut optimiser = Adam::new(AdamConfig::laprop(1e-3));
/// // Four sequences of eight time steps.
/// let losses = model.learn(&replay.sample(4, 8, &mut rng), &mut optimiser, &mut rng);
/// assert_eq!(losses[0].0, "reconstruction");
///
/// // Observe once, imagine one step, and decode the observation that is predicted.
/// let action = tensor(model.device(), vec![0.0], (1, 1, 1));
/// let latent = model.observe(&model.initial(1), &action, &obs, &mut rng);
/// let imagined = model.imagine(&latent, &action, &mut rng);
/// assert_eq!(model.decode(&imagined.features()).len(), 3);
/// # Ok::<(), handful::error::Error>(())
/// ```
#[derive(Clone, Debug)]
pub struct WorldModel {
    config: WorldModelConfig,
    cpu: Cpu,
    obs_features: LatentFeatures,
    bins: SymexpBins,
    /// On the encoder's inputs; None if none is penalised.
    lasso: Option<GroupLasso>,
    encoder: Mlp,
    rssm: Rssm,
    decoder: Mlp,
    reward: Mlp,
    continuation: Mlp,
    /// Reconstructs the penalised inputs. No gradient flows from it into latent states.
    probe: Option<Mlp>,
}

parameters_of_fields!(WorldModel: encoder, rssm, decoder, reward, continuation as "continues", probe);

impl WorldModel {
    /// A new model of environments with this specification.
    ///
    /// # Errors
    /// If a setting lies outside its range, or something is wrong with the specification.
    pub fn try_new(spec: &Spec, config: &WorldModelConfig, rng: &mut Rng) -> Result<Self> {
        config.check_at("world")?;
        spec.check()?;
        Ok(Self::new(spec, config, rng))
    }

    /// The same from settings that were checked, as those of an agent are.
    ///
    /// # Panics
    /// If a setting lies outside its range.
    pub fn new(spec: &Spec, config: &WorldModelConfig, rng: &mut Rng) -> Self {
        must_hold(config, "world");
        let cpu = device();
        let hidden = vec![config.units; config.layers];
        let features = config.rssm.features();
        let obs_features = LatentFeatures::new(spec);
        let mut mlp = |input, hidden: &[usize], output| Mlp::dreamer(&cpu, input, hidden, output, rng);
        let encoder = mlp(obs_features.width(), &hidden, None);
        let decoder = mlp(features, &hidden, Some(obs_features.width()));
        let reward = mlp(features, &hidden[..1], Some(config.bins)).scale_output(0.0);
        let continuation = mlp(features, &hidden[..1], Some(1));
        let lasso = obs_features.lasso(config.lasso).map(|coefficients| GroupLasso { coefficients });
        let probe = lasso.is_some().then(|| mlp(features, &hidden[..1], Some(obs_features.width())));
        Self {
            rssm: Rssm::new(&cpu, &config.rssm, spec.action_size, config.units, rng),
            obs_features,
            bins: SymexpBins::new(config.bins, config.bin_limit),
            config: config.clone(),
            cpu,
            lasso,
            encoder,
            decoder,
            reward,
            continuation,
            probe,
        }
    }

    /// Its settings.
    pub fn config(&self) -> &WorldModelConfig {
        &self.config
    }

    /// The device that its tensors live on.
    pub fn device(&self) -> &Cpu {
        &self.cpu
    }

    /// The bins of the two-hot distributions of rewards and values.
    pub fn bins(&self) -> &SymexpBins {
        &self.bins
    }

    /// The latent state at the start of an episode, for `rows` of them.
    pub fn initial(&self, rows: usize) -> Latent {
        self.rssm.initial(rows)
    }

    /// One step with an observation: the latent state after `action` (`[1, rows, actions]`) has led to `obs`
    /// (`[rows, observation]`), drawn from the posterior. Before the first observation of an episode the action is zero.
    pub fn observe(&self, before: &Latent, action: &Tensor3, obs: &[f32], rng: &mut Rng) -> Latent {
        let token = self.encoder.forward(self.obs_features.encode(&self.cpu, obs), Grad::Input);
        self.rssm.observe(&mut NoneTape, before, action, &token, rng).0
    }

    /// One step of imagination: the latent state after `action` (`[1, rows, actions]`), drawn from the prior.
    pub fn imagine(&self, before: &Latent, action: &Tensor3, rng: &mut Rng) -> Latent {
        self.imagine_on(&mut NoneTape, before, action, rng)
    }

    /// [`WorldModel::imagine`] on a tape: gradients flow to the actions, too.
    pub fn imagine_on<T: Tape<f32, Cpu>>(
        &self,
        tape: &mut T,
        before: &Latent,
        action: &Tensor3,
        rng: &mut Rng,
    ) -> Latent {
        self.rssm.imagine(tape, before, action, rng)
    }

    /// The observations that are predicted from features `[1, rows, features]`, in physical units: `[rows, observation]`.
    pub fn decode(&self, features: &Tensor3) -> Vec<f32> {
        let mut decoded = self.decoder.forward(features.clone(), Grad::Input);
        if let Some(probe) = &self.probe {
            let probed = probe.forward(features.clone(), Grad::Input);
            let numbers = values_mut(&mut decoded).iter_mut().zip(values(&probed)).enumerate();
            let of_probe = numbers.filter(|(i, _)| self.penalised(i % self.obs_features.width()));
            of_probe.for_each(|(_, (decoded, probed))| *decoded = *probed);
        }
        self.obs_features.decode(&decoded)
    }

    /// Whether an input of the encoder is penalised by the lasso.
    fn penalised(&self, input: usize) -> bool {
        self.lasso.as_ref().is_some_and(|lasso| lasso.coefficients[input] > 0.0)
    }

    /// The proximal step of the lasso, after a gradient step.
    pub(crate) fn select_inputs(&mut self, learning_rate: f32) {
        if let Some(lasso) = &self.lasso {
            lasso.step(&mut self.encoder, learning_rate);
        }
    }

    /// The predicted rewards for arriving in latent states with these features, `[rows]`.
    pub fn rewards(&self, features: &Tensor3) -> Vec<f32> {
        self.bins.decode(&self.reward.forward(features.clone(), Grad::Input))
    }

    /// The logits of those rewards, `[1, rows, bins]`, with a gradient that flows through to the features only.
    pub fn reward_logits<T: Tape<f32, Cpu>>(&self, tape: &mut T, features: &Tensor3) -> Tensor3 {
        self.reward.on(tape, features, Grad::Input)
    }

    /// The predicted discount of the future at latent states with these features, `[rows]`: the probability that the episode
    /// continues, times the discount.
    pub fn continuations(&self, features: &Tensor3) -> Vec<f32> {
        let logits = self.continuation.forward(features.clone(), Grad::Input);
        values(&logits).iter().map(|logit| sigmoid(*logit)).collect()
    }
}

impl OpenLoopModel for WorldModel {
    fn open_loop_predictions(&self, starts: &[(&Episode, usize)], ahead: usize, rng: &mut Rng) -> Vec<Vec<f32>> {
        // Each particle draws its own latent states from the posterior, too.
        let rows: Vec<(&Episode, usize)> = starts.repeat(PARTICLES);
        let width = starts[0].0.actions[0].len();
        let mut latent = self.initial(rows.len());
        for back in (0..CONTEXT).rev() {
            // Rows whose episode has not begun yet are reset until it does.
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
            let taken = actions.iter().flat_map(|actions| &actions[k * width..][..width]).copied().collect();
            latent = self.imagine(&latent, &tensor(&self.cpu, taken, (1, rows.len(), width)), rng);
            futures.push(self.decode(&latent.features()));
        }
        futures
    }
}
