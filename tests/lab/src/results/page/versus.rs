//! Records of the atlas beside videos, as the page needs them.
//!
//! Records of `shadecast-lab quality` enter. Groups of comparisons leave: one scene, head, size and rate each, by latency.

use crate::experiments::quality::{self, OverLink, Quality, Row};
use anyhow::Context;
use serde_json::Value;
use std::collections::BTreeMap;

/// What ours is called.
pub(super) const ATLAS: &str = "atlas";
/// What names of videos begin with.
const VIDEO: &str = "video";

/// What a method showed over a link.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Method {
    /// What it is called; of videos with the same abilities only the best has come here.
    pub name: String,
    /// Mean, 0 to 1.
    pub flip: f64,
    /// Of what is animated.
    pub animated_flip: Option<f64>,
    /// Change of the error from frame to frame.
    pub flicker: Option<f64>,
    /// Mean, and of the worst view, dB.
    pub psnr_db: [f64; 2],
    /// What was sent.
    pub mbit_per_s: f64,
    /// Mean quantiser.
    pub qp: Option<f64>,
}

/// All methods over a link.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Point {
    /// One way, milliseconds.
    pub latency_ms: f64,
    /// The link as a run takes it.
    pub link: String,
    /// Ours first.
    pub methods: Vec<Method>,
}

/// What a group has in common.
#[derive(Clone, Debug, PartialEq, PartialOrd)]
pub(super) struct Setting {
    /// As a person calls it.
    pub scene: String,
    /// The head's path.
    pub head: String,
    /// Pixels an eye.
    pub size: Option<String>,
    /// Packets that the link loses, as a run takes it: `1%`.
    pub lost: Option<String>,
    /// Megabits a second that all streams may take.
    pub rate_mbit: Option<f64>,
}

/// Comparisons by latency.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Group {
    /// What they have in common.
    pub setting: Setting,
    /// Ascending.
    pub points: Vec<Point>,
}

impl Method {
    /// Whether it is not ours, in any form.
    pub(super) fn is_video(&self) -> bool {
        self.name.starts_with(VIDEO)
    }
}

impl Point {
    /// Ours, and the video with the least FLIP.
    pub(super) fn rivals(&self) -> Option<(&Method, &Method)> {
        let ours = self.methods.iter().find(|method| method.name == ATLAS)?;
        let videos = self.methods.iter().filter(|method| method.is_video());
        Some((ours, videos.min_by(|a, b| a.flip.total_cmp(&b.flip))?))
    }

    /// FLIP of ours over that of the best video: below 1 ours is closer to the truth.
    pub(super) fn ratio(&self) -> Option<f64> {
        self.rivals().map(|(ours, video)| ours.flip / video.flip)
    }
}

impl Setting {
    /// For a heading.
    pub(super) fn title(&self) -> String {
        let size = self.size.as_ref().map(|size| format!(", {size} pixels an eye"));
        let rate = self.rate_mbit.map(|rate| format!(", {rate} Mbit/s"));
        let lost = self.lost.as_ref().map(|lost| format!(", {lost} lost"));
        let Self { scene, head, .. } = self;
        [size, lost, rate]
            .into_iter()
            .flatten()
            .fold(format!("{scene}, head \"{head}\""), |title, part| title + &part)
    }
}

/// Whether a record is a comparison, by its name.
pub(super) fn is_comparison(name: &str) -> bool {
    name.starts_with("quality-")
}

/// The comparisons among `records`, by setting.
///
/// # Errors
/// A record that is named as one is none.
pub(super) fn groups(records: &BTreeMap<String, Value>) -> anyhow::Result<Vec<Group>> {
    let mut groups: Vec<Group> = Vec::new();
    for (name, record) in records.iter().filter(|(name, _)| is_comparison(name)) {
        let found: Quality = serde_json::from_value(record.clone()).with_context(|| name.clone())?;
        for over in &found.links {
            let (setting, point) = (setting(&found, over), point(over).with_context(|| name.clone())?);
            match groups.iter_mut().find(|group| group.setting == setting) {
                Some(group) => group.points.push(point),
                None => groups.push(Group { setting, points: vec![point] }),
            }
        }
    }
    for group in &mut groups {
        group.points.sort_by(|a, b| a.latency_ms.total_cmp(&b.latency_ms));
    }
    groups.sort_by(|a, b| a.setting.partial_cmp(&b.setting).unwrap_or(std::cmp::Ordering::Equal));
    Ok(groups)
}

fn setting(found: &Quality, over: &OverLink) -> Setting {
    let said = |flag| option(&over.ours.command, flag);
    Setting {
        scene: found.scene.clone(),
        head: found.head.clone(),
        size: said("--size").map(str::to_owned),
        lost: part_of_link(&over.link, "loss").map(str::to_owned),
        rate_mbit: said("--bitrate").and_then(|rate| rate.parse().ok()),
    }
}

/// What follows a flag of a command.
fn option<'a>(command: &'a str, flag: &str) -> Option<&'a str> {
    command.split_whitespace().skip_while(|word| *word != flag).nth(1)
}

fn point(over: &OverLink) -> anyhow::Result<Point> {
    let mut methods: Vec<Method> = Vec::new();
    for method in std::iter::once(&over.ours).chain(&over.others).chain(&over.videos).map(method) {
        match methods.iter_mut().find(|other| other.name == method.name) {
            Some(other) if method.flip < other.flip => *other = method,
            Some(_) => {}
            None => methods.push(method),
        }
    }
    let latency_ms = latency_ms(&over.link).with_context(|| format!("\"{}\" has no latency", over.link))?;
    Ok(Point { latency_ms, link: over.link.clone(), methods })
}

