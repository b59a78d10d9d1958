//! What a run is: task, method, seed, budget, settings.

use std::path::Path;

use serde::{Deserialize, Serialize, de::DeserializeOwned};
use toml::{Table, Value};

use super::names::check_name;
use super::starts::{LIMIT, Starts, check_below};
use crate::error::{Error, Result, shortened};

/// Everything that a run's outcome depends on. In TOML the agent's settings stand in the table that is named like it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// The task: the name of a registered environment.
    pub task: String,
    /// The method's name: that of its preset.
    pub method: String,
    /// The seed of everything random in the run, below [`LIMIT`].
    pub seed: u64,
    /// The kind of agent: the name of a registered one.
    pub agent: String,
    /// Environment steps to train for, random warm-up included; 0 for a policy that does not learn.
    pub steps: usize,
    /// Environment steps between evaluations. The presets of a task agree on it and on the episodes, because a coarser grid or
    /// fewer episodes would make their learning curves incomparable.
    #[serde(default = "default_evaluate_every")]
    pub evaluate_every: usize,
    /// Episodes of an evaluation during training.
    #[serde(default = "default_evaluation_episodes")]
    pub evaluation_episodes: usize,
    /// Episodes of the test at the end.
    #[serde(default = "default_test_episodes")]
    pub test_episodes: usize,
    /// The initial states of evaluations and test: `test`, or `development` for a run that helps to choose settings.
    #[serde(default)]
    pub starts: Starts,
    /// What [`SHAKE`](crate::rng::SHAKE) was when the run began; it is resumed with the same.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub shake: u64,
    /// Options of the environment.
    #[serde(default)]
    pub env: Table,
    /// Settings of the agent.
    #[serde(skip)]
    pub settings: Table,
}

/// The first key of a run's `config.toml`: how many values follow. A file that was cut short has fewer, and must not be
/// completed with defaults.
const VALUES: &str = "values";

/// What no agent can be called, because a configuration or a preset has another entry of that name.
const RESERVED: [&str; 14] = [
    VALUES,
    "task",
    "method",
    "seed",
    "agent",
    "steps",
    "evaluate_every",
    "evaluation_episodes",
    "test_episodes",
    "starts",
    "shake",
    "env",
    "for",
    "base",
];

/// What is wrong with an agent's name, if it is taken.
fn reserved(agent: &str) -> Option<String> {
    let said = || format!("an agent cannot be called `{agent}`: configurations have another entry of that name");
    RESERVED.contains(&agent).then(said)
}

fn count_values(table: &Table) -> i64 {
    table.values().map(|value| value.as_table().map_or(1, count_values)).sum()
}

fn default_evaluate_every() -> usize {
    500
}

fn default_evaluation_episodes() -> usize {
    20
}

fn default_test_episodes() -> usize {
    100
}

fn is_zero(number: &u64) -> bool {
    *number == 0
}

