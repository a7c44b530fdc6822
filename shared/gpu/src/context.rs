//! The device and its companions: allocator, command slots, retire ring, validation messages.

use crate::devices::{
    self, DENSITY_MAP_EXTENSION, FoundDevice, NO_DRIVER, NO_LAYER, Needs, PICTURE_EXTENSIONS,
    has_density_maps, has_geometry_shader, missing, name_of,
};
use crate::kept_pipelines::KeptPipelines;
use crate::lanes::{LANES, Lanes};
use crate::limits::{self, DeviceLimits};
use crate::lock::{self, Lock};
use crate::memory::Garbage;
use crate::pending::Pending;
use crate::recorder::CommandSlot;
use crate::shared_pipelines::SharedPipelines;
use crate::timings::KeptTimings;
use crate::{Doing, GpuError};
use ash::{ext, vk};
use gpu_allocator::vulkan::{Allocator, AllocatorCreateDesc};
use std::collections::VecDeque;
use std::ffi::{CStr, c_char, c_void};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex, OnceLock};

const VALIDATION_LAYER: &CStr = c"VK_LAYER_KHRONOS_validation";
/// How a device is opened.
#[derive(Clone, Debug)]
pub struct GpuOptions {
    /// Feature set.
    pub needs: Needs,
    /// Validation layers on, missing barriers looked for too; every message is counted and logged.
    pub validation: bool,
    /// Part of the wanted device's name; `None` takes the best one (discrete, integrated, CPU).
    pub device_name: Option<String>,
}

/// Who creates instance and device: the program itself on a desktop, the OpenXR runtime for a client.
pub trait DeviceSource {
    /// `vkCreateInstance` or the runtime's equivalent.
    fn create_instance(
        &self,
        entry: &ash::Entry,
        info: &vk::InstanceCreateInfo<'_>,
    ) -> Result<vk::Instance, GpuError>;
    /// Chooses the physical device.
    fn physical_device(
        &self,
        instance: &ash::Instance,
        options: &GpuOptions,
    ) -> Result<vk::PhysicalDevice, GpuError>;
    /// `vkCreateDevice` or the runtime's equivalent.
    fn create_device(
        &self,
        instance: &ash::Instance,
        physical: vk::PhysicalDevice,
        info: &vk::DeviceCreateInfo<'_>,
    ) -> Result<vk::Device, GpuError>;
    /// Whether passes are to take density maps, where the device can.
    fn wants_density_maps(&self) -> bool {
        false
    }
}

/// Instance and device straight from the Vulkan loader.
#[derive(Clone, Copy, Debug, Default)]
pub struct DesktopDevice;

/// A device, opened. Cloned as `Arc`; every object keeps it alive.
pub struct Gpu {
    device: ash::Device,
    pub(crate) allocator: Mutex<Option<Allocator>>,
    pub(crate) lanes: Lanes,
    pub(crate) queue_family: u32,
    /// Bits of its timestamps that count; 0: its scopes are not timed.
    pub(crate) timestamp_bits: u32,
    pub(crate) idle_slots: Lock<Vec<CommandSlot>>,
    pub(crate) pending: Pending<CommandSlot>,
    pub(crate) garbage: Lock<VecDeque<(u64, Garbage)>>,
    /// Somebody else destroys what was retired, not whoever records next.
    pub(crate) leaves_retired: AtomicBool,
    pub(crate) timings: Lock<KeptTimings>,
    pub(crate) pipelines: SharedPipelines,
    pub(crate) kept_pipelines: OnceLock<KeptPipelines>,
    pub(crate) properties: vk::PhysicalDeviceProperties,
    limits: DeviceLimits,
    numbers_triangles: bool,
    takes_density_maps: bool,
    physical: vk::PhysicalDevice,
    messenger: Option<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    validation: Box<ValidationLog>,
    instance: ash::Instance,
    entry: ash::Entry,
}

#[derive(Default)]
struct ValidationLog {
    count: AtomicU32,
    texts: Mutex<Vec<String>>,
}

impl std::fmt::Debug for Gpu {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Gpu").field("device", &self.device_name()).finish_non_exhaustive()
    }
}

