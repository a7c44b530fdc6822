//! The scene, as far as choosing what a client holds needs to know it. Pure.

use crate::scene::numbering::{ScenePatch, SceneVertex};
use glam::Vec3;
use shadecast_protocol::ids::MeshId;
use shadecast_scene::patches::Patch;

/// Most vertices of a patch.
pub(crate) const MAX_CORNERS: usize = shadecast_protocol::limits::PATCH_MAX_VERTICES as usize;

/// The scene as far as the client's memory goes.
pub(crate) trait Geometry {
    /// The instance that a scene-wide patch number belongs to.
    fn instance_of_patch(&self, patch: ScenePatch) -> u16;
    /// Its first vertex.
    fn first_vertex(&self, instance: u16) -> SceneVertex;
    /// The mesh of an instance, and its first patch of any LOD.
    fn mesh_of(&self, instance: u16) -> (MeshId, ScenePatch);
    /// The patch; its vertices are indices within the model.
    fn patch(&self, patch: ScenePatch) -> Patch;
    /// The world position of a static vertex, `None` for one that moves.
    fn static_position(&self, vertex: SceneVertex) -> Option<Vec3>;
    /// Whether its material cuts something out.
    fn is_masked(&self, patch: ScenePatch) -> bool;
    /// Scene-wide count of vertices.
    fn vertex_count(&self) -> usize;
}

/// The corners of a patch, as indices within the model.
pub(crate) fn corners(patch: Patch) -> impl Iterator<Item = u32> {
    patch.vertices.into_iter().take(patch.kind.vertex_count())
}

/// Scene-wide numbers of a patch's vertices.
pub(crate) fn vertices_of_patch(
    geometry: &impl Geometry,
    patch: ScenePatch,
) -> impl Iterator<Item = SceneVertex> {
    let first = geometry.first_vertex(geometry.instance_of_patch(patch));
    corners(geometry.patch(patch)).map(move |corner| first.plus(corner))
}

/// Static geometry for tests that care for no place.
#[cfg(test)]
pub(crate) mod test_geometry {
    use super::*;
    use shadecast_protocol::atlas::PatchKind;

    fn triangle(vertices: [u32; 3]) -> Patch {
        let [a, b, c] = vertices;
        Patch { vertices: [a, b, c, a, a], kind: PatchKind::One, material: 0, double_sided: false }
    }

    macro_rules! geometry {
        ($(#[$doc:meta])* $name:ident, $corners:expr, $vertices:expr) => {
            $(#[$doc])*
            pub(crate) struct $name {
                pub patches: u32,
            }

            impl Geometry for $name {
                fn instance_of_patch(&self, _: ScenePatch) -> u16 {
                    0
                }
                fn first_vertex(&self, _: u16) -> SceneVertex {
                    SceneVertex(0)
                }
                fn mesh_of(&self, _: u16) -> (MeshId, ScenePatch) {
                    (MeshId(0), ScenePatch(0))
                }
                fn patch(&self, patch: ScenePatch) -> Patch {
                    triangle($corners(patch.0))
                }
                fn static_position(&self, _: SceneVertex) -> Option<Vec3> {
                    Some(Vec3::ZERO)
                }
                fn is_masked(&self, _: ScenePatch) -> bool {
                    false
                }
                fn vertex_count(&self) -> usize {
                    $vertices(self.patches) as usize
                }
            }
        };
    }

    geometry!(
        /// Triangles with nothing in common.
        Loose,
        |patch: u32| [3 * patch, 3 * patch + 1, 3 * patch + 2],
        |patches: u32| 3 * patches
    );
    geometry!(
        /// Triangles side by side around vertex 0.
        Fan,
        |patch: u32| [0, patch + 1, patch + 2],
        |patches: u32| patches + 2
    );
}
