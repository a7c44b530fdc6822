//! The one draw of a bundle: both eyes by multiview. It samples the atlas and shades nothing (`client_atlas.*`).

use super::FRAMES_IN_FLIGHT;
use super::scatter::VertexMemory;
use super::settle::{Settle, SettlePicture, SettleSet, SettleTiles, Store};
use super::upload::{Chroma, PlaneStaging, Planes};
use crate::decode::DevicePicture;
use crate::display::EyeImages;
use crate::draw::coverage::CoverageMap;
use crate::draw::draw_list::{Drawable, MAX_CORNERS_PER_PATCH, MAX_INDICES_PER_PATCH};
use crate::platform::requirements::REQUIRED;
use shadecast_gpu::{
    Attachment, Bind, BindGroup, Buffer, DENSITY_MAP_FORMAT, FixedSampler, Foreign, Framebuffer, Gpu,
    GpuError, GraphicsPipeline, GraphicsPipelineDesc, Image, ImageDesc, Memory, Part, Recorder, RenderPass,
    RenderPassDesc, Sampler, SamplerDesc, YcbcrImage, YcbcrSampler, vk,
};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_shaders::Shader;
use shadecast_shaders::generated::{
    CLIENT_ATLAS_BICUBIC_FRAG, CLIENT_ATLAS_COSITED_FRAG, CLIENT_ATLAS_FRAG,
    CLIENT_ATLAS_MASKED_BICUBIC_FRAG, CLIENT_ATLAS_MASKED_COSITED_FRAG, CLIENT_ATLAS_MASKED_FRAG,
    CLIENT_ATLAS_MASKED_PICTURE_FRAG, CLIENT_ATLAS_MASKED_VERT, CLIENT_ATLAS_PICTURE_FRAG, CLIENT_ATLAS_VERT,
    CornerGpu, EyesGpu,
};
use std::sync::Arc;

/// Depth: reversed, never stored.
pub(super) const DEPTH_FORMAT: vk::Format = REQUIRED.depth_format;
/// Both eyes.
pub(super) const BOTH_EYES: u32 = 0b11;

/// What is drawn to: the swapchain's images, multisampled colour and depth that live within the pass.
pub struct EyeTargets {
    /// The one pass of a display frame.
    pub pass: Arc<RenderPass>,
    samples: vk::SampleCountFlags,
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

/// The pipelines.
pub struct AtlasDraw {
    chroma: Chroma,
    has_store: bool,
    ways: Ways,
    sampler: Sampler,
    settle: Settle,
}

/// The pipeline of what covers all of its block, without `discard`, so that its depth is tested early, and that of cutouts.
pub struct Ways([GraphicsPipeline; 2]);

/// Both for pictures on the device, and the pipeline that copies blocks of such.
pub struct OfPictures {
    draw: Ways,
    settle: SettlePicture,
}

/// What all bundles of a connection are drawn with.
#[derive(Clone, Copy)]
pub struct Shared<'a> {
    /// Positions of the corners.
    pub memory: &'a VertexMemory,
    /// Copies of blocks of earlier pictures.
    pub store: &'a Store,
    /// The eyes of each frame in flight.
    pub eyes: [&'a Buffer; FRAMES_IN_FLIGHT],
}

/// The pipelines of pictures on the device, on the thread that takes them in: made when the first comes, and anew when the decoder changes
/// their format.
pub struct PictureWays {
    gpu: Arc<Gpu>,
    pass: Arc<RenderPass>,
    has_store: bool,
    made: Option<(Arc<YcbcrSampler>, Arc<OfPictures>)>,
}

/// A bundle's bindings for both, one per frame in flight.
type Groups = [[BindGroup; FRAMES_IN_FLIGHT]; 2];

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
    /// The picture, where the CPU has it.
    pub planes: PlaneStaging,
    /// The picture, where the device has it, and what draws it; it counts where it is there.
    pub on_device: Option<(DevicePicture, Arc<OfPictures>)>,
    /// The blocks of the picture that settle.
    pub settled: SettleTiles,
}

/// One on display, one that is made, and one that the device may still read.
pub const BUNDLES: usize = 3;

/// A bundle's images, and the bindings of its memory.
pub struct BundleSet {
    /// The picture that the CPU had.
    pub planes: Planes,
    groups: Groups,
    settle: SettleSet,
    /// With the picture that the device has, and what draws it.
    of_picture: Option<PictureSet>,
}

