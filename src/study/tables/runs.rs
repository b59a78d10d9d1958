//! Which runs the tables of a study are made of.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use polars::prelude::*;

use super::gather::left_out;
use super::{Tables, inside, numbers, strings};
use crate::agent::method_names;
use crate::error::{Error, Result, shortened};
use crate::settings::value_at;
use crate::study::config::upgrade_keys;
use crate::study::folder::difference;
use crate::study::version::separated;

/// Task, method and seed.
pub(super) type RunName = (String, String, u64);

/// A run of a study.
#[derive(Clone, Debug, PartialEq)]
pub struct Run {
    /// The task.
    pub task: String,
    /// The method.
    pub method: String,
    /// The seed.
    pub seed: u64,
    /// The version of the program that made it; empty if that is not known.
    pub version: String,
    /// Its configuration, as TOML; empty if that is not known.
    pub configuration: String,
}

impl Tables {
    /// The runs, as far as they are recorded.
    ///
    /// # Errors
    /// If the table lacks a column.
    pub fn runs(&self) -> Result<Vec<Run>> {
        if self.runs.width() == 0 {
            return Ok(Vec::new());
        }
        let column = |name: &str| strings(&self.runs, name).map_err(inside);
        let seeds = numbers(&self.runs, "seed").map_err(inside)?.into_iter().map(|seed| seed.unwrap_or(0.0) as u64);
        let names = column("task")?.into_iter().zip(column("method")?).zip(seeds);
        let texts = column("version")?.into_iter().zip(column("configuration")?);
        let run =
            |(((task, method), seed), (version, configuration))| Run { task, method, seed, version, configuration };
        Ok(names.zip(texts).map(run).collect())
    }

    /// The runs, or their folders, that are in no table, and what else lies among them, each with the reason.
    ///
    /// # Errors
    /// If the table lacks a column.
    pub fn missing_runs(&self) -> Result<Vec<(String, String)>> {
        if self.left_out.width() == 0 {
            return Ok(Vec::new());
        }
        let column = |name: &str| strings(&self.left_out, name).map_err(inside);
        Ok(column("run")?.into_iter().zip(column("reason")?).collect())
    }

    /// Adds to those what is in no table for another reason.
    ///
    /// # Errors
    /// If the table of them lacks a column.
    pub(crate) fn leave_out(&mut self, others: impl IntoIterator<Item = (String, String)>) -> Result<()> {
        let mut missing = self.missing_runs()?;
        missing.extend(others);
        self.left_out = left_out(missing).map_err(inside)?;
        Ok(())
    }

    /// Whether a method has the reward of a task as a function, or only the rewards that it receives: as its runs' configuration says,
    /// or its name where that is not recorded. None for agents that are not this library's.
    ///
    /// # Errors
    /// If the table lacks a column, or a configuration is not TOML.
    pub fn is_told_the_reward(&self, task: &str, method: &str) -> Result<Option<bool>> {
        let mut runs = self.runs()?;
        runs.retain(|run| run.task == task && run.method == method);
        let settings = settings(&runs)?;
        // Runs of one method have the same settings.
        Ok(settings.values().next().map_or_else(|| is_told_by_name(method), |settings| is_told(settings, method)))
    }

    /// Sentences that say which methods of a task do not have the same environment, or plan with another reward than the one that is
    /// measured, as far as configurations are recorded, and of which tasks different versions of the program made the runs.
    ///
    /// # Errors
    /// If the table lacks a column, or a configuration is not TOML.
    pub(in crate::study) fn differences_of_environments(&self) -> Result<Vec<String>> {
        let mut sentences = Vec::new();
        let mut first: BTreeMap<String, (String, toml::Table)> = BTreeMap::new();
        let runs = self.runs()?;
        let settings = settings(&runs)?;
        for (task, method) in self.tasks_and_methods()? {
            let of_method = |((of, name, _), _): &(&RunName, &toml::Table)| (of, name) == (&task, &method);
            let Some((_, settings)) = settings.iter().find(of_method) else { continue };
            let mut env = settings.get("env").and_then(toml::Value::as_table).cloned().unwrap_or_default();
            let planned = env.remove("planning_reward");
            let planned = planned.as_ref().and_then(toml::Value::as_str);
            let measured = env.get("reward").and_then(toml::Value::as_str);
            if let Some(planned) = planned.filter(|planned| Some(*planned) != measured)
                && is_told(settings, &method) == Some(true)
            {
                sentences.push(format!(
                    "On `{task}`, `{method}` plans with a different reward (`{planned}`) from the one that is measured and that the other \
                     methods receive."
                ));
            }
            match first.get(&task) {
                None => _ = first.insert(task, (method, env)),
                Some((other, theirs)) => {
                    let how = difference(&env, theirs);
                    sentences.extend(how.map(|how| {
                        format!("**Not the same environment:** that of `{method}` on `{task}` is not that of `{other}` ({how}).")
                    }));
                }
            }
        }
        let mut versions: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
        for run in &runs {
            versions.entry(&run.task).or_default().extend(separated(&run.version));
        }
        for (task, _) in versions.into_iter().filter(|(_, versions)| versions.len() > 1) {
            sentences.push(format!(
                "The runs on `{task}` were made by different versions of the program (see the checklist). Whether these simulate alike, \
                 the tables do not say."
            ));
        }
        Ok(sentences)
    }

