//! The client on the mock headset: what a person in it would see, without a server.

mod support;

use shadecast_client::client::{Client, FrameReport, Step};
use shadecast_client::decode::Picture as Planes;
use shadecast_mock_runtime::config::{EventKind, MockConfig, ScriptedEvent};
use shadecast_mock_runtime::record::Side;
use shadecast_protocol::PROTOCOL_VERSION;
use shadecast_protocol::atlas::{AtlasExtent, Block, BlockAddress, BlockSize, PatchKind};
use shadecast_protocol::delta::{GeometryDelta, InstanceInfo, Motion, NewPatch, NewVertex, SampleBatch};
use shadecast_protocol::ids::{FrameId, InstanceId, PatchSlot, VertexSlot};
use shadecast_protocol::message::{Codec, Environment, ResumeSecret, ServerOffer, Welcome};
use shadecast_protocol::pose::Pose;
use shadecast_protocol::session::{DeltaSender, Out, ServerEvent, ServerSession, picture_stream};
use shadecast_protocol::time::{DEFAULT_GRID, DisplayTime, GridIndex, ServerTime};
use shadecast_protocol::wire::{PictureHeader, StreamMessage, parse_stream};
use std::collections::VecDeque;
use support::{Run, SIDE, at, coded, finish, frame, pixel};

const ATLAS: AtlasExtent = AtlasExtent::MIN;
/// sRGB values of the two patches, and their full-range BT.709 planes.
const RED: ([u8; 3], [u8; 3]) = ([200, 40, 40], [74, 110, 208]);
const BLUE: ([u8; 3], [u8; 3]) = ([40, 60, 220], [67, 210, 111]);
/// The animated edge moves this fast, metres per second.
const SPEED: f32 = 0.3;

fn environment() -> Environment {
    Environment { zenith: [0.1, 0.3, 0.9], horizon: [0.5, 0.5, 0.5], nadir: [0.1, 0.1, 0.1] }
}

fn terms() -> Welcome {
    Welcome {
        protocol_version: PROTOCOL_VERSION,
        session: 1,
        grid: DEFAULT_GRID,
        atlas_extent_texels: ATLAS,
        vertex_slots: 256,
        patch_slots: 64,
        codec: Codec::H264,
        environment: environment(),
        world_from_stage: Pose::IDENTITY,
        update_period_ns: 33_333_333,
        resume: ResumeSecret([1; 16]),
    }
}

fn block(x: u16) -> Block {
    Block { address: BlockAddress { x, y: 0 }, size: BlockSize::new(6, 6).expect("a size") }
}

/// Left half red, right half blue, elsewhere green so that a wrong lookup is seen.
fn planes(blocks: [u16; 2]) -> Planes {
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
    let plane = |step: usize, component: usize| {
        let texels = (0..h / step).flat_map(|y| (0..w / step).map(move |x| (x, y)));
        texels.map(|(x, y)| ycbcr(x * step, y * step)[component]).collect()
    };
    Planes { extent_texels: ATLAS.texels(), y: plane(1, 0), cb: plane(2, 1), cr: plane(2, 2) }
}

