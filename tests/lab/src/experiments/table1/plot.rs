//! The table as SVG pictures, from its JSON: rates over dragons (the paper's Figure 4, with the paper's curves beside ours),
//! and costs of an update over dragons, with the fitted exponents.

use super::cell::{Column, Mode, Set};
use super::paper::PAPER;
use super::report::word;
use anyhow::{Context, ensure};
use serde_json::Value;
use std::fmt::Write;

const EXTENT: [f64; 2] = [860.0, 420.0];
/// The plot's left, right, top and bottom within it.
const PLOT: [f64; 4] = [70.0, 560.0, 20.0, 365.0];
/// Where curves are named.
const LEGEND_X: f64 = 580.0;

const COLOURS: [&str; 3] = ["#7f8c8d", "#1f6fb2", "#c0392b"];

/// Numbers over dragons.
struct Curve {
    name: String,
    colour: &'static str,
    /// As SVG has it; empty: a line.
    dashes: &'static str,
    points: Vec<(f64, f64)>,
}

/// The paper's Figure 4: rates of both in the three columns, ours as lines, the paper's dashed.
///
/// # Errors
/// The JSON is of something else.
pub fn rates(table: &Value) -> anyhow::Result<String> {
    let names = ["without animation", "time stands still", "animated"];
    let columns = [Column::Off, Column::Static, Column::Animated];
    let mut curves = Vec::new();
    for (side, dashes) in [("server", ""), ("client", "2 3")] {
        for ((column, name), colour) in columns.into_iter().zip(names).zip(COLOURS) {
            curves.push(Curve {
                name: format!("{side}, {name}"),
                colour,
                dashes,
                points: points(table, (Set::Paper, Mode::Ours, column), &format!("{side}_fps"))?,
            });
        }
    }
    for (place, side) in ["server", "client"].into_iter().enumerate() {
        let of = |row: &super::paper::PaperRow| (f64::from(row.dragons), row.fps(Column::Animated)[place]);
        curves.push(Curve {
            name: format!("the paper's {side}, animated"),
            colour: ["#d68910", "#b7950b"][place],
            dashes: "8 4",
            points: PAPER.iter().map(of).collect(),
        });
    }
    draw(&curves, &format!("dragons in view; up: a second, each by itself ({})", place_of(table)))
}

/// What an update takes over dragons, all in flight.
///
/// # Errors
/// The JSON is of something else.
pub fn costs(table: &Value) -> anyhow::Result<String> {
    let ways = [
        ("full detail", Set::Paper, Mode::Ours, "full_detail", COLOURS[1]),
        ("levels of detail, reuse", Set::Shipped, Mode::Ours, "shipped", "#27ae60"),
        ("the paper's ways", Set::Paper, Mode::AsPaper, "as_paper", COLOURS[2]),
    ];
    let mut curves = Vec::new();
    for (name, set, mode, growth, colour) in ways {
        let points = points(table, (set, mode, Column::Animated), "update_ms")?;
        let power = table["growth"][growth].as_f64();
        let power = power.map_or(String::new(), |power| format!(": power {power:.2}"));
        curves.push(Curve { name: format!("{name}{power}"), colour, dashes: "", points });
    }
    draw(&curves, &format!("dragons in view; up: milliseconds an update ({})", place_of(table)))
}

fn place_of(table: &Value) -> String {
    let device = table["device"].as_str().unwrap_or("?").replace('&', "and").replace('<', "");
    format!("{device}, scale {}", table["scale"])
}

fn points(table: &Value, of: (Set, Mode, Column), key: &str) -> anyhow::Result<Vec<(f64, f64)>> {
    let rows = table["rows"].as_array().context("a table has rows")?;
    let is_of = |row: &&Value| {
        [("set", word(of.0)), ("mode", word(of.1)), ("column", word(of.2))]
            .iter()
            .all(|(key, value)| row[*key].as_str() == Some(value.as_str()))
    };
    let point = |row: &Value| -> anyhow::Result<(f64, f64)> {
        let number = |key: &str| row[key].as_f64().with_context(|| format!("a row has no number {key}"));
        Ok((number("dragons")?, number(key)?))
    };
    rows.iter().filter(is_of).map(point).collect()
}

/// Ends of an axis, and what is written beside it.
struct Axis {
    ends: [f64; 2],
    ticks: Vec<f64>,
}

impl Axis {
    /// From one power of ten to another, around all values.
    fn powers(values: impl Iterator<Item = f64> + Clone) -> Self {
        let least = values.clone().fold(f64::INFINITY, f64::min).log10().floor() as i32;
        let most = (values.fold(0.0, f64::max).log10().ceil() as i32).max(least + 1);
        let ticks: Vec<f64> = (least..=most).map(|power| 10f64.powi(power)).collect();
        Self { ends: [10f64.powi(least), 10f64.powi(most)], ticks }
    }

    /// Around the numbers themselves, which are its ticks.
    fn numbers(values: impl Iterator<Item = f64>) -> Self {
        let mut ticks: Vec<f64> = values.collect();
        ticks.sort_by(f64::total_cmp);
        ticks.dedup();
        Self { ends: [ticks[0] / 1.2, ticks[ticks.len() - 1] * 1.2], ticks }
    }

    /// Where a value lies between the ends, by its logarithm.
    fn share(&self, value: f64) -> f64 {
        let [low, high] = self.ends;
        (value / low).ln() / (high / low).ln()
    }

