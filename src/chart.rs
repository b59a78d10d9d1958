//! Charts for chapters and examples: lines, points and bands in one frame, as SVG.
//!
//! ```
//! use handful::chart::Chart;
//!
//! let returns = (0..10).map(|episode| (200.0 * f64::from(episode), -1200.0 + 100.0 * f64::from(episode)));
//! let svg = Chart::new("environment steps", "episode return")
//!     .line("an agent", returns)
//!     .dashed("random actions", [(0.0, -1200.0), (1800.0, -1200.0)])
//!     .svg()?;
//! assert!(svg.starts_with("<svg"));
//! # Ok::<(), handful::error::Error>(())
//! ```
//!
//! In a notebook, a [`Chart`] that is the last expression of a cell is displayed.

use plotters::coord::ranged1d::{AsRangedCoord, ValueFormatter};
use plotters::element::DashedPathElement;
use plotters::prelude::*;

use crate::error::{Error, Result};

/// Colours that colour-blind readers can tell apart (Okabe and Ito).
pub const PALETTE: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
];
/// The font of all figures.
pub const FONT: &str = "sans-serif";
/// The colour of axes and other secondary lines.
pub const GREY: RGBColor = RGBColor(110, 110, 110);

/// A chart. [`Chart::line`], [`Chart::dashed`], [`Chart::points`] and [`Chart::band`] add series to it.
#[derive(Clone, Debug, Default)]
pub struct Chart {
    x_label: String,
    y_label: String,
    x_log: bool,
    y_log: bool,
    y_range: Option<[f64; 2]>,
    series: Vec<Series>,
}

#[derive(Clone, Debug)]
struct Series {
    name: String,
    shape: Shape,
    points: Vec<(f64, f64)>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Shape {
    Line,
    Dashed,
    Points,
    Band,
}

impl Chart {
    /// An empty chart with labels (quantity and unit) for its axes.
    pub fn new(x_label: &str, y_label: &str) -> Self {
        Self { x_label: x_label.into(), y_label: y_label.into(), ..Self::default() }
    }

    /// Uses a logarithmic scale for x. Points with x ≤ 0 are left out.
    pub fn log_x(mut self) -> Self {
        self.x_log = true;
        self
    }

    /// Uses a logarithmic scale for y. Points with y ≤ 0 are left out.
    pub fn log_y(mut self) -> Self {
        self.y_log = true;
        self
    }

    /// Sets the range of the y axis, which otherwise follows from the points.
    pub fn between(mut self, low: f64, high: f64) -> Self {
        self.y_range = Some([low, high]);
        self
    }

    /// Adds a line through `(x, y)` points.
    pub fn line(self, name: &str, points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        self.with(name, Shape::Line, points.into_iter().collect())
    }

    /// Adds a dashed line, for a bound, a baseline or the true values.
    pub fn dashed(self, name: &str, points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        self.with(name, Shape::Dashed, points.into_iter().collect())
    }

    /// Adds points, which are not connected.
    pub fn points(self, name: &str, points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        self.with(name, Shape::Points, points.into_iter().collect())
    }

    /// Adds a band between `low` and `high`, from `(x, low, high)`, in the colour of the series added last.
    pub fn band(self, band: impl IntoIterator<Item = (f64, f64, f64)>) -> Self {
        let band: Vec<(f64, f64, f64)> = band.into_iter().collect();
        let low = band.iter().map(|(x, low, _)| (*x, *low));
        let high = band.iter().rev().map(|(x, _, high)| (*x, *high));
        let outline = low.chain(high).collect();
        self.with("", Shape::Band, outline)
    }

    fn with(mut self, name: &str, shape: Shape, points: Vec<(f64, f64)>) -> Self {
        self.series.push(Series { name: name.into(), shape, points });
        self
    }

    /// Draws the chart and returns it as SVG.
    ///
    /// # Errors
    /// If there is nothing to draw: no finite point (on a logarithmic scale, no positive one).
    pub fn svg(&self) -> Result<String> {
        let shown = || self.series.iter().flat_map(|series| &series.points).filter(|point| self.shows(point));
        let x = span(shown().map(|(x, _)| *x), self.x_log);
        let y = self.y_range.map(|[low, high]| (low, high)).or_else(|| span(shown().map(|(_, y)| *y), self.y_log));
        let (Some((x0, x1)), Some((y0, y1))) = (x, y) else {
            return Err(Error::Config("chart: there is nothing to draw".into()));
        };
        let mut svg = String::new();
        let drawn = match (self.x_log, self.y_log) {
            (false, false) => self.draw(&mut svg, x0..x1, y0..y1),
            (true, false) => self.draw(&mut svg, (x0..x1).log_scale(), y0..y1),
            (false, true) => self.draw(&mut svg, x0..x1, (y0..y1).log_scale()),
            (true, true) => self.draw(&mut svg, (x0..x1).log_scale(), (y0..y1).log_scale()),
        };
        drawn.map_err(|error| Error::Config(format!("chart: {error}")))?;
        Ok(svg)
    }

    fn shows(&self, &(x, y): &(f64, f64)) -> bool {
        x.is_finite() && y.is_finite() && (!self.x_log || x > 0.0) && (!self.y_log || y > 0.0)
    }

