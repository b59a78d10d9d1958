use std::path::Path;

use super::{Tables, band, means, methods, percent, save, thousands};
use crate::chart::{Chart, GREY, Panels};
use crate::error::Result;

/// Success rate over environment steps for one task, or the return if there is no success, a panel for each learning method: a thin line
/// for each seed, a thick one for their mean, and in grey the means of the other methods. Returns `false`, and draws nothing, if no method
/// learns.
///
/// # Errors
/// If the tables lack a column or the file cannot be written.
pub fn learning_curves(tables: &Tables, task: &str, path: &Path) -> Result<bool> {
    let by_return = tables.is_judged_by_return(task)?;
    let mut learning = Vec::new();
    for (colour, method) in methods(tables, task)? {
        let curves = if by_return { tables.return_curves(task, &method)? } else { tables.curves(task, &method)? };
        if !curves.is_empty() {
            learning.push((colour, method, band(&curves), curves));
        }
    }
    let lasts = learning.iter().flat_map(|(.., curves)| curves).filter_map(|(x, _)| x.last().copied());
    let Some(budget) = lasts.reduce(f64::max) else {
        return Ok(false);
    };
    let what = if by_return { "return" } else { "success rate" };
    let mut panels = Panels::new(&format!("{task}: {what} (thin: each seed; grey: the other methods)"));
    let values = || learning.iter().flat_map(|(.., curves)| curves).flat_map(|(_, values)| values.iter().copied());
    let (lowest, highest) = (values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max));
    for (colour, method, own, curves) in &learning {
        let seeds = curves.len();
        let mut chart = Chart::new("environment steps", "")
            .titled(&format!("{method} ({seeds} seed{})", if seeds == 1 { "" } else { "s" }))
            .x_between(0.0, budget)
            .x_ticks(4, thousands);
        chart = if by_return {
            let margin = 0.04 * (highest - lowest).max(1e-6);
            chart.between(lowest - margin, highest + margin)
        } else {
            chart.between(-0.02, 1.04).y_ticks(6, percent)
        };
        for (_, _, other, _) in learning.iter().filter(|(_, other, ..)| other != method) {
            chart = chart.thin(means(other)).coloured(GREY);
        }
        for (steps, success) in curves {
            chart = chart.thin(steps.iter().copied().zip(success.iter().copied())).coloured(*colour);
        }
        panels = panels.panel(chart.line("", means(own)).coloured(*colour));
    }
    save(&panels, path)?;
    Ok(true)
}
