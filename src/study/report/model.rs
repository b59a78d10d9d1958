//! How well the learned models predict, in numbers.

use super::super::tables::{Curve, Tables};
use crate::error::Result;

/// The numbers of steps ahead for which the error and the coverage are listed.
const ERRORS: [u32; 4] = [1, 5, 15, 25];
const COVERAGES: [u32; 2] = [1, 15];

/// The open-loop error and the calibration of each model of a task in its last evaluation; nothing if no method has a model.
///
/// # Errors
/// If the tables lack a column.
pub(super) fn table(tables: &Tables, task: &str) -> Result<String> {
    let mut rows = String::new();
    for method in tables.methods(task)? {
        let of_seeds = |horizons: &[u32], column: &str| -> Result<Vec<String>> {
            let entry = |horizon: &u32| Ok(over_seeds(&tables.model_curves(task, &method, *horizon, column)?));
            horizons.iter().map(entry).collect()
        };
        let (errors, coverages) = (of_seeds(&ERRORS, "rmse")?, of_seeds(&COVERAGES, "coverage90")?);
        if errors.iter().any(|entry| entry != "-") {
            rows += &format!("| {method} | {} | {} |\n", errors.join(" | "), coverages.join(" | "));
        }
    }
    if rows.is_empty() {
        return Ok(rows);
    }
    let [errors, coverages] = [("error", &ERRORS[..]), ("coverage", &COVERAGES[..])].map(|(what, horizons)| {
        let heading = |steps| format!(" {what}, {steps} step{} |", if steps == 1 { "" } else { "s" });
        horizons.iter().copied().map(heading).collect::<String>()
    });
    Ok(format!(
        "\nThe learned models in the last evaluation: open-loop error after so many steps of the model, in standard deviations of the change (root \
         mean square over features, median over start times; predicting no change has about 1), and coverage, the share of outcomes inside \
         the 90 % interval of models that have one. Median of the seeds [lowest, highest].\n\n\
         | method |{errors}{coverages}\n|{}\n{rows}",
        " --- |".repeat(1 + ERRORS.len() + COVERAGES.len())
    ))
}

/// The median of the last values of the curves, the lowest and the highest; a dash if there is none.
fn over_seeds(curves: &[Curve]) -> String {
    let mut last: Vec<f64> = curves.iter().filter_map(|(_, values)| values.last().copied()).collect();
    last.sort_by(f64::total_cmp);
    match last.as_slice() {
        [] => "-".into(),
        [only] => format!("{only:.2}"),
        all => {
            let median = (all[(all.len() - 1) / 2] + all[all.len() / 2]) / 2.0;
            format!("{median:.2} [{:.2}, {:.2}]", all[0], all[all.len() - 1])
        }
    }
}
