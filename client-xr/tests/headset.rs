//! The client on the mock headset: what a person in it would see, without a server.

mod support;

use rand::rngs::SmallRng;
use rand::{Rng, SeedableRng};
use shadecast_client::client::{Client, ClientError, FrameReport, Notice, Step};
use shadecast_client::decode::{DecodeError, Decoder};
use shadecast_client::draw::stages::FRAMES_IN_FLIGHT;
use shadecast_gpu::{Gpu, MemoryUse, vk};
use shadecast_mock_runtime::config::{EventKind, MockConfig, ScriptedEvent, ScriptedHand, ScriptedInput};
use shadecast_mock_runtime::record::{Side, read_frames};
use shadecast_protocol::atlas::{AtlasExtent, Block, BlockAddress, BlockSize, PatchKind, PixelTexels};
use shadecast_protocol::delta::{Delta, DeltaEncoder};
use shadecast_protocol::geometry::{GeometryDelta, InstanceInfo, Motion, NewPatch, NewVertex, Settled};
use shadecast_protocol::ids::{InstanceId, MeshId, PatchSlot, UpdateId, VertexSlot};
use shadecast_protocol::limits::{MAX_NEW_SAMPLE_GRIDS, MAX_PATCH_SLOTS, MAX_STORE_PAGES, MAX_VERTEX_SLOTS};
use shadecast_protocol::message::{Codec, Environment, HeadState, ResumeSecret, ServerOffer};
use shadecast_protocol::motion::SampleBatch;
use shadecast_protocol::motion::message::{MotionMessage, MotionNews};
use shadecast_protocol::picture::I420;
use shadecast_protocol::pose::Pose;
use shadecast_protocol::session::{
    DeltaSender, Out, ServerEvent, ServerSession, motion_stream, picture_stream,
};
use shadecast_protocol::time::{ClientTime, DEFAULT_GRID, GridIndex, ServerTime, WorldTime};
use shadecast_protocol::wire::{PictureHeader, StreamMessage, parse_stream};
use shadecast_protocol::world_clock::{Steer, Steering, WorldClock};
use shadecast_test_support::peers::offer;
use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use support::on_device::{changing_decoder, on_device_decoder};
use support::{Picture, Run, SIDE, at, coded, finish, frame, pixel, toy_decoder};

const ATLAS: AtlasExtent = AtlasExtent::MIN;
/// sRGB values of the two patches, and their full-range BT.709 planes.
const RED: ([u8; 3], [u8; 3]) = ([200, 40, 40], [74, 110, 208]);
const BLUE: ([u8; 3], [u8; 3]) = ([40, 60, 220], [67, 210, 111]);
/// The animated edge moves this fast, metres per second.
const SPEED: f32 = 0.3;

fn environment() -> Environment {
    Environment { zenith: [0.1, 0.3, 0.9], horizon: [0.5, 0.5, 0.5], nadir: [0.1, 0.1, 0.1] }
}

fn block(x: u16) -> Block {
    Block { address: BlockAddress { page: 0, x, y: 0 }, size: BlockSize::new(6, 6).expect("a size") }
}

/// Left half red, right half blue, elsewhere green so that a wrong lookup is seen.
fn planes(blocks: [u16; 2]) -> I420 {
    let [w, h] = ATLAS.texels().map(|side| side as usize);
    let ycbcr = |x: usize, y: usize| {
        let inside = |from: u16| (usize::from(from)..usize::from(from) + 64).contains(&x) && y < 64;
        if inside(blocks[0]) {
            RED.1
        } else if inside(blocks[1]) {
            BLUE.1
        } else {
            [150, 40, 20]
        }
    };
    let plane = |step: usize, component: usize| -> Vec<u8> {
        let texels = (0..h / step).flat_map(|y| (0..w / step).map(move |x| (x, y)));
        texels.map(|(x, y)| ycbcr(x * step, y * step)[component]).collect()
    };
    I420::new(ATLAS.texels(), [plane(1, 0), plane(2, 1), plane(2, 2)].concat()).expect("a picture")
}

/// Where the moving edge is at a time of the world.
fn edge_x(time: WorldTime) -> f32 {
    0.5 + SPEED * (time.seconds() as f32 - 1.0)
}

/// Samples of the right patch's edge from grid step `from` on.
fn samples(from: i32, to: i32) -> Vec<SampleBatch> {
    let place = |slot: u32, grid: i32| {
        let time = DEFAULT_GRID.time_of(GridIndex(grid));
        let x = if slot < 6 { 0.02 } else { edge_x(time) };
        let y = if slot.is_multiple_of(2) { 2.1 } else { 1.1 };
        [x, y, -2.0].map(|metres| (metres / 0.0001f32).round() as i32)
    };
    let batch = |grid| SampleBatch {
        grid: GridIndex(grid),
        values: (4..8).map(|slot| (VertexSlot(slot), place(slot, grid))).collect(),
    };
    (from..=to).map(batch).collect()
}

/// Two squares of a metre two metres ahead: the left one static and red, the right one animated and blue.
fn two_patches() -> Delta {
    let statics = [[-0.5, 2.1], [-0.5, 1.1], [-0.02, 2.1], [-0.02, 1.1]];
    let fixed = |(slot, [x, y]): (u32, [f32; 2])| NewVertex {
        slot: VertexSlot(slot),
        instance: InstanceId(3),
        number: slot,
        motion: Motion::Static { position: [x, y, -2.0].into() },
    };
    let moving = |slot| NewVertex {
        slot: VertexSlot(slot),
        instance: InstanceId(7),
        number: slot,
        motion: Motion::Sampled,
    };
    let patch = |slot: u32, instance: u16, first: u32| NewPatch {
        slot: PatchSlot(slot),
        instance: InstanceId(instance),
        mesh: MeshId(0),
        number: slot,
        kind: PatchKind::Two,
        // Around the square: upper left, upper right, lower right, lower left.
        vertices: [first, first + 2, first + 3, first + 1, first].map(VertexSlot),
        double_sided: true,
    };
    let geometry = GeometryDelta {
        update: UpdateId(0),
        time: WorldTime(1_000_000_000),
        instances: vec![InstanceInfo { instance: InstanceId(7), step_m: 0.0001 }],
        new_vertices: (0..).zip(statics).map(fixed).chain((4..8).map(moving)).collect(),
        new_patches: vec![patch(0, 3, 0), patch(1, 7, 4)],
        placements: vec![(PatchSlot(0), Some(block(0))), (PatchSlot(1), Some(block(64)))],
        ..GeometryDelta::default()
    };
    Delta { geometry, is_update: true, samples: samples(29, 45) }
}

#[track_caller]
fn assert_close(got: [u8; 3], want: [u8; 3], what: &str) {
    let is_close = got.iter().zip(want).all(|(got, want)| got.abs_diff(want) <= 3);
    assert!(is_close, "{what}: {got:?} instead of {want:?}");
}

#[test]
fn a_runtime_without_time_conversion_keeps_frame_distances() {
    let hidden = ["XR_KHR_convert_timespec_time", "XR_KHR_win32_convert_performance_counter_time"];
    let hidden_extensions = hidden.map(str::to_owned).to_vec();
    let run = Run::new(MockConfig { hidden_extensions, ..MockConfig::default() });
    let mut client = run.client();
    let times: Vec<ClientTime> = (0..20).map(|_| frame(&mut client).display_time).collect();
    let period_ns = (1e9 / MockConfig::default().refresh_hz).round() as i64;
    for pair in times.windows(2) {
        assert!((pair[1].since(pair[0]) - period_ns).abs() <= 1, "{pair:?}");
    }
    let now = shadecast_client::platform::monotonic_now();
    assert!(now.since(times[0]).abs() < 60_000_000_000, "on the client's clock: {times:?} at {now:?}");
    finish(&run, client);
}

#[test]
fn before_the_first_bundle_both_eyes_see_the_waiting_room() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    client.presenter.set_status("Connecting to 192.168.1.5:7400");
    for _ in 0..4 {
        let report = frame(&mut client);
        assert_eq!(report.update, None);
    }
    finish(&run, client);
    let (left, right) = (run.picture(3, Side::Left), run.picture(3, Side::Right));
    for picture in [&left, &right] {
        let bright = picture.pixels().filter(|pixel| pixel[1] > 140).count();
        assert!((100..3000).contains(&bright), "{bright} bright pixels of text");
        assert_ne!(picture.at(SIDE / 2, 2), picture.at(SIDE / 2, SIDE / 3), "a gradient");
    }
    let differing = left.pixels().zip(right.pixels()).filter(|(left, right)| left != right).count();
    assert!(differing > 100, "the eyes see the text from two places: {differing} pixels differ");
}

#[test]
fn a_rehearsal_is_unseen_and_leaves_no_memory() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let held_bytes =
        |client: &Client| client.presenter.gpu().memory().iter().map(|used| used.bytes).sum::<u64>();
    let before = held_bytes(&client);
    client.presenter.rehearse().expect("every stage runs");
    for _ in 0..4 {
        assert_eq!(frame(&mut client).update, None, "nothing of it is displayed");
    }
    client.presenter.gpu().destroy_retired(); // as the intake does
    assert!(held_bytes(&client) <= before, "{} and {before} bytes", held_bytes(&client));
    let mut line = Line::connect(&mut client);
    line.send(static_patches(), &planes([0, 64]), true);
    for _ in 0..3 {
        line.frame(&mut client);
    }
    assert_eq!(line.frame(&mut client).update, Some(UpdateId(0)), "a session goes on as without it");
    finish(&run, client);
}

#[test]
fn both_eyes_see_patches_in_place_and_in_colour() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::in_step(&mut client);
    line.send(two_patches(), &planes([0, 64]), true);
    line.frame(&mut client); // its picture is being decoded
    let report = line.frame(&mut client);
    assert_eq!((report.update, report.is_new, report.withheld_patches), (Some(UpdateId(0)), true, 0));
    let shown = client.presenter.stats().frames - 1;
    assert!(!line.frame(&mut client).is_new);
    let probe = client.presenter.probe().expect("a probe");
    finish(&run, client);
    for (side, eye) in [(Side::Left, -1.0), (Side::Right, 1.0)] {
        let picture = run.picture(shown, side);
        let see = |point: [f32; 3]| {
            let [x, y] = pixel(point, eye);
            picture.at(x as u32, y as u32)
        };
        assert_close(see([-0.25, 1.6, -2.0]), RED.0, "the left square");
        assert_close(see([0.25, 1.6, -2.0]), BLUE.0, "the right square");
        assert_close(see([-0.47, 1.13, -2.0]), RED.0, "its lower left corner");
        let sky = picture.at(SIDE / 2, 0);
        assert!(sky[2] > sky[0] + 20, "blue sky above: {sky:?}");
        let green = picture.pixels().filter(|[r, g, b]| g > r && g > b && *g > 120).count();
        assert_eq!(green, 0, "no texel beside the blocks is seen");
    }
    for (view, eye) in probe.iter().zip([-1.0, 1.0]) {
        let see = |point: [f32; 3]| {
            let [x, y] = pixel(point, eye);
            let at = (y as u32 * SIDE + x as u32) as usize;
            (view.instance[at], view.distance_m[at])
        };
        let (instance, distance_m) = see([-0.25, 1.6, -2.0]);
        assert!(instance == 3 && (distance_m - 2.0).abs() < 1e-4, "{instance} at {distance_m} m");
        assert_eq!(see([0.25, 1.6, -2.0]).0, 7);
        assert_eq!(see([0.0, 0.5, -2.0]), (u32::MAX, f32::INFINITY));
    }
}

