//! A small OpenXR application: the real loader, Vulkan by `XR_KHR_vulkan_enable2`, validation where it is installed,
//! and images filled byte by byte, so that captures can be compared exactly.

use std::ffi::{CStr, c_void};
use std::path::Path;
use std::sync::atomic::{AtomicU32, Ordering};

use ash::vk::{self, Handle as _};
use openxr as xr;
use shadecast_mock_runtime::record::{Side, picture_path};

/// The stereo views.
pub const STEREO: xr::ViewConfigurationType = xr::ViewConfigurationType::PRIMARY_STEREO;

/// Messages of the validation layers, of all applications of the process.
static VALIDATION_MESSAGES: AtomicU32 = AtomicU32::new(0);

/// The loader's entry points.
pub fn load() -> xr::Entry {
    // SAFETY: the system's OpenXR loader.
    unsafe { xr::Entry::load(&()) }.unwrap_or_else(|error| {
        panic!("the OpenXR loader libopenxr_loader.so.1 is missing ({error}); install the package libopenxr-loader1")
    })
}

/// Whether a set holds the extension that converts times on this system.
pub fn converts_time(extensions: &mut xr::ExtensionSet) -> &mut bool {
    #[cfg(unix)]
    return &mut extensions.khr_convert_timespec_time;
    #[cfg(windows)]
    return &mut extensions.khr_win32_convert_performance_counter_time;
}

/// An instance of the runtime under test.
pub fn create_instance(entry: &xr::Entry) -> xr::Result<xr::Instance> {
    create_instance_with(entry, |_| ())
}

/// The same with more extensions.
pub fn create_instance_with(
    entry: &xr::Entry,
    add: impl FnOnce(&mut xr::ExtensionSet),
) -> xr::Result<xr::Instance> {
    let mut extensions = xr::ExtensionSet::default();
    extensions.khr_vulkan_enable2 = true;
    extensions.ext_performance_settings = true;
    *converts_time(&mut extensions) = true;
    add(&mut extensions);
    let info = xr::ApplicationInfo {
        application_name: "mock runtime test",
        application_version: 1,
        engine_name: "",
        engine_version: 0,
        api_version: xr::Version::new(1, 0, 0),
    };
    entry.create_instance(&info, &extensions, &[], &())
}

unsafe extern "system" fn count_message(
    severity: vk::DebugUtilsMessageSeverityFlagsEXT,
    _types: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    _user: *mut c_void,
) -> vk::Bool32 {
    VALIDATION_MESSAGES.fetch_add(1, Ordering::SeqCst);
    // SAFETY: the layer passes valid data with a zero-terminated or null message.
    let text = unsafe { data.as_ref().and_then(|data| data.message_as_c_str()) };
    eprintln!("validation {severity:?}: {}", text.unwrap_or_default().to_string_lossy());
    vk::FALSE
}

/// How many messages the validation layers have given in this process.
pub fn validation_messages() -> u32 {
    VALIDATION_MESSAGES.load(Ordering::SeqCst)
}

/// The Vulkan side of the application.
pub struct Gpu {
    _entry: ash::Entry,
    instance: ash::Instance,
    messenger: Option<(ash::ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    device: ash::Device,
    physical_device: vk::PhysicalDevice,
    queue: vk::Queue,
    pool: vk::CommandPool,
}

fn messenger_info() -> vk::DebugUtilsMessengerCreateInfoEXT<'static> {
    type Severity = vk::DebugUtilsMessageSeverityFlagsEXT;
    type Type = vk::DebugUtilsMessageTypeFlagsEXT;
    vk::DebugUtilsMessengerCreateInfoEXT::default()
        .message_severity(Severity::WARNING | Severity::ERROR)
        .message_type(Type::VALIDATION)
        .pfn_user_callback(Some(count_message))
}

const VALIDATION: &CStr = c"VK_LAYER_KHRONOS_validation";

