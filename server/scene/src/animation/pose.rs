//! CPU twin of the GPU's animation stages: bone palette, morph targets, skinning; and the same from the source curves, the
//! truth for both. Local poses come from [`super::sampling`] or [`source_pose`].

use super::clip;
use crate::{Model, Trs, Vertex};
use glam::{Affine3A, Mat3A, Vec3, Vec3A};
use std::borrow::Cow;

pub use super::clip::{source_morph_weights, source_pose};

/// A vertex after skinning.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SkinnedVertex {
    /// In the frame that `skin`'s last argument leads to, metres.
    pub position: Vec3,
    /// Unit length, zero only where the matrix flattens it to nothing.
    pub normal: Vec3,
    /// xyz unit length, w the sign of the bitangent.
    pub tangent: [f32; 4],
}

/// `model_from_bone` of every bone. One pass, since parents precede their children.
pub fn global_pose(model: &Model, locals: &[Trs]) -> Vec<Affine3A> {
    let mut globals: Vec<Affine3A> = Vec::with_capacity(locals.len());
    for (bone, local) in model.bones.iter().zip(locals) {
        let parent = bone.parent.map_or(Affine3A::IDENTITY, |parent| globals[parent as usize]);
        globals.push(parent * local.affine());
    }
    globals
}

/// `model_from_mesh` of every palette entry.
pub fn palette(model: &Model, globals: &[Affine3A]) -> Vec<Affine3A> {
    model.palette.iter().map(|entry| globals[entry.bone as usize] * entry.bone_from_mesh).collect()
}

/// The vertices with every morph target added that has a weight; normals and tangents unit length again. Borrowed
/// where nothing is added.
pub fn morphed<'a>(model: &'a Model, morph_weights: &[f32]) -> Cow<'a, [Vertex]> {
    assert_eq!(morph_weights.len(), model.morphs.len(), "one weight per morph");
    if morph_weights.iter().all(|weight| *weight == 0.0) {
        return Cow::Borrowed(&model.vertices);
    }
    let mut vertices = model.vertices.clone();
    for (morph, weight) in model.morphs.iter().zip(morph_weights).filter(|(_, weight)| **weight != 0.0) {
        for delta in &morph.deltas {
            let vertex = &mut vertices[delta.vertex as usize];
            let tangent = Vec3::from_slice(&vertex.tangent[..3]) + *weight * delta.tangent;
            vertex.position += *weight * delta.position;
            vertex.normal += *weight * delta.normal;
            vertex.tangent = tangent.extend(vertex.tangent[3]).to_array();
        }
    }
    Cow::Owned(vertices)
}

/// Linear blend skinning of `vertices` (a model's, or what [`morphed`] makes of them). Tangents follow the blended
/// matrix, normals its cofactor matrix, so that they stay perpendicular to surfaces under unequal scales.
pub fn skin(vertices: &[Vertex], palette: &[Affine3A], world_from_model: Affine3A) -> Vec<SkinnedVertex> {
    let skin_one = |vertex: &Vertex| {
        let world_from_mesh = world_from_model * blend(palette, vertex.joints, vertex.weights);
        let linear = world_from_mesh.matrix3;
        let tangent = linear * Vec3A::from_slice(&vertex.tangent[..3]);
        SkinnedVertex {
            position: world_from_mesh.transform_point3(vertex.position),
            normal: (normal_matrix(linear) * Vec3A::from(vertex.normal)).normalize_or_zero().into(),
            tangent: tangent.normalize_or_zero().extend(vertex.tangent[3]).to_array(),
        }
    };
    vertices.iter().map(skin_one).collect()
}

/// The weighted sum of up to four palette matrices.
pub fn blend(palette: &[Affine3A], joints: [u16; 4], weights: [f32; 4]) -> Affine3A {
    let mut sum = Affine3A { matrix3: Mat3A::ZERO, translation: Vec3A::ZERO };
    for (joint, weight) in joints.into_iter().zip(weights) {
        let matrix = &palette[usize::from(joint)];
        sum.matrix3 += matrix.matrix3 * weight;
        sum.translation += matrix.translation * weight;
    }
    sum
}

