//! Coarser levels of detail over a model's own vertices.
//!
//! The simplifier (meshopt) weighs positions against attributes. The effect of skinning and morphing on a vertex is such an
//! attribute: the vertex's *positions in several other poses*. Where those are a linear function of the place on the surface,
//! as on a rigid limb, they cost nothing. Around a joint they cost the surface's error in those poses, in metres, so joints
//! keep their loops. Bone weights as attributes would need a scale by each bone's motion, for which the poses are the measure
//! anyway.

mod poses;

use crate::surface::Surface;
use crate::{Cancel, Cancelled, Lod, Model, Primitive};
use glam::{Vec2, Vec3};
use meshopt::{SimplifyOptions, VertexDataAdapter};
use poses::PoseSet;
use std::collections::HashMap;

/// No level has fewer triangles than this unless the one before it had less than twice as many.
const MIN_TRIANGLES: usize = 64;
/// A level must be smaller than the one before by this factor, or the chain ends.
const MIN_GAIN: f32 = 0.8;
/// No level's error is larger than this part of the model's extent.
const MAX_RELATIVE_ERROR: f32 = 0.06;
/// Texels along a side of the largest block: where a level's error is one pixel, none of its edges should need more.
const BLOCK_TEXELS: f32 = 512.0;
/// What meshopt takes.
const MAX_ATTRIBUTES: usize = 32;
/// A change of the normal by 1 over a distance counts as this part of the distance.
const NORMAL_WEIGHT: f32 = 0.5;
const COLOR_WEIGHT: f32 = 0.5;
/// A slide of the texture by a distance counts as this part of the distance.
const SLIDE_WEIGHT: f32 = 0.25;
/// Being off in another pose counts as this part of being off in the rest pose.
const POSE_WEIGHT: f32 = 1.0;
/// The same for poses that no clip shows.
const BENT_WEIGHT: f32 = 0.5;

/// What may be switched off, to measure what it is worth.
#[derive(Clone, Copy, Debug)]
struct Options {
    poses: bool,
}

/// The levels of a model, finest first; none where it is too small or has no finite rest pose.
///
/// # Errors
/// Somebody asked to end.
pub fn build(model: &Model, cancel: &Cancel) -> Result<Vec<Lod>, Cancelled> {
    chain(model, Options { poses: true }, cancel)
}

fn chain(model: &Model, options: Options, cancel: &Cancel) -> Result<Vec<Lod>, Cancelled> {
    let Some(source) = Source::new(model, options, cancel)? else { return Ok(Vec::new()) };
    let mut lods: Vec<Lod> = Vec::new();
    let (mut triangles, mut error_m) = (model.indices.len() / 3, 0.0f32);
    while triangles >= 2 * MIN_TRIANGLES {
        cancel.check()?;
        let mut lod = source.simplify(triangles / 2);
        let count = lod.indices.len() / 3;
        if count == 0 || count as f32 > MIN_GAIN * triangles as f32 {
            break;
        }
        error_m = source.error_m(&lod.indices, error_m)?;
        if error_m > MAX_RELATIVE_ERROR * source.extent_m {
            break;
        }
        lod.error_m = error_m.max(source.longest_edge_m(&lod.indices) / BLOCK_TEXELS);
        (triangles, error_m) = (count, lod.error_m);
        lods.push(lod);
    }
    Ok(lods)
}

/// Corners of the model, one for each primitive that shares a vertex: borders between materials are seams then, which
/// the simplifier keeps together, and every corner knows its primitive.
struct Source<'a> {
    model: &'a Model,
    vertex_of_corner: Vec<u32>,
    primitive_of_corner: Vec<u32>,
    /// Three corners per triangle.
    corners: Vec<u32>,
    /// Of corners, in the rest pose; equal to the last bit where corners are at one place.
    positions: Vec<Vec3>,
    poses: PoseSet,
    /// The full detail in each real pose.
    surfaces: Vec<Surface>,
    extent_m: f32,
    area_m2: f32,
    longest_edge_m: f32,
    use_poses: bool,
    cancel: &'a Cancel,
}

