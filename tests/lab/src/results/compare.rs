//! `shadecast-lab compare`: what changed between two results, or two folders of them.
//!
//! Two records enter. A line for each figure that changed leaves, with better or worse where its metric has a direction, and a
//! count of regressions. Nothing here knows bars: a figure is compared with its earlier self alone.

use super::{records, texts_under};
use crate::report::text_table::table;
use anyhow::{Context, ensure};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::Path;

/// Which way a metric is better.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Direction {
    Lower,
    Higher,
    /// Either way, or the machine's speed is in it: reported, and no verdict.
    Reported,
}

/// Metrics of a kind, and by how much they differ without a change of code.
struct Kind {
    /// Parts of keys that name it; the last part of a path decides first, then the parts before it.
    keys: &'static [&'static str],
    direction: Direction,
    /// Noise in the metric's own unit.
    absolute: f64,
    /// Noise as a share of the earlier figure; the larger of both counts.
    relative: f64,
}

const fn kind(keys: &'static [&'static str], direction: Direction, absolute: f64, relative: f64) -> Kind {
    Kind { keys, direction, absolute, relative }
}

/// The first kind whose key fits counts. Virtual time repeats exactly on one device, so these bounds are those between devices
/// and drivers. Times are the machine's.
const KINDS: [Kind; 16] = [
    // The machine's times and what follows from them, also where a key has a unit of another kind in it.
    kind(&["clock_error", "clock_step", "clocks_apart"], Direction::Reported, 0.0, 0.1),
    kind(
        &["gpu_ms", "cpu_ms", "stage_ms", "rss_", "memory_before", "memory_peak"],
        Direction::Reported,
        0.0,
        0.1,
    ),
    kind(&["flip_ratio"], Direction::Lower, 0.01, 0.0),
    // FLIP, 0 to 1.
    kind(&["flip"], Direction::Lower, 0.001, 0.01),
    kind(&["flicker"], Direction::Lower, 0.0002, 0.02),
    // Decibels.
    kind(&["psnr_difference_db"], Direction::Lower, 0.05, 0.0),
    kind(&["_db"], Direction::Higher, 0.1, 0.0),
    kind(&["ssim"], Direction::Higher, 0.001, 0.0),
    // Shares of pixels, 0 to 1.
    kind(&["hole"], Direction::Lower, 0.0001, 0.02),
    // Megabits a second, and bytes.
    kind(&["delivered_mbit"], Direction::Reported, 0.0, 0.02),
    kind(&["mbit"], Direction::Lower, 0.05, 0.01),
    kind(&["bytes"], Direction::Lower, 64.0, 0.01),
    // Millimetres, pixels and shares of a range by which vertices are wrong.
    kind(&["error_mm", "error_px", "error_percent", "max_mm", "max_percent"], Direction::Lower, 0.01, 0.02),
    // Counts of what must not be.
    kind(
        &["validation_messages", "missed_bars", "frozen", "torn", "stopped", "dropped_patches"],
        Direction::Lower,
        0.0,
        0.0,
    ),
    // Times and rates.
    kind(&["_ms", "_s", "ms", "fps", "per_s", "_hz"], Direction::Reported, 0.0, 0.1),
    kind(&[""], Direction::Reported, 0.0, 0.0),
];

/// Of these a record has several, and ours is not among them: they may become better.
const RIVALS: [&str; 4] = ["others", "videos", "methods", "paper_fps"];

fn kind_of(path: &str) -> &'static Kind {
    let fits = |part: &str| {
        KINDS.iter().find(|kind| kind.keys.iter().any(|key| !key.is_empty() && part.contains(key)))
    };
    path.rsplit('/').find_map(fits).unwrap_or(&KINDS[KINDS.len() - 1])
}

fn direction_of(path: &str) -> Direction {
    let is_rival = path.split('/').any(|part| RIVALS.iter().any(|rival| part.starts_with(rival)));
    if is_rival { Direction::Reported } else { kind_of(path).direction }
}

/// What became of a figure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Beyond noise in the metric's direction.
    Better,
    /// Beyond noise against it.
    Worse,
    /// Not there any more, though it has a direction.
    Gone,
    /// It has no direction.
    Changed,
}

