//! Visibility's second half: the union of the ID buffers as one word per entry.

use ash::vk;
use shadecast_gpu::{
    Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Image, Memory, Part, Recorder, Sampler,
    SamplerDesc,
};
use shadecast_shaders::generated::MARK_COMP;
use std::sync::Arc;

/// The stage with its output.
pub struct Mark {
    pipeline: ComputePipeline,
    group: BindGroup,
    _sampler: Sampler,
    /// One word per entry: 1 where it is visible.
    pub visible: Buffer,
}

impl Mark {
    /// Reads `id_buffer`, marks at most so many `entries`.
    pub fn new(gpu: &Arc<Gpu>, id_buffer: &Image, entries: u32) -> Result<Self, GpuError> {
        let pipeline = ComputePipeline::new(gpu, &MARK_COMP)?;
        let sampler = Sampler::new(gpu, nearest())?;
        let visible = Buffer::new(gpu, "visible patches", u64::from(entries) * 4, Memory::Device)?;
        let group = BindGroup::new(
            pipeline.layout(),
            &[("id_buffer", Bind::Sampled(id_buffer, &sampler)), ("Visible", Bind::Buffer(&visible))],
        )?;
        Ok(Self { pipeline, group, _sampler: sampler, visible })
    }

    /// About half of each side of an ID buffer of `extent`, as [`Self::record`] takes it.
    pub(crate) fn half_of(&self, extent: [u32; 2]) -> [u32; 2] {
        let workgroup = self.pipeline.workgroup();
        [0, 1].map(|axis| (extent[axis] / 2).next_multiple_of(workgroup[axis]).min(extent[axis]))
    }

    /// Marks what a part of the ID buffer shows, in its first layer alone or in both. Its sides are the buffer's, or multiples of a
    /// workgroup's: what lies beyond is of another update.
    pub fn record(&self, recorder: &mut Recorder, Part { extent: [width, height], first_alone }: Part) {
        let layers = if first_alone { 1 } else { 2 };
        recorder.dispatch(&self.pipeline, &self.group, &[0u32; 0], [width, height, layers]);
    }
}

/// For images that are read texel by texel.
pub(crate) fn nearest() -> SamplerDesc {
    SamplerDesc::clamped(vk::Filter::NEAREST)
}
