//! Buffers, images and samplers. Dropping one hands its handles to the retire ring; the fence destroys.

use crate::limits::{self, DeviceLimits};
use crate::{Doing, Gpu, GpuError};
use ash::vk;
use gpu_allocator::MemoryLocation;
use gpu_allocator::vulkan::{Allocation, AllocationCreateDesc, AllocationScheme};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Where a buffer lives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Memory {
    /// Device-local, not mapped.
    Device,
    /// Mapped, written by the CPU.
    Upload,
    /// Mapped and cached, read by the CPU.
    Readback,
}

impl Memory {
    const ALL: [Self; 3] = [Self::Device, Self::Upload, Self::Readback];

    /// What the names of its allocations end with.
    fn tag(self) -> &'static str {
        match self {
            Self::Device => "",
            Self::Upload => " <- CPU",
            Self::Readback => " -> CPU",
        }
    }

    fn location(self) -> MemoryLocation {
        match self {
            Self::Device => MemoryLocation::GpuOnly,
            Self::Upload => MemoryLocation::CpuToGpu,
            Self::Readback => MemoryLocation::GpuToCpu,
        }
    }
}

/// What memory is held for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MemoryUse {
    /// Name of the buffers or images.
    pub name: String,
    /// Where they are.
    pub memory: Memory,
    /// Bytes of all of this name.
    pub bytes: u64,
}

impl Gpu {
    /// What is held, by name; what was dropped counts until no submitted work can use it any more.
    pub fn memory(&self) -> Vec<MemoryUse> {
        let allocator = self.allocator.lock().expect("not poisoned");
        let report = allocator.as_ref().expect("alive until the device goes").generate_report();
        let mut uses: BTreeMap<(String, Memory), u64> = BTreeMap::new();
        for allocation in report.allocations {
            // Device memory has an empty tag, and is tried last.
            let tagged = Memory::ALL
                .into_iter()
                .rev()
                .find_map(|memory| Some((allocation.name.strip_suffix(memory.tag())?.to_owned(), memory)));
            *uses.entry(tagged.expect("every name ends with nothing")).or_default() += allocation.size;
        }
        uses.into_iter().map(|((name, memory), bytes)| MemoryUse { name, memory, bytes }).collect()
    }

    /// What the device's memory has given, in use or not, bytes.
    pub fn reserved_bytes(&self) -> u64 {
        let allocator = self.allocator.lock().expect("not poisoned");
        allocator.as_ref().expect("alive until the device goes").generate_report().total_capacity_bytes
    }
}

/// A buffer with its memory.
pub struct Buffer {
    gpu: Arc<Gpu>,
    pub(crate) handle: vk::Buffer,
    allocation: Option<Allocation>,
    size: u64,
}

/// What an image is.
#[derive(Clone, Copy, Debug)]
pub struct ImageDesc {
    /// For messages.
    pub name: &'static str,
    /// Width and height in texels.
    pub extent: [u32; 2],
    /// Array layers.
    pub layers: u32,
    /// Shaders see an array, also where it has one layer.
    pub is_array: bool,
    /// Mip levels.
    pub mips: u32,
    /// Samples per texel.
    pub samples: vk::SampleCountFlags,
    /// Format.
    pub format: vk::Format,
    /// Samplers see all of it in this format, as large as the other; levels keep that. Storage images have no sRGB formats.
    pub sampled_format: Option<vk::Format>,
    /// Usage.
    pub usage: vk::ImageUsageFlags,
}

impl ImageDesc {
    /// One layer, one mip level, one sample.
    pub fn new(name: &'static str, extent: [u32; 2], format: vk::Format, usage: vk::ImageUsageFlags) -> Self {
        let samples = vk::SampleCountFlags::TYPE_1;
        Self {
            name,
            extent,
            layers: 1,
            is_array: false,
            mips: 1,
            samples,
            format,
            sampled_format: None,
            usage,
        }
    }
}

