//! Registered environments.

use std::collections::BTreeMap;
use std::marker::PhantomData;
use std::sync::Arc;

use serde::{Deserialize, Serialize, de::DeserializeOwned};
use toml::{Table, Value};

use super::Registry;
use crate::agent::{Method, Oracle, OracleConfig, Scripted};
use crate::env::tabletop::{ObservationKind, TableOptions, TableTask, Tabletop};
use crate::env::{Env, KnownReward, SharedReward, Snapshot, Task};
use crate::error::{Error, Result};
use crate::settings::{Ranges, choices};
use crate::study::config::settings_table;

/// Settings that are read from TOML and written to it with all defaults filled in. Give yours `#[serde(default, deny_unknown_fields)]`:
/// without the first, a file has to name every setting; without the second, a misspelt one is ignored.
///
/// ```
/// #[derive(serde::Serialize, serde::Deserialize)]
/// #[serde(default, deny_unknown_fields)]
/// struct Windy {
///     /// Speed of the wind, m/s.
///     wind: f32,
/// }
///
/// impl Default for Windy {
///     fn default() -> Self {
///         Self { wind: 1.0 }
///     }
/// }
///
/// fn usable(_: impl handful::study::registry::Settings) {}
/// usable(Windy::default());
/// ```
pub trait Settings: Serialize + DeserializeOwned + Default + Send + Sync + 'static {}

impl<S: Serialize + DeserializeOwned + Default + Send + Sync + 'static> Settings for S {}

/// The options of an environment, or the settings of an agent, that has none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoOptions {}

type Make<O, T> = Arc<dyn Fn(&O) -> Result<T> + Send + Sync>;
type MakeOracle<O> = Arc<dyn Fn(&O, OracleConfig, u64) -> Result<Method> + Send + Sync>;

/// An environment to be registered: how to make it, and what else can be had of it. `O` are its options, which stand in
/// the table `[env]` of a preset or configuration file.
pub struct EnvEntry<E, O = NoOptions> {
    name: String,
    check: Check,
    make: Make<O, E>,
    make_for_planning: Make<O, E>,
    known_reward: Option<Make<O, Option<SharedReward>>>,
    oracle: Option<MakeOracle<O>>,
    scripted: Option<Make<O, Scripted>>,
    env: PhantomData<fn() -> E>,
}

impl<E, O> std::fmt::Debug for EnvEntry<E, O> {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        f.debug_struct("EnvEntry").field("name", &self.name).finish_non_exhaustive()
    }
}

impl<E: Env> EnvEntry<E> {
    /// An environment without options.
    pub fn new(name: &str, make: impl Fn() -> Result<E> + Send + Sync + 'static) -> Self {
        Self::with_options(name, move |_: &NoOptions| make())
    }
}

impl<E: Env, O: Settings> EnvEntry<E, O> {
    /// An environment with options.
    pub fn with_options(name: &str, make: impl Fn(&O) -> Result<E> + Send + Sync + 'static) -> Self {
        let make: Make<O, E> = Arc::new(make);
        let check: Check = |_, _| Ok(());
        Self {
            name: name.into(),
            check,
            make_for_planning: make.clone(),
            make,
            known_reward: None,
            oracle: None,
            scripted: None,
            env: PhantomData,
        }
    }

    /// The known reward and the oracle, from here on, have other options than the environment that the agent acts in.
    fn planning_with(mut self, options: impl Fn(&O) -> O + Send + Sync + 'static) -> Self {
        let make = self.make.clone();
        self.make_for_planning = Arc::new(move |o| make(&options(o)));
        self
    }

    /// Its options have ranges, which are checked before anything is made.
    fn with_ranges(self) -> Self
    where
        O: Ranges,
    {
        Self { check: in_range::<O>, ..self }
    }

    /// Its reward is known as a function of observations: agents that plan need not learn it.
    #[must_use]
    pub fn with_known_reward(self) -> Self
    where
        E: KnownReward + Sync,
    {
        self.with_known_reward_if(|_| true)
    }

