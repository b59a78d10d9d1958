//! The report of a study, written from its tables alone.

mod model;
mod results;
mod task;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::page;
use super::provenance;
use super::replays;
use super::starts::Starts;
use super::tables::Tables;
use super::verdict::{listed, verdict};
use crate::error::{Error, Result, shortened};
use crate::files;

/// A temporary file that is older than this is nobody's any more.
const ABANDONED: Duration = Duration::from_secs(3600);

/// Reads a study's tables from the folder `from`, and writes `summary.csv`, the figures, `report.md` and the same as a
/// page that needs no other file, `report.html`, into the folder `to`. Returns the table of results as text.
///
/// # Errors
/// If a table is missing or damaged, if `to` is another folder that holds the tables of a study, or if a file cannot be written.
pub fn write(from: &Path, to: &Path) -> Result<String> {
    write_noting(from, to, &mut |_| ())
}

/// The same. Each run and each recording that the report is without is told to `note`, with the reason.
///
/// # Errors
/// As [`write()`].
pub(crate) fn write_noting(from: &Path, to: &Path, note: &mut dyn FnMut(String)) -> Result<String> {
    let tables = Tables::read(from)?;
    if !files::same_folder(from, to) && to.join("tests.csv").exists() {
        // Its summary and figures would be replaced by those of other numbers.
        return Err(Error::Config(format!(
            "{}: this folder holds a study of its own; choose another --out",
            to.display()
        )));
    }
    for (run, reason) in tables.missing_runs()? {
        note(format!("left out: {} ({})", shortened(&run, 200), shortened(&reason, 300)));
    }
    for folder in [to, &to.join(replays::FOLDER)] {
        files::sweep(folder, ABANDONED);
    }
    tables.write_summary(to)?;
    let pairs = tables.tasks_and_methods()?;
    let mut tasks: Vec<&str> = Vec::new();
    for (task, _) in &pairs {
        if !tasks.contains(&task.as_str()) {
            tasks.push(task);
        }
    }
    let mut text = format!("# Comparison on {}\n\n", tasks.join(", "));
    text += tuning_note(&tables)?;
    text += &question(&tables, &pairs)?;
    let verdict = verdict(&tables, &tasks)?;
    if !verdict.is_empty() {
        text += &format!("## Verdict\n\n{verdict}\n");
    }
    text += &format!("## What is compared\n\n{}\n", terms(&tables, &pairs)?);
    text += &format!("## Results\n\n{}", results::section(&tables)?);
    let (replays, problems) = replays::of_report(&tables, from, to)?;
    for problem in problems {
        note(format!("no replay: {problem}"));
    }
    let mut not_alike = Vec::new();
    for name in &tasks {
        let differ = task::grids_differ(&tables, name)?;
        text += &task::section(&tables, name, differ, &replays, to)?;
        if differ {
            not_alike.push(*name);
        }
    }
    text += &format!("\n## How certain is this?\n\n{}", caveat(&tables, &pairs)?);
    text += &format!("\n## Checklist\n\n{}", provenance::checklist(&tables, &not_alike)?);
    let configurations = provenance::configurations(&tables)?;
    if !configurations.is_empty() {
        text += &format!("\n## Configurations\n{configurations}");
    }
    files::write(&to.join("report.md"), text.as_bytes())?;
    files::write(&to.join("report.html"), page::page(&text, to)?.as_bytes())?;
    Ok(tuning_note(&tables)?.to_string() + &results::text_table(&tables)?)
}

/// Joins the tables and recordings of several studies ([`Tables::read_all`]) into a study in the folder `to`. Returns what is wrong with
/// recordings that cannot be used.
///
/// # Errors
/// If the studies cannot be joined, if `to` holds the tables of another study, or if a file cannot be read or written.
pub fn join(folders: &[PathBuf], to: &Path) -> Result<Vec<String>> {
    let tables = Tables::read_all(folders)?;
    tables.check_place(to)?;
    tables.write(to)?;
    replays::join(folders, to)
}