/// An image with its memory and one view of all of it (a 2D view for one layer, an array view for more or where the description asks for it).
pub struct Image {
    gpu: Arc<Gpu>,
    pub(crate) handle: vk::Image,
    pub(crate) view: vk::ImageView,
    backing: Option<Backing>,
    desc: ImageDesc,
}

/// A view of one mip level of an image, of all of its layers, as an array. The image outlives its use.
pub struct ImageLevel {
    gpu: Arc<Gpu>,
    pub(crate) view: vk::ImageView,
}

/// Where an image's memory comes from.
pub(crate) enum Backing {
    /// The allocator.
    Allocation(Allocation),
    /// Memory of its own: lazily allocated for attachments that live within one pass, or a platform's.
    Own(vk::DeviceMemory),
}

/// How a texture is read.
#[derive(Clone, Copy, Debug)]
pub struct SamplerDesc {
    /// Magnification and minification.
    pub filter: vk::Filter,
    /// Addressing in u and v.
    pub wrap: [vk::SamplerAddressMode; 2],
    /// Mip levels in use, linear between them.
    pub mips: bool,
    /// Added to the mip level; below 0 is sharper.
    pub mip_bias: f32,
    /// Largest anisotropy; 1 is off.
    pub anisotropy: f32,
}

impl SamplerDesc {
    /// Of one level, to the edge and no further.
    pub fn clamped(filter: vk::Filter) -> Self {
        let wrap = [vk::SamplerAddressMode::CLAMP_TO_EDGE; 2];
        Self { filter, wrap, mips: false, mip_bias: 0.0, anisotropy: 1.0 }
    }
}

/// A sampler.
pub struct Sampler {
    gpu: Arc<Gpu>,
    pub(crate) handle: vk::Sampler,
}

/// Handles on their way out.
pub(crate) enum Garbage {
    Buffer(vk::Buffer, Option<Allocation>),
    Image(vk::Image, vk::ImageView, Option<Backing>),
    View(vk::ImageView),
    Sampler(vk::Sampler),
    YcbcrSampler(vk::Sampler, vk::SamplerYcbcrConversion),
    DescriptorPool(vk::DescriptorPool),
    Layout(vk::PipelineLayout, vk::DescriptorSetLayout),
    Pipeline(vk::Pipeline),
    RenderPass(vk::RenderPass),
    Framebuffer(vk::Framebuffer),
    #[cfg(feature = "window")]
    Swapchain(Box<ash::khr::swapchain::Device>, vk::SwapchainKHR),
    #[cfg(feature = "window")]
    Surface(Box<ash::khr::surface::Instance>, vk::SurfaceKHR),
}

impl Garbage {
    pub(crate) fn destroy(self, gpu: &Gpu) {
        let device = &gpu.device();
        // SAFETY: the handles were created from this device, are owned by this value alone, and the retire ring
        // calls this only after all work that could use them has finished.
        unsafe {
            match self {
                Self::Buffer(buffer, allocation) => {
                    device.destroy_buffer(buffer, None);
                    free(gpu, allocation);
                }
                Self::Image(image, view, backing) => {
                    device.destroy_image_view(view, None);
                    device.destroy_image(image, None);
                    match backing {
                        Some(Backing::Allocation(allocation)) => free(gpu, Some(allocation)),
                        Some(Backing::Own(memory)) => device.free_memory(memory, None),
                        None => {}
                    }
                }
                Self::View(view) => device.destroy_image_view(view, None),
                Self::Sampler(sampler) => device.destroy_sampler(sampler, None),
                Self::YcbcrSampler(sampler, conversion) => {
                    device.destroy_sampler(sampler, None);
                    device.destroy_sampler_ycbcr_conversion(conversion, None);
                }
                Self::DescriptorPool(pool) => device.destroy_descriptor_pool(pool, None),
                Self::Layout(layout, set) => {
                    device.destroy_pipeline_layout(layout, None);
                    device.destroy_descriptor_set_layout(set, None);
                }
                Self::Pipeline(pipeline) => device.destroy_pipeline(pipeline, None),
                Self::RenderPass(pass) => device.destroy_render_pass(pass, None),
                Self::Framebuffer(framebuffer) => device.destroy_framebuffer(framebuffer, None),
                #[cfg(feature = "window")]
                Self::Swapchain(functions, swapchain) => functions.destroy_swapchain(swapchain, None),
                #[cfg(feature = "window")]
                Self::Surface(functions, surface) => functions.destroy_surface(surface, None),
            }
        }
    }
}

