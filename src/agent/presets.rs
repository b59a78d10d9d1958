//! The presets that come with the crate, as TOML: the methods that the command line knows, with what differs for a task.
//!
//! A preset's table `for.TASK` holds what differs for that task; `base` names a preset that it builds on.

use serde::de::DeserializeOwned;
use toml::{Table, Value};

use super::{DreamerConfig, OracleConfig, PetsConfig, SacConfig, TdMpc2Config};
use crate::error::{Error, Result};
use crate::settings::{choices, merge};

/// Each preset's name and text.
pub(crate) const PRESETS: [(&str, &str); 11] = [
    ("random", include_str!("../../data/presets/random.toml")),
    ("scripted", include_str!("../../data/presets/scripted.toml")),
    ("oracle", include_str!("../../data/presets/oracle.toml")),
    ("pets", include_str!("../../data/presets/pets.toml")),
    ("pets-learned", include_str!("../../data/presets/pets-learned.toml")),
    ("dreamer", include_str!("../../data/presets/dreamer.toml")),
    ("planet", include_str!("../../data/presets/planet.toml")),
    ("size1m", include_str!("../../data/presets/size1m.toml")),
    ("tdmpc2", include_str!("../../data/presets/tdmpc2.toml")),
    ("sac", include_str!("../../data/presets/sac.toml")),
    ("debug", include_str!("../../data/presets/debug.toml")),
];

/// The methods that have a preset.
pub fn method_names() -> impl Iterator<Item = &'static str> {
    PRESETS.iter().map(|(name, _)| *name)
}

/// Settings that can be had as a preset, with or without a task.
///
/// ```
/// use handful::prelude::*;
///
/// let config = PetsConfig::preset("pets")?;
/// let for_push = PetsConfig::preset_for("pets", "push")?;
/// assert!(for_push.terminal_weight > config.terminal_weight);
/// # Ok::<(), handful::error::Error>(())
/// ```
pub trait Preset: DeserializeOwned + Default {
    /// The table of a preset that holds these settings: "pets", "sac", ...
    const TABLE: &'static str;

    /// The settings of a method, whatever the task.
    ///
    /// # Errors
    /// If there is no such method, or it is one of another kind of agent.
    fn preset(method: &str) -> Result<Self> {
        Self::preset_for(method, "")
    }

    /// The settings of a method for a task; those of [`Preset::preset`] if nothing differs for that task. These are the agent's own:
    /// the numbers of steps and episodes of a preset, and its options of the environment (`planning_reward`, for example, with which
    /// `pets` plans on `push`), are in [`Registry::config`](crate::study::registry::Registry::config).
    ///
    /// # Errors
    /// As [`Preset::preset`].
    fn preset_for(method: &str, task: &str) -> Result<Self> {
        let mut table = preset_table(&PRESETS, task, method, &choices::<Self>(Self::TABLE))?;
        if table.get("agent").and_then(Value::as_str) != Some(Self::TABLE) {
            return Err(Error::Config(format!("the method `{method}` has no settings of the kind `{}`", Self::TABLE)));
        }
        let settings = table.remove(Self::TABLE).unwrap_or_else(|| Value::Table(Table::new()));
        settings.try_into().map_err(|problem: toml::de::Error| Error::Config(problem.message().into()))
    }
}

impl Preset for SacConfig {
    const TABLE: &'static str = "sac";
}

impl Preset for PetsConfig {
    const TABLE: &'static str = "pets";
}

impl Preset for DreamerConfig {
    const TABLE: &'static str = "dreamer";
}

impl Preset for TdMpc2Config {
    const TABLE: &'static str = "tdmpc2";
}

impl Preset for OracleConfig {
    const TABLE: &'static str = "oracle";
}

/// The settings of a method for a task: its preset's, over those of the preset that it names as its `base`. `choices` are the
/// paths of tables that name a variant ([`merge`]).
pub(crate) fn preset_table(
    presets: &[(impl AsRef<str>, impl AsRef<str>)],
    task: &str,
    method: &str,
    choices: &[String],
) -> Result<Table> {
    let mut tables = Vec::new();
    let mut next = Some(method.to_string());
    while let Some(name) = next {
        let wrong = |problem: &str| Error::Config(format!("the preset `{name}`: {problem}"));
        if tables.len() == presets.len() {
            return Err(wrong("it is its own `base`"));
        }
        let found = presets.iter().find(|(other, _)| other.as_ref() == name);
        let (_, text) =
            found.ok_or_else(|| Error::unknown("method", &name, presets.iter().map(|(name, _)| name.as_ref())))?;
        let mut table: Table = toml::from_str(text.as_ref()).map_err(|problem| wrong(problem.message()))?;
        specialise(&mut table, task, choices).map_err(|problem| wrong(&problem.to_string()))?;
        next = match table.remove("base") {
            None => None,
            Some(Value::String(base)) => Some(base),
            Some(_) => return Err(wrong("`base` must be the name of a preset")),
        };
        tables.push(table);
    }
    let mut whole = Table::new();
    for table in tables.into_iter().rev() {
        rename_settings(&mut whole, table.get("agent"));
        merge(&mut whole, table, choices);
    }
    Ok(whole)
}

/// An agent that replaces that of the `base` has its settings: a variant reads them in a table of its own name.
fn rename_settings(base: &mut Table, agent: Option<&Value>) {
    let name = |agent: Option<&Value>| agent.and_then(Value::as_str).map(String::from);
    let (Some(agent), Some(replaced)) = (name(agent), name(base.get("agent"))) else { return };
    if let Some(settings) = base.remove(&replaced) {
        base.insert(agent, settings);
    }
}

/// Puts the part of a table that is for this task over the rest of it.
///
/// # Errors
/// If `for` is not a table with a table for each task.
pub(crate) fn specialise(table: &mut Table, task: &str, choices: &[String]) -> Result<()> {
    let Some(by_task) = table.remove("for") else { return Ok(()) };
    let mut by_task: std::collections::BTreeMap<String, Table> =
        by_task.try_into().map_err(|_| Error::Config("`for` must hold a table for each task: `[for.TASK]`".into()))?;
    if let Some(part) = by_task.remove(task) {
        merge(table, part, choices);
    }
    Ok(())
}
