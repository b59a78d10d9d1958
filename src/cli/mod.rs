//! The command line: train, resume, evaluate, compare, report and watch, for everything in a [`Registry`].
//!
//! The program `handful` is this with [`Registry::standard`]; a program of one's own registers more and calls [`main`].

mod evaluate;
mod export;
mod output;
mod progress;
mod report;
mod study;
mod train;
mod watch;

use std::error::Error as _;
use std::path::Path;
use std::process::ExitCode;
use std::str::FromStr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::{Parser, Subcommand};
use console::style;

use self::output::note;
use crate::error::{Error, Result};
use crate::rng::{read_shake, shake};
use crate::study::config::RunConfig;
use crate::study::registry::Registry;
use crate::study::run::is_unfinished;

/// Model-based reinforcement learning on a robot arm. Without a command: the quick study.
#[derive(Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
}

#[derive(Subcommand)]
enum Command {
    /// Compare methods on tasks: train, test, draw, report. Resumes where it stopped.
    Study(study::Args),
    /// Train one agent. Resumes where it stopped.
    Train(train::Args),
    /// Test a trained agent.
    Evaluate(evaluate::Args),
    /// Write a run's settings and weights (matrices in half precision) to a folder to share.
    Export(export::Args),
    /// Write figures, summary.csv, report.md and report.html again from a study's CSV files.
    Report(report::Args),
    /// Write an episode as one HTML file with a 3D replay.
    Watch(watch::Args),
}

/// Starts with other random numbers than those of the run would be other starts.
fn note_other_shake(config: &RunConfig) {
    if config.shake != shake() {
        note(format_args!(
            "this run was made with HANDFUL_SHAKE={}, which is {} now, so the starts are not those of the run",
            config.shake,
            shake()
        ));
    }
}

/// Carries out the command that the program was called with. The answer is the program's exit code: 0, 2 after an error,
/// 130 after an interruption.
pub fn main(registry: &Registry) -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        // One line, as for all other values that cannot be used.
        Err(problem) if problem.kind() == clap::error::ErrorKind::ValueValidation => {
            note(problem.render().to_string().lines().next().unwrap_or_default());
            return ExitCode::from(2);
        }
        Err(problem) => problem.exit(),
    };
    let outcome = read_shake().and_then(|_| begin_threads()).and_then(|()| match cli.command {
        None => study::run(registry, study::Args::default()),
        Some(Command::Study(args)) => study::run(registry, args),
        Some(Command::Train(args)) => train::run(registry, args),
        Some(Command::Evaluate(args)) => end_on_ctrl_c().and_then(|()| evaluate::run(registry, &args)),
        Some(Command::Export(args)) => end_on_ctrl_c().and_then(|()| export::run(&args)),
        Some(Command::Report(args)) => end_on_ctrl_c().and_then(|()| report::run(&args)),
        Some(Command::Watch(args)) => end_on_ctrl_c().and_then(|()| watch::run(registry, &args)),
    });
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(Error::Interrupted) => {
            note(Error::Interrupted);
            ExitCode::from(130)
        }
        Err(error) => {
            note(format_args!("{} {error}", style("error:").red().bold().for_stderr()));
            ExitCode::from(2)
        }
    }
}

/// The threads that all commands share.
fn begin_threads() -> Result<()> {
    // What a library would panic at, ignore, or spend minutes on.
    for (name, least) in [("RAYON_NUM_THREADS", 0), ("POLARS_MAX_THREADS", 1)] {
        let value = std::env::var_os(name).unwrap_or_default().to_string_lossy().into_owned();
        if !value.is_empty() && !value.parse().is_ok_and(|count: usize| (least..=1024).contains(&count)) {
            return Err(Error::Config(format!("{name} is `{value}`; it must be a whole number from {least} to 1024")));
        }
    }
    match rayon::ThreadPoolBuilder::new().build_global() {
        // Without a cause, a program of one's own has begun them already.
        Err(problem) if problem.source().is_some() => {
            Err(Error::Config(format!("cannot start threads ({problem}); lower RAYON_NUM_THREADS")))
        }
        _ => Ok(()),
    }
}

/// A number on the command line.
fn whole<T: FromStr>(text: &str) -> Result<T, &'static str> {
    let digits = !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    text.parse().map_err(|_| if digits { "it is too large" } else { "give a whole number, 0 or more" })
}

/// Says that the run in a folder has not ended, so that its weights may not be those that it will end with.
fn note_unfinished(folder: &Path) {
    if is_unfinished(folder) {
        note(format_args!("{}: this run has not ended; these are its weights so far", folder.display()));
    }
}

/// Runs and studies have tables of the same names: neither writes over those of the other.
///
/// # Errors
/// If the folder holds a `what`, which this file of it tells.
fn refuse_folder_of(what: &str, file: &str, folder: &Path) -> Result<()> {
    if folder.join(file).exists() {
        return Err(Error::Config(format!("{}: this folder holds a {what}; choose another --out", folder.display())));
    }
    Ok(())
}

/// Says so if a run ends within the warm-up of its agent.
fn note_long_warm_up(config: &RunConfig) {
    let warm_up = config.settings.get("warm_up").filter(|_| config.learns()).and_then(toml::Value::as_integer);
    if let Some(warm_up) =
        warm_up.filter(|warm_up| usize::try_from(*warm_up).is_ok_and(|warm_up| warm_up > config.steps))
    {
        let RunConfig { task, method, agent, steps, .. } = config;
        note(format_args!(
            "{method} on {task} learns nothing: `{agent}.warm_up` is {warm_up}, and the run has {steps} steps"
        ));
    }
}

/// For commands that have nothing to save: Ctrl-C, SIGTERM and SIGHUP end the program.
fn end_on_ctrl_c() -> Result<()> {
    handle_ctrl_c(|| std::process::exit(130))
}

/// For commands that have something to save. The first Ctrl-C asks runs to finish their episode (in a
/// test, the batch of episodes that run side by side) and to save, by setting what is returned; a second one, later than within a
/// second, ends the program.
/// SIGTERM and SIGHUP do the same.
fn stop_on_ctrl_c() -> Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let asked = Arc::clone(&stop);
    let mut first: Option<Instant> = None;
    handle_ctrl_c(move || {
        asked.store(true, Ordering::Relaxed);
        match first {
            // GNU `timeout`, for one, signals a process and then its group.
            Some(first) if first.elapsed() < Duration::from_secs(1) => return,
            Some(_) => std::process::exit(130),
            None => first = Some(Instant::now()),
        }
        note("\nfinishing the episodes that have begun and saving; press Ctrl-C again to quit at once");
    })?;
    Ok(stop)
}

/// A SIGHUP that was ignored when the program began stays so: `nohup handful train ... &` outlives its terminal.
fn handle_ctrl_c(handler: impl FnMut() + Send + 'static) -> Result<()> {
    // SAFETY: to ignore a signal runs no code of ours; the answer is what was done about it before.
    #[cfg(unix)]
    let ignore_hang_up = || unsafe { libc::signal(libc::SIGHUP, libc::SIG_IGN) };
    #[cfg(unix)]
    let before = ignore_hang_up();
    ctrlc::set_handler(handler).map_err(|problem| Error::Config(format!("cannot watch for Ctrl-C: {problem}")))?;
    #[cfg(unix)]
    if before == libc::SIG_IGN {
        ignore_hang_up();
    }
    Ok(())
}
