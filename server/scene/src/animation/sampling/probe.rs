//! How far skinned vertices are from where the original has them.

use super::SampledClip;
use crate::animation::pose;
use crate::{Model, Vertex};
use glam::{Affine3A, Vec3, Vec3A};

/// All that a model's vertices depend on at one time.
#[derive(Clone, Debug)]
pub(crate) struct Moment {
    /// `model_from_mesh` by palette entry.
    pub palette: Vec<Affine3A>,
    /// By morph target.
    pub weights: Vec<f32>,
}

impl Moment {
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
}

/// Calls with each of `vertices` (indices) and the distance of its two places.
pub(crate) fn distances(
    model: &Model,
    truth: &Moment,
    found: &Moment,
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
