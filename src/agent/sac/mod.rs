//! Soft actor-critic, the model-free baseline. Equation numbers are those of Haarnoja et al. 2018 (arXiv:1812.05905).

mod acting;
mod backup;
mod checkpoint;
mod config;
mod hindsight;
mod inputs;

use dfdx::prelude::*;
use dfdx::tensor::Cpu;

use backup::soft_bellman_backup;
pub use config::SacConfig;
use hindsight::Hindsight;
use inputs::Inputs;

use super::decision::{Decision, Held, check_decisions};
use super::temperature::Temperature;
use super::warm_up::RandomActions;
use super::{Losses, Slots};
use crate::env::{SharedReward, Spec};
use crate::error::Result;
use crate::nn::ops;
use crate::nn::{
    Activation, Adam, AdamConfig, Grad, GroupLasso, Init, Mlp, MlpConfig, Norm, SquashedGaussian, Tensor3,
    copy_parameters, device, polyak, tensor, values,
};
use crate::replay::{Batch, ReplayBuffer};
use crate::rng::{self, Rng};
use crate::settings::Ranges;

/// The SAC agent: a policy, its critics and target critics, a temperature, and a replay buffer.
///
/// Soft actor-critic (SAC) with automatic temperature (Haarnoja et al. 2018, "Soft Actor-Critic Algorithms and
/// Applications", arXiv:1812.05905, Algorithm 1). The model-free baseline.
///
/// One update: [`Sac::learn`] samples a minibatch from the replay buffer, moves the critics towards the soft Bellman
/// target, the policy up the critics' values and its entropy, the temperature towards the target entropy, and the target
/// critics towards the critics.
///
/// Deviations: log standard deviations are squashed into [-5, 2] as in CleanRL; the temperature's loss is
/// -ln(alpha) (log pi + target) as in Stable-Baselines3; critics may have layer normalisation; observations are shifted
/// and scaled by the environment's own [`Feature`](crate::env::Feature)s, or read as latent models read them; inputs may have a
/// group lasso; truncated episodes are bootstrapped; returns may be of n steps; critics may have dropout (DroQ, which takes the
/// mean of the critics for the policy where we take the smallest); goals may be relabelled in hindsight; the policy may explore
/// with coloured noise, and may be updated less often than the critics; an action may be held for several time steps; gradients
/// may be clipped.
///
/// ```
/// use handful::prelude::*;
///
/// let mut env = Task::Pendulum.make();
/// let config = SacConfig { hidden: vec![16], warm_up: 50, batch: 16, ..SacConfig::default() };
/// let mut agent = Sac::new(env.spec(), config, 0)?;
/// let mut obs = env.reset(0);
/// agent.begin_episode();
/// for _ in 0..60 {
///     let action = agent.act(&obs, Mode::Explore);
///     let Step { observation, reward, terminated, truncated, .. } = env.step(&action)?;
///     agent.observe(&Transition { obs, action, reward, next_obs: observation.clone(), terminated, truncated });
///     if let Some(losses) = agent.update() {
///         assert!(losses["critic_loss"].is_finite() && losses["entropy"].is_finite());
///     }
///     obs = observation;
/// }
/// assert_eq!(agent.act(&obs, Mode::Evaluate).len(), 1);
/// # Ok::<(), handful::error::Error>(())
/// ```
#[doc(alias = "SAC")]
#[doc(alias = "soft actor-critic")]
pub struct Sac {
    config: SacConfig,
    cpu: Cpu,
    inputs: Inputs,
    discount: f32,
    action_size: usize,
    /// From observations to mean and log standard deviation of a squashed Gaussian.
    policy: Mlp,
    /// From observations and actions to Q; one member for each critic.
    critics: Mlp,
    /// The target network: follows the critics slowly.
    target_critics: Mlp,
    policy_optimiser: Adam,
    critic_optimiser: Adam,
    /// On the inputs of the policy, and of the critics.
    lassos: Option<[GroupLasso; 2]>,
    temperature: Temperature,
    replay: ReplayBuffer,
    hindsight: Option<Hindsight>,
    observed: usize,
    updates: usize,
    /// Coloured noise of the warm-up, and of the policy after it.
    warm_up_noise: Option<RandomActions>,
    exploration_noise: Option<RandomActions>,
    /// The action that is held, and its transitions so far.
    held: Held,
    decision: Decision,
    /// The actions held in the environments that it is evaluated in.
    slots: Slots<Held>,
    rng: Rng,
}

