//! Splits triangles with long edges, so that no patch needs a larger block than the atlas grants.
//!
//! The split of an edge depends only on its two end positions, and its middle only on its two ends, in any order. So both sides
//! of an edge split alike, even across a seam without shared vertices, and no T-junction can open a crack.

use super::influences::reduce_to_four;
use super::{Cancel, Cancelled, Model, Morph, MorphDelta, Primitive, Vertex};
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;

/// The longest edge that a patch may have, metres in the world: design section 5.
pub const MAX_EDGE_M: f32 = 0.5;

/// Splitting stops before a model would grow beyond this many indices.
pub(crate) const MAX_INDICES: usize = 12 << 20;

/// What splitting did.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SplitStats {
    /// Triangles before.
    pub triangles_before: usize,
    /// Triangles after.
    pub triangles_after: usize,
    /// False where the model would have grown too large, and longer edges are left.
    pub complete: bool,
}

/// Splits edges at their middle until none is longer than `max_edge_m` in mesh space (for an asset that is placed
/// with a scale, pass the limit divided by that scale). New vertices interpolate all attributes and morph targets;
/// influences are blended and reduced to the four largest. Primitives keep their order and materials.
pub fn split_long_edges(model: &mut Model, max_edge_m: f32) -> SplitStats {
    split_until(model, max_edge_m, &Cancel::default()).expect("nobody asks to end")
}

/// As [`split_long_edges`], until somebody asks to end: the model is then good for nothing.
pub(crate) fn split_until(
    model: &mut Model,
    max_edge_m: f32,
    cancel: &Cancel,
) -> Result<SplitStats, Cancelled> {
    assert!(max_edge_m > 0.0, "longest edge {max_edge_m} m");
    let triangles_before = model.indices.len() / 3;
    let mut splitter = Splitter {
        limit_squared: max_edge_m * max_edge_m,
        first_middle: model.vertices.len() as u32,
        vertices: &mut model.vertices,
        ends: Vec::new(),
    };
    let mut parts: Vec<Vec<u32>> =
        model.primitives.iter().map(|primitive| slice(&model.indices, primitive)).collect();
    // Each pass halves the long edges; a length that 64 halvings do not bring below the limit is not finite.
    let mut complete = false;
    for _ in 0..64 {
        cancel.check()?;
        let long = parts.iter().map(|part| splitter.count_long(part)).sum::<usize>();
        complete = long == 0;
        let total: usize = parts.iter().map(Vec::len).sum();
        if complete || total + 3 * long > MAX_INDICES {
            break;
        }
        // A middle is shared by primitives too, since they share vertices.
        let mut middles = HashMap::new();
        for part in &mut parts {
            *part = splitter.split_pass(part, &mut middles);
        }
    }
    let (first_middle, ends) = (splitter.first_middle, splitter.ends);
    model.morphs.iter_mut().for_each(|morph| add_middles(morph, first_middle, &ends));
    store(model, &parts);
    Ok(SplitStats { triangles_before, triangles_after: model.indices.len() / 3, complete })
}

fn slice(indices: &[u32], primitive: &Primitive) -> Vec<u32> {
    indices[primitive.first_index as usize..][..primitive.index_count as usize].to_vec()
}

fn store(model: &mut Model, parts: &[Vec<u32>]) {
    model.indices.clear();
    for (primitive, part) in model.primitives.iter_mut().zip(parts) {
        primitive.first_index = model.indices.len() as u32;
        primitive.index_count = part.len() as u32;
        model.indices.extend(part);
    }
}

/// The middle of an edge moves by the mean of its ends. Ends of later middles may be earlier ones.
fn add_middles(morph: &mut Morph, first_middle: u32, ends: &[[u32; 2]]) {
    let mut delta_of_vertex: HashMap<u32, usize> =
        morph.deltas.iter().enumerate().map(|(number, delta)| (delta.vertex, number)).collect();
    for (vertex, ends) in (first_middle..).zip(ends) {
        let moved = ends.map(|end| delta_of_vertex.get(&end).map(|number| morph.deltas[*number]));
        if moved == [None, None] {
            continue;
        }
        let still = MorphDelta { vertex, position: Vec3::ZERO, normal: Vec3::ZERO, tangent: Vec3::ZERO };
        let [a, b] = moved.map(|delta| delta.unwrap_or(still));
        delta_of_vertex.insert(vertex, morph.deltas.len());
        morph.deltas.push(MorphDelta {
            vertex,
            position: (a.position + b.position) * 0.5,
            normal: (a.normal + b.normal) * 0.5,
            tangent: (a.tangent + b.tangent) * 0.5,
        });
    }
}

struct Splitter<'a> {
    limit_squared: f32,
    /// Vertices from here on are middles.
    first_middle: u32,
    vertices: &'a mut Vec<Vertex>,
    /// Of each middle the ends of its edge.
    ends: Vec<[u32; 2]>,
}

