//! `watch`: an episode as a 3D replay.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use super::output::answer;
use super::{note_other_shake, note_unfinished, whole};
use crate::error::{Error, Result};
use crate::study::config::RunConfig;
use crate::study::registry::Registry;
use crate::study::starts::EvalSeeds;
use crate::watch::Recording;

#[derive(clap::Args)]
#[command(group = clap::ArgGroup::new("agent").required(true).args(["run", "task"]))]
pub(super) struct Args {
    /// A run's folder
    #[arg(long)]
    run: Option<PathBuf>,
    /// A task, for a policy that needs no training
    #[arg(long)]
    task: Option<String>,
    /// The policy: scripted, random, oracle, or another that does not learn
    #[arg(long, default_value = "scripted", conflicts_with = "run")]
    policy: String,
    /// Seed: the episode starts as the first one of `evaluate --seed` with it
    #[arg(long, default_value_t = 0, value_parser = whole::<u64>, allow_negative_numbers = true)]
    seed: u64,
    /// The file [default: watch.html in the run's folder, or TASK-POLICY.html]
    #[arg(long)]
    out: Option<PathBuf>,
}

/// The configuration of a policy that does not learn.
fn without_training(registry: &Registry, task: &str, policy: &str, seed: u64) -> Result<RunConfig> {
    let fixed = |policy: &str| {
        registry.config(task, policy, seed, None, None).map(|config| (!config.learns()).then_some(config))
    };
    match fixed(policy) {
        Ok(Some(config)) => Ok(config),
        Err(problem)
            if registry.method_names().any(|name| name == policy) || !registry.env_names().any(|name| name == task) =>
        {
            Err(problem)
        }
        _ => {
            let known = registry.method_names().filter(|name| matches!(fixed(name), Ok(Some(_))));
            Err(Error::unknown("policy", policy, known))
        }
    }
}

/// # Errors
/// If the path is a folder, or a file that is not a replay (it would be lost) or cannot be read.
fn refuse_other_file(path: &Path) -> Result<()> {
    if path.is_dir() {
        return Err(Error::Config(format!("{}: this is a folder; give --out the name of a file", path.display())));
    }
    let mut begins = Vec::new();
    if path.is_file() {
        let read = File::open(path).and_then(|file| file.take(9).read_to_end(&mut begins));
        read.map_err(Error::io("read", path))?;
    }
    if begins.is_empty() || begins == b"<!doctype" {
        return Ok(());
    }
    Err(Error::Config(format!("{}: this file is not a replay; choose another --out", path.display())))
}

pub(super) fn run(registry: &Registry, args: &Args) -> Result<()> {
    let (config, mut method, default) = match (&args.run, &args.task) {
        (Some(folder), _) => {
            let (config, method) = registry.trained_method(folder)?;
            note_other_shake(&config);
            note_unfinished(folder);
            (config, method, folder.join("watch.html"))
        }
        (None, Some(task)) => {
            let config = without_training(registry, task, &args.policy, args.seed)?;
            let method = registry.method(&config)?;
            (config, method, PathBuf::from(format!("{task}-{}.html", args.policy)))
        }
        (None, None) => unreachable!("the command line asks for one of them"),
    };
    let path = args.out.clone().unwrap_or(default);
    refuse_other_file(&path)?;
    let title = format!("{}, {}, seed {}", config.task, config.method, args.seed);
    let reset_seed = EvalSeeds::Seed(args.seed).seed(0)?;
    let recording = Recording::of_episode(title, registry.make_env(&config)?, &mut method, reset_seed)?;
    if !recording.is_visible() {
        let advice = "draws nothing to watch: implement `Env::scene` and `Env::poses`";
        return Err(Error::Unsupported(format!("`{}` {advice}", config.task)));
    }
    recording.write(&path)?;
    let outcome = if recording.success() { "success" } else { "no success" };
    answer(format_args!("{} steps, {outcome}; open {} in a browser", recording.steps(), path.display()))
}
