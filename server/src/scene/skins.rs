//! What skinning reads of meshes beside their vertices: morph targets, and vertices packed for it where that is asked for.

use crate::support::named::{UnknownName, named};
use crate::support::upload;
use shadecast_gpu::{Buffer, Gpu, GpuError};
use shadecast_scene::influences::units_of_weight;
use shadecast_scene::{Model, Vertex};
use shadecast_shaders::constants::MAX_INFLUENCES;
use shadecast_shaders::generated::{MorphDeltaGpu, PackedVertexGpu};
use std::ops::Range;
use std::sync::Arc;

/// How vertices get their matrices.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Skinning {
    /// The paper's: each vertex walks the whole parent chain of each of its bones
    PerVertexChain,
    /// Each bone once into a palette, then each vertex once
    #[default]
    Palette,
    /// As palette, from compact vertices, each number of influences by itself
    Packed,
}

impl Skinning {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::PerVertexChain, Self::Palette, Self::Packed];

    /// Its name, as a person writes it.
    pub fn name(self) -> &'static str {
        match self {
            Self::PerVertexChain => "per-vertex-chain",
            Self::Palette => "palette",
            Self::Packed => "packed",
        }
    }
}

impl std::fmt::Display for Skinning {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(self.name())
    }
}

impl std::str::FromStr for Skinning {
    type Err = UnknownName;

    fn from_str(text: &str) -> Result<Self, UnknownName> {
        named("the skinning", text, &Self::ALL, Self::name)
    }
}

/// A mesh's place in the shared buffers.
#[derive(Clone, Debug)]
pub struct SkinnedMesh {
    /// Whether any morph target moves its vertices.
    pub has_morphs: bool,
    /// Entries in the packed vertices, those of 1, 2, 3 and 4 influences; empty where [`Skinning`] does not use them.
    pub packed: [Range<u32>; MAX_INFLUENCES as usize],
}

/// Of all meshes.
pub struct SkinningBuffers {
    /// `PackedVertexGpu`.
    pub packed_vertices: Buffer,
    /// `MorphDeltaGpu`, by vertex.
    pub morph_deltas: Buffer,
}

/// What goes into [`SkinningBuffers`], collected mesh by mesh.
pub(crate) struct SkinningArrays {
    skinning: Skinning,
    packed: Vec<PackedVertexGpu>,
    morph_deltas: Vec<MorphDeltaGpu>,
}

impl SkinningArrays {
    /// Nothing yet.
    pub(crate) fn new(skinning: Skinning) -> Self {
        Self { skinning, packed: Vec::new(), morph_deltas: Vec::new() }
    }

    /// Adds a model's mesh; gives by vertex the first of its morph deltas and their number, too.
    pub(crate) fn add(&mut self, model: &Model) -> (SkinnedMesh, Vec<[u32; 2]>) {
        let is_packed = self.skinning == Skinning::Packed;
        let packed = if is_packed { self.add_packed(model) } else { Default::default() };
        (SkinnedMesh { has_morphs: !model.morphs.is_empty(), packed }, self.add_morphs(model))
    }

    /// Brings all to the device.
    pub(crate) fn upload(&self, gpu: &Arc<Gpu>) -> Result<SkinningBuffers, GpuError> {
        Ok(SkinningBuffers {
            packed_vertices: upload::array(gpu, "packed vertices", &self.packed)?,
            morph_deltas: upload::array(gpu, "morph targets", &self.morph_deltas)?,
        })
    }

    /// Sorts the morph targets' deltas by vertex; returns the first delta of each vertex and their number.
    fn add_morphs(&mut self, model: &Model) -> Vec<[u32; 2]> {
        let mut of_vertex: Vec<Vec<MorphDeltaGpu>> = vec![Vec::new(); model.vertices.len()];
        for (morph, source) in model.morphs.iter().enumerate() {
            for delta in &source.deltas {
                of_vertex[delta.vertex as usize].push(MorphDeltaGpu {
                    position: delta.position.to_array(),
                    morph: morph as u32,
                    normal: delta.normal.to_array(),
                    tangent: delta.tangent.to_array(),
                    reserved0: 0,
                    reserved1: 0,
                });
            }
        }
        let place = |deltas: Vec<MorphDeltaGpu>| {
            let range = [self.morph_deltas.len() as u32, deltas.len() as u32];
            self.morph_deltas.extend(deltas);
            range
        };
        of_vertex.into_iter().map(place).collect()
    }

    /// Positions with their influences, sorted by the number of influences.
    fn add_packed(&mut self, model: &Model) -> [Range<u32>; MAX_INFLUENCES as usize] {
        [1, 2, 3, 4].map(|count| {
            let first = self.packed.len() as u32;
            let vertices = (0..).zip(&model.vertices).filter(|(_, v)| v.influences().max(1) == count);
            self.packed.extend(vertices.map(|(index, v)| packed(index, v)));
            first..self.packed.len() as u32
        })
    }
}

fn packed(index: u32, v: &Vertex) -> PackedVertexGpu {
    let (joints, weights) = used_first(v);
    let units = weights.map(units_of_weight);
    let [x, y, z] = v.position.to_array().map(f32::to_bits);
    PackedVertexGpu {
        position_joints: [x, y, z, pair(joints[0], joints[1])],
        influences: [pair(joints[2], joints[3]), pair(units[0], units[1]), pair(units[2], units[3]), index],
    }
}

/// A vertex's influences in their order, those of weight 0 last: shaders stop at the first one.
pub(crate) fn used_first(v: &Vertex) -> ([u16; 4], [f32; 4]) {
    let mut order = [0, 1, 2, 3];
    order.sort_by_key(|influence| v.weights[*influence] <= 0.0);
    (order.map(|influence| v.joints[influence]), order.map(|influence| v.weights[influence]))
}

/// Two halves of a word.
pub(crate) fn pair(low: u16, high: u16) -> u32 {
    u32::from(low) | u32::from(high) << 16
}
