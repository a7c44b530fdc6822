use super::state::Motionless;
use super::*;
use glam::Vec3;
use shadecast_protocol::ids::{InstanceId, SkeletonId};
use shadecast_protocol::message::MotionMemory;
use shadecast_protocol::motion::predicted::Prediction;
use shadecast_protocol::time::DEFAULT_GRID;
use shadecast_shaders::generated::VertexWriteGpu;

const SLOTS: u32 = 40;

fn enter_three(motion: &mut Motion) {
    let vertex = |slot| NewVertex {
        slot: VertexSlot(slot),
        instance: InstanceId(0),
        number: slot,
        motion: geometry::Motion::Sampled,
    };
    motion.take(UpdateId(0), &[0, 1, 2].map(vertex), positions(0..16), true);
}

/// Of vertices 0, 1, 2.
fn positions(steps: std::ops::Range<i32>) -> Vec<PositionBatch> {
    let at = |slot| (VertexSlot(slot), Vec3::ONE);
    steps.map(|step| PositionBatch { grid: GridIndex(step), positions: [0, 1, 2].map(at).to_vec() }).collect()
}

#[test]
fn written_vertex_records_are_dropped_from_a_full_queue() {
    let mut motion = Motion::new(SLOTS, MotionMemory::DEFAULT.into());
    enter_three(&mut motion);
    let mut staging = [bytemuck::Zeroable::zeroed(); 12];
    for update in 1..2000 {
        let first = 12 + update as i32 * 4;
        motion.take(UpdateId(update), &[], positions(first..first + 4), true);
        motion.writes.drain_into(&mut staging, |_| {});
        assert!(motion.writes.waiting() > 0, "the first delta's are always ahead");
        assert!(motion.writes.records.len() < 100, "{}", motion.writes.records.len());
    }
}

#[test]
fn more_vertex_records_than_a_turn_may_bring_are_too_much() {
    let mut motion = Motion::new(SLOTS, MotionMemory::DEFAULT.into());
    enter_three(&mut motion);
    for update in 1..4 {
        assert!(!motion.is_full(), "{} records", motion.writes.waiting());
        motion.take(UpdateId(update), &[], positions(0..16), true);
    }
    assert!(motion.is_full(), "{} records", motion.writes.waiting());
}

/// One instance, number 3, of a skeleton; vertices 0 to 3 are its.
fn with_skinned() -> Motion {
    let mut motion = Motion::new(SLOTS, MotionMemory::DEFAULT.into());
    let (skeleton, instance) = (SkeletonId(0), InstanceId(3));
    motion.skinned().set_skeleton(skeleton, skinned::SkeletonPlace::default());
    let told = skinned::SkinnedInstance {
        skeleton,
        placement: [[0.0; 4]; 3],
        path: None,
        palette_base: 5,
        global_base: 0,
        source: skinned::Source::Grid { first_word: 0, steps: 8 },
    };
    motion.skinned().set_instance(instance, told).expect("its skeleton is known");
    for slot in 0..4 {
        motion.enter_skinned(VertexSlot(slot), instance, RestId(slot)).expect("the instance is known");
    }
    motion.take(UpdateId(0), &[], Vec::new(), true);
    motion
}

#[test]
fn shared_vertices_of_an_instance_count_once() {
    let mut motion = with_skinned();
    let patches = [[0, 1, 2], [1, 2, 3]].map(|patch| patch.map(VertexSlot));
    for _ in 0..2 {
        let mut users = motion.users();
        let first = patches.map(|patch| users.add(&patch));
        users.end();
        assert_eq!(first, [GridIndex(i32::MIN); 2], "they wait for no samples");
        assert_eq!(motion.drawn(), [Drawn { instance: InstanceId(3), vertices: 4 }]);
    }
    for (patch, left) in [(0, 4), (1, 4), (0, 3), (1, 0)] {
        let mut users = motion.users();
        users.remove(&patches[patch]);
        users.end();
        let vertices = motion.drawn().iter().map(|drawn| drawn.vertices).sum::<u32>();
        assert_eq!(vertices, left, "{:?}", motion.drawn());
    }
    assert_eq!(motion.state().motionless(DEFAULT_GRID, WorldTime(i64::MAX)), Motionless::default());
}

#[test]
fn a_vertex_of_an_unknown_instance_does_not_enter() {
    let mut motion = with_skinned();
    assert_eq!(motion.enter_skinned(VertexSlot(9), InstanceId(4), RestId(0)), None);
    assert_eq!(motion.state().vertex_count, 4);
}