    /// The same, for some of its options only.
    #[must_use]
    pub fn with_known_reward_if(mut self, known: impl Fn(&O) -> bool + Send + Sync + 'static) -> Self
    where
        E: KnownReward + Sync,
    {
        let make = self.make_for_planning.clone();
        self.known_reward = Some(Arc::new(move |options: &O| {
            Ok(if known(options) { Some(Arc::new(make(options)?) as SharedReward) } else { None })
        }));
        self
    }

    /// It can be restored, so that the oracle can plan in it.
    #[must_use]
    pub fn with_oracle(mut self) -> Self
    where
        E: Snapshot,
    {
        let make = self.make_for_planning.clone();
        self.oracle = Some(Arc::new(move |options: &O, config, seed| {
            Ok(Method::fixed(Oracle::new(|| make(options), config, seed)?))
        }));
        self
    }

    /// There is a hand-written policy for it. Where the options rule it out, `policy` returns [`Error::Unsupported`]: a study whose methods
    /// nobody named leaves it out then, while any other error ends the study.
    #[must_use]
    pub fn with_scripted(mut self, policy: impl Fn(&O) -> Result<Scripted> + Send + Sync + 'static) -> Self {
        self.scripted = Some(Arc::new(policy));
        self
    }
}

impl EnvEntry<Tabletop, TableOptions> {
    /// A task of one's own for the arm, with all that our tasks have: a known reward, the oracle, and its scripted policy.
    pub fn table_task(task: impl TableTask + 'static) -> Self {
        let task: Arc<dyn TableTask> = Arc::new(task);
        let make = {
            let task = task.clone();
            move |options: &TableOptions| Tabletop::with_shared(task.clone(), *options)
        };
        Self::with_options(task.name(), make.clone())
            .with_ranges()
            .planning_with(TableOptions::of_planning)
            .with_known_reward_if(|options| options.observation == ObservationKind::Compact)
            .with_oracle()
            .with_scripted(move |options| {
                let arm = make(options)?;
                let policy = arm.scripted_policy();
                policy.map(Scripted::new).ok_or_else(|| {
                    Error::Unsupported(format!("{} has no scripted policy for these observations", arm.spec().name))
                })
            })
    }
}

/// Fills in the defaults of the settings in the table at a path.
pub(super) type Complete = fn(&str, Table) -> Result<Table, toml::de::Error>;

/// The [`Complete`] of a type of settings. They are read at their path, so that errors name all of it.
pub(super) fn completed<S: Settings>(path: &str, table: Table) -> Result<Table, toml::de::Error> {
    let outer = Table::from_iter([(path.to_string(), Value::Table(table))]);
    let settings: BTreeMap<String, S> = outer.try_into()?;
    Ok(settings_table(&settings[path]))
}

/// Checks the settings in the table at a path.
pub(super) type Check = fn(&str, &Table) -> Result<()>;

/// The [`Check`] of settings that have ranges.
pub(super) fn in_range<S: Settings + Ranges>(path: &str, table: &Table) -> Result<()> {
    parsed::<S>(table)?.check_at(path)
}

fn parsed<S: Settings>(table: &Table) -> Result<S> {
    table.clone().try_into().map_err(|problem: toml::de::Error| Error::Config(problem.message().into()))
}

type Erased<T> = Box<dyn Fn(&Table) -> Result<T> + Send + Sync>;

/// An [`EnvEntry`] without its types.
pub(super) struct ErasedEnv {
    pub(super) name: String,
    pub(super) complete: Complete,
    pub(super) check: Check,
    pub(super) choices: Vec<String>,
    pub(super) make: Erased<Box<dyn Env>>,
    pub(super) known_reward: Option<Erased<Option<SharedReward>>>,
    #[allow(clippy::type_complexity)] // a closure's type, named once
    pub(super) oracle: Option<Box<dyn Fn(&Table, OracleConfig, u64) -> Result<Method> + Send + Sync>>,
    pub(super) scripted: Option<Erased<Scripted>>,
}

impl<E: Env, O: Settings> EnvEntry<E, O> {
    pub(super) fn erased(self) -> ErasedEnv {
        let Self { name, check, make, known_reward, oracle, scripted, .. } = self;
        ErasedEnv {
            name,
            complete: completed::<O>,
            check,
            choices: choices::<O>("env"),
            make: Box::new(move |options| Ok(Box::new(make(&parsed(options)?)?))),
            known_reward: known_reward.map(|make| Box::new(move |o: &Table| make(&parsed(o)?)) as Erased<_>),
            oracle: oracle.map(|make| {
                Box::new(move |options: &Table, config: OracleConfig, seed: u64| make(&parsed(options)?, config, seed))
                    as Box<_>
            }),
            scripted: scripted.map(|make| Box::new(move |o: &Table| make(&parsed(o)?)) as Erased<_>),
        }
    }
}

/// The tasks of this crate.
pub(super) fn register(registry: Registry) -> Registry {
    Task::ALL.into_iter().fold(registry, |registry, task| {
        let entry = EnvEntry::with_options(task.name(), move |options: &TableOptions| task.make_with(*options))
            .with_ranges()
            .planning_with(TableOptions::of_planning)
            .with_known_reward_if(|options| options.observation == ObservationKind::Compact)
            .with_oracle();
        let scripted = task.scripted_policy(TableOptions::default()).is_some();
        registry.env(if scripted { entry.with_scripted(move |o| Scripted::of_task(task, *o)) } else { entry })
    })
}
