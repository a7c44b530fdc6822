//! What the scheduler decides for two viewers in virtual time. The server's own test plays the same run through the pipeline that
//! ships, and holds its decisions against these.

use serde_json::json;
use shadecast_client::client::Step;
use shadecast_lab::experiments::run::mock_config;
use shadecast_lab::session::options::{RunOptions, StageMs, ViewerOptions};
use shadecast_lab::session::{Lab, Schedule};
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use shadecast_test_support::headset::turn;
use std::path::Path;

/// Set to write the recording anew, after the schedule was changed on purpose.
const RECORD: &str = "SHADECAST_RECORD_SCHEDULE";

/// Two viewers of a dragon for a second, on a device that both keep busy.
fn scheduled(stages: StageMs) -> (Schedule, i64) {
    let out = tempfile::tempdir().expect("a folder");
    let link = |text: &str| text.parse().expect("a link");
    let options = RunOptions {
        extent_pixels: [64, 64],
        atlas_extent_texels: AtlasExtent::new(512, 512).expect("an atlas"),
        seconds: 1.2,
        link: link("latency=20ms"),
        others: vec![ViewerOptions { link: link("latency=5ms"), head: None }],
        stages,
        ..RunOptions::new(SceneSource::Dragons(1), out.path().to_owned())
    };
    let config = mock_config(&options, ClockKind::Virtual, 0).expect("a configuration");
    let config = MockConfig { capture_dir: None, ..config };
    // SAFETY: it is the caller's turn.
    let mut lab = unsafe { Lab::open(&options, &config) }.expect("a session");
    while let Step::Frame(_) = lab.step().expect("it goes on") {}
    (lab.server.schedule, (1e9 / options.rate_hz) as i64)
}

#[test]
fn two_viewers_are_scheduled_as_recorded() {
    let _turn = turn();
    let stages: StageMs = "visibility=6,placement=2,shading=9,encode=8".parse().expect("durations");
    let (Schedule { joined, decisions, headless }, period_ns) = scheduled(stages);
    // Viewers have the names that their places in the order of arrival give them.
    let name = |line: usize| joined.iter().position(|(_, other)| *other == line).expect("it came");
    let decisions: Vec<_> = decisions.iter().map(|(at_ns, line, what)| (at_ns, name(*line), what)).collect();
    let steps = stages.steps_ns();
    let recorded = json!({
        "period_ns": period_ns,
        "visibility_ns": steps.visibility,
        "placement_ns": steps.placement,
        "shading_ns": steps.shading,
        "encode_ns": stages.ns(stages.encode),
        "joined_ns": joined.iter().map(|(at_ns, _)| at_ns).collect::<Vec<_>>(),
        "headless": headless.iter().map(|(at_ns, line)| (at_ns, name(*line))).collect::<Vec<_>>(),
        "decisions": decisions,
    });
    let path =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../server/src/serve/stream/pipeline/two_viewers.json");
    let text = format!("{recorded}\n");
    if std::env::var_os(RECORD).is_some() {
        std::fs::write(&path, &text).expect("the recording is written");
    }
    let before = std::fs::read_to_string(&path).expect("the recording");
    assert!(decisions.len() > 100, "{} decisions", decisions.len());
    assert!(text == before, "the schedule is another; if that is meant, set {RECORD} and run the test again");
}
