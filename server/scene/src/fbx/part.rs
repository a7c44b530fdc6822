//! The parts of a mesh, one per material, before shapes move them.

use crate::Vertex;

/// The triangles of one material of a mesh, in mesh space.
pub(super) struct Part {
    pub(super) vertices: Vec<Vertex>,
    pub(super) indices: Vec<u32>,
    /// The control point of each vertex, which is what shapes move.
    pub(super) control_points: Vec<u32>,
    /// Whether anything reads the tangents.
    pub(super) tangents: bool,
}
