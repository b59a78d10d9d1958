//! The figures of a study, as SVG, drawn from its tables alone.

use std::path::Path;

use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::element::DashedPathElement;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::tables::Tables;
use crate::chart::{FONT, GREY, PALETTE};
use crate::error::{Error, Result};
use crate::files;

const SIZE: (u32, u32) = (820, 440);

/// The methods that have the same colour of the palette in every study. Others take the colours that are left.
const COLOURED: [&str; PALETTE.len()] = ["oracle", "pets", "dreamer", "sac", "planet", "scripted", "random"];

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Drawn = std::result::Result<(), Box<dyn std::error::Error>>;

/// Success over environment steps for one task: a line for the mean of each learning method with a band from its worst
/// seed to its best, and a dashed line for each method that does not learn. Returns `false`, and draws nothing, if no
/// method learns.
///
/// # Errors
/// If the tables lack a column or the file cannot be written.
pub fn learning_curves(tables: &Tables, task: &str, path: &Path) -> Result<bool> {
    let mut learning = Vec::new();
    let mut fixed = Vec::new();
    for (color, method) in methods(tables, task)? {
        let curves = tables.curves(task, &method)?;
        if curves.is_empty() {
            fixed.push((color, method.clone(), tables.value(task, &method, "success")?.unwrap_or(0.0)));
        } else {
            learning.push((color, method, curves));
        }
    }
    let lasts = learning.iter().flat_map(|(_, _, curves)| curves).filter_map(|(x, _)| x.last().copied());
    let Some(budget) = lasts.reduce(f64::max) else {
        return Ok(false);
    };
    draw(path, |area| {
        let mut chart = ChartBuilder::on(&area)
            .caption(format!("{task}: success over environment steps"), (FONT, 20))
            .margin(14)
            .x_label_area_size(44)
            .y_label_area_size(58)
            .build_cartesian_2d(0.0..budget, -0.02..1.04)?;
        chart
            .configure_mesh()
            .light_line_style(WHITE)
            .bold_line_style(GREY.mix(0.2))
            .axis_style(GREY)
            .x_desc("environment steps, random warm-up included")
            .y_desc("success rate")
            .y_labels(6)
            .x_label_formatter(&|x| thousands(*x))
            .y_label_formatter(&|y| format!("{:.0} %", 100.0 * y))
            .label_style((FONT, 14))
            .draw()?;
        let bands: Vec<Band> = learning.iter().map(|(.., curves)| band(curves)).collect();
        // All bands first, so that none covers a line.
        for ((color, _, curves), (steps, band)) in learning.iter().zip(&bands) {
            let outline = steps.iter().zip(band).map(|(x, [low, _, _])| (*x, *low));
            let back = steps.iter().zip(band).rev().map(|(x, [_, _, high])| (*x, *high));
            let polygon: Vec<(f64, f64)> = outline.chain(back).collect();
            if curves.len() > 1 {
                chart.draw_series([Polygon::new(polygon, color.mix(0.18))])?;
            }
        }
        for ((color, method, curves), (steps, band)) in learning.iter().zip(&bands) {
            let color = *color;
            let mean = steps.iter().zip(band).map(|(x, [_, mean, _])| (*x, *mean));
            let label = format!("{method} ({} seed{})", curves.len(), if curves.len() == 1 { "" } else { "s" });
            chart
                .draw_series(LineSeries::new(mean, color.stroke_width(3)))?
                .label(label)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 22, y)], color.stroke_width(3)));
        }
        for (color, method, success) in &fixed {
            let color = *color;
            let ends = [(0.0, *success), (budget, *success)];
            chart
                .draw_series(DashedLineSeries::new(ends, 7, 5, color.stroke_width(2)))?
                .label(format!("{method} (does not learn)"))
                .legend(move |(x, y)| DashedPathElement::new([(x, y), (x + 22, y)], 5, 3, color.stroke_width(2)));
        }
        legend(&mut chart, SeriesLabelPosition::LowerRight)?;
        Ok(())
    })?;
    Ok(true)
}

