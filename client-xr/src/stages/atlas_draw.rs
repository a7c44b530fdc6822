//! The one draw of a bundle: both eyes by multiview, the atlas looked up and nothing shaded (`client_atlas.*`).

use super::FRAMES_IN_FLIGHT;
use super::scatter::VertexMemory;
use super::upload::{Chroma, PlaneStaging, Planes};
use crate::coverage::CoverageMap;
use crate::draw_list::{Drawable, MAX_CORNERS_PER_PATCH, MAX_INDICES_PER_PATCH};
use crate::platform::requirements::REQUIRED;
use shadecast_gpu::{
    Attachment, Bind, BindGroup, Buffer, Framebuffer, Gpu, GpuError, GraphicsPipeline, GraphicsPipelineDesc,
    Image, ImageDesc, Memory, Recorder, RenderPass, RenderPassDesc, Sampler, SamplerDesc, vk,
};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_shaders::generated::{
    CLIENT_ATLAS_BICUBIC_FRAG, CLIENT_ATLAS_FRAG, CLIENT_ATLAS_MASKED_BICUBIC_FRAG, CLIENT_ATLAS_MASKED_FRAG,
    CLIENT_ATLAS_MASKED_VERT, CLIENT_ATLAS_VERT, CornerGpu, EyesGpu,
};
use std::sync::Arc;

/// Depth: reversed, never stored.
pub(super) const DEPTH_FORMAT: vk::Format = REQUIRED.depth_format;
/// Both eyes.
pub(super) const BOTH_EYES: u32 = 0b11;

/// What is drawn to: the swapchain's images, multisampled colour and depth that live within the pass.
pub struct EyeTargets {
    /// The one pass of a display frame.
    pub pass: RenderPass,
    framebuffers: Vec<Framebuffer>,
    _transient: Vec<Image>,
}

/// How a colour between texels is found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Reconstruction {
    /// On a straight line between the nearest texels.
    #[default]
    Bilinear,
    /// Brightness by Catmull and Rom's cubic, in five lookups instead of one.
    Bicubic,
}

/// How colours are looked up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Lookup {
    /// Between texels.
    pub reconstruction: Reconstruction,
    /// In which pictures.
    pub chroma: Chroma,
}

/// The pipelines. What covers all of its block has one without `discard`, so that its depth is tested early.
pub struct AtlasDraw {
    chroma: Chroma,
    pipeline: GraphicsPipeline,
    masked: GraphicsPipeline,
    sampler: Sampler,
}

/// What the CPU makes of a bundle: a worker writes it, the render thread lets the GPU read it. A connection has [`BUNDLES`].
pub struct BundleMemory {
    /// Which of its connection's.
    pub index: usize,
    /// Corners by patch.
    pub corners: Buffer,
    /// Indices of corners.
    pub indices: Buffer,
    /// What cutouts leave of their blocks: a [`CoverageMap`]'s words, once there are any.
    pub coverage: Buffer,
    /// The picture.
    pub planes: PlaneStaging,
}

/// One on display, one that is made, and one that the device may still read.
pub const BUNDLES: usize = 3;

/// A bundle's images, and the bindings of its memory.
pub struct BundleSet {
    /// The picture.
    pub planes: Planes,
    groups: [BindGroup; FRAMES_IN_FLIGHT],
    masked_groups: [BindGroup; FRAMES_IN_FLIGHT],
}