#[test]
fn an_animated_edge_moves_with_every_display_frame() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::in_step(&mut client);
    line.send(two_patches(), &planes([0, 64]), true);
    line.frame(&mut client);
    let first = client.presenter.stats().frames;
    let mut last = None;
    for _ in 0..20 {
        let report = line.frame(&mut client);
        let time = report.world_time.expect("a clock");
        let [x, y, z, _] = client.presenter.read_positions().expect("positions")[6];
        assert!((x - edge_x(time)).abs() < 2e-4, "{x} instead of {} at {time:?}", edge_x(time));
        assert!((y - 2.1).abs() < 1e-4 && (z + 2.0).abs() < 1e-4);
        assert_ne!(last.replace(x), Some(x), "it moved");
        assert_eq!((report.held_vertices, report.frozen_vertices), (0, 0));
    }
    finish(&run, client);
    // The pictures move too: where the edge was at the first frame, the last one shows the square.
    let beyond = pixel([0.53, 1.6, -2.0], -1.0).map(|p| p as u32);
    assert_ne!(run.picture(first, Side::Left).at(beyond[0], beyond[1]), BLUE.0);
    assert_close(run.picture(first + 19, Side::Left).at(beyond[0], beyond[1]), BLUE.0, "the edge has passed");
}

#[test]
fn a_vertex_without_samples_freezes_and_returns_smoothly() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::in_step(&mut client);
    let first = Delta { samples: samples(29, 33), ..two_patches() };
    line.send(first, &planes([0, 64]), true);
    line.frame(&mut client);
    let (mut frozen, mut largest, mut last) = (0, 0f32, None);
    for index in 0..50 {
        if index == 16 {
            let geometry = GeometryDelta { update: UpdateId(1), ..GeometryDelta::default() };
            line.send_delta(Delta { geometry, is_update: true, samples: samples(34, 49) });
        }
        let report = line.frame(&mut client);
        frozen += report.frozen_vertices;
        let x = client.presenter.read_positions().expect("positions")[6][0];
        if let Some(last) = last.replace(x) {
            largest = largest.max((x - last).abs());
        }
    }
    let frame_m = SPEED / 72.0;
    assert!(frozen > 0, "freezing is counted");
    assert!(largest < 2.5 * frame_m, "moved by {largest} m in a frame, the curve by {frame_m}");
    finish(&run, client);
}

#[test]
fn a_patch_without_samples_is_withheld_and_the_rest_is_seen() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::in_step(&mut client);
    let late = Delta { samples: samples(40, 45), ..two_patches() };
    line.send(late, &planes([0, 64]), true);
    line.frame(&mut client);
    assert_eq!(line.frame(&mut client).withheld_patches, 1);
    let first = client.presenter.stats().frames - 1;
    let picture = |frame| run.picture(frame, Side::Left);
    let [x, y] = pixel([0.25, 1.6, -2.0], -1.0).map(|p| p as u32);
    assert_ne!(picture(first).at(x, y), BLUE.0);
    let [red_x, red_y] = pixel([-0.25, 1.6, -2.0], -1.0).map(|p| p as u32);
    assert_close(picture(first).at(red_x, red_y), RED.0, "the static patch");
    while line.frame(&mut client).withheld_patches > 0 {}
    let seen = client.presenter.stats().frames - 1;
    finish(&run, client);
    assert_close(picture(seen).at(x, y), BLUE.0, "drawn as soon as it can be");
}

#[test]
fn the_newest_picture_has_its_own_placements() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::in_step(&mut client);
    line.send(two_patches(), &planes([0, 64]), true);
    // The blocks change places; the picture of that update never comes, that of the next has them elsewhere again.
    let swapped = vec![(PatchSlot(0), Some(block(64))), (PatchSlot(1), Some(block(0)))];
    let moved = vec![(PatchSlot(0), Some(block(128)))];
    let next =
        |frame, placements| GeometryDelta { update: UpdateId(frame), placements, ..GeometryDelta::default() };
    line.frame(&mut client);
    line.frame(&mut client);
    let first = client.presenter.stats().frames - 1;
    line.send_delta(next(1, swapped));
    assert_eq!(line.frame(&mut client).update, Some(UpdateId(0)), "no picture, no switch");
    line.send(next(2, moved), &planes([128, 0]), true);
    line.frame(&mut client);
    assert_eq!(line.frame(&mut client).update, Some(UpdateId(2)));
    finish(&run, client);
    for index in first..first + 4 {
        let picture = run.picture(index, Side::Right);
        let see = |x: f32| pixel([x, 1.6, -2.0], 1.0).map(|p| p as u32);
        assert_close(picture.at(see(-0.25)[0], see(-0.25)[1]), RED.0, &format!("left in frame {index}"));
        assert_close(picture.at(see(0.25)[0], see(0.25)[1]), BLUE.0, &format!("right in frame {index}"));
    }
}

/// Two squares beside each other that share an edge and both move to the right; x tells the time.
fn moving_strip(samples: Vec<SampleBatch>) -> Delta {
    let moving = |slot| NewVertex {
        slot: VertexSlot(slot),
        instance: InstanceId(7),
        number: slot,
        motion: Motion::Sampled,
    };
    let patch = |slot: u32, first: u32| NewPatch {
        slot: PatchSlot(slot),
        instance: InstanceId(7),
        mesh: MeshId(0),
        number: slot,
        kind: PatchKind::Two,
        vertices: [first, first + 2, first + 3, first + 1, first].map(VertexSlot),
        double_sided: true,
    };
    let geometry = GeometryDelta {
        instances: vec![InstanceInfo { instance: InstanceId(7), step_m: 0.0001 }],
        new_vertices: (0..6).map(moving).collect(),
        new_patches: vec![patch(0, 0), patch(1, 2)],
        placements: vec![(PatchSlot(0), Some(block(0))), (PatchSlot(1), Some(block(64)))],
        ..GeometryDelta::default()
    };
    Delta { geometry, is_update: true, samples }
}

/// Where a vertex of the strip is when the stage's clock reads `seconds`.
fn strip_x(slot: u32, seconds: f32) -> f32 {
    f32::from(slot as u8 / 2) * 0.5 - 0.5 + SPEED * (seconds - 1.0)
}

fn strip_samples(slots: std::ops::Range<u32>, steps: std::ops::RangeInclusive<i32>) -> Vec<SampleBatch> {
    let place = |slot: u32, grid: i32| {
        let x = strip_x(slot, DEFAULT_GRID.time_of(GridIndex(grid)).seconds() as f32);
        let y = if slot.is_multiple_of(2) { 2.1 } else { 1.1 };
        [x, y, -2.0].map(|metres| (metres / 0.0001f32).round() as i32)
    };
    let batch = |grid| SampleBatch {
        grid: GridIndex(grid),
        values: slots.clone().map(|slot| (VertexSlot(slot), place(slot, grid))).collect(),
    };
    steps.map(batch).collect()
}

/// The time of each vertex of each triangle drawn, as its place tells it; the largest difference within a triangle.
fn torn_s(client: &Client) -> f32 {
    let positions = client.presenter.read_positions().expect("positions");
    let seconds = |slot: u32| (positions[slot as usize][0] - strip_x(slot, 1.0)) / SPEED + 1.0;
    let triangles = client.presenter.drawn_triangles();
    assert!(!triangles.is_empty(), "something is drawn");
    let spread = |triangle: [u32; 3]| {
        let times = triangle.map(seconds);
        times.into_iter().fold(f32::MIN, f32::max) - times.into_iter().fold(f32::MAX, f32::min)
    };
    triangles.into_iter().map(spread).fold(0.0, f32::max)
}

#[test]
fn samples_of_the_next_update_do_not_tear_the_display() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::in_step(&mut client);
    line.send(moving_strip(strip_samples(0..6, 29..=33)), &planes([0, 64]), true);
    line.frame(&mut client);
    // The next update has lost sight of the right square; its samples come before its picture.
    let lost = GeometryDelta {
        update: UpdateId(1),
        evicted_patches: vec![PatchSlot(1)],
        evicted_vertices: vec![VertexSlot(4), VertexSlot(5)],
        ..GeometryDelta::default()
    };
    let lost = Delta { geometry: lost, is_update: true, samples: strip_samples(0..4, 34..=49) };
    let (mut stood_still, mut largest, mut last) = (0, 0f32, None);
    for index in 0..45 {
        match index {
            8 => line.send_delta(lost.clone()),
            19 => {
                let next = GeometryDelta { update: UpdateId(2), ..GeometryDelta::default() };
                line.send(next, &planes([0, 64]), true);
            }
            _ => {}
        }
        let report = line.frame(&mut client);
        let torn = torn_s(&client);
        assert!(torn < 0.002, "frame {index}: corners of a triangle are {torn} s apart");
        stood_still += u32::from(report.motion_time < report.world_time);
        let x = client.presenter.read_positions().expect("positions")[0][0];
        if let Some(last) = last.replace(x) {
            largest = largest.max((x - last).abs());
        }
        if index >= 36 {
            assert_eq!(report.motion_time, report.world_time, "frame {index}: caught up after 200 ms");
        }
    }
    assert!(stood_still > 5, "{stood_still} frames behind the display's time");
    let frame_m = SPEED / 72.0;
    assert!(largest < 2.5 * frame_m, "moved by {largest} m in a frame, the motion by {frame_m}");
    finish(&run, client);
}

/// A server's session and a link of no length, both in the client's virtual time.
struct Line {
    server: ServerSession,
    /// The server's sending half, once it has said yes.
    sender: Option<DeltaSender>,
    encoder: DeltaEncoder,
    /// What the server sends beside the session.
    streams: VecDeque<Out>,
    frames: i64,
    events: Vec<ServerEvent>,
    /// How the world's time goes on.
    world: WorldClock,
    /// How often the client allocated in each turn, and how many messages left it.
    allocations: Vec<[u64; 2]>,
    /// Streams whose frame and kind this names are lost: what the client gets is a reset.
    lost_pictures: Vec<u32>,
    /// The server's clock is ahead of the client's by this.
    ahead_ns: i64,
}

/// The server's clock is usually ahead of the client's by this.
const SERVER_AHEAD_NS: i64 = 5_000_000_000;
/// From one turn of the runtime to the next.
const PERIOD_NS: i64 = 13_888_889;
/// Turns in which a session comes to stand, and the client knows the server's clock.
const CONNECTING_TURNS: i64 = 13;

impl Line {
    fn new(world_from_stage: Pose, ahead_ns: i64) -> Self {
        Self::with_store(world_from_stage, ahead_ns, 0)
    }

