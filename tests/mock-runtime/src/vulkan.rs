//! `XR_KHR_vulkan_enable2`: the application's Vulkan instance and device are made here, with nothing added, and the
//! runtime works on that same device through the application's own loader.

use std::ffi::{CStr, c_char};

use ash::vk;
use openxr_sys as xr;
use vk::Handle as _;
use xr::platform::{VkDevice, VkInstance, VkPhysicalDevice, VkResult};

use crate::fault::{CallResult, Fault};
use crate::ffi::entry;
use crate::instance::check_system;
use crate::runtime;

/// What `xrCreateVulkanInstanceKHR` made.
pub(crate) struct Vulkan {
    pub(crate) instance: ash::Instance,
    /// What `xrCreateVulkanDeviceKHR` made of it since: devices with the physical devices that they are of.
    devices: Vec<(u64, u64)>,
}

impl Vulkan {
    /// True where a session's instance and device were made here, as the specification wants them to be. A device of nobody's would be
    /// used, and end the program, before anybody could say what is wrong with it.
    pub(crate) fn has_made(&self, binding: &xr::GraphicsBindingVulkanKHR) -> bool {
        let device = (binding.device as u64, binding.physical_device as u64);
        is_instance(self, binding.instance) && self.devices.contains(&device)
    }
}

/// The application's `vkGetInstanceProcAddr`.
fn static_functions(given: Option<xr::platform::VkGetInstanceProcAddr>) -> CallResult<ash::StaticFn> {
    let given = given.ok_or_else(|| Fault::usage("pfnGetInstanceProcAddr is null"))?;
    // SAFETY: both types describe vkGetInstanceProcAddr; a VkInstance is a pointer in both.
    let get_instance_proc_addr = unsafe {
        std::mem::transmute::<xr::platform::VkGetInstanceProcAddr, vk::PFN_vkGetInstanceProcAddr>(given)
    };
    Ok(ash::StaticFn { get_instance_proc_addr })
}

/// A function of the application's Vulkan loader.
fn function(
    vulkan: &ash::StaticFn,
    instance: vk::Instance,
    name: &CStr,
) -> CallResult<unsafe extern "system" fn()> {
    // SAFETY: vkGetInstanceProcAddr takes a null or valid instance and a zero-terminated name.
    let found = unsafe { (vulkan.get_instance_proc_addr)(instance, name.as_ptr().cast::<c_char>()) };
    found.ok_or_else(|| {
        let message = format!("pfnGetInstanceProcAddr does not know {}", name.to_string_lossy());
        Fault::application(xr::Result::ERROR_VALIDATION_FAILURE, message)
    })
}

