//! `train`: one run.

use std::path::{Path, PathBuf};

use super::output::answer;
use super::progress::Progress;
use super::{note_long_warm_up, refuse_folder_of, stop_on_ctrl_c, whole};
use crate::error::Result;
use crate::study::registry::Registry;
use crate::study::run::{is_complete, read_summary};
use crate::study::runner;
use crate::study::starts::Starts;

#[derive(clap::Args)]
pub(super) struct Args {
    /// The task: reach, push, lift, stack, door, pendulum, cartpole, or one that was registered
    #[arg(long)]
    task: String,
    /// The method: a preset, like sac
    #[arg(long)]
    method: String,
    /// Environment steps; the preset's number if left out
    #[arg(long, value_parser = whole::<usize>, allow_negative_numbers = true)]
    steps: Option<usize>,
    /// The seed of everything random
    #[arg(long, default_value_t = 0, value_parser = whole::<u64>, allow_negative_numbers = true)]
    seed: u64,
    /// Initial states of evaluations and test: test, or development for tuning
    #[arg(long)]
    starts: Option<Starts>,
    /// A TOML file with settings that differ from the preset
    #[arg(long)]
    config: Option<PathBuf>,
    /// The run's folder [default: runs/TASK-METHOD-seedN]
    #[arg(long)]
    out: Option<PathBuf>,
}

pub(super) fn run(registry: &Registry, args: Args) -> Result<()> {
    let Args { task, method, steps, seed, starts, config, out } = args;
    let mut config = registry.config(&task, &method, seed, steps, config.as_deref())?;
    config.starts = starts.unwrap_or(config.starts);
    let folder = out.unwrap_or_else(|| Path::new("runs").join(format!("{task}-{method}-seed{seed}")));
    refuse_folder_of("study", "tests.csv", &folder)?;
    let config = registry.as_begun(&config, &folder);
    if is_complete(&folder, &config) {
        answer(format_args!("this run is complete: {}", folder.display()))?;
        return print_test(&folder);
    }
    note_long_warm_up(&config);
    let stop = stop_on_ctrl_c()?;
    let runs = vec![(config, folder)];
    let progress = Progress::new(&runs);
    let (config, folder) = &runs[0];
    // Inside the thread pool, so that parallel pieces of an update need no hand-over.
    rayon::scope(|_| runner::carry_out(registry, 0, config, folder, &progress, &stop))?;
    progress.finish();
    print_test(folder)
}

fn print_test(folder: &Path) -> Result<()> {
    let text = toml::to_string(&read_summary(folder)?).expect("a summary is TOML");
    answer(format_args!("{text}run: {}", folder.display()))
}