impl Gpu {
    /// Opens a device and runs the multiview self-test on it.
    ///
    /// # Errors
    /// No loader, no device with the needed features, or a device that draws only one of two views.
    pub fn open(options: &GpuOptions, source: &dyn DeviceSource) -> Result<Arc<Self>, GpuError> {
        // SAFETY: loading the Vulkan loader runs its initialisers, which have no preconditions.
        let entry = unsafe { ash::Entry::load() }.map_err(|e| GpuError::NoLoader(e.to_string()))?;
        let validation = Box::<ValidationLog>::default();
        let instance = create_instance(&entry, options, source)?;
        let messenger = create_messenger(&entry, &instance, options, &validation)?;
        let physical = source.physical_device(&instance, options)?;
        // SAFETY: `physical` belongs to `instance`.
        let properties = unsafe { instance.get_physical_device_properties(physical) };
        let QueueFamily { index: queue_family, queues, timestamp_bits } = queue_family(&instance, physical)?;
        let is_server = options.needs == Needs::Server;
        let queues = if is_server { queues.min(LANES as u32) } else { 1 };
        let takes_density_maps = source.wants_density_maps() && has_density_maps(&instance, physical);
        let family = (queue_family, queues);
        let device = create_device(&instance, physical, family, takes_density_maps, options, source)?;
        let lanes = Lanes::new(&device, queue_family, queues, is_server)?;
        let allocator = Allocator::new(&AllocatorCreateDesc {
            instance: instance.clone(),
            device: device.clone(),
            physical_device: physical,
            debug_settings: Default::default(),
            buffer_device_address: false,
            allocation_sizes: Default::default(),
        })
        .map_err(|e| GpuError::NoDevice(e.to_string()))?;
        let gpu = Arc::new(Self {
            device,
            allocator: Mutex::new(Some(allocator)),
            lanes,
            queue_family,
            timestamp_bits,
            idle_slots: Lock::default(),
            pending: Pending::default(),
            garbage: Lock::default(),
            leaves_retired: AtomicBool::new(false),
            timings: Lock::default(),
            pipelines: SharedPipelines::default(),
            kept_pipelines: OnceLock::new(),
            properties,
            limits: limits::of(&instance, physical),
            takes_density_maps,
            numbers_triangles: options.needs == Needs::Server && has_geometry_shader(&instance, physical),
            physical,
            messenger,
            validation,
            instance,
            entry,
        });
        crate::selftest::multiview(&gpu)?;
        Ok(gpu)
    }

    /// The device's own name for itself.
    pub fn device_name(&self) -> String {
        name_of(&self.properties)
    }

    /// Most bytes that one binding of a storage buffer can reach.
    pub fn max_storage_buffer_bytes(&self) -> u64 {
        u64::from(self.properties.limits.max_storage_buffer_range)
    }

    /// The device's offer of every limit that the programs rely on.
    pub fn limits(&self) -> &DeviceLimits {
        &self.limits
    }

    /// Samples a pixel that passes with colour and depth can have: 1 and 4, and on some devices others.
    pub fn sample_counts(&self) -> vk::SampleCountFlags {
        let limits = &self.properties.limits;
        limits.framebuffer_color_sample_counts & limits.framebuffer_depth_sample_counts
    }

    /// Whether fragments may ask for `gl_PrimitiveID`: a device of the server that has geometry shaders.
    pub fn numbers_triangles(&self) -> bool {
        self.numbers_triangles
    }

    /// Whether passes take density maps: the device can, and it was opened for that.
    pub fn takes_density_maps(&self) -> bool {
        self.takes_density_maps
    }

    /// Whether the device is a CPU: correct, slow.
    pub fn is_cpu(&self) -> bool {
        self.properties.device_type == vk::PhysicalDeviceType::CPU
    }

    /// Validation warnings and errors since the device was opened; 0 with validation off.
    pub fn validation_messages(&self) -> u32 {
        self.validation.count.load(Ordering::Relaxed)
    }

    /// The same for reports; `None` with validation off: nothing was checked.
    pub fn checked_messages(&self) -> Option<u32> {
        self.messenger.is_some().then(|| self.validation_messages())
    }

    /// Whether validation is on and looks for missing barriers: some layers cannot be asked to.
    pub fn checks_synchronisation(&self) -> bool {
        self.messenger.is_some() && can_check_synchronisation(&self.entry).unwrap_or(false)
    }

    /// The first validation messages, for a failing test's text.
    pub fn validation_texts(&self) -> Vec<String> {
        self.validation.texts.lock().expect("not poisoned").clone()
    }

    /// The loaded device functions, for code that must call Vulkan itself. Whoever asks for them is about to call the device, which may
    /// take its time: no lock of this crate is held by then.
    pub fn device(&self) -> &ash::Device {
        debug_assert!(lock::none_held(), "a lock is held while the device is called");
        &self.device
    }

    /// The instance functions.
    pub fn instance(&self) -> &ash::Instance {
        &self.instance
    }

