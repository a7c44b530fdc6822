//! What is measured of the atlas beside videos: a usual case, and others that differ from it in one thing.

use super::{Job, LongScene, LongSource, NINE_DRAGONS, SCENES};
use crate::experiments::quality::{self, Compared, LATENCIES_MS};
use crate::session::options::{Head, RunOptions};
use anyhow::Context;
use shadecast_server::pacing::quality::QualityOptions;
use std::path::Path;

/// A scene, a head and a link.
#[derive(Clone, Copy)]
struct Case {
    scene: LongScene,
    head: &'static str,
    latency_ms: f64,
    lost_percent: f64,
    mbit_per_s: f64,
}

const USUAL: Case =
    Case { scene: NINE_DRAGONS, head: "stride", latency_ms: 20.0, lost_percent: 0.0, mbit_per_s: 6.0 };
/// As many bits a pixel as 5, 10, 50 and 100 Mbit/s are for 730x730 pixels an eye; the usual rate is 20.
const OTHER_RATES: [f64; 4] = [1.5, 3.0, 15.0, 30.0];
const OTHER_HEADS: [&str; 4] = ["sit", "walk", "peek", "abrupt"];
const FAR_MS: f64 = 110.0;
const OTHER_SCENES: [LongScene; 6] = [
    SCENES[1],
    SCENES[9],
    LongScene { name: "hall", source: LongSource::Hall, clip: None },
    SCENES[8],
    LongScene { name: "leaves", source: LongSource::Leaves, clip: None },
    COURTYARD,
];
const COURTYARD: LongScene = LongScene { name: "courtyard", source: LongSource::Courtyard, clip: None };

impl Case {
    /// Of its record: what is as usual is left out.
    fn name(&self) -> String {
        let Self { scene, head, latency_ms, lost_percent, mbit_per_s } = self;
        let head = if *head == USUAL.head { String::new() } else { format!("-{head}") };
        let lost = if *lost_percent > 0.0 { format!("-lost-{lost_percent}") } else { String::new() };
        let rate = if *mbit_per_s == USUAL.mbit_per_s { String::new() } else { format!("-{mbit_per_s}mbit") };
        format!("quality-{}{head}-{latency_ms}ms{lost}{rate}", scene.name)
    }

    fn options(&self, folder: &Path) -> anyhow::Result<Option<(RunOptions, String)>> {
        let Some((source, shown)) = self.scene.found(folder)? else { return Ok(None) };
        let options = RunOptions {
            head: Head::Named(self.head.to_owned()),
            quality: QualityOptions::Bitrate(self.mbit_per_s),
            ..quality::usual(source, folder.join("run"))
        };
        Ok(Some((options, shown)))
    }
}

/// Those that differ in the latency alone.
fn usual() -> [Case; LATENCIES_MS.len()] {
    LATENCIES_MS.map(|latency_ms| Case { latency_ms, ..USUAL })
}

fn others() -> Vec<Case> {
    let mut cases = OTHER_HEADS.map(|head| Case { head, ..USUAL }).to_vec();
    cases.extend(["peek", "abrupt"].map(|head| Case { head, latency_ms: FAR_MS, ..USUAL }));
    cases.extend(OTHER_SCENES.map(|scene| Case { scene, ..USUAL }));
    cases.push(Case { scene: COURTYARD, head: "peek", ..USUAL });
    cases.push(Case { lost_percent: 1.0, ..USUAL });
    cases.extend(OTHER_RATES.map(|mbit_per_s| Case { mbit_per_s, ..USUAL }));
    cases
}

/// A job a case. The usual ones have the other atlases too.
pub(super) fn jobs() -> Vec<Job> {
    let job = |case: Case, compared: Compared| {
        Job::new(&case.name(), move |folder| {
            let Some((options, shown)) = case.options(folder)? else { return Ok(None) };
            let links = [quality::link(case.latency_ms, case.lost_percent)];
            let found = quality::measure(&options, &shown, &links, &compared)?;
            print!("{found}");
            serde_json::to_value(found).context("a record").map(Some)
        })
    };
    let of_usual = usual().map(|case| job(case, Compared::default()));
    let of_others = others().into_iter().map(|case| job(case, Compared::with_videos_alone()));
    of_usual.into_iter().chain(of_others).collect()
}

/// The names of all records, the usual ones first.
pub fn names() -> Vec<String> {
    usual().iter().chain(&others()).map(Case::name).collect()
}

/// The name of the usual record over so many milliseconds.
pub fn usual_name(latency_ms: f64) -> String {
    Case { latency_ms, ..USUAL }.name()
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_scene::load::load_head_path;

    #[test]
    fn names_say_what_is_not_as_usual() {
        assert_eq!(USUAL.name(), "quality-dragons9-20ms");
        let case = Case { head: "peek", latency_ms: 110.0, lost_percent: 1.0, mbit_per_s: 1.5, ..USUAL };
        assert_eq!(case.name(), "quality-dragons9-peek-110ms-lost-1-1.5mbit");
    }

    #[test]
    fn every_head_that_is_named_is_there() {
        let folder = tempfile::tempdir().expect("a folder");
        for case in others().into_iter().filter(|case| !matches!(case.scene.source, LongSource::Asset(_))) {
            let (options, _) = case.options(folder.path()).expect("written").expect("made here");
            load_head_path(&options.scene, case.head).expect("it has this path");
        }
    }
}
