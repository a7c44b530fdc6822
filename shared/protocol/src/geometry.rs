//! Geometry for the client: the vertices and patches that enter and leave its memory, and the places of patches in the atlas.
//! Motion is in [`crate::motion`], the bytes are in [`crate::delta`].

use crate::atlas::{Block, PatchKind, PixelTexels};
use crate::coverage::Coverage;
use crate::ids::{InstanceId, MeshId, PatchSlot, RestId, UpdateId, VertexSlot};
use crate::limits::STATIC_STEPS_PER_M;
use crate::motion::predicted::PredictedVertex;
use crate::motion::rest::{MeshInfo, RestVertex};
use crate::motion::skeleton::{SkeletonInfo, SkinnedInstance};
use crate::time::WorldTime;
use glam::Vec3;

/// Whole numbers of 32 bits beyond this lie two and more apart.
const MOST_STATIC_STEPS: f32 = 16_777_216.0;

/// What one update changes in the client's memory. Applied in the order: patch evictions, vertex evictions, instances,
/// what is skinned, rest vertices, new vertices, new patches, placements, coverage, settled blocks, predictions. Deltas follow each other without a gap,
/// by their sequence, of which those between updates are a part.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GeometryDelta {
    /// The update.
    pub update: UpdateId,
    /// The world's time when the update was begun.
    pub time: WorldTime,
    /// The world's time that the update's picture is shaded for.
    pub shaded: WorldTime,
    /// Instances seen for the first time, or with a new quantisation step.
    pub instances: Vec<InstanceInfo>,
    /// What is skinned by the client, as far as it has not been told.
    pub skinned: Skinned,
    /// Vertices before skinning that it has not been told, by rising numbers.
    pub new_rests: Vec<RestVertex>,
    /// Vertices that enter, by rising slots, which are free.
    pub new_vertices: Vec<NewVertex>,
    /// Patches that enter, by rising slots, which are free; their vertices are present.
    pub new_patches: Vec<NewPatch>,
    /// Patches to forget, by rising slots.
    pub evicted_patches: Vec<PatchSlot>,
    /// Vertices to forget, by rising slots; no patch uses them any more.
    pub evicted_vertices: Vec<VertexSlot>,
    /// Patches whose block changes with this update's picture, by rising slots; `None`: it has none, do not draw it.
    pub placements: Vec<(PatchSlot, Option<Block>)>,
    /// Of the patches that get a block with this update, those that do not cover all of it. What is not among them is opaque.
    pub coverage: Vec<(PatchSlot, Coverage)>,
    /// Blocks to copy from this update's picture to the store.
    pub settled: Vec<Settled>,
    /// Where predicted vertices will be, ascending by slots; whoever is not among them keeps what was told.
    pub predictions: Vec<PredictedVertex>,
}

/// The place nearest to `position` that a static vertex is told in a few bits: at most 31 um off along each axis. What lies far out
/// stays as it is: there numbers of 32 bits are coarser than the grid.
pub fn on_static_grid(position: Vec3) -> Vec3 {
    // With 0 added, since -0 is not on the grid.
    let on_grid = (position * STATIC_STEPS_PER_M).round() / STATIC_STEPS_PER_M + 0.0;
    if grid_steps(on_grid).is_some() { on_grid } else { position }
}

/// The steps of a place on the grid of static vertices; `None` beside it, and far out.
pub(crate) fn grid_steps(position: Vec3) -> Option<[i32; 3]> {
    let steps = position * STATIC_STEPS_PER_M;
    let is_on_grid = steps.to_array().iter().all(|c| c.fract() == 0.0 && c.abs() < MOST_STATIC_STEPS);
    // A step of -0 would come back as 0.
    let is_plain = position.to_array().iter().all(|c| c.to_bits() != (-0.0f32).to_bits());
    (is_on_grid && is_plain).then(|| steps.as_ivec3().to_array())
}

impl GeometryDelta {
    /// Says nothing any more; the memory of its lists stays.
    pub fn clear(&mut self) {
        let Self {
            update,
            time,
            shaded,
            instances,
            skinned: Skinned { skeletons, meshes, instances: skinned },
            new_rests,
            new_vertices,
            new_patches,
            evicted_patches,
            evicted_vertices,
            placements,
            coverage,
            settled,
            predictions,
        } = self;
        (*update, *time, *shaded) = (UpdateId::default(), WorldTime::default(), WorldTime::default());
        instances.clear();
        skeletons.clear();
        meshes.clear();
        skinned.clear();
        new_rests.clear();
        new_vertices.clear();
        new_patches.clear();
        evicted_patches.clear();
        evicted_vertices.clear();
        placements.clear();
        coverage.clear();
        settled.clear();
        predictions.clear();
    }

    /// How much there is to take in: vertices, patches, placements and settled blocks.
    pub fn records(&self) -> usize {
        let placed = self.placements.len() + self.coverage.len() + self.settled.len();
        let patches = self.new_patches.len() + self.evicted_patches.len() + placed;
        self.new_rests.len()
            + self.new_vertices.len()
            + self.evicted_vertices.len()
            + self.predictions.len()
            + patches
    }
}

/// A block whose colours no longer change: the client keeps a copy. From a later update on, a placement may name it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settled {
    /// Whose block it is: it lies in the atlas.
    pub slot: PatchSlot,
    /// Where the copy lies in the store: as large.
    pub to: Block,
    /// What it is filtered for.
    pub pixel: PixelTexels,
}

/// What a client needs to know to skin.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Skinned {
    /// Skeletons.
    pub skeletons: Vec<SkeletonInfo>,
    /// Meshes.
    pub meshes: Vec<MeshInfo>,
    /// Instances of them, each once.
    pub instances: Vec<SkinnedInstance>,
}

/// An instance with samples, as far as a client needs to know it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InstanceInfo {
    /// The instance.
    pub instance: InstanceId,
    /// Quantisation step of its vertices' samples in metres, `MIN_STEP_M..=MAX_STEP_M`.
    pub step_m: f32,
}

/// A vertex that enters the client's memory.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NewVertex {
    /// Its place.
    pub slot: VertexSlot,
    /// Whose it is.
    pub instance: InstanceId,
    /// Its number within the mesh.
    pub number: u32,
    /// How it moves.
    pub motion: Motion,
}

/// How a vertex moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Motion {
    /// Not at all.
    Static {
        /// In the world, metres.
        position: Vec3,
    },
    /// By samples on the grid: see [`crate::motion`].
    Sampled,
    /// By what updates predict: see [`crate::motion::predicted`].
    Predicted,
    /// With its instance's skeleton, by the client itself.
    Skinned {
        /// Where it is before skinning.
        rest: RestId,
    },
}

/// A patch that enters the client's memory. It has no block until a placement gives it one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NewPatch {
    /// Its place.
    pub slot: PatchSlot,
    /// Whose it is.
    pub instance: InstanceId,
    /// The mesh of this instance.
    pub mesh: MeshId,
    /// Its number within the mesh, over all LODs. What is told of a patch once is known of all instances.
    pub number: u32,
    /// Number and arrangement of its triangles.
    pub kind: PatchKind,
    /// Its vertices; entries that the kind does not use repeat the first.
    pub vertices: [VertexSlot; 5],
    /// Seen from behind too. Others are not drawn from there: behind a thin surface lies its other side.
    pub double_sided: bool,
}
