//! Which way instances take, as clients are told it, without a GPU.

use super::*;
use crate::scene::numbering::InstanceSize;
use shadecast_protocol::limits::MIN_SAMPLE_RING;
use shadecast_scene::animation::sampling::Sampling;
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_scene::process::Loading;
use shadecast_scene::{
    Bone, Clip, Instance, Interpolation, Morph, MorphDelta, PaletteEntry, Track, TrackValues, Trs, Vertex,
};

const VERTICES: u32 = 12;

/// A skeleton of so many bones, with a clip that moves the first; `size` tells its mesh from others.
fn model(bones: u32, size: f32) -> Model {
    let mut model = Model { name: "dancer".into(), ..Model::default() };
    for bone in 0..bones {
        let parent = bone.checked_sub(1);
        model.bones.push(Bone { name: format!("b{bone}"), parent, rest: Trs::IDENTITY });
        model.palette.push(PaletteEntry { bone, bone_from_mesh: glam::Affine3A::IDENTITY });
    }
    let vertex = |number: u32| Vertex {
        position: glam::Vec3::new(number as f32 * size, 1.0, 0.0),
        weights: [1.0, 0.0, 0.0, 0.0],
        ..Vertex::default()
    };
    model.vertices = (0..VERTICES).map(vertex).collect();
    model.indices = (0..VERTICES).collect();
    let values = TrackValues::Translation(vec![glam::Vec3::ZERO, glam::Vec3::X, glam::Vec3::ZERO]);
    let tracks =
        vec![Track { bone: 0, times_s: vec![0.0, 0.5, 1.0], interpolation: Interpolation::Linear, values }];
    model.clips = vec![Clip { name: "dance".into(), duration_s: 1.0, tracks, ..Clip::default() }];
    model
}

fn moving(model: usize) -> Instance {
    Instance { clip: Some(0), ..Instance::new("moving", model) }
}

/// The scene, and what clients are told of its motion.
fn library(models: Vec<Model>, instances: Vec<Instance>, option: MotionOption) -> (Scene, MotionLibrary) {
    let template = load_scene(&SceneSource::Dragons(1)).expect("the built-in scene loads");
    let scene = Scene { models, instances, events: Vec::new(), ..template };
    let manager =
        AnimationManager::new(&scene, Sampling::default(), &Loading::plain()).expect("nobody ends it");
    let size = |(index, instance): (usize, &Instance)| InstanceSize {
        model: instance.model,
        patches: vec![1],
        vertices: VERTICES,
        is_animated: scene.moves(index),
        ..InstanceSize::default()
    };
    let numbering = Numbering::new(&scene.instances.iter().enumerate().map(size).collect::<Vec<_>>());
    let library = MotionLibrary::new(&scene, &manager, &numbering, option);
    (scene, library)
}

/// Which instances a client with all the memory that there is skins.
fn skinned(library: &MotionLibrary) -> Vec<bool> {
    library.skinned(MotionMemory::MAX).iter().map(Option::is_some).collect()
}

#[test]
fn a_still_model_keeps_none_with_the_same_mesh_from_being_skinned() {
    let still = Model { clips: Vec::new(), ..model(3, 1.0) };
    for models in [[still.clone(), model(3, 1.0)], [model(3, 1.0), still]] {
        let moves = models.each_ref().map(|model| !model.clips.is_empty());
        let instances =
            (0..2).map(|index| if moves[index] { moving(index) } else { Instance::new("still", index) });
        let (_, library) = library(models.to_vec(), instances.collect(), MotionOption::Auto);
        assert_eq!(skinned(&library), moves);
        assert!(library.unsampled_memory().is_some());
    }
}

/// So many targets, each of which moves every vertex.
fn with_morphs(count: u32) -> Model {
    let delta = |vertex| MorphDelta {
        vertex,
        position: glam::Vec3::X,
        normal: glam::Vec3::ZERO,
        tangent: glam::Vec3::ZERO,
    };
    let morph = |index| Morph {
        name: format!("m{index}"),
        rest_weight: 0.0,
        deltas: (0..VERTICES).map(delta).collect(),
    };
    Model { morphs: (0..count).map(morph).collect(), ..model(1, 1.0) }
}

