//! Collects the tables of a study from the folders of its runs.

use std::path::Path;

use polars::prelude::*;

use super::admission::{Admission, Candidate};
use super::read::{self, TableFormat};
use super::{Tables, inside, numbers};
use crate::error::{Error, Result};
use crate::study::config::RunConfig;
use crate::study::folder::{check_tables, version};

impl Tables {
    /// Collects the tables from the folders of runs. A run whose files are missing or damaged is left out, and so is one that
    /// is there twice, or that has other settings than the first with its task and method: the table [`Tables::left_out`] names
    /// them, and the report does.
    ///
    /// # Errors
    /// If there is nothing but such runs (then what is wrong with the first), or some runs were tested on the test's starts and
    /// others on development starts.
    pub fn gather<'a>(folders: impl IntoIterator<Item = &'a Path>) -> Result<Self> {
        let mut collected = Collected::default();
        let (mut missing, mut first) = (Vec::new(), None);
        for folder in folders {
            if let Err(problem) = collected.take_in(folder) {
                missing.push((folder.display().to_string(), problem.to_string()));
                first.get_or_insert(problem);
            }
        }
        if let Some(problem) = first.filter(|_| collected.tests.is_empty()) {
            return Err(problem);
        }
        let Collected { evaluations, models, values, tests, runs, .. } = collected;
        let joined = |rows: Vec<LazyFrame>| concatenate(rows).map_err(inside);
        let tables = Self {
            evaluations: joined(evaluations)?,
            models: joined(models)?,
            values: joined(values)?,
            tests: joined(tests)?,
            runs: joined(runs)?,
            left_out: left_out(missing).map_err(inside)?,
            summary: DataFrame::empty(),
        };
        tables.summarised()
    }
}

/// The tables of the runs so far.
#[derive(Default)]
struct Collected {
    evaluations: Vec<LazyFrame>,
    models: Vec<LazyFrame>,
    values: Vec<LazyFrame>,
    tests: Vec<LazyFrame>,
    runs: Vec<LazyFrame>,
    admission: Admission,
}

impl Collected {
    /// Takes in all tables of a run.
    ///
    /// # Errors
    /// If it cannot be used; then nothing of it is taken in.
    fn take_in(&mut self, folder: &Path) -> Result<()> {
        let config = RunConfig::read(&folder.join("config.toml"))?;
        let run = Candidate {
            task: config.task.clone(),
            method: config.method.clone(),
            seed: config.seed,
            starts: config.starts.name().into(),
            settings: Some(config.to_table()),
        };
        if let Some(objection) = self.admission.objection(&run) {
            let problem = format!("`{}` on `{}` with seed {} {objection}", run.method, run.task, run.seed);
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
        let tests = labelled("test.csv", &read::TESTS)?.with_column(lit(config.starts.name()).alias("starts"));
        let mut evaluations = None;
        if config.learns() {
            let rows = read::of_run(&folder.join("evaluations.csv"), &read::EVALUATIONS)?;
            let episodes = read::of_run(&folder.join("episodes.csv"), &read::EPISODES)?;
            evaluations = Some(label(with_seconds(rows, &episodes).map_err(inside)?));
        }
        let if_there = |file: &str, format: &TableFormat| -> Result<Option<LazyFrame>> {
            folder.join(file).exists().then(|| labelled(file, format)).transpose()
        };
        let (models, values) = (if_there("model.csv", &read::MODELS)?, if_there("values.csv", &read::VALUES)?);
        let row = DataFrame::new_infer_height(vec![
            Column::new("version".into(), vec![version(folder)]),
            Column::new("configuration".into(), vec![config.to_toml()]),
        ]);
        self.runs.push(label(row.map_err(inside)?));
        self.tests.push(tests);
        self.evaluations.extend(evaluations);
        self.models.extend(models);
        self.values.extend(values);
        self.admission.admit(&run);
        Ok(())
    }
}

/// The table of runs that are in no other table, each with the reason; without columns if there is none.
pub(super) fn left_out(runs: Vec<(String, String)>) -> PolarsResult<DataFrame> {
    if runs.is_empty() {
        return Ok(DataFrame::empty());
    }
    let (runs, reasons): (Vec<String>, Vec<String>) = runs.into_iter().unzip();
    DataFrame::new_infer_height(vec![Column::new("run".into(), runs), Column::new("reason".into(), reasons)])
}

/// One below the other; all have the same columns.
pub(super) fn concatenate(frames: Vec<LazyFrame>) -> PolarsResult<DataFrame> {
    let options = UnionArgs { to_supertypes: true, ..UnionArgs::default() };
    if frames.is_empty() { Ok(DataFrame::empty()) } else { concat(frames, options)?.collect() }
}

/// The evaluations of a run, with the seconds of training until each: those of the last episode before it.
fn with_seconds(mut evaluations: DataFrame, episodes: &DataFrame) -> PolarsResult<DataFrame> {
    let ends: Vec<_> = numbers(episodes, "step")?.into_iter().zip(numbers(episodes, "seconds")?).collect();
    let until = |step: Option<f64>| ends.iter().rev().find(|(end, _)| *end <= step).map_or(Some(0.0), |(_, s)| *s);
    let seconds: Vec<Option<f64>> = numbers(&evaluations, "step")?.into_iter().map(until).collect();
    evaluations.with_column(Column::new("seconds".into(), seconds))?;
    Ok(evaluations)
}
