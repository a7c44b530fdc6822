//! Visibility's first half: which patch each pixel of the predicted views shows.

use crate::animation::gpu::Animation;
use crate::scene_gpu::SceneGpu;
use crate::stages::geometry::Geometry;
use ash::vk;
use shadecast_gpu::{
    Attachment, Bind, BindGroup, Buffer, Framebuffer, Gpu, GpuError, Image, ImageDesc, Recorder, RenderPass,
    RenderPassDesc,
};
use shadecast_shaders::generated::{ID_BUFFER_FRAG, ID_BUFFER_VERT, IdBufferPush};
use std::sync::Arc;

/// The stage with its output; both eyes of one time at once.
pub struct IdBuffer {
    pass: RenderPass,
    geometry: Geometry,
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
        let geometry = Geometry::new(gpu, &ID_BUFFER_VERT, &ID_BUFFER_FRAG, &pass)?;
        let textures = scene.texture_binds();
        let group = BindGroup::new(
            geometry.layout(),
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
        Ok(Self { pass, geometry, group, target, image, _depth: depth })
    }

    /// Draws the `needed` instances as they are in `slot` into the two views from `first_view` on.
    pub fn record(
        &self,
        recorder: &mut Recorder,
        scene: &SceneGpu,
        animation: &Animation,
        needed: &[bool],
        slot: u32,
        first_view: u32,
    ) {
        let clears = [vk::ClearValue::default(), vk::ClearValue::default()]; // no patch; far, which is 0
        recorder.begin_pass(&self.pass, &self.target, &clears);
        self.geometry.record_some(
            recorder,
            &self.group,
            scene,
            |number| needed[number],
            |draw| IdBufferPush {
                vertex_base: draw.model.vertex_base,
                position_base: animation.position_base(draw.instance, slot),
                triangle_base: (draw.model.index_base + draw.primitive.first_index) / 3,
                patch_base: draw.instance.first_patch,
                material: draw.model.material_base + draw.primitive.material,
                first_view,
            },
        );
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