impl EyeTargets {
    /// A pass and its framebuffers for `images`, which have two layers of `extent_pixels`.
    pub fn new(
        gpu: &Arc<Gpu>,
        images: &[vk::Image],
        format: vk::Format,
        extent_pixels: [u32; 2],
        samples: vk::SampleCountFlags,
    ) -> Result<Self, GpuError> {
        let multisampled = samples != vk::SampleCountFlags::TYPE_1;
        let color = |store| Attachment {
            format,
            load: vk::AttachmentLoadOp::DONT_CARE, // the background covers what the bundle leaves
            store,
            before: vk::ImageLayout::UNDEFINED,
            after: vk::ImageLayout::COLOR_ATTACHMENT_OPTIMAL,
        };
        let shown = color(vk::AttachmentStoreOp::STORE);
        let (colors, resolves) = match multisampled {
            true => (vec![color(vk::AttachmentStoreOp::DONT_CARE)], vec![shown]),
            false => (vec![shown], vec![]),
        };
        let desc = RenderPassDesc {
            resolves,
            depth: Some(DEPTH_FORMAT),
            samples,
            view_mask: BOTH_EYES,
            ..RenderPassDesc::new(colors)
        };
        let pass = RenderPass::new(gpu, &desc)?;
        let attachment = |name, format, usage| {
            let usage = usage | vk::ImageUsageFlags::TRANSIENT_ATTACHMENT;
            Image::new(
                gpu,
                ImageDesc { layers: 2, samples, ..ImageDesc::new(name, extent_pixels, format, usage) },
            )
        };
        let mut transient = Vec::new();
        if multisampled {
            transient.push(attachment("eye colour", format, vk::ImageUsageFlags::COLOR_ATTACHMENT)?);
        }
        transient.push(attachment("eye depth", DEPTH_FORMAT, vk::ImageUsageFlags::DEPTH_STENCIL_ATTACHMENT)?);
        let views: Vec<_> = transient.iter().map(Image::view).collect();
        let desc = ImageDesc {
            layers: 2,
            ..ImageDesc::new("swapchain image", extent_pixels, format, vk::ImageUsageFlags::COLOR_ATTACHMENT)
        };
        let foreign = usize::from(multisampled);
        let framebuffers = images
            .iter()
            .map(|image| Framebuffer::around_foreign_image(gpu, &pass, *image, &desc, foreign, &views))
            .collect::<Result<_, _>>()?;
        Ok(Self { pass, framebuffers, _transient: transient })
    }

    /// Begins the pass on the swapchain image `index`.
    pub fn begin(&self, recorder: &mut Recorder, index: usize) {
        let color = vk::ClearValue::default();
        let far = vk::ClearValue { depth_stencil: vk::ClearDepthStencilValue { depth: 0.0, stencil: 0 } };
        let clears = [color, color, far];
        // One clear value per attachment: colour and depth, or multisampled colour, resolve target and depth.
        let first = usize::from(self._transient.len() == 1);
        recorder.begin_pass(&self.pass, &self.framebuffers[index], &clears[first..]);
    }
}

impl AtlasDraw {
    /// The pipelines for `pass`.
    pub fn new(gpu: &Arc<Gpu>, pass: &RenderPass, lookup: Lookup) -> Result<Self, GpuError> {
        let Lookup { reconstruction, chroma } = lookup;
        let (fragment, masked) = match reconstruction {
            Reconstruction::Bilinear => (&CLIENT_ATLAS_FRAG, &CLIENT_ATLAS_MASKED_FRAG),
            Reconstruction::Bicubic => (&CLIENT_ATLAS_BICUBIC_FRAG, &CLIENT_ATLAS_MASKED_BICUBIC_FRAG),
        };
        let desc = GraphicsPipelineDesc {
            cull: vk::CullModeFlags::BACK,
            depth_write: Some(true),
            ..GraphicsPipelineDesc::new(&CLIENT_ATLAS_VERT, fragment, pass)
        };
        let pipeline = GraphicsPipeline::new(gpu, &desc)?;
        let masked = GraphicsPipelineDesc { vertex: &CLIENT_ATLAS_MASKED_VERT, fragment: masked, ..desc };
        let masked = GraphicsPipeline::new(gpu, &masked)?;
        let edge = vk::SamplerAddressMode::CLAMP_TO_EDGE;
        let sampler =
            SamplerDesc { filter: vk::Filter::LINEAR, wrap: [edge; 2], mips: false, anisotropy: 1.0 };
        Ok(Self { chroma, pipeline, masked, sampler: Sampler::new(gpu, sampler)? })
    }