/// What the study asks.
fn question(tables: &Tables, pairs: &[(String, String)]) -> Result<String> {
    let any = |column: &str| -> Result<bool> {
        let of = |(task, method): &(String, String)| Ok(tables.value(task, method, column)?.is_some());
        pairs.iter().map(of).try_fold(false, |any, there| Ok(any | there?))
    };
    let learned = any("steps")?;
    let mut asked =
        Vec::from_iter(learned.then_some("How many environment steps does each method need to learn a task? "));
    asked.push(if learned { "How often does it succeed afterwards?" } else { "How often does each method succeed?" });
    asked.extend(any("smoothness_sparc")?.then_some(" How smooth is its motion?"));
    asked.extend(learned.then_some(" Seeds of one method differ, too, so differences have intervals over seeds."));
    Ok(format!("## Question\n\n{}\n\n", asked.concat()))
}

/// What stands above the numbers of runs that served to choose settings.
fn tuning_note(tables: &Tables) -> Result<&'static str> {
    Ok(match tables.starts()? {
        Starts::Test => "",
        Starts::Development => {
            "Tuning runs: everything here was measured on development starts. Choose settings by it, but report the results \
             of runs on the test's starts.\n\n"
        }
    })
}

/// What all methods have in common, and what some know that the others do not.
fn terms(tables: &Tables, pairs: &[(String, String)]) -> Result<String> {
    let (mut told, mut unknown, mut uninformed) = (BTreeSet::new(), BTreeSet::new(), false);
    for (task, method) in pairs {
        match tables.is_told_the_reward(task, method)? {
            Some(true) => _ = told.insert(format!("`{method}`")),
            Some(false) => uninformed |= tables.value(task, method, "steps")?.is_some(),
            None => _ = unknown.insert(format!("`{method}`")),
        }
    }
    let [told, unknown] = [told, unknown].map(|methods| methods.into_iter().collect::<Vec<String>>());
    let mut text = String::from(
        "All methods of a task are evaluated from the same initial states and tested from the same initial states, without exploration \
         noise (planners still sample their candidates). The test is of the agent at the end of training; no earlier one is selected. \
         Every environment step of training counts, also in the random warm-up. Every number on this page comes from the study's \
         tables (CSV files)",
    );
    let configured = tables.runs()?.iter().any(|run| !run.configuration.is_empty());
    text += if configured { "; settings, from its `runs.csv`, are listed at the end.\n" } else { ".\n" };
    if !told.is_empty() {
        text += &format!(
            "\nThe methods are not given the same information: {} {} given a reward function{}{}.{}\n",
            listed(&told),
            if told.len() == 1 { "is" } else { "are" },
            if told.iter().any(|method| method == "`oracle`") {
                ", and `oracle` plans in the true simulator"
            } else {
                ""
            },
            if unknown.is_empty() { String::new() } else { format!("; for {}, this is not known", listed(&unknown)) },
            if uninformed { " The other methods that learn have only the rewards that they receive." } else { "" },
        );
    }
    for difference in tables.differences_of_environments()? {
        text += &format!("\n{difference}\n");
    }
    Ok(text)
}

fn caveat(tables: &Tables, pairs: &[(String, String)]) -> Result<String> {
    let mut fewest = f64::INFINITY;
    for (task, method) in pairs {
        if tables.value(task, method, "steps")?.is_some() {
            fewest = fewest.min(tables.value(task, method, "seeds")?.unwrap_or(0.0));
        }
    }
    Ok(match fewest {
        f64::INFINITY => "No method here learns, so the only uncertainty is that of the test episodes.\n".into(),
        n if n < 5.0 => format!(
            "Not very: a learning method has only {n:.0} seed{} here, too few for a reliable interval over seeds. Train at least five seeds \
             of every learning method before you draw conclusions.\n",
            if n == 1.0 { "" } else { "s" }
        ),
        n => format!(
            "Each learning method has at least {n:.0} seeds. With five, a two-level bootstrap that should cover the truth in 95 % of cases \
             covers it in 85 to 95 %; the more the seeds differ, the fewer. A bootstrap over seeds alone covers ratios and probabilities of \
             improvement in about 85 %, and probabilities near 0 or 1 in far fewer. Where there is a t interval over seeds, it is the safer \
             one; where most seeds are at 0 or 100 %, both cover less. No interval accounts for a failure so rare that no seed shows it.\n"
        ),
    })
}
