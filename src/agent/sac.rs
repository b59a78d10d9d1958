//! Soft actor-critic with automatic temperature (Haarnoja et al. 2018, "Algorithms and Applications").
//!
//! The model-free baseline, made strong: critics may be normalised (which lets them learn several
//! times from every step), the squashed Gaussian is computed in its stable form, and ends by the
//! clock are bootstrapped.
//!
//! Deviations: log standard deviations are squashed into [-5, 2] as in CleanRL; the temperature's
//! loss is -log(alpha) (log pi + target) as in Stable-Baselines3; observations are shifted and scaled
//! by the environment's own [`crate::env::Feature`]s.

use dfdx::prelude::*;
use dfdx::tensor::Cpu;
use serde::{Deserialize, Serialize};

use super::{Agent, Checkpoint, Diagnostics, Losses, Mode, Slot, ValueEstimate};
use crate::env::Spec;
use crate::error::{Error, Result};
use crate::model::open_loop::Episode;
use crate::nn::ops;
use crate::nn::{
    Activation, Adam, AdamConfig, Grad, Init, Mlp, MlpConfig, Norm, SquashedGaussian, Tensor3, Weights, adam_step,
    copy_parameters, device, polyak, tensor, values,
};
use crate::replay::{Batch, ReplayBuffer, Transition};
use crate::rng::{self, Rng};

/// Scaled observations are clamped to this.
const MAX_INPUT: f32 = 10.0;

/// Settings of [`Sac`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SacConfig {
    /// Width of each hidden layer of policy and critics.
    pub hidden: Vec<usize>,
    /// Whether the critics' hidden layers are normalised.
    pub layer_norm: bool,
    /// Critics; the smallest of their values counts.
    pub critics: usize,
    /// Step size of policy and critics.
    pub learning_rate: f32,
    /// Step size of the temperature.
    pub temperature_rate: f32,
    /// Temperature at the start.
    pub initial_temperature: f32,
    /// The entropy aimed at, for each number of an action.
    pub target_entropy: f32,
    /// Transitions in a minibatch.
    pub batch: usize,
    /// Discount of the future, per step.
    pub discount: f32,
    /// How fast the target critics follow, per update.
    pub polyak: f32,
    /// Transitions remembered.
    pub replay: usize,
    /// Random steps before the first update.
    pub warm_up: usize,
    /// Critic updates for each step.
    pub updates_per_step: usize,
    /// Critic updates for each update of policy and temperature.
    pub critic_updates_per_policy_update: usize,
    /// Gradients with a larger norm are scaled down to it.
    pub max_gradient_norm: Option<f32>,
}

impl Default for SacConfig {
    fn default() -> Self {
        Self {
            hidden: vec![256, 256],
            layer_norm: false,
            critics: 2,
            learning_rate: 3e-4,
            temperature_rate: 3e-4,
            initial_temperature: 1.0,
            target_entropy: -1.0,
            batch: 256,
            discount: 0.99,
            polyak: 0.005,
            replay: 1_000_000,
            warm_up: 1000,
            updates_per_step: 1,
            critic_updates_per_policy_update: 1,
            max_gradient_norm: None,
        }
    }
}

/// Policy, critics, and the experience that they learn from.
pub struct Sac {
    config: SacConfig,
    cpu: Cpu,
    centre: Vec<f32>,
    scale: Vec<f32>,
    actions: usize,
    policy: Mlp,
    critics: Mlp,
    targets: Mlp,
    policy_optimiser: Adam,
    critic_optimiser: Adam,
    /// Logarithm of the temperature, with its own Adam moments.
    temperature: Temperature,
    replay: ReplayBuffer,
    observed: usize,
    updates: usize,
    rng: Rng,
}

