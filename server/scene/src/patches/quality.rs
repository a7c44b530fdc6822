//! Use of a patch's rectangle by its triangles.

use super::{PatchKind, Patches};
use crate::Vertex;
use glam::{Vec2, Vec3};

/// How well patches turned out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PatchReport {
    /// Patches with 1, 2 and 3 triangles.
    pub count_by_kind: [usize; 3],
    /// Triangles a patch, on average; 0 where there are none.
    pub triangles_per_patch: f32,
    /// What part of the rectangles' area is more than the triangles have, 0..1.
    pub wasted_share: f32,
    /// How much longer a triangle is than its picture on the rectangle, in the direction where it is longest; the mean by
    /// area. 1 is perfect.
    pub mean_stretch: f32,
    /// The largest stretch of any triangle.
    pub worst_stretch: f32,
}

/// Triangles on a rectangle whose sides are as long as the longer of the patch's opposite sides: in such proportions its
/// block is chosen.
#[derive(Clone, Copy, Debug)]
pub(super) struct Fit {
    /// Width and height, in the mesh's unit.
    pub(super) sides: Vec2,
    /// Of the triangles.
    pub(super) area: f32,
    /// Square of the stretch, the mean by area.
    pub(super) stretch_squared: f32,
    /// How much longer the triangles are than their pictures on the rectangle, in the direction where they are longest: a
    /// block has too few texels for them by this factor there. 1 is perfect, and a single equilateral triangle has 1.22.
    pub(super) worst_stretch: f32,
    /// Stretch times area.
    stretched_area: f32,
}

impl Fit {
    pub(super) fn new(kind: PatchKind, p: &[Vec3; 5]) -> Self {
        let sides = rectangle(kind, p);
        let (mut total, mut squares, mut stretched, mut worst) = (0.0, 0.0, 0.0, 1.0f32);
        for corners in kind.triangles() {
            let corners = corners.map(usize::from);
            let place = corners.map(|corner| Vec2::from(kind.corner_uv()[corner]) * sides);
            let [origin, a, b] = corners.map(|corner| p[corner]);
            let edges = [a - origin, b - origin];
            let area = edges[0].cross(edges[1]).length() * 0.5;
            let stretch = stretch(edges, [place[1] - place[0], place[2] - place[0]]);
            total += area;
            squares += area * stretch * stretch;
            stretched += area * stretch;
            // What has no area shows nothing.
            worst = if area > 0.0 { worst.max(stretch) } else { worst };
        }
        let stretch_squared = if total > 0.0 { squares / total } else { 1.0 };
        Self { sides, area: total, stretch_squared, worst_stretch: worst, stretched_area: stretched }
    }
}

/// The longer of opposite sides.
fn rectangle(kind: PatchKind, p: &[Vec3; 5]) -> Vec2 {
    match kind {
        PatchKind::One => Vec2::new(p[0].distance(p[1]), p[0].distance(p[2])),
        PatchKind::Two | PatchKind::Three => Vec2::new(
            p[0].distance(p[1]).max(p[3].distance(p[2])),
            p[0].distance(p[3]).max(p[1].distance(p[2])),
        ),
    }
}

/// The larger singular value of the map that takes two edges' places on the rectangle to the edges; 1 where it is smaller,
/// or where there is no such map. Sander et al. 2001, Texture Mapping Progressive Meshes, section 3.
fn stretch([a, b]: [Vec3; 2], [place_a, place_b]: [Vec2; 2]) -> f32 {
    let determinant = place_a.perp_dot(place_b);
    let across = (a * place_b.y - b * place_a.y) / determinant;
    let down = (b * place_a.x - a * place_b.x) / determinant;
    let (aa, bb, ab) = (across.length_squared(), down.length_squared(), across.dot(down));
    let squared = 0.5 * (aa + bb + ((aa - bb) * (aa - bb) + 4.0 * ab * ab).sqrt());
    if squared.is_finite() { squared.sqrt().max(1.0) } else { 1.0 }
}

impl Patches {
    /// Counts, waste and stretch; `vertices` are the model's.
    pub fn report(&self, vertices: &[Vertex]) -> PatchReport {
        let mut count_by_kind = [0; 3];
        let (mut rectangles, mut triangles, mut stretched, mut worst) = (0.0f64, 0.0f64, 0.0f64, 1.0f32);
        for patch in &self.patches {
            count_by_kind[patch.kind.triangle_count() - 1] += 1;
            let fit = Fit::new(patch.kind, &patch.vertices.map(|v| vertices[v as usize].position));
            rectangles += f64::from(fit.sides.element_product());
            triangles += f64::from(fit.area);
            stretched += f64::from(fit.stretched_area);
            worst = worst.max(fit.worst_stretch);
        }
        let share = |part: f64, whole: f64, otherwise: f32| {
            if whole > 0.0 { (part / whole) as f32 } else { otherwise }
        };
        PatchReport {
            count_by_kind,
            triangles_per_patch: share(self.patch_of_triangle.len() as f64, self.patches.len() as f64, 0.0),
            wasted_share: share(rectangles - triangles, rectangles, 0.0),
            mean_stretch: share(stretched, triangles, 1.0),
            worst_stretch: worst,
        }
    }
}
