//! Records of the atlas beside videos, as the page needs them.
//!
//! JSON of `shadecast-lab quality` enters, of today's form or of one with more methods. Groups of comparisons leave: one scene,
//! head, size and rate each, by latency. What a record lacks is left open.

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
    pub psnr_db: [Option<f64>; 2],
    /// What was sent.
    pub mbit_per_s: Option<f64>,
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
    pub head: Option<String>,
    /// Pixels an eye.
    pub size: Option<String>,
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
        let head = self.head.as_ref().map(|head| format!(", head \"{head}\""));
        let size = self.size.as_ref().map(|size| format!(", {size} pixels an eye"));
        let rate = self.rate_mbit.map(|rate| format!(", {rate} Mbit/s"));
        [head, size, rate].into_iter().flatten().fold(self.scene.clone(), |title, part| title + &part)
    }
}

/// Whether a record is a comparison, by its name.
pub(super) fn is_comparison(name: &str) -> bool {
    name == "quality" || name.starts_with("quality-")
}

/// The comparisons among `records`, by setting.
pub(super) fn groups(records: &BTreeMap<String, Value>) -> Vec<Group> {
    let mut groups: Vec<Group> = Vec::new();
    for (name, record) in records.iter().filter(|(name, _)| is_comparison(name)) {
        for over in record["links"].as_array().into_iter().flatten() {
            let Some(point) = point(over) else { continue };
            let setting = setting(name, record, over);
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
    groups
}

/// A record says it in fields of its own, or its commands do.
fn setting(name: &str, record: &Value, over: &Value) -> Setting {
    let command = over["ours"]["command"].as_str().unwrap_or("");
    let said = |fields: &[&str], flag: &str| {
        let field = fields.iter().find_map(|field| text(&record[*field]));
        field.or_else(|| option(command, flag))
    };
    let scene = text(&record["scene"]);
    Setting {
        scene: scene.unwrap_or_else(|| name.trim_start_matches("quality-").to_owned()),
        head: said(&["head", "head_path"], "--head-path"),
        size: said(&["size"], "--size"),
        rate_mbit: said(&["rate_mbit", "bitrate_mbit", "bitrate"], "--bitrate")
            .and_then(|rate| rate.parse().ok()),
    }
}

fn text(value: &Value) -> Option<String> {
    match value {
        Value::String(text) => Some(text.clone()),
        Value::Number(number) => Some(number.to_string()),
        _ => None,
    }
}

/// What follows a flag of a command.
fn option(command: &str, flag: &str) -> Option<String> {
    command.split_whitespace().skip_while(|word| *word != flag).nth(1).map(str::to_owned)
}

fn point(over: &Value) -> Option<Point> {
    let link = over["link"].as_str()?;
    let mut methods: Vec<Method> = Vec::new();
    let mut add = |method: Option<Method>| {
        let Some(method) = method else { return };
        match methods.iter_mut().find(|other| other.name == method.name) {
            Some(other) if method.flip < other.flip => *other = method,
            Some(_) => {}
            None => methods.push(method),
        }
    };
    add(method(ATLAS, &over["ours"]));
    for (key, value) in over.as_object()?.iter().filter(|(key, _)| *key != "ours") {
        match value {
            Value::Array(rows) => rows.iter().for_each(|row| add(method(&name_of(key, row), row))),
            Value::Object(rows) if !rows.contains_key("flip") => {
                rows.iter().for_each(|(name, row)| add(method(&spaced(name), row)));
            }
            row => add(method(&spaced(key), row)),
        }
    }
    Some(Point { latency_ms: latency_ms(link)?, link: link.to_owned(), methods })
}

/// One way: `latency=20ms` of a link.
fn latency_ms(link: &str) -> Option<f64> {
    let latency = link.split(',').find_map(|part| part.trim().strip_prefix("latency="))?;
    latency.strip_suffix("ms").unwrap_or(latency).parse().ok()
}

fn spaced(name: &str) -> String {
    name.replace(['_', '-'], " ")
}

/// A row's own name, or what its video can do.
fn name_of(list: &str, row: &Value) -> String {
    let named = ["name", "method", "label", "way"].iter().find_map(|key| row[*key].as_str());
    if let Some(name) = named {
        return spaced(name);
    }
    let settings = row["method"]["video"].as_object().or_else(|| row["video"].as_object());
    let Some(settings) = settings else { return spaced(list.trim_end_matches('s')) };
    let words = settings.iter().filter_map(|(key, value)| match value {
        Value::Bool(true) => Some(spaced(key.strip_prefix("has_").unwrap_or(key))),
        Value::String(word) => Some(spaced(word)),
        _ => None,
    });
    let words: Vec<String> = words.collect();
    if words.is_empty() { VIDEO.to_owned() } else { format!("{VIDEO} with {}", words.join(", ")) }
}

/// `None` where it was not measured.
fn method(name: &str, row: &Value) -> Option<Method> {
    Some(Method {
        name: name.to_owned(),
        flip: row["flip"].as_f64()?,
        animated_flip: row["animated_flip"].as_f64(),
        flicker: row["flicker"].as_f64(),
        psnr_db: [0, 1].map(|place| row["psnr_db"][place].as_f64()),
        mbit_per_s: row["mbit_per_s"].as_f64(),
        qp: row["qp"].as_f64(),
    })
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::experiments::quality::{self, OverLink, Quality, Video};
    use serde_json::json;

    /// A row of a method; the video's settings where it is one.
    fn row(flip: f64, qp: f64, bitrate: f64, video: Value) -> Value {
        json!({"video": video, "command": format!("shadecast-lab run dragons:9 --size 400x400 --head-path stride \
            --bitrate {bitrate} --link x"), "mbit_per_s": bitrate, "qp": qp, "flip": flip, "flip_worst": 2.0 * flip,
            "flip_at_view": flip, "psnr_db": [30.0 - 50.0 * flip, 25.0], "ssim": 0.9, "flicker": 0.1 * flip,
            "animated_flip": 1.5 * flip})
    }

    /// A comparison over a link: ours, and the best video.
    pub(in crate::results::page) fn record(latency_ms: f64, bitrate: f64, ours: f64, best: f64) -> Value {
        let video = |margin: f64, has_depth: bool| json!({"rate_hz": 30.0, "margin_degrees": margin, "has_depth": has_depth});
        let videos = [
            row(best, 24.0, bitrate, video(10.0, true)),
            row(1.1 * best, 24.0, bitrate, video(5.0, true)),
            row(1.5 * best, 22.0, bitrate, video(10.0, false)),
        ];
        json!({"scene": "dragons:9", "commit": "abc1234", "links": [{
            "link": format!("latency={latency_ms}ms,jitter=10ms"),
            "ours": row(ours, 31.0, bitrate, Value::Null), "videos": videos, "flip_ratio": ours / best,
        }]})
    }

    #[test]
    fn records_of_one_setting_are_one_group_by_latency() {
        let records = [
            ("quality-dragons9-20ms", record(20.0, 6.0, 0.061, 0.072)),
            ("quality-dragons9-110ms", record(110.0, 6.0, 0.067, 0.099)),
            ("quality-dragons9-12mbit", record(20.0, 12.0, 0.05, 0.06)),
            ("picture-dragons9", json!({"links": [{"link": "latency=1ms"}]})),
        ];
        let records = records.into_iter().map(|(name, record)| (name.to_owned(), record)).collect();
        let groups = groups(&records);
        assert_eq!(groups.len(), 2);
        assert_eq!(groups[0].setting.title(), "dragons:9, head \"stride\", 400x400 pixels an eye, 6 Mbit/s");
        let latencies: Vec<f64> = groups[0].points.iter().map(|point| point.latency_ms).collect();
        assert_eq!(latencies, [20.0, 110.0]);
        let names: Vec<&str> =
            groups[0].points[0].methods.iter().map(|method| method.name.as_str()).collect();
        assert_eq!(names, [ATLAS, "video with depth", "video"], "the best of each sort");
        assert_eq!(groups[0].points[0].methods[1].flip, 0.072);
        assert!((groups[0].points[1].ratio().expect("both") - 0.067 / 0.099).abs() < 1e-12);
    }

    #[test]
    fn methods_are_read_from_lists_and_from_fields() {
        let mut record = record(20.0, 6.0, 0.061, 0.072);
        record["links"][0]["methods"] = json!([
            {"name": "atlas_without_prediction", "flip": 0.08},
            {"name": "video with motion vectors", "flip": 0.05},
        ]);
        record["links"][0]["as_paper"] = json!({"flip": 0.09});
        record["links"][0]["others"] = json!({"atlas-without-store": {"flip": 0.1}, "note": "text"});
        let groups = groups(&[("quality-x".to_owned(), record)].into());
        let names: Vec<&str> =
            groups[0].points[0].methods.iter().map(|method| method.name.as_str()).collect();
        for name in
            ["atlas without prediction", "video with motion vectors", "as paper", "atlas without store"]
        {
            assert!(names.contains(&name), "{name} is missing in {names:?}");
        }
        let (ours, video) = groups[0].points[0].rivals().expect("both");
        assert_eq!((ours.flip, video.flip), (0.061, 0.05));
    }

    #[test]
    fn a_record_of_the_experiment_is_understood() {
        let row = |method: quality::Method, flip: f64| quality::Row {
            method,
            command: "shadecast-lab run dragons:9 --size 400x400 --bitrate 6".to_owned(),
            mbit_per_s: 6.0,
            qp: Some(24.0),
            flip,
            flip_worst: flip,
            flip_at_view: flip,
            psnr_db: [30.0, 28.0],
            ssim: 0.9,
            hole_fraction: None,
            flicker: None,
            animated_flip: None,
        };
        let video =
            |has_depth| quality::Method::Video(Video { rate_hz: 30.0, margin_degrees: 5.0, has_depth });
        let link = OverLink {
            link: quality::link(20.0),
            ours: row(quality::Method::Atlas, 0.06),
            others: quality::Method::OTHERS.map(|method| row(method, 0.08)).to_vec(),
            videos: vec![row(video(true), 0.07), row(video(false), 0.1)],
            flip_ratio: 0.06 / 0.07,
        };
        let record = Quality { scene: "dragons:9".into(), head: "stride".into(), links: vec![link] };
        let record = serde_json::to_value(record).expect("JSON");
        let groups = groups(&[("quality-dragons9-20ms".to_owned(), record)].into());
        assert_eq!(groups[0].setting.title(), "dragons:9, head \"stride\", 400x400 pixels an eye, 6 Mbit/s");
        let names: Vec<&str> =
            groups[0].points[0].methods.iter().map(|method| method.name.as_str()).collect();
        let others = ["atlas without prediction", "atlas as paper"];
        assert_eq!(names, [ATLAS, others[0], others[1], "video with depth", VIDEO]);
    }

    #[test]
    fn what_is_no_comparison_is_left_out() {
        for record in
            [json!(null), json!({"links": 3}), json!({"links": [{"link": "rate=1mbit", "ours": {}}]})]
        {
            assert_eq!(groups(&[("quality-x".to_owned(), record)].into()), []);
        }
    }
}