entry! {
    get_requirements: GetVulkanGraphicsRequirementsKHR = "xrGetVulkanGraphicsRequirements2KHR"(
        instance: value xr::Instance,
        system_id: value xr::SystemId,
        requirements: output xr::GraphicsRequirementsVulkanKHR,
    ) {
        let mut runtime = runtime::lock();
        let core = runtime.core(instance)?;
        check_system(system_id)?;
        core.requirements_asked = true;
        requirements.min_api_version_supported = xr::Version::new(1, 0, 0);
        requirements.max_api_version_supported = xr::Version::new(1, 4, 0);
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    create_vulkan_instance: CreateVulkanInstanceKHR = "xrCreateVulkanInstanceKHR"(
        instance: value xr::Instance,
        create_info: input xr::VulkanInstanceCreateInfoKHR,
        vulkan_instance: slot VkInstance,
        vulkan_result: slot VkResult,
    ) {
        let mut runtime = runtime::lock();
        let core = runtime.core(instance)?;
        check_system(create_info.system_id)?;
        let functions = static_functions(create_info.pfn_get_instance_proc_addr)?;
        let create = function(&functions, vk::Instance::null(), c"vkCreateInstance")?;
        // SAFETY: vkGetInstanceProcAddr answers vkCreateInstance for its name.
        let create = unsafe { std::mem::transmute::<unsafe extern "system" fn(), vk::PFN_vkCreateInstance>(create) };
        let mut made = vk::Instance::null();
        // SAFETY: the application passes a valid VkInstanceCreateInfo and a valid or null allocator.
        let result =
            unsafe { create(create_info.vulkan_create_info.cast(), create_info.vulkan_allocator.cast(), &mut made) };
        *vulkan_result = result.as_raw();
        *vulkan_instance = made.as_raw() as VkInstance;
        if result == vk::Result::SUCCESS {
            // SAFETY: the instance was made by these functions a moment ago.
            let instance = unsafe { ash::Instance::load(&functions, made) };
            core.vulkan = Some(Vulkan { instance, devices: Vec::new() });
        }
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    get_graphics_device: GetVulkanGraphicsDevice2KHR = "xrGetVulkanGraphicsDevice2KHR"(
        instance: value xr::Instance,
        get_info: input xr::VulkanGraphicsDeviceGetInfoKHR,
        physical_device: slot VkPhysicalDevice,
    ) {
        let mut runtime = runtime::lock();
        let core = runtime.core(instance)?;
        check_system(get_info.system_id)?;
        let vulkan = core.vulkan.as_ref().filter(|vulkan| is_instance(vulkan, get_info.vulkan_instance));
        let vulkan = vulkan.ok_or_else(|| {
            Fault::usage("vulkanInstance is not the one that xrCreateVulkanInstanceKHR made last")
        })?;
        let chosen = choose_device(vulkan, core.config.vulkan_device.as_deref())?;
        *physical_device = chosen.as_raw() as VkPhysicalDevice;
        Ok(xr::Result::SUCCESS)
    }
}

/// True where `instance` is the application's instance.
fn is_instance(vulkan: &Vulkan, instance: VkInstance) -> bool {
    vulkan.instance.handle().as_raw() == instance as u64
}

/// The first device of the fastest kind that can draw and whose name has `wanted` in it.
fn choose_device(vulkan: &Vulkan, wanted: Option<&str>) -> CallResult<vk::PhysicalDevice> {
    // SAFETY: the instance lives: the application must destroy its session before it.
    let devices = unsafe { vulkan.instance.enumerate_physical_devices() }.map_err(|error| {
        Fault::runtime(xr::Result::ERROR_RUNTIME_FAILURE, format!("cannot list the Vulkan devices: {error}"))
    })?;
    let described: Vec<_> = devices.iter().map(|device| describe(vulkan, *device)).collect();
    let wanted = wanted.unwrap_or_default().to_lowercase();
    let fits = described.iter().filter(|found| found.draws && found.name.to_lowercase().contains(&wanted));
    fits.min_by_key(|found| found.rank).map(|found| found.device).ok_or_else(|| {
        let names: Vec<_> = described.iter().map(|found| found.name.as_str()).collect();
        let message = format!(
            "no Vulkan device with {wanted:?} in its name can draw; there are {names:?}; correct \"vulkan_device\""
        );
        Fault::runtime(xr::Result::ERROR_RUNTIME_FAILURE, message)
    })
}

struct Described {
    device: vk::PhysicalDevice,
    name: String,
    draws: bool,
    /// The lower, the faster its kind.
    rank: u32,
}

fn describe(vulkan: &Vulkan, device: vk::PhysicalDevice) -> Described {
    // SAFETY: the device was listed by this instance.
    let properties = unsafe { vulkan.instance.get_physical_device_properties(device) };
    // SAFETY: as above.
    let families = unsafe { vulkan.instance.get_physical_device_queue_family_properties(device) };
    let name = properties.device_name_as_c_str().unwrap_or_default().to_string_lossy().into_owned();
    let rank = match properties.device_type {
        vk::PhysicalDeviceType::DISCRETE_GPU => 0,
        vk::PhysicalDeviceType::INTEGRATED_GPU => 1,
        vk::PhysicalDeviceType::VIRTUAL_GPU => 2,
        vk::PhysicalDeviceType::CPU => 3,
        _ => 4,
    };
    let draws = families.iter().any(|family| family.queue_flags.contains(vk::QueueFlags::GRAPHICS));
    Described { device, name, draws, rank }
}

entry! {
    create_vulkan_device: CreateVulkanDeviceKHR = "xrCreateVulkanDeviceKHR"(
        instance: value xr::Instance,
        create_info: input xr::VulkanDeviceCreateInfoKHR,
        vulkan_device: slot VkDevice,
        vulkan_result: slot VkResult,
    ) {
        let mut runtime = runtime::lock();
        let core = runtime.core(instance)?;
        check_system(create_info.system_id)?;
        let vulkan = core.vulkan.as_mut().ok_or_else(|| Fault::order("call xrCreateVulkanInstanceKHR first"))?;
        let functions = static_functions(create_info.pfn_get_instance_proc_addr)?;
        let create = function(&functions, vulkan.instance.handle(), c"vkCreateDevice")?;
        // SAFETY: vkGetInstanceProcAddr answers vkCreateDevice for its name.
        let create = unsafe { std::mem::transmute::<unsafe extern "system" fn(), vk::PFN_vkCreateDevice>(create) };
        let physical_device = vk::PhysicalDevice::from_raw(create_info.vulkan_physical_device as u64);
        let mut made = vk::Device::null();
        // SAFETY: the application passes its physical device, a valid VkDeviceCreateInfo and a valid or null allocator.
        let result = unsafe {
            create(
                physical_device,
                create_info.vulkan_create_info.cast(),
                create_info.vulkan_allocator.cast(),
                &mut made,
            )
        };
        *vulkan_result = result.as_raw();
        *vulkan_device = made.as_raw() as VkDevice;
        if result == vk::Result::SUCCESS {
            vulkan.devices.push((made.as_raw(), physical_device.as_raw()));
        }
        Ok(xr::Result::SUCCESS)
    }
}
