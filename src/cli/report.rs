//! `report`: tables, figures and report of a study anew, or of several studies together.

use std::path::{Path, PathBuf};

#[cfg(feature = "study")]
use super::output::{answer, note};
use super::refuse_folder_of;
use crate::error::{Error, Result};
#[cfg(feature = "study")]
use crate::{files, study::report};

#[derive(clap::Args)]
pub(super) struct Args {
    /// A study's folder; given several times, the runs are joined in another folder, --out
    #[arg(long, default_value = "runs/quick")]
    from: Vec<PathBuf>,
    /// Where to write report and figures [default: the study's folder]
    #[arg(long)]
    out: Option<PathBuf>,
}

pub(super) fn run(args: &Args) -> Result<()> {
    match (args.from.as_slice(), &args.out) {
        ([from], None) => write(from, from),
        ([from], Some(out)) => refuse_folder_of("run", "config.toml", out).and_then(|()| write(from, out)),
        (studies, Some(out)) => join(studies, out),
        (_, None) => {
            Err(Error::Config("several studies are joined in a folder of their own: say which with --out".into()))
        }
    }
}

#[cfg(feature = "study")]
fn join(studies: &[PathBuf], to: &Path) -> Result<()> {
    refuse_folder_of("run", "config.toml", to)?;
    studies.iter().try_for_each(|study| check_study(study))?;
    // Joined with themselves, they would be written over.
    if let Some(study) = studies.iter().find(|study| files::same_folder(study, to)) {
        return Err(Error::Config(format!(
            "{} is one of the studies that are joined: take another --out",
            study.display()
        )));
    }
    for problem in report::join(studies, to)? {
        note(format_args!("no replay: {problem}"));
    }
    write(to, to)
}

#[cfg(not(feature = "study"))]
fn join(_studies: &[PathBuf], to: &Path) -> Result<()> {
    write(to, to)
}

#[cfg(feature = "study")]
pub(super) fn write(from: &Path, to: &Path) -> Result<()> {
    check_study(from)?;
    let table = report::write_noting(from, to, &mut |text| note(text))?;
    answer(format_args!("{table}\nreport: {}", to.join("report.md").display()))
}

#[cfg(not(feature = "study"))]
pub(super) fn write(_from: &Path, _to: &Path) -> Result<()> {
    Err(Error::Config("reports need the feature `study`: cargo run --features study".into()))
}

/// # Errors
/// If there are no tables of a study in the folder.
#[cfg(feature = "study")]
fn check_study(folder: &Path) -> Result<()> {
    let name = folder.display();
    let problem = if !folder.exists() {
        format!(
            "cannot read {name}: there is no such folder; give that of a study to --from, or make one: handful study --out {name}"
        )
    } else if folder.join("tests.csv").exists() {
        return Ok(());
    } else if folder.join("config.toml").exists() {
        format!(
            "{name}: this folder holds a run; give that of a study to --from, or test the run: handful evaluate --run {name}"
        )
    } else {
        format!(
            "{name}: there is no study (no tests.csv), or it is not complete: handful study --out {name} writes its tables at the end"
        )
    };
    Err(Error::Config(problem))
}
