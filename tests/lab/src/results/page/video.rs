//! The page's section on video: curves of FLIP over latency and over rate, tables, and a sentence wherever video is closer.
//!
//! Groups of comparisons enter, HTML leaves.

use super::html::{folded, markdown, paragraph};
use super::plot::{Plot, Series, legend};
use super::versus::{ATLAS, Group, Method, Point, Setting};
use crate::report::page::escaped;
use crate::results::figures;
use std::fmt::Write;

/// One way, milliseconds: up to here a picture is hardly out of date when it is shown.
const SHORT_MS: f64 = 50.0;

/// Names of methods in all groups, ours first: the place is the look of a curve.
pub(super) fn names(groups: &[Group]) -> Vec<String> {
    let mut names = vec![ATLAS.to_owned()];
    for method in groups.iter().flat_map(|group| &group.points).flat_map(|point| &point.methods) {
        if !names.contains(&method.name) {
            names.push(method.name.clone());
        }
    }
    names
}

/// The whole section.
///
/// # Errors
/// A curve cannot be drawn.
pub(super) fn section(groups: &[Group]) -> anyhow::Result<String> {
    if groups.is_empty() {
        return Ok(paragraph(figures::NOT_MEASURED.trim()));
    }
    let names = names(groups);
    let mut out = paragraph(
        "FLIP is the error that an eye sees when it flips between picture and truth: 0 is none, lower is better. All methods have the same scene, \
         head and link, and as many bits. The atlas as in the paper also sends its predicted positions, which take what they need. Of videos \
         with the same abilities the best setting counts.",
    );
    out += "<div class=\"plots\">\n";
    for group in groups {
        out += &over_latency(group, &names)?;
    }
    out += "</div>\n";
    let over_rate = over_rate(groups, &names)?;
    if !over_rate.is_empty() {
        out += &folded("FLIP over rate", &format!("<div class=\"plots\">\n{over_rate}</div>\n"));
    }
    for group in groups {
        let title = group.setting.title();
        let _ = writeln!(out, "<h3>{}</h3>", escaped(&title));
        out += &markdown(&format!("FLIP of {title}"), &table(group));
        out += &losses(group);
        out += &folded("All measures", &markdown(&format!("All measures of {title}"), &details(group)));
    }
    Ok(out)
}

fn figure(caption: &str, plot: &Plot, names: &[String]) -> anyhow::Result<String> {
    let looks: Vec<(usize, &str)> =
        plot.series.iter().map(|series| (series.look, names[series.look].as_str())).collect();
    Ok(format!(
        "<figure>{}{}<figcaption>{}</figcaption></figure>\n",
        plot.svg()?,
        legend(looks.into_iter()),
        escaped(caption)
    ))
}

/// A curve for each method: FLIP over what `x` says of a point.
fn series<'a>(names: &[String], points: impl Iterator<Item = (f64, &'a Point)> + Clone) -> Vec<Series> {
    let curve = |(look, name): (usize, &String)| {
        let found = points.clone().filter_map(|(x, point)| Some((x, of(point, name)?.flip)));
        Series { look, points: found.collect() }
    };
    names.iter().enumerate().map(curve).filter(|series| !series.points.is_empty()).collect()
}

fn of<'a>(point: &'a Point, name: &str) -> Option<&'a Method> {
    point.methods.iter().find(|method| method.name == name)
}

fn over_latency(group: &Group, names: &[String]) -> anyhow::Result<String> {
    let title = group.setting.title();
    // A logarithm has no zero.
    let series = series(names, group.points.iter().map(|point| (point.latency_ms.max(0.1), point)));
    let label = format!("FLIP over latency, {title}");
    let plot = Plot { label: &label, x: "latency one way, ms", y: "FLIP", series: &series };
    figure(&format!("{title}: FLIP over latency. Lower is better."), &plot, names)
}

/// A plot for each link over which a scene was measured at several rates.
fn over_rate(groups: &[Group], names: &[String]) -> anyhow::Result<String> {
    let without_rate = |group: &Group| Setting { rate_mbit: None, ..group.setting.clone() };
    let mut kinds: Vec<(Setting, f64)> = Vec::new();
    for group in groups.iter().filter(|group| group.setting.rate_mbit.is_some()) {
        for point in &group.points {
            let kind = (without_rate(group), point.latency_ms);
            if !kinds.contains(&kind) {
                kinds.push(kind);
            }
        }
    }
    let mut out = String::new();
    for (setting, latency_ms) in kinds {
        let alike = groups.iter().filter(|group| without_rate(group) == setting);
        let rated = alike.filter_map(|group| Some((group.setting.rate_mbit?, group)));
        let mut points: Vec<(f64, &Point)> = rated
            .flat_map(|(rate, group)| group.points.iter().map(move |point| (rate, point)))
            .filter(|(_, point)| point.latency_ms == latency_ms)
            .collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        if points.len() < 2 {
            continue;
        }
        let caption =
            format!("{}: FLIP over rate at {latency_ms} ms one way. Lower is better.", setting.title());
        let series = series(names, points.iter().copied());
        let label = format!("FLIP over rate, {} at {latency_ms} ms", setting.title());
        let plot = Plot { label: &label, x: "rate, Mbit/s", y: "FLIP", series: &series };
        out += &figure(&caption, &plot, names)?;
    }
    Ok(out)
}

