//! The tables of a study. `evaluations.csv`, `models.csv`, `values.csv` and `tests.csv` collect the numbers of all runs.
//! Everything else (`summary.csv` with one row per task and method, the figures, the report) is computed from these files
//! alone.

use std::io::ErrorKind;
use std::path::Path;

use polars::prelude::*;

mod admission;
mod frames;
mod gather;
mod join;
mod place;
mod read;
mod runs;
mod whole;

use super::starts::Starts;
use super::summary::summarise;
use crate::chart::LARGEST;
use crate::error::{Error, Result};
use crate::files;
use frames::csv;
pub(super) use frames::{by_run, curves, lists, numbers, of, optional_curves, strings};
#[cfg(feature = "cli")]
pub(crate) use place::check_place;
pub use runs::Run;
use runs::check_runs;

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
    /// task, method, seed, step, expected, realised, ...: the return that the agent expected in each
    /// evaluation (its value, or its plans' predicted return over their horizon), and the return that followed.
    pub values: DataFrame,
    /// task, method, seed, episode, return, success, ..., starts: one row per test episode.
    pub tests: DataFrame,
    /// task, method, seed, version, configuration: one row per run, with the version of the program that made it, and its
    /// configuration as TOML. Studies of earlier versions do not have this table.
    pub runs: DataFrame,
    /// run, reason: the runs, or their folders, that are in no table, and what else lies among them, and why.
    pub left_out: DataFrame,
    /// One row per task and method, computed from the other tables.
    pub summary: DataFrame,
}

impl Tables {
    /// Reads the tables of a study from its folder. A run that has fewer rows than its configuration says, was tested on other
    /// starts than it says, or has another configuration than the first with its task and method, is left out by name, as in
    /// [`Tables::gather`]; the runs of earlier versions, which recorded no configuration, cannot be checked.
    ///
    /// # Errors
    /// If a table is missing or damaged, or lacks a run; if there is no whole run; or if the starts of the tests differ.
    pub fn read(folder: &Path) -> Result<Self> {
        let optional = |file: &str, read: &dyn Fn(&Path) -> Result<DataFrame>| {
            let path = folder.join(file);
            if path.exists() { read(&path) } else { Ok(DataFrame::empty()) }
        };
        let mut tables = Self {
            evaluations: read::of_study(&folder.join("evaluations.csv"), &read::EVALUATIONS)?,
            models: read::of_study(&folder.join("models.csv"), &read::MODELS)?,
            values: read::of_study(&folder.join("values.csv"), &read::VALUES)?,
            tests: read::of_study(&folder.join("tests.csv"), &read::TESTS)?,
            runs: optional("runs.csv", &|path| read::of_study(path, &read::RUNS))?,
            left_out: optional("left_out.csv", &|path| read::of_run(path, &read::LEFT_OUT))?,
            summary: DataFrame::empty(),
        };
        tables.leave_out_partial_runs(folder)?;
        tables.summarised()
    }

    /// Computes the summary from the other tables.
    fn summarised(mut self) -> Result<Self> {
        check_runs(&self)?;
        self.summary = summarise(&self.evaluations, &self.values, &self.tests).map_err(inside)?;
        self.starts()?;
        Ok(self)
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
        let left_out = folder.join("left_out.csv");
        let mut tables = vec![
            (folder.join("evaluations.csv"), csv(&self.evaluations)?),
            (folder.join("models.csv"), csv(&self.models)?),
            (folder.join("values.csv"), csv(&self.values)?),
            (folder.join("tests.csv"), csv(&self.tests)?),
            (folder.join("runs.csv"), csv(&self.runs)?),
        ];
        let all_there = self.left_out.width() == 0;
        if !all_there {
            tables.push((left_out.clone(), csv(&self.left_out)?));
        }
        // Together, since tables of different studies may look like those of one.
        files::write_all(&tables.iter().map(|(path, bytes)| (path.as_path(), bytes.as_slice())).collect::<Vec<_>>())?;
        // What an earlier attempt left behind.
        if all_there
            && let Err(problem) = std::fs::remove_file(&left_out)
            && problem.kind() != ErrorKind::NotFound
        {
            return Err(Error::io("remove", &left_out)(problem));
        }
        Ok(())
    }

