//! The pinned bytes of the wire format. Peers of the same version must agree on them, on every machine and in every build.
//!
//! A failing test here means that old and new programs no longer understand each other. Raise `PROTOCOL_VERSION`, then copy the
//! new bytes from the failure's message.

use crate::atlas::{AtlasExtent, Block, BlockAddress, BlockSize, PatchKind, PixelTexels};
use crate::coverage::Coverage;
use crate::delta::{Delta, DeltaEncoder};
use crate::geometry::{GeometryDelta, InstanceInfo, Motion, NewPatch, NewVertex, Settled, Skinned};
use crate::ids::{ClipId, InstanceId, MeshId, PatchSlot, RestId, SkeletonId, UpdateId, VertexSlot};
use crate::message::{ClientDatagram, ClientMessage, Codec, Refused, ServerDatagram, ServerMessage, Welcome};
use crate::motion::SampleBatch;
use crate::motion::clip::ClipChunk;
use crate::motion::keys::{ChunkTrack, TrackKind};
use crate::motion::message::{MotionMessage, MotionNews, NewSchedule};
use crate::motion::playback::{Playback, Repetition, Schedule};
use crate::motion::poses::{BonePose, GridPose};
use crate::motion::predicted::{PredictedVertex, Prediction};
use crate::motion::rest::{MeshInfo, RestVertex};
use crate::motion::skeleton::{ClipRef, PoseSource, SkeletonEntry, SkeletonInfo, SkinnedInstance};
use crate::pairing::{ClientPairing, ServerPairing};
use crate::testing::{displayed, head, hello, welcome};
use crate::time::{ClientTime, GridIndex, ServerTime, WorldTime};
use crate::wire::{PictureHeader, encode_geometry, encode_motion, encode_picture, frame_control};
use crate::world_clock::{Steer, WorldClock};
use glam::Vec3;

/// The version whose bytes are pinned below.
const PINNED_VERSION: u32 = 10;

#[track_caller]
fn assert_pinned(bytes: &[u8], hex: &str) {
    let actual: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    let pinned: String = hex.split_whitespace().collect();
    assert_eq!(actual, pinned, "the wire format has changed: raise PROTOCOL_VERSION and pin the new bytes");
}

/// Two deltas: everything enters, then it moves and some of it leaves.
fn deltas() -> [Vec<u8>; 2] {
    let (near, far) = (InstanceId(3), InstanceId(7));
    let vertex =
        |slot, instance, motion| NewVertex { slot: VertexSlot(slot), instance, number: slot, motion };
    let block = |x, y, width_log2, height_log2| {
        Some(Block { address: BlockAddress { page: 0, x, y }, size: BlockSize { width_log2, height_log2 } })
    };
    let patch = |slot, instance, kind, vertices: [u32; 5]| NewPatch {
        slot: PatchSlot(slot),
        instance,
        mesh: MeshId(2),
        number: slot,
        kind,
        vertices: vertices.map(VertexSlot),
        double_sided: false,
    };
    let sample = |slot: u32, step: i32| {
        let along = slot as i32 * 40 + step * step * 7;
        (VertexSlot(slot), [along, 1000 - along / 3, -250])
    };
    let batch = |grid, slots: std::ops::Range<u32>| SampleBatch {
        grid: GridIndex(grid),
        values: slots.map(|slot| sample(slot, grid)).collect(),
    };
    let still = Motion::Static { position: Vec3::new(1.0, -0.5, 2.25) };
    let mut new_vertices: Vec<_> = (0..40).map(|slot| vertex(slot, near, Motion::Sampled)).collect();
    new_vertices.extend((100..103).map(|slot| vertex(slot, far, still)));
    let enters = GeometryDelta {
        update: UpdateId(0),
        time: WorldTime(1_000_000_000),
        shaded: WorldTime(1_020_000_000),
        instances: vec![
            InstanceInfo { instance: near, step_m: 0.0005 },
            InstanceInfo { instance: far, step_m: 0.25 },
        ],
        new_vertices,
        new_patches: vec![
            patch(0, near, PatchKind::Two, [0, 1, 2, 3, 0]),
            patch(1, near, PatchKind::Three, [2, 3, 4, 5, 6]),
            patch(9, far, PatchKind::One, [100, 101, 102, 100, 100]),
        ],
        placements: vec![(PatchSlot(0), block(0, 0, 2, 9)), (PatchSlot(9), block(2044, 1020, 2, 2))],
        coverage: vec![
            (PatchSlot(0), Coverage::from_fn(2048, |texel| (40..300).contains(&texel))),
            (PatchSlot(9), Coverage::from_fn(16, |texel| texel % 2 == 0)),
        ],
        ..Default::default()
    };
    let enters = Delta {
        geometry: enters,
        is_update: true,
        samples: (29..33).map(|grid| batch(grid, 0..40)).collect(),
    };
    let stored = Block {
        address: BlockAddress { page: 2, x: 1024, y: 8 },
        size: BlockSize { width_log2: 2, height_log2: 2 },
    };
    let moves = GeometryDelta {
        update: UpdateId(1),
        time: WorldTime(1_033_333_333),
        evicted_patches: vec![PatchSlot(1)],
        evicted_vertices: vec![VertexSlot(5), VertexSlot(6)],
        placements: vec![(PatchSlot(0), None)],
        settled: vec![Settled { slot: PatchSlot(9), to: stored, pixel: PixelTexels::new([1.5, 3.0]) }],
        ..Default::default()
    };
    let moves = Delta { geometry: moves, is_update: true, samples: vec![batch(32, 10..13), batch(35, 0..0)] };
    let mut coder = DeltaEncoder::new(200, 20).with_store(2).with_atlas(AtlasExtent::DEFAULT);
    [coder.encode(&enters).bytes, coder.encode(&moves).bytes]
}

