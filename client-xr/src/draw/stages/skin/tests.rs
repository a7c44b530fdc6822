//! Skinned vertices on the GPU against their twins, on random skeletons, clips, fades, paths and poses on the grid. Validation
//! is on; any message fails.

use super::*;
use crate::draw::stages::batch::Batch;
use crate::draw::stages::interpolate::Slots;
use crate::draw::stages::pose::{PoseStage, PoseStaging};
use crate::draw::stages::scatter::Scatter;
use crate::motion::Motion;
use crate::motion::arena::ArenaSerial;
use crate::motion::skinned::{
    Drawn, PoseQuery, SkeletonPlace, SkinCapacity, Skinned, SkinnedCounts, SkinnedInstance, Source,
};
use glam::{Affine3A, Quat, Vec3, Vec4};
use shadecast_gpu::{Access, Buffer, DesktopDevice, GpuOptions, Memory, Needs};
use shadecast_protocol::geometry::{self, NewVertex};
use shadecast_protocol::ids::{ClipId, InstanceId, SkeletonId, UpdateId, VertexSlot};
use shadecast_protocol::limits::{ARENA_ALIGNMENT_WORDS, CHUNK_S, DEFAULT_SAMPLE_RING};
use shadecast_protocol::motion::PositionBatch;
use shadecast_protocol::motion::clip::chunk_count;
use shadecast_protocol::motion::playback::{Playback, Repetition, Schedule};
use shadecast_protocol::motion::skeleton::{ClipRef, grid_words};
use shadecast_protocol::time::{Grid, GridIndex, WorldTime};
use shadecast_shaders::constants::{CUBIC_TRACK, LINEAR_TRACK, NO_PARENT, STEP_TRACK};
use shadecast_shaders::generated::{EntryGpu, PlacedPoseGpu, RestGpu, TrackGpu};
use shadecast_shaders::records::{Rest, RestId, morph_delta_word};
use shadecast_shaders::twin;
use shadecast_shaders::twin::pose::Arena;

const SLOTS: u32 = 600;
const GRID: Grid = Grid { spacing_ns: 33_333_333 };
const CLIP_S: f32 = 1.7;
/// What the client may be off from the double-precision twin.
const BOUND_M: f64 = 5e-5;
const MORPHS: u32 = 5;
const RING_STEPS: u32 = 8;
/// Whatever the skeleton, its clips have all of its tracks.
const MOST_TRACKS: u32 = u32::MAX;
const CAPACITY: SkinCapacity = SkinCapacity {
    rests: SLOTS,
    arena_words: 1 << 18,
    palette_entries: 1 << 14,
    bones: 1 << 14,
    sample_ring: DEFAULT_SAMPLE_RING,
};

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

    /// In -1..1.
    fn number(&mut self) -> f32 {
        (self.below(1 << 20) as f32 / (1 << 19) as f32) - 1.0
    }

    fn vec3(&mut self) -> Vec3 {
        Vec3::new(self.number(), self.number(), self.number())
    }

    fn quat(&mut self) -> Quat {
        Quat::from_euler(glam::EulerRot::XYZ, 3.0 * self.number(), 1.5 * self.number(), 3.0 * self.number())
    }
}

/// The words of an arena, as a server would lay them out.
#[derive(Default)]
struct Words(Vec<[u32; 4]>);

impl Words {
    /// Gives the first word.
    fn add<T: bytemuck::Pod>(&mut self, values: &[T]) -> u32 {
        self.0.resize(self.0.len().next_multiple_of(4), [0; 4]);
        let first = self.0.len() as u32;
        let bytes: &[u8] = bytemuck::cast_slice(values);
        for word in bytes.chunks(16) {
            let mut whole = [0u8; 16];
            whole[..word.len()].copy_from_slice(word);
            self.0.push(bytemuck::cast(whole));
        }
        first
    }

