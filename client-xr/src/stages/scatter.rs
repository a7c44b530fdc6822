//! The client's vertex memory on the GPU, and what writes deltas into it (`client_scatter.comp`).

use super::FRAMES_IN_FLIGHT;
use crate::motion::arrivals::VertexWrites;
use crate::motion::skinned::SkinCapacity;
use shadecast_gpu::{Access, Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Memory, Recorder};
use shadecast_shaders::generated::{CLIENT_SCATTER_COMP, RestGpu, ScatterPush, VertexWriteGpu};
use std::sync::Arc;

/// Records that one display frame can write; what is more waits for the next.
const STAGING_RECORDS: u32 = 200_000;

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

/// What one connection needs to write: a staging buffer per frame in flight.
pub struct ScatterStaging {
    in_flight: [(Buffer, BindGroup); FRAMES_IN_FLIGHT],
    records: usize,
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

    /// Staging for `memory`.
    pub fn staging(&self, gpu: &Arc<Gpu>, memory: &VertexMemory) -> Result<ScatterStaging, GpuError> {
        let records = (memory.vertex_slots * (memory.sample_ring + 1)).min(STAGING_RECORDS) as usize;
        let bytes = (records * size_of::<VertexWriteGpu>()) as u64;
        let of_frame = || {
            let staging = Buffer::new(gpu, "vertex staging", bytes, Memory::Upload)?;
            let binds = [
                ("Samples", Bind::Buffer(&memory.samples)),
                ("Positions", Bind::Buffer(&memory.positions)),
                ("Blends", Bind::Buffer(&memory.blends)),
                ("Writes", Bind::Buffer(&staging)),
                ("Skins", Bind::Buffer(&memory.skins)),
                ("Rests", Bind::Buffer(&memory.rests)),
            ];
            let group = BindGroup::new(self.pipeline.layout(), &binds)?;
            Ok::<_, GpuError>((staging, group))
        };
        Ok(ScatterStaging { in_flight: [of_frame()?, of_frame()?, of_frame()?], records })
    }

    /// Writes what waits in `writes`, as far as the staging buffer of frame in flight `flight` reaches. Its last
    /// recording has finished.
    pub fn record(
        &self,
        recorder: &mut Recorder,
        staging: &mut ScatterStaging,
        flight: usize,
        memory: &VertexMemory,
        writes: &mut VertexWrites,
    ) {
        let (buffer, group) = &mut staging.in_flight[flight];
        let bytes = staging.records * size_of::<VertexWriteGpu>();
        let records: &mut [VertexWriteGpu] = bytemuck::cast_slice_mut(&mut buffer.bytes_mut()[..bytes]);
        writes.drain_into(records, |range| {
            let count = range.end - range.start;
            let (vertex_slots, sample_ring) = (memory.vertex_slots, memory.sample_ring);
            let push = ScatterPush { first: range.start, count, vertex_slots, sample_ring };
            recorder.dispatch(&self.pipeline, group, &push, [count, 1, 1]);
            recorder.barrier(Access::COMPUTE, Access::COMPUTE);
        });
    }
}
