//! Skinning: each vertex once per sample time into `saved_vertices`, each frame once per update into `saved_frames`.
//! Three ways, to be measured side by side.

use crate::scene_gpu::{InstanceGpu, SceneGpu};
use crate::stages::palette::Palette;
use shadecast_gpu::{Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Memory, Recorder};
use shadecast_shaders::Shader;
use shadecast_shaders::generated::{
    FrameGpu, SKIN_CHAIN_COMP, SKIN_COMP, SKIN_PACKED_COMP, SkinJobGpu, SkinPush,
};
use std::sync::Arc;

/// Vertices in a workgroup.
pub const GROUP: u32 = 64;
/// More workgroups than this go into rows of so many: 65,535 in one dimension is all that Vulkan promises.
const GROUPS_IN_ROW: u32 = 32_768;

/// How vertices get their matrices.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Skinning {
    /// The paper's: each vertex walks the whole parent chain of each of its bones
    PerVertexChain,
    /// Each bone once into a palette, then each vertex once
    #[default]
    Palette,
    /// As palette, positions from a compact stream sorted by the number of influences
    Packed,
}

/// The stage with its outputs: static instances first, then one run of the animated ones per slot.
pub struct Skin {
    positions: Variant,
    frames: Variant,
    /// World positions, vec4.
    pub saved_vertices: Buffer,
    /// Normals and tangents at shading time, static ones first.
    pub saved_frames: Buffer,
    static_vertices: u32,
    animated_vertices: u32,
}

struct Variant {
    pipeline: ComputePipeline,
    group: BindGroup,
    jobs: JobRing,
}

/// Jobs of recordings that may not have been submitted yet, one after the other, then over the oldest.
struct JobRing {
    buffer: Buffer,
    capacity: usize,
    next: usize,
}

impl JobRing {
    fn new(gpu: &Arc<Gpu>, capacity: usize) -> Result<Self, GpuError> {
        let bytes = (capacity * size_of::<SkinJobGpu>()) as u64;
        Ok(Self { buffer: Buffer::new(gpu, "skinning jobs", bytes, Memory::Upload)?, capacity, next: 0 })
    }

    /// Writes the jobs and returns the number of the first.
    fn push(&mut self, jobs: &[SkinJobGpu]) -> u32 {
        assert!(jobs.len() <= self.capacity, "{} jobs at once, room for {}", jobs.len(), self.capacity);
        if self.next + jobs.len() > self.capacity {
            self.next = 0;
        }
        let first = self.next;
        self.buffer.write(first * size_of::<SkinJobGpu>(), bytemuck::cast_slice(jobs));
        self.next += jobs.len();
        first as u32
    }
}

