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
        let grids = tables.evaluation_grid(task, &method)?;
        let ends: Vec<f64> = grids.iter().filter_map(|(steps, _)| steps.last().copied()).collect();
        let of_seeds = |horizons: &[u32], column: &str| -> Result<Vec<String>> {
            let entry = |horizon: &u32| Ok(at_the_end(&tables.model_curves(task, &method, *horizon, column)?, &ends));
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
        "\nThe learned models in the last evaluation: open-loop prediction error 1 to 25 time steps ahead, in standard deviations \
         of the change (root mean square over features, median over start times; predicting no change has a root mean square of \
         about 1 over start times, and a smaller median if little moves at many of them), and coverage, the share of outcomes \
         inside the 90 % interval of models that have one. Median of the seeds [lowest, highest]. Particles that follow the means of their models \
         (`ts-inf-mean`) leave out noise, so their interval covers less by design. The errors of `dreamer` and `tdmpc2` are those of \
         observations reconstructed from their latent states, which may lack what the agent does not need.\n\n\
         | method |{errors}{coverages}\n|{}\n{rows}",
        " --- |".repeat(1 + ERRORS.len() + COVERAGES.len())
    ))
}

/// The median, the lowest and the highest value at the last evaluation, whose step `ends` has for each seed; how many seeds have one, if
/// not all do (what is not finite is in no curve); a dash if none does.
fn at_the_end(curves: &[Curve], ends: &[f64]) -> String {
    let last = ends.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let at_last = |(steps, values): &Curve| values.last().copied().filter(|_| steps.last() == Some(&last));
    let mut values: Vec<f64> = curves.iter().filter_map(at_last).collect();
    values.sort_by(f64::total_cmp);
    let text = match values.as_slice() {
        [] => return "-".into(),
        [only] => format!("{only:.2}"),
        all => {
            let median = (all[(all.len() - 1) / 2] + all[all.len() / 2]) / 2.0;
            format!("{median:.2} [{:.2}, {:.2}]", all[0], all[all.len() - 1])
        }
    };
    if values.len() < ends.len() { format!("{text} ({} of {} seeds)", values.len(), ends.len()) } else { text }
}
