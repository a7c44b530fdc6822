//! All requirements on a headset, in one place. The limits of its device are in the table of [`shadecast_gpu::limits`]. Tests
//! compare the list with a first-generation standalone headset, and the actual requests with the list.

use shadecast_gpu::vk;

/// What must be there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Requirements {
    /// Major and minor version of Vulkan.
    pub vulkan_version: [u32; 2],
    /// Vulkan device extensions.
    pub vulkan_extensions: &'static [&'static str],
    /// Vulkan features, by the names of the specification.
    pub vulkan_features: &'static [&'static str],
    /// Vulkan features where pictures stay in the device's memory, which on Android they always do.
    pub picture_features: &'static [&'static str],
    /// Vulkan device extensions by which the device reads what Android's decoders write; asked for there alone.
    pub picture_extensions: &'static [&'static str],
    /// Vulkan device extensions and features that are used where they are there, for fixed foveation.
    pub density_map_extensions: &'static [&'static str],
    /// See `density_map_extensions`.
    pub density_map_features: &'static [&'static str],
    /// Formats of the images of both eyes, best first: one of them must be there. They store what linear values encode to.
    pub eye_formats: [vk::Format; 2],
    /// Format of depth, which never leaves the pass.
    pub depth_format: vk::Format,
    /// Format of the atlas's planes.
    pub plane_format: vk::Format,
    /// SPIR-V capabilities that the client's shaders declare.
    pub spirv_capabilities: &'static [&'static str],
    /// OpenXR extensions, besides what a system's loader needs.
    pub openxr_extensions: &'static [&'static str],
}

/// What the client requires.
pub const REQUIRED: Requirements = Requirements {
    vulkan_version: [1, 1],
    vulkan_extensions: &[],
    vulkan_features: &["multiview"],
    picture_features: &["samplerYcbcrConversion"],
    picture_extensions: &[
        "VK_ANDROID_external_memory_android_hardware_buffer",
        "VK_EXT_queue_family_foreign",
    ],
    density_map_extensions: &["VK_EXT_fragment_density_map"],
    density_map_features: &["fragmentDensityMap", "fragmentDensityMapNonSubsampledImages"],
    eye_formats: [vk::Format::R8G8B8A8_SRGB, vk::Format::B8G8R8A8_SRGB],
    depth_format: vk::Format::D32_SFLOAT,
    plane_format: vk::Format::R8_UNORM,
    spirv_capabilities: &["Shader", "ImageQuery", "MultiView"],
    openxr_extensions: &["XR_KHR_vulkan_enable2"],
};
