//! The atlas as full-range BT.709 4:2:0 planes in memory for the encoder, and its alpha as coverage in scenes with cutouts.
//! Unchanged blocks are neither converted nor copied: their bytes stay.

use crate::visibility::passes::mark::nearest;
use shadecast_gpu::{
    Access, Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Image, Memory, Recorder, Sampler,
};
use shadecast_protocol::atlas::Block;
use shadecast_protocol::coverage::Coverage;
use shadecast_protocol::limits::SUPERBLOCK_MIN_LOG2;
use shadecast_protocol::picture::I420;
use shadecast_shaders::constants::YCBCR_TEXELS;
use shadecast_shaders::generated::{YCBCR_COMP, YcbcrPush};
use std::ops::Range;
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
    work: Work,
    converted_texels: u64,
    /// Its list on the device.
    groups: Buffer,
    extent: [u32; 2],
}

/// The workgroups that have something to convert.
#[derive(Clone, Debug)]
struct Work {
    /// Texels of a workgroup.
    texels: [u32; 2],
    columns: u32,
    /// In rows.
    is_due: Vec<bool>,
}

impl Work {
    /// All of an atlas of this extent, with workgroups of so many texels.
    fn all(extent: [u32; 2], texels: [u32; 2]) -> Self {
        let [columns, rows] = [0, 1].map(|axis| extent[axis].div_ceil(texels[axis]));
        Self { texels, columns, is_due: vec![true; (columns * rows) as usize] }
    }

    /// A block has changed.
    fn add(&mut self, block: Block) {
        let ([left, top, right, bottom], [across, down]) = (block.rect_texels(), self.texels);
        for row in top / down..bottom.div_ceil(down) {
            let at = |column: u32| (row * self.columns + column) as usize;
            self.is_due[at(left / across)..at(right.div_ceil(across))].fill(true);
        }
    }

    /// All of it is done.
    fn clear(&mut self) {
        self.is_due.fill(false);
    }

