//! The atlas as full-range BT.709 4:2:0 planes, in memory that the encoder can read, and its alpha as coverage where the scene
//! has cutouts.

use crate::stages::mark::nearest;
use shadecast_gpu::{
    Access, Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Image, Memory, Recorder, Sampler,
};
use shadecast_protocol::atlas::Block;
use shadecast_protocol::coverage::Coverage;
use shadecast_protocol::limits::SUPERBLOCK_MIN_LOG2;
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
    /// On the device, and where the CPU reads it; of a word where the scene has no cutouts.
    coverage: [Buffer; 2],
    has_coverage: bool,
    cell_extents: Buffer,
    extent: [u32; 2],
}

impl Ycbcr {
    /// Converts `atlas`, whose width is a multiple of 8 and height of 2.
    pub fn new(gpu: &Arc<Gpu>, atlas: &Image, has_coverage: bool) -> Result<Self, GpuError> {
        let extent = atlas.desc().extent;
        let bytes = I420::byte_count(extent);
        let pipeline = ComputePipeline::new(gpu, &YCBCR_COMP)?;
        let sampler = Sampler::new(gpu, nearest())?;
        let planes = Buffer::new(gpu, "planes", bytes, Memory::Device)?;
        let readback = Buffer::new(gpu, "planes for the encoder", bytes, Memory::Readback)?;
        let words =
            if has_coverage { extent[0] * extent[1] / YCBCR_TEXELS.iter().product::<u32>() } else { 1 };
        let of_coverage = |name, memory| Buffer::new(gpu, name, u64::from(words) * 4, memory);
        let coverage = [
            of_coverage("coverage", Memory::Device)?,
            of_coverage("coverage for the CPU", Memory::Readback)?,
        ];
        let cells: u32 = extent.map(|side| side.div_ceil(1 << SUPERBLOCK_MIN_LOG2)).iter().product();
        let cell_extents = Buffer::new(gpu, "blocks of cells", u64::from(cells) * 4, Memory::Upload)?;
        let group = BindGroup::new(
            pipeline.layout(),
            &[
                ("atlas", Bind::Sampled(atlas, &sampler)),
                ("Planes", Bind::Buffer(&planes)),
                ("Coverage", Bind::Buffer(&coverage[0])),
                ("CellExtents", Bind::Buffer(&cell_extents)),
            ],
        )?;
        let _sampler = sampler;
        Ok(Self { pipeline, group, _sampler, planes, readback, coverage, has_coverage, cell_extents, extent })
    }

    /// Takes what the blocks are like in each cell: [`crate::atlas::Atlas::cell_extents`]. Chroma is made of a block's own
    /// texels. No submitted work still reads it.
    pub fn write_cells(&mut self, cell_extents: &[u32]) {
        self.cell_extents.write(0, bytemuck::cast_slice(cell_extents));
    }

    /// Converts and copies to where the CPU reads.
    pub fn record(&self, recorder: &mut Recorder) {
        let [width, height] = self.extent;
        let push = YcbcrPush {
            width_texels: width,
            height_texels: height,
            has_coverage: u32::from(self.has_coverage),
        };
        let [across, down] = YCBCR_TEXELS;
        let items = [width.div_ceil(across), height.div_ceil(down), 1];
        recorder.dispatch(&self.pipeline, &self.group, &push, items);
        recorder.barrier(Access::COMPUTE_WRITE, Access::COPY_READ);
        recorder.copy_buffer(&self.planes, 0, &self.readback, 0, self.readback.size());
        if self.has_coverage {
            let [from, to] = &self.coverage;
            recorder.copy_buffer(from, 0, to, 0, to.size());
        }
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
    }

    /// Which texels of a block are covered, once the recording has finished. The scene has cutouts.
    pub fn coverage(&self, block: Block) -> Coverage {
        let words: &[u32] = self.coverage[1].values();
        let ([across, down], [left, top, ..]) = (YCBCR_TEXELS, block.rect_texels());
        Coverage::from_fn(block.size.texels(), |texel| {
            let (x, y) = (left + texel % block.size.width(), top + texel / block.size.width());
            let word = words[(y / down * (self.extent[0] / across) + x / across) as usize];
            word >> (y % down * across + x % across) & 1 == 1
        })
    }

    /// Copies the picture to `picture`, once the recording has finished.
    pub fn read(&self, picture: &mut I420) {
        let bytes = &self.readback.bytes()[..I420::byte_count(self.extent) as usize];
        let read = picture.refill(self.extent, |planes| planes.extend_from_slice(bytes));
        read.expect("an atlas has even sides");
    }
}