#[test]
fn the_pinned_version_is_the_current_one() {
    assert_eq!(PINNED_VERSION, crate::PROTOCOL_VERSION, "pin the bytes of the new version");
}

#[test]
fn control_messages_keep_their_bytes() {
    assert_pinned(
        &frame_control(&ClientMessage::Hello(hello()).encode()),
        "9200000000010105302e312e3080208020d804ac02840780802080801080800420060101006f1203bd000000000000000000\
         00000000000000000000000000803f000040bf0000403f0000003f000060bf6f12033d000000000000000000000000000000\
         00000000000000803f000040bf0000403f0000003f000060bfa80e800ff0b59f0d0109090909090909090909090909090909",
    );
    assert_pinned(&ClientMessage::Displayed(displayed(300)).encode(), "01ac02094801c801030080d1ca08");
    assert_pinned(&ClientMessage::RefreshRequest { after: Some(UpdateId(8)) }.encode(), "020108");
    assert_pinned(&ClientMessage::Goodbye.encode(), "03");
    assert_pinned(&ClientMessage::Watching { is_watched: true }.encode(), "0401");
    assert_pinned(&ClientMessage::Steer(Steer::Halt).encode(), "0500");
    assert_pinned(&ClientMessage::Steer(Steer::GoOn).encode(), "0501");
    assert_pinned(&ClientMessage::Steer(Steer::Step).encode(), "0502");
    assert_pinned(
        &ServerMessage::Welcome(welcome()).encode(),
        "0001ef9bafcdf8acd19101aa81e51f80108010d804ac0288278407c8010804000000803e0000003f0000803f0000003f0000403f
         0000803f0000003e0000003e0000003e0000000000000000000060400000000000000000000000000000803faa81e51f00010203
         0405060708090a0b0c0d0e0f",
    );
    assert_pinned(
        &ServerMessage::Welcome(Welcome { codec: Codec::Raw, ..welcome() }).encode()[..24],
        "0001ef9bafcdf8acd19101aa81e51f80108010d804ac0288",
    );
    let refused = Refused::new("too old", "update");
    assert_pinned(&ServerMessage::Refused(refused).encode(), "0107746f6f206f6c6406757064617465");
    assert_pinned(&ServerMessage::Goodbye.encode(), "02");
    let (element, proof) = (std::array::from_fn(|n| n as u8), [0xee; 32]);
    let word = "000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f";
    let proven = "ee".repeat(32);
    let of_client = |step| ClientMessage::Pairing(step).encode();
    assert_pinned(&of_client(ClientPairing::Offer { element }), &format!("0600{word}"));
    assert_pinned(&of_client(ClientPairing::Proof { proof }), &format!("0601{proven}"));
    assert_pinned(&of_client(ClientPairing::WrongCode), "0602");
    let of_server = |step| ServerMessage::Pairing(step).encode();
    assert_pinned(&of_server(ServerPairing::Needed { patience_ms: 60_000 }), "0300e0d403");
    let answer = ServerPairing::Answer { element, proof };
    assert_pinned(&of_server(answer), &format!("0301{word}{proven}"));
    assert_pinned(&ServerMessage::Padding(vec![0; 2]).encode(), "04020000");
}

