use std::path::Path;

use plotters::chart::SeriesLabelPosition;

use super::{Tables, band, means, methods, percent, save, thousands};
use crate::chart::{Chart, Panels};
use crate::error::Result;

/// Success rate over environment steps for one task: a line for the mean of each learning method, its band from the
/// worst seed to the best, and a dashed line for each method that does not learn. Returns `false`, and draws nothing,
/// if no method learns.
///
/// # Errors
/// If the tables lack a column or the file cannot be written.
pub fn learning_curves(tables: &Tables, task: &str, path: &Path) -> Result<bool> {
    let mut learning = Vec::new();
    let mut fixed = Vec::new();
    for (colour, method) in methods(tables, task)? {
        let curves = tables.curves(task, &method)?;
        if curves.is_empty() {
            fixed.push((colour, method.clone(), tables.value(task, &method, "success")?.unwrap_or(0.0)));
        } else {
            learning.push((colour, method, curves.len(), band(&curves), curves));
        }
    }
    let lasts = learning.iter().flat_map(|(.., curves)| curves).filter_map(|(x, _)| x.last().copied());
    let Some(budget) = lasts.reduce(f64::max) else {
        return Ok(false);
    };
    let mut chart = Chart::new("environment steps, random warm-up included", "success rate")
        .x_between(0.0, budget)
        .x_ticks(11, thousands)
        .between(-0.02, 1.04)
        .y_ticks(6, percent)
        .legend(SeriesLabelPosition::LowerRight);
    // All bands first, so that none covers a line.
    for (colour, _, seeds, band, _) in &learning {
        if *seeds > 1 {
            chart = chart.band(band.iter().map(|(x, [low, _, high])| (*x, *low, *high))).coloured(*colour);
        }
    }
    for (colour, method, seeds, band, _) in &learning {
        let label = format!("{method} ({seeds} seed{})", if *seeds == 1 { "" } else { "s" });
        chart = chart.line(&label, means(band)).coloured(*colour);
    }
    for (colour, method, success) in fixed {
        let label = format!("{method} (does not learn)");
        chart = chart.dashed(&label, [(0.0, success), (budget, success)]).coloured(colour);
    }
    save(&Panels::new(&format!("{task}: success rate over environment steps")).panel(chart), path)?;
    Ok(true)
}
