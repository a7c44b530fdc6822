//! The ID buffer is the same for both ways of numbering triangles, and without hidden geometry. Validation is on.

use glam::{Quat, Vec3};
use shadecast_gpu::{Access, Buffer, DesktopDevice, Gpu, GpuOptions, Memory, Needs, vk};
use shadecast_lab::scenes::leaves::write_leaves;
use shadecast_lab::scenes::room::write_room;
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_protocol::time::WorldTime;
use shadecast_scene::load::{SceneSource, load_scene_with};
use shadecast_scene::process::Loading;
use shadecast_server::scene::views::view_gpu;
use shadecast_server::scene::{SceneGpu, SceneOptions};
use shadecast_server::skinning::gpu::Animation;
use shadecast_server::time::RingPlace;
use shadecast_server::visibility::clusters::Clusters;
use shadecast_server::visibility::culling::Sight;
use shadecast_server::visibility::lod_set::{LodChoice, LodSet};
use shadecast_server::visibility::passes::id_buffer::{IdBuffer, Pass, TriangleNumbers};
use shadecast_server::visibility::predict::View;
use shadecast_server::world::samples::SampleWindow;
use shadecast_shaders::constants::{FIRST_ID, ID_BUFFER_VIEWS};
use std::sync::Arc;

const EXTENT: [u32; 2] = [160, 120];
const PIXELS: usize = (EXTENT[0] * EXTENT[1]) as usize;

/// What is looked at, and how.
struct Drawing<'a> {
    scene: &'a Arc<SceneGpu>,
    lod: usize,
    /// Of the head, about the upright axis, radians.
    turn: f32,
    numbers: TriangleNumbers,
    /// Whether what stands still and is not in sight is left out.
    in_sight: bool,
    /// The left eye is drawn once more, alone.
    first_alone: bool,
}

/// Both layers of the ID buffer of a scene in motion.
fn ids(
    gpu: &Arc<Gpu>,
    Drawing { scene, lod, turn, numbers, in_sight, first_alone }: Drawing<'_>,
) -> Vec<u32> {
    let mut animation = Animation::new(gpu, scene, 1).unwrap();
    let views: [View; ID_BUFFER_VIEWS as usize] = std::array::from_fn(|number| {
        let position = Vec3::new(0.1 * number as f32 - 0.4, 1.6, 0.3);
        let eye = Pose { position, orientation: Quat::from_rotation_y(turn) };
        View { world_from_eye: scene.scene.world_from_stage.then(eye), fov: Fov::symmetric_degrees(80.0) }
    });
    let on_device = views.map(|View { world_from_eye, fov }| {
        view_gpu(fov.clip_from_eye() * world_from_eye.inverse().matrix(), world_from_eye.position)
    });
    let clusters =
        if in_sight { SampleWindow::new(scene, &animation).clusters() } else { Clusters::default() };
    let sight = Sight::of(views[4..6].iter());
    let views = Buffer::upload(gpu, "views", &on_device).unwrap();
    let id_buffer = IdBuffer::with_numbers(gpu, scene, &animation, &views, EXTENT, numbers).unwrap();
    let lods = (0..scene.numbering.instances.len()).map(|instance| {
        let coarsest = scene.mesh(instance).lods.len() - 1;
        Some(LodChoice { shown: lod.min(coarsest), next: None })
    });
    let lods = LodSet::new(&scene.numbering, lods);
    let target = Buffer::new(gpu, "ids", 2 * PIXELS as u64 * 4, Memory::Readback).unwrap();
    let mut recorder = gpu.record().unwrap();
    animation.record_sample(&mut recorder, RingPlace(0), WorldTime(731_000_000));
    recorder.barrier(Access::COMPUTE_WRITE, Access::GRAPHICS_READ);
    let within = (&clusters, &sight);
    let mut pass =
        Pass { lods: lods.all(), place: RingPlace(0), first_view: 4, part: id_buffer.whole(), within };
    id_buffer.record(&mut recorder, scene, &animation, pass);
    if first_alone {
        // From other eyes in between, so that what was there is not what is compared.
        pass.first_view = 0;
        recorder.barrier(Access::COLOR_WRITE, Access::COLOR_WRITE);
        id_buffer.record(&mut recorder, scene, &animation, pass);
        (pass.first_view, pass.part.first_alone) = (4, true);
        recorder.barrier(Access::COLOR_WRITE, Access::COLOR_WRITE);
        id_buffer.record(&mut recorder, scene, &animation, pass);
    }
    let layouts = [vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL, vk::ImageLayout::TRANSFER_SRC_OPTIMAL];
    recorder.transition(id_buffer.image(), layouts, Access::COLOR_WRITE, Access::COPY_READ);
    for layer in 0..2 {
        recorder.read_image(id_buffer.image(), layer, &target, u64::from(layer) * PIXELS as u64 * 4);
    }
    recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
    gpu.wait(recorder.submit().unwrap()).unwrap();
    target.values::<u32>()[..2 * PIXELS].to_vec()
}