impl RunConfig {
    /// Reads the `config.toml` of a run.
    ///
    /// # Errors
    /// If there is none, or it is not one of ours.
    pub fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).map_err(Error::io("read", path))?;
        let table: Table = toml::from_str(&text).map_err(|problem| bad_config(path, &problem))?;
        let cut =
            |what: &str| Err(Error::Config(format!("{}: {what}; restore the file, or remove the run", path.display())));
        // Files of earlier versions do not tell how many values they have.
        if let Some(count) = table.get(VALUES) {
            let left = count_values(&table) - 1;
            if *count != Value::Integer(left) {
                return cut(&format!("{left} values are left of {count}"));
            }
        }
        // A number that lost its last digits is a number, too.
        if !text.is_empty() && !text.ends_with('\n') {
            return cut("its last line has no end");
        }
        let config = Self::from_toml(&text).map_err(|problem| bad_config(path, &problem))?;
        config.check().map_err(|problem| Error::Config(format!("{}: {problem}", path.display())))?;
        Ok(config)
    }

    /// From the text of `config.toml`, whole or not.
    pub(super) fn from_toml(text: &str) -> Result<Self, toml::de::Error> {
        let mut table: Table = toml::from_str(text)?;
        table.remove(VALUES);
        upgrade_keys(&mut table);
        Self::from_table(table)
    }

    /// From the table that [`RunConfig::to_table`] makes.
    pub(crate) fn from_table(mut table: Table) -> Result<Self, toml::de::Error> {
        let agent = table.get("agent").and_then(Value::as_str).unwrap_or_default().to_string();
        if let Some(problem) = reserved(&agent) {
            return Err(serde::de::Error::custom(problem));
        }
        if let Some(other) = OUR_AGENTS.iter().find(|other| **other != agent && table.contains_key(**other)) {
            return Err(serde::de::Error::custom(format!(
                "[{other}] is for another kind of agent; settings of this one stand in [{agent}]"
            )));
        }
        let settings = match table.remove(&agent) {
            Some(settings) => settings.try_into()?,
            None => Table::new(),
        };
        Ok(Self { settings, ..table.try_into()? })
    }

    /// All of it as one table.
    pub(crate) fn to_table(&self) -> Table {
        let mut table = Table::try_from(self).expect("a configuration is TOML");
        if !self.settings.is_empty() {
            table.insert(self.agent.clone(), Value::Table(self.settings.clone()));
        }
        table
    }

    /// The text of `config.toml`.
    pub(crate) fn to_toml(&self) -> String {
        let count = count_values(&self.to_table());
        let mut text = format!("{VALUES} = {count}\n") + &toml::to_string(self).expect("a configuration is TOML");
        if !self.settings.is_empty() {
            let settings = Table::from_iter([(self.agent.clone(), Value::Table(self.settings.clone()))]);
            text = text + "\n" + &toml::to_string(&settings).expect("settings are TOML");
        }
        text
    }

    /// # Errors
    /// If a name is not an identifier, the agent has the name of another entry, or a number lies outside its range.
    pub(crate) fn check(&self) -> Result<()> {
        for (what, name) in [("a task", &self.task), ("a method", &self.method), ("an agent", &self.agent)] {
            check_name(what, name)?;
        }
        if let Some(problem) = reserved(&self.agent) {
            return Err(Error::Config(problem));
        }
        check_below("seed", self.seed, LIMIT)?;
        // An evaluation has no more episodes than there are seeds for.
        for (name, value, limit) in [
            ("evaluate_every", self.evaluate_every, u64::MAX),
            ("evaluation_episodes", self.evaluation_episodes, LIMIT),
            ("test_episodes", self.test_episodes, LIMIT),
        ] {
            if value == 0 {
                return Err(Error::Config(format!("`{name}` must be at least 1")));
            }
            check_below(name, value as u64, limit)?;
        }
        Ok(())
    }

    /// Whether the method learns; the others are only tested.
    pub fn learns(&self) -> bool {
        self.steps > 0
    }

    /// The agent's settings.
    ///
    /// # Errors
    /// If the agent's settings are of another type.
    pub fn settings<C: DeserializeOwned>(&self) -> Result<C> {
        let settings = self.settings.clone().try_into();
        settings.map_err(|problem: toml::de::Error| Error::Config(problem.message().into()))
    }

    /// The same run with other settings of the agent.
    ///
    /// # Panics
    /// If the settings cannot be written as TOML.
    #[must_use]
    pub fn with_settings<C: Serialize>(self, settings: &C) -> Self {
        Self { settings: settings_table(settings), ..self }
    }
}

/// Settings as a table, by way of their text: there an f32 has its shortest form (0.95, not 0.949999988).
///
/// # Panics
/// If they cannot be written as TOML.
pub(crate) fn settings_table(settings: &impl Serialize) -> Table {
    toml::from_str(&toml::to_string(settings).expect("settings are TOML")).expect("what was just written can be read")
}

/// The agents whose settings have had other names.
const OUR_AGENTS: [&str; 5] = ["pets", "oracle", "dreamer", "tdmpc2", "sac"];

