//! Sections of the page other than video: the paper's table, motion, links, pictures, bits by cause, memory, bars.
//!
//! Committed records enter, HTML leaves. Tables of the documents are theirs.

use super::html::{SVG_NAMESPACE, folded, inline, markdown, paragraph, scrolling};
use super::provenance::Committed;
use crate::experiments::table1::plot;
use crate::report::page::escaped;
use crate::results::bars::{Report, Verdict, short};
use crate::results::figures::{self, PICTURES, cell_of};
use serde_json::Value;
use std::fmt::Write;

/// Streams whose bits are shown by cause, and what people call them.
const STREAMS: [(&str, &str); 2] = [("stream_20_ms", "20 ms"), ("stream_110_ms", "110 ms")];

/// A table of the documents.
fn of_documents(name: &str, label: &str, committed: &Committed) -> anyhow::Result<String> {
    Ok(markdown(label, &figures::table(name, &committed.folder)?))
}

/// The paper's Table 1 and Figure 4.
pub(super) fn table1(committed: &Committed) -> anyhow::Result<String> {
    let Some(table) = committed.record("table1") else { return Ok(paragraph(figures::NOT_MEASURED.trim())) };
    let device = table["device"].as_str().unwrap_or("a device that is not recorded");
    let faster = cell_of("{worst.animation_geometry_speedup,1,0}", table);
    let mut out = paragraph(&format!(
        "The paper's rates are those of its GPU and headset, ours those of {device}: compare how they fall with more dragons, and the \
         paper's ways with ours on one device. Our animation and geometry take a {faster}th of the paper's, at worst."
    ));
    for (svg, caption) in [
        (plot::rates(table)?, "Figure 4: updates and frames a second over dragons, with the paper's"),
        (plot::costs(table)?, "What an update takes over dragons"),
    ] {
        let svg = svg.replacen(SVG_NAMESPACE, "", 1);
        let named = format!("<svg class=\"drawn\" role=\"img\" aria-label=\"{}\"", escaped(caption));
        let svg = svg.replacen("<svg", &named, 1);
        let _ = writeln!(
            out,
            "<figure>{}<figcaption>{}</figcaption></figure>",
            scrolling(caption, &svg),
            escaped(caption)
        );
    }
    out += &of_documents("table1", "Table 1, our ways, full detail", committed)?;
    out += &of_documents("table1-growth", "How the cost grows, and the paper's ways over ours", committed)?;
    let more = of_documents("table1-as-paper", "Table 1, the paper's ways", committed)?
        + &of_documents("table1-shipped", "Table 1 with levels of detail and reuse, as it ships", committed)?
        + &of_documents("table1-stages", "Where the time goes", committed)?;
    Ok(out + &folded("The paper's ways, the shipped settings, and stages", &more))
}

/// How exactly vertices move.
pub(super) fn motion(committed: &Committed) -> String {
    let scenes = committed.names("motion-auto-");
    if scenes.is_empty() {
        return paragraph(figures::NOT_MEASURED.trim());
    }
    let rows_of = |name: &str| committed.record(name).map_or(&[][..], rows);
    let ours = scenes.iter().map(|name| {
        let all = rows_of(name);
        let worst = |key: &str| all.iter().filter_map(|row| row[key].as_f64()).fold(0.0, f64::max);
        vec![
            name.trim_start_matches("motion-auto-").to_owned(),
            all.len().to_string(),
            format!("{:.3}", worst("max_error_mm")),
            format!("{:.3}", worst("p99_error_mm")),
            format!("{:.3}", worst("max_error_px")),
            format!("{:.0}, {:.0}", worst("frozen_vertex_frames"), worst("torn_vertex_frames")),
        ]
    });
    let heads = ["scene", "links", "worst, mm", "99 %, mm", "worst, pixels", "frozen, torn"];
    let table = markdown("Motion of every scene, the worst of its links", &figures::markdown(&heads, ours));
    let kinds = rows_of("motion-auto-dragon").iter().chain(rows_of("motion-dragon-kinds")).map(|row| {
        let word = |key: &str| row[key].as_str().unwrap_or("?").to_owned();
        let cells = [
            "{max_error_mm,1,2}",
            "{p99_error_mm,1,2}",
            "{motion_bytes,0.001,0}",
            "{frozen_vertex_frames,1,0}",
            "{torn_vertex_frames,1,0}",
        ];
        [word("kind"), word("link")].into_iter().chain(cells.map(|cell| cell_of(cell, row))).collect()
    });
    let heads = ["way", "link", "worst, mm", "99 %, mm", "sent, kB", "frozen", "torn"];
    let ways = markdown("One dragon: our way (auto) beside others", &figures::markdown(&heads, kinds));
    paragraph(
        "Distance of drawn vertices from where the source's own curves have them. `auto` is ours: keys are sent once, and the client skins. \
         `paper` predicts positions, and stands still when the next update comes late.",
    ) + &table
        + &ways
}