fn free(gpu: &Gpu, allocation: Option<Allocation>) {
    let mut allocator = gpu.allocator.lock().expect("not poisoned");
    if let (Some(allocator), Some(allocation)) = (allocator.as_mut(), allocation) {
        // Freeing fails only for a foreign allocation, which this is not.
        let freed = allocator.free(allocation);
        debug_assert!(freed.is_ok());
    }
}

/// From this size on a buffer or image has memory of its own, bytes. Dropping it returns the memory. Within a shared block of
/// 64 or 256 MB it would stay as long as anything else lives there, and each session would leave some.
const OWN_MEMORY_BYTES: u64 = 4 << 20;

fn allocate(
    gpu: &Gpu,
    name: &str,
    requirements: vk::MemoryRequirements,
    memory: Memory,
    owner: AllocationScheme,
) -> Result<Allocation, GpuError> {
    let desc = AllocationCreateDesc {
        name: &format!("{name}{}", memory.tag()),
        requirements,
        location: memory.location(),
        linear: matches!(owner, AllocationScheme::DedicatedBuffer(_)),
        allocation_scheme: match requirements.size < OWN_MEMORY_BYTES {
            true => AllocationScheme::GpuAllocatorManaged,
            false => owner,
        },
    };
    let mut allocator = gpu.allocator.lock().expect("not poisoned");
    let allocator = allocator.as_mut().expect("alive until the device goes");
    allocator.allocate(&desc).map_err(|e| GpuError::Memory {
        name: name.into(),
        size: requirements.size,
        reason: e.to_string(),
    })
}

impl Buffer {
    /// A buffer of `size` bytes (at least 16), usable for everything this project does with buffers.
    pub fn new(gpu: &Arc<Gpu>, name: &str, size: u64, memory: Memory) -> Result<Self, GpuError> {
        let size = size.max(16).next_multiple_of(16);
        let usage = vk::BufferUsageFlags::STORAGE_BUFFER
            | vk::BufferUsageFlags::UNIFORM_BUFFER
            | vk::BufferUsageFlags::VERTEX_BUFFER
            | vk::BufferUsageFlags::INDEX_BUFFER
            | vk::BufferUsageFlags::TRANSFER_SRC
            | vk::BufferUsageFlags::TRANSFER_DST;
        let info = vk::BufferCreateInfo::default().size(size).usage(usage);
        // SAFETY: the device is alive; the memory bound comes from an allocation made for these requirements.
        unsafe {
            let handle = gpu.device().create_buffer(&info, None).doing("creating a buffer")?;
            let requirements = gpu.device().get_buffer_memory_requirements(handle);
            let owner = AllocationScheme::DedicatedBuffer(handle);
            let allocation = allocate(gpu, name, requirements, memory, owner)?;
            gpu.device()
                .bind_buffer_memory(handle, allocation.memory(), allocation.offset())
                .doing("binding a buffer's memory")?;
            Ok(Self { gpu: gpu.clone(), handle, allocation: Some(allocation), size })
        }
    }

    /// A mapped buffer that holds `data`.
    pub fn upload<T: bytemuck::Pod>(gpu: &Arc<Gpu>, name: &str, data: &[T]) -> Result<Self, GpuError> {
        let bytes: &[u8] = bytemuck::cast_slice(data);
        let mut buffer = Self::new(gpu, name, bytes.len() as u64, Memory::Upload)?;
        buffer.write(0, bytes);
        Ok(buffer)
    }

