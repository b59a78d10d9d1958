//! `report`: tables, figures and report of a study anew.

use std::path::{Path, PathBuf};

use crate::error::Result;

#[derive(clap::Args)]
pub(super) struct Args {
    /// A study's folder
    #[arg(long, default_value = "runs/quick")]
    from: PathBuf,
    /// Where to write report and figures; the same folder if left out
    #[arg(long)]
    out: Option<PathBuf>,
}

pub(super) fn run(args: &Args) -> Result<()> {
    write(&args.from, args.out.as_deref().unwrap_or(&args.from))
}

#[cfg(feature = "study")]
pub(super) fn write(from: &Path, to: &Path) -> Result<()> {
    let table = crate::study::report::write(from, to)?;
    super::output::answer(format_args!("{table}\nreport: {}", to.join("report.md").display()))
}

#[cfg(not(feature = "study"))]
pub(super) fn write(_from: &Path, _to: &Path) -> Result<()> {
    Err(crate::error::Error::Config("reports need the feature `study`: cargo run --features study".into()))
}