    /// Tracks first, with absolute places of keys and times behind them.
    fn add_clip(&mut self, curves: &[Curve]) -> u32 {
        let mut tracks = vec![TrackGpu { kind: STEP_TRACK, ..bytemuck::Zeroable::zeroed() }; curves.len()];
        let first = self.add(&tracks);
        for (track, curve) in tracks.iter_mut().zip(curves) {
            let is_cubic = curve.kind == CUBIC_TRACK && curve.keys.len() > 1;
            let of_key = |(_, value, tangent): &(f32, Vec4, Vec4)| match is_cubic {
                true => vec![value.to_array(), tangent.to_array()],
                false => vec![value.to_array()],
            };
            let values: Vec<[f32; 4]> = curve.keys.iter().flat_map(of_key).collect();
            let times: Vec<f32> = curve.keys.iter().map(|(time_s, ..)| *time_s).collect();
            (track.key_count, track.kind) = (curve.keys.len() as u32, curve.kind);
            track.first_key = self.add(&values);
            track.first_time = self.add(&times) * 4;
        }
        let words: &[[u32; 4]] = bytemuck::cast_slice(&tracks);
        self.0[first as usize..][..words.len()].copy_from_slice(words);
        first
    }
}

/// Times, values, tangents.
#[derive(Clone)]
struct Curve {
    kind: u32,
    keys: Vec<(f32, Vec4, Vec4)>,
}

impl Curve {
    fn random(dice: &mut Dice, near: Vec4, by: f32) -> Self {
        let kind = [STEP_TRACK, LINEAR_TRACK, CUBIC_TRACK][dice.below(3) as usize];
        let count = if dice.below(4) == 0 { 1 } else { 2 + dice.below(12) as usize };
        let vec4 = |dice: &mut Dice| dice.vec3().extend(dice.number());
        let key = |key: usize| {
            let time_s = CLIP_S * key as f32 / (count.max(2) - 1) as f32;
            (time_s, near + by * vec4(dice), by * vec4(dice))
        };
        Self { kind, keys: (0..count).map(key).collect() }
    }

    /// The keys that decide a chunk: from the last at or before its start to the first at or after its end.
    fn chunk(&self, chunk: u32) -> Self {
        let (start, end) = (f64::from(chunk) * CHUNK_S, f64::from(chunk + 1) * CHUNK_S);
        let first = self.keys.iter().rposition(|key| f64::from(key.0) <= start).unwrap_or(0);
        let last = self.keys.iter().position(|key| f64::from(key.0) >= end).unwrap_or(self.keys.len() - 1);
        Self { kind: self.kind, keys: self.keys[first..=last].to_vec() }
    }

    fn negated(mut self) -> Self {
        self.keys.iter_mut().for_each(|(_, value, tangent)| (*value, *tangent) = (-*value, -*tangent));
        self
    }
}

/// A random skeleton, its clips and its mesh.
struct Model {
    skeleton: SkeletonPlace,
    /// Around which its bones move: translation and rotation.
    rests: Vec<(Vec3, Quat)>,
    /// By clip: where its chunks are, and where it is as a whole.
    clips: Vec<(Vec<u32>, u32)>,
    vertices: Vec<Rest>,
}

fn rows(transform: Affine3A) -> [[f32; 4]; 3] {
    let (m, t) = (transform.matrix3, transform.translation);
    [0, 1, 2].map(|r| [m.x_axis[r], m.y_axis[r], m.z_axis[r], t[r]])
}

fn skeleton(dice: &mut Dice, words: &mut Words) -> SkeletonPlace {
    let level_count = 2 + dice.below(5) as u32;
    let mut level_starts = vec![0];
    let mut parents = Vec::new();
    for level in 0..level_count as usize {
        let before = if level == 0 { 0 } else { level_starts[level - 1] as u64 };
        let first = parents.len() as u64;
        for _ in 0..1 + dice.below(14) {
            let mut parent = || (before + dice.below(first - before)) as i32;
            parents.push(if level == 0 { NO_PARENT } else { parent() });
        }
        level_starts.push(parents.len() as u32);
    }
    let bone_count = parents.len() as u32;
    let entry_count = bone_count.min(4 + dice.below(40) as u32);
    let entry = |_| EntryGpu {
        bone_from_mesh: rows(Affine3A::from_rotation_translation(dice.quat(), 0.3 * dice.vec3())),
        bone: [dice.below(u64::from(bone_count)) as u32, 0, 0, 0],
    };
    let entries: Vec<_> = (0..entry_count).map(entry).collect();
    SkeletonPlace {
        bone_base: words.add(&parents) * 4,
        level_base: words.add(&level_starts) * 4,
        level_count,
        entry_base: words.add(&entries) / 4,
        entry_count,
        bone_count,
        morph_count: MORPHS,
        written: ArenaSerial::default(),
    }
}