fn rows(record: &Value) -> &[Value] {
    record["rows"].as_array().map_or(&[], Vec::as_slice)
}

/// Links that are bad in one way each.
pub(super) fn links(committed: &Committed) -> String {
    let records = committed.names("links-");
    let rows: Vec<Vec<String>> = records
        .iter()
        .filter_map(|name| committed.record(name))
        .flat_map(rows)
        .map(|row| {
            let cells = [
                "{pictures_per_s,1,1}",
                "{age_median_ms,1,0}, {age_worst_ms,1,0} ms",
                "{longest_pause_ms,1,0} ms",
                "{queue_worst_ms,1,0} ms",
                "{delivered_mbit_s,1,1}",
                "{flip,1,3}",
            ];
            let link = row["link"].as_str().unwrap_or("?").to_owned();
            std::iter::once(link).chain(cells.map(|cell| cell_of(cell, row))).collect()
        })
        .collect();
    if rows.is_empty() {
        return paragraph(figures::NOT_MEASURED.trim());
    }
    let heads = [
        "link",
        "pictures a second",
        "age of a picture: median, worst",
        "longest pause",
        "queue, worst",
        "Mbit/s",
        "FLIP",
    ];
    paragraph("The head's own motion never waits for a picture: age is that of the shading.")
        + &markdown("Links", &figures::markdown(&heads, rows))
}

/// Pictures of a headset's size.
pub(super) fn pictures(committed: &Committed) -> anyhow::Result<String> {
    if committed.names("picture-").is_empty() {
        return Ok(paragraph(figures::NOT_MEASURED.trim()));
    }
    Ok(paragraph(
        "PSNR above 30 dB is hard to tell apart side by side. `local` is without codec and link: what the atlas itself costs.",
    ) + &of_documents("picture", "Pictures of 1300x1300 pixels an eye", committed)?)
}

/// What the bits of the atlas are for.
pub(super) fn bits(committed: &Committed) -> String {
    let mut rows: Vec<Vec<String>> = Vec::new();
    let mut heads = vec!["cause".to_owned()];
    for (scene, label) in PICTURES {
        for (stream, link) in STREAMS {
            let record = committed.record(&format!("picture-{scene}"));
            let causes = record.and_then(|record| record[stream]["stats"]["bits_by_cause"].as_object());
            let Some(causes) = causes else { continue };
            heads.push(format!("{label}, {link}"));
            let sum: f64 = causes.values().filter_map(Value::as_f64).sum();
            for (cause, bits) in causes {
                let share = format!("{:.0} %", 100.0 * bits.as_f64().unwrap_or(0.0) / sum.max(1.0));
                match rows.iter_mut().find(|row| row[0] == *cause) {
                    Some(row) => row.push(share),
                    None => rows.push(vec![cause.clone(), share]),
                }
            }
        }
    }
    if rows.is_empty() {
        return paragraph(figures::NOT_MEASURED.trim());
    }
    let heads: Vec<&str> = heads.iter().map(String::as_str).collect();
    paragraph(
        "Shares of the atlas's bits. `moving`: blocks of what moves; `entering`: what came into view; `relit`: light or shadow changed; `resized`: \
         other size or place.",
    ) + &markdown("Bits by cause", &figures::markdown(&heads, rows))
}

/// Memory of a client, and what a frame moves in it.
pub(super) fn memory(committed: &Committed) -> anyhow::Result<String> {
    let counted = "Counted from the layouts of the client's compiled shaders and its usual room, on no device. `shadecast-lab figures` prints it.";
    Ok(paragraph(counted)
        + &of_documents("memory", "Device memory of a client with the usual room", committed)?
        + &of_documents("budget", "What a display frame moves in memory", committed)?)
}

