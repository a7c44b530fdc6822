//! The table of causes, at a size for a software device: runs without a cause are otherwise the same runs, and better by the
//! cost of the cause.

use shadecast_lab::experiments::causes::{Cause, Mask, Row, measure, usual};
use shadecast_lab::experiments::run::run;
use shadecast_lab::scenes::walls::{TEXELS, write_walls};
use shadecast_lab::session::options::{Renderer, RunOptions, Spared};
use shadecast_lab::session::originals::Arrival;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use shadecast_server::pacing::quality::{DEFAULT_QP, QualityOptions};
use shadecast_server::pacing::relief::{Measure, Measures};
use shadecast_server::shading::filter::Filter;
use shadecast_server::update::policy::UpdatePolicy;
use shadecast_test_support::headset::turn;
use shadecast_transport::LinkProfile;
use std::path::Path;

fn small(scene: SceneSource, out: &Path) -> RunOptions {
    RunOptions {
        extent_pixels: [128, 128],
        atlas_extent_texels: AtlasExtent::new(1024, 1024).expect("an atlas"),
        seconds: 0.6,
        compare_from: 29,
        validation: true,
        ..usual(scene, out.to_owned())
    }
}

#[test]
fn each_removed_cause_improves_the_picture_worst_first() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let causes = [Cause::Density, Cause::ShadowTime, Cause::Outlines, Cause::Quantisation];
    // One quantiser for all: what a cause leaves must not be what its bits bought.
    let quality = QualityOptions::Constant(DEFAULT_QP);
    let options = RunOptions { quality, ..small(SceneSource::Dragons(1), out.path()) };
    let found = measure(&options, "dragon", &causes).unwrap();
    println!("{found}");
    assert_eq!((found.rows.len(), found.shipped.len(), found.views), (3 * causes.len(), 3, 6));
    let of = |cause: Cause, mask: Mask| -> Row {
        *found.rows.iter().find(|row| (row.cause, row.mask) == (cause, mask)).expect("measured")
    };
    for cause in [Cause::Density, Cause::Outlines, Cause::Quantisation] {
        assert!(of(cause, Mask::All).flip_gain > 0.0, "{:?}", of(cause, Mask::All));
    }
    let shadow = of(Cause::ShadowTime, Mask::Shadowed);
    assert!(shadow.psnr_gain_db > 0.1 && shadow.flip_gain > 0.0, "{shadow:?}");
    for mask in [Mask::All, Mask::Animated, Mask::Shadowed] {
        let gains: Vec<f64> = found.rows.iter().filter(|r| r.mask == mask).map(|r| r.flip_gain).collect();
        assert!(gains.is_sorted_by(|a, b| a >= b), "{mask:?}: {gains:?}");
    }
}

#[test]
fn an_atlas_that_arrives_uncoded_changes_no_time() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let coded = small(SceneSource::Dragons(1), out.path());
    let spared = Spared { arrival: Arrival::FullChroma, ..Spared::default() };
    let uncoded = RunOptions { spared, ..coded.clone() };
    let [coded, uncoded] = [coded, uncoded].map(|options| run(&options).unwrap());
    assert_eq!(coded.compared, uncoded.compared, "the same updates at the same times");
    assert_eq!(coded.stats.mbit_per_s, uncoded.stats.mbit_per_s, "the same bytes on the way");
    assert!(coded.stats.psnr_db < uncoded.stats.psnr_db);
    assert_eq!(uncoded.stats.validation_messages, Some(0));
}

#[test]
fn filtering_for_display_pixels_is_nearer_to_the_truth() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let walls = SceneSource::File(write_walls(out.path(), TEXELS).unwrap());
    let [pixel, texel] = [Filter::Pixel, Filter::Texel].map(|filter| {
        let policy = UpdatePolicy { filter, ..UpdatePolicy::default() };
        let spared = Spared { policy, ..Spared::default() };
        let link = LinkProfile::default().into();
        let renderer = Renderer::Local;
        run(&RunOptions { spared, link, renderer, ..small(walls.clone(), &out.path().join("run")) })
            .unwrap()
            .stats
    });
    assert!(pixel.psnr_db > texel.psnr_db.map(|db| db + 0.5), "{:?}, {:?}", pixel.psnr_db, texel.psnr_db);
    assert!(pixel.flip < texel.flip, "{:?}, {:?}", pixel.flip, texel.flip);
    assert_eq!(texel.validation_messages, Some(0));
}

/// Light of a filtered texture is not the mean of its texels' light: one sample is too bright, and has no detail.
#[test]
fn four_samples_of_a_pixel_are_nearer_to_the_truth_than_one() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let walls = SceneSource::File(write_walls(out.path(), TEXELS).unwrap());
    let [four, one] = [Measures::default(), Measures::only(Measure::OneSample)].map(|measures| {
        let policy = UpdatePolicy { measures: Some(measures), ..UpdatePolicy::default() };
        let spared = Spared { policy, ..Spared::default() };
        let (link, renderer) = (LinkProfile::default().into(), Renderer::Local);
        let of_walls = small(walls.clone(), &out.path().join("run"));
        run(&RunOptions { spared, link, renderer, truth_places: 4, ..of_walls }).unwrap().stats
    });
    println!("{:?} {:?} {:?} {:?}", four.psnr_db, one.psnr_db, four.flip, one.flip);
    assert!(four.psnr_db > one.psnr_db.map(|db| db + 1.0), "{:?}, {:?}", four.psnr_db, one.psnr_db);
    assert!(four.flip < one.flip.map(|flip| 0.9 * flip), "{:?}, {:?}", four.flip, one.flip);
    assert_eq!([four, one].map(|stats| stats.validation_messages), [Some(0); 2]);
}

#[test]
fn reused_blocks_cost_at_most_a_fifth_of_a_decibel() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let walls = SceneSource::File(write_walls(out.path(), TEXELS).unwrap());
    let [reused, all] = [true, false].map(|reuse| {
        let spared =
            Spared { policy: UpdatePolicy { reuse, ..UpdatePolicy::default() }, ..Spared::default() };
        // A store's copies are reused as well, and err in another way.
        run(&RunOptions { spared, store_pages: 0, ..small(walls.clone(), &out.path().join("run")) })
            .unwrap()
            .stats
    });
    let lost_db = all.psnr_db.zip(reused.psnr_db).map(|(all, reused)| all - reused);
    assert!(lost_db < Some(0.2), "{:?}, {:?}", reused.psnr_db, all.psnr_db);
    assert!(reused.reused_share > 0.5 && all.reused_share == 0.0, "{}", reused.reused_share);
    // Most of the bits are those of the first updates, in both runs.
    assert!(reused.mbit_per_s.atlas < 1.01 * all.mbit_per_s.atlas, "the encoder skips what stays");
    assert_eq!((reused.validation_messages, all.validation_messages), (Some(0), Some(0)));
}