    /// A device-local buffer that holds `data`, copied through a staging buffer; waits for the copy.
    pub fn device_local<T: bytemuck::Pod>(gpu: &Arc<Gpu>, name: &str, data: &[T]) -> Result<Self, GpuError> {
        let staging = Self::upload(gpu, name, data)?;
        let buffer = Self::new(gpu, name, staging.size, Memory::Device)?;
        let mut recorder = gpu.record()?;
        recorder.copy_buffer(&staging, 0, &buffer, 0, staging.size);
        gpu.wait(recorder.submit()?)?;
        Ok(buffer)
    }

    /// Size in bytes.
    pub fn size(&self) -> u64 {
        self.size
    }

    /// The mapped bytes.
    ///
    /// # Panics
    /// The buffer is device-local: a mistake of ours.
    pub fn bytes(&self) -> &[u8] {
        self.allocation.as_ref().and_then(|a| a.mapped_slice()).expect("a mapped buffer")
    }

    /// The mapped bytes as values.
    pub fn values<T: bytemuck::Pod>(&self) -> &[T] {
        bytemuck::cast_slice(self.bytes())
    }

    /// The mapped bytes, to write. The caller knows that no submitted work reads them.
    pub fn bytes_mut(&mut self) -> &mut [u8] {
        self.allocation.as_mut().and_then(|a| a.mapped_slice_mut()).expect("a mapped buffer")
    }

    /// Writes `bytes` at `offset`. The caller knows that no submitted work reads them.
    pub fn write(&mut self, offset: usize, bytes: &[u8]) {
        self.bytes_mut()[offset..offset + bytes.len()].copy_from_slice(bytes);
    }

    /// The Vulkan handle.
    pub fn handle(&self) -> vk::Buffer {
        self.handle
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        self.gpu.retire(Garbage::Buffer(self.handle, self.allocation.take()));
    }
}

impl Image {
    /// An image in layout UNDEFINED. One with usage TRANSIENT_ATTACHMENT gets lazily allocated memory where there is any.
    pub fn new(gpu: &Arc<Gpu>, desc: ImageDesc) -> Result<Self, GpuError> {
        Self::allocated(gpu, desc, YcbcrView(None))
    }

    /// The same, seen through a conversion where there is one.
    pub(crate) fn allocated(gpu: &Arc<Gpu>, desc: ImageDesc, view: YcbcrView) -> Result<Self, GpuError> {
        check_extent(gpu.limits(), &desc)?;
        let flags = match desc.sampled_format {
            Some(_) => vk::ImageCreateFlags::MUTABLE_FORMAT | vk::ImageCreateFlags::EXTENDED_USAGE,
            None => vk::ImageCreateFlags::empty(),
        };
        let info = vk::ImageCreateInfo::default()
            .flags(flags)
            .image_type(vk::ImageType::TYPE_2D)
            .format(desc.format)
            .extent(vk::Extent3D { width: desc.extent[0], height: desc.extent[1], depth: 1 })
            .mip_levels(desc.mips)
            .array_layers(desc.layers)
            .samples(desc.samples)
            .usage(desc.usage);
        // SAFETY: the device is alive; the memory bound comes from an allocation made for these requirements.
        unsafe {
            let handle = gpu.device().create_image(&info, None).doing("creating an image")?;
            let requirements = gpu.device().get_image_memory_requirements(handle);
            let backing = image_backing(gpu, &desc, handle, requirements)?;
            let (memory, offset) = match &backing {
                Backing::Allocation(allocation) => (allocation.memory(), allocation.offset()),
                Backing::Own(memory) => (*memory, 0),
            };
            gpu.device().bind_image_memory(handle, memory, offset).doing("binding an image's memory")?;
            Self::around(gpu, desc, handle, backing, view)
        }
    }