impl Sac {
    /// A fresh agent for an environment.
    ///
    /// # Errors
    /// If a setting cannot be used.
    pub fn new(spec: &Spec, config: SacConfig, seed: u64) -> Result<Self> {
        config.check()?;
        spec.check()?;
        let cpu = device();
        let mut rng = rng::stream(seed, "sac");
        let (observations, actions) = (spec.observation_size(), spec.action_size);
        let policy = MlpConfig {
            members: 1,
            input: observations,
            hidden: config.hidden.clone(),
            output: Some(2 * actions),
            norm: Norm::None,
            activation: Activation::Relu,
            init: Init::Uniform,
        };
        let critics = MlpConfig {
            members: config.critics,
            input: observations + actions,
            output: Some(1),
            norm: if config.layer_norm { Norm::Layer } else { Norm::None },
            ..policy.clone()
        };
        let policy = Mlp::new(&cpu, &policy, &mut rng);
        let critics = Mlp::new(&cpu, &critics, &mut rng);
        // A copy with tensors of its own.
        let mut targets = critics.clone();
        copy_parameters(&mut targets, &critics);
        let optimiser =
            Adam::new(AdamConfig { max_norm: config.max_gradient_norm, ..AdamConfig::new(config.learning_rate) });
        Ok(Self {
            centre: spec.observation.iter().map(|feature| feature.centre).collect(),
            scale: spec.observation.iter().map(|feature| feature.scale).collect(),
            actions,
            policy,
            critics,
            targets,
            policy_optimiser: optimiser.clone(),
            critic_optimiser: optimiser,
            temperature: Temperature::new(config.initial_temperature, config.temperature_rate),
            replay: ReplayBuffer::new(observations, actions, config.replay),
            observed: 0,
            updates: 0,
            rng,
            cpu,
            config,
        })
    }

    /// The temperature: how much entropy is worth.
    pub fn temperature(&self) -> f32 {
        self.temperature.log.exp()
    }

    /// One critic update on a random minibatch, and a policy update when it is due.
    pub fn learn(&mut self) -> Losses {
        let batch = self.replay.sample(self.config.batch, &mut self.rng);
        let mut losses = self.update_critics(&batch);
        self.updates += 1;
        if self.updates.is_multiple_of(self.config.critic_updates_per_policy_update) {
            losses.append(&mut self.update_policy(&batch));
        }
        losses
    }

    /// What the critics should say of a batch.
    fn targets(&mut self, batch: &Batch) -> Vec<f32> {
        let next = self.observations(&batch.next_obs);
        let head = self.policy.forward(next.clone(), Grad::Input);
        let (action, log_density) = SquashedGaussian::from_head(head).sample(self.noise(batch.size));
        let q = self.targets.forward(ops::join(next, action), Grad::Input);
        let q = q.min::<(usize, usize), Axis<0>>().as_vec();
        soft_targets(batch, &q, &log_density.as_vec(), self.temperature(), self.config.discount)
    }

    fn update_critics(&mut self, batch: &Batch) -> Losses {
        let critics = self.config.critics;
        let targets = self.targets(batch).repeat(critics);
        let targets = tensor(&self.cpu, targets, (critics, batch.size, 1));
        let actions = tensor(&self.cpu, batch.actions.clone(), (1, batch.size, self.actions));
        let input = ops::join(self.observations(&batch.obs), actions);
        let q = self.critics.forward(input.leaky_traced(), Grad::Params);
        let mean_q = values(&q).iter().sum::<f32>() / (critics * batch.size) as f32;
        // The mean over the batch, summed over the critics.
        let loss = (q - targets).square().mean() * critics as f32;
        let critic_loss = loss.array();
        let mut gradients = loss.backward();
        let norm = self.critic_optimiser.step(&mut self.critics, &mut gradients);
        polyak(&mut self.targets, &self.critics, self.config.polyak);
        Losses::from([("critic_loss", critic_loss), ("critic_gradient", norm), ("q", mean_q)])
    }

    fn update_policy(&mut self, batch: &Batch) -> Losses {
        let obs = self.observations(&batch.obs);
        let noise = self.noise(batch.size);
        let head = self.policy.forward(obs.clone().leaky_traced(), Grad::Params);
        let (action, log_density) = SquashedGaussian::from_head(head).sample(noise);
        let log_densities = log_density.as_vec();
        // The critics judge; they do not learn from it.
        let (action, tape) = action.split_tape();
        let q = self.critics.forward(ops::join(obs.put_tape(tape), action), Grad::Input);
        let q = q.min::<(usize, usize), Axis<0>>().mean();
        let loss = log_density.mean() * self.temperature() - q;
        let policy_loss = loss.array();
        let mut gradients = loss.backward();
        let norm = self.policy_optimiser.step(&mut self.policy, &mut gradients);

        let mean_log_density = log_densities.iter().sum::<f32>() / log_densities.len() as f32;
        self.temperature.step(mean_log_density + self.config.target_entropy * self.actions as f32);
        Losses::from([
            ("policy_loss", policy_loss),
            ("policy_gradient", norm),
            ("entropy", -mean_log_density),
            ("temperature", self.temperature()),
        ])
    }