    fn x(&self, value: f64) -> f64 {
        PLOT[0] + (PLOT[1] - PLOT[0]) * self.share(value)
    }

    fn y(&self, value: f64) -> f64 {
        PLOT[3] - (PLOT[3] - PLOT[2]) * self.share(value)
    }
}

fn draw(curves: &[Curve], caption: &str) -> anyhow::Result<String> {
    let all = || curves.iter().flat_map(|curve| curve.points.iter().copied());
    ensure!(all().next().is_some(), "the table has no rows to draw");
    ensure!(all().all(|(x, y)| x > 0.0 && y > 0.0 && y.is_finite()), "a rate or a cost is not above 0");
    let (x, y) = (Axis::numbers(all().map(|point| point.0)), Axis::powers(all().map(|point| point.1)));
    let [width, height] = EXTENT;
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\" font-size=\"12\"><rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n"
    );
    grid(&mut out, &x, &y)?;
    for (index, curve) in curves.iter().filter(|curve| !curve.points.is_empty()).enumerate() {
        let Curve { name, colour, dashes, points } = curve;
        let line: Vec<String> =
            points.iter().map(|point| format!("{:.1},{:.1}", x.x(point.0), y.y(point.1))).collect();
        writeln!(
            out,
            "<polyline fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\" stroke-dasharray=\"{dashes}\" points=\"{}\"/>",
            line.join(" ")
        )?;
        for point in points {
            let (x, y) = (x.x(point.0), y.y(point.1));
            writeln!(out, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3\" fill=\"{colour}\"/>")?;
        }
        let at = PLOT[2] + 14.0 + 20.0 * index as f64;
        writeln!(
            out,
            "<line x1=\"{LEGEND_X}\" x2=\"{}\" y1=\"{at}\" y2=\"{at}\" stroke=\"{colour}\" stroke-width=\"2\" stroke-dasharray=\"{dashes}\"/><text x=\"{}\" y=\"{}\">{name}</text>",
            LEGEND_X + 30.0,
            LEGEND_X + 38.0,
            at + 4.0
        )?;
    }
    let middle = (PLOT[0] + PLOT[1]) * 0.5;
    writeln!(
        out,
        "<text x=\"{middle}\" y=\"{}\" text-anchor=\"middle\">{caption}</text></svg>",
        height - 12.0
    )?;
    Ok(out)
}

fn grid(out: &mut String, x: &Axis, y: &Axis) -> std::fmt::Result {
    let [left, right, top, bottom] = PLOT;
    for tick in &y.ticks {
        let at = y.y(*tick);
        writeln!(
            out,
            "<line x1=\"{left}\" x2=\"{right}\" y1=\"{at:.1}\" y2=\"{at:.1}\" stroke=\"#ddd\"/><text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{tick}</text>",
            left - 6.0,
            at + 4.0
        )?;
    }
    for tick in &x.ticks {
        let at = x.x(*tick);
        writeln!(
            out,
            "<line x1=\"{at:.1}\" x2=\"{at:.1}\" y1=\"{top}\" y2=\"{bottom}\" stroke=\"#ddd\"/><text x=\"{at:.1}\" y=\"{}\" text-anchor=\"middle\">{tick}</text>",
            bottom + 16.0
        )?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiments::table1::report::tests::report;
    use serde_json::json;

    #[test]
    fn every_curve_is_drawn_inside_the_plot_and_named() {
        let table = serde_json::to_value(report()).expect("JSON");
        for (svg, curves) in [(rates(&table).expect("a picture"), 8), (costs(&table).expect("a picture"), 3)]
        {
            assert_eq!(svg.matches("<polyline").count(), curves, "{svg}");
            assert!(svg.ends_with("</svg>\n") && svg.contains("a device, scale 0.5"), "{svg}");
            for circle in svg.split("<circle ").skip(1) {
                let number = |name: &str| -> f64 {
                    let rest = circle.split(&format!("{name}=\"")).nth(1).expect("it is there");
                    rest.split('"').next().expect("a number").parse().expect("a number")
                };
                let (x, y) = (number("cx"), number("cy"));
                assert!((PLOT[0]..=PLOT[1]).contains(&x) && (PLOT[2]..=PLOT[3]).contains(&y), "{circle}");
            }
        }
        assert!(costs(&table).expect("a picture").contains("levels of detail, reuse: power 0.50"));
    }

    #[test]
    fn more_is_higher_and_more_dragons_are_farther_right() {
        let (x, y) = (Axis::numbers([9.0, 169.0].into_iter()), Axis::powers([0.3, 400.0].into_iter()));
        assert_eq!(y.ends, [0.1, 1000.0]);
        assert!(x.x(169.0) > x.x(9.0) && y.y(400.0) < y.y(0.3));
    }

    #[test]
    fn what_is_no_table_is_refused() {
        assert!(rates(&json!({})).is_err() && costs(&json!({"rows": []})).is_err());
        assert!(rates(&json!({"rows": [{"set": "paper", "mode": "ours", "column": "off"}]})).is_err());
        let zero =
            json!({"set": "paper", "mode": "ours", "column": "animated", "dragons": 9, "update_ms": 0.0});
        assert!(costs(&json!({"rows": [zero]})).is_err());
    }
}
