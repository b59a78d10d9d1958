use super::draw::{self, Drawn, Frame};
use super::{Chart, FONT};
use crate::error::Result;

/// How many charts a row has at most.
const COLUMNS: usize = 3;

/// Charts under one title: up to three side by side, more in rows.
#[derive(Clone, Debug, Default)]
pub struct Panels {
    title: String,
    charts: Vec<Chart>,
}

impl Panels {
    /// No charts yet. An empty title takes no space.
    pub fn new(title: &str) -> Self {
        Self { title: title.into(), charts: Vec::new() }
    }

    /// Adds a chart after the others.
    pub fn panel(mut self, chart: Chart) -> Self {
        self.charts.push(chart);
        self
    }

    /// Draws the charts and returns them as one SVG: 820 by 440 pixels, or 280 pixels for each of several rows.
    ///
    /// # Errors
    /// If there is nothing to draw in one of them.
    pub fn svg(&self) -> Result<String> {
        let rows = self.charts.len().div_ceil(COLUMNS).max(1);
        let columns = self.charts.len().div_ceil(rows).max(1);
        let height = if rows == 1 { 440 } else { 40 + 280 * rows as u32 };
        let mut svg = String::new();
        let area = draw::canvas(&mut svg, (820, height))?;
        let body = || -> Drawn<_> {
            let body = area.margin(14, 10, 10, 10);
            Ok(if self.title.is_empty() { body } else { body.titled(&self.title, (FONT, 20))? })
        };
        let body = body().map_err(draw::failed)?;
        for (area, chart) in body.split_evenly((rows, columns)).iter().zip(&self.charts) {
            chart.draw_on(area, &Frame::PANEL)?;
        }
        drop((body, area));
        Ok(svg)
    }

    /// Displays the charts in a notebook; called by the evcxr kernel.
    pub fn evcxr_display(&self) {
        draw::display(self.svg());
    }
}
