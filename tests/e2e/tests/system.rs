//! The whole system in virtual time, at the size that a software device can do in a test: quality against the ground
//! truth, motion between updates, and the same pictures twice. Validation layers are on throughout.

use shadecast_lab::options::{Renderer, RunOptions};
use shadecast_lab::run::{Report, run};
use shadecast_mock_runtime::record::read_frames;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use std::path::Path;
use std::sync::{Mutex, MutexGuard};

/// The OpenXR loader and the mock runtime read the process's environment: one run at a time.
static ENVIRONMENT: Mutex<()> = Mutex::new(());

fn alone() -> MutexGuard<'static, ()> {
    ENVIRONMENT.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

fn small(scene: SceneSource, out: &Path) -> RunOptions {
    RunOptions {
        extent_pixels: [192, 192],
        atlas_extent_texels: AtlasExtent::new(1024, 1024).expect("an atlas"),
        seconds: 1.6,
        compare_every: 9,
        validation: true,
        motion: true,
        ..RunOptions::new(scene, out.to_owned())
    }
}

#[track_caller]
fn assert_good(report: &Report, what: &str) {
    let stats = &report.stats;
    println!("{what}:\n{stats}\n{:?}", report.motion);
    assert_eq!(stats.validation_messages, 0, "{what}");
    assert_eq!(report.runtime_errors, 0, "{what}: calls that the OpenXR runtime refused");
    assert!(stats.frames_compared >= 10, "{what}: {} views compared", stats.frames_compared);
    assert_eq!(stats.frames_without_bundle, 0, "{what}: after the first bundle there is always one");
    assert!(stats.psnr_db.is_some_and(|db| db >= 30.0), "{what}: PSNR {:?}", stats.psnr_db);
    assert!(stats.flip.is_some_and(|flip| flip <= 0.10), "{what}: FLIP {:?}", stats.flip);
    assert!(
        stats.hole_fraction.is_some_and(|holes| holes <= 0.005),
        "{what}: holes {:?}",
        stats.hole_fraction
    );
}

#[test]
fn a_dragon_over_a_simulated_link_looks_like_the_truth_and_moves_between_updates() {
    let _alone = alone();
    let out = tempfile::tempdir().unwrap();
    let report = run(&small(SceneSource::Dragons(1), out.path())).unwrap();
    assert_good(&report, "dragon, stream");
    let motion = report.motion.expect("vertices were followed");
    assert!(motion.vertices > 50, "{motion:?}");
    assert!(motion.moved_share > 0.99, "vertices move at every display frame: {motion:?}");
    assert!(motion.p99_error_percent_of_range <= 0.3, "{motion:?}");
    assert!(report.stats.bytes_per_animated_vertex_sample.is_some_and(|bytes| bytes < 4.5));
    for name in
        ["stats.json", "sheet.png", "atlas.png", "client-left.png", "truth-right.png", "difference-left.png"]
    {
        assert!(out.path().join(name).metadata().is_ok_and(|m| m.len() > 0), "{name} is missing");
    }
}

#[test]
fn the_local_renderer_hands_over_in_memory_and_looks_like_the_truth() {
    let _alone = alone();
    let out = tempfile::tempdir().unwrap();
    let options = RunOptions { renderer: Renderer::Local, ..small(SceneSource::Dragons(1), out.path()) };
    let report = run(&options).unwrap();
    assert_good(&report, "dragon, local");
    assert_eq!(report.stats.mbit_per_s.atlas, 0.0, "nothing is encoded");
}

#[test]
fn the_forward_renderer_compared_with_itself_is_perfect() {
    let _alone = alone();
    let out = tempfile::tempdir().unwrap();
    let options = RunOptions {
        renderer: Renderer::Forward,
        seconds: 0.5,
        motion: false,
        ..small(SceneSource::Dragons(1), out.path())
    };
    let stats = run(&options).unwrap().stats;
    assert_eq!(stats.psnr_db, Some(shadecast_lab::metrics::MAX_PSNR_DB));
    assert_eq!(stats.flip, Some(0.0));
}

#[test]
fn two_runs_in_virtual_time_give_identical_pictures() {
    let _alone = alone();
    let run_once = || {
        let out = tempfile::tempdir().unwrap();
        let options = RunOptions {
            extent_pixels: [96, 96],
            seconds: 0.7,
            compare_every: 7,
            motion: false,
            ..small(SceneSource::Dragons(1), out.path())
        };
        run(&options).unwrap();
        let capture = out.path().join("capture");
        let frames = read_frames(&capture).unwrap();
        let pictures: Vec<Vec<u8>> = frames
            .iter()
            .filter(|frame| frame.captured)
            .flat_map(|frame| {
                use shadecast_mock_runtime::record::{Side, picture_path};
                [Side::Left, Side::Right]
                    .map(|side| std::fs::read(picture_path(&capture, frame.frame, side)).unwrap())
            })
            .collect();
        (frames, pictures)
    };
    let (first, second) = (run_once(), run_once());
    assert!(first.1.len() >= 8, "{} pictures", first.1.len());
    assert_eq!(first.0, second.0, "poses and times");
    assert!(first.1 == second.1, "pictures differ");
}

#[test]
fn real_models_look_like_the_truth() {
    let _alone = alone();
    for file in ["CesiumMan.glb", "Fox.glb"] {
        let Some(path) = shadecast_lab::long::asset(file) else {
            eprintln!("SKIPPED: {file} is not there; the project ships no models of others");
            continue;
        };
        let out = tempfile::tempdir().unwrap();
        let options = RunOptions { motion: false, ..small(SceneSource::File(path), out.path()) };
        assert_good(&run(&options).unwrap(), file);
    }
}
