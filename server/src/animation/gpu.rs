//! The animation manager: samples of the whole scene on the time grid, each computed once on the GPU and kept in a
//! ring of slots, shared by all updates that cover its time.

use crate::scene_gpu::{InstanceGpu, SceneGpu};
use crate::stages::palette::Palette;
use crate::stages::skin::Skin;
use shadecast_gpu::{Access, Gpu, GpuError, Recorder};
use shadecast_protocol::time::ServerTime;
use std::sync::Arc;

/// Palettes and saved vertices of a ring of sample times.
pub struct Animation {
    scene: Arc<SceneGpu>,
    palette: Palette,
    skin: Skin,
    statics_done: bool,
}

impl Animation {
    /// With room for `slots` sample times.
    pub fn new(gpu: &Arc<Gpu>, scene: &Arc<SceneGpu>, slots: u32) -> Result<Self, GpuError> {
        let palette = Palette::new(gpu, scene, slots)?;
        let skin = Skin::new(gpu, scene, &palette.palettes, slots)?;
        Ok(Self { scene: scene.clone(), palette, skin, statics_done: false })
    }

    /// Poses and skins the animated instances at `time` into `slot`; the static ones with the first call.
    pub fn record_sample(&mut self, recorder: &mut Recorder, slot: u32, time: ServerTime) {
        // The slot's palettes and vertices, and the shared bone transforms, may still be read by the last sample.
        recorder.barrier(Access::COMPUTE, Access::COMPUTE);
        recorder.scope("palette", |r| self.palette.record(r, &self.scene, slot, time.seconds()));
        recorder.barrier(Access::COMPUTE_WRITE, Access::COMPUTE_READ);
        let base = self.palette.slot_base(slot);
        recorder.scope("skin", |r| {
            self.skin.record_positions(r, &self.scene, base, slot, true);
            if !self.statics_done {
                self.skin.record_positions(r, &self.scene, base, slot, false);
                self.skin.record_frames(r, &self.scene, base, false);
            }
        });
        self.statics_done = true;
    }

    /// Skins normals and tangents of the animated instances as they are in `slot`.
    pub fn record_frames(&self, recorder: &mut Recorder, slot: u32) {
        let base = self.palette.slot_base(slot);
        recorder.scope("skin frames", |r| self.skin.record_frames(r, &self.scene, base, true));
    }

    /// First saved vertex of an instance at a slot's time.
    pub fn position_base(&self, instance: &InstanceGpu, slot: u32) -> u32 {
        self.skin.position_base(instance, slot)
    }

    /// First saved frame of an instance.
    pub fn frame_base(&self, instance: &InstanceGpu) -> u32 {
        self.skin.frame_base(instance)
    }

    /// World positions, vec4: static instances first, then one run of the animated ones per slot.
    pub fn saved_vertices(&self) -> &shadecast_gpu::Buffer {
        &self.skin.saved_vertices
    }

    /// Normals and tangents, static instances first.
    pub fn saved_frames(&self) -> &shadecast_gpu::Buffer {
        &self.skin.saved_frames
    }
}
