//! The animation stages on the GPU against their CPU twin, and what they are spared: on small scenes of everything
//! that moves vertices, with validation layers on.

use glam::{Affine3A, Quat, Vec3};
use rand::{Rng, SeedableRng, rngs::SmallRng};
use shadecast_gpu::{Access, Buffer, DesktopDevice, Gpu, GpuOptions, Memory, Needs};
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_protocol::time::{DEFAULT_GRID, GridIndex, ServerTime};
use shadecast_scene::animation::{pose, sampling};
use shadecast_scene::influences::reduce_to_four;
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_scene::{
    Bone, Clip, Instance, Interpolation, Material, Model, Morph, MorphDelta, MorphTrack, PaletteEntry, Path,
    Primitive, Repetition, Scene, Track, TrackValues, Trs, Vertex,
};
use shadecast_server::animation::RingPlace;
use shadecast_server::animation::gpu::{Animation, AnimationCounts};
use shadecast_server::animation::skinning::Skinning;
use shadecast_server::culling::Needed;
use shadecast_server::predict::{PredictedViews, View};
use shadecast_server::samples::SampleWindow;
use shadecast_server::scene::{SceneGpu, SceneOptions};
use std::sync::Arc;

const SEED: u64 = 41;

fn gpu() -> Arc<Gpu> {
    let options = GpuOptions { needs: Needs::Server, validation: true, device_name: None };
    Gpu::open(&options, &DesktopDevice).expect("a Vulkan device; `./shadecast setup` installs a software one")
}

#[track_caller]
fn assert_no_messages(gpu: &Gpu) {
    assert_eq!(gpu.validation_messages(), 0, "{:#?}", gpu.validation_texts());
}

fn random_vector(rng: &mut SmallRng, reach: f32) -> Vec3 {
    Vec3::from_array([0; 3].map(|_| rng.random_range(-reach..reach)))
}

fn random_rotation(rng: &mut SmallRng, angle: f32) -> Quat {
    Quat::from_axis_angle((random_vector(rng, 1.0) + 1e-3).normalize(), rng.random_range(-angle..angle))
}

fn random_trs(rng: &mut SmallRng) -> Trs {
    Trs {
        translation: random_vector(rng, 0.2),
        rotation: random_rotation(rng, 1.0),
        // Small: scales multiply along a chain, and with them what single precision rounds off.
        scale: Vec3::ONE + random_vector(rng, 0.05),
    }
}

/// Keys for every third bone's rotation, every fourth one's translation, every fifth one's scale.
fn random_tracks(rng: &mut SmallRng, bones: u32) -> Vec<Track> {
    let mut tracks = Vec::new();
    for bone in 0..bones {
        let mut add = |rng: &mut SmallRng, every: u32, values: &dyn Fn(&mut SmallRng) -> TrackValues| {
            if bone % every == 0 {
                let interpolation = [Interpolation::Linear, Interpolation::Step][usize::from(bone % 7 == 0)];
                let times_s = vec![0.0, 0.3, 0.7, 1.0];
                tracks.push(Track { bone, times_s, interpolation, values: values(rng) });
            }
        };
        add(rng, 3, &|rng| TrackValues::Rotation((0..4).map(|_| random_rotation(rng, 0.8)).collect()));
        add(rng, 4, &|rng| TrackValues::Translation((0..4).map(|_| random_vector(rng, 0.2)).collect()));
        add(rng, 5, &|rng| TrackValues::Scale((0..4).map(|_| Vec3::ONE + random_vector(rng, 0.1)).collect()));
    }
    tracks
}

fn random_vertex(rng: &mut SmallRng, bones: u16) -> Vertex {
    let count = rng.random_range(1..=4);
    let influences: Vec<_> =
        (0..count).map(|_| (rng.random_range(0..bones), rng.random_range(0.05f32..1.0))).collect();
    let (joints, weights) = reduce_to_four(influences).expect("positive weights");
    let normal = (random_vector(rng, 1.0) + 1e-3).normalize();
    let tangent = normal.any_orthonormal_vector().extend(1.0).to_array();
    Vertex { position: random_vector(rng, 1.0), normal, tangent, joints, weights, ..Vertex::default() }
}

fn random_morph(rng: &mut SmallRng, vertices: u32, index: u32) -> Morph {
    let delta = |vertex: u32, rng: &mut SmallRng| MorphDelta {
        vertex,
        position: random_vector(rng, 0.3),
        normal: random_vector(rng, 0.3),
        tangent: random_vector(rng, 0.3),
    };
    Morph {
        name: format!("m{index}"),
        rest_weight: 0.1 * index as f32,
        deltas: (0..vertices).filter(|v| v % (index + 2) == 0).map(|v| delta(v, rng)).collect(),
    }
}

