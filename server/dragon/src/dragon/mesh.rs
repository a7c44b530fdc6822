//! Triangles with what the importer and the texture painter need to know of each vertex.

use super::loft::Loft;
use super::weights::Weights;
use glam::{Vec2, Vec3, Vec4};
use std::collections::HashMap;
use std::f32::consts::TAU;

/// What a surface is made of; decides how the painter colours it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Skin {
    /// Scales. `paint` is how ventral it is (0 back, 1 belly), length along the part (m), grain (0 body, 1 head),
    /// how much it is the inside of the mouth (0..1).
    Hide,
    /// Wing and ear skin. `paint` is distance to the nearest finger bone (m), 0 root to 1 rim, 1 on the upper side.
    Membrane,
    /// Horns, claws, spikes, teeth. `paint` is 0 base to 1 tip, darkness of the base.
    Horn,
    /// The eyes. `paint` is the angle from the line of sight (radians), sideways part of it, upright part of it.
    Eye,
}

#[derive(Clone, Debug)]
pub(super) struct Vertex {
    /// Model space, metres.
    pub position: Vec3,
    /// Unit length, outwards.
    pub normal: Vec3,
    /// As glTF stores it: w times cross(normal, xyz) points up in the texture picture.
    pub tangent: Vec4,
    /// Texels of the dragon's texture, down.
    pub texel: Vec2,
    /// See [`Skin`].
    pub paint: Vec4,
    pub skin: Skin,
    pub weights: Weights,
    /// 0 hidden from the sky, 1 open.
    pub openness: f32,
}

impl Vertex {
    pub fn new(position: Vec3, texel: Vec2, skin: Skin, paint: Vec4) -> Self {
        let weights = Weights::default();
        Self { position, normal: Vec3::Y, tangent: Vec4::X, texel, paint, skin, weights, openness: 1.0 }
    }
}

#[derive(Clone, Debug, Default)]
pub(super) struct Mesh {
    pub vertices: Vec<Vertex>,
    /// Counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    pub fn append(&mut self, other: Self) {
        let first = self.vertices.len() as u32;
        self.vertices.extend(other.vertices);
        self.triangles.extend(other.triangles.iter().map(|t| t.map(|index| index + first)));
    }

    /// The same on the other side of the body, for the joints that `mirror_joint` gives.
    pub fn mirrored(&self, mirror_joint: &dyn Fn(usize) -> usize) -> Self {
        let mut mesh = self.clone();
        for vertex in &mut mesh.vertices {
            vertex.position.x = -vertex.position.x;
            vertex.normal.x = -vertex.normal.x;
            vertex.weights = vertex.weights.mapped(mirror_joint);
        }
        mesh.triangles.iter_mut().for_each(|triangle| triangle.swap(1, 2));
        mesh
    }

    pub fn set_weights(&mut self, weights: impl Fn(Vec3) -> Weights) {
        for vertex in &mut self.vertices {
            vertex.weights = weights(vertex.position);
        }
    }

    /// Smooth normals, weighted by angle. Vertices at one place share theirs, so that texture seams do not show.
    pub fn smooth_normals(&mut self) {
        let mut sums: HashMap<[i32; 3], Vec3> = HashMap::new();
        for triangle in &self.triangles {
            let p = triangle.map(|index| self.vertices[index as usize].position);
            let normal = (p[1] - p[0]).cross(p[2] - p[0]).normalize_or_zero();
            for corner in 0..3 {
                let (here, next, last) = (p[corner], p[(corner + 1) % 3], p[(corner + 2) % 3]);
                let angle = (next - here).angle_between(last - here);
                if angle.is_finite() {
                    *sums.entry(place(here)).or_default() += normal * angle;
                }
            }
        }
        for vertex in &mut self.vertices {
            let sum = sums.get(&place(vertex.position)).copied().unwrap_or(Vec3::Y);
            vertex.normal = sum.try_normalize().unwrap_or(Vec3::Y);
        }
    }

    /// Tangents along the texture's u, orthogonal to the normals.
    pub fn tangents(&mut self) {
        let mut sums = vec![(Vec3::ZERO, Vec3::ZERO); self.vertices.len()];
        for triangle in &self.triangles {
            let [a, b, c] = triangle.map(|index| &self.vertices[index as usize]);
            let (e1, e2) = (b.position - a.position, c.position - a.position);
            let (d1, d2) = (b.texel - a.texel, c.texel - a.texel);
            let area = d1.perp_dot(d2);
            if area.abs() < 1e-6 {
                continue;
            }
            let along_u = (e1 * d2.y - e2 * d1.y) / area;
            let along_v = (e2 * d1.x - e1 * d2.x) / area;
            for &index in triangle {
                sums[index as usize].0 += along_u * area.abs();
                sums[index as usize].1 += along_v * area.abs();
            }
        }
        for (vertex, (along_u, along_v)) in self.vertices.iter_mut().zip(sums) {
            let flat = along_u - vertex.normal * vertex.normal.dot(along_u);
            let tangent = flat.try_normalize().unwrap_or_else(|| vertex.normal.any_orthonormal_vector());
            // Texels count downwards: up in the picture is against v.
            let up = vertex.normal.cross(tangent).dot(-along_v);
            vertex.tangent = tangent.extend(if up < 0.0 { -1.0 } else { 1.0 });
        }
    }

    /// Moves vertices along their normals by the sum of some round bumps (or dents), then renews the normals.
    pub fn sculpt(&mut self, bumps: &[Bump]) {
        self.smooth_normals();
        for vertex in &mut self.vertices {
            let height = |bump: &Bump| {
                let relative = (vertex.position - bump.centre) / bump.radius_m;
                bump.height_m * (-relative.length_squared()).exp()
            };
            vertex.position += vertex.normal * bumps.iter().map(height).sum::<f32>();
        }
        self.smooth_normals();
    }

    /// Drops the triangles that satisfy `hidden`, and the vertices that no triangle is left of.
    pub fn drop_triangles(&mut self, hidden: impl Fn([&Vertex; 3]) -> bool) {
        let vertices = &self.vertices;
        self.triangles.retain(|triangle| !hidden(triangle.map(|index| &vertices[index as usize])));
        let mut new_index = vec![u32::MAX; self.vertices.len()];
        let mut kept = Vec::new();
        for index in self.triangles.iter_mut().flatten() {
            let slot = &mut new_index[*index as usize];
            if *slot == u32::MAX {
                *slot = kept.len() as u32;
                kept.push(self.vertices[*index as usize].clone());
            }
            *index = *slot;
        }
        self.vertices = kept;
    }
}

