//! The runtime's own work on the application's device: images of swapchains, and their way back to the CPU.
//!
//! The application's queue is used in `xrAcquireSwapchainImage` and `xrEndFrame` only, where the specification allows
//! it, and every submission is waited for at once, so nothing is in flight when a call returns.

use ash::vk;
use openxr_sys as xr;
use vk::Handle as _;

use crate::fault::{CallResult, Fault};
use crate::vulkan::Vulkan;

/// Bytes of a texel of every swapchain format.
const TEXEL_BYTES: usize = 4;

/// The application's device, with one command buffer and one staging buffer of the runtime's.
pub(crate) struct Gpu {
    device: ash::Device,
    instance: ash::Instance,
    physical_device: vk::PhysicalDevice,
    memory: vk::PhysicalDeviceMemoryProperties,
    queue: vk::Queue,
    pool: vk::CommandPool,
    commands: vk::CommandBuffer,
    fence: vk::Fence,
    staging: Option<Staging>,
}

struct Staging {
    buffer: vk::Buffer,
    memory: vk::DeviceMemory,
    /// Persistently mapped.
    mapped: *const u8,
    size: usize,
}

// SAFETY: `mapped` is memory of the device, read only by who holds the `Gpu` mutably.
unsafe impl Send for Staging {}

/// What an image is made of.
pub(crate) struct ImageInfo {
    pub(crate) format: vk::Format,
    pub(crate) extent: [u32; 2],
    pub(crate) array_size: u32,
    pub(crate) mip_count: u32,
    pub(crate) usage: vk::ImageUsageFlags,
    pub(crate) mutable_format: bool,
    /// The format is of depths.
    pub(crate) is_depth: bool,
}

/// An image with its memory.
pub(crate) struct GpuImage {
    pub(crate) image: vk::Image,
    is_depth: bool,
    memory: vk::DeviceMemory,
}

/// A part of an image in COLOR_ATTACHMENT_OPTIMAL that is wanted as RGB bytes.
pub(crate) struct ReadBack {
    pub(crate) image: vk::Image,
    pub(crate) array_index: u32,
    pub(crate) offset: [i32; 2],
    pub(crate) extent: [u32; 2],
    pub(crate) blue_first: bool,
}

impl ReadBack {
    fn bytes(&self) -> usize {
        self.extent[0] as usize * self.extent[1] as usize * TEXEL_BYTES
    }
}

fn failure(doing: &str, error: vk::Result) -> Fault {
    let code = match error {
        vk::Result::ERROR_OUT_OF_HOST_MEMORY | vk::Result::ERROR_OUT_OF_DEVICE_MEMORY => {
            xr::Result::ERROR_OUT_OF_MEMORY
        }
        _ => xr::Result::ERROR_RUNTIME_FAILURE,
    };
    Fault::runtime(code, format!("{doing} on the application's Vulkan device: {error}"))
}

const fn whole(aspect_mask: vk::ImageAspectFlags) -> vk::ImageSubresourceRange {
    vk::ImageSubresourceRange {
        aspect_mask,
        base_mip_level: 0,
        level_count: vk::REMAINING_MIP_LEVELS,
        base_array_layer: 0,
        layer_count: vk::REMAINING_ARRAY_LAYERS,
    }
}

/// A layout change that waits for all earlier commands of the queue and holds back all later ones.
fn change_of_layout(
    image: vk::Image,
    from: vk::ImageLayout,
    to: vk::ImageLayout,
) -> vk::ImageMemoryBarrier<'static> {
    vk::ImageMemoryBarrier::default()
        .src_access_mask(vk::AccessFlags::MEMORY_WRITE)
        .dst_access_mask(vk::AccessFlags::MEMORY_READ | vk::AccessFlags::MEMORY_WRITE)
        .old_layout(from)
        .new_layout(to)
        .src_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
        .dst_queue_family_index(vk::QUEUE_FAMILY_IGNORED)
        .image(image)
        .subresource_range(whole(vk::ImageAspectFlags::COLOR))
}