    /// The policy's best action for each row of observations.
    fn modes(&self, observations: &[f32]) -> Vec<Vec<f32>> {
        let head = self.policy.forward(self.observations(observations), Grad::Input);
        let actions = SquashedGaussian::from_head(head).mode();
        values(&actions).chunks(self.actions).map(<[f32]>::to_vec).collect()
    }

    /// Observations as the networks see them, `[1, rows, observation]`.
    fn observations(&self, raw: &[f32]) -> Tensor3 {
        let size = self.centre.len();
        let features = || self.centre.iter().zip(&self.scale);
        let mut scaled = Vec::with_capacity(raw.len());
        for row in raw.chunks_exact(size) {
            // A cube on the floor is far enough away; networks need not see how far.
            let row = row.iter().zip(features());
            scaled.extend(row.map(|(x, (centre, scale))| ((x - centre) / scale).clamp(-MAX_INPUT, MAX_INPUT)));
        }
        tensor(&self.cpu, scaled, (1, raw.len() / size, size))
    }

    fn noise(&mut self, rows: usize) -> Tensor3 {
        let noise = (0..rows * self.actions).map(|_| rng::normal(&mut self.rng) as f32).collect();
        tensor(&self.cpu, noise, (1, rows, self.actions))
    }
}

impl Agent for Sac {
    fn act(&mut self, obs: &[f32], mode: Mode) -> Vec<f32> {
        if mode == Mode::Evaluate {
            return self.modes(obs).remove(0);
        }
        if self.observed < self.config.warm_up {
            return (0..self.actions).map(|_| rng::uniform(&mut self.rng, -1.0, 1.0) as f32).collect();
        }
        let head = self.policy.forward(self.observations(obs), Grad::Input);
        let noise = self.noise(1);
        let (action, _) = SquashedGaussian::from_head(head).sample(noise);
        values(&action).to_vec()
    }

    fn act_batch(&mut self, slots: &[Slot]) -> Vec<Vec<f32>> {
        let observations: Vec<&[f32]> = slots.iter().map(|slot| slot.obs).collect();
        self.modes(&observations.concat())
    }

    fn observe(&mut self, transition: &Transition) {
        self.replay.push(transition);
        self.observed += 1;
    }

    fn update(&mut self) -> Option<Losses> {
        if self.observed < self.config.warm_up {
            return None;
        }
        // Inside the thread pool, or every parallel piece of an update would be handed over to it anew.
        rayon::scope(|_| (0..self.config.updates_per_step).map(|_| self.learn()).last())
    }
}

impl Diagnostics for Sac {
    fn value_estimates(&self, episodes: &[Episode]) -> Vec<ValueEstimate> {
        let of_episode = |episode: &Episode| {
            let observations = episode.observations.concat();
            let actions = self.modes(&observations).concat();
            let actions = tensor(&self.cpu, actions, (1, episode.observations.len(), self.actions));
            let q = self.critics.forward(ops::join(self.observations(&observations), actions), Grad::Input);
            let values = q.min::<(usize, usize), Axis<0>>().as_vec();
            ValueEstimate::of_episode(&values, episode, self.config.discount)
        };
        episodes.iter().flat_map(of_episode).collect()
    }
}

impl Checkpoint for Sac {
    fn weights(&self) -> Weights {
        let mut weights = Weights::default();
        weights.insert_module("policy", &self.policy);
        weights.insert_module("critics", &self.critics);
        weights.insert_module("targets", &self.targets);
        weights.insert("temperature", vec![self.temperature.log], [1, 1, 1]);
        weights
    }

    fn load_weights(&mut self, weights: &Weights) -> Result<()> {
        let log = weights.get("temperature", [1, 1, 1])?[0];
        weights.load_module("policy", &mut self.policy)?;
        weights.load_module("critics", &mut self.critics)?;
        weights.load_module("targets", &mut self.targets)?;
        self.temperature.log = log;
        Ok(())
    }

    fn training_state(&self) -> Weights {
        let mut state = Weights::default();
        self.policy_optimiser.save(&mut state, "policy");
        self.critic_optimiser.save(&mut state, "critics");
        self.replay.save(&mut state, "replay");
        state.insert_counts("counts", &[self.observed as u64, self.updates as u64]);
        state.insert_counts("rng", &rng::state(&self.rng));
        let Temperature { moments: [first, second], steps, .. } = self.temperature;
        state.insert("temperature", vec![first, second, steps as f32], [1, 1, 3]);
        state
    }

