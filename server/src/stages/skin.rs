//! Skinning: each vertex once per sample time into `saved_vertices`, each frame once per update into `saved_frames`.

use crate::scene_gpu::{InstanceGpu, SceneGpu};
use shadecast_gpu::{Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Memory, Recorder};
use shadecast_shaders::generated::{FrameGpu, SKIN_COMP, SkinPush};
use std::sync::Arc;

/// The stage with its outputs: static instances first, then one run of the animated ones per slot.
pub struct Skin {
    pipeline: ComputePipeline,
    group: BindGroup,
    /// World positions, vec4.
    pub saved_vertices: Buffer,
    /// Normals and tangents at shading time, static ones first.
    pub saved_frames: Buffer,
    static_vertices: u32,
    animated_vertices: u32,
}

impl Skin {
    /// With room for `slots` sample times.
    pub fn new(gpu: &Arc<Gpu>, scene: &SceneGpu, palettes: &Buffer, slots: u32) -> Result<Self, GpuError> {
        let pipeline = ComputePipeline::new(gpu, &SKIN_COMP)?;
        let totals = scene.totals;
        let positions =
            u64::from(totals.static_vertices) + u64::from(slots) * u64::from(totals.animated_vertices);
        let saved_vertices = Buffer::new(gpu, "saved vertices", positions * 16, Memory::Device)?;
        let frames_bytes = u64::from(totals.vertices) * size_of::<FrameGpu>() as u64;
        let saved_frames = Buffer::new(gpu, "saved frames", frames_bytes, Memory::Device)?;
        let group = BindGroup::new(
            pipeline.layout(),
            &[
                ("Vertices", Bind::Buffer(&scene.vertices)),
                ("Palettes", Bind::Buffer(palettes)),
                ("SavedVertices", Bind::Buffer(&saved_vertices)),
                ("SavedFrames", Bind::Buffer(&saved_frames)),
            ],
        )?;
        let (static_vertices, animated_vertices) = (totals.static_vertices, totals.animated_vertices);
        Ok(Self { pipeline, group, saved_vertices, saved_frames, static_vertices, animated_vertices })
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

    /// Skins the positions of the static or the animated instances with the palettes of `slot`.
    pub fn record_positions(
        &self,
        recorder: &mut Recorder,
        scene: &SceneGpu,
        palette_base: u32,
        slot: u32,
        animated: bool,
    ) {
        for instance in scene.instances.iter().filter(|i| i.is_animated == animated) {
            let output_base = self.position_base(instance, slot);
            self.record_one(recorder, scene, instance, [palette_base, output_base, 0]);
        }
    }

    /// Skins normals and tangents of the static or the animated instances with the palettes of a slot.
    pub fn record_frames(
        &self,
        recorder: &mut Recorder,
        scene: &SceneGpu,
        palette_base: u32,
        animated: bool,
    ) {
        for instance in scene.instances.iter().filter(|i| i.is_animated == animated) {
            let output_base = self.frame_base(instance);
            self.record_one(recorder, scene, instance, [palette_base, output_base, 1]);
        }
    }

    fn record_one(
        &self,
        recorder: &mut Recorder,
        scene: &SceneGpu,
        instance: &InstanceGpu,
        [palette_base, output_base, writes_frames]: [u32; 3],
    ) {
        let model = &scene.models[instance.model];
        let push = SkinPush {
            vertex_base: model.vertex_base,
            vertex_count: model.vertex_count,
            palette_base: palette_base + instance.palette_base,
            output_base,
            writes_frames,
        };
        recorder.dispatch(&self.pipeline, &self.group, &push, [model.vertex_count.div_ceil(64), 1, 1]);
    }
}
