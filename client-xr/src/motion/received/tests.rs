//! Messages about motion in any order, and their words of the arena.

use super::*;
use crate::motion::skinned::{DrawnInstances, PoseQuery, SkinnedCounts};
use shadecast_protocol::geometry::{GeometryDelta, NewVertex};
use shadecast_protocol::ids::{ClipId, RestId as WireRest, SkeletonId, VertexSlot};
use shadecast_protocol::message::MotionMemory;
use shadecast_protocol::motion::playback::{Playback, Repetition};
use shadecast_protocol::motion::poses::BonePose;
use shadecast_protocol::motion::skeleton::{SkeletonEntry, grid_words};
use shadecast_protocol::time::{DEFAULT_GRID, GridIndex, WorldTime};
use shadecast_shaders::constants::POSE_READY;
use shadecast_shaders::generated::PlacedPoseGpu;

const DANCE: ClipId = ClipId(3);
const WALK: ClipId = ClipId(4);
const FOX: InstanceId = InstanceId(7);
const RING: u32 = 32;
/// Words of the smallest chunk: three tracks of one key.
const WORDS: u32 = 12;

fn motion() -> Motion {
    Motion::new(
        40,
        MotionMemory { arena_words: 4000, rest_vertices: 40, pose_places: 40, sample_ring: RING }.into(),
    )
}

fn track(kind: TrackKind, keys: usize) -> ChunkTrack {
    let value = |key: usize| [key as f32, 1.0, 2.0, 3.0];
    let has_tangents = kind == TrackKind::Cubic && keys > 1;
    let tangents = (0..if has_tangents { keys } else { 0 }).map(|key| value(key + 100)).collect();
    let times_s = (0..keys).map(|key| key as f32 * 0.1).collect();
    ChunkTrack { kind, times_s, values: (0..keys).map(value).collect(), tangents }
}

/// The first chunk of a clip, of one bone.
fn chunk(sequence: u32, clip: ClipId, first_word: u32) -> MotionMessage {
    let tracks = vec![track(TrackKind::Step, 1); 3];
    let chunk = ClipChunk { clip, index: 0, first_word, tracks };
    assert_eq!(chunk.words(), WORDS);
    MotionMessage { sequence, news: MotionNews::Chunk(chunk) }
}

fn playing(clip: ClipId) -> Schedule<ClipRef> {
    let (from, repetition) = (WorldTime(0), Repetition::Loop);
    let clip = ClipRef { clip, duration_s: 0.4 };
    Schedule::new(Playback { from, clip, start_s: 0.0, speed: 1.0, repetition, fade_ns: 0 })
}

fn schedule(sequence: u32, clip: ClipId) -> MotionMessage {
    let change = NewSchedule { instance: FOX, schedule: playing(clip) };
    MotionMessage { sequence, news: MotionNews::Schedule(change) }
}

/// A skeleton of one bone at word 0, and a fox that dances.
fn fox() -> ReceivedDelta {
    let skeleton = SkeletonInfo {
        skeleton: SkeletonId(0),
        first_word: 0,
        parents: vec![None],
        level_starts: vec![0, 1],
        entries: vec![SkeletonEntry { bone: 0, bone_from_mesh: [[1.0, 2.0, 3.0, 4.0]; 3] }],
        morph_count: 0,
    };
    let instance = SkinnedInstance {
        instance: FOX,
        skeleton: SkeletonId(0),
        source: PoseSource::Clips,
        placement: [[0.0; 4]; 3],
        path: None,
        schedule: playing(DANCE),
        bone_base: 0,
        palette_base: 0,
    };
    let skinned = geometry::Skinned { skeletons: vec![skeleton], meshes: vec![], instances: vec![instance] };
    received(0, GeometryDelta { skinned, ..GeometryDelta::default() }, vec![])
}

fn received(update: u32, geometry: GeometryDelta, rests: Vec<PlacedRest>) -> ReceivedDelta {
    let geometry = GeometryDelta { update: UpdateId(update), ..geometry };
    ReceivedDelta { geometry, rests, positions: vec![], is_update: true }
}

