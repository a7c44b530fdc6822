//! Tangents for files without them: MikkTSpace for normal-mapped primitives, as glTF requires; any unit vector in the surface
//! for the others, whose shading never reads it.

use super::{TextureSlot, Vertex};
use glam::{Vec2, Vec3};
use std::collections::HashMap;

/// MikkTSpace visits the triangles around a vertex by recursion; more than this at one place could exhaust the stack.
const MAX_FAN: usize = 2000;

/// A unit vector perpendicular to the normal, with positive bitangent sign.
pub(crate) fn arbitrary(normal: Vec3) -> [f32; 4] {
    normal.any_orthonormal_vector().extend(1.0).to_array()
}

/// Writes tangents for a list of separate triangles (three vertices each), along the texture coordinates as the
/// normal map's slot makes them. False where a vertex belongs to so many triangles that a simpler method, without
/// MikkTSpace's exact compatibility, had to be used.
pub(crate) fn generate(corners: &mut [Vertex], normal_map: &TextureSlot) -> bool {
    if largest_fan(corners) > MAX_FAN {
        generate_simple(corners, normal_map);
        return false;
    }
    // Infallible: its error type has no values.
    let _ = bevy_mikktspace::generate_tangents(&mut Triangles { corners, normal_map });
    true
}

fn largest_fan(corners: &[Vertex]) -> usize {
    let mut counts: HashMap<[u32; 3], usize> = HashMap::new();
    for corner in corners {
        *counts.entry(position_bits(corner.position)).or_default() += 1;
    }
    counts.into_values().max().unwrap_or(0)
}

/// Equal for equal positions; adding zero makes -0 into 0.
fn position_bits(position: Vec3) -> [u32; 3] {
    (position + Vec3::ZERO).to_array().map(f32::to_bits)
}

struct Triangles<'a> {
    corners: &'a mut [Vertex],
    normal_map: &'a TextureSlot,
}

impl bevy_mikktspace::Geometry for Triangles<'_> {
    fn num_faces(&self) -> usize {
        self.corners.len() / 3
    }

    fn num_vertices_of_face(&self, _face: usize) -> usize {
        3
    }

    fn position(&self, face: usize, vert: usize) -> [f32; 3] {
        self.corners[face * 3 + vert].position.to_array()
    }

    fn normal(&self, face: usize, vert: usize) -> [f32; 3] {
        self.corners[face * 3 + vert].normal.to_array()
    }

    fn tex_coord(&self, face: usize, vert: usize) -> [f32; 2] {
        // MikkTSpace counts v upwards; glTF's runs downwards.
        let [u, v] = self.normal_map.coordinates(&self.corners[face * 3 + vert]);
        [u, 1.0 - v]
    }

    fn set_tangent(&mut self, space: Option<bevy_mikktspace::TangentSpace>, face: usize, vert: usize) {
        let vertex = &mut self.corners[face * 3 + vert];
        let [x, y, z, sign] = space.map_or_else(|| arbitrary(vertex.normal), |space| space.tangent_encoded());
        vertex.tangent = orthonormal(Vec3::new(x, y, z), sign, vertex.normal);
    }
}

/// A vector made unit length, however short: one whose squared length is too small for full precision is scaled up
/// first. `None` for zero.
pub(crate) fn unit(vector: Vec3) -> Option<Vec3> {
    (vector / vector.abs().max_element()).try_normalize()
}

/// The direction made unit length and perpendicular to the normal, or an arbitrary one where that is impossible.
pub(crate) fn orthonormal(direction: Vec3, sign: f32, normal: Vec3) -> [f32; 4] {
    let sign = if sign < 0.0 { -1.0 } else { 1.0 };
    match unit(direction - normal * normal.dot(direction)) {
        Some(unit) => unit.extend(sign).to_array(),
        None => arbitrary(normal),
    }
}

