//! What was learned of the world: models that predict what comes next, and say how sure they are.
//!
//! [`Ensemble`] learns; its snapshot [`Dynamics`] predicts; [`Imagination`] lets a snapshot run ahead along many action
//! sequences at once. [`uncertainty`] and [`calibration`] tell what the predictions are worth.

mod autoencoder;
pub mod calibration;
mod cube;
mod differentiable;
mod dynamics;
mod ensemble;
mod imagination;
mod layout;
mod normaliser;
pub mod open_loop;
pub mod rssm;
pub mod uncertainty;
mod view;
mod world_model;

pub use autoencoder::{Autoencoder, AutoencoderConfig};
pub use cube::Cube;
pub use differentiable::Differentiable;
pub use dynamics::{Dynamics, Prediction};
pub use ensemble::{Ensemble, EnsembleConfig, Fit};
pub use imagination::{Imagination, ImaginedReturns, Propagation, Reward, Value};
pub use layout::FeatureMap;
pub use normaliser::Normaliser;
pub use rssm::{Latent, Rssm, RssmConfig};
pub use world_model::{WorldModel, WorldModelConfig, WorldModelLoss};