/// Bars: those missed with their reasons, and the others.
pub(super) fn bars(report: &Report) -> String {
    let (missed, met): (Vec<&Verdict>, Vec<&Verdict>) = report.0.iter().partition(|verdict| verdict.fails());
    let measured =
        |verdict: &Verdict| verdict.measured.as_ref().map_or_else(Clone::clone, |found| short(*found));
    let rows = missed.iter().map(|verdict| {
        let reason = verdict.known.clone().unwrap_or_else(|| "not explained yet".to_owned());
        vec![format!("`{}`", verdict.figure), verdict.bar.clone(), measured(verdict), reason]
    });
    let table = figures::markdown(&["figure", "bar", "measured", "reason"], rows);
    let held = met
        .iter()
        .map(|verdict| vec![format!("`{}`", verdict.figure), verdict.bar.clone(), measured(verdict)]);
    let held = figures::markdown(&["figure", "bar", "measured"], held);
    format!(
        "<p>{}</p>\n{}{}",
        inline(&format!("{} of {} bars are met, {} are missed.", met.len(), report.0.len(), missed.len())),
        markdown("Bars that are missed", &table),
        folded(&format!("{} bars that are met", met.len()), &markdown("Bars that are met", &held))
    )
}

/// Names of the records that miss bars.
pub(super) fn records_of_missed(report: &Report) -> Vec<&str> {
    let mut names: Vec<&str> = report
        .0
        .iter()
        .filter(|verdict| verdict.fails())
        .filter_map(|verdict| Some(verdict.figure.split_once(": ")?.0))
        .collect();
    names.sort_unstable();
    names.dedup();
    names
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn committed(records: &[(&str, Value)]) -> Committed {
        let folder = tempfile::tempdir().expect("a folder");
        for (name, record) in records {
            std::fs::write(folder.path().join(format!("{name}.json")), record.to_string()).expect("written");
        }
        Committed::read(folder.path())
    }

    #[test]
    fn sections_without_records_say_so() {
        let none = committed(&[]);
        let sections = [
            table1(&none).expect("a section"),
            motion(&none),
            links(&none),
            pictures(&none).expect("a section"),
            bits(&none),
        ];
        assert!(sections.iter().all(|section| section.contains("Not measured yet.")), "{sections:?}");
    }

    #[test]
    fn bits_are_shares_of_their_sum() {
        let bits_of = |moving: u64| json!({"stats": {"bits_by_cause": {"moving": moving, "relit": 25}}});
        let records =
            [("picture-dragons9", json!({"stream_20_ms": bits_of(75), "stream_110_ms": bits_of(25)}))];
        let html = bits(&committed(&records));
        assert!(html.contains("<th scope=\"row\">moving</th><td>75 %</td><td>50 %</td>"), "{html}");
        assert!(html.contains("<th scope=\"col\">nine dragons, 20 ms</th>"), "{html}");
    }

    #[test]
    fn a_scene_has_the_worst_of_its_links() {
        let row = |mm: f64| {
            json!({"kind": "auto", "link": "a", "max_error_mm": mm, "p99_error_mm": 0.05,
            "max_error_px": 0.01, "frozen_vertex_frames": 0, "torn_vertex_frames": 0, "motion_bytes": 4000})
        };
        let html = motion(&committed(&[("motion-auto-fox", json!({"rows": [row(0.1), row(0.2)]}))]));
        assert!(html.contains("<th scope=\"row\">fox</th><td>2</td><td>0.200</td>"), "{html}");
    }

    #[test]
    fn a_missed_bar_says_why() {
        let verdict = |missed_by: Option<f64>, known: Option<&str>| Verdict {
            figure: "run: flip".into(),
            bar: "<= 0.1".into(),
            measured: Ok(0.2),
            missed_by,
            known: known.map(str::to_owned),
        };
        let html = bars(&Report(vec![
            verdict(Some(0.1), Some("a cause")),
            verdict(Some(0.1), None),
            verdict(None, None),
        ]));
        for part in ["1 of 3 bars are met, 2 are missed", "a cause", "not explained yet", "&lt;= 0.1"] {
            assert!(html.contains(part), "{part} is missing in {html}");
        }
    }
}
