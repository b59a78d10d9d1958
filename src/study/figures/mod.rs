//! The figures of a study, as SVG, drawn from its tables alone.

use std::path::Path;

use plotters::style::RGBColor;

use super::statistics::mean;
use super::tables::{Curve, Tables};
use crate::chart::{GREY, PALETTE, Panels};
use crate::error::Result;
use crate::files;

mod learning;
mod profile;
mod test;
mod training;

pub use learning::learning_curves;
pub use profile::profile;
pub use test::tests;
pub use training::{model, values};

/// What the file names of a method's figures on a task begin with: different for any two of them. A task's name without a dash
/// ends at the first one, and no name holds a dot.
pub(super) fn stem(task: &str, method: &str) -> String {
    let mark = if task.contains('-') { '.' } else { '-' };
    format!("{task}{mark}{method}")
}

/// The methods that have the same colour of the palette in every study. Others take the colours that are left.
const COLOURED: [&str; PALETTE.len()] = ["oracle", "pets", "dreamer", "sac", "planet", "scripted", "random", "tdmpc2"];

/// The methods of a task, each with its colour.
fn methods(tables: &Tables, task: &str) -> Result<Vec<(RGBColor, String)>> {
    let of_task = tables.methods(task)?;
    let left = COLOURED.iter().zip(PALETTE).filter(|(known, _)| !of_task.iter().any(|method| method == *known));
    let mut left = left.map(|(_, colour)| colour).collect::<Vec<_>>().into_iter();
    let mut colour_of = |method: &String| match COLOURED.iter().position(|known| known == method) {
        Some(place) => PALETTE[place],
        None => left.next().unwrap_or(GREY),
    };
    Ok(of_task.into_iter().map(|method| (colour_of(&method), method)).collect())
}

/// Environment steps, and the lowest, mean and highest value over the seeds at each.
type Band = Vec<(f64, [f64; 3])>;

/// The band over the steps that all seeds have in common.
fn band(curves: &[Curve]) -> Band {
    let at = |(x, y): &Curve, step: f64| x.iter().position(|other| *other == step).map(|i| y[i]);
    let over_seeds = |step: f64| {
        let values = curves.iter().map(|curve| at(curve, step)).collect::<Option<Vec<f64>>>()?;
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        Some((step, [low, mean(&values), high]))
    };
    curves.first().map_or(Vec::new(), |(steps, _)| steps.iter().filter_map(|step| over_seeds(*step)).collect())
}

fn means(band: &Band) -> impl Iterator<Item = (f64, f64)> {
    band.iter().map(|(x, [_, mean, _])| (*x, *mean))
}

/// 12500 as "12.5k", 1.25 as "1.25".
fn thousands(x: f64) -> String {
    if x >= 1000.0 { format!("{}k", (x / 100.0).round() / 10.0) } else { format!("{}", (100.0 * x).round() / 100.0) }
}

/// 0.25 as "25 %".
fn percent(share: f64) -> String {
    format!("{:.0} %", 100.0 * share)
}

/// -3.14 as "-3.1".
fn tenths(number: f64) -> String {
    format!("{number:.1}")
}

fn save(panels: &Panels, path: &Path) -> Result<()> {
    files::write(path, panels.svg()?.as_bytes())
}