#[test]
fn datagrams_keep_their_bytes() {
    assert_pinned(
        &ClientDatagram::Pose(head(7)).encode(),
        "00078ea8d6b9070000003f0000d03f000000c09a99193f0000000000000000cdcc4c3f0000803e000000000000c0bf00 \
         00000000002040000000006f1203bd00000000000000000000000000000000000000000000803f000040bf0000403f00 \
         00003f000060bf6f12033d00000000000000000000000000000000000000000000803f000040bf0000403f0000003f00 \
         0060bf03",
    );
    let ping = ClientDatagram::ClockPing { client_send: ClientTime(123_456_789) };
    assert_pinned(&ping.encode(), "01aab4de75");
    let pong = ServerDatagram::ClockPong {
        client_send: ClientTime(123_456_789),
        server_receive: ServerTime(1_000),
        server_send: ServerTime(2_000),
    };
    assert_pinned(&pong.encode(), "00aab4de75d00fa01f");
    let stamp = ServerDatagram::ClockStamp { server_send: ServerTime(2_000) };
    assert_pinned(&stamp.encode(), "01a01f");
}

#[test]
fn streams_keep_their_bytes() {
    let header = PictureHeader { update: UpdateId(5), time: ServerTime(-1), is_refresh: true };
    assert_pinned(
        &encode_picture(header, &[0, 0, 0, 1, 0x67]),
        "0205000000ffffffffffffffff01050000000000000167",
    );
    let [enters, moves] = deltas();
    assert_pinned(
        &encode_geometry(&enters),
        "015343473200000000000000000100ca9a3b0000000000f7cb3c000000000b0301c20154010c0102036f12033a070000803e\
         00000000043a00b403556bf028cdbfb600000080daf50100edfa00a0767d0050bb3e00a05d1f00d4ae0f006ad70700b4eb03\
         80daf50140edfa0080767d0050bb3e00a85d1f00d0ae0f006ad70700b5eb0300daf50140edfa00a0767d0040bb3e00a85d1f\
         00d4ae0f0068d70700b5eb0380daf50100edfa00a0767d0050bb3e00a05d1f00d4ae0f006ad7071c68281b005b000001a573\
         48130120499224011c68281b80360000016575481d01d8b66ddb061c68281b005b000001253748250110141e480290040c0b\
         d4f87dedd3c67e4291245beeb95f8e296981b33e819afcca066bf9fac5f10e0dfb1a217305a7dc894c9419ea407a46fa0c59\
         cfb09fafbc939d77832e648afc60350f2f294d059732376886e9b2e193658a8000020000288402d40d1001555500",
    );
    assert_pinned(
        &encode_geometry(&moves),
        "0153434732010000000100000001556a973d0000000000000000000000000103010f04010107000000000002400203140000\
         82c2034900040401c9a3c080000001120009000862",
    );
}

/// A chunk, a schedule and a pose.
fn news_of_motion() -> [MotionNews; 4] {
    let (clip, instance) = (ClipRef { clip: ClipId(300), duration_s: 4.0 }, InstanceId(7));
    let still = |values: Vec<[f32; 4]>| ChunkTrack {
        kind: TrackKind::Step,
        times_s: vec![0.0],
        values,
        tangents: Vec::new(),
    };
    let moving = ChunkTrack {
        kind: TrackKind::Cubic,
        times_s: vec![0.5, 0.75],
        values: vec![[0.0, 0.0, 0.0, 1.0], [0.0, 0.5, 0.0, 0.75]],
        tangents: vec![[0.0; 4], [0.25; 4]],
    };
    let turning = ChunkTrack {
        kind: TrackKind::Linear,
        times_s: vec![0.5, 0.625],
        values: vec![[0.0, 0.59375, 0.0, -0.8125], [0.28125, -0.75, 0.0, -0.59375]],
        tangents: Vec::new(),
    };
    let [still, one] = [[1.0, 2.0, 3.0, 0.0], [1.0, 1.0, 1.0, 0.0]].map(|value| still(vec![value]));
    let tracks = vec![still, moving, one, turning];
    let (from, repetition) = (WorldTime(1_000_000_000), Repetition::PingPong);
    let playback = Playback { from, clip, start_s: 0.25, speed: -1.5, repetition, fade_ns: 200_000_000 };
    let bone = BonePose { translation: [0.5, -0.25, 0.125], rotation: [0.0, 0.6, 0.0, 0.8], scale: [1.0; 3] };
    let pose = GridPose { instance, grid: GridIndex(40), bones: vec![bone; 2], weights: vec![0.5] };
    let mut clock = WorldClock::default();
    clock.steer(Steer::Halt, ServerTime(1_000_000_000));
    clock.steer(Steer::Step, ServerTime(2_000_000_000));
    [
        MotionNews::Chunk(ClipChunk { clip: clip.clip, index: 1, first_word: 64, tracks }),
        MotionNews::Schedule(NewSchedule { instance, schedule: Schedule::new(playback) }),
        MotionNews::Poses(vec![pose]),
        MotionNews::Clock(Box::new(clock)),
    ]
}

