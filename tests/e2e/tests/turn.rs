//! A head that turns by 90 degrees to a wall full of things, on a slow device and a slow link, in virtual time.

use shadecast_lab::experiments::run::{Look, run};
use shadecast_lab::scenes::room::{MANY_VASES, write_room};
use shadecast_lab::session::options::{Head, RunOptions, StageMs};
use shadecast_mock_runtime::head_path::COLUMNS;
use shadecast_scene::load::SceneSource;
use shadecast_transport::LinkProfile;
use std::fmt::Write as _;

const REFRESH_HZ: f64 = 72.0;
/// The head stands still for so long, seconds, then turns, then stands again.
const STILL_S: f64 = 6.0;
const TURN_S: f64 = 1.0;
const AFTER_S: f64 = 4.0;
/// One update takes so long, seconds.
const UPDATE_S: f64 = 0.7;

fn head_csv() -> String {
    let mut text = format!("{COLUMNS}\n");
    for frame in 0..=((STILL_S + TURN_S + AFTER_S + 1.0) * REFRESH_HZ) as u32 {
        let t_s = f64::from(frame) / REFRESH_HZ;
        let turned_degrees = 90.0 * ((t_s - STILL_S) / TURN_S).clamp(0.0, 1.0);
        let (sin, cos) = (0.5 * turned_degrees.to_radians()).sin_cos();
        let _ = writeln!(text, "{t_s:.6},0,1.6,0,0,{sin:.9},0,{cos:.9}");
    }
    text
}

#[test]
fn what_a_turn_shows_is_whole_with_the_first_update_of_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let head = folder.path().join("turn.csv");
    std::fs::write(&head, head_csv()).expect("a file");
    let options = RunOptions {
        extent_pixels: [128, 128],
        head: Head::File(head),
        seconds: STILL_S + TURN_S + AFTER_S,
        surround: 0.25,
        compare_every: 6,
        compare_from: (STILL_S * REFRESH_HZ) as u64,
        stages: StageMs { server: 1e3 * UPDATE_S, ..StageMs::default() },
        link: "latency=20ms,rate=0.4mbit".parse::<LinkProfile>().expect("a link").into(),
        ..RunOptions::new(
            SceneSource::File(write_room(folder.path(), MANY_VASES).expect("a room")),
            folder.path().join("run"),
        )
    };
    // This file has one test, and no thread has been started yet: the environment is its own.
    let report = run(&options).expect("a run");
    let after_s = |frame: u64| frame as f64 / REFRESH_HZ - STILL_S - TURN_S;
    let line = |look: &Look| format!("{:.2} s: {:.2} %", after_s(look.frame), 100.0 * look.holes);
    println!(
        "missing, after the turn's end: {}",
        report.looks.iter().map(line).collect::<Vec<_>>().join(", ")
    );
    // The surround, in parts.
    assert!(report.looks.iter().all(|look| look.holes < 0.06));
    // From the first update on that was begun while the head turned.
    let shown = report.looks.iter().filter(|look| after_s(look.frame) > 1.3 * UPDATE_S);
    let holes: Vec<f64> = shown.map(|look| look.holes).collect();
    let mean = holes.iter().sum::<f64>() / holes.len() as f64;
    println!("mean from the first update on: {:.2} %", 100.0 * mean);
    assert!(holes.len() > 20 && mean < 0.0075 && holes.iter().all(|holes| *holes < 0.02), "{mean}");
}
