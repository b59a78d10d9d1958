//! The tables of a study. `evaluations.csv`, `models.csv`, `values.csv` and `tests.csv` collect the numbers of all runs.
//! Everything else (`summary.csv` with one row per task and method, the figures, the report) is computed from these files
//! alone.

use std::collections::BTreeSet;
use std::path::Path;

use polars::prelude::*;

mod read;

use super::config::RunConfig;
use super::folder::check_tables;
use super::starts::Starts;
use super::summary::summarise;
use crate::chart::LARGEST;
use crate::error::{Error, Result};
use crate::files;
use read::TableFormat;

/// The success rate of the column `steps_to_80`.
pub const LEVEL: f64 = 0.8;

/// The method that the other methods which learn are compared with.
pub const BASELINE: &str = "sac";

/// The curve of one seed: environment steps, and the value at each of them.
pub type Curve = (Vec<f64>, Vec<f64>);

/// The tables of a study.
#[derive(Clone, Debug)]
pub struct Tables {
    /// task, method, seed, step, success, ..., seconds: one row per evaluation of each learning run. The seconds are those of
    /// training until then; tables of earlier versions do not have them.
    pub evaluations: DataFrame,
    /// task, method, seed, step, horizon, rmse, ...: the open-loop prediction error of each learned model on
    /// the episodes of each evaluation.
    pub models: DataFrame,
    /// task, method, seed, step, expected, realised, ...: the estimated value in each
    /// evaluation, and the discounted return that followed.
    pub values: DataFrame,
    /// task, method, seed, episode, return, success, ..., starts: one row per test episode.
    pub tests: DataFrame,
    /// One row per task and method, computed from the other tables.
    pub summary: DataFrame,
}

