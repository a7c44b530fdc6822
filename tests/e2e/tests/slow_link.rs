//! A link below the scene's needs, in virtual time: fewer updates, but a picture that goes on.

use shadecast_lab::experiments::slow_link::measure;
use shadecast_lab::session::options::RunOptions;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use shadecast_transport::LinkProfile;

#[test]
fn a_link_slower_than_the_scene_shows_a_picture_and_goes_on() {
    let out = tempfile::tempdir().unwrap();
    let options = RunOptions {
        extent_pixels: [96, 96],
        atlas_extent_texels: AtlasExtent::MIN,
        seconds: 12.0,
        link: "latency=20ms,rate=0.4mbit".parse::<LinkProfile>().unwrap().into(),
        ..RunOptions::new(SceneSource::Dragons(1), out.path().to_owned())
    };
    // This file has one test, and no thread has been started yet: the environment is its own.
    let report = measure(&options).unwrap();
    println!("{report}, shown at {:.2?}", report.shown_s);
    assert!(report.withheld > 50, "the link carries the scene: the test shows nothing");
    assert!(report.first_picture_s < 5.0, "{report}");
    // The keys of the clip take 1.3 s of this link, once.
    assert!(report.shown_s.len() > 5 && report.longest_pause_s < 3.0, "{report}");
    assert!((0.1..0.6).contains(&report.sent_mbit_s), "what is sent is what the link carries: {report}");
}
