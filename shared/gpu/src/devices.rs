//! The Vulkan devices of this machine, and the missing requirements of each.

use crate::GpuError;
use crate::limits::{self, DeviceLimits};
use ash::vk;
use std::ffi::CStr;

/// What to do where there is no device at all.
pub(crate) const NO_DRIVER: &str = if cfg!(windows) {
    "there is no driver; install the one of the graphics card's maker"
} else {
    "there is no driver; install the one of the graphics card's maker, or Mesa's (Debian and Ubuntu: package \
     mesa-vulkan-drivers, which also has one that needs no graphics card), or run ./shadecast setup"
};
/// The same without the loader.
pub(crate) const NO_LOADER: &str = if cfg!(windows) {
    "it comes with the driver of the graphics card's maker"
} else {
    "install it (Debian and Ubuntu: package libvulkan1)"
};
/// The same without the layer.
pub(crate) const NO_LAYER: &str = if cfg!(windows) {
    "it comes with the Vulkan SDK"
} else {
    "Debian and Ubuntu: package vulkan-validationlayers"
};

/// Which of the required feature sets a device must have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Needs {
    /// Vulkan 1.2 with descriptor indexing. `gl_PrimitiveID` in fragment shaders is asked for where the device has it.
    Server,
    /// Vulkan 1.1 core with multiview: nothing a first-generation standalone headset lacks.
    Client,
    /// The same with pictures of several planes that one lookup reads; on Android those of its decoders.
    ClientOfPictures,
}

/// Extensions by which a device of Android reads what its decoders write.
pub const PICTURE_EXTENSIONS: [&CStr; 2] =
    [ash::android::external_memory_android_hardware_buffer::NAME, ash::ext::queue_family_foreign::NAME];

/// Extension by which a pass shades fewer fragments where a map says so.
pub const DENSITY_MAP_EXTENSION: &CStr = ash::ext::fragment_density_map::NAME;

/// A device that a driver offers.
#[derive(Clone, Debug)]
pub struct FoundDevice {
    /// Its own name for itself.
    pub name: String,
    /// "discrete GPU", "integrated GPU", "virtual GPU", "CPU" or "other".
    pub kind: &'static str,
    /// Correct, slow.
    pub is_cpu: bool,
    /// Vulkan's version: major, minor.
    pub vulkan_version: [u32; 2],
    /// Bytes of its own memory.
    pub memory_bytes: u64,
    /// The first thing that is needed and not there.
    pub lacks: Option<String>,
    /// Its offer of every limit.
    pub limits: DeviceLimits,
    /// Has two queues for graphics and compute, so that one works beside the other.
    pub has_two_queues: bool,
    pub(crate) physical: vk::PhysicalDevice,
}

impl FoundDevice {
    /// Whether its name holds `wanted`, where somebody wants one.
    pub fn is_named(&self, wanted: Option<&str>) -> bool {
        wanted.is_none_or(|wanted| self.name.contains(wanted))
    }

    /// Whether who wants that would take it: it lacks nothing.
    pub fn is_usable(&self, wanted: Option<&str>) -> bool {
        self.lacks.is_none() && self.is_named(wanted)
    }
}

/// All devices of an instance, the best first.
pub(crate) fn list(instance: &ash::Instance, needs: Needs) -> Result<Vec<FoundDevice>, GpuError> {
    // SAFETY: the instance is alive.
    let listed = unsafe { instance.enumerate_physical_devices() };
    // A driver without its hardware fails instead of listing nothing.
    let listed = listed.unwrap_or_default();
    if listed.is_empty() {
        return Err(GpuError::NoDevice(NO_DRIVER.into()));
    }
    let mut ranked: Vec<_> = listed.into_iter().map(|physical| found(instance, physical, needs)).collect();
    ranked.sort_by_key(|(rank, _)| *rank);
    Ok(ranked.into_iter().map(|(_, found)| found).collect())
}

fn found(instance: &ash::Instance, physical: vk::PhysicalDevice, needs: Needs) -> (u32, FoundDevice) {
    // SAFETY: `physical` was just listed by this instance.
    let (properties, memory, families) = unsafe {
        (
            instance.get_physical_device_properties(physical),
            instance.get_physical_device_memory_properties(physical),
            instance.get_physical_device_queue_family_properties(physical),
        )
    };
    let heaps = memory.memory_heaps[..memory.memory_heap_count as usize].iter();
    let own = heaps.filter(|heap| heap.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL));
    let wanted = vk::QueueFlags::GRAPHICS | vk::QueueFlags::COMPUTE;
    let queues = families.iter().find(|family| family.queue_flags.contains(wanted));
    let version = properties.api_version;
    let device = FoundDevice {
        name: name_of(&properties),
        kind: kind(properties.device_type),
        is_cpu: properties.device_type == vk::PhysicalDeviceType::CPU,
        vulkan_version: [vk::api_version_major(version), vk::api_version_minor(version)],
        memory_bytes: own.map(|heap| heap.size).max().unwrap_or(0),
        lacks: missing(instance, physical, needs),
        limits: limits::of(instance, physical),
        has_two_queues: queues.is_some_and(|family| family.queue_count > 1),
        physical,
    };
    (rank(properties.device_type), device)
}

fn kind(device_type: vk::PhysicalDeviceType) -> &'static str {
    match device_type {
        vk::PhysicalDeviceType::DISCRETE_GPU => "discrete GPU",
        vk::PhysicalDeviceType::INTEGRATED_GPU => "integrated GPU",
        vk::PhysicalDeviceType::VIRTUAL_GPU => "virtual GPU",
        vk::PhysicalDeviceType::CPU => "CPU",
        _ => "other",
    }
}

