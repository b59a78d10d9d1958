//! Runs, studies, and what is concluded from them.
//!
//! [`run::Run`] is one training run in its folder; [`runner`] carries out many; with the feature `study`, [`tables`]
//! gathers their numbers, and [`figures`] and [`report`] show them.
//!
//! ```
//! use std::sync::atomic::AtomicBool;
//!
//! use handful::prelude::*;
//! use handful::study::runner::{StudyPlan, carry_out_all};
//!
//! let folder = tempfile::tempdir().expect("a folder");
//! let plan = StudyPlan {
//!     tasks: vec!["cartpole".into()],
//!     methods: vec!["random".into(), "debug".into()],
//!     seeds: 0..1,
//!     budget: None,
//!     folder: folder.path().into(),
//! };
//! let registry = Registry::standard();
//! let runs = plan.runs(&registry)?;
//! carry_out_all(&registry, &runs, 2, &(), &AtomicBool::new(false))?;
//! # #[cfg(feature = "study")]
//! # {
//! let tables = handful::study::tables::Tables::gather(runs.iter().map(|(_, folder)| folder.as_path()))?;
//! tables.write(folder.path())?;
//! println!("{}", handful::study::report::write(folder.path(), folder.path())?);
//! assert!(folder.path().join("report.md").exists());
//! # }
//! # Ok::<(), Error>(())
//! ```

mod completed;
pub mod config;
pub mod evaluate;
mod export;
#[cfg(feature = "study")]
pub mod figures;
mod folder;
mod names;
#[cfg(all(feature = "cli", feature = "study"))]
pub(crate) mod others;
#[cfg(feature = "study")]
mod page;
#[cfg(feature = "study")]
mod provenance;
pub mod records;
pub mod registry;
#[cfg(feature = "study")]
pub mod replays;
#[cfg(feature = "study")]
pub mod report;
pub mod run;
pub mod runner;
pub mod smoothness;
pub mod starts;
pub mod statistics;
pub mod status;
#[cfg(feature = "study")]
mod summary;
#[cfg(feature = "study")]
pub mod tables;
mod tensorboard;
#[cfg(feature = "study")]
mod verdict;
mod version;
