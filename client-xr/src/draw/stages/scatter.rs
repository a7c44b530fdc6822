//! The client's vertex memory on the GPU, and the pass that writes deltas into it (`client_scatter.comp`).

use super::batch::Batch;
use crate::motion::skinned::SkinCapacity;
use shadecast_gpu::{Access, Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Memory, Recorder};
use shadecast_shaders::generated::{CLIENT_SCATTER_COMP, RestGpu, ScatterPush};
use std::sync::Arc;

/// Samples, positions, blends and skins of all vertex slots, and the rests of skinned ones: see `client_vertices.glsl`.
pub struct VertexMemory {
    /// `[ring][slot]`, 16 bytes each.
    pub samples: Buffer,
    /// By slot, 16 bytes each.
    pub positions: Buffer,
    /// By slot, 16 bytes each.
    pub blends: Buffer,
    /// By slot, 8 bytes each.
    pub skins: Buffer,
    /// By number, `RestGpu`.
    pub rests: Buffer,
    /// Slots.
    pub vertex_slots: u32,
    /// Steps of the time grid that are kept of each.
    pub sample_ring: u32,
}

/// The pipeline.
pub struct Scatter {
    pipeline: ComputePipeline,
}

impl VertexMemory {
    /// Empty memory for so many slots, with what was agreed; `recorder` clears it.
    pub fn new(
        gpu: &Arc<Gpu>,
        recorder: &mut Recorder,
        vertex_slots: u32,
        SkinCapacity { rests, sample_ring, .. }: SkinCapacity,
    ) -> Result<Self, GpuError> {
        let by_slot = u64::from(vertex_slots) * 16;
        let rest_bytes = u64::from(rests) * size_of::<RestGpu>() as u64;
        let memory = Self {
            samples: Buffer::new(gpu, "vertex samples", by_slot * u64::from(sample_ring), Memory::Device)?,
            positions: Buffer::new(gpu, "vertex positions", by_slot, Memory::Device)?,
            blends: Buffer::new(gpu, "vertex blends", by_slot, Memory::Device)?,
            skins: Buffer::new(gpu, "vertex skins", by_slot / 2, Memory::Device)?,
            rests: Buffer::new(gpu, "vertex rests", rest_bytes, Memory::Device)?,
            vertex_slots,
            sample_ring,
        };
        let Self { samples, positions, blends, skins, rests, .. } = &memory;
        [samples, positions, blends, skins, rests].into_iter().for_each(|buffer| recorder.fill(buffer, 0));
        recorder.barrier(Access::COPY_WRITE, Access::COMPUTE);
        Ok(memory)
    }

    /// Bytes of its buffers.
    pub fn bytes(&self) -> u64 {
        let Self { samples, positions, blends, skins, rests, .. } = self;
        [samples, positions, blends, skins, rests].into_iter().map(Buffer::size).sum()
    }
}

impl Scatter {
    /// The pipeline.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, GpuError> {
        Ok(Self { pipeline: ComputePipeline::new(gpu, &CLIENT_SCATTER_COMP)? })
    }

    /// Bindings of a batch for `memory`.
    pub fn bind(&self, batch: &Batch, memory: &VertexMemory) -> Result<BindGroup, GpuError> {
        let binds = [
            ("Samples", Bind::Buffer(&memory.samples)),
            ("Positions", Bind::Buffer(&memory.positions)),
            ("Blends", Bind::Buffer(&memory.blends)),
            ("Writes", Bind::Buffer(&batch.vertices)),
            ("Skins", Bind::Buffer(&memory.skins)),
            ("Rests", Bind::Buffer(&memory.rests)),
        ];
        BindGroup::new(self.pipeline.layout(), &binds)
    }

    /// Writes the records of a batch, bound by `group`.
    pub fn record(&self, recorder: &mut Recorder, group: &BindGroup, memory: &VertexMemory, batch: &Batch) {
        let VertexMemory { vertex_slots, sample_ring, .. } = *memory;
        for range in &batch.ranges {
            let count = range.end - range.start;
            let push = ScatterPush { first: range.start, count, vertex_slots, sample_ring };
            recorder.dispatch(&self.pipeline, group, &push, [count, 1, 1]);
            recorder.barrier(Access::COMPUTE, Access::COMPUTE);
        }
    }
}
