//! A primitive under construction: its vertices, its triangles, and every morph target's offset of every vertex. They stay in
//! step while corners are separated and equal vertices merged.
//!
//! Missing attributes follow glTF 2.0 section 3.7.2.2. Without base normals, normals are flat in the base and in every target.
//! Without base tangents, they are generated for the base and for every target. The targets' own normals or tangents are then
//! ignored. A target without its own normals (tangents) keeps the base's.

use super::super::{MorphDelta, TextureSlot, Vertex, tangent, weld};
use glam::Vec3;
use std::collections::HashMap;

/// What a morph target adds to one vertex.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Delta {
    pub(super) position: Vec3,
    pub(super) normal: Vec3,
    pub(super) tangent: Vec3,
}

impl Delta {
    /// With -0 as 0.
    fn bits(&self) -> [u32; 9] {
        let numbers = [self.position, self.normal, self.tangent].map(|v| (v + Vec3::ZERO).to_array());
        std::array::from_fn(|at| numbers[at / 3][at % 3].to_bits())
    }
}

/// Vertices and triangles with their morph targets.
pub(super) struct Shape {
    pub(super) vertices: Vec<Vertex>,
    pub(super) indices: Vec<u32>,
    /// Each as long as `vertices`.
    pub(super) targets: Vec<Vec<Delta>>,
}

impl Shape {
    /// Gives each triangle corner a vertex of its own.
    pub(super) fn separate_corners(&mut self) {
        self.vertices = self.indices.iter().map(|index| self.vertices[*index as usize]).collect();
        for target in &mut self.targets {
            *target = self.indices.iter().map(|index| target[*index as usize]).collect();
        }
        self.indices = (0..self.vertices.len() as u32).collect();
    }

    /// For separate corners: the triangle's normal, in the base and in every target.
    pub(super) fn make_flat_normals(&mut self) {
        flat_normals(&mut self.vertices);
        for at in 0..self.targets.len() {
            let mut moved = self.moved(at);
            flat_normals(&mut moved);
            for ((delta, moved), base) in self.targets[at].iter_mut().zip(moved).zip(&self.vertices) {
                delta.normal = moved.normal - base.normal;
            }
        }
    }

    /// For separate corners: tangents for a normal map, in the base and in every target. False where a simpler method
    /// had to be used.
    pub(super) fn generate_tangents(&mut self, normal_map: &TextureSlot) -> bool {
        let exact = tangent::generate(&mut self.vertices, normal_map);
        for at in 0..self.targets.len() {
            let mut moved = self.moved(at);
            tangent::generate(&mut moved, normal_map);
            for ((delta, moved), base) in self.targets[at].iter_mut().zip(moved).zip(&self.vertices) {
                delta.tangent = tangent_change(base, &moved);
            }
        }
        exact
    }

    /// The vertices with target `at` added once.
    fn moved(&self, at: usize) -> Vec<Vertex> {
        let add = |(vertex, delta): (&Vertex, &Delta)| Vertex {
            position: vertex.position + delta.position,
            normal: tangent::unit(vertex.normal + delta.normal).unwrap_or(vertex.normal),
            ..*vertex
        };
        self.vertices.iter().zip(&self.targets[at]).map(add).collect()
    }

    /// Merges vertices that are equal in everything, morph targets included.
    pub(super) fn weld(&mut self) {
        let classes = self.delta_classes();
        let class = |vertex: u32| classes.get(vertex as usize).copied().unwrap_or(0);
        let origins = weld::weld_within_classes(&mut self.vertices, &mut self.indices, class);
        for target in &mut self.targets {
            *target = origins.iter().map(|origin| target[*origin as usize]).collect();
        }
    }

    /// By vertex: equal where all deltas are. Empty without targets.
    fn delta_classes(&self) -> Vec<u32> {
        if self.targets.is_empty() {
            return Vec::new();
        }
        let mut known: HashMap<Vec<[u32; 9]>, u32> = HashMap::new();
        let class = |vertex: usize| {
            let deltas = self.targets.iter().map(|target| target[vertex].bits()).collect();
            let next = known.len() as u32;
            *known.entry(deltas).or_insert(next)
        };
        (0..self.vertices.len()).map(class).collect()
    }

