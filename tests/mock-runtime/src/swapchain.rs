//! Swapchains: images that the runtime owns and the application draws into, in the order acquire, wait, release.

use std::collections::VecDeque;

use ash::vk;
use openxr_sys as xr;
use xr::Handle as _;

use crate::config::MAX_EXTENT_PIXELS;
use crate::fault::{CallResult, Fault};
use crate::ffi::{self, entry};
use crate::foveation;
use crate::gpu::{Gpu, GpuImage, ImageInfo};
use crate::runtime::{self, Extensions, Session};

/// Formats of swapchains, the preferred ones first: colour, then depth, of which every device has both.
const FORMATS: [vk::Format; 4] =
    [vk::Format::R8G8B8A8_SRGB, vk::Format::B8G8R8A8_SRGB, vk::Format::D32_SFLOAT, vk::Format::D16_UNORM];

/// Images of a swapchain that is not static.
const IMAGE_COUNT: u32 = 3;

/// A swapchain of the session's.
pub(crate) struct Swapchain {
    pub(crate) extent: [u32; 2],
    pub(crate) array_size: u32,
    pub(crate) images: ImageQueue,
    /// The profile of fixed foveation that it was given last; 0: none.
    pub(crate) foveation_profile: u64,
    format: vk::Format,
    gpu_images: Vec<SwapchainImage>,
}

struct SwapchainImage {
    image: GpuImage,
    /// Where fewer fragments are enough; made where the application asks for it.
    density_map: Option<GpuImage>,
    /// True once the image is in the layout in which the application gets it, which its first acquire sees to.
    in_layout: bool,
}

impl Swapchain {
    pub(crate) fn image(&self, index: u32) -> vk::Image {
        self.gpu_images[index as usize].image.image
    }

    /// True where it holds depths.
    pub(crate) fn is_depth(&self) -> bool {
        is_depth(self.format)
    }

    /// True where a texel's first byte is blue.
    pub(crate) fn blue_first(&self) -> bool {
        self.format == vk::Format::B8G8R8A8_SRGB
    }

    pub(crate) fn destroy(self, gpu: &Gpu) {
        for image in self.gpu_images {
            gpu.destroy_image(image.image);
            image.density_map.into_iter().for_each(|map| gpu.destroy_image(map));
        }
    }

    pub(crate) fn has_density_maps(&self) -> bool {
        self.gpu_images.iter().all(|image| image.density_map.is_some())
    }
}

fn is_depth(format: vk::Format) -> bool {
    matches!(format, vk::Format::D32_SFLOAT | vk::Format::D16_UNORM)
}

/// Who holds which image: the application acquires them in turn, waits for the oldest and releases it.
#[derive(Clone, Debug)]
pub(crate) struct ImageQueue {
    count: u32,
    next: u32,
    acquired: VecDeque<u32>,
    /// The oldest acquired image was waited for.
    waited: bool,
    last_released: Option<u32>,
    /// How often one was.
    releases: u64,
    /// Only one acquire is allowed, ever.
    is_static: bool,
    was_acquired: bool,
}

impl ImageQueue {
    fn new(count: u32, is_static: bool) -> Self {
        Self {
            count,
            next: 0,
            acquired: VecDeque::new(),
            waited: false,
            last_released: None,
            releases: 0,
            is_static,
            was_acquired: false,
        }
    }

    fn acquire(&mut self) -> CallResult<u32> {
        if self.is_static && self.was_acquired {
            return Err(Fault::order("a static swapchain's image is acquired once only"));
        }
        if self.acquired.len() as u32 == self.count {
            return Err(Fault::order("all images are acquired; release one before acquiring another"));
        }
        let index = self.next;
        self.next = (self.next + 1) % self.count;
        self.acquired.push_back(index);
        self.was_acquired = true;
        Ok(index)
    }

    fn wait(&mut self) -> CallResult<()> {
        if self.acquired.is_empty() {
            return Err(Fault::order("no image is acquired; call xrAcquireSwapchainImage first"));
        }
        if self.waited {
            return Err(Fault::order("the oldest acquired image was waited for already; release it first"));
        }
        self.waited = true;
        Ok(())
    }

    fn release(&mut self) -> CallResult<()> {
        if !self.waited {
            return Err(Fault::order("no image was waited for; call xrWaitSwapchainImage first"));
        }
        self.waited = false;
        self.last_released = self.acquired.pop_front();
        self.releases += 1;
        Ok(())
    }

    /// The image that layers show.
    pub(crate) fn last_released(&self) -> Option<u32> {
        self.last_released
    }