impl<'a> Source<'a> {
    fn new(model: &'a Model, options: Options, cancel: &'a Cancel) -> Result<Option<Self>, Cancelled> {
        if model.indices.len() / 3 < 2 * MIN_TRIANGLES {
            return Ok(None);
        }
        let Some(poses) = PoseSet::choose(model, cancel)? else { return Ok(None) };
        let (vertex_of_corner, primitive_of_corner, corners) = split_by_primitive(model);
        let rest = &poses.real[0];
        let positions = welded(model, &vertex_of_corner, rest);
        let (low, high) = bounds(&positions);
        let extent_m = (high - low).max_element();
        let surface = |at: &Vec<Vec3>| {
            cancel.check()?;
            Ok(Surface::new(triangles(&model.indices, at)))
        };
        let surfaces = poses.real.iter().map(surface).collect::<Result<_, _>>()?;
        let area_m2 = triangles(&model.indices, rest).map(area).sum();
        let mut source = Self {
            model,
            vertex_of_corner,
            primitive_of_corner,
            corners,
            positions,
            poses,
            surfaces,
            extent_m,
            area_m2,
            longest_edge_m: 0.0,
            use_poses: options.poses,
            cancel,
        };
        source.longest_edge_m = source.longest_edge_m(&model.indices);
        Ok((extent_m > 0.0 && area_m2 > 0.0).then_some(source))
    }

    fn simplify(&self, target_triangles: usize) -> Lod {
        let attributes = Attributes::new(self, target_triangles);
        let bytes: &[u8] = bytemuck::cast_slice(&self.positions);
        let adapter = VertexDataAdapter::new(bytes, size_of::<Vec3>(), 0).expect("whole positions");
        let corners = meshopt::simplify_with_attributes_and_locks(
            &self.corners,
            &adapter,
            &attributes.values,
            &attributes.weights,
            attributes.weights.len() * size_of::<f32>(),
            &vec![false; self.positions.len()],
            target_triangles * 3,
            f32::MAX,
            SimplifyOptions::Prune,
            None,
        );
        self.sorted(&corners)
    }

    /// The triangles by primitive, without an error yet.
    fn sorted(&self, corners: &[u32]) -> Lod {
        let mut parts = vec![Vec::new(); self.model.primitives.len()];
        for triangle in corners.chunks_exact(3) {
            let part = &mut parts[self.primitive_of_corner[triangle[0] as usize] as usize];
            part.extend(triangle.iter().map(|corner| self.vertex_of_corner[*corner as usize]));
        }
        let mut lod = Lod { error_m: 0.0, indices: Vec::new(), primitives: Vec::new() };
        for (primitive, part) in self.model.primitives.iter().zip(parts) {
            let first_index = lod.indices.len() as u32;
            let index_count = part.len() as u32;
            lod.primitives.push(Primitive { first_index, index_count, material: primitive.material });
            lod.indices.extend(part);
        }
        lod
    }

    /// Largest distance between the surfaces in any real pose, at least `floor`: of the full detail's vertices from
    /// the level, and of middles of the level's edges and triangles from the full detail (its vertices lie on it).
    fn error_m(&self, indices: &[u32], floor: f32) -> Result<f32, Cancelled> {
        let go_on = || !self.cancel.is_asked();
        let mut error_m = floor;
        for (positions, full) in self.poses.real.iter().zip(&self.surfaces) {
            let level = Surface::new(triangles(indices, positions));
            let used = self.vertex_of_corner.iter().map(|vertex| positions[*vertex as usize]);
            error_m = level.largest_distance(used.take_while(|_| go_on()), error_m);
            let middles = triangles(indices, positions)
                .flat_map(|[a, b, c]| [(a + b) * 0.5, (b + c) * 0.5, (c + a) * 0.5, (a + b + c) / 3.0]);
            error_m = full.largest_distance(middles.take_while(|_| go_on()), error_m);
            self.cancel.check()?;
        }
        Ok(error_m)
    }

    /// 0 where no edge is longer than those of the full detail.
    fn longest_edge_m(&self, indices: &[u32]) -> f32 {
        let edges = triangles(indices, &self.poses.real[0])
            .flat_map(|[a, b, c]| [a.distance_squared(b), b.distance_squared(c), c.distance_squared(a)]);
        let longest_m = edges.fold(0.0, f32::max).sqrt();
        if longest_m > self.longest_edge_m { longest_m } else { 0.0 }
    }
}

fn split_by_primitive(model: &Model) -> (Vec<u32>, Vec<u32>, Vec<u32>) {
    let mut known = HashMap::with_capacity(model.vertices.len());
    let (mut vertices, mut primitives, mut corners) = (Vec::new(), Vec::new(), Vec::new());
    for (number, primitive) in model.primitives.iter().enumerate() {
        for vertex in &model.indices[primitive.first_index as usize..][..primitive.index_count as usize] {
            corners.push(*known.entry((number as u32, *vertex)).or_insert_with(|| {
                vertices.push(*vertex);
                primitives.push(number as u32);
                vertices.len() as u32 - 1
            }));
        }
    }
    (vertices, primitives, corners)
}

