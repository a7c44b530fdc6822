//! Level selection's first half: the largest projected extent of every visible patch.

use crate::animation::RingPlace;
use crate::animation::gpu::Animation;
use crate::looks::Looks;
use crate::predict::VIEW_TIMES;
use crate::scene::SceneGpu;
use shadecast_gpu::{Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Memory, Recorder};
use shadecast_protocol::limits::MAX_VIEWS;
use shadecast_shaders::generated::{LEVEL_SELECTION_COMP, LevelSelectionPush};
use std::sync::Arc;

/// The stage with its output.
pub struct LevelSelection {
    pipeline: ComputePipeline,
    group: BindGroup,
    /// One word per entry: width | height << 16 in texels, 0 where it is not visible.
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
        let extents = Buffer::new(
            gpu,
            "patch extents",
            u64::from(scene.numbering.totals.looked_at) * 4,
            Memory::Device,
        )?;
        let [saved_vertices, boxes] = animation.position_binds();
        let group = BindGroup::new(
            pipeline.layout(),
            &[
                saved_vertices,
                boxes,
                ("Vertices", Bind::Buffer(&scene.meshes.vertices)),
                ("Views", Bind::Buffer(views)),
                ("Patches", Bind::Buffer(&scene.meshes.patches)),
                ("Materials", Bind::Buffer(&scene.materials.buffer)),
                ("Visible", Bind::Buffer(visible)),
                ("Extents", Bind::Buffer(&extents)),
            ],
        )?;
        Ok(Self { pipeline, group, extents })
    }

    /// Measures the visible patches of what is looked at, with geometry as it is at the place of each view time.
    pub fn record(
        &self,
        recorder: &mut Recorder,
        scene: &SceneGpu,
        animation: &Animation,
        looks: &Looks,
        places: [RingPlace; VIEW_TIMES],
    ) {
        for look in looks.all() {
            let instance = &scene.numbering.instances[look.instance];
            let model = &scene.models[instance.model];
            let patch_count = look.patches.count;
            let bases = places.map(|place| animation.position_base(look.instance, place));
            // What is not there at a time is not seen then; what is never there is only told so.
            let any = bases.iter().flatten().next().copied().unwrap_or_default();
            let push = LevelSelectionPush {
                vertex_base: model.vertex_base,
                patch_base: model.levels[look.level].patch_base,
                first_entry: look.first_entry,
                patch_count,
                view_count: MAX_VIEWS,
                position_base: bases.map(|base| base.unwrap_or(any)),
                material_base: model.material_base,
                instance: look.instance as u32,
            };
            recorder.dispatch(&self.pipeline, &self.group, &push, [patch_count, 1, 1]);
        }
    }
}
