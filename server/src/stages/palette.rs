//! Bone palettes: every bone of every instance once per sample time.

use crate::scene_gpu::SceneGpu;
use shadecast_gpu::{Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Memory, Recorder};
use shadecast_shaders::generated::{PALETTE_COMP, PalettePush, PoseGpu};
use std::sync::Arc;

/// The stage with its outputs.
pub struct Palette {
    pipeline: ComputePipeline,
    group: BindGroup,
    /// One run of poses per slot, written just before the slot's dispatch.
    poses: Buffer,
    _globals: Buffer,
    /// Rows of `world_from_mesh`, three vec4 per entry, one run of entries per slot.
    pub palettes: Buffer,
    instances: u32,
    entries: u32,
}

impl Palette {
    /// With room for `slots` sample times.
    pub fn new(gpu: &Arc<Gpu>, scene: &SceneGpu, slots: u32) -> Result<Self, GpuError> {
        let pipeline = ComputePipeline::new(gpu, &PALETTE_COMP)?;
        let (instances, totals) = (scene.instances.len() as u32, scene.totals);
        let poses_bytes = u64::from(slots * instances) * size_of::<PoseGpu>() as u64;
        let poses = Buffer::new(gpu, "poses", poses_bytes, Memory::Upload)?;
        let globals = Buffer::new(gpu, "bone transforms", u64::from(totals.bones) * 48, Memory::Device)?;
        let palettes_bytes = u64::from(slots) * u64::from(totals.palette) * 48;
        let palettes = Buffer::new(gpu, "palettes", palettes_bytes, Memory::Device)?;
        let group = BindGroup::new(
            pipeline.layout(),
            &[
                ("Poses", Bind::Buffer(&poses)),
                ("Parents", Bind::Buffer(&scene.parents)),
                ("Levels", Bind::Buffer(&scene.levels)),
                ("Keys", Bind::Buffer(&scene.keys)),
                ("Entries", Bind::Buffer(&scene.entries)),
                ("Globals", Bind::Buffer(&globals)),
                ("Palettes", Bind::Buffer(&palettes)),
            ],
        )?;
        Ok(Self { pipeline, group, poses, _globals: globals, palettes, instances, entries: totals.palette })
    }

    /// Evaluates all instances at `time_s` into `slot`. No submitted work still reads the slot's poses.
    pub fn record(&mut self, recorder: &mut Recorder, scene: &SceneGpu, slot: u32, time_s: f64) {
        let first = (slot * self.instances) as usize * size_of::<PoseGpu>();
        for index in 0..self.instances as usize {
            let pose = scene.pose(index, time_s);
            self.poses.write(first + index * size_of::<PoseGpu>(), bytemuck::bytes_of(&pose));
        }
        let push = PalettePush { pose_base: slot * self.instances, palette_slot_base: slot * self.entries };
        recorder.dispatch(&self.pipeline, &self.group, &push, [self.instances, 1, 1]);
    }

    /// First palette entry of a slot.
    pub fn slot_base(&self, slot: u32) -> u32 {
        slot * self.entries
    }
}