/// The cofactor matrix with the determinant's sign: a positive multiple of the inverse transpose where that exists,
/// and still of use where a scale is zero.
pub fn normal_matrix(linear: Mat3A) -> Mat3A {
    let (x, y, z) = (linear.x_axis, linear.y_axis, linear.z_axis);
    let cofactor = Mat3A::from_cols(y.cross(z), z.cross(x), x.cross(y));
    if x.dot(cofactor.x_axis) < 0.0 { cofactor * -1.0 } else { cofactor }
}

/// The palette `t_s` seconds into the clip, from the source curves.
pub fn source_palette(model: &Model, clip: Option<usize>, t_s: f64) -> Vec<Affine3A> {
    palette(model, &global_pose(model, &source_pose(model, clip, t_s)))
}

/// All skinned vertices `t_s` seconds into the clip, from the source curves.
pub fn source_skin(
    model: &Model,
    clip: Option<usize>,
    t_s: f64,
    world_from_model: Affine3A,
) -> Vec<SkinnedVertex> {
    let vertices = morphed(model, &source_morph_weights(model, clip, t_s));
    skin(&vertices, &source_palette(model, clip, t_s), world_from_model)
}

/// For each vertex, whether the clip moves it: whether a bone it follows, or an ancestor of one, has a curve that
/// really varies, or a morph target of it does.
pub fn animated_vertices(model: &Model, clip: Option<usize>) -> Vec<bool> {
    let entries = animated_palette(model, clip);
    let moves = |(joint, weight): (u16, f32)| weight > 0.0 && entries[usize::from(joint)];
    let mut animated: Vec<bool> = model
        .vertices
        .iter()
        .map(|vertex| vertex.joints.into_iter().zip(vertex.weights).any(moves))
        .collect();
    for track in clip.iter().flat_map(|clip| &model.clips[*clip].morph_tracks) {
        if clip::morph_track_varies(track) {
            let morphs = &model.morphs[track.first_morph as usize..][..track.morph_count as usize];
            morphs.iter().flat_map(|m| &m.deltas).for_each(|delta| animated[delta.vertex as usize] = true);
        }
    }
    animated
}

/// For each palette entry, whether the clip moves it.
pub fn animated_palette(model: &Model, clip: Option<usize>) -> Vec<bool> {
    let mut bones = vec![false; model.bones.len()];
    for track in clip.iter().flat_map(|clip| &model.clips[*clip].tracks) {
        bones[track.bone as usize] |= clip::track_varies(track);
    }
    for bone in 0..bones.len() {
        bones[bone] |= model.bones[bone].parent.is_some_and(|parent| bones[parent as usize]);
    }
    model.palette.iter().map(|entry| bones[entry.bone as usize]).collect()
}

/// Smallest and largest corner of the model, in model space, over `times` moments spread over the clip; `None` for
/// a model without vertices.
pub fn bounds(model: &Model, clip: Option<usize>, times: u32) -> Option<(Vec3, Vec3)> {
    let duration_s = model.duration_s(clip);
    let moments = if duration_s > 0.0 { times.max(1) } else { 1 };
    let mut found: Option<(Vec3, Vec3)> = None;
    for moment in 0..moments {
        let t_s = f64::from(duration_s) * f64::from(moment) / f64::from(moments);
        for vertex in source_skin(model, clip, t_s, Affine3A::IDENTITY) {
            let at = vertex.position;
            let (low, high) = found.unwrap_or((at, at));
            found = Some((low.min(at), high.max(at)));
        }
    }
    found
}

#[cfg(test)]
mod tests {
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
        let delta = MorphDelta {
            vertex: 1,
            position: Vec3::X,
            normal: Vec3::new(3.0, 0.0, -1.0),
            tangent: Vec3::ZERO,
        };
        model.morphs = vec![Morph { name: "m".into(), rest_weight: 0.25, deltas: vec![delta] }];
        let at = |model: &Model, clip, t_s| source_skin(model, clip, t_s, Affine3A::IDENTITY)[1];
        let expected = |model: &Model, weight: f32| {
            source_palette(model, None, 0.0)[1]
                .transform_point3(model.vertices[1].position + weight * Vec3::X)
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
}
