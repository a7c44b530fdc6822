//! One glTF primitive to vertices, triangles and morph targets: strips and fans unrolled, normals and tangents made
//! where missing, influences reduced, equal vertices welded.

use super::super::error::Fault;
use super::super::influences::reduce_to_four;
use super::super::limits::{MAX_DELTAS, MAX_VERTICES};
use super::super::{MorphDelta, Vertex, tangent};
use super::Warnings;
use super::accessor::Reader;
use super::material::Coordinates;
use super::shape::{Delta, Shape, triangle_normal};
use ::gltf::accessor::Dimensions;
use ::gltf::mesh::{Mode, Semantic};
use glam::Vec3;

/// JOINTS_n and WEIGHTS_n beyond this are not looked for: 32 influences a vertex.
const MAX_SETS: u32 = 8;

/// The triangles of one primitive, in mesh space. Joints count within the skin; without a skin they are unused.
pub(super) struct Part {
    pub(super) vertices: Vec<Vertex>,
    pub(super) indices: Vec<u32>,
    pub(super) has_influences: bool,
    /// By morph target: the vertices of the part that it moves.
    pub(super) targets: Vec<Vec<MorphDelta>>,
}

/// Reads one primitive; `None` where it has no triangles (points, lines, empty).
pub(super) fn read(
    reader: Reader,
    primitive: &::gltf::Primitive,
    element: &str,
    warnings: &mut Warnings,
) -> Result<Option<Part>, Fault> {
    if matches!(primitive.mode(), Mode::Points | Mode::Lines | Mode::LineLoop | Mode::LineStrip) {
        warnings.insert("points and lines are not drawn".into());
        return Ok(None);
    }
    let coordinates = Coordinates::of(&primitive.material())?;
    let source = Source { reader, primitive, element, coordinates };
    source.note_what_is_left_out(warnings);
    let mut vertices = source.vertices()?;
    let indices = source.triangles(vertices.len())?;
    let has_influences = source.influences(&mut vertices)?;
    let targets = source.targets(vertices.len(), indices.len())?;
    let mut shape = Shape { vertices, indices, targets };
    let has_normals = source.normals(&mut shape.vertices, &shape.indices, warnings)?;
    if !has_normals {
        // glTF 2.0 section 3.7.2.1: flat normals where there are none, and given tangents are then ignored.
        shape.separate_corners();
        shape.make_flat_normals();
    }
    source.tangents(has_normals, &mut shape, warnings)?;
    shape.weld();
    let targets = shape.morph_deltas();
    let Shape { vertices, indices, .. } = shape;
    Ok((!indices.is_empty()).then_some(Part { vertices, indices, has_influences, targets }))
}

struct Source<'a> {
    reader: Reader<'a>,
    primitive: &'a ::gltf::Primitive<'a>,
    element: &'a str,
    coordinates: Coordinates,
}

