//! What a study shows, in a few sentences at the head of its report.

use super::tables::{BASELINE, LEVEL, Tables};
use crate::error::Result;

/// For each task, which methods are better than the baseline and which are not, as far as intervals tell.
///
/// # Errors
/// If the summary lacks a column.
pub(super) fn verdict(tables: &Tables, tasks: &[&str]) -> Result<String> {
    let mut text = String::new();
    for task in tasks {
        text += &on_task(tables, task)?;
    }
    Ok(text)
}

fn on_task(tables: &Tables, task: &str) -> Result<String> {
    let mut learning = Vec::new();
    for (_, method) in tables.tasks_and_methods()?.into_iter().filter(|(of, _)| of == task) {
        if tables.value(task, &method, "steps")?.is_some() {
            learning.push(method);
        }
    }
    if learning.is_empty() {
        return Ok(String::new());
    }
    let level = 100.0 * LEVEL;
    let mut soonest: Option<(f64, &str)> = None;
    for method in &learning {
        if let Some(steps) = tables.value(task, method, "steps_to_80")?
            && soonest.is_none_or(|(least, _)| steps < least)
        {
            soonest = Some((steps, method));
        }
    }
    let mut text = match soonest {
        Some((steps, method)) => {
            format!("- **{task}**: `{method}` is first at {level:.0} % success, by step {steps:.0}.")
        }
        None => format!("- **{task}**: no method reaches {level:.0} % success in its median seed."),
    };
    if !learning.iter().any(|method| method == BASELINE) {
        return Ok(text + "\n");
    }
    for (column, none, better, worse, open) in [
        (
            "sac_steps_ratio",
            1.0,
            "Fewer steps to it than",
            "More steps to it than",
            "No certain difference in steps to it from",
        ),
        (
            "success_minus_sac",
            0.0,
            "Higher final success than",
            "Lower final success than",
            "No certain difference in final success from",
        ),
    ] {
        let ends = [format!("{column}_low"), format!("{column}_high")];
        let unknown = "Seeds that never get there, so no ratio to";
        let mut groups = [better, worse, open, unknown].map(|what| (what, Vec::new()));
        for method in learning.iter().filter(|method| *method != BASELINE) {
            let group = match (tables.value(task, method, &ends[0])?, tables.value(task, method, &ends[1])?) {
                (Some(low), _) if low > none => 0,
                (_, Some(high)) if high < none => 1,
                (None, None) => 3,
                _ => 2,
            };
            groups[group].1.push(format!("`{method}`"));
        }
        for (what, methods) in groups.into_iter().filter(|(_, methods)| !methods.is_empty()) {
            text += &format!(" {what} `{BASELINE}`: {}.", methods.join(", "));
        }
    }
    Ok(text + "\n")
}
