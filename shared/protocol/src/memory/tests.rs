use super::*;
use crate::ids::ClipId;
use crate::limits::{DEFAULT_SAMPLE_RING, MIN_SAMPLE_RING};
use crate::motion::keys::{ChunkTrack, TrackKind};
use crate::motion::playback::{Playback, Repetition, Schedule};
use crate::motion::quantise;
use crate::motion::skeleton::{ClipRef, SkeletonEntry};
use crate::time::{GridIndex, WorldTime};
use glam::Vec3;

const SLOT: VertexSlot = VertexSlot(5);
const INSTANCE: InstanceId = InstanceId(9);

fn enters(step_m: f32) -> GeometryDelta {
    GeometryDelta {
        instances: vec![InstanceInfo { instance: INSTANCE, step_m }],
        new_vertices: vec![NewVertex { slot: SLOT, instance: INSTANCE, number: 0, motion: Motion::Sampled }],
        ..GeometryDelta::default()
    }
}

#[test]
fn a_position_round_trips_within_half_a_step() {
    let position = Vec3::new(1.234_567, -7.654_321, 0.000_2);
    let mut memory = ClientMemory::new(8, 1);
    for step_m in [0.0005, 0.01] {
        memory.apply(&enters(step_m)).unwrap();
        let batch = SampleBatch { grid: GridIndex(3), values: vec![(SLOT, quantise(position, step_m))] };
        let received = memory.positions(vec![batch]);
        let error = received[0].positions[0].1 - position;
        assert!(error.abs().max_element() <= step_m * 0.501, "{error} at {step_m}");
        let leaves = GeometryDelta { evicted_vertices: vec![SLOT], ..GeometryDelta::default() };
        memory.apply(&leaves).unwrap();
    }
    assert_eq!(quantise(Vec3::new(1e30, f32::NAN, -1e30), 1e-6), [i32::MAX, 0, i32::MIN]);
}

#[test]
fn poses_on_the_grid_must_lie_in_the_arena_that_was_agreed() {
    let playback = Playback {
        from: WorldTime(0),
        clip: ClipRef { clip: ClipId(0), duration_s: 0.0 },
        start_s: 0.0,
        speed: 1.0,
        repetition: Repetition::Once,
        fade_ns: 0,
    };
    let skeleton = SkeletonInfo {
        skeleton: SkeletonId(2),
        first_word: 0,
        parents: vec![None],
        level_starts: vec![0, 1],
        entries: Vec::new(),
        morph_count: 5,
    };
    let told = |first_word, sample_ring| {
        let instance = SkinnedInstance {
            instance: INSTANCE,
            skeleton: SkeletonId(2),
            source: PoseSource::Grid { first_word },
            placement: [[0.0; 4]; 3],
            path: None,
            schedule: Schedule::new(playback),
            bone_base: 0,
            palette_base: 0,
        };
        let skinned =
            Skinned { skeletons: vec![skeleton.clone()], instances: vec![instance], ..Skinned::default() };
        let arena_words = 4 + ring_words(sample_ring, 1, 5);
        let motion = MotionMemory { arena_words, sample_ring, ..MotionMemory::MAX };
        let delta = GeometryDelta { skinned, ..GeometryDelta::default() };
        ClientMemory::new(8, 1).with_motion(motion).apply(&delta)
    };
    for ring in [MIN_SAMPLE_RING, DEFAULT_SAMPLE_RING] {
        assert!(told(4, ring).is_ok());
        assert!(told(8, ring).is_err() && told(u32::MAX - 3, ring).is_err());
    }
}

#[test]
fn a_new_step_concerns_the_vertices_that_are_there() {
    let mut memory = ClientMemory::new(8, 1);
    assert_eq!(memory.apply(&enters(0.0005)).unwrap(), Entered { sampled: vec![SLOT], rescaled: vec![] });
    let step = InstanceInfo { instance: INSTANCE, step_m: 0.00025 };
    let other = NewVertex { slot: VertexSlot(6), instance: INSTANCE, number: 6, motion: Motion::Sampled };
    let delta =
        GeometryDelta { instances: vec![step], new_vertices: vec![other], ..GeometryDelta::default() };
    let entered = memory.apply(&delta).unwrap();
    assert_eq!(entered, Entered { sampled: vec![VertexSlot(6)], rescaled: vec![(SLOT, 2.0)] });
    assert_eq!(memory.step_m(INSTANCE), Some(0.00025));
}

const SKELETON: SkeletonId = SkeletonId(2);

/// Two bones, an entry each, a morph target; instance 9; a mesh of vertices 10 to 19.
fn told() -> GeometryDelta {
    let clip = ClipRef { clip: ClipId(0), duration_s: 1.0 };
    let (from, repetition) = (WorldTime(0), Repetition::Loop);
    let playback = Playback { from, clip, start_s: 0.0, speed: 1.0, repetition, fade_ns: 0 };
    let entry = |bone| SkeletonEntry { bone, bone_from_mesh: [[0.0; 4]; 3] };
    let skeleton = SkeletonInfo {
        skeleton: SKELETON,
        first_word: 8,
        parents: vec![None, Some(0)],
        level_starts: vec![0, 1, 2],
        entries: vec![entry(0), entry(1)],
        morph_count: 1,
    };
    let instance = SkinnedInstance {
        instance: INSTANCE,
        skeleton: SKELETON,
        source: PoseSource::Clips,
        placement: [[0.0; 4]; 3],
        path: None,
        schedule: Schedule::new(playback),
        bone_base: 0,
        palette_base: 0,
    };
    let mesh = MeshInfo { first_rest: RestId(10), count: 10, step: 0.001 };
    let skinned = Skinned { skeletons: vec![skeleton], meshes: vec![mesh], instances: vec![instance] };
    GeometryDelta { skinned, ..with_rest(|_| {}) }
}