/// Bones, influences, morph targets, every kind of curve; 200 vertices, a number that fills no workgroup.
fn random_model(rng: &mut SmallRng, morphs: u32) -> Model {
    const BONES: u32 = 30;
    const VERTICES: u32 = 200;
    let mut model = Model { name: "random".into(), ..Model::default() };
    for bone in 0..BONES {
        let parent = (bone > 0 && rng.random_bool(0.9)).then(|| rng.random_range(0..bone));
        model.bones.push(Bone { name: format!("b{bone}"), parent, rest: random_trs(rng) });
        let bone_from_mesh = random_trs(rng).affine();
        model.palette.push(PaletteEntry { bone, bone_from_mesh });
    }
    model.vertices = (0..VERTICES).map(|_| random_vertex(rng, BONES as u16)).collect();
    model.indices = (0..VERTICES - 2).flat_map(|v| [v, v + 1, v + 2]).collect();
    let index_count = model.indices.len() as u32;
    model.primitives = vec![Primitive { first_index: 0, index_count, material: 0 }];
    model.materials = vec![Material::default()];
    model.morphs = (0..morphs).map(|index| random_morph(rng, VERTICES, index)).collect();
    let morph_tracks = (morphs > 0).then(|| MorphTrack {
        first_morph: 0,
        morph_count: morphs,
        times_s: vec![0.0, 0.5, 1.0],
        interpolation: Interpolation::Linear,
        weights: (0..3 * morphs).map(|_| rng.random_range(-1.0..1.0)).collect(),
    });
    model.clips = vec![Clip {
        name: "c".into(),
        duration_s: 1.0,
        tracks: random_tracks(rng, BONES),
        morph_tracks: morph_tracks.into_iter().collect(),
    }];
    model
}

fn random_path(rng: &mut SmallRng) -> Path {
    let track =
        |values| Track { bone: 0, times_s: vec![0.0, 1.0], interpolation: Interpolation::Linear, values };
    let places = vec![random_vector(rng, 2.0), random_vector(rng, 2.0)];
    let turns = vec![random_rotation(rng, 1.0), random_rotation(rng, 1.0)];
    let tracks = vec![track(TrackValues::Translation(places)), track(TrackValues::Rotation(turns))];
    let clip = Clip { name: "p".into(), duration_s: 1.0, tracks, ..Clip::default() };
    Path { clip, repetition: Repetition::PingPong, time_shift_s: 0.3, speed: 0.7 }
}

/// A scene around models and instances, without ground.
fn scene_of(models: Vec<Model>, instances: Vec<Instance>) -> Scene {
    let template = load_scene(&SceneSource::Dragons(1)).expect("the built-in scene loads");
    Scene { models, instances, ..template }
}

/// Animated, on a path, both, mirrored in time, with morphs and without, and still.
fn mixed_scene(rng: &mut SmallRng) -> Scene {
    let models = vec![random_model(rng, 3), random_model(rng, 0)];
    let animated = |name: &str, model: usize| Instance { clip: Some(0), ..Instance::new(name, model) };
    let placement = Affine3A::from_scale_rotation_translation(
        Vec3::splat(1.5),
        Quat::from_rotation_y(0.4),
        Vec3::new(1.0, 0.5, -2.0),
    );
    let instances = vec![
        Instance { placement, ..animated("morphing", 0) },
        Instance { path: Some(random_path(rng)), ..animated("walking", 1) },
        Instance { path: Some(random_path(rng)), ..Instance::new("carried", 0) },
        Instance { speed: -0.8, repetition: Repetition::PingPong, ..animated("backwards", 1) },
        Instance { placement, ..Instance::new("still", 1) },
    ];
    scene_of(models, instances)
}

fn read<T: bytemuck::Pod>(gpu: &Arc<Gpu>, buffer: &Buffer) -> Vec<T> {
    let target = Buffer::new(gpu, "read-back", buffer.size(), Memory::Readback).unwrap();
    let mut recorder = gpu.record().unwrap();
    recorder.copy_buffer(buffer, 0, &target, 0, buffer.size());
    recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
    gpu.wait(recorder.submit().unwrap()).unwrap();
    target.values::<T>().to_vec()
}

/// What the twin makes of an instance: clip and path as sampled.
fn twin(scene: &Scene, index: usize, sampling: sampling::Sampling, time_s: f64) -> Vec<pose::SkinnedVertex> {
    let instance = &scene.instances[index];
    let model = &scene.models[instance.model];
    let paths = sampling::SampledPaths::new(scene, sampling);
    let sampling = sampling.in_model(sampling::world_scale(scene, instance.model));
    let clip = sampling::sample(model, instance.clip, sampling);
    let phase_s = instance.clip_phase_s(clip.duration_s, time_s);
    let palette = pose::palette(model, &pose::global_pose(model, &clip.local_pose(phase_s)));
    let vertices = pose::morphed(model, &clip.morph_weights(phase_s));
    pose::skin(&vertices, &palette, paths.world_from_model(scene, index, time_s))
}