impl Gpu {
    /// Makes instance and device through the runtime.
    pub fn new(instance: &xr::Instance, system: xr::SystemId) -> Self {
        // SAFETY: the system's Vulkan loader.
        let entry = unsafe { ash::Entry::load() }.expect("the Vulkan loader libvulkan.so.1 is installed");
        let (vulkan, messenger) = Self::make_instance(&entry, instance, system);
        // SAFETY: the instance was made above.
        let physical_device =
            unsafe { instance.vulkan_graphics_device(system, vulkan.handle().as_raw() as _) };
        let physical_device = vk::PhysicalDevice::from_raw(physical_device.expect("a device") as u64);
        let priorities = [1.0];
        let queues =
            [vk::DeviceQueueCreateInfo::default().queue_family_index(0).queue_priorities(&priorities)];
        let info = vk::DeviceCreateInfo::default().queue_create_infos(&queues);
        // SAFETY: valid create info for the physical device that the runtime gave.
        let device = unsafe {
            instance.create_vulkan_device(
                system,
                std::mem::transmute::<vk::PFN_vkGetInstanceProcAddr, xr::sys::platform::VkGetInstanceProcAddr>(
                    entry.static_fn().get_instance_proc_addr,
                ),
                physical_device.as_raw() as _,
                &raw const info as _,
            )
        };
        let device = device.expect("OpenXR agrees").expect("Vulkan makes the device");
        // SAFETY: the device was made above; queue family 0 draws on every driver these tests meet.
        unsafe {
            let device = ash::Device::load(vulkan.fp_v1_0(), vk::Device::from_raw(device as u64));
            let queue = device.get_device_queue(0, 0);
            let pool = device
                .create_command_pool(&vk::CommandPoolCreateInfo::default(), None)
                .expect("a command pool");
            Self { _entry: entry, instance: vulkan, messenger, device, physical_device, queue, pool }
        }
    }

