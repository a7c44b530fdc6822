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

fn cases() -> Vec<Case> {
    let mut cases = LATENCIES_MS.map(|latency_ms| Case { latency_ms, ..USUAL }).to_vec();
    cases.extend(OTHER_HEADS.map(|head| Case { head, ..USUAL }));
    cases.extend(["peek", "abrupt"].map(|head| Case { head, latency_ms: FAR_MS, ..USUAL }));
    cases.extend(OTHER_SCENES.map(|scene| Case { scene, ..USUAL }));
    cases.push(Case { scene: COURTYARD, head: "peek", ..USUAL });
    cases.push(Case { lost_percent: 1.0, ..USUAL });
    cases.extend(OTHER_RATES.map(|mbit_per_s| Case { mbit_per_s, ..USUAL }));
    cases
}

/// A job a case. Those that differ in the latency alone have the other atlases too.
pub(super) fn jobs() -> Vec<Job> {
    let job = |case: Case| {
        let is_usual = case.name() == Case { latency_ms: case.latency_ms, ..USUAL }.name();
        Job::new(&case.name(), move |folder| {
            let Some((options, shown)) = case.options(folder)? else { return Ok(None) };
            let compared = if is_usual { Compared::default() } else { Compared::with_videos_alone() };
            let links = [quality::link(case.latency_ms, case.lost_percent)];
            let found = quality::measure(&options, &shown, &links, &compared)?;
            print!("{found}");
            serde_json::to_value(found).context("a record").map(Some)
        })
    };
    cases().into_iter().map(job).collect()
}

/// The names of all records, the usual ones first.
pub fn names() -> Vec<String> {
    cases().iter().map(Case::name).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_say_what_is_not_as_usual() {
        assert_eq!(USUAL.name(), "quality-dragons9-20ms");
        let case = Case { head: "peek", latency_ms: 110.0, lost_percent: 1.0, mbit_per_s: 1.5, ..USUAL };
        assert_eq!(case.name(), "quality-dragons9-peek-110ms-lost-1-1.5mbit");
    }

    #[test]
    fn every_head_that_is_named_is_there() {
        let folder = tempfile::tempdir().expect("a folder");
        for case in cases().into_iter().filter(|case| !matches!(case.scene.source, LongSource::Asset(_))) {
            let (options, _) = case.options(folder.path()).expect("written").expect("made here");
            if let (Head::Named(name), LongSource::Dragons(_) | LongSource::Courtyard) =
                (&options.head, case.scene.source)
            {
                shadecast_scene::load::load_head_path(&options.scene, name).expect("it has this path");
            }
        }
    }
}
