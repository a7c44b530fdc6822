//! A video of both eyes, as the atlas is compared with: it must be no weaker than it could be.

use shadecast_lab::experiments::quality::{self, Compared, Method, Video};
use shadecast_lab::experiments::run::run;
use shadecast_lab::report::stats::Stats;
use shadecast_lab::scenes::walls::{TEXELS, write_walls};
use shadecast_lab::session::options::{Head, Renderer, RunOptions};
use shadecast_scene::load::SceneSource;
use shadecast_server::pacing::quality::QualityOptions;
use shadecast_test_support::headset::turn;
use shadecast_transport::LinkProfile;
use std::path::Path;

fn small(out: &Path, head: &str, quality: QualityOptions) -> RunOptions {
    let link: LinkProfile = "latency=20ms,jitter=10ms".parse().expect("a link");
    RunOptions {
        renderer: Renderer::Video,
        link: link.into(),
        head: Head::Named(head.to_owned()),
        extent_pixels: [128, 128],
        seconds: 1.2,
        compare_from: 44,
        truth_places: 2,
        quality,
        validation: true,
        ..RunOptions::new(SceneSource::File(write_walls(out, TEXELS).expect("a room")), out.join("run"))
    }
}

fn stats(options: &RunOptions) -> Stats {
    let stats = run(options).unwrap().stats;
    assert_eq!(stats.validation_messages, Some(0));
    stats
}

/// With a fine quantiser nothing is lost but the filter of the time-warp and hues between pixels; a head that turns is foreseen.
#[test]
fn a_still_head_sees_the_truth_and_a_turning_one_nearly() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let [still, turning] = ["still", "turn"].map(|head| {
        let fine = small(out.path(), head, QualityOptions::Constant(10));
        stats(&RunOptions { video_margin_degrees: if head == "still" { 0.0 } else { 10.0 }, ..fine })
    });
    println!("{:?} {:?}, {:?} {:?}", still.psnr_db, still.flip, turning.psnr_db, turning.flip);
    assert!(still.psnr_db > Some(31.0) && still.flip < Some(0.05), "{:?}, {:?}", still.psnr_db, still.flip);
    assert!(turning.psnr_db_worst > Some(22.0), "{:?}", turning.psnr_db_worst);
    assert_eq!(still.hole_fraction, Some(0.0), "a video has no holes");
}

/// What moves is rendered for when it is seen, however long the way is.
#[test]
fn a_still_head_sees_what_moves_alike_over_a_short_and_a_long_way() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let [near, far] = ["latency=5ms", "latency=110ms"].map(|link| {
        let link: LinkProfile = link.parse().expect("a link");
        let fine = small(out.path(), "still", QualityOptions::Constant(16));
        let scene = SceneSource::Dragons(1);
        let compare_every = 5; // each moment of a picture's time on display
        stats(&RunOptions { link: link.into(), scene, compare_every, seconds: 1.6, compare_from: 72, ..fine })
    });
    let [near_flip, far_flip] = [&near, &far].map(|stats| stats.animated.flip.expect("a dragon is seen"));
    assert!((far_flip / near_flip - 1.0).abs() < 0.2, "{near_flip}, {far_flip}");
}

#[test]
fn a_video_takes_the_bits_that_it_may() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let rate = |mbit_per_s| small(out.path(), "stride", QualityOptions::Bitrate(mbit_per_s));
    let [few, more] = [0.5, 2.0].map(|mbit_per_s| stats(&RunOptions { seconds: 2.0, ..rate(mbit_per_s) }));
    let [few_mbit, more_mbit] = [&few, &more].map(|stats| stats.mbit_per_s.atlas);
    assert!((0.4..0.6).contains(&few_mbit) && (1.6..2.4).contains(&more_mbit), "{few_mbit}, {more_mbit}");
    assert!(more.flip < few.flip, "{:?}, {:?}", more.flip, few.flip);
}

#[test]
fn both_ways_are_measured_alike_and_again_alike() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let options = RunOptions {
        scene: SceneSource::Dragons(1),
        extent_pixels: [96, 96],
        ..small(out.path(), "stride", QualityOptions::Bitrate(1.0))
    };
    let links = ["latency=20ms,jitter=10ms", "latency=110ms,jitter=10ms"].map(str::to_owned);
    let videos = [0.0, 10.0].map(|margin_degrees| Video {
        rate_hz: 30.0,
        margin_degrees,
        has_depth: margin_degrees > 0.0,
    });
    let compared = Compared { others: Method::OTHERS.to_vec(), videos: videos.to_vec() };
    let measure = |links: &[String], compared: &Compared| {
        quality::measure(&options, "dragons:1", links, compared).unwrap()
    };
    let found = measure(&links, &Compared { others: Vec::new(), ..compared.clone() });
    let again = measure(&links[..1], &compared);
    print!("{found}");
    assert_eq!(
        (&found.links[0].ours, &found.links[0].videos),
        (&again.links[0].ours, &again.links[0].videos)
    );
    let [unpredicted, as_paper] = again.links[0].others.as_slice() else {
        panic!("{:?}", again.links[0].others)
    };
    assert!(unpredicted.flip > again.links[0].ours.flip, "{unpredicted:?}");
    assert!(as_paper.mbit_per_s > again.links[0].ours.mbit_per_s, "{as_paper:?}");
    for over in &found.links {
        assert_eq!(over.videos.len(), 2);
        assert!(over.videos.iter().chain([&over.ours]).all(|row| row.flicker > Some(0.0)));
        assert!(over.videos[0].flip <= over.videos[1].flip, "the best counts");
        assert!((over.flip_ratio - over.ours.flip / over.videos[0].flip).abs() < 1e-12);
    }
    let [near, far] = [0, 1].map(|link: usize| found.links[link].videos[0].flip);
    assert!(near < far, "a longer way makes a video worse: {near}, {far}");
}