    #[allow(clippy::type_complexity)]
    fn make_instance(
        entry: &ash::Entry,
        instance: &xr::Instance,
        system: xr::SystemId,
    ) -> (ash::Instance, Option<(ash::ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>) {
        // SAFETY: the Vulkan loader is loaded.
        let layers = unsafe { entry.enumerate_instance_layer_properties() }.unwrap_or_default();
        let validates = layers.iter().any(|layer| layer.layer_name_as_c_str() == Ok(VALIDATION));
        if !validates {
            eprintln!("note: VK_LAYER_KHRONOS_validation is not installed; Vulkan's use is not checked");
        }
        let names = [VALIDATION.as_ptr()];
        let extensions = [ash::ext::debug_utils::NAME.as_ptr()];
        let application = vk::ApplicationInfo::default().api_version(vk::API_VERSION_1_1);
        let mut info = vk::InstanceCreateInfo::default().application_info(&application);
        let mut early = messenger_info();
        if validates {
            info =
                info.enabled_layer_names(&names).enabled_extension_names(&extensions).push_next(&mut early);
        }
        // SAFETY: valid create info, and the loader's own vkGetInstanceProcAddr.
        let made = unsafe {
            instance.create_vulkan_instance(
                system,
                std::mem::transmute::<vk::PFN_vkGetInstanceProcAddr, xr::sys::platform::VkGetInstanceProcAddr>(
                    entry.static_fn().get_instance_proc_addr,
                ),
                &raw const info as _,
            )
        };
        let made = vk::Instance::from_raw(made.expect("OpenXR agrees").expect("Vulkan makes it") as u64);
        // SAFETY: the instance was made a moment ago, with debug_utils where it validates.
        unsafe {
            let vulkan = ash::Instance::load(entry.static_fn(), made);
            let messenger = validates.then(|| {
                let functions = ash::ext::debug_utils::Instance::new(entry, &vulkan);
                let messenger =
                    functions.create_debug_utils_messenger(&messenger_info(), None).expect("a messenger");
                (functions, messenger)
            });
            (vulkan, messenger)
        }
    }

    /// What a session needs to know.
    pub fn binding(&self) -> xr::vulkan::SessionCreateInfo {
        xr::vulkan::SessionCreateInfo {
            instance: self.instance.handle().as_raw() as _,
            physical_device: self.physical_device.as_raw() as _,
            device: self.device.handle().as_raw() as _,
            queue_family_index: 0,
            queue_index: 0,
        }
    }

    /// Fills a layer of an image that is in COLOR_ATTACHMENT_OPTIMAL with the bytes that `texel` gives for (x, y), in
    /// the image's own channel order.
    pub fn paint(&self, image: u64, layer: u32, size: [u32; 2], texel: impl Fn(u32, u32) -> [u8; 4]) {
        let texels = (0..size[1]).flat_map(|y| (0..size[0]).map(move |x| (x, y)));
        let bytes: Vec<u8> = texels.flat_map(|(x, y)| texel(x, y)).collect();
        // SAFETY: every handle below is made, used and destroyed here, and the queue is waited for in between.
        unsafe {
            let (buffer, memory) = self.upload_buffer(&bytes);
            let info =
                vk::CommandBufferAllocateInfo::default().command_pool(self.pool).command_buffer_count(1);
            let commands = self.device.allocate_command_buffers(&info).expect("commands");
            self.record_paint(commands[0], vk::Image::from_raw(image), layer, size, buffer);
            let submit = vk::SubmitInfo::default().command_buffers(&commands);
            self.device.queue_submit(self.queue, &[submit], vk::Fence::null()).expect("submit");
            self.device.queue_wait_idle(self.queue).expect("wait");
            self.device.free_command_buffers(self.pool, &commands);
            self.device.destroy_buffer(buffer, None);
            self.device.free_memory(memory, None);
        }
    }

    unsafe fn upload_buffer(&self, bytes: &[u8]) -> (vk::Buffer, vk::DeviceMemory) {
        type Kind = vk::MemoryPropertyFlags;
        let info = vk::BufferCreateInfo::default()
            .size(bytes.len() as u64)
            .usage(vk::BufferUsageFlags::TRANSFER_SRC);
        // SAFETY: the device lives; memory is mapped while it is written, and large enough.
        unsafe {
            let buffer = self.device.create_buffer(&info, None).expect("a buffer");
            let needs = self.device.get_buffer_memory_requirements(buffer);
            let types = self.instance.get_physical_device_memory_properties(self.physical_device);
            let wanted = Kind::HOST_VISIBLE | Kind::HOST_COHERENT;
            let index = (0..types.memory_type_count).find(|index| {
                needs.memory_type_bits & (1 << index) != 0
                    && types.memory_types[*index as usize].property_flags.contains(wanted)
            });
            let info = vk::MemoryAllocateInfo::default()
                .allocation_size(needs.size)
                .memory_type_index(index.expect("host memory"));
            let memory = self.device.allocate_memory(&info, None).expect("memory");
            self.device.bind_buffer_memory(buffer, memory, 0).expect("bind");
            let mapped =
                self.device.map_memory(memory, 0, vk::WHOLE_SIZE, vk::MemoryMapFlags::empty()).expect("map");
            std::ptr::copy_nonoverlapping(bytes.as_ptr(), mapped.cast(), bytes.len());
            self.device.unmap_memory(memory);
            (buffer, memory)
        }
    }

    unsafe fn record_paint(
        &self,
        commands: vk::CommandBuffer,
        image: vk::Image,
        layer: u32,
        size: [u32; 2],
        buffer: vk::Buffer,
    ) {
        type Layout = vk::ImageLayout;
        let range = vk::ImageSubresourceRange {
            aspect_mask: vk::ImageAspectFlags::COLOR,
            base_mip_level: 0,
            level_count: 1,
            base_array_layer: layer,
            layer_count: 1,
        };
        let change = |from, to| {
            vk::ImageMemoryBarrier::default()
                .src_access_mask(vk::AccessFlags::MEMORY_WRITE)
                .dst_access_mask(vk::AccessFlags::MEMORY_WRITE)
                .old_layout(from)
                .new_layout(to)
                .image(image)
                .subresource_range(range)
        };
        let region = vk::BufferImageCopy::default()
            .image_subresource(vk::ImageSubresourceLayers {
                aspect_mask: vk::ImageAspectFlags::COLOR,
                mip_level: 0,
                base_array_layer: layer,
                layer_count: 1,
            })
            .image_extent(vk::Extent3D { width: size[0], height: size[1], depth: 1 });
        let begin = vk::CommandBufferBeginInfo::default();
        let all = vk::PipelineStageFlags::ALL_COMMANDS;
        let none = vk::DependencyFlags::empty();
        let to_copy = change(Layout::COLOR_ATTACHMENT_OPTIMAL, Layout::TRANSFER_DST_OPTIMAL);
        let back = change(Layout::TRANSFER_DST_OPTIMAL, Layout::COLOR_ATTACHMENT_OPTIMAL);
        // SAFETY: the commands are new, and image and buffer are alive and large enough.
        unsafe {
            let device = &self.device;
            device.begin_command_buffer(commands, &begin).expect("begin");
            device.cmd_pipeline_barrier(commands, all, all, none, &[], &[], &[to_copy]);
            device.cmd_copy_buffer_to_image(commands, buffer, image, Layout::TRANSFER_DST_OPTIMAL, &[region]);
            device.cmd_pipeline_barrier(commands, all, all, none, &[], &[], &[back]);
            device.end_command_buffer(commands).expect("end");
        }
    }
}

impl Drop for Gpu {
    fn drop(&mut self) {
        // SAFETY: the session, which used the device, was dropped before; children go before parents.
        unsafe {
            self.device.destroy_command_pool(self.pool, None);
            self.device.destroy_device(None);
            if let Some((functions, messenger)) = self.messenger.take() {
                functions.destroy_debug_utils_messenger(messenger, None);
            }
            self.instance.destroy_instance(None);
        }
    }
}

/// An application with a session. Fields are dropped in this order.
pub struct App {
    pub stage: xr::Space,
    pub stream: xr::FrameStream<xr::Vulkan>,
    pub waiter: xr::FrameWaiter,
    pub session: xr::Session<xr::Vulkan>,
    pub gpu: Gpu,
    pub instance: xr::Instance,
    pub system: xr::SystemId,
}

impl App {
    /// Creates everything up to the session, which has not begun.
    pub fn new() -> Self {
        Self::of_instance(create_instance(&load()).expect("the runtime makes an instance"))
    }