/// A vertex of the fox, moved by so many morph targets from a word on.
fn vertex(update: u32, slot: u32, morph_word: u32, morphs: u16) -> ReceivedDelta {
    let rest = PlacedRest {
        rest: WireRest(slot),
        position: [1.0, 2.0, 3.0],
        joints: [0; 4],
        weights: [u16::MAX, 0, 0, 0],
        morph_word,
        morphs: (0..morphs).map(|morph| (morph, [0.5; 3])).collect(),
    };
    let motion = geometry::Motion::Skinned { rest: WireRest(slot) };
    let entering = NewVertex { slot: VertexSlot(slot), instance: FOX, number: slot, motion };
    let geometry = GeometryDelta { new_vertices: vec![entering], ..GeometryDelta::default() };
    received(update, geometry, vec![rest])
}

/// Everything that waits goes to the GPU; the bytes of the arena.
fn write(motion: &mut Motion) -> Vec<u8> {
    let (mut staging, mut copies) = (vec![0; 1 << 16], Vec::new());
    motion.arena().drain_into(&mut staging, |copy| copies.push(copy));
    let mut arena = vec![0; 4000 * WORD_BYTES];
    for copy in copies {
        let bytes = &staging[copy.staged.start as usize..copy.staged.end as usize];
        arena[copy.arena_byte as usize..][..bytes.len()].copy_from_slice(bytes);
    }
    let mut records = vec![bytemuck::Zeroable::zeroed(); 1000];
    motion.writes().drain_into(&mut records, |_| {});
    arena
}

/// The fox at a time near the start, with all that has arrived on the GPU.
fn pose(motion: &mut Motion) -> (PlacedPoseGpu, SkinnedCounts) {
    write(motion);
    let mut drawn = DrawnInstances::default();
    drawn.add_vertex(FOX);
    motion.drawn = drawn;
    let mut out = [bytemuck::Zeroable::zeroed()];
    let moment =
        PoseQuery { time: WorldTime(100_000_000), grid: DEFAULT_GRID, written: motion.arena.written() };
    let counts = motion.skinned.poses(moment, motion.drawn.all(), &mut out);
    (out[0], counts)
}

/// The word from which the fox is evaluated, where it can be.
fn evaluated_from(motion: &mut Motion) -> Option<u32> {
    let (pose, _) = pose(motion);
    // A track is two words.
    (pose.flags & POSE_READY != 0).then_some(pose.pose.track_base * 2)
}

#[test]
fn an_early_chunk_is_used_when_its_instance_arrives() {
    let mut motion = motion();
    motion.take_motion(chunk(0, DANCE, 100));
    assert_eq!(pose(&mut motion).1.withheld_vertices, 1, "nobody knows the fox");
    motion.take_delta(&mut fox());
    assert_eq!(evaluated_from(&mut motion), Some(100));
}

#[test]
fn a_chunk_that_takes_some_words_of_another_ends_it() {
    for first_word in [100 - WORDS + 4, 100, 100 + WORDS - 4] {
        let mut motion = motion();
        motion.take_delta(&mut fox());
        motion.take_motion(chunk(0, DANCE, 100));
        assert_eq!(evaluated_from(&mut motion), Some(100));
        motion.take_motion(chunk(1, WALK, first_word));
        assert_eq!(evaluated_from(&mut motion), None, "from {first_word}");
    }
}

#[test]
fn a_chunk_beside_another_leaves_it() {
    for first_word in [100 - WORDS, 100 + WORDS] {
        let mut motion = motion();
        motion.take_delta(&mut fox());
        motion.take_motion(chunk(0, DANCE, 100));
        motion.take_motion(chunk(1, WALK, first_word));
        assert_eq!(evaluated_from(&mut motion), Some(100), "from {first_word}");
    }
}

