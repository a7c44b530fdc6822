//! The previous grouping: cheapest groups first, while their triangles are free.
use super::{Patch, PatchKind, Patches, Triangles};
use glam::Vec3;
use std::collections::HashMap;

const MIN_NORMAL_COSINE: f32 = 0.6;
const MAX_PAIR_COST: f32 = 2.0;
const MAX_STRIP_COST: f32 = 1.8;

pub(crate) fn build(triangles: Triangles) -> Patches {
    let mut builder = Builder::new(triangles);
    let strips = builder.strips();
    builder.take(strips);
    let pairs = builder.pairs();
    builder.take(pairs);
    builder.finish()
}

#[derive(Clone, Copy)]
struct Candidate {
    cost: f32,
    triangles: [u32; 3],
    count: usize,
    vertices: [u32; 5],
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