/// A figure that changed.
#[derive(Clone, Debug, PartialEq)]
pub struct Change {
    /// Keys, joined by slashes; rows of lists by their names.
    pub path: String,
    /// The earlier figure.
    pub before: f64,
    /// The later one.
    pub after: Option<f64>,
    /// What that means.
    pub verdict: Verdict,
}

/// A record and its earlier self.
#[derive(Clone, Debug, PartialEq)]
pub struct Compared {
    /// Its name.
    pub name: String,
    /// Both commits, where the records say them.
    pub commits: [Option<String>; 2],
    /// Their commands differ: a change may be one of options.
    pub has_other_commands: bool,
    /// How many figures both have.
    pub figures: usize,
    /// Those that changed beyond noise.
    pub changes: Vec<Change>,
}

/// All records of two folders, or one of each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Comparison {
    /// Those that both have.
    pub compared: Vec<Compared>,
    /// Those that one has alone: earlier, later.
    pub alone: [Vec<String>; 2],
}

/// Compares two files, or two folders.
///
/// # Errors
/// One is not there, is no JSON, or they are a file and a folder.
pub fn compare(before: &Path, after: &Path) -> anyhow::Result<Comparison> {
    ensure!(
        before.is_dir() == after.is_dir(),
        "{} and {} are a file and a folder: compare two of a kind",
        before.display(),
        after.display()
    );
    if before.is_dir() {
        let (before, after) = (records(before), records(after));
        let alone = |one: &BTreeMap<String, Value>, other: &BTreeMap<String, Value>| {
            one.keys().filter(|name| !other.contains_key(*name)).cloned().collect()
        };
        let both = before.iter().filter_map(|(name, record)| Some((name, record, after.get(name)?)));
        let compared = both.map(|(name, before, after)| compared(name, before, after)).collect();
        return Ok(Comparison { compared, alone: [alone(&before, &after), alone(&after, &before)] });
    }
    let read = |path: &Path| -> anyhow::Result<Value> {
        let text = std::fs::read_to_string(path).with_context(|| format!("reading {}", path.display()))?;
        serde_json::from_str(&text).with_context(|| format!("{} is no JSON", path.display()))
    };
    let name = after.file_stem().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
    let compared = vec![compared(&name, &read(before)?, &read(after)?)];
    Ok(Comparison { compared, ..Comparison::default() })
}

fn compared(name: &str, before: &Value, after: &Value) -> Compared {
    let commit = |record: &Value| record["commit"].as_str().map(str::to_owned);
    let commits = [commit(before), commit(after)];
    let has_other_commands = texts_under(before, "command") != texts_under(after, "command");
    let (before, after) = (figures(before), figures(after));
    let both = before.keys().filter(|path| after.contains_key(*path)).count();
    let changes = before.iter().filter_map(|(path, before)| change(path, *before, after.get(path).copied()));
    Compared { name: name.to_owned(), commits, has_other_commands, figures: both, changes: changes.collect() }
}

/// `None` where it is the same, within noise.
fn change(path: &str, before: f64, after: Option<f64>) -> Option<Change> {
    let direction = direction_of(path);
    let Kind { absolute, relative, .. } = kind_of(path);
    let made = |verdict| Some(Change { path: path.to_owned(), before, after, verdict });
    let Some(later) = after else {
        return if direction == Direction::Reported { None } else { made(Verdict::Gone) };
    };
    let grown = later - before;
    if grown.abs() <= absolute.max(relative * before.abs()) {
        return None;
    }
    match direction {
        Direction::Reported => made(Verdict::Changed),
        Direction::Lower if grown < 0.0 => made(Verdict::Better),
        Direction::Higher if grown > 0.0 => made(Verdict::Better),
        Direction::Lower | Direction::Higher => made(Verdict::Worse),
    }
}

/// All numbers of a record by their paths.
fn figures(record: &Value) -> BTreeMap<String, f64> {
    let mut found = BTreeMap::new();
    collect(record, "", &mut found);
    found
}

