//! Colours go from one picture to the next while that is on display: shadows that move lie where they are at each display time.

use shadecast_lab::experiments::run::run;
use shadecast_lab::report::stats::Stats;
use shadecast_lab::session::options::{Head, RunOptions};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use std::path::Path;

fn dragon(folder: &Path, blends: bool) -> Stats {
    let scene = SceneSource::Dragons(1);
    let options = RunOptions {
        extent_pixels: [160, 160],
        atlas_extent_texels: AtlasExtent::new(2048, 1024).expect("an atlas"),
        head: Head::Named("still".to_owned()),
        seconds: 1.2,
        compare_from: 40,
        compare_every: 5,
        link: "latency=20ms".parse().expect("a link"),
        validation: true,
        blends,
        ..RunOptions::new(scene, folder.join(blends.to_string()))
    };
    let stats = run(&options).expect("a run").stats;
    println!("blends: {blends}: {stats}");
    stats
}

#[test]
fn moving_shadows_are_nearer_to_the_truth() {
    let folder = tempfile::tempdir().expect("a folder");
    // This file has one test, and no thread has been started yet: the environment is its own.
    let (without, with) = (dragon(folder.path(), false), dragon(folder.path(), true));
    assert_eq!((without.validation_messages, with.validation_messages), (Some(0), Some(0)));
    let (psnr, ssim) = (
        |stats: &Stats| stats.shadowed.psnr_db.expect("compared"),
        |stats: &Stats| stats.shadowed.ssim.expect("compared"),
    );
    assert!(psnr(&with) > psnr(&without) + 0.25, "{} and {} dB", psnr(&with), psnr(&without));
    assert!(ssim(&with) > ssim(&without) + 0.003, "{} and {}", ssim(&with), ssim(&without));
    // What moves is shaded for later than the middle of an update, and blends there.
    let animated = |stats: &Stats| stats.animated.psnr_db.expect("compared");
    assert!(animated(&with) > animated(&without) - 0.1, "{} and {} dB", animated(&with), animated(&without));
}
