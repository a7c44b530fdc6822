//! The animation stages on the GPU against their CPU twin, and the work that they skip, on small scenes with every kind of
//! motion. Validation is on.

use glam::{Affine3A, Quat, Vec3, Vec4};
use rand::{Rng, SeedableRng, rngs::SmallRng};
use shadecast_e2e::SavedVertices;
use shadecast_gpu::{Access, DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_lab::measure::truth::InstancePose;
use shadecast_protocol::message::MotionMemory;
use shadecast_protocol::motion::clip::{chunk_at, chunk_count};
use shadecast_protocol::motion::message::{MotionMessage, MotionNews};
use shadecast_protocol::motion::playback::Schedule;
use shadecast_protocol::motion::skeleton::ClipRef;
use shadecast_protocol::session::Out;
use shadecast_protocol::time::{DEFAULT_GRID, GridIndex, ServerTime, WorldTime};
use shadecast_protocol::wire::{StreamMessage, parse_stream};
use shadecast_scene::Cancel;
use shadecast_scene::animation::{playing, pose, sampling};
use shadecast_scene::influences::reduce_to_four;
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_scene::lod;
use shadecast_scene::timeline::{Change, Event};
use shadecast_scene::{
    Bone, Clip, Instance, Interpolation, Material, Model, Morph, MorphDelta, MorphTrack, PaletteEntry, Path,
    Primitive, Repetition, Scene, Track, TrackValues, Trs, Vertex,
};
use shadecast_server::animation::saved::MOST_PLACES;
use shadecast_server::animation::timeline::SharedTimeline;
use shadecast_server::motion::sender::MotionSender;
use shadecast_server::pacing::share::WayState;
use shadecast_server::scene::motion_library::MotionOption;
use shadecast_server::scene::skins::Skinning;
use shadecast_server::scene::{SceneGpu, SceneOptions};
use shadecast_server::skinning::gpu::{Animation, AnimationCounts, SampleJob};
use shadecast_server::time::RingPlace;
use shadecast_server::visibility::culling::Needed;
use shadecast_server::world::samples::SampleWindow;
use shadecast_server::world::{SampleTimes, Sampled};
use std::collections::HashMap;
use std::ops::Range;
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

/// What the twin makes of an instance: clip and path as sampled.
fn twin(
    scene: &Scene,
    index: usize,
    sampling: sampling::Sampling,
    time: WorldTime,
) -> Vec<pose::SkinnedVertex> {
    let instance = &scene.instances[index];
    let model = &scene.models[instance.model];
    let paths = sampling::SampledPaths::new(scene, sampling);
    let sampling = sampling.in_model(sampling::world_scale(scene, instance.model));
    let playable = scene.playable(index);
    let clips: HashMap<_, _> =
        playable.into_iter().map(|clip| (clip, sampling::sample(model, clip, sampling))).collect();
    let playing = scene.schedules()[index].at(time);
    let locals = playing::sampled_pose(|clip| &clips[&clip], &playing);
    let palette = pose::palette(model, &pose::global_pose(model, &locals));
    let vertices =
        pose::morphed(model, &playing::sampled_morph_weights(|clip| &clips[&clip], &playing)).into_owned();
    pose::skin(&vertices, &palette, paths.world_from_model(scene, index, time.seconds()))
}

fn compare_with_twin(gpu: &Arc<Gpu>, scene: &Scene, options: SceneOptions, times_s: &[f64]) {
    let gpu_scene = Arc::new(SceneGpu::new(gpu, scene.clone(), &options).expect("the scene fits"));
    let mut animation = Animation::new(gpu, &gpu_scene, 2).unwrap();
    for time_s in times_s {
        let time = WorldTime((time_s * 1e9) as i64);
        let mut recorder = gpu.record().unwrap();
        animation.record_sample(&mut recorder, RingPlace(1), time);
        recorder.barrier(Access::COMPUTE_WRITE, Access::COMPUTE);
        animation.record_tangents(&mut recorder, RingPlace(1), |_| true);
        recorder.barrier(Access::COMPUTE_WRITE, Access::COPY_READ);
        gpu.wait(recorder.submit().unwrap()).unwrap();
        let saved = SavedVertices::read(gpu, &animation);
        for index in 0..gpu_scene.numbering.instances.len() {
            let name = format!("{options:?}, {} at {time_s} s, seed {SEED}", scene.instances[index].name);
            let twin = twin(scene, index, options.sampling, time);
            let size = twin.iter().map(|v| v.position.length()).fold(1.0, f32::max);
            for (v, expected) in twin.iter().enumerate() {
                let position = saved.position(&animation, index, RingPlace(1), v);
                let error = position.distance(expected.position) / size;
                assert!(error < 1e-5, "{name}, vertex {v}: {error}");
                let (normal, tangent) = saved.frame(&animation, index, v);
                assert!(normal.distance(expected.normal) < 1e-4, "{name}, normal {v}: {normal}");
                let wanted = Vec4::from(expected.tangent);
                assert!(tangent.distance(wanted) < 1.5e-4, "{name}, tangent {v}: {tangent} {wanted}");
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
                SceneOptions { sampling, skinning, ..SceneOptions::default() },
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
        compare_with_twin(
            &gpu,
            &scene,
            SceneOptions { sampling, skinning, ..SceneOptions::default() },
            &[0.731],
        );
    }
    assert_no_messages(&gpu);
}

/// Fades an instance from what it plays into a clip from 0.5 s on, for as long, and pauses it 1.5 s later.
fn fading(mut scene: Scene, instance: usize, clip: Option<usize>) -> Scene {
    let event = |at_ms: i64, change| Event { at: WorldTime(at_ms * 1_000_000), instance, change };
    let (clip, fade_ns) = (Some(clip), 500_000_000);
    scene.events.push(event(500, Change { clip, local_s: Some(0.3), fade_ns, ..Change::default() }));
    scene.events.push(event(2000, Change { speed: Some(0.0), ..Change::default() }));
    scene
}

/// A model with morphs and two clips, which knows nothing of each other's rotations.
fn model_of_two_clips(rng: &mut SmallRng) -> Model {
    let mut model = random_model(rng, 3);
    let tracks = random_tracks(rng, model.bones.len() as u32);
    let mut other = Clip { name: "d".into(), tracks, ..model.clips[0].clone() };
    other.morph_tracks[0].weights.reverse();
    model.clips.push(other);
    model
}

#[test]
fn amid_a_cross_fade_every_way_of_skinning_equals_the_cpu_twin() {
    let gpu = gpu();
    let mut rng = SmallRng::seed_from_u64(SEED);
    let model = model_of_two_clips(&mut rng);
    let instances = ["to a clip", "to rest"].map(|name| Instance { clip: Some(0), ..Instance::new(name, 0) });
    let scene = scene_of(vec![model], instances.to_vec());
    let scene = fading(fading(scene, 0, Some(1)), 1, None);
    for skinning in [Skinning::PerVertexChain, Skinning::Palette, Skinning::Packed] {
        let options = SceneOptions { skinning, ..SceneOptions::default() };
        compare_with_twin(&gpu, &scene, options, &[0.499, 0.5, 0.56, 0.731, 0.999, 1.0, 1.3, 2.5]);
    }
    assert_no_messages(&gpu);
}

/// World positions of an instance of a model at a time, as the GPU has them.
fn positions(
    gpu: &Arc<Gpu>,
    animation: &mut Animation,
    (instance, model): (usize, &Model),
    time: WorldTime,
) -> Vec<Vec3> {
    let mut recorder = gpu.record().unwrap();
    animation.record_sample(&mut recorder, RingPlace(0), time);
    gpu.wait(recorder.submit().unwrap()).unwrap();
    let saved = SavedVertices::read(gpu, animation);
    let position = |vertex| saved.position(animation, instance, RingPlace(0), vertex);
    (0..model.vertices.len()).map(position).collect()
}

/// The first instance of a scene, amid a fade and after it, against the source's own curves.
fn compare_with_truth(gpu: &Arc<Gpu>, scene: &Scene, most_m: f32) {
    let gpu_scene = Arc::new(SceneGpu::new(gpu, scene.clone(), &SceneOptions::default()).expect("it fits"));
    let mut animation = Animation::new(gpu, &gpu_scene, 1).unwrap();
    let model = &scene.models[scene.instances[0].model];
    let mut fades = 0;
    for at_ms in [450, 530, 620, 750, 990, 1400, 2300] {
        let time = WorldTime(at_ms * 1_000_000);
        let found = positions(gpu, &mut animation, (0, model), time);
        let truth = InstancePose::at(scene, 0, time.seconds());
        for (number, found) in found.iter().enumerate() {
            let error_m = found.distance(truth.vertex(model, number).as_vec3());
            assert!(error_m < most_m, "{}, vertex {number} at {at_ms} ms: {error_m} m", model.name);
        }
        fades += usize::from(scene.schedules()[0].at(time).fading.is_some());
    }
    assert_eq!(fades, 4, "amid a fade");
}

#[test]
fn amid_a_cross_fade_vertices_are_where_the_source_has_them() {
    let gpu = gpu();
    let mut rng = SmallRng::seed_from_u64(SEED);
    let model = model_of_two_clips(&mut rng);
    let generated = scene_of(vec![model], vec![Instance { clip: Some(0), ..Instance::new("generated", 0) }]);
    compare_with_truth(&gpu, &fading(generated, 0, Some(1)), 1e-4);
    let Some(fox) = shadecast_lab::scenes::assets::asset("Fox.glb") else {
        eprintln!("SKIPPED: Fox.glb is not there; the project ships no models of others");
        return;
    };
    let fox = load_scene(&SceneSource::File(fox)).expect("the fox loads");
    compare_with_truth(&gpu, &fading(fox, 0, Some(2)), 1e-4);
    assert_no_messages(&gpu);
}

#[test]
fn a_paused_instance_stands_still() {
    let gpu = gpu();
    let model = model_of_two_clips(&mut SmallRng::seed_from_u64(SEED));
    let scene = scene_of(vec![model.clone()], vec![Instance { clip: Some(0), ..Instance::new("paused", 0) }]);
    let scene = fading(scene, 0, Some(1));
    let gpu_scene = Arc::new(SceneGpu::new(&gpu, scene, &SceneOptions::default()).expect("it fits"));
    let mut animation = Animation::new(&gpu, &gpu_scene, 1).unwrap();
    let mut at = |ms: i64| positions(&gpu, &mut animation, (0, &model), WorldTime(ms * 1_000_000));
    assert_ne!(at(1900), at(1950), "it moves until then");
    assert_eq!(at(2000), at(9876));
}

#[test]
fn a_live_instance_follows_its_pose_until_released() {
    let gpu = gpu();
    let mut rng = SmallRng::seed_from_u64(SEED);
    let model = model_of_two_clips(&mut rng);
    let live = Instance { clip: Some(0), live: true, ..Instance::new("live", 0) };
    let beside = Instance { clip: Some(0), ..Instance::new("beside", 0) };
    let scene = scene_of(vec![model.clone()], vec![beside, live.clone(), live]);
    for skinning in [Skinning::PerVertexChain, Skinning::Palette] {
        let options = SceneOptions { skinning, ..SceneOptions::default() };
        let gpu_scene = Arc::new(SceneGpu::new(&gpu, scene.clone(), &options).expect("it fits"));
        let mut animation = Animation::new(&gpu, &gpu_scene, 1).unwrap();
        let ms = |ms: i64| WorldTime(ms * 1_000_000);
        let rest = pose::source_pose(&model, None, 0.0);
        let turned: Vec<Trs> = rest
            .iter()
            .map(|bone| Trs { rotation: bone.rotation * random_rotation(&mut rng, 1.0), ..*bone })
            .collect();
        let timeline = animation.timeline().clone();
        timeline.lock().set_pose(1, ms(1000), rest.clone()).expect("a pose");
        timeline.lock().set_pose(1, ms(1400), turned.clone()).expect("another");
        for (at_ms, share) in [(1000, 0.0), (1100, 0.25), (1400, 1.0), (1800, 1.0)] {
            let found = positions(&gpu, &mut animation, (1, &model), ms(at_ms));
            let locals: Vec<Trs> =
                rest.iter().zip(&turned).map(|(from, to)| playing::mix(*from, *to, share)).collect();
            let palette = pose::palette(&model, &pose::global_pose(&model, &locals));
            let weights: Vec<f32> = model.morphs.iter().map(|morph| morph.rest_weight).collect();
            let twin = pose::skin(&pose::morphed(&model, &weights), &palette, Affine3A::IDENTITY);
            let size = twin.iter().map(|v| v.position.length()).fold(1.0, f32::max);
            for (v, (found, expected)) in found.iter().zip(&twin).enumerate() {
                let error = found.distance(expected.position) / size;
                assert!(error < 1e-5, "{skinning:?}, vertex {v} at {at_ms} ms: {error}");
            }
        }
        let back = timeline.lock().release_pose(1, ms(0)).expect("it is live");
        assert_eq!(back, WorldTime(ms(1800).0 + 1), "what was sampled stays");
        let [released, other] =
            [1, 2].map(|instance| positions(&gpu, &mut animation, (instance, &model), ms(2100)));
        assert_eq!(released, other, "it plays its clip as if nothing had been");
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
fn further_instances_add_only_per_instance_data() {
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
    animation.record_sample(&mut recorder, RingPlace(0), WorldTime(0));
    gpu.wait(recorder.submit().unwrap()).unwrap();
    let AnimationCounts { poses, shared_poses, instance_samples, .. } = animation.counts();
    assert_eq!((poses, shared_poses, instance_samples), (2, 3, 5));
    assert_no_messages(&gpu);
}

#[test]
fn samples_are_computed_once_and_only_for_what_is_needed() {
    let gpu = gpu();
    let model = random_model(&mut SmallRng::seed_from_u64(SEED), 0);
    let instance = |shift: f32| Instance { clip: Some(0), time_shift_s: shift, ..Instance::new("i", 0) };
    let scene = scene_of(vec![model], vec![instance(0.0), instance(0.4)]);
    let scene = Arc::new(SceneGpu::new(&gpu, scene, &SceneOptions::default()).expect("the scene fits"));
    let mut animation = Animation::new(&gpu, &scene, MOST_PLACES).unwrap();
    let mut window = SampleWindow::new(&scene, &animation);
    let mut computed_for = |first: i32, looks: [bool; 3], shaded: i32, needed: [bool; 2]| {
        let before = animation.counts().instance_samples;
        let times = [first + 1, first + 2, first + 4].map(|at| GridIndex(at).into());
        let times = SampleTimes { times, looks, shaded: GridIndex(first + shaded).into() };
        let needed = Needed::from_iter(needed);
        let mut recorder = gpu.record().unwrap();
        let sampled = window.record(&mut recorder, &mut animation, DEFAULT_GRID, times, &needed);
        gpu.wait(recorder.submit().unwrap()).unwrap();
        (animation.counts().instance_samples - before, sampled)
    };
    let (computed, Sampled { places, shaded }) = computed_for(80, [true; 3], 3, [true, true]);
    assert_eq!(computed, 8, "the three times of both, and what the update is shaded for");
    assert!(!places.contains(&shaded), "{shaded:?} in {places:?}");
    let mut computed_at = |first: i32, looks: [bool; 3], needed: [bool; 2]| {
        let (computed, Sampled { places, shaded }) = computed_for(first, looks, 2, needed);
        assert_eq!(shaded, places[1]);
        (computed, places)
    };
    let (computed, places) = computed_at(60, [false, true, false], [true, true]);
    assert_eq!(computed, 2, "the middle of both alone");
    assert_eq!(places, [places[1]; 3]);
    let (computed, places) = computed_at(70, [false, false, true], [true, true]);
    assert_eq!(computed, 4, "the middle and the time that is looked at");
    assert!(places[0] == places[1] && places[1] != places[2], "{places:?}");
    let mut computed = |first, needed| computed_at(first, [true; 3], needed).0;
    assert_eq!(computed(10, [true, true]), 6, "the three times of both");
    assert_eq!(computed(10, [true, true]), 0, "nothing new");
    assert_eq!(computed(11, [true, true]), 4, "two new times");
    assert_eq!(computed(13, [true, false]), 1, "one new time of the one that is needed");
    assert_eq!(computed(14, [true, true]), 4, "two new times, one that the other one had missed is over");
    assert_eq!(computed(40, [true, true]), 6, "after a long silence all");
    assert_no_messages(&gpu);
}

/// The chunks that a client is sent in this step, each with the words that it takes.
fn sent_chunks(sender: &mut MotionSender, now_ms: i64) -> Vec<(u32, Range<u32>)> {
    let streams = sender.tick(ServerTime(now_ms * 1_000_000), None);
    let chunk = |out: &Out| {
        let Out::Stream { bytes, .. } = out else { panic!("{out:?}") };
        let Ok(StreamMessage::Motion(payload)) = parse_stream(bytes) else { panic!("no news of motion") };
        match MotionMessage::decode(payload).expect("what the server sends is valid").news {
            MotionNews::Chunk(chunk) => (chunk.index, chunk.first_word..chunk.first_word + chunk.words()),
            other => panic!("{other:?}"),
        }
    };
    streams.iter().map(chunk).collect()
}

/// The dragon's clip of four seconds, for a client whose arena holds `spare_words` of chunks.
fn dragon_sender(gpu: &Arc<Gpu>, spare_words: Option<u32>) -> (MotionSender, Schedule<ClipRef>) {
    let scene = load_scene(&SceneSource::Dragons(1)).expect("the built-in scene loads");
    let scene = Arc::new(SceneGpu::new(gpu, scene, &SceneOptions::default()).expect("the scene fits"));
    let all = scene.motion.memory();
    let arena_words = spare_words.map_or(all.arena_words, |spare| scene.motion.first_chunk_word() + spare);
    let memory = MotionMemory { arena_words, ..all };
    let mut sender = MotionSender::new(&scene, &SharedTimeline::new(&scene.scene), memory);
    let mut told = scene.motion.skinned(memory).into_iter().flatten().next().expect("the dragon has a clip");
    sender.announce(&mut told);
    (sender, told.schedule)
}

#[test]
fn a_loop_is_sent_once_and_what_is_shown_next_comes_first() {
    let (mut sender, schedule) = dragon_sender(&gpu(), None);
    let at = schedule.at(WorldTime(0)).now;
    let first = chunk_at(at.phase_s(at.clip.duration_s), at.clip.duration_s);
    let mut seen = Vec::new();
    for step in 0..300 {
        let sent = sent_chunks(&mut sender, step * 33);
        seen.extend(sent.iter().map(|(index, _)| *index));
        assert!(sent.is_empty() || step * 33 < 4000, "after the first round nothing is sent: {sent:?}");
    }
    assert_eq!(seen.len(), chunk_count(at.clip.duration_s) as usize, "each once: {seen:?}");
    assert_eq!(seen[0], first, "{seen:?}");
}

#[test]
fn a_clip_longer_than_the_arena_is_there_whenever_it_is_shown() {
    let (mut sender, schedule) = dragon_sender(&gpu(), Some(16_000));
    let mut there: HashMap<u32, Range<u32>> = HashMap::new();
    let mut evictions = 0;
    for step in 0..700 {
        for (index, words) in sent_chunks(&mut sender, step * 33) {
            let before = there.len();
            there.retain(|_, other| other.end <= words.start || words.end <= other.start);
            evictions += before - there.len();
            there.insert(index, words);
        }
        // What is displayed is a little behind or ahead of the server's own time.
        for away_ms in [-150, 0, 400] {
            let at = schedule.at(WorldTime((step * 33 + away_ms) * 1_000_000)).now;
            let index = chunk_at(at.phase_s(at.clip.duration_s), at.clip.duration_s);
            assert!(there.contains_key(&index), "step {step}, {away_ms} ms: {index} of {:?}", there.keys());
        }
    }
    assert!(evictions > 10, "the arena was never full: {evictions}");
}

/// Whatever the way and the ring: what is sent ahead leaves the client room for what it shows meanwhile.
#[test]
fn samples_reach_no_further_ahead_than_the_ring_holds() {
    let scene = load_scene(&SceneSource::Dragons(1)).expect("the built-in scene loads");
    let options = SceneOptions { motion: MotionOption::Samples, ..SceneOptions::default() };
    let scene = Arc::new(SceneGpu::new(&gpu(), scene, &options).expect("the scene fits"));
    let lead_ms = |sample_ring, round_trip_ms: i64| {
        let memory = MotionMemory { sample_ring, ..MotionMemory::NONE };
        let mut sender = MotionSender::new(&scene, &SharedTimeline::new(&scene.scene), memory);
        let start_ms = sender.lead_ns() / 1_000_000;
        let way = WayState { smoothed_ns: round_trip_ms * 1_000_000, ..WayState::default() };
        sender.tick(ServerTime(0), Some(&way));
        [start_ms, sender.lead_ns() / 1_000_000]
    };
    // Behind the time that is shown, and around it, six steps are needed.
    assert_eq!(lead_ms(8, 20), [66, 66]);
    assert_eq!([lead_ms(32, 20), lead_ms(32, 200), lead_ms(32, 2000)], [[400, 190], [400, 820], [400, 866]]);
    assert_eq!(lead_ms(64, 2000), [400, 1933]);
}

/// A model of few triangles and so many vertices, copies of a few.
fn of_many_vertices(rng: &mut SmallRng, vertices: usize) -> Model {
    let mut model = random_model(rng, 0);
    model.vertices = model.vertices.iter().cycle().take(vertices).cloned().collect();
    model
}

#[test]
fn what_one_buffer_does_not_hold_is_skinned_into_several() {
    let gpu = gpu();
    let model = of_many_vertices(&mut SmallRng::seed_from_u64(SEED), 220_000);
    let instance = |number: usize| Instance {
        clip: Some(0),
        time_shift_s: 0.01 * number as f32,
        ..Instance::new("one of many", 0)
    };
    let scene = scene_of(vec![model.clone()], (0..80).map(instance).collect());
    let gpu_scene = Arc::new(SceneGpu::new(&gpu, scene.clone(), &SceneOptions::default()).expect("it fits"));
    let mut animation = Animation::new(&gpu, &gpu_scene, 1).unwrap();
    let mut recorder = gpu.record().unwrap();
    animation.record_sample(&mut recorder, RingPlace(0), WorldTime(400_000_000));
    recorder.barrier(Access::COMPUTE_WRITE, Access::COMPUTE);
    animation.record_tangents(&mut recorder, RingPlace(0), |_| true);
    gpu.wait(recorder.submit().unwrap()).unwrap();
    assert_eq!(animation.saved_vertices().len(), 2, "80 of 220,000 are more than 128 MiB");
    let saved = SavedVertices::read(&gpu, &animation);
    for instance in [0, 75, 76, 79] {
        let twin = twin(&scene, instance, sampling::Sampling::default(), WorldTime(400_000_000));
        for vertex in (0..model.vertices.len()).step_by(997) {
            let position = saved.position(&animation, instance, RingPlace(0), vertex);
            assert!(position.distance(twin[vertex].position) < 1e-4, "{instance}, vertex {vertex}");
            let (normal, _) = saved.frame(&animation, instance, vertex);
            assert!(normal.distance(twin[vertex].normal) < 1e-4, "{instance}, normal {vertex}");
        }
    }
    assert_no_messages(&gpu);
}

#[test]
fn only_vertices_of_the_needed_lod_are_skinned() {
    let gpu = gpu();
    let mut scene = load_scene(&SceneSource::Dragons(1)).expect("the built-in scene loads");
    let dragon = scene.instances.iter().position(|instance| instance.clip.is_some()).expect("it flies");
    let model = scene.instances[dragon].model;
    scene.models[model].lods =
        lod::build(&scene.models[model], &Cancel::default()).expect("nobody asks to end");
    let gpu_scene = Arc::new(SceneGpu::new(&gpu, scene.clone(), &SceneOptions::default()).expect("it fits"));
    let mut animation = Animation::new(&gpu, &gpu_scene, 4).unwrap();
    let time = WorldTime(731_000_000);
    let twin = twin(&scene, dragon, sampling::Sampling::default(), time);
    let (mut skinned, place) = (Vec::new(), RingPlace(2));
    for lod in [4, 4, 5, 1, 0] {
        let job = SampleJob { instance: dragon, lod, place, time };
        let before = animation.counts().vertices;
        let mut recorder = gpu.record().unwrap();
        let jobs: Vec<SampleJob> = [job].into_iter().filter(|job| !animation.has(*job)).collect();
        animation.record(&mut recorder, &jobs, job);
        gpu.wait(recorder.submit().unwrap()).unwrap();
        skinned.push(animation.counts().vertices - before);
        let saved = SavedVertices::read(&gpu, &animation);
        for vertex in scene.models[model].triangles(lod).indices.iter().map(|index| *index as usize) {
            let off_m = saved.position(&animation, dragon, place, vertex).distance(twin[vertex].position);
            assert!(off_m < 1e-4, "LOD {lod}, vertex {vertex}: {off_m} m off");
        }
    }
    let all = scene.models[model].vertices.len() as u64;
    assert!(
        skinned[0] > 0 && skinned[1..3] == [0, 0] && skinned[3] < all && skinned[4] == all,
        "{skinned:?}"
    );
    assert_no_messages(&gpu);
}
