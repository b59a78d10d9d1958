//! `evaluate`: test a trained agent.

use std::path::PathBuf;

use super::output::answer;
use super::{note_other_shake, note_unfinished, whole};
use crate::error::Result;
use crate::study::evaluate::{EvalSeeds, Evaluation, Evaluator};
use crate::study::registry::Registry;
use crate::study::starts::Starts;

#[derive(clap::Args)]
pub(super) struct Args {
    /// A run's folder
    #[arg(long)]
    run: PathBuf,
    /// Episodes
    #[arg(long, default_value_t = 100, value_parser = whole::<usize>, allow_negative_numbers = true)]
    episodes: usize,
    /// The seed of the initial states
    #[arg(long, conflicts_with = "starts", value_parser = whole::<u64>, allow_negative_numbers = true)]
    seed: Option<u64>,
    /// The initial states: test, or development (on which settings are chosen) [default: those of the run's test]
    #[arg(long)]
    starts: Option<Starts>,
    /// A TOML file with settings that differ from the run's, such as another planner for its model
    #[arg(long)]
    config: Option<PathBuf>,
    /// Answer in JSON
    #[arg(long)]
    json: bool,
}

pub(super) fn run(registry: &Registry, args: &Args) -> Result<()> {
    let (config, mut method) = registry.trained_method_with(&args.run, args.config.as_deref())?;
    note_other_shake(&config);
    note_unfinished(&args.run);
    let seeds = args.seed.map_or(args.starts.unwrap_or(config.starts).test(), EvalSeeds::Seed);
    let mut evaluator = Evaluator::new(|| registry.make_env(&config))?;
    let mut evaluation = Evaluation::default();
    while !evaluator.next_batch(&mut evaluation, &mut method, args.episodes, seeds)? {
        // Only the results are asked for, and a million episodes do not fit into memory.
        evaluation.episodes.clear();
    }
    let summary = evaluation.summary();
    answer(if args.json {
        serde_json::to_string_pretty(&summary).expect("a summary is JSON")
    } else {
        toml::to_string(&summary).expect("a summary is TOML").trim_end().into()
    })
}
