//! Presentation to a desktop window: a capable device, and a swapchain whose images are values consumed by presenting them.
//! Headsets do not use it: the OpenXR runtime owns their swapchains.

use crate::memory::Garbage;
use crate::{
    Attachment, DesktopDevice, DeviceSource, Doing, Foreign, Framebuffer, Gpu, GpuError, GpuOptions,
    ImageDesc, Recorder, RenderPass, RenderPassDesc, Ticket,
};
use ash::{khr, vk};
use raw_window_handle::{RawDisplayHandle, RawWindowHandle};
use std::ffi::{CStr, c_char};
use std::sync::Arc;

/// Instance and device with what presenting on a display needs.
#[derive(Clone, Copy, Debug)]
pub struct WindowDevice {
    /// The display, as the window's library names it.
    pub display: RawDisplayHandle,
}

impl DeviceSource for WindowDevice {
    fn create_instance(
        &self,
        entry: &ash::Entry,
        info: &vk::InstanceCreateInfo<'_>,
    ) -> Result<vk::Instance, GpuError> {
        let needed = ash_window::enumerate_required_extensions(self.display)
            .doing("finding out how to present on this display")?;
        // SAFETY: the caller's slice of names, which it keeps alive through the call.
        let mut names = unsafe { extended(info.pp_enabled_extension_names, info.enabled_extension_count) };
        names.extend_from_slice(needed);
        DesktopDevice.create_instance(entry, &info.enabled_extension_names(&names))
    }

    fn physical_device(
        &self,
        instance: &ash::Instance,
        options: &GpuOptions,
    ) -> Result<vk::PhysicalDevice, GpuError> {
        DesktopDevice.physical_device(instance, options)
    }

    fn create_device(
        &self,
        instance: &ash::Instance,
        physical: vk::PhysicalDevice,
        info: &vk::DeviceCreateInfo<'_>,
    ) -> Result<vk::Device, GpuError> {
        if !has_extension(instance, physical, khr::swapchain::NAME)? {
            return Err(GpuError::NoDevice("the chosen device cannot present to windows".into()));
        }
        // SAFETY: as in `create_instance`.
        let mut names = unsafe { extended(info.pp_enabled_extension_names, info.enabled_extension_count) };
        names.push(khr::swapchain::NAME.as_ptr());
        DesktopDevice.create_device(instance, physical, &info.enabled_extension_names(&names))
    }
}

/// # Safety
/// `names` points to `count` names, or `count` is 0.
unsafe fn extended(names: *const *const c_char, count: u32) -> Vec<*const c_char> {
    if count == 0 {
        return Vec::new();
    }
    // SAFETY: the caller's promise.
    unsafe { std::slice::from_raw_parts(names, count as usize) }.to_vec()
}

fn has_extension(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    name: &CStr,
) -> Result<bool, GpuError> {
    // SAFETY: `physical` belongs to `instance`.
    let all = unsafe { instance.enumerate_device_extension_properties(physical) };
    let all = all.doing("listing the device's extensions")?;
    Ok(all.iter().any(|extension| extension.extension_name_as_c_str() == Ok(name)))
}

/// A window's surface with its swapchain. One frame in flight: the caller waits for the last [`Ticket`] before it
/// acquires again, so one semaphore serves all acquisitions.
pub struct Swapchain {
    gpu: Arc<Gpu>,
    surfaces: khr::surface::Instance,
    surface: vk::SurfaceKHR,
    functions: khr::swapchain::Device,
    handle: vk::SwapchainKHR,
    format: vk::SurfaceFormatKHR,
    pass: RenderPass,
    targets: Vec<Framebuffer>,
    acquired: vk::Semaphore,
    /// By image; never fewer than images, kept when the swapchain is made anew.
    drawn: Vec<vk::Semaphore>,
    extent: [u32; 2],
    is_stale: bool,
}

/// An image of the window's, to be drawn and then presented.
#[must_use = "an image that is not presented is lost to the window"]
pub struct WindowImage {
    index: u32,
}

impl Swapchain {
    /// For a window of a device that [`WindowDevice`] opened.
    ///
    /// # Safety
    /// The handles are of a living window and its display, and outlive the swapchain.
    pub unsafe fn new(
        gpu: &Arc<Gpu>,
        display: RawDisplayHandle,
        window: RawWindowHandle,
    ) -> Result<Self, GpuError> {
        let surfaces = khr::surface::Instance::new(gpu.entry(), gpu.instance());
        // SAFETY: the caller vouches for the handles; the instance has the display's extensions.
        let surface =
            unsafe { ash_window::create_surface(gpu.entry(), gpu.instance(), display, window, None) };
        let surface = surface.doing("creating the window's surface")?;
        let format = choose_format(gpu, &surfaces, surface)?;
        let pass = RenderPass::new(gpu, &present_pass(format.format))?;
        Ok(Self {
            surfaces,
            surface,
            functions: khr::swapchain::Device::new(gpu.instance(), gpu.device()),
            handle: vk::SwapchainKHR::null(),
            format,
            pass,
            targets: Vec::new(),
            acquired: semaphore(gpu)?,
            drawn: Vec::new(),
            extent: [0, 0],
            is_stale: true,
            gpu: gpu.clone(),
        })
    }

