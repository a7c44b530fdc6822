//! The vertex memory on the GPU against its twin, on random deltas and display times. Validation is on; any message fails.

use super::*;
use crate::draw::stages::batch::Batch;
use crate::draw::stages::scatter::Scatter;
use crate::motion::Motion;
use crate::motion::skinned::SkinCapacity;
use glam::Vec3;
use shadecast_gpu::{Access, Buffer, DesktopDevice, GpuOptions, Memory, Needs};
use shadecast_protocol::delta::ReceivedDelta;
use shadecast_protocol::geometry::{self, GeometryDelta, NewVertex};
use shadecast_protocol::ids::{InstanceId, UpdateId, VertexSlot};
use shadecast_protocol::message::MotionMemory;
use shadecast_protocol::motion::PositionBatch;
use shadecast_protocol::motion::predicted::{PredictedVertex, Prediction};
use shadecast_protocol::time::{GridIndex, WorldTime};
use shadecast_shaders::constants::{NOT_DRAWABLE, ON_CURVE, PAST_THE_END};
use shadecast_shaders::twin::interpolate::VertexMemory as Twin;
use std::collections::BTreeSet;

const SLOTS: u32 = 300;
const GRID: Grid = Grid { spacing_ns: 33_333_333 };

struct Dice(u64);

impl Dice {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, limit: u64) -> u64 {
        self.next() % limit
    }
}

/// Some vertices enter, some animated ones get samples: new, missing, and sent again.
fn random_news(dice: &mut Dice, update: u32, step: i32) -> (Vec<NewVertex>, Vec<PositionBatch>) {
    let how = |dice: &mut Dice| match dice.below(4) {
        0 => geometry::Motion::Static { position: Vec3::splat(dice.below(1000) as f32 * 0.01) },
        _ => geometry::Motion::Sampled,
    };
    let enters = |dice: &mut Dice| update == 0 || dice.below(20) == 0;
    let entering = (0..SLOTS)
        .filter_map(|slot| {
            let vertex = NewVertex {
                slot: VertexSlot(slot),
                instance: InstanceId(0),
                number: slot,
                motion: how(dice),
            };
            enters(dice).then_some(vertex)
        })
        .collect();
    let somewhere =
        |dice: &mut Dice| Vec3::from_array([0; 3].map(|_| (dice.below(4000) as i32 - 2000) as f32 * 0.001));
    let positions = |dice: &mut Dice| {
        let slots = (0..SLOTS).map(VertexSlot).filter(|_| dice.below(3) > 0).collect::<Vec<_>>();
        slots.into_iter().map(|slot| (slot, somewhere(dice))).collect()
    };
    let batch = |step| PositionBatch { grid: GridIndex(step), positions: positions(dice) };
    (entering, (step - 2..=step + 3).map(batch).collect())
}

fn open() -> Arc<Gpu> {
    let options = GpuOptions { needs: Needs::Client, validation: true, device_name: None };
    Gpu::open(&options, &DesktopDevice).expect("a Vulkan device; `./shadecast setup` installs a software one")
}

/// The vertex memory on the GPU and its twin, told the same.
struct Both {
    gpu: Arc<Gpu>,
    memory: VertexMemory,
    scatter: Scatter,
    batch: Batch,
    scatter_group: BindGroup,
    interpolate: Interpolate,
    group: BindGroup,
    readback: Buffer,
    twin: Twin,
    /// For each.
    motions: [Motion; 2],
    slots: Slots,
    frames: usize,
}

impl Both {
    fn new(gpu: &Arc<Gpu>, sample_ring: u32) -> Self {
        let (scatter, interpolate) = (Scatter::new(gpu).unwrap(), Interpolate::new(gpu).unwrap());
        let capacity = SkinCapacity::from(MotionMemory { sample_ring, ..MotionMemory::NONE });
        let mut recorder = gpu.record().unwrap();
        let memory = VertexMemory::new(gpu, &mut recorder, SLOTS, capacity).unwrap();
        gpu.wait(recorder.submit().unwrap()).unwrap();
        let batch = Batch::new(gpu, 0, SLOTS, sample_ring).unwrap();
        Self {
            scatter_group: scatter.bind(&batch, &memory).unwrap(),
            batch,
            group: interpolate.bind(&memory).unwrap(),
            readback: Buffer::new(gpu, "positions", memory.positions.size(), Memory::Readback).unwrap(),
            twin: Twin::new(SLOTS, sample_ring),
            motions: [(); 2].map(|()| Motion::new(SLOTS, capacity)),
            slots: Slots { vertex_count: SLOTS, vertex_slots: SLOTS, sample_ring },
            gpu: gpu.clone(),
            memory,
            scatter,
            interpolate,
            frames: 0,
        }
    }