fn collect(value: &Value, path: &str, found: &mut BTreeMap<String, f64>) {
    let below = |part: &str| if path.is_empty() { part.to_owned() } else { format!("{path}/{part}") };
    match value {
        Value::Object(fields) => fields.iter().for_each(|(key, value)| collect(value, &below(key), found)),
        Value::Array(list) => {
            for (part, value) in names(list).iter().zip(list) {
                collect(value, &below(part), found);
            }
        }
        value => found.extend(value.as_f64().map(|number| (path.to_owned(), number))),
    }
}

/// What rows of a list are called: by their words, such as kind and link, so that a row is found wherever it stands; by their places
/// where two have the same words.
fn names(list: &[Value]) -> Vec<String> {
    let names: Vec<String> = list.iter().map(name).collect();
    let distinct: BTreeSet<&String> = names.iter().collect();
    if distinct.len() == names.len() && !names.iter().any(String::is_empty) {
        return names;
    }
    (0..list.len()).map(|place| place.to_string()).collect()
}

fn name(row: &Value) -> String {
    const NUMBERS: [&str; 3] = ["dragons", "rate_hz", "margin_degrees"];
    let mut words = Vec::new();
    for (key, value) in row.as_object().into_iter().flatten() {
        match value {
            // A command has options that may have changed while the row is the same.
            Value::String(word) if key != "command" && key != "device" => words.push(word.clone()),
            Value::Number(number) if NUMBERS.contains(&key.as_str()) => words.push(number.to_string()),
            Value::Bool(true) => words.push(key.clone()),
            // Settings of a way.
            Value::Object(_) if ["video", "method"].contains(&key.as_str()) => words.push(name(value)),
            _ => {}
        }
    }
    words.join(", ")
}

impl Comparison {
    /// How many figures became worse beyond noise, or are gone.
    pub fn regressions(&self) -> usize {
        let all = self.compared.iter().flat_map(|one| &one.changes);
        all.filter(|change| matches!(change.verdict, Verdict::Worse | Verdict::Gone)).count()
    }
}

impl fmt::Display for Comparison {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        for one in self.compared.iter().filter(|one| !one.changes.is_empty()) {
            writeln!(out, "{one}")?;
        }
        for (names, which) in self.alone.iter().zip(["first", "second"]) {
            if !names.is_empty() {
                writeln!(out, "only in the {which}: {}", names.join(", "))?;
            }
        }
        let figures: usize = self.compared.iter().map(|one| one.figures).sum();
        let changes: Vec<&Change> = self.compared.iter().flat_map(|one| &one.changes).collect();
        let better = changes.iter().filter(|change| change.verdict == Verdict::Better).count();
        let regressions = self.regressions();
        write!(
            out,
            "{} results, {figures} figures: {better} better, {regressions} worse or gone, {} others changed",
            self.compared.len(),
            changes.len() - better - regressions
        )
    }
}

