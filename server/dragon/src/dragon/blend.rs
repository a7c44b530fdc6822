//! Joins limbs: where two lofts meet, both surfaces are moved onto one smooth union, so that no crease shows.
//!
//! The union is the polynomial smooth minimum of the two rough distances. Each surface sinks below it where the other
//! one is nearer, so that they cross at equal distance instead of lying in each other.

use super::loft::Loft;
use super::mesh::{Mesh, Vertex};
use super::weights::{Limb, Shading, Weights};
use crate::curve::{lerp, smoothstep};
use glam::Vec3;

/// One limb's surface against others.
pub(super) struct Joint<'a> {
    pub own: &'a Limb,
    pub others: Vec<&'a Limb>,
    /// Radius of the fillet, metres.
    pub fillet_m: f32,
    /// Width of the zone in which bone weights change over, to either side, metres.
    pub changeover_m: f32,
}

impl Joint<'_> {
    /// Moves the surface onto the union, sets weights, paint and normals, and drops what lies deep inside the others.
    pub fn apply(&self, mesh: &mut Mesh) {
        mesh.smooth_normals();
        for vertex in &mut mesh.vertices {
            let before = self.distances(vertex.position);
            if before.1.abs() < self.fillet_m {
                vertex.position = self.onto_union(vertex.position);
            }
            self.change_over(vertex);
        }
        mesh.smooth_normals();
        for vertex in &mut mesh.vertices {
            let (own, other) = self.distances(vertex.position);
            let share = 1.0 - smoothstep(0.5, 1.0, (own - other).abs() / self.fillet_m);
            let union = self.gradient(vertex.position).normalize_or_zero();
            vertex.normal = vertex.normal.lerp(union, share).normalize_or(vertex.normal);
        }
        let depth = 0.5 * self.fillet_m;
        mesh.drop_triangles(|[a, b, c]| {
            // Where a tube's start was pressed together inside the other it may have folded over: never seen either.
            let face = (b.position - a.position).cross(c.position - a.position);
            let folded = face.dot(a.normal + b.normal + c.normal) <= 0.0;
            folded || self.nearest_other((a.position + b.position + c.position) / 3.0).0 < -depth
        });
    }

    fn nearest_other(&self, point: Vec3) -> (f32, Option<&Limb>) {
        let distances = self.others.iter().map(|&limb| (limb.loft.distance(point), limb));
        let nearest = distances.min_by(|a, b| a.0.total_cmp(&b.0));
        nearest.map_or((f32::INFINITY, None), |(distance, limb)| (distance, Some(limb)))
    }

    fn distances(&self, point: Vec3) -> (f32, f32) {
        (self.own.loft.distance(point), self.nearest_other(point).0)
    }

    fn union(&self, point: Vec3) -> f32 {
        let (a, b) = self.distances(point);
        smooth_minimum(a, b, self.fillet_m)
    }

    /// By differences at the corners of a tetrahedron.
    fn gradient(&self, point: Vec3) -> Vec3 {
        const STEP_M: f32 = 2e-3;
        let corners = [
            Vec3::new(1.0, -1.0, -1.0),
            Vec3::new(-1.0, -1.0, 1.0),
            Vec3::new(-1.0, 1.0, -1.0),
            Vec3::new(1.0, 1.0, 1.0),
        ];
        corners.iter().map(|&corner| corner * self.union(point + corner * STEP_M)).sum::<Vec3>()
            / (4.0 * STEP_M)
    }

    fn onto_union(&self, start: Vec3) -> Vec3 {
        const STEPS: usize = 4;
        let mut point = start;
        for _ in 0..STEPS {
            let (a, b) = self.distances(point);
            // Nothing where both are equally near, back to its own depth a fillet further in.
            let sunk = -self.fillet_m * ((a - b) / self.fillet_m).clamp(0.0, 1.0).powi(2);
            let gradient = self.gradient(point);
            let miss = smooth_minimum(a, b, self.fillet_m) - sunk;
            let step = gradient * (miss / gradient.length_squared().max(0.1));
            point -= step.clamp_length_max(0.5 * self.fillet_m);
        }
        point
    }

    /// Near the others, weights and paint go over into theirs: the same for both surfaces at the same place.
    fn change_over(&self, vertex: &mut Vertex) {
        let point = vertex.position;
        let (other_m, other) = self.nearest_other(point);
        let share =
            smoothstep(-self.changeover_m, self.changeover_m, other_m - self.own.loft.distance(point));
        vertex.weights = self.own.weights(point);
        let Some(other) = other.filter(|_| share < 1.0) else { return };
        vertex.weights = Weights::mix(&other.weights(point), &vertex.weights, share);
        vertex.paint.x = lerp(other.ventral(point), self.own.ventral(point), share);
        // Belly plates run on from the trunk onto limbs, which have none of their own.
        if self.own.shading != Shading::TRUNK && other.shading == Shading::TRUNK {
            vertex.paint.y = other.loft.nearest_m(point);
        }
    }
}

fn smooth_minimum(a: f32, b: f32, radius: f32) -> f32 {
    let h = (radius - (a - b).abs()).max(0.0) / radius;
    a.min(b) - 0.25 * h * h * radius
}

/// How open a place is to the sky and its surroundings, 0..1: compares distances along the normal with the way gone.
pub(super) fn openness(point: Vec3, normal: Vec3, lofts: &[&Loft]) -> f32 {
    const REACHES_M: [f32; 3] = [0.03, 0.08, 0.16];
    let hidden = REACHES_M.map(|reach| {
        let at = point + normal * reach;
        let nearest = lofts.iter().map(|loft| loft.distance(at)).fold(f32::INFINITY, f32::min);
        ((reach - nearest) / reach).clamp(0.0, 1.0)
    });
    1.0 - hidden.iter().sum::<f32>() / hidden.len() as f32
}
