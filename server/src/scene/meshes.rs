//! Vertices, triangles and patches of all models, at every LOD; equal meshes are there once.

use crate::scene::skins::{pair, used_first};
use crate::support::upload;
use shadecast_gpu::{Buffer, Gpu, GpuError};
use shadecast_scene::patches::Patch;
use shadecast_scene::{Model, Primitive, Vertex};
use shadecast_shaders::generated::{PatchGpu, VertexGpu};
use std::sync::Arc;

/// A mesh's place in the shared buffers.
#[derive(Clone, Debug)]
pub struct Mesh {
    /// First entry in the vertex buffer.
    pub vertex_base: u32,
    /// Vertices.
    pub vertex_count: u32,
    /// Its LODs, the finest first; there is one at least.
    pub lods: Arc<[MeshLod]>,
}

/// An LOD of a mesh.
#[derive(Clone, Debug)]
pub struct MeshLod {
    /// First entry in the index buffer; a third of it is the first entry in `patch_of_triangle`.
    pub index_base: u32,
    /// Ranges of its indices, from `index_base` on.
    pub primitives: Vec<Primitive>,
    /// First entry in the patch buffer.
    pub patch_base: u32,
    /// The patches, for the CPU.
    pub patches: Vec<Patch>,
    /// Distance of its surface from the finest LOD's at most, metres of the model.
    pub error_m: f32,
    /// Vertices that its triangles use.
    pub vertices: u32,
    /// So many vertices, in [`Meshes::vertex_order`], hold those of this LOD and of all coarser ones.
    pub skinned: u32,
    /// Triangles that a client draws for it: of two sides twice.
    pub triangles: u32,
}

/// The meshes of all models.
pub struct Meshes {
    /// `VertexGpu`.
    pub vertices: Buffer,
    /// The vertices of each mesh, numbers within it, from its `vertex_base` on: those of the coarsest LOD first.
    pub vertex_order: Buffer,
    /// Three a triangle, numbers within the mesh.
    pub indices: Buffer,
    /// `PatchGpu`.
    pub patches: Buffer,
    /// Number of the patch within the mesh, by triangle.
    pub patch_of_triangle: Buffer,
}

/// What goes into [`Meshes`], collected mesh by mesh.
#[derive(Default)]
pub(super) struct MeshArrays {
    vertices: Vec<VertexGpu>,
    vertex_order: Vec<u32>,
    indices: Vec<u32>,
    patches: Vec<PatchGpu>,
    patch_of_triangle: Vec<u32>,
}

impl MeshArrays {
    /// Adds a model's mesh; `morphs` says by vertex which morph deltas move it.
    pub(super) fn add(&mut self, model: &Model, morphs: &[[u32; 2]]) -> Mesh {
        let coarsest = coarsest_lods(model);
        let mesh = Mesh {
            vertex_base: self.vertices.len() as u32,
            vertex_count: model.vertices.len() as u32,
            lods: (0..=model.lods.len()).map(|lod| self.add_lod(model, lod, &coarsest)).collect(),
        };
        let first = self.vertex_order.len();
        self.vertex_order.extend(0..mesh.vertex_count);
        self.vertex_order[first..].sort_by_key(|vertex| std::cmp::Reverse(coarsest[*vertex as usize]));
        self.vertices.extend(model.vertices.iter().zip(morphs).map(|(v, morphs)| vertex(v, *morphs)));
        mesh
    }

    fn add_lod(&mut self, model: &Model, lod: usize, coarsest: &[usize]) -> MeshLod {
        let (triangles, patches) = (model.triangles(lod), model.patches_of(lod).into_owned());
        let added = MeshLod {
            index_base: self.indices.len() as u32,
            primitives: triangles.primitives.to_vec(),
            patch_base: self.patches.len() as u32,
            error_m: lod.checked_sub(1).map_or(0.0, |lod| model.lods[lod].error_m),
            vertices: used_vertices(triangles.indices, model.vertices.len()),
            skinned: coarsest.iter().filter(|of_vertex| **of_vertex >= lod).count() as u32,
            triangles: patches.patches.iter().map(Patch::drawn_triangles).sum(),
            patches: patches.patches,
        };
        self.indices.extend(triangles.indices);
        self.patches.extend(added.patches.iter().map(|p| PatchGpu {
            vertices: p.vertices,
            kind: p.kind as u32,
            material: p.material,
            reserved: 0,
        }));
        self.patch_of_triangle.extend(&patches.patch_of_triangle);
        added
    }

    /// Brings all to the device.
    pub(super) fn upload(&self, gpu: &Arc<Gpu>) -> Result<Meshes, GpuError> {
        Ok(Meshes {
            vertices: upload::array(gpu, "vertices", &self.vertices)?,
            vertex_order: upload::array(gpu, "order of vertices", &self.vertex_order)?,
            indices: upload::array(gpu, "indices", &self.indices)?,
            patches: upload::array(gpu, "patches", &self.patches)?,
            patch_of_triangle: upload::array(gpu, "patch of triangle", &self.patch_of_triangle)?,
        })
    }
}

/// How many vertices of so many a list of triangles uses.
fn used_vertices(indices: &[u32], vertices: usize) -> u32 {
    let mut is_used = vec![false; vertices];
    indices.iter().for_each(|index| is_used[*index as usize] = true);
    is_used.into_iter().filter(|used| *used).count() as u32
}

/// By vertex the coarsest LOD that uses it.
fn coarsest_lods(model: &Model) -> Vec<usize> {
    let mut coarsest = vec![0; model.vertices.len()];
    for lod in 0..=model.lods.len() {
        model.triangles(lod).indices.iter().for_each(|index| coarsest[*index as usize] = lod);
    }
    coarsest
}

fn vertex(v: &Vertex, morphs: [u32; 2]) -> VertexGpu {
    let (joints, weights) = used_first(v);
    VertexGpu {
        position_u: v.position.extend(v.uv[0]).to_array(),
        normal_v: v.normal.extend(v.uv[1]).to_array(),
        tangent: v.tangent,
        weights,
        joints: [pair(joints[0], joints[1]), pair(joints[2], joints[3])],
        morphs,
        uv1: v.uv1,
        color: u32::from_le_bytes(v.color),
        reserved: 0,
    }
}