fn curves(dice: &mut Dice, rests: &[(Vec3, Quat)]) -> Vec<Curve> {
    let mut curves = Vec::new();
    for (translation, rotation) in rests {
        curves.push(Curve::random(dice, translation.extend(0.0), 0.1));
        let turned = Curve::random(dice, Vec4::from(*rotation), 0.3);
        curves.push(if dice.below(2) == 0 { turned.negated() } else { turned });
        curves.push(Curve::random(dice, Vec4::ONE, 0.1));
    }
    curves
}

fn vertex(dice: &mut Dice, skeleton: &SkeletonPlace, words: &mut Words) -> Rest {
    let influences = 1 + dice.below(4) as usize;
    let mut weights = [0u16; 4];
    let mut left = 65535;
    for weight in &mut weights[..influences - 1] {
        *weight = dice.below(u64::from(left) / 2) as u16;
        left -= *weight;
    }
    weights[influences - 1] = left;
    weights.sort_unstable_by(|a, b| b.cmp(a));
    let morphs: Vec<u32> = (0..MORPHS).filter(|_| dice.below(3) == 0).collect();
    let deltas: Vec<_> =
        morphs.into_iter().map(|morph| morph_delta_word((0.1 * dice.vec3()).to_array(), morph)).collect();
    Rest {
        position_m: dice.vec3().to_array(),
        joints: [0; 4].map(|_| dice.below(u64::from(skeleton.entry_count)) as u16),
        weights,
        first_delta: words.add(&deltas),
        delta_count: deltas.len() as u8,
    }
}

impl Model {
    fn random(dice: &mut Dice, words: &mut Words) -> Self {
        let skeleton = skeleton(dice, words);
        let rests: Vec<_> = (0..skeleton.bone_count).map(|_| (0.3 * dice.vec3(), dice.quat())).collect();
        let clip = |_| {
            let mut all = curves(dice, &rests);
            all.extend((0..MORPHS).map(|_| Curve::random(dice, Vec4::splat(0.4), 0.5)));
            let chunk = |chunk| words.add_clip(&all.iter().map(|c| c.chunk(chunk)).collect::<Vec<_>>());
            let chunks: Vec<u32> = (0..chunk_count(CLIP_S)).map(chunk).collect();
            (chunks, words.add_clip(&all))
        };
        let clips = [0, 1].map(clip).to_vec();
        let vertices = (0..60).map(|_| vertex(dice, &skeleton, words)).collect();
        Self { skeleton, rests, clips, vertices }
    }

    fn path(dice: &mut Dice, words: &mut Words) -> (Vec<u32>, u32) {
        let all = curves(dice, &[(Vec3::ZERO, Quat::IDENTITY)]);
        let chunk = |chunk| words.add_clip(&all.iter().map(|c| c.chunk(chunk)).collect::<Vec<_>>());
        ((0..chunk_count(CLIP_S)).map(chunk).collect(), words.add_clip(&all))
    }
}

fn playback(from_ms: i64, clip: u32, fade_ms: i64) -> Playback<ClipRef> {
    Playback {
        from: WorldTime(from_ms * 1_000_000),
        clip: ClipRef { clip: ClipId(clip), duration_s: CLIP_S },
        start_s: 0.3,
        speed: 1.1,
        repetition: Repetition::PingPong,
        fade_ns: fade_ms * 1_000_000,
    }
}

/// The GPU's side of a connection.
struct Bench {
    gpu: Arc<Gpu>,
    vertices: VertexMemory,
    memory: SkinMemory,
    scatter: Scatter,
    batch: Batch,
    scatter_group: BindGroup,
    pose: PoseStage,
    poses: PoseStaging,
    skin: Skin,
    group: BindGroup,
    motion: Motion,
    frames: usize,
}

