//! Registered agents.

use toml::Table;

use super::Registry;
use super::envs::{ErasedEnv, NoOptions, Settings, SharedReward, completed};
use crate::agent::{Dreamer, DreamerConfig, Method, OracleConfig, Pets, PetsConfig, Random, Sac, SacConfig};
use crate::env::Spec;
use crate::error::{Error, Result};

/// What an agent is made from, beside its settings.
pub struct AgentContext<'a> {
    /// The environment's spec.
    pub spec: &'a Spec,
    /// The run's seed.
    pub seed: u64,
    pub(super) env: &'a ErasedEnv,
    pub(super) options: &'a Table,
}

impl AgentContext<'_> {
    /// The environment's reward, if it is known as a function of observations.
    ///
    /// # Errors
    /// If the environment cannot be made.
    pub fn known_reward(&self) -> Result<Option<SharedReward>> {
        self.env.known_reward.as_ref().map_or(Ok(None), |make| make(self.options))
    }

    fn oracle(&self, config: OracleConfig) -> Result<Method> {
        let make = self.env.oracle.as_ref().ok_or_else(|| {
            Error::BadSetting(format!(
                "{} has no oracle: it was not registered `with_oracle`, which needs `Snapshot`",
                self.env.name
            ))
        })?;
        make(self.options, config, self.seed)
    }

    fn scripted(&self) -> Result<Method> {
        let make = self.env.scripted.as_ref();
        let make = make.ok_or_else(|| Error::BadSetting(format!("{} has no scripted policy", self.env.name)))?;
        Ok(Method::fixed(make(self.options)?))
    }
}

impl std::fmt::Debug for AgentContext<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let Self { spec, seed, options, .. } = self;
        f.debug_struct("AgentContext").field("spec", spec).field("seed", seed).field("options", options).finish()
    }
}

/// A registered agent.
pub(super) struct AgentEntry {
    pub(super) name: String,
    pub(super) learns: bool,
    pub(super) complete: fn(Table) -> Result<Table, toml::de::Error>,
    #[allow(clippy::type_complexity)] // a closure's type, named once
    pub(super) make: Box<dyn Fn(&AgentContext, Table) -> Result<Method> + Send + Sync>,
}

impl AgentEntry {
    pub(super) fn new<C: Settings>(
        name: &str,
        learns: bool,
        make: impl Fn(&AgentContext, C) -> Result<Method> + Send + Sync + 'static,
    ) -> Self {
        let make = move |context: &AgentContext, table: Table| {
            let problem = |problem: toml::de::Error| Error::BadSetting(problem.message().into());
            make(context, table.try_into().map_err(problem)?)
        };
        Self { name: name.into(), learns, complete: completed::<C>, make: Box::new(make) }
    }
}

/// The agents of this crate.
pub(super) fn register(registry: Registry) -> Registry {
    let oracle = AgentEntry::new("oracle", false, |context, config| context.oracle(config));
    let scripted = AgentEntry::new("scripted", false, |context, NoOptions {}| context.scripted());
    registry
        .add_agent(oracle)
        .add_agent(scripted)
        .policy("random", |context, NoOptions {}| Ok(Random::new(context.spec, context.seed)))
        .agent("sac", |context, config: SacConfig| Sac::new(context.spec, config, context.seed))
        .agent("dreamer", |context, config: DreamerConfig| Dreamer::new(context.spec, config, context.seed))
        .agent("pets", |context, config: PetsConfig| {
            Pets::new(context.spec, context.known_reward()?, config, context.seed)
        })
}
