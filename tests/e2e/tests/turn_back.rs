//! A head that turns round within a frame, and back: what it has seen is in the client's store, as sharp as it was.

use shadecast_lab::experiments::run::{Look, run};
use shadecast_lab::scenes::walls::write_walls;
use shadecast_lab::session::options::{Head, RunOptions};
use shadecast_mock_runtime::head_path::COLUMNS;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use shadecast_transport::LinkProfile;
use std::fmt::Write as _;
use std::ops::Range;

const REFRESH_HZ: u64 = 72;
/// Display frames for which the head stays as it is.
const STAY_FRAMES: u64 = 2 * REFRESH_HZ;

/// Looks ahead, behind, and ahead again.
fn head_csv() -> String {
    let mut text = format!("{COLUMNS}\n");
    for frame in 0..=3 * STAY_FRAMES {
        let t_s = frame as f64 / REFRESH_HZ as f64;
        let turned = if (frame / STAY_FRAMES) % 2 == 1 { [1.0, 0.0] } else { [0.0, 1.0] };
        let _ = writeln!(text, "{t_s:.6},0,1.6,0,0,{},0,{}", turned[0], turned[1]);
    }
    text
}

#[test]
fn what_was_seen_is_sharp_in_the_first_frame_of_a_turn_back() {
    let folder = tempfile::tempdir().expect("a folder");
    let head = folder.path().join("head.csv");
    std::fs::write(&head, head_csv()).expect("a file");
    let options = RunOptions {
        extent_pixels: [96, 96],
        atlas_extent_texels: AtlasExtent::new(1024, 1024).expect("an atlas"),
        head: Head::File(head),
        seconds: 3.0 * STAY_FRAMES as f64 / REFRESH_HZ as f64,
        surround: 0.25,
        compare_every: 4,
        compare_from: STAY_FRAMES - 20,
        validation: true,
        store_pages: 2,
        link: "latency=20ms,jitter=10ms".parse::<LinkProfile>().expect("a link").into(),
        ..RunOptions::new(
            SceneSource::File(write_walls(folder.path(), 512).expect("a room")),
            folder.path().join("run"),
        )
    };
    // This file has one test, and no thread has been started yet: the environment is its own.
    let report = run(&options).expect("a run");
    let worst = |name: &str, frames: Range<u64>| {
        let looks = report.looks.iter().filter(|look| frames.contains(&look.frame));
        let flips: Vec<f64> = looks.filter_map(|look: &Look| look.flip).collect();
        println!("{name}: {flips:.4?}");
        flips.into_iter().fold(0.0, f64::max)
    };
    let before = worst("before the head turns", STAY_FRAMES - 20..STAY_FRAMES);
    let behind = worst("first frames behind", STAY_FRAMES..STAY_FRAMES + 4);
    let later = worst("later there", 2 * STAY_FRAMES - 20..2 * STAY_FRAMES);
    let back = worst("first frames back", 2 * STAY_FRAMES..2 * STAY_FRAMES + 24);
    assert_eq!(report.stats.validation_messages, Some(0));
    assert!(before > 0.0 && back < 1.02 * before, "{back} and {before}");
    // What was never seen is what the surround is: coarse at first.
    assert!(behind > 1.1 * later, "{behind} and {later}");
}