    /// The same with more extensions.
    pub fn with(add: impl FnOnce(&mut xr::ExtensionSet)) -> Self {
        Self::of_instance(create_instance_with(&load(), add).expect("the runtime makes an instance"))
    }

    /// The same with all that fixed foveation takes.
    pub fn foveated() -> Self {
        Self::with(|extensions| {
            extensions.fb_foveation = true;
            extensions.fb_foveation_configuration = true;
            extensions.fb_swapchain_update_state = true;
            extensions.fb_foveation_vulkan = true;
        })
    }

    fn of_instance(instance: xr::Instance) -> Self {
        let system = instance.system(xr::FormFactor::HEAD_MOUNTED_DISPLAY).expect("a headset");
        instance.graphics_requirements::<xr::Vulkan>(system).expect("requirements");
        let gpu = Gpu::new(&instance, system);
        Self::on(gpu, instance, system)
    }

    fn on(gpu: Gpu, instance: xr::Instance, system: xr::SystemId) -> Self {
        // SAFETY: the binding's handles are valid, and outlive the session by the order of fields.
        let (session, waiter, stream) =
            unsafe { instance.create_session::<xr::Vulkan>(system, &gpu.binding()) }.expect("a session");
        let stage = session
            .create_reference_space(xr::ReferenceSpaceType::STAGE, xr::Posef::IDENTITY)
            .expect("the stage");
        Self { stage, stream, waiter, session, gpu, instance, system }
    }

    /// Creates everything and begins the session.
    pub fn begun() -> Self {
        Self::new().beginning()
    }

