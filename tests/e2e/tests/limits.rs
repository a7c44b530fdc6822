//! The table of limits against the shaders: each need is the largest of all pipelines.

use shadecast_gpu::limits::{DeviceLimits, verdicts};
use shadecast_gpu::{Needs, survey};
use shadecast_protocol::limits::{ATLAS_MAX_EXTENT, MAX_KEPT_SAMPLES, MAX_VERTEX_SLOTS};
use shadecast_shaders::constants::{CHUNK_VERTICES, ID_BUFFER_VIEWS, YCBCR_TEXELS};
use shadecast_shaders::generated::{
    self as shaders, BackdropGpu, EyesGpu, HandsGpu, LightGpu, NoticeGpu, ViewGpu,
};
use shadecast_shaders::{BindingKind, Shader, Stage};
use std::collections::BTreeMap;

/// Every pipeline of the server that ships; one walks bone chains for a measurement, and is checked where it is made.
const SERVER: &[&[&Shader]] = &[
    &[&shaders::FORWARD_VERT, &shaders::FORWARD_FRAG],
    &[&shaders::FORWARD_PROBE_VERT, &shaders::FORWARD_PROBE_FRAG],
    &[&shaders::FORWARD_BACKGROUND_VERT, &shaders::FORWARD_BACKGROUND_FRAG],
    &[&shaders::ID_BUFFER_VERT, &shaders::ID_BUFFER_FRAG],
    &[&shaders::ID_BUFFER_PULLED_VERT, &shaders::ID_BUFFER_PULLED_FRAG],
    &[&shaders::SHADING_VERT, &shaders::SHADING_FRAG],
    &[&shaders::SHADING_VERT, &shaders::SHADING_TEXEL_FRAG],
    &[&shaders::SHADOW_VERT, &shaders::SHADOW_FRAG],
    &[&shaders::PRESENT_VERT, &shaders::PRESENT_FRAG],
    &[&shaders::EXTENTS_COMP],
    &[&shaders::MARK_COMP],
    &[&shaders::PALETTE_COMP],
    &[&shaders::SKIN_COMP],
    &[&shaders::SKIN_PACKED_COMP],
    &[&shaders::YCBCR_COMP],
];
/// Every pipeline of the client.
const CLIENT: &[&[&Shader]] = &[
    &[&shaders::CLIENT_ATLAS_VERT, &shaders::CLIENT_ATLAS_FRAG],
    &[&shaders::CLIENT_ATLAS_VERT, &shaders::CLIENT_ATLAS_BICUBIC_FRAG],
    &[&shaders::CLIENT_ATLAS_VERT, &shaders::CLIENT_ATLAS_PICTURE_FRAG],
    &[&shaders::CLIENT_ATLAS_VERT, &shaders::CLIENT_ATLAS_COSITED_FRAG],
    &[&shaders::CLIENT_ATLAS_MASKED_VERT, &shaders::CLIENT_ATLAS_MASKED_FRAG],
    &[&shaders::CLIENT_ATLAS_MASKED_VERT, &shaders::CLIENT_ATLAS_MASKED_BICUBIC_FRAG],
    &[&shaders::CLIENT_ATLAS_MASKED_VERT, &shaders::CLIENT_ATLAS_MASKED_PICTURE_FRAG],
    &[&shaders::CLIENT_ATLAS_MASKED_VERT, &shaders::CLIENT_ATLAS_MASKED_COSITED_FRAG],
    &[&shaders::CLIENT_BACKGROUND_VERT, &shaders::CLIENT_BACKGROUND_FRAG],
    &[&shaders::CLIENT_HANDS_VERT, &shaders::CLIENT_HANDS_FRAG],
    &[&shaders::CLIENT_NOTICE_VERT, &shaders::CLIENT_NOTICE_FRAG],
    &[&shaders::CLIENT_PROBE_VERT, &shaders::CLIENT_PROBE_FRAG],
    &[&shaders::PRESENT_VERT, &shaders::PRESENT_EYES_FRAG],
    &[&shaders::CLIENT_INTERPOLATE_COMP],
    &[&shaders::CLIENT_POSE_COMP],
    &[&shaders::CLIENT_SCATTER_COMP],
    &[&shaders::CLIENT_SKIN_COMP],
    &[&shaders::CLIENT_SETTLE_COMP],
    &[&shaders::CLIENT_SETTLE_PICTURE_COMP],
    &[&shaders::CLIENT_SETTLE_COSITED_COMP],
    &[&shaders::CLIENT_SETTLE_MIP_COMP],
];
/// Planes of a picture of a platform's format, each of which may take a descriptor.
const PICTURE_PLANES: u32 = 4;