#[test]
fn heavy_morph_targets_are_left_to_samples_unless_clips_are_asked_for() {
    let heavy = (MOST_MORPH_BYTES / MORPH_BYTES) as u32 + 1;
    for (count, option, is_sent) in [
        (heavy - 1, MotionOption::Auto, true),
        (heavy, MotionOption::Auto, false),
        (heavy, MotionOption::Clip, true),
        (MAX_VERTEX_MORPHS + 1, MotionOption::Clip, false),
    ] {
        let (scene, library) = library(vec![with_morphs(count)], vec![moving(0)], option);
        assert_eq!(skinned(&library), [is_sent], "{count} targets, {option:?}");
        if is_sent {
            let rest = library.rest(&scene, 0, VERTICES - 1);
            assert_eq!(rest.morphs.len(), count as usize, "{option:?}");
        }
        assert_eq!(library.unsampled_memory().is_some(), is_sent);
    }
}

/// Clients refuse such numbers, and with them the session.
#[test]
fn what_has_numbers_that_clients_do_not_take_is_sampled() {
    let far = |metres: f32| {
        let mut model = model(2, 1.0);
        let TrackValues::Translation(values) = &mut model.clips[0].tracks[0].values else { unreachable!() };
        values[1] = glam::Vec3::X * metres;
        model
    };
    let mut bound_far = model(2, 1.0);
    bound_far.palette[1].bone_from_mesh = glam::Affine3A::from_translation(glam::Vec3::X * 2e6);
    let large = |metres: f32| model(2, metres / VERTICES as f32);
    for (model, is_sent) in [
        (far(10.0), true),
        (far(2e6), false),
        (bound_far, false),
        (large(40_000.0), true),
        // In steps of 0.02 mm that is more than 32 bits hold.
        (large(50_000.0), false),
    ] {
        let (_, library) = library(vec![model], vec![moving(0)], MotionOption::Auto);
        assert_eq!(skinned(&library), [is_sent]);
        assert_eq!(library.unsampled_memory().is_some(), is_sent);
    }
}

#[test]
fn the_least_memory_without_samples_is_that_in_which_all_that_moves_has_room() {
    let models = vec![model(3, 1.0), model(40, 2.0), model(7, 3.0)];
    let instances = vec![moving(0), Instance::new("still", 2), moving(1), moving(0), moving(2)];
    let (scene, library) = library(models, instances, MotionOption::Auto);
    let least = library.unsampled_memory().expect("all play clips");
    assert_eq!(least.sample_ring, MIN_SAMPLE_RING);
    let moves: Vec<bool> = (0..scene.instances.len()).map(|index| scene.moves(index)).collect();
    let all_skinned = |memory: MotionMemory| {
        library.skinned(memory).iter().zip(&moves).all(|(skinned, moves)| skinned.is_some() == *moves)
    };
    assert!(all_skinned(least));
    assert!(library.memory().holds(least), "what is offered is enough: {:?}", library.memory());
    let MotionMemory { arena_words, rest_vertices, pose_places, .. } = least;
    for less in [
        MotionMemory { arena_words: arena_words - 1, ..least },
        MotionMemory { rest_vertices: rest_vertices - 1, ..least },
        MotionMemory { pose_places: pose_places - 1, ..least },
    ] {
        assert!(!all_skinned(less), "{less:?}");
    }
}

#[test]
fn the_longer_ring_is_for_scenes_of_which_something_is_sampled_or_posed() {
    let live = |instance| Instance { live: true, ..instance };
    let unsampled = |instances, option| library(vec![model(3, 1.0)], instances, option).1.unsampled_memory();
    let still = || Instance::new("still", 0);
    assert_eq!(unsampled(vec![still()], MotionOption::Samples), Some(MotionMemory::LEAST), "nothing moves");
    assert_eq!(unsampled(vec![moving(0)], MotionOption::Paper), Some(MotionMemory::LEAST), "predicted");
    assert!(unsampled(vec![moving(0)], MotionOption::Auto).is_some());
    assert_eq!(unsampled(vec![still(), moving(0)], MotionOption::Samples), None);
    assert_eq!(unsampled(vec![still(), moving(0)], MotionOption::Palette), None);
    assert_eq!(
        unsampled(vec![moving(0), live(still())], MotionOption::Auto),
        None,
        "posed by an application"
    );
}
