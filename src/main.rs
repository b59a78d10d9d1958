//! The command line.

mod progress;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::{Parser, Subcommand, ValueEnum};
use console::style;
use handful::agent::{Agent, Random, Scripted};
use handful::env::tabletop::TableOptions;
use handful::env::{Env, Task};
use handful::error::{Error, Result};
use handful::study::config::RunConfig;
use handful::study::evaluate::{EvalSeeds, Evaluator};
use handful::study::plan::{self, Profile, StudyPlan};
use handful::study::run::{self, trained_agent};
use handful::watch::Recording;

use progress::Progress;

/// Training makes and drops many arrays of a quarter of a megabyte; the system's allocator would give each back to
/// the kernel and fault it in again.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Model-based reinforcement learning on a robot arm. Without a command: the quick study.
#[derive(Parser)]
#[command(version, about)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
}

#[derive(Subcommand)]
enum Command {
    /// Compare methods on tasks: train, test, draw, report. Resumes where it stopped.
    Study(StudyArgs),
    /// Train one agent. Resumes where it stopped.
    Train(TrainArgs),
    /// Test a trained agent.
    Evaluate(EvaluateArgs),
    /// Make tables, figures and report.md anew from a study's CSV files.
    Report(ReportArgs),
    /// Write an episode as one HTML file with a 3D replay.
    Watch(WatchArgs),
}

#[derive(clap::Args)]
struct StudyArgs {
    /// How much to take on
    #[arg(long, value_enum, default_value_t = ProfileArg::Quick)]
    profile: ProfileArg,
    /// Tasks, separated by commas
    #[arg(long, value_delimiter = ',')]
    tasks: Option<Vec<String>>,
    /// Methods, separated by commas
    #[arg(long, value_delimiter = ',')]
    methods: Option<Vec<String>>,
    /// How many seeds, or a range like 0..5
    #[arg(long)]
    seeds: Option<String>,
    /// Runs at a time; as many as there are cores if left out
    #[arg(long)]
    jobs: Option<usize>,
    /// Where to write everything [default: runs/PROFILE]
    #[arg(long)]
    out: Option<PathBuf>,
}

#[derive(Clone, Copy, ValueEnum)]
enum ProfileArg {
    /// A few minutes
    Quick,
    /// Hours
    Full,
}

#[derive(clap::Args)]
struct TrainArgs {
    /// The task: reach, push, lift, stack, pendulum or cartpole
    #[arg(long)]
    task: String,
    /// The method: a preset, like sac
    #[arg(long)]
    method: String,
    /// Environment steps; the preset's number if left out
    #[arg(long)]
    steps: Option<usize>,
    /// The seed of everything random
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// A TOML file with settings that differ from the preset
    #[arg(long)]
    config: Option<PathBuf>,
    /// The run's folder [default: runs/TASK-METHOD-seedN]
    #[arg(long)]
    out: Option<PathBuf>,
}

#[derive(clap::Args)]
struct EvaluateArgs {
    /// A run's folder
    #[arg(long)]
    run: PathBuf,
    /// Episodes
    #[arg(long, default_value_t = 100)]
    episodes: usize,
    /// The seed of the starts; the test's own starts if left out
    #[arg(long)]
    seed: Option<u64>,
    /// Answer in JSON
    #[arg(long)]
    json: bool,
}

#[derive(clap::Args)]
struct ReportArgs {
    /// A study's folder
    #[arg(long, default_value = "runs/quick")]
    from: PathBuf,
    /// Where to write report and figures; the same folder if left out
    #[arg(long)]
    out: Option<PathBuf>,
}

#[derive(clap::Args)]
struct WatchArgs {
    /// A run's folder
    #[arg(long, required_unless_present = "task", conflicts_with = "task")]
    run: Option<PathBuf>,
    /// A task, for a policy that needs no training
    #[arg(long)]
    task: Option<String>,
    /// That policy: scripted or random
    #[arg(long, default_value = "scripted", conflicts_with = "run")]
    policy: String,
    /// The episode's seed
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// The file [default: NAME.html]
    #[arg(long)]
    out: Option<PathBuf>,
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    let stop = Arc::new(AtomicBool::new(false));
    let outcome = stop_on_ctrl_c(&stop).and_then(|()| match cli.command {
        None => Cli::try_parse_from(["handful", "study"])
            .map_err(|problem| Error::BadSetting(problem.to_string()))
            .and_then(|default| match default.command {
                Some(Command::Study(args)) => study(args, &stop),
                _ => unreachable!("that is the command that was asked for"),
            }),
        Some(Command::Study(args)) => study(args, &stop),
        Some(Command::Train(args)) => train(args, &stop),
        Some(Command::Evaluate(args)) => evaluate(&args),
        Some(Command::Report(args)) => report(&args.from, args.out.as_deref().unwrap_or(&args.from)),
        Some(Command::Watch(args)) => watch(&args),
    });
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(Error::Interrupted) => {
            eprintln!("{}", Error::Interrupted);
            ExitCode::from(130)
        }
        Err(error) => {
            eprintln!("{} {error}", style("error:").red().bold().for_stderr());
            ExitCode::from(2)
        }
    }
}

/// The first Ctrl-C asks runs to finish their episode (in a test, the episodes that are played side by side) and to save; the
/// second ends the program.
fn stop_on_ctrl_c(stop: &Arc<AtomicBool>) -> Result<()> {
    let stop = Arc::clone(stop);
    ctrlc::set_handler(move || {
        if stop.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
        eprintln!("\nfinishing the episodes that have begun and saving; press Ctrl-C again to give that up");
    })
    .map_err(|problem| Error::BadSetting(format!("cannot watch for Ctrl-C: {problem}")))
}