/// Where the moving edge is at a server time.
fn edge_x(time: ServerTime) -> f32 {
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
fn two_patches() -> GeometryDelta {
    let statics = [[-0.5, 2.1], [-0.5, 1.1], [-0.02, 2.1], [-0.02, 1.1]];
    let fixed = |(slot, [x, y]): (u32, [f32; 2])| NewVertex {
        slot: VertexSlot(slot),
        instance: InstanceId(3),
        motion: Motion::Static { position: [x, y, -2.0].into() },
    };
    let moving =
        |slot| NewVertex { slot: VertexSlot(slot), instance: InstanceId(7), motion: Motion::Sampled };
    let patch = |slot: u32, instance: u16, first: u32| NewPatch {
        slot: PatchSlot(slot),
        instance: InstanceId(instance),
        kind: PatchKind::Two,
        // Around the square: upper left, upper right, lower right, lower left.
        vertices: [first, first + 2, first + 3, first + 1, first].map(VertexSlot),
        double_sided: true,
    };
    GeometryDelta {
        frame: FrameId(0),
        time: ServerTime(1_000_000_000),
        instances: vec![InstanceInfo { instance: InstanceId(7), step_m: 0.0001 }],
        new_vertices: (0..).zip(statics).map(fixed).chain((4..8).map(moving)).collect(),
        new_patches: vec![patch(0, 3, 0), patch(1, 7, 4)],
        placements: vec![(PatchSlot(0), Some(block(0))), (PatchSlot(1), Some(block(64)))],
        samples: samples(29, 45),
        ..GeometryDelta::default()
    }
}

#[track_caller]
fn assert_close(got: [u8; 3], want: [u8; 3], what: &str) {
    let is_close = got.iter().zip(want).all(|(got, want)| got.abs_diff(want) <= 3);
    assert!(is_close, "{what}: {got:?} instead of {want:?}");
}

#[test]
fn before_the_first_bundle_there_is_a_gradient_a_floor_and_a_text_in_both_eyes() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    client.set_status("Connecting to 192.168.1.5:7400");
    for _ in 0..4 {
        let report = frame(&mut client);
        assert_eq!(report.frame, None);
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
fn patches_are_seen_where_they_are_and_in_the_atlas_colours_by_both_eyes() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    client.start_local(terms(), 0).expect("a scene");
    client.accept_local(at(1), two_patches(), Some(planes([0, 64])));
    frame(&mut client); // not seen: the session is not visible yet
    let report = frame(&mut client);
    assert_eq!((report.frame, report.is_new, report.withheld_patches), (Some(FrameId(0)), true, 0));
    assert!(!frame(&mut client).is_new);
    let probe = client.probe().expect("a probe");
    finish(&run, client);
    for (side, eye) in [(Side::Left, -1.0), (Side::Right, 1.0)] {
        let picture = run.picture(1, side);
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
fn an_animated_edge_moves_with_every_display_frame_and_follows_its_motion() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    client.start_local(terms(), 0).expect("a scene");
    client.accept_local(at(1), two_patches(), Some(planes([0, 64])));
    frame(&mut client);
    let mut last = None;
    for _ in 0..20 {
        let report = frame(&mut client);
        let time = report.server_time.expect("a clock");
        let [x, y, z, _] = client.read_positions().expect("positions")[6];
        assert!((x - edge_x(time)).abs() < 2e-4, "{x} instead of {} at {time:?}", edge_x(time));
        assert!((y - 2.1).abs() < 1e-4 && (z + 2.0).abs() < 1e-4);
        assert_ne!(last.replace(x), Some(x), "it moved");
        assert_eq!((report.held_vertices, report.frozen_vertices), (0, 0));
    }
    finish(&run, client);
    // The pictures move too: where the edge was at the first frame, the last one shows the square.
    let beyond = pixel([0.53, 1.6, -2.0], -1.0).map(|p| p as u32);
    assert_ne!(run.picture(1, Side::Left).at(beyond[0], beyond[1]), BLUE.0);
    assert_close(run.picture(20, Side::Left).at(beyond[0], beyond[1]), BLUE.0, "the edge has passed");
}

#[test]
fn a_vertex_that_runs_out_of_samples_stops_and_is_counted_and_returns_without_a_jump() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    client.start_local(terms(), 0).expect("a scene");
    let first = GeometryDelta { samples: samples(29, 33), ..two_patches() };
    client.accept_local(at(1), first, Some(planes([0, 64])));
    frame(&mut client);
    let (mut frozen, mut largest, mut last) = (0, 0f32, None);
    for index in 0..50 {
        if index == 16 {
            let late =
                GeometryDelta { frame: FrameId(1), samples: samples(34, 49), ..GeometryDelta::default() };
            client.accept_local(at(2), late, None);
        }
        let report = frame(&mut client);
        frozen += report.frozen_vertices;
        let x = client.read_positions().expect("positions")[6][0];
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
    client.start_local(terms(), 0).expect("a scene");
    let late = GeometryDelta { samples: samples(40, 45), ..two_patches() };
    client.accept_local(at(1), late, Some(planes([0, 64])));
    frame(&mut client);
    assert_eq!(frame(&mut client).withheld_patches, 1);
    let picture = |frame| run.picture(frame, Side::Left);
    let [x, y] = pixel([0.25, 1.6, -2.0], -1.0).map(|p| p as u32);
    assert_ne!(picture(1).at(x, y), BLUE.0);
    let [red_x, red_y] = pixel([-0.25, 1.6, -2.0], -1.0).map(|p| p as u32);
    assert_close(picture(1).at(red_x, red_y), RED.0, "the static patch");
    while frame(&mut client).withheld_patches > 0 {}
    let seen = client.stats().frames - 1;
    finish(&run, client);
    assert_close(picture(seen).at(x, y), BLUE.0, "drawn as soon as it can be");
}

#[test]
fn the_newest_picture_goes_with_its_own_placements() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    client.start_local(terms(), 0).expect("a scene");
    client.accept_local(at(1), two_patches(), Some(planes([0, 64])));
    // The blocks change places; the picture of that update never comes, that of the next has them elsewhere again.
    let swapped = vec![(PatchSlot(0), Some(block(64))), (PatchSlot(1), Some(block(0)))];
    let moved = vec![(PatchSlot(0), Some(block(128)))];
    let next =
        |frame, placements| GeometryDelta { frame: FrameId(frame), placements, ..GeometryDelta::default() };
    frame(&mut client);
    frame(&mut client);
    client.accept_local(at(2), next(1, swapped), None);
    assert_eq!(frame(&mut client).frame, Some(FrameId(0)), "no picture, no switch");
    client.accept_local(at(3), next(2, moved), Some(planes([128, 0])));
    assert_eq!(frame(&mut client).frame, Some(FrameId(2)));
    finish(&run, client);
    for index in [1, 2, 3] {
        let picture = run.picture(index, Side::Right);
        let see = |x: f32| pixel([x, 1.6, -2.0], 1.0).map(|p| p as u32);
        assert_close(picture.at(see(-0.25)[0], see(-0.25)[1]), RED.0, &format!("left in frame {index}"));
        assert_close(picture.at(see(0.25)[0], see(0.25)[1]), BLUE.0, &format!("right in frame {index}"));
    }
}

/// A server's session and a link of no length, both in the client's virtual time.
struct Line {
    server: ServerSession,
    /// The server's sending half, once it has said yes.
    sender: Option<DeltaSender>,
    /// What the server sends beside the session.
    streams: VecDeque<Out>,
    frames: i64,
    events: Vec<ServerEvent>,
    /// Streams whose frame and kind this names are lost: what the client gets is a reset.
    lost_pictures: Vec<u32>,
}

/// The server's clock is ahead of the client's by this.
const SERVER_AHEAD_NS: i64 = 5_000_000_000;

impl Line {
    fn new() -> Self {
        let server = ServerSession::new(ServerOffer {
            protocol_version: PROTOCOL_VERSION,
            min_protocol_version: PROTOCOL_VERSION,
            app_version: "test".into(),
            session: 5,
            grid: DEFAULT_GRID,
            atlas_extent_texels: ATLAS,
            vertex_slots: 1000,
            patch_slots: 1000,
            codecs: vec![Codec::H264],
            environment: environment(),
            world_from_stage: Pose { position: [10.0, 0.0, 0.0].into(), ..Pose::IDENTITY },
            update_period_ns: 33_333_333,
            resume: ResumeSecret([2; 16]),
        });
        Self {
            server,
            sender: None,
            streams: VecDeque::new(),
            frames: 0,
            events: Vec::new(),
            lost_pictures: Vec::new(),
        }
    }

    /// One display frame, and what both ends say meanwhile.
    fn frame(&mut self, client: &mut Client) -> FrameReport {
        let now = at(1_000_000_000 + self.frames * 13_888_889);
        self.frames += 1;
        self.deliver(client, now);
        client.advance(now).expect("time passes");
        let report = frame(client);
        while let Some(out) = client.poll_out() {
            match out {
                Out::Control(bytes) => self.server.on_control(&bytes),
                Out::Datagram(bytes) => self.server.on_datagram(&bytes, ServerTime(now.0 + SERVER_AHEAD_NS)),
                Out::Stream { .. } => panic!("clients send no streams"),
            }
        }
        while let Some(event) = self.server.poll_event() {
            if matches!(event, ServerEvent::Asked { .. }) {
                self.sender = self.server.accept();
            }
            self.events.push(event);
        }
        self.deliver(client, now);
        report
    }

    /// What the server has said reaches the client.
    fn deliver(&mut self, client: &mut Client, now: DisplayTime) {
        let server_now = ServerTime(now.0 + SERVER_AHEAD_NS);
        while let Some(out) = self.server.poll_out(server_now).or_else(|| self.streams.pop_front()) {
            match out {
                Out::Control(bytes) => client.receive_control(now, &bytes).expect("control"),
                Out::Datagram(bytes) => client.receive_datagram(now, &bytes),
                Out::Stream { bytes, .. } => match parse_stream(&bytes).expect("a stream") {
                    StreamMessage::Picture { header, .. } if self.lost_pictures.contains(&header.frame.0) => {
                        client.receive_reset(now, &bytes[..20]);
                    }
                    _ => client.receive_stream(now, &bytes).expect("a stream"),
                },
            }
        }
    }

    /// Display frames until the session stands and the client knows the server's clock.
    fn connect(client: &mut Client) -> Self {
        let mut line = Self::new();
        client.on_connected(at(1_000_000_000));
        for _ in 0..12 {
            line.frame(client);
        }
        assert!(matches!(line.events[0], ServerEvent::Asked { .. }), "{:?}", line.events);
        line
    }

    fn send(&mut self, delta: &GeometryDelta, planes: &Planes, is_refresh: bool) {
        let sender = self.sender.as_mut().expect("a session");
        self.streams.push_back(sender.delta_stream(delta).expect("a small delta").0);
        let header = PictureHeader { frame: delta.frame, time: delta.time, is_refresh };
        self.streams.push_back(picture_stream(header, &coded(planes, is_refresh)).expect("a small picture"));
    }
}

/// The two squares around the client's head, whose stage begins at x = 10 m, both static.
fn static_patches() -> GeometryDelta {
    let mut delta = GeometryDelta { samples: vec![], ..two_patches() };
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
        ServerEvent::Pose(pose) => Some(pose),
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
    line.send(&static_patches(), &planes([0, 64]), true);
    let reports: Vec<_> = (0..3).map(|_| line.frame(&mut client)).collect();
    // 6 ms of decoding: the first frame is too early.
    assert_eq!(
        reports.iter().map(|report| report.frame).collect::<Vec<_>>(),
        [None, Some(FrameId(0)), Some(FrameId(0))]
    );
    let displayed = line.events.iter().find_map(|event| match event {
        ServerEvent::Displayed(displayed) => Some(*displayed),
        _ => None,
    });
    let displayed = displayed.expect("a report");
    assert_eq!((displayed.frame, displayed.frames_without_bundle), (FrameId(0), 12));
    assert_eq!(Some(displayed.display_time), reports[1].server_time);
    let stats = client.stats();
    assert_eq!(
        (stats.bundles, stats.atlas_bytes),
        (1, u64::from(ATLAS.width() * ATLAS.height()) * 3 / 2 + 1)
    );
    finish(&run, client);
    let [x, y] = pixel([-0.25, 1.6, -2.0], -1.0).map(|p| p as u32);
    assert_close(run.picture(stats.frames - 1, Side::Left).at(x, y), RED.0, "the left square");
}

#[test]
fn a_lost_picture_leaves_the_last_bundle_on_display_until_a_refresh_that_is_asked_for() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    line.lost_pictures = vec![1];
    line.send(&static_patches(), &planes([0, 64]), true);
    line.frame(&mut client);
    for frame in 1..4 {
        let placements = vec![(PatchSlot(0), Some(block(64 * frame as u16)))];
        let delta = GeometryDelta { frame: FrameId(frame), placements, ..GeometryDelta::default() };
        line.send(&delta, &planes([64 * frame as u16, 0]), frame == 3);
        let shown = line.frame(&mut client).frame;
        assert_eq!(
            shown,
            Some(FrameId(0)),
            "update {frame} is not shown: it needs the lost one, or is being decoded"
        );
    }
    assert_eq!(line.frame(&mut client).frame, Some(FrameId(3)));
    let asked =
        line.events.iter().filter(|event| matches!(event, ServerEvent::RefreshRequest { .. })).count();
    assert_eq!((asked, client.stats().lost_pictures), (1, 2));
    finish(&run, client);
}