    /// The loader.
    pub fn entry(&self) -> &ash::Entry {
        &self.entry
    }

    /// The physical device.
    pub fn physical_device(&self) -> vk::PhysicalDevice {
        self.physical
    }

    /// Family of the queues; a client's has the index 0 within it.
    pub fn queue_family(&self) -> u32 {
        self.queue_family
    }

    /// Waits until everything submitted has finished: for shutdown only, before others destroy what the GPU may still use.
    pub fn wait_idle(&self) {
        // SAFETY: the queue is used from this thread alone while the caller shuts down. A lost device is idle too.
        let _ = unsafe { self.device.device_wait_idle() };
    }

    /// Hands handles to the retire ring: they are destroyed when the work that could use them is done.
    pub(crate) fn retire(&self, garbage: Garbage) {
        // What is recorded now is submitted next, so it may still use the object.
        let last_user = self.pending.last_begun() + 1;
        self.garbage.lock().push_back((last_user, garbage));
    }

    /// From now on what was retired is destroyed by [`Self::destroy_retired`] alone. A thread that must not wait for the driver records
    /// without doing so; another one calls that from time to time.
    pub fn leave_retired(&self) {
        self.leaves_retired.store(true, Ordering::Relaxed);
    }

    /// Destroys what no submitted or recorded work can use any more.
    pub fn destroy_retired(&self) {
        while let Some(item) = self.next_retired() {
            item.destroy(self);
        }
    }

    /// Whether anything waits to be destroyed.
    pub fn has_retired(&self) -> bool {
        !self.garbage.lock().is_empty()
    }

    fn next_retired(&self) -> Option<Garbage> {
        let done = self.pending.completed();
        let mut garbage = self.garbage.lock();
        let (last_user, _) = garbage.front()?;
        if *last_user > done { None } else { garbage.pop_front().map(|(_, item)| item) }
    }
}

impl Drop for Gpu {
    fn drop(&mut self) {
        // SAFETY: shutdown; nobody else holds the device, so nothing is submitted meanwhile.
        let _ = unsafe { self.device.device_wait_idle() };
        let garbage: Vec<_> = self.garbage.lock().drain(..).collect();
        garbage.into_iter().for_each(|(_, item)| item.destroy(self));
        let idle: Vec<_> = self.idle_slots.lock().drain(..).collect();
        self.pending.drain().into_iter().chain(idle).for_each(|slot| slot.destroy(&self.device));
        self.lanes.destroy(&self.device);
        self.kept_pipelines.get().into_iter().for_each(|kept| kept.destroy(&self.device));
        drop(self.allocator.lock().expect("not poisoned").take());
        // SAFETY: the device is idle and all its objects are gone; the messenger outlives the device, and the
        // instance goes last.
        unsafe {
            self.device.destroy_device(None);
            if let Some((functions, messenger)) = self.messenger.take() {
                functions.destroy_debug_utils_messenger(messenger, None);
            }
            self.instance.destroy_instance(None);
        }
    }
}

/// What devices there are, the best first, and what each lacks.
///
/// # Errors
/// No Vulkan loader, or no driver.
pub fn survey(needs: Needs) -> Result<Vec<FoundDevice>, GpuError> {
    // SAFETY: loading the Vulkan loader runs its initialisers, which have no preconditions.
    let entry = unsafe { ash::Entry::load() }.map_err(|e| GpuError::NoLoader(e.to_string()))?;
    let options = GpuOptions { needs, validation: false, device_name: None };
    let instance = create_instance(&entry, &options, &DesktopDevice)?;
    let found = devices::list(&instance, needs);
    // SAFETY: nothing was made with the instance.
    unsafe { instance.destroy_instance(None) };
    found
}

impl DeviceSource for DesktopDevice {
    fn create_instance(
        &self,
        entry: &ash::Entry,
        info: &vk::InstanceCreateInfo<'_>,
    ) -> Result<vk::Instance, GpuError> {
        // SAFETY: `info` and all it points to live through the call.
        match unsafe { entry.create_instance(info, None) } {
            Ok(instance) => Ok(instance.handle()),
            // What the loader says where it finds no driver at all.
            Err(vk::Result::ERROR_INCOMPATIBLE_DRIVER) => Err(GpuError::NoDevice(NO_DRIVER.into())),
            refused => Ok(refused.doing("creating the Vulkan instance")?.handle()),
        }
    }

