//! Probabilistic ensembles (Chua et al. 2018, PETS, section 4): several networks, each of which predicts a Gaussian over
//! the change of the observation in one time step.
//!
//! For an observation and an action each network outputs mean and log-variance of the *change* of the observation, and of
//! the reward if that is learned. The variance that members predict is aleatoric uncertainty (noise of the environment);
//! their disagreement is epistemic uncertainty (too few data).
//!
//! Deviations from PETS:
//! - Targets are normalised as well as inputs, because features differ in scale (a cube moves by millimetres per time
//!   step, the hand by centimetres).
//! - The bounds of the log-variance are constant unless [`EnsembleConfig::learn_bounds`] is set (as in mbrl-lib), and each
//!   member has its own.
//! - Early stopping keeps the best weights of each member separately, whatever the margin (mbrl-lib asks for 1 % of any
//!   member); weight decay is decoupled (AdamW).
//! - All members train on the same transitions, each in its own order, unless [`EnsembleConfig::bootstrap`] is set (PETS draws
//!   a bootstrap sample for each).
//! - The loss is the beta-NLL; with [`EnsembleConfig::beta`] 0 it is that of PETS. Targets far from the mean are clipped.
//! - The length of a fit is a number of gradient steps, not of epochs, and the members that predict are the best on the
//!   validation set ([`EnsembleConfig::elites`], as in mbrl-lib).
//! - A share of the transitions is held out from all fits, as validation set (PETS holds none out).
//! - Predicted standard deviations are calibrated by a temperature on the validation set.
//!
//! ```
//! use handful::model::{Ensemble, EnsembleConfig};
//! use handful::prelude::*;
//! use handful::rng;
//!
//! let mut world = Task::Pendulum.make();
//! let mut rng = rng::stream(0, "example");
//! let mut replay = ReplayBuffer::new(world.spec().observation_size(), world.spec().action_size, 1000);
//! let mut obs = world.reset(0);
//! for _ in 0..200 {
//!     let action = vec![rng::uniform(&mut rng, -1.0, 1.0) as f32];
//!     let Step { observation: next_obs, reward, terminated, truncated, .. } = world.step(&action)?;
//!     let transition = Transition { obs, action, reward, next_obs: next_obs.clone(), terminated, truncated };
//!     replay.push(&transition);
//!     obs = next_obs;
//! }
//!
//! let config = EnsembleConfig { members: 3, elites: 2, hidden: vec![16], first_steps: 50, ..EnsembleConfig::default() };
//! let mut ensemble = Ensemble::new(world.spec(), config, &mut rng)?;
//! let fit = ensemble.fit(&replay, &mut rng);
//! assert_eq!((fit.steps, fit.errors.len()), (50, 3));
//! assert_eq!(ensemble.dynamics().members(), 2);
//! # Ok::<(), handful::error::Error>(())
//! ```

mod config;
mod data;
mod fit;

pub use config::EnsembleConfig;
pub use fit::Fit;

use self::fit::{Learner, Member};
use super::{Dynamics, FeatureMap, Normaliser};
use crate::checkpoint::{MAX_COUNT, Weights};
use crate::env::Spec;
use crate::error::Result;
use crate::nn::{Activation, Adam, AdamConfig, Init, LogVarianceBounds, Mlp, MlpConfig, Norm, device};
use crate::rng::Rng;
use crate::settings::Ranges;

/// A probabilistic ensemble in training: networks, optimisers and normalisation. [`Ensemble::dynamics`] is the snapshot
/// that predicts.
#[doc(alias = "PE")]
#[doc(alias = "deep ensemble")]
#[doc(alias = "bootstrap ensemble")]
#[derive(Clone, Debug)]
pub struct Ensemble {
    config: EnsembleConfig,
    features: FeatureMap,
    /// Scale of each feature of an observation, from the spec.
    scales: Vec<f32>,
    /// Whether each feature of an observation is a flag.
    flags: Vec<bool>,
    actions: usize,
    members: Vec<Member>,
    inputs: Normaliser,
    targets: Normaliser,
    /// Factor of the predicted standard deviation of each output, fitted on the validation set.
    temperature: Vec<f32>,
    elites: Vec<usize>,
    fits: usize,
}