/// Bindings of a picture that the device has.
struct PictureSet {
    ways: Arc<OfPictures>,
    groups: Groups,
    /// None without a store.
    settle: Option<BindGroup>,
}

impl EyeTargets {
    /// A pass and its framebuffers for the images of two eyes.
    pub fn new(gpu: &Arc<Gpu>, eyes: EyeImages<'_>, samples: vk::SampleCountFlags) -> Result<Self, GpuError> {
        let EyeImages { format, one_eye, density_maps, .. } = eyes;
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
            first_alone: one_eye,
            density_map: density_maps.is_some(),
            ..RenderPassDesc::new(colors)
        };
        let pass = Arc::new(RenderPass::new(gpu, &desc)?);
        Self::of_pass(gpu, pass, eyes, samples)
    }

    /// The same pass for other images of the same kind.
    pub fn for_images(&self, gpu: &Arc<Gpu>, eyes: EyeImages<'_>) -> Result<Self, GpuError> {
        Self::of_pass(gpu, self.pass.clone(), eyes, self.samples)
    }

    fn of_pass(
        gpu: &Arc<Gpu>,
        pass: Arc<RenderPass>,
        eyes: EyeImages<'_>,
        samples: vk::SampleCountFlags,
    ) -> Result<Self, GpuError> {
        let EyeImages { images, format, extent_pixels, density_maps, .. } = eyes;
        let multisampled = samples != vk::SampleCountFlags::TYPE_1;
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
        let of_eyes = |name, extent, format, usage| ImageDesc {
            layers: 2,
            ..ImageDesc::new(name, extent, format, usage)
        };
        let shown = of_eyes("swapchain image", extent_pixels, format, vk::ImageUsageFlags::COLOR_ATTACHMENT);
        let density = density_maps.map(|maps| {
            let usage = vk::ImageUsageFlags::FRAGMENT_DENSITY_MAP_EXT;
            of_eyes("density map", maps.extent_texels, DENSITY_MAP_FORMAT, usage)
        });
        let framebuffer = |number: usize| {
            let map = density_maps.zip(density.as_ref());
            let map = map.map(|(maps, desc)| (maps.images[number], desc, views.len() + 1));
            let image = (images[number], &shown, usize::from(multisampled));
            let foreign: Vec<_> = [Some(image), map]
                .into_iter()
                .flatten()
                .map(|(image, desc, index)| Foreign { image, desc, index })
                .collect();
            Framebuffer::around_foreign_images(gpu, &pass, extent_pixels, &foreign, &views)
        };
        let framebuffers = (0..images.len()).map(framebuffer).collect::<Result<_, _>>()?;
        Ok(Self { pass, samples, framebuffers, _transient: transient })
    }

    /// Begins the pass on all of the swapchain image `index`.
    pub fn begin(&self, recorder: &mut Recorder, index: usize) {
        let extent = self.framebuffers[index].extent();
        self.begin_part(recorder, index, Part { extent, first_alone: false });
    }

    /// The same on a part of it.
    pub fn begin_part(&self, recorder: &mut Recorder, index: usize, part: Part) {
        let color = vk::ClearValue::default();
        let far = vk::ClearValue { depth_stencil: vk::ClearDepthStencilValue { depth: 0.0, stencil: 0 } };
        let clears = [color, color, far];
        // A clear value for colour and depth, or multisampled colour, resolve target and depth; a density map is not cleared.
        let first = usize::from(self._transient.len() == 1);
        recorder.begin_pass_of(&self.pass, &self.framebuffers[index], &clears[first..], part);
    }
}

impl AtlasDraw {
    /// The pipelines for `pass`. With `has_store`, blocks may be looked up in the store.
    pub fn new(gpu: &Arc<Gpu>, pass: &RenderPass, lookup: Lookup, has_store: bool) -> Result<Self, GpuError> {
        let Lookup { reconstruction, chroma } = lookup;
        let (fragment, masked) = match reconstruction {
            Reconstruction::Bilinear => (&CLIENT_ATLAS_FRAG, &CLIENT_ATLAS_MASKED_FRAG),
            Reconstruction::Bicubic => (&CLIENT_ATLAS_BICUBIC_FRAG, &CLIENT_ATLAS_MASKED_BICUBIC_FRAG),
        };
        let ways = Ways::new(gpu, pass, [fragment, masked], (has_store, None))?;
        let sampler = SamplerDesc::clamped(vk::Filter::LINEAR);
        let (sampler, settle) = (Sampler::new(gpu, sampler)?, Settle::new(gpu)?);
        Ok(Self { chroma, has_store, ways, sampler, settle })
    }

