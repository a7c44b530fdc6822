//! A link that carries less than the scene needs, in virtual time: fewer updates, but a picture, and one that goes on.

use shadecast_client::client::Step;
use shadecast_lab::options::RunOptions;
use shadecast_lab::run::{mock_config, prepare_runtime, set_runtime};
use shadecast_lab::session::{Lab, Sent, Server};
use shadecast_mock_runtime::config::ClockKind;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use shadecast_transport::LinkProfile;

/// When new updates came on display, in virtual seconds, and what was sent.
fn new_updates(link: &str, seconds: f64) -> (Vec<f64>, Sent) {
    let out = tempfile::tempdir().unwrap();
    let options = RunOptions {
        extent_pixels: [96, 96],
        atlas_extent_texels: AtlasExtent::MIN,
        seconds,
        link: link.parse::<LinkProfile>().unwrap().into(),
        ..RunOptions::new(SceneSource::Dragons(1), out.path().to_owned())
    };
    let runtime =
        prepare_runtime(&mock_config(&options, ClockKind::Virtual, 0).unwrap(), out.path()).unwrap();
    // SAFETY: this file has one test, and no thread has been started yet.
    unsafe { set_runtime(&runtime) };
    let mut lab = Lab::new(&options, Server::new(&options).unwrap()).unwrap();
    lab.connect().unwrap();
    let (mut frames, mut shown) = (0, Vec::new());
    while let Step::Frame(report) = lab.step().unwrap() {
        frames += 1;
        if report.is_new {
            shown.push(f64::from(frames) / options.refresh_hz);
        }
    }
    (shown, lab.server.sent)
}

#[test]
fn a_link_slower_than_the_scene_shows_a_picture_and_goes_on() {
    let seconds = 12.0;
    let (shown, sent) = new_updates("latency=20ms,rate=0.4mbit", seconds);
    println!("{} updates, {} withheld, shown at {shown:.2?}; {sent:?}", sent.updates, sent.withheld);
    assert!(sent.withheld > 100, "the link carries the scene: the test shows nothing");
    assert!(shown.first().is_some_and(|first| *first < 5.0), "the first picture: {shown:?}");
    let times: Vec<f64> = shown.into_iter().chain([seconds]).collect();
    let longest = times.windows(2).map(|pair| pair[1] - pair[0]).fold(0.0, f64::max);
    // It goes on; how well is rate control's: after a pause an update brings the samples of all of it, and 6.3 s were measured.
    assert!(times.len() > 3 && longest < 8.0, "{longest} s without a new picture: {times:?}");
    let mbit_s = (sent.atlas_bytes + sent.geometry_bytes) as f64 * 8e-6 / seconds;
    assert!((0.1..0.6).contains(&mbit_s), "what is sent is what the link carries: {mbit_s} Mbit/s");
}