    /// What owns `handle`, which has its memory.
    pub(crate) fn around(
        gpu: &Arc<Gpu>,
        desc: ImageDesc,
        handle: vk::Image,
        backing: Backing,
        view: YcbcrView,
    ) -> Result<Self, GpuError> {
        let view = create_view(gpu, handle, &desc, (0, desc.layers), view);
        // A null view is none to destroy.
        let made = Self {
            gpu: gpu.clone(),
            handle,
            view: view.as_ref().copied().unwrap_or_default(),
            backing: Some(backing),
            desc,
        };
        view.map(|_| made)
    }

    /// What it was made with.
    pub fn desc(&self) -> &ImageDesc {
        &self.desc
    }

    /// The Vulkan handle.
    pub fn handle(&self) -> vk::Image {
        self.handle
    }

    /// The view of the whole image.
    pub fn view(&self) -> vk::ImageView {
        self.view
    }

    /// A mip level of it, for shaders that write it.
    ///
    /// # Errors
    /// Those of the device.
    pub fn level(&self, level: u32) -> Result<ImageLevel, GpuError> {
        let range = vk::ImageSubresourceRange { base_mip_level: level, level_count: 1, ..self.whole() };
        let info = vk::ImageViewCreateInfo::default()
            .image(self.handle)
            .view_type(vk::ImageViewType::TYPE_2D_ARRAY)
            .format(self.desc.format)
            .subresource_range(range);
        // SAFETY: the image is alive and has the level, which the validation layers check in tests.
        let view = unsafe { self.gpu.device().create_image_view(&info, None) };
        Ok(ImageLevel { gpu: self.gpu.clone(), view: view.doing("creating a view of a mip level")? })
    }

    /// All of it, for barriers.
    pub fn whole(&self) -> vk::ImageSubresourceRange {
        whole(&self.desc, 0, self.desc.layers)
    }
}

/// That the device has images as large.
fn check_extent(limits: &DeviceLimits, desc: &ImageDesc) -> Result<(), GpuError> {
    let ImageDesc { name, extent: [width, height], layers, usage, .. } = desc;
    let what = format!("the image \"{name}\" of {width}x{height} texels");
    let check = |limit, needed: u32| limits::check(limits, limit, &what, needed.into(), "use a smaller one");
    check("maxImageDimension2D", *width.max(height))?;
    check("maxImageArrayLayers", *layers)?;
    if usage.intersects(vk::ImageUsageFlags::COLOR_ATTACHMENT | vk::ImageUsageFlags::DEPTH_STENCIL_ATTACHMENT)
    {
        check("maxFramebufferWidth", *width)?;
        check("maxFramebufferHeight", *height)?;
        check("maxViewportDimensions[0]", *width)?;
        check("maxViewportDimensions[1]", *height)?;
    }
    Ok(())
}

impl Drop for Image {
    fn drop(&mut self) {
        self.gpu.retire(Garbage::Image(self.handle, self.view, self.backing.take()));
    }
}

impl Drop for ImageLevel {
    fn drop(&mut self) {
        self.gpu.retire(Garbage::View(self.view));
    }
}

fn image_backing(
    gpu: &Gpu,
    desc: &ImageDesc,
    handle: vk::Image,
    requirements: vk::MemoryRequirements,
) -> Result<Backing, GpuError> {
    let lazy = match desc.usage.contains(vk::ImageUsageFlags::TRANSIENT_ATTACHMENT) {
        true => lazy_memory_type(gpu, requirements.memory_type_bits),
        false => None,
    };
    let Some(memory_type_index) = lazy else {
        let owner = AllocationScheme::DedicatedImage(handle);
        let allocation = allocate(gpu, desc.name, requirements, Memory::Device, owner)?;
        return Ok(Backing::Allocation(allocation));
    };
    let info = vk::MemoryAllocateInfo::default()
        .allocation_size(requirements.size)
        .memory_type_index(memory_type_index);
    // SAFETY: the device is alive, and the type is one of its own that the image can use.
    let memory = unsafe { gpu.device().allocate_memory(&info, None) };
    Ok(Backing::Own(memory.doing("allocating lazy memory for an attachment")?))
}