/// The value of a key of a link.
fn part_of_link<'a>(link: &'a str, key: &str) -> Option<&'a str> {
    link.split(',').find_map(|part| part.trim().strip_prefix(key)?.strip_prefix('='))
}

/// One way: `latency=20ms` of a link.
fn latency_ms(link: &str) -> Option<f64> {
    let latency = part_of_link(link, "latency")?;
    latency.strip_suffix("ms").unwrap_or(latency).parse().ok()
}

fn method(row: &Row) -> Method {
    let name = match row.method {
        quality::Method::Video(video) if video.has_depth => format!("{VIDEO} with depth"),
        quality::Method::Video(_) => VIDEO.to_owned(),
        ours => ours.to_string(),
    };
    Method {
        name,
        flip: row.flip,
        animated_flip: row.animated_flip,
        flicker: row.flicker,
        psnr_db: row.psnr_db,
        mbit_per_s: row.mbit_per_s,
        qp: row.qp,
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::experiments::quality::Video;
    use serde_json::json;

    fn row(method: quality::Method, flip: f64, qp: f64, bitrate: f64) -> Row {
        Row {
            method,
            command: format!(
                "shadecast-lab run dragons:9 --size 400x400 --head-path stride --bitrate {bitrate}"
            ),
            mbit_per_s: bitrate,
            qp: Some(qp),
            flip,
            flip_worst: 2.0 * flip,
            flip_at_view: flip,
            psnr_db: [30.0 - 50.0 * flip, 25.0],
            ssim: 0.9,
            hole_fraction: None,
            flicker: Some(0.1 * flip),
            animated_flip: Some(1.5 * flip),
        }
    }

    /// A comparison over a link: ours, and the best video.
    pub(in crate::results::page) fn record(latency_ms: f64, bitrate: f64, ours: f64, best: f64) -> Value {
        let video = |margin_degrees, has_depth| {
            quality::Method::Video(Video { rate_hz: 30.0, margin_degrees, has_depth })
        };
        let link = OverLink {
            link: quality::link(latency_ms, 0.0),
            ours: row(quality::Method::Atlas, ours, 31.0, bitrate),
            others: quality::Method::OTHERS.map(|method| row(method, 1.4 * ours, 31.0, bitrate)).to_vec(),
            videos: vec![
                row(video(10.0, true), best, 24.0, bitrate),
                row(video(5.0, true), 1.1 * best, 24.0, bitrate),
                row(video(10.0, false), 1.5 * best, 22.0, bitrate),
            ],
            flip_ratio: ours / best,
        };
        let found = Quality { scene: "dragons:9".into(), head: "stride".into(), links: vec![link] };
        let mut record = serde_json::to_value(found).expect("JSON");
        record["commit"] = json!("abc1234");
        record
    }

    fn groups_of(records: &[(&str, Value)]) -> anyhow::Result<Vec<Group>> {
        groups(&records.iter().map(|(name, record)| ((*name).to_owned(), record.clone())).collect())
    }

    #[test]
    fn a_link_that_loses_packets_is_a_group_of_its_own() {
        let mut lossy = record(20.0, 6.0, 0.062, 0.073);
        lossy["links"][0]["link"] = json!(quality::link(20.0, 1.0));
        let records = [("quality-a", record(20.0, 6.0, 0.061, 0.072)), ("quality-b", lossy)];
        let records = records.map(|(name, record)| (name.to_owned(), record));
        let groups = groups(&BTreeMap::from(records)).expect("comparisons");
        assert!(groups.iter().all(|group| group.points.len() == 1 && group.points[0].latency_ms == 20.0));
        let titles: Vec<String> = groups.iter().map(|group| group.setting.title()).collect();
        assert_eq!(titles.iter().filter(|title| title.contains("1% lost")).count(), 1, "{titles:?}");
    }

    #[test]
    fn records_of_one_setting_are_one_group_by_latency() {
        let groups = groups_of(&[
            ("quality-dragons9-20ms", record(20.0, 6.0, 0.061, 0.072)),
            ("quality-dragons9-110ms", record(110.0, 6.0, 0.067, 0.099)),
            ("quality-dragons9-12mbit", record(20.0, 12.0, 0.05, 0.06)),
            ("picture-dragons9", json!({"links": [{"link": "latency=1ms"}]})),
        ])
        .expect("comparisons");
        assert_eq!(groups.len(), 2);
        assert_eq!(groups[0].setting.title(), "dragons:9, head \"stride\", 400x400 pixels an eye, 6 Mbit/s");
        let latencies: Vec<f64> = groups[0].points.iter().map(|point| point.latency_ms).collect();
        assert_eq!(latencies, [20.0, 110.0]);
        let names: Vec<&str> =
            groups[0].points[0].methods.iter().map(|method| method.name.as_str()).collect();
        let others = ["atlas without prediction", "atlas as in the paper"];
        assert_eq!(names, [ATLAS, others[0], others[1], "video with depth", VIDEO], "the best of each sort");
        assert_eq!(groups[0].points[0].methods[3].flip, 0.072);
        assert!((groups[0].points[1].ratio().expect("both") - 0.067 / 0.099).abs() < 1e-12);
    }

    #[test]
    fn what_is_no_comparison_is_an_error_by_its_name() {
        for record in [json!(null), json!({"links": 3}), json!({"links": [{"link": "rate=1mbit"}]})] {
            let error = groups_of(&[("quality-x", record)]).expect_err("it is none");
            assert!(format!("{error:#}").contains("quality-x"), "{error:#}");
        }
    }
}