impl Source<'_> {
    fn note_what_is_left_out(&self, warnings: &mut Warnings) {
        if self.primitive.get(&Semantic::Colors(1)).is_some() {
            warnings.insert("vertex colours beyond COLOR_0 are ignored".into());
        }
        if self.primitive.get(&Semantic::Joints(MAX_SETS)).is_some() {
            warnings.insert(format!("of more than {} joints of a vertex the first are used", 4 * MAX_SETS));
        }
    }

    fn fault(&self, problem: impl Into<String>) -> Fault {
        Fault::new(self.element, problem)
    }

    /// An attribute as floats, `None` if absent; `count` is the number of vertices.
    fn attribute<const N: usize>(
        &self,
        semantic: Semantic,
        shape: Dimensions,
        count: usize,
    ) -> Result<Option<Vec<[f32; N]>>, Fault> {
        let Some(accessor) = self.primitive.get(&semantic) else { return Ok(None) };
        let element = self.attribute_element(&semantic, &accessor);
        self.check_count(&accessor, count, &element)?;
        self.reader.floats(&accessor, shape, &element).map(Some)
    }

    fn attribute_element(&self, semantic: &Semantic, accessor: &::gltf::Accessor) -> String {
        format!("{} {} (accessor {})", self.element, semantic.to_string(), accessor.index())
    }

    fn check_count(&self, accessor: &::gltf::Accessor, count: usize, element: &str) -> Result<(), Fault> {
        if accessor.count() == count {
            return Ok(());
        }
        Err(Fault::new(element, format!("has {} elements for {count} vertices", accessor.count())))
    }

    /// Positions, texture coordinates and colours; the rest is filled in later.
    fn vertices(&self) -> Result<Vec<Vertex>, Fault> {
        let Some(accessor) = self.primitive.get(&Semantic::Positions) else {
            return Err(self.fault("has no POSITION"));
        };
        let element = self.attribute_element(&Semantic::Positions, &accessor);
        let positions = self.reader.floats::<3>(&accessor, Dimensions::Vec3, &element)?;
        let vertex = |p: &[f32; 3]| Vertex { position: Vec3::from_array(*p), ..Vertex::default() };
        let mut vertices: Vec<Vertex> = positions.iter().map(vertex).collect();
        self.texture_coordinates(&mut vertices)?;
        self.colors(&mut vertices)?;
        Ok(vertices)
    }

    /// The second set only where a texture uses it: it would keep vertices apart for nothing.
    fn texture_coordinates(&self, vertices: &mut [Vertex]) -> Result<(), Fault> {
        let [first, second] = self.coordinates.sets;
        let read = |set| self.attribute(Semantic::TexCoords(set), Dimensions::Vec2, vertices.len());
        let (uv, uv1) = (read(first)?, if self.coordinates.uses_second { read(second)? } else { None });
        for (vertex, uv) in vertices.iter_mut().zip(uv.into_iter().flatten()) {
            vertex.uv = uv;
        }
        for (vertex, uv) in vertices.iter_mut().zip(uv1.into_iter().flatten()) {
            vertex.uv1 = uv;
        }
        Ok(())
    }

    fn colors(&self, vertices: &mut [Vertex]) -> Result<(), Fault> {
        let semantic = Semantic::Colors(0);
        let Some(accessor) = self.primitive.get(&semantic) else { return Ok(()) };
        let element = self.attribute_element(&semantic, &accessor);
        self.check_count(&accessor, vertices.len(), &element)?;
        let colors = self.reader.colors(&accessor, &element)?;
        for (vertex, color) in vertices.iter_mut().zip(colors) {
            vertex.color = color.map(|part| (part * 255.0).round() as u8);
        }
        Ok(())
    }

    /// By morph target, for each vertex of the file.
    fn targets(&self, vertex_count: usize, index_count: usize) -> Result<Vec<Vec<Delta>>, Fault> {
        let targets = self.primitive.morph_targets();
        // Corners may have to be separated: then there are as many vertices as indices.
        let needed = targets.len().saturating_mul(vertex_count.max(index_count));
        if needed > MAX_DELTAS {
            return Err(self.fault(format!(
                "its {} morph targets need {needed} deltas; at most {MAX_DELTAS} are supported",
                targets.len()
            )));
        }
        targets.enumerate().map(|(number, target)| self.target(number, &target, vertex_count)).collect()
    }

    fn target(
        &self,
        number: usize,
        target: &::gltf::mesh::MorphTarget,
        count: usize,
    ) -> Result<Vec<Delta>, Fault> {
        let read = |name: &str, accessor: Option<::gltf::Accessor>| {
            let Some(accessor) = accessor else { return Ok::<_, Fault>(vec![Vec3::ZERO; count]) };
            let element = format!("{} target {number} {name} (accessor {})", self.element, accessor.index());
            self.check_count(&accessor, count, &element)?;
            let values = self.reader.floats::<3>(&accessor, Dimensions::Vec3, &element)?;
            Ok(values.into_iter().map(Vec3::from_array).collect())
        };
        let positions = read("POSITION", target.positions())?;
        let (normals, tangents) = (read("NORMAL", target.normals())?, read("TANGENT", target.tangents())?);
        let all = positions.into_iter().zip(normals).zip(tangents);
        Ok(all.map(|((position, normal), tangent)| Delta { position, normal, tangent }).collect())
    }

    /// Three indices a triangle, all below `vertex_count`.
    fn triangles(&self, vertex_count: usize) -> Result<Vec<u32>, Fault> {
        let list = match self.primitive.indices() {
            Some(accessor) => self.indices(&accessor, vertex_count)?,
            None => (0..vertex_count as u32).collect(),
        };
        if list.len() > MAX_VERTICES {
            return Err(
                self.fault(format!("has {} indices; at most {MAX_VERTICES} are supported", list.len()))
            );
        }
        match self.primitive.mode() {
            Mode::TriangleStrip => Ok(unroll_strip(&list)),
            Mode::TriangleFan => Ok(unroll_fan(&list)),
            _ if list.len() % 3 == 0 => Ok(list),
            _ => Err(self.fault(format!("has {} indices, which is not a multiple of three", list.len()))),
        }
    }

    fn indices(&self, accessor: &::gltf::Accessor, vertex_count: usize) -> Result<Vec<u32>, Fault> {
        let element = format!("{} indices (accessor {})", self.element, accessor.index());
        let list: Vec<u32> = self
            .reader
            .integers::<1>(accessor, Dimensions::Scalar, &element)?
            .into_iter()
            .flatten()
            .collect();
        match list.iter().position(|index| *index as usize >= vertex_count) {
            Some(at) => {
                let problem = format!("index {at} is {}, but there are {vertex_count} vertices", list[at]);
                Err(Fault::new(element, problem))
            }
            None => Ok(list),
        }
    }

    /// False where the primitive has no normals. A normal of no length is replaced by its triangle's.
    fn normals(
        &self,
        vertices: &mut [Vertex],
        indices: &[u32],
        warnings: &mut Warnings,
    ) -> Result<bool, Fault> {
        let Some(normals) = self.attribute::<3>(Semantic::Normals, Dimensions::Vec3, vertices.len())? else {
            return Ok(false);
        };
        for (vertex, normal) in vertices.iter_mut().zip(normals) {
            vertex.normal = tangent::unit(Vec3::from_array(normal)).unwrap_or(Vec3::ZERO);
        }
        if vertices.iter().any(|vertex| vertex.normal == Vec3::ZERO) {
            warnings.insert("normals of length 0 are replaced".into());
            replace_zero_normals(vertices, indices);
        }
        Ok(true)
    }

    fn tangents(&self, has_normals: bool, shape: &mut Shape, warnings: &mut Warnings) -> Result<(), Fault> {
        // After flat normals the vertices are no longer the file's, and the specification ignores its tangents.
        let given = match has_normals {
            true => self.attribute::<4>(Semantic::Tangents, Dimensions::Vec4, shape.vertices.len())?,
            false => None,
        };
        if let Some(given) = given {
            for (vertex, [x, y, z, w]) in shape.vertices.iter_mut().zip(given) {
                vertex.tangent = tangent::orthonormal(Vec3::new(x, y, z), w, vertex.normal);
            }
            return Ok(());
        }
        shape.targets.iter_mut().flatten().for_each(|delta| delta.tangent = Vec3::ZERO);
        if let Some(normal_map) = &self.coordinates.normal_map {
            shape.separate_corners();
            if !shape.generate_tangents(normal_map) {
                warnings.insert("tangents of very large triangle fans are approximate".into());
            }
        } else {
            shape.vertices.iter_mut().for_each(|vertex| vertex.tangent = tangent::arbitrary(vertex.normal));
        }
        Ok(())
    }

    /// False where the primitive has no JOINTS_0.
    fn influences(&self, vertices: &mut [Vertex]) -> Result<bool, Fault> {
        let mut sets = Vec::new();
        for set in 0..MAX_SETS {
            match self.influence_set(set, vertices.len())? {
                Some(pair) => sets.push(pair),
                None => break,
            }
        }
        if sets.is_empty() {
            return Ok(false);
        }
        for (index, vertex) in vertices.iter_mut().enumerate() {
            let all = sets.iter().flat_map(|(joints, weights)| joints[index].into_iter().zip(weights[index]));
            let reduced = reduce_to_four(all).ok_or_else(|| {
                self.fault(format!("vertex {index} has no weight above zero, or a negative one"))
            })?;
            (vertex.joints, vertex.weights) = reduced;
        }
        Ok(true)
    }

    fn influence_set(&self, set: u32, count: usize) -> Result<Option<InfluenceSet>, Fault> {
        let Some(accessor) = self.primitive.get(&Semantic::Joints(set)) else { return Ok(None) };
        let element = self.attribute_element(&Semantic::Joints(set), &accessor);
        self.check_count(&accessor, count, &element)?;
        if accessor.data_type() == ::gltf::accessor::DataType::U32 {
            return Err(Fault::new(element, "joints must be of 8 or 16 bits"));
        }
        let joints = self.reader.integers::<4>(&accessor, Dimensions::Vec4, &element)?;
        let weights = self.attribute::<4>(Semantic::Weights(set), Dimensions::Vec4, count)?;
        let weights = weights.ok_or_else(|| self.fault(format!("has JOINTS_{set} but no WEIGHTS_{set}")))?;
        Ok(Some((joints.into_iter().map(|four| four.map(|joint| joint as u16)).collect(), weights)))
    }
}