    /// The number of that release: another image has another one, and so has the same image that was drawn to again.
    pub(crate) fn releases(&self) -> u64 {
        self.releases
    }
}

entry! {
    enumerate_swapchain_formats: EnumerateSwapchainFormats = "xrEnumerateSwapchainFormats"(
        session: value xr::Session,
        capacity: value u32,
        count: raw_out u32,
        formats: raw_out i64,
    ) {
        runtime::lock().session(session)?;
        // SAFETY: count and formats are the caller's, of the capacity it says.
        unsafe {
            ffi::enumerate((capacity, count, formats), &FORMATS, |slot, format| {
                *slot = i64::from(format.as_raw());
            })
        }
    }
}

/// The images that a swapchain's creation asks for.
fn image_info(info: &xr::SwapchainCreateInfo) -> CallResult<ImageInfo> {
    let format =
        FORMATS.into_iter().find(|format| i64::from(format.as_raw()) == info.format).ok_or_else(|| {
            let message = format!("format {}; take one of xrEnumerateSwapchainFormats", info.format);
            Fault::application(xr::Result::ERROR_SWAPCHAIN_FORMAT_UNSUPPORTED, message)
        })?;
    let sizes = [info.width, info.height];
    let sizes_ok = sizes.iter().all(|side| (1..=MAX_EXTENT_PIXELS).contains(side));
    let counts_ok = info.array_size > 0 && info.mip_count > 0 && info.sample_count > 0;
    if !sizes_ok || !counts_ok {
        let message =
            format!("{sizes:?} pixels (1 to {MAX_EXTENT_PIXELS}), and all counts above 0, are needed");
        return Err(Fault::usage(message));
    }
    let unsupported = |what: &str| Err(Fault::application(xr::Result::ERROR_FEATURE_UNSUPPORTED, what));
    if info.face_count != 1 {
        return unsupported("faceCount must be 1: there are no cube swapchains");
    }
    if info.sample_count != 1 {
        return unsupported("sampleCount must be 1: resolve in the render pass");
    }
    if info.create_flags.contains(xr::SwapchainCreateFlags::PROTECTED_CONTENT) {
        return unsupported("there is no protected content");
    }
    let mutable = info.usage_flags.contains(xr::SwapchainUsageFlags::MUTABLE_FORMAT);
    Ok(ImageInfo {
        format,
        extent: sizes,
        array_size: info.array_size,
        mip_count: info.mip_count,
        usage: vulkan_usage(info.usage_flags, is_depth(format))?,
        is_depth: is_depth(format),
        mutable_format: mutable,
    })
}

/// The application's usages, and those that the runtime needs itself: the attachment's, for the layout in which images
/// are handed over, TRANSFER_SRC for captures.
fn vulkan_usage(flags: xr::SwapchainUsageFlags, is_depth: bool) -> CallResult<vk::ImageUsageFlags> {
    type Xr = xr::SwapchainUsageFlags;
    type Vk = vk::ImageUsageFlags;
    let (wrong, message) = match is_depth {
        true => (
            Xr::COLOR_ATTACHMENT | Xr::UNORDERED_ACCESS,
            "neither COLOR_ATTACHMENT nor UNORDERED_ACCESS goes with a depth format",
        ),
        false => (Xr::DEPTH_STENCIL_ATTACHMENT, "DEPTH_STENCIL_ATTACHMENT does not go with a colour format"),
    };
    if flags.intersects(wrong) {
        return Err(Fault::application(xr::Result::ERROR_FEATURE_UNSUPPORTED, message));
    }
    let attachment = if is_depth { Vk::DEPTH_STENCIL_ATTACHMENT } else { Vk::COLOR_ATTACHMENT };
    let pairs = [
        (Xr::COLOR_ATTACHMENT, Vk::COLOR_ATTACHMENT),
        (Xr::DEPTH_STENCIL_ATTACHMENT, Vk::DEPTH_STENCIL_ATTACHMENT),
        (Xr::UNORDERED_ACCESS, Vk::STORAGE),
        (Xr::TRANSFER_SRC, Vk::TRANSFER_SRC),
        (Xr::TRANSFER_DST, Vk::TRANSFER_DST),
        (Xr::SAMPLED, Vk::SAMPLED),
        (Xr::INPUT_ATTACHMENT, Vk::INPUT_ATTACHMENT),
    ];
    let asked = pairs.into_iter().filter(|(xr, _)| flags.contains(*xr)).map(|(_, vk)| vk);
    Ok(asked.fold(attachment | Vk::TRANSFER_SRC, |all, usage| all | usage))
}

