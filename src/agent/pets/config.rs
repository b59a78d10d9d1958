//! Settings of [`Pets`](super::Pets).

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};
use crate::model::uncertainty::Risk;
use crate::model::{EnsembleConfig, Propagation};
use crate::plan::{ControlConfig, IcemConfig, PlannerConfig};

/// Settings of [`Pets`](super::Pets). [`Preset`](crate::agent::Preset) has tuned ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PetsConfig {
    /// The model.
    pub ensemble: EnsembleConfig,
    /// The planner and its settings.
    pub planner: PlannerConfig,
    /// How plans become control.
    pub control: ControlConfig,
    /// Weight of the terminal reward: the known reward of resting in a plan's last state is added to its return so many
    /// times. A short plan then prefers to end well. Without effect if the reward is learned.
    pub terminal_weight: f32,
    /// How uncertainty is propagated along imagined trajectories.
    #[doc(alias = "trajectory sampling")]
    pub propagation: Propagation,
    /// Particles: imagined trajectories of each candidate; a multiple of the ensemble's elites.
    pub particles: usize,
    /// How the returns of a candidate's particles become one score.
    pub risk: Risk,
    /// Return subtracted for each unit of disagreement between the members
    /// ([`ImaginedReturns::disagreement`](crate::model::ImaginedReturns)).
    pub disagreement_penalty: f32,
    /// Return added for each unit of disagreement, in [`Mode::Explore`](crate::agent::Mode) only.
    #[doc(alias = "curiosity")]
    pub disagreement_bonus: f32,
    /// Time steps of random actions before the first fit.
    pub warm_up: usize,
    /// Exponent beta of the random actions' noise ([`ColoredNoise`](crate::plan::noise::ColoredNoise)): white noise (0)
    /// barely moves an arm.
    pub warm_up_noise_beta: f64,
    /// Time steps between two fits of the model.
    pub fit_every: usize,
    /// Capacity of the replay buffer, in transitions.
    pub replay: usize,
}

impl Default for PetsConfig {
    fn default() -> Self {
        Self {
            ensemble: EnsembleConfig::default(),
            planner: PlannerConfig::Icem(IcemConfig::default()),
            control: ControlConfig::default(),
            terminal_weight: 0.0,
            propagation: Propagation::TsInf,
            particles: 5,
            risk: Risk::Neutral,
            disagreement_penalty: 0.0,
            disagreement_bonus: 0.0,
            warm_up: 500,
            warm_up_noise_beta: 2.0,
            fit_every: 200,
            replay: 1_000_000,
        }
    }
}

impl PetsConfig {
    pub(super) fn check(&self) -> Result<()> {
        self.control.check(&self.planner)?;
        if !self.particles.is_multiple_of(self.ensemble.elites) || self.particles == 0 {
            return Err(Error::BadSetting(format!(
                "pets: `particles` must be a multiple of the {} elites of the ensemble",
                self.ensemble.elites
            )));
        }
        if self.warm_up < 2 || self.fit_every == 0 {
            return Err(Error::BadSetting("pets: `warm_up` must be at least 2, `fit_every` at least 1".into()));
        }
        Ok(())
    }
}