#[test]
fn a_displayed_skinned_slot_cannot_be_reused() {
    let mut motion = with_skinned();
    let mut users = motion.users();
    users.add(&[0, 1, 2].map(VertexSlot));
    users.end();
    motion.enter_skinned(VertexSlot(3), InstanceId(3), RestId(0)).expect("known");
    assert_eq!(motion.take_contradiction(), None);
    motion.enter_skinned(VertexSlot(2), InstanceId(3), RestId(0)).expect("known");
    assert_eq!(motion.take_contradiction(), Some(VertexSlot(2)));
}

const MS: i64 = 1_000_000;

/// Vertices 0 and 1 enter with update 0 at 1000 ms, which says where they are 30, 60 and 90 ms later.
fn with_predicted() -> Motion {
    let mut motion = Motion::new(SLOTS, MotionMemory::NONE.into());
    let (instance, predicted) = (InstanceId(0), geometry::Motion::Predicted);
    let entering =
        [0, 1].map(|slot| NewVertex { slot: VertexSlot(slot), instance, number: slot, motion: predicted });
    motion.take(UpdateId(0), &entering, Vec::new(), false);
    motion.predict(UpdateId(0), WorldTime(1000 * MS), &[0, 1].map(predicted_vertex));
    motion
}

/// At 1 m, 2 m and 3 m.
fn predicted_vertex(slot: u32) -> PredictedVertex {
    let prediction = |number: u8| Prediction {
        position_m: Vec3::splat(f32::from(number)),
        since_update_s: f32::from(number) * 0.03,
    };
    PredictedVertex { slot: VertexSlot(slot), predictions: [1, 2, 3].map(prediction) }
}

/// What at most `room` records bring, by segments.
fn drain(motion: &mut Motion, room: usize) -> Vec<Vec<VertexWriteGpu>> {
    let (mut staging, mut ranges) = (vec![bytemuck::Zeroable::zeroed(); room], Vec::new());
    motion.writes.drain_into(&mut staging, |range| ranges.push(range));
    ranges.iter().map(|range| staging[range.start as usize..range.end as usize].to_vec()).collect()
}

#[test]
fn predictions_follow_their_vertices_and_complete_the_update() {
    let mut motion = with_predicted();
    let places: Vec<u32> = (0..3).collect();
    let write = |slot: u32, number: &u32| {
        let at = WorldTime((1030 + 30 * i64::from(*number)) * MS);
        prediction_write(slot, *number, at, [*number as f32 + 1.0; 3])
    };
    let of_slot = |slot: u32| places.iter().map(move |number| write(slot, number));
    let all: Vec<_> = of_slot(0).chain(of_slot(1)).collect();
    let first = drain(&mut motion, 7);
    assert_eq!(first, [[0, 1].map(predicted_entry).to_vec(), all[..5].to_vec()]);
    assert_eq!(motion.complete(), None, "one prediction waits");
    assert_eq!(drain(&mut motion, 7), [all[5..].to_vec()]);
    assert_eq!(motion.complete(), Some(UpdateId(0)));
}

#[test]
fn vertices_past_their_last_prediction_are_counted_as_frozen() {
    let mut motion = with_predicted();
    let mut users = motion.users();
    let ready = users.add(&[0, 1, 0].map(VertexSlot));
    users.end();
    assert_eq!(ready, GridIndex(i32::MIN), "they wait for no samples");
    let frozen =
        |motion: &mut Motion, ms: i64| motion.state().motionless(DEFAULT_GRID, WorldTime(ms * MS)).frozen;
    assert_eq!([999, 1030, 1089].map(|ms| frozen(&mut motion, ms)), [0; 3]);
    assert_eq!([1091, 5000].map(|ms| frozen(&mut motion, ms)), [2; 2], "each once");
    motion.take(UpdateId(1), &[], Vec::new(), false);
    motion.predict(UpdateId(1), WorldTime(1050 * MS), &[predicted_vertex(0)]);
    assert_eq!([1089, 1091, 1139, 1141].map(|ms| frozen(&mut motion, ms)), [0, 1, 1, 2]);
    let mut users = motion.users();
    users.remove(&[0, 1, 0].map(VertexSlot));
    users.end();
    assert_eq!(frozen(&mut motion, 5000), 0, "nobody sees them");
}