    /// The same with so many pages of settled blocks.
    fn with_store(world_from_stage: Pose, ahead_ns: i64, store_pages: u32) -> Self {
        let server = ServerSession::new(ServerOffer {
            session: 5,
            store_pages,
            atlas_extent_texels: ATLAS,
            environment: environment(),
            world_from_stage,
            resume: ResumeSecret([2; 16]),
            ..offer()
        });
        Self {
            server,
            sender: None,
            encoder: DeltaEncoder::new(MAX_VERTEX_SLOTS, MAX_PATCH_SLOTS)
                .with_store(store_pages)
                .with_atlas(ATLAS),
            streams: VecDeque::new(),
            frames: 0,
            events: Vec::new(),
            world: WorldClock::default(),
            allocations: Vec::new(),
            lost_pictures: Vec::new(),
            ahead_ns,
        }
    }

    /// One display frame, and what both ends say meanwhile.
    fn frame(&mut self, client: &mut Client) -> FrameReport {
        for _ in 0..10 {
            if let Step::Frame(report) = self.turn(client) {
                return report;
            }
        }
        panic!("no frame");
    }

    /// One turn of the runtime, and what both ends say meanwhile.
    fn turn(&mut self, client: &mut Client) -> Step {
        self.try_turn(client).expect("a step")
    }

    /// The same with a runtime that may be lost.
    fn try_turn(&mut self, client: &mut Client) -> Result<Step, ClientError> {
        let now = self.begin(client);
        client.intake.advance(now);
        let mut step = None;
        let taken = allocation_counter::measure(|| step = Some(client.step()));
        let step = step.expect("it was made")?;
        let left = self.answer(client);
        self.allocations.push([taken.count_total, left]);
        self.deliver(client, now);
        Ok(step)
    }

    /// The next turn begins: what the server has said reaches the client.
    fn begin(&mut self, client: &mut Client) -> ClientTime {
        let now = at(1_000_000_000 + self.frames * PERIOD_NS);
        self.frames += 1;
        self.deliver(client, now);
        now
    }

    /// The server hears what the client has to say. Gives the number of messages.
    fn answer(&mut self, client: &mut Client) -> u64 {
        let now = at(1_000_000_000 + (self.frames - 1) * PERIOD_NS);
        let mut left = 0;
        while let Some(out) = client.intake.poll_out() {
            left += 1;
            match out {
                Out::Control(bytes) => self.server.on_control(&bytes),
                Out::Datagram(bytes) => self.server.on_datagram(&bytes, ServerTime(now.0 + self.ahead_ns)),
                Out::Stream { .. } => panic!("clients send no streams"),
            }
        }
        while let Some(event) = self.server.poll_event() {
            if matches!(event, ServerEvent::Asked { .. }) {
                self.sender = self.server.accept();
            }
            self.events.push(event);
        }
        left
    }

    /// What the client has said of being watched.
    fn watching(&self) -> Vec<bool> {
        let said = self.events.iter().filter_map(|event| match event {
            ServerEvent::Watching(is_watched) => Some(*is_watched),
            _ => None,
        });
        said.collect()
    }

    fn poses(&self) -> Vec<HeadState> {
        let said = self.events.iter().filter_map(|event| match event {
            ServerEvent::Head(head) => Some(*head),
            _ => None,
        });
        said.collect()
    }

    /// What the server has said reaches the client.
    fn deliver(&mut self, client: &mut Client, now: ClientTime) {
        let server_now = ServerTime(now.0 + self.ahead_ns);
        while let Some(out) = self.server.poll_out(server_now).or_else(|| self.streams.pop_front()) {
            match out {
                Out::Control(bytes) => client.intake.receive_control(now, &bytes),
                Out::Datagram(bytes) => client.intake.receive_datagram(now, &bytes),
                Out::Stream { bytes, .. } => match parse_stream(&bytes).expect("a stream") {
                    StreamMessage::Picture { header, .. }
                        if self.lost_pictures.contains(&header.update.0) =>
                    {
                        client.intake.receive_reset(now, &bytes[..20]);
                    }
                    _ => client.intake.receive_stream(now, &bytes),
                },
            }
        }
    }

    /// Display frames until the session stands and the client knows the server's clock.
    fn connect(client: &mut Client) -> Self {
        Self::connect_with_store(client, 0)
    }

    /// The same with so many pages of settled blocks.
    fn connect_with_store(client: &mut Client, pages: u32) -> Self {
        let ten_metres_on = Pose { position: [10.0, 0.0, 0.0].into(), ..Pose::IDENTITY };
        let mut line = Self::with_store(ten_metres_on, SERVER_AHEAD_NS, pages);
        client.intake.on_connected(at(1_000_000_000));
        for _ in 0..12 {
            line.frame(client);
        }
        assert!(matches!(line.events[0], ServerEvent::Asked { .. }), "{:?}", line.events);
        line
    }

    /// A session that stands, with a server whose world is the stage, and whose clock reads a second now.
    fn in_step(client: &mut Client) -> Self {
        let mut line = Self::new(Pose::IDENTITY, -CONNECTING_TURNS * PERIOD_NS);
        client.intake.on_connected(at(1_000_000_000));
        for _ in 0..CONNECTING_TURNS {
            line.turn(client);
        }
        line
    }

    fn send_delta(&mut self, delta: impl Into<Delta>) {
        let sender = self.sender.as_mut().expect("a session");
        self.streams.push_back(sender.stream(&self.encoder.encode(&delta.into())));
    }

    fn send(&mut self, delta: impl Into<Delta>, planes: &I420, is_refresh: bool) {
        let delta = delta.into();
        let header = PictureHeader {
            update: delta.geometry.update,
            time: ServerTime(delta.geometry.time.0),
            is_refresh,
        };
        self.send_delta(delta);
        self.streams.push_back(picture_stream(header, &coded(planes, is_refresh)).expect("a small picture"));
    }
}

/// The two squares around the client's head, whose stage begins at x = 10 m, both static.
fn static_patches() -> GeometryDelta {
    let mut delta = two_patches().geometry;
    for (index, vertex) in delta.new_vertices.iter_mut().enumerate() {
        let x = [9.5, 9.5, 9.98, 9.98, 10.02, 10.02, 10.5, 10.5][index];
        let y = if index % 2 == 0 { 2.1 } else { 1.1 };
        vertex.motion = Motion::Static { position: [x, y, -2.0].into() };
    }
    delta
}

#[test]
fn a_session_is_agreed_on_and_the_server_learns_of_head_and_time() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    let reports: Vec<_> = (0..10).map(|_| line.frame(&mut client)).collect();
    let ServerEvent::Asked { hello, .. } = &line.events[0] else { panic!("{:?}", line.events) };
    let capabilities = &hello.capabilities;
    assert_eq!((capabilities.eye_extent_pixels, capabilities.max_vertex_slots), ([SIDE; 2], 256));
    assert!((capabilities.eyes[1].head_from_eye.position.x - 0.0315).abs() < 1e-5);
    let poses = line.events.iter().filter_map(|event| match event {
        ServerEvent::Head(pose) => Some(pose),
        _ => None,
    });
    let last: Vec<_> = poses.rev().take(10).collect();
    for (report, pose) in reports.iter().rev().zip(last) {
        let shown = report.display_time.0 + SERVER_AHEAD_NS;
        assert_eq!(pose.time.0, shown, "the head's time is the frame's on the server's clock");
        assert!((pose.world_from_head.position - glam::Vec3::new(10.0, 1.6, 0.0)).length() < 1e-5);
    }
    finish(&run, client);
}

#[test]
fn updates_of_a_session_are_shown_after_decoding_and_reported() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    line.send(static_patches(), &planes([0, 64]), true);
    let reports: Vec<_> = (0..3).map(|_| line.frame(&mut client)).collect();
    // 6 ms of decoding: the first frame is too early.
    assert_eq!(
        reports.iter().map(|report| report.update).collect::<Vec<_>>(),
        [None, Some(UpdateId(0)), Some(UpdateId(0))]
    );
    let displayed = line.events.iter().find_map(|event| match event {
        ServerEvent::Displayed(displayed) => Some(*displayed),
        _ => None,
    });
    let displayed = displayed.expect("a report");
    assert_eq!((displayed.update, displayed.frames_without_bundle), (UpdateId(0), 12));
    assert_eq!(Some(displayed.display_time), reports[1].server_time);
    let stats = client.presenter.stats();
    assert_eq!(
        (stats.bundles, stats.atlas_bytes),
        (1, u64::from(ATLAS.width() * ATLAS.height()) * 3 / 2 + 1)
    );
    finish(&run, client);
    let [x, y] = pixel([-0.25, 1.6, -2.0], -1.0).map(|p| p as u32);
    assert_close(run.picture(stats.frames - 1, Side::Left).at(x, y), RED.0, "the left square");
}

/// The pose, and now and then a question for the server's clock, leave in memory of their own; the timings of `KEPT_RECORDINGS` are
/// kept until others take their place.
#[test]
fn a_display_frame_allocates_nothing_but_the_messages_that_leave() {
    const KEPT_RECORDINGS: usize = 64;
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    line.send(static_patches(), &planes([0, 64]), true);
    for _ in 0..KEPT_RECORDINGS + 60 {
        line.frame(&mut client);
    }
    let settled = &line.allocations[line.allocations.len() - 40..];
    assert!(settled.iter().all(|[count, left]| count <= left), "{settled:?}");
    finish(&run, client);
}

/// With the intake on another thread, all that the thread that draws does is this.
#[test]
fn the_presenter_allocates_nothing_while_updates_arrive() {
    let run = Run::new(MockConfig::default());
    let client = run.client();
    draws_without_allocating(&run, client);
}

#[test]
fn the_presenter_allocates_nothing_with_device_pictures() {
    let run = Run::new(MockConfig::default());
    let client = run.client_on_device(on_device_decoder);
    draws_without_allocating(&run, client);
}

#[test]
fn the_presenter_allocates_nothing_while_blocks_settle() {
    let run = Run::new(MockConfig::default());
    let client = run.client();
    settles_without_allocating(&run, client);
}

#[test]
fn the_presenter_allocates_nothing_while_blocks_of_device_pictures_settle() {
    let run = Run::new(MockConfig::default());
    let client = run.client_on_device(on_device_decoder);
    settles_without_allocating(&run, client);
}

/// What is said changes, the figures are shown, and the world stands still for so long that the notice comes.
#[test]
fn the_presenter_allocates_nothing_while_texts_change() {
    let a = "right/input/a/click";
    let inputs = script(&[(20, a, 1.0), (25, a, 0.0)]);
    let controllers = Some("/interaction_profiles/oculus/touch_controller".to_owned());
    let run = Run::unseen(MockConfig { controllers, inputs, ..MockConfig::default() });
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    line.send(static_patches(), &planes([0, 64]), true);
    for _ in 0..80 {
        line.frame(&mut client);
    }
    let mut allocated = Vec::new();
    for number in 0..400 {
        if number % 30 == 0 {
            client.intake.set_status(&format!("Connection lost; trying again ({number})"));
        }
        client.intake.take_presented();
        client.intake.prepare();
        let taken = allocation_counter::measure(|| {
            let _ = frame_alone(&mut client);
        });
        allocated.push(taken.count_total);
    }
    assert!(allocated[40..].iter().all(|count| *count == 0), "{allocated:?}");
    finish(&run, client);
}

