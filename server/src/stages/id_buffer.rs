//! Visibility's first half: which patch each pixel of the predicted views shows.

use crate::animation::gpu::Animation;
use crate::scene_gpu::SceneGpu;
use ash::vk;
use shadecast_gpu::{
    Attachment, Bind, BindGroup, Buffer, Framebuffer, Gpu, GpuError, GraphicsPipeline, GraphicsPipelineDesc,
    Image, ImageDesc, Recorder, RenderPass, RenderPassDesc,
};
use shadecast_shaders::generated::{ID_BUFFER_FRAG, ID_BUFFER_VERT, IdBufferPush};
use std::sync::Arc;

/// The stage with its output; both eyes of one time at once.
pub struct IdBuffer {
    pass: RenderPass,
    culled: GraphicsPipeline,
    double_sided: GraphicsPipeline,
    group: BindGroup,
    target: Framebuffer,
    /// R32_UINT, two layers: scene-wide patch number + 1, 0 for background.
    pub image: Image,
    _depth: Image,
}

impl IdBuffer {
    /// For views of `extent` pixels. `views` is the uniform buffer of all predicted views.
    pub fn new(
        gpu: &Arc<Gpu>,
        scene: &SceneGpu,
        animation: &Animation,
        views: &Buffer,
        extent: [u32; 2],
    ) -> Result<Self, GpuError> {
        let (image, depth) = (id_image(gpu, extent)?, depth_image(gpu, extent, 2)?);
        let pass = RenderPass::new(
            gpu,
            &RenderPassDesc {
                colors: vec![Attachment {
                    format: vk::Format::R32_UINT,
                    load: vk::AttachmentLoadOp::CLEAR,
                    store: vk::AttachmentStoreOp::STORE,
                    before: vk::ImageLayout::UNDEFINED,
                    after: vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL,
                }],
                resolves: vec![],
                depth: Some(vk::Format::D32_SFLOAT),
                samples: vk::SampleCountFlags::TYPE_1,
                view_mask: 0b11,
            },
        )?;
        let pipeline = |cull| {
            GraphicsPipeline::new(
                gpu,
                &GraphicsPipelineDesc {
                    vertex: &ID_BUFFER_VERT,
                    fragment: &ID_BUFFER_FRAG,
                    pass: &pass,
                    topology: vk::PrimitiveTopology::TRIANGLE_LIST,
                    cull,
                    depth_write: Some(true),
                    blend: false,
                    vertex_input: None,
                },
            )
        };
        let (culled, double_sided) = (pipeline(vk::CullModeFlags::BACK)?, pipeline(vk::CullModeFlags::NONE)?);
        let textures = scene.texture_binds();
        let group = BindGroup::new(
            culled.layout(),
            &[
                ("Vertices", Bind::Buffer(&scene.vertices)),
                ("SavedVertices", Bind::Buffer(animation.saved_vertices())),
                ("Views", Bind::Buffer(views)),
                ("PatchOfTriangle", Bind::Buffer(&scene.patch_of_triangle)),
                ("Materials", Bind::Buffer(&scene.materials)),
                SceneGpu::textures_bind(&textures),
            ],
        )?;
        let target = Framebuffer::new(gpu, &pass, extent, &[image.view(), depth.view()])?;
        Ok(Self { pass, culled, double_sided, group, target, image, _depth: depth })
    }

    /// Draws the scene as it is in `slot` into the two views from `first_view` on.
    pub fn record(
        &self,
        recorder: &mut Recorder,
        scene: &SceneGpu,
        animation: &Animation,
        slot: u32,
        first_view: u32,
    ) {
        let clears = [vk::ClearValue::default(), vk::ClearValue::default()]; // no patch; far, which is 0
        recorder.begin_pass(&self.pass, &self.target, &clears);
        recorder.bind_indices(&scene.indices, 0);
        for double_sided in [false, true] {
            let pipeline = if double_sided { &self.double_sided } else { &self.culled };
            recorder.bind(pipeline, &self.group);
            for instance in &scene.instances {
                let (model, source) = (&scene.models[instance.model], &scene.scene.models[instance.model]);
                let sided = |p: &&crate::scene::Primitive| {
                    source.materials[p.material as usize].double_sided == double_sided
                };
                for primitive in source.primitives.iter().filter(sided) {
                    let push = IdBufferPush {
                        vertex_base: model.vertex_base,
                        position_base: animation.position_base(instance, slot),
                        triangle_base: (model.index_base + primitive.first_index) / 3,
                        patch_base: instance.first_patch,
                        material: model.material_base + primitive.material,
                        first_view,
                    };
                    recorder.push_constants(pipeline, &push);
                    recorder.draw_indexed(model.index_base + primitive.first_index, primitive.index_count);
                }
            }
        }
        recorder.end_pass();
    }
}

fn id_image(gpu: &Arc<Gpu>, extent: [u32; 2]) -> Result<Image, GpuError> {
    Image::new(
        gpu,
        ImageDesc {
            name: "ID buffer",
            extent,
            layers: 2,
            mips: 1,
            samples: vk::SampleCountFlags::TYPE_1,
            format: vk::Format::R32_UINT,
            usage: vk::ImageUsageFlags::COLOR_ATTACHMENT
                | vk::ImageUsageFlags::SAMPLED
                | vk::ImageUsageFlags::TRANSFER_SRC,
        },
    )
}

/// A depth buffer that no pass stores.
pub(crate) fn depth_image(gpu: &Arc<Gpu>, extent: [u32; 2], layers: u32) -> Result<Image, GpuError> {
    Image::new(
        gpu,
        ImageDesc {
            name: "depth",
            extent,
            layers,
            mips: 1,
            samples: vk::SampleCountFlags::TYPE_1,
            format: vk::Format::D32_SFLOAT,
            usage: vk::ImageUsageFlags::DEPTH_STENCIL_ATTACHMENT,
        },
    )
}