    fn draw<X, Y>(&self, svg: &mut String, x: X, y: Y) -> std::result::Result<(), Box<dyn std::error::Error>>
    where
        X: AsRangedCoord<Value = f64>,
        Y: AsRangedCoord<Value = f64>,
        X::CoordDescType: ValueFormatter<f64>,
        Y::CoordDescType: ValueFormatter<f64>,
    {
        let area = SVGBackend::with_string(svg, (680, 340)).into_drawing_area();
        area.fill(&WHITE)?;
        let mut chart = ChartBuilder::on(&area)
            .margin(12)
            .margin_right(24)
            .x_label_area_size(42)
            .y_label_area_size(62)
            .build_cartesian_2d(x, y)?;
        chart
            .configure_mesh()
            .max_light_lines(0)
            .bold_line_style(GREY.mix(0.2))
            .axis_style(GREY)
            .x_desc(&self.x_label)
            .y_desc(&self.y_label)
            .x_label_formatter(&|x| plain(*x))
            .y_label_formatter(&|y| plain(*y))
            .label_style((FONT, 14))
            .draw()?;
        let mut colours = PALETTE.into_iter().cycle();
        let mut colour = PALETTE[0];
        for Series { name, shape, points } in &self.series {
            if *shape != Shape::Band {
                colour = colours.next().expect("colours without end");
            }
            let points: Vec<(f64, f64)> = points.iter().copied().filter(|point| self.shows(point)).collect();
            let line = colour.stroke_width(if *shape == Shape::Dashed { 2 } else { 3 });
            let series = match shape {
                Shape::Line => chart.draw_series(LineSeries::new(points, line))?,
                Shape::Dashed => chart.draw_series(DashedLineSeries::new(points, 7, 5, line))?,
                Shape::Points => {
                    chart.draw_series(points.into_iter().map(|p| Circle::new(p, 3, colour.mix(0.7).filled())))?
                }
                Shape::Band => chart.draw_series([Polygon::new(points, colour.mix(0.2))])?,
            };
            if !name.is_empty() {
                // A short piece of the line, or one point, for the legend.
                let series = series.label(name);
                match shape {
                    Shape::Dashed => {
                        series.legend(move |(x, y)| DashedPathElement::new([(x, y), (x + 22, y)], 5, 3, line))
                    }
                    Shape::Points => series.legend(move |(x, y)| Circle::new((x + 11, y), 3, line.filled())),
                    Shape::Line | Shape::Band => {
                        series.legend(move |(x, y)| PathElement::new([(x, y), (x + 22, y)], line))
                    }
                };
            }
        }
        if self.series.iter().filter(|series| !series.name.is_empty()).count() > 1 {
            chart
                .configure_series_labels()
                .position(self.emptiest_corner())
                .background_style(WHITE.mix(0.85))
                .border_style(GREY.mix(0.4))
                .label_font((FONT, 14))
                .draw()?;
        }
        drop(chart);
        Ok(area.present()?)
    }

    /// The corner in which the legend hides the fewest points.
    fn emptiest_corner(&self) -> SeriesLabelPosition {
        let shown = || self.series.iter().flat_map(|series| &series.points).filter(|point| self.shows(point));
        let along = |value: f64, log: bool| if log { value.ln() } else { value };
        let middle = |values: Vec<f64>| {
            let (low, high) = (
                values.iter().copied().fold(f64::INFINITY, f64::min),
                values.iter().copied().fold(f64::NEG_INFINITY, f64::max),
            );
            (low + high) / 2.0
        };
        let x = middle(shown().map(|(x, _)| along(*x, self.x_log)).collect());
        let y = match self.y_range {
            Some(range) => middle(range.map(|y| along(y, self.y_log)).to_vec()),
            None => middle(shown().map(|(_, y)| along(*y, self.y_log)).collect()),
        };
        let corners = [
            (SeriesLabelPosition::UpperRight, true, true),
            (SeriesLabelPosition::LowerRight, true, false),
            (SeriesLabelPosition::UpperLeft, false, true),
            (SeriesLabelPosition::LowerLeft, false, false),
        ];
        let inside = |right: bool, up: bool| {
            let here =
                |&&(px, py): &&(f64, f64)| (along(px, self.x_log) > x) == right && (along(py, self.y_log) > y) == up;
            shown().filter(here).count()
        };
        let best = corners.into_iter().min_by_key(|(_, right, up)| inside(*right, *up));
        best.expect("four corners").0
    }

    /// Displays the chart in a notebook; called by the evcxr kernel.
    pub fn evcxr_display(&self) {
        match self.svg() {
            Ok(svg) => println!("EVCXR_BEGIN_CONTENT image/svg+xml\n{svg}\nEVCXR_END_CONTENT"),
            Err(error) => println!("{error}"),
        }
    }
}

/// The range of the numbers with a small margin, or `None` if there are none.
fn span(numbers: impl Iterator<Item = f64>, log: bool) -> Option<(f64, f64)> {
    let (low, high) =
        numbers.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (f64::min(low, x), f64::max(high, x)));
    if low > high {
        return None;
    }
    if log {
        return Some((low / 1.1, high * 1.1));
    }
    let margin = if high > low { 0.03 * (high - low) } else { high.abs().max(1.0) * 0.1 };
    Some((low - margin, high + margin))
}

/// A number with up to four decimals, without trailing zeros.
fn plain(x: f64) -> String {
    let text = format!("{x:.4}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".into() } else { text.into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chart_draws_what_is_finite_and_nothing_else() {
        let chart = Chart::new("x", "y").line("a", [(0.0, 1.0), (1.0, f64::NAN), (2.0, 3.0)]);
        let svg = chart.svg().expect("two points to draw");
        assert!(svg.starts_with("<svg") && !svg.contains("NaN"));
        assert!(Chart::new("x", "y").line("a", [(0.0, 1.0)]).log_x().svg().is_err(), "nothing positive to draw");
    }

    #[test]
    fn numbers_at_axes_are_short() {
        assert_eq!([0.0, -0.0, 0.25, 1000.0].map(plain), ["0", "0", "0.25", "1000"]);
    }
}