    fn physical_device(
        &self,
        instance: &ash::Instance,
        options: &GpuOptions,
    ) -> Result<vk::PhysicalDevice, GpuError> {
        let all = devices::list(instance, options.needs)?;
        let wanted = options.device_name.as_deref();
        let best = all.iter().find(|found| found.is_usable(wanted));
        best.map(|found| found.physical).ok_or_else(|| {
            let refused = all.iter().map(|found| match &found.lacks {
                Some(what) if found.is_named(wanted) => format!("{}: lacks {what}", found.name),
                _ => format!("{}: not the one asked for", found.name),
            });
            GpuError::NoDevice(refused.collect::<Vec<_>>().join("; "))
        })
    }

    fn create_device(
        &self,
        instance: &ash::Instance,
        physical: vk::PhysicalDevice,
        info: &vk::DeviceCreateInfo<'_>,
    ) -> Result<vk::Device, GpuError> {
        // SAFETY: `physical` belongs to `instance`; `info` and all it points to live through the call.
        let device = unsafe { instance.create_device(physical, info, None) };
        Ok(device.doing("creating the Vulkan device")?.handle())
    }
}

fn create_instance(
    entry: &ash::Entry,
    options: &GpuOptions,
    source: &dyn DeviceSource,
) -> Result<ash::Instance, GpuError> {
    let api = if options.needs == Needs::Server { vk::API_VERSION_1_2 } else { vk::API_VERSION_1_1 };
    let application = vk::ApplicationInfo::default().application_name(c"Shadecast").api_version(api);
    let info = vk::InstanceCreateInfo::default().application_info(&application);
    let handle = if options.validation {
        require_validation_layer(entry)?;
        create_validated_instance(entry, info, source)?
    } else {
        source.create_instance(entry, &info)?
    };
    // SAFETY: `handle` was created with this entry's functions.
    Ok(unsafe { ash::Instance::load(entry.static_fn(), handle) })
}

fn create_validated_instance(
    entry: &ash::Entry,
    info: vk::InstanceCreateInfo<'_>,
    source: &dyn DeviceSource,
) -> Result<vk::Instance, GpuError> {
    let layers: [*const c_char; 1] = [VALIDATION_LAYER.as_ptr()];
    let mut extensions: Vec<*const c_char> = vec![ext::debug_utils::NAME.as_ptr()];
    let features = [vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION];
    let mut synchronisation = vk::ValidationFeaturesEXT::default().enabled_validation_features(&features);
    let mut info = info.enabled_layer_names(&layers);
    if can_check_synchronisation(entry)? {
        extensions.push(ext::validation_features::NAME.as_ptr());
        info = info.push_next(&mut synchronisation);
    }
    source.create_instance(entry, &info.enabled_extension_names(&extensions))
}

/// Whether the installed validation layer can be asked by this program to look for missing barriers.
fn can_check_synchronisation(entry: &ash::Entry) -> Result<bool, GpuError> {
    // SAFETY: the layer's name ends in NUL.
    let offered = unsafe { entry.enumerate_instance_extension_properties(Some(VALIDATION_LAYER)) }
        .doing("listing the validation layer's extensions")?;
    Ok(offered.iter().any(|e| e.extension_name_as_c_str() == Ok(ext::validation_features::NAME)))
}

fn require_validation_layer(entry: &ash::Entry) -> Result<(), GpuError> {
    // SAFETY: no preconditions.
    let layers = unsafe { entry.enumerate_instance_layer_properties() }.doing("listing Vulkan layers")?;
    if layers.iter().any(|l| l.layer_name_as_c_str() == Ok(VALIDATION_LAYER)) {
        return Ok(());
    }
    Err(GpuError::NoDevice(format!(
        "validation was asked for, but VK_LAYER_KHRONOS_validation is not installed ({NO_LAYER})"
    )))
}

fn create_messenger(
    entry: &ash::Entry,
    instance: &ash::Instance,
    options: &GpuOptions,
    log: &ValidationLog,
) -> Result<Option<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>, GpuError> {
    if !options.validation {
        return Ok(None);
    }
    let functions = ext::debug_utils::Instance::new(entry, instance);
    let info = vk::DebugUtilsMessengerCreateInfoEXT::default()
        .message_severity(
            vk::DebugUtilsMessageSeverityFlagsEXT::ERROR | vk::DebugUtilsMessageSeverityFlagsEXT::WARNING,
        )
        .message_type(
            vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION | vk::DebugUtilsMessageTypeFlagsEXT::PERFORMANCE,
        )
        .pfn_user_callback(Some(on_message))
        .user_data(std::ptr::from_ref(log).cast_mut().cast());
    // SAFETY: the log is boxed in the `Gpu`, which destroys the messenger before it frees the log.
    let messenger = unsafe { functions.create_debug_utils_messenger(&info, None) };
    Ok(Some((functions, messenger.doing("creating the validation messenger")?)))
}