#[test]
fn news_of_motion_keep_their_bytes() {
    let [chunk, schedule, poses, clock] =
        news_of_motion().map(|news| encode_motion(&MotionMessage { sequence: 9, news }.encode()));
    assert_pinned(
        &chunk,
        "030900000001ac020140040804000110503838aca13e9f4000048241810008241832c1df81228d79aa0000",
    );
    assert_pinned(
        &schedule,
        "030900000002070180a8d6b907ac0200008040000000000000d03f000000000000f8bf028088debe01",
    );
    assert_pinned(
        &poses,
        "03090000000301075002011f0000003ffcffff7ffe3fffff7793fdff1fffffff9fffcfffffdd64ffff07",
    );
    assert_pinned(&clock, "030900000004000180a8d6b9070180d0acf30e01aad191930f000000000000000000000000000000");
}

#[test]
fn what_is_told_of_skinning_and_predicted_keeps_its_bytes() {
    let MotionNews::Schedule(NewSchedule { instance, schedule }) = &news_of_motion()[1] else {
        unreachable!("the second is a schedule");
    };
    let rows = [[1.0, 0.0, 0.0, 0.5], [0.0, 1.0, 0.0, 0.25], [0.0, 0.0, 1.0, -2.0]];
    let skeleton = SkeletonInfo {
        skeleton: SkeletonId(2),
        first_word: 0,
        parents: vec![None, Some(0)],
        level_starts: vec![0, 1, 2],
        entries: vec![SkeletonEntry { bone: 1, bone_from_mesh: rows }],
        morph_count: 1,
    };
    let told = SkinnedInstance {
        instance: *instance,
        skeleton: SkeletonId(2),
        source: PoseSource::Clips,
        placement: rows,
        path: None,
        schedule: schedule.clone(),
        bone_base: 0,
        palette_base: 0,
    };
    let rest = RestVertex {
        rest: RestId(3),
        position: [100, -200, 300],
        joints: [0; 4],
        weights: [65_535, 0, 0, 0],
        morph_word: 32,
        morphs: vec![(0, [5, -6, 7])],
    };
    let vertex =
        |slot, motion| NewVertex { slot: VertexSlot(slot), instance: *instance, number: slot, motion };
    let predictions = [1, 2, 3].map(|step| Prediction {
        position_m: Vec3::splat(step as f32),
        since_update_s: step as f32 * 0.03125,
    });
    let delta = GeometryDelta {
        skinned: Skinned {
            skeletons: vec![skeleton],
            meshes: vec![MeshInfo { first_rest: RestId(0), count: 8, step: 0.0001 }],
            instances: vec![told],
        },
        new_rests: vec![rest],
        new_vertices: vec![vertex(4, Motion::Skinned { rest: RestId(3) }), vertex(5, Motion::Predicted)],
        predictions: vec![PredictedVertex { slot: VertexSlot(5), predictions }],
        ..GeometryDelta::default()
    };
    assert_pinned(
        &DeltaEncoder::new(200, 20).encode(&delta.into()).bytes,
        "5343473200000000000000000100000000000000000000000000000000019e01120106330101000102000102000103000102\
         01010000803f00000000000000000000003f000000000000803f000000000000803e00000000000000000000803f000000c0\
         01000817b7d13801580702000000803f00000000000000000000003f000000000000803f000000000000803e000000000000\
         00000000803f000000c0000180a8d6b907ac0200008040000000000000d03f000000000000f8bf028088debe010000010300\
         01002183f418282c090120000a0b0e0005e1366625c00105000000803f0000803f0000803f0000003d000000400000004000\
         0000400000803d0000404000004040000040400000c03d0000",
    );
}