impl Bench {
    fn new() -> Self {
        let options = GpuOptions { needs: Needs::Client, validation: true, device_name: None };
        let gpu = Gpu::open(&options, &DesktopDevice)
            .expect("a Vulkan device; `./shadecast setup` installs a software one");
        let mut recorder = gpu.record().unwrap();
        let vertices = VertexMemory::new(&gpu, &mut recorder, SLOTS, CAPACITY).unwrap();
        let memory = SkinMemory::new(&gpu, &mut recorder, CAPACITY).unwrap();
        gpu.wait(recorder.submit().unwrap()).unwrap();
        let (scatter, pose) = (Scatter::new(&gpu).unwrap(), PoseStage::new(&gpu).unwrap());
        let skin = Skin::new(&gpu).unwrap();
        let batch = Batch::new(&gpu, 0, SLOTS, CAPACITY.sample_ring).unwrap();
        Self {
            scatter_group: scatter.bind(&batch, &vertices).unwrap(),
            batch,
            poses: pose.staging(&gpu, &memory).unwrap(),
            group: skin.bind(&vertices, &memory).unwrap(),
            motion: Motion::new(SLOTS, CAPACITY),
            gpu,
            vertices,
            memory,
            scatter,
            pose,
            skin,
            frames: 0,
        }
    }

    /// One display frame: positions by slot, and how the instances stand.
    fn frame(&mut self, time: WorldTime) -> (Vec<[f32; 4]>, SkinnedCounts) {
        let flight = self.frames % 3;
        self.frames += 1;
        let mut recorder = self.gpu.record().unwrap();
        self.batch.fill(&mut self.motion);
        self.memory.record(&mut recorder, &self.batch);
        self.scatter.record(&mut recorder, &self.scatter_group, &self.vertices, &self.batch);
        recorder.barrier(crate::draw::stages::ARRIVALS, Access::COMPUTE);
        let moment = PoseQuery { time, grid: GRID, written: self.batch.state.written };
        let drawn = self.motion.drawn().to_vec();
        let counts = self.motion.skinned().poses(moment, &drawn, self.poses.poses_mut(flight));
        self.pose.record(&mut recorder, &self.poses, flight, counts.instances);
        recorder.barrier(Access::COMPUTE_WRITE, Access::COMPUTE_READ);
        self.skin.record(&mut recorder, &self.group, self.batch.state.vertex_count);
        (self.positions(recorder), counts)
    }

    /// By slot, when all of a recording is done.
    fn positions(&self, mut recorder: Recorder) -> Vec<[f32; 4]> {
        let positions = &self.vertices.positions;
        let readback = Buffer::new(&self.gpu, "positions", positions.size(), Memory::Readback).unwrap();
        recorder.barrier(Access::COMPUTE_WRITE, Access::COPY_READ);
        recorder.copy_buffer(positions, 0, &readback, 0, positions.size());
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
        self.gpu.wait(recorder.submit().unwrap()).unwrap();
        readback.values::<[f32; 4]>()[..SLOTS as usize].to_vec()
    }

    /// Vertices of instances from slot 0 on, with rests of the same numbers; all of them are drawn.
    fn enter(&mut self, of_instances: &[&[Rest]]) {
        let mut slots = (0..SLOTS).map(VertexSlot);
        for (instance, rests) in of_instances.iter().enumerate() {
            for (rest, slot) in rests.iter().zip(&mut slots) {
                self.motion.write_rest(RestId(slot.0), rest);
                let instance = InstanceId(instance as u16);
                self.motion.enter_skinned(slot, instance, RestId(slot.0)).expect("known");
            }
        }
        self.motion.take(UpdateId(0), &[], Vec::new(), true);
        let mut users = self.motion.users();
        let count = of_instances.iter().map(|rests| rests.len() as u32).sum();
        (0..count).for_each(|slot| {
            users.add(&[VertexSlot(slot)]);
        });
        users.end();
    }