#[test]
fn after_a_reconnect_the_old_bundle_stays_until_the_new_server_has_one() {
    let run = Run::new(MockConfig::default());
    let mut client = run.client();
    let mut line = Line::connect(&mut client);
    line.send(&static_patches(), &planes([0, 64]), true);
    for _ in 0..2 {
        line.frame(&mut client);
    }
    client.on_closed(at(2_000_000_000));
    for _ in 0..3 {
        assert_eq!(frame(&mut client).frame, Some(FrameId(0)), "without a server the last bundle stays");
    }
    let mut line = Line::connect(&mut client);
    assert_eq!(line.frame(&mut client).frame, Some(FrameId(0)), "connected, but there is no new one yet");
    // The new server has the squares' colours exchanged.
    line.send(&static_patches(), &planes([64, 0]), true);
    line.frame(&mut client);
    assert!(line.frame(&mut client).is_new);
    let last = client.stats().frames - 1;
    assert_eq!(client.stats().connections, 2);
    finish(&run, client);
    let [x, y] = pixel([-0.25, 1.6, -2.0], -1.0).map(|p| p as u32);
    assert_close(run.picture(last - 2, Side::Left).at(x, y), RED.0, "the old server's picture");
    assert_close(run.picture(last, Side::Left).at(x, y), BLUE.0, "the new server's picture");
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
    line.send(&static_patches(), &planes([0, 64]), true);
    for _ in 0..3 {
        line.frame(&mut client);
    }
    let moving = client.stats().frames - 1;
    client.on_closed(at(2_000_000_000));
    client.set_status("Connecting to 192.168.1.5:7400: it did not answer");
    for _ in 0..100 {
        frame(&mut client);
    }
    let quiet = client.stats().frames - 1;
    for _ in 0..60 {
        assert_eq!(frame(&mut client).frame, Some(FrameId(0)), "the last bundle stays");
    }
    let told = client.stats().frames - 1;
    let mut line = Line::connect(&mut client);
    line.send(&static_patches(), &planes([0, 64]), true);
    while !line.frame(&mut client).is_new {}
    line.frame(&mut client);
    let again = client.stats().frames - 1;
    finish(&run, client);
    assert_eq!(differing(&run, moving, quiet), 0, "a second without a picture is not worth a word");
    assert!(differing(&run, moving, told) > 1000, "a panel is in front of the world");
    let ink = run.picture(told, Side::Left).pixels().filter(|pixel| pixel.iter().all(|c| *c > 200)).count();
    assert!(ink > 50, "{ink} bright pixels of text");
    assert_eq!(differing(&run, moving, again), 0, "the world moves again");
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
    client.request_exit();
    let steps = (0..20).take_while(|_| client.step().expect("a step") != Step::Exit).count();
    assert!(steps < 10, "{steps} steps");
    finish(&run, client);
}

#[test]
fn a_lost_instance_is_told_from_other_errors_and_the_headset_opens_again() {
    let events = vec![ScriptedEvent { frame: 3, kind: EventKind::InstanceLoss }];
    let run = Run::new(MockConfig { events, ..MockConfig::default() });
    let mut client = run.client();
    let error = (0..20).find_map(|_| client.step().err()).expect("the loss is an error");
    assert!(error.is_lost(), "{error}");
    drop(client);
    let mut client = run.client();
    frame(&mut client);
    finish(&run, client);
}