fn table(group: &Group) -> String {
    let names = names(std::slice::from_ref(group));
    let heads: Vec<&str> = std::iter::once("latency one way")
        .chain(names.iter().map(String::as_str))
        .chain(["atlas over best video", "closer to the truth"])
        .collect();
    let row = |point: &Point| {
        let flip = |name: &String| {
            of(point, name).map_or_else(|| "-".into(), |method| format!("{:.4}", method.flip))
        };
        let ratio = point.ratio();
        let closer = match ratio {
            Some(ratio) if ratio < 1.0 => "atlas",
            Some(_) => "video",
            None => "-",
        };
        let first = [format!("{} ms", point.latency_ms)];
        let last = [ratio.map_or_else(|| "-".into(), |ratio| format!("{ratio:.2}x")), closer.to_owned()];
        first.into_iter().chain(names.iter().map(flip)).chain(last).collect()
    };
    figures::markdown(&heads, group.points.iter().map(row))
}

fn details(group: &Group) -> String {
    let heads = ["latency", "method", "FLIP", "of animated", "flicker", "PSNR, worst", "Mbit/s", "quantiser"];
    let or_not = |value: Option<f64>, decimals: usize| {
        value.map_or_else(|| "-".to_owned(), |value| format!("{value:.decimals$}"))
    };
    let row = |(point, method): (&Point, &Method)| {
        vec![
            format!("{} ms", point.latency_ms),
            method.name.clone(),
            format!("{:.4}", method.flip),
            or_not(method.animated_flip, 4),
            or_not(method.flicker, 4),
            format!("{:.1}, {:.1} dB", method.psnr_db[0], method.psnr_db[1]),
            format!("{:.2}", method.mbit_per_s),
            or_not(method.qp, 1),
        ]
    };
    let rows = group.points.iter().flat_map(|point| point.methods.iter().map(move |method| (point, method)));
    figures::markdown(&heads, rows.map(row))
}

/// A sentence for each comparison in which video is closer.
fn losses(group: &Group) -> String {
    let lost = group.points.iter().filter(|point| point.ratio().is_some_and(|ratio| ratio >= 1.0));
    let sentence = |point: &Point| {
        let (ours, video) = point.rivals()?;
        Some(paragraph(&format!(
            "At {} ms video is closer: {} has a FLIP of {:.4}, the atlas {:.4}. {}",
            point.latency_ms,
            video.name,
            video.flip,
            ours.flip,
            reason(point)
        )))
    };
    lost.filter_map(sentence).collect()
}

/// Why video is closer in a comparison.
pub(super) fn reason(point: &Point) -> String {
    let age = if point.latency_ms <= SHORT_MS {
        "At this delay a picture that is turned to the head is hardly out of date. "
    } else {
        ""
    };
    let quantisers = point.rivals().and_then(|(ours, video)| Some((ours.qp?, video.qp?)));
    let bits = match quantisers {
        Some((ours, video)) if video < ours => {
            format!(
                " The same bits quantise it with {video:.0}, the atlas with {ours:.0}; higher is coarser."
            )
        }
        _ => String::new(),
    };
    format!(
        "{age}Video spends its bits on pixels in view, the atlas on all surfaces that may come into view.{bits}"
    )
}

#[cfg(test)]
mod tests {
    use super::super::versus::groups;
    use super::super::versus::tests::record;
    use super::*;

    #[test]
    fn video_is_named_where_it_is_closer() {
        let records =
            [("quality-a", record(5.0, 6.0, 0.08, 0.07)), ("quality-b", record(110.0, 6.0, 0.07, 0.1))];
        let groups =
            groups(&records.map(|(name, record)| (name.to_owned(), record)).into()).expect("comparisons");
        let html = section(&groups).expect("a section");
        for part in [
            "At 5 ms video is closer: video with depth has a FLIP of 0.0700, the atlas 0.0800.",
            "quantise it with 24, the atlas with 31",
            "hardly out of date",
            "<td>0.70x</td><td>atlas</td>",
            "<td>1.14x</td><td>video</td>",
        ] {
            assert!(html.contains(part), "{part} is missing in {html}");
        }
        assert_eq!(html.matches("is closer: ").count(), 1);
        assert_eq!(html.matches("class=\"plot\"").count(), 1, "one rate: no curve over rates");
    }

    #[test]
    fn two_rates_make_a_curve_over_rate() {
        let records =
            [("quality-a", record(20.0, 6.0, 0.06, 0.07)), ("quality-b", record(20.0, 12.0, 0.05, 0.06))];
        let groups =
            groups(&records.map(|(name, record)| (name.to_owned(), record)).into()).expect("comparisons");
        let html = section(&groups).expect("a section");
        assert_eq!(html.matches("class=\"plot\"").count(), 3, "{html}");
        assert!(html.contains("FLIP over rate at 20 ms one way"), "{html}");
    }

    #[test]
    fn without_records_nothing_is_claimed() {
        assert_eq!(section(&[]).expect("a section"), "<p>Not measured yet.</p>\n");
    }
}
