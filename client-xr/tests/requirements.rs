//! What the client asks of a headset: the list against what every headset has, and what is really asked for against the list.

use shadecast_client::platform::requirements::REQUIRED;
use shadecast_gpu::limits::{DeviceLimits, verdict};
use shadecast_gpu::{
    DENSITY_MAP_EXTENSION, DesktopDevice, DeviceSource, Gpu, GpuError, GpuOptions, Needs, PICTURE_EXTENSIONS,
    vk,
};
use shadecast_protocol::limits::{MAX_KEPT_SAMPLES, MAX_PATCH_SLOTS};
use shadecast_shaders::Shader;
use shadecast_shaders::generated as shaders;
use std::ffi::CStr;
use std::sync::Mutex;

/// What a Snapdragon 865 / XR2 of 2020 has: its published Vulkan profile, restricted to what is worth using.
const EVERY_HEADSET_FEATURES: [&str; 5] = [
    "multiview",
    "storageBuffer16BitAccess",
    "samplerYcbcrConversion",
    "shaderDrawParameters",
    "robustBufferAccess",
];
const EVERY_HEADSET_CAPABILITIES: [&str; 4] = ["Matrix", "Shader", "MultiView", "ImageQuery"];
/// By which Android's own decoders are read since its release 8; both headsets list them.
const EVERY_HEADSET_PICTURE_EXTENSIONS: [&str; 2] =
    ["VK_ANDROID_external_memory_android_hardware_buffer", "VK_EXT_queue_family_foreign"];
/// Used where they are there, which is on headsets of such processors alone.
const HEADSET_DENSITY_MAPS: [&str; 3] =
    ["VK_EXT_fragment_density_map", "fragmentDensityMap", "fragmentDensityMapNonSubsampledImages"];
const EVERY_RUNTIME_EXTENSIONS: [&str; 1] = ["XR_KHR_vulkan_enable2"];
/// Quest 2's and Quest 3's drivers have these for what the client does with them; Vulkan guarantees all but the depth of 32 bits.
const EVERY_HEADSET_FORMATS: [vk::Format; 4] =
    [vk::Format::R8G8B8A8_SRGB, vk::Format::B8G8R8A8_SRGB, vk::Format::D32_SFLOAT, vk::Format::R8_UNORM];

fn client_shaders() -> Vec<&'static Shader> {
    vec![
        &shaders::CLIENT_SCATTER_COMP,
        &shaders::CLIENT_INTERPOLATE_COMP,
        &shaders::CLIENT_POSE_COMP,
        &shaders::CLIENT_SKIN_COMP,
        &shaders::CLIENT_SETTLE_COMP,
        &shaders::CLIENT_SETTLE_PICTURE_COMP,
        &shaders::CLIENT_SETTLE_COSITED_COMP,
        &shaders::CLIENT_SETTLE_MIP_COMP,
        &shaders::CLIENT_ATLAS_VERT,
        &shaders::CLIENT_ATLAS_FRAG,
        &shaders::CLIENT_ATLAS_BICUBIC_FRAG,
        &shaders::CLIENT_ATLAS_PICTURE_FRAG,
        &shaders::CLIENT_ATLAS_COSITED_FRAG,
        &shaders::CLIENT_ATLAS_MASKED_VERT,
        &shaders::CLIENT_ATLAS_MASKED_FRAG,
        &shaders::CLIENT_ATLAS_MASKED_BICUBIC_FRAG,
        &shaders::CLIENT_ATLAS_MASKED_PICTURE_FRAG,
        &shaders::CLIENT_ATLAS_MASKED_COSITED_FRAG,
        &shaders::CLIENT_BACKGROUND_VERT,
        &shaders::CLIENT_BACKGROUND_FRAG,
        &shaders::CLIENT_HANDS_VERT,
        &shaders::CLIENT_HANDS_FRAG,
        &shaders::CLIENT_NOTICE_VERT,
        &shaders::CLIENT_NOTICE_FRAG,
        &shaders::CLIENT_PROBE_VERT,
        &shaders::CLIENT_PROBE_FRAG,
    ]
}

