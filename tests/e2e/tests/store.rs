//! Blocks that no longer change, in the client's store: pictures are as they were without.

use shadecast_lab::experiments::run::run;
use shadecast_lab::image::Rgb8Image;
use shadecast_lab::report::stats::Stats;
use shadecast_lab::scenes::room::write_room;
use shadecast_lab::session::options::{Head, Renderer, RunOptions};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use std::path::Path;

fn room(folder: &Path, store_pages: u32) -> Stats {
    let scene = SceneSource::File(write_room(folder, [2, 1]).expect("a room"));
    let options = RunOptions {
        renderer: Renderer::Local,
        extent_pixels: [96, 96],
        atlas_extent_texels: AtlasExtent::new(1024, 1024).expect("an atlas"),
        head: Head::Named("still".to_owned()),
        seconds: 2.0,
        compare_from: 100,
        validation: true,
        store_pages,
        ..RunOptions::new(scene, folder.join(store_pages.to_string()))
    };
    let stats = run(&options).expect("a run").stats;
    println!("{store_pages} pages: {stats}");
    stats
}

/// Part of the atlas of a run that is grey at its end.
fn grey_part(folder: &Path, store_pages: u32) -> f64 {
    let atlas = folder.join(store_pages.to_string()).join("atlas.png");
    let atlas = Rgb8Image::read_png(&atlas).expect("an atlas");
    let is_grey = |at: u32| {
        let texel = atlas.pixel(at % atlas.width, at / atlas.width);
        texel.iter().all(|value| value.abs_diff(128) < 2)
    };
    let all = atlas.pixel_count() as u32;
    (0..all).filter(|at| is_grey(*at)).count() as f64 / f64::from(all)
}

#[test]
fn still_blocks_settle_and_look_as_they_did() {
    let folder = tempfile::tempdir().expect("a folder");
    // This file has one test, and no thread has been started yet: the environment is its own.
    let (without, with) = (room(folder.path(), 0), room(folder.path(), 2));
    assert_eq!((without.stored_blocks, with.validation_messages), (0, Some(0)));
    assert!(with.stored_blocks > 200, "{} blocks", with.stored_blocks);
    // A little blur: some texels of copies are smaller than half a pixel, and mip levels begin there.
    let decibels = |stats: &Stats| stats.psnr_db.expect("compared");
    assert!(decibels(&with) > decibels(&without) - 1.0, "{} and {}", decibels(&with), decibels(&without));
    assert!(with.hole_fraction <= without.hole_fraction, "{with}");
    // What is left in the atlas is grey: neither a refresh nor any other picture takes bits for it.
    let grey = [0, 2].map(|pages| grey_part(folder.path(), pages));
    assert!(1.0 - grey[1] < 0.1 * (1.0 - grey[0]), "{grey:?}");
}
