//! One glTF primitive to vertices and triangles: strips and fans unrolled, normals and tangents made where missing,
//! influences reduced, equal vertices welded.

use super::super::error::Fault;
use super::super::influences::reduce_to_four;
use super::super::limits::MAX_VERTICES;
use super::super::{Vertex, tangent, weld};
use super::Warnings;
use super::accessor::Reader;
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
    let source = Source { reader, primitive, element };
    note_what_is_left_out(primitive, warnings);
    let mut vertices = source.vertices(warnings)?;
    let mut indices = source.triangles(vertices.len())?;
    let has_influences = source.influences(&mut vertices)?;
    let has_normals = source.normals(&mut vertices, &indices, warnings)?;
    if !has_normals {
        // glTF 2.0 section 3.7.2.1: flat normals where there are none, and given tangents are then ignored.
        separate_corners(&mut vertices, &mut indices);
        flat_normals(&mut vertices);
    }
    source.tangents(has_normals, &mut vertices, &mut indices, warnings)?;
    weld::weld(&mut vertices, &mut indices);
    Ok((!indices.is_empty()).then_some(Part { vertices, indices, has_influences }))
}

fn note_what_is_left_out(primitive: &::gltf::Primitive, warnings: &mut Warnings) {
    if primitive.morph_targets().next().is_some() {
        warnings.insert(super::MORPH_WARNING.into());
    }
    if primitive.get(&Semantic::Colors(0)).is_some() {
        warnings.insert("vertex colours are ignored".into());
    }
}

struct Source<'a> {
    reader: Reader<'a>,
    primitive: &'a ::gltf::Primitive<'a>,
    element: &'a str,
}

impl Source<'_> {
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

    /// Positions and texture coordinates; the rest is filled in later.
    fn vertices(&self, warnings: &mut Warnings) -> Result<Vec<Vertex>, Fault> {
        let Some(accessor) = self.primitive.get(&Semantic::Positions) else {
            return Err(self.fault("has no POSITION"));
        };
        let element = self.attribute_element(&Semantic::Positions, &accessor);
        let positions = self.reader.floats::<3>(&accessor, Dimensions::Vec3, &element)?;
        let uvs = self.texture_coordinates(positions.len(), warnings)?;
        let vertex = |(position, uv): (&[f32; 3], &[f32; 2])| Vertex {
            position: Vec3::from_array(*position),
            uv: *uv,
            ..Vertex::default()
        };
        Ok(positions.iter().zip(&uvs).map(vertex).collect())
    }

    /// The set that the base colour uses (a vertex holds one), zeros if there is none.
    fn texture_coordinates(&self, count: usize, warnings: &mut Warnings) -> Result<Vec<[f32; 2]>, Fault> {
        let sets = used_texture_sets(&self.primitive.material());
        let set = sets.first().copied().unwrap_or(0);
        if sets.iter().any(|other| *other != set) {
            warnings.insert("only one set of texture coordinates per material is used".into());
        }
        let found = self.attribute(Semantic::TexCoords(set), Dimensions::Vec2, count)?;
        Ok(found.unwrap_or_else(|| vec![[0.0; 2]; count]))
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
            vertex.normal = Vec3::from_array(normal).normalize_or_zero();
        }
        if vertices.iter().any(|vertex| vertex.normal == Vec3::ZERO) {
            warnings.insert("normals without length are replaced".into());
            replace_zero_normals(vertices, indices);
        }
        Ok(true)
    }

    fn tangents(
        &self,
        has_normals: bool,
        vertices: &mut Vec<Vertex>,
        indices: &mut Vec<u32>,
        warnings: &mut Warnings,
    ) -> Result<(), Fault> {
        // After flat normals the vertices are no longer the file's, and the specification ignores its tangents.
        let given = match has_normals {
            true => self.attribute::<4>(Semantic::Tangents, Dimensions::Vec4, vertices.len())?,
            false => None,
        };
        if let Some(given) = given {
            for (vertex, [x, y, z, w]) in vertices.iter_mut().zip(given) {
                vertex.tangent = tangent::orthonormal(Vec3::new(x, y, z), w, vertex.normal);
            }
        } else if self.primitive.material().normal_texture().is_some() {
            separate_corners(vertices, indices);
            if !tangent::generate(vertices) {
                warnings.insert("tangents of very large triangle fans are approximate".into());
            }
        } else {
            vertices.iter_mut().for_each(|vertex| vertex.tangent = tangent::arbitrary(vertex.normal));
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

/// Texture coordinate sets of a material's textures, the base colour's (or else the first found) first.
fn used_texture_sets(material: &::gltf::Material) -> Vec<u32> {
    let pbr = material.pbr_metallic_roughness();
    let sets = [
        pbr.base_color_texture().map(|texture| texture.tex_coord()),
        material.normal_texture().map(|texture| texture.tex_coord()),
        pbr.metallic_roughness_texture().map(|texture| texture.tex_coord()),
        material.occlusion_texture().map(|texture| texture.tex_coord()),
        material.emissive_texture().map(|texture| texture.tex_coord()),
    ];
    sets.into_iter().flatten().collect()
}

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

/// Gives each triangle corner a vertex of its own.
fn separate_corners(vertices: &mut Vec<Vertex>, indices: &mut Vec<u32>) {
    *vertices = indices.iter().map(|index| vertices[*index as usize]).collect();
    *indices = (0..vertices.len() as u32).collect();
}

/// For separate corners: the triangle's normal; up where the triangle has no area.
fn flat_normals(corners: &mut [Vertex]) {
    for triangle in corners.chunks_exact_mut(3) {
        let normal = triangle_normal([0, 1, 2].map(|i| triangle[i].position));
        triangle.iter_mut().for_each(|corner| corner.normal = normal);
    }
}

fn triangle_normal([a, b, c]: [Vec3; 3]) -> Vec3 {
    (b - a).cross(c - a).try_normalize().unwrap_or(Vec3::Y)
}

fn replace_zero_normals(vertices: &mut [Vertex], indices: &[u32]) {
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
