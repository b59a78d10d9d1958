//! Which runs the tables of a study are made of.

use std::collections::{BTreeMap, BTreeSet};

use polars::prelude::*;

use super::{Tables, inside, numbers, strings};
use crate::error::{Error, Result};

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
    /// Its configuration, as TOML.
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

    /// The folders of runs that are in no table, each with the reason.
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

    /// The seeds of each method that learns, by task and method.
    ///
    /// # Errors
    /// If the table lacks a column.
    pub fn seeds_of_learners(&self) -> Result<BTreeMap<(String, String), BTreeSet<u64>>> {
        let mut seeds: BTreeMap<_, BTreeSet<u64>> = BTreeMap::new();
        for (task, method, seed) in runs(&self.evaluations).map_err(inside)? {
            seeds.entry((task, method)).or_default().extend(seed.parse::<u64>());
        }
        Ok(seeds)
    }
}

/// Every run was tested, and of a method that learns every run was evaluated.
pub(super) fn check_runs(evaluations: &DataFrame, others: [&DataFrame; 3], tests: &DataFrame) -> Result<()> {
    let [evaluated, tested] = [evaluations, tests].map(|table| runs(table).map_err(inside));
    let (evaluated, tested) = (evaluated?, tested?);
    if tested.is_empty() {
        return Err(Error::Config("the study has no test episode: there is nothing to report".into()));
    }
    let missing = |run: &(String, String, String), table: &str| {
        let (task, method, seed) = run;
        Err(Error::Config(format!(
            "the study is incomplete: `{method}` on `{task}` with seed {seed} is not in its {table}"
        )))
    };
    for table in others.into_iter().chain([evaluations]) {
        if let Some(run) = runs(table).map_err(inside)?.difference(&tested).next() {
            return missing(run, "tests");
        }
    }
    let learns = |(task, method, _): &&(String, String, String)| {
        evaluated.iter().any(|(of, other, _)| (of, other) == (task, method))
    };
    match tested.difference(&evaluated).find(learns) {
        Some(run) => missing(run, "evaluations"),
        None => Ok(()),
    }
}

/// Task, method and seed of each run in a table.
fn runs(table: &DataFrame) -> PolarsResult<BTreeSet<(String, String, String)>> {
    if table.width() == 0 {
        return Ok(BTreeSet::new());
    }
    let seeds = table.column("seed")?.cast(&DataType::String)?;
    let seeds = seeds.str()?.iter().map(|seed| seed.unwrap_or_default().to_string());
    let names = strings(table, "task")?.into_iter().zip(strings(table, "method")?);
    Ok(names.zip(seeds).map(|((task, method), seed)| (task, method, seed)).collect())
}
