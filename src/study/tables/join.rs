//! Joins the tables of several studies into those of one.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use polars::prelude::*;

use super::admission::{Admission, Candidate};
use super::gather::concatenate;
use super::{Tables, inside, numbers, strings};
use crate::error::{Error, Result};

/// Task, method and seed.
type RunName = (String, String, u64);

impl Tables {
    /// Reads the tables of several studies as those of one, for runs that were made at different times or on different machines.
    /// Methods come in the order of their first runs, and the runs of a method in that of their seeds. A run that is there twice, or
    /// that has other settings than the first with its task and method, is left out by name, as in [`Tables::gather`].
    ///
    /// # Errors
    /// As [`Tables::read`], for each of them and for all together; or if one lacks a column that another has.
    pub fn read_all(folders: &[PathBuf]) -> Result<Self> {
        let (mut studies, mut taken) = (Vec::new(), Vec::new());
        let (mut left_out, mut methods) = (Vec::new(), Vec::new());
        let mut admission = Admission::default();
        for (at, folder) in folders.iter().enumerate() {
            let tables = Self::read(folder)?;
            let mut settings = settings(&tables)?;
            for name in run_names(&tables.tests).map_err(inside)? {
                let (task, method, seed) = name.clone();
                let settings = settings.remove(&name).unwrap_or_default();
                let run = Candidate { task, method, seed, starts: String::new(), settings };
                if let Some(objection) = admission.objection(&run) {
                    let run = format!("{}: {} on {} with seed {}", folder.display(), name.1, name.0, name.2);
                    left_out.push((run, format!("it {objection}")));
                    continue;
                }
                admission.admit(&run);
                let method = (name.0.clone(), name.1.clone());
                if !methods.contains(&method) {
                    methods.push(method);
                }
                taken.push((at, name));
            }
            left_out.extend(tables.missing_runs()?);
            studies.push(tables);
        }
        let place = |(task, method, seed): &RunName| {
            (methods.iter().position(|(of, name)| (of, name) == (task, method)), *seed)
        };
        taken.sort_by_key(|(_, name)| place(name));
        let joined = |table: fn(&Self) -> &DataFrame| {
            same_columns(studies.iter().map(table).zip(folders))?;
            let rows = taken.iter().filter_map(|(at, name)| of_run(table(&studies[*at]), name));
            concatenate(rows.collect()).map_err(inside)
        };
        Self::summarised(
            [joined(|t| &t.evaluations)?, joined(|t| &t.models)?, joined(|t| &t.values)?, joined(|t| &t.tests)?],
            joined(|t| &t.runs)?,
            super::gather::left_out(left_out).map_err(inside)?,
        )
    }
}

/// A table with fewer columns comes from an earlier version.
fn same_columns<'a>(tables: impl Iterator<Item = (&'a DataFrame, &'a PathBuf)>) -> Result<()> {
    let mut tables = tables.filter(|(table, _)| table.width() > 0);
    let Some((first, folder)) = tables.next() else { return Ok(()) };
    match tables.find(|(table, _)| table.get_column_names() != first.get_column_names()) {
        Some((_, other)) => Err(Error::Config(format!(
            "the tables in {} and {} do not have the same columns: they come from versions that cannot be joined",
            folder.display(),
            other.display()
        ))),
        None => Ok(()),
    }
}

/// The names of the runs in a table, in the order of their first rows.
fn run_names(table: &DataFrame) -> PolarsResult<Vec<RunName>> {
    let seeds = numbers(table, "seed")?.into_iter().map(|seed| seed.unwrap_or_default() as u64);
    let names = strings(table, "task")?.into_iter().zip(strings(table, "method")?).zip(seeds);
    let mut seen = BTreeSet::new();
    let names = names.map(|((task, method), seed)| (task, method, seed));
    Ok(names.filter(|name| seen.insert(name.clone())).collect())
}

/// The configuration of each recorded run.
fn settings(tables: &Tables) -> Result<BTreeMap<RunName, toml::Table>> {
    let mut settings = BTreeMap::new();
    for run in tables.runs()? {
        let table: toml::Table = run.configuration.parse().map_err(|problem: toml::de::Error| {
            let problem = problem.message();
            Error::Config(format!("`{}` on `{}`: its configuration is not TOML: {problem}", run.method, run.task))
        })?;
        settings.insert((run.task, run.method, run.seed), table);
    }
    Ok(settings)
}

/// The rows of a run; `None` if the table has none at all.
fn of_run(table: &DataFrame, (task, method, seed): &RunName) -> Option<LazyFrame> {
    let this = col("task").eq(lit(task.as_str())).and(col("method").eq(lit(method.as_str())));
    (table.width() > 0).then(|| table.clone().lazy().filter(this.and(col("seed").eq(lit(*seed as i64)))))
}