    /// The pass that draws a window's image, from nothing to ready for presenting.
    pub fn pass(&self) -> &RenderPass {
        &self.pass
    }

    /// Format of the images.
    pub fn format(&self) -> vk::Format {
        self.format.format
    }

    /// Whether the device codes linear colour to sRGB on writing; else the shader must.
    pub fn codes_srgb(&self) -> bool {
        is_srgb(self.format.format)
    }

    /// Width and height of the images in pixels.
    pub fn extent(&self) -> [u32; 2] {
        self.extent
    }

    /// The next image; `None` where the window has no area, or changed while it was asked. `window_pixels` counts where
    /// the window leaves its size to the swapchain. All earlier work has finished.
    pub fn acquire(&mut self, window_pixels: [u32; 2]) -> Result<Option<WindowImage>, GpuError> {
        let capabilities = self.capabilities()?;
        let extent = extent_of(&capabilities, window_pixels);
        if extent.contains(&0) {
            return Ok(None);
        }
        if self.is_stale || extent != self.extent {
            self.make(&capabilities, extent)?;
        }
        // SAFETY: the swapchain is alive; the semaphore is unsignalled, since the last frame, which waited for it, is over.
        let next = unsafe {
            self.functions.acquire_next_image(self.handle, u64::MAX, self.acquired, vk::Fence::null())
        };
        match next {
            Ok((index, suboptimal)) => {
                self.is_stale |= suboptimal;
                Ok(Some(WindowImage { index }))
            }
            Err(vk::Result::ERROR_OUT_OF_DATE_KHR) => {
                self.is_stale = true;
                Ok(None)
            }
            Err(result) => Err(GpuError::Vulkan { doing: "acquiring the window's next image", result }),
        }
    }

    /// What to draw into.
    pub fn target(&self, image: &WindowImage) -> &Framebuffer {
        &self.targets[image.index as usize]
    }

    /// Submits what was recorded, the drawing of `image` included, and shows it.
    pub fn present(&mut self, recorder: Recorder, image: WindowImage) -> Result<Ticket, GpuError> {
        let drawn = self.drawn[image.index as usize];
        let ticket = recorder.submit_between(self.acquired, drawn)?;
        let (waits, chains, indices) = ([drawn], [self.handle], [image.index]);
        let info =
            vk::PresentInfoKHR::default().wait_semaphores(&waits).swapchains(&chains).image_indices(&indices);
        let lanes = &self.gpu.lanes;
        // SAFETY: the image was acquired and is in the layout of presenting after the pass; no other thread uses the queue
        // meanwhile.
        let shown = lanes.in_turn(|| unsafe { self.functions.queue_present(lanes.main(), &info) });
        match shown {
            Ok(suboptimal) => self.is_stale |= suboptimal,
            Err(vk::Result::ERROR_OUT_OF_DATE_KHR) => self.is_stale = true,
            Err(result) => return Err(GpuError::Vulkan { doing: "presenting to the window", result }),
        }
        Ok(ticket)
    }

    fn capabilities(&self) -> Result<vk::SurfaceCapabilitiesKHR, GpuError> {
        let physical = self.gpu.physical_device();
        // SAFETY: surface and device belong to the instance.
        let got = unsafe { self.surfaces.get_physical_device_surface_capabilities(physical, self.surface) };
        got.doing("asking for the window's size")
    }

