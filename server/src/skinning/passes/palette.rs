//! Bone palettes: every bone of every pose once.

use crate::scene::SceneGpu;
use shadecast_gpu::{Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Memory, Recorder};
use shadecast_shaders::constants::AFFINE_ROWS;
use shadecast_shaders::generated::{PALETTE_COMP, PalettePush, PoseGpu};
use std::ops::Range;
use std::sync::Arc;

/// Bytes of a bone's transform: rows of a `vec4`.
pub const BONE_BYTES: u64 = AFFINE_ROWS as u64 * 16;

/// The stage with its inputs and outputs.
pub(crate) struct Palette {
    pipeline: ComputePipeline,
    group: BindGroup,
    /// `PoseGpu`, written by whoever records, at most as many a sample time as there are instances.
    pub poses: Buffer,
    _globals: Buffer,
    /// Rows of `model_from_mesh`, three vec4 an entry.
    pub palettes: Buffer,
}

impl Palette {
    /// With room for `times` sample times at which no two instances share a pose.
    pub(crate) fn new(gpu: &Arc<Gpu>, scene: &SceneGpu, times: u32) -> Result<Self, GpuError> {
        let pipeline = ComputePipeline::new(gpu, &PALETTE_COMP)?;
        let bytes = |count: u32, size: u64| u64::from(times) * u64::from(count) * size;
        let poses_bytes = bytes(scene.numbering.instances.len() as u32, size_of::<PoseGpu>() as u64);
        let poses = Buffer::new(gpu, "poses", poses_bytes, Memory::Upload)?;
        let globals = Buffer::new(
            gpu,
            "bone transforms",
            bytes(scene.numbering.totals.bones, BONE_BYTES),
            Memory::Device,
        )?;
        let palettes =
            Buffer::new(gpu, "palettes", bytes(scene.numbering.totals.palette, BONE_BYTES), Memory::Device)?;
        let mut binds = scene.animation.binds();
        binds.extend([
            ("Poses", Bind::Buffer(&poses)),
            ("Levels", Bind::Buffer(&scene.animation.level_starts)),
            ("Globals", Bind::Buffer(&globals)),
            ("Palettes", Bind::Buffer(&palettes)),
        ]);
        let group = BindGroup::new(pipeline.layout(), &binds)?;
        Ok(Self { pipeline, group, poses, _globals: globals, palettes })
    }

    /// Evaluates a range of the poses.
    pub(crate) fn record(&self, recorder: &mut Recorder, poses: Range<u32>) {
        if !poses.is_empty() {
            let push = PalettePush { pose_base: poses.start };
            // A workgroup for each pose.
            let invocations = poses.len() as u32 * self.pipeline.workgroup()[0];
            recorder.dispatch(&self.pipeline, &self.group, &push, [invocations, 1, 1]);
        }
    }
}