impl Gpu {
    /// Takes the device and the queue of a session's graphics binding.
    pub(crate) fn new(vulkan: &Vulkan, binding: &xr::GraphicsBindingVulkanKHR) -> CallResult<Self> {
        if !vulkan.has_made(binding) {
            let message = "the graphics binding must have what xrCreateVulkanInstanceKHR and xrCreateVulkanDeviceKHR have made";
            return Err(Fault::application(xr::Result::ERROR_GRAPHICS_DEVICE_INVALID, message));
        }
        let instance = vulkan.instance.clone();
        let physical_device = vk::PhysicalDevice::from_raw(binding.physical_device as u64);
        let handle = vk::Device::from_raw(binding.device as u64);
        // SAFETY: the device is the application's, of this instance, and outlives the session.
        let device = unsafe { ash::Device::load(instance.fp_v1_0(), handle) };
        // SAFETY: the physical device is one of this instance's.
        let memory = unsafe { instance.get_physical_device_memory_properties(physical_device) };
        // SAFETY: the application says that its device has this queue.
        let queue = unsafe { device.get_device_queue(binding.queue_family_index, binding.queue_index) };
        let mut gpu = Self {
            device,
            instance,
            physical_device,
            memory,
            queue,
            pool: vk::CommandPool::null(),
            commands: vk::CommandBuffer::null(),
            fence: vk::Fence::null(),
            staging: None,
        };
        gpu.make_commands(binding.queue_family_index)
            .map_err(|error| failure("cannot make commands", error))?;
        Ok(gpu)
    }

    fn make_commands(&mut self, queue_family_index: u32) -> Result<(), vk::Result> {
        let pool_info = vk::CommandPoolCreateInfo::default()
            .flags(vk::CommandPoolCreateFlags::RESET_COMMAND_BUFFER)
            .queue_family_index(queue_family_index);
        // SAFETY: the device lives, and has the queue family.
        self.pool = unsafe { self.device.create_command_pool(&pool_info, None) }?;
        let commands_info =
            vk::CommandBufferAllocateInfo::default().command_pool(self.pool).command_buffer_count(1);
        // SAFETY: the pool was made above.
        self.commands = unsafe { self.device.allocate_command_buffers(&commands_info) }?[0];
        // SAFETY: the device lives.
        self.fence = unsafe { self.device.create_fence(&vk::FenceCreateInfo::default(), None) }?;
        Ok(())
    }

    /// Makes an image for a swapchain, in no layout yet.
    pub(crate) fn create_image(&self, info: &ImageInfo) -> CallResult<GpuImage> {
        let flags = match info.mutable_format {
            true => vk::ImageCreateFlags::MUTABLE_FORMAT,
            false => vk::ImageCreateFlags::empty(),
        };
        self.check_image(info, flags)?;
        let create_info = vk::ImageCreateInfo::default()
            .flags(flags)
            .image_type(vk::ImageType::TYPE_2D)
            .format(info.format)
            .extent(vk::Extent3D { width: info.extent[0], height: info.extent[1], depth: 1 })
            .mip_levels(info.mip_count)
            .array_layers(info.array_size)
            .samples(vk::SampleCountFlags::TYPE_1)
            .tiling(vk::ImageTiling::OPTIMAL)
            .usage(info.usage);
        // SAFETY: the device lives, and check_image found that it makes such images.
        let image = unsafe { self.device.create_image(&create_info, None) }
            .map_err(|error| failure("cannot make a swapchain image", error))?;
        self.bind_image(image, info.is_depth).inspect_err(|_| {
            // SAFETY: the image was made above, and nobody else has it.
            unsafe { self.device.destroy_image(image, None) }
        })
    }