/// Positions of corners in the rest pose. Those of one place in mesh space that skinning, by rounding, puts a little
/// apart are put together again: a crack would open between them.
fn welded(model: &Model, vertex_of_corner: &[u32], rest: &[Vec3]) -> Vec<Vec3> {
    let (low, high) = bounds(rest);
    let tolerance = 1e-5 * (high - low).max_element();
    let mut places: HashMap<[u32; 3], Vec<Vec3>> = HashMap::with_capacity(vertex_of_corner.len());
    let place = |vertex: &u32| {
        let key = model.vertices[*vertex as usize].position.to_array().map(|x| (x + 0.0).to_bits());
        let (known, at) = (places.entry(key).or_default(), rest[*vertex as usize]);
        match known.iter().find(|other| other.distance(at) <= tolerance) {
            Some(other) => *other,
            None => {
                known.push(at);
                at
            }
        }
    };
    vertex_of_corner.iter().map(place).collect()
}

/// What the simplifier should keep besides positions: so many numbers per corner, each with a weight.
struct Attributes {
    values: Vec<f32>,
    weights: Vec<f32>,
}

impl Attributes {
    fn new(source: &Source, target_triangles: usize) -> Self {
        let vertices = &source.model.vertices;
        let has_color = vertices.iter().any(|v| v.color != vertices[0].color);
        // meshopt counts an attribute's error times the root of the area that it stands for, in units of the extent,
        // while an error of position counts as it is. This makes metres of both at the level's density.
        let area = source.area_m2 / (source.extent_m * source.extent_m);
        let density = (target_triangles as f32 / (6.0 * area)).sqrt();
        let per_metre = density / source.extent_m;
        let slide = SLIDE_WEIGHT * per_metre * metres_per_uv(source);
        let mut weights = [[NORMAL_WEIGHT; 3].as_slice(), &[slide; 2]].concat();
        if has_color {
            weights.extend([COLOR_WEIGHT / 255.0; 3]);
        }
        let room = (MAX_ATTRIBUTES - weights.len()) / 3;
        let poses = source.other_poses(per_metre);
        let poses = &poses[..poses.len().min(room)];
        poses.iter().for_each(|(_, weight)| weights.extend([*weight; 3]));
        let mut values = Vec::with_capacity(source.vertex_of_corner.len() * weights.len());
        for vertex in &source.vertex_of_corner {
            let v = &vertices[*vertex as usize];
            values.extend(v.normal.to_array().into_iter().chain(v.uv));
            values.extend(v.color.iter().take(if has_color { 3 } else { 0 }).map(|c| f32::from(*c)));
            values.extend(poses.iter().flat_map(|(at, _)| at[*vertex as usize].to_array()));
        }
        Self { values, weights }
    }
}

impl Source<'_> {
    /// Positions in all poses but the rest pose, with their weights, whose squares sum to one at most.
    fn other_poses(&self, per_metre: f32) -> Vec<(&[Vec3], f32)> {
        if !self.use_poses {
            return Vec::new();
        }
        let (real, bent) = (&self.poses.real[1..], &self.poses.bent);
        let weight = |share: f32, count: usize| per_metre * share / (count as f32).sqrt();
        let real = real.iter().map(|at| (&at[..], weight(POSE_WEIGHT, real.len())));
        real.chain(bent.iter().map(|at| (&at[..], weight(BENT_WEIGHT, bent.len())))).collect()
    }
}

/// Length on the surface of one unit of texture coordinates, on average; 0 where there are none.
fn metres_per_uv(source: &Source) -> f32 {
    let uv = |v: u32| Vec2::from(source.model.vertices[v as usize].uv);
    let of_triangle = |t: &[u32]| (uv(t[1]) - uv(t[0])).perp_dot(uv(t[2]) - uv(t[0])).abs() * 0.5;
    let uv_area: f32 = source.model.indices.chunks_exact(3).map(of_triangle).sum();
    let ratio = (source.area_m2 / uv_area).sqrt();
    if ratio.is_finite() { ratio } else { 0.0 }
}

fn triangles<'a>(indices: &'a [u32], positions: &'a [Vec3]) -> impl Iterator<Item = [Vec3; 3]> + 'a {
    indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]].map(|vertex| positions[vertex as usize]))
}

fn area([a, b, c]: [Vec3; 3]) -> f32 {
    (b - a).cross(c - a).length() * 0.5
}

fn bounds(points: &[Vec3]) -> (Vec3, Vec3) {
    let empty = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    points.iter().fold(empty, |(low, high), p| (low.min(*p), high.max(*p)))
}

#[cfg(test)]
mod tests;
