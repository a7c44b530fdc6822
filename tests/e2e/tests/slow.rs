//! Slow devices in virtual time: how soon a picture comes, and what is missing of it. In virtual time an update takes the same whatever it
//! does without, so that this says nothing of measures.

use shadecast_lab::experiments::slow::measure;
use shadecast_lab::session::options::{RunOptions, StageMs};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;

#[test]
fn a_slow_device_shows_a_picture_after_one_update_and_soon_a_whole_one() {
    let out = tempfile::tempdir().expect("a folder");
    let options = RunOptions {
        extent_pixels: [128, 128],
        atlas_extent_texels: AtlasExtent::new(1024, 1024).expect("an atlas"),
        seconds: 5.0,
        stages: StageMs { server: 250.0, encode: 20.0, decode: 10.0, steps: None },
        ..RunOptions::new(SceneSource::Dragons(1), out.path().to_owned())
    };
    // This file has one test, and no thread has been started yet: the environment is its own.
    let report = measure(&options, "dragon", &[1.0, 2.8]).expect("two runs");
    println!("{report}");
    let [fast, slow] = &report.rows[..] else { panic!("{report}") };
    for row in [fast, slow] {
        // A connection, one update, and the frames in which it is taken in.
        let update_s = row.update_ms * 1e-3;
        assert!(row.first_picture_s < update_s + 0.35, "{row:?}");
        assert!(row.whole_picture_s.is_some_and(|whole_s| whole_s < 3.0 * update_s + 0.5), "{row:?}");
        assert!(row.updates_per_s * update_s > 0.8, "one after the other: {row:?}");
        assert!(row.holes.mean < 0.01 && row.holes.worst < 0.1, "{row:?}");
    }
    assert!(fast.flip < slow.flip, "{fast:?}, {slow:?}");
    assert!(out.path().join("sheet.png").exists());
}