/// The final test of every method on one task: success with its 95 % interval, and the smoothness of the hand's movement
/// if the environment has a hand.
///
/// # Errors
/// If the tables lack a column or the file cannot be written.
pub fn tests(tables: &Tables, task: &str, path: &Path) -> Result<()> {
    let mut rows = Vec::new();
    for (color, method) in methods(tables, task)? {
        let value = |column: &str| tables.value(task, &method, column);
        let success = [value("success_low")?, value("success")?, value("success_high")?].map(|v| v.unwrap_or(0.0));
        let sparc = value("smoothness_sparc")?;
        rows.push((color, method, success, sparc));
    }
    let roughest = rows.iter().filter_map(|(.., sparc)| *sparc).reduce(f64::min);
    let count = rows.len();
    draw(path, |area| {
        let area = area.margin(14, 10, 10, 10).titled(&format!("{task}: final test"), (FONT, 20))?;
        let panel = |area: &Area, title: &str, left_margin: u32, from: f64, to: f64, percent: bool| -> Drawn {
            let mut chart = ChartBuilder::on(area)
                .caption(title, (FONT, 15))
                .margin(8)
                .x_label_area_size(34)
                .y_label_area_size(left_margin)
                .build_cartesian_2d(from..to, -0.6..count as f64 - 0.4)?;
            chart
                .configure_mesh()
                .disable_y_mesh()
                .disable_y_axis()
                .light_line_style(WHITE)
                .bold_line_style(GREY.mix(0.2))
                .axis_style(GREY)
                .x_labels(6)
                .x_label_formatter(&|x| if percent { format!("{:.0} %", 100.0 * x) } else { format!("{x:.1}") })
                .label_style((FONT, 14))
                .draw()?;
            for (i, (color, method, [low, mid, high], sparc)) in rows.iter().enumerate() {
                let y = (count - 1 - i) as f64;
                if percent {
                    chart.draw_series([PathElement::new([(*low, y), (*high, y)], color.stroke_width(3))])?;
                    chart.draw_series([Circle::new((*mid, y), 6, color.filled())])?;
                } else if let Some(sparc) = sparc {
                    chart.draw_series([Circle::new((*sparc, y), 6, color.filled())])?;
                }
                if left_margin > 0 {
                    let at = chart.backend_coord(&(from, y));
                    let corner = area.get_base_pixel();
                    let style = (FONT, 15).into_font().color(&BLACK).pos(Pos::new(HPos::Right, VPos::Center));
                    area.draw_text(method, &style, (at.0 - corner.0 - 12, at.1 - corner.1))?;
                }
            }
            Ok(())
        };
        let success = |area: &Area| panel(area, "success, 95 % interval", 110, 0.0, 1.03, true);
        let Some(roughest) = roughest else {
            return success(&area);
        };
        let (left, right) = area.split_horizontally(470);
        success(&left)?;
        let from = 1.1 * roughest.min(-2.0);
        panel(&right, "smoothness (SPARC; minimum jerk: -1.4)", 0, from, -1.0, false)
    })
}

/// The horizons, in steps, for which a model's open-loop error is drawn.
const HORIZONS: [u32; 3] = [1, 5, 15];

/// The quality of a method's model over training: its open-loop error at several horizons, and the coverage of its 90 %
/// interval. Returns `false`, and draws nothing, if the method has no model.
///
/// # Errors
/// If the tables lack a column or the file cannot be written.
pub fn model(tables: &Tables, task: &str, method: &str, path: &Path) -> Result<bool> {
    let mut lines = Vec::new();
    for (color, horizon) in PALETTE.into_iter().zip(HORIZONS) {
        let error = tables.model_curves(task, method, horizon, "rmse")?;
        let coverage = tables.model_curves(task, method, horizon, "coverage90")?;
        if !error.is_empty() {
            lines.push((color, horizon, [band(&error), band(&coverage)]));
        }
    }
    let Some(worst) = lines.iter().flat_map(|(_, _, bands)| &bands[0].1).map(|[.., high]| *high).reduce(f64::max)
    else {
        return Ok(false);
    };
    let lines_of = |which: usize| {
        let line = |(color, horizon, bands): &(RGBColor, u32, [Band; 2])| {
            let label = format!("{horizon} step{} ahead", if *horizon == 1 { "" } else { "s" });
            (*color, label, bands[which].clone())
        };
        lines.iter().map(line).collect()
    };
    let panels = [
        Panel {
            title: "error (1: predicting no change)",
            range: 0.0..worst.clamp(1.05, 4.0),
            mark: Some(1.0),
            percent: false,
            lines: lines_of(0),
            legend: SeriesLabelPosition::UpperRight,
        },
        Panel {
            title: "coverage of the 90 % interval",
            range: 0.0..1.03,
            mark: Some(0.9),
            percent: true,
            lines: lines_of(1),
            legend: SeriesLabelPosition::LowerRight,
        },
    ];
    over_training(path, &format!("{task}: open-loop predictions of {method} on held-out episodes"), &panels)?;
    Ok(true)
}

/// The discounted return that a method's agent predicts over training, beside the realised one. Returns `false`, and draws
/// nothing, if it predicts none.
///
/// # Errors
/// If the tables lack a column or the file cannot be written.
pub fn values(tables: &Tables, task: &str, method: &str, path: &Path) -> Result<bool> {
    let curves = |column: &str| tables.value_curves(task, method, column);
    let (predicted, realised, correlation) = (curves("expected")?, curves("realised")?, curves("correlation")?);
    if predicted.is_empty() {
        return Ok(false);
    }
    let [predicted, realised, correlation] = [predicted, realised, correlation].map(|curves| band(&curves));
    let all = predicted.1.iter().chain(&realised.1).flatten().copied();
    let (low, high) = (all.clone().fold(0.0, f64::min), all.fold(0.0, f64::max));
    let panels = [
        Panel {
            title: "mean over time steps",
            range: 1.05 * low..1.05 * high.max(low + 1e-3),
            mark: None,
            percent: false,
            lines: vec![(PALETTE[0], "predicted".into(), predicted), (PALETTE[1], "realised".into(), realised)],
            legend: SeriesLabelPosition::LowerRight,
        },
        Panel {
            title: "correlation of the two",
            range: -0.3..1.03,
            mark: Some(1.0),
            percent: false,
            lines: vec![(PALETTE[2], "over time steps".into(), correlation)],
            legend: SeriesLabelPosition::LowerRight,
        },
    ];
    over_training(path, &format!("{task}: predicted and realised discounted return of {method}"), &panels)?;
    Ok(true)
}

