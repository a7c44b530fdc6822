//! The case in three sentences: what it is, what is better and by how much, where not and why.
//!
//! Comparisons and records enter, HTML leaves. Every number is of a record.

use super::html::inline;
use super::provenance::Committed;
use super::versus::{Group, Point};
use super::video::reason;
use crate::results::bars::Report;
use serde_json::Value;

/// Comparisons that a sentence names at most.
const NAMED: usize = 4;
/// The link on which ways of moving vertices are compared here.
const MOTION_LINK: &str = "latency=110ms";

const WHAT: &str = "A server shades the visible surfaces of an animated scene into an atlas and streams that with the visible triangles; \
    the headset draws them from its newest head pose and moves them itself. The usual way is a video of both eyes, turned to where the head is.";

/// A comparison with its group.
type Compared<'a> = (&'a Group, &'a Point, f64);

/// The three sentences.
pub(super) fn case(groups: &[Group], committed: &Committed, bars: &Report) -> String {
    let sentences = [
        ("What it is", WHAT.to_owned()),
        ("What is better", better(groups, committed)),
        ("Where it is not", worse(groups, bars)),
    ];
    let rows = sentences
        .iter()
        .map(|(head, sentence)| format!("<div><dt>{head}</dt><dd>{}</dd></div>\n", inline(sentence)));
    format!("<dl class=\"case\">\n{}</dl>\n", rows.collect::<String>())
}

fn compared(groups: &[Group]) -> Vec<Compared<'_>> {
    let points = groups.iter().flat_map(|group| group.points.iter().map(move |point| (group, point)));
    points.filter_map(|(group, point)| Some((group, point, point.ratio()?))).collect()
}

fn better(groups: &[Group], committed: &Committed) -> String {
    let all = compared(groups);
    if all.is_empty() {
        return format!("Beside video it is not measured yet. {}", motion(committed));
    }
    let won = all.iter().filter(|(_, _, ratio)| *ratio < 1.0).count();
    let mut ratios: Vec<f64> = all.iter().map(|(_, _, ratio)| *ratio).collect();
    ratios.sort_by(f64::total_cmp);
    let (least, middle, most) = (ratios[0], ratios[ratios.len() / 2], ratios[ratios.len() - 1]);
    format!(
        "With the same bits over the same link its picture is closer to the truth than the best video's in {won} of {} comparisons: the \
         visible error (FLIP) is {middle:.2} of the video's in the middle one, {least:.2} to {most:.2} in all. {}",
        all.len(),
        motion(committed)
    )
}

/// Of vertices: ours beside the paper's way, where both are measured.
fn motion(committed: &Committed) -> String {
    let worst = |record: &str, kind: &str| {
        let rows = committed.record(record)?["rows"].as_array()?;
        let is_it = |row: &&Value| {
            row["kind"] == kind && row["link"].as_str().is_some_and(|link| link.starts_with(MOTION_LINK))
        };
        rows.iter().find(is_it)?["max_error_mm"].as_f64()
    };
    let both = worst("motion-auto-dragon", "auto").zip(worst("motion-dragon-kinds", "paper"));
    both.map_or_else(String::new, |(ours, paper)| {
        format!(
            "Over 110 ms a moving dragon's vertices are at most {ours:.2} mm from where they belong; with the paper's predictions \
             {paper:.0} mm."
        )
    })
}

fn worse(groups: &[Group], bars: &Report) -> String {
    let all = compared(groups);
    let lost: Vec<&Compared> = all.iter().filter(|(_, _, ratio)| *ratio >= 1.0).collect();
    let video = match (all.is_empty(), lost.first()) {
        (true, _) => String::new(),
        (false, None) => "Video is closer in no comparison. ".to_owned(),
        (false, Some((_, first, _))) => {
            let named: Vec<String> = lost.iter().take(NAMED).map(|lost| name(lost)).collect();
            let more = if lost.len() > NAMED { " and others" } else { "" };
            format!(
                "Video is closer in {} of {} comparisons: {}{more}. {} ",
                lost.len(),
                all.len(),
                named.join("; "),
                reason(first)
            )
        }
    };
    format!(
        "{video}{} of {} bars are missed, each with its reason below. No headset has run it yet: pictures are of virtual time, and rates \
         are those of the device below each table.",
        bars.failures(),
        bars.0.len()
    )
}

fn name((group, point, ratio): &Compared) -> String {
    let rate = group.setting.rate_mbit.map_or_else(String::new, |rate| format!(" and {rate} Mbit/s"));
    format!(
        "{} at {} ms{rate} (the atlas has {ratio:.2} of its error)",
        group.setting.scene, point.latency_ms
    )
}

#[cfg(test)]
mod tests {
    use super::super::versus::groups;
    use super::super::versus::tests::record;
    use super::*;
    use serde_json::json;

    fn said(records: &[(&str, Value)]) -> String {
        let folder = tempfile::tempdir().expect("a folder");
        for (name, record) in records {
            std::fs::write(folder.path().join(format!("{name}.json")), record.to_string()).expect("written");
        }
        let committed = Committed::read(folder.path());
        case(&groups(&committed.records).expect("comparisons"), &committed, &Report(Vec::new()))
    }

    #[test]
    fn the_case_counts_who_is_closer_and_gives_the_reason() {
        let html = said(&[
            ("quality-a", record(5.0, 6.0, 0.08, 0.07)),
            ("quality-b", record(20.0, 6.0, 0.06, 0.08)),
            ("quality-c", record(110.0, 6.0, 0.05, 0.1)),
        ]);
        for part in [
            "in 2 of 3 comparisons",
            "0.75 of the video's in the middle one, 0.50 to 1.14 in all",
            "Video is closer in 1 of 3 comparisons: dragons:9",
            "(the atlas has 1.14 of its error)",
            "Video spends its bits on pixels in view",
        ] {
            assert!(html.contains(part), "{part} is missing in {html}");
        }
    }

    #[test]
    fn the_case_claims_nothing_that_is_not_measured() {
        let html = said(&[]);
        assert!(html.contains("not measured yet") && !html.contains("comparisons"), "{html}");
        let row = |kind: &str, mm: f64| {
            json!({"rows": [
            {"kind": kind, "link": "latency=110ms,jitter=10ms", "max_error_mm": mm}]})
        };
        let html =
            said(&[("motion-auto-dragon", row("auto", 0.105)), ("motion-dragon-kinds", row("paper", 485.8))]);
        assert!(html.contains("at most 0.10 mm") && html.contains("predictions 486 mm"), "{html}");
    }
}