impl Sac {
    /// A new agent for an environment.
    ///
    /// # Errors
    /// If a setting or the spec cannot be used.
    pub fn new(spec: &Spec, config: SacConfig, seed: u64) -> Result<Self> {
        Self::with_reward(spec, None, config, seed)
    }

    /// A new agent that is given the reward as a function of observations. With [`SacConfig::hindsight`] it learns from that
    /// reward; without, it makes no use of it.
    ///
    /// # Errors
    /// As [`Sac::new`]; [`Error::Unsupported`](crate::error::Error::Unsupported) if the settings ask for hindsight where there is no goal
    /// or the reward is not known.
    pub fn with_reward(spec: &Spec, reward: Option<SharedReward>, config: SacConfig, seed: u64) -> Result<Self> {
        config.check_at("sac")?;
        spec.check()?;
        check_decisions("sac", spec, config.action_repeat, 1)?;
        let share = config.hindsight;
        let hindsight = (share > 0.0).then(|| Hindsight::new(spec, reward, share)).transpose()?;
        let cpu = device();
        let mut rng = rng::stream(seed, "sac");
        let (observation_size, action_size) = (spec.observation_size(), spec.action_size);
        let inputs = Inputs::new(spec, config.latent_features);
        let noise = |beta: Option<f64>| {
            beta.map(|beta| RandomActions::new(beta, spec.horizon / config.action_repeat, action_size))
        };
        let policy = MlpConfig {
            members: 1,
            input: inputs.width(),
            hidden: config.hidden.clone(),
            output: Some(2 * action_size),
            norm: Norm::None,
            activation: Activation::Relu,
            init: Init::Uniform,
        };
        let critics = MlpConfig {
            members: config.critics,
            input: inputs.width() + action_size,
            output: Some(1),
            norm: if config.layer_norm { Norm::Layer } else { Norm::None },
            ..policy.clone()
        };
        let lassos = inputs.lasso(config.lasso).map(|features| {
            let with_action = [&features[..], &vec![0.0; action_size]].concat();
            [features, with_action].map(|coefficients| GroupLasso { coefficients })
        });
        let policy = Mlp::new(&cpu, &policy, &mut rng);
        let critics = Mlp::new(&cpu, &critics, &mut rng);
        // A copy with tensors of its own.
        let mut target_critics = critics.clone();
        copy_parameters(&mut target_critics, &critics);
        let optimiser =
            Adam::new(AdamConfig { max_norm: config.max_gradient_norm, ..AdamConfig::new(config.learning_rate) });
        Ok(Self {
            inputs,
            lassos,
            discount: config.discount_for(spec.horizon),
            action_size,
            policy,
            critics,
            target_critics,
            policy_optimiser: optimiser.clone(),
            critic_optimiser: optimiser,
            temperature: Temperature::new(config.initial_temperature, config.temperature_rate),
            replay: ReplayBuffer::new(observation_size, action_size, config.replay),
            hindsight,
            observed: 0,
            updates: 0,
            warm_up_noise: noise(config.warm_up_noise_beta),
            exploration_noise: noise(config.exploration_noise_beta),
            held: Held::default(),
            decision: Decision::default(),
            slots: Slots::default(),
            rng,
            cpu,
            config,
        })
    }

    /// The temperature alpha: the weight of entropy against reward.
    #[doc(alias = "alpha")]
    pub fn temperature(&self) -> f32 {
        self.temperature.alpha()
    }

    /// One update on a random minibatch: of the critics and their target network, and, when it is due, of policy and
    /// temperature. Returns `critic_loss`, `q` (the critics' mean value), and of the policy `policy_loss`, `entropy` (of the
    /// actions, in nats) and `temperature`; `critic_gradient` and `policy_gradient` are norms before clipping.
    ///
    /// # Panics
    /// If no whole decision has been observed.
    #[doc(alias = "Bellman")]
    pub fn learn(&mut self) -> Losses {
        let SacConfig { batch, n_step, .. } = self.config;
        let batch = match &self.hindsight {
            None => self.replay.sample_n_step(batch, n_step, self.discount, &mut self.rng),
            Some(hindsight) => hindsight.sample(&self.replay, batch, n_step, self.discount, &mut self.rng),
        };
        let mut losses = self.update_critics(&batch);
        self.updates += 1;
        if self.updates.is_multiple_of(self.config.critic_updates_per_policy_update) {
            losses.append(&mut self.update_policy(&batch));
        }
        losses
    }

