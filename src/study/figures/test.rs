use std::path::Path;

use super::{Tables, mean, methods, percent, save, tenths};
use crate::chart::{Chart, Panels};
use crate::error::Result;

/// How far below a method's interval its seeds are drawn, in rows.
const BELOW: f64 = 0.25;

/// The final test of every method on one task: the success rate of each seed (small dots, below), their mean with its 95 %
/// interval from the summary, and smoothness of the hand, if there is one, in the same way (with a t interval).
///
/// # Errors
/// If the tables lack a column or the file cannot be written.
pub fn tests(tables: &Tables, task: &str, path: &Path) -> Result<()> {
    let methods = methods(tables, task)?;
    let mut success = Chart::new("", "")
        .titled("success rate: seeds, mean, 95 % interval")
        .x_between(-0.03, 1.03)
        .x_ticks(6, percent)
        .rows(methods.iter().map(|(_, method)| method));
    let mut smoothness = Chart::new("", "").titled("smoothness (SPARC; minimum jerk: -1.4)").x_ticks(6, tenths);
    let mut roughest = f64::INFINITY;
    for (row, (colour, method)) in methods.iter().enumerate() {
        let y = row as f64;
        let value = |column: &str| tables.value(task, method, column);
        let [low, middle, high] = [value("success_low")?, value("success")?, value("success_high")?];
        let interval = low.into_iter().chain(high).map(|end| (end, y));
        success = success.line("", interval).coloured(*colour);
        success = success.dots("", middle.map(|x| (x, y))).coloured(*colour);
        let seeds = tables.successes(task, method)?;
        let rates = seeds.iter().map(|episodes| (mean(episodes), y + BELOW));
        success = success.points("", rates.filter(|_| seeds.len() > 1)).coloured(*colour);
        if let Some(sparc) = value("smoothness_sparc")? {
            let interval = [value("smoothness_sparc_t_low")?, value("smoothness_sparc_t_high")?];
            roughest = interval.into_iter().flatten().fold(roughest, f64::min);
            smoothness = smoothness.line("", interval.into_iter().flatten().map(|end| (end, y))).coloured(*colour);
            smoothness = smoothness.dots("", [(sparc, y)]).coloured(*colour);
            let seeds = tables.smoothness(task, method)?;
            let all = seeds.iter().map(|episodes| mean(episodes)).filter(|seed| seeds.len() > 1 && seed.is_finite());
            roughest = all.clone().fold(roughest.min(sparc), f64::min);
            smoothness = smoothness.points("", all.map(|seed| (seed, y + BELOW))).coloured(*colour);
        }
    }
    let mut panels = Panels::new(&format!("{task}: final test")).panel(success);
    if roughest.is_finite() {
        let unnamed = methods.iter().map(|_| "");
        panels = panels.panel(smoothness.x_between(1.1 * roughest.min(-2.0), -1.0).rows(unnamed));
    }
    save(&panels, path)
}
