//! Curves as SVG inside the page: ink and grid have the colour of its text, and curves have colours that it can change for the
//! dark.
//!
//! Numbers enter, SVG and a legend leave. Nothing here knows their meaning.

use super::html::SVG_NAMESPACE;
use crate::report::page::escaped;
use anyhow::{Context, ensure};
use plotters::prelude::*;
use std::fmt::Write;

/// Pixels before the page scales it: wide enough for its text at a phone's width.
const EXTENT: (u32, u32) = (480, 320);
const FONT: (&str, i32) = ("sans-serif", 17);
/// Stands for the page's own colour of text.
const INK: RGBColor = RGBColor(1, 1, 1);
const INK_WRITTEN: &str = "\"#010101\"";
/// What plotters writes on every line though it says nothing.
const OPAQUE: &str = " opacity=\"1\"";
/// For people who see few colours, too (Okabe and Ito). The page's style has those of the dark.
const COLOURS: [RGBColor; 6] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(176, 128, 0),
    RGBColor(128, 128, 128),
];
/// Room above the largest value and beside the ends.
const ROOM: f64 = 1.1;

/// A curve.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Series {
    /// Which colour and mark it has.
    pub look: usize,
    /// Values over arguments, which are above 0.
    pub points: Vec<(f64, f64)>,
}

/// Curves with axes.
pub(super) struct Plot<'a> {
    /// What it shows, for who does not see it.
    pub label: &'a str,
    /// What is to the right, with its unit.
    pub x: &'a str,
    /// What is up, with its unit.
    pub y: &'a str,
    /// The curves.
    pub series: &'a [Series],
}

impl Plot<'_> {
    /// The picture.
    ///
    /// # Errors
    /// There is nothing to draw, or an argument is not above 0.
    pub(super) fn svg(&self) -> anyhow::Result<String> {
        let all = || self.series.iter().flat_map(|series| series.points.iter().copied());
        ensure!(all().next().is_some(), "{}: there is nothing to draw", self.label);
        ensure!(all().all(|(x, y)| x > 0.0 && y.is_finite()), "{}: an argument is not above 0", self.label);
        let mut ticks: Vec<f64> = all().map(|(x, _)| x).collect();
        ticks.sort_by(f64::total_cmp);
        ticks.dedup();
        let ends = (ticks[0] / ROOM)..(ticks[ticks.len() - 1] * ROOM);
        let top = all().map(|(_, y)| y).fold(0.0, f64::max).max(f64::MIN_POSITIVE) * ROOM;
        let mut svg = String::new();
        self.draw(&mut svg, ends, ticks, top).map_err(|error| anyhow::anyhow!("{}: {error}", self.label))?;
        self.fitted(&svg)
    }

    fn draw(
        &self,
        svg: &mut String,
        ends: std::ops::Range<f64>,
        ticks: Vec<f64>,
        top: f64,
    ) -> Result<(), Box<dyn std::error::Error>> {
        let area = SVGBackend::with_string(svg, EXTENT).into_drawing_area();
        let across = ends.log_scale().with_key_points(ticks);
        let mut chart = ChartBuilder::on(&area)
            .margin(10)
            .x_label_area_size(44)
            .y_label_area_size(64)
            .build_cartesian_2d(across, 0.0..top)?;
        chart
            .configure_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(INK.mix(0.2))
            .axis_style(INK)
            .label_style(FONT.into_font().color(&INK))
            .y_labels(6)
            .x_desc(self.x)
            .y_desc(self.y)
            .x_label_formatter(&|x| rounded(*x))
            .draw()?;
        for Series { look, points } in self.series {
            let colour = COLOURS[look % COLOURS.len()];
            chart.draw_series(LineSeries::new(points.iter().copied(), colour.stroke_width(2)))?;
            let style = colour.filled();
            match look % 3 {
                0 => drop(chart.draw_series(points.iter().map(|at| Circle::new(*at, 5, style)))?),
                1 => drop(chart.draw_series(points.iter().map(|at| TriangleMarker::new(*at, 6, style)))?),
                _ => drop(
                    chart.draw_series(points.iter().map(|at| Cross::new(*at, 5, colour.stroke_width(3))))?,
                ),
            }
        }
        area.present()?;
        Ok(())
    }

    /// As wide as its box, with the page's ink and a name.
    fn fitted(&self, svg: &str) -> anyhow::Result<String> {
        let (_, rest) = svg.split_once("viewBox=").context("plotters writes a viewBox")?;
        let rest =
            rest.replace(INK_WRITTEN, "\"currentColor\"").replace(SVG_NAMESPACE, "").replace(OPAQUE, "");
        Ok(format!("<svg class=\"plot\" role=\"img\" aria-label=\"{}\" viewBox={rest}", escaped(self.label)))
    }
}