impl Tables {
    /// Collects the tables from the folders of runs.
    ///
    /// # Errors
    /// If a run's files are missing or damaged, or some runs were tested on the test's starts and others on development
    /// starts.
    pub fn gather<'a>(folders: impl IntoIterator<Item = &'a Path>) -> Result<Self> {
        let (mut evaluations, mut tests) = (Vec::new(), Vec::new());
        let (mut models, mut values) = (Vec::new(), Vec::new());
        let mut seen = BTreeSet::new();
        for folder in folders {
            let config = RunConfig::read(&folder.join("config.toml"))?;
            if !seen.insert((config.task.clone(), config.method.clone(), config.seed, config.starts.name())) {
                let problem =
                    format!("`{}` on `{}` with seed {} is there twice", config.method, config.task, config.seed);
                return Err(Error::data(folder)(problem));
            }
            check_tables(folder)?;
            let label = |frame: DataFrame| {
                frame.lazy().select([
                    lit(config.task.as_str()).alias("task"),
                    lit(config.method.as_str()).alias("method"),
                    lit(config.seed).alias("seed"),
                    all().as_expr(),
                ])
            };
            let labelled = |file: &str, format: &TableFormat| -> Result<LazyFrame> {
                Ok(label(read::of_run(&folder.join(file), format)?))
            };
            tests.push(labelled("test.csv", &read::TESTS)?.with_column(lit(config.starts.name()).alias("starts")));
            if config.learns() {
                let rows = read::of_run(&folder.join("evaluations.csv"), &read::EVALUATIONS)?;
                let episodes = read::of_run(&folder.join("episodes.csv"), &read::EPISODES)?;
                evaluations.push(label(with_seconds(rows, &episodes).map_err(inside)?));
            }
            for (file, format, frames) in
                [("model.csv", &read::MODELS, &mut models), ("values.csv", &read::VALUES, &mut values)]
            {
                if folder.join(file).exists() {
                    frames.push(labelled(file, format)?);
                }
            }
        }
        let join = |frames: Vec<LazyFrame>| {
            let options = UnionArgs { to_supertypes: true, ..UnionArgs::default() };
            if frames.is_empty() { Ok(DataFrame::empty()) } else { concat(frames, options)?.collect() }
        };
        let joined =
            || -> PolarsResult<[DataFrame; 4]> { Ok([join(evaluations)?, join(models)?, join(values)?, join(tests)?]) };
        Self::summarised(joined().map_err(inside)?)
    }

    /// Reads the tables of a study from its folder.
    ///
    /// # Errors
    /// If one is missing or damaged, or the starts of the tests differ.
    pub fn read(folder: &Path) -> Result<Self> {
        Self::summarised([
            read::of_study(&folder.join("evaluations.csv"), &read::EVALUATIONS)?,
            read::of_study(&folder.join("models.csv"), &read::MODELS)?,
            read::of_study(&folder.join("values.csv"), &read::VALUES)?,
            read::of_study(&folder.join("tests.csv"), &read::TESTS)?,
        ])
    }

    fn summarised([evaluations, models, values, tests]: [DataFrame; 4]) -> Result<Self> {
        check_runs(&evaluations, [&models, &values], &tests)?;
        let summary = summarise(&evaluations, &tests).map_err(inside)?;
        let tables = Self { evaluations, models, values, tests, summary };
        tables.starts()?;
        Ok(tables)
    }

    /// On which starts the runs were tested. Tables of earlier versions do not say: they know only the test's.
    ///
    /// # Errors
    /// If some were tested on the test's and others on development starts: these numbers do not belong in one table.
    pub fn starts(&self) -> Result<Starts> {
        if self.tests.column("starts").is_err() {
            return Ok(Starts::Test);
        }
        let mut names = strings(&self.tests, "starts").map_err(inside)?;
        names.sort();
        names.dedup();
        match names.as_slice() {
            [] => Ok(Starts::Test),
            [name] => name.parse(),
            _ => Err(Error::Config(format!(
                "some runs were tested on the starts `{}`, others on `{}`; compare them separately",
                names[0], names[1]
            ))),
        }
    }

    /// Writes the collected tables into a study's folder.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        write(&folder.join("evaluations.csv"), &self.evaluations)?;
        write(&folder.join("models.csv"), &self.models)?;
        write(&folder.join("values.csv"), &self.values)?;
        write(&folder.join("tests.csv"), &self.tests)
    }

    /// Writes `summary.csv` into a folder.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn write_summary(&self, folder: &Path) -> Result<()> {
        write(&folder.join("summary.csv"), &self.summary)
    }

    /// Tasks and methods, in the order in which they were run.
    pub fn tasks_and_methods(&self) -> Result<Vec<(String, String)>> {
        let rows = |column: &str| strings(&self.summary, column).map_err(inside);
        Ok(rows("task")?.into_iter().zip(rows("method")?).collect())
    }

    /// The success curves of a method: for each seed, steps and success rates.
    ///
    /// # Errors
    /// If the table lacks a column.
    pub fn curves(&self, task: &str, method: &str) -> Result<Vec<Curve>> {
        curves(&self.evaluations, task, method, "success").map_err(inside)
    }

    /// The evaluations of a method during training: for each seed, their steps, and the episodes of each.
    ///
    /// # Errors
    /// If the table lacks a column.
    pub fn evaluation_grid(&self, task: &str, method: &str) -> Result<Vec<Curve>> {
        curves(&self.evaluations, task, method, "episodes").map_err(inside)
    }

    /// A column of `models.csv` over environment steps, for one horizon: for each seed, steps and values. Empty for methods
    /// without a model.
    ///
    /// # Errors
    /// If the table lacks a column.
    pub fn model_curves(&self, task: &str, method: &str, horizon: u32, column: &str) -> Result<Vec<Curve>> {
        let found = || {
            if self.models.width() == 0 {
                return Ok(Vec::new());
            }
            let rows = self.models.clone().lazy().filter(col("horizon").eq(lit(horizon))).collect()?;
            curves(&rows, task, method, column)
        };
        found().map_err(inside)
    }

    /// A column of `values.csv` over environment steps: for each seed, steps and values. Empty for methods that estimate
    /// no value.
    ///
    /// # Errors
    /// If the table lacks the column.
    pub fn value_curves(&self, task: &str, method: &str, column: &str) -> Result<Vec<Curve>> {
        curves(&self.values, task, method, column).map_err(inside)
    }

    /// How many numbers of a method's model and values its figures leave out, because they are not finite or too large.
    ///
    /// # Errors
    /// If a table lacks a column.
    pub fn left_out(&self, task: &str, method: &str) -> Result<usize> {
        let mut count = 0;
        for (table, columns) in
            [(&self.models, &["rmse", "coverage90"][..]), (&self.values, &["expected", "realised", "correlation"])]
        {
            let rows = of(table, task, method).map_err(inside)?;
            for column in columns.iter().filter(|_| rows.width() > 0) {
                let drawn = |number: &f64| number.abs() <= LARGEST;
                count += numbers(&rows, column).map_err(inside)?.iter().flatten().filter(|x| !drawn(x)).count();
            }
        }
        Ok(count)
    }

    /// An entry of the summary; `None` if the entry is empty.
    ///
    /// # Errors
    /// If the table lacks a column.
    pub fn value(&self, task: &str, method: &str, column: &str) -> Result<Option<f64>> {
        let found = || -> PolarsResult<Option<f64>> {
            let row = of(&self.summary, task, method)?;
            Ok(numbers(&row, column)?.into_iter().next().flatten())
        };
        found().map_err(inside)
    }
}

