//! How a chart is drawn with plotters.

use plotters::coord::Shift;
use plotters::coord::ranged1d::{AsRangedCoord, ValueFormatter};
use plotters::element::DashedPathElement;
use plotters::prelude::*;

use super::axis::Axis;
use super::{Chart, FONT, GREY, PALETTE, Series, Shape};
use crate::error::{Error, Result};

/// Where it is drawn.
pub type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
/// What plotters says when it draws.
pub type Drawn<T = ()> = std::result::Result<T, Box<dyn std::error::Error>>;

/// A white area of this width and height in pixels.
pub fn canvas(svg: &mut String, size: (u32, u32)) -> Result<Area<'_>> {
    let area = SVGBackend::with_string(svg, size).into_drawing_area();
    area.fill(&WHITE).map_err(|error| failed(error.into()))?;
    Ok(area)
}

pub fn failed(error: Box<dyn std::error::Error>) -> Error {
    Error::Config(format!("chart: {error}"))
}

/// Prints an SVG as the evcxr kernel expects an image.
pub fn display(svg: Result<String>) {
    match svg {
        Ok(svg) => println!("EVCXR_BEGIN_CONTENT image/svg+xml\n{svg}\nEVCXR_END_CONTENT"),
        Err(error) => println!("{error}"),
    }
}

/// Sizes in pixels.
pub struct Frame {
    title: u32,
    margin: u32,
    margin_right: u32,
    x_labels: u32,
    /// With a name at the axis, and without.
    y_labels: [u32; 2],
}

impl Frame {
    /// Of a chart that is a figure of its own.
    pub const ALONE: Self = Self { title: 17, margin: 12, margin_right: 24, x_labels: 42, y_labels: [62, 62] };
    /// Of one of several.
    pub const PANEL: Self = Self { title: 15, margin: 8, margin_right: 8, x_labels: 40, y_labels: [62, 50] };
}

impl Chart {
    pub(super) fn draw<X, Y>(&self, area: &Area, frame: &Frame, axes: [Axis; 2], x: X, y: Y) -> Drawn
    where
        X: AsRangedCoord<Value = f64>,
        Y: AsRangedCoord<Value = f64>,
        X::CoordDescType: ValueFormatter<f64>,
        Y::CoordDescType: ValueFormatter<f64>,
    {
        let mut builder = ChartBuilder::on(area);
        if !self.title.is_empty() {
            builder.caption(&self.title, (FONT, frame.title));
        }
        let mut chart = builder
            .margin(frame.margin)
            .margin_right(frame.margin_right)
            .x_label_area_size(frame.x_labels)
            .y_label_area_size(self.y_label_area(frame))
            .build_cartesian_2d(x, y)?;
        chart
            .configure_mesh()
            .max_light_lines(0)
            .bold_line_style(GREY.mix(0.2))
            .axis_style(GREY)
            .x_desc(&self.x_label)
            .y_desc(&self.y_label)
            .x_labels(self.x_ticks.count)
            .y_labels(self.y_ticks.count)
            .x_label_formatter(&|x| self.x_ticks.label(axes[0], *x))
            .y_label_formatter(&|y| {
                self.rows.get(y.round() as usize).cloned().unwrap_or_else(|| self.y_ticks.label(axes[1], *y))
            })
            .label_style((FONT, 14))
            .draw()?;
        let place = |(x, y): (f64, f64)| (axes[0].near(x), axes[1].near(y));
        if let Some(mark) = self.mark.filter(|mark| mark.is_finite()) {
            let ends = [axes[0].low, axes[0].high].map(|x| place((x, mark)));
            chart.draw_series(DashedLineSeries::new(ends, 7, 5, GREY.stroke_width(1)))?;
        }
        let mut colours = PALETTE.into_iter().cycle();
        let mut colour = PALETTE[0];
        for Series { name, shape, points, colour: own } in &self.series {
            if let Some(own) = own {
                colour = *own;
            } else if *shape != Shape::Band {
                colour = colours.next().expect("colours without end");
            }
            let points: Vec<(f64, f64)> = points.iter().copied().filter(|point| self.shows(point)).map(place).collect();
            let line = colour.stroke_width(if *shape == Shape::Dashed { 2 } else { 3 });
            let series = match shape {
                Shape::Line => chart.draw_series(LineSeries::new(points, line))?,
                Shape::Thin => chart.draw_series(LineSeries::new(points, colour.mix(0.5).stroke_width(1)))?,
                Shape::Dashed => chart.draw_series(DashedLineSeries::new(points, 7, 5, line))?,
                Shape::Points => {
                    chart.draw_series(points.into_iter().map(|p| Circle::new(p, 3, colour.mix(0.7).filled())))?
                }
                Shape::Dots => chart.draw_series(points.into_iter().map(|p| Circle::new(p, 6, colour.filled())))?,
                Shape::Band => chart.draw_series([Polygon::new(points, colour.mix(0.2))])?,
            };
            if !name.is_empty() {
                // A short piece of the line, or one point, for the legend.
                let series = series.label(name);
                match shape {
                    Shape::Dashed => {
                        series.legend(move |(x, y)| DashedPathElement::new([(x, y), (x + 22, y)], 5, 3, line))
                    }
                    Shape::Points | Shape::Dots => {
                        series.legend(move |(x, y)| Circle::new((x + 11, y), 3, line.filled()))
                    }
                    Shape::Line | Shape::Thin | Shape::Band => {
                        series.legend(move |(x, y)| PathElement::new([(x, y), (x + 22, y)], line))
                    }
                };
            }
        }
        let names = self.series.iter().filter(|series| !series.name.is_empty()).count();
        if names > 1 || (names == 1 && self.legend.is_some()) {
            chart
                .configure_series_labels()
                .position(self.legend.clone().unwrap_or_else(|| self.emptiest_corner(axes)))
                .background_style(WHITE.mix(0.85))
                .border_style(GREY.mix(0.4))
                .label_font((FONT, 14))
                .draw()?;
        }
        Ok(())
    }

    /// Wide enough for the labels of the y axis.
    fn y_label_area(&self, frame: &Frame) -> u32 {
        let longest = self.rows.iter().map(|name| name.chars().count()).max().unwrap_or(0) as u32;
        frame.y_labels[usize::from(self.y_label.is_empty())].max(9 * longest.min(20) + 12)
    }

    /// The corner in which the legend hides the fewest points.
    fn emptiest_corner(&self, [x, y]: [Axis; 2]) -> SeriesLabelPosition {
        let corners = [
            (SeriesLabelPosition::UpperRight, true, true),
            (SeriesLabelPosition::LowerRight, true, false),
            (SeriesLabelPosition::UpperLeft, false, true),
            (SeriesLabelPosition::LowerLeft, false, false),
        ];
        let points = || self.series.iter().flat_map(|series| &series.points).filter(|point| self.shows(point));
        let inside = |right: bool, up: bool| {
            points().filter(|&&(px, py)| x.is_upper(px) == right && y.is_upper(py) == up).count()
        };
        let best = corners.into_iter().min_by_key(|(_, right, up)| inside(*right, *up));
        best.expect("four corners").0
    }
}

/// A number as a power of ten, with up to three digits.
pub fn scientific(x: f64) -> String {
    let rounded: f64 = format!("{x:.2e}").parse().expect("a number that was just written");
    format!("{rounded:e}")
}

/// A number with up to four decimals, without trailing zeros; a very large one in powers of ten.
pub fn plain(x: f64) -> String {
    if x.abs() >= 1e9 {
        return format!("{x:.2e}");
    }
    let text = format!("{x:.4}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".into() } else { text.into() }
}