    /// By target: the vertices that it moves, ascending.
    pub(super) fn morph_deltas(&self) -> Vec<Vec<MorphDelta>> {
        let moving = |(vertex, delta): (usize, &Delta)| {
            let Delta { position, normal, tangent } = *delta;
            let moves = *delta != Delta::default();
            moves.then_some(MorphDelta { vertex: vertex as u32, position, normal, tangent })
        };
        self.targets.iter().map(|target| target.iter().enumerate().filter_map(moving).collect()).collect()
    }
}

/// Nothing where the bitangent's sign changes, which a sum cannot express.
fn tangent_change(base: &Vertex, moved: &Vertex) -> Vec3 {
    if base.tangent[3] != moved.tangent[3] {
        return Vec3::ZERO;
    }
    Vec3::from_slice(&moved.tangent[..3]) - Vec3::from_slice(&base.tangent[..3])
}

/// For separate corners: the triangle's normal; up where the triangle has no area.
fn flat_normals(corners: &mut [Vertex]) {
    for triangle in corners.chunks_exact_mut(3) {
        let normal = triangle_normal([0, 1, 2].map(|i| triangle[i].position));
        triangle.iter_mut().for_each(|corner| corner.normal = normal);
    }
}

/// Up where the triangle has no area.
pub(super) fn triangle_normal([a, b, c]: [Vec3; 3]) -> Vec3 {
    let (ab, ac) = (tangent::unit(b - a), tangent::unit(c - a));
    ab.zip(ac).and_then(|(ab, ac)| tangent::unit(ab.cross(ac))).unwrap_or(Vec3::Y)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn corner(x: f32, y: f32) -> Vertex {
        Vertex { position: Vec3::new(x, y, 0.0), ..Vertex::default() }
    }

    /// Two triangles of a square that share their diagonal by equal vertices; one target.
    fn square(target: Vec<Delta>) -> Shape {
        let at = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 0.0), (1.0, 1.0), (0.0, 1.0)];
        let vertices = at.map(|(x, y)| corner(x, y)).to_vec();
        Shape { vertices, indices: (0..6).collect(), targets: vec![target] }
    }

    fn lift(z: f32) -> Delta {
        Delta { position: Vec3::new(0.0, 0.0, z), ..Delta::default() }
    }

    #[test]
    fn vertices_whose_deltas_differ_are_not_merged() {
        let still = Delta::default();
        let mut same = square(vec![still; 6]);
        same.weld();
        assert_eq!((same.vertices.len(), same.targets[0].len()), (4, 4));
        let mut torn = square(vec![lift(1.0), still, lift(2.0), still, lift(2.0), still]);
        torn.weld();
        assert_eq!((torn.vertices.len(), torn.targets[0].len()), (5, 5));
        let lifted: Vec<(u32, f32)> =
            torn.morph_deltas()[0].iter().map(|delta| (delta.vertex, delta.position.z)).collect();
        assert_eq!(lifted, [(0, 1.0), (2, 2.0)]);
    }

    #[test]
    fn flat_normals_of_a_target_are_those_of_the_moved_triangle() {
        let mut shape = square(vec![lift(0.0), lift(0.0), lift(1.0), lift(0.0), lift(1.0), lift(1.0)]);
        shape.make_flat_normals();
        // Points (0, 0, 0), (1, 1, 1), (0, 1, 1) span a plane that rises with y.
        let risen = shape.vertices[3].normal + shape.targets[0][3].normal;
        assert!(risen.abs_diff_eq(Vec3::new(0.0, -1.0, 1.0).normalize(), 1e-6), "{risen}");
    }

    #[test]
    fn tangents_of_a_target_follow_the_moved_texture() {
        let mut shape = square(vec![Delta::default(); 6]);
        for (vertex, delta) in shape.vertices.iter_mut().zip(&mut shape.targets[0]) {
            vertex.uv = [vertex.position.x, 1.0 - vertex.position.y];
            // Folds the square up around the y axis: x becomes z.
            delta.position = Vec3::new(-vertex.position.x, 0.0, vertex.position.x);
            delta.normal = Vec3::new(-1.0, 0.0, -1.0);
        }
        assert!(shape.generate_tangents(&0.into()));
        for (vertex, delta) in shape.vertices.iter().zip(&shape.targets[0]) {
            let moved = Vec3::from_slice(&vertex.tangent[..3]) + delta.tangent;
            assert!(moved.abs_diff_eq(Vec3::Z, 1e-5), "{moved}");
        }
    }
}
