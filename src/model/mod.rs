//! Learned models of the environment: what comes next, and how uncertain that is.
//!
//! | model | predicts | paper |
//! | --- | --- | --- |
//! | [`Ensemble`] | the next observation, as a Gaussian per member; the reward, if it is not known | PETS (Chua et al. 2018) |
//! | [`Autoencoder`] | the next code of an observation, deterministically | |
//! | [`WorldModel`] | the next latent state, from a history of observations | PlaNet, Dreamer (Hafner et al. 2019, 2023) |
//! | [`ImplicitModel`] | the next latent state, rewards and values, but no observation | TD-MPC2 (Hansen et al. 2024) |
//!
//! An [`Ensemble`] is trained; its snapshot [`Dynamics`] predicts; [`Imagination`] rolls a snapshot out along many action
//! sequences at once. [`uncertainty`] separates epistemic from aleatoric uncertainty, [`calibration`] and [`open_loop`]
//! measure how good predictions are.
//!
//! ```
//! use handful::model::{Ensemble, EnsembleConfig};
//! use handful::prelude::*;
//! use handful::rng;
//!
//! // Random transitions of a pendulum.
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
//! let config = EnsembleConfig { hidden: vec![16], first_steps: 100, ..EnsembleConfig::default() };
//! let mut ensemble = Ensemble::new(world.spec(), config, &mut rng)?;
//! ensemble.fit(&replay, &mut rng);
//! let dynamics = ensemble.dynamics();
//! let prediction = dynamics.predict(&obs, &[0.5]);
//! // It has the features that the ensemble predicts: of a pendulum all, of the arm those that are no goal and no difference.
//! for (j, (i, _)) in dynamics.typical_changes().enumerate() {
//!     let std = (prediction.aleatoric[j] + prediction.epistemic[j]).sqrt();
//!     println!("{}: {:.3} ± {std:.3}", world.spec().observation[i].name, prediction.mean[j]);
//! }
//! # Ok::<(), handful::error::Error>(())
//! ```

mod autoencoder;
pub mod calibration;
mod differentiable;
mod dynamics;
pub mod ensemble;
pub mod features;
pub mod imagination;
pub mod implicit;
pub mod open_loop;
pub mod rssm;
pub mod uncertainty;
mod world_model;

pub use autoencoder::{Autoencoder, AutoencoderConfig};
pub use differentiable::Differentiable;
pub use dynamics::{Dynamics, Prediction};
pub use ensemble::{Ensemble, EnsembleConfig, Fit, LearnedReward};
pub use features::{Cube, Distances, FeatureMap, LatentFeatures, Normaliser};
pub use imagination::{Imagination, ImaginedReturns, Propagation, Reward, Value};
pub use implicit::{EntropyBonus, ImplicitConfig, ImplicitLoss, ImplicitModel, PolicyPrior, Probe, Probed};
pub use rssm::{Latent, Rssm, RssmConfig};
pub use world_model::{WorldModel, WorldModelConfig, WorldModelLoss};
