//! Every GPU stage of the server against its CPU twin, on a small scene. Validation is on.

use glam::{Mat4, Vec3, Vec4};
use shadecast_e2e::{SavedVertices, read};
use shadecast_gpu::{Access, Buffer, DesktopDevice, Gpu, GpuOptions, Memory, Needs, Part};
use shadecast_protocol::atlas::{Block, BlockAddress, BlockSize};
use shadecast_protocol::picture::I420;
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_protocol::time::WorldTime;
use shadecast_scene::animation::{playing, pose, sampling};
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_server::scene::numbering::ScenePatch;
use shadecast_server::scene::views::predicted_view_gpu;
use shadecast_server::scene::{SceneGpu, SceneOptions};
use shadecast_server::skinning::gpu::Animation;
use shadecast_server::time::RingPlace;
use shadecast_server::truth::forward::Forward;
use shadecast_server::visibility::clusters::Clusters;
use shadecast_server::visibility::culling::Sight;
use shadecast_server::visibility::lod_set::{LodChoice, LodSet};
use shadecast_server::visibility::passes::extents::Extents;
use shadecast_server::visibility::passes::id_buffer::{IdBuffer, Pass};
use shadecast_server::visibility::passes::mark::Mark;
use shadecast_server::visibility::passes::spread::Spread;
use shadecast_shaders::constants::{ID_BUFFER_VIEWS, SPREAD};
use shadecast_shaders::twin;
use std::sync::Arc;

fn gpu() -> Arc<Gpu> {
    let options = GpuOptions { needs: Needs::Server, validation: true, device_name: None };
    Gpu::open(&options, &DesktopDevice).expect("a Vulkan device; `./shadecast setup` installs a software one")
}

fn dragon(gpu: &Arc<Gpu>) -> Arc<SceneGpu> {
    let scene = load_scene(&SceneSource::Dragons(1)).expect("the built-in scene loads");
    Arc::new(SceneGpu::new(gpu, scene, &SceneOptions::default()).expect("the scene fits"))
}

#[track_caller]
fn assert_no_messages(gpu: &Gpu) {
    assert_eq!(gpu.validation_messages(), 0, "{:#?}", gpu.validation_texts());
}

#[test]
fn skinned_vertices_equal_the_cpu_twin_within_1e_5() {
    let gpu = gpu();
    let scene = dragon(&gpu);
    let mut animation = Animation::new(&gpu, &scene, 2).unwrap();
    for time_s in [0.0, 0.731, 3.999] {
        let time = WorldTime((time_s * 1e9) as i64);
        let mut recorder = gpu.record().unwrap();
        animation.record_sample(&mut recorder, RingPlace(1), time);
        gpu.wait(recorder.submit().unwrap()).unwrap();
        let saved = SavedVertices::read(&gpu, &animation);
        for (index, instance) in scene.scene.instances.iter().enumerate() {
            let model = &scene.scene.models[instance.model];
            let clip = sampling::sample(model, instance.clip, sampling::Sampling::default());
            let playing = scene.scene.schedules()[index].at(time);
            let locals = playing::sampled_pose(|_| &clip, &playing);
            let palette = pose::palette(model, &pose::global_pose(model, &locals));
            let twin = pose::skin(&model.vertices, &palette, instance.world_from_model(time.seconds()));
            let size = twin.iter().map(|v| v.position.length()).fold(1.0, f32::max);
            for (v, expected) in twin.iter().enumerate() {
                let position = saved.position(&animation, index, RingPlace(1), v);
                let error = position.distance(expected.position) / size;
                assert!(error < 1e-5, "{} vertex {v} at {time_s} s: {error}", instance.name);
            }
        }
    }
    assert_no_messages(&gpu);
}

#[test]
fn marks_and_extents_equal_their_cpu_twins() {
    let seen = marks_and_extents(IDS, 0);
    assert!(seen > 500, "{seen}");
}

#[test]
fn marks_of_a_part_of_the_id_buffer_equal_their_cpu_twin() {
    let seen = marks_and_extents(PART_OF_IDS, 0);
    assert!(seen > 150, "{seen}");
}

