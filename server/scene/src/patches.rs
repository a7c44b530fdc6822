//! Patches: groups of 1 to 3 adjacent triangles of one material, each mapped to a rectangle of the atlas.
//!
//! Built once per model and level of detail, greedily, cheapest group first; the cost of a group is the area of its rectangle over the
//! area of its triangles (waste), so that a single triangle costs at least 2 and a square quad costs 1.

use crate::{Material, Model, Primitive, Vertex};
use glam::Vec3;
use serde::{Deserialize, Serialize};
use shadecast_protocol::atlas::PatchKind;
use std::borrow::Cow;
use std::collections::HashMap;

/// Groups that bend more than this (cosine between face normals) stay apart: one rectangle cannot stand for them.
const MIN_NORMAL_COSINE: f32 = 0.6;
/// A pair is worth it while it wastes less than its two triangles would alone.
const MAX_PAIR_COST: f32 = 2.0;
/// A third triangle joins while the strip wastes less than this.
const MAX_STRIP_COST: f32 = 1.8;

/// One patch of a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Patch {
    /// Indices into the model's vertices; entries that the kind does not use repeat the first.
    pub vertices: [u32; 5],
    /// Number and arrangement of triangles.
    pub kind: PatchKind,
    /// Index into the model's materials.
    pub material: u32,
    /// Seen from behind too, as its material says.
    pub double_sided: bool,
}

impl Patch {
    /// Triangles that are drawn for it: those of two sides twice.
    pub fn drawn_triangles(&self) -> u32 {
        self.kind.triangle_count() as u32 * if self.double_sided { 2 } else { 1 }
    }
}

/// All patches of one level of detail of a model.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Patches {
    /// In the order of their first triangle.
    #[serde(with = "rows")]
    pub patches: Vec<Patch>,
    /// For each triangle of the level's index list the patch that holds it.
    #[serde(with = "crate::bulk")]
    pub patch_of_triangle: Vec<u32>,
}

/// What patches are built of: the triangles of one level of detail.
#[derive(Clone, Copy, Debug)]
pub struct Triangles<'a> {
    /// The model's.
    pub vertices: &'a [Vertex],
    /// Three per triangle, all in range.
    pub indices: &'a [u32],
    /// Ranges of `indices`.
    pub primitives: &'a [Primitive],
    /// The model's.
    pub materials: &'a [Material],
}

/// How well patches turned out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PatchReport {
    /// Patches with 1, 2 and 3 triangles.
    pub count_by_kind: [usize; 3],
    /// Rectangle area over triangle area, weighted by area; 1 is perfect.
    pub mean_waste: f32,
    /// Longest over shortest of a patch's opposite sides, the mean of both pairs, weighted by area; 1 is perfect. Patches
    /// of one triangle have no opposite sides and count as 1.
    pub mean_stretch: f32,
}

/// Patches as rows of words, for [`crate::bulk`].
mod rows {
    use super::{Patch, PatchKind};
    use crate::bulk;
    use serde::de::{Deserializer, Error};
    use serde::ser::Serializer;

    pub fn serialize<S: Serializer>(patches: &[Patch], serializer: S) -> Result<S::Ok, S::Error> {
        let row = |p: &Patch| {
            let [a, b, c, d, e] = p.vertices;
            [a, b, c, d, e, p.kind as u32, p.material, u32::from(p.double_sided)]
        };
        bulk::serialize(&patches.iter().map(row).collect::<Vec<[u32; 8]>>(), serializer)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<Patch>, D::Error> {
        let patch = |[a, b, c, d, e, kind, material, double_sided]: [u32; 8]| {
            let kind = u8::try_from(kind).ok().and_then(PatchKind::from_triangle_count);
            let kind = kind.ok_or_else(|| D::Error::custom("unknown kind of patch"))?;
            Ok(Patch { vertices: [a, b, c, d, e], kind, material, double_sided: double_sided != 0 })
        };
        bulk::deserialize::<[u32; 8], D>(deserializer)?.into_iter().map(patch).collect()
    }
}

#[derive(Clone, Copy)]
struct Candidate {
    cost: f32,
    triangles: [u32; 3],
    count: usize,
    vertices: [u32; 5],
}

impl Patches {
    /// Groups the triangles of one level of detail.
    pub fn build(triangles: Triangles) -> Self {
        let mut builder = Builder::new(triangles);
        let strips = builder.strips();
        builder.take(strips);
        let pairs = builder.pairs();
        builder.take(pairs);
        builder.finish()
    }

