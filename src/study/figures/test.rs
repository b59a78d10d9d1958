use std::path::Path;

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::{Tables, methods, percent};
use crate::chart::{FONT, GREY};
use crate::error::{Error, Result};
use crate::files;

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Drawn = std::result::Result<(), Box<dyn std::error::Error>>;

/// The final test of every method on one task: success rate with its 95 % interval from the summary, and smoothness of the
/// hand if there is one.
///
/// # Errors
/// If the tables lack a column or the file cannot be written.
pub fn tests(tables: &Tables, task: &str, path: &Path) -> Result<()> {
    let mut rows = Vec::new();
    for (colour, method) in methods(tables, task)? {
        let value = |column: &str| tables.value(task, &method, column);
        let success = [value("success_low")?, value("success")?, value("success_high")?].map(|v| v.unwrap_or(0.0));
        let sparc = value("smoothness_sparc")?.filter(|sparc| sparc.is_finite());
        rows.push((colour, method, success, sparc));
    }
    let roughest = rows.iter().filter_map(|(.., sparc)| *sparc).reduce(f64::min);
    let count = rows.len();
    draw(path, |area| {
        let area = area.margin(14, 10, 10, 10).titled(&format!("{task}: final test"), (FONT, 20))?;
        let panel = |area: &Area, title: &str, left_margin: u32, from: f64, to: f64, is_share: bool| -> Drawn {
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
                .x_label_formatter(&|x| if is_share { percent(*x) } else { format!("{x:.1}") })
                .label_style((FONT, 14))
                .draw()?;
            for (i, (colour, method, [low, mid, high], sparc)) in rows.iter().enumerate() {
                let y = (count - 1 - i) as f64;
                if is_share {
                    chart.draw_series([PathElement::new([(*low, y), (*high, y)], colour.stroke_width(3))])?;
                    chart.draw_series([Circle::new((*mid, y), 6, colour.filled())])?;
                } else if let Some(sparc) = sparc {
                    chart.draw_series([Circle::new((*sparc, y), 6, colour.filled())])?;
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
        let success = |area: &Area| panel(area, "success rate, 95 % interval", 110, 0.0, 1.03, true);
        let Some(roughest) = roughest else {
            return success(&area);
        };
        let (left, right) = area.split_horizontally(470);
        success(&left)?;
        let from = 1.1 * roughest.min(-2.0);
        panel(&right, "smoothness (SPARC; minimum jerk: -1.4)", 0, from, -1.0, false)
    })
}

fn draw(path: &Path, paint: impl FnOnce(Area) -> Drawn) -> Result<()> {
    let mut svg = String::new();
    let area = SVGBackend::with_string(&mut svg, (820, 440)).into_drawing_area();
    let painted = area.fill(&WHITE).map_err(Into::into).and_then(|()| paint(area));
    painted.map_err(|problem| Error::data(path)(format!("cannot be drawn: {problem}")))?;
    files::write(path, svg.as_bytes())
}
