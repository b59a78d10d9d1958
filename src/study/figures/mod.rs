//! The figures of a study, as SVG, drawn from its tables alone.

use std::path::Path;

use plotters::style::RGBColor;

use super::tables::{Curve, Tables};
use crate::chart::{GREY, PALETTE, Panels};
use crate::error::Result;
use crate::files;

mod learning;
mod test;
mod training;

pub use learning::learning_curves;
pub use test::tests;
pub use training::{model, values};

/// The methods that have the same colour of the palette in every study. Others take the colours that are left.
const COLOURED: [&str; PALETTE.len()] = ["oracle", "pets", "dreamer", "sac", "planet", "scripted", "random"];

/// The methods of a task, each with its colour.
fn methods(tables: &Tables, task: &str) -> Result<Vec<(RGBColor, String)>> {
    let of_task = tables.tasks_and_methods()?.into_iter().filter(|(of, _)| of == task).map(|(_, method)| method);
    let of_task: Vec<String> = of_task.collect();
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
    let Some((steps, _)) = curves.iter().min_by_key(|(x, _)| x.len()) else {
        return Vec::new();
    };
    let over_seeds = |(i, x): (usize, &f64)| {
        let values: Vec<f64> = curves.iter().map(|(_, y)| y[i]).collect();
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        (*x, [low, values.iter().sum::<f64>() / values.len() as f64, high])
    };
    steps.iter().enumerate().map(over_seeds).collect()
}

fn means(band: &Band) -> impl Iterator<Item = (f64, f64)> {
    band.iter().map(|(x, [_, mean, _])| (*x, *mean))
}

/// 12500 as "12.5k".
fn thousands(x: f64) -> String {
    if x >= 1000.0 { format!("{}k", (x / 100.0).round() / 10.0) } else { format!("{x:.0}") }
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