#[test]
fn a_chunk_older_than_its_replacement_is_dropped() {
    for (clip, expected) in [(DANCE, None), (WALK, Some(104))] {
        let mut motion = motion();
        motion.take_delta(&mut fox());
        motion.take_motion(chunk(9, WALK, 104));
        write(&mut motion);
        motion.take_motion(chunk(8, DANCE, 100));
        assert!(motion.arena().is_empty(), "it would end the later one");
        motion.take_motion(schedule(10, clip));
        assert_eq!(evaluated_from(&mut motion), expected, "{clip:?}");
    }
}

#[test]
fn numbers_of_messages_go_on_after_the_last() {
    let mut motion = motion();
    motion.take_delta(&mut fox());
    motion.take_motion(chunk(u32::MAX, WALK, 104));
    motion.take_motion(chunk(0, DANCE, 100));
    assert_eq!(evaluated_from(&mut motion), Some(100));
}

#[test]
fn a_moved_chunk_survives_the_reuse_of_its_old_place() {
    // Whichever of its places is heard of first.
    for order in [[0, 1, 2], [1, 0, 2], [1, 2, 0]] {
        let mut motion = motion();
        motion.take_delta(&mut fox());
        let all = [chunk(0, DANCE, 100), chunk(1, DANCE, 200), chunk(2, WALK, 100)];
        order.into_iter().for_each(|which| motion.take_motion(all[which].clone()));
        assert_eq!(evaluated_from(&mut motion), Some(200), "{order:?}");
    }
}

#[test]
fn what_is_there_for_good_ends_a_chunk_in_its_words() {
    let mut motion = motion();
    motion.take_motion(chunk(0, DANCE, 4));
    motion.take_delta(&mut fox());
    assert_eq!(evaluated_from(&mut motion), None, "the skeleton has these words");
    motion.take_motion(chunk(1, DANCE, 100));
    assert_eq!(evaluated_from(&mut motion), Some(100));
    motion.take_delta(&mut vertex(1, 0, 105, 1));
    assert_eq!(evaluated_from(&mut motion), None, "a morph target has one of these words");
}

#[test]
fn an_update_is_complete_with_its_morph_targets() {
    let mut motion = motion();
    motion.take_delta(&mut fox());
    write(&mut motion);
    assert_eq!(motion.complete(), Some(UpdateId(0)));
    motion.take_delta(&mut vertex(1, 0, 0, 0));
    motion.take_delta(&mut vertex(2, 1, 500, 200));
    motion.take_delta(&mut vertex(3, 2, 0, 0));
    let mut records = vec![bytemuck::Zeroable::zeroed(); 1000];
    motion.writes().drain_into(&mut records, |_| {});
    assert_eq!(motion.complete(), Some(UpdateId(1)));
    motion.arena().drain_into(&mut vec![0; 100 * WORD_BYTES], |_| {});
    assert_eq!(motion.complete(), Some(UpdateId(1)), "half of them");
    motion.arena().drain_into(&mut vec![0; 100 * WORD_BYTES], |_| {});
    assert_eq!(motion.complete(), Some(UpdateId(3)));
}

#[test]
fn vertices_that_enter_do_not_withhold_those_that_are_seen() {
    let mut motion = motion();
    motion.take_delta(&mut fox());
    motion.take_motion(chunk(0, DANCE, 100));
    assert_eq!(evaluated_from(&mut motion), Some(100));
    motion.take_delta(&mut vertex(1, 0, 500, 200));
    let mut drawn = DrawnInstances::default();
    drawn.add_vertex(FOX);
    motion.drawn = drawn;
    let moment = PoseQuery { time: WorldTime(0), grid: DEFAULT_GRID, written: motion.arena.written() };
    let counts = motion.skinned.poses(moment, motion.drawn.all(), &mut [bytemuck::Zeroable::zeroed()]);
    assert_eq!(counts.withheld_vertices, 0, "though their morph targets are on their way");
}

