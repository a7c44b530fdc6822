//! Render passes of one subpass, and framebuffers.

use crate::memory::{Garbage, YcbcrView, create_view};
use crate::{Doing, Gpu, GpuError, ImageDesc};
use ash::vk;
use std::sync::Arc;

/// One attachment of a pass.
#[derive(Clone, Copy, Debug)]
pub struct Attachment {
    /// Format.
    pub format: vk::Format,
    /// Load operation.
    pub load: vk::AttachmentLoadOp,
    /// Store operation.
    pub store: vk::AttachmentStoreOp,
    /// Layout before the pass (UNDEFINED where the content does not matter).
    pub before: vk::ImageLayout,
    /// Layout after the pass.
    pub after: vk::ImageLayout,
}

/// A render pass of one subpass.
#[derive(Clone, Debug)]
pub struct RenderPassDesc {
    /// Colour attachments, with `samples` samples.
    pub colors: Vec<Attachment>,
    /// One resolve target per colour attachment; empty without MSAA.
    pub resolves: Vec<Attachment>,
    /// Depth, never stored.
    pub depth: Option<vk::Format>,
    /// Samples of colour and depth.
    pub samples: vk::SampleCountFlags,
    /// Multiview mask; 0 is off.
    pub view_mask: u32,
    /// Whether a pass may draw the first view alone ([`Part`]): each pipeline for it exists twice then.
    pub first_alone: bool,
    /// A map says where fewer fragments are shaded; needs [`Gpu::takes_density_maps`].
    pub density_map: bool,
}

/// Format of density maps: the share of fragments across and along.
pub const DENSITY_MAP_FORMAT: vk::Format = vk::Format::R8G8_UNORM;

/// An image that somebody else owns, such as that of an OpenXR swapchain, as an attachment.
#[derive(Clone, Copy, Debug)]
pub struct Foreign<'a> {
    /// The image.
    pub image: vk::Image,
    /// What is known of it: all of its layers are bound.
    pub desc: &'a ImageDesc,
    /// Its place among the attachments.
    pub index: usize,
}

impl RenderPassDesc {
    /// Colour alone, one sample, one view.
    pub fn new(colors: Vec<Attachment>) -> Self {
        Self {
            colors,
            resolves: Vec::new(),
            depth: None,
            samples: vk::SampleCountFlags::TYPE_1,
            view_mask: 0,
            first_alone: false,
            density_map: false,
        }
    }
}

/// What one recording of a pass draws.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Part {
    /// Width and height from the first corner on, in pixels, within the framebuffer's.
    pub extent: [u32; 2],
    /// The first view and no other, in a pass that may ([`RenderPassDesc::first_alone`]).
    pub first_alone: bool,
}

/// A render pass.
pub struct RenderPass {
    gpu: Arc<Gpu>,
    pub(crate) handles: OfViews<vk::RenderPass>,
    pub(crate) samples: vk::SampleCountFlags,
    pub(crate) colors: usize,
    pub(crate) has_depth: bool,
    /// Says what pipelines of compatible passes have in common.
    pub(crate) key: String,
}

/// One thing for all views of a pass, and where it may draw the first alone, another for that.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OfViews<T> {
    pub(crate) all: T,
    pub(crate) first: Option<T>,
}

impl<T: Copy> OfViews<T> {
    /// The one for some of the views.
    pub(crate) fn of(&self, first_alone: bool) -> T {
        match self.first {
            Some(first) if first_alone => first,
            _ => {
                debug_assert!(!first_alone, "the pass was not made for the first view alone");
                self.all
            }
        }
    }

    /// One more for each that is there.
    pub(crate) fn map<U, E>(&self, mut make: impl FnMut(T) -> Result<U, E>) -> Result<OfViews<U>, E> {
        Ok(OfViews { all: make(self.all)?, first: self.first.map(make).transpose()? })
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = T> {
        std::iter::once(self.all).chain(self.first)
    }
}

/// Image views for a pass, in its order: colours, resolves, depth, density map.
pub struct Framebuffer {
    gpu: Arc<Gpu>,
    pub(crate) handles: OfViews<vk::Framebuffer>,
    pub(crate) extent: [u32; 2],
    owned_views: Vec<vk::ImageView>,
}

impl RenderPass {
    /// A pass. Execution and memory dependencies with the outside are the recorder's barriers.
    pub fn new(gpu: &Arc<Gpu>, desc: &RenderPassDesc) -> Result<Self, GpuError> {
        Self::create(gpu, desc, vk::AttachmentStoreOp::DONT_CARE)
    }

