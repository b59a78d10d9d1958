//! Charts as SVG: lines, points and bands in one frame ([`Chart`]), or several frames ([`Panels`]).
//!
//! In a notebook, either one is displayed if it is the last expression of a cell. Numbers that no axis can show (not finite, or
//! beyond 1e100) are left out.
//!
//! ```
//! use handful::chart::{Chart, Panels};
//!
//! let steps = (0..50).map(|t| 0.1 * f64::from(t));
//! let decay = Chart::new("time, s", "distance, m")
//!     .line("measured", steps.clone().map(|t| (t, (-t).exp())))
//!     .dashed("tolerance", [(0.0, 0.1), (5.0, 0.1)])
//!     .log_y();
//! let speed = Chart::new("time, s", "speed, m/s").line("", steps.map(|t| (t, -(-t).exp())));
//! let svg = Panels::new("Approach").panel(decay.titled("distance")).panel(speed.titled("speed")).svg()?;
//! assert!(svg.starts_with("<svg"));
//! # Ok::<(), handful::error::Error>(())
//! ```

mod axis;
mod draw;
mod panels;

use std::ops::Range;

use plotters::coord::combinators::BindKeyPoints;
use plotters::prelude::*;

use crate::error::{Error, Result};
pub use axis::LARGEST;
use axis::{Axis, fits};
use draw::Frame;
pub use panels::Panels;

/// Colours that colour-blind readers can tell apart: those of Okabe and Ito, with Tol's wine red for their yellow, which is too
/// bright for a line.
pub const PALETTE: [RGBColor; 8] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
    RGBColor(136, 34, 85),
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
    title: String,
    x_log: bool,
    y_log: bool,
    x_range: Option<[f64; 2]>,
    y_range: Option<[f64; 2]>,
    x_ticks: Ticks,
    y_ticks: Ticks,
    rows: Vec<String>,
    mark: Option<f64>,
    legend: Option<SeriesLabelPosition>,
    series: Vec<Series>,
}

#[derive(Clone, Debug)]
struct Series {
    name: String,
    shape: Shape,
    points: Vec<(f64, f64)>,
    colour: Option<RGBColor>,
}

/// About how many labels an axis has, and how they are written.
#[derive(Clone, Copy, Debug)]
struct Ticks {
    count: usize,
    text: fn(f64) -> String,
}

impl Default for Ticks {
    fn default() -> Self {
        Self { count: 11, text: draw::plain }
    }
}