    #[track_caller]
    fn assert_valid(&self) {
        assert_eq!(self.gpu.validation_messages(), 0, "{:?}", self.gpu.validation_texts());
    }
}

/// A model's clips and its path in the tables: in chunks for the GPU, whole for the twin.
fn tell(tables: &mut Skinned, clips: &[(Vec<u32>, u32)], is_whole: bool, written: ArenaSerial) {
    for (id, (chunks, whole)) in clips.iter().enumerate() {
        let id = ClipId(id as u32);
        for (chunk, place) in chunks.iter().enumerate() {
            let place = if is_whole { *whole } else { *place };
            tables.set_chunk((id, chunk as u32), place, MOST_TRACKS, written);
        }
    }
}

/// Places of palettes and bones behind those of the instances before.
fn instance(index: u32, source: Source) -> SkinnedInstance {
    let angle = index as f32;
    let placement =
        Affine3A::from_rotation_translation(Quat::from_rotation_y(angle), Vec3::new(7.0, 1.0, -7.0));
    SkinnedInstance {
        skeleton: SkeletonId(0),
        placement: rows(placement),
        path: None,
        palette_base: 100 * index,
        global_base: 150 * index,
        source,
    }
}

/// How far the GPU's positions are from the twin's at most, metres. `tables` are the twin's own.
#[track_caller]
fn worst_error_m(
    positions: &[[f32; 4]],
    words: &Words,
    tables: &mut Skinned,
    model: &Model,
    time: WorldTime,
    instances: u16,
) -> f64 {
    let mut poses = vec![bytemuck::Zeroable::zeroed(); usize::from(instances)];
    let drawn: Vec<_> = (0..instances).map(|i| Drawn { instance: InstanceId(i), vertices: 1 }).collect();
    let moment = PoseQuery { time, grid: GRID, written: ArenaSerial::default() };
    tables.poses(moment, &drawn, &mut poses);
    let mut slots = positions.iter();
    let mut worst = 0f64;
    for pose in &poses {
        let posed = Arena(&words.0).pose(pose);
        for rest in &model.vertices {
            let expected = twin::skin::position(Arena(&words.0), &rest.gpu(), &posed);
            let [x, y, z, state] = *slots.next().expect("a slot");
            assert_eq!(state, shadecast_shaders::constants::ON_CURVE);
            let errors = [x, y, z].into_iter().zip(expected).map(|(gpu, cpu)| (f64::from(gpu) - cpu).powi(2));
            let error_m = errors.sum::<f64>().sqrt();
            assert!(error_m.is_finite(), "{x} {y} {z}, twin {expected:?}");
            worst = worst.max(error_m);
        }
    }
    worst
}

fn clip_instances() -> Vec<SkinnedInstance> {
    let mut fading = Schedule::new(playback(0, 0, 0));
    fading.change(playback(300, 1, 700));
    let once = Playback { repetition: Repetition::Once, speed: 0.7, ..playback(0, 1, 0) };
    let clips = [Schedule::new(playback(0, 0, 0)), fading, Schedule::new(once)];
    let mut instances: Vec<_> =
        clips.into_iter().zip(0..).map(|(clip, index)| instance(index, Source::Clips(clip))).collect();
    for moved in &mut instances[1..] {
        moved.path = Some(Schedule::new(Playback { repetition: Repetition::Loop, ..playback(0, 2, 0) }));
    }
    instances
}

