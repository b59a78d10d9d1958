//! The planners of this crate by name, as settings files have them.

use serde::{Deserialize, Serialize};

use super::{
    Cem, CemConfig, Gradient, GradientConfig, GuidedConfig, GuidedMppi, Hybrid, HybridConfig, Icem, IcemConfig,
    MakePlanner, Mppi, MppiConfig, Planner, RandomShooting, ShootingConfig,
};
use crate::error::{Error, Result};
use crate::settings::{Ranges, fits, ranges};

/// A planner of this crate with its settings.
///
/// ```
/// use handful::plan::{MppiConfig, PlannerConfig};
///
/// let config: PlannerConfig = toml::from_str("[mppi]\npopulation = 100").expect("a planner and its settings");
/// assert_eq!(config, PlannerConfig::Mppi(MppiConfig { population: 100, ..MppiConfig::default() }));
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum PlannerConfig {
    /// Random shooting.
    Shooting(ShootingConfig),
    /// The cross-entropy method as in PETS.
    Cem(CemConfig),
    /// CEM with coloured noise and a memory.
    Icem(IcemConfig),
    /// Model predictive path integral control.
    Mppi(MppiConfig),
    /// MPPI over elites, guided by a policy's proposals.
    Guided(GuidedConfig),
    /// Gradient ascent from several starts (gradient shooting).
    Gradient(GradientConfig),
    /// iCEM, refined by gradient ascent.
    Hybrid(HybridConfig),
}

impl PlannerConfig {
    /// A planner for `action_size`-dimensional actions.
    ///
    /// # Errors
    /// If a setting lies outside its range, an action has no numbers, or the candidates do not fit into memory.
    pub fn try_build(&self, action_size: usize) -> Result<Box<dyn Planner>> {
        self.check_at("planner")?;
        if action_size == 0 {
            return Err(Error::Config("`action_size` is 0; a planner needs actions of at least one number".into()));
        }
        if !fits(&[self.candidates(), self.horizon(), action_size]) {
            return Err(Error::Config("`planner`: the candidates times `horizon` do not fit into memory".into()));
        }
        Ok(self.build(action_size))
    }

    /// The same from settings that were checked, as those of an agent are.
    ///
    /// # Panics
    /// If a setting lies outside its range.
    pub fn build(&self, action_size: usize) -> Box<dyn Planner> {
        match self {
            PlannerConfig::Shooting(config) => Box::new(RandomShooting::new(config.clone(), action_size)),
            PlannerConfig::Cem(config) => Box::new(Cem::new(config.clone(), action_size)),
            PlannerConfig::Icem(config) => Box::new(Icem::new(config.clone(), action_size)),
            PlannerConfig::Mppi(config) => Box::new(Mppi::new(config.clone(), action_size)),
            PlannerConfig::Guided(config) => Box::new(GuidedMppi::new(config.clone(), action_size)),
            PlannerConfig::Gradient(config) => Box::new(Gradient::new(config.clone(), action_size)),
            PlannerConfig::Hybrid(config) => Box::new(Hybrid::new(config.clone(), action_size)),
        }
    }

    /// The planning horizon, in actions.
    pub fn horizon(&self) -> usize {
        match self {
            PlannerConfig::Shooting(config) => config.horizon,
            PlannerConfig::Cem(config) => config.horizon,
            PlannerConfig::Icem(config) => config.horizon,
            PlannerConfig::Mppi(config) => config.horizon,
            PlannerConfig::Guided(config) => config.horizon,
            PlannerConfig::Gradient(config) => config.horizon,
            PlannerConfig::Hybrid(config) => config.icem.horizon,
        }
    }

    /// Candidates that are evaluated side by side, at most.
    pub(crate) fn candidates(&self) -> usize {
        let of_icem = |config: &IcemConfig| config.population.max(2 * config.elites) + config.elites + 1;
        match self {
            PlannerConfig::Shooting(config) => config.population,
            PlannerConfig::Cem(config) => config.population,
            PlannerConfig::Icem(config) => of_icem(config),
            PlannerConfig::Mppi(config) => config.population,
            PlannerConfig::Guided(config) => config.population,
            PlannerConfig::Gradient(config) => config.starts,
            PlannerConfig::Hybrid(config) => of_icem(&config.icem),
        }
    }
}

ranges!(enum PlannerConfig {
    "shooting" Shooting: Nested,
    "cem" Cem: Nested,
    "icem" Icem: Nested,
    "mppi" Mppi: Nested,
    "guided" Guided: Nested,
    "gradient" Gradient: Nested,
    "hybrid" Hybrid: Nested,
});

impl MakePlanner for PlannerConfig {
    fn make(&self, action_size: usize) -> Box<dyn Planner> {
        self.build(action_size)
    }
}