/// A vertex before skinning, changed, and one that it places.
fn with_rest(change: fn(&mut RestVertex)) -> GeometryDelta {
    let mut rest = RestVertex {
        rest: RestId(10),
        position: [0; 3],
        joints: [1, 0, 1, 1],
        weights: [40_000, 25_535, 0, 0],
        morph_word: 100,
        morphs: vec![(0, [1; 3])],
    };
    change(&mut rest);
    let motion = Motion::Skinned { rest: rest.rest };
    let vertex = NewVertex { slot: SLOT, instance: INSTANCE, number: 0, motion };
    GeometryDelta { new_rests: vec![rest], new_vertices: vec![vertex], ..GeometryDelta::default() }
}

fn memory() -> ClientMemory {
    let motion = MotionMemory { arena_words: 400, rest_vertices: 40, pose_places: 2, sample_ring: 32 };
    ClientMemory::new(8, 1).with_motion(motion)
}

/// What changes in the first delta is refused for this reason.
#[track_caller]
fn assert_refused(change: impl Fn(&mut GeometryDelta), reason: &str) {
    let mut delta = told();
    change(&mut delta);
    let error = memory().apply(&delta).expect_err(reason).to_string();
    assert!(error.contains(reason), "{error}");
}

#[test]
fn what_is_told_of_skinning_is_taken() {
    assert_eq!(memory().apply(&told()), Ok(Entered::default()));
}

#[test]
fn a_vertex_names_only_its_instances_joints_and_morphs() {
    let lacks = "joints or morph targets that instance 9 lacks";
    assert_refused(|delta| delta.new_rests[0].joints[3] = 2, lacks);
    assert_refused(|delta| delta.new_rests[0].morphs[0].0 = 1, lacks);
    assert_refused(|delta| delta.skinned.skeletons[0].morph_count = 0, lacks);
    assert_refused(|delta| delta.skinned.skeletons[0].entries.truncate(1), lacks);
}

#[test]
fn nothing_reaches_beyond_the_arena_or_the_poses() {
    let morphs = "the morph targets of a vertex";
    assert_refused(|delta| delta.new_rests[0].morph_word = 400, morphs);
    assert_refused(|delta| delta.new_rests[0].morph_word = u32::MAX, morphs);
    assert_refused(|delta| delta.skinned.skeletons[0].first_word = 392, "a skeleton");
    assert_refused(|delta| delta.skinned.instances[0].bone_base = 1, "beyond what was agreed");
    assert_refused(|delta| delta.skinned.instances[0].palette_base = 1, "beyond what was agreed");
    let ring = |first_word| {
        move |delta: &mut GeometryDelta| {
            delta.skinned.instances[0].source = PoseSource::Grid { first_word };
        }
    };
    assert_refused(ring(200), "a ring of poses");
    assert_refused(ring(u32::MAX), "a ring of poses");
}

#[test]
fn what_stays_in_the_arena_for_good_is_given_to_nothing_else() {
    let for_good = "of the arena holds something for good";
    assert_refused(|delta| delta.new_rests[0].morph_word = 8, for_good);
    let ring = PoseSource::Grid { first_word: 10 };
    assert_refused(|delta| delta.skinned.instances[0].source = ring, for_good);
    let mut memory = memory();
    memory.apply(&told()).unwrap();
    let track = |words| ClipChunk { clip: ClipId(0), index: 0, first_word: words, tracks: vec![curve()] };
    assert_eq!(
        [0, 4, 8, 96, 100, 104, 396].map(|word| memory.check_chunk(&track(word)).is_ok()),
        [true, true, false, true, false, true, true]
    );
    assert!(memory.check_chunk(&track(400)).is_err(), "beyond the arena");
}

/// Takes four words.
fn curve() -> ChunkTrack {
    let (kind, tangents) = (TrackKind::Step, Vec::new());
    ChunkTrack { kind, times_s: vec![0.0], values: vec![[0.0; 4]], tangents }
}

#[test]
fn a_vertex_before_skinning_is_told_once_and_of_a_mesh() {
    assert_refused(|delta| delta.new_rests[0].rest = RestId(20), "is of no mesh");
    let mut memory = memory();
    memory.apply(&told()).unwrap();
    let again = GeometryDelta { new_vertices: vec![], ..with_rest(|_| {}) };
    assert!(memory.apply(&again).unwrap_err().to_string().contains("10 is told twice"));
}

#[test]
fn the_set_of_slots_iterates_in_order() {
    let mut set = SlotSet::new(200);
    let slots = [0, 1, 63, 64, 127, 128, 199];
    slots.iter().rev().for_each(|slot| assert!(set.insert(*slot)));
    assert!(!set.insert(63) && set.remove(1) && !set.remove(1) && !set.remove(1000));
    assert_eq!(set.iter().collect::<Vec<_>>(), [0, 63, 64, 127, 128, 199]);
}