unsafe extern "system" fn on_message(
    _: vk::DebugUtilsMessageSeverityFlagsEXT,
    _: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    user: *mut c_void,
) -> vk::Bool32 {
    // SAFETY: the layer passes valid data for the call's duration; `user` is the log of `create_messenger`.
    let (data, log) = unsafe { (&*data, &*user.cast::<ValidationLog>()) };
    // SAFETY: the message is a NUL-terminated string where present.
    let text = unsafe { data.message_as_c_str() }.unwrap_or(c"").to_string_lossy().into_owned();
    tracing::error!(target: "vulkan", "{text}");
    log.count.fetch_add(1, Ordering::Relaxed);
    if let Ok(mut texts) = log.texts.lock()
        && texts.len() < 20
    {
        texts.push(text);
    }
    vk::FALSE
}

/// The queue family of a device for graphics and compute.
struct QueueFamily {
    index: u32,
    queues: u32,
    /// Bits of its timestamps that count; 0: it has none.
    timestamp_bits: u32,
}

fn queue_family(instance: &ash::Instance, physical: vk::PhysicalDevice) -> Result<QueueFamily, GpuError> {
    let wanted = vk::QueueFlags::GRAPHICS | vk::QueueFlags::COMPUTE;
    // SAFETY: `physical` belongs to `instance`.
    unsafe { instance.get_physical_device_queue_family_properties(physical) }
        .iter()
        .zip(0..)
        .find(|(family, _)| family.queue_flags.contains(wanted))
        .map(|(family, index)| QueueFamily {
            index,
            queues: family.queue_count,
            timestamp_bits: family.timestamp_valid_bits,
        })
        .ok_or_else(|| GpuError::NoDevice("it has no queue for graphics and compute".into()))
}

fn create_device(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    (queue_family, queues): (u32, u32),
    takes_density_maps: bool,
    options: &GpuOptions,
    source: &dyn DeviceSource,
) -> Result<ash::Device, GpuError> {
    if let Some(what) = missing(instance, physical, options.needs) {
        return Err(GpuError::NoDevice(format!("the chosen device lacks {what}")));
    }
    let server = options.needs == Needs::Server;
    let core = vk::PhysicalDeviceFeatures::default()
        .geometry_shader(server && has_geometry_shader(instance, physical))
        .sampler_anisotropy(server)
        .shader_storage_buffer_array_dynamic_indexing(server);
    let mut multiview = vk::PhysicalDeviceMultiviewFeatures::default().multiview(true);
    let mut indexing = vk::PhysicalDeviceDescriptorIndexingFeatures::default()
        .runtime_descriptor_array(true)
        .shader_sampled_image_array_non_uniform_indexing(true)
        .shader_storage_buffer_array_non_uniform_indexing(true)
        .descriptor_binding_partially_bound(true);
    let priorities = &[1.0; LANES][..queues as usize];
    let queues =
        [vk::DeviceQueueCreateInfo::default().queue_family_index(queue_family).queue_priorities(priorities)];
    let mut timeline = vk::PhysicalDeviceTimelineSemaphoreFeatures::default().timeline_semaphore(true);
    let mut info = vk::DeviceCreateInfo::default()
        .queue_create_infos(&queues)
        .enabled_features(&core)
        .push_next(&mut multiview);
    if server {
        info = info.push_next(&mut indexing).push_next(&mut timeline);
    }
    let mut pictures =
        vk::PhysicalDeviceSamplerYcbcrConversionFeatures::default().sampler_ycbcr_conversion(true);
    let mut density_maps = vk::PhysicalDeviceFragmentDensityMapFeaturesEXT::default()
        .fragment_density_map(true)
        .fragment_density_map_non_subsampled_images(true);
    let mut extensions = Vec::new();
    if options.needs == Needs::ClientOfPictures {
        info = info.push_next(&mut pictures);
        if cfg!(target_os = "android") {
            extensions.extend(PICTURE_EXTENSIONS.map(CStr::as_ptr));
        }
    }
    if takes_density_maps {
        info = info.push_next(&mut density_maps);
        extensions.push(DENSITY_MAP_EXTENSION.as_ptr());
    }
    let info = info.enabled_extension_names(&extensions);
    let handle = source.create_device(instance, physical, &info)?;
    // SAFETY: `handle` was created from this instance.
    Ok(unsafe { ash::Device::load(instance.fp_v1_0(), handle) })
}
