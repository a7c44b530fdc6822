//! What moves may turn into view, or uncover, until the next update: rings of patches around those that the predicted views show.

use crate::scene::SceneGpu;
use crate::visibility::lod_set::LodInstance;
use shadecast_gpu::{Access, Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Memory, Recorder};
use shadecast_shaders::generated::{SPREAD_COMP, SpreadPush};
use std::sync::Arc;

/// The stage.
pub struct Spread {
    /// From patches to their vertices, and back.
    pipelines: [ComputePipeline; 2],
    group: BindGroup,
    /// A bit for each vertex of the scene.
    reached: Buffer,
}

impl Spread {
    /// Adds to `visible`, a word for each patch of the LOD set.
    pub fn new(gpu: &Arc<Gpu>, scene: &SceneGpu, visible: &Buffer) -> Result<Self, GpuError> {
        let pipeline = |to_patches: u32| ComputePipeline::specialised(gpu, &SPREAD_COMP, &[to_patches]);
        let pipelines = [pipeline(0)?, pipeline(1)?];
        let bytes = u64::from(scene.numbering.totals.vertices.div_ceil(32)) * 4;
        let reached = Buffer::new(gpu, "vertices near visible patches", bytes, Memory::Device)?;
        let group = BindGroup::new(
            pipelines[0].layout(),
            &[
                ("Patches", Bind::Buffer(&scene.meshes.patches)),
                ("Visible", Bind::Buffer(visible)),
                ("Reached", Bind::Buffer(&reached)),
            ],
        )?;
        Ok(Self { pipelines, group, reached })
    }

    /// Adds to each of these LODs so many rings around its visible patches. Needs barriers before and after it.
    pub fn record(&self, recorder: &mut Recorder, scene: &SceneGpu, rings: &[(LodInstance, u32)]) {
        recorder.fill(&self.reached, 0);
        recorder.barrier(Access::COPY_WRITE, Access::COMPUTE);
        let most = rings.iter().map(|(_, rings)| *rings).max().unwrap_or(0);
        for (ring, pipeline) in (0..most).flat_map(|ring| self.pipelines.iter().map(move |way| (ring, way))) {
            for (lod, _) in rings.iter().filter(|(_, rings)| ring < *rings) {
                let instance = &scene.numbering.instances[lod.instance];
                let push = SpreadPush {
                    patch_base: scene.models[instance.model].lods[lod.lod].patch_base,
                    first_entry: lod.first_entry,
                    patch_count: lod.patches.count,
                    first_vertex: instance.first_vertex.0,
                };
                recorder.dispatch(pipeline, &self.group, &push, [lod.patches.count, 1, 1]);
            }
            recorder.barrier(Access::COMPUTE, Access::COMPUTE);
        }
    }
}