fn compare_with_twin(gpu: &Arc<Gpu>, scene: &Scene, options: SceneOptions, times_s: &[f64]) {
    let gpu_scene = Arc::new(SceneGpu::new(gpu, scene.clone(), &options).expect("the scene fits"));
    let mut animation = Animation::new(gpu, &gpu_scene, 2).unwrap();
    for time_s in times_s {
        let time = ServerTime((time_s * 1e9) as i64);
        let mut recorder = gpu.record().unwrap();
        animation.record_sample(&mut recorder, RingPlace(1), time);
        recorder.barrier(Access::COMPUTE_WRITE, Access::COMPUTE);
        animation.record_tangents(&mut recorder, RingPlace(1), |_| true);
        recorder.barrier(Access::COMPUTE_WRITE, Access::COPY_READ);
        gpu.wait(recorder.submit().unwrap()).unwrap();
        let positions: Vec<[f32; 4]> = read(gpu, animation.saved_vertices());
        let frames: Vec<[[f32; 4]; 2]> = read(gpu, animation.tangents());
        for (index, place) in gpu_scene.numbering.instances.iter().enumerate() {
            let name = format!("{options:?}, {} at {time_s} s, seed {SEED}", scene.instances[index].name);
            let twin = twin(scene, index, options.sampling, time.seconds());
            let size = twin.iter().map(|v| v.position.length()).fold(1.0, f32::max);
            let at = animation.position_base(place, RingPlace(1)) as usize;
            let frames_at = animation.tangent_base(place) as usize;
            for (v, expected) in twin.iter().enumerate() {
                let [x, y, z, _] = positions[at + v];
                let error = Vec3::new(x, y, z).distance(expected.position) / size;
                assert!(error < 1e-5, "{name}, vertex {v}: {error}");
                let [normal, tangent] = frames[frames_at + v].map(|f| Vec3::new(f[0], f[1], f[2]));
                assert!(normal.distance(expected.normal) < 1e-4, "{name}, normal {v}: {normal}");
                let wanted = Vec3::from_slice(&expected.tangent[..3]);
                assert!(tangent.distance(wanted) < 1e-4, "{name}, tangent {v}: {tangent} {wanted}");
            }
        }
    }
}

#[test]
fn every_way_of_skinning_and_sampling_equals_the_cpu_twin() {
    let gpu = gpu();
    let scene = mixed_scene(&mut SmallRng::seed_from_u64(SEED));
    for skinning in [Skinning::PerVertexChain, Skinning::Palette, Skinning::Packed] {
        for sampling in [sampling::Sampling::default(), sampling::Sampling::Constant { interval_s: 0.1 }] {
            compare_with_twin(
                &gpu,
                &scene,
                SceneOptions { sampling, skinning },
                &[0.0, 0.456, 1.0, 86_400.3],
            );
        }
    }
    assert_no_messages(&gpu);
}

#[test]
fn the_dragon_equals_the_cpu_twin_however_it_is_skinned() {
    let gpu = gpu();
    let scene = load_scene(&SceneSource::Dragons(1)).expect("the built-in scene loads");
    let sampling = sampling::Sampling::Constant { interval_s: 0.1 };
    for skinning in [Skinning::PerVertexChain, Skinning::Packed] {
        compare_with_twin(&gpu, &scene, SceneOptions { sampling, skinning }, &[0.731]);
    }
    assert_no_messages(&gpu);
}

/// Bytes of what is stored once for the whole scene.
fn shared_bytes(scene: &SceneGpu) -> Vec<u64> {
    let buffers = [
        &scene.meshes.vertices,
        &scene.skins.packed_vertices,
        &scene.meshes.indices,
        &scene.meshes.patches,
        &scene.meshes.patch_of_triangle,
        &scene.skins.morph_deltas,
    ];
    let textures = scene.materials.texture_binds().len() as u64;
    buffers.iter().map(|b| b.size()).chain([scene.animation.bytes, textures]).collect()
}

#[test]
fn a_hundred_and_sixty_nine_instances_add_only_what_is_per_instance() {
    let gpu = gpu();
    let options = SceneOptions { skinning: Skinning::Packed, ..SceneOptions::default() };
    let one = load_scene(&SceneSource::Dragons(1)).expect("the built-in scene loads");
    let mut many = one.clone();
    many.instances
        .extend((1..169).map(|index| Instance { time_shift_s: index as f32, ..one.instances[0].clone() }));
    let [one, many] = [one, many].map(|scene| SceneGpu::new(&gpu, scene, &options).expect("the scene fits"));
    assert_eq!(many.numbering.instances.len(), one.numbering.instances.len() + 168);
    assert_eq!(shared_bytes(&one), shared_bytes(&many));
    assert_eq!(one.materials.buffer.size(), many.materials.buffer.size());
}