#[test]
fn a_skeleton_that_is_on_its_way_makes_its_update_incomplete() {
    let mut motion = motion();
    motion.take_delta(&mut fox());
    motion.writes().drain_into(&mut [], |_| {});
    assert_eq!(motion.complete(), None);
    write(&mut motion);
    assert_eq!(motion.complete(), Some(UpdateId(0)));
}

#[test]
fn a_schedule_that_comes_before_its_instance_counts() {
    let mut motion = motion();
    [chunk(0, DANCE, 100), chunk(1, WALK, 200), schedule(2, WALK)]
        .into_iter()
        .for_each(|news| motion.take_motion(news));
    motion.take_delta(&mut fox());
    assert_eq!(evaluated_from(&mut motion), Some(200));
}

#[test]
fn an_early_schedule_is_not_blended_from_an_undisplayed_state() {
    let mut motion = motion();
    pose(&mut motion);
    [chunk(0, WALK, 200), schedule(1, WALK)].into_iter().for_each(|news| motion.take_motion(news));
    motion.take_delta(&mut fox());
    let (placed, counts) = pose(&mut motion);
    assert_eq!(
        (counts.withheld_vertices, placed.pose.fading),
        (0, 0.0),
        "the dance is not there, nor needed"
    );
}

#[test]
fn of_two_schedules_the_later_one_counts_whichever_comes_first() {
    for order in [[0, 1], [1, 0]] {
        let mut motion = motion();
        motion.take_delta(&mut fox());
        [chunk(0, DANCE, 100), chunk(1, WALK, 200)].into_iter().for_each(|news| motion.take_motion(news));
        let both = [schedule(2, DANCE), schedule(3, WALK)];
        order.into_iter().for_each(|which| motion.take_motion(both[which].clone()));
        assert_eq!(evaluated_from(&mut motion), Some(200), "{order:?}");
    }
}

/// Numbers of 4 bytes from an arena word on.
fn numbers<T: bytemuck::Pod>(arena: &[u8], word: u32, count: usize) -> Vec<T> {
    let bytes = &arena[word as usize * WORD_BYTES..][..count * size_of::<T>()];
    bytes.chunks_exact(size_of::<T>()).map(bytemuck::pod_read_unaligned).collect()
}

#[test]
fn a_chunks_words_follow_its_layout() {
    let kinds = [TrackKind::Step, TrackKind::Linear, TrackKind::Cubic];
    let tracks: Vec<_> = (1..6).flat_map(|keys| kinds.map(|kind| track(kind, keys))).collect();
    let chunk = ClipChunk { clip: DANCE, index: 0, first_word: 40, tracks: tracks.clone() };
    let bytes = chunk_words(&chunk);
    let [keys_word, times_word, words] = layout(&tracks);
    assert_eq!(bytes.len(), words as usize * WORD_BYTES);
    let mut arena = vec![0; 40 * WORD_BYTES];
    arena.extend(bytes);
    let gpu: Vec<TrackGpu> = numbers(&arena, 40, tracks.len());
    let (mut next_key, mut next_time) = (40 + keys_word, (40 + times_word) * NUMBERS);
    for (track, gpu) in tracks.iter().zip(gpu) {
        assert_eq!((gpu.first_key, gpu.first_time), (next_key, next_time), "none shares another's");
        assert_eq!((gpu.key_count as usize, gpu.interval_s), (track.values.len(), 0.0));
        let of_key = |key: usize| match track.tangents.get(key) {
            Some(tangent) => vec![track.values[key], *tangent],
            None => vec![track.values[key]],
        };
        let expected: Vec<[f32; 4]> = (0..track.values.len()).flat_map(of_key).collect();
        assert_eq!(numbers::<[f32; 4]>(&arena, gpu.first_key, expected.len()), expected);
        let times: Vec<f32> = numbers(&arena, 0, arena.len() / 4);
        assert_eq!(times[gpu.first_time as usize..][..track.times_s.len()], track.times_s);
        next_key += expected.len() as u32;
        next_time += track.times_s.len() as u32;
    }
    assert_eq!(next_key, 40 + times_word);
    assert_eq!(next_time.div_ceil(NUMBERS).next_multiple_of(4), 40 + words);
}

