//! Error against bytes of keys, as a picture: the curves of `inspect error --curve`.

use anyhow::{Context, ensure};
use serde_json::Value;
use std::fmt::Write;

const EXTENT: [f64; 2] = [640.0, 360.0];
/// The plot's left, right, top and bottom within it.
const PLOT: [f64; 4] = [70.0, 620.0, 20.0, 310.0];
/// Bytes at its left and right.
const BYTES: [f64; 2] = [25e3, 1.2e6];
/// Millimetres at its bottom and top.
const MM: [f64; 2] = [0.005, 1000.0];
const GRID_MM: [f64; 6] = [0.01, 0.1, 1.0, 10.0, 100.0, 1000.0];
const GRID_KB: [f64; 4] = [30.0, 100.0, 300.0, 1000.0];

/// A way of sampling, its colour, and on which side of its points their names stand.
struct Curve {
    key: &'static str,
    name: &'static str,
    colour: &'static str,
    beside: f64,
    anchor: &'static str,
}

const CURVES: [Curve; 2] = [
    Curve { key: "constant", name: "constant interval", colour: "#c0392b", beside: 6.0, anchor: "start" },
    Curve { key: "bounded", name: "error-bounded", colour: "#1f6fb2", beside: -7.0, anchor: "end" },
];

/// The picture, as SVG, of what `inspect error --curve --json` said of a model's first clip.
///
/// # Errors
/// The text is something else.
pub fn svg(inspected: &Value) -> anyhow::Result<String> {
    let curve = &inspected["clips"][0]["curve"];
    let [width, height] = EXTENT;
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\" font-size=\"12\"><rect width=\"{width}\" height=\"{height}\" fill=\"white\"/>\n"
    );
    grid(&mut out)?;
    for (index, way) in CURVES.iter().enumerate() {
        draw(&mut out, way, &curve[way.key])?;
        let y = 36 + 16 * index;
        writeln!(
            out,
            "<text x=\"612\" y=\"{y}\" text-anchor=\"end\" fill=\"{}\">{}</text>",
            way.colour, way.name
        )?;
    }
    let clip = &inspected["clips"][0];
    writeln!(
        out,
        "<text x=\"345\" y=\"348\" text-anchor=\"middle\">bytes of keys ({}, {} s); up: error of the worst vertex; large dots: where the curve bends</text></svg>",
        clip["model"].as_str().unwrap_or("a model"),
        clip["duration_s"]
    )?;
    Ok(out)
}

fn grid(out: &mut String) -> std::fmt::Result {
    let [left, right, top, bottom] = PLOT;
    for mm in GRID_MM {
        let y = y_of(mm);
        writeln!(
            out,
            "<line x1=\"{left}\" x2=\"{right}\" y1=\"{y:.1}\" y2=\"{y:.1}\" stroke=\"#ddd\"/><text x=\"64\" y=\"{:.1}\" text-anchor=\"end\">{mm} mm</text>",
            y + 4.0
        )?;
    }
    for kb in GRID_KB {
        let x = x_of(kb * 1e3);
        writeln!(
            out,
            "<line x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"{top}\" y2=\"{bottom}\" stroke=\"#ddd\"/><text x=\"{x:.1}\" y=\"326\" text-anchor=\"middle\">{kb} kB</text>"
        )?;
    }
    Ok(())
}

fn draw(out: &mut String, way: &Curve, points: &Value) -> anyhow::Result<()> {
    let points =
        points.as_array().with_context(|| format!("no curve \"{}\": use inspect error --curve", way.key))?;
    let places: Vec<[f64; 2]> = points.iter().map(place).collect::<anyhow::Result<_>>()?;
    ensure!(!places.is_empty(), "the curve \"{}\" is empty", way.key);
    let line: Vec<String> = places.iter().map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
    let colour = way.colour;
    writeln!(
        out,
        "<polyline fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\" points=\"{}\"/>",
        line.join(" ")
    )?;
    for (point, [x, y]) in points.iter().zip(places) {
        let radius = if point["bends_here"] == true { 6 } else { 3 };
        let below = if way.beside < 0.0 { 12.0 } else { -6.0 };
        let name = point["sampling"].as_str().unwrap_or("");
        let name = name.split(':').nth(1).and_then(|name| name.split(',').next()).unwrap_or(name);
        writeln!(out, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\" fill=\"{colour}\"/>")?;
        writeln!(
            out,
            "<text x=\"{:.1}\" y=\"{:.1}\" fill=\"{colour}\" font-size=\"10\" text-anchor=\"{}\">{name}</text>",
            x + way.beside,
            y + below,
            way.anchor
        )?;
    }
    Ok(())
}

fn place(point: &Value) -> anyhow::Result<[f64; 2]> {
    let bytes = point["bytes"].as_f64().context("a point of the curve has no bytes")?;
    let mm = point["table"]["vertices"]["max_mm"].as_f64().context("a point of the curve has no error")?;
    Ok([x_of(bytes), y_of(mm)])
}

fn x_of(bytes: f64) -> f64 {
    let [left, right, ..] = PLOT;
    left + (right - left) * share(bytes, BYTES)
}

fn y_of(mm: f64) -> f64 {
    let [.., top, bottom] = PLOT;
    bottom - (bottom - top) * share(mm, MM)
}

/// Where a value lies between two ends, by its logarithm, kept inside.
fn share(value: f64, [low, high]: [f64; 2]) -> f64 {
    ((value.max(low) / low).ln() / (high / low).ln()).min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn points_stand_where_their_bytes_and_errors_are() {
        let point = |bytes: f64, mm: f64, bends: bool| {
            json!({"bytes": bytes, "bends_here": bends, "sampling": "error-bounded:1mm,100%",
                "table": {"vertices": {"max_mm": mm}}})
        };
        let inspected = json!({"clips": [{"model": "a dragon", "duration_s": 4.0, "curve": {
            "constant": [point(30e3, 1000.0, false)], "bounded": [point(1e9, 0.0, true)]
        }}]});
        let svg = svg(&inspected).expect("a picture");
        assert!(
            svg.contains("cx=\"95.9\" cy=\"20.0\" r=\"3\"")
                && svg.contains("cx=\"620.0\" cy=\"310.0\" r=\"6\""),
            "{svg}"
        );
        assert!(svg.contains(">1mm</text>") && svg.trim_end().ends_with("</svg>"), "{svg}");
        assert!(super::svg(&json!({"clips": []})).is_err());
    }
}