    /// The target y of the critics, `[batch]`: [`soft_bellman_backup`] with a' ~ pi(s') and the smallest of the target
    /// critics' values of (s', a'). No gradient flows into it (stop-gradient).
    #[doc(alias = "Bellman")]
    fn soft_bellman_target(&mut self, batch: &Batch) -> Vec<f32> {
        let next_obs = self.observations(&batch.next_obs);
        let head = self.policy.forward(next_obs.clone(), Grad::Input);
        let (next_action, next_log_pi) = SquashedGaussian::from_head(head).sample(self.noise(batch.size));
        let input = ops::join(next_obs, next_action);
        let q = self.target_critics.forward_with_dropout(input, Grad::Input, self.config.critic_dropout, &mut self.rng);
        let min_q = q.min::<(usize, usize), Axis<0>>().as_vec();
        soft_bellman_backup(batch, &min_q, &next_log_pi.as_vec(), self.temperature(), self.discount)
    }

    /// A step on the soft Bellman residual (equation 5), J_Q = E[(Q(s, a) - y)^2], summed over the critics (without the
    /// factor 1/2); the target network follows.
    fn update_critics(&mut self, batch: &Batch) -> Losses {
        let critics = self.config.critics;
        let y = self.soft_bellman_target(batch).repeat(critics);
        let y = tensor(&self.cpu, y, (critics, batch.size, 1));
        let actions = tensor(&self.cpu, batch.actions.clone(), (1, batch.size, self.action_size));
        let input = ops::join(self.observations(&batch.obs), actions);
        let dropout = self.config.critic_dropout;
        let q = self.critics.forward_with_dropout(input.leaky_traced(), Grad::Params, dropout, &mut self.rng);
        let mean_q = values(&q).iter().sum::<f32>() / (critics * batch.size) as f32;
        let loss = (q - y).square().mean() * critics as f32;
        let critic_loss = loss.array();
        let mut gradients = loss.backward();
        let norm = self.critic_optimiser.step(&mut self.critics, &mut gradients);
        if let Some([_, lasso]) = &self.lassos {
            lasso.step(&mut self.critics, self.config.learning_rate);
        }
        polyak(&mut self.target_critics, &self.critics, self.config.target_rate);
        Losses::from([("critic_loss", critic_loss), ("critic_gradient", norm), ("q", mean_q)])
    }

    /// A step on the policy loss (equation 9), J_pi = E[alpha log pi(a|s) - min Q(s, a)] with reparameterised actions
    /// a = tanh(mean + std * noise), and then on the temperature loss ([`Temperature::step`]).
    fn update_policy(&mut self, batch: &Batch) -> Losses {
        let obs = self.observations(&batch.obs);
        let noise = self.noise(batch.size);
        let head = self.policy.forward(obs.clone().leaky_traced(), Grad::Params);
        let (action, log_pi) = SquashedGaussian::from_head(head).sample(noise);
        let log_pis = log_pi.as_vec();
        // Gradients flow through the critics to the action, but not into the critics.
        let (action, tape) = action.split_tape();
        let input = ops::join(obs.put_tape(tape), action);
        let q = self.critics.forward_with_dropout(input, Grad::Input, self.config.critic_dropout, &mut self.rng);
        let min_q = q.min::<(usize, usize), Axis<0>>().mean();
        let loss = log_pi.mean() * self.temperature() - min_q;
        let policy_loss = loss.array();
        let mut gradients = loss.backward();
        let norm = self.policy_optimiser.step(&mut self.policy, &mut gradients);
        if let Some([lasso, _]) = &self.lassos {
            lasso.step(&mut self.policy, self.config.learning_rate);
        }

        let mean_log_pi = log_pis.iter().sum::<f32>() / log_pis.len() as f32;
        let entropy_gap = mean_log_pi + self.config.target_entropy * self.action_size as f32;
        self.temperature.step(entropy_gap);
        Losses::from([
            ("policy_loss", policy_loss),
            ("policy_gradient", norm),
            ("entropy", -mean_log_pi),
            ("temperature", self.temperature()),
        ])
    }

    /// Observations as the networks read them: `[1, rows, inputs]`.
    fn observations(&self, raw: &[f32]) -> Tensor3 {
        self.inputs.of(&self.cpu, raw)
    }

    /// Standard normal noise, `[1, rows, actions]`.
    fn noise(&mut self, rows: usize) -> Tensor3 {
        let noise = rng::normals(rows * self.action_size, &mut self.rng);
        tensor(&self.cpu, noise, (1, rows, self.action_size))
    }
}

impl std::fmt::Debug for Sac {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.debug_struct("Sac")
            .field("config", &self.config)
            .field("observed", &self.observed)
            .field("updates", &self.updates)
            .field("temperature", &self.temperature())
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests;