impl Skin {
    /// With room for `slots` sample times. `morph_weights` holds those of each pose.
    ///
    /// # Errors
    /// More skinned vertices than the device can bind as one buffer.
    pub fn new(
        gpu: &Arc<Gpu>,
        scene: &SceneGpu,
        palette: &Palette,
        morph_weights: &Buffer,
        slots: u32,
    ) -> Result<Self, GpuError> {
        let totals = scene.totals;
        let positions =
            u64::from(totals.static_vertices) + u64::from(slots) * u64::from(totals.animated_vertices);
        let frames_bytes = u64::from(totals.vertices) * size_of::<FrameGpu>() as u64;
        scene.check_room(gpu, "skinned vertices of all instances and sample times", positions * 16)?;
        scene.check_room(gpu, "normals and tangents of all instances", frames_bytes)?;
        let saved_vertices = Buffer::new(gpu, "saved vertices", positions * 16, Memory::Device)?;
        let saved_frames = Buffer::new(gpu, "saved frames", frames_bytes, Memory::Device)?;
        // Every slot may be filled, and the static instances once, before anything is submitted.
        let capacity = (slots as usize + 2) * scene.instances.len().max(1);
        let variant = |shader: &'static Shader| {
            let jobs = JobRing::new(gpu, capacity)?;
            let pipeline = ComputePipeline::new(gpu, shader)?;
            let mut binds = scene.animation.binds();
            binds.extend([
                ("Vertices", Bind::Buffer(&scene.vertices)),
                ("PackedVertices", Bind::Buffer(&scene.packed_vertices)),
                ("Jobs", Bind::Buffer(&jobs.buffer)),
                ("MorphDeltas", Bind::Buffer(&scene.morph_deltas)),
                ("MorphWeights", Bind::Buffer(morph_weights)),
                ("SavedVertices", Bind::Buffer(&saved_vertices)),
                ("SavedFrames", Bind::Buffer(&saved_frames)),
                ("Palettes", Bind::Buffer(&palette.palettes)),
                ("Poses", Bind::Buffer(&palette.poses)),
            ]);
            let group = BindGroup::of(pipeline.layout(), &binds)?;
            Ok::<_, GpuError>(Variant { pipeline, group, jobs })
        };
        let (positions, frames) = match scene.skinning {
            Skinning::PerVertexChain => (&SKIN_CHAIN_COMP, &SKIN_CHAIN_COMP),
            Skinning::Palette => (&SKIN_COMP, &SKIN_COMP),
            Skinning::Packed => (&SKIN_PACKED_COMP, &SKIN_COMP),
        };
        Ok(Self {
            positions: variant(positions)?,
            frames: variant(frames)?,
            saved_vertices,
            saved_frames,
            static_vertices: totals.static_vertices,
            animated_vertices: totals.animated_vertices,
        })
    }

    /// First saved vertex of an instance at a slot's time.
    pub fn position_base(&self, instance: &InstanceGpu, slot: u32) -> u32 {
        match instance.is_animated {
            true => self.static_vertices + slot * self.animated_vertices + instance.saved_base,
            false => instance.saved_base,
        }
    }

    /// First saved frame of an instance.
    pub fn frame_base(&self, instance: &InstanceGpu) -> u32 {
        if instance.is_animated { self.static_vertices + instance.saved_base } else { instance.saved_base }
    }

    /// Skins the positions of `jobs` (whose `first_group` it fills in). At most as
    /// many sample times as there are slots are recorded before the GPU has done them.
    pub fn record_positions(&mut self, recorder: &mut Recorder, scene: &SceneGpu, jobs: &mut [SkinJobGpu]) {
        let packed = scene.skinning == Skinning::Packed;
        let groups = |job: &SkinJobGpu| match packed {
            true => job.packed_ends[3] / GROUP,
            false => job.vertex_count.div_ceil(GROUP),
        };
        dispatch(recorder, &mut self.positions, jobs, groups, false);
    }

    /// Skins the normals and tangents of `jobs` likewise.
    pub fn record_frames(&mut self, recorder: &mut Recorder, jobs: &mut [SkinJobGpu]) {
        let groups = |job: &SkinJobGpu| job.vertex_count.div_ceil(GROUP);
        dispatch(recorder, &mut self.frames, jobs, groups, true);
    }
}

/// All jobs at once; each workgroup finds its job by the number of groups before it.
fn dispatch(
    recorder: &mut Recorder,
    variant: &mut Variant,
    jobs: &mut [SkinJobGpu],
    groups_of: impl Fn(&SkinJobGpu) -> u32,
    frames: bool,
) {
    let mut groups = 0;
    for job in jobs.iter_mut() {
        job.first_group = groups;
        groups += groups_of(job);
    }
    if groups == 0 {
        return;
    }
    let job_base = variant.jobs.push(jobs);
    let push = SkinPush { job_base, job_count: jobs.len() as u32, writes_frames: u32::from(frames) };
    let row = groups.min(GROUPS_IN_ROW);
    recorder.dispatch(&variant.pipeline, &variant.group, &push, [row, groups.div_ceil(row), 1]);
}