impl Ticks {
    /// A number at an axis: as asked for, except that a logarithmic axis shows tiny ones, too.
    fn label(&self, axis: Axis, number: f64) -> String {
        if axis.log && number < 1e-4 { draw::scientific(number) } else { (self.text)(number) }
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Shape {
    Line,
    Thin,
    Dashed,
    Points,
    Dots,
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

    /// Writes a title above the frame.
    pub fn titled(mut self, title: &str) -> Self {
        self.title = title.into();
        self
    }

    /// Sets the range of the y axis, which otherwise (or if an axis cannot have this range) follows from the points.
    pub fn between(mut self, low: f64, high: f64) -> Self {
        self.y_range = Some([low, high]);
        self
    }

    /// Sets the range of the x axis, which otherwise (or if an axis cannot have this range) follows from the points.
    pub fn x_between(mut self, low: f64, high: f64) -> Self {
        self.x_range = Some([low, high]);
        self
    }

    /// Sets the approximate number of labels on the x axis (otherwise 11) and how a number is written there.
    pub fn x_ticks(mut self, count: usize, text: fn(f64) -> String) -> Self {
        self.x_ticks = Ticks { count, text };
        self
    }

    /// Sets the approximate number of labels on the y axis (otherwise 11) and how a number is written there.
    pub fn y_ticks(mut self, count: usize, text: fn(f64) -> String) -> Self {
        self.y_ticks = Ticks { count, text };
        self
    }

    /// Writes names at the y axis instead of numbers, the first at the top: row `i` is at `y = i`.
    pub fn rows<S: Into<String>>(mut self, names: impl IntoIterator<Item = S>) -> Self {
        self.rows = names.into_iter().map(Into::into).collect();
        // With one more than there are rows, plotters has room for all of them and for nothing between them.
        self.y_ticks.count = self.rows.len() + 1;
        let last = self.rows.len() as f64 - 1.0;
        self.between(last + 0.6, -0.6)
    }

    /// Adds a thin dashed line at this y across the frame: a reference value.
    pub fn mark(mut self, y: f64) -> Self {
        self.mark = Some(y);
        self
    }

    /// Places the legend, even for a single name. Otherwise two or more names get one in the corner where it hides the
    /// fewest points.
    pub fn legend(mut self, position: SeriesLabelPosition) -> Self {
        self.legend = Some(position);
        self
    }

    /// Adds a line through `(x, y)` points.
    pub fn line(self, name: &str, points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        self.with(name, Shape::Line, points.into_iter().collect())
    }

    /// Adds a thin, pale line: one run of several, or what others did.
    pub fn thin(self, points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        self.with("", Shape::Thin, points.into_iter().collect())
    }

    /// Adds a dashed line, for a bound, a baseline or the true values.
    pub fn dashed(self, name: &str, points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        self.with(name, Shape::Dashed, points.into_iter().collect())
    }

    /// Adds points, which are not connected.
    pub fn points(self, name: &str, points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        self.with(name, Shape::Points, points.into_iter().collect())
    }

    /// Adds large dots, for a few values that matter each.
    pub fn dots(self, name: &str, points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        self.with(name, Shape::Dots, points.into_iter().collect())
    }

    /// Sets the colour of the series added last; otherwise series take those of the [`PALETTE`] in turn.
    pub fn coloured(mut self, colour: RGBColor) -> Self {
        if let Some(last) = self.series.last_mut() {
            last.colour = Some(colour);
        }
        self
    }

    /// Adds a band between `low` and `high`, from `(x, low, high)`, in the colour of the series added before it.
    pub fn band(self, band: impl IntoIterator<Item = (f64, f64, f64)>) -> Self {
        let band: Vec<(f64, f64, f64)> = band.into_iter().collect();
        let low = band.iter().map(|(x, low, _)| (*x, *low));
        let high = band.iter().rev().map(|(x, _, high)| (*x, *high));
        let outline = low.chain(high).collect();
        self.with("", Shape::Band, outline)
    }

    fn with(mut self, name: &str, shape: Shape, points: Vec<(f64, f64)>) -> Self {
        self.series.push(Series { name: name.into(), shape, points, colour: None });
        self
    }

    /// Draws the chart and returns it as SVG, 680 by 340 pixels.
    ///
    /// # Errors
    /// If there is nothing to draw: no finite point (on a logarithmic scale, no positive one).
    pub fn svg(&self) -> Result<String> {
        let mut svg = String::new();
        self.draw_on(&draw::canvas(&mut svg, (680, 340))?, &Frame::ALONE)?;
        Ok(svg)
    }

    /// Draws the chart on an area.
    fn draw_on(&self, area: &draw::Area, frame: &Frame) -> Result<()> {
        let points = || self.series.iter().flat_map(|series| &series.points).filter(|point| self.shows(point));
        let x = Axis::new(self.x_range, points().map(|(x, _)| *x), self.x_log);
        let y = Axis::new(self.y_range, points().map(|(_, y)| *y), self.y_log);
        let (Some(x), Some(y)) = (x, y) else {
            return Err(Error::Config("chart: there is nothing to draw".into()));
        };
        let [across, up] = [x, y].map(|Axis { low, high, .. }| low..high);
        let logarithmic = |range: Range<f64>, axis: Axis| range.log_scale().with_key_points(axis.log_labels());
        let drawn = match (x.log, y.log) {
            (false, false) => self.draw(area, frame, [x, y], across, up),
            (true, false) => self.draw(area, frame, [x, y], logarithmic(across, x), up),
            (false, true) => self.draw(area, frame, [x, y], across, logarithmic(up, y)),
            (true, true) => self.draw(area, frame, [x, y], logarithmic(across, x), logarithmic(up, y)),
        };
        drawn.map_err(draw::failed)
    }

    /// Whether a point can be drawn on these axes.
    fn shows(&self, &(x, y): &(f64, f64)) -> bool {
        fits(x, self.x_log) && fits(y, self.y_log)
    }

    /// Displays the chart in a notebook; called by the evcxr kernel.
    pub fn evcxr_display(&self) {
        draw::display(self.svg());
    }
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
    fn ranges_that_no_axis_can_have_are_not_taken() {
        let points = [(0.0, 1.0), (1.0, f64::INFINITY), (2.0, 3.0)];
        let own = Chart::new("x", "y").line("a", points).svg().expect("two points to draw");
        for (low, high) in [(0.0, f64::INFINITY), (f64::NAN, 1.0), (1.0, 1.0)] {
            let chart = Chart::new("x", "y").line("a", points).between(low, high).x_between(low, high);
            assert_eq!(chart.svg().expect("two points to draw"), own, "from {low} to {high}");
        }
        assert_eq!(Chart::new("x", "y").line("a", points).mark(f64::INFINITY).svg().expect("two points to draw"), own);
    }

    /// With every shape, also far outside of the frame. Most of these took plotters forever.
    #[test]
    fn no_number_hangs_a_chart() {
        let hard = [0.0, 1.0, -1.0, 5e-324, 1e-200, 1e16, 1e16 + 2.0, 1e90, 1e300, f64::MAX, f64::INFINITY, f64::NAN];
        for a in hard {
            for b in hard {
                let points = [(0.0, a), (a, b), (b, 2.0), (1.0, -b)];
                let chart = Chart::new("x", "y").line("line", points).dashed("dashed", points).points("points", points);
                let chart = chart.dots("dots", points).band([(0.0, a, b), (1.0, b, a), (b, 0.0, a)]).mark(b);
                for chart in
                    [chart.clone(), chart.clone().between(a, b), chart.clone().x_between(a, b).between(0.0, 1.0)]
                {
                    for chart in [chart.clone(), chart.clone().log_x(), chart.clone().log_y()] {
                        let svg = chart.svg().unwrap_or_default();
                        assert!(svg.len() < 500_000 && !svg.contains("NaN") && !svg.contains("inf"), "{a}, {b}");
                    }
                }
            }
        }
    }

    #[test]
    fn rows_have_names() {
        for count in 1..=30 {
            let names: Vec<String> = (0..count).map(|i| format!("row {i};")).collect();
            let chart = Chart::new("x", "").rows(&names).dots("", [(0.5, 0.0)]);
            let svg = chart.svg().expect("a dot");
            assert!(names.iter().all(|name| svg.matches(name.as_str()).count() == 1), "{count}");
        }
    }

    #[test]
    fn panels_stand_side_by_side() {
        let chart = |title: &str| Chart::new("x", "y").titled(title).line("", [(0.0, 0.0), (1.0, 1.0)]);
        let svg = Panels::new("both").panel(chart("left")).panel(chart("right")).svg().expect("two charts");
        for title in ["both", "left", "right"] {
            assert!(svg.contains(title), "{title}");
        }
        assert!(Panels::new("both").panel(Chart::default()).svg().is_err(), "nothing to draw");
    }

    #[test]
    fn numbers_at_axes_are_short() {
        assert_eq!([0.0, -0.0, 0.25, 1000.0].map(draw::plain), ["0", "0", "0.25", "1000"]);
        assert_eq!([2e-5, 6.02e-7].map(draw::scientific), ["2e-5", "6.02e-7"]);
        let tiny =
            Chart::new("x", "y").line("", [(0.0, 1.5e-5), (1.0, 3e-4)]).log_y().svg().expect("two points to draw");
        for label in ["2e-5", "5e-5", "0.0001", "0.0002"] {
            assert!(tiny.contains(&format!("\n{label}\n")), "{label}: {tiny}");
        }
    }
}
