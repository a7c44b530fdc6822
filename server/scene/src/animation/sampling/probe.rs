//! Distance of skinned vertices from their places in the original.

use super::SampledClip;
use crate::animation::pose;
use crate::{Model, Vertex};
use glam::{Affine3A, Vec3, Vec3A};

/// Inputs of a model's vertices at one time.
#[derive(Clone, Debug)]
pub(crate) struct VertexInputs {
    /// `model_from_mesh` by palette entry.
    pub palette: Vec<Affine3A>,
    /// By morph target.
    pub weights: Vec<f32>,
}

impl VertexInputs {
    /// By the source curves.
    pub fn of_source(model: &Model, clip: Option<usize>, t_s: f64) -> Self {
        Self {
            palette: pose::source_palette(model, clip, t_s),
            weights: pose::source_morph_weights(model, clip, t_s),
        }
    }

    /// By sampled curves.
    pub fn of_samples(model: &Model, clip: &SampledClip, t_s: f64) -> Self {
        let globals = pose::global_pose(model, &clip.local_pose(t_s));
        Self { palette: pose::palette(model, &globals), weights: clip.morph_weights(t_s) }
    }

    /// A vertex before it is skinned.
    pub fn morphed_point(&self, model: &Model, vertex: u32) -> Vec3A {
        let mut point = model.vertices[vertex as usize].position;
        for (morph, weight) in model.morphs.iter().zip(&self.weights).filter(|(_, weight)| **weight != 0.0) {
            let deltas = morph.deltas.iter().filter(|delta| delta.vertex == vertex);
            point += deltas.map(|delta| *weight * delta.position).sum::<Vec3>();
        }
        point.into()
    }
}

/// From where the truth has a vertex to where it was found.
pub(crate) fn offset(model: &Model, truth: &VertexInputs, found: &VertexInputs, vertex: u32) -> Vec3A {
    let Vertex { joints, weights, .. } = model.vertices[vertex as usize];
    let (from, to) = (truth.morphed_point(model, vertex), found.morphed_point(model, vertex));
    let joints = joints.into_iter().zip(weights).filter(|(_, weight)| *weight > 0.0);
    let offset = |(joint, weight): (u16, f32)| {
        let (a, b) = (truth.palette[usize::from(joint)], found.palette[usize::from(joint)]);
        // Differences first: they are small, and places are not.
        weight * ((b.matrix3 - a.matrix3) * to + (b.translation - a.translation) + a.matrix3 * (to - from))
    };
    joints.map(offset).sum()
}

/// Calls with each of `vertices` (indices) and the distance of its two places.
pub(crate) fn distances(
    model: &Model,
    truth: &VertexInputs,
    found: &VertexInputs,
    vertices: &[u32],
    mut each: impl FnMut(u32, f32),
) {
    let difference = |(a, b): (&Affine3A, &Affine3A)| Affine3A {
        matrix3: a.matrix3 - b.matrix3,
        translation: a.translation - b.translation,
    };
    let differences: Vec<Affine3A> = found.palette.iter().zip(&truth.palette).map(difference).collect();
    if model.morphs.is_empty() {
        for index in vertices {
            let Vertex { position, joints, weights, .. } = model.vertices[*index as usize];
            let moved = pose::blend(&differences, joints, weights).transform_point3a(position.into());
            each(*index, moved.length());
        }
        return;
    }
    let offset = offsets(model, &truth.weights);
    let changes: Vec<f32> = found.weights.iter().zip(&truth.weights).map(|(a, b)| a - b).collect();
    let change = offsets(model, &changes);
    for index in vertices {
        let Vertex { position, joints, weights, .. } = model.vertices[*index as usize];
        let place = Vec3A::from(position + offset[*index as usize]);
        let moved = pose::blend(&differences, joints, weights).transform_point3a(place);
        let shape =
            pose::blend(&found.palette, joints, weights).matrix3 * Vec3A::from(change[*index as usize]);
        each(*index, (moved + shape).length());
    }
}

/// What the morph targets of these weights add to each vertex.
fn offsets(model: &Model, weights: &[f32]) -> Vec<Vec3> {
    let mut offsets = vec![Vec3::ZERO; model.vertices.len()];
    for (morph, weight) in model.morphs.iter().zip(weights).filter(|(_, weight)| **weight != 0.0) {
        for delta in &morph.deltas {
            offsets[delta.vertex as usize] += *weight * delta.position;
        }
    }
    offsets
}