    /// Memory for a bundle of a connection with these capacities.
    pub fn bundle_memory(
        &self,
        gpu: &Arc<Gpu>,
        index: usize,
        patch_slots: u32,
        extent: AtlasExtent,
    ) -> Result<BundleMemory, GpuError> {
        let patches = u64::from(patch_slots);
        let corner_bytes = patches * (MAX_CORNERS_PER_PATCH * size_of::<CornerGpu>()) as u64;
        let index_bytes = patches * (MAX_INDICES_PER_PATCH * size_of::<u32>()) as u64;
        Ok(BundleMemory {
            index,
            corners: Buffer::new(gpu, "corners", corner_bytes, Memory::Upload)?,
            indices: Buffer::new(gpu, "indices", index_bytes, Memory::Upload)?,
            coverage: Buffer::new(gpu, "coverage", CoverageMap::byte_count(extent), Memory::Upload)?,
            planes: PlaneStaging::new(gpu, extent, self.chroma)?,
        })
    }

    /// What draws from `bundle`.
    pub fn bundle_set(
        &self,
        gpu: &Arc<Gpu>,
        recorder: &mut Recorder,
        bundle: &BundleMemory,
        extent: AtlasExtent,
        memory: &VertexMemory,
        eyes: [&Buffer; FRAMES_IN_FLIGHT],
    ) -> Result<BundleSet, GpuError> {
        let planes = Planes::new(gpu, recorder, extent, self.chroma)?;
        let binds = |eyes| {
            [
                ("Corners", Bind::Buffer(&bundle.corners)),
                ("Positions", Bind::Buffer(&memory.positions)),
                ("Eyes", Bind::Buffer(eyes)),
                ("luma_plane", Bind::Sampled(&planes.images[0], &self.sampler)),
                ("cb_plane", Bind::Sampled(&planes.images[1], &self.sampler)),
                ("cr_plane", Bind::Sampled(&planes.images[2], &self.sampler)),
                ("Coverage", Bind::Buffer(&bundle.coverage)),
            ]
        };
        let masked = |eyes| BindGroup::new(self.masked.layout(), &binds(eyes));
        let opaque = |eyes| BindGroup::new(self.pipeline.layout(), &binds(eyes)[..6]);
        let groups = [opaque(eyes[0])?, opaque(eyes[1])?, opaque(eyes[2])?];
        let masked_groups = [masked(eyes[0])?, masked(eyes[1])?, masked(eyes[2])?];
        Ok(BundleSet { planes, groups, masked_groups })
    }

    /// Draws what can be drawn of the bundle behind `indices`, with the eyes of frame in flight `flight`.
    pub fn record(
        &self,
        recorder: &mut Recorder,
        set: &BundleSet,
        indices: &Buffer,
        flight: usize,
        drawn: Drawable,
    ) {
        let ways = [(&self.pipeline, &set.groups[flight]), (&self.masked, &set.masked_groups[flight])];
        for ([first, count], (pipeline, group)) in drawn.ranges().into_iter().zip(ways) {
            if count > 0 {
                recorder.bind(pipeline, group);
                recorder.bind_indices(indices, 0);
                recorder.draw_indexed(first, count);
            }
        }
    }
}

/// Uniform buffers of the eyes, one per frame in flight.
pub fn eye_buffers(gpu: &Arc<Gpu>) -> Result<[Buffer; FRAMES_IN_FLIGHT], GpuError> {
    let buffer = || Buffer::new(gpu, "eyes", size_of::<EyesGpu>() as u64, Memory::Upload);
    Ok([buffer()?, buffer()?, buffer()?])
}

#[cfg(test)]
#[path = "atlas_draw_tests.rs"]
mod tests;