fn draws_without_allocating(run: &Run, mut client: Client) {
    let line = Line::connect(&mut client);
    takes_updates_without_allocating(run, client, line, &[]);
}

fn settles_without_allocating(run: &Run, mut client: Client) {
    let line = Line::connect_with_store(&mut client, 1);
    let settled = [Settled { slot: PatchSlot(0), to: stored(1, 64), pixel: PixelTexels::default() }];
    takes_updates_without_allocating(run, client, line, &settled);
}

fn takes_updates_without_allocating(run: &Run, mut client: Client, mut line: Line, settled: &[Settled]) {
    line.send(static_patches(), &planes([0, 64]), true);
    for _ in 0..80 {
        line.frame(&mut client);
    }
    let mut counts = Vec::new();
    for number in 1..=60 {
        if number % 2 == 0 {
            let update = UpdateId(number / 2);
            let again = GeometryDelta { update, settled: settled.to_vec(), ..GeometryDelta::default() };
            line.send(again, &planes([number as u16, 64]), false);
        }
        let now = line.begin(&mut client);
        client.intake.take_presented();
        client.intake.advance(now);
        client.intake.prepare();
        let mut step = None;
        let taken = allocation_counter::measure(|| {
            let turn = client.presenter.wait_turn().expect("a turn");
            step = Some(client.presenter.present(turn, None));
        });
        let Some(Ok(Step::Frame(report))) = step else { panic!("{step:?}") };
        counts.push((report.is_new, taken.count_total));
        line.answer(&mut client);
    }
    let settled = &counts[20..];
    assert!(
        settled.iter().filter(|(is_new, _)| *is_new).count() > 15,
        "bundles came on display: {settled:?}"
    );
    assert!(settled.iter().all(|(_, count)| *count == 0), "{settled:?}");
    finish(run, client);
}

#[test]
fn device_pictures_are_drawn_in_any_format_and_returned() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client_on_device(changing_decoder);
    let mut line = Line::connect(&mut client);
    line.send(static_patches(), &planes([0, 64]), true);
    let mut shown = Vec::new();
    for number in 1..=60 {
        if number % 2 == 0 {
            let update = UpdateId(number / 2);
            let again = GeometryDelta { update, ..GeometryDelta::default() };
            // Red and blue change places with every second one.
            let at = if number / 2 % 2 == 0 { [0, 64] } else { [64, 0] };
            line.send(again, &planes(at), false);
        }
        let report = line.frame(&mut client);
        let stats = client.presenter.stats();
        shown.extend(report.update.map(|update| (stats.frames - 1, update.0)));
    }
    finish(&run, client);
    assert!(shown.last().is_some_and(|(_, update)| *update >= 28), "{shown:?}");
    for (index, update) in shown {
        let want = if update % 2 == 0 { [RED.0, BLUE.0] } else { [BLUE.0, RED.0] };
        let picture = run.picture(index, Side::Left);
        for (x, want) in [-0.25, 0.25].into_iter().zip(want) {
            let [x, y] = pixel([x, 1.6, -2.0], -1.0).map(|p| p as u32);
            assert_close(picture.at(x, y), want, &format!("update {update} in frame {index}"));
        }
    }
}

#[test]
fn a_lost_picture_keeps_the_last_bundle_until_a_refresh() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    line.lost_pictures = vec![1];
    line.send(static_patches(), &planes([0, 64]), true);
    line.frame(&mut client);
    for frame in 1..4 {
        let placements = vec![(PatchSlot(0), Some(block(64 * frame as u16)))];
        let delta = GeometryDelta { update: UpdateId(frame), placements, ..GeometryDelta::default() };
        line.send(delta, &planes([64 * frame as u16, 0]), frame == 3);
        let shown = line.frame(&mut client).update;
        assert_eq!(
            shown,
            Some(UpdateId(0)),
            "update {frame} is not shown: it needs the lost one, or is being decoded"
        );
    }
    assert_eq!(line.frame(&mut client).update, Some(UpdateId(3)));
    let asked =
        line.events.iter().filter(|event| matches!(event, ServerEvent::RefreshRequest { .. })).count();
    assert_eq!((asked, client.presenter.stats().lost_pictures), (1, 2));
    finish(&run, client);
}

/// A block of the store as large as [`block`]'s.
fn stored(page: u8, x: u16) -> Block {
    let Block { address, size } = block(x);
    Block { address: BlockAddress { page, y: 128, ..address }, size }
}

/// What settles with an update, and where patches are from it on.
fn settling(update: u32, settled: &[(u32, Block)], placed: &[(u32, Block)]) -> GeometryDelta {
    let settles = |(slot, to): &(u32, Block)| Settled {
        slot: PatchSlot(*slot),
        to: *to,
        pixel: PixelTexels::default(),
    };
    GeometryDelta {
        update: UpdateId(update),
        settled: settled.iter().map(settles).collect(),
        placements: placed.iter().map(|(slot, block)| (PatchSlot(*slot), Some(*block))).collect(),
        ..GeometryDelta::default()
    }
}

/// The left square's block settles with the first update, the right one's with the second, which the display skips.
fn keeps_settled_colours(run: &Run, mut client: Client) {
    let mut line = Line::connect_with_store(&mut client, 2);
    let (left, right) = (stored(1, 64), stored(2, 192));
    let first = settling(0, &[(0, left)], &[]).settled;
    line.send(GeometryDelta { settled: first, ..static_patches() }, &planes([0, 64]), true);
    line.frame(&mut client);
    assert_eq!(line.frame(&mut client).update, Some(UpdateId(0)));
    line.send(settling(1, &[(1, right)], &[(0, left)]), &planes([128, 64]), false);
    line.send(settling(2, &[], &[(1, right)]), &planes([128, 192]), false);
    let shown: Vec<_> = (0..3).map(|_| line.frame(&mut client).update.map(|update| update.0)).collect();
    assert_eq!(shown, [Some(0), Some(2), Some(2)], "the second update is decoded, and skipped");
    let last = client.presenter.stats().frames - 1;
    assert!(!line.events.iter().any(|event| matches!(event, ServerEvent::RefreshRequest { .. })));
    finish(run, client);
    for index in last - 3..=last {
        let picture = run.picture(index, Side::Left);
        for (x, want) in [(-0.25, RED.0), (0.25, BLUE.0)] {
            let [x, y] = pixel([x, 1.6, -2.0], -1.0).map(|p| p as u32);
            assert_close(picture.at(x, y), want, &format!("frame {index} at {x}"));
        }
    }
}

#[test]
fn a_settled_block_keeps_the_colours_of_its_picture() {
    let run = Run::new(MockConfig::default());
    let client = run.client();
    keeps_settled_colours(&run, client);
}

#[test]
fn a_settled_block_of_a_device_picture_keeps_its_colours() {
    let run = Run::new(MockConfig::default());
    let client = run.client_on_device(on_device_decoder);
    keeps_settled_colours(&run, client);
}

/// They come at once, and are decoded two in a display frame.
#[test]
fn every_block_of_a_burst_of_updates_settles() {
    for burst in [3, 5, 9] {
        let run = Run::new(MockConfig::default());
        let mut client = run.client();
        let mut line = Line::connect_with_store(&mut client, 1);
        line.send(static_patches(), &planes([0, 64]), true);
        line.frame(&mut client);
        for update in 1..=burst {
            let to = stored(1, 64 * update as u16);
            line.send(settling(update, &[(0, to)], &[]), &planes([0, 64]), false);
        }
        for _ in 0..20 {
            line.frame(&mut client);
        }
        let mut shown = Vec::new();
        for update in 1..=burst {
            let placed = [(0, stored(1, 64 * update as u16))];
            line.send(settling(burst + update, &[], &placed), &planes([128, 64]), false);
            line.frame(&mut client);
            assert_eq!(line.frame(&mut client).update, Some(UpdateId(burst + update)));
            shown.push((update, client.presenter.stats().frames - 1));
        }
        assert_eq!(refreshes_asked(&line), []);
        finish(&run, client);
        let [x, y] = pixel([-0.25, 1.6, -2.0], -1.0).map(|p| p as u32);
        for (update, frame) in shown {
            let what = format!("the block of update {update} of {burst}");
            assert_close(run.picture(frame, Side::Left).at(x, y), RED.0, &what);
        }
    }
}

/// The refreshes asked for.
fn refreshes_asked(line: &Line) -> Vec<Option<UpdateId>> {
    let asked = line.events.iter().filter_map(|event| match event {
        ServerEvent::RefreshRequest { after } => Some(*after),
        _ => None,
    });
    asked.collect()
}

/// The picture that heals the decoder heals no store.
#[test]
fn a_lost_picture_with_settled_blocks_requests_a_refresh() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::connect_with_store(&mut client, 1);
    line.send(static_patches(), &planes([0, 64]), true);
    line.frame(&mut client);
    line.frame(&mut client);
    line.send_delta(settling(1, &[(0, stored(1, 64))], &[]));
    line.send(settling(2, &[], &[]), &planes([0, 64]), true);
    for _ in 0..20 {
        line.frame(&mut client);
    }
    assert_eq!(refreshes_asked(&line), [Some(UpdateId(0))]);
    finish(&run, client);
}

#[test]
fn one_request_tells_of_all_that_a_lost_picture_took_along() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::connect_with_store(&mut client, 1);
    line.lost_pictures = vec![1];
    line.send(static_patches(), &planes([0, 64]), true);
    line.frame(&mut client);
    for update in 1..5 {
        // Those after the lost one cannot be decoded; the last answers the request.
        let to = stored(1, 64 * update as u16);
        line.send(settling(update, &[(0, to)], &[]), &planes([0, 64]), update == 4);
        line.frame(&mut client);
    }
    for _ in 0..20 {
        line.frame(&mut client);
    }
    assert_eq!(refreshes_asked(&line), [Some(UpdateId(0))]);
    finish(&run, client);
}

#[test]
fn a_client_offers_the_pages_that_it_is_told_to() {
    for (pages, offered) in [(0, 0), (6, 6), (u32::MAX, MAX_STORE_PAGES)] {
        let run = Run::unseen(MockConfig::default());
        let mut client = run.client_of_pages(pages);
        let line = Line::connect_with_store(&mut client, 0);
        let ServerEvent::Asked { hello, .. } = &line.events[0] else { panic!("{:?}", line.events) };
        assert_eq!(hello.capabilities.store_pages, offered);
        finish(&run, client);
    }
}