    /// Writes `summary.csv` into a folder.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn write_summary(&self, folder: &Path) -> Result<()> {
        files::write(&folder.join("summary.csv"), &csv(&self.summary)?)
    }

    /// Tasks and methods, in the order in which they were run.
    ///
    /// # Errors
    /// If the summary lacks a column.
    pub fn tasks_and_methods(&self) -> Result<Vec<(String, String)>> {
        let rows = |column: &str| strings(&self.summary, column).map_err(inside);
        Ok(rows("task")?.into_iter().zip(rows("method")?).collect())
    }

    /// The methods of a task, in the order in which they were run.
    ///
    /// # Errors
    /// If the summary lacks a column.
    pub fn methods(&self, task: &str) -> Result<Vec<String>> {
        let all = self.tasks_and_methods()?.into_iter();
        Ok(all.filter(|(of, _)| of == task).map(|(_, method)| method).collect())
    }

    /// The success curves of a method: for each seed, steps and success rates.
    ///
    /// # Errors
    /// If the table lacks a column.
    pub fn curves(&self, task: &str, method: &str) -> Result<Vec<Curve>> {
        curves(&self.evaluations, task, method, "success").map_err(inside)
    }

    /// The same for the mean return of each evaluation. Empty if the tables do not tell it.
    ///
    /// # Errors
    /// If the table lacks a column.
    pub fn return_curves(&self, task: &str, method: &str) -> Result<Vec<Curve>> {
        optional_curves(&self.evaluations, task, method, "return_mean").map_err(inside)
    }

    /// True if methods learn the task and none succeeds in any evaluation, so that reports compare returns instead; false if no returns
    /// were recorded.
    ///
    /// # Errors
    /// If the table lacks a column.
    pub fn is_judged_by_return(&self, task: &str) -> Result<bool> {
        if self.evaluations.column("return_mean").is_err() {
            return Ok(false);
        }
        let mut curves = Vec::new();
        for method in self.methods(task)? {
            curves.extend(self.curves(task, &method)?);
        }
        Ok(!curves.is_empty() && curves.iter().flat_map(|(_, success)| success).all(|success| *success == 0.0))
    }

    /// Over environment steps, the seconds of training until each evaluation. Empty if the tables do not tell them.
    ///
    /// # Errors
    /// If the table lacks a column.
    pub fn clocks(&self, task: &str, method: &str) -> Result<Vec<Curve>> {
        optional_curves(&self.evaluations, task, method, "seconds").map_err(inside)
    }

    /// The final test of a method: for each seed, 1 for each episode that succeeds, 0 for each other.
    ///
    /// # Errors
    /// If the table lacks a column.
    pub fn successes(&self, task: &str, method: &str) -> Result<Vec<Vec<f64>>> {
        let found = || lists(&by_run(of(&self.tests, task, method)?.lazy(), &["success"])?, "success");
        found().map_err(inside)
    }

    /// The SPARC of each test episode of a method, for each seed; empty if the tables do not tell it.
    ///
    /// # Errors
    /// If the table lacks a column.
    pub(super) fn smoothness(&self, task: &str, method: &str) -> Result<Vec<Vec<f64>>> {
        if self.tests.column("sparc").is_err() {
            return Ok(Vec::new());
        }
        let found = || lists(&by_run(of(&self.tests, task, method)?.lazy(), &["sparc"])?, "sparc");
        found().map_err(inside)
    }

    /// The return of an episode of a run's test, counted from 1; `None` if it is not in the tests.
    ///
    /// # Errors
    /// If the table lacks a column.
    pub(super) fn test_return(&self, task: &str, method: &str, seed: u64, episode: usize) -> Result<Option<f64>> {
        let number = |name: &str, number: u64| col(name).eq(lit(number as i64));
        let found = || {
            let rows = of(&self.tests, task, method)?.lazy();
            let rows = rows.filter(number("seed", seed).and(number("episode", episode as u64))).collect()?;
            Ok(numbers(&rows, "return")?.into_iter().next().flatten())
        };
        found().map_err(inside)
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

/// An error in tables that could be read.
fn inside(problem: PolarsError) -> Error {
    let problem = problem.to_string();
    Error::Config(format!(
        "the tables of the study are inconsistent ({}); restore them, or repeat the command that made them",
        problem.lines().next().unwrap_or_default()
    ))
}