/// A Gaussian displacement, see [`Mesh::sculpt`].
#[derive(Clone, Copy, Debug)]
pub(super) struct Bump {
    pub centre: Vec3,
    pub radius_m: Vec3,
    pub height_m: f32,
}

/// Places closer than a hundredth of a millimetre are one.
fn place(position: Vec3) -> [i32; 3] {
    (position * 1e5).round().as_ivec3().to_array()
}

/// Rows of vertices, from one side of a surface to the other, to be joined by triangles.
///
/// Rows may differ in length: each vertex carries its place (0..=1) in the row, and neighbours in place are joined.
/// Rows go along one tangent and places along another such that their cross product points outwards.
#[derive(Debug, Default)]
pub(super) struct Rows {
    mesh: Mesh,
    rows: Vec<Vec<(f32, u32)>>,
}

impl Rows {
    pub fn push(&mut self, row: impl IntoIterator<Item = (f32, Vertex)>) {
        let first = self.mesh.vertices.len() as u32;
        let (places, vertices): (Vec<f32>, Vec<Vertex>) = row.into_iter().unzip();
        self.mesh.vertices.extend(vertices);
        self.rows.push(places.into_iter().zip(first..).collect());
    }

    pub fn into_mesh(mut self) -> Mesh {
        for (parity, pair) in self.rows.windows(2).enumerate() {
            stitch(&pair[0], &pair[1], parity % 2 == 0, &mut self.mesh.triangles);
        }
        let vertices = &self.mesh.vertices;
        self.mesh.triangles.retain(|triangle| {
            let [a, b, c] = triangle.map(|index| vertices[index as usize].position);
            (b - a).cross(c - a).length() > 1e-9
        });
        self.mesh
    }
}

