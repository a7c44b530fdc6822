use super::*;
use crate::{
    Bone, Clip, Interpolation, Morph, MorphDelta, MorphTrack, PaletteEntry, Track, TrackValues, Vertex,
};
use glam::{Mat4, Quat};
use rand::{Rng, SeedableRng, rngs::SmallRng};

fn random_trs(rng: &mut SmallRng) -> Trs {
    let mut number = |low: f32, high: f32| rng.random_range(low..high);
    Trs {
        translation: Vec3::new(number(-1.0, 1.0), number(-1.0, 1.0), number(-1.0, 1.0)),
        rotation: Quat::from_euler(
            glam::EulerRot::XYZ,
            number(-3.0, 3.0),
            number(-1.5, 1.5),
            number(-3.0, 3.0),
        ),
        scale: Vec3::new(number(0.5, 2.0), number(0.5, 2.0), number(0.5, 2.0)),
    }
}

fn vertex(joints: [u16; 4], weights: [f32; 4]) -> Vertex {
    Vertex {
        position: Vec3::new(0.3, -0.2, 0.9),
        normal: Vec3::Z,
        tangent: [1.0, 0.0, 0.0, 1.0],
        joints,
        weights,
        ..Vertex::default()
    }
}

/// A random forest with one clip that moves every third bone, one palette entry and one vertex per bone.
fn random_model(rng: &mut SmallRng, bone_count: u32) -> Model {
    let mut model = Model::default();
    let mut tracks = Vec::new();
    for bone in 0..bone_count {
        let parent = (bone > 0 && rng.random_bool(0.9)).then(|| rng.random_range(0..bone));
        model.bones.push(Bone { name: format!("b{bone}"), parent, rest: random_trs(rng) });
        let bone_from_mesh = random_trs(rng).affine();
        model.palette.push(PaletteEntry { bone, bone_from_mesh });
        model.vertices.push(vertex([bone as u16; 4], [1.0, 0.0, 0.0, 0.0]));
        if bone % 3 == 1 {
            let keys = (0..3).map(|_| random_trs(rng).rotation).collect();
            let (times_s, values) = (vec![0.0, 0.4, 1.0], TrackValues::Rotation(keys));
            tracks.push(Track { bone, times_s, interpolation: Interpolation::Linear, values });
        }
    }
    model.clips.push(Clip { name: "c".into(), duration_s: 1.0, tracks, ..Clip::default() });
    model
}

/// The product of the whole parent chain, in double steps of plain 4x4 matrices.
fn chain(model: &Model, locals: &[Trs], bone: u32) -> Mat4 {
    let local = locals[bone as usize];
    let matrix = Mat4::from_scale_rotation_translation(local.scale, local.rotation, local.translation);
    model.bones[bone as usize].parent.map_or(matrix, |parent| chain(model, locals, parent) * matrix)
}

#[test]
fn one_pass_over_parents_first_equals_walking_every_chain() {
    let mut rng = SmallRng::seed_from_u64(21);
    for case in 0..30 {
        let count = rng.random_range(1..60);
        let model = random_model(&mut rng, count);
        let locals = source_pose(&model, Some(0), rng.random_range(0.0..1.0));
        let globals = global_pose(&model, &locals);
        for bone in 0..count {
            let (found, expected) = (Mat4::from(globals[bone as usize]), chain(&model, &locals, bone));
            let size = expected.to_cols_array().into_iter().map(f32::abs).fold(1.0, f32::max);
            assert!(found.abs_diff_eq(expected, 1e-4 * size), "seed 21, case {case}, bone {bone}");
        }
    }
}

#[test]
fn only_vertices_below_a_moving_bone_are_animated() {
    let mut rng = SmallRng::seed_from_u64(24);
    for case in 0..20 {
        let model = random_model(&mut rng, 30);
        let animated = animated_vertices(&model, Some(0));
        let positions = |t| {
            source_skin(&model, Some(0), t, Affine3A::IDENTITY)
                .into_iter()
                .map(|vertex| vertex.position)
                .collect::<Vec<_>>()
        };
        let (first, second) = (positions(0.0), positions(0.33));
        for vertex in 0..model.vertices.len() {
            let moved = first[vertex] != second[vertex];
            assert_eq!(animated[vertex], moved, "seed 24, case {case}, vertex {vertex}");
        }
        assert!(animated_vertices(&model, None).iter().all(|animated| !animated));
    }
}

