//! Bones as geometry, for files with a skeleton and no mesh. Without it nothing would be visible.

use super::hierarchy::Hierarchy;
use crate::limits::MAX_PALETTE;
use crate::{Bone, Material, Model, PaletteEntry, Primitive, Vertex, tangent};
use glam::{Affine3A, Vec3};

/// Others are damaged, or joints at one place.
const LENGTHS_M: std::ops::Range<f32> = 1e-6..1e6;

/// Of a bone's length: where it is thickest, and how thick.
const THICKEST: f32 = 0.15;
const RADIUS: f32 = 0.1;

/// Adds a long octahedron from every bone of the skeleton to each of its children. False where there is none.
pub(super) fn add(scene: &ufbx::Scene, hierarchy: &Hierarchy, model: &mut Model) -> bool {
    for node in hierarchy.shown(scene).filter(|node| node.attrib_type == ufbx::ElementType::Bone) {
        let Some(parent) = node.parent.as_deref() else { continue };
        let bone: &Bone = &hierarchy.bones[hierarchy.bone(node) as usize];
        let of_skeleton = parent.attrib_type == ufbx::ElementType::Bone && !parent.is_root;
        if of_skeleton
            && LENGTHS_M.contains(&bone.rest.translation.length())
            && model.palette.len() < MAX_PALETTE
        {
            let joint = model.palette.len() as u16;
            let entry = PaletteEntry { bone: hierarchy.bone(parent), bone_from_mesh: Affine3A::IDENTITY };
            model.palette.push(entry);
            add_octahedron(bone.rest.translation, joint, model);
        }
    }
    if model.indices.is_empty() {
        return false;
    }
    let index_count = model.indices.len() as u32;
    model.primitives.push(Primitive { first_index: 0, index_count, material: model.materials.len() as u32 });
    model.materials.push(Material { name: "skeleton".into(), ..Material::default() });
    true
}

/// From the origin to `tip`, with flat faces.
fn add_octahedron(tip: Vec3, joint: u16, model: &mut Model) {
    let (side, other) = (tip / tip.length()).any_orthonormal_pair();
    let rim = [side, other, -side, -other].map(|way| tip * THICKEST + way * (tip.length() * RADIUS));
    for corner in 0..4 {
        let (a, b) = (rim[corner], rim[(corner + 1) % 4]);
        for triangle in [[a, b, tip], [b, a, Vec3::ZERO]] {
            add_triangle(triangle, joint, model);
        }
    }
}

fn add_triangle(corners: [Vec3; 3], joint: u16, model: &mut Model) {
    let [a, b, c] = corners;
    let normal = (b - a).cross(c - a).try_normalize().unwrap_or(Vec3::Y);
    let tangent = tangent::arbitrary(normal);
    for position in corners {
        model.indices.push(model.vertices.len() as u32);
        model.vertices.push(Vertex { position, normal, tangent, joints: [joint; 4], ..Vertex::default() });
    }
}
