//! Playback over time on the client: events of the scene, changes and poses of an application. In virtual time, at a small
//! size. Validation is on.

use glam::{Quat, Vec3};
use shadecast_client::client::{FrameReport, Step};
use shadecast_lab::experiments::motion_table::{Condition, MotionRow, measure};
use shadecast_lab::experiments::run::mock_config;
use shadecast_lab::session::Lab;
use shadecast_lab::session::options::RunOptions;
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::time::WorldTime;
use shadecast_scene::animation::pose::source_pose;
use shadecast_scene::load::SceneSource;
use shadecast_scene::timeline::Change;
use shadecast_server::skinning::posing::CpuPose;
use shadecast_test_support::headset::turn;
use std::collections::HashMap;
use std::path::Path;

const LINK: &str = "latency=20ms,jitter=5ms,rate=100mbit";
/// How far a wing is rounded off where it stops or starts between two steps of the grid, at most.
const MOST_ROUNDED_MM: f64 = 6.0;

/// A dragon that fades to rest and back to its flight, stands still for a while and goes on faster.
const EVENTS: &str = r#"
[[model]]
name = "dragon"
file = "dragon"

[[instance]]
model = "dragon"
name = "near"
clip = "fly"

[[event]]
at = 0.6
instance = "near"
clip = ""
fade = 0.3

[[event]]
at = 1.0
instance = "near"
clip = "fly"
seek = 1.3
fade = 0.25

[[event]]
at = 1.5
instance = "near"
pause = true

[[event]]
at = 1.7
instance = "near"
speed = 1.5
"#;

/// A dragon that an application may pose.
const LIVE: &str = r#"
[[model]]
name = "dragon"
file = "dragon"

[[instance]]
model = "dragon"
name = "near"
clip = "fly"
live = true
"#;

fn options(scene: SceneSource, seconds: f64, link: &str, out: &Path) -> RunOptions {
    RunOptions {
        extent_pixels: [64, 64],
        atlas_extent_texels: AtlasExtent::new(512, 512).expect("an atlas"),
        seconds,
        link: link.parse::<Condition>().expect("a link").link,
        validation: true,
        ..RunOptions::new(scene, out.to_owned())
    }
}

fn written(text: &str, folder: &Path) -> SceneSource {
    let path = folder.join("scene.toml");
    std::fs::write(&path, text).expect("a folder of our own");
    SceneSource::File(path)
}

fn ms(ms: i64) -> WorldTime {
    WorldTime(ms * 1_000_000)
}

#[test]
fn events_are_shown_when_they_happen_by_clips_and_by_poses() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let options = options(written(EVENTS, out.path()), 2.2, LINK, out.path());
    let kinds = ["auto", "palette"].map(|kind| kind.parse().expect("a kind"));
    let table = measure(&options, "events", &kinds, &[LINK.parse().unwrap()]).unwrap();
    println!("{table}");
    let [clips, poses] = &table.rows[..] else { panic!("two kinds") };
    let stands = |row: &MotionRow| row.frozen_vertex_frames + row.torn_vertex_frames;
    assert!(clips.frames > 100 && clips.max_error_mm <= 0.2, "{clips:?}");
    assert_eq!((stands(clips), clips.bytes.poses), (0, 0), "{clips:?}");
    assert_eq!([clips, poses].map(|row| row.validation_messages), [Some(0); 2]);
    // Between two steps of the grid a curve that begins or ends there is rounded off; elsewhere nothing is.
    assert!(
        poses.max_error_mm <= MOST_ROUNDED_MM && poses.p99_error_mm <= MOST_ROUNDED_MM / 2.0,
        "{poses:?}"
    );
    assert_eq!((stands(poses), poses.bytes.keys), (0, 0), "{poses:?}");
    assert!(poses.bytes.poses > 0, "{poses:?}");
}

/// What became of all animated vertices in a display frame.
#[derive(Debug)]
struct Seen {
    time: WorldTime,
    /// Largest distance from where the timeline has them, metres.
    error_m: f32,
    /// Largest way since the frame before, metres.
    way_m: f32,
}

/// Runs a scene; before each display frame `act` may change what is played, by the time that was seen last.
fn watch(options: &RunOptions, mut act: impl FnMut(&Lab, WorldTime)) -> Vec<Seen> {
    let config = MockConfig { capture_dir: None, ..mock_config(options, ClockKind::Virtual, 0).unwrap() };
    // SAFETY: it is the caller's turn.
    let mut lab = unsafe { Lab::open(options, &config) }.unwrap();
    let (mut seen, mut before) = (Vec::new(), HashMap::new());
    while let Step::Frame(frame) = lab.step().unwrap() {
        seen.extend(look(&mut lab, &frame, &mut before));
        if let Some(time) = frame.world_time {
            act(&lab, time);
        }
    }
    assert_eq!(lab.server.gpu.validation_messages(), 0);
    seen
}

