//! Eyes wider than one projection, in virtual time: geometry at their border is present. Validation is on.

use shadecast_lab::experiments::run::run;
use shadecast_lab::report::stats::Stats;
use shadecast_lab::scenes::room::write_room;
use shadecast_lab::session::options::{Renderer, RunOptions};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use std::path::Path;

fn look_around_in_a_room(folder: &Path, fov_degrees: f32) -> Stats {
    let scene = SceneSource::File(write_room(folder, [2, 1]).expect("a room"));
    let options = RunOptions {
        renderer: Renderer::Local,
        extent_pixels: [160, 160],
        fov_degrees,
        atlas_extent_texels: AtlasExtent::new(1024, 1024).expect("an atlas"),
        seconds: 0.8,
        compare_every: 9,
        validation: true,
        ..RunOptions::new(scene, folder.join(format!("{fov_degrees}")))
    };
    let report = run(&options).expect("a run");
    println!("{fov_degrees} degrees: {}", report.stats);
    assert_eq!((report.stats.validation_messages, report.runtime_errors), (Some(0), 0));
    report.stats
}

#[test]
fn an_eye_of_150_degrees_has_no_more_holes_than_a_usual_one() {
    let folder = tempfile::tempdir().expect("a folder");
    // This file has one test, and no thread has been started yet: the environment is its own.
    let [usual, wide] = [90.0, 150.0].map(|degrees| look_around_in_a_room(folder.path(), degrees));
    let holes = |stats: &Stats| stats.hole_fraction.expect("views were compared");
    assert!(holes(&wide) < holes(&usual) + 0.002, "{} and {}", holes(&wide), holes(&usual));
    assert!(wide.psnr_db.expect("views were compared") > 25.0, "{wide}");
}
