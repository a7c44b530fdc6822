//! All that the client asks of a headset, in one place. A test holds it against what a first-generation standalone headset
//! has, and what is really asked for against it.

/// What must be there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Requirements {
    /// Major and minor version of Vulkan.
    pub vulkan_version: [u32; 2],
    /// Vulkan device extensions.
    pub vulkan_extensions: &'static [&'static str],
    /// Vulkan features, by the names of the specification.
    pub vulkan_features: &'static [&'static str],
    /// SPIR-V capabilities that the client's shaders declare.
    pub spirv_capabilities: &'static [&'static str],
    /// OpenXR extensions, besides what a system's loader needs.
    pub openxr_extensions: &'static [&'static str],
    /// Bytes of the largest storage buffer.
    pub storage_buffer_bytes: u64,
    /// Bytes of push constants.
    pub push_constant_bytes: u32,
}

/// What the client requires.
pub const REQUIRED: Requirements = Requirements {
    vulkan_version: [1, 1],
    vulkan_extensions: &[],
    vulkan_features: &["multiview"],
    spirv_capabilities: &["Shader", "ImageQuery", "MultiView"],
    openxr_extensions: &["XR_KHR_vulkan_enable2", "XR_KHR_convert_timespec_time"],
    // The sample ring of the most vertex slots.
    storage_buffer_bytes: shadecast_protocol::limits::MAX_VERTEX_SLOTS as u64
        * shadecast_protocol::limits::SAMPLE_RING as u64
        * 16,
    push_constant_bytes: 32,
};
