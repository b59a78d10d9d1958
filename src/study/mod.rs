//! Runs, studies, and what is concluded from them.
//!
//! [`run::Run`] is one training run in its folder; [`runner`] carries out many; with the feature `study`, [`tables`]
//! gathers their numbers, and [`figures`] and [`report`] show them.

pub mod config;
pub mod evaluate;
#[cfg(feature = "study")]
pub mod figures;
pub mod records;
pub mod registry;
#[cfg(feature = "study")]
pub mod report;
pub mod run;
pub mod runner;
pub mod smoothness;
pub mod statistics;
#[cfg(feature = "study")]
pub mod tables;
