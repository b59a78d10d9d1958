//! Probabilistic ensembles (Chua et al. 2018, PETS, section 4): several networks, each of which predicts a Gaussian over
//! the change of the observation in one time step.
//!
//! For an observation and an action each network outputs mean and log-variance of the *change* of the observation. The
//! variance that members predict is aleatoric uncertainty (noise of the environment); their disagreement is epistemic
//! uncertainty (too few data). A reward that is not known is learned by networks of its own ([`LearnedReward`]).
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
mod networks;
mod reward;

pub use config::EnsembleConfig;
pub use fit::Fit;
pub use reward::LearnedReward;

use self::data::Data;
use self::fit::Split;
use self::networks::Networks;
use self::reward::RewardModel;
use super::{Dynamics, FeatureMap};
use crate::checkpoint::{MAX_COUNT, Weights};
use crate::env::Spec;
use crate::error::Result;
use crate::replay::ReplayBuffer;
use crate::rng::Rng;
use crate::settings::Ranges;

/// Floor of a normaliser's standard deviations, as a fraction of the feature's scale.
const MIN_STD: f32 = 1e-3;

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
    networks: Networks,
    /// Learns the reward, if it is not known.
    reward: Option<RewardModel>,
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
        let (features, actions) = (FeatureMap::new(spec)?, spec.action_size);
        let (inputs, outputs) = (features.input_size() + actions, features.predicted.len());
        Ok(Self {
            features,
            scales: spec.observation.iter().map(|feature| feature.scale).collect(),
            flags: spec.observation.iter().map(|feature| feature.flag).collect(),
            actions,
            networks: Networks::new(&config, [inputs, outputs], &config.hidden, config.gated, rng),
            reward: config.learn_reward.then(|| RewardModel::new(spec, &config, rng)),
            fits: 0,
            config,
        })
    }

    /// Whether it has been fitted at least once.
    pub fn is_fitted(&self) -> bool {
        self.fits > 0
    }

    /// Trains on all transitions in `replay`. Weights and optimiser state continue from the fit before; normalisation,
    /// elites and temperature are computed anew.
    ///
    /// # Panics
    /// If there are fewer than two transitions.
    #[doc(alias = "negative log-likelihood")]
    #[doc(alias = "early stopping")]
    #[doc(alias = "bootstrap")]
    #[doc(alias = "train")]
    pub fn fit(&mut self, replay: &ReplayBuffer, rng: &mut Rng) -> Fit {
        assert!(replay.len() >= 2, "an ensemble learns from at least two transitions");
        let limit = if self.is_fitted() { self.config.steps } else { self.config.first_steps };
        let split = Split::new(replay, self.config.held_out);
        let data = self.normalised(replay);
        let mut fit = self.networks.fit(&self.config, &data, &split, limit, rng);
        if let Some(reward) = &mut self.reward {
            fit.reward_errors = reward.fit(&self.config, replay, &split, limit, rng).errors;
        }
        self.fits += 1;
        fit
    }

    /// All transitions as inputs (observation features and action) and targets (changes of the predicted features).
    fn normalised(&mut self, replay: &ReplayBuffer) -> Data {
        let (mut inputs, mut targets) = (Vec::new(), Vec::new());
        for i in 0..replay.len() {
            let row = replay.row(i);
            let (mut obs, mut next_obs) = (row.obs.to_vec(), row.next_obs.to_vec());
            self.features.canonicalize(&mut obs, Some(&mut next_obs));
            inputs.extend(self.features.inputs(&obs).chain(row.action.iter().copied()));
            targets.extend(self.features.predicted.iter().map(|i| next_obs[*i] - obs[*i]));
        }
        let floor = |i: &usize| MIN_STD * self.scales[*i];
        let unscaled = vec![MIN_STD; self.features.near.len() + self.actions];
        let input_floors: Vec<f32> = self.features.raw.iter().map(floor).chain(unscaled).collect();
        // A flag that flips in a share f of all steps changes by 1/sqrt(f) standard deviations: clipped, the flip of a rare
        // one would be predicted too small to be noticed. With this floor no flip exceeds the clip.
        let flip = 1.0 / self.config.max_target;
        let target_floor = |i: &usize| if self.flags[*i] { floor(i).max(flip) } else { floor(i) };
        let target_floors: Vec<f32> = self.features.predicted.iter().map(target_floor).collect();
        Data::new(
            &mut self.networks,
            [inputs, targets],
            [&input_floors, &target_floors],
            [f32::INFINITY, self.config.max_target],
        )
    }

    /// The elites as a model to predict and plan with: a snapshot, which later fits do not change.
    pub fn dynamics(&self) -> Dynamics {
        let Networks { members, inputs, targets, temperature, elites, .. } = &self.networks;
        Dynamics::new(
            elites.iter().map(|&member| members[member].learner.frozen()),
            self.features.clone(),
            self.actions,
            inputs.clone(),
            targets.clone(),
            temperature.clone(),
        )
        .with_reward(self.reward.as_ref().map(RewardModel::learned))
    }

    /// Everything that predictions depend on.
    pub fn weights(&self) -> Weights {
        let mut weights = Weights::default();
        self.networks.save(&mut weights, "");
        self.reward.iter().for_each(|reward| reward.save(&mut weights));
        weights.insert_counts("fits", &[self.fits as u64]);
        weights
    }

    /// Loads what [`Ensemble::weights`] returned.
    ///
    /// # Errors
    /// If an array is missing or has another shape, as with other settings, or a number cannot have been saved.
    pub fn load_weights(&mut self, weights: &Weights) -> Result<()> {
        self.networks.load(weights, "")?;
        self.reward.iter_mut().try_for_each(|reward| reward.load(weights))?;
        self.fits = weights.count("fits", 0..=MAX_COUNT)? as usize;
        Ok(())
    }

    /// Gradient steps so far, of the member that has made most.
    pub fn updates(&self) -> u64 {
        self.networks.members.iter().map(|member| member.optimiser.steps()).max().unwrap_or(0)
    }

    /// Adds the state of the optimisers to `state`.
    pub fn save_training_state(&self, state: &mut Weights) {
        self.networks.save_training_state(state, "");
        self.reward.iter().for_each(|reward| reward.save_training_state(state));
    }

    /// Loads what [`Ensemble::save_training_state`] stored.
    ///
    /// # Errors
    /// If an array is missing or has another shape.
    pub fn load_training_state(&mut self, state: &Weights) -> Result<()> {
        self.networks.load_training_state(state, "")?;
        self.reward.iter_mut().try_for_each(|reward| reward.load_training_state(state))
    }
}