impl fmt::Display for Compared {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [before, after] =
            [0, 1].map(|side| self.commits[side].as_deref().unwrap_or("a commit that is not recorded"));
        let options = if self.has_other_commands { ", with other commands: options count too" } else { "" };
        writeln!(out, "{}: {before} -> {after}{options}", self.name)?;
        let row = |change: &Change| {
            let verdict = match change.verdict {
                Verdict::Better => "better",
                Verdict::Worse => "WORSE",
                Verdict::Gone => "GONE",
                Verdict::Changed => "",
            };
            let after = change.after.map_or_else(|| "-".to_owned(), |after| format!("{after:.5}"));
            [change.path.clone(), format!("{:.5}", change.before), after, verdict.to_owned()]
        };
        write!(out, "{}", table(["figure", "before", "after", ""], self.changes.iter().map(row)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn verdicts(before: &Value, after: &Value) -> Vec<(String, Verdict)> {
        let changes = compared("a", before, after).changes;
        changes.into_iter().map(|change| (change.path, change.verdict)).collect()
    }

    #[test]
    fn each_metric_has_its_direction() {
        let before = json!({"stats": {"flip": 0.06, "psnr_db": 35.0, "ssim": 0.9, "hole_fraction": 0.001,
            "mbit_per_s": {"atlas": 6.0}}, "motion": {"max_error_mm": 1.0}});
        let after = json!({"stats": {"flip": 0.05, "psnr_db": 36.0, "ssim": 0.95, "hole_fraction": 0.0001,
            "mbit_per_s": {"atlas": 5.0}}, "motion": {"max_error_mm": 0.5}});
        let better = verdicts(&before, &after);
        assert_eq!(better.len(), 6);
        assert!(better.iter().all(|(_, verdict)| *verdict == Verdict::Better), "{better:?}");
        let worse = verdicts(&after, &before);
        assert!(worse.len() == 6 && worse.iter().all(|(_, verdict)| *verdict == Verdict::Worse), "{worse:?}");
    }

    #[test]
    fn noise_is_no_change() {
        let before = json!({"flip": 0.06, "psnr_db": 35.0, "all_mbit_s": 6.0, "hole_fraction": 0.001});
        let after = json!({"flip": 0.0605, "psnr_db": 34.95, "all_mbit_s": 6.04, "hole_fraction": 0.00105});
        assert_eq!(verdicts(&before, &after), []);
    }

    #[test]
    fn times_are_reported_and_fail_nothing() {
        let before = json!({"update_ms": 10.0, "gpu_ms": {"skin": 1.0}, "client_fps": 70.0, "mean_qp": 30.0});
        let after = json!({"update_ms": 20.0, "gpu_ms": {"skin": 9.0}, "client_fps": 7.0, "mean_qp": 31.0});
        let found = verdicts(&before, &after);
        assert!(
            found.len() == 4 && found.iter().all(|(_, verdict)| *verdict == Verdict::Changed),
            "{found:?}"
        );
    }

    #[test]
    fn a_row_is_found_by_its_words_wherever_it_stands() {
        let row = |link: &str, flip: f64| json!({"link": link, "flip": flip, "command": format!("{flip}")});
        let before = json!({"rows": [row("LAN", 0.03), row("20 ms", 0.05)]});
        let after = json!({"rows": [row("20 ms", 0.05), row("LAN", 0.09)]});
        assert_eq!(verdicts(&before, &after), [("rows/LAN/flip".to_owned(), Verdict::Worse)]);
    }

    #[test]
    fn a_better_video_is_no_regression() {
        let of = |flip: f64, ours: f64| {
            json!({"links": [{"link": "latency=20ms", "ours": {"flip": ours},
            "videos": [{"method": {"video": {"rate_hz": 30.0, "has_depth": true}}, "flip": flip}]}]})
        };
        let found = verdicts(&of(0.08, 0.06), &of(0.07, 0.06));
        assert_eq!(found, [("links/latency=20ms/videos/has_depth, 30.0/flip".to_owned(), Verdict::Changed)]);
        assert_eq!(verdicts(&of(0.08, 0.06), &of(0.08, 0.07))[0].1, Verdict::Worse);
    }

    #[test]
    fn folders_are_compared_by_names_and_say_both_commits() {
        let [before, after] = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
        let write = |folder: &tempfile::TempDir, name: &str, record: Value| {
            std::fs::write(folder.path().join(name), record.to_string()).expect("written");
        };
        write(&before, "run.json", json!({"commit": "aaa", "command": "a", "flip": 0.05, "ssim": 0.9}));
        write(&after, "run.json", json!({"commit": "bbb", "flip": 0.07, "ssim": null}));
        write(&before, "old.json", json!({"flip": 1.0}));
        let found = compare(before.path(), after.path()).expect("two folders");
        assert_eq!(found.regressions(), 2);
        let text = found.to_string();
        for said in ["run: aaa -> bbb, with other commands", "WORSE", "GONE", "only in the first: old"] {
            assert!(text.contains(said), "{said} is missing in {text}");
        }
        assert!(compare(before.path(), &after.path().join("run.json")).is_err());
        let file = before.path().join("run.json");
        assert_eq!(compare(&file, &file).expect("two files").regressions(), 0);
    }
}
