//! From triangles to patches: possible groups, their costs, and the patches of the cheapest groups.

use super::matching::{Graph, Joined, NO_TWIN, others};
use super::quality::Fit;
use super::{Patch, PatchKind, Patches, Triangles};
use crate::{Cancel, Cancelled};
use glam::Vec3;
use std::collections::HashMap;

/// Triangles that bend more than this (cosine between face normals) stay apart: one rectangle cannot stand for them.
const MIN_NORMAL_COSINE: f32 = 0.6;
/// No triangle of a group may be longer than its picture by more than this, in any direction.
const MAX_STRETCH: f32 = 1.6;
/// Added to the sides of a group's rectangle, in units of the legs that a mean triangle has as half of a square: what a
/// block has beyond its picture. The larger it is, the fewer patches, and the more waste and stretch; see `docs/decisions.md`.
const OVERHEAD_UNITS: f32 = 1.0;
/// Cost of what has no finite one.
const WORST_COST: f32 = 1e12;

/// The triangles with what they are compared by.
pub(super) struct Grouping<'a> {
    source: Triangles<'a>,
    materials: Vec<u32>,
    normals: Vec<Vec3>,
    /// A length: costs are in squares of it.
    unit: f32,
}

impl<'a> Grouping<'a> {
    pub(super) fn new(source: Triangles<'a>) -> Self {
        let mut materials = vec![0; source.indices.len() / 3];
        for primitive in source.primitives {
            let first = primitive.first_index as usize / 3;
            materials[first..first + primitive.index_count as usize / 3].fill(primitive.material);
        }
        let mut this = Self { source, materials, normals: Vec::new(), unit: 1.0 };
        let crosses: Vec<Vec3> = (0..this.count()).map(|triangle| this.cross(triangle)).collect();
        let mean = crosses.iter().map(|cross| f64::from(cross.length())).sum::<f64>() / crosses.len() as f64;
        this.normals = crosses.into_iter().map(Vec3::normalize_or_zero).collect();
        let unit = mean.sqrt() as f32;
        this.unit = if unit.is_finite() && unit > 0.0 { unit } else { 1.0 };
        this
    }

    /// The patches of the cheapest groups that were found.
    pub(super) fn patches(&self, cancel: &Cancel) -> Result<Patches, Cancelled> {
        let graph = self.graph();
        let joined = graph.divide(cancel)?;
        Ok(self.collect(&graph, &joined))
    }

    fn count(&self) -> u32 {
        self.materials.len() as u32
    }

    fn corners(&self, triangle: u32) -> [u32; 3] {
        let first = 3 * triangle as usize;
        self.source.indices[first..first + 3].try_into().expect("three")
    }

    fn position(&self, vertex: u32) -> Vec3 {
        self.source.vertices[vertex as usize].position
    }

    fn cross(&self, triangle: u32) -> Vec3 {
        let [a, b, c] = self.corners(triangle).map(|vertex| self.position(vertex));
        (b - a).cross(c - a)
    }

    /// The ends of a side, as its triangle's winding has them, and the corner opposite.
    fn ends(&self, side: u32) -> [u32; 3] {
        let mut corners = self.corners(side / 3);
        corners.rotate_left(side as usize % 3);
        corners
    }

    /// By side the side of the triangle across, where the two may share a patch.
    fn twins(&self) -> Vec<u32> {
        let sides = self.source.indices.len() as u32;
        let mut owners: HashMap<(u32, u32), u32> = HashMap::with_capacity(sides as usize);
        for side in 0..sides {
            let [from, to, _] = self.ends(side);
            owners.entry((from, to)).or_insert(side);
        }
        let mut twins = vec![NO_TWIN; sides as usize];
        for (&(from, to), &side) in &owners {
            if let Some(&twin) = owners.get(&(to, from)).filter(|twin| self.fits(side, **twin)) {
                twins[side as usize] = twin;
            }
        }
        twins
    }

    /// Whether two triangles across a side are of one material and about one direction, and are not each other's backs.
    fn fits(&self, side: u32, twin: u32) -> bool {
        let (a, b) = (side as usize / 3, twin as usize / 3);
        a != b
            && self.materials[a] == self.materials[b]
            && self.normals[a].dot(self.normals[b]) >= MIN_NORMAL_COSINE
            && self.ends(side)[2] != self.ends(twin)[2]
    }

    fn graph(&self) -> Graph {
        let twins = self.twins();
        let alone = (0..self.count()).map(|triangle| self.alone(triangle).1).collect();
        let pair = |side: u32| {
            self.pair(&twins, side).map_or(f32::INFINITY, |group| self.cost(PatchKind::Two, group))
        };
        let strip = |side: u32| {
            self.strip(&twins, side).map_or(f32::INFINITY, |group| self.cost(PatchKind::Three, group))
        };
        let sides = 0..twins.len() as u32;
        let (pairs, strips) = (sides.clone().map(pair).collect(), sides.map(strip).collect());
        Graph { twins, alone, pairs, strips }
    }

