//! Whether the tables of a study have all rows of each of its runs, by the configurations in `runs.csv`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use polars::prelude::*;

use super::admission::{Admission, Candidate};
use super::runs::{RunName, incomplete, row_names, run_names, said_of, settings};
use super::{Tables, inside, numbers, strings};
use crate::error::{Error, Result};

impl Tables {
    /// Leaves out the runs of which rows were lost, that were tested on other starts than their configuration says, or that have
    /// another configuration than the first with their task and method.
    ///
    /// # Errors
    /// If there is nothing but such runs, or a run is not in a table at all.
    pub(super) fn leave_out_partial_runs(&mut self, folder: &Path) -> Result<()> {
        let objections = self.objections().map_err(Error::data(folder))?;
        let Some((first, reason)) = objections.first() else { return Ok(()) };
        let (task, method, seed) = first;
        let problem = format!("no run can be reported; `{method}` on `{task}` with seed {seed}: {reason}");
        let out: BTreeSet<&RunName> = objections.iter().map(|(run, _)| run).collect();
        let Self { evaluations, models, values, tests, runs, .. } = self;
        for table in [evaluations, models, values, tests, runs] {
            *table = without(table, &out).map_err(inside)?;
        }
        if self.tests.height() == 0 {
            return Err(Error::data(folder)(problem));
        }
        self.leave_out(objections.iter().map(|(run, reason)| (said_of(folder, run), reason.clone())))
    }

    /// The runs to leave out, each with the reason.
    fn objections(&self) -> Result<Vec<(RunName, String)>> {
        let recorded = self.runs()?;
        if recorded.is_empty() {
            return Ok(Vec::new());
        }
        let mut settings = settings(&recorded)?;
        let names = run_names(&self.runs).map_err(inside)?;
        let names: BTreeSet<RunName> = names.into_iter().collect();
        let steps = numbers_of_each(&self.evaluations, "step").map_err(inside)?;
        let episodes = numbers_of_each(&self.tests, "episode").map_err(inside)?;
        let starts_of = starts_of_each(&self.tests).map_err(inside)?;
        let evaluated = [("values.csv", &self.values), ("models.csv", &self.models)];
        let evaluated = evaluated.map(|(file, table)| Ok((file, numbers_of_each(table, "step").map_err(inside)?)));
        let evaluated = evaluated.into_iter().collect::<Result<Vec<_>>>()?;
        let (mut admission, mut objections) = (Admission::default(), Vec::new());
        for name in run_names(&self.tests).map_err(inside)? {
            if !names.contains(&name) {
                return Err(incomplete(&name, "runs.csv", "tests.csv"));
            }
            let (task, method, seed) = name.clone();
            let starts = starts_of.get(&name).cloned().unwrap_or_default();
            let run = Candidate { task, method, seed, starts, settings: settings.remove(&name) };
            if run.number("steps").is_some_and(|steps| steps > 0) && !steps.contains_key(&name) {
                return Err(incomplete(&name, "evaluations.csv", "tests.csv"));
            }
            let lost = lost_rows(&run, steps.get(&name), episodes.get(&name))
                .or_else(|| evaluated.iter().find_map(|(file, steps)| lost_end(&run, file, steps)))
                .or_else(|| other_starts(&run));
            match lost.or_else(|| admission.objection(&run).map(|objection| format!("it {objection}"))) {
                Some(reason) => objections.push((name, reason)),
                None => admission.admit(&run),
            }
        }
        Ok(objections)
    }
}

/// What the tables lack of a run that has evaluations at these steps and these episodes of the test.
fn lost_rows(run: &Candidate, steps: Option<&Vec<i64>>, episodes: Option<&Vec<i64>>) -> Option<String> {
    if let (Some(budget), Some(there)) = (run.number("steps").filter(|budget| *budget > 0), steps) {
        if let Some(last) = there.last().filter(|last| **last != budget) {
            return Some(format!("its last evaluation in `evaluations.csv` is at step {last} of {budget}"));
        }
        let every =
            run.number("evaluate_every").and_then(|every| usize::try_from(every).ok()).filter(|every| *every > 0);
        let lost = every.and_then(|every| (0..budget).step_by(every).find(|step| !there.contains(step)));
        if let Some(step) = lost {
            return Some(format!("its evaluation at step {step} is not in `evaluations.csv`"));
        }
    }
    let (wanted, there) = (run.number("test_episodes")?, episodes?.len());
    (usize::try_from(wanted) != Ok(there)).then(|| format!("its test in `tests.csv` has {there} of {wanted} episodes"))
}

/// Whether a table lacks the rows of a run's last evaluation, which another run of its method has. `steps` are those of all runs.
fn lost_end(run: &Candidate, file: &str, steps: &BTreeMap<RunName, Vec<i64>>) -> Option<String> {
    let Candidate { task, method, seed, .. } = run;
    let budget = run.number("steps")?;
    let at_end = |steps: &Vec<i64>| steps.last() == Some(&budget);
    // An agent may have nothing to say of its last evaluation; then no run of it has.
    steps.iter().find(|((of_task, of_method, _), steps)| (of_task, of_method) == (task, method) && at_end(steps))?;
    let there = steps.get(&(task.clone(), method.clone(), *seed)).is_some_and(at_end);
    (!there).then(|| format!("its last evaluation, at step {budget}, is not in `{file}`"))
}

/// Whether a run was tested on other starts than its configuration says. Where nothing is said, they are the test's.
fn other_starts(run: &Candidate) -> Option<String> {
    let said = run.settings.as_ref()?.get("starts").and_then(toml::Value::as_str).unwrap_or("test");
    let tested = if run.starts.is_empty() { "test" } else { &run.starts };
    (said != tested).then(|| {
        format!("its configuration says that it is tested on the starts `{said}`, `tests.csv` says `{tested}`")
    })
}

/// On which starts each run was tested, if that is told.
fn starts_of_each(tests: &DataFrame) -> PolarsResult<BTreeMap<RunName, String>> {
    if tests.column("starts").is_err() {
        return Ok(BTreeMap::new());
    }
    Ok(row_names(tests)?.into_iter().zip(strings(tests, "starts")?).collect())
}

/// The numbers in a column, for each run.
fn numbers_of_each(table: &DataFrame, column: &str) -> PolarsResult<BTreeMap<RunName, Vec<i64>>> {
    let mut of_each: BTreeMap<RunName, Vec<i64>> = BTreeMap::new();
    if table.width() > 0 {
        let numbers = numbers(table, column)?.into_iter().map(|number| number.unwrap_or_default() as i64);
        row_names(table)?
            .into_iter()
            .zip(numbers)
            .for_each(|(name, number)| of_each.entry(name).or_default().push(number));
    }
    Ok(of_each)
}

/// The rows of the other runs.
fn without(table: &DataFrame, runs: &BTreeSet<&RunName>) -> PolarsResult<DataFrame> {
    if table.width() == 0 {
        return Ok(table.clone());
    }
    let kept: BooleanChunked = row_names(table)?.iter().map(|name| Some(!runs.contains(name))).collect();
    table.filter(&kept)
}