/// 0 where the table has no such row for a program.
fn need(needs: Needs, name: &str) -> u32 {
    let rows = verdicts(&DeviceLimits::default(), needs);
    rows.iter().find(|row| row.name == name).map_or(0, |row| row.needed)
}

/// Bindings of a shader by number, with kind and places: an open array has one at least, a decoder's picture one for each plane.
fn bindings(shader: &Shader) -> BTreeMap<u32, (BindingKind, u32)> {
    let is_picture = |name: &str| name.starts_with("picture") && shader.name.starts_with("client_");
    let places = |name, count: u32| if is_picture(name) { PICTURE_PLANES } else { count.max(1) };
    shader.bindings.iter().map(|b| (b.index, (b.kind, places(b.name, b.count)))).collect()
}

/// The same of all shaders of a pipeline.
fn set(pipeline: &[&Shader]) -> BTreeMap<u32, (BindingKind, u32)> {
    pipeline.iter().flat_map(|shader| bindings(shader)).collect()
}

fn of_kind(kind: BindingKind, all: impl IntoIterator<Item = (BindingKind, u32)>) -> u32 {
    all.into_iter().filter(|(of, _)| *of == kind).map(|(_, places)| places).sum()
}

/// The most of anything over all pipelines.
fn most(pipelines: &[&[&Shader]], of: impl Fn(&[&Shader]) -> u32) -> u32 {
    pipelines.iter().copied().map(of).max().unwrap_or(0)
}

fn most_of_a_shader(pipelines: &[&[&Shader]], of: impl Fn(&Shader) -> u32) -> u32 {
    most(pipelines, |pipeline| pipeline.iter().map(|shader| of(shader)).max().unwrap_or(0))
}

const SIDES: [(Needs, &[&[&Shader]]); 2] = [(Needs::Server, SERVER), (Needs::Client, CLIENT)];

#[test]
fn needs_of_descriptors_are_those_of_the_shaders() {
    let kinds = [
        (BindingKind::UniformBuffer, &["UniformBuffers"][..]),
        (BindingKind::StorageBuffer, &["StorageBuffers"]),
        (BindingKind::SampledImage, &["Samplers", "SampledImages"]),
        (BindingKind::StorageImage, &["StorageImages"]),
    ];
    for (needs, pipelines) in SIDES {
        for (kind, names) in kinds {
            let kind_of = |shader: &Shader| of_kind(kind, bindings(shader).into_values());
            let of_stage = most_of_a_shader(pipelines, kind_of);
            let of_set = most(pipelines, |pipeline| of_kind(kind, set(pipeline).into_values()));
            for name in names {
                assert_eq!(need(needs, &format!("maxPerStageDescriptor{name}")), of_stage, "{needs:?}");
                assert_eq!(need(needs, &format!("maxDescriptorSet{name}")), of_set, "{needs:?}");
            }
        }
        // A fragment shader of a probe writes two attachments, any other one.
        let attachments = |shader: &Shader| match (shader.stage, shader.name.contains("probe")) {
            (Stage::Fragment, true) => 2,
            (Stage::Fragment, false) => 1,
            _ => 0,
        };
        let resources = |shader: &Shader| {
            bindings(shader).values().map(|(_, places)| places).sum::<u32>() + attachments(shader)
        };
        assert_eq!(need(needs, "maxPerStageResources"), most_of_a_shader(pipelines, resources), "{needs:?}");
    }
}