    /// A pass that leaves depth alone, ready to be sampled; it begins with the cleared depth.
    pub fn depth_map(gpu: &Arc<Gpu>, format: vk::Format) -> Result<Self, GpuError> {
        let desc = RenderPassDesc { depth: Some(format), ..RenderPassDesc::new(vec![]) };
        Self::create(gpu, &desc, vk::AttachmentStoreOp::STORE)
    }

    fn create(
        gpu: &Arc<Gpu>,
        desc: &RenderPassDesc,
        depth_store: vk::AttachmentStoreOp,
    ) -> Result<Self, GpuError> {
        let one = vk::SampleCountFlags::TYPE_1;
        let mut attachments: Vec<_> = desc.colors.iter().map(|a| description(a, desc.samples)).collect();
        attachments.extend(desc.resolves.iter().map(|a| description(a, one)));
        if let Some(format) = desc.depth {
            let depth = Attachment {
                format,
                load: vk::AttachmentLoadOp::CLEAR,
                store: depth_store,
                before: vk::ImageLayout::UNDEFINED,
                after: match depth_store {
                    vk::AttachmentStoreOp::STORE => vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL,
                    _ => vk::ImageLayout::DEPTH_STENCIL_ATTACHMENT_OPTIMAL,
                },
            };
            attachments.push(description(&depth, desc.samples));
        }
        let depth_index = attachments.len().saturating_sub(1);
        if desc.density_map {
            attachments.push(description(&density_map(), one));
        }
        let reference = |index: usize, layout| vk::AttachmentReference { attachment: index as u32, layout };
        let color = vk::ImageLayout::COLOR_ATTACHMENT_OPTIMAL;
        let colors: Vec<_> = (0..desc.colors.len()).map(|i| reference(i, color)).collect();
        let resolves: Vec<_> =
            (0..desc.resolves.len()).map(|i| reference(desc.colors.len() + i, color)).collect();
        let depth = reference(depth_index, vk::ImageLayout::DEPTH_STENCIL_ATTACHMENT_OPTIMAL);
        let mut subpass = vk::SubpassDescription::default().color_attachments(&colors);
        if !resolves.is_empty() {
            subpass = subpass.resolve_attachments(&resolves);
        }
        if desc.depth.is_some() {
            subpass = subpass.depth_stencil_attachment(&depth);
        }
        let subpasses = [subpass];
        let dependencies = [attachment_reuse(), hand_over()];
        let info = vk::RenderPassCreateInfo::default()
            .attachments(&attachments)
            .subpasses(&subpasses)
            .dependencies(&dependencies);
        let mut density =
            vk::RenderPassFragmentDensityMapCreateInfoEXT::default().fragment_density_map_attachment(
                reference(attachments.len().saturating_sub(1), density_map().after),
            );
        let info = match desc.density_map {
            true => {
                assert!(gpu.takes_density_maps(), "the device was not opened for density maps");
                info.push_next(&mut density)
            }
            false => info,
        };
        let masks = OfViews { all: desc.view_mask, first: desc.first_alone.then_some(FIRST_VIEW) };
        Ok(Self {
            gpu: gpu.clone(),
            handles: masks.map(|mask| for_views(gpu, info, mask))?,
            samples: desc.samples,
            colors: desc.colors.len(),
            has_depth: desc.depth.is_some(),
            key: format!("{desc:?}"),
        })
    }
}

const FIRST_VIEW: u32 = 0b1;

/// The pass of some views; 0: without multiview.
fn for_views(gpu: &Gpu, info: vk::RenderPassCreateInfo<'_>, mask: u32) -> Result<vk::RenderPass, GpuError> {
    let masks = [mask];
    let mut multiview = vk::RenderPassMultiviewCreateInfo::default().view_masks(&masks);
    let info = if mask == 0 { info } else { info.push_next(&mut multiview) };
    // SAFETY: the device is alive; all that the info points to lives through the call.
    unsafe { gpu.device().create_render_pass(&info, None) }.doing("creating a render pass")
}

/// Somebody else writes it, ready to be read by passes.
fn density_map() -> Attachment {
    let layout = vk::ImageLayout::FRAGMENT_DENSITY_MAP_OPTIMAL_EXT;
    Attachment {
        format: DENSITY_MAP_FORMAT,
        load: vk::AttachmentLoadOp::LOAD,
        store: vk::AttachmentStoreOp::DONT_CARE,
        before: layout,
        after: layout,
    }
}

/// The next use of an attachment waits for the last one: depth and MSAA images are shared by frames in flight.
fn attachment_reuse() -> vk::SubpassDependency {
    let stages = vk::PipelineStageFlags::COLOR_ATTACHMENT_OUTPUT
        | vk::PipelineStageFlags::EARLY_FRAGMENT_TESTS
        | vk::PipelineStageFlags::LATE_FRAGMENT_TESTS;
    let writes = vk::AccessFlags::COLOR_ATTACHMENT_WRITE | vk::AccessFlags::DEPTH_STENCIL_ATTACHMENT_WRITE;
    let reads = vk::AccessFlags::COLOR_ATTACHMENT_READ | vk::AccessFlags::DEPTH_STENCIL_ATTACHMENT_READ;
    vk::SubpassDependency {
        src_subpass: vk::SUBPASS_EXTERNAL,
        dst_subpass: 0,
        src_stage_mask: stages,
        dst_stage_mask: stages,
        src_access_mask: writes,
        dst_access_mask: writes | reads,
        dependency_flags: vk::DependencyFlags::empty(),
    }
}

/// The pass's last layout transitions come before what a following barrier from colour or depth output waits for. Without it they
/// are ordered only before the end of the pipe, which no barrier names.
fn hand_over() -> vk::SubpassDependency {
    let stages =
        vk::PipelineStageFlags::COLOR_ATTACHMENT_OUTPUT | vk::PipelineStageFlags::LATE_FRAGMENT_TESTS;
    let writes = vk::AccessFlags::COLOR_ATTACHMENT_WRITE | vk::AccessFlags::DEPTH_STENCIL_ATTACHMENT_WRITE;
    vk::SubpassDependency {
        src_subpass: 0,
        dst_subpass: vk::SUBPASS_EXTERNAL,
        src_stage_mask: stages,
        dst_stage_mask: stages,
        src_access_mask: writes,
        dst_access_mask: writes | vk::AccessFlags::COLOR_ATTACHMENT_READ,
        dependency_flags: vk::DependencyFlags::empty(),
    }
}

fn description(a: &Attachment, samples: vk::SampleCountFlags) -> vk::AttachmentDescription {
    vk::AttachmentDescription::default()
        .format(a.format)
        .samples(samples)
        .load_op(a.load)
        .store_op(a.store)
        .stencil_load_op(vk::AttachmentLoadOp::DONT_CARE)
        .stencil_store_op(vk::AttachmentStoreOp::DONT_CARE)
        .initial_layout(a.before)
        .final_layout(a.after)
}

impl Drop for RenderPass {
    fn drop(&mut self) {
        self.handles.iter().for_each(|pass| self.gpu.retire(Garbage::RenderPass(pass)));
    }
}

impl Framebuffer {
    /// Binds `views` (which the caller keeps alive) to `pass`.
    pub fn new(
        gpu: &Arc<Gpu>,
        pass: &RenderPass,
        extent: [u32; 2],
        views: &[vk::ImageView],
    ) -> Result<Self, GpuError> {
        let handles = pass.handles.map(|pass| {
            let info = vk::FramebufferCreateInfo::default()
                .render_pass(pass)
                .attachments(views)
                .width(extent[0])
                .height(extent[1])
                .layers(1);
            // SAFETY: pass and views are alive, and the views are of the pass's formats.
            unsafe { gpu.device().create_framebuffer(&info, None) }.doing("creating a framebuffer")
        })?;
        Ok(Self { gpu: gpu.clone(), handles, extent, owned_views: Vec::new() })
    }

    /// Width and height in pixels.
    pub fn extent(&self) -> [u32; 2] {
        self.extent
    }

    /// As [`Framebuffer::new`], where some attachments are images that somebody else owns, by rising places.
    pub fn around_foreign_images(
        gpu: &Arc<Gpu>,
        pass: &RenderPass,
        extent: [u32; 2],
        foreign: &[Foreign<'_>],
        other_views: &[vk::ImageView],
    ) -> Result<Self, GpuError> {
        let (mut views, mut owned_views) = (other_views.to_vec(), Vec::new());
        for Foreign { image, desc, index } in foreign {
            let view = create_view(gpu, *image, desc, (0, desc.layers), YcbcrView(None))?;
            views.insert(*index, view);
            owned_views.push(view);
        }
        let mut framebuffer = Self::new(gpu, pass, extent, &views)?;
        framebuffer.owned_views = owned_views;
        Ok(framebuffer)
    }
}

impl Drop for Framebuffer {
    fn drop(&mut self) {
        self.handles.iter().for_each(|framebuffer| self.gpu.retire(Garbage::Framebuffer(framebuffer)));
        self.owned_views.drain(..).for_each(|view| self.gpu.retire(Garbage::View(view)));
    }
}
