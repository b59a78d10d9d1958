//! `evaluate`: test a trained agent.

use std::path::PathBuf;

use crate::error::Result;
use crate::study::evaluate::{EvalSeeds, Evaluator};
use crate::study::registry::Registry;

#[derive(clap::Args)]
pub(super) struct Args {
    /// A run's folder
    #[arg(long)]
    run: PathBuf,
    /// Episodes
    #[arg(long, default_value_t = 100)]
    episodes: usize,
    /// The seed of the initial states; those of the test if left out
    #[arg(long)]
    seed: Option<u64>,
    /// Answer in JSON
    #[arg(long)]
    json: bool,
}

pub(super) fn run(registry: &Registry, args: &Args) -> Result<()> {
    let (config, mut method) = registry.trained_method(&args.run)?;
    let seeds = args.seed.map_or(EvalSeeds::Test, EvalSeeds::Seed);
    let mut evaluator = Evaluator::new(|| registry.make_env(&config))?;
    let summary = evaluator.evaluate(&mut method, args.episodes, seeds)?.summary();
    if args.json {
        println!("{}", serde_json::to_string_pretty(&summary).expect("a summary is JSON"));
    } else {
        print!("{}", toml::to_string(&summary).expect("a summary is TOML"));
    }
    Ok(())
}