    /// Counts, mean waste and mean stretch; `vertices` are the model's.
    pub fn report(&self, vertices: &[Vertex]) -> PatchReport {
        let mut count_by_kind = [0; 3];
        let (mut rectangles, mut triangles, mut stretch) = (0.0f64, 0.0f64, 0.0f64);
        for patch in &self.patches {
            count_by_kind[patch.kind.triangle_count() - 1] += 1;
            let p = patch.vertices.map(|v| vertices[v as usize].position);
            let covered: f32 = patch.kind.triangles().iter().map(|t| area(t.map(|c| p[c as usize]))).sum();
            rectangles += f64::from(rectangle_area(patch.kind, &p));
            triangles += f64::from(covered);
            stretch += f64::from(covered * side_ratio(patch.kind, &p));
        }
        let mean = |sum: f64| if triangles > 0.0 { (sum / triangles) as f32 } else { 1.0 };
        PatchReport { count_by_kind, mean_waste: mean(rectangles), mean_stretch: mean(stretch) }
    }
}

impl Model {
    /// The patches of a level of detail: those made at load, or made now for a model that did not come through it.
    pub fn patches_of(&self, level: usize) -> Cow<'_, Patches> {
        match self.patches.get(level) {
            Some(patches) => Cow::Borrowed(patches),
            None => Cow::Owned(Patches::build(self.triangles(level))),
        }
    }

    /// The triangles of a level of detail: 0 is the full one, `n` is `lods[n - 1]`.
    pub fn triangles(&self, level: usize) -> Triangles<'_> {
        let (indices, primitives) = match level.checked_sub(1).map(|lod| &self.lods[lod]) {
            None => (&self.indices, &self.primitives),
            Some(lod) => (&lod.indices, &lod.primitives),
        };
        Triangles { vertices: &self.vertices, indices, primitives, materials: &self.materials }
    }
}

/// How much longer opposite sides of a patch are than each other, on average.
fn side_ratio(kind: PatchKind, p: &[Vec3; 5]) -> f32 {
    if kind == PatchKind::One {
        return 1.0;
    }
    let ratio = |a: f32, b: f32| a.max(b) / a.min(b).max(1e-3 * a.max(b)).max(f32::MIN_POSITIVE);
    let across = ratio(p[0].distance(p[1]), p[3].distance(p[2]));
    (across + ratio(p[0].distance(p[3]), p[1].distance(p[2]))) * 0.5
}

fn area([a, b, c]: [Vec3; 3]) -> f32 {
    (b - a).cross(c - a).length() * 0.5
}

/// Area of the rectangle whose sides are the longest of the patch's opposite sides.
fn rectangle_area(kind: PatchKind, p: &[Vec3; 5]) -> f32 {
    match kind {
        PatchKind::One => p[0].distance(p[1]) * p[0].distance(p[2]),
        _ => {
            let width = p[0].distance(p[1]).max(p[3].distance(p[2]));
            width * p[0].distance(p[3]).max(p[1].distance(p[2]))
        }
    }
}

struct Builder<'a> {
    source: Triangles<'a>,
    triangles: Vec<[u32; 3]>,
    material: Vec<u32>,
    normal: Vec<Vec3>,
    /// Directed edge (from, to) to the triangle whose winding holds it.
    edges: HashMap<(u32, u32), u32>,
    groups: Vec<Option<Candidate>>,
    taken: Vec<bool>,
}

impl<'a> Builder<'a> {
    fn new(source: Triangles<'a>) -> Self {
        let triangles: Vec<[u32; 3]> = source.indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect();
        let mut material = vec![0; triangles.len()];
        for primitive in source.primitives {
            let first = primitive.first_index as usize / 3;
            material[first..first + primitive.index_count as usize / 3].fill(primitive.material);
        }
        let position = |v: u32| source.vertices[v as usize].position;
        let normal = triangles
            .iter()
            .map(|t| {
                (position(t[1]) - position(t[0])).cross(position(t[2]) - position(t[0])).normalize_or_zero()
            })
            .collect();
        let mut edges = HashMap::with_capacity(triangles.len() * 3);
        for (index, t) in triangles.iter().enumerate() {
            for corner in 0..3 {
                edges.entry((t[corner], t[(corner + 1) % 3])).or_insert(index as u32);
            }
        }
        let count = triangles.len();
        let (groups, taken) = (vec![None; count], vec![false; count]);
        Self { source, triangles, material, normal, edges, groups, taken }
    }