    /// The workgroups, ascending: x | y << 16.
    fn groups(&self) -> impl Iterator<Item = u32> + '_ {
        let due = self.is_due.iter().enumerate().filter(|(_, is_due)| **is_due);
        due.map(|(at, _)| (at as u32 % self.columns) | ((at as u32 / self.columns) << 16))
    }

    /// Ranges of rows of texels that hold all of it, in an atlas of this height.
    fn rows(&self, height: u32) -> impl Iterator<Item = Range<u32>> + '_ {
        let ([_, down], columns) = (self.texels, self.columns as usize);
        let count = self.is_due.len() / columns;
        let is_due = move |row: &usize| self.is_due[row * columns..][..columns].contains(&true);
        let mut from = 0;
        std::iter::from_fn(move || {
            let first = (from..count).find(is_due)?;
            from = (first..count).find(|row| !is_due(row)).unwrap_or(count);
            Some(first as u32 * down..(from as u32 * down).min(height))
        })
    }
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
        let [columns, rows, _] = pipeline.workgroup();
        let work = Work::all(extent, [columns * YCBCR_TEXELS[0], rows * YCBCR_TEXELS[1]]);
        let groups =
            Buffer::new(gpu, "changed parts of the atlas", work.is_due.len() as u64 * 4, Memory::Upload)?;
        let group = BindGroup::new(
            pipeline.layout(),
            &[
                ("atlas", Bind::Sampled(atlas, &sampler)),
                ("Planes", Bind::Buffer(&planes)),
                ("Coverage", Bind::Buffer(&coverage[0])),
                ("CellExtents", Bind::Buffer(&cell_extents)),
                ("Groups", Bind::Buffer(&groups)),
            ],
        )?;
        let _sampler = sampler;
        Ok(Self {
            pipeline,
            group,
            _sampler,
            planes,
            readback,
            coverage,
            has_coverage,
            cell_extents,
            work,
            converted_texels: 0,
            groups,
            extent,
        })
    }

    /// As it was when it was made: nothing of what was converted is left. No submitted work still uses it.
    pub(crate) fn wipe(&mut self, gpu: &Arc<Gpu>) -> Result<(), GpuError> {
        self.work.is_due.fill(true);
        self.converted_texels = 0;
        self.cell_extents.bytes_mut().fill(0);
        self.groups.bytes_mut().fill(0);
        let mut recorder = gpu.record()?;
        let [on_device, read] = &self.coverage;
        [&self.planes, &self.readback, on_device, read].into_iter().for_each(|b| recorder.fill(b, 0));
        recorder.barrier(Access::COPY_WRITE, Access::COMPUTE_WRITE);
        recorder.barrier(Access::COPY_WRITE, Access::COPY_WRITE);
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
        gpu.wait(recorder.submit()?)
    }

    /// Blocks have changed since the last conversion; all of the atlas has before the first.
    pub(crate) fn note_changed(&mut self, blocks: impl Iterator<Item = Block>) {
        blocks.for_each(|block| self.work.add(block));
    }

    /// Takes what the blocks are like in each cell: `cell_extents`. Chroma is made of a block's own
    /// texels. No submitted work still reads it.
    pub fn write_cells(&mut self, cell_extents: &[u32]) {
        self.cell_extents.write(0, bytemuck::cast_slice(cell_extents));
    }

    /// Converts what has changed and copies it to where the CPU reads. No submitted work still reads its list.
    pub fn record(&mut self, recorder: &mut Recorder) {
        let [width, height] = self.extent;
        let list: &mut [u32] = bytemuck::cast_slice_mut(self.groups.bytes_mut());
        let count =
            list.iter_mut().zip(self.work.groups()).map(|(entry, group)| *entry = group).count() as u32;
        self.converted_texels = u64::from(count) * u64::from(self.work.texels.iter().product::<u32>());
        if count == 0 {
            return;
        }
        let push = YcbcrPush {
            width_texels: width,
            height_texels: height,
            has_coverage: u32::from(self.has_coverage),
        };
        let [columns, rows, _] = self.pipeline.workgroup();
        recorder.dispatch(&self.pipeline, &self.group, &push, [columns * count, rows, 1]);
        recorder.barrier(Access::COMPUTE_WRITE, Access::COPY_READ);
        self.work.rows(height).for_each(|rows| self.copy_rows(recorder, rows));
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
        self.work.clear();
    }

    /// Texels that the last recording converted: of whole workgroups.
    pub(crate) fn converted_texels(&self) -> u64 {
        self.converted_texels
    }

    /// Copies rows of texels of all planes, an even number of them.
    fn copy_rows(&self, recorder: &mut Recorder, rows: Range<u32>) {
        let [width, height] = self.extent.map(u64::from);
        let (first, count) = (u64::from(rows.start), u64::from(rows.end - rows.start));
        // Of a row of chroma there is one for two rows of texels, and half as long.
        let mut copy = |[from, to]: [&Buffer; 2], base: u64, four_rows_bytes: u64| {
            let at = base + first * four_rows_bytes / 4;
            recorder.copy_buffer(from, at, to, at, count * four_rows_bytes / 4);
        };
        let planes = [&self.planes, &self.readback];
        copy(planes, 0, 4 * width);
        copy(planes, width * height, width);
        copy(planes, width * height * 5 / 4, width);
        if self.has_coverage {
            copy(self.coverage.each_ref(), 0, width);
        }
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

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_protocol::atlas::{BlockAddress, BlockSize};

    fn block(x: u16, y: u16, log2: u8) -> Block {
        Block { address: BlockAddress { page: 0, x, y }, size: BlockSize::new(log2, log2).expect("a size") }
    }

    #[test]
    fn workgroups_are_those_that_hold_a_texel_of_what_changed() {
        let mut work = Work::all([256, 128], [64, 16]);
        assert!(work.groups().count() == 4 * 8 && work.rows(128).eq(std::iter::once(0..128)));
        work.clear();
        assert_eq!((work.groups().count(), work.rows(128).count()), (0, 0));
        [block(60, 12, 2), block(64, 16, 6), block(252, 124, 2)]
            .into_iter()
            .for_each(|block| work.add(block));
        let group = |x: u32, y: u32| x | y << 16;
        let expected = [group(0, 0), group(1, 1), group(1, 2), group(1, 3), group(1, 4), group(3, 7)];
        assert!(work.groups().eq(expected));
        assert_eq!(work.rows(128).collect::<Vec<_>>(), [0..80, 112..128]);
    }

    #[test]
    fn the_last_rows_end_with_the_atlas() {
        assert!(Work::all([8, 10], [64, 16]).rows(10).eq(std::iter::once(0..10)));
    }
}
