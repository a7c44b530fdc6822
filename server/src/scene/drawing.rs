//! What every stage that rasterises the scene shares: a pipeline for each kind of side, and the walk over instances and
//! primitives.

use crate::scene::meshes::MeshLod;
use crate::scene::{ModelGpu, SceneGpu};
use ash::vk;
use shadecast_gpu::{
    BindGroup, Gpu, GpuError, GraphicsPipeline, GraphicsPipelineDesc, Layout, Recorder, RenderPass,
};
use shadecast_scene::Primitive;
use shadecast_shaders::Shader;
use std::ops::Range;
use std::sync::Arc;

/// The LOD that shadows and the truth are drawn at.
pub(crate) const FULL_DETAIL: usize = 0;

/// The pipelines of a pass that draws the scene with depth test.
pub(crate) struct Geometry {
    culled: GraphicsPipeline,
    double_sided: GraphicsPipeline,
    /// Whether the vertex shader reads the indices by itself.
    pulls_indices: bool,
}

/// One draw: a primitive of an instance.
pub(crate) struct Draw<'a> {
    /// Number of the instance in the scene.
    pub(crate) number: usize,
    /// Its model.
    pub(crate) model: &'a ModelGpu,
    /// The LOD of its mesh.
    pub(crate) lod: &'a MeshLod,
    /// The primitive, in the LOD's own numbers.
    pub(crate) primitive: &'a Primitive,
    /// Its first index that is drawn, in the LOD's own numbers.
    pub(crate) first_index: u32,
}

impl Geometry {
    /// Pipelines of two shaders in `pass`, with places for the scene's textures.
    pub(crate) fn new(
        gpu: &Arc<Gpu>,
        scene: &SceneGpu,
        vertex: &Shader,
        fragment: &Shader,
        pass: &RenderPass,
    ) -> Result<Self, GpuError> {
        let pipeline = |cull| {
            let desc = GraphicsPipelineDesc {
                cull,
                depth_write: Some(true),
                textures: scene.materials.texture_count(),
                ..GraphicsPipelineDesc::new(vertex, fragment, pass)
            };
            GraphicsPipeline::new(gpu, &desc)
        };
        Ok(Self {
            culled: pipeline(vk::CullModeFlags::BACK)?,
            double_sided: pipeline(vk::CullModeFlags::NONE)?,
            pulls_indices: vertex.bindings.iter().any(|binding| binding.name == "Indices"),
        })
    }

    /// Layout of both, for bind groups.
    pub(crate) fn layout(&self) -> &Arc<Layout> {
        self.culled.layout()
    }

    /// Draws every instance at the LOD that `lod_of` gives for its number, if any.
    pub(crate) fn record<P: bytemuck::Pod>(
        &self,
        recorder: &mut Recorder,
        group: &BindGroup,
        scene: &SceneGpu,
        lod_of: impl Fn(usize) -> Option<usize>,
        push: impl Fn(&Draw<'_>) -> P,
    ) {
        let all = |_, primitive: &Primitive| {
            std::iter::once(primitive.first_index..primitive.first_index + primitive.index_count)
        };
        self.record_runs(recorder, (group, scene), lod_of, all, push);
    }

    /// The same, of each primitive of an instance and LOD only some runs of indices.
    pub(crate) fn record_runs<P: bytemuck::Pod, R: Iterator<Item = Range<u32>>>(
        &self,
        recorder: &mut Recorder,
        (group, scene): (&BindGroup, &SceneGpu),
        lod_of: impl Fn(usize) -> Option<usize>,
        runs: impl Fn([usize; 2], &Primitive) -> R,
        push: impl Fn(&Draw<'_>) -> P,
    ) {
        recorder.bind_indices(&scene.meshes.indices, 0);
        for (pipeline, double_sided) in [(&self.culled, false), (&self.double_sided, true)] {
            recorder.bind(pipeline, group);
            for (number, instance) in scene.numbering.instances.iter().enumerate() {
                let Some(lod_index) = lod_of(number) else { continue };
                let (model, source) = (&scene.models[instance.model], &scene.scene.models[instance.model]);
                let is_so =
                    |p: &&Primitive| source.materials[p.material as usize].double_sided == double_sided;
                let lod = &model.lods[lod_index];
                for primitive in lod.primitives.iter().filter(is_so) {
                    for run in runs([number, lod_index], primitive) {
                        let (first_index, count) = (run.start, run.end - run.start);
                        let draw = Draw { number, model, lod, primitive, first_index };
                        recorder.push_constants(pipeline, &push(&draw));
                        match self.pulls_indices {
                            true => recorder.draw(count, 1),
                            false => recorder.draw_indexed(lod.index_base + first_index, count),
                        }
                    }
                }
            }
        }
    }
}