#[test]
fn a_reconnect_keeps_the_old_bundle_until_a_new_one() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    line.send(static_patches(), &planes([0, 64]), true);
    for _ in 0..2 {
        line.frame(&mut client);
    }
    client.intake.on_closed(at(2_000_000_000));
    for _ in 0..3 {
        assert_eq!(frame(&mut client).update, Some(UpdateId(0)), "without a server the last bundle stays");
    }
    let mut line = Line::connect(&mut client);
    assert_eq!(line.frame(&mut client).update, Some(UpdateId(0)), "connected, but there is no new one yet");
    // The new server has the squares' colours exchanged.
    line.send(static_patches(), &planes([64, 0]), true);
    line.frame(&mut client);
    assert!(line.frame(&mut client).is_new);
    let last = client.presenter.stats().frames - 1;
    assert_eq!(client.presenter.stats().connections, 2);
    finish(&run, client);
    let [x, y] = pixel([-0.25, 1.6, -2.0], -1.0).map(|p| p as u32);
    assert_close(run.picture(last - 2, Side::Left).at(x, y), RED.0, "the old server's picture");
    assert_close(run.picture(last, Side::Left).at(x, y), BLUE.0, "the new server's picture");
}

/// A decoder for the first session alone.
fn decoder_of_the_first(
    codec: Codec,
    extent: AtlasExtent,
    gpu: &Arc<Gpu>,
) -> Result<Box<dyn Decoder>, DecodeError> {
    static MADE: AtomicU32 = AtomicU32::new(0);
    match MADE.fetch_add(1, Ordering::Relaxed) {
        0 => toy_decoder(codec, extent, gpu),
        _ => Err(DecodeError::Extent(extent.texels())),
    }
}

#[test]
fn undecodable_sessions_leave_the_displayed_scene_alone() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client_with(decoder_of_the_first);
    let mut line = Line::connect(&mut client);
    line.send(static_patches(), &planes([0, 64]), true);
    for _ in 0..2 {
        line.frame(&mut client);
    }
    client.intake.on_closed(at(2_000_000_000));
    frame(&mut client);
    let mut line = Line::connect(&mut client);
    // Lawful in an empty memory, and not beside the first session's patches; more than wait for pictures.
    let geometry = static_patches();
    let other = |slot: VertexSlot| VertexSlot(slot.0 + 100);
    let mut enters = geometry.clone();
    enters.new_vertices.iter_mut().for_each(|vertex| vertex.slot = other(vertex.slot));
    enters.new_patches.iter_mut().for_each(|patch| patch.vertices = patch.vertices.map(other));
    line.send_delta(enters);
    for update in 1..300 {
        line.send_delta(GeometryDelta { update: UpdateId(update), ..GeometryDelta::default() });
        if update % 50 == 0 {
            assert_eq!(line.frame(&mut client).update, Some(UpdateId(0)), "the first one's stays");
        }
    }
    assert_eq!(line.frame(&mut client).update, Some(UpdateId(0)));
    let failures =
        std::iter::from_fn(|| client.intake.poll_notice()).filter(|n| matches!(n, Notice::Failed(_)));
    assert_eq!(failures.count(), 1, "and the driver knows");
    finish(&run, client);
}

/// As [`Line::turn`], with an intake on a thread of its own, which runs once a turn.
fn turn_apart(line: &mut Line, client: &mut Client) {
    let now = line.begin(client);
    client.intake.take_presented();
    client.intake.advance(now);
    client.intake.prepare();
    let turn = client.presenter.wait_turn().expect("a turn");
    client.presenter.present(turn, None).expect("a step");
    line.answer(client);
    line.deliver(client, now);
}

#[test]
fn at_most_two_scenes_are_held_by_servers_that_come_and_go() {
    let run = Run::unseen(MockConfig::default());
    let mut client = run.client();
    let mut first = Line::connect(&mut client);
    first.send(static_patches(), &planes([0, 64]), true);
    for _ in 0..3 {
        first.frame(&mut client);
    }
    let held_bytes = |client: &Client| {
        let of_name = |used: &MemoryUse| (used.name == "vertex positions").then_some(used.bytes);
        client.presenter.gpu().memory().iter().filter_map(of_name).sum::<u64>()
    };
    let one_scene = held_bytes(&client);
    let (mut most, mut frames) = (0, first.frames);
    for _ in 0..6 {
        let mut line = Line { frames, ..Line::new(Pose::IDENTITY, SERVER_AHEAD_NS) };
        client.intake.on_connected(at(1_000_000_000 + line.frames * PERIOD_NS));
        let from = client.presenter.stats().connections;
        while client.presenter.stats().connections == from {
            turn_apart(&mut line, &mut client);
            most = most.max(held_bytes(&client));
        }
        frames = line.frames;
    }
    assert_eq!(client.presenter.stats().connections, 7, "each brought a scene");
    assert_eq!(most, 2 * one_scene);
    finish(&run, client);
}

/// Pixels of the left eye that two frames show differently.
fn differing(run: &Run, before: u64, after: u64) -> usize {
    let (before, after) = (run.picture(before, Side::Left), run.picture(after, Side::Left));
    before.pixels().zip(after.pixels()).filter(|(before, after)| before != after).count()
}

#[test]
fn a_world_that_stands_still_says_why_until_pictures_come_again() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    line.send(static_patches(), &planes([0, 64]), true);
    for _ in 0..3 {
        line.frame(&mut client);
    }
    let moving = client.presenter.stats().frames - 1;
    client.intake.on_closed(at(2_000_000_000));
    client.presenter.set_status("Connecting to 192.168.1.5:7400: it did not answer");
    for _ in 0..100 {
        frame(&mut client);
    }
    let quiet = client.presenter.stats().frames - 1;
    for _ in 0..60 {
        assert_eq!(frame(&mut client).update, Some(UpdateId(0)), "the last bundle stays");
    }
    let told = client.presenter.stats().frames - 1;
    let mut line = Line::connect(&mut client);
    line.send(static_patches(), &planes([0, 64]), true);
    while !line.frame(&mut client).is_new {}
    line.frame(&mut client);
    let again = client.presenter.stats().frames - 1;
    finish(&run, client);
    assert_eq!(differing(&run, moving, quiet), 0, "a second without a picture is not worth a word");
    assert!(differing(&run, moving, told) > 1000, "a panel is in front of the world");
    let ink = run.picture(told, Side::Left).pixels().filter(|pixel| pixel.iter().all(|c| *c > 200)).count();
    assert!(ink > 50, "{ink} bright pixels of text");
    assert_eq!(differing(&run, moving, again), 0, "the world moves again");
}

/// A head that looks ahead for `from_s` seconds, and then turns to the left at `speed`, radians per second, for `for_s`.
fn turning_head(folder: &Path, from_s: f32, speed: f32, for_s: f32) -> PathBuf {
    let row = |t_s: f32, yaw: f32| format!("{t_s},0,1.6,0,0,{},0,{}\n", (yaw * 0.5).sin(), (yaw * 0.5).cos());
    let steps = (0..=20).map(|step| step as f32 / 20.0 * for_s);
    let turn: String = steps.map(|t_s| row(from_s + t_s, t_s * speed)).collect();
    let path = folder.join("turn.csv");
    std::fs::write(&path, row(0.0, 0.0) + &turn).expect("write the head path");
    path
}

/// Whether the left edge of the red square is seen where a head at `stage_from_head` has it: red within, and not beyond.
fn is_edge_seen(picture: &Picture, stage_from_head: Pose, eye: f32) -> bool {
    let head_from_eye = Pose { position: [eye * 0.0315, 0.0, 0.0].into(), ..Pose::IDENTITY };
    let eye_from_stage = stage_from_head.then(head_from_eye).inverse().affine();
    let is_red = |x: f32| {
        // Above the panel with the text.
        let seen = eye_from_stage.transform_point3([x, 2.0, -2.0].into());
        let half = SIDE as f32 * 0.5;
        let [x, y] = [half - seen.x / seen.z * half, half + seen.y / seen.z * half];
        picture.at(x as u32, y as u32).iter().zip(RED.0).all(|(got, want)| got.abs_diff(want) <= 12)
    };
    is_red(-0.475) && !is_red(-0.525)
}

#[test]
fn a_silent_server_leaves_the_head_free_under_a_notice() {
    let folder = tempfile::tempdir().expect("a folder");
    // 3 pixels from frame to frame.
    let head_path = Some(turning_head(folder.path(), 3.4, 1.8, 0.25));
    let run = Run::new(MockConfig { head_path, ..MockConfig::default() });
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    line.send(static_patches(), &planes([0, 64]), true);
    for _ in 0..3 {
        line.frame(&mut client);
    }
    client.presenter.set_status("Connected to 192.168.1.5:7400");
    for _ in 0..250 {
        assert_eq!(frame(&mut client).update, Some(UpdateId(0)), "the last bundle stays");
    }
    finish(&run, client);
    let frames: Vec<_> = read_frames(&run.captures()).expect("a log");
    let heads: Vec<Pose> = frames.iter().map(|frame| frame.head_pose.into()).collect();
    let turning: Vec<_> = (1..frames.len())
        .filter(|at| heads[*at].orientation.dot(heads[at - 1].orientation) < 0.999_99)
        .collect();
    assert!(turning.len() >= 16, "{} frames in which the head turns", turning.len());
    for at in turning {
        let frame = frames[at].frame;
        for (side, eye) in [(Side::Left, -1.0), (Side::Right, 1.0)] {
            let picture = run.picture(frame, side);
            assert!(is_edge_seen(&picture, heads[at], eye), "{side:?} eye of frame {frame}");
            assert!(!is_edge_seen(&picture, heads[at - 1], eye), "a head of one frame ago would pass");
            let ink = picture.pixels().filter(|pixel| pixel.iter().all(|c| *c > 200)).count();
            assert!(ink > 50, "{ink} bright pixels of text in frame {frame}");
        }
    }
}

/// What keeps a device from going on, until the CPU lets it.
struct Gate {
    gpu: Arc<Gpu>,
    event: vk::Event,
}

impl Gate {
    fn close(gpu: &Arc<Gpu>) -> Self {
        let device = gpu.device();
        // SAFETY: the device is alive; the event is waited for by the recording alone, and set before the gate goes.
        unsafe {
            let event = device.create_event(&vk::EventCreateInfo::default(), None).expect("an event");
            let recorder = gpu.record().expect("a recording");
            let (from, to) = (vk::PipelineStageFlags::HOST, vk::PipelineStageFlags::ALL_COMMANDS);
            device.cmd_wait_events(recorder.commands(), &[event], from, to, &[], &[], &[]);
            recorder.submit().expect("it waits");
            Self { gpu: gpu.clone(), event }
        }
    }

    fn open(&self) {
        // SAFETY: the event is alive.
        unsafe { self.gpu.device().set_event(self.event) }.expect("set");
    }
}

impl Drop for Gate {
    fn drop(&mut self) {
        self.open();
        self.gpu.wait_idle();
        // SAFETY: the device is done with it.
        unsafe { self.gpu.device().destroy_event(self.event, None) };
    }
}

