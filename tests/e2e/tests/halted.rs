//! A viewer halts the world with one trigger, steps it with the other, and resumes it, for every kind of motion. In virtual
//! time, at a small size. Validation is on.

use glam::Vec4;
use shadecast_client::client::Step;
use shadecast_lab::experiments::motion_table::{Condition, Kind};
use shadecast_lab::experiments::run::mock_config;
use shadecast_lab::image::Rgb8Image;
use shadecast_lab::measure::compare::{Comparer, Shown};
use shadecast_lab::session::Lab;
use shadecast_lab::session::options::RunOptions;
use shadecast_mock_runtime::config::{ClockKind, MockConfig, ScriptedInput};
use shadecast_mock_runtime::record::{Side, picture_path, read_frames};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::time::{ServerTime, WorldTime};
use shadecast_protocol::world_clock::STEP_NS;
use shadecast_scene::load::SceneSource;
use shadecast_server::scene::SceneOptions;
use shadecast_server::scene::numbering::SceneVertex;
use shadecast_test_support::headset::turn;
use std::collections::HashMap;
use std::path::Path;

/// Display frames a second.
const REFRESH_HZ: u64 = 72;
/// Frames in which a trigger is pulled: to halt, twice for a step, to go on.
const HALT: u64 = 60;
const STEPS: [u64; 2] = [124, 128];
const GO_ON: u64 = 172;
const FRAMES: u64 = 221;
/// From a press to its effect over this link, frames at most: 0.4 s.
const EFFECT: u64 = 29;

/// What was seen in a display frame.
struct Seen {
    world: WorldTime,
    /// What the server says of that moment.
    truth: WorldTime,
    server: ServerTime,
    /// Largest way of a vertex since the frame before, metres.
    way_m: f32,
    is_new: bool,
    /// PSNR of the left eye against the truth, where that was looked at.
    psnr_db: Option<f64>,
}

fn pulls() -> Vec<ScriptedInput> {
    let pull = |frame: u64, hand: &str| {
        let path = format!("/user/hand/{hand}/input/trigger/value");
        [(frame, 1.0), (frame + 2, 0.0)].map(|(frame, value)| ScriptedInput {
            frame,
            path: path.clone(),
            value,
        })
    };
    [(HALT, "right"), (STEPS[0], "left"), (STEPS[1], "left"), (GO_ON, "right")]
        .into_iter()
        .flat_map(|(frame, hand)| pull(frame, hand))
        .collect()
}

fn watch(kind: &str, out: &Path) -> Vec<Seen> {
    let kind: Kind = kind.parse().expect("a kind");
    let link = "latency=20ms,jitter=5ms,rate=100mbit".parse::<Condition>().expect("a link").link;
    let plain = RunOptions::new(SceneSource::Dragons(1), out.to_owned());
    let options = RunOptions {
        extent_pixels: [96, 96],
        atlas_extent_texels: AtlasExtent::new(1024, 512).expect("an atlas"),
        seconds: FRAMES as f64 / REFRESH_HZ as f64,
        refresh_hz: REFRESH_HZ as f64,
        link,
        validation: true,
        scene_options: SceneOptions { motion: kind.option, ..plain.scene_options },
        ..plain
    };
    let controllers = Some("/interaction_profiles/oculus/touch_controller".to_owned());
    let config = mock_config(&options, ClockKind::Virtual, 6).expect("a configuration");
    let config = MockConfig { controllers, inputs: pulls(), ..config };
    // SAFETY: it is the caller's turn.
    let mut lab = unsafe { Lab::open(&options, &config) }.expect("it opens");
    let mut comparer =
        Comparer::new(&lab.server.gpu, &lab.server.scene, options.extent_pixels).expect("a truth");
    let (mut seen, mut before) = (Vec::new(), HashMap::<SceneVertex, Vec4>::new());
    while let Step::Frame(frame) = lab.step().expect("it goes on") {
        let (Some(world), Some(server), true) = (frame.world_time, frame.server_time, frame.update.is_some())
        else {
            continue;
        };
        let positions = lab.client.presenter.read_positions().expect("positions");
        let update = frame.update.expect("it was looked at");
        let residents = lab.seat_mut().residents.at(update).expect("what it holds").to_vec();
        let place = |(slot, vertex): (u32, SceneVertex)| (vertex, Vec4::from(positions[slot as usize]));
        let now: HashMap<SceneVertex, Vec4> = residents.into_iter().map(place).collect();
        let way = |(vertex, at): (&SceneVertex, &Vec4)| match before.get(vertex) {
            Some(was) if at.w != 0.0 && was.w != 0.0 => (at.truncate() - was.truncate()).length(),
            _ => 0.0,
        };
        let way_m = now.iter().map(way).fold(0.0, f32::max);
        before = now;
        let truth = lab.server.world_time(frame.display_time.0);
        let psnr_db = psnr(&lab, &mut comparer, truth, out);
        seen.push(Seen { world, truth, server, way_m, is_new: frame.is_new, psnr_db });
    }
    assert_eq!(lab.server.gpu.validation_messages(), 0);
    seen
}

