//! What every stage that rasterises the scene shares: a pipeline for each kind of material, and the walk over instances and
//! primitives.

use crate::scene::meshes::MeshLod;
use crate::scene::{ModelGpu, SceneGpu};
use ash::vk;
use shadecast_gpu::{
    BindGroup, Gpu, GpuError, GraphicsPipeline, GraphicsPipelineDesc, Layout, Recorder, RenderPass,
};
use shadecast_scene::{Material, Primitive};
use shadecast_shaders::Shader;
use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::Arc;

/// The LOD that shadows and the truth are drawn at.
pub(crate) const FULL_DETAIL: usize = 0;

/// What a pipeline differs in from another of the same pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Kind {
    /// Both sides are drawn.
    is_double_sided: bool,
    /// Its materials may have holes: fragments are tested.
    is_masked: bool,
}

impl Kind {
    fn of(material: &Material) -> Self {
        Self { is_double_sided: material.double_sided, is_masked: material.alpha_cutoff.is_some() }
    }
}

/// The pipelines of a pass that draws the scene with depth test.
pub(crate) struct Geometry {
    /// One for each kind of material that the scene has; one at least.
    pipelines: Vec<(Kind, GraphicsPipeline)>,
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
        let pipeline = |kind: Kind| {
            let desc = GraphicsPipelineDesc {
                cull: if kind.is_double_sided { vk::CullModeFlags::NONE } else { vk::CullModeFlags::BACK },
                depth_write: Some(true),
                textures: scene.materials.texture_count(),
                constants: &[u32::from(kind.is_masked)],
                ..GraphicsPipelineDesc::new(vertex, fragment, pass)
            };
            Ok((kind, GraphicsPipeline::new(gpu, &desc)?))
        };
        let materials = scene.scene.models.iter().flat_map(|model| &model.materials);
        let simplest = Kind { is_double_sided: false, is_masked: false };
        let kinds = BTreeSet::from_iter(materials.map(Kind::of).chain([simplest]));
        Ok(Self {
            pipelines: kinds.into_iter().map(pipeline).collect::<Result<_, GpuError>>()?,
            pulls_indices: vertex.bindings.iter().any(|binding| binding.name == "Indices"),
        })
    }

    /// Layout of all, for bind groups.
    pub(crate) fn layout(&self) -> &Arc<Layout> {
        self.pipelines[0].1.layout()
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
        for (kind, pipeline) in &self.pipelines {
            recorder.bind(pipeline, group);
            for (number, instance) in scene.numbering.instances.iter().enumerate() {
                let Some(lod_index) = lod_of(number) else { continue };
                let (model, source) = (&scene.models[instance.model], &scene.scene.models[instance.model]);
                let is_so = |p: &&Primitive| Kind::of(&source.materials[p.material as usize]) == *kind;
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
