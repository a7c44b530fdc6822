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
mod tests;
