//! Input and output buffers of skinned instances on the GPU, and the pass that writes arrivals into the arena.

use super::batch::{Batch, OrderedCopy};
use crate::motion::arena::WORD_BYTES;
use crate::motion::skinned::SkinCapacity;
use shadecast_gpu::{Access, Buffer, Gpu, GpuError, Memory, Recorder};
use shadecast_shaders::constants::AFFINE_ROWS;
use std::sync::Arc;

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

    /// Copies what a batch has for the arena.
    pub fn record(&self, recorder: &mut Recorder, batch: &Batch) {
        for OrderedCopy { copy, is_ordered } in &batch.copies {
            if *is_ordered {
                recorder.barrier(Access::COPY_WRITE, Access::COPY_WRITE);
            }
            let bytes = copy.staged.end - copy.staged.start;
            recorder.copy_buffer(&batch.arena, copy.staged.start, &self.arena, copy.arena_byte, bytes);
        }
    }
}
