//! Cutouts on the client: the gaps between the leaves of a curtain, in pictures of the whole system. Validation is on.

use shadecast_lab::experiments::run::run;
use shadecast_lab::image::Rgb8Image;
use shadecast_lab::scenes::leaves::write_leaves;
use shadecast_lab::session::options::{Renderer, RunOptions};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use shadecast_test_support::headset::turn;

/// Runs the room of leaves; gives the share of pixels where the last pictures of both eyes are of another colour than the
/// truth's: leaf for wall, or wall for leaf.
#[track_caller]
fn share_of_other_colour(sway: bool, renderer: Renderer) -> (f64, f64) {
    let out = tempfile::tempdir().unwrap();
    let options = RunOptions {
        extent_pixels: [128, 128],
        atlas_extent_texels: AtlasExtent::new(1024, 1024).expect("an atlas"),
        seconds: 1.0,
        compare_every: 9,
        validation: true,
        renderer,
        ..RunOptions::new(SceneSource::File(write_leaves(out.path(), sway).unwrap()), out.path().to_owned())
    };
    let report = run(&options).unwrap();
    println!("{}", report.stats);
    assert_eq!((report.stats.validation_messages, report.runtime_errors), (Some(0), 0));
    let read = |name: String| Rgb8Image::read_png(&out.path().join(name)).unwrap();
    let is_leaf = |[r, g, _]: [u8; 3]| g > r;
    let (mut differing, mut pixels) = (0, 0);
    for side in ["left", "right"] {
        let [client, truth] = ["client", "truth"].map(|who| read(format!("{who}-{side}.png")));
        for (x, y) in (0..truth.height).flat_map(|y| (0..truth.width).map(move |x| (x, y))) {
            differing += usize::from(is_leaf(client.pixel(x, y)) != is_leaf(truth.pixel(x, y)));
            pixels += 1;
        }
    }
    (differing as f64 / pixels as f64, report.stats.psnr_db.expect("views were compared"))
}

#[test]
fn walls_show_between_leaves_as_they_do_in_the_truth() {
    let _turn = turn();
    for renderer in [Renderer::Local, Renderer::Stream] {
        let (share, psnr_db) = share_of_other_colour(false, renderer);
        println!("still, {renderer:?}: {:.2} % of another colour, {psnr_db:.2} dB", 100.0 * share);
        assert!(share < 0.04 && psnr_db > 24.0, "{renderer:?}: {share} {psnr_db}");
    }
}

#[test]
fn leaves_that_sway_are_cut_out_all_the_same() {
    let _turn = turn();
    let (share, psnr_db) = share_of_other_colour(true, Renderer::Stream);
    println!("swaying: {:.2} % of another colour, {psnr_db:.2} dB", 100.0 * share);
    assert!(share < 0.04 && psnr_db > 24.0, "{share} {psnr_db}");
}
