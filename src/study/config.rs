//! What a run is: task, method, seed, budget, settings; from presets, files and the command line.

use std::path::Path;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use crate::agent::{
    Agent, Dreamer, DreamerConfig, Oracle, OracleConfig, Pets, PetsConfig, Random, Sac, SacConfig, Scripted,
};
use crate::env::tabletop::TableOptions;
use crate::env::{Env, Task, World};
use crate::error::{Error, Result};

/// The presets that come with the crate: the methods that the command line knows. A preset's table
/// `for.TASK` holds what differs for that task; `base` names a preset that it differs from.
const PRESETS: [(&str, &str); 9] = [
    ("random", include_str!("../../data/presets/random.toml")),
    ("scripted", include_str!("../../data/presets/scripted.toml")),
    ("oracle", include_str!("../../data/presets/oracle.toml")),
    ("pets", include_str!("../../data/presets/pets.toml")),
    ("dreamer", include_str!("../../data/presets/dreamer.toml")),
    ("planet", include_str!("../../data/presets/planet.toml")),
    ("size1m", include_str!("../../data/presets/size1m.toml")),
    ("sac", include_str!("../../data/presets/sac.toml")),
    ("debug", include_str!("../../data/presets/debug.toml")),
];

/// Names of all methods.
pub fn methods() -> impl Iterator<Item = &'static str> {
    PRESETS.iter().map(|(name, _)| *name)
}

/// The kinds of agent that a method can be made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AgentKind {
    /// [`Random`].
    Random,
    /// [`Scripted`].
    Scripted,
    /// [`Oracle`].
    Oracle,
    /// [`Pets`].
    Pets,
    /// [`Dreamer`].
    Dreamer,
    /// [`Sac`].
    Sac,
}

/// Everything that a run's outcome depends on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// The task.
    pub task: Task,
    /// The method's name: that of its preset.
    pub method: String,
    /// The seed of everything random in the run.
    pub seed: u64,
    /// The kind of agent.
    pub agent: AgentKind,
    /// Environment steps to train for, random warm-up included.
    pub steps: usize,
    /// Environment steps between evaluations.
    #[serde(default = "default_evaluate_every")]
    pub evaluate_every: usize,
    /// Episodes of an evaluation during training.
    #[serde(default = "default_evaluation_episodes")]
    pub evaluation_episodes: usize,
    /// Episodes of the test at the end.
    #[serde(default = "default_test_episodes")]
    pub test_episodes: usize,
    /// Options of the environment.
    #[serde(default)]
    pub env: TableOptions,
    /// Settings of the oracle, for agents of that kind.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub oracle: Option<OracleConfig>,
    /// Settings of PETS, for agents of that kind.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pets: Option<PetsConfig>,
    /// Settings of Dreamer, for agents of that kind.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dreamer: Option<DreamerConfig>,
    /// Settings of SAC, for agents of that kind.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sac: Option<SacConfig>,
}

fn default_evaluate_every() -> usize {
    1000
}

fn default_evaluation_episodes() -> usize {
    20
}

fn default_test_episodes() -> usize {
    100
}

impl RunConfig {
    /// A method's preset for a task, changed by a file of the same form if one is given, and by
    /// `steps` if it is given.
    ///
    /// # Errors
    /// If the method is unknown, the file cannot be read, or a field or value in it is wrong.
    pub fn new(task: Task, method: &str, seed: u64, steps: Option<usize>, file: Option<&Path>) -> Result<Self> {
        let mut table = preset(task, method)?;
        if let Some(path) = file {
            let text = std::fs::read_to_string(path).map_err(Error::io("read", path))?;
            let mut changes: Table = toml::from_str(&text).map_err(|problem| bad_config(path, &problem))?;
            specialise(&mut changes, task);
            merge(&mut table, changes);
        }
        table.insert("task".into(), Value::String(task.name().into()));
        table.insert("method".into(), Value::String(method.into()));
        table.insert("seed".into(), Value::Integer(seed as i64));
        if let Some(steps) = steps {
            table.insert("steps".into(), Value::Integer(steps as i64));
        }
        let path = file.unwrap_or(Path::new(method));
        let config: Self = table.try_into().map_err(|problem| bad_config(path, &problem))?;
        config.check()?;
        Ok(config)
    }