fn stitch(a: &[(f32, u32)], b: &[(f32, u32)], a_first: bool, triangles: &mut Vec<[u32; 3]>) {
    const SAME: f32 = 1e-4;
    let (mut i, mut j) = (0, 0);
    while i + 1 < a.len() || j + 1 < b.len() {
        let next_a = a.get(i + 1).map_or(f32::INFINITY, |next| next.0);
        let next_b = b.get(j + 1).map_or(f32::INFINITY, |next| next.0);
        let take_a = if (next_a - next_b).abs() < SAME { a_first } else { next_a < next_b };
        if take_a {
            triangles.push([a[i].1, b[j].1, a[i + 1].1]);
            i += 1;
        } else {
            triangles.push([a[i].1, b[j].1, b[j + 1].1]);
            j += 1;
        }
    }
}

/// Where a part lies in the texture: the left end of its centre line, and its scale.
#[derive(Clone, Copy, Debug)]
pub(super) struct Island {
    pub origin: Vec2,
    pub texels_per_m: f32,
}

/// How to cut a loft into triangles.
pub(super) struct Tube<'a> {
    pub loft: &'a Loft,
    /// Lengths along the curve, metres.
    pub from_m: f32,
    pub to_m: f32,
    /// Wanted edge length at a length along the curve, metres.
    pub edge_m: &'a dyn Fn(f32) -> f32,
    /// Whether the surface is closed at each end.
    pub caps: [bool; 2],
    pub island: Island,
    pub skin: Skin,
    /// Paint for a length along the curve (m) and an angle from the top (radians, -pi..pi).
    pub paint: &'a dyn Fn(f32, f32) -> Vec4,
}

impl Tube<'_> {
    pub fn mesh(&self) -> Mesh {
        let mut rows = Rows::default();
        let stops = self.stops_m();
        if self.caps[0] {
            rows.push([self.pole(self.from_m)]);
        }
        let mut count = 0;
        for (i, &s_m) in stops.iter().enumerate() {
            // End rings do not look at their neighbours, so that a tube that goes on from here has the same ring.
            let is_end = i == 0 || i + 1 == stops.len();
            count = self.rim_count(s_m, if is_end { 0 } else { count });
            rows.push(self.ring(s_m, count));
        }
        if self.caps[1] {
            rows.push([self.pole(self.to_m)]);
        }
        rows.into_mesh()
    }

    /// Ring positions: the wanted edge apart, closer where the tube is thin.
    fn stops_m(&self) -> Vec<f32> {
        let spacing = |s_m: f32| {
            let section = self.loft.section(s_m);
            let edge_m = (self.edge_m)(s_m);
            edge_m.min(1.5 * section.half_width.max(section.top)).max(0.65 * edge_m)
        };
        let mut stops = vec![self.from_m];
        let mut s_m = self.from_m;
        while s_m < self.to_m {
            s_m += spacing(s_m);
            stops.push(s_m);
        }
        // The last step overshoots: shrink all of them a little instead of leaving one short ring.
        let shrink = (self.to_m - self.from_m) / (s_m - self.from_m);
        stops.iter().map(|stop| self.from_m + (stop - self.from_m) * shrink).collect()
    }

    /// An even number of vertices, changed only when the wanted number moves away from the previous ring's.
    fn rim_count(&self, s_m: f32, previous: usize) -> usize {
        let wanted = self.loft.section(s_m).rim_length() / (self.edge_m)(s_m);
        if previous > 0 && (wanted - previous as f32).abs() < 2.5 {
            return previous;
        }
        (2 * (0.5 * wanted).round() as usize).clamp(6, 96)
    }

    /// From the underside over the far side and the top back to the underside, where the seam is.
    fn ring(&self, s_m: f32, count: usize) -> Vec<(f32, Vertex)> {
        let section = self.loft.section(s_m);
        let at = |i: usize| {
            let turn = i as f32 / count as f32;
            let angle = TAU * (turn - 0.5);
            // The seam's two vertices must be at exactly one place.
            let place = if i == count { section.rim(-0.5 * TAU) } else { section.rim(angle) };
            (turn, self.vertex(place, s_m, turn, angle))
        };
        (0..=count).map(at).collect()
    }

    fn pole(&self, s_m: f32) -> (f32, Vertex) {
        (0.5, self.vertex(self.loft.section(s_m).centre, s_m, 0.5, 0.0))
    }

    fn vertex(&self, place: Vec3, s_m: f32, turn: f32, angle: f32) -> Vertex {
        let across = (turn - 0.5) * self.loft.section(s_m).rim_length();
        let texel = self.island.origin + Vec2::new(s_m - self.from_m, across) * self.island.texels_per_m;
        Vertex::new(place, texel, self.skin, (self.paint)(s_m, angle))
    }
}