    fn bind_image(&self, image: vk::Image, is_depth: bool) -> CallResult<GpuImage> {
        // SAFETY: the image is of this device.
        let needs = unsafe { self.device.get_image_memory_requirements(image) };
        let memory = self.allocate(needs, vk::MemoryPropertyFlags::DEVICE_LOCAL, "a swapchain image")?;
        // SAFETY: the memory was allocated for this image, and neither is bound.
        match unsafe { self.device.bind_image_memory(image, memory, 0) } {
            Ok(()) => Ok(GpuImage { image, is_depth, memory }),
            Err(error) => {
                // SAFETY: nothing is bound to the memory.
                unsafe { self.device.free_memory(memory, None) };
                Err(failure("cannot bind a swapchain image", error))
            }
        }
    }

    /// Refuses images that the device cannot make.
    fn check_image(&self, info: &ImageInfo, flags: vk::ImageCreateFlags) -> CallResult<()> {
        let unsupported =
            |message: String| Err(Fault::application(xr::Result::ERROR_FEATURE_UNSUPPORTED, message));
        // SAFETY: the physical device is the application's, of this instance.
        let limits = unsafe {
            self.instance.get_physical_device_image_format_properties(
                self.physical_device,
                info.format,
                vk::ImageType::TYPE_2D,
                vk::ImageTiling::OPTIMAL,
                info.usage,
                flags,
            )
        };
        match limits {
            Err(error) => unsupported(format!("{:?} with {:?}: {error}", info.format, info.usage)),
            Ok(limits)
                if info.array_size > limits.max_array_layers || info.mip_count > limits.max_mip_levels =>
            {
                unsupported(format!(
                    "{} array layers, {} mip levels: too many",
                    info.array_size, info.mip_count
                ))
            }
            Ok(_) => Ok(()),
        }
    }

    /// Frees an image. The application has made sure that its own work on it is done.
    pub(crate) fn destroy_image(&self, image: GpuImage) {
        // SAFETY: the runtime's own work is always waited for, and the application must have finished its own before
        // it destroys a swapchain.
        unsafe {
            self.device.destroy_image(image.image, None);
            self.device.free_memory(image.memory, None);
        }
    }

    fn allocate(
        &self,
        needs: vk::MemoryRequirements,
        wanted: vk::MemoryPropertyFlags,
        what: &str,
    ) -> CallResult<vk::DeviceMemory> {
        let types = self.memory.memory_types_as_slice().iter().enumerate();
        let mut allowed = types.filter(|(index, _)| needs.memory_type_bits & (1 << index) != 0);
        let (index, _) = allowed.find(|(_, ty)| ty.property_flags.contains(wanted)).ok_or_else(|| {
            let message = format!("the Vulkan device has no memory of kind {wanted:?} for {what}");
            Fault::runtime(xr::Result::ERROR_RUNTIME_FAILURE, message)
        })?;
        let info =
            vk::MemoryAllocateInfo::default().allocation_size(needs.size).memory_type_index(index as u32);
        // SAFETY: the device lives, and has this memory type.
        unsafe { self.device.allocate_memory(&info, None) }
            .map_err(|error| failure(&format!("cannot allocate memory for {what}"), error))
    }

    /// Puts a new image into the layout of its attachment, in which the application gets it.
    pub(crate) fn hand_over(&mut self, image: &GpuImage) -> CallResult<()> {
        let (layout, aspect) = match image.is_depth {
            true => (vk::ImageLayout::DEPTH_STENCIL_ATTACHMENT_OPTIMAL, vk::ImageAspectFlags::DEPTH),
            false => (vk::ImageLayout::COLOR_ATTACHMENT_OPTIMAL, vk::ImageAspectFlags::COLOR),
        };
        let barrier = change_of_layout(image.image, vk::ImageLayout::UNDEFINED, layout)
            .subresource_range(whole(aspect));
        self.submit(|gpu| gpu.barrier(&[barrier], &[]))
            .map_err(|error| failure("cannot hand over a swapchain image", error))
    }

