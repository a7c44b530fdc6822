//! The faces of a mesh that share a material to vertices and triangles: polygons triangulated, one vertex for each
//! corner first, then equal ones welded.

use super::convert::vec3;
use super::morph::Shapes;
use super::part::Part;
use super::skin::{self, Binding};
use crate::error::Fault;
use crate::gltf::mesh::replace_zero_normals;
use crate::import::Warnings;
use crate::{TextureSlot, Vertex, tangent, weld};
use glam::Vec3;

pub(super) fn note_what_is_left_out(mesh: &ufbx::Mesh, warnings: &mut Warnings) {
    skin::note_what_is_approximate(mesh, warnings);
    let smooth = mesh.subdivision_display_mode;
    if matches!(smooth, ufbx::SubdivisionDisplayMode::Smooth | ufbx::SubdivisionDisplayMode::HullAndSmooth) {
        warnings.insert("subdivision is ignored; meshes keep their control cage".into());
    }
    if mesh.uv_sets.len() > 2 {
        warnings.insert("only the first two sets of texture coordinates are used".into());
    }
}

/// What one part is read from.
pub(super) struct Source<'a> {
    pub(super) mesh: &'a ufbx::Mesh,
    pub(super) part: &'a ufbx::MeshPart,
    pub(super) binding: &'a Binding,
    pub(super) shapes: &'a Shapes,
    pub(super) element: &'a str,
}

impl Source<'_> {
    pub(super) fn read(
        &self,
        normal_map: Option<&TextureSlot>,
        warnings: &mut Warnings,
    ) -> Result<Part, Fault> {
        let corners = self.corners();
        let mut vertices = Vec::with_capacity(corners.len());
        for corner in &corners {
            vertices.push(self.vertex(*corner as usize, warnings)?);
        }
        let mut indices: Vec<u32> = (0..vertices.len() as u32).collect();
        if vertices.iter().any(|vertex| vertex.normal == Vec3::ZERO) {
            warnings.insert("normals of length 0 are replaced".into());
            replace_zero_normals(&mut vertices, &indices);
        }
        match normal_map {
            None => vertices.iter_mut().for_each(|vertex| vertex.tangent = tangent::arbitrary(vertex.normal)),
            Some(normal_map) if !tangent::generate(&mut vertices, normal_map) => {
                warnings.insert("tangents of very large triangle fans are approximate".into());
            }
            Some(_) => {}
        }
        if self.binding.mirrored {
            turn_over(&mut vertices, &mut indices);
        }
        let control_point = |corner: u32| {
            let corner = corners[corner as usize] as usize;
            self.mesh.vertex_indices.get(corner).copied().unwrap_or(0)
        };
        let class = |corner: u32| self.shapes.class(control_point(corner));
        let origins = weld::weld_within_classes(&mut vertices, &mut indices, class);
        let control_points = origins.into_iter().map(control_point).collect();
        Ok(Part { vertices, indices, control_points, tangents: normal_map.is_some() })
    }

    /// Three for each triangle, as indices of the mesh's polygon corners.
    fn corners(&self) -> Vec<u32> {
        let mesh = self.mesh;
        let mut corners = Vec::with_capacity(3 * self.part.num_triangles);
        let mut triangles = vec![0; 3 * mesh.max_face_triangles];
        for face in &*self.part.face_indices {
            let hole = mesh.face_hole.get(*face as usize).copied().unwrap_or(false);
            let Some(face) = mesh.faces.get(*face as usize).filter(|face| !hole && face.num_indices >= 3)
            else {
                continue;
            };
            let count = ufbx::triangulate_face(&mut triangles, mesh, *face) as usize;
            corners.extend_from_slice(&triangles[..3 * count]);
        }
        corners
    }

    fn vertex(&self, corner: usize, warnings: &mut Warnings) -> Result<Vertex, Fault> {
        let mesh = self.mesh;
        let control_point = mesh.vertex_indices.get(corner).copied().unwrap_or(0);
        let position = value(&mesh.vertex_position.values, &mesh.vertex_position.indices, corner).map(vec3);
        let Some(position) = position.filter(|position| position.is_finite()) else {
            return Err(Fault::new(
                self.element,
                format!("control point {control_point} is not a finite position"),
            ));
        };
        let normal = value(&mesh.vertex_normal.values, &mesh.vertex_normal.indices, corner);
        let (joints, weights) = self.binding.at(control_point);
        Ok(Vertex {
            position,
            normal: normal.map_or(Vec3::ZERO, unit),
            uv: self.texture_coordinates(0, corner, warnings),
            uv1: self.texture_coordinates(1, corner, warnings),
            color: self.color(corner),
            joints,
            weights,
            ..Vertex::default()
        })
    }

    /// FBX counts v upwards.
    fn texture_coordinates(&self, set: usize, corner: usize, warnings: &mut Warnings) -> [f32; 2] {
        let set = self.mesh.uv_sets.get(set).map(|set| &set.vertex_uv);
        let Some(uv) = set.and_then(|uv| value(&uv.values, &uv.indices, corner)) else { return [0.0; 2] };
        let uv = [uv.x as f32, (1.0 - uv.y) as f32];
        if uv.iter().all(|coordinate| coordinate.is_finite()) {
            return uv;
        }
        warnings.insert("texture coordinates that are not finite are replaced by 0".into());
        [0.0; 2]
    }

    fn color(&self, corner: usize) -> [u8; 4] {
        let color = &self.mesh.vertex_color;
        let byte = |channel: f64| (channel.clamp(0.0, 1.0) * 255.0).round() as u8;
        value(&color.values, &color.indices, corner).map_or([255; 4], |c| [c.x, c.y, c.z, c.w].map(byte))
    }
}

/// An attribute at a corner; `None` where the mesh does not have it.
fn value<T: Copy>(values: &[T], indices: &[u32], corner: usize) -> Option<T> {
    indices.get(corner).and_then(|index| values.get(*index as usize)).copied()
}

/// Zero for what has no direction. In double precision, where normals of any length have one.
fn unit(v: ufbx::Vec3) -> Vec3 {
    let length = (v.x * v.x + v.y * v.y + v.z * v.z).sqrt();
    if !(length.is_finite() && length > 0.0) {
        return Vec3::ZERO;
    }
    vec3(ufbx::Vec3 { x: v.x / length, y: v.y / length, z: v.z / length }).normalize_or_zero()
}

/// For what a transform mirrors: the other winding, and the other sign of the bitangent.
fn turn_over(vertices: &mut [Vertex], indices: &mut [u32]) {
    vertices.iter_mut().for_each(|vertex| vertex.tangent[3] = -vertex.tangent[3]);
    indices.chunks_exact_mut(3).for_each(|triangle| triangle.swap(1, 2));
}
