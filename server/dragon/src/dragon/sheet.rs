//! Thin closed skins: two layers that meet at the rim.

use super::mesh::{Mesh, Rows, Skin, Vertex};
use super::weights::Weights;
use crate::curve::smoothstep;
use glam::{Vec2, Vec3, Vec4};

/// A surface over `s` (0 root, 1 rim) and `t` (0..=1 across); the upper side is where d/ds x d/dt points.
pub(super) struct Sheet<'a> {
    pub place: &'a dyn Fn(f32, f32) -> Vec3,
    /// Texel of a place for the upper (0) and lower (1) layer.
    pub texel: &'a dyn Fn(Vec3, usize) -> Vec2,
    /// Rows from root to rim.
    pub rows: usize,
    /// Wanted edge length across, metres.
    pub edge_m: f32,
    /// Thickness over s and t, metres: nothing at a free rim.
    pub thickness_m: &'a dyn Fn(f32, f32) -> f32,
    /// Distance to the nearest bone over s, t and the width there, metres, for the painter.
    pub bone_m: &'a dyn Fn(f32, f32, f32) -> f32,
    /// Bone weights over s and t; without them the caller sets weights.
    pub weights: Option<&'a dyn Fn(f32, f32) -> Weights>,
}

/// Thickness that vanishes towards the rim at `s = 1`.
pub(super) fn thin_rim(s: f32) -> f32 {
    1.0 - smoothstep(0.85, 1.0, s)
}

impl Sheet<'_> {
    pub fn mesh(&self) -> Mesh {
        let mut mesh = self.layer(0);
        let mut below = self.layer(1);
        below.triangles.iter_mut().for_each(|triangle| triangle.swap(1, 2));
        below.smooth_normals();
        mesh.smooth_normals();
        mesh.append(below);
        mesh
    }

    fn layer(&self, layer: usize) -> Mesh {
        let mut rows = Rows::default();
        for row in 0..=self.rows {
            let s = row as f32 / self.rows as f32;
            let width_m = self.width_m(s);
            let count = (width_m / self.edge_m).round() as usize;
            let vertex = |i: usize| {
                let t = if count == 0 { 0.5 } else { i as f32 / count as f32 };
                (t, self.vertex(s, t, width_m, layer))
            };
            rows.push((0..=count).map(vertex));
        }
        rows.into_mesh()
    }

    fn vertex(&self, s: f32, t: f32, width_m: f32, layer: usize) -> Vertex {
        let place = (self.place)(s, t);
        let sign = if layer == 0 { 0.5 } else { -0.5 };
        let position = place + self.normal(s, t) * (sign * (self.thickness_m)(s, t));
        let paint = Vec4::new((self.bone_m)(s, t, width_m), s, 1.0 - layer as f32, 0.0);
        let mut vertex = Vertex::new(position, (self.texel)(place, layer), Skin::Membrane, paint);
        if let Some(weights) = self.weights {
            vertex.weights = weights(s, t);
        }
        vertex
    }

    /// From `t = 0` to `t = 1`, metres.
    fn width_m(&self, s: f32) -> f32 {
        const STEPS: usize = 8;
        let at = |i: usize| (self.place)(s, i as f32 / STEPS as f32);
        (0..STEPS).map(|i| at(i).distance(at(i + 1))).sum()
    }

    fn normal(&self, s: f32, t: f32) -> Vec3 {
        const STEP: f32 = 0.02;
        // Rows may shrink to a point at the root: look a little further out.
        let s = s.max(0.1);
        let (s0, s1) = ((s - STEP).max(0.0), (s + STEP).min(1.0));
        let (t0, t1) = ((t - STEP).max(0.0), (t + STEP).min(1.0));
        let along = (self.place)(s1, t) - (self.place)(s0, t);
        let across = (self.place)(s, t1) - (self.place)(s, t0);
        along.cross(across).normalize_or(Vec3::Y)
    }
}
