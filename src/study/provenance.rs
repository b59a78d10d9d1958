//! Where the numbers of a study come from: a reviewer's checklist, the runs that are missing, and the configurations.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

use super::starts::Starts;
use super::tables::{Run, Tables};
use super::verdict::{budgets, listed};
use super::version::is_one_commit;
use crate::error::{Result, shortened};
use crate::watch::escaped;

/// The fewest seeds, and episodes of a test, that a comparison should have.
const SEEDS: usize = 5;
const TEST_EPISODES: f64 = 100.0;

/// What a reviewer would ask, answered from the tables. `different_grids` says which tasks' methods were not evaluated alike.
///
/// # Errors
/// If a table lacks a column.
pub(super) fn checklist(tables: &Tables, different_grids: &[&str]) -> Result<String> {
    let mut text = String::new();
    let mut item = |claim: &str, exceptions: &[String]| {
        let answer = if exceptions.is_empty() { "yes" } else { "no" };
        write!(text, "- **{answer}**: {claim}").expect("text grows");
        text +=
            &if exceptions.is_empty() { ".\n".into() } else { format!(". Exceptions: {}.\n", exceptions.join("; ")) };
    };
    let (mut few, mut short, mut missing) = (Vec::new(), Vec::new(), Vec::new());
    let mut of_tasks: BTreeMap<String, BTreeSet<u64>> = BTreeMap::new();
    let seeds = tables.seeds_of_learners()?;
    for ((task, _), seeds) in &seeds {
        of_tasks.entry(task.clone()).or_default().extend(seeds);
    }
    for ((task, method), seeds) in &seeds {
        if seeds.len() < SEEDS {
            few.push(format!("`{method}` on `{task}` has {}", seeds.len()));
        }
        let absent: Vec<String> = of_tasks[task].difference(seeds).map(u64::to_string).collect();
        if !absent.is_empty() {
            missing.push(format!("`{method}` on `{task}` lacks {}", absent.join(", ")));
        }
    }
    for (task, method) in tables.tasks_and_methods()? {
        let value = |column: &str| tables.value(&task, &method, column);
        let episodes = value("test_episodes")?.unwrap_or(0.0) / value("seeds")?.unwrap_or(1.0).max(1.0);
        if episodes < TEST_EPISODES {
            short.push(format!("`{method}` on `{task}` has {episodes:.0}"));
        }
    }
    item("each learning method of a task has at least five seeds", &few);
    item("all learning methods of a task have the same seeds", &missing);
    item("everything that was found among the runs is included", &left_out(tables)?);
    item(
        "all learning methods of a task are trained for the same number of steps",
        &different_budgets(tables, of_tasks.keys())?,
    );
    item(
        "up to the smallest budget, all learning methods of a task are evaluated at the same steps with the same number of episodes",
        &different_grids.iter().map(|task| format!("on `{task}`")).collect::<Vec<_>>(),
    );
    item("each agent is tested in at least 100 episodes", &short);
    let tuning = tables.starts()? == Starts::Development;
    let tuned = if tuning { vec!["these are development starts".into()] } else { Vec::new() };
    item("the starts of the test are new to every run: neither its training nor its evaluations used them", &tuned);
    item("one version of the library, with its sources committed, made all runs", &versions(&tables.runs()?));
    Ok(text
        + "\nRuns that do not reach the level count as right-censored. What the tables cannot tell: whether settings were chosen after results \
           on the test's starts had been seen, on which seeds, and with how many trials for each method; and which runs were given up or \
           replaced.\n")
}

/// A text that may be anything, as code.
fn quoted(text: &str) -> String {
    format!("`{}`", text.replace(['`', '\n', '\r'], " "))
}

/// The budgets of each task whose methods do not all have the same.
fn different_budgets<'a>(tables: &Tables, tasks: impl Iterator<Item = &'a String>) -> Result<Vec<String>> {
    let mut exceptions = Vec::new();
    for task in tasks {
        let budgets = budgets(tables, task)?;
        if budgets.len() > 1 {
            let each: Vec<String> =
                budgets.iter().map(|(steps, methods)| format!("{steps} for {}", listed(methods))).collect();
            exceptions.push(format!("on `{task}`, {}", listed(&each)));
        }
    }
    Ok(exceptions)
}

/// The runs that are in no table, and why.
fn left_out(tables: &Tables) -> Result<Vec<String>> {
    let runs = tables.missing_runs()?.into_iter();
    Ok(runs.map(|(run, reason)| format!("{} ({})", quoted(&run), quoted(&reason))).collect())
}

/// Why it cannot be said that one version, with its sources committed, made all runs; nothing if it can.
fn versions(runs: &[Run]) -> Vec<String> {
    let versions: BTreeSet<&str> = runs.iter().map(|run| run.version.as_str()).collect();
    if versions.len() == 1 && versions.iter().all(|version| is_one_commit(version)) {
        return Vec::new();
    }
    let shown = |version: &&str| if version.is_empty() { "one that is not recorded".into() } else { quoted(version) };
    let shown: Vec<String> = versions.iter().map(shown).collect();
    let none = versions.iter().all(|version| version.is_empty());
    vec![if none { "the version is not recorded".into() } else { format!("made by {}", shown.join(", ")) }]
}

/// The configurations, one for each method on a task, with the seeds and the versions of the program; folded, where a page can.
///
/// # Errors
/// If the table lacks a column.
pub(super) fn configurations(tables: &Tables) -> Result<String> {
    let mut text = String::new();
    let mut methods: Vec<(String, String)> = Vec::new();
    let mut runs = tables.runs()?;
    runs.retain(|run| !run.configuration.is_empty());
    for run in &runs {
        let method = (run.task.clone(), run.method.clone());
        if methods.contains(&method) {
            continue;
        }
        let alike: Vec<&Run> =
            runs.iter().filter(|other| (&other.task, &other.method) == (&run.task, &run.method)).collect();
        let seeds: Vec<String> = alike.iter().map(|run| run.seed.to_string()).collect();
        let versions: BTreeSet<String> = alike.iter().map(|run| escaped(&shortened(&run.version, 200))).collect();
        let versions: Vec<String> = versions.into_iter().collect();
        let (of, version) = (if seeds.len() == 1 { "seed" } else { "seeds" }, versions.join(", "));
        write!(
            text,
            "\n<details><summary><code>{}</code> on <code>{}</code>: {of} {}; version {version}</summary>\n\n",
            run.method,
            run.task,
            seeds.join(", "),
        )
        .expect("text grows");
        // Lines that begin with four spaces are code, whatever is in them.
        for line in run.configuration.lines() {
            writeln!(text, "    {line}").expect("text grows");
        }
        text += "\n</details>\n";
        methods.push(method);
    }
    Ok(text)
}