#[test]
fn rings_around_what_is_marked_equal_their_cpu_twin() {
    let [marked, near] = [0, 3].map(|rings| marks_and_extents(IDS, rings));
    assert!(near > marked * 5 / 4, "{marked} are marked, {near} are near them");
}

/// Extent of the ID buffer, and of a part of it.
const IDS: [u32; 2] = [128, 96];
const PART_OF_IDS: [u32; 2] = [64, 48];

/// Holds the stages against their twins, on this part of the ID buffer, with so many rings around what is marked. Gives how many
/// patches are seen.
fn marks_and_extents(part: [u32; 2], rings: u32) -> usize {
    let least = if part == IDS { 500 } else { 150 };
    let gpu = gpu();
    let scene = dragon(&gpu);
    let mut animation = Animation::new(&gpu, &scene, 3).unwrap();
    let (extent, part) = (IDS, Part { extent: part, first_alone: false });
    let eye = |x: f32| Pose { position: Vec3::new(x, 1.6, 0.3), ..Pose::IDENTITY };
    let (fov, shown) = (Fov::symmetric_degrees(80.0), Fov::symmetric_degrees(40.0));
    let world_eyes: Vec<Pose> =
        (0..6).map(|v| scene.scene.world_from_stage.then(eye(v as f32 * 0.05))).collect();
    let matrices: Vec<Mat4> = world_eyes.iter().map(|e| fov.clip_from_eye() * e.inverse().matrix()).collect();
    let predicted = |(m, e): (&Mat4, &Pose)| predicted_view_gpu(*m, e.position, fov, shown, [76.0, 57.0]);
    let view_gpus: Vec<_> = matrices.iter().zip(&world_eyes).map(predicted).collect();
    // The frusta of wide eyes lie behind the predicted views.
    let mut all_views = view_gpus.clone();
    all_views.resize(ID_BUFFER_VIEWS as usize, view_gpus[0]);
    let views = Buffer::upload(&gpu, "views", &all_views).unwrap();
    let id_buffer = IdBuffer::new(&gpu, &scene, &animation, &views, extent).unwrap();
    let instances = scene.numbering.instances.len();
    let lods = LodSet::new(&scene.numbering, vec![Some(LodChoice { shown: 0, next: None }); instances]);
    let mark = Mark::new(&gpu, id_buffer.image(), scene.numbering.totals.in_lod_set).unwrap();
    let spread = Spread::new(&gpu, &scene, &mark.visible).unwrap();
    let extents = Extents::new(&gpu, &scene, &animation, &views, &mark.visible).unwrap();
    let pixels = (extent[0] * extent[1]) as usize;
    let ids = Buffer::new(&gpu, "ids", pixels as u64 * 8, Memory::Readback).unwrap();
    let mut recorder = gpu.record().unwrap();
    for place in 0..3 {
        animation.record_sample(&mut recorder, RingPlace(place), WorldTime(i64::from(place) * 33_000_000));
    }
    recorder.fill(&mark.visible, 0);
    extents.record_start(&mut recorder);
    recorder.barrier(Access::COPY_WRITE, Access::COMPUTE);
    recorder.barrier(Access::COMPUTE_WRITE, Access::GRAPHICS_READ);
    let within = (&Clusters::default(), &Sight::default());
    let pass = Pass { lods: lods.all(), place: RingPlace(1), first_view: 2, part, within };
    id_buffer.record(&mut recorder, &scene, &animation, pass);
    recorder.barrier(Access::COLOR_WRITE, Access::COMPUTE_READ);
    mark.record(&mut recorder, part);
    recorder.barrier(Access::COMPUTE_WRITE, Access::COMPUTE);
    let spread_lods: Vec<_> = lods.all().iter().map(|lod| (*lod, rings)).collect();
    spread.record(&mut recorder, &scene, &spread_lods);
    extents.record(&mut recorder, &scene, &animation, &lods, [0, 1, 2].map(RingPlace));
    recorder.barrier(Access::COMPUTE_WRITE, Access::HOST_READ);
    let layouts = [
        shadecast_gpu::vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL,
        shadecast_gpu::vk::ImageLayout::TRANSFER_SRC_OPTIMAL,
    ];
    recorder.transition(id_buffer.image(), layouts, Access::COMPUTE_READ, Access::COPY_READ);
    (0..2).for_each(|layer| {
        recorder.read_image(id_buffer.image(), layer, &ids, u64::from(layer) * pixels as u64 * 4)
    });
    recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
    gpu.wait(recorder.submit().unwrap()).unwrap();

    // Of one LOD: entries are numbers of patches.
    let patches = lods.entries();
    let visible: Vec<u32> = read(&gpu, &mark.visible);
    let is_drawn = |at: &usize| {
        let at = *at as u32 % (extent[0] * extent[1]);
        at % extent[0] < part.extent[0] && at / extent[0] < part.extent[1]
    };
    let drawn: Vec<u32> = (0..2 * pixels).filter(is_drawn).map(|at| ids.values::<u32>()[at]).collect();
    let mut twin = twin::mark::mark(&drawn, patches);
    let vertices = |patch: u32| {
        let instance = scene.numbering.instance_of_patch(ScenePatch(patch));
        let first = scene.numbering.instances[instance].first_vertex.0;
        scene.patch(ScenePatch(patch)).vertices.map(|vertex| first + vertex)
    };
    let vertices: Vec<_> = (0..patches as u32).map(vertices).collect();
    (0..rings).for_each(|_| twin::spread::spread(&vertices, &mut twin));
    assert_eq!(visible[..patches], twin[..]);
    assert!(twin.iter().filter(|visible| **visible != 0).count() > least, "the dragon is in view");

    let saved = SavedVertices::read(&gpu, &animation);
    let mut seen = Vec::new();
    extents.read(&mut seen);
    let entries: Vec<u32> = seen.iter().map(|patch| patch.entry).collect();
    assert!(entries.is_sorted_by(|a, b| a < b), "each is listed once, ascending");
    let twin_views: Vec<_> = view_gpus
        .iter()
        .map(|view| twin::extents::View {
            clip_from_world: Mat4::from_cols_array_2d(&view.clip_from_world),
            tangents_from_clip: Vec4::from(view.tangents_from_clip),
            shown_tangents: Vec4::from(view.shown_tangents),
            pixels_per_tangent: Vec4::from(view.pixels_per_tangent).truncate().truncate(),
        })
        .collect();
    let (mut compared, mut listed) = (0, 0);
    for patch in (0..patches as u32).filter(|p| twin[*p as usize] != 0) {
        let number = ScenePatch(patch);
        let instance = scene.numbering.instance_of_patch(number);
        let shape = scene.patch(number);
        let world: Vec<[Vec4; 5]> = (0..6)
            .map(|view| {
                let at = |v: u32| saved.position(&animation, instance, RingPlace(view / 2), v as usize);
                shape.vertices.map(|v| at(v).extend(1.0))
            })
            .collect();
        let expected = twin::extents::extent_texels(shape.kind as u32, &twin_views, &world);
        let at = entries.binary_search(&patch);
        let is_listed = twin[patch as usize] != SPREAD || twin::extents::is_within(&twin_views, &world);
        assert_eq!(at.is_ok(), is_listed, "patch {patch}");
        listed += usize::from(is_listed);
        let Ok(at) = at else { continue };
        let got = [seen[at].extent_texels & 0xffff, seen[at].extent_texels >> 16];
        for axis in 0..2 {
            // Textures may cap it; rounding may differ by one.
            assert!(got[axis] <= expected[axis] + 1, "patch {patch}: {got:?}, twin {expected:?}");
            assert!(got[axis] + 1 >= expected[axis].min(8), "patch {patch}: {got:?}, twin {expected:?}");
            compared += usize::from(got[axis].abs_diff(expected[axis]) <= 1);
        }
    }
    assert!(compared > least, "most extents are not capped: {compared}");
    assert_eq!(listed, entries.len(), "nothing else is listed");
    assert_no_messages(&gpu);
    entries.len()
}