/// Environment steps, and the lowest, mean and highest value over the seeds at each of them.
type Band = (Vec<f64>, Vec<[f64; 3]>);

/// One of two charts side by side.
struct Panel {
    title: &'static str,
    range: std::ops::Range<f64>,
    /// A reference value, drawn as a dashed line.
    mark: Option<f64>,
    percent: bool,
    lines: Vec<(RGBColor, String, Band)>,
    legend: SeriesLabelPosition,
}

/// Draws the means over the seeds against environment steps, in two charts side by side.
fn over_training(path: &Path, title: &str, panels: &[Panel; 2]) -> Result<()> {
    let steps = panels.iter().flat_map(|panel| &panel.lines).flat_map(|(_, _, (steps, _))| steps.iter().copied());
    let (first, last) = (steps.clone().fold(f64::INFINITY, f64::min), steps.fold(0.0, f64::max));
    draw(path, |area| {
        let area = area.margin(14, 10, 10, 10).titled(title, (FONT, 20))?;
        for (area, Panel { title, range, mark, percent, lines, legend: position }) in
            area.split_evenly((1, 2)).iter().zip(panels)
        {
            let mut chart = ChartBuilder::on(area)
                .caption(title, (FONT, 15))
                .margin(8)
                .x_label_area_size(40)
                .y_label_area_size(50)
                .build_cartesian_2d(first.min(last - 1.0)..last, range.clone())?;
            chart
                .configure_mesh()
                .light_line_style(WHITE)
                .bold_line_style(GREY.mix(0.2))
                .axis_style(GREY)
                .x_desc("environment steps")
                .x_labels(5)
                .x_label_formatter(&|x| thousands(*x))
                .y_label_formatter(&|y| if *percent { format!("{:.0} %", 100.0 * y) } else { number(*y, range) })
                .label_style((FONT, 14))
                .draw()?;
            if let Some(mark) = *mark {
                chart.draw_series(DashedLineSeries::new([(first, mark), (last, mark)], 7, 5, GREY.stroke_width(1)))?;
            }
            for (color, label, (x, y)) in lines {
                let color = *color;
                let mean = x.iter().zip(y).map(|(x, [_, mean, _])| (*x, *mean));
                chart
                    .draw_series(LineSeries::new(mean, color.stroke_width(3)))?
                    .label(label)
                    .legend(move |(x, y)| PathElement::new([(x, y), (x + 22, y)], color.stroke_width(3)));
            }
            legend(&mut chart, position.clone())?;
        }
        Ok(())
    })
}

/// A label with one decimal if the range is small, else without.
fn number(y: f64, range: &std::ops::Range<f64>) -> String {
    if range.end - range.start < 10.0 { format!("{y:.1}") } else { format!("{y:.0}") }
}

type Chart<'a, 'b> = ChartContext<'a, SVGBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

fn legend<'a, 'b: 'a>(chart: &mut Chart<'a, 'b>, position: SeriesLabelPosition) -> Drawn {
    chart
        .configure_series_labels()
        .position(position)
        .background_style(WHITE.mix(0.85))
        .border_style(GREY.mix(0.4))
        .label_font((FONT, 14))
        .margin(8)
        .draw()?;
    Ok(())
}

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

/// The steps that all seeds have in common, with the lowest, mean and highest value at each.
fn band(curves: &[(Vec<f64>, Vec<f64>)]) -> Band {
    let shortest = curves.iter().min_by_key(|(x, _)| x.len()).expect("at least one curve");
    let rows = (0..shortest.0.len()).map(|i| {
        let values: Vec<f64> = curves.iter().map(|(_, y)| y[i]).collect();
        let low = values.iter().copied().fold(f64::INFINITY, f64::min);
        let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        [low, values.iter().sum::<f64>() / values.len() as f64, high]
    });
    (shortest.0.clone(), rows.collect())
}

/// 12500 as "12.5k".
fn thousands(x: f64) -> String {
    if x >= 1000.0 { format!("{}k", (x / 100.0).round() / 10.0) } else { format!("{x:.0}") }
}

fn draw(path: &Path, paint: impl FnOnce(Area) -> Drawn) -> Result<()> {
    let mut svg = String::new();
    let area = SVGBackend::with_string(&mut svg, SIZE).into_drawing_area();
    let painted = area.fill(&WHITE).map_err(Into::into).and_then(|()| paint(area));
    painted.map_err(|problem| Error::data(path)(format!("cannot be drawn: {problem}")))?;
    files::write(path, svg.as_bytes())
}