    /// Memory for a bundle of a connection with these capacities.
    pub fn bundle_memory(
        &self,
        gpu: &Arc<Gpu>,
        index: usize,
        patch_slots: u32,
        extent: AtlasExtent,
        has_store: bool,
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
            on_device: None,
            settled: match has_store {
                true => SettleTiles::new(gpu, extent, patch_slots)?,
                false => SettleTiles::none(gpu)?,
            },
        })
    }

    /// What draws from `bundle`.
    pub fn bundle_set(
        &self,
        gpu: &Arc<Gpu>,
        recorder: &mut Recorder,
        bundle: &BundleMemory,
        extent: AtlasExtent,
        shared: Shared<'_>,
    ) -> Result<BundleSet, GpuError> {
        let planes = Planes::new(gpu, recorder, extent, self.chroma)?;
        let [luma, cb, cr] = planes.images.each_ref().map(|plane| Bind::Sampled(plane, &self.sampler));
        let pictures = [("luma_plane", luma), ("cb_plane", cb), ("cr_plane", cr)];
        let groups = self.ways.bind(bundle, shared, &self.settle.sampler, &pictures)?;
        let settle = self.settle.bind(&bundle.settled, shared.store, &planes, &self.sampler)?;
        Ok(BundleSet { planes, groups, settle, of_picture: None })
    }

    /// Puts the picture of `bundle` where its draw finds it, and copies the blocks of it that settle to the store. The GPU is done
    /// with what was there.
    ///
    /// # Errors
    /// The device has no room for the bindings of pictures of a format that was not there before.
    pub fn record_picture(
        &self,
        recorder: &mut Recorder,
        set: &mut BundleSet,
        bundle: &BundleMemory,
        shared: Shared<'_>,
    ) -> Result<(), GpuError> {
        match &bundle.on_device {
            None => set.planes.record(recorder, &bundle.planes),
            Some((DevicePicture { image, is_foreign, .. }, ways)) => {
                if *is_foreign {
                    recorder.take_over(image);
                }
                self.bind_picture(set, bundle, (image, ways), shared)?;
            }
        }
        if !bundle.settled.is_empty() {
            self.record_settled(recorder, set, bundle, shared.store);
        }
        Ok(())
    }

    fn bind_picture(
        &self,
        set: &mut BundleSet,
        bundle: &BundleMemory,
        (image, ways): (&YcbcrImage, &Arc<OfPictures>),
        shared: Shared<'_>,
    ) -> Result<(), GpuError> {
        match &mut set.of_picture {
            Some(bound) if Arc::ptr_eq(&bound.ways, ways) => {
                ways.draw.rebind(&mut bound.groups, image);
                bound.settle.iter_mut().for_each(|group| ways.settle.rebind(group, image));
            }
            bound => {
                let pictures = [("picture", Bind::Picture(image))];
                *bound = Some(PictureSet {
                    ways: ways.clone(),
                    groups: ways.draw.bind(bundle, shared, &self.settle.sampler, &pictures)?,
                    settle: ways.settle.bind(&bundle.settled, shared.store, image)?,
                });
            }
        }
        Ok(())
    }

    fn record_settled(&self, recorder: &mut Recorder, set: &BundleSet, bundle: &BundleMemory, store: &Store) {
        let BundleSet { settle, of_picture, .. } = set;
        match of_picture.as_ref().filter(|_| bundle.on_device.is_some()) {
            None => self.settle.record(recorder, store, settle, &bundle.settled),
            Some(PictureSet { ways, settle: Some(group), .. }) => {
                let finest = (&ways.settle, group);
                self.settle.record_picture(recorder, store, settle, &bundle.settled, finest);
            }
            Some(_) => {}
        }
    }

    /// Draws what can be drawn of `bundle`, whose picture is where its draw finds it, with the eyes of frame in flight `flight`.
    pub fn record(
        &self,
        recorder: &mut Recorder,
        set: &BundleSet,
        bundle: &BundleMemory,
        flight: usize,
        drawn: Drawable,
    ) {
        let (ways, groups) = match set.of_picture.as_ref().filter(|_| bundle.on_device.is_some()) {
            Some(PictureSet { ways, groups, .. }) => (&ways.draw, groups),
            None => (&self.ways, &set.groups),
        };
        let ways = ways.0.iter().zip(groups);
        for ([first, count], (pipeline, groups)) in drawn.ranges().into_iter().zip(ways) {
            if count > 0 {
                recorder.bind(pipeline, &groups[flight]);
                recorder.bind_indices(&bundle.indices, 0);
                recorder.draw_indexed(first, count);
            }
        }
    }
}

