//! Charts as SVG: lines, points and bands in one frame ([`Chart`]), or frames side by side ([`Panels`]).
//!
//! In a notebook, either one shows itself at the end of a cell. What is not finite is left out of a chart.
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

mod draw;
mod panels;

use plotters::prelude::*;

use crate::error::{Error, Result};
use draw::{Layout, span, usable};
pub use panels::Panels;

/// Colours that stay apart for colour-blind readers (Okabe and Ito).
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
/// Axes and their labels.
pub const GREY: RGBColor = RGBColor(110, 110, 110);

/// A chart, to be filled with [`Chart::line`] and its like.
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

#[derive(Clone, Copy, Debug, PartialEq)]
enum Shape {
    Line,
    Dashed,
    Points,
    Band,
}

impl Chart {
    /// An empty chart with these names (and units) at its axes.
    pub fn new(x_label: &str, y_label: &str) -> Self {
        Self { x_label: x_label.into(), y_label: y_label.into(), ..Self::default() }
    }

    /// Shows x on a logarithmic scale.
    pub fn log_x(mut self) -> Self {
        self.x_log = true;
        self
    }

    /// Shows y on a logarithmic scale.
    pub fn log_y(mut self) -> Self {
        self.y_log = true;
        self
    }

    /// Writes a title above the frame.
    pub fn titled(mut self, title: &str) -> Self {
        self.title = title.into();
        self
    }

    /// Shows y between these; without it, or if they cannot be the ends of an axis, all points.
    pub fn between(mut self, low: f64, high: f64) -> Self {
        self.y_range = Some([low, high]);
        self
    }

    /// Shows x between these; without it, or if they cannot be the ends of an axis, all points.
    pub fn x_between(mut self, low: f64, high: f64) -> Self {
        self.x_range = Some([low, high]);
        self
    }

    /// About how many labels the x axis has (otherwise 11), and how a number is written there.
    pub fn x_ticks(mut self, count: usize, text: fn(f64) -> String) -> Self {
        self.x_ticks = Ticks { count, text };
        self
    }

    /// About how many labels the y axis has (otherwise 11), and how a number is written there.
    pub fn y_ticks(mut self, count: usize, text: fn(f64) -> String) -> Self {
        self.y_ticks = Ticks { count, text };
        self
    }

    /// Draws a thin dashed line at this y from end to end: a value to compare with.
    pub fn mark(mut self, y: f64) -> Self {
        self.mark = Some(y);
        self
    }

    /// Puts the legend here, even for one name. Otherwise two or more names have one where it hides the fewest points.
    pub fn legend(mut self, position: SeriesLabelPosition) -> Self {
        self.legend = Some(position);
        self
    }

    /// Adds a line.
    pub fn line(self, name: &str, points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        self.with(name, Shape::Line, points.into_iter().collect())
    }

    /// Adds a dashed line: a bound, a baseline, the truth.
    pub fn dashed(self, name: &str, points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        self.with(name, Shape::Dashed, points.into_iter().collect())
    }

    /// Adds points.
    pub fn points(self, name: &str, points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        self.with(name, Shape::Points, points.into_iter().collect())
    }

    /// Gives the series that was added last a colour of its own instead of the palette's next.
    pub fn coloured(mut self, colour: RGBColor) -> Self {
        if let Some(last) = self.series.last_mut() {
            last.colour = Some(colour);
        }
        self
    }

    /// Adds a band of `(x, low, high)`, in the colour of the line that was added last.
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

    /// The chart as SVG.
    ///
    /// # Errors
    /// If nothing in it can be drawn: no finite point (on a logarithmic scale: no positive one).
    pub fn svg(&self) -> Result<String> {
        let mut svg = String::new();
        self.draw_on(&draw::canvas(&mut svg, (680, 340))?, &Layout::ALONE)?;
        Ok(svg)
    }

    /// Draws the chart on an area.
    fn draw_on(&self, area: &draw::Area, layout: &Layout) -> Result<()> {
        let shown = || self.series.iter().flat_map(|series| &series.points).filter(|point| self.shows(point));
        let x = usable(self.x_range, self.x_log).or_else(|| span(shown().map(|(x, _)| *x), self.x_log));
        let y = usable(self.y_range, self.y_log).or_else(|| span(shown().map(|(_, y)| *y), self.y_log));
        let (Some((x0, x1)), Some((y0, y1))) = (x, y) else {
            return Err(Error::BadSetting("chart: nothing in it can be drawn".into()));
        };
        let drawn = match (self.x_log, self.y_log) {
            (false, false) => self.draw(area, layout, x0..x1, y0..y1),
            (true, false) => self.draw(area, layout, (x0..x1).log_scale(), y0..y1),
            (false, true) => self.draw(area, layout, x0..x1, (y0..y1).log_scale()),
            (true, true) => self.draw(area, layout, (x0..x1).log_scale(), (y0..y1).log_scale()),
        };
        drawn.map_err(draw::failed)
    }

    /// Only finite numbers enter a chart, and only positive ones a logarithmic scale.
    fn shows(&self, &(x, y): &(f64, f64)) -> bool {
        x.is_finite() && y.is_finite() && (!self.x_log || x > 0.0) && (!self.y_log || y > 0.0)
    }

    /// Shows it in a notebook; called by the kernel.
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
    }
}
