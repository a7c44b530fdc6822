//! The atlas as full-range BT.709 4:2:0 planes, in memory that the encoder can read.

use crate::stages::mark::nearest;
use shadecast_gpu::{
    Access, Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Image, Memory, Recorder, Sampler,
};
use shadecast_protocol::picture::I420;
use shadecast_shaders::constants::YCBCR_TEXELS;
use shadecast_shaders::generated::{YCBCR_COMP, YcbcrPush};
use std::sync::Arc;

/// The stage with its output.
pub struct Ycbcr {
    pipeline: ComputePipeline,
    group: BindGroup,
    _sampler: Sampler,
    planes: Buffer,
    readback: Buffer,
    extent: [u32; 2],
}

impl Ycbcr {
    /// Converts `atlas`, whose width is a multiple of 8 and height of 2.
    pub fn new(gpu: &Arc<Gpu>, atlas: &Image) -> Result<Self, GpuError> {
        let extent = atlas.desc().extent;
        let bytes = I420::byte_count(extent);
        let pipeline = ComputePipeline::new(gpu, &YCBCR_COMP)?;
        let sampler = Sampler::new(gpu, nearest())?;
        let planes = Buffer::new(gpu, "planes", bytes, Memory::Device)?;
        let readback = Buffer::new(gpu, "planes for the encoder", bytes, Memory::Readback)?;
        let group = BindGroup::new(
            pipeline.layout(),
            &[("atlas", Bind::Sampled(atlas, &sampler)), ("Planes", Bind::Buffer(&planes))],
        )?;
        Ok(Self { pipeline, group, _sampler: sampler, planes, readback, extent })
    }

    /// Converts and copies to where the CPU reads.
    pub fn record(&self, recorder: &mut Recorder) {
        let [width, height] = self.extent;
        let push = YcbcrPush { width_texels: width, height_texels: height };
        let [across, down] = YCBCR_TEXELS;
        let items = [width.div_ceil(across), height.div_ceil(down), 1];
        recorder.dispatch(&self.pipeline, &self.group, &push, items);
        recorder.barrier(Access::COMPUTE_WRITE, Access::COPY_READ);
        recorder.copy_buffer(&self.planes, 0, &self.readback, 0, self.readback.size());
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
    }

    /// Copies the picture to `picture`, once the recording has finished.
    pub fn read(&self, picture: &mut I420) {
        let bytes = &self.readback.bytes()[..I420::byte_count(self.extent) as usize];
        let read = picture.refill(self.extent, |planes| planes.extend_from_slice(bytes));
        read.expect("an atlas has even sides");
    }
}