    /// The triangle across the edge `from -> to` of `triangle`, of the same material and about the same direction.
    fn across(&self, triangle: u32, from: u32, to: u32) -> Option<u32> {
        let other = *self.edges.get(&(to, from))?;
        let (a, b) = (triangle as usize, other as usize);
        let fits = other != triangle
            && self.material[a] == self.material[b]
            && self.normal[a].dot(self.normal[b]) >= MIN_NORMAL_COSINE;
        fits.then_some(other)
    }

    fn opposite(&self, triangle: u32, from: u32, to: u32) -> Option<u32> {
        self.triangles[triangle as usize].into_iter().find(|v| *v != from && *v != to)
    }

    /// Waste of a group: 1 is a perfect rectangle.
    fn cost(&self, kind: PatchKind, vertices: [u32; 5]) -> f32 {
        let p = vertices.map(|v| self.source.vertices[v as usize].position);
        let covered: f32 = kind.triangles().iter().map(|t| area(t.map(|c| p[c as usize]))).sum();
        if covered <= 0.0 { f32::INFINITY } else { rectangle_area(kind, &p) / covered }
    }

    /// Pairs around every inner edge. The edge runs x -> y in triangle a, so a = (y, o, x) and b = (y, x, p).
    fn pairs(&self) -> Vec<Candidate> {
        let mut candidates = Vec::new();
        for a in 0..self.triangles.len() as u32 {
            let t = self.triangles[a as usize];
            for corner in 0..3 {
                let (x, y, o) = (t[corner], t[(corner + 1) % 3], t[(corner + 2) % 3]);
                let Some(b) = self.across(a, x, y).filter(|b| *b > a) else { continue };
                let Some(p) = self.opposite(b, x, y) else { continue };
                let vertices = [y, o, x, p, y];
                let cost = self.cost(PatchKind::Two, vertices);
                if cost < MAX_PAIR_COST && p != o {
                    candidates.push(Candidate { cost, triangles: [a, b, a], count: 2, vertices });
                }
            }
        }
        candidates
    }

    /// Strips of three around every triangle m = (v4, v2, v3) with neighbours across v3-v4 and v4-v2.
    fn strips(&self) -> Vec<Candidate> {
        let mut candidates = Vec::new();
        for m in 0..self.triangles.len() as u32 {
            let t = self.triangles[m as usize];
            for corner in 0..3 {
                let (v4, v2, v3) = (t[corner], t[(corner + 1) % 3], t[(corner + 2) % 3]);
                let Some(left) = self.across(m, v3, v4) else { continue };
                let Some(right) = self.across(m, v4, v2).filter(|right| *right != left) else { continue };
                let (Some(v0), Some(v1)) = (self.opposite(left, v3, v4), self.opposite(right, v4, v2)) else {
                    continue;
                };
                let vertices = [v0, v1, v2, v3, v4];
                let cost = self.cost(PatchKind::Three, vertices) * self.bend(v0, v4, v1);
                if cost < MAX_STRIP_COST && v0 != v1 {
                    candidates.push(Candidate { cost, triangles: [left, m, right], count: 3, vertices });
                }
            }
        }
        candidates
    }

    /// 1 where v4 lies on the middle of the edge v0-v1, more where the edge bends or v4 is off the middle.
    fn bend(&self, v0: u32, v4: u32, v1: u32) -> f32 {
        let [a, m, b] = [v0, v4, v1].map(|v| self.source.vertices[v as usize].position);
        let (left, right) = (a.distance(m), m.distance(b));
        let uneven = left.max(right) / left.min(right).max(1e-9);
        (left + right) / a.distance(b).max(1e-9) * uneven.sqrt()
    }

    /// Accepts candidates, cheapest first, while their triangles are free. A strip stays behind the pair that would
    /// waste less than it does, because pairs of the same triangles are in its own count of waste already.
    fn take(&mut self, mut candidates: Vec<Candidate>) {
        candidates.sort_by(|a, b| a.cost.total_cmp(&b.cost).then(a.triangles.cmp(&b.triangles)));
        let limit = if candidates.first().is_some_and(|c| c.count == 3) { 1.35 } else { MAX_PAIR_COST };
        for candidate in candidates.into_iter().filter(|c| c.cost < limit) {
            let members = &candidate.triangles[..candidate.count];
            if members.iter().any(|t| self.taken[*t as usize]) {
                continue;
            }
            members.iter().for_each(|t| self.taken[*t as usize] = true);
            let first = *members.iter().min().expect("one at least");
            self.groups[first as usize] = Some(candidate);
        }
    }