entry! {
    create_swapchain: CreateSwapchain = "xrCreateSwapchain"(
        session: value xr::Session,
        create_info: input xr::SwapchainCreateInfo,
        swapchain: slot xr::Swapchain,
    ) {
        let mut runtime = runtime::lock();
        let handle = runtime.new_handle();
        let (core, session) = runtime.session(session)?;
        let info = image_info(create_info)?;
        let has_maps = wants_density_maps(create_info, core.extensions)?;
        let is_static = create_info.create_flags.contains(xr::SwapchainCreateFlags::STATIC_IMAGE);
        let count = if is_static { 1 } else { IMAGE_COUNT };
        session.swapchains.insert(handle, new_swapchain(&session.gpu, &info, count, (is_static, has_maps))?);
        *swapchain = xr::Swapchain::from_raw(handle);
        Ok(xr::Result::SUCCESS)
    }
}

/// Whether a swapchain's creation asks for density maps.
fn wants_density_maps(info: &xr::SwapchainCreateInfo, extensions: Extensions) -> CallResult<bool> {
    // SAFETY: the chain is the application's, of valid structures.
    let asked = unsafe { ffi::chained_input::<xr::SwapchainCreateInfoFoveationFB>(info.next) };
    // Structures of extensions that are not enabled are left out.
    let Some(asked) = asked.filter(|_| extensions.foveation) else { return Ok(false) };
    type Flags = xr::SwapchainCreateFoveationFlagsFB;
    if asked.flags.intersects(Flags::SCALED_BIN) || (!asked.flags.is_empty() && !extensions.foveation_vulkan)
    {
        let message = "flags other than FRAGMENT_DENSITY_MAP (XR_FB_foveation_vulkan) do not go with Vulkan";
        return Err(Fault::application(xr::Result::ERROR_VALIDATION_FAILURE, message));
    }
    Ok(asked.flags.contains(Flags::FRAGMENT_DENSITY_MAP))
}

fn density_map(gpu: &Gpu, of: &ImageInfo) -> CallResult<GpuImage> {
    gpu.create_image(&ImageInfo {
        format: foveation::FORMAT,
        extent: foveation::map_extent(of.extent),
        array_size: of.array_size,
        mip_count: 1,
        usage: vk::ImageUsageFlags::SAMPLED | vk::ImageUsageFlags::TRANSFER_DST,
        mutable_format: false,
        is_depth: false,
    })
}

fn new_swapchain(
    gpu: &Gpu,
    info: &ImageInfo,
    count: u32,
    (is_static, has_maps): (bool, bool),
) -> CallResult<Swapchain> {
    let mut swapchain = Swapchain {
        extent: info.extent,
        array_size: info.array_size,
        images: ImageQueue::new(count, is_static),
        foveation_profile: 0,
        format: info.format,
        gpu_images: Vec::new(),
    };
    let image = || {
        let image = gpu.create_image(info)?;
        match has_maps.then(|| density_map(gpu, info)).transpose() {
            Ok(density_map) => Ok(SwapchainImage { image, density_map, in_layout: false }),
            Err(fault) => {
                gpu.destroy_image(image);
                Err(fault)
            }
        }
    };
    for _ in 0..count {
        match image() {
            Ok(image) => swapchain.gpu_images.push(image),
            Err(fault) => {
                swapchain.destroy(gpu);
                return Err(fault);
            }
        }
    }
    Ok(swapchain)
}