/// Direction in which u grows, from each triangle alone.
fn generate_simple(corners: &mut [Vertex], normal_map: &TextureSlot) {
    for triangle in corners.chunks_exact_mut(3) {
        let [p0, p1, p2] = [0, 1, 2].map(|i| triangle[i].position);
        let [w0, w1, w2] = [0, 1, 2].map(|i| Vec2::from_array(normal_map.coordinates(&triangle[i])));
        let (e1, e2, d1, d2) = (p1 - p0, p2 - p0, w1 - w0, w2 - w0);
        let area = d1.perp_dot(d2);
        let along_u = (e1 * d2.y - e2 * d1.y) * area.signum();
        // v runs downwards, so that a positive area in (u, v) is a mirrored one in glTF's tangent space.
        let sign = -area.signum();
        for corner in triangle {
            corner.tangent = orthonormal(along_u, sign, corner.normal);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn corner(position: [f32; 3], uv: [f32; 2]) -> Vertex {
        Vertex { position: Vec3::from_array(position), tangent: [0.0; 4], uv, ..Vertex::default() }
    }

    /// A square in the xy plane with u to the right and v down, as a picture lies in glTF.
    fn picture() -> Vec<Vertex> {
        let at = |x: f32, y: f32| corner([x, y, 0.0], [x, 1.0 - y]);
        vec![at(0.0, 0.0), at(1.0, 0.0), at(1.0, 1.0), at(0.0, 0.0), at(1.0, 1.0), at(0.0, 1.0)]
    }

    #[track_caller]
    fn assert_tangents(corners: &[Vertex], expected: [f32; 4]) {
        for corner in corners {
            for (found, wanted) in corner.tangent.iter().zip(expected) {
                assert!((found - wanted).abs() < 1e-5, "{:?} instead of {expected:?}", corner.tangent);
            }
        }
    }

    #[test]
    fn tangent_points_along_u_and_bitangent_up_the_picture() {
        // glTF: bitangent = cross(normal, tangent) * w; a normal map's green points up the picture: +y here.
        let mut corners = picture();
        assert!(generate(&mut corners, &0.into()));
        assert_tangents(&corners, [1.0, 0.0, 0.0, 1.0]);
    }

    #[test]
    fn mirrored_picture_has_a_negative_sign() {
        let mut corners = picture();
        corners.iter_mut().for_each(|corner| corner.uv[0] = 1.0 - corner.uv[0]);
        generate(&mut corners, &0.into());
        assert_tangents(&corners, [-1.0, 0.0, 0.0, -1.0]);
    }

    #[test]
    fn tangent_follows_the_transform_and_the_set_of_the_normal_map() {
        let turned = TextureSlot { texture: 0, set: 1, uv_transform: [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.5]] };
        let mut corners = picture();
        corners.iter_mut().for_each(|corner| (corner.uv1, corner.uv) = (corner.uv, [0.0; 2]));
        generate(&mut corners, &turned);
        // u' is v, which grows down the picture.
        assert_tangents(&corners, [0.0, -1.0, 0.0, 1.0]);
    }

    #[test]
    fn vectors_of_any_length_become_unit_and_zero_does_not() {
        for length in [1e-42, 3e-23, 1e-20, 1.0, 1e30] {
            let found = unit(Vec3::new(3.0, 0.0, -4.0) * length).expect("not zero");
            // 1e-42 itself has only a few bits.
            assert!((found.length() - 1.0).abs() < 1e-6 && found.x > 0.59 && found.z < -0.79, "{found}");
        }
        assert_eq!(unit(Vec3::ZERO), None);
    }

    #[test]
    fn simple_method_agrees_on_flat_pictures() {
        for mirrored in [false, true] {
            let mut corners = picture();
            if mirrored {
                corners.iter_mut().for_each(|corner| corner.uv[0] = 1.0 - corner.uv[0]);
            }
            let mut simple = corners.clone();
            generate(&mut corners, &0.into());
            generate_simple(&mut simple, &0.into());
            assert_tangents(&simple, corners[0].tangent);
        }
    }

    #[test]
    fn a_huge_fan_does_not_overflow_the_stack() {
        let mut corners = Vec::new();
        let rim = |i: usize| {
            let angle = i as f32 * 1e-4;
            corner([angle.cos(), angle.sin(), 0.0], [angle.cos(), angle.sin()])
        };
        for i in 0..60_000 {
            corners.extend([corner([0.0; 3], [0.0; 2]), rim(i), rim(i + 1)]);
        }
        assert!(!generate(&mut corners, &0.into()));
        assert!(corners.iter().all(|c| (Vec3::from_slice(&c.tangent[..3]).length() - 1.0).abs() < 1e-3));
    }

    #[test]
    fn degenerate_coordinates_give_unit_tangents() {
        let mut corners = picture();
        corners.iter_mut().for_each(|corner| corner.uv = [0.5, 0.5]);
        generate(&mut corners, &0.into());
        for corner in &corners {
            let tangent = Vec3::from_slice(&corner.tangent[..3]);
            assert!((tangent.length() - 1.0).abs() < 1e-5 && tangent.dot(Vec3::Z).abs() < 1e-5);
        }
    }
}