#[test]
fn vertex_without_weight_on_a_moving_bone_is_static() {
    let mut rng = SmallRng::seed_from_u64(25);
    let mut model = random_model(&mut rng, 2);
    model.bones[1].parent = None;
    model.vertices =
        vec![vertex([0, 1, 0, 0], [1.0, 0.0, 0.0, 0.0]), vertex([0, 1, 0, 0], [0.9, 0.1, 0.0, 0.0])];
    assert_eq!(animated_vertices(&model, Some(0)), [false, true]);
}

#[test]
fn morphs_are_added_before_skinning_and_move_their_vertices() {
    let mut rng = SmallRng::seed_from_u64(28);
    let mut model = random_model(&mut rng, 3);
    model.clips[0].tracks.clear();
    let delta =
        MorphDelta { vertex: 1, position: Vec3::X, normal: Vec3::new(3.0, 0.0, -1.0), tangent: Vec3::ZERO };
    model.morphs = vec![Morph { name: "m".into(), rest_weight: 0.25, deltas: vec![delta] }];
    let at = |model: &Model, clip, t_s| source_skin(model, clip, t_s, Affine3A::IDENTITY)[1];
    let expected = |model: &Model, weight: f32| {
        source_palette(model, None, 0.0)[1].transform_point3(model.vertices[1].position + weight * Vec3::X)
    };
    assert!(at(&model, None, 0.0).position.abs_diff_eq(expected(&model, 0.25), 1e-5), "rest weight");
    assert_eq!(animated_vertices(&model, Some(0)), [false; 3]);
    model.clips[0].morph_tracks = vec![MorphTrack {
        first_morph: 0,
        morph_count: 1,
        times_s: vec![0.0, 1.0],
        interpolation: Interpolation::Linear,
        weights: vec![0.0, 1.0],
    }];
    assert!(at(&model, Some(0), 0.5).position.abs_diff_eq(expected(&model, 0.5), 1e-5));
    assert_eq!(morphed(&model, &[0.5])[1].normal, Vec3::new(1.5, 0.0, 0.5));
    assert_eq!(animated_vertices(&model, Some(0)), [false, true, false]);
}

#[test]
fn blending_equal_matrices_changes_nothing() {
    let matrix = random_trs(&mut SmallRng::seed_from_u64(26)).affine();
    let blended = blend(&[matrix; 4], [0, 1, 2, 3], [0.1, 0.2, 0.3, 0.4]);
    assert!(blended.abs_diff_eq(matrix, 1e-6));
}

#[test]
fn normals_stay_perpendicular_under_unequal_and_mirroring_scales() {
    let (along, across) = (Vec3A::new(1.0, 1.0, 0.0), Vec3A::new(0.5, -0.5, 3.0));
    let normal = along.cross(across);
    for scale in [Vec3::new(3.0, 0.2, 1.0), Vec3::new(-1.0, 1.0, 1.0), Vec3::new(2.0, -0.1, -4.0)] {
        let linear = Mat3A::from_diagonal(scale) * Mat3A::from_rotation_y(0.7);
        let turned = normal_matrix(linear) * normal;
        let cosines = [turned.dot(linear * along), turned.dot(linear * across)];
        assert!(cosines.iter().all(|cosine| cosine.abs() < 1e-4), "{scale}: {cosines:?}");
        assert!(turned.dot(linear * normal) > 0.0, "{scale}: the normal points to the other side");
    }
}

#[test]
fn bounds_cover_the_whole_clip() {
    let mut rng = SmallRng::seed_from_u64(27);
    let model = random_model(&mut rng, 12);
    let (low, high) = bounds(&model, Some(0), 20).expect("vertices");
    for vertex in source_skin(&model, Some(0), 0.35, Affine3A::IDENTITY) {
        assert!(
            vertex.position.cmpge(low - 1e-4).all() && vertex.position.cmple(high + 1e-4).all(),
            "seed 27"
        );
    }
    assert_eq!(bounds(&Model::default(), None, 3), None);
}