#[test]
fn the_forward_renderer_draws_the_dragon_twice_alike() {
    let gpu = gpu();
    let scene = dragon(&gpu);
    let mut forward = Forward::new(&gpu, &scene, [128, 128]).unwrap();
    let eye =
        scene.scene.world_from_stage.then(Pose { position: Vec3::new(0.0, 1.6, 0.0), ..Pose::IDENTITY });
    let fov = Fov::symmetric_degrees(90.0);
    let first = forward.render(eye, fov, WorldTime(500_000_000)).unwrap();
    let moved = forward.render(eye, fov, WorldTime(750_000_000)).unwrap();
    let again = forward.render(eye, fov, WorldTime(500_000_000)).unwrap();
    assert_eq!(first, again);
    assert_ne!(first.rgb8, moved.rgb8, "the wings move");
    let covered = first.instance.iter().filter(|i| **i != u32::MAX).count();
    assert!(covered * 10 > first.instance.len() * 4, "{covered} pixels of geometry");
    let nearest = first.distance_m.iter().copied().fold(f32::INFINITY, f32::min);
    assert!(nearest > 0.3 && nearest < 5.0, "{nearest} m");
    assert_no_messages(&gpu);
}

#[test]
fn atlas_planes_equal_the_cpu_twin_within_one_code_value() {
    use shadecast_gpu::vk::{Format, ImageLayout, ImageUsageFlags};
    use shadecast_gpu::{Image, ImageDesc};
    use shadecast_server::shading::passes::ycbcr::Ycbcr;
    let gpu = gpu();
    let extent = [128u32, 128];
    let mut state = 5u32;
    let rgba8: Vec<u8> = (0..extent[0] * extent[1] * 4)
        .map(|_| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        })
        .collect();
    let desc = ImageDesc::new(
        "atlas",
        extent,
        Format::R8G8B8A8_UNORM,
        ImageUsageFlags::SAMPLED | ImageUsageFlags::TRANSFER_DST,
    );
    let atlas = Image::new(&gpu, desc).unwrap();
    let staging = Buffer::upload(&gpu, "texels", &rgba8).unwrap();
    let mut ycbcr = Ycbcr::new(&gpu, &atlas, true).unwrap();
    // Blocks of every shape lie beside each other.
    let cell_extents = [4 | 4 << 16, 8 | 4 << 16, 16 | 64 << 16, 64 | 8 << 16];
    ycbcr.write_cells(&cell_extents);
    let mut recorder = gpu.record().unwrap();
    let [blank, written, read] =
        [ImageLayout::UNDEFINED, ImageLayout::TRANSFER_DST_OPTIMAL, ImageLayout::SHADER_READ_ONLY_OPTIMAL];
    recorder.transition(&atlas, [blank, written], Access::NONE, Access::COPY_WRITE);
    recorder.write_image(&atlas, 0, &staging, 0);
    recorder.transition(&atlas, [written, read], Access::COPY_WRITE, Access::COMPUTE_READ);
    ycbcr.record(&mut recorder);
    gpu.wait(recorder.submit().unwrap()).unwrap();
    let twin = twin::ycbcr::picture(&rgba8, extent, &cell_extents);
    let mut picture = I420::default();
    ycbcr.read(&mut picture);
    assert_eq!(picture.extent_texels(), twin.extent_texels());
    let worst = picture.bytes().iter().zip(twin.bytes()).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(worst <= Some(1), "{worst:?}");
    let (address, size) =
        (BlockAddress { page: 0, x: 20, y: 12 }, BlockSize { width_log2: 4, height_log2: 5 });
    let coverage = ycbcr.coverage(Block { address, size });
    for texel in 0..size.texels() {
        let (x, y) = (20 + texel % 16, 12 + texel / 16);
        let alpha = rgba8[((y * extent[0] + x) * 4 + 3) as usize];
        assert_eq!(coverage.is_covered(texel), alpha >= 128, "{x} {y}");
    }
    assert_no_messages(&gpu);
}