/// A frame of the half that draws alone, which therefore waits for nothing.
fn frame_alone(client: &mut Client) -> FrameReport {
    let turn = client.presenter.wait_turn().expect("a turn");
    match client.presenter.present(turn, None).expect("a step") {
        Step::Frame(report) => report,
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_slow_device_is_not_waited_for_and_repeats_its_picture() {
    let folder = tempfile::tempdir().expect("a folder");
    let head_path = Some(turning_head(folder.path(), 0.1, 1.0, 3.0));
    let run = Run::unseen(MockConfig { head_path, ..MockConfig::default() });
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    line.send(static_patches(), &planes([0, 64]), true);
    for _ in 0..3 {
        line.frame(&mut client);
    }
    client.presenter.frame_timings().expect("it waits until the device is done");
    let first = client.presenter.stats().frames as usize;

    let gate = Gate::close(&client.presenter.gpu().clone());
    let behind: Vec<_> = (0..12).map(|_| frame_alone(&mut client)).collect();
    for (at, report) in behind.iter().enumerate() {
        let is_new = at < FRAMES_IN_FLIGHT;
        assert_eq!((report.is_rendered, report.is_repeated), (is_new, !is_new), "frame {at}");
        assert_eq!(report.update, Some(UpdateId(0)), "the same bundle");
    }
    gate.open();
    let caught_up = (0..100_000).position(|_| frame_alone(&mut client).is_rendered);
    let repeated = behind.len() - FRAMES_IN_FLIGHT + caught_up.expect("it goes on");
    drop(gate);
    assert_eq!(client.presenter.stats().repeated_frames, repeated as u64);
    client.intake.take_presented();
    finish(&run, client);

    let frames = read_frames(&run.captures()).expect("a log");
    let shown = |at: usize| (frames[at].views[0].pose, frames[at].views[1].pose);
    let last = first + FRAMES_IN_FLIGHT - 1;
    for at in last + 1..first + behind.len() {
        assert!(frames[at].repeated && !frames[at].empty, "frame {at}");
        assert_eq!(shown(at), shown(last), "as seen from where the eyes were when it was drawn");
        assert_ne!(frames[at].head_pose, frames[at - 1].head_pose, "the head goes on");
    }
    assert!(!frames[last].repeated && shown(last) != shown(last - 1));
    assert_eq!(frames.iter().filter(|frame| frame.repeated).count(), repeated);
}

/// Steps of the grid for the moving strip at the client's time; the server's clock is ahead.
fn strip_steps(line: &Line) -> std::ops::RangeInclusive<i32> {
    let now = WorldTime(1_000_000_000 + line.frames * PERIOD_NS + line.ahead_ns);
    let step = DEFAULT_GRID.floor(now).0;
    step..=step + 5
}

/// An update every other turn, from a server that goes on though nobody looks. Gives the bytes that wait in the client.
fn absence(line: &mut Line, client: &mut Client, turns: u32, frame: &mut u32) -> usize {
    let planes = planes([0, 64]);
    for turn in 0..turns {
        if turn % 2 == 0 {
            *frame += 1;
            let samples = strip_samples(0..6, strip_steps(line));
            let geometry = GeometryDelta { update: UpdateId(*frame), ..GeometryDelta::default() };
            line.send(Delta { geometry, is_update: true, samples }, &planes, true);
        }
        line.turn(client);
    }
    client.intake.waiting_bytes()
}

#[test]
fn an_unwatched_client_keeps_its_picture_current() {
    let events = vec![
        ScriptedEvent { frame: 20, kind: EventKind::Hide },
        ScriptedEvent { frame: 1460, kind: EventKind::Show },
    ];
    let run = Run::new(MockConfig { events, capture_every: 0, ..MockConfig::default() });
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    line.send(moving_strip(strip_samples(0..6, strip_steps(&line))), &planes([0, 64]), true);
    let mut newest = 0;
    absence(&mut line, &mut client, 8, &mut newest);
    assert!(line.watching().is_empty(), "somebody looks");
    let early = absence(&mut line, &mut client, 700, &mut newest);
    assert_eq!(line.watching(), [false], "told once");
    let late = absence(&mut line, &mut client, 720, &mut newest);
    assert!(late <= early, "{early} bytes wait after 10 s, {late} after 20 s");
    let back: Vec<_> = (0..30).map(|_| line.frame(&mut client)).collect();
    assert_eq!(line.watching(), [false, true]);
    let first = back.iter().find(|report| report.is_rendered).expect("seen again");
    assert_eq!(first.update, Some(UpdateId(newest)), "the newest, and at once");
    finish(&run, client);
}

#[test]
fn a_resumed_session_keeps_its_server() {
    let events = vec![ScriptedEvent { frame: 20, kind: EventKind::Pause { ms: 10_000 } }];
    let run = Run::new(MockConfig { events, capture_every: 0, ..MockConfig::default() });
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    line.send(moving_strip(strip_samples(0..6, strip_steps(&line))), &planes([0, 64]), true);
    let mut newest = 0;
    absence(&mut line, &mut client, 20, &mut newest);
    let jump = line.poses().last().expect("poses").discontinuity;
    let early = absence(&mut line, &mut client, 540, &mut newest);
    assert_eq!(client.step().expect("a step"), Step::Idle);
    let late = absence(&mut line, &mut client, 120, &mut newest);
    assert!(late <= early, "{early} bytes wait at first, {late} in the end");
    assert_eq!(line.watching(), [false]);
    let turns = (0..130).map(|_| line.turn(&mut client));
    let back: Vec<_> = turns
        .filter_map(|step| match step {
            Step::Frame(report) => Some(report),
            _ => None,
        })
        .collect();
    assert_eq!(line.watching(), [false, true]);
    let first = back.iter().find(|report| report.is_rendered).expect("seen again");
    assert_eq!(first.update, Some(UpdateId(newest)));
    assert_ne!(line.poses().last().expect("poses").discontinuity, jump, "another session of the headset");
    assert_eq!(client.presenter.stats().connections, 1);
    finish(&run, client);
}

#[test]
fn recentring_is_distinguished_from_motion_at_its_frame() {
    let kind = EventKind::Recentre { x_mm: 2000, z_mm: 500, yaw_degrees: 30 };
    let events = vec![ScriptedEvent { frame: 20, kind }];
    let run = Run::new(MockConfig { events, ..MockConfig::default() });
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    for _ in 0..30 {
        line.frame(&mut client);
    }
    let poses = line.poses();
    let mut jumps = 0;
    for pair in poses.windows(2) {
        let moved_m = pair[0].world_from_head.position.distance(pair[1].world_from_head.position);
        assert_eq!(moved_m > 1.0, pair[0].discontinuity != pair[1].discontinuity, "{pair:?}");
        assert!(pair[1].linear_velocity.length() < 0.1, "a jump is no velocity: {pair:?}");
        jumps += u32::from(moved_m > 1.0);
    }
    assert_eq!(jumps, 1);
    finish(&run, client);
}

/// Inputs with their values, each from a frame on.
fn script(inputs: &[(u64, &str, f32)]) -> Vec<ScriptedInput> {
    let input = |(frame, path, value): &(u64, &str, f32)| ScriptedInput {
        frame: *frame,
        path: format!("/user/hand/{path}"),
        value: *value,
    };
    inputs.iter().map(input).collect()
}

#[test]
fn controllers_walk_and_turn_the_room_through_the_world() {
    for (controllers, walk, turn) in [
        ("oculus/touch_controller", "left/input/thumbstick/y", "right/input/thumbstick/x"),
        ("valve/index_controller", "left/input/thumbstick/y", "right/input/thumbstick/x"),
        ("khr/simple_controller", "left/input/select/click", "right/input/select/click"),
    ] {
        let inputs = script(&[(20, walk, 1.0), (56, walk, 0.0), (70, turn, 1.0), (75, turn, 0.0)]);
        let controllers = Some(format!("/interaction_profiles/{controllers}"));
        let run = Run::new(MockConfig { controllers, inputs, ..MockConfig::default() });
        let mut client = run.client();
        let mut line = Line::connect(&mut client);
        for _ in 0..80 {
            line.frame(&mut client);
        }
        let poses = line.poses();
        let (first, last) = (poses[0], poses[poses.len() - 1]);
        let moved = last.world_from_head.position - first.world_from_head.position;
        assert!(moved.abs_diff_eq([0.0, 0.0, -0.8].into(), 0.03), "half a second at a brisk pace: {moved}");
        let walks =
            poses.iter().filter(|pose| pose.linear_velocity.abs_diff_eq([0.0, 0.0, -1.6].into(), 0.01));
        let (walks, frames) = (walks.count(), 36);
        assert!(walks.abs_diff(frames) <= 2, "{walks} frames say that they walk");
        let turned =
            (last.world_from_head.orientation * first.world_from_head.orientation.inverse()).to_scaled_axis();
        let right = -std::f32::consts::PI / 6.0;
        assert!(turned.abs_diff_eq([0.0, right, 0.0].into(), 1e-3), "one flick, one turn: {turned}");
        let jumps = poses.windows(2).filter(|pair| pair[0].discontinuity != pair[1].discontinuity).count();
        assert_eq!(jumps, 1, "a turn is a jump, a walk is none");
        finish(&run, client);
        // The compositor knows the room alone.
        for shown in read_frames(&run.captures()).expect("a log") {
            for view in &shown.views {
                let [x, y, z] = view.pose.position;
                assert!(x.abs() < 0.04 && (y - 1.6).abs() < 1e-4 && z.abs() < 1e-4, "{:?}", view.pose);
            }
        }
    }
}

#[test]
fn the_nearest_refresh_rate_is_requested() {
    let events = vec![ScriptedEvent { frame: 30, kind: EventKind::RefreshRate { hz: 90 } }];
    let other_rates_hz = vec![90.0, 120.0];
    let run = Run::unseen(MockConfig { events, other_rates_hz, ..MockConfig::default() });
    let mut client = run.client_at(118.0);
    let times: Vec<ClientTime> = (0..60).map(|_| frame(&mut client).display_time).collect();
    let apart: Vec<i64> = times.windows(2).map(|pair| pair[1].since(pair[0])).collect();
    assert!(apart[1..28].iter().all(|period_ns| is_of(*period_ns, 120.0)), "{apart:?}");
    assert!(apart[31..].iter().all(|period_ns| is_of(*period_ns, 90.0)), "{apart:?}");
    finish(&run, client);
}

fn is_of(period_ns: i64, hz: f64) -> bool {
    (period_ns - (1e9 / hz) as i64).abs() <= 1
}

#[test]
fn sustained_performance_is_requested_where_offered() {
    let levels = |hidden: &[&str]| {
        let hidden_extensions = hidden.iter().map(|name| (*name).to_owned()).collect();
        let run = Run::unseen(MockConfig { hidden_extensions, ..MockConfig::default() });
        let mut client = run.client();
        frame(&mut client);
        finish(&run, client);
        let summary = shadecast_mock_runtime::record::read_summary(&run.captures());
        summary.expect("a summary").performance_levels
    };
    assert_eq!(levels(&[]), [50; 2], "sustained high");
    assert_eq!(levels(&["XR_EXT_performance_settings"]), [0; 2]);
}

#[test]
fn a_runtime_that_cannot_be_asked_for_a_rate_keeps_its_own() {
    let hidden_extensions = vec!["XR_FB_display_refresh_rate".to_owned()];
    let run = Run::unseen(MockConfig { hidden_extensions, ..MockConfig::default() });
    let mut client = run.client_at(120.0);
    let times = [frame(&mut client), frame(&mut client)].map(|report| report.display_time);
    assert!(is_of(times[1].since(times[0]), 72.0), "{times:?}");
    finish(&run, client);
}

#[test]
fn the_menu_button_leaves() {
    let inputs = script(&[(10, "left/input/menu/click", 1.0)]);
    let controllers = Some("/interaction_profiles/oculus/touch_controller".to_owned());
    let run = Run::new(MockConfig { controllers, inputs, ..MockConfig::default() });
    let mut client = run.client();
    let frames = (0..100).take_while(|_| client.step().expect("a step") != Step::Exit).count();
    assert!((10..25).contains(&frames), "{frames} steps");
    finish(&run, client);
}

#[test]
fn a_button_toggles_the_figures() {
    for profile in ["oculus/touch_controller", "valve/index_controller"] {
        let a = "right/input/a/click";
        let inputs = script(&[(20, a, 1.0), (50, a, 0.0), (60, a, 1.0), (65, a, 0.0)]);
        let controllers = Some(format!("/interaction_profiles/{profile}"));
        let run = Run::new(MockConfig { controllers, inputs, ..MockConfig::default() });
        let mut client = run.client();
        for _ in 0..80 {
            frame(&mut client);
        }
        finish(&run, client);
        for (side, eye) in [(Side::Left, -1.0), (Side::Right, 1.0)] {
            let [before, held, shown, hidden] = [10, 40, 55, 75].map(|number| run.picture(number, side));
            assert!(before.pixels().eq(hidden.pixels()), "{profile}: nothing is left behind");
            let [x, y] = pixel([0.0, 1.15, -1.75], eye);
            for panel in [held, shown] {
                let differs = |(x, y): &(u32, u32)| panel.at(*x, *y) != before.at(*x, *y);
                let changed: Vec<_> =
                    (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| (x, y))).filter(differs).collect();
                let is_far =
                    |at: &&(u32, u32)| (at.0 as f32 - x).abs() > 60.0 || (at.1 as f32 - y).abs() > 18.0;
                assert_eq!(changed.iter().find(is_far), None, "{profile}: all else stays as it was");
                assert!(changed.len() > 1000, "{profile}: {} pixels", changed.len());
            }
        }
    }
}

#[test]
fn controllers_are_drawn_in_place_in_both_eyes() {
    let hand = |frame, hand: &str, position_m| ScriptedHand {
        frame,
        hand: format!("/user/hand/{hand}"),
        position_m,
        yaw_pitch_roll_degrees: [0.0; 3],
    };
    let (left, right) = ([-0.15, 1.5, -0.5], [0.2, 1.7, -0.6]);
    let controllers = Some("/interaction_profiles/oculus/touch_controller".to_owned());
    let hands = vec![hand(20, "left", Some(left)), hand(30, "right", Some(right)), hand(40, "left", None)];
    let run = Run::new(MockConfig { controllers, hands, ..MockConfig::default() });
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    line.send(static_patches(), &planes([0, 64]), true);
    let first = client.presenter.stats().frames;
    for _ in 0..50 {
        line.frame(&mut client);
    }
    assert!(first < 15, "{first} frames to connect");
    finish(&run, client);
    for (side, eye) in [(Side::Left, -1.0), (Side::Right, 1.0)] {
        let at = |number: u64, place: [f32; 3]| {
            let [x, y] = pixel(place, eye).map(|p| p as u32);
            run.picture(number, side).at(x, y)
        };
        let is_blue = |[r, _, b]: [u8; 3]| b > r.saturating_add(30);
        let is_orange = |[r, _, b]: [u8; 3]| r > b.saturating_add(30);
        let [before, one, both, other] = [15, 25, 35, 45].map(|number| [at(number, left), at(number, right)]);
        assert!(is_blue(one[0]) && one[0] != before[0], "the left one: {one:?} after {before:?}");
        assert_eq!(one[1], before[1], "no right one yet");
        assert!(both[0] == one[0] && is_orange(both[1]) && both[1] != before[1], "both: {both:?}");
        assert_eq!([other[0], other[1]], [before[0], both[1]], "the left one is not tracked any more");
    }
}

#[test]
fn buttons_go_through_a_list_and_take_of_it_once_for_each_press() {
    for (profile, next, take) in [
        ("oculus/touch_controller", "right/input/b/click", "right/input/trigger/value"),
        ("valve/index_controller", "right/input/b/click", "right/input/trigger/value"),
        ("khr/simple_controller", "left/input/select/click", "right/input/select/click"),
    ] {
        let presses = [(20, next, 1.0), (25, next, 0.0), (30, next, 1.0), (35, next, 0.0), (40, take, 1.0)];
        let controllers = Some(format!("/interaction_profiles/{profile}"));
        let run = Run::new(MockConfig { controllers, inputs: script(&presses), ..MockConfig::default() });
        let mut client = run.client();
        let picks: Vec<_> = (0..60)
            .map(|_| {
                frame(&mut client);
                client.intake.take_presented();
                client.intake.presses()
            })
            .collect();
        let at = |frame: usize| (picks[frame].nexts, picks[frame].takes);
        assert_eq!([10, 23, 33, 50, 59].map(at), [(0, 0), (1, 0), (2, 0), (2, 1), (2, 1)], "{profile}");
        finish(&run, client);
    }
}

#[test]
fn triggers_halt_the_world_and_let_it_go_on_and_make_steps() {
    let (halt, step) = ("right/input/trigger/value", "left/input/trigger/value");
    let pulls = [(25, halt), (35, step), (40, step), (50, halt), (53, halt)];
    let presses: Vec<_> =
        pulls.iter().flat_map(|(frame, path)| [(*frame, *path, 1.0), (frame + 2, *path, 0.0)]).collect();
    for profile in ["oculus/touch_controller", "valve/index_controller"] {
        let controllers = Some(format!("/interaction_profiles/{profile}"));
        let run = Run::new(MockConfig { controllers, inputs: script(&presses), ..MockConfig::default() });
        let mut client = run.client();
        let mut line = Line::connect(&mut client);
        line.send(static_patches(), &planes([0, 64]), true);
        for _ in 0..70 {
            line.frame(&mut client);
        }
        let wanted: Vec<Steering> = line
            .events
            .iter()
            .filter_map(|event| if let ServerEvent::Steer(wanted) = event { Some(*wanted) } else { None })
            .collect();
        // This server says nothing of the world's time: who asked for it to stand asks for it to go on next.
        let expected = [Steer::Halt, Steer::Step, Steer::Step, Steer::GoOn, Steer::Halt].map(Steering::from);
        assert_eq!(wanted, expected, "{profile}");
        finish(&run, client);
    }
}

#[test]
fn without_focus_controllers_do_nothing() {
    let inputs = script(&[(20, "left/input/thumbstick/y", 1.0)]);
    let controllers = Some("/interaction_profiles/oculus/touch_controller".to_owned());
    let events = vec![ScriptedEvent { frame: 15, kind: EventKind::FocusLoss }];
    let run = Run::new(MockConfig { controllers, inputs, events, ..MockConfig::default() });
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    for _ in 0..40 {
        line.frame(&mut client);
    }
    let poses = line.poses();
    let (first, last) = (poses[0].world_from_head.position, poses[poses.len() - 1].world_from_head.position);
    assert!(first.distance(last) < 0.01, "{first} to {last}");
    finish(&run, client);
}

#[test]
fn a_far_future_picture_ends_only_the_session() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    while client.intake.poll_notice().is_some() {}
    let header = PictureHeader { update: UpdateId(4_000_000_000), time: ServerTime(0), is_refresh: false };
    line.streams.push_back(picture_stream(header, &coded(&planes([0, 64]), false)).expect("small"));
    for _ in 0..60 {
        line.frame(&mut client);
    }
    let Some(Notice::Failed(reason)) = client.intake.poll_notice() else { panic!("no word") };
    assert!(reason.contains("frame 4000000000"), "{reason}");
    finish(&run, client);
}