fn lazy_memory_type(gpu: &Gpu, allowed: u32) -> Option<u32> {
    // SAFETY: the physical device belongs to the instance.
    let properties = unsafe { gpu.instance().get_physical_device_memory_properties(gpu.physical_device()) };
    let lazy = vk::MemoryPropertyFlags::LAZILY_ALLOCATED;
    (0..properties.memory_type_count).find(|&index| {
        let flags = properties.memory_types[index as usize].property_flags;
        allowed & 1 << index != 0 && flags.contains(lazy)
    })
}

fn whole(desc: &ImageDesc, first_layer: u32, layers: u32) -> vk::ImageSubresourceRange {
    let depth = matches!(desc.format, vk::Format::D32_SFLOAT | vk::Format::D16_UNORM);
    let aspect = if depth { vk::ImageAspectFlags::DEPTH } else { vk::ImageAspectFlags::COLOR };
    vk::ImageSubresourceRange {
        aspect_mask: aspect,
        base_mip_level: 0,
        level_count: desc.mips,
        base_array_layer: first_layer,
        layer_count: layers,
    }
}

/// By what an image's view is converted, where it is.
#[derive(Clone, Copy)]
pub(crate) struct YcbcrView(pub(crate) Option<vk::SamplerYcbcrConversion>);

/// A view of so many layers, from the first on, of an image made with `desc`.
pub(crate) fn create_view(
    gpu: &Gpu,
    image: vk::Image,
    desc: &ImageDesc,
    (first_layer, layers): (u32, u32),
    view: YcbcrView,
) -> Result<vk::ImageView, GpuError> {
    let kind = match layers == 1 && !desc.is_array {
        true => vk::ImageViewType::TYPE_2D,
        false => vk::ImageViewType::TYPE_2D_ARRAY,
    };
    let with = |conversion| vk::SamplerYcbcrConversionInfo::default().conversion(conversion);
    let mut conversion = view.0.map(with);
    let mut usage = vk::ImageViewUsageCreateInfo::default().usage(vk::ImageUsageFlags::SAMPLED);
    let mut info = vk::ImageViewCreateInfo::default()
        .image(image)
        .view_type(kind)
        .format(desc.sampled_format.unwrap_or(desc.format))
        .subresource_range(whole(desc, first_layer, layers));
    if let Some(conversion) = &mut conversion {
        info = info.push_next(conversion);
    }
    if desc.sampled_format.is_some() {
        info = info.push_next(&mut usage);
    }
    // SAFETY: the image is alive and has the layers and mips that its description says.
    unsafe { gpu.device().create_image_view(&info, None) }.doing("creating an image view")
}

impl Sampler {
    /// A sampler.
    pub fn new(gpu: &Arc<Gpu>, desc: SamplerDesc) -> Result<Self, GpuError> {
        let info = vk::SamplerCreateInfo::default()
            .mag_filter(desc.filter)
            .min_filter(desc.filter)
            .mipmap_mode(if desc.mips {
                vk::SamplerMipmapMode::LINEAR
            } else {
                vk::SamplerMipmapMode::NEAREST
            })
            .address_mode_u(desc.wrap[0])
            .address_mode_v(desc.wrap[1])
            .address_mode_w(vk::SamplerAddressMode::CLAMP_TO_EDGE)
            .anisotropy_enable(desc.anisotropy > 1.0)
            .max_anisotropy(desc.anisotropy.min(gpu.properties.limits.max_sampler_anisotropy))
            .mip_lod_bias(desc.mip_bias)
            .max_lod(if desc.mips { vk::LOD_CLAMP_NONE } else { 0.0 });
        // SAFETY: the device is alive and has the feature anisotropy needs where it is asked for.
        let handle = unsafe { gpu.device().create_sampler(&info, None) }.doing("creating a sampler")?;
        Ok(Self { gpu: gpu.clone(), handle })
    }
}

impl Drop for Sampler {
    fn drop(&mut self) {
        self.gpu.retire(Garbage::Sampler(self.handle));
    }
}