#[test]
fn skinned_vertices_equal_their_twin() {
    let mut worst = 0f64;
    for seed in 1..5 {
        let (mut dice, mut words, mut bench) = (Dice(seed), Words::default(), Bench::new());
        let model = Model::random(&mut dice, &mut words);
        let mut clips = model.clips.clone();
        clips.push(Model::path(&mut dice, &mut words));
        let mut tables = Skinned::default();
        let written = bench.motion.arena().push(0, bytemuck::cast_slice(&words.0));
        tell(bench.motion.skinned(), &clips, false, written);
        tell(&mut tables, &clips, true, ArenaSerial::default());
        for tables in [bench.motion.skinned(), &mut tables] {
            tables.set_skeleton(SkeletonId(0), model.skeleton);
            for (instance, index) in clip_instances().into_iter().zip(0..) {
                tables.set_instance(InstanceId(index), instance).unwrap();
            }
        }
        bench.enter(&[&model.vertices[..]; 3]);
        // The words take some frames to arrive.
        while !bench.motion.arena().is_empty() {
            bench.frame(WorldTime(0));
        }
        for frame in 0..40 {
            let time = WorldTime(frame * 61_111_111 - 100_000_000);
            let (positions, counts) = bench.frame(time);
            assert_eq!((counts.instances, counts.withheld_vertices), (3, 0));
            let error_m = worst_error_m(&positions, &words, &mut tables, &model, time, 3);
            assert!(error_m < BOUND_M, "seed {seed}, frame {frame}: {} mm", error_m * 1e3);
            worst = worst.max(error_m);
        }
        bench.assert_valid();
    }
    println!("worst: {:.5} mm", worst * 1e3);
    assert!(worst > 0.0, "single precision is not double precision");
}

#[test]
fn an_instance_has_no_area_before_its_chunk() {
    let (mut dice, mut words, mut bench) = (Dice(7), Words::default(), Bench::new());
    let model = Model::random(&mut dice, &mut words);
    bench.motion.arena().push(0, bytemuck::cast_slice(&words.0));
    while !bench.motion.arena().is_empty() {
        bench.frame(WorldTime(0));
    }
    // More than a frame can write lies before the chunk.
    let place = words.0.len() as u32;
    let late = bench.motion.arena().push(place, &vec![0; 700 << 10]);
    let tables = bench.motion.skinned();
    tell(tables, &model.clips, false, ArenaSerial::default());
    tables.set_chunk((ClipId(0), 0), model.clips[0].0[0], MOST_TRACKS, late);
    tables.set_skeleton(SkeletonId(0), model.skeleton);
    for index in 0..2 {
        let clip = Schedule::new(playback(0, index, 0));
        tables.set_instance(InstanceId(index as u16), instance(index, Source::Clips(clip))).unwrap();
    }
    bench.enter(&[&model.vertices[..]; 2]);
    let count = model.vertices.len();
    let (positions, counts) = bench.frame(WorldTime(0));
    assert_eq!(counts, SkinnedCounts { instances: 2, withheld_vertices: count as u32, ..Default::default() });
    assert!(positions[..count].iter().all(|p| p[..3] == [0.0; 3]), "{:?}", &positions[..count]);
    assert!(positions[count..2 * count].iter().all(|p| p[..3] != [0.0; 3]));
    let (positions, counts) = bench.frame(WorldTime(0));
    assert_eq!(counts.withheld_vertices, 0);
    assert!(positions[..2 * count].iter().all(|p| p[..3] != [0.0; 3]));
    bench.assert_valid();
}

/// Poses on the grid with any signs of rotations; gives the words of one step.
fn random_step(dice: &mut Dice, model: &Model) -> Vec<[u32; 4]> {
    let mut values = Vec::new();
    for (translation, rotation) in &model.rests {
        let turned = Vec4::from(*rotation) + 0.2 * dice.vec3().extend(dice.number());
        let turned = if dice.below(2) == 0 { -turned } else { turned };
        let scale = Vec3::ONE + 0.1 * dice.vec3();
        values.extend([(*translation + 0.05 * dice.vec3()).extend(0.0), turned, scale.extend(0.0)]);
    }
    values.extend((0..MORPHS.div_ceil(4)).map(|_| dice.vec3().extend(dice.number())));
    let step_words = grid_words(model.skeleton.bone_count, MORPHS);
    values.resize(values.len().next_multiple_of(ARENA_ALIGNMENT_WORDS as usize), Vec4::ZERO);
    assert_eq!(values.len() as u32, step_words);
    values.iter().map(|value| value.to_array().map(f32::to_bits)).collect()
}

/// An instance with poses at some steps, on the GPU and in the twin's tables.
struct GridBench {
    bench: Bench,
    words: Words,
    tables: Skinned,
    model: Model,
    dice: Dice,
}