#[test]
fn a_flood_of_zero_bit_samples_ends_the_session() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    while client.intake.poll_notice().is_some() {}
    let still = |slot| NewVertex {
        slot: VertexSlot(slot),
        instance: InstanceId(7),
        number: slot,
        motion: Motion::Sampled,
    };
    let batch = |grid| SampleBatch {
        grid: GridIndex(grid),
        values: (0..256).map(|slot| (VertexSlot(slot), [0; 3])).collect(),
    };
    let grids = MAX_NEW_SAMPLE_GRIDS as i32;
    for frame in 0..250 {
        let enters = frame == 0;
        let geometry = GeometryDelta {
            update: UpdateId(frame),
            instances: enters
                .then_some(InstanceInfo { instance: InstanceId(7), step_m: 0.001 })
                .into_iter()
                .collect(),
            new_vertices: (0..if enters { 256 } else { 0 }).map(still).collect(),
            ..GeometryDelta::default()
        };
        line.send_delta(Delta { geometry, is_update: true, samples: (0..grids).map(batch).collect() });
    }
    line.deliver(&mut client, at(2_000_000_000));
    // One delta of 2048 samples is more than a turn takes in; records of 20 bytes, twice for the vector's growth.
    assert!(client.intake.waiting_bytes() < 400_000, "{} bytes wait", client.intake.waiting_bytes());
    let Some(Notice::Failed(reason)) = client.intake.poll_notice() else { panic!("no word") };
    assert!(reason.contains("above the limit of 128"), "{reason}");
    finish(&run, client);
}

#[test]
fn the_sessions_end_ends_the_client() {
    let events = vec![ScriptedEvent { frame: 5, kind: EventKind::Stop }];
    let run = Run::new(MockConfig { events, ..MockConfig::default() });
    let mut client = run.client();
    let frames = (0..100).take_while(|_| client.step().expect("a step") != Step::Exit).count();
    assert!((5..20).contains(&frames), "{frames} steps");
    finish(&run, client);
}

#[test]
fn a_wish_to_exit_passes_through_the_runtime() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    for _ in 0..3 {
        frame(&mut client);
    }
    client.presenter.request_exit();
    let steps = (0..20).take_while(|_| client.step().expect("a step") != Step::Exit).count();
    assert!(steps < 10, "{steps} steps");
    finish(&run, client);
}

#[test]
fn a_lost_instance_or_session_reopens_the_headset() {
    for kind in LOSSES {
        let run =
            Run::new(MockConfig { events: vec![ScriptedEvent { frame: 3, kind }], ..MockConfig::default() });
        let mut client = run.client();
        let error =
            (0..20).find_map(|_| client.step().err()).unwrap_or_else(|| panic!("{kind:?} is an error"));
        assert!(error.is_lost(), "{kind:?}: {error}");
        drop(client);
        let mut client = run.client();
        let number = frame_number(&run, &mut client);
        assert!(number > 3, "{kind:?}: frame {number} of a runtime that has gone on");
        finish(&run, client);
    }
}