#[test]
fn the_kinds_of_tracks_are_told_apart() {
    let kinds = [TrackKind::Step, TrackKind::Linear, TrackKind::Cubic].map(|kind| kind_of(&track(kind, 2)));
    assert_eq!(kinds, [STEP_TRACK, LINEAR_TRACK, CUBIC_TRACK]);
}

#[test]
fn a_skeleton_lies_where_its_place_says() {
    let mut motion = motion();
    let mut delta = fox();
    let skeleton = &mut delta.geometry.skinned.skeletons[0];
    (skeleton.first_word, skeleton.parents) = (8, vec![None, None, Some(1), Some(0), Some(3)]);
    skeleton.level_starts = vec![0, 2, 4, 5];
    skeleton.entries[0].bone = 4;
    motion.take_delta(&mut delta);
    let (placed, _) = pose(&mut motion);
    motion.take_delta(&mut received(1, delta.geometry.clone(), vec![]));
    let arena = write(&mut motion);
    let words: Vec<i32> = numbers(&arena, 0, 400);
    let at = |base: u32, count: usize| words[base as usize..][..count].to_vec();
    assert_eq!(at(placed.pose.bone_base, 5), [NO_PARENT, NO_PARENT, 1, 0, 3]);
    assert_eq!(at(placed.pose.level_base, 4), [0, 2, 4, 5]);
    assert_eq!((placed.pose.level_count, placed.pose.entry_count), (3, 1));
    let entry: Vec<EntryGpu> = numbers(&arena, placed.pose.entry_base * ENTRY_WORDS, 1);
    assert_eq!((entry[0].bone[0], entry[0].bone_from_mesh), (4, [[1.0, 2.0, 3.0, 4.0]; 3]));
}

/// A fox with a ring of poses from word 400 on.
fn posed_fox() -> ReceivedDelta {
    let mut delta = fox();
    delta.geometry.skinned.instances[0].source = PoseSource::Grid { first_word: 400 };
    delta
}

fn posed(grid: i32, x: f32, bones: usize) -> GridPose {
    let bone = BonePose { translation: [x, 2.0, 3.0], rotation: [0.0, 0.0, 0.0, 1.0], scale: [1.0; 3] };
    GridPose { instance: FOX, grid: GridIndex(grid), bones: vec![bone; bones], weights: vec![] }
}

fn poses(poses: Vec<GridPose>) -> MotionMessage {
    MotionMessage { sequence: 5, news: MotionNews::Poses(poses) }
}

/// The first number of the pose in a grid step's place.
fn x_at(arena: &[u8], grid: i32) -> f32 {
    let word = 400 + grid.rem_euclid(RING as i32) as usize * grid_words(1, 0) as usize;
    bytemuck::pod_read_unaligned(&arena[word * WORD_BYTES..][..4])
}

#[test]
fn poses_reach_their_places_before_or_after_their_instance() {
    for is_early in [false, true] {
        let mut motion = motion();
        let news = poses(vec![posed(-1, 10.0, 1), posed(0, 20.0, 1), posed(1, 30.0, 1)]);
        if is_early {
            motion.take_motion(news);
            motion.take_delta(&mut posed_fox());
        } else {
            motion.take_delta(&mut posed_fox());
            motion.take_motion(news);
        }
        let arena = write(&mut motion);
        assert_eq!([-1, 0, 1].map(|grid| x_at(&arena, grid)), [10.0, 20.0, 30.0], "{is_early}");
    }
}

#[test]
fn an_older_or_foreign_pose_changes_nothing() {
    let mut motion = motion();
    motion.take_delta(&mut posed_fox());
    motion.take_motion(poses(vec![posed(40, 10.0, 1), posed(8, 20.0, 1), posed(40, 30.0, 2)]));
    let arena = write(&mut motion);
    assert_eq!(x_at(&arena, 40), 10.0);
}
