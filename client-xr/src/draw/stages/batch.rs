//! A worker's batch of arrivals about vertices and skeletons: bytes that the GPU copies and scatters, their destinations, and
//! their changes to the render thread's tables.

use crate::motion::Motion;
use crate::motion::arena::ArenaCopy;
use crate::motion::skinned::SkinnedChange;
use crate::motion::state::MotionState;
use shadecast_gpu::{Buffer, Gpu, GpuError, Memory};
use shadecast_shaders::generated::VertexWriteGpu;
use std::ops::Range;
use std::sync::Arc;

/// Records of a batch at most; what is more waits for the next.
const STAGING_RECORDS: u32 = 200_000;
/// Bytes for the arena of a batch at most; what is more waits for the next.
const STAGING_BYTES: u64 = 512 << 10;
/// Batches of a connection: one that is written, and those of the frames that the CPU may be ahead.
pub const BATCHES: usize = super::FRAMES_IN_FLIGHT + 1;
/// Copies without a barrier between them at most, so that looking for common bytes among them stays cheap.
const UNORDERED_COPIES: usize = 64;

/// See the module.
pub struct Batch {
    /// Which of its connection's.
    pub index: usize,
    /// Vertex records.
    pub vertices: Buffer,
    records: usize,
    /// Records that do not depend on each other; a barrier lies between two ranges.
    pub ranges: Vec<Range<u32>>,
    /// Bytes for the arena.
    pub arena: Buffer,
    /// Where they go.
    pub copies: Vec<OrderedCopy>,
    /// What changes in the tables of skinned instances, before any of it is written.
    pub changes: Vec<SkinnedChange>,
    /// How the newest draw list stands with it.
    pub state: MotionState,
}

/// A copy into the arena.
#[derive(Clone, Debug)]
pub struct OrderedCopy {
    /// From where to where.
    pub copy: ArenaCopy,
    /// Whether it must wait for those before it.
    pub is_ordered: bool,
}

impl Batch {
    /// An empty one of a connection with so many vertex slots and steps kept of each.
    pub fn new(gpu: &Arc<Gpu>, index: usize, vertex_slots: u32, sample_ring: u32) -> Result<Self, GpuError> {
        let records = (vertex_slots * (sample_ring + 1)).min(STAGING_RECORDS) as usize;
        let bytes = (records * size_of::<VertexWriteGpu>()) as u64;
        Ok(Self {
            index,
            vertices: Buffer::new(gpu, "vertex staging", bytes, Memory::Upload)?,
            records,
            ranges: Vec::with_capacity(16),
            arena: Buffer::new(gpu, "arena staging", STAGING_BYTES, Memory::Upload)?,
            copies: Vec::with_capacity(UNORDERED_COPIES),
            changes: Vec::with_capacity(64),
            state: MotionState::default(),
        })
    }

    /// Takes in what waits in `motion`, as far as there is room. The GPU is done with what was in it.
    pub fn fill(&mut self, motion: &mut Motion) {
        let Self { vertices, records, ranges, arena, copies, changes, .. } = self;
        ranges.clear();
        let bytes = *records * size_of::<VertexWriteGpu>();
        let staging: &mut [VertexWriteGpu] = bytemuck::cast_slice_mut(&mut vertices.bytes_mut()[..bytes]);
        motion.writes().drain_into(staging, |range| ranges.push(range));
        copies.clear();
        let mut ordered = 0;
        motion.arena().drain_into(arena.bytes_mut(), |copy| {
            let unordered = &copies[ordered..];
            let is_full = unordered.len() == UNORDERED_COPIES;
            let is_ordered = is_full || unordered.iter().any(|other| other.copy.overlaps(&copy));
            ordered = if is_ordered { copies.len() } else { ordered };
            copies.push(OrderedCopy { copy, is_ordered });
        });
        changes.clear();
        motion.take_changes(changes);
        self.state = motion.state();
    }
}
