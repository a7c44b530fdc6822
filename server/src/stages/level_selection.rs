//! Level selection's first half: the largest projected extent of every visible patch.

use crate::animation::gpu::Animation;
use crate::predict::VIEW_TIMES;
use crate::scene_gpu::SceneGpu;
use shadecast_gpu::{Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Memory, Recorder};
use shadecast_protocol::limits::MAX_VIEWS;
use shadecast_shaders::generated::{LEVEL_SELECTION_COMP, LevelSelectionPush};
use std::sync::Arc;

/// The stage with its output.
pub struct LevelSelection {
    pipeline: ComputePipeline,
    group: BindGroup,
    /// One word per scene-wide patch: width | height << 16 in texels, 0 where it is not visible.
    pub extents: Buffer,
}

impl LevelSelection {
    /// `views` is the uniform buffer of all predicted views, `visible` the marks.
    pub fn new(
        gpu: &Arc<Gpu>,
        scene: &SceneGpu,
        animation: &Animation,
        views: &Buffer,
        visible: &Buffer,
    ) -> Result<Self, GpuError> {
        let pipeline = ComputePipeline::new(gpu, &LEVEL_SELECTION_COMP)?;
        let extents = Buffer::new(gpu, "patch extents", u64::from(scene.totals.patches) * 4, Memory::Device)?;
        let group = BindGroup::new(
            pipeline.layout(),
            &[
                ("Vertices", Bind::Buffer(&scene.vertices)),
                ("SavedVertices", Bind::Buffer(animation.saved_vertices())),
                ("Views", Bind::Buffer(views)),
                ("Patches", Bind::Buffer(&scene.patches)),
                ("Materials", Bind::Buffer(&scene.materials)),
                ("Visible", Bind::Buffer(visible)),
                ("Extents", Bind::Buffer(&extents)),
            ],
        )?;
        Ok(Self { pipeline, group, extents })
    }

    /// Measures every visible patch with geometry as it is in each view time's slot.
    pub fn record(
        &self,
        recorder: &mut Recorder,
        scene: &SceneGpu,
        animation: &Animation,
        slots: [u32; VIEW_TIMES],
    ) {
        for instance in &scene.instances {
            let model = &scene.models[instance.model];
            let patch_count = model.patches.len() as u32;
            let push = LevelSelectionPush {
                vertex_base: model.vertex_base,
                patch_base: model.patch_base,
                scene_patch_base: instance.first_patch,
                patch_count,
                view_count: MAX_VIEWS,
                position_base: slots.map(|slot| animation.position_base(instance, slot)),
                material_base: model.material_base,
            };
            recorder.dispatch(&self.pipeline, &self.group, &push, [patch_count, 1, 1]);
        }
    }
}
