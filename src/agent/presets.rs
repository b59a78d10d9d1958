//! The presets that come with the crate, as TOML: the methods that the command line knows, with what differs for a task.
//!
//! A preset's table `for.TASK` holds what differs for that task; `base` names a preset that it builds on.

use serde::de::DeserializeOwned;
use toml::{Table, Value};

use super::{DreamerConfig, OracleConfig, PetsConfig, SacConfig};
use crate::error::{Error, Result};

/// Each preset's name and text.
pub(crate) const PRESETS: [(&str, &str); 9] = [
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

    /// The settings of a method for a task; those of [`Preset::preset`] if nothing differs for that task.
    ///
    /// # Errors
    /// As [`Preset::preset`].
    fn preset_for(method: &str, task: &str) -> Result<Self> {
        let mut table = preset_table(&PRESETS, task, method)?;
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

impl Preset for OracleConfig {
    const TABLE: &'static str = "oracle";
}

/// The settings of a method for a task: its preset's, over those of the preset that it names as its `base`.
pub(crate) fn preset_table(presets: &[(impl AsRef<str>, impl AsRef<str>)], task: &str, method: &str) -> Result<Table> {
    let found = presets.iter().find(|(name, _)| name.as_ref() == method);
    let (_, text) =
        found.ok_or_else(|| Error::unknown("method", method, presets.iter().map(|(name, _)| name.as_ref())))?;
    let mut table: Table = toml::from_str(text.as_ref())
        .map_err(|problem| Error::Config(format!("the preset `{method}`: {}", problem.message())))?;
    specialise(&mut table, task);
    let Some(Value::String(base)) = table.remove("base") else { return Ok(table) };
    let mut whole = preset_table(presets, task, &base)?;
    merge(&mut whole, table);
    Ok(whole)
}

/// Puts the part of a table that is for this task over the rest of it.
pub(crate) fn specialise(table: &mut Table, task: &str) {
    if let Some(Value::Table(mut by_task)) = table.remove("for")
        && let Some(Value::Table(part)) = by_task.remove(task)
    {
        merge(table, part);
    }
}

/// Puts `over` over `base`, table by table.
pub(crate) fn merge(base: &mut Table, over: Table) {
    for (key, value) in over {
        match (base.get_mut(&key), value) {
            (Some(Value::Table(base)), Value::Table(over)) => merge(base, over),
            (_, value) => {
                base.insert(key, value);
            }
        }
    }
}