#[test]
fn the_requirements_fit_a_first_generation_headset() {
    assert!(REQUIRED.vulkan_version <= [1, 1]);
    assert!(REQUIRED.vulkan_extensions.is_empty());
    assert!(REQUIRED.vulkan_features.iter().all(|f| EVERY_HEADSET_FEATURES.contains(f)));
    assert!(REQUIRED.picture_features.iter().all(|f| EVERY_HEADSET_FEATURES.contains(f)));
    assert!(REQUIRED.picture_extensions.iter().all(|e| EVERY_HEADSET_PICTURE_EXTENSIONS.contains(e)));
    let mut density_maps = REQUIRED.density_map_extensions.iter().chain(REQUIRED.density_map_features);
    assert!(density_maps.all(|name| HEADSET_DENSITY_MAPS.contains(name)));
    assert!(REQUIRED.spirv_capabilities.iter().all(|c| EVERY_HEADSET_CAPABILITIES.contains(c)));
    let formats = [REQUIRED.depth_format, REQUIRED.plane_format].into_iter().chain(REQUIRED.eye_formats);
    assert!(formats.into_iter().all(|format| EVERY_HEADSET_FORMATS.contains(&format)));
    assert!(REQUIRED.openxr_extensions.iter().all(|e| EVERY_RUNTIME_EXTENSIONS.contains(e)));
}

#[test]
fn the_largest_buffer_is_within_the_table_of_limits() {
    let largest = [u64::from(MAX_KEPT_SAMPLES) * 16, u64::from(MAX_PATCH_SLOTS) * 5 * 16];
    let needed = verdict(&DeviceLimits::default(), Needs::Client, "maxStorageBufferRange").needed;
    assert_eq!(largest.into_iter().max(), Some(u64::from(needed)));
}

#[test]
fn the_shaders_declare_only_listed_capabilities() {
    let mut declared = std::collections::BTreeSet::new();
    for shader in client_shaders() {
        for capability in capabilities(shader.words) {
            assert!(REQUIRED.spirv_capabilities.contains(&capability), "{}: {capability}", shader.name);
            declared.insert(capability);
        }
    }
    assert_eq!(declared.len(), REQUIRED.spirv_capabilities.len(), "{declared:?}");
}

/// What a driver does with a position that is no number is its own choice.
#[test]
fn no_vertex_shader_of_the_client_writes_what_is_no_number() {
    for shader in [
        &shaders::CLIENT_ATLAS_VERT,
        &shaders::CLIENT_ATLAS_MASKED_VERT,
        &shaders::CLIENT_PROBE_VERT,
        &shaders::CLIENT_BACKGROUND_VERT,
    ] {
        for constant in float_constants(shader.words) {
            assert!(!f32::from_bits(constant).is_nan(), "{}: constant {constant:#x}", shader.name);
        }
    }
}

/// Values of the `OpConstant` instructions whose type is a float of 32 bits. Source: SPIR-V 1.3,
/// sections 2.3, 3.32.6 and 3.32.7.
fn float_constants(words: &[u32]) -> Vec<u32> {
    const OP_TYPE_FLOAT: u32 = 22;
    const OP_CONSTANT: u32 = 43;
    let mut float_type = None;
    let mut found = Vec::new();
    let mut at = 5;
    while at < words.len() {
        let (length, opcode) = ((words[at] >> 16) as usize, words[at] & 0xffff);
        match (opcode, length) {
            (OP_TYPE_FLOAT, 3) if words[at + 2] == 32 => float_type = Some(words[at + 1]),
            (OP_CONSTANT, 4) if Some(words[at + 1]) == float_type => found.push(words[at + 3]),
            _ => {}
        }
        at += length.max(1);
    }
    assert!(!found.is_empty(), "a module without constants was not read right");
    found
}

/// `OpCapability` instructions of a module. Source: SPIR-V 1.3, sections 2.3 and 3.31.
fn capabilities(words: &[u32]) -> Vec<&'static str> {
    let mut found = Vec::new();
    let mut at = 5;
    while at < words.len() {
        let (length, opcode) = ((words[at] >> 16) as usize, words[at] & 0xffff);
        if opcode == 17 {
            found.push(match words[at + 1] {
                0 => "Matrix",
                1 => "Shader",
                50 => "ImageQuery",
                4439 => "MultiView",
                _ => "unknown",
            });
        }
        at += length.max(1);
    }
    found
}

/// Passes everything on, and notes what the device is created with.
#[derive(Default)]
struct Noting {
    asked: Mutex<Vec<String>>,
}