    /// The seeds of each method that learns, by task and method.
    ///
    /// # Errors
    /// If the table lacks a column.
    pub fn seeds_of_learners(&self) -> Result<BTreeMap<(String, String), BTreeSet<u64>>> {
        let mut seeds: BTreeMap<_, BTreeSet<u64>> = BTreeMap::new();
        for (task, method, seed) in run_names(&self.evaluations).map_err(inside)? {
            seeds.entry((task, method)).or_default().insert(seed);
        }
        Ok(seeds)
    }
}

/// Whether a run with these settings has the reward as a function. None for agents that are not ours.
fn is_told(settings: &toml::Table, method: &str) -> Option<bool> {
    match settings.get("agent").and_then(toml::Value::as_str) {
        Some("oracle") => Some(true),
        Some("pets") => {
            let learns = value_at(settings, "pets.ensemble.learn_reward").and_then(toml::Value::as_bool);
            Some(!learns.unwrap_or(false))
        }
        Some("sac") => {
            let relabelled = value_at(settings, "sac.hindsight").and_then(toml::Value::as_float);
            Some(relabelled.unwrap_or(0.0) > 0.0)
        }
        Some("random" | "scripted" | "dreamer" | "tdmpc2") => Some(false),
        Some(_) => None,
        None => is_told_by_name(method),
    }
}

/// The same where its settings are not recorded.
fn is_told_by_name(method: &str) -> Option<bool> {
    method_names().any(|name| name == method).then(|| ["oracle", "pets"].contains(&method))
}

/// Every run was tested, and of a method that learns every run was evaluated.
pub(super) fn check_runs(tables: &Tables) -> Result<()> {
    let names = |table: &DataFrame| -> Result<BTreeSet<RunName>> {
        Ok(run_names(table).map_err(inside)?.into_iter().collect())
    };
    let (evaluated, tested) = (names(&tables.evaluations)?, names(&tables.tests)?);
    if tested.is_empty() {
        return Err(Error::Config("the study has no test episode: there is nothing to report".into()));
    }
    let others = [
        ("models.csv", &tables.models),
        ("values.csv", &tables.values),
        ("runs.csv", &tables.runs),
        ("evaluations.csv", &tables.evaluations),
    ];
    for (file, table) in others {
        if let Some(run) = names(table)?.difference(&tested).next() {
            return Err(incomplete(run, "tests.csv", file));
        }
    }
    let learns = |(task, method, _): &&RunName| evaluated.iter().any(|(of, other, _)| (of, other) == (task, method));
    match tested.difference(&evaluated).find(learns) {
        Some(run) => Err(incomplete(run, "evaluations.csv", "tests.csv")),
        None => Ok(()),
    }
}

/// For a run that is in one table of a study, but not in another which has to have it.
pub(super) fn incomplete((task, method, seed): &RunName, absent: &str, present: &str) -> Error {
    Error::Config(format!(
        "the study is incomplete: `{method}` on `{task}` with seed {seed} is not in its {absent}, but in its {present}; \
         restore {absent}, or make the tables of the study anew"
    ))
}

/// A run in the table of those that are left out.
pub(super) fn said_of(folder: &Path, (task, method, seed): &RunName) -> String {
    format!("{}: {method} on {task} with seed {seed}", folder.display())
}

/// The run of each row.
pub(super) fn row_names(table: &DataFrame) -> PolarsResult<Vec<RunName>> {
    if table.width() == 0 {
        return Ok(Vec::new());
    }
    let seeds = numbers(table, "seed")?.into_iter().map(|seed| seed.unwrap_or_default() as u64);
    let names = strings(table, "task")?.into_iter().zip(strings(table, "method")?).zip(seeds);
    Ok(names.map(|((task, method), seed)| (task, method, seed)).collect())
}

/// The runs in a table, in the order of their first rows.
pub(super) fn run_names(table: &DataFrame) -> PolarsResult<Vec<RunName>> {
    let mut seen = BTreeSet::new();
    let mut names = row_names(table)?;
    names.retain(|name| seen.insert(name.clone()));
    Ok(names)
}

/// The configuration of each run for which it is recorded.
///
/// # Errors
/// If one is not TOML.
pub(super) fn settings(runs: &[Run]) -> Result<BTreeMap<RunName, toml::Table>> {
    let mut settings = BTreeMap::new();
    for run in runs.iter().filter(|run| !run.configuration.is_empty()) {
        let Run { task, method, seed, configuration, .. } = run;
        let mut table: toml::Table = configuration.parse().map_err(|problem: toml::de::Error| {
            let problem = shortened(problem.message().trim_end(), 200);
            let run = format!("`{method}` on `{task}` with seed {seed}");
            Error::Config(format!("{run}: its configuration in runs.csv is not TOML ({problem}); restore that table"))
        })?;
        // As when a run's folder is read: the number of values is no setting.
        table.remove("values");
        upgrade_keys(&mut table);
        settings.insert((task.clone(), method.clone(), *seed), table);
    }
    Ok(settings)
}
