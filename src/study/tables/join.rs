//! Joins the tables of several studies into those of one.

use std::path::PathBuf;

use polars::prelude::*;

use super::admission::{Admission, Candidate};
use super::gather::{concatenate, left_out};
use super::runs::{RunName, run_names, said_of, settings};
use super::{Tables, inside};
use crate::error::{Error, Result};

impl Tables {
    /// Reads the tables of several studies as those of one, for runs that were made at different times or on different machines.
    /// Methods come in the order of their first runs, and the runs of a method in that of their seeds. A run that is there twice, or
    /// that has other settings than the first with its task and method, is left out by name, as in [`Tables::gather`]. Where the
    /// settings of some are recorded and those of others are not, the latter are recorded as nothing.
    ///
    /// # Errors
    /// As [`Tables::read`], for each of them and for all together; or if one lacks a column that another has.
    pub fn read_all(folders: &[PathBuf]) -> Result<Self> {
        let (mut studies, mut taken) = (Vec::new(), Vec::new());
        let (mut missing, mut methods) = (Vec::new(), Vec::new());
        let mut admission = Admission::default();
        for (at, folder) in folders.iter().enumerate() {
            let tables = Self::read(folder)?;
            let mut settings = settings(&tables.runs()?)?;
            for name in run_names(&tables.tests).map_err(inside)? {
                let (task, method, seed) = name.clone();
                let settings = settings.remove(&name);
                let run = Candidate { task, method, seed, starts: String::new(), settings };
                if let Some(objection) = admission.objection(&run) {
                    missing.push((said_of(folder, &name), format!("it {objection}")));
                    continue;
                }
                admission.admit(&run);
                let method = (name.0.clone(), name.1.clone());
                if !methods.contains(&method) {
                    methods.push(method);
                }
                taken.push((at, name));
            }
            missing.extend(tables.missing_runs()?);
            studies.push(tables);
        }
        same_starts(&studies, folders)?;
        name_unrecorded_runs(&mut studies)?;
        let place = |(task, method, seed): &RunName| {
            (methods.iter().position(|(of, name)| (of, name) == (task, method)), *seed)
        };
        taken.sort_by_key(|(_, name)| place(name));
        let joined = |table: fn(&Self) -> &DataFrame| {
            same_columns(studies.iter().map(table).zip(folders))?;
            let rows = taken.iter().filter_map(|(at, name)| of_run(table(&studies[*at]), name));
            concatenate(rows.collect()).map_err(inside)
        };
        let tables = Self {
            evaluations: joined(|t| &t.evaluations)?,
            models: joined(|t| &t.models)?,
            values: joined(|t| &t.values)?,
            tests: joined(|t| &t.tests)?,
            runs: joined(|t| &t.runs)?,
            left_out: left_out(missing).map_err(inside)?,
            summary: DataFrame::empty(),
        };
        tables.summarised()
    }
}

/// # Errors
/// If some studies were tested on the test's and others on development starts.
fn same_starts(studies: &[Tables], folders: &[PathBuf]) -> Result<()> {
    let mut first = None;
    for (tables, folder) in studies.iter().zip(folders) {
        let starts = tables.starts()?;
        let (before, other) = *first.get_or_insert((starts, folder));
        if starts != before {
            return Err(Error::Config(format!(
                "the runs in {} were tested on the starts `{}`, those in {} on `{}`; compare them separately",
                other.display(),
                before.name(),
                folder.display(),
                starts.name()
            )));
        }
    }
    Ok(())
}

/// If some studies have a table of their runs, those of earlier versions get one that names theirs.
fn name_unrecorded_runs(studies: &mut [Tables]) -> Result<()> {
    if studies.iter().all(|tables| tables.runs.width() == 0) {
        return Ok(());
    }
    for tables in studies.iter_mut().filter(|tables| tables.runs.width() == 0) {
        let names = run_names(&tables.tests).map_err(inside)?;
        let column = |name: &str, of: fn(&RunName) -> &str| {
            Column::new(name.into(), names.iter().map(of).collect::<Vec<&str>>())
        };
        let columns = vec![
            column("task", |(task, ..)| task),
            column("method", |(_, method, _)| method),
            Column::new("seed".into(), names.iter().map(|(.., seed)| *seed as i64).collect::<Vec<i64>>()),
            column("version", |_| ""),
            column("configuration", |_| ""),
        ];
        tables.runs = DataFrame::new_infer_height(columns).map_err(inside)?;
    }
    Ok(())
}

/// A table with fewer columns comes from an earlier version.
fn same_columns<'a>(tables: impl Iterator<Item = (&'a DataFrame, &'a PathBuf)>) -> Result<()> {
    let mut tables = tables.filter(|(table, _)| table.width() > 0);
    let Some((first, folder)) = tables.next() else { return Ok(()) };
    match tables.find(|(table, _)| table.get_column_names() != first.get_column_names()) {
        Some((_, other)) => Err(Error::Config(format!(
            "the tables in {} and {} do not have the same columns: they come from versions that cannot be joined; \
             run one of them again with this version",
            folder.display(),
            other.display()
        ))),
        None => Ok(()),
    }
}

/// The rows of a run; `None` if the table has none at all.
fn of_run(table: &DataFrame, (task, method, seed): &RunName) -> Option<LazyFrame> {
    let this = col("task").eq(lit(task.as_str())).and(col("method").eq(lit(method.as_str())));
    (table.width() > 0).then(|| table.clone().lazy().filter(this.and(col("seed").eq(lit(*seed as i64)))))
}