impl GridBench {
    fn new(seed: u64) -> Self {
        let (mut dice, mut words, mut bench) = (Dice(seed), Words::default(), Bench::new());
        let model = Model::random(&mut dice, &mut words);
        let ring_words = RING_STEPS * grid_words(model.skeleton.bone_count, MORPHS);
        let first_word = words.add(&vec![[0u32; 4]; ring_words as usize]);
        bench.motion.arena().push(0, bytemuck::cast_slice(&words.0));
        let mut tables = Skinned::default();
        for tables in [bench.motion.skinned(), &mut tables] {
            tables.set_skeleton(SkeletonId(0), model.skeleton);
            let source = Source::Grid { first_word, steps: RING_STEPS };
            tables.set_instance(InstanceId(0), instance(0, source)).unwrap();
        }
        bench.enter(&[&model.vertices[..]]);
        Self { bench, words, tables, model, dice }
    }

    fn add_step(&mut self, step: i32) {
        let (id, step) = (InstanceId(0), GridIndex(step));
        let values = random_step(&mut self.dice, &self.model);
        let place = self.tables.grid_step_word(id, step).expect("a ring");
        self.words.0[place as usize..][..values.len()].copy_from_slice(&values);
        let written = self.bench.motion.arena().push(place, bytemuck::cast_slice(&values));
        self.bench.motion.skinned().set_grid_step(id, step, written);
        self.tables.set_grid_step(id, step, ArenaSerial::default());
    }

    /// At a time in grid steps.
    #[track_caller]
    fn frame(&mut self, at: f64) -> SkinnedCounts {
        while !self.bench.motion.arena().is_empty() {
            self.bench.frame(WorldTime(0));
        }
        let time = WorldTime((at * GRID.spacing_ns as f64) as i64);
        let (positions, counts) = self.bench.frame(time);
        let error_m = worst_error_m(&positions, &self.words, &mut self.tables, &self.model, time, 1);
        assert!(error_m < BOUND_M, "at {at}: {} mm", error_m * 1e3);
        counts
    }
}

#[test]
fn grid_poses_equal_their_twin_with_four_steps_and_with_two() {
    let mut grid = GridBench::new(11);
    (4..6).for_each(|step| grid.add_step(step));
    let ready = SkinnedCounts { instances: 1, ..Default::default() };
    assert_eq!([4.0, 4.3, 4.9].map(|at| grid.frame(at)), [ready; 3], "two steps");
    grid.add_step(3);
    assert_eq!(grid.frame(4.5), ready, "three steps");
    (6..20).for_each(|step| grid.add_step(step));
    assert_eq!([15.3, 14.6, 17.99].map(|at| grid.frame(at)), [ready; 3], "four steps, the ring taken again");
    grid.bench.assert_valid();
}

#[test]
fn past_the_last_pose_an_instance_extrapolates_one_step() {
    let mut grid = GridBench::new(12);
    (4..6).for_each(|step| grid.add_step(step));
    let vertices = grid.model.vertices.len() as u32;
    let counts = |held_vertices, frozen_vertices, withheld_vertices| SkinnedCounts {
        instances: 1,
        held_vertices,
        frozen_vertices,
        withheld_vertices,
    };
    assert_eq!(grid.frame(5.4), counts(vertices, 0, 0));
    assert_eq!(grid.frame(6.2), counts(0, vertices, 0));
    assert_eq!(grid.frame(3.9), counts(0, 0, vertices));
}

