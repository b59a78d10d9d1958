//! The table of all results, and what its columns mean.

use super::super::tables::{BASELINE, LEVEL, Tables};
use crate::error::Result;

const HEAD: [&str; 10] =
    ["task", "method", "seeds", "steps", "success", "return", "80 % by step", "ms per action", "SPARC", "LDLJ"];

/// The table and the definitions of its columns and of those in the tables of the tasks.
///
/// # Errors
/// If the summary lacks a column.
pub(super) fn section(tables: &Tables) -> Result<String> {
    let level = 100.0 * LEVEL;
    Ok(format!(
        "{}\n<details><summary>What the columns mean</summary>\n\n\
         - *success*: share of test episodes in which the task is solved at the last step, with a 95 % interval. With several seeds, that \
         is the two-level bootstrap: seeds are drawn, then the episodes of each. With one seed (a method that does not learn needs only one), \
         and where all episodes have the same outcome, it is the Wilson interval, which covers the test episodes and not the differences \
         between seeds.\n\
         - *[a, b]*: a 95 % interval, by the bootstrap where nothing else is said.\n\
         - *steps*: environment steps of training.\n\
         - *{level:.0} % by step*: the first evaluation at which that success rate is reached and confirmed by the next one; the \
         median over seeds (a dash if the median seed does not reach it within its budget). In brackets the median of the seconds until \
         then, evaluations included.\n\
         - *ms per action*: the time that choosing the first action of an episode takes in the last evaluation, in one environment; the \
         median of five times, and over seeds. With action repeat, that action is held for several steps. Times may come from different \
         machines, and from machines that several runs shared.\n\
         - *SPARC*, *LDLJ*: spectral arc length and log dimensionless jerk of the hand's path; closer to zero is smoother.\n\
         - *area under the curve*: the mean success rate up to the smallest budget, with a t interval over seeds (none where all agree).\n\
         - *gradient updates*: steps of the optimiser (of the critics, for `sac`; of the ensemble, for `pets` and `pets-learned`). Batches differ, so these \
         numbers do not compare between methods.\n\
         - *action change*: root mean square of the change from one action to the next in the test.\n\
         - *optimism*: (expected - realised return) / |realised return| in the last evaluation, of means over time steps and seeds. Methods \
         with a value function expect the value of their policy (of `sac`, a soft value, which includes entropies), and realise the \
         discounted rewards that followed plus, at the time limit, the discounted value of the last observation, which makes optimism look \
         smaller. `pets` and `pets-learned` expect what a plan predicts for its horizon, and realise the sum over that horizon, both \
         undiscounted, in the reward that they plan with, without a terminal value, in four episodes. Compare only methods of the same kind. \
         *Correlation* is that of the two over time steps, its mean over seeds.\n\
         - *return minus `{BASELINE}`'s*: the difference of mean test returns, with a t interval over seeds.\n\
         - *better*, *earlier*: the probability that a seed has more test success than one of `{BASELINE}`, or reaches {level:.0} % by an \
         earlier step (probability of improvement; 0.5 means no difference; ties, and pairs whose order is unknown because of censoring, \
         count one half). There is no interval where all pairs agree.\n\n</details>\n",
        markdown(&rows(tables)?)
    ))
}

fn rows(tables: &Tables) -> Result<Vec<[String; 10]>> {
    let mut rows = Vec::new();
    for (task, method) in tables.tasks_and_methods()? {
        let value = |column: &str| tables.value(&task, &method, column);
        let show = |column: &str, digits: usize| -> Result<String> {
            Ok(match value(column)? {
                None => "-".into(),
                Some(v) if v.abs() >= 1e9 => format!("{v:.2e}"),
                Some(v) => format!("{v:.digits$}"),
            })
        };
        let percent =
            |column: &str| -> Result<String> { Ok(format!("{:.0}", 100.0 * value(column)?.unwrap_or(f64::NAN))) };
        let success = format!("{} % [{}, {}]", percent("success")?, percent("success_low")?, percent("success_high")?);
        rows.push([
            task.clone(),
            method.clone(),
            show("seeds", 0)?,
            show("steps", 0)?,
            success,
            show("return_mean", 1)?,
            match (value("steps_to_80")?, value("seconds_to_80")?) {
                (Some(steps), Some(seconds)) => format!("{steps:.0} ({seconds:.0} s)"),
                (Some(steps), None) => format!("{steps:.0}"),
                (None, _) => "-".into(),
            },
            value("action_ms")?.map_or("-".into(), two_digits),
            show("smoothness_sparc", 2)?,
            show("smoothness_ldlj", 2)?,
        ]);
    }
    Ok(rows)
}

fn markdown(rows: &[[String; 10]]) -> String {
    let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
    let head = line(&HEAD.map(String::from));
    let rule = format!("|{}\n", " --- |".repeat(HEAD.len()));
    head + &rule + &rows.iter().map(|row| line(row)).collect::<String>()
}

/// Two significant digits, and the integer part of larger numbers.
fn two_digits(x: f64) -> String {
    if x <= 0.0 || !x.is_finite() {
        return format!("{x}");
    }
    let digits = (1.0 - x.log10().floor()).clamp(0.0, 9.0) as usize;
    format!("{x:.digits$}")
}

/// The table for a terminal.
///
/// # Errors
/// If the summary lacks a column.
pub(super) fn text_table(tables: &Tables) -> Result<String> {
    let mut table = comfy_table::Table::new();
    table.load_style(comfy_table::presets::UTF8_HORIZONTAL_ONLY).set_header(HEAD);
    for row in rows(tables)? {
        table.add_row(row);
    }
    Ok(table.to_string())
}
