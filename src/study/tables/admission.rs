//! Which runs belong into the tables of a study.

use std::collections::{BTreeMap, BTreeSet};

use crate::study::folder::difference;

/// Admits each run once, and of the runs of a method on a task those with the settings of the first.
#[derive(Default)]
pub(super) struct Admission {
    admitted: BTreeSet<(String, String, u64, String)>,
    /// Of each method on a task the seed and the settings of its first run.
    first: BTreeMap<(String, String), (u64, Option<toml::Table>)>,
}

/// A run that would like to be in a study.
pub(super) struct Candidate {
    pub task: String,
    pub method: String,
    pub seed: u64,
    /// Empty if the tables do not tell.
    pub starts: String,
    /// Its configuration, if that is recorded.
    pub settings: Option<toml::Table>,
}

impl Admission {
    /// Why the run is left out, as the end of a sentence that begins with the run.
    pub fn objection(&self, run: &Candidate) -> Option<String> {
        let (seed, first) = self.first.get(&run.of_method())?;
        let settings = run.common_settings();
        let different = settings.as_ref().zip(first.as_ref()).and_then(|(settings, first)| difference(settings, first));
        if let Some(how) = different {
            return Some(format!("has another configuration than with seed {seed} ({how})"));
        }
        if self.admitted.contains(&run.key()) {
            return Some("is there twice".into());
        }
        match (settings, first) {
            (None, Some(_)) => Some(format!("cannot be compared with seed {seed}: its configuration is not recorded")),
            (Some(_), None) => {
                Some(format!("cannot be compared with seed {seed}: the configuration of that is not recorded"))
            }
            _ => None,
        }
    }

    /// Admits a run.
    pub fn admit(&mut self, run: &Candidate) {
        self.admitted.insert(run.key());
        self.first.entry(run.of_method()).or_insert_with(|| (run.seed, run.common_settings()));
    }
}

impl Candidate {
    /// A whole number of its configuration.
    pub fn number(&self, key: &str) -> Option<i64> {
        self.settings.as_ref()?.get(key)?.as_integer()
    }

    fn key(&self) -> (String, String, u64, String) {
        (self.task.clone(), self.method.clone(), self.seed, self.starts.clone())
    }

    fn of_method(&self) -> (String, String) {
        (self.task.clone(), self.method.clone())
    }

    /// The settings without those in which the runs of a method differ.
    fn common_settings(&self) -> Option<toml::Table> {
        let mut settings = self.settings.clone()?;
        for own in ["seed", "starts"] {
            settings.remove(own);
        }
        Some(settings)
    }
}
