//! Every device limit that the programs rely on, in one table: the need of each program beside the device's offer. A device is
//! checked against the table before it is opened. Needs that depend on the scene are checked where they arise, by [`check`].

use crate::{GpuError, Needs};
use ash::vk;
use shadecast_protocol::limits::MAX_STORE_PAGES;
use shadecast_spirv::BindingKind;

/// The offer of a device.
#[derive(Clone, Copy, Debug, Default)]
pub struct DeviceLimits {
    /// Of Vulkan 1.0.
    pub core: vk::PhysicalDeviceLimits,
    /// Views that a pass may draw at once.
    pub multiview_views: u32,
    /// Most samples per pixel of a pass with colour and depth.
    pub samples: u32,
}

/// One limit of one device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Verdict {
    /// Its name in the Vulkan specification.
    pub name: &'static str,
    /// The least that will do.
    pub needed: u32,
    /// The device's value.
    pub offered: u32,
}

impl Verdict {
    /// Whether the device offers enough.
    pub fn is_met(&self) -> bool {
        self.offered >= self.needed
    }
}

impl std::fmt::Display for Verdict {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {} needed, {} offered", self.name, self.needed, self.offered)
    }
}

/// A row: name, need of the server, need of the client, place of the offer.
type Row = (&'static str, [u32; 2], fn(&mut DeviceLimits) -> &mut u32);

/// Images and framebuffers of the largest atlas, which is a coded picture too.
const ATLAS_SIDE: u32 = shadecast_protocol::limits::ATLAS_MAX_EXTENT[0];

/// The table. A need of 0 is none. `tests/limits.rs` holds the needs against the shaders.
#[rustfmt::skip]
const ROWS: &[Row] = &[
    // The allocator asks for blocks of 64 MiB and more.
    ("maxMemoryAllocationCount", [256, 256], |l| &mut l.core.max_memory_allocation_count),
    // Wrap modes of textures; one for each stage that samples.
    ("maxSamplerAllocationCount", [16, 8], |l| &mut l.core.max_sampler_allocation_count),
    ("maxImageDimension2D", [ATLAS_SIDE, ATLAS_SIDE], |l| &mut l.core.max_image_dimension2_d),
    // Two eyes; pages of the store.
    ("maxImageArrayLayers", [2, MAX_STORE_PAGES], |l| &mut l.core.max_image_array_layers),
    ("maxMultiviewViewCount", [2, 2], |l| &mut l.multiview_views),
    ("maxFramebufferWidth", [ATLAS_SIDE, ATLAS_SIDE], |l| &mut l.core.max_framebuffer_width),
    ("maxFramebufferHeight", [ATLAS_SIDE, ATLAS_SIDE], |l| &mut l.core.max_framebuffer_height),
    // Multiview draws into the layers of a framebuffer of one.
    ("maxFramebufferLayers", [1, 1], |l| &mut l.core.max_framebuffer_layers),
    ("maxViewportDimensions[0]", [ATLAS_SIDE, ATLAS_SIDE], |l| &mut l.core.max_viewport_dimensions[0]),
    ("maxViewportDimensions[1]", [ATLAS_SIDE, ATLAS_SIDE], |l| &mut l.core.max_viewport_dimensions[1]),
    // Number and distance in the probes.
    ("maxColorAttachments", [2, 2], |l| &mut l.core.max_color_attachments),
    ("maxFragmentOutputAttachments", [2, 2], |l| &mut l.core.max_fragment_output_attachments),
    // Four samples: the truth, and a client's default.
    ("framebufferColorSampleCounts", [4, 4], |l| &mut l.samples),
    ("maxVertexOutputComponents", [20, 16], |l| &mut l.core.max_vertex_output_components),
    ("maxFragmentInputComponents", [20, 16], |l| &mut l.core.max_fragment_input_components),
    // An instance has at most as many vertices.
    ("maxDrawIndexedIndexValue", [(1 << 24) - 1, 0], |l| &mut l.core.max_draw_indexed_index_value),
    ("maxBoundDescriptorSets", [1, 1], |l| &mut l.core.max_bound_descriptor_sets),
    ("maxPushConstantsSize", [84, 40], |l| &mut l.core.max_push_constants_size),
    ("maxUniformBufferRange", [3840, 304], |l| &mut l.core.max_uniform_buffer_range),
    // The server's saved vertices, the client's samples.
    ("maxStorageBufferRange", [128 << 20, 128 << 20], |l| &mut l.core.max_storage_buffer_range),
    ("maxPerStageDescriptorUniformBuffers", [2, 2], |l| &mut l.core.max_per_stage_descriptor_uniform_buffers),
    ("maxPerStageDescriptorStorageBuffers", [14, 10], |l| &mut l.core.max_per_stage_descriptor_storage_buffers),
    // A texture and the shadow map; the store, and two pictures: three planes each, or one of a platform's format.
    (SAMPLERS, [2, 9], |l| &mut l.core.max_per_stage_descriptor_samplers),
    ("maxPerStageDescriptorSampledImages", [2, 9], |l| &mut l.core.max_per_stage_descriptor_sampled_images),
    // Two mip levels of the store.
    ("maxPerStageDescriptorStorageImages", [0, 2], |l| &mut l.core.max_per_stage_descriptor_storage_images),
    // Attachments count.
    ("maxPerStageResources", [17, 11], |l| &mut l.core.max_per_stage_resources),
    ("maxDescriptorSetUniformBuffers", [2, 2], |l| &mut l.core.max_descriptor_set_uniform_buffers),
    ("maxDescriptorSetStorageBuffers", [14, 10], |l| &mut l.core.max_descriptor_set_storage_buffers),
    ("maxDescriptorSetSamplers", [2, 9], |l| &mut l.core.max_descriptor_set_samplers),
    ("maxDescriptorSetSampledImages", [2, 9], |l| &mut l.core.max_descriptor_set_sampled_images),
    ("maxDescriptorSetStorageImages", [0, 2], |l| &mut l.core.max_descriptor_set_storage_images),
    // The curves of one path.
    ("maxComputeSharedMemorySize", [0, 48], |l| &mut l.core.max_compute_shared_memory_size),
    ("maxComputeWorkGroupInvocations", [128, 64], |l| &mut l.core.max_compute_work_group_invocations),
    ("maxComputeWorkGroupSize[0]", [128, 64], |l| &mut l.core.max_compute_work_group_size[0]),
    ("maxComputeWorkGroupSize[1]", [8, 1], |l| &mut l.core.max_compute_work_group_size[1]),
    // All vertices of a client, all parts of the largest atlas; a server's models are checked when they are loaded.
    ("maxComputeWorkGroupCount[0]", [8192, 8192], |l| &mut l.core.max_compute_work_group_count[0]),
    ("maxComputeWorkGroupCount[1]", [512, 1], |l| &mut l.core.max_compute_work_group_count[1]),
    ("maxComputeWorkGroupCount[2]", [2, 1], |l| &mut l.core.max_compute_work_group_count[2]),
];

const SAMPLERS: &str = "maxPerStageDescriptorSamplers";
/// The rows of which each texture of a scene takes one more.
const OF_TEXTURES: [&str; 5] = [
    SAMPLERS,
    "maxPerStageDescriptorSampledImages",
    "maxPerStageResources",
    "maxDescriptorSetSamplers",
    "maxDescriptorSetSampledImages",
];

/// The limits of a stage: descriptors of a kind, or of all.
pub(crate) const OF_STAGES: [(&str, Option<BindingKind>); 6] = [
    ("maxPerStageDescriptorUniformBuffers", Some(BindingKind::UniformBuffer)),
    ("maxPerStageDescriptorStorageBuffers", Some(BindingKind::StorageBuffer)),
    (SAMPLERS, Some(BindingKind::SampledImage)),
    ("maxPerStageDescriptorSampledImages", Some(BindingKind::SampledImage)),
    ("maxPerStageDescriptorStorageImages", Some(BindingKind::StorageImage)),
    ("maxPerStageResources", None),
];
/// The limits of a set: descriptors of a kind.
pub(crate) const OF_SETS: [(&str, BindingKind); 5] = [
    ("maxDescriptorSetUniformBuffers", BindingKind::UniformBuffer),
    ("maxDescriptorSetStorageBuffers", BindingKind::StorageBuffer),
    ("maxDescriptorSetSamplers", BindingKind::SampledImage),
    ("maxDescriptorSetSampledImages", BindingKind::SampledImage),
    ("maxDescriptorSetStorageImages", BindingKind::StorageImage),
];

/// The whole table for a device, in its order, without the rows that a program does not need.
pub fn verdicts(limits: &DeviceLimits, needs: Needs) -> Vec<Verdict> {
    let mut limits = *limits;
    let column = usize::from(needs != Needs::Server);
    let rows = ROWS.iter().map(|(name, needed, field)| Verdict {
        name,
        needed: needed[column],
        offered: *field(&mut limits),
    });
    rows.filter(|verdict| verdict.needed > 0).collect()
}

/// The first limit that is too low.
pub(crate) fn lacking(limits: &DeviceLimits, needs: Needs) -> Option<Verdict> {
    verdicts(limits, needs).into_iter().find(|verdict| !verdict.is_met())
}

/// The row of a limit, which a program needs.
///
/// # Panics
/// The table has no such row: a mistake of ours.
pub fn verdict(limits: &DeviceLimits, needs: Needs, name: &str) -> Verdict {
    let found = verdicts(limits, needs).into_iter().find(|verdict| verdict.name == name);
    found.unwrap_or_else(|| panic!("the table of limits has no {name}"))
}

/// Textures of a scene that a server's shaders can be given at once.
pub fn most_textures(limits: &DeviceLimits) -> u32 {
    let Verdict { needed, offered, .. } = scarcest(limits);
    offered.saturating_sub(needed - 1)
}

/// The row that ends the textures first. The need of each has one texture in it.
fn scarcest(limits: &DeviceLimits) -> Verdict {
    let rows = OF_TEXTURES.map(|name| verdict(limits, Needs::Server, name));
    let room = |row: &Verdict| i64::from(row.offered) - i64::from(row.needed);
    rows.into_iter().min_by_key(room).expect("there are rows")
}

/// That a scene's textures can be bound at once.
///
/// # Errors
/// They cannot; the text names the limit.
pub fn check_textures(limits: &DeviceLimits, count: u32) -> Result<(), GpuError> {
    let Verdict { name, needed, .. } = scarcest(limits);
    let needed = count.saturating_add(needed - 1);
    let what = format!("binding the scene's {count} textures");
    check(limits, name, &what, needed.into(), "use fewer textures (several can share an image)")
}

/// That a device offers as much of a limit as `what` needs.
///
/// # Errors
/// It does not; the text names limit, need, offer and `remedy`.
pub fn check(
    limits: &DeviceLimits,
    name: &str,
    what: &str,
    needed: u64,
    remedy: &str,
) -> Result<(), GpuError> {
    let row = ROWS.iter().find(|row| row.0 == name).unwrap_or_else(|| panic!("no limit is called {name}"));
    let offered = *row.2(&mut limits.clone());
    if needed <= u64::from(offered) {
        return Ok(());
    }
    Err(GpuError::TooLarge(format!(
        "{what} needs {needed}, and this device offers {offered} ({name}); {remedy}, or another device"
    )))
}

/// Asks a device.
pub(crate) fn of(instance: &ash::Instance, physical: vk::PhysicalDevice) -> DeviceLimits {
    // SAFETY: `physical` belongs to `instance`.
    let core = unsafe { instance.get_physical_device_properties(physical) };
    let mut multiview = vk::PhysicalDeviceMultiviewProperties::default();
    if core.api_version >= vk::API_VERSION_1_1 {
        let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut multiview);
        // SAFETY: the chain holds a struct of Vulkan 1.1, which the device has, and lives through the call.
        unsafe { instance.get_physical_device_properties2(physical, &mut properties) };
    }
    let core = core.limits;
    let samples = core.framebuffer_color_sample_counts & core.framebuffer_depth_sample_counts;
    let samples = samples.as_raw().checked_ilog2().map_or(0, |bit| 1 << bit);
    DeviceLimits { core, multiview_views: multiview.max_multiview_view_count, samples }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [Needs; 3] = [Needs::Server, Needs::Client, Needs::ClientOfPictures];

    /// Offers `value` of everything.
    fn offering(value: u32) -> DeviceLimits {
        let mut limits = DeviceLimits::default();
        ROWS.iter().for_each(|(_, _, field)| *field(&mut limits) = value);
        limits
    }

    /// A device that lacks nothing, but for one limit.
    fn masked(name: &str, value: u32) -> DeviceLimits {
        let mut limits = offering(u32::MAX);
        let row = ROWS.iter().find(|row| row.0 == name).expect("a row");
        *row.2(&mut limits) = value;
        limits
    }

    #[test]
    fn each_limit_is_refused_one_below_its_need_and_taken_at_it() {
        for needs in ALL {
            for Verdict { name, needed, .. } in verdicts(&offering(u32::MAX), needs) {
                assert_eq!(lacking(&masked(name, needed), needs), None, "{name}");
                let refused = lacking(&masked(name, needed - 1), needs);
                assert_eq!(refused, Some(Verdict { name, needed, offered: needed - 1 }));
            }
        }
    }

    #[test]
    fn rows_have_names_and_places_of_their_own() {
        for (at, (name, _, field)) in ROWS.iter().enumerate() {
            let mut limits = offering(0);
            *field(&mut limits) = 1;
            let set = ROWS.iter().filter(|(_, _, other)| *other(&mut limits.clone()) == 1).count();
            assert_eq!(set, 1, "{name} shares its place");
            assert!(ROWS[at + 1..].iter().all(|(other, ..)| other != name), "{name} stands twice");
        }
    }

    /// Vulkan's own guarantees; source: Vulkan 1.3, table "Required Limits".
    #[test]
    fn of_the_least_vulkan_device_only_storage_buffers_are_too_few() {
        let mut least = offering(u32::MAX);
        let core = &mut least.core;
        (core.max_memory_allocation_count, core.max_sampler_allocation_count) = (4096, 4000);
        (core.max_image_dimension2_d, core.max_image_array_layers) = (4096, 256);
        (core.max_framebuffer_width, core.max_framebuffer_height) = (4096, 4096);
        (core.max_framebuffer_layers, core.max_viewport_dimensions) = (256, [4096; 2]);
        (core.max_color_attachments, core.max_fragment_output_attachments) = (4, 4);
        (core.max_vertex_output_components, core.max_fragment_input_components) = (64, 64);
        core.max_draw_indexed_index_value = (1 << 24) - 1;
        (core.max_bound_descriptor_sets, core.max_push_constants_size) = (4, 128);
        (core.max_uniform_buffer_range, core.max_storage_buffer_range) = (16_384, 1 << 27);
        core.max_per_stage_descriptor_uniform_buffers = 12;
        core.max_per_stage_descriptor_storage_buffers = 4;
        (core.max_per_stage_descriptor_samplers, core.max_per_stage_descriptor_sampled_images) = (16, 16);
        core.max_per_stage_resources = 128;
        (core.max_descriptor_set_uniform_buffers, core.max_descriptor_set_storage_buffers) = (72, 24);
        (core.max_descriptor_set_samplers, core.max_descriptor_set_sampled_images) = (96, 96);
        (core.max_compute_shared_memory_size, core.max_compute_work_group_invocations) = (16_384, 128);
        core.max_compute_work_group_size = [128, 128, 64];
        core.max_compute_work_group_count = [65_535; 3];
        (least.multiview_views, least.samples) = (6, 4);
        for needs in ALL {
            let all = verdicts(&least, needs);
            let unmet: Vec<_> = all.iter().filter(|row| !row.is_met()).map(|row| row.name).collect();
            assert_eq!(unmet, ["maxPerStageDescriptorStorageBuffers"], "{needs:?}");
        }
    }

    #[test]
    fn textures_end_with_the_scarcest_limit_and_the_refusal_names_it() {
        for (name, beside) in OF_TEXTURES.into_iter().zip([1, 1, 16, 1, 1]) {
            let limits = masked(name, 64);
            assert_eq!(most_textures(&limits), 64 - beside, "{name}");
            assert!(check_textures(&limits, 64 - beside).is_ok());
            let refused = check_textures(&limits, 65 - beside).expect_err("one too many").to_string();
            for word in [name, "needs 65", "offers 64", "use fewer textures"] {
                assert!(refused.contains(word), "{word}: {refused}");
            }
        }
    }

    #[test]
    fn a_device_without_room_for_one_texture_has_room_for_none() {
        assert_eq!(most_textures(&masked(SAMPLERS, 0)), 0);
        assert_eq!(most_textures(&masked(SAMPLERS, 1)), 0);
    }
}