    /// What a group costs; infinite where it must not be.
    fn cost(&self, kind: PatchKind, vertices: [u32; 5]) -> f32 {
        let fit = Fit::new(kind, &vertices.map(|vertex| self.position(vertex) / self.unit));
        if kind == PatchKind::Three && fit.worst_stretch > MAX_STRETCH {
            return f32::INFINITY;
        }
        // With so many texels more, stretch would do no harm.
        let sides = fit.sides * fit.stretch_squared.sqrt();
        let cost = (sides.x + OVERHEAD_UNITS) * (sides.y + OVERHEAD_UNITS);
        if cost < WORST_COST { cost } else { WORST_COST }
    }

    /// A triangle by itself, and what it costs. The rectangle's right angle, at (0, 0), is where that is cheapest.
    fn alone(&self, triangle: u32) -> ([u32; 5], f32) {
        let turned = |side: u32| {
            let [a, b, c] = self.ends(side);
            [a, b, c, a, a]
        };
        let ways = (3 * triangle..3 * triangle + 3).map(turned);
        let costs = ways.map(|vertices| (vertices, self.cost(PatchKind::One, vertices)));
        costs.min_by(|a, b| a.1.total_cmp(&b.1)).expect("three corners")
    }

    /// The two triangles at a side. It runs from x to y: they are (y, o, x) and (y, x, p).
    fn pair(&self, twins: &[u32], side: u32) -> Option<[u32; 5]> {
        let twin = Some(twins[side as usize]).filter(|twin| *twin != NO_TWIN)?;
        // Both sides are the same group, in the same order.
        let [x, y, o] = self.ends(side.min(twin));
        let [_, _, p] = self.ends(side.max(twin));
        Some([y, o, x, p, y])
    }

    /// A triangle (v4, v2, v3) between those across v3-v4 and v4-v2; the side is that from v2 to v3.
    fn strip(&self, twins: &[u32], side: u32) -> Option<[u32; 5]> {
        let [v2, v3, v4] = self.ends(side);
        let [left, right] = others(side).map(|side| twins[side as usize]);
        if left == NO_TWIN || right == NO_TWIN || left / 3 == right / 3 {
            return None;
        }
        let (v0, v1) = (self.ends(left)[2], self.ends(right)[2]);
        (v0 != v1).then_some([v0, v1, v2, v3, v4])
    }

    /// Numbers all groups by their first triangle.
    fn collect(&self, graph: &Graph, joined: &Joined) -> Patches {
        let count = self.count();
        let mut result = Patches { patches: Vec::new(), patch_of_triangle: vec![u32::MAX; count as usize] };
        for triangle in 0..count {
            if result.patch_of_triangle[triangle as usize] != u32::MAX {
                continue;
            }
            let number = result.patches.len() as u32;
            let (members, vertices) = self.group(graph, joined, triangle);
            let kind = PatchKind::ALL[members.len() - 1];
            members.iter().for_each(|member| result.patch_of_triangle[*member as usize] = number);
            let material = self.materials[triangle as usize];
            let double_sided = self.source.materials.get(material as usize).is_some_and(|m| m.double_sided);
            result.patches.push(Patch { vertices, kind, material, double_sided });
        }
        result
    }

    /// The group of a triangle: its triangles, and its vertices in the order of their kind.
    fn group(&self, graph: &Graph, joined: &Joined, triangle: u32) -> (Vec<u32>, [u32; 5]) {
        let joined_sides = |triangle: u32| {
            (3 * triangle..3 * triangle + 3).filter(|side| joined[*side as usize]).collect::<Vec<u32>>()
        };
        let across = |side: u32| graph.twins[side as usize] / 3;
        let mine = joined_sides(triangle);
        let Some(side) = mine.first() else { return (vec![triangle], self.alone(triangle).0) };
        let other = across(*side);
        let middle = [triangle, other].into_iter().find(|member| joined_sides(*member).len() == 2);
        let Some(middle) = middle else {
            return (vec![triangle, other], self.pair(&graph.twins, *side).expect("joined"));
        };
        let mut members: Vec<u32> = joined_sides(middle).into_iter().map(across).collect();
        members.push(middle);
        let omitted =
            (3 * middle..3 * middle + 3).find(|side| !joined[*side as usize]).expect("one of three");
        (members, self.strip(&graph.twins, omitted).expect("joined"))
    }
}
