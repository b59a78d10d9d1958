use super::draw::{self, Drawn, Frame};
use super::{Chart, FONT};
use crate::error::Result;

/// Charts side by side under one title.
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

    /// Adds a chart to the right of the others.
    pub fn panel(mut self, chart: Chart) -> Self {
        self.charts.push(chart);
        self
    }

    /// Draws the charts and returns them as one SVG, 820 by 440 pixels.
    ///
    /// # Errors
    /// If there is nothing to draw in one of them.
    pub fn svg(&self) -> Result<String> {
        let mut svg = String::new();
        let area = draw::canvas(&mut svg, (820, 440))?;
        let body = || -> Drawn<_> {
            let body = area.margin(14, 10, 10, 10);
            Ok(if self.title.is_empty() { body } else { body.titled(&self.title, (FONT, 20))? })
        };
        let body = body().map_err(draw::failed)?;
        for (area, chart) in body.split_evenly((1, self.charts.len().max(1))).iter().zip(&self.charts) {
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