    /// Reads the `config.toml` of a run.
    ///
    /// # Errors
    /// If there is none, or it is not one of ours.
    pub fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).map_err(Error::io("read", path))?;
        let config: Self = toml::from_str(&text).map_err(|problem| bad_config(path, &problem))?;
        config.check()?;
        Ok(config)
    }

    fn check(&self) -> Result<()> {
        for (name, value) in [
            ("evaluate_every", self.evaluate_every),
            ("evaluation_episodes", self.evaluation_episodes),
            ("test_episodes", self.test_episodes),
        ] {
            if value == 0 {
                return Err(Error::BadSetting(format!("`{name}` must be at least 1")));
            }
        }
        if self.env.horizon == Some(0) {
            return Err(Error::BadSetting("`env.horizon` must be at least 1".into()));
        }
        Ok(())
    }

    /// Whether the method learns; the others are only tested.
    pub fn learns(&self) -> bool {
        self.steps > 0 && matches!(self.agent, AgentKind::Pets | AgentKind::Dreamer | AgentKind::Sac)
    }

    /// The run's world.
    ///
    /// # Errors
    /// If the options do not suit the task.
    pub fn world(&self) -> Result<World> {
        self.task.make_with(self.env)
    }

    /// The run's agent, before it has learned anything.
    ///
    /// # Errors
    /// If a setting cannot be used, or the task has no policy of the kind.
    pub fn agent(&self) -> Result<Box<dyn Agent>> {
        let world = self.world()?;
        Ok(match self.agent {
            AgentKind::Random => Box::new(Random::new(world.spec(), self.seed)),
            AgentKind::Scripted => Box::new(Scripted::new(self.task, self.env)?),
            AgentKind::Oracle => {
                Box::new(Oracle::new(self.task, self.env, self.oracle.clone().unwrap_or_default(), self.seed)?)
            }
            AgentKind::Pets => {
                let spec = world.spec().clone();
                Box::new(Pets::new(&spec, Arc::new(world), self.pets.clone().unwrap_or_default(), self.seed)?)
            }
            AgentKind::Dreamer => {
                Box::new(Dreamer::new(world.spec(), self.dreamer.clone().unwrap_or_default(), self.seed)?)
            }
            AgentKind::Sac => Box::new(Sac::new(world.spec(), self.sac.clone().unwrap_or_default(), self.seed)?),
        })
    }
}

/// The settings of a method for a task: its preset's, over those of the preset that it names as its `base`.
fn preset(task: Task, method: &str) -> Result<Table> {
    let found = PRESETS.iter().find(|(name, _)| *name == method);
    let (_, text) = found.ok_or_else(|| Error::unknown("method", method, methods()))?;
    let mut table: Table = toml::from_str(text).expect("our presets are TOML");
    specialise(&mut table, task);
    let Some(Value::String(base)) = table.remove("base") else { return Ok(table) };
    let mut whole = preset(task, &base)?;
    merge(&mut whole, table);
    Ok(whole)
}

/// Puts the part of a table that is for this task over the rest of it.
fn specialise(table: &mut Table, task: Task) {
    if let Some(Value::Table(mut by_task)) = table.remove("for")
        && let Some(Value::Table(part)) = by_task.remove(task.name())
    {
        merge(table, part);
    }
}

/// Puts `over` over `base`, table by table.
fn merge(base: &mut Table, over: Table) {
    for (key, value) in over {
        match (base.get_mut(&key), value) {
            (Some(Value::Table(base)), Value::Table(over)) => merge(base, over),
            (_, value) => {
                base.insert(key, value);
            }
        }
    }
}

/// One line of what is wrong with a configuration; for an unknown field, with the closest known one.
fn bad_config(path: &Path, problem: &toml::de::Error) -> Error {
    let message = problem.message();
    let mut names = message.split('`').skip(1).step_by(2);
    let problem = match (message.starts_with("unknown field"), names.next()) {
        (true, Some(field)) => Error::unknown("field", field, names).to_string(),
        _ => message.trim_end().to_string(),
    };
    Error::BadConfig { path: path.into(), problem }
}