    fn make(&mut self, capabilities: &vk::SurfaceCapabilitiesKHR, extent: [u32; 2]) -> Result<(), GpuError> {
        let most = if capabilities.max_image_count == 0 { u32::MAX } else { capabilities.max_image_count };
        let info = vk::SwapchainCreateInfoKHR::default()
            .surface(self.surface)
            .min_image_count((capabilities.min_image_count + 1).min(most))
            .image_format(self.format.format)
            .image_color_space(self.format.color_space)
            .image_extent(vk::Extent2D { width: extent[0], height: extent[1] })
            .image_array_layers(1)
            .image_usage(vk::ImageUsageFlags::COLOR_ATTACHMENT)
            .image_sharing_mode(vk::SharingMode::EXCLUSIVE)
            .pre_transform(capabilities.current_transform)
            .composite_alpha(composite_alpha(capabilities))
            .present_mode(vk::PresentModeKHR::FIFO)
            .clipped(true)
            .old_swapchain(self.handle);
        // SAFETY: the surface is alive, and what the info says is within its capabilities.
        let made = unsafe { self.functions.create_swapchain(&info, None) }.doing("creating the swapchain")?;
        self.retire();
        self.handle = made;
        // SAFETY: the swapchain was just made.
        let images = unsafe { self.functions.get_swapchain_images(made) };
        let desc =
            ImageDesc::new("window", extent, self.format.format, vk::ImageUsageFlags::COLOR_ATTACHMENT);
        for image in images.doing("listing the swapchain's images")? {
            let foreign = [Foreign { image, desc: &desc, index: 0 }];
            let target = Framebuffer::around_foreign_images(&self.gpu, &self.pass, extent, &foreign, &[])?;
            self.targets.push(target);
        }
        while self.drawn.len() < self.targets.len() {
            self.drawn.push(semaphore(&self.gpu)?);
        }
        (self.extent, self.is_stale) = (extent, false);
        Ok(())
    }

    /// Gives the old swapchain and what draws into it to the retire ring.
    fn retire(&mut self) {
        self.targets.clear();
        if self.handle != vk::SwapchainKHR::null() {
            self.gpu.retire(Garbage::Swapchain(self.functions.clone().into(), self.handle));
        }
    }
}

impl Drop for Swapchain {
    fn drop(&mut self) {
        self.gpu.wait_idle();
        self.targets.clear();
        // SAFETY: the window goes and the device is idle: nothing uses these any more.
        unsafe {
            self.functions.destroy_swapchain(self.handle, None);
            self.gpu.device().destroy_semaphore(self.acquired, None);
            self.drawn.drain(..).for_each(|s| self.gpu.device().destroy_semaphore(s, None));
        }
        // The ring is emptied in order: what is left of older swapchains goes before their surface does.
        self.gpu.retire(Garbage::Surface(self.surfaces.clone().into(), self.surface));
    }
}

fn semaphore(gpu: &Gpu) -> Result<vk::Semaphore, GpuError> {
    // SAFETY: the device is alive.
    unsafe { gpu.device().create_semaphore(&vk::SemaphoreCreateInfo::default(), None) }
        .doing("creating a semaphore")
}

fn is_srgb(format: vk::Format) -> bool {
    matches!(format, vk::Format::B8G8R8A8_SRGB | vk::Format::R8G8B8A8_SRGB)
}

/// 8-bit sRGB where there is such a format; any other is written with coded values.
fn choose_format(
    gpu: &Gpu,
    surfaces: &khr::surface::Instance,
    surface: vk::SurfaceKHR,
) -> Result<vk::SurfaceFormatKHR, GpuError> {
    let physical = gpu.physical_device();
    // SAFETY: surface and device belong to the instance.
    let (can, formats) = unsafe {
        let can = surfaces.get_physical_device_surface_support(physical, gpu.queue_family(), surface);
        (can, surfaces.get_physical_device_surface_formats(physical, surface))
    };
    if !can.doing("asking whether the device can present")? {
        let name = gpu.device_name();
        return Err(GpuError::NoDevice(format!("{name} cannot present to this window; choose another one")));
    }
    let formats = formats.doing("listing the window's formats")?;
    let best = formats.iter().find(|f| is_srgb(f.format)).or(formats.first());
    best.copied().ok_or_else(|| GpuError::NoDevice("the window has no format".into()))
}

fn composite_alpha(capabilities: &vk::SurfaceCapabilitiesKHR) -> vk::CompositeAlphaFlagsKHR {
    let opaque = vk::CompositeAlphaFlagsKHR::OPAQUE;
    let has = capabilities.supported_composite_alpha;
    if has.contains(opaque) { opaque } else { vk::CompositeAlphaFlagsKHR::INHERIT }
}

/// The window's own size, or where it has none the wanted one.
fn extent_of(capabilities: &vk::SurfaceCapabilitiesKHR, wanted: [u32; 2]) -> [u32; 2] {
    let (own, least, most) =
        (capabilities.current_extent, capabilities.min_image_extent, capabilities.max_image_extent);
    if own.width != u32::MAX {
        return [own.width, own.height];
    }
    let fit = |side: u32, least: u32, most: u32| side.clamp(least, most.max(least));
    [fit(wanted[0], least.width, most.width), fit(wanted[1], least.height, most.height)]
}

fn present_pass(format: vk::Format) -> RenderPassDesc {
    RenderPassDesc::new(vec![Attachment {
        format,
        load: vk::AttachmentLoadOp::DONT_CARE,
        store: vk::AttachmentStoreOp::STORE,
        before: vk::ImageLayout::UNDEFINED,
        after: vk::ImageLayout::PRESENT_SRC_KHR,
    }])
}