/// Of the next frame, by the runtime's own count.
fn frame_number(run: &Run, client: &mut Client) -> u64 {
    frame(client);
    read_frames(&run.captures()).expect("a log").last().expect("a frame").frame
}

/// What happens to a headset in so many frames, at random: each as likely as any other, but for the loss of the instance.
/// What ends a headset session that can be opened again.
const LOSSES: [EventKind; 3] =
    [EventKind::InstanceLoss, EventKind::SessionLoss, EventKind::SuddenSessionLoss];

fn random_script(rng: &mut SmallRng, frames: u64) -> (Vec<ScriptedEvent>, Vec<ScriptedInput>) {
    let (mut events, mut inputs) = (Vec::new(), Vec::new());
    let mut frame = 20;
    while frame < frames {
        let kind = match rng.random_range(0..30) {
            0..4 => EventKind::FocusLoss,
            4..8 => EventKind::FocusGain,
            8..11 => EventKind::Hide,
            11..16 => EventKind::Show,
            16..20 => EventKind::Pause { ms: rng.random_range(0..500) },
            20..24 => EventKind::Recentre {
                x_mm: rng.random_range(-3000..3000),
                z_mm: rng.random_range(-3000..3000),
                yaw_degrees: rng.random_range(-180..180),
            },
            24..27 => EventKind::RefreshRate { hz: [72, 90, 120][rng.random_range(0..3)] },
            27 => EventKind::SessionLoss,
            28 => EventKind::SuddenSessionLoss,
            _ => EventKind::InstanceLoss,
        };
        events.push(ScriptedEvent { frame, kind });
        let paths = ["left/input/thumbstick/x", "left/input/thumbstick/y", "right/input/thumbstick/x"];
        let pulls = ["left/input/trigger/value", "right/input/trigger/value", "right/input/a/click"];
        let (path, value) = match rng.random_range(0..6) {
            pull @ 0..3 => (pulls[pull], f32::from(u8::from(rng.random::<bool>()))),
            stick => (paths[stick - 3], rng.random_range(-1.0..1.0)),
        };
        inputs.push(ScriptedInput { frame, path: format!("/user/hand/{path}"), value });
        frame += rng.random_range(3..30);
    }
    (events, inputs)
}

/// Updates for a client: the two squares, and then one or the other colour of theirs; now and then a picture is lost. The world is
/// halted and goes on as the client wants, at once, so that it always hears of it too late.
fn random_update(line: &mut Line, rng: &mut SmallRng, update: u32) {
    let (mut is_asked, mut clock) = (false, None);
    for event in line.events.drain(..) {
        is_asked |= matches!(event, ServerEvent::RefreshRequest { .. });
        if let ServerEvent::Steer(wanted) = event {
            let now = ServerTime(1_000_000_000 + line.frames * PERIOD_NS + line.ahead_ns);
            line.world.forget_before(now.plus_ns(-1_000_000_000));
            line.world.steer(wanted, now);
            clock = Some(Box::new(line.world));
        }
    }
    if let Some(clock) = clock {
        let message = MotionMessage { sequence: update, news: MotionNews::Clock(clock) };
        line.streams.push_back(motion_stream(&message, None));
    }
    let geometry = match update {
        0 => static_patches(),
        _ => GeometryDelta {
            update: UpdateId(update),
            time: WorldTime(1_000_000_000 + line.frames * PERIOD_NS + line.ahead_ns),
            ..GeometryDelta::default()
        },
    };
    if rng.random_ratio(1, 10) {
        line.lost_pictures.push(update);
    }
    let places = if rng.random() { [0, 64] } else { [64, 0] };
    line.send(geometry, &planes(places), update == 0 || is_asked);
}

/// So many frames (`SHADECAST_EVENT_FRAMES`; 500 of themselves) in which anything happens to headset, hands and link: no call that the
/// runtime refuses, no word of the layers, and a picture again whenever all is well.
#[test]
fn whatever_happens_to_headset_and_link_frames_go_on() {
    let frames =
        std::env::var("SHADECAST_EVENT_FRAMES").map_or(500, |frames| frames.parse().expect("a number"));
    let mut rng = SmallRng::seed_from_u64(11);
    let (events, inputs) = random_script(&mut rng, frames);
    let losses = events.iter().filter(|event| LOSSES.contains(&event.kind)).count();
    let controllers = Some("/interaction_profiles/oculus/touch_controller".to_owned());
    let run = Run::unseen(MockConfig {
        events,
        inputs,
        controllers,
        other_rates_hz: vec![90.0, 120.0],
        ..MockConfig::default()
    });
    let (mut client, mut line, mut update) = (run.client(), Line::new(Pose::IDENTITY, SERVER_AHEAD_NS), 0);
    client.intake.on_connected(at(1_000_000_000));
    let (mut made, mut shown, mut lost, mut turns) = (0, 0, 0, 0u64);
    while made < frames {
        turns += 1;
        assert!(turns < 20 * frames, "{made} frames in {turns} turns");
        match line.try_turn(&mut client) {
            Ok(Step::Frame(report)) => {
                made += 1;
                shown += u64::from(report.is_rendered && report.update.is_some());
            }
            Ok(Step::Idle) => {}
            Ok(Step::Exit) => panic!("nobody has asked for the end"),
            Err(error) => {
                assert!(error.is_lost(), "{error}");
                assert_eq!(
                    client.presenter.gpu().validation_messages(),
                    0,
                    "{:?}",
                    client.presenter.gpu().validation_texts()
                );
                drop(client);
                (client, lost) = (run.client(), lost + 1);
            }
        }
        let is_new =
            line.frames > 0 && (client.presenter.stats().connections == 0 || rng.random_ratio(1, 200));
        if is_new {
            line = Line { frames: line.frames, ..Line::new(Pose::IDENTITY, SERVER_AHEAD_NS) };
            client.intake.on_connected(at(1_000_000_000 + line.frames * PERIOD_NS));
            update = 0;
        } else if line.sender.is_some() && rng.random_ratio(1, 3) {
            random_update(&mut line, &mut rng, update);
            update += 1;
        }
        assert!(client.intake.waiting_bytes() < 4_000_000, "{} bytes wait", client.intake.waiting_bytes());
        while client.intake.poll_notice().is_some() {}
    }
    println!("{made} frames, {shown} of them with a picture, {lost} losses of {losses}, {turns} turns");
    assert!(shown > frames / 4 && lost > 0, "{shown} of {made} frames show something, {lost} losses");
    finish(&run, client);
}

/// Frames of one repetition of [`repeated`].
const REPEATED_FRAMES: u64 = 120;

/// The same happenings again and again, but for the loss of the instance, which leaves no client to look at.
fn repeated(times: u64) -> (Vec<ScriptedEvent>, Vec<ScriptedInput>) {
    let (mut events, inputs) = random_script(&mut SmallRng::seed_from_u64(23), REPEATED_FRAMES);
    events.retain(|event| event.kind != EventKind::InstanceLoss);
    // Each begins as the first did: seen and in focus, at the rate of the beginning.
    let frame = REPEATED_FRAMES - 1;
    let back = [EventKind::Show, EventKind::FocusGain, EventKind::RefreshRate { hz: 72 }];
    events.extend(back.map(|kind| ScriptedEvent { frame, kind }));
    let offsets = (0..times).map(|time| time * REPEATED_FRAMES);
    let at = |offset: u64| {
        let events =
            events.iter().cloned().map(move |event| ScriptedEvent { frame: event.frame + offset, ..event });
        let inputs =
            inputs.iter().cloned().map(move |input| ScriptedInput { frame: input.frame + offset, ..input });
        (events.collect::<Vec<_>>(), inputs.collect::<Vec<_>>())
    };
    let (events, inputs): (Vec<_>, Vec<_>) = offsets.map(at).unzip();
    (events.concat(), inputs.concat())
}

/// One repetition, with a new session, of which the server's side is dropped.
fn repetition(client: &mut Client, from: i64) -> i64 {
    let mut rng = SmallRng::seed_from_u64(29);
    let mut line = Line { frames: from, ..Line::new(Pose::IDENTITY, SERVER_AHEAD_NS) };
    client.intake.on_connected(at(1_000_000_000 + from * PERIOD_NS));
    let (mut made, mut update) = (0, 0);
    while made < REPEATED_FRAMES {
        assert!(line.frames - from < 20 * REPEATED_FRAMES as i64, "{made} frames");
        made += u64::from(matches!(line.turn(client), Step::Frame(_)));
        if line.sender.is_some() && line.frames % 3 == 0 {
            random_update(&mut line, &mut rng, update);
            update += 1;
        }
        while client.intake.poll_notice().is_some() {}
    }
    client.intake.on_closed(at(1_000_000_000 + line.frames * PERIOD_NS));
    line.frames
}

/// Bytes by which the heap has grown, and those that the device holds, after each of some repetitions. Each also forgets
/// `forgotten_bytes`.
fn growth(times: u64, forgotten_bytes: usize) -> Vec<(i64, u64)> {
    let (events, inputs) = repeated(times);
    let controllers = Some("/interaction_profiles/oculus/touch_controller".to_owned());
    let other_rates_hz = vec![90.0, 120.0];
    let run =
        Run::unseen(MockConfig { events, inputs, controllers, other_rates_hz, ..MockConfig::default() });
    let (mut client, mut from) = (run.client(), 0);
    let mut grown = Vec::new();
    for _ in 0..times {
        let taken = allocation_counter::measure(|| {
            from = repetition(&mut client, from);
            std::mem::forget(std::hint::black_box(vec![0u8; forgotten_bytes]));
        });
        let held_bytes = client.presenter.gpu().memory().iter().map(|of| of.bytes).sum();
        grown.push((taken.bytes_current, held_bytes));
    }
    finish(&run, client);
    grown
}

/// By how many bytes the heap grows in a repetition, on average of those after the first two, in which buffers find their size.
/// What waits at its end differs by tens of kilobytes from one to the next.
fn mean_growth_bytes(grown: &[(i64, u64)]) -> i64 {
    let settled = &grown[2..];
    settled.iter().map(|(heap_bytes, _)| heap_bytes).sum::<i64>() / settled.len() as i64
}

#[test]
fn what_happens_again_and_again_takes_no_more_memory() {
    const BOUND_BYTES: i64 = 10_000;
    let grown = growth(10, 0);
    println!("{grown:?}");
    assert!(mean_growth_bytes(&grown) < BOUND_BYTES, "{grown:?}");
    // What was dropped a moment ago may still count: what leaks counts in every later repetition.
    let least_bytes = grown[5..].iter().map(|(_, held_bytes)| *held_bytes).min();
    assert!(least_bytes <= Some(grown[1].1), "{grown:?}");
    let leaking = growth(10, 2 * BOUND_BYTES as usize);
    assert!(mean_growth_bytes(&leaking) > BOUND_BYTES, "what is forgotten each time is found: {leaking:?}");
}