impl Splitter<'_> {
    fn is_long(&self, a: u32, b: u32) -> bool {
        let (a, b) = (self.vertices[a as usize].position, self.vertices[b as usize].position);
        a.distance_squared(b) > self.limit_squared
    }

    fn marks(&self, [a, b, c]: [u32; 3]) -> [bool; 3] {
        [self.is_long(a, b), self.is_long(b, c), self.is_long(c, a)]
    }

    /// Long edges of all triangles: as many triangles are added by the next pass.
    fn count_long(&self, indices: &[u32]) -> usize {
        corners(indices).map(|triangle| self.marks(triangle).into_iter().filter(|long| *long).count()).sum()
    }

    fn split_pass(&mut self, indices: &[u32], middles: &mut HashMap<(u32, u32), u32>) -> Vec<u32> {
        let mut out = Vec::with_capacity(indices.len() * 2);
        for triangle in corners(indices) {
            let marks = self.marks(triangle);
            let mut middle = |edge: usize| {
                let (a, b) = (triangle[edge], triangle[(edge + 1) % 3]);
                marks[edge].then(|| self.middle(a, b, middles))
            };
            let mids = [middle(0), middle(1), middle(2)];
            self.emit(triangle, mids, &mut out);
        }
        out
    }

    /// The triangle's pieces, wound as it is.
    fn emit(&self, [a, b, c]: [u32; 3], mids: [Option<u32>; 3], out: &mut Vec<u32>) {
        match mids {
            [None, None, None] => out.extend([a, b, c]),
            [Some(ab), Some(bc), Some(ca)] => out.extend([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca]),
            [Some(ab), None, None] => out.extend([a, ab, c, ab, b, c]),
            [Some(ab), Some(bc), None] => {
                out.extend([ab, b, bc]);
                self.emit_quad([a, ab, bc, c], out);
            }
            // The remaining cases are turns of those above.
            [None, ..] => self.emit([b, c, a], [mids[1], mids[2], mids[0]], out),
            [Some(_), None, Some(_)] => self.emit([c, a, b], [mids[2], mids[0], mids[1]], out),
        }
    }

    /// Cuts along the shorter diagonal.
    fn emit_quad(&self, [a, b, c, d]: [u32; 4], out: &mut Vec<u32>) {
        let position = |vertex: u32| self.vertices[vertex as usize].position;
        if position(a).distance_squared(position(c)) <= position(b).distance_squared(position(d)) {
            out.extend([a, b, c, a, c, d]);
        } else {
            out.extend([a, b, d, b, c, d]);
        }
    }

    fn middle(&mut self, a: u32, b: u32, middles: &mut HashMap<(u32, u32), u32>) -> u32 {
        let (vertices, ends) = (&mut *self.vertices, &mut self.ends);
        *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
            ends.push([a, b]);
            vertices.push(halfway(&vertices[a as usize], &vertices[b as usize]));
            (vertices.len() - 1) as u32
        })
    }
}

fn corners(indices: &[u32]) -> impl Iterator<Item = [u32; 3]> {
    indices.chunks_exact(3).map(|triangle| [triangle[0], triangle[1], triangle[2]])
}

/// The vertex in the middle of an edge. Position and influences do not depend on the order of the ends, to the last
/// bit: sums of two floats commute.
fn halfway(a: &Vertex, b: &Vertex) -> Vertex {
    let normal = (a.normal + b.normal).try_normalize().unwrap_or(a.normal);
    let tangents = Vec3::from_slice(&a.tangent[..3]) + Vec3::from_slice(&b.tangent[..3]);
    let tangent = (tangents - normal * normal.dot(tangents)).try_normalize();
    let tangent = tangent.unwrap_or_else(|| normal.any_orthonormal_vector());
    let both = |vertex: &Vertex| vertex.joints.into_iter().zip(vertex.weights.map(|weight| weight * 0.5));
    // Weights of a vertex are not negative and sum to one, so that there is always something to keep.
    let (joints, weights) = reduce_to_four(both(a).chain(both(b))).unwrap_or((a.joints, a.weights));
    let middle = |a: [f32; 2], b: [f32; 2]| [(a[0] + b[0]) * 0.5, (a[1] + b[1]) * 0.5];
    Vertex {
        position: (a.position + b.position) * 0.5,
        normal,
        tangent: tangent.extend(a.tangent[3].min(b.tangent[3])).to_array(),
        uv: middle(a.uv, b.uv),
        uv1: middle(a.uv1, b.uv1),
        color: [0, 1, 2, 3].map(|c| u8::midpoint(a.color[c], b.color[c])),
        joints,
        weights,
    }
}

#[cfg(test)]
mod tests;