impl Ensemble {
    /// An ensemble with random weights for an environment.
    ///
    /// # Errors
    /// [`Error::Config`](crate::error::Error::Config) if a setting is out of range, or for the reasons of
    /// [`FeatureMap::new`].
    pub fn new(spec: &Spec, config: EnsembleConfig, rng: &mut Rng) -> Result<Self> {
        config.check_at("ensemble")?;
        let cpu = device();
        let (features, actions) = (FeatureMap::new(spec)?, spec.action_size);
        let features = if config.learn_reward { features.with_goals(spec) } else { features };
        let inputs = features.input_size() + actions;
        let outputs = features.predicted.len() + usize::from(config.learn_reward);
        let shape = MlpConfig {
            members: config.members,
            input: inputs,
            hidden: config.hidden.clone(),
            output: Some(if config.gated { 3 } else { 2 } * outputs),
            norm: Norm::None,
            activation: Activation::Silu,
            init: Init::TruncatedNormal,
        };
        let networks = Mlp::new(&cpu, &shape, rng);
        let optimiser = AdamConfig { weight_decay: config.weight_decay, ..AdamConfig::new(config.learning_rate) };
        let member = |i: usize| {
            let bounds = LogVarianceBounds::new(&cpu, outputs);
            Member { learner: Learner { network: networks.member(&cpu, i), bounds }, optimiser: Adam::new(optimiser) }
        };
        Ok(Self {
            features,
            scales: spec.observation.iter().map(|feature| feature.scale).collect(),
            flags: spec.observation.iter().map(|feature| feature.flag).collect(),
            actions,
            members: (0..config.members).map(member).collect(),
            inputs: Normaliser::identity(inputs),
            targets: Normaliser::identity(outputs),
            temperature: vec![1.0; outputs],
            elites: (0..config.elites).collect(),
            fits: 0,
            config,
        })
    }

    /// Whether it has been fitted at least once.
    pub fn is_fitted(&self) -> bool {
        self.fits > 0
    }

    /// The elites as a model to predict and plan with: a snapshot, which later fits do not change.
    pub fn dynamics(&self) -> Dynamics {
        Dynamics::new(
            self.elites.iter().map(|&member| self.members[member].learner.frozen()),
            self.features.clone(),
            self.actions,
            self.inputs.clone(),
            self.targets.clone(),
            self.temperature.clone(),
        )
    }

    /// Everything that predictions depend on.
    pub fn weights(&self) -> Weights {
        let mut weights = Weights::default();
        for (i, member) in self.members.iter().enumerate() {
            weights.insert_module(&member_name(i), &member.learner);
        }
        self.inputs.save(&mut weights, "inputs");
        self.targets.save(&mut weights, "targets");
        weights.insert("temperature", self.temperature.clone(), [1, 1, self.temperature.len()]);
        let elites: Vec<u64> = self.elites.iter().map(|member| *member as u64).collect();
        weights.insert_counts("elites", &elites);
        weights.insert_counts("fits", &[self.fits as u64]);
        weights
    }

    /// Loads what [`Ensemble::weights`] returned.
    ///
    /// # Errors
    /// If an array is missing or has another shape, as with other settings, or a number is none that was saved.
    pub fn load_weights(&mut self, weights: &Weights) -> Result<()> {
        let last = self.config.members as u64 - 1;
        let elites = weights.counts_within("elites", &vec![0..=last; self.config.elites])?;
        let temperature =
            weights.get_within("temperature", [1, 1, self.temperature.len()], f32::MIN_POSITIVE..=f32::MAX)?.to_vec();
        self.fits = weights.count("fits", 0..=MAX_COUNT)? as usize;
        for (i, member) in self.members.iter_mut().enumerate() {
            weights.load_module(&member_name(i), &mut member.learner)?;
        }
        self.inputs.load(weights, "inputs")?;
        self.targets.load(weights, "targets")?;
        self.elites = elites.into_iter().map(|member| member as usize).collect();
        self.temperature = temperature;
        Ok(())
    }

    /// Gradient steps so far, of the member that has made most.
    pub fn updates(&self) -> u64 {
        self.members.iter().map(|member| member.optimiser.steps()).max().unwrap_or(0)
    }

    /// Adds the state of the optimisers to `state`.
    pub fn save_training_state(&self, state: &mut Weights) {
        for (i, member) in self.members.iter().enumerate() {
            member.optimiser.save(state, &member_name(i));
        }
    }

    /// Loads what [`Ensemble::save_training_state`] stored.
    ///
    /// # Errors
    /// If an array is missing or has another shape.
    pub fn load_training_state(&mut self, state: &Weights) -> Result<()> {
        for (i, member) in self.members.iter_mut().enumerate() {
            member.optimiser.load(state, &member_name(i), &member.learner)?;
        }
        Ok(())
    }
}

/// Prefix of a member's arrays in a checkpoint.
fn member_name(member: usize) -> String {
    format!("ensemble.{member}")
}