entry! {
    destroy_swapchain: DestroySwapchain = "xrDestroySwapchain"(swapchain: value xr::Swapchain) {
        let mut runtime = runtime::lock();
        let session = runtime.instance.as_mut().and_then(|instance| instance.session.as_mut());
        let session = session.ok_or_else(|| Fault::handle("swapchain"))?;
        let removed = session.swapchains.remove(&swapchain.into_raw()).ok_or_else(|| Fault::handle("swapchain"))?;
        removed.destroy(&session.gpu);
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    enumerate_swapchain_images: EnumerateSwapchainImages = "xrEnumerateSwapchainImages"(
        swapchain: value xr::Swapchain,
        capacity: value u32,
        count: raw_out u32,
        images: raw_out xr::SwapchainImageBaseHeader,
    ) {
        let mut runtime = runtime::lock();
        let (core, session) = runtime.session_of_swapchain(swapchain)?;
        let tells_maps = core.extensions.foveation_vulkan;
        let images = images.cast::<xr::SwapchainImageVulkanKHR>();
        let swapchain = swapchain_of(session, swapchain)?.0;
        let [width, height] = foveation::map_extent(swapchain.extent);
        let ours = &swapchain.gpu_images;
        // SAFETY: with the Vulkan extension the array consists of XrSwapchainImageVulkan2KHR; it is the caller's, of the
        // capacity it says.
        unsafe {
            ffi::enumerate((capacity, count, images), ours, |slot, ours| {
                slot.image = vk::Handle::as_raw(ours.image.image);
                let map = ours.density_map.as_ref().filter(|_| tells_maps);
                // Each element has a chain of its own, of the caller's.
                let place = ffi::chained_output::<xr::SwapchainImageFoveationVulkanFB>(slot.next);
                if let (Some(map), Some(place)) = (map, place) {
                    place.image = vk::Handle::as_raw(map.image);
                    (place.width, place.height) = (width, height);
                }
            })
        }
    }
}

pub(crate) fn swapchain_of(
    session: &mut Session,
    handle: xr::Swapchain,
) -> CallResult<(&mut Swapchain, &mut Gpu)> {
    let Session { swapchains, gpu, .. } = session;
    let swapchain = swapchains.get_mut(&handle.into_raw()).ok_or_else(|| Fault::handle("swapchain"))?;
    Ok((swapchain, gpu))
}

entry! {
    acquire_swapchain_image: AcquireSwapchainImage = "xrAcquireSwapchainImage"(
        swapchain: value xr::Swapchain,
        acquire_info: optional xr::SwapchainImageAcquireInfo,
        index: slot u32,
    ) {
        let _ = acquire_info;
        let mut runtime = runtime::lock();
        let (_, session) = runtime.session_of_swapchain(swapchain)?;
        let (swapchain, gpu) = swapchain_of(session, swapchain)?;
        let acquired = swapchain.images.acquire()?;
        let image = &mut swapchain.gpu_images[acquired as usize];
        if !image.in_layout {
            gpu.hand_over(&image.image)?;
            image.in_layout = true;
        }
        *index = acquired;
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    wait_swapchain_image: WaitSwapchainImage = "xrWaitSwapchainImage"(
        swapchain: value xr::Swapchain,
        wait_info: input xr::SwapchainImageWaitInfo,
    ) {
        // Captures are read back before xrEndFrame returns, so the runtime is never still reading an image.
        let _ = wait_info.timeout;
        let mut runtime = runtime::lock();
        let (_, session) = runtime.session_of_swapchain(swapchain)?;
        swapchain_of(session, swapchain)?.0.images.wait()?;
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    release_swapchain_image: ReleaseSwapchainImage = "xrReleaseSwapchainImage"(
        swapchain: value xr::Swapchain,
        release_info: optional xr::SwapchainImageReleaseInfo,
    ) {
        let _ = release_info;
        let mut runtime = runtime::lock();
        let (_, session) = runtime.session_of_swapchain(swapchain)?;
        swapchain_of(session, swapchain)?.0.images.release()?;
        Ok(xr::Result::SUCCESS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn refused<T: std::fmt::Debug>(outcome: CallResult<T>) {
        assert_eq!(outcome.expect_err("out of order").code, xr::Result::ERROR_CALL_ORDER_INVALID);
    }

    #[test]
    fn images_come_in_turn_and_the_oldest_is_released_first() {
        let mut queue = ImageQueue::new(3, false);
        assert_eq!(queue.last_released(), None);
        for round in 0..7 {
            assert_eq!(queue.acquire().expect("free"), round % 3);
            queue.wait().expect("acquired");
            queue.release().expect("waited");
            assert_eq!(queue.last_released(), Some(round % 3));
        }
    }

    #[test]
    fn wait_release_and_acquire_out_of_order_are_refused() {
        let mut queue = ImageQueue::new(2, false);
        refused(queue.wait());
        refused(queue.release());
        queue.acquire().expect("free");
        refused(queue.release());
        queue.acquire().expect("free");
        refused(queue.acquire());
        queue.wait().expect("acquired");
        refused(queue.wait());
        queue.release().expect("waited");
        assert_eq!(queue.last_released(), Some(0));
    }

    #[test]
    fn a_static_swapchain_is_acquired_once() {
        let mut queue = ImageQueue::new(1, true);
        queue.acquire().expect("first");
        queue.wait().expect("acquired");
        queue.release().expect("waited");
        refused(queue.acquire());
    }
}