/// Of the left eye of the frame that was just shown, if it was captured.
fn psnr(lab: &Lab, comparer: &mut Comparer, time: WorldTime, out: &Path) -> Option<f64> {
    let records = read_frames(&out.join("capture")).expect("the frames");
    let record = records.last().filter(|record| record.captured)?;
    let picture =
        Rgb8Image::read_png(&picture_path(&out.join("capture"), record.frame, Side::Left)).expect("one");
    let view = record.views.first().expect("two views");
    let world_from_eye = lab.server.scene.scene.world_from_stage.then(view.stage_pose.into());
    let shown = Shown { world_from_eye, fov: view.frustum(), time, picture: &picture, probe: None };
    let (_, metrics) = comparer.measure(&shown).expect("metrics");
    metrics.picture.map(|picture| picture.psnr_db)
}

fn mean_db(seen: &[Seen]) -> f64 {
    let all: Vec<f64> = seen.iter().filter_map(|seen| seen.psnr_db).collect();
    assert!(!all.is_empty(), "no picture was looked at");
    all.iter().sum::<f64>() / all.len() as f64
}

/// Of all frames from one on until another, those that are the `first` and later after a press.
fn part(seen: &[Seen], from: u64, until: u64) -> &[Seen] {
    let skipped = FRAMES - seen.len() as u64;
    let place = |frame: u64| (frame - skipped) as usize;
    &seen[place(from)..place(until)]
}

/// `still_m`: how far a vertex may go in a world that stands, metres.
fn check(kind: &str, still_m: f32) {
    let _turn = turn();
    let out = tempfile::tempdir().expect("a folder");
    let seen = watch(kind, out.path());
    for seen in &seen {
        let apart_ns = seen.world.since(seen.truth).abs();
        assert!(apart_ns <= 3_000_000, "{kind}: the clocks are {apart_ns} ns apart");
    }
    let [before, stands, stepped, after] = [
        part(&seen, 30, HALT),
        part(&seen, HALT + EFFECT, STEPS[0]),
        part(&seen, STEPS[1] + EFFECT, GO_ON),
        part(&seen, GO_ON + EFFECT, FRAMES),
    ];
    let moves = |seen: &[Seen]| seen.windows(2).all(|pair| pair[0].world < pair[1].world);
    assert!(moves(before) && before.iter().all(|seen| seen.world.0 == seen.server.0), "{kind}: it goes");
    for still in [stands, stepped] {
        assert!(still.windows(2).all(|pair| pair[0].world == pair[1].world), "{kind}: it stands");
        let way_m = still[1..].iter().map(|seen| seen.way_m).fold(0.0, f32::max);
        assert!(way_m < still_m, "{kind}: a vertex moves by {way_m} m in a world that stands");
        assert!(still.iter().any(|seen| seen.is_new), "{kind}: updates go on");
    }
    assert_eq!(stepped[0].world.since(stands[0].world), 2 * STEP_NS, "{kind}: two steps");
    assert!(moves(after), "{kind}: it goes on");
    let fastest_m = before.iter().map(|seen| seen.way_m).fold(0.0, f32::max);
    let jump_m = seen[30..].iter().map(|seen| seen.way_m).fold(0.0, f32::max);
    assert!(jump_m <= 1.5 * fastest_m, "{kind}: {jump_m} m at once, {fastest_m} before");
    let [before_db, stands_db, after_db] = [before, &stands[20..], after].map(mean_db);
    println!("{kind}: {before_db:.2} dB before, {stands_db:.2} while it stands, {after_db:.2} after");
    assert!(
        stands_db >= before_db - 0.3 && after_db >= before_db - 1.5,
        "{kind}: {before_db} dB, {stands_db}, {after_db}"
    );
}

#[test]
fn clips_stand_and_go_on() {
    check("auto", 1e-4);
}

#[test]
fn poses_stand_and_go_on() {
    check("palette", 1e-4);
}

#[test]
fn samples_stand_and_go_on() {
    // One that is sent again, since the head has come nearer, is rounded otherwise: to half a millimetre.
    check("samples", 1e-3);
}