/// `before`: where each vertex was in the frame before.
fn look(lab: &mut Lab, frame: &FrameReport, before: &mut HashMap<u32, Vec3>) -> Option<Seen> {
    let (update, time) = (frame.update?, frame.world_time.filter(|_| frame.is_rendered)?);
    let positions = lab.client.presenter.read_positions().unwrap();
    let residents = lab.seat_mut().residents.at(update)?.to_vec();
    let scene = &lab.server.scene;
    let shown = lab.server.world.timeline().lock().at(0, time);
    let pose = CpuPose::at(scene, 0, &shown, time);
    let (place, model) = (&scene.numbering.instances[0], &scene.scene.models[0]);
    let (mut error_m, mut way_m, mut now) = (0.0f32, 0.0f32, HashMap::new());
    for (slot, vertex) in residents {
        let [x, y, z, state] = positions[slot as usize];
        if state == 0.0 || scene.numbering.instance_of_vertex(vertex) != 0 {
            continue;
        }
        let (number, at) = (vertex.0 - place.first_vertex.0, Vec3::new(x, y, z));
        error_m = error_m.max(at.distance(pose.vertex(model, number as usize)));
        way_m = way_m.max(before.get(&vertex.0).map_or(0.0, |before| at.distance(*before)));
        now.insert(vertex.0, at);
    }
    *before = now;
    (!before.is_empty()).then_some(Seen { time, error_m, way_m })
}

fn worst(seen: &[Seen], of: impl Fn(&Seen) -> f32) -> f32 {
    seen.iter().map(of).fold(0.0, f32::max)
}

/// Half a beat of the wings away.
fn elsewhere() -> Change {
    Change { local_s: Some(0.7), speed: Some(-1.0), ..Change::default() }
}

#[test]
fn an_applications_change_shows_in_its_frame() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let mut effect = None;
    let seen = watch(&options(SceneSource::Dragons(1), 2.0, LINK, out.path()), |lab, time| {
        if effect.is_none() && time > ms(900) {
            let timeline = lab.server.world.timeline();
            effect = Some(timeline.lock().set_playback(0, elsewhere(), time).expect("its own clip"));
        }
    });
    let effect = effect.expect("it runs for two seconds");
    assert!((ms(900)..ms(1300)).contains(&effect), "soon, and not too soon to be told: {effect:?}");
    assert!(seen.iter().any(|seen| seen.time > effect) && seen.len() > 80, "{} frames", seen.len());
    let error_m = worst(&seen, |seen| seen.error_m);
    assert!(error_m <= 2e-4, "{error_m} m");
    assert!(worst(&seen, |seen| seen.way_m) > 0.2, "the change is one that can be seen");
}

#[test]
fn a_late_change_is_blended_without_a_jump() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    // Silence from 1.3 to 2.2 s of the server's time: what changes soon after its beginning is heard of too late.
    let link = format!("{LINK},outage=0.9s");
    let mut effect = None;
    let seen = watch(&options(SceneSource::Dragons(1), 3.6, &link, out.path()), |lab, time| {
        if effect.is_none() && time > ms(1400) {
            let timeline = lab.server.world.timeline();
            effect = Some(timeline.lock().set_playback(0, elsewhere(), time).expect("its own clip"));
        }
    });
    let effect = effect.expect("it runs for longer");
    let is_late = |seen: &&Seen| seen.time > effect && seen.error_m > 0.1;
    assert!(seen.iter().filter(is_late).count() > 5, "the client knew in time: {effect:?}");
    let way_m = worst(&seen, |seen| seen.way_m);
    assert!(way_m < 0.15, "a vertex has jumped by {way_m} m");
    let last = &seen[seen.len() - 20..];
    assert!(worst(last, |seen| seen.error_m) <= 2e-4, "{:?}", last.last());
}

#[test]
fn poses_of_an_application_are_shown_between_steps_of_the_grid() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let mut posed = ms(0);
    let seen = watch(&options(written(LIVE, out.path()), 1.6, LINK, out.path()), |lab, time| {
        let mut timeline = lab.server.world.timeline().lock();
        let until = timeline.sampled_until().unwrap_or(time).plus_ns(250_000_000);
        let model = &lab.server.scene.scene.models[0];
        posed = posed.max(timeline.sampled_until().unwrap_or(time));
        while posed < until {
            posed = posed.plus_ns(10_000_000);
            let mut pose = source_pose(model, None, 0.0);
            let angle = 0.1 * (posed.seconds() * 5.0).sin() as f32;
            pose.iter_mut().take(8).for_each(|bone| bone.rotation *= Quat::from_rotation_z(angle));
            timeline.set_pose(0, posed, pose).expect("a pose within reach");
        }
    });
    assert!(seen.len() > 60, "{} frames", seen.len());
    let posed: Vec<&Seen> = seen.iter().filter(|seen| seen.time > ms(1000)).collect();
    let error_m = posed.iter().map(|seen| seen.error_m).fold(0.0, f32::max);
    assert!(error_m <= 1e-3, "{error_m} m");
    assert!(posed.iter().all(|seen| seen.way_m > 0.0), "it moves in every frame");
}