#[test]
fn equal_models_of_different_files_are_stored_once() {
    let gpu = gpu();
    let model = random_model(&mut SmallRng::seed_from_u64(SEED), 2);
    let mut renamed = model.clone();
    renamed.name = "another file".into();
    renamed.materials[0].roughness = 0.1;
    let instance = |model: usize| Instance { clip: Some(0), ..Instance::new("i", model) };
    let options = SceneOptions { skinning: Skinning::Packed, ..SceneOptions::default() };
    let one = scene_of(vec![model.clone()], vec![instance(0)]);
    let two = scene_of(vec![model, renamed], vec![instance(0), instance(1)]);
    let [one, two] = [one, two].map(|scene| SceneGpu::new(&gpu, scene, &options).expect("the scene fits"));
    assert_eq!(shared_bytes(&one), shared_bytes(&two));
    assert_eq!(
        two.materials.buffer.size(),
        2 * one.materials.buffer.size(),
        "materials differ and are the model's own"
    );
    assert_eq!(two.animation.manager.skeletons.len(), 1);
    assert_eq!(two.animation.manager.clips.len(), 2, "the rest pose and the clip");
}

#[test]
fn instances_in_the_same_pose_share_a_palette() {
    let gpu = gpu();
    let model = random_model(&mut SmallRng::seed_from_u64(SEED), 1);
    // The same phase by the same shift, by a whole turn of the loop, and by a path that changes only the place.
    let shifts = [0.25, 0.25, 1.25, 0.5, 0.25];
    let mut instances: Vec<Instance> = shifts
        .iter()
        .map(|shift| Instance { clip: Some(0), time_shift_s: *shift, ..Instance::new("i", 0) })
        .collect();
    instances[4].path = Some(random_path(&mut SmallRng::seed_from_u64(SEED)));
    let scene = scene_of(vec![model], instances);
    let gpu_scene = Arc::new(SceneGpu::new(&gpu, scene, &SceneOptions::default()).expect("the scene fits"));
    let mut animation = Animation::new(&gpu, &gpu_scene, 1).unwrap();
    let mut recorder = gpu.record().unwrap();
    animation.record_sample(&mut recorder, RingPlace(0), ServerTime(0));
    gpu.wait(recorder.submit().unwrap()).unwrap();
    let AnimationCounts { poses, shared_poses, instance_samples, .. } = animation.counts();
    assert_eq!((poses, shared_poses, instance_samples), (2, 3, 5));
    assert_no_messages(&gpu);
}

/// Views that nobody looks through: only the times count here.
fn views(first: i32, horizon: i32) -> PredictedViews {
    let view = View { world_from_eye: Pose::IDENTITY, fov: Fov::symmetric_degrees(90.0) };
    PredictedViews {
        times: [GridIndex(first + 1), GridIndex(first + 2), GridIndex(horizon - 2)],
        eyes: [[view; 2]; 3],
        world_from_head: Pose::IDENTITY,
        first_sample: GridIndex(first),
        horizon: GridIndex(horizon),
        margin: 0.0,
    }
}

#[test]
fn samples_are_computed_once_and_only_for_what_is_needed() {
    let gpu = gpu();
    let model = random_model(&mut SmallRng::seed_from_u64(SEED), 0);
    let instance = |shift: f32| Instance { clip: Some(0), time_shift_s: shift, ..Instance::new("i", 0) };
    let scene = scene_of(vec![model], vec![instance(0.0), instance(0.4)]);
    let scene = Arc::new(SceneGpu::new(&gpu, scene, &SceneOptions::default()).expect("the scene fits"));
    let mut animation = Animation::new(&gpu, &scene, shadecast_server::samples::RING).unwrap();
    let mut window = SampleWindow::new(&gpu, &scene, &animation).unwrap();
    let mut computed = |first: i32, needed: [bool; 2]| {
        let before = animation.counts().instance_samples;
        let mut recorder = gpu.record().unwrap();
        window.record(
            &mut recorder,
            &mut animation,
            DEFAULT_GRID,
            &views(first, first + 6),
            &Needed::from_iter(needed),
        );
        gpu.wait(recorder.submit().unwrap()).unwrap();
        animation.counts().instance_samples - before
    };
    assert_eq!(computed(10, [true, true]), 14, "the whole window of both");
    assert_eq!(computed(10, [true, true]), 0, "nothing new");
    assert_eq!(computed(11, [true, true]), 2, "the new grid point");
    assert_eq!(computed(13, [true, false]), 2, "two new ones of the one that is needed");
    assert_eq!(computed(14, [true, true]), 1 + 3, "and those that the other one missed");
    assert_eq!(computed(40, [true, true]), 14, "after a long silence all");
    assert_no_messages(&gpu);
}
