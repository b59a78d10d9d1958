//! `export`: what a run has learned, as a small folder of its own.

use std::path::PathBuf;

use super::output::answer;
use super::{note_unfinished, refuse_folder_of};
use crate::error::Result;
use crate::study::run::export;

#[derive(clap::Args)]
pub(super) struct Args {
    /// A run's folder
    #[arg(long)]
    run: PathBuf,
    /// The folder to write, for `evaluate` and `watch`
    #[arg(long)]
    out: PathBuf,
}

pub(super) fn run(args: &Args) -> Result<()> {
    refuse_folder_of("study", "tests.csv", &args.out)?;
    let bytes = export(&args.run, &args.out)?;
    note_unfinished(&args.run);
    answer(format_args!("{}: settings and weights, {} kB", args.out.display(), bytes.div_ceil(1000)))
}