    fn load_training_state(&mut self, state: &Weights) -> Result<()> {
        let counts = state.counts("counts", 2)?;
        let rng = rng::from_state(&state.counts("rng", 4)?);
        let temperature = state.get("temperature", [1, 1, 3])?;
        self.policy_optimiser.load(state, "policy", &self.policy)?;
        self.critic_optimiser.load(state, "critics", &self.critics)?;
        self.replay.load(state, "replay")?;
        self.temperature.moments = [temperature[0], temperature[1]];
        self.temperature.steps = temperature[2] as i32;
        self.observed = counts[0] as usize;
        self.updates = counts[1] as usize;
        self.rng = rng;
        Ok(())
    }
}

/// y = r + discount (1 - terminated) (q - temperature log pi), where q is the smallest of the target critics'
/// values of the next action, and log pi that action's log-density. An end by the clock is no end.
fn soft_targets(batch: &Batch, q: &[f32], log_density: &[f32], temperature: f32, discount: f32) -> Vec<f32> {
    let future = q.iter().zip(log_density).map(|(q, log)| q - temperature * log);
    let steps = batch.rewards.iter().zip(&batch.terminated).zip(future);
    steps.map(|((r, end), future)| r + discount * (1.0 - end) * future).collect()
}

/// One number that learns by Adam: the logarithm of the temperature.
#[derive(Clone, Copy, Debug)]
struct Temperature {
    log: f32,
    rate: f32,
    moments: [f32; 2],
    steps: i32,
}

impl Temperature {
    fn new(start: f32, rate: f32) -> Self {
        Self { log: start.ln(), rate, moments: [0.0; 2], steps: 0 }
    }

    /// A step on the loss -log(alpha) * entropy_gap, whose gradient is -entropy_gap, where
    /// entropy_gap = mean(log pi) + target entropy: too little entropy raises the temperature.
    fn step(&mut self, entropy_gap: f32) {
        let gradient = -entropy_gap;
        self.steps += 1;
        let corrections = [0.9_f32, 0.999].map(|beta| 1.0 - beta.powi(self.steps));
        let unbiased = |[m, v]: [f32; 2]| [m / corrections[0], v / corrections[1]];
        let [m, v] = adam_step(gradient, self.moments.each_mut(), [0.1, 0.001], unbiased);
        self.log -= self.rate * m / (v.sqrt() + 1e-8);
    }
}

impl SacConfig {
    fn check(&self) -> Result<()> {
        let positive = [
            ("critics", self.critics),
            ("batch", self.batch),
            ("replay", self.replay),
            ("critic_updates_per_policy_update", self.critic_updates_per_policy_update),
        ];
        for (name, value) in positive {
            if value == 0 {
                return Err(Error::BadSetting(format!("sac: `{name}` must be at least 1")));
            }
        }
        if self.hidden.is_empty() || self.hidden.contains(&0) {
            return Err(Error::BadSetting("sac: `hidden` must name at least one layer, each at least 1 wide".into()));
        }
        if !(0.0..=1.0).contains(&self.discount) || !(0.0..=1.0).contains(&self.polyak) {
            return Err(Error::BadSetting("sac: `discount` and `polyak` must lie in [0, 1]".into()));
        }
        if self.initial_temperature.is_nan() || self.initial_temperature <= 0.0 {
            return Err(Error::BadSetting("sac: `initial_temperature` must be positive".into()));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn targets_bootstrap_unless_the_task_ended() {
        let batch = Batch { size: 2, rewards: vec![1.0, -0.5], terminated: vec![0.0, 1.0], ..Batch::default() };
        let y = soft_targets(&batch, &[4.5, 2.0], &[-0.8, 1.2], 0.2, 0.99);
        assert!((y[0] - 5.6134).abs() < 1e-6 && (y[1] + 0.5).abs() < 1e-6, "{y:?}");
    }

    #[test]
    fn too_much_entropy_cools() {
        let log_densities = [2.259_301, -0.8, 0.5, 1.0_f32];
        let mean = log_densities.iter().sum::<f32>() / 4.0;
        let mut temperature = Temperature::new(1.0, 3e-4);
        temperature.step(mean - 2.0);
        assert!((temperature.log + 3e-4).abs() < 1e-8, "{}", temperature.log);
        let mut temperature = Temperature::new(1.0, 3e-4);
        temperature.step(3.0 - 2.0);
        assert!(temperature.log > 0.0, "too little entropy heats");
    }
}