    /// Copies parts of images, as RGB, row by row. The images keep their layout.
    pub(crate) fn read_back(&mut self, parts: &[ReadBack]) -> CallResult<Vec<Vec<u8>>> {
        let size = parts.iter().map(ReadBack::bytes).sum();
        let (buffer, mapped) = self.staging(size)?;
        self.submit(|gpu| gpu.record_copies(parts, buffer))
            .map_err(|error| failure("cannot capture a frame", error))?;
        // SAFETY: `size` bytes are mapped, coherent, and the GPU has finished writing to them: submit has waited, and
        // the last barrier made the writes visible to the host.
        let mut bytes = unsafe { std::slice::from_raw_parts(mapped, size) };
        let mut pictures = Vec::with_capacity(parts.len());
        for part in parts {
            let (these, rest) = bytes.split_at(part.bytes());
            pictures.push(rgb(these, part.blue_first));
            bytes = rest;
        }
        Ok(pictures)
    }

    fn record_copies(&self, parts: &[ReadBack], buffer: vk::Buffer) {
        let colour = vk::ImageLayout::COLOR_ATTACHMENT_OPTIMAL;
        let source = vk::ImageLayout::TRANSFER_SRC_OPTIMAL;
        let mut images: Vec<vk::Image> = parts.iter().map(|part| part.image).collect();
        images.dedup();
        let to_source: Vec<_> = images.iter().map(|image| change_of_layout(*image, colour, source)).collect();
        let to_colour: Vec<_> = images.iter().map(|image| change_of_layout(*image, source, colour)).collect();
        self.barrier(&to_source, &[]);
        let mut offset = 0;
        for part in parts {
            let region = region(part, offset);
            // SAFETY: the commands are being recorded; the part lies inside its image (layers.rs) and its bytes inside
            // the buffer, which is as large as all parts.
            unsafe {
                self.device.cmd_copy_image_to_buffer(self.commands, part.image, source, buffer, &[region])
            };
            offset += part.bytes();
        }
        let to_host = vk::MemoryBarrier::default()
            .src_access_mask(vk::AccessFlags::TRANSFER_WRITE)
            .dst_access_mask(vk::AccessFlags::HOST_READ);
        self.barrier(&to_colour, &[to_host]);
    }

    fn barrier(&self, images: &[vk::ImageMemoryBarrier], memory: &[vk::MemoryBarrier]) {
        // SAFETY: the commands are being recorded, and the images are alive.
        unsafe {
            self.device.cmd_pipeline_barrier(
                self.commands,
                vk::PipelineStageFlags::ALL_COMMANDS,
                vk::PipelineStageFlags::ALL_COMMANDS | vk::PipelineStageFlags::HOST,
                vk::DependencyFlags::empty(),
                memory,
                &[],
                images,
            );
        }
    }

    /// Records commands, submits them to the application's queue and waits for them.
    fn submit(&mut self, record: impl FnOnce(&Self)) -> Result<(), vk::Result> {
        let begin = vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        // SAFETY: the commands are not pending: every submission is waited for.
        unsafe { self.device.begin_command_buffer(self.commands, &begin) }?;
        record(self);
        let commands = [self.commands];
        let submit = vk::SubmitInfo::default().command_buffers(&commands);
        // SAFETY: the application leaves its queue to the runtime during the calls that come here; the fence is
        // unsignalled and unused.
        unsafe {
            self.device.end_command_buffer(self.commands)?;
            self.device.queue_submit(self.queue, &[submit], self.fence)?;
            self.device.wait_for_fences(&[self.fence], true, u64::MAX)?;
            self.device.reset_fences(&[self.fence])
        }
    }