fn study(args: StudyArgs, stop: &AtomicBool) -> Result<()> {
    let (profile, name) = match args.profile {
        ProfileArg::Quick => (Profile::Quick, "quick"),
        ProfileArg::Full => (Profile::Full, "full"),
    };
    let folder = args.out.unwrap_or_else(|| Path::new("runs").join(name));
    let mut plan = StudyPlan::new(profile, folder);
    if let Some(tasks) = args.tasks {
        plan.tasks = tasks.iter().map(|name| name.parse()).collect::<Result<_>>()?;
    }
    if let Some(methods) = args.methods {
        plan.methods = methods;
    }
    if let Some(seeds) = args.seeds {
        plan.seeds = seed_range(&seeds)?;
    }
    let jobs = args.jobs.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from));
    if jobs == 0 {
        return Err(Error::BadSetting("`--jobs` must be at least 1".into()));
    }
    let runs = plan.runs()?;
    let progress = Progress::new(&runs);
    plan::carry_out_all(&runs, jobs, &progress, stop)?;
    progress.finish();
    conclude(&runs, &plan.folder)
}

fn seed_range(text: &str) -> Result<std::ops::Range<u64>> {
    let bad = |_| Error::BadSetting(format!("`--seeds {text}`: give a number of seeds, or a range like 0..5"));
    match text.split_once("..") {
        Some((from, to)) => Ok(from.parse().map_err(bad)?..to.parse().map_err(bad)?),
        None => Ok(0..text.parse().map_err(bad)?),
    }
}

#[cfg(feature = "study")]
fn conclude(runs: &[(RunConfig, PathBuf)], folder: &Path) -> Result<()> {
    let tables = handful::study::tables::Tables::gather(runs.iter().map(|(_, folder)| folder.as_path()))?;
    tables.write(folder)?;
    report(folder, folder)
}

#[cfg(not(feature = "study"))]
fn conclude(_runs: &[(RunConfig, PathBuf)], folder: &Path) -> Result<()> {
    println!("the runs are in {}; build with the feature `study` for tables and figures", folder.display());
    Ok(())
}

#[cfg(feature = "study")]
fn report(from: &Path, to: &Path) -> Result<()> {
    println!("{}", handful::study::report::write(from, to)?);
    println!("report: {}", to.join("report.md").display());
    Ok(())
}

#[cfg(not(feature = "study"))]
fn report(_from: &Path, _to: &Path) -> Result<()> {
    Err(Error::BadSetting("reports need the feature `study`: cargo run --features study".into()))
}

fn train(args: TrainArgs, stop: &AtomicBool) -> Result<()> {
    let task: Task = args.task.parse()?;
    let config = RunConfig::new(task, &args.method, args.seed, args.steps, args.config.as_deref())?;
    let folder =
        args.out.unwrap_or_else(|| Path::new("runs").join(format!("{task}-{}-seed{}", args.method, args.seed)));
    if run::is_complete(&folder) && RunConfig::read(&folder.join("config.toml"))? == config {
        println!("this run is complete: {}", folder.display());
        return print_test(&folder);
    }
    let runs = vec![(config, folder)];
    let progress = Progress::new(&runs);
    let (config, folder) = &runs[0];
    // Inside the thread pool, so that parallel pieces of an update need no hand-over.
    rayon::scope(|_| plan::carry_out(0, config, folder, &progress, stop))?;
    progress.finish();
    print_test(folder)
}

fn print_test(folder: &Path) -> Result<()> {
    let path = folder.join("summary.toml");
    let text = std::fs::read_to_string(&path).map_err(Error::io("read", &path))?;
    print!("{text}");
    println!("run: {}", folder.display());
    Ok(())
}

fn evaluate(args: &EvaluateArgs) -> Result<()> {
    let (config, mut agent) = trained_agent(&args.run)?;
    let starts = args.seed.map_or(EvalSeeds::Test, EvalSeeds::Seed);
    let make = || config.world();
    let summary = Evaluator::new(make)?.evaluate(agent.as_mut(), args.episodes, starts)?.summary();
    if args.json {
        println!("{}", serde_json::to_string_pretty(&summary).expect("a summary is JSON"));
    } else {
        print!("{}", toml::to_string(&summary).expect("a summary is TOML"));
    }
    Ok(())
}

fn watch(args: &WatchArgs) -> Result<()> {
    let (title, mut world, mut agent, default) = match (&args.run, &args.task) {
        (Some(folder), _) => {
            let (config, agent) = trained_agent(folder)?;
            let title = format!("{}, {}, seed {}", config.task, config.method, args.seed);
            (title, config.world()?, agent, folder.join("watch.html"))
        }
        (None, Some(name)) => {
            let task: Task = name.parse()?;
            let world = task.make();
            let agent: Box<dyn Agent> = match args.policy.as_str() {
                "scripted" => Box::new(Scripted::new(task, TableOptions::default())?),
                "random" => Box::new(Random::new(world.spec(), args.seed)),
                other => return Err(Error::unknown("policy", other, ["scripted", "random"])),
            };
            let title = format!("{task}, {}, seed {}", args.policy, args.seed);
            (title, world, agent, PathBuf::from(format!("{task}-{}.html", args.policy)))
        }
        (None, None) => unreachable!("the command line asks for one of them"),
    };
    let recording = Recording::of_episode(title, &mut world, agent.as_mut(), args.seed)?;
    let path = args.out.clone().unwrap_or(default);
    recording.write(&path)?;
    let outcome = if recording.success() { "success" } else { "no success" };
    println!("{} steps, {outcome}; open {} in a browser", recording.steps(), path.display());
    Ok(())
}