impl DeviceSource for Noting {
    fn create_instance(
        &self,
        entry: &ash::Entry,
        info: &vk::InstanceCreateInfo<'_>,
    ) -> Result<vk::Instance, GpuError> {
        // SAFETY: the application info is there and lives through the call.
        let version = unsafe { (*info.p_application_info).api_version };
        let asked = format!("{}.{}", vk::api_version_major(version), vk::api_version_minor(version));
        self.asked.lock().unwrap().push(asked);
        DesktopDevice.create_instance(entry, info)
    }

    fn physical_device(
        &self,
        instance: &ash::Instance,
        options: &GpuOptions,
    ) -> Result<vk::PhysicalDevice, GpuError> {
        DesktopDevice.physical_device(instance, options)
    }

    fn create_device(
        &self,
        instance: &ash::Instance,
        physical: vk::PhysicalDevice,
        info: &vk::DeviceCreateInfo<'_>,
    ) -> Result<vk::Device, GpuError> {
        let mut asked = self.asked.lock().unwrap();
        for index in 0..info.enabled_extension_count as usize {
            // SAFETY: the array has as many NUL-terminated names as the info says.
            let name = unsafe { CStr::from_ptr(*info.pp_enabled_extension_names.add(index)) };
            asked.push(name.to_string_lossy().into_owned());
        }
        // SAFETY: null or the features of version 1.0.
        if let Some(core) = unsafe { info.p_enabled_features.as_ref() } {
            // SAFETY: the struct is nothing but 55 booleans of 32 bits.
            let flags: [u32; 55] = unsafe { std::mem::transmute(*core) };
            asked.extend(
                flags
                    .iter()
                    .enumerate()
                    .filter(|(_, on)| **on != 0)
                    .map(|(i, _)| format!("core feature {i}")),
            );
        }
        let mut next = info.p_next.cast::<vk::BaseInStructure<'_>>();
        // SAFETY: a chain of Vulkan structs, each of which begins with its type and the next.
        while let Some(link) = unsafe { next.as_ref() } {
            if link.s_type == vk::StructureType::PHYSICAL_DEVICE_MULTIVIEW_FEATURES {
                // SAFETY: the type says what it is.
                let features = unsafe { *next.cast::<vk::PhysicalDeviceMultiviewFeatures<'_>>() };
                let flags = [
                    (features.multiview, "multiview"),
                    (features.multiview_geometry_shader, "multiviewGeometryShader"),
                    (features.multiview_tessellation_shader, "multiviewTessellationShader"),
                ];
                asked.extend(flags.iter().filter(|(on, _)| *on != 0).map(|(_, name)| (*name).to_owned()));
            } else if link.s_type == vk::StructureType::PHYSICAL_DEVICE_SAMPLER_YCBCR_CONVERSION_FEATURES {
                asked.push("samplerYcbcrConversion".to_owned());
            } else {
                asked.push(format!("{:?}", link.s_type));
            }
            next = link.p_next;
        }
        drop(asked);
        DesktopDevice.create_device(instance, physical, info)
    }
}

#[test]
fn a_device_is_asked_for_exactly_what_the_list_says() {
    let [major, minor] = REQUIRED.vulkan_version;
    let version = format!("{major}.{minor}");
    let named = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>();
    let all = [named(REQUIRED.vulkan_extensions), named(REQUIRED.vulkan_features)].concat();
    let wanted = [vec![version], all].concat();
    assert_eq!(asked_for(Needs::Client), wanted);
    // What reads a decoder's buffers is asked for on Android alone.
    let of_pictures = [wanted, named(REQUIRED.picture_features)].concat();
    assert_eq!(asked_for(Needs::ClientOfPictures), of_pictures);
    assert_eq!(PICTURE_EXTENSIONS.map(|name| name.to_str().expect("ASCII")), REQUIRED.picture_extensions);
    assert_eq!([DENSITY_MAP_EXTENSION.to_str().expect("ASCII")], REQUIRED.density_map_extensions);
}

fn asked_for(needs: Needs) -> Vec<String> {
    let source = Noting::default();
    let options = GpuOptions { needs, validation: true, device_name: None };
    let gpu = Gpu::open(&options, &source).expect("a Vulkan device");
    assert_eq!(gpu.validation_messages(), 0, "{:?}", gpu.validation_texts());
    let mut asked = source.asked.into_inner().unwrap();
    asked.sort();
    asked
}