    /// Begins the session.
    pub fn beginning(self) -> Self {
        assert_eq!(self.states(), [xr::SessionState::IDLE, xr::SessionState::READY]);
        self.session.begin(STEREO).expect("READY");
        self
    }

    /// Destroys the session and begins another one of the same instance on the same device.
    pub fn begun_anew(self) -> Self {
        let Self { stage, stream, waiter, session, gpu, instance, system } = self;
        drop((stage, stream, waiter, session));
        Self::on(gpu, instance, system).beginning()
    }

    /// A path's number.
    #[track_caller]
    pub fn path(&self, text: &str) -> xr::Path {
        self.instance.string_to_path(text).expect("a path")
    }

    /// A swapchain for `size` pixels with `array_size` layers.
    pub fn swapchain(
        &self,
        format: vk::Format,
        size: [u32; 2],
        array_size: u32,
    ) -> xr::Swapchain<xr::Vulkan> {
        let info = xr::SwapchainCreateInfo {
            create_flags: xr::SwapchainCreateFlags::EMPTY,
            usage_flags: xr::SwapchainUsageFlags::COLOR_ATTACHMENT | xr::SwapchainUsageFlags::TRANSFER_DST,
            format: format.as_raw() as u32,
            sample_count: 1,
            width: size[0],
            height: size[1],
            face_count: 1,
            array_size,
            mip_count: 1,
        };
        self.session.create_swapchain(&info).expect("a swapchain")
    }

    /// All waiting state changes of the session.
    pub fn states(&self) -> Vec<xr::SessionState> {
        let mut storage = xr::EventDataBuffer::new();
        let mut states = Vec::new();
        while let Some(event) = self.instance.poll_event(&mut storage).expect("poll") {
            match event {
                xr::Event::SessionStateChanged(change) => states.push(change.state()),
                _ => panic!("only state changes are expected here"),
            }
        }
        states
    }

    /// Runs a frame without layers.
    pub fn empty_frame(&mut self) -> xr::FrameState {
        let state = self.waiter.wait().expect("wait");
        self.stream.begin().expect("begin");
        self.stream.end(state.predicted_display_time, xr::EnvironmentBlendMode::OPAQUE, &[]).expect("end");
        state
    }

    /// Ends a session that is STOPPING.
    pub fn end(&self) {
        self.session.end().expect("STOPPING");
        assert_eq!(self.states(), [xr::SessionState::IDLE, xr::SessionState::EXITING]);
    }
}

/// One eye's part of a projection layer.
pub fn view<'a>(
    swapchain: &'a xr::Swapchain<xr::Vulkan>,
    array_index: u32,
    rect: xr::Rect2Di,
    located: &xr::View,
) -> xr::CompositionLayerProjectionView<'a, xr::Vulkan> {
    let part =
        xr::SwapchainSubImage::new().swapchain(swapchain).image_array_index(array_index).image_rect(rect);
    xr::CompositionLayerProjectionView::new().pose(located.pose).fov(located.fov).sub_image(part)
}

/// A rectangle of a swapchain's image.
pub fn rect(x: i32, y: i32, width: i32, height: i32) -> xr::Rect2Di {
    xr::Rect2Di { offset: xr::Offset2Di { x, y }, extent: xr::Extent2Di { width, height } }
}

/// Width, height and RGB bytes of a captured picture.
pub fn picture(captures: &Path, frame: u64, side: Side) -> ([u32; 2], Vec<u8>) {
    let path = picture_path(captures, frame, side);
    let file = std::fs::File::open(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let mut reader = png::Decoder::new(std::io::BufReader::new(file)).read_info().expect("a PNG");
    let mut bytes = vec![0; reader.output_buffer_size().expect("a size")];
    let info = reader.next_frame(&mut bytes).expect("pixels");
    assert_eq!((info.color_type, info.bit_depth), (png::ColorType::Rgb, png::BitDepth::Eight));
    bytes.truncate(info.buffer_size());
    ([info.width, info.height], bytes)
}
