//! What skinned instances are evaluated from and into on the GPU, and what writes arrivals into the arena.

use super::FRAMES_IN_FLIGHT;
use crate::motion::arena::{ArenaCopy, ArenaWrites, WORD_BYTES};
use crate::motion::skinned::SkinCapacity;
use shadecast_gpu::{Access, Buffer, Gpu, GpuError, Memory, Recorder};
use shadecast_shaders::constants::AFFINE_ROWS;
use std::sync::Arc;

/// Bytes that one display frame can write; what is more waits for the next.
const STAGING_BYTES: u64 = 512 << 10;
/// Copies without a barrier between them at most, so that looking for common bytes among them stays cheap.
const UNORDERED_COPIES: usize = 64;

/// One connection's memory for skeletons, clips and palettes.
pub struct SkinMemory {
    /// 16-byte words that the server manages: tracks, keys, hierarchies, morph deltas.
    pub arena: Buffer,
    /// Bones of one display frame, rows.
    pub globals: Buffer,
    /// `world_from_mesh` by palette entry, rows.
    pub palettes: Buffer,
    /// Morph weights, by places of the palettes.
    pub morph_weights: Buffer,
}

/// What one connection needs to write its arena: a staging buffer per frame in flight.
pub struct ArenaStaging {
    in_flight: [Buffer; FRAMES_IN_FLIGHT],
    /// Of the frame that is being recorded.
    copies: Vec<ArenaCopy>,
}

impl SkinMemory {
    /// Empty memory; `recorder` clears it.
    pub fn new(gpu: &Arc<Gpu>, recorder: &mut Recorder, capacity: SkinCapacity) -> Result<Self, GpuError> {
        let SkinCapacity { arena_words, palette_entries, bones, .. } = capacity;
        let rows = |count: u32| u64::from(count) * u64::from(AFFINE_ROWS) * 16;
        let arena_bytes = u64::from(arena_words) * WORD_BYTES as u64;
        let memory = Self {
            arena: Buffer::new(gpu, "arena", arena_bytes, Memory::Device)?,
            globals: Buffer::new(gpu, "bone transforms", rows(bones), Memory::Device)?,
            palettes: Buffer::new(gpu, "palettes", rows(palette_entries), Memory::Device)?,
            morph_weights: Buffer::new(gpu, "morph weights", u64::from(palette_entries) * 4, Memory::Device)?,
        };
        let all = [&memory.arena, &memory.globals, &memory.palettes, &memory.morph_weights];
        all.into_iter().for_each(|buffer| recorder.fill(buffer, 0));
        recorder.barrier(Access::COPY_WRITE, Access::COMPUTE);
        recorder.barrier(Access::COPY_WRITE, Access::COPY_WRITE);
        Ok(memory)
    }

    /// Bytes of its buffers.
    pub fn bytes(&self) -> u64 {
        let Self { arena, globals, palettes, morph_weights } = self;
        [arena, globals, palettes, morph_weights].into_iter().map(Buffer::size).sum()
    }
}

impl ArenaStaging {
    /// Staging for one connection.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, GpuError> {
        let of_frame = || Buffer::new(gpu, "arena staging", STAGING_BYTES, Memory::Upload);
        let in_flight = [of_frame()?, of_frame()?, of_frame()?];
        Ok(Self { in_flight, copies: Vec::with_capacity(UNORDERED_COPIES) })
    }

    /// Copies what waits in `writes`, as far as the staging buffer of frame in flight `flight` reaches. Its last recording has
    /// finished.
    pub fn record(
        &mut self,
        recorder: &mut Recorder,
        flight: usize,
        memory: &SkinMemory,
        writes: &mut ArenaWrites,
    ) {
        let Self { in_flight, copies } = self;
        let staging = &mut in_flight[flight];
        copies.clear();
        writes.drain_into(staging.bytes_mut(), |copy| copies.push(copy));
        let mut ordered = 0;
        for (index, copy) in copies.iter().enumerate() {
            let unordered = &copies[ordered..index];
            if unordered.len() == UNORDERED_COPIES || unordered.iter().any(|other| other.overlaps(copy)) {
                recorder.barrier(Access::COPY_WRITE, Access::COPY_WRITE);
                ordered = index;
            }
            let bytes = copy.staged.end - copy.staged.start;
            recorder.copy_buffer(staging, copy.staged.start, &memory.arena, copy.arena_byte, bytes);
        }
    }
}
