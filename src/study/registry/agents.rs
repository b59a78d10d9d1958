//! Registered agents.

use toml::Table;

use super::Registry;
use super::envs::{Check, Complete, ErasedEnv, NoOptions, Settings, completed, in_range};
use crate::agent::{
    Dreamer, DreamerConfig, Method, OracleConfig, Pets, PetsConfig, Random, Sac, SacConfig, TdMpc2, TdMpc2Config,
};
use crate::env::{Env, SharedReward, Spec};
use crate::error::{Error, Result};
use crate::settings::{Ranges, choices, value_at};
use crate::study::folder::difference_in;

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
    /// One more environment like those of the run, for an agent that needs one to itself; `<dyn Env>::downcast_ref` gets its type back.
    ///
    /// # Errors
    /// If the environment cannot be made.
    pub fn make_env(&self) -> Result<Box<dyn Env>> {
        (self.env.make)(self.options)
    }

    /// The reward that methods are told, if it is known as a function of observations: `planning_reward`, where the options set
    /// one (the environment then pays another).
    ///
    /// # Errors
    /// If the environment cannot be made.
    pub fn known_reward(&self) -> Result<Option<SharedReward>> {
        let reward = self.env.known_reward.as_ref().map_or(Ok(None), |make| make(self.options))?;
        Ok(reward.filter(|reward| reward.is_known()))
    }

    fn oracle(&self, config: OracleConfig) -> Result<Method> {
        let make = self.env.oracle.as_ref().ok_or_else(|| {
            Error::Unsupported(format!(
                "{} has no oracle: it was not registered `with_oracle`, which needs `Snapshot`",
                self.env.name
            ))
        })?;
        make(self.options, config, self.seed)
    }

    fn scripted(&self) -> Result<Method> {
        let make = self.env.scripted.as_ref();
        let make = make.ok_or_else(|| {
            Error::Unsupported(format!(
                "{} has no scripted policy; take another method or policy, such as random",
                self.env.name
            ))
        })?;
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
    pub(super) complete: Complete,
    pub(super) check: Check,
    pub(super) choices: Vec<String>,
    /// Paths of the settings without which trained weights would mean something else, even where all arrays keep their sizes.
    trained_with: &'static [&'static str],
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
            let problem = |problem: toml::de::Error| Error::Config(problem.message().into());
            make(context, table.try_into().map_err(problem)?)
        };
        let choices = choices::<C>(name);
        Self {
            name: name.into(),
            learns,
            complete: completed::<C>,
            check: |_, _| Ok(()),
            choices,
            trained_with: &[],
            make: Box::new(make),
        }
    }

    fn trained_with(self, settings: &'static [&'static str]) -> Self {
        Self { trained_with: settings, ..self }
    }

    /// # Errors
    /// If settings differ that belong to the trained weights.
    pub(super) fn check_trained_with(&self, trained: &Table, changed: &Table) -> Result<()> {
        let [trained, changed] = [trained, changed].map(|settings| -> Table {
            let of_weights = self.trained_with.iter();
            of_weights.filter_map(|path| Some((path.to_string(), value_at(settings, path)?.clone()))).collect()
        });
        match difference_in(&format!("{}.", self.name), &trained, &changed) {
            None => Ok(()),
            Some(difference) => {
                Err(Error::Config(format!("this setting belongs to the run's weights ({difference}); leave it out")))
            }
        }
    }

    /// Its settings have ranges, which are checked before anything is made.
    fn with_ranges<C: Settings + Ranges>(self) -> Self {
        Self { check: in_range::<C>, ..self }
    }
}

/// The agents of this crate.
pub(super) fn register(registry: Registry) -> Registry {
    let oracle =
        AgentEntry::new("oracle", false, |context, config| context.oracle(config)).with_ranges::<OracleConfig>();
    let sac = AgentEntry::new("sac", true, |context, config: SacConfig| {
        Ok(Method::learner(Sac::with_reward(context.spec, context.known_reward()?, config, context.seed)?))
    });
    let dreamer = AgentEntry::new("dreamer", true, |context, config: DreamerConfig| {
        Ok(Method::learner(Dreamer::new(context.spec, config, context.seed)?))
    });
    let pets = AgentEntry::new("pets", true, |context, config: PetsConfig| {
        Ok(Method::learner(Pets::new(context.spec, context.known_reward()?, config, context.seed)?))
    });
    let tdmpc2 = AgentEntry::new("tdmpc2", true, |context, config: TdMpc2Config| {
        Ok(Method::learner(TdMpc2::new(context.spec, config, context.seed)?))
    });
    let scripted = AgentEntry::new("scripted", false, |context, NoOptions {}| context.scripted());
    registry
        .add_agent(oracle)
        .add_agent(scripted)
        .policy("random", |context, NoOptions {}| Ok(Random::new(context.spec, context.seed)))
        .add_agent(sac.with_ranges::<SacConfig>().trained_with(&["latent_features"]))
        .add_agent(dreamer.with_ranges::<DreamerConfig>().trained_with(&["world", "action_repeat"]))
        .add_agent(tdmpc2.with_ranges::<TdMpc2Config>().trained_with(&["model", "action_repeat", "reward_unit"]))
        .add_agent(pets.with_ranges::<PetsConfig>().trained_with(&["ensemble.reward_unit", "action_repeat"]))
}