impl Ways {
    fn new(
        gpu: &Arc<Gpu>,
        pass: &RenderPass,
        [fragment, masked]: [&Shader; 2],
        (has_store, fixed): (bool, Option<FixedSampler>),
    ) -> Result<Self, GpuError> {
        let pipeline = |vertex, fragment| {
            let desc = GraphicsPipelineDesc {
                cull: vk::CullModeFlags::BACK,
                depth_write: Some(true),
                constants: &[u32::from(has_store)],
                ..GraphicsPipelineDesc::new(vertex, fragment, pass)
            };
            GraphicsPipeline::fixing(gpu, &desc, fixed.clone())
        };
        Ok(Self([pipeline(&CLIENT_ATLAS_VERT, fragment)?, pipeline(&CLIENT_ATLAS_MASKED_VERT, masked)?]))
    }

    fn bind(
        &self,
        bundle: &BundleMemory,
        Shared { memory, store, eyes }: Shared<'_>,
        of_store: &Sampler,
        pictures: &[(&str, Bind<'_>)],
    ) -> Result<Groups, GpuError> {
        let group = |pipeline: &GraphicsPipeline, eyes| {
            let mut binds = vec![
                ("Corners", Bind::Buffer(&bundle.corners)),
                ("Positions", Bind::Buffer(&memory.positions)),
                ("Eyes", Bind::Buffer(eyes)),
                ("Coverage", Bind::Buffer(&bundle.coverage)),
                ("store", Bind::Sampled(&store.image, of_store)),
            ];
            binds.extend_from_slice(pictures);
            BindGroup::of(pipeline.layout(), &binds)
        };
        let of = |pipeline| {
            Ok::<_, GpuError>([
                group(pipeline, eyes[0])?,
                group(pipeline, eyes[1])?,
                group(pipeline, eyes[2])?,
            ])
        };
        Ok([of(&self.0[0])?, of(&self.0[1])?])
    }

    /// The same with another picture of the same kind.
    fn rebind(&self, groups: &mut Groups, picture: &YcbcrImage) {
        for (pipeline, groups) in self.0.iter().zip(groups) {
            groups.iter_mut().for_each(|group| group.rebind(pipeline.layout(), "picture", picture));
        }
    }
}

impl PictureWays {
    /// None yet, for `pass`, in place of those of `draw`.
    pub fn new(gpu: &Arc<Gpu>, pass: &Arc<RenderPass>, draw: &AtlasDraw) -> Self {
        Self { gpu: gpu.clone(), pass: pass.clone(), has_store: draw.has_store, made: None }
    }

    /// The device, for decoders whose pictures are in its memory.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// What draws `picture`, always in a straight line between texels.
    ///
    /// # Errors
    /// The device cannot draw pictures of its format.
    pub fn of(&mut self, picture: &YcbcrImage) -> Result<Arc<OfPictures>, GpuError> {
        let sampler = &picture.sampler;
        if let Some((_, ways)) = self.made.as_ref().filter(|(known, _)| Arc::ptr_eq(known, sampler)) {
            return Ok(ways.clone());
        }
        let shaders = match sampler.is_cosited() {
            false => [&CLIENT_ATLAS_PICTURE_FRAG, &CLIENT_ATLAS_MASKED_PICTURE_FRAG],
            true => [&CLIENT_ATLAS_COSITED_FRAG, &CLIENT_ATLAS_MASKED_COSITED_FRAG],
        };
        let fixed = Some(("picture", sampler.clone()));
        let draw = Ways::new(&self.gpu, &self.pass, shaders, (self.has_store, fixed))?;
        let ways = Arc::new(OfPictures { draw, settle: SettlePicture::new(&self.gpu, sampler)? });
        self.made = Some((sampler.clone(), ways.clone()));
        Ok(ways)
    }
}

/// Uniform buffers of the eyes, one per frame in flight.
pub fn eye_buffers(gpu: &Arc<Gpu>) -> Result<[Buffer; FRAMES_IN_FLIGHT], GpuError> {
    let buffer = || Buffer::new(gpu, "eyes", size_of::<EyesGpu>() as u64, Memory::Upload);
    Ok([buffer()?, buffer()?, buffer()?])
}

#[cfg(test)]
mod tests;