#[test]
fn skinning_touches_skinned_vertices_only() {
    let (mut dice, mut words, mut bench) = (Dice(9), Words::default(), Bench::new());
    let model = Model::random(&mut dice, &mut words);
    let written = bench.motion.arena().push(0, bytemuck::cast_slice(&words.0));
    tell(bench.motion.skinned(), &model.clips, false, written);
    bench.motion.skinned().set_skeleton(SkeletonId(0), model.skeleton);
    let clip = Source::Clips(Schedule::new(playback(0, 0, 0)));
    bench.motion.skinned().set_instance(InstanceId(0), instance(0, clip)).unwrap();
    bench.enter(&[&model.vertices[..3]]);
    let vertex =
        |slot, motion| NewVertex { slot: VertexSlot(slot), instance: InstanceId(1), number: slot, motion };
    let still = geometry::Motion::Static { position: Vec3::new(1.0, 2.0, 3.0) };
    let sample = |step| PositionBatch {
        grid: GridIndex(step),
        positions: vec![(VertexSlot(4), Vec3::new(4.0, 5.0, 6.0))],
    };
    bench.motion.take(
        UpdateId(1),
        &[vertex(3, still), vertex(4, geometry::Motion::Sampled)],
        vec![sample(0), sample(1)],
        true,
    );
    let interpolate = crate::draw::stages::interpolate::Interpolate::new(&bench.gpu).unwrap();
    let group = interpolate.bind(&bench.vertices).unwrap();
    // Positions by skinning alone, and when interpolation has come after it.
    let frame = |bench: &mut Bench| {
        let (before, _) = bench.frame(WorldTime(0));
        let evaluation =
            crate::motion::pace::Evaluation { at: WorldTime(0), before: WorldTime(0), elapsed_ns: 0 };
        let vertex_count = bench.motion.state().vertex_count;
        let slots = Slots { vertex_count, vertex_slots: SLOTS, sample_ring: CAPACITY.sample_ring };
        let push = crate::draw::stages::interpolate::push(GRID, evaluation, slots, Default::default());
        let mut recorder = bench.gpu.record().unwrap();
        interpolate.record(&mut recorder, &group, &push);
        (before, bench.positions(recorder))
    };
    while !bench.motion.arena().is_empty() {
        bench.frame(WorldTime(0));
    }
    let (before, after) = frame(&mut bench);
    assert_eq!(before[..4], after[..4]);
    assert_eq!([after[3], after[4]], [[1.0, 2.0, 3.0, 1.0], [4.0, 5.0, 6.0, 1.0]]);
    assert_eq!(before[4], [0.0; 4], "skinning has not written it");
    // A slot that was skinned holds something else.
    bench.motion.take(
        UpdateId(2),
        &[vertex(0, still), vertex(1, geometry::Motion::Sampled)],
        Vec::new(),
        true,
    );
    let (_, after) = frame(&mut bench);
    assert_eq!([after[0], after[1]], [[1.0, 2.0, 3.0, 1.0], [0.0; 4]]);
    assert_eq!(after[2], before[2]);
    bench.assert_valid();
}

#[test]
fn what_is_written_last_to_the_same_words_is_there() {
    let mut bench = Bench::new();
    for value in 1..=3u8 {
        bench.motion.arena().push(4, &[value; 64]);
        bench.motion.arena().push(7, &[value + 10; 32]);
    }
    bench.frame(WorldTime(0));
    let readback = Buffer::new(&bench.gpu, "arena", 256, Memory::Readback).unwrap();
    let mut recorder = bench.gpu.record().unwrap();
    recorder.copy_buffer(&bench.memory.arena, 0, &readback, 0, 256);
    recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
    bench.gpu.wait(recorder.submit().unwrap()).unwrap();
    let word = |word: usize| readback.bytes()[word * 16..][..16].to_vec();
    assert_eq!([3, 4, 6, 7, 8, 9].map(word), [0, 3, 3, 13, 13, 0].map(|value| vec![value; 16]));
    bench.assert_valid();
}

#[test]
fn a_skinned_vertex_reads_fewer_bytes_a_frame_than_a_sampled_one() {
    let bench = Bench::new();
    let of_slot = |buffer: &Buffer| buffer.size() / u64::from(SLOTS);
    let clip = of_slot(&bench.vertices.skins) + size_of::<RestGpu>() as u64;
    let cubic = of_slot(&bench.vertices.samples) / u64::from(DEFAULT_SAMPLE_RING) * 4;
    let blend = of_slot(&bench.vertices.blends);
    let position = of_slot(&bench.vertices.positions);
    println!("clip: {clip} B read, palette beside, {position} B written");
    println!("samples: {cubic} B read, blends {blend} B read and written, {position} B read and written");
    println!("an instance: {} B", size_of::<PlacedPoseGpu>());
    assert_eq!([clip, cubic], [40, 64]);
}