/// The evaluations of a run, with the seconds of training until each: those of the last episode before it.
fn with_seconds(mut evaluations: DataFrame, episodes: &DataFrame) -> PolarsResult<DataFrame> {
    let ends: Vec<_> = numbers(episodes, "step")?.into_iter().zip(numbers(episodes, "seconds")?).collect();
    let until = |step: Option<f64>| ends.iter().rev().find(|(end, _)| *end <= step).map_or(Some(0.0), |(_, s)| *s);
    let seconds: Vec<Option<f64>> = numbers(&evaluations, "step")?.into_iter().map(until).collect();
    evaluations.with_column(Column::new("seconds".into(), seconds))?;
    Ok(evaluations)
}

pub(super) fn of(frame: &DataFrame, task: &str, method: &str) -> PolarsResult<DataFrame> {
    if frame.width() == 0 {
        return Ok(frame.clone());
    }
    let here = col("task").eq(lit(task)).and(col("method").eq(lit(method)));
    frame.clone().lazy().filter(here).collect()
}

/// Groups rows by run: one row per run, in the order of the runs, with each of these columns as a list.
pub(super) fn by_run(rows: LazyFrame, columns: &[&str]) -> PolarsResult<DataFrame> {
    let lists: Vec<Expr> = columns.iter().map(|name| col(*name).strict_cast(DataType::Float64).drop_nulls()).collect();
    rows.group_by_stable(["task", "method", "seed"].map(col)).agg(lists).collect()
}

/// A column over environment steps, for each seed. What no chart can show is left out.
pub(super) fn curves(rows: &DataFrame, task: &str, method: &str, value: &str) -> PolarsResult<Vec<Curve>> {
    if rows.width() == 0 {
        return Ok(Vec::new());
    }
    let number = col(value).cast(DataType::Float64);
    let shown = number.clone().gt_eq(lit(-LARGEST)).and(number.lt_eq(lit(LARGEST)));
    let known = of(rows, task, method)?.lazy().filter(shown);
    let runs = by_run(known, &["step", value])?;
    Ok(lists(&runs, "step")?.into_iter().zip(lists(&runs, value)?).collect())
}

pub(super) fn lists(runs: &DataFrame, column: &str) -> PolarsResult<Vec<Vec<f64>>> {
    let numbers = |list: Series| Ok(list.f64()?.iter().flatten().collect());
    runs.column(column)?.list()?.no_null_series_iter().map(numbers).collect()
}

pub(super) fn strings(frame: &DataFrame, column: &str) -> PolarsResult<Vec<String>> {
    Ok(frame.column(column)?.str()?.iter().map(|s| s.unwrap_or_default().to_string()).collect())
}

fn numbers(frame: &DataFrame, column: &str) -> PolarsResult<Vec<Option<f64>>> {
    let column = frame.column(column)?.cast(&DataType::Float64)?;
    Ok(column.f64()?.iter().collect())
}

fn write(path: &Path, table: &DataFrame) -> Result<()> {
    let mut bytes = Vec::new();
    if table.width() > 0 {
        CsvWriter::new(&mut bytes).finish(&mut table.clone()).map_err(inside)?;
    }
    files::write(path, &bytes)
}

/// Every run was tested, and of a method that learns every run was evaluated.
fn check_runs(evaluations: &DataFrame, others: [&DataFrame; 2], tests: &DataFrame) -> Result<()> {
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
    for table in [evaluations, others[0], others[1]] {
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

/// An error in tables that could be read.
fn inside(problem: PolarsError) -> Error {
    let problem = problem.to_string();
    Error::Config(format!("the tables of the study are inconsistent: {}", problem.lines().next().unwrap_or_default()))
}