/// A name of each curve beside its mark.
pub(super) fn legend<'a>(names: impl Iterator<Item = (usize, &'a str)>) -> String {
    let mut out = "<ul class=\"legend\">".to_owned();
    for (look, name) in names {
        let RGBColor(r, g, b) = COLOURS[look % COLOURS.len()];
        let colour = format!("#{r:02X}{g:02X}{b:02X}");
        let mark = match look % 3 {
            0 => format!("<circle cx=\"12\" cy=\"7\" r=\"5\" fill=\"{colour}\"/>"),
            1 => format!("<polygon points=\"12,1 17,11 7,11\" fill=\"{colour}\"/>"),
            _ => format!("<path d=\"M7,2 17,12 M17,2 7,12\" stroke=\"{colour}\" stroke-width=\"3\"/>"),
        };
        let _ = write!(
            out,
            "<li><svg width=\"24\" height=\"14\" aria-hidden=\"true\"><path d=\"M0,7 24,7\" stroke=\"{colour}\" \
             stroke-width=\"2\"/>{mark}</svg> {}</li>",
            escaped(name)
        );
    }
    out + "</ul>\n"
}

/// As few digits as say it.
fn rounded(value: f64) -> String {
    if value >= 20.0 { format!("{value:.0}") } else { format!("{}", (value * 10.0).round() / 10.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_are_drawn_in_the_pages_ink() {
        let series = [
            Series { look: 0, points: vec![(5.0, 0.05), (200.0, 0.07)] },
            Series { look: 1, points: vec![(5.0, 0.06), (200.0, 0.13)] },
        ];
        let plot = Plot { label: "FLIP < latency", x: "ms", y: "FLIP", series: &series };
        let svg = plot.svg().expect("a picture");
        assert!(
            svg.starts_with("<svg class=\"plot\" role=\"img\" aria-label=\"FLIP &lt; latency\""),
            "{svg}"
        );
        assert!(svg.contains("currentColor") && !svg.contains("#010101") && !svg.contains("http"), "{svg}");
        assert!(svg.contains("#0072B2") && svg.contains("#D55E00") && svg.trim_end().ends_with("</svg>"));
        assert_eq!(svg.matches("<circle").count(), 2, "{svg}");
    }

    #[test]
    fn what_cannot_be_drawn_is_refused() {
        let none = Plot { label: "none", x: "", y: "", series: &[] };
        assert!(none.svg().is_err());
        let series = [Series { look: 0, points: vec![(0.0, 1.0)] }];
        assert!(Plot { label: "zero", x: "", y: "", series: &series }.svg().is_err());
    }

    #[test]
    fn a_legend_has_a_mark_for_each_name() {
        let legend = legend([(0, "atlas"), (1, "video & depth")].into_iter());
        assert!(legend.contains("> atlas</li>") && legend.contains("video &amp; depth"), "{legend}");
        assert!(legend.contains("<circle") && legend.contains("<polygon"), "{legend}");
    }
}
