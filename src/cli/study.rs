//! `study`: compare methods on tasks.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use indicatif::HumanDuration;

use super::output::{answer, note};
use super::progress::Progress;
use super::{note_long_warm_up, refuse_folder_of, stop_on_ctrl_c, whole};
use crate::error::{Error, Result};
use crate::study::config::RunConfig;
#[cfg(feature = "study")]
use crate::study::others::others_among;
use crate::study::registry::Registry;
use crate::study::run::check_run;
use crate::study::runner::{self, Profile, StudyPlan};
use crate::study::starts::Starts;
use crate::study::status::{RunState, RunStatus, status, time_left};

#[derive(clap::Args)]
pub(super) struct Args {
    /// Size of the study
    #[arg(long, value_enum, default_value_t = ProfileArg::Quick)]
    profile: ProfileArg,
    /// Tasks, separated by commas; each then has the full budget of its presets, also in the quick profile [default: those
    /// of the profile]
    #[arg(long, value_delimiter = ',')]
    tasks: Option<Vec<String>>,
    /// Methods, separated by commas [default: those of the profile]
    #[arg(long, value_delimiter = ',')]
    methods: Option<Vec<String>>,
    /// How many seeds, or a range like 0..5 (without 5); methods that do not learn have the first one only [default: 2, in the full
    /// profile 5]
    #[arg(long, value_parser = seed_range, allow_negative_numbers = true)]
    seeds: Option<Range<u64>>,
    /// Initial states of evaluations and test: test, or development for tuning [default: test]
    #[arg(long)]
    starts: Option<Starts>,
    /// Runs at a time [default: as many as there are cores]
    #[arg(long, value_parser = at_least_one, allow_negative_numbers = true)]
    jobs: Option<usize>,
    /// Where to write everything [default: runs/PROFILE]
    #[arg(long)]
    out: Option<PathBuf>,
    /// Only print the progress of the runs, which another process may be carrying out
    #[arg(long)]
    status: bool,
}

