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

/// Where the colours of blocks are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Colours {
    /// How they are looked up.
    pub lookup: Lookup,
    /// Blocks may be in the store.
    pub has_store: bool,
    /// They go from one picture to the next while that is on display.
    pub blends: bool,
}

/// The pipelines.
pub struct AtlasDraw {
    colours: Colours,
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
    colours: Colours,
    made: Option<(Arc<YcbcrSampler>, Arc<OfPictures>)>,
}

/// A bundle's bindings for both, one per frame in flight.
type Groups = [[BindGroup; FRAMES_IN_FLIGHT]; 2];

/// A picture that the device has, and what draws it.
pub type OnDevice = (DevicePicture, Arc<OfPictures>);

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
    pub on_device: Option<OnDevice>,
    /// The blocks of the picture that settle.
    pub settled: SettleTiles,
}

/// One on display, one that is made, and one that the device may still read. The planes of the last are also what a client blends
/// from: they change when the next bundle is shown, not when it is made.
pub const BUNDLES: usize = 3;

/// Bindings of planes: of the picture on display, and of the one before it.
const PLANES: [&str; 3] = ["luma_plane", "cb_plane", "cr_plane"];
const PLANES_BEFORE: [&str; 3] = ["luma_before", "cb_before", "cr_before"];
/// Bindings of both where each is one image.
const PICTURES: &[&str] = &["picture", "picture_before"];

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
    /// The pipelines for `pass`.
    pub fn new(gpu: &Arc<Gpu>, pass: &RenderPass, colours: Colours) -> Result<Self, GpuError> {
        let (fragment, masked) = match colours.lookup.reconstruction {
            Reconstruction::Bilinear => (&CLIENT_ATLAS_FRAG, &CLIENT_ATLAS_MASKED_FRAG),
            Reconstruction::Bicubic => (&CLIENT_ATLAS_BICUBIC_FRAG, &CLIENT_ATLAS_MASKED_BICUBIC_FRAG),
        };
        let ways = Ways::new(gpu, pass, [fragment, masked], (colours, None))?;
        let sampler = SamplerDesc::clamped(vk::Filter::LINEAR);
        let (sampler, settle) = (Sampler::new(gpu, sampler)?, Settle::new(gpu)?);
        Ok(Self { colours, ways, sampler, settle })
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
            planes: PlaneStaging::new(gpu, extent, self.colours.lookup.chroma)?,
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
        let planes = Planes::new(gpu, recorder, extent, self.colours.lookup.chroma)?;
        let pictures = [self.planes_as(PLANES, &planes), self.planes_as(PLANES_BEFORE, &planes)].concat();
        let groups = self.ways.bind(bundle, shared, &self.settle.sampler, &pictures)?;
        let settle = self.settle.bind(&bundle.settled, shared.store, &planes, &self.sampler)?;
        Ok(BundleSet { planes, groups, settle, of_picture: None })
    }

    fn planes_as<'a>(
        &'a self,
        names: [&'static str; 3],
        planes: &'a Planes,
    ) -> [(&'static str, Bind<'a>); 3] {
        std::array::from_fn(|plane| (names[plane], Bind::Sampled(&planes.images[plane], &self.sampler)))
    }

    /// Whether colours go from one picture to the next.
    pub fn blends(&self) -> bool {
        self.colours.blends
    }

    /// Lets draws of `now` blend from the picture before: of `before`, or the one that the device has. The GPU is done with what `now`
    /// was used for. False where it cannot.
    pub fn bind_before(
        &self,
        (now, memory): (&mut BundleSet, &BundleMemory),
        (before, on_device): (&BundleSet, Option<&OnDevice>),
    ) -> bool {
        match (&memory.on_device, on_device, &mut now.of_picture) {
            (None, None, _) => {
                self.ways.rebind(&mut now.groups, &self.planes_as(PLANES_BEFORE, &before.planes));
                true
            }
            (Some((_, ways)), Some((picture, same)), Some(bound)) if Arc::ptr_eq(ways, same) => {
                let picture = Bind::Picture(&picture.image);
                ways.draw.rebind(&mut bound.groups, &[("picture_before", picture)]);
                true
            }
            _ => false,
        }
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
                let picture = Bind::Picture(image);
                ways.draw.rebind(&mut bound.groups, &[("picture", picture), ("picture_before", picture)]);
                bound.settle.iter_mut().for_each(|group| ways.settle.rebind(group, image));
            }
            bound => {
                let pictures = [("picture", Bind::Picture(image)), ("picture_before", Bind::Picture(image))];
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
        (colours, fixed): (Colours, Option<FixedSampler>),
    ) -> Result<Self, GpuError> {
        let pipeline = |vertex, fragment| {
            let desc = GraphicsPipelineDesc {
                cull: vk::CullModeFlags::BACK,
                depth_write: Some(true),
                constants: &[u32::from(colours.has_store), u32::from(colours.blends)],
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

    /// The same with other pictures of the same kind.
    fn rebind(&self, groups: &mut Groups, pictures: &[(&str, Bind<'_>)]) {
        for (pipeline, groups) in self.0.iter().zip(groups) {
            for group in groups {
                pictures.iter().for_each(|(name, picture)| group.rebind(pipeline.layout(), name, picture));
            }
        }
    }
}

impl PictureWays {
    /// None yet, for `pass`, in place of those of `draw`.
    pub fn new(gpu: &Arc<Gpu>, pass: &Arc<RenderPass>, draw: &AtlasDraw) -> Self {
        Self { gpu: gpu.clone(), pass: pass.clone(), colours: draw.colours, made: None }
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
        let fixed = Some((PICTURES, sampler.clone()));
        let draw = Ways::new(&self.gpu, &self.pass, shaders, (self.colours, fixed))?;
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