fn rank(device_type: vk::PhysicalDeviceType) -> u32 {
    match device_type {
        vk::PhysicalDeviceType::DISCRETE_GPU => 0,
        vk::PhysicalDeviceType::INTEGRATED_GPU => 1,
        vk::PhysicalDeviceType::VIRTUAL_GPU => 2,
        vk::PhysicalDeviceType::CPU => 3,
        _ => 4,
    }
}

pub(crate) fn name_of(properties: &vk::PhysicalDeviceProperties) -> String {
    properties.device_name_as_c_str().map_or_else(|_| "unnamed".into(), |n| n.to_string_lossy().into_owned())
}

/// Names the first needed feature that the device lacks, or the first limit that is too low.
pub(crate) fn missing(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    needs: Needs,
) -> Option<String> {
    let feature = missing_feature(instance, physical, needs).map(str::to_owned);
    let limit = || limits::lacking(&limits::of(instance, physical), needs);
    feature.or_else(|| limit().map(|verdict| verdict.to_string()))
}

fn missing_feature(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    needs: Needs,
) -> Option<&'static str> {
    // SAFETY: `physical` belongs to `instance`.
    let properties = unsafe { instance.get_physical_device_properties(physical) };
    let api = if needs == Needs::Server { vk::API_VERSION_1_2 } else { vk::API_VERSION_1_1 };
    if properties.api_version < api {
        return Some("the needed Vulkan version (server 1.2, client 1.1)");
    }
    let mut multiview = vk::PhysicalDeviceMultiviewFeatures::default();
    let mut indexing = vk::PhysicalDeviceDescriptorIndexingFeatures::default();
    let mut pictures = vk::PhysicalDeviceSamplerYcbcrConversionFeatures::default();
    let mut features =
        vk::PhysicalDeviceFeatures2::default().push_next(&mut multiview).push_next(&mut pictures);
    if needs == Needs::Server {
        features = features.push_next(&mut indexing);
    }
    // SAFETY: the chain holds structs that this Vulkan version knows, and lives through the call.
    unsafe { instance.get_physical_device_features2(physical, &mut features) };
    let core = features.features;
    if multiview.multiview == 0 {
        return Some("multiview");
    }
    if needs == Needs::ClientOfPictures && pictures.sampler_ycbcr_conversion == 0 {
        return Some("samplerYcbcrConversion");
    }
    if needs == Needs::ClientOfPictures && cfg!(target_os = "android") {
        return lacking(instance, physical, &PICTURE_EXTENSIONS);
    }
    if needs != Needs::Server {
        return None;
    }
    let wanted = [
        (core.sampler_anisotropy, "samplerAnisotropy"),
        (indexing.runtime_descriptor_array, "runtimeDescriptorArray"),
        (indexing.shader_sampled_image_array_non_uniform_indexing, "non-uniform texture indexing"),
        (core.shader_storage_buffer_array_dynamic_indexing, "shaderStorageBufferArrayDynamicIndexing"),
        (indexing.shader_storage_buffer_array_non_uniform_indexing, "non-uniform buffer indexing"),
        (indexing.descriptor_binding_partially_bound, "partially bound descriptors"),
    ];
    wanted.iter().find(|(has, _)| *has == 0).map(|(_, name)| *name)
}

/// The first of these extensions that the device does not have.
fn lacking(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    wanted: &[&'static CStr],
) -> Option<&'static str> {
    // SAFETY: `physical` belongs to `instance`. A device that cannot list them has none.
    let offered = unsafe { instance.enumerate_device_extension_properties(physical) }.unwrap_or_default();
    let has = |name: &CStr| offered.iter().any(|of_device| of_device.extension_name_as_c_str() == Ok(name));
    let lacks = wanted.iter().copied().find(|name| !has(name));
    lacks.map(|name| name.to_str().unwrap_or("an extension that reads pictures"))
}

/// The feature that `gl_PrimitiveID` in a fragment shader belongs to; some drivers lack it (MoltenVK, some of phones).
pub(crate) fn has_geometry_shader(instance: &ash::Instance, physical: vk::PhysicalDevice) -> bool {
    // SAFETY: `physical` belongs to `instance`.
    unsafe { instance.get_physical_device_features(physical) }.geometry_shader != 0
}

/// Whether passes take a density map with attachments of any kind: those of an OpenXR runtime are not made for it alone.
pub(crate) fn has_density_maps(instance: &ash::Instance, physical: vk::PhysicalDevice) -> bool {
    if lacking(instance, physical, &[DENSITY_MAP_EXTENSION]).is_some() {
        return false;
    }
    let mut maps = vk::PhysicalDeviceFragmentDensityMapFeaturesEXT::default();
    let mut features = vk::PhysicalDeviceFeatures2::default().push_next(&mut maps);
    // SAFETY: the device has the extension whose struct is in the chain, which lives through the call.
    unsafe { instance.get_physical_device_features2(physical, &mut features) };
    maps.fragment_density_map != 0 && maps.fragment_density_map_non_subsampled_images != 0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_extension_that_is_not_there_is_named() {
        let options = crate::GpuOptions { needs: Needs::Client, validation: false, device_name: None };
        let gpu = crate::Gpu::open(&options, &crate::DesktopDevice).expect("a Vulkan device");
        let lacks = |wanted: &[&'static CStr]| lacking(gpu.instance(), gpu.physical_device(), wanted);
        // Part of Vulkan 1.1, and still listed by every driver.
        let there = ash::khr::maintenance1::NAME;
        assert_eq!(lacks(&[]), None);
        assert_eq!(lacks(&[there]), None);
        assert_eq!(lacks(&[there, c"VK_SHADECAST_none", c"VK_SHADECAST_other"]), Some("VK_SHADECAST_none"));
    }
}