impl Default for Args {
    fn default() -> Self {
        Self {
            profile: ProfileArg::Quick,
            tasks: None,
            methods: None,
            seeds: None,
            starts: None,
            jobs: None,
            out: None,
            status: false,
        }
    }
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum ProfileArg {
    /// A few minutes
    Quick,
    /// Hours
    Full,
}

pub(super) fn run(registry: &Registry, args: Args) -> Result<()> {
    let (profile, name) = match args.profile {
        ProfileArg::Quick => (Profile::Quick, "quick"),
        ProfileArg::Full => (Profile::Full, "full"),
    };
    let folder = args.out.unwrap_or_else(|| Path::new("runs").join(name));
    let mut plan = StudyPlan::new(registry, profile, folder);
    if let Some(tasks) = args.tasks {
        plan = plan.with_tasks(tasks);
    }
    match args.methods {
        Some(methods) => plan.methods = methods,
        None => leave_out_what_a_task_lacks(registry, &mut plan)?,
    }
    plan.seeds = args.seeds.unwrap_or(plan.seeds);
    let cores = || std::thread::available_parallelism().map_or(1, usize::from);
    let jobs = args.jobs.unwrap_or_else(cores);
    refuse_folder_of("run", "config.toml", &plan.folder)?;
    let mut runs = plan.runs(registry)?;
    for (config, folder) in &mut runs {
        config.starts = args.starts.unwrap_or(config.starts);
        *config = registry.as_begun(config, folder);
        check_run(folder, config)?;
    }
    if args.status {
        return answer(report_status(&status(&runs), jobs));
    }
    #[cfg(feature = "study")]
    crate::study::tables::check_place(&plan.folder, &runs)?;
    let mut first_of_method: Vec<&RunConfig> = runs.iter().map(|(config, _)| config).collect();
    first_of_method.dedup_by_key(|config| (&config.task, &config.method));
    first_of_method.into_iter().for_each(note_long_warm_up);
    let stop = stop_on_ctrl_c()?;
    let progress = Progress::new(&runs);
    let failed = match runner::carry_out_all(registry, &runs, jobs, &progress, &stop) {
        Err(problem @ Error::Run { .. }) => Err(problem),
        carried_out => Ok(carried_out?),
    };
    progress.finish();
    match (failed, conclude(registry, &runs, &plan.folder, &stop)) {
        (Err(_), Err(problem @ (Error::Interrupted | Error::Io { .. }))) => Err(problem),
        (failed, concluded) => failed.and(concluded),
    }
}

/// Of the methods that nobody asked for, those are left out that need something which one of the tasks does not have: a script, a
/// snapshot, a known reward.
///
/// # Errors
/// If something else is wrong with a task or a method.
fn leave_out_what_a_task_lacks(registry: &Registry, plan: &mut StudyPlan) -> Result<()> {
    let mut kept = Vec::new();
    for method in std::mem::take(&mut plan.methods) {
        let mut lacks = None;
        for task in &plan.tasks {
            let config = registry.config(task, &method, 0, None, None)?;
            registry.make_env(&config)?.spec().check()?;
            match registry.method(&config) {
                Err(problem @ Error::Unsupported(_)) => lacks = Some(problem),
                made => drop(made?),
            }
        }
        match lacks {
            Some(problem) => note(format_args!("without {method}: {problem}")),
            None => kept.push(method),
        }
    }
    plan.methods = kept;
    Ok(())
}

/// A line for each task and method, and one for all.
fn report_status(runs: &[RunStatus], jobs: usize) -> String {
    let mut groups: Vec<(&str, &str)> = Vec::new();
    for run in runs {
        if !groups.contains(&(&run.task, &run.method)) {
            groups.push((&run.task, &run.method));
        }
    }
    let line = |name: &str, runs: &[RunStatus]| {
        let count = |state| runs.iter().filter(|run| run.state == state).count();
        let step: usize = runs.iter().map(|run| run.step).sum();
        let steps: usize = runs.iter().map(|run| run.steps).sum();
        let trained = (100 * step).checked_div(steps).map_or(String::from("-"), |percent| format!("{percent} %"));
        let left = match time_left(runs, jobs) {
            _ if step == steps => String::from("-"),
            Some(seconds) => {
                Duration::try_from_secs_f64(seconds).map_or("unknown".into(), |left| HumanDuration(left).to_string())
            }
            None => String::from("unknown"),
        };
        let [complete, running, stopped, waiting] =
            [RunState::Complete, RunState::Running, RunState::Stopped, RunState::Waiting].map(count);
        format!("{name:24} {complete:8} {running:7} {stopped:7} {waiting:7} {trained:>7}  {left}\n")
    };
    let mut text = format!(
        "{:24} {:>8} {:>7} {:>7} {:>7} {:>7}  {}\n",
        "", "complete", "running", "stopped", "waiting", "trained", "time left"
    );
    for (task, method) in groups {
        let alike: Vec<RunStatus> =
            runs.iter().filter(|run| run.task == task && run.method == method).cloned().collect();
        text += &line(&format!("{task} {method}"), &alike);
    }
    text + line(&format!("all, {jobs} at a time"), runs).trim_end()
}

fn at_least_one(text: &str) -> Result<usize, &'static str> {
    whole(text).and_then(|number| if number == 0 { Err("give at least 1") } else { Ok(number) })
}

fn seed_range(text: &str) -> Result<Range<u64>, String> {
    let bad = |_| String::from("give a number of seeds, or a range like 0..5");
    match text.split_once("..") {
        Some((from, to)) => Ok(from.parse().map_err(bad)?..to.parse().map_err(bad)?),
        None => Ok(0..text.parse().map_err(bad)?),
    }
}

#[cfg(feature = "study")]
fn conclude(registry: &Registry, runs: &[(RunConfig, PathBuf)], folder: &Path, stop: &AtomicBool) -> Result<()> {
    // A run may have been begun there since.
    refuse_folder_of("run", "config.toml", folder)?;
    let mut tables = crate::study::tables::Tables::gather(runs.iter().map(|(_, folder)| folder.as_path()))?;
    tables.leave_out(others_among(folder, runs))?;
    tables.write(folder)?;
    for problem in crate::study::replays::record(registry, runs, folder, stop)? {
        note(format_args!("no replay: {problem}"));
    }
    super::report::write(folder, folder)
}

#[cfg(not(feature = "study"))]
fn conclude(_registry: &Registry, _runs: &[(RunConfig, PathBuf)], folder: &Path, _stop: &AtomicBool) -> Result<()> {
    let advice = "build with the feature `study` for tables and figures";
    super::output::answer(format_args!("the runs are in {}; {advice}", folder.display()))
}
