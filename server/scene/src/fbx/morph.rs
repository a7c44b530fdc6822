//! Blend shapes to morph targets. A channel with in-between shapes becomes one morph per shape. Their weights follow the
//! channel's by FBX's blending (see [`Channel::weights`]).

use super::convert::{self, vec3};
use super::part::Part;
use crate::error::Fault;
use crate::import::Warnings;
use crate::limits::MAX_DELTAS;
use crate::{Morph, MorphDelta};
use glam::{Quat, Vec3};
use std::collections::{HashMap, HashSet};

/// All morphs of a model, and where their weights come from.
#[derive(Default)]
pub(super) struct Morphs {
    pub(super) morphs: Vec<Morph>,
    pub(super) channels: Vec<Channel>,
    delta_count: usize,
}

/// What blends one or more shapes by one animated number.
pub(super) struct Channel {
    /// Of the FBX element that is animated.
    pub(super) element_id: u32,
    /// Index into [`Morphs::morphs`]; the channel's morphs follow each other.
    pub(super) first_morph: u32,
    /// For each morph the channel's weight at which it is fully there, in FBX's order.
    pub(super) targets: Vec<f64>,
}

/// The shapes of one mesh.
#[derive(Default)]
pub(super) struct Shapes {
    shapes: Vec<Shape>,
    moved: HashSet<u32>,
}

struct Shape {
    morph: u32,
    /// By control point: what the full weight adds to position and normal.
    offsets: HashMap<u32, (Vec3, Vec3)>,
    has_normals: bool,
}

impl Shapes {
    /// For welding: control points that a shape moves stay apart from all others.
    pub(super) fn class(&self, control_point: u32) -> u32 {
        if self.moved.contains(&control_point) { control_point } else { u32::MAX }
    }
}

impl Channel {
    /// The weights of the channel's shapes, as FBX blends them: up to the first shape it grows in; between two shapes
    /// they share; beyond the last one the last two are extrapolated. Shapes at negative weights likewise downwards;
    /// where there are none, the first shape is taken away.
    pub(super) fn weights(&self, weight: f64) -> Vec<f64> {
        let mut weights = vec![0.0; self.targets.len()];
        let negative = self.targets.iter().take_while(|target| **target < 0.0).count();
        let order: Vec<usize> =
            if weight > 0.0 { (negative..weights.len()).collect() } else { (0..negative).rev().collect() };
        let (mut before, mut after): (Option<usize>, Option<usize>) = (None, None);
        for index in order {
            (before, after) = (after, Some(index));
            let target = self.targets[index];
            if (weight > 0.0 && target > weight) || (weight <= 0.0 && target < weight) {
                break;
            }
        }
        let Some(next) = after else {
            // No shape on this side of 0: the nearest on the other side is taken away instead.
            let nearest = if weight > 0.0 { negative.checked_sub(1) } else { Some(negative) };
            let nearest = nearest.and_then(|index| Some((index, *self.targets.get(index)?)));
            if let Some((index, target)) = nearest.filter(|(_, target)| *target != 0.0) {
                weights[index] = weight / target;
            }
            return weights;
        };
        let target = |shape: Option<usize>| shape.map_or(0.0, |shape| self.targets[shape]);
        let span = target(after) - target(before);
        if span != 0.0 {
            let share = (weight - target(before)) / span;
            weights[next] = share;
            if let Some(before) = before {
                weights[before] = 1.0 - share;
            }
        }
        weights
    }
}

impl Morphs {
    /// The shapes of a mesh, with a morph for each; those of a mesh that another node shows already are found again.
    pub(super) fn register(&mut self, mesh: &ufbx::Mesh, warnings: &mut Warnings) -> Result<Shapes, Fault> {
        let mut found = Shapes::default();
        for deformer in &mesh.blend_deformers {
            for channel in &deformer.channels {
                let first = self.channel(channel)?;
                for (index, key) in channel.keyframes.iter().enumerate() {
                    let shape = read_shape(&key.shape, first + index as u32, mesh.num_vertices)?;
                    found.moved.extend(shape.offsets.keys());
                    if !shape.has_normals {
                        warnings.insert(
                            "blend shapes without normals get normals computed from their surface".into(),
                        );
                    }
                    found.shapes.push(shape);
                }
            }
        }
        Ok(found)
    }