/// Keys that had another name in earlier versions, with the table in which they stand.
const RENAMED_KEYS: [(&str, &str, &str); 15] = [
    ("pets", "tail", "terminal_weight"),
    ("oracle", "tail", "terminal_weight"),
    ("pets", "caution", "disagreement_penalty"),
    ("pets", "curiosity", "disagreement_bonus"),
    ("pets", "warm_up_colour", "warm_up_noise_beta"),
    ("dreamer", "warm_up_colour", "warm_up_noise_beta"),
    ("dreamer", "exploration_colour", "exploration_noise_beta"),
    ("ensemble", "anneal", "final_learning_rate_fraction"),
    ("control", "hold", "action_repeat"),
    ("icem", "colour", "noise_beta"),
    ("gradient", "colour", "noise_beta"),
    ("rssm", "memory", "deter"),
    ("rssm", "categoricals", "stoch"),
    ("sac", "polyak", "target_rate"),
    ("behaviour", "slow_rate", "target_rate"),
];

/// Gives the keys and values of earlier versions the names that they have now: those of our agents, not of the user's own.
pub(crate) fn upgrade_keys(table: &mut Table) {
    for (name, value) in table.iter_mut() {
        match value {
            Value::Table(settings) if OUR_AGENTS.contains(&name.as_str()) => upgrade_table(name, settings),
            Value::Table(by_task) if name == "for" => {
                by_task.iter_mut().filter_map(|(_, part)| part.as_table_mut()).for_each(upgrade_keys);
            }
            _ => {}
        }
    }
}

fn upgrade_table(name: &str, table: &mut Table) {
    for (_, old, new) in RENAMED_KEYS.iter().filter(|(within, ..)| *within == name) {
        // Where both stand, the old one is an unknown field.
        if !table.contains_key(*new)
            && let Some(value) = table.remove(*old)
        {
            table.insert((*new).into(), value);
        }
    }
    if let Some(Value::String(propagation)) = table.get_mut("propagation") {
        match propagation.as_str() {
            "members" => *propagation = "ts-inf-mean".into(),
            "mean" => *propagation = "expectation".into(),
            _ => {}
        }
    }
    if let Some(Value::Table(risk)) = table.get_mut("risk")
        && let Some(share) = risk.remove("worst")
    {
        risk.insert("cvar".into(), share);
    }
    for (key, value) in table.iter_mut() {
        if let Value::Table(inner) = value {
            upgrade_table(key, inner);
        }
    }
}

/// One line of what is wrong with a configuration, and where; for an unknown field, with the closest known one.
pub(crate) fn bad_config(path: &Path, source: &toml::de::Error) -> Error {
    let message = source.message();
    let unknown = message.strip_prefix("unknown field `").and_then(|rest| rest.rsplit_once("`, expected"));
    let problem = match unknown {
        Some((field, known)) => {
            let known: Vec<&str> = known.split('`').skip(1).step_by(2).collect();
            let said = Error::unknown("field", field, known.iter().copied()).to_string();
            let at_the_top = known.contains(&"evaluate_every");
            if at_the_top { said + "; settings of an agent belong in its table, such as `[sac]`" } else { said }
        }
        None if message.contains("unit variant, expected newtype variant") => {
            "a name alone is not enough: write `{ NAME = VALUE }`, or `{ NAME = {} }` if its value is a table of settings".into()
        }
        None => shortened(message.trim_end(), 300),
    };
    // The path of the field is told only as the last line of the whole message, and the line of the file in its first.
    let whole = source.to_string();
    let field = whole.trim_end().rsplit_once("\nin `").and_then(|(_, field)| field.strip_suffix('`'));
    let line = whole.lines().next().and_then(|line| line.strip_prefix("TOML parse error at "));
    let problem = match (field, line) {
        (Some(field), _) => format!("`{}`: {problem}", shortened(field, 100)),
        (None, Some(line)) => format!("{line}: {problem}"),
        (None, None) => problem,
    };
    Error::ConfigFile { path: path.into(), problem, source: Box::new(source.clone()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Otherwise an agent of that name would put its settings into their place.
    #[test]
    fn no_agent_is_called_like_an_entry() {
        let text = "task = \"reach\"\nmethod = \"sac\"\nseed = 0\nagent = \"sac\"\nsteps = 1\nshake = 1\n";
        let config: RunConfig = toml::from_str(text).expect("a configuration");
        for entry in config.to_table().keys().map(String::as_str).chain([VALUES, "for", "base"]) {
            let problem = RunConfig { agent: entry.into(), ..config.clone() }.check().expect_err(entry).to_string();
            assert!(problem.contains(&format!("cannot be called `{entry}`")), "{problem}");
        }
    }
}
