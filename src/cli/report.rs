//! `report`: tables, figures and report of a study anew, or of several studies together.

use std::path::{Path, PathBuf};

use super::refuse_folder_of;
use crate::error::{Error, Result};

#[derive(clap::Args)]
pub(super) struct Args {
    /// A study's folder; given several times, their runs are joined in --out
    #[arg(long, default_value = "runs/quick")]
    from: Vec<PathBuf>,
    /// Where to write report and figures; the same folder if left out
    #[arg(long)]
    out: Option<PathBuf>,
}

pub(super) fn run(args: &Args) -> Result<()> {
    match (args.from.as_slice(), &args.out) {
        ([from], out) => write(from, out.as_ref().unwrap_or(from)),
        (studies, Some(out)) => join(studies, out),
        (_, None) => {
            Err(Error::Config("several studies are joined in a folder of their own: say which with --out".into()))
        }
    }
}

#[cfg(feature = "study")]
fn join(studies: &[PathBuf], to: &Path) -> Result<()> {
    refuse_folder_of("run", "config.toml", to)?;
    // Joined with themselves, they would be written over.
    if let Some(study) = studies.iter().find(|study| study.canonicalize().ok() == to.canonicalize().ok()) {
        return Err(Error::Config(format!(
            "{} is one of the studies that are joined: take another --out",
            study.display()
        )));
    }
    crate::study::report::join(studies, to)?;
    write(to, to)
}

#[cfg(not(feature = "study"))]
fn join(_studies: &[PathBuf], to: &Path) -> Result<()> {
    write(to, to)
}

#[cfg(feature = "study")]
pub(super) fn write(from: &Path, to: &Path) -> Result<()> {
    let table = crate::study::report::write(from, to)?;
    super::output::answer(format_args!("{table}\nreport: {}", to.join("report.md").display()))
}

#[cfg(not(feature = "study"))]
pub(super) fn write(_from: &Path, _to: &Path) -> Result<()> {
    Err(Error::Config("reports need the feature `study`: cargo run --features study".into()))
}
