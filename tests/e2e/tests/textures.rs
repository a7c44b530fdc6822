//! Textures spread as far as a pixel: a picture is near to the mean of what its pixels cover.

use shadecast_lab::experiments::run::run;
use shadecast_lab::scenes::walls::{TEXELS, write_walls};
use shadecast_lab::session::options::{Head, Renderer, RunOptions};
use shadecast_scene::load::SceneSource;

#[test]
fn a_picture_is_near_to_the_mean_of_what_its_pixels_cover() {
    let folder = tempfile::tempdir().expect("a folder");
    let walls = write_walls(folder.path(), TEXELS).expect("walls");
    let options = RunOptions {
        renderer: Renderer::Local,
        extent_pixels: [96, 96],
        head: Head::Named("walk".to_owned()),
        seconds: 0.7,
        compare_from: 36,
        truth_places: 4,
        validation: true,
        ..RunOptions::new(SceneSource::File(walls), folder.path().join("run"))
    };
    // This file has one test, and no thread has been started yet: the environment is its own.
    let stats = run(&options).expect("a run").stats;
    println!("{stats}");
    assert_eq!(stats.validation_messages, Some(0));
    let (psnr_db, ssim) = (stats.psnr_db.expect("compared"), stats.ssim.expect("compared"));
    // Read at the usual mip levels it has 26.2 dB and 0.80.
    assert!(psnr_db > 27.0 && ssim > 0.85, "{psnr_db} dB, {ssim}");
}
