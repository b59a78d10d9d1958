use std::path::Path;

use plotters::chart::SeriesLabelPosition;

use super::{Tables, methods, percent, save, thousands};
use crate::chart::{Chart, Panels};
use crate::error::Result;
use crate::study::statistics::{mean, performance_profile};

/// Thresholds of the performance profile: every percent.
const THRESHOLDS: usize = 100;

/// How reliable the methods that learn a task are, and what they cost: the performance profile of their seeds in the final
/// test, and each seed's success rate over the seconds of its training (not drawn if the tables do not tell them). Returns
/// `false`, and draws nothing, if no method has two seeds.
///
/// # Errors
/// If the tables lack a column or the file cannot be written.
pub fn profile(tables: &Tables, task: &str, path: &Path) -> Result<bool> {
    let thresholds: Vec<f64> = (0..THRESHOLDS).map(|i| i as f64 / THRESHOLDS as f64).collect();
    let mut profile = Chart::new("success rate in the test", "")
        .titled("share of seeds above a success rate")
        .x_between(0.0, 1.0)
        .x_ticks(6, percent)
        .between(-0.02, 1.04)
        .y_ticks(6, percent)
        .legend(SeriesLabelPosition::LowerLeft);
    let mut cost = Chart::new("seconds of training, evaluations included", "")
        .titled("success rate of each seed")
        .log_x()
        .between(-0.02, 1.04)
        .y_ticks(6, percent)
        .x_ticks(6, thousands);
    let (mut most, mut timed) = (0, false);
    for (colour, method) in methods(tables, task)? {
        let curves = tables.curves(task, &method)?;
        if curves.is_empty() {
            continue;
        }
        let seeds: Vec<f64> = tables.successes(task, &method)?.iter().map(|episodes| mean(episodes)).collect();
        most = most.max(seeds.len());
        let shares = thresholds.iter().copied().zip(performance_profile(&seeds, &thresholds));
        profile = profile.line(&method, shares).coloured(colour);
        for ((_, success), (_, seconds)) in curves.iter().zip(tables.clocks(task, &method)?) {
            // A logarithmic axis has no zero.
            let over_seconds: Vec<(f64, f64)> =
                seconds.into_iter().map(|s| s.max(1.0)).zip(success.iter().copied()).collect();
            timed = true;
            cost = cost.thin(over_seconds).coloured(colour);
        }
    }
    if most < 2 {
        return Ok(false);
    }
    let panels = Panels::new(&format!("{task}: how reliable, and at what cost")).panel(profile);
    save(&if timed { panels.panel(cost) } else { panels }, path)?;
    Ok(true)
}