    /// The staging buffer, with at least `size` bytes.
    fn staging(&mut self, size: usize) -> CallResult<(vk::Buffer, *const u8)> {
        if let Some(staging) = self.staging.as_ref().filter(|staging| staging.size >= size) {
            return Ok((staging.buffer, staging.mapped));
        }
        self.free_staging();
        let info =
            vk::BufferCreateInfo::default().size(size as u64).usage(vk::BufferUsageFlags::TRANSFER_DST);
        // SAFETY: the device lives.
        let buffer = unsafe { self.device.create_buffer(&info, None) }
            .map_err(|error| failure("cannot make a staging buffer", error))?;
        let staging = self.bind_staging(buffer, size).inspect_err(|_| {
            // SAFETY: the buffer was made above, and nobody else has it.
            unsafe { self.device.destroy_buffer(buffer, None) }
        })?;
        let staging = self.staging.insert(staging);
        Ok((staging.buffer, staging.mapped))
    }

    fn bind_staging(&self, buffer: vk::Buffer, size: usize) -> CallResult<Staging> {
        type Kind = vk::MemoryPropertyFlags;
        let coherent = Kind::HOST_VISIBLE | Kind::HOST_COHERENT;
        // SAFETY: the buffer is of this device.
        let needs = unsafe { self.device.get_buffer_memory_requirements(buffer) };
        let memory = self
            .allocate(needs, coherent | Kind::HOST_CACHED, "captures")
            .or_else(|_| self.allocate(needs, coherent, "captures"))?;
        // SAFETY: the memory was allocated for this buffer, neither is bound, and it is not mapped.
        let mapped = unsafe {
            self.device
                .bind_buffer_memory(buffer, memory, 0)
                .and_then(|()| self.device.map_memory(memory, 0, vk::WHOLE_SIZE, vk::MemoryMapFlags::empty()))
        };
        match mapped {
            Ok(mapped) => Ok(Staging { buffer, memory, mapped: mapped.cast(), size }),
            Err(error) => {
                // SAFETY: the memory was allocated above; its buffer is destroyed by the caller before any use.
                unsafe { self.device.free_memory(memory, None) };
                Err(failure("cannot map a staging buffer", error))
            }
        }
    }

    fn free_staging(&mut self) {
        let Some(staging) = self.staging.take() else { return };
        // SAFETY: the GPU is done with the buffer: every submission is waited for. Freeing unmaps.
        unsafe {
            self.device.destroy_buffer(staging.buffer, None);
            self.device.free_memory(staging.memory, None);
        }
    }
}

impl Drop for Gpu {
    fn drop(&mut self) {
        self.free_staging();
        // SAFETY: every submission was waited for; null handles are allowed.
        unsafe {
            self.device.destroy_fence(self.fence, None);
            self.device.destroy_command_pool(self.pool, None);
        }
    }
}

fn region(part: &ReadBack, buffer_offset: usize) -> vk::BufferImageCopy {
    let subresource = vk::ImageSubresourceLayers {
        aspect_mask: vk::ImageAspectFlags::COLOR,
        mip_level: 0,
        base_array_layer: part.array_index,
        layer_count: 1,
    };
    vk::BufferImageCopy::default()
        .buffer_offset(buffer_offset as u64)
        .image_subresource(subresource)
        .image_offset(vk::Offset3D { x: part.offset[0], y: part.offset[1], z: 0 })
        .image_extent(vk::Extent3D { width: part.extent[0], height: part.extent[1], depth: 1 })
}

/// Drops alpha, and puts red first.
fn rgb(texels: &[u8], blue_first: bool) -> Vec<u8> {
    let order = if blue_first { [2, 1, 0] } else { [0, 1, 2] };
    texels.chunks_exact(TEXEL_BYTES).flat_map(|texel| order.map(|channel| texel[channel])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn red_comes_first_whatever_the_format() {
        assert_eq!(rgb(&[1, 2, 3, 255, 4, 5, 6, 0], false), [1, 2, 3, 4, 5, 6]);
        assert_eq!(rgb(&[1, 2, 3, 255], true), [3, 2, 1]);
    }
}