fn gpu() -> Arc<Gpu> {
    let options = GpuOptions { needs: Needs::Server, validation: true, device_name: None };
    Gpu::open(&options, &DesktopDevice).expect("a Vulkan device; `./shadecast setup` installs one")
}

fn load(gpu: &Arc<Gpu>, source: &SceneSource) -> Arc<SceneGpu> {
    let scene = load_scene_with(source, &Loading { lods: true, ..Loading::plain() }).expect("it loads");
    Arc::new(SceneGpu::new(gpu, scene, &SceneOptions::default()).expect("it fits"))
}

/// Number of patches in an ID buffer.
fn patches_in(ids: &[u32]) -> usize {
    let mut seen: Vec<u32> = ids.iter().copied().filter(|id| *id >= FIRST_ID).collect();
    seen.sort_unstable();
    seen.dedup();
    seen.len()
}

#[test]
fn both_ways_of_numbering_triangles_give_the_same_patches() {
    let gpu = gpu();
    let folder = tempfile::tempdir().unwrap();
    let leaves = write_leaves(folder.path(), true).unwrap();
    for (source, lod, patches) in [
        (SceneSource::Dragons(2), 0, 1000),
        (SceneSource::Dragons(2), 2, 100),
        (SceneSource::File(leaves), 0, 2),
    ] {
        let scene = load(&gpu, &source);
        let of = |numbers| {
            ids(&gpu, Drawing { scene: &scene, lod, turn: 0.0, numbers, in_sight: false, first_alone: false })
        };
        let pulled = of(TriangleNumbers::Pulled);
        assert!(patches_in(&pulled) >= patches, "{source:?}: {} patches in view", patches_in(&pulled));
        if gpu.numbers_triangles() {
            assert!(of(TriangleNumbers::Given) == pulled, "{source:?}, LOD {lod}");
        }
    }
    assert_eq!(gpu.validation_messages(), 0, "{:#?}", gpu.validation_texts());
}

#[test]
fn one_eye_alone_is_drawn_as_beside_the_other() {
    let gpu = gpu();
    let scene = load(&gpu, &SceneSource::Dragons(2));
    for numbers in [TriangleNumbers::Pulled, TriangleNumbers::of(&gpu)] {
        let of = |first_alone| {
            ids(&gpu, Drawing { scene: &scene, lod: 0, turn: 0.0, numbers, in_sight: false, first_alone })
        };
        let [both, alone] = [false, true].map(of);
        assert!(both[..PIXELS] == alone[..PIXELS], "{numbers:?}: the left eye");
        assert!(both[PIXELS..] != alone[PIXELS..], "{numbers:?}: the right eye was not drawn again");
    }
    assert_eq!(gpu.validation_messages(), 0, "{:#?}", gpu.validation_texts());
}

#[test]
fn what_is_not_in_sight_is_not_missed() {
    let gpu = gpu();
    let folder = tempfile::tempdir().unwrap();
    for source in [SceneSource::File(write_room(folder.path(), [2, 1]).unwrap()), SceneSource::Dragons(1)] {
        let scene = load(&gpu, &source);
        for turn in [0.0, 0.9, 2.5, 4.4] {
            let numbers = TriangleNumbers::of(&gpu);
            let of = |in_sight| {
                ids(&gpu, Drawing { scene: &scene, lod: 0, turn, numbers, in_sight, first_alone: false })
            };
            let all = of(false);
            assert!(patches_in(&all) > 1, "{source:?}: there is something to see");
            assert!(of(true) == all, "{source:?}, turned by {turn}");
        }
    }
    assert_eq!(gpu.validation_messages(), 0, "{:#?}", gpu.validation_texts());
}