    /// The channel's first morph.
    fn channel(&mut self, source: &ufbx::BlendChannel) -> Result<u32, Fault> {
        let element_id = source.element.element_id;
        if let Some(known) = self.channels.iter().find(|channel| channel.element_id == element_id) {
            return Ok(known.first_morph);
        }
        let element = convert::label("blend channel", &source.element);
        let targets: Vec<f64> = source.keyframes.iter().map(|key| key.target_weight).collect();
        if !(source.weight.is_finite() && targets.iter().all(|target| target.is_finite())) {
            return Err(Fault::new(element, "has a weight that is not finite"));
        }
        let name = convert::name("blend channel", &source.element);
        let channel = Channel { element_id, first_morph: self.morphs.len() as u32, targets };
        for (target, weight) in channel.targets.iter().zip(channel.weights(source.weight)) {
            let name = if channel.targets.len() == 1 { name.clone() } else { format!("{name} at {target}") };
            self.morphs.push(Morph { name, rest_weight: weight as f32, deltas: Vec::new() });
        }
        let first_morph = channel.first_morph;
        self.channels.push(channel);
        Ok(first_morph)
    }

    /// Adds the deltas of a part's vertices, of which the first has the index `base` in the model.
    pub(super) fn append(&mut self, part: &Part, shapes: &Shapes, base: u32) -> Result<(), String> {
        for shape in &shapes.shapes {
            let normals = if shape.has_normals { Vec::new() } else { turned_normals(part, shape) };
            let deltas = &mut self.morphs[shape.morph as usize].deltas;
            for (vertex, control_point) in part.control_points.iter().enumerate() {
                let Some((position, normal)) = shape.offsets.get(control_point) else { continue };
                let source = &part.vertices[vertex];
                let turn = normals
                    .get(vertex)
                    .copied()
                    .unwrap_or_else(|| turn(source.normal, source.normal + *normal));
                let tangent = Vec3::from_slice(&source.tangent[..3]);
                let tangent = if part.tangents { turn * tangent - tangent } else { Vec3::ZERO };
                let normal = if shape.has_normals { *normal } else { turn * source.normal - source.normal };
                deltas.push(MorphDelta {
                    vertex: base + vertex as u32,
                    position: *position,
                    normal,
                    tangent,
                });
            }
            self.delta_count += part.control_points.len();
            if self.delta_count > MAX_DELTAS {
                return Err(format!("brings the model over {MAX_DELTAS} blend shape offsets; reduce it"));
            }
        }
        Ok(())
    }
}

fn read_shape(source: &ufbx::BlendShape, morph: u32, point_count: usize) -> Result<Shape, Fault> {
    let mut shape = Shape { morph, offsets: HashMap::new(), has_normals: false };
    for (index, control_point) in source.offset_vertices.iter().enumerate() {
        let weight = source.offset_weights.get(index).map_or(1.0, |weight| *weight as f32);
        let offset =
            |list: &[ufbx::Vec3]| list.get(index).map_or(Vec3::ZERO, |offset| vec3(*offset) * weight);
        let (position, normal) = (offset(&source.position_offsets), offset(&source.normal_offsets));
        if !(position.is_finite() && normal.is_finite()) {
            let element = convert::label("blend shape", &source.element);
            return Err(Fault::new(element, format!("offset {index} is not finite")));
        }
        // The file may name control points that the mesh does not have, or one several times.
        if (*control_point as usize) < point_count && (position != Vec3::ZERO || normal != Vec3::ZERO) {
            let sum = shape.offsets.entry(*control_point).or_default();
            *sum = (sum.0 + position, sum.1 + normal);
        }
        shape.has_normals |= normal != Vec3::ZERO;
    }
    Ok(shape)
}

/// For each vertex the rotation of the surface around it when the shape is fully there. Vertices at one control point
/// with one normal turn together, so that what was smooth stays so.
fn turned_normals(part: &Part, shape: &Shape) -> Vec<Quat> {
    let group = |vertex: usize| {
        (part.control_points[vertex], part.vertices[vertex].normal.to_array().map(f32::to_bits))
    };
    let moved = |vertex: usize| {
        let offset = shape.offsets.get(&part.control_points[vertex]).map_or(Vec3::ZERO, |offset| offset.0);
        part.vertices[vertex].position + offset
    };
    let mut sums: HashMap<_, (Vec3, Vec3)> = HashMap::new();
    for triangle in part.indices.chunks_exact(3) {
        let corners = [0, 1, 2].map(|corner| triangle[corner] as usize);
        let area = |[a, b, c]: [Vec3; 3]| (b - a).cross(c - a);
        let before = area(corners.map(|corner| part.vertices[corner].position));
        let after = area(corners.map(moved));
        for corner in corners {
            let sum = sums.entry(group(corner)).or_default();
            *sum = (sum.0 + before, sum.1 + after);
        }
    }
    let turn_of = |vertex: usize| sums.get(&group(vertex)).map_or(Quat::IDENTITY, |sum| turn(sum.0, sum.1));
    (0..part.vertices.len()).map(turn_of).collect()
}

/// The shortest rotation from one direction to another; none where one of them has no length.
fn turn(from: Vec3, to: Vec3) -> Quat {
    match (from.try_normalize(), to.try_normalize()) {
        (Some(from), Some(to)) => Quat::from_rotation_arc(from, to),
        _ => Quat::IDENTITY,
    }
}
