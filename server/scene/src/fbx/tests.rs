//! The importer on small generated files, on thousands of damaged ones, and on real assets where they are there.

use super::*;
use crate::animation::pose;
use crate::sound::{assert_sound, exercise};
use glam::{Affine3A, Vec3};
use std::collections::HashMap;
use std::path::PathBuf;

// ---- real assets ----

const REAL: [&str; 2] = ["maya_human_ik_7400_binary.fbx", "maya_game_sausage_7500_binary_combined.fbx"];

/// The bytes of a real asset, where it is there.
fn real(name: &str) -> Option<Vec<u8>> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/assets").join(name);
    if !path.is_file() {
        eprintln!("SKIPPED: {} does not exist", path.display());
        return None;
    }
    Some(std::fs::read(path).expect("readable"))
}

#[test]
fn all_real_assets_load() {
    for name in REAL {
        let Some(bytes) = real(name) else { return };
        let (model, warnings) =
            import(&bytes, name, None).map_err(|fault| fault.in_file(name)).expect("loads");
        assert_sound(&model, name);
        exercise(&model);
        print_statistics(&model, &warnings);
        assert!(warnings.is_empty(), "{name}: {warnings:?}");
    }
}

/// The sausage has three stacks, one after the other on one time line; the human has neither meshes nor curves.
#[test]
fn real_animation_moves_a_skin_of_plausible_size_from_time_0() {
    let Some(bytes) = real(REAL[1]) else { return };
    let model = from_slice(&bytes, REAL[1]).expect("loads");
    let names: Vec<&str> = model.clips.iter().map(|clip| clip.name.as_str()).collect();
    assert_eq!(names, ["wiggle", "spin", "deform"]);
    for (index, clip) in model.clips.iter().enumerate() {
        assert!((0.79..0.84).contains(&clip.duration_s), "'{}' lasts {} s", clip.name, clip.duration_s);
        let moving =
            pose::animated_vertices(&model, Some(index)).into_iter().filter(|moving| *moving).count();
        assert!(moving * 2 > model.vertices.len(), "'{}' moves {moving} vertices", clip.name);
    }
    let (low, high) = pose::bounds(&model, None, 1).expect("vertices");
    // Modelled as 4 units of a centimetre.
    let extent = (high - low).max_element();
    assert!((0.02..0.06).contains(&extent), "{extent} m");
}

fn print_statistics(model: &Model, warnings: &Warnings) {
    for (index, clip) in model.clips.iter().enumerate() {
        let keys: usize = clip.tracks.iter().map(|track| track.times_s.len()).sum();
        let (low, high) = pose::bounds(model, Some(index), 8).expect("vertices");
        eprintln!(
            "    clip '{}' {:.3} s, {} tracks, {keys} keys, {} morph tracks, from {low:.2} to {high:.2}",
            clip.name,
            clip.duration_s,
            clip.tracks.len(),
            clip.morph_tracks.len()
        );
    }
    eprintln!(
        "{}: {} vertices, {} triangles, {} bones, {} palette entries, {} primitives, {} morphs, materials {:?}, {} lights, warnings {warnings:?}",
        model.name,
        model.vertices.len(),
        model.indices.len() / 3,
        model.bones.len(),
        model.palette.len(),
        model.primitives.len(),
        model.morphs.len(),
        model.materials,
        model.lights.len(),
    );
}

/// Largest distance in metres between the vertices of a model at a time of a clip and what the library's own evaluation
/// of the original curves, blend shapes and skins gives. Model vertices are found in the file by their place in mesh
/// space; of control points at one place the nearest counts.
#[track_caller]
fn largest_skinning_error_m(scene: &ufbx::Scene, model: &Model, clip: usize, t_s: f64) -> f32 {
    let stack = &scene.anim_stacks[clip];
    let options = ufbx::EvaluateOpts { evaluate_skinning: true, ..ufbx::EvaluateOpts::default() };
    let evaluated =
        ufbx::evaluate_scene(scene, &stack.anim, stack.anim.time_begin + t_s, options).expect("evaluates");
    let mut places: HashMap<[u32; 3], Vec<Vec3>> = HashMap::new();
    for mesh in &evaluated.meshes {
        for (rest, skinned) in mesh.vertices.iter().zip(&*mesh.skinned_position.values) {
            let node = &mesh.element.instances[0];
            let to_world = if mesh.skinned_is_local {
                affine(&node.geometry_to_world).expect("finite")
            } else {
                Affine3A::IDENTITY
            };
            let world = to_world.transform_point3(convert::vec3(*skinned));
            places.entry(convert::vec3(*rest).to_array().map(f32::to_bits)).or_default().push(world);
        }
    }
    let palette = pose::source_palette(model, Some(clip), t_s);
    let vertices = pose::morphed(model, &pose::source_morph_weights(model, Some(clip), t_s));
    let skinned = pose::skin(&vertices, &palette, Affine3A::IDENTITY);
    let error = |(vertex, skinned): (&crate::Vertex, &pose::SkinnedVertex)| {
        let candidates = &places[&vertex.position.to_array().map(f32::to_bits)];
        candidates.iter().map(|place| place.distance(skinned.position)).fold(f32::INFINITY, f32::min)
    };
    model.vertices.iter().zip(&skinned).map(error).fold(0.0, f32::max)
}

#[test]
fn skinned_vertices_are_where_the_library_itself_puts_them() {
    for name in REAL {
        let Some(bytes) = real(name) else { return };
        let (scene, model) =
            (parse(&bytes).map_err(|f| f.problem).expect("parses"), from_slice(&bytes, name).expect("loads"));
        for (clip, source) in model.clips.iter().enumerate() {
            let (low, high) = pose::bounds(&model, Some(clip), 8).expect("vertices");
            let extent = (high - low).max_element();
            let worst = (0..=40).map(|moment| f64::from(moment) / 40.0 * f64::from(source.duration_s));
            let worst =
                worst.map(|t_s| largest_skinning_error_m(&scene, &model, clip, t_s)).fold(0.0, f32::max);
            eprintln!("{name} '{}': {:.4} mm of {extent:.2} m", source.name, worst * 1e3);
            assert!(worst < 1e-3 * extent, "{name} '{}': {worst} m of {extent} m", source.name);
        }
    }
}
