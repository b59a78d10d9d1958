//! Which runs belong into the tables of a study.

use std::collections::{BTreeMap, BTreeSet};

use crate::study::folder::difference;

/// Admits each run once, and of the runs of a method on a task those with the settings of the first.
#[derive(Default)]
pub(super) struct Admission {
    admitted: BTreeSet<(String, String, u64, String)>,
    /// Of each method on a task the seed and the settings of its first run.
    first: BTreeMap<(String, String), (u64, toml::Table)>,
}

/// A run that would like to be in a study.
pub(super) struct Candidate {
    pub task: String,
    pub method: String,
    pub seed: u64,
    /// Empty if the tables do not tell.
    pub starts: String,
    /// Its configuration.
    pub settings: toml::Table,
}

impl Admission {
    /// Why the run is left out, as the end of a sentence that begins with the run.
    pub fn objection(&self, run: &Candidate) -> Option<String> {
        if self.admitted.contains(&run.key()) {
            return Some("is there twice".into());
        }
        let (seed, settings) = self.first.get(&run.of_method())?;
        let how = difference(&run.common_settings(), settings)?;
        Some(format!("has another configuration than with seed {seed} ({how})"))
    }

    /// Admits a run.
    pub fn admit(&mut self, run: &Candidate) {
        self.admitted.insert(run.key());
        self.first.entry(run.of_method()).or_insert_with(|| (run.seed, run.common_settings()));
    }
}

impl Candidate {
    fn key(&self) -> (String, String, u64, String) {
        (self.task.clone(), self.method.clone(), self.seed, self.starts.clone())
    }

    fn of_method(&self) -> (String, String) {
        (self.task.clone(), self.method.clone())
    }

    /// The settings without those in which the runs of a method differ.
    fn common_settings(&self) -> toml::Table {
        let mut settings = self.settings.clone();
        for own in ["seed", "starts"] {
            settings.remove(own);
        }
        settings
    }
}