#[test]
fn the_limits_table_has_the_needs_of_the_shaders() {
    for (needs, pipelines) in SIDES {
        let of = |of: fn(&Shader) -> u32| most_of_a_shader(pipelines, of);
        assert_eq!(need(needs, "maxPushConstantsSize"), of(|shader| shader.push_bytes));
        let side = |shader: &Shader, axis: usize| shader.workgroup.map_or(0, |size| size[axis]);
        assert_eq!(need(needs, "maxComputeWorkGroupSize[0]"), most_of_a_shader(pipelines, |s| side(s, 0)));
        assert_eq!(need(needs, "maxComputeWorkGroupSize[1]"), most_of_a_shader(pipelines, |s| side(s, 1)));
        assert_eq!(most_of_a_shader(pipelines, |s| side(s, 2)), 1, "the table has no row for it");
        let all = of(|shader| shader.workgroup.map_or(0, |size| size.iter().product()));
        assert_eq!(need(needs, "maxComputeWorkGroupInvocations"), all);
        let varyings =
            of(|shader| if shader.stage == Stage::Vertex { 4 * locations(shader.words) } else { 0 });
        assert_eq!(need(needs, "maxVertexOutputComponents"), varyings, "{needs:?}");
        assert_eq!(need(needs, "maxFragmentInputComponents"), varyings, "{needs:?}");
    }
}

/// Locations that a vertex shader writes: none of ours reads any. Source: SPIR-V 1.3, sections 3.20 and 3.32.3.
fn locations(words: &[u32]) -> u32 {
    const OP_DECORATE: u32 = 71;
    const LOCATION: u32 = 30;
    let (mut at, mut found) = (5, 0);
    while at < words.len() {
        let (length, opcode) = ((words[at] >> 16) as usize, words[at] & 0xffff);
        if opcode == OP_DECORATE && words[at + 2] == LOCATION {
            found = found.max(words[at + 3] + 1);
        }
        at += length.max(1);
    }
    found
}

#[test]
fn needs_of_buffers_and_dispatches_are_those_of_the_largest() {
    let views = size_of::<ViewGpu>() as u32 * ID_BUFFER_VIEWS;
    let uniforms =
        [size_of::<BackdropGpu>(), size_of::<EyesGpu>(), size_of::<HandsGpu>(), size_of::<NoticeGpu>()];
    assert_eq!(need(Needs::Server, "maxUniformBufferRange"), views.max(size_of::<LightGpu>() as u32));
    assert_eq!(
        need(Needs::Client, "maxUniformBufferRange") as usize,
        uniforms.into_iter().max().unwrap_or(0)
    );
    // A saved vertex has 8 bytes, a sample 16.
    assert_eq!(need(Needs::Server, "maxStorageBufferRange"), CHUNK_VERTICES * 8);
    assert_eq!(need(Needs::Client, "maxStorageBufferRange"), MAX_KEPT_SAMPLES * 16);
    assert_eq!(need(Needs::Server, "maxDrawIndexedIndexValue"), CHUNK_VERTICES - 1);
    let [width, height] = ATLAS_MAX_EXTENT;
    assert_eq!(need(Needs::Server, "maxImageDimension2D"), width.max(height));
    let [x, y, _] = shaders::YCBCR_COMP.workgroup.expect("compute");
    let texels = [x * YCBCR_TEXELS[0], y * YCBCR_TEXELS[1]];
    let parts = width.div_ceil(texels[0]) * height.div_ceil(texels[1]);
    let marks = width.div_ceil(shaders::MARK_COMP.workgroup.expect("compute")[0]);
    assert_eq!(need(Needs::Server, "maxComputeWorkGroupCount[0]"), parts.max(marks));
    let slots = MAX_VERTEX_SLOTS.div_ceil(shaders::CLIENT_INTERPOLATE_COMP.workgroup.expect("compute")[0]);
    assert_eq!(need(Needs::Client, "maxComputeWorkGroupCount[0]"), slots);
}

#[test]
fn the_devices_here_are_asked_for_every_row() {
    for needs in [Needs::Server, Needs::Client, Needs::ClientOfPictures] {
        let found = survey(needs).expect("a Vulkan device; `./shadecast setup` installs a software one");
        assert!(found.iter().any(|device| device.lacks.is_none()), "{found:?}");
        for device in found.iter().filter(|device| device.lacks.is_none()) {
            assert!(verdicts(&device.limits, needs).iter().all(|row| row.is_met()), "{}", device.name);
        }
    }
}
