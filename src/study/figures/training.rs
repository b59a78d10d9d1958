use std::path::Path;

use plotters::style::RGBColor;

use super::{Tables, band, means, percent, save, tenths, thousands};
use crate::chart::{Chart, PALETTE, Panels};
use crate::error::Result;
use crate::study::tables::Curve;

/// The horizons, in steps, for which a model's open-loop prediction error is drawn.
const HORIZONS: [u32; 3] = [1, 5, 15];

/// The quality of a method's model over training: its open-loop prediction error at several horizons, and the coverage of
/// its 90 % interval, if it has one. Returns `false`, and draws nothing, if the method has no model.
///
/// # Errors
/// If the tables lack a column or the file cannot be written.
pub fn model(tables: &Tables, task: &str, method: &str, path: &Path) -> Result<bool> {
    let (mut errors, mut coverages) = (Vec::new(), Vec::new());
    for (colour, horizon) in PALETTE.into_iter().zip(HORIZONS) {
        let error = tables.model_curves(task, method, horizon, "rmse")?;
        let coverage = tables.model_curves(task, method, horizon, "coverage90")?;
        if !error.is_empty() {
            let label = format!("{horizon} step{} ahead", if horizon == 1 { "" } else { "s" });
            errors.push((colour, label.clone(), error));
            if !coverage.is_empty() {
                coverages.push((colour, label, coverage));
            }
        }
    }
    if errors.is_empty() {
        return Ok(false);
    }
    // A model that has learned nothing yet may be off by any factor: a logarithmic axis shows it.
    let least = drawn(&errors).filter(|error| *error > 0.0).fold(1.0, f64::min);
    let worst = drawn(&errors).fold(1.0, f64::max);
    let error = over_training("open-loop error (1: std of the change)", &errors)
        .log_y()
        .between(0.8 * least, 1.25 * worst)
        .mark(1.0);
    let title = format!("{task}: open-loop predictions of {method} on its evaluation episodes (thin: each seed)");
    let mut panels = Panels::new(&title).panel(error);
    if !coverages.is_empty() {
        let coverage = over_training("coverage of the 90 % interval", &coverages);
        panels = panels.panel(coverage.between(0.0, 1.03).y_ticks(11, percent).mark(0.9));
    }
    save(&panels, path)?;
    Ok(true)
}

/// The return that a method expects over training (its estimated value, or what its plans predict for their horizon), beside
/// the return that followed. Returns `false`, and draws
/// nothing, if the method estimates none.
///
/// # Errors
/// If the tables lack a column or the file cannot be written.
pub fn values(tables: &Tables, task: &str, method: &str, path: &Path) -> Result<bool> {
    let curves = |column: &str| tables.value_curves(task, method, column);
    let (estimated, followed, correlation) = (curves("expected")?, curves("realised")?, curves("correlation")?);
    if estimated.is_empty() {
        return Ok(false);
    }
    let both = [
        (PALETTE[0], "expected return".to_string(), estimated),
        (PALETTE[1], "return that followed".to_string(), followed),
    ];
    let (low, high) = (drawn(&both).fold(0.0, f64::min), drawn(&both).fold(0.0, f64::max));
    let (low, high) = (1.05 * low, 1.05 * high.max(low + 1e-3));
    let means = over_training("mean over time steps", &both)
        .between(low, high)
        .y_ticks(11, if high - low < 10.0 { tenths } else { whole });
    let correlation = [(PALETTE[2], "over time steps".to_string(), correlation)];
    let lowest = drawn(&correlation).fold(-0.3, f64::min);
    let correlation =
        over_training("correlation of the two", &correlation).between(lowest, 1.03).y_ticks(11, tenths).mark(1.0);
    let title = format!("{task}: return that {method} expected, and the return that followed (thin: each seed)");
    save(&Panels::new(&title).panel(means).panel(correlation), path)?;
    Ok(true)
}

/// What changes over training: its colour and name, and a curve for each seed.
type Measure = (RGBColor, String, Vec<Curve>);

/// All values of all seeds.
fn drawn(measures: &[Measure]) -> impl Iterator<Item = f64> {
    measures.iter().flat_map(|(.., seeds)| seeds).flat_map(|(_, values)| values.iter().copied())
}

/// A thin line for each seed, and a thick one for their mean.
fn over_training(title: &str, measures: &[Measure]) -> Chart {
    let steps = measures.iter().flat_map(|(.., seeds)| seeds).flat_map(|(steps, _)| steps.iter().copied());
    let (first, last) = (steps.clone().fold(f64::INFINITY, f64::min), steps.fold(0.0, f64::max));
    let mut chart =
        Chart::new("environment steps", "").titled(title).x_between(first.min(last - 1.0), last).x_ticks(5, thousands);
    for (colour, label, seeds) in measures {
        for (steps, values) in seeds {
            chart = chart.thin(steps.iter().copied().zip(values.iter().copied())).coloured(*colour);
        }
        chart = chart.line(label, means(&band(seeds))).coloured(*colour);
    }
    chart
}

fn whole(y: f64) -> String {
    format!("{y:.0}")
}