    /// One display frame, in which both agree.
    #[track_caller]
    fn frame(&mut self, push: &InterpolatePush, what: &str) {
        let [on_gpu, on_cpu] = &mut self.motions;
        let mut recorder = self.gpu.record().unwrap();
        self.batch.fill(on_gpu);
        self.scatter.record(&mut recorder, &self.scatter_group, &self.memory, &self.batch);
        self.interpolate.record(&mut recorder, &self.group, push);
        recorder.barrier(Access::COMPUTE_WRITE, Access::COPY_READ);
        recorder.copy_buffer(&self.memory.positions, 0, &self.readback, 0, self.readback.size());
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
        self.gpu.wait(recorder.submit().unwrap()).unwrap();
        scatter_on(&mut self.twin, on_cpu);
        self.twin.interpolate(push);
        let seen = &self.readback.values::<[f32; 4]>()[..SLOTS as usize];
        for (slot, (gpu, cpu)) in seen.iter().zip(&self.twin.positions).enumerate() {
            let is_close = gpu.iter().zip(cpu).all(|(a, b)| (a - b).abs() <= 1e-5 * (1.0 + b.abs()));
            assert!(gpu.iter().chain(cpu).all(|c| c.is_finite()), "slot {slot}: {gpu:?}, twin {cpu:?}");
            assert!(
                is_close && gpu[3] == cpu[3],
                "{what}, frame {}, slot {slot}: {gpu:?}, twin {cpu:?}",
                self.frames
            );
        }
        self.frames += 1;
    }

    /// The states that vertices are in.
    fn states(&self) -> BTreeSet<u32> {
        self.twin.positions.iter().map(|position| position[3] as u32).collect()
    }
}

#[test]
fn gpu_and_twin_agree_on_random_deltas_and_times() {
    let gpu = open();
    let (cubic, linear) = (Interpolation::Cubic, Interpolation::Linear);
    for (seed, interpolation, ring) in [(1, cubic, 32), (2, linear, 32), (3, cubic, 8), (4, linear, 64)] {
        compare(&gpu, seed, interpolation, ring);
    }
    assert_eq!(gpu.validation_messages(), 0, "{:?}", gpu.validation_texts());
}

fn compare(gpu: &Arc<Gpu>, seed: u64, interpolation: Interpolation, sample_ring: u32) {
    let (mut dice, mut both) = (Dice(seed), Both::new(gpu, sample_ring));
    let (mut time, mut before) = (WorldTime(-200_000_000), None);
    for frame in 0..60 {
        if dice.below(3) > 0 {
            let late = dice.below(3) as i32;
            let (entering, positions) = random_news(&mut dice, frame, GRID.floor(time).0 - late);
            let motions = both.motions.iter_mut();
            motions.for_each(|motion| motion.take(UpdateId(frame), &entering, positions.clone(), true));
        }
        let push = push(GRID, evaluation(time, before.replace(time)), both.slots, interpolation);
        both.frame(&push, &format!("seed {seed}"));
        time = time.plus_ns(13_888_889);
    }
    assert!(both.states().len() > 1, "the deltas reach more than one state: {:?}", both.states());
}

