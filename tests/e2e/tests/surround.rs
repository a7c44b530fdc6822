//! A still head that suddenly turns and moves at full speed, over a link with long delay, in virtual time.

use shadecast_lab::experiments::abrupt::{AbruptReport, measure};
use shadecast_lab::scenes::room::write_room;
use shadecast_lab::session::options::RunOptions;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use std::path::Path;

fn abrupt(folder: &Path, surround: f32) -> AbruptReport {
    let scene = SceneSource::File(write_room(folder, [2, 1]).expect("a room"));
    let options = RunOptions {
        extent_pixels: [64, 64],
        atlas_extent_texels: AtlasExtent::new(1024, 1024).expect("an atlas"),
        link: "latency=110ms,jitter=10ms,rate=100mbit".parse().expect("a link"),
        surround,
        ..RunOptions::new(scene, folder.join("run"))
    };
    let report = measure(&options).expect("a run");
    println!("surround {surround}: {report}");
    report
}

#[test]
fn an_abrupt_turn_over_a_long_way_shows_no_emptiness() {
    let folder = tempfile::tempdir().expect("a folder");
    // This file has one test, and no thread has been started yet: the environment is its own.
    let without = abrupt(folder.path(), 0.0);
    assert!(without.worst_hole_fraction > 0.1, "there is something to miss: {without}");
    let with = abrupt(folder.path(), 0.25);
    assert!(with.worst_hole_fraction < 0.015, "{with}");
}
