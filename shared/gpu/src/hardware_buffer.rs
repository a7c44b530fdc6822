//! Pictures in the memory of Android's own buffers (`AHardwareBuffer`), as its decoders write them.

use crate::ycbcr::{YcbcrFormat, YcbcrImage, YcbcrSampler};
use crate::{Doing, Gpu, GpuError};
use ash::android::external_memory_android_hardware_buffer as extension;
use ash::vk;
use std::sync::Arc;

/// The format's number, zero for one of Vulkan's own.
pub(crate) fn external_format(format: YcbcrFormat) -> vk::ExternalFormatANDROID<'static> {
    let number = match format {
        YcbcrFormat::Known(_) => 0,
        YcbcrFormat::External(number, _) => number,
    };
    vk::ExternalFormatANDROID::default().external_format(number)
}

/// What a buffer is to the device.
#[derive(Clone, Copy, Debug)]
pub struct HardwareBufferKind {
    /// Its texels: what a sampler must be made for.
    pub format: YcbcrFormat,
    bytes: u64,
    memory_types: u32,
}

impl HardwareBufferKind {
    /// Asks the device.
    ///
    /// # Errors
    /// It cannot use the buffer.
    ///
    /// # Safety
    /// `buffer` is alive, and `gpu` was opened for pictures.
    pub unsafe fn of(gpu: &Gpu, buffer: *const vk::AHardwareBuffer) -> Result<Self, GpuError> {
        let functions = extension::Device::new(gpu.instance(), gpu.device());
        let mut format = vk::AndroidHardwareBufferFormatPropertiesANDROID::default();
        let mut properties = vk::AndroidHardwareBufferPropertiesANDROID::default().push_next(&mut format);
        // SAFETY: the caller's; the structs live through the call.
        let asked = unsafe { functions.get_android_hardware_buffer_properties(buffer, &mut properties) };
        asked.doing("asking what a decoder's buffer is")?;
        let (bytes, memory_types) = (properties.allocation_size, properties.memory_type_bits);
        let format = match format.external_format {
            0 => YcbcrFormat::Known(format.format),
            number => YcbcrFormat::External(number, format.format_features),
        };
        Ok(Self { format, bytes, memory_types })
    }
}

impl YcbcrImage {
    /// An image in the buffer's memory, which it keeps alive.
    ///
    /// # Errors
    /// The device refuses.
    ///
    /// # Safety
    /// `buffer` is alive, has `extent_texels` and was found to be of `kind`; `sampler` is one of its format.
    pub unsafe fn import(
        gpu: &Arc<Gpu>,
        (buffer, kind): (*mut vk::AHardwareBuffer, HardwareBufferKind),
        extent_texels: [u32; 2],
        sampler: &Arc<YcbcrSampler>,
    ) -> Result<Self, GpuError> {
        assert_eq!(sampler.format(), kind.format, "a sampler of another format");
        let mut external = external_format(kind.format);
        let mut of_android = vk::ExternalMemoryImageCreateInfo::default()
            .handle_types(vk::ExternalMemoryHandleTypeFlags::ANDROID_HARDWARE_BUFFER_ANDROID);
        let info = vk::ImageCreateInfo::default()
            .image_type(vk::ImageType::TYPE_2D)
            .format(kind.format.vulkan())
            .extent(vk::Extent3D { width: extent_texels[0], height: extent_texels[1], depth: 1 })
            .mip_levels(1)
            .array_layers(1)
            .samples(vk::SampleCountFlags::TYPE_1)
            .usage(vk::ImageUsageFlags::SAMPLED)
            .push_next(&mut of_android)
            .push_next(&mut external);
        // SAFETY: the device is alive; the rest is the caller's.
        let image = unsafe { gpu.device().create_image(&info, None) };
        let image = image.doing("creating an image around a decoder's buffer")?;
        // SAFETY: the image is new; the rest is the caller's.
        let memory = unsafe { import_memory(gpu, image, buffer, kind) };
        if memory.is_err() {
            // SAFETY: nothing uses it.
            unsafe { gpu.device().destroy_image(image, None) };
        }
        Self::imported(gpu, sampler, extent_texels, (image, memory?))
    }
}

/// The buffer's memory, bound to `image`.
///
/// # Safety
/// As for [`YcbcrImage::import`]; the image was made for such memory and has none.
unsafe fn import_memory(
    gpu: &Gpu,
    image: vk::Image,
    buffer: *mut vk::AHardwareBuffer,
    kind: HardwareBufferKind,
) -> Result<vk::DeviceMemory, GpuError> {
    let mut imported = vk::ImportAndroidHardwareBufferInfoANDROID::default().buffer(buffer);
    let mut of_image = vk::MemoryDedicatedAllocateInfo::default().image(image);
    let info = vk::MemoryAllocateInfo::default()
        .allocation_size(kind.bytes)
        .memory_type_index(kind.memory_types.trailing_zeros())
        .push_next(&mut imported)
        .push_next(&mut of_image);
    // SAFETY: the caller's; what the info points to lives through the call.
    unsafe {
        let memory = gpu.device().allocate_memory(&info, None).doing("importing a decoder's buffer")?;
        let bound = gpu.device().bind_image_memory(image, memory, 0);
        if bound.is_err() {
            gpu.device().free_memory(memory, None);
        }
        bound.doing("binding a decoder's buffer").map(|()| memory)
    }
}