/// Some vertices enter, and of most of those that an update predicts it says where they will be, at times of its own.
fn random_predictions(dice: &mut Dice, update: u32, time: WorldTime, known: &mut [bool]) -> ReceivedDelta {
    let mut new_vertices = Vec::new();
    for (slot, is_predicted) in (0..).zip(known.iter_mut()) {
        if update == 0 || dice.below(20) == 0 {
            *is_predicted = dice.below(4) > 0;
            let motion = match *is_predicted {
                true => geometry::Motion::Predicted,
                false => geometry::Motion::Static { position: Vec3::splat(slot as f32) },
            };
            new_vertices.push(NewVertex {
                slot: VertexSlot(slot),
                instance: InstanceId(0),
                number: slot,
                motion,
            });
        }
    }
    let told = (0..SLOTS).filter(|slot| known[*slot as usize] && dice.below(8) > 0).collect::<Vec<_>>();
    let mut prediction = |step: f32| Prediction {
        position_m: Vec3::from_array([0; 3].map(|_| (dice.below(4000) as i32 - 2000) as f32 * 0.001)),
        since_update_s: step * 0.033 + dice.below(20) as f32 * 0.001,
    };
    let vertex =
        |slot| PredictedVertex { slot: VertexSlot(slot), predictions: [1.0, 2.0, 3.0].map(&mut prediction) };
    let predictions = told.into_iter().map(vertex).collect();
    let geometry =
        GeometryDelta { update: UpdateId(update), time, new_vertices, predictions, ..Default::default() };
    ReceivedDelta { geometry, is_update: true, ..Default::default() }
}

#[test]
fn gpu_and_twin_agree_on_predicted_vertices() {
    let gpu = open();
    // The second time: tags begin anew on the way.
    for (seed, ring, start_ns) in [(5, 8, 1_000_000_000), (6, 32, 3_355_000_000_000)] {
        let (mut dice, mut both) = (Dice(seed), Both::new(&gpu, ring));
        let (mut known, mut states) = (vec![false; SLOTS as usize], BTreeSet::new());
        let (mut time, mut before) = (WorldTime(start_ns), None);
        let mut update = 0;
        for frame in 0..120 {
            if frame == 0 || dice.below(6) == 0 {
                let made = time.plus_ns(dice.below(60_000_000) as i64 - 50_000_000);
                let delta = random_predictions(&mut dice, update, made, &mut known);
                both.motions.iter_mut().for_each(|motion| motion.take_delta(&mut delta.clone()));
                update += 1;
            }
            let evaluation = evaluation(time, before.replace(time));
            both.frame(&push(GRID, evaluation, both.slots, Interpolation::Cubic), &format!("seed {seed}"));
            states.extend(both.states());
            time = time.plus_ns(13_888_889);
        }
        let all = [NOT_DRAWABLE, ON_CURVE, PAST_THE_END].map(|state| state as u32);
        assert_eq!(states, all.into(), "the predictions reach every state");
    }
    assert_eq!(gpu.validation_messages(), 0, "{:?}", gpu.validation_texts());
}

fn scatter_on(twin: &mut Twin, motion: &mut Motion) {
    let mut records = vec![bytemuck::Zeroable::zeroed(); 100_000];
    let mut ranges = Vec::new();
    motion.writes().drain_into(&mut records, |range| ranges.push(range));
    ranges.into_iter().for_each(|range| twin.scatter(&records[range.start as usize..range.end as usize]));
}

#[test]
fn a_time_is_split_into_a_step_and_a_fraction_also_before_zero() {
    let at = |ns| GridTime::of(Grid { spacing_ns: 100 }, WorldTime(ns));
    assert_eq!(at(250), GridTime { step: GridIndex(2), fraction: 0.5 });
    assert_eq!(at(-25), GridTime { step: GridIndex(-1), fraction: 0.75 });
    assert_eq!(at(300), GridTime { step: GridIndex(3), fraction: 0.0 });
}

#[test]
fn blending_is_over_after_its_time() {
    let slots = Slots { vertex_count: 1, vertex_slots: 1, sample_ring: 8 };
    let step = |ns| {
        let now = WorldTime(1_000_000_000);
        push(GRID, evaluation(now.plus_ns(ns), Some(now)), slots, Interpolation::Cubic).blend_step
    };
    assert_eq!(step(BLEND_NS), 1.0);
    assert!((step(BLEND_NS / 4) - 0.25).abs() < 1e-6);
    assert_eq!(step(-5), 0.0, "a clock that is corrected backwards does not undo it");
}

fn evaluation(at: WorldTime, before: Option<WorldTime>) -> Evaluation {
    let before = before.unwrap_or(at);
    Evaluation { at, before, elapsed_ns: at.since(before) }
}