type InfluenceSet = (Vec<[u16; 4]>, Vec<[f32; 4]>);

/// glTF 2.0 section 3.7.2.1: triangle i of a strip is (i, i + 1 + i % 2, i + 2 - i % 2).
fn unroll_strip(list: &[u32]) -> Vec<u32> {
    let triangle = |(i, w): (usize, &[u32])| if i % 2 == 0 { [w[0], w[1], w[2]] } else { [w[0], w[2], w[1]] };
    list.windows(3).enumerate().flat_map(triangle).collect()
}

/// Triangle i of a fan is (i + 1, i + 2, 0).
fn unroll_fan(list: &[u32]) -> Vec<u32> {
    let Some((centre, rim)) = list.split_first() else { return Vec::new() };
    rim.windows(2).flat_map(|pair| [pair[0], pair[1], *centre]).collect()
}

/// A normal of no length is replaced by its triangle's.
pub(crate) fn replace_zero_normals(vertices: &mut [Vertex], indices: &[u32]) {
    for triangle in indices.chunks_exact(3) {
        let corners = [0, 1, 2].map(|i| triangle[i] as usize);
        let normal = triangle_normal(corners.map(|corner| vertices[corner].position));
        for corner in corners {
            if vertices[corner].normal == Vec3::ZERO {
                vertices[corner].normal = normal;
            }
        }
    }
    vertices
        .iter_mut()
        .filter(|vertex| vertex.normal == Vec3::ZERO)
        .for_each(|vertex| vertex.normal = Vec3::Y);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strips_and_fans_keep_the_winding_of_the_specification() {
        assert_eq!(unroll_strip(&[0, 1, 2, 3, 4]), [0, 1, 2, 1, 3, 2, 2, 3, 4]);
        assert_eq!(unroll_fan(&[9, 1, 2, 3]), [1, 2, 9, 2, 3, 9]);
        assert!(
            unroll_strip(&[0, 1]).is_empty() && unroll_fan(&[]).is_empty() && unroll_fan(&[1]).is_empty()
        );
    }
}