    /// Gives every triangle left a patch of its own and numbers all patches by their first triangle.
    fn finish(self) -> Patches {
        let mut result =
            Patches { patches: Vec::new(), patch_of_triangle: vec![u32::MAX; self.triangles.len()] };
        for triangle in 0..self.triangles.len() as u32 {
            let group = match self.groups[triangle as usize] {
                Some(group) => group,
                None if self.taken[triangle as usize] => continue,
                None => self.single(triangle),
            };
            let number = result.patches.len() as u32;
            for member in &group.triangles[..group.count] {
                result.patch_of_triangle[*member as usize] = number;
            }
            let kind = PatchKind::ALL[group.count - 1];
            let material = self.material[triangle as usize];
            let double_sided = self.source.materials.get(material as usize).is_some_and(|m| m.double_sided);
            result.patches.push(Patch { vertices: group.vertices, kind, material, double_sided });
        }
        result
    }

    /// The corner opposite the longest edge goes to (0, 0), where the rectangle's right angle is.
    fn single(&self, triangle: u32) -> Candidate {
        let t = self.triangles[triangle as usize];
        let best = (0..3)
            .map(|corner| [t[corner], t[(corner + 1) % 3], t[(corner + 2) % 3], t[corner], t[corner]])
            .min_by(|a, b| self.cost(PatchKind::One, *a).total_cmp(&self.cost(PatchKind::One, *b)))
            .expect("three corners");
        Candidate { cost: 2.0, triangles: [triangle; 3], count: 1, vertices: best }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    /// A wavy grid of `side` x `side` quads.
    fn wavy_grid(side: u32) -> Model {
        let vertex = |i: u32| {
            let (x, z) = ((i % (side + 1)) as f32, (i / (side + 1)) as f32);
            Vertex {
                position: Vec3::new(x, (x * 0.7).sin() * 0.3 + (z * 1.3).cos() * 0.2, z),
                normal: Vec3::Y,
                uv: [x, z],
                ..Vertex::default()
            }
        };
        let mut indices = Vec::new();
        for z in 0..side {
            for x in 0..side {
                let a = z * (side + 1) + x;
                let (b, c, d) = (a + 1, a + side + 1, a + side + 2);
                indices.extend([a, c, b, b, c, d]);
            }
        }
        let count = indices.len() as u32;
        Model {
            vertices: (0..(side + 1) * (side + 1)).map(vertex).collect(),
            indices,
            primitives: vec![Primitive { first_index: 0, index_count: count, material: 3 }],
            ..Model::default()
        }
    }

    #[test]
    fn every_triangle_is_in_exactly_one_patch_with_its_own_winding() {
        let model = wavy_grid(9);
        let patches = Patches::build(model.triangles(0));
        let mut of_patches = HashSet::new();
        for patch in &patches.patches {
            assert_eq!(patch.material, 3);
            for t in patch.kind.triangles() {
                let mut t = t.map(|c| patch.vertices[c as usize]);
                let first = (0..3).min_by_key(|i| t[*i]).unwrap();
                t.rotate_left(first);
                assert!(of_patches.insert(t), "{t:?} twice");
            }
        }
        let of_model: HashSet<_> = model
            .indices
            .chunks_exact(3)
            .map(|t| {
                let mut t = [t[0], t[1], t[2]];
                let first = (0..3).min_by_key(|i| t[*i]).unwrap();
                t.rotate_left(first);
                t
            })
            .collect();
        assert_eq!(of_patches, of_model);
    }

    #[test]
    fn patch_of_triangle_names_the_patch_that_holds_it() {
        let model = wavy_grid(5);
        let patches = Patches::build(model.triangles(0));
        for (triangle, corners) in model.indices.chunks_exact(3).enumerate() {
            let patch = patches.patches[patches.patch_of_triangle[triangle] as usize];
            assert!(corners.iter().all(|v| patch.vertices.contains(v)));
        }
    }

    #[test]
    fn a_regular_grid_becomes_nearly_square_quads() {
        let model = wavy_grid(12);
        let report = Patches::build(model.triangles(0)).report(&model.vertices);
        let [singles, pairs, strips] = report.count_by_kind;
        assert!(pairs * 2 + strips * 3 >= singles * 10, "{report:?}");
        assert!(report.mean_waste < 1.3, "{report:?}");
    }
}
