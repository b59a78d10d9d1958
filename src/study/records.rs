//! What a run records: the rows of its CSV files.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::evaluate::{Evaluation, Summary};
use super::statistics::{correlation, mean};
use crate::agent::{Losses, ValueEstimate};
use crate::error::{Error, Result};
use crate::files;
use crate::model::open_loop::OpenLoop;

/// Losses are averaged over this many steps for `losses.csv`.
const LOSSES_EVERY: usize = 500;

const EPISODE_COLUMNS: [&str; 6] = ["step", "episode", "return", "success", "length", "seconds"];
const EVALUATION_COLUMNS: [&str; 9] = [
    "step",
    "episodes",
    "success",
    "return_mean",
    "return_std",
    "smoothness_sparc",
    "smoothness_ldlj",
    "action_ms",
    "updates",
];
const MODEL_COLUMNS: [&str; 6] = ["step", "horizon", "rmse", "nll", "coverage90", "rmse_p90"];
const VALUE_COLUMNS: [&str; 5] = ["step", "expected", "realised", "rmse", "correlation"];
const TEST_COLUMNS: [&str; 8] = ["episode", "return", "success", "length", "stage", "sparc", "ldlj", "action_change"];

/// The tables that a complete run has.
pub(super) const TABLES: [&str; 6] =
    ["episodes.csv", "evaluations.csv", "losses.csv", "model.csv", "values.csv", "test.csv"];

/// A row of `episodes.csv`: one training episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpisodeRow {
    /// Environment steps at its end.
    pub step: usize,
    /// Its number, from 1.
    pub episode: usize,
    /// Sum of rewards.
    #[serde(rename = "return")]
    pub total: f64,
    /// Whether the task was fulfilled at its last step.
    pub success: bool,
    /// Steps in it.
    pub length: usize,
    /// Seconds of training at its end.
    pub seconds: f64,
}

/// A row of `evaluations.csv`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EvaluationRow {
    /// Environment steps so far.
    pub step: usize,
    /// What was measured.
    #[serde(flatten)]
    pub summary: Summary,
    /// Gradient steps so far; earlier versions did not count them.
    #[serde(default)]
    pub updates: u64,
}

/// A row of `losses.csv`: the mean of one loss over the last steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LossRow {
    /// Environment steps so far.
    pub step: usize,
    /// What it is.
    pub name: String,
    /// Its mean.
    pub value: f32,
}

/// A row of `model.csv`: how well the model predicts the last evaluation's episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelRow {
    /// Environment steps so far.
    pub step: usize,
    /// The errors.
    #[serde(flatten)]
    pub open_loop: OpenLoop,
}

/// A row of `values.csv`: the returns that the agent expected in the last evaluation's episodes (values, or what plans predict
/// for their horizon), and those that followed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ValueRow {
    /// Environment steps so far.
    pub step: usize,
    /// Mean of the estimates.
    pub expected: f64,
    /// Mean of the returns.
    pub realised: f64,
    /// Root mean square of the difference.
    pub rmse: f64,
    /// Correlation of the two over all time steps; 0 if one of them never changes.
    pub correlation: f64,
}

impl ValueRow {
    pub(super) fn new(step: usize, estimates: &[ValueEstimate]) -> Option<Self> {
        let expected: Vec<f64> = estimates.iter().map(|estimate| f64::from(estimate.expected)).collect();
        let realised: Vec<f64> = estimates.iter().map(|estimate| f64::from(estimate.realised)).collect();
        let square = |(e, r): (&f64, &f64)| (e - r).powi(2);
        let squares: Vec<f64> = expected.iter().zip(&realised).map(square).collect();
        (!estimates.is_empty()).then(|| Self {
            step,
            expected: mean(&expected),
            realised: mean(&realised),
            rmse: mean(&squares).sqrt(),
            correlation: correlation(&expected, &realised),
        })
    }
}

/// What a run has recorded so far; the CSV files are this.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct Progress {
    pub(super) step: usize,
    pub(super) seconds: f64,
    /// The versions of the program that have worked on it.
    #[serde(default)]
    pub(super) versions: BTreeSet<String>,
    pub(super) episodes: Vec<EpisodeRow>,
    pub(super) evaluations: Vec<EvaluationRow>,
    pub(super) losses: Vec<LossRow>,
    #[serde(default)]
    pub(super) model: Vec<ModelRow>,
    #[serde(default)]
    pub(super) values: Vec<ValueRow>,
    /// The test, as far as it has come.
    #[serde(default)]
    pub(super) test: Evaluation,
    /// Sum and count of each loss since the last row of it.
    pub(super) pending: BTreeMap<String, (f32, usize)>,
}

impl Progress {
    /// Takes in the losses of an update.
    ///
    /// # Errors
    /// [`Error::Diverged`] if one is NaN.
    pub(super) fn note(&mut self, losses: Losses) -> Result<()> {
        let Self { step, losses: rows, pending, .. } = self;
        for (name, value) in losses {
            if value.is_nan() {
                return Err(Error::Diverged { what: format!("`{name}`"), step: *step });
            }
            let (sum, count) = pending.entry(name.into()).or_default();
            (*sum, *count) = (*sum + value, *count + 1);
        }
        if step.is_multiple_of(LOSSES_EVERY) {
            let means = std::mem::take(pending).into_iter();
            rows.extend(means.map(|(name, (sum, count))| LossRow { step: *step, name, value: sum / count as f32 }));
        }
        Ok(())
    }

    /// Writes the CSV files.
    ///
    /// # Errors
    /// If one cannot be written.
    pub(super) fn write_tables(&self, folder: &Path) -> Result<()> {
        let Self { episodes, evaluations, losses, model, values, .. } = self;
        let predictions = model.iter().map(|row| (row.step, &row.open_loop));
        write_csv(&folder.join("model.csv"), &MODEL_COLUMNS, predictions)?;
        write_csv(&folder.join("values.csv"), &VALUE_COLUMNS, values.iter())?;
        write_csv(&folder.join("episodes.csv"), &EPISODE_COLUMNS, episodes.iter())?;
        // Without the interval of the success rate, which follows from the rate and the episodes.
        let evaluations = evaluations.iter().map(|EvaluationRow { step, summary: s, updates }| {
            let smoothness = (s.smoothness_sparc, s.smoothness_ldlj);
            (step, s.episodes, s.success, s.return_mean, s.return_std, smoothness, s.action_ms, updates)
        });
        write_csv(&folder.join("evaluations.csv"), &EVALUATION_COLUMNS, evaluations)?;
        write_csv(&folder.join("losses.csv"), &["step", "name", "value"], losses.iter())
    }
}

/// Writes `test.csv`.
pub(super) fn write_test(folder: &Path, test: &Evaluation) -> Result<()> {
    let rows = test.results.iter().enumerate().map(|(i, result)| (i + 1, result));
    write_csv(&folder.join("test.csv"), &TEST_COLUMNS, rows)
}

pub(super) fn write_csv<T: Serialize>(path: &Path, columns: &[&str], rows: impl Iterator<Item = T>) -> Result<()> {
    let mut writer = csv::WriterBuilder::new().has_headers(false).from_writer(Vec::new());
    let composed =
        writer.write_record(columns).and_then(|()| rows.into_iter().try_for_each(|row| writer.serialize(row)));
    composed.map_err(Error::data(path))?;
    let bytes = writer.into_inner().map_err(|problem| Error::data(path)(problem.to_string()))?;
    files::write(path, &bytes)
}
