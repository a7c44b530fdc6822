//! The store: copies of blocks whose colours no longer change, with their mip levels, and the passes that make them of a
//! picture (`client_settle*.comp`).

use super::upload::Planes;
use arrayvec::ArrayVec;
use shadecast_gpu::{
    Access, Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Image, ImageDesc, ImageLevel, Memory,
    Recorder, Sampler, SamplerDesc, YcbcrImage, YcbcrSampler, vk,
};
use shadecast_protocol::atlas::{AtlasExtent, Block};
use shadecast_protocol::limits::STORE_PAGE_SIDE;
use shadecast_shaders::constants::{SETTLE_TILE, STORE_LEVELS};
use shadecast_shaders::generated::{
    CLIENT_SETTLE_COMP, CLIENT_SETTLE_COSITED_COMP, CLIENT_SETTLE_MIP_COMP, CLIENT_SETTLE_PICTURE_COMP,
    SettlePush, SettleTileGpu,
};
use std::sync::Arc;

/// As passes write it: no device must write the format of lookups.
const FORMAT: vk::Format = vk::Format::R32_UINT;
/// As lookups read it: light, which alone may be averaged, in nine bits a channel with a common exponent. Every device filters it.
const SAMPLED_FORMAT: vk::Format = vk::Format::E5B9G9R9_UFLOAT_PACK32;
/// Tiles of a dispatch: workgroups that every device has.
const TILES_PER_DISPATCH: u32 = 8192;
/// Its layout when it is looked up, and when it is written.
const LAYOUTS: [vk::ImageLayout; 2] = [vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL, vk::ImageLayout::GENERAL];

/// One connection's store: an array of pages. Without pages it is one texel that no draw looks up.
pub struct Store {
    /// All pages and levels.
    pub image: Image,
    /// The finest first; none without pages.
    levels: ArrayVec<ImageLevel, { STORE_LEVELS as usize }>,
}

/// What a worker writes of the blocks of an update that settle.
pub struct SettleTiles {
    tiles: Buffer,
    count: u32,
}

/// The pipelines, and how the store is looked up.
pub struct Settle {
    planes: ComputePipeline,
    mip: ComputePipeline,
    /// Of lookups in the store.
    pub sampler: Sampler,
}

/// A bundle's bindings: none without pages.
pub struct SettleSet {
    planes: Option<BindGroup>,
    mips: ArrayVec<BindGroup, { STORE_LEVELS as usize }>,
}

/// What copies pictures on the device.
pub struct SettlePicture(ComputePipeline);

impl Store {
    /// A store of black pages; `recorder` makes it so.
    pub fn new(gpu: &Arc<Gpu>, recorder: &mut Recorder, pages: u32) -> Result<Self, GpuError> {
        let usage = vk::ImageUsageFlags::SAMPLED
            | vk::ImageUsageFlags::STORAGE
            | vk::ImageUsageFlags::TRANSFER_DST
            | vk::ImageUsageFlags::TRANSFER_SRC;
        let side = if pages == 0 { 1 } else { STORE_PAGE_SIDE };
        let mips = if pages == 0 { 1 } else { STORE_LEVELS };
        let desc = ImageDesc {
            sampled_format: Some(SAMPLED_FORMAT),
            ..ImageDesc::new("store", [side; 2], FORMAT, usage)
        };
        let image = Image::new(gpu, ImageDesc { layers: pages.max(1), is_array: true, mips, ..desc })?;
        let cleared = vk::ImageLayout::TRANSFER_DST_OPTIMAL;
        let layouts = [vk::ImageLayout::UNDEFINED, cleared];
        recorder.transition(&image, layouts, Access::NONE, Access::COPY_WRITE);
        recorder.clear_image(&image, [0.0, 0.0, 0.0, 1.0]);
        recorder.transition(&image, [cleared, LAYOUTS[0]], Access::COPY_WRITE, Access::FRAGMENT_READ);
        let levels = if pages == 0 { 0 } else { mips };
        let levels = (0..levels).map(|level| image.level(level)).collect::<Result<_, _>>()?;
        Ok(Self { image, levels })
    }
}

impl SettleTiles {
    /// For all blocks that an atlas has room for.
    pub fn new(gpu: &Arc<Gpu>, extent: AtlasExtent, patch_slots: u32) -> Result<Self, GpuError> {
        // A block without a side of 4 texels has a tile for each 64 texels at most; one with such a side one more.
        let most = u64::from(extent.width()) * u64::from(extent.height()) / 64 + u64::from(patch_slots);
        let bytes = most * size_of::<SettleTileGpu>() as u64;
        Ok(Self { tiles: Buffer::new(gpu, "blocks to settle", bytes, Memory::Upload)?, count: 0 })
    }

    /// For a connection without a store.
    pub fn none(gpu: &Arc<Gpu>) -> Result<Self, GpuError> {
        Ok(Self { tiles: Buffer::new(gpu, "blocks to settle", 0, Memory::Upload)?, count: 0 })
    }

    /// Takes in blocks of a picture, and where they go. The GPU is done with what was here. What is more than all blocks that an
    /// atlas has room for, as no honest server says, is left out.
    pub fn write(&mut self, blocks: impl Iterator<Item = (Block, Block)>) {
        let room = self.tiles.size() as usize / size_of::<SettleTileGpu>();
        let places: &mut [SettleTileGpu] =
            bytemuck::cast_slice_mut(&mut self.tiles.bytes_mut()[..room * size_of::<SettleTileGpu>()]);
        let tiles = blocks.flat_map(|(from, to)| tiles_of(from, to));
        self.count = 0;
        for (place, tile) in places.iter_mut().zip(tiles) {
            *place = tile;
            self.count += 1;
        }
    }

    /// Whether there is nothing to copy.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// One tile of zeros, for a rehearsal.
    pub(crate) fn write_zeros(&mut self) {
        self.tiles.bytes_mut()[..size_of::<SettleTileGpu>()].fill(0);
        self.count = 1;
    }
}

fn tiles_of(from: Block, to: Block) -> impl Iterator<Item = SettleTileGpu> {
    let place = |block: Block| u32::from(block.address.x) | u32::from(block.address.y) << 16;
    let size = to.size;
    let bits = u32::from(to.address.x | to.address.y) | size.width() | size.height();
    let highest = bits.trailing_zeros().min(STORE_LEVELS - 1);
    let of_block = u32::from(size.width_log2)
        | u32::from(size.height_log2) << 4
        | (u32::from(to.address.page).saturating_sub(1)) << 18
        | highest << 23;
    let [columns, rows] = [size.width(), size.height()].map(|side| side.div_ceil(SETTLE_TILE));
    (0..columns * rows).map(move |tile| SettleTileGpu {
        from: place(from),
        to: place(to),
        shape: of_block | (tile % columns) << 8 | (tile / columns) << 13,
    })
}

impl Settle {
    /// The pipelines.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, GpuError> {
        let sampler = SamplerDesc { mips: true, ..SamplerDesc::clamped(vk::Filter::LINEAR) };
        Ok(Self {
            planes: ComputePipeline::new(gpu, &CLIENT_SETTLE_COMP)?,
            mip: ComputePipeline::new(gpu, &CLIENT_SETTLE_MIP_COMP)?,
            sampler: Sampler::new(gpu, sampler)?,
        })
    }

    /// Binds what a bundle says, and the planes that `sampler` reads.
    pub fn bind(
        &self,
        tiles: &SettleTiles,
        store: &Store,
        planes: &Planes,
        sampler: &Sampler,
    ) -> Result<SettleSet, GpuError> {
        let tiles = ("Tiles", Bind::Buffer(&tiles.tiles));
        let [luma, cb, cr] = planes.images.each_ref().map(|plane| Bind::Sampled(plane, sampler));
        let pictures = [("luma_plane", luma), ("cb_plane", cb), ("cr_plane", cr)];
        let of_planes = |level: &ImageLevel| {
            let [luma, cb, cr] = pictures;
            BindGroup::new(self.planes.layout(), &[tiles, ("written", Bind::Storage(level)), luma, cb, cr])
        };
        let planes = store.levels.first().map(of_planes).transpose()?;
        let mips = store.levels.windows(2).map(|pair| {
            let levels = [("written", Bind::Storage(&pair[1])), ("finer", Bind::Storage(&pair[0]))];
            BindGroup::new(self.mip.layout(), &[tiles, levels[0], levels[1]])
        });
        Ok(SettleSet { planes, mips: mips.collect::<Result<_, _>>()? })
    }

    /// Copies the blocks of the picture in the planes.
    pub fn record(&self, recorder: &mut Recorder, store: &Store, set: &SettleSet, tiles: &SettleTiles) {
        if let Some(group) = &set.planes {
            self.record_with(recorder, store, set, tiles, (&self.planes, group));
        }
    }

    /// The same of a picture on the device, bound to `group`.
    pub fn record_picture(
        &self,
        recorder: &mut Recorder,
        store: &Store,
        set: &SettleSet,
        tiles: &SettleTiles,
        (pipeline, group): (&SettlePicture, &BindGroup),
    ) {
        self.record_with(recorder, store, set, tiles, (&pipeline.0, group));
    }

    fn record_with(
        &self,
        recorder: &mut Recorder,
        store: &Store,
        set: &SettleSet,
        tiles: &SettleTiles,
        finest: (&ComputePipeline, &BindGroup),
    ) {
        let [read, written] = LAYOUTS;
        recorder.transition(&store.image, [read, written], Access::FRAGMENT_READ, Access::COMPUTE);
        let mips = set.mips.iter().map(|group| (&self.mip, group));
        for (level, (pipeline, group)) in (0..).zip(std::iter::once(finest).chain(mips)) {
            for first_tile in (0..tiles.count).step_by(TILES_PER_DISPATCH as usize) {
                let groups = (tiles.count - first_tile).min(TILES_PER_DISPATCH);
                let invocations = groups * pipeline.workgroup()[0];
                recorder.dispatch(pipeline, group, &SettlePush { first_tile, level }, [invocations, 1, 1]);
            }
            recorder.barrier(Access::COMPUTE_WRITE, Access::COMPUTE_READ); // the level, for the next
        }
        recorder.transition(&store.image, [written, read], Access::COMPUTE_WRITE, Access::FRAGMENT_READ);
    }
}

impl SettlePicture {
    /// The pipeline for pictures that `sampler` reads.
    pub fn new(gpu: &Arc<Gpu>, sampler: &Arc<YcbcrSampler>) -> Result<Self, GpuError> {
        let shader = match sampler.is_cosited() {
            false => &CLIENT_SETTLE_PICTURE_COMP,
            true => &CLIENT_SETTLE_COSITED_COMP,
        };
        Ok(Self(ComputePipeline::fixing(gpu, shader, (&["picture"], sampler.clone()))?))
    }

    /// Binds what a bundle says, and its picture; `None` without pages.
    pub fn bind(
        &self,
        tiles: &SettleTiles,
        store: &Store,
        picture: &YcbcrImage,
    ) -> Result<Option<BindGroup>, GpuError> {
        let Some(level) = store.levels.first() else { return Ok(None) };
        let binds = [
            ("Tiles", Bind::Buffer(&tiles.tiles)),
            ("written", Bind::Storage(level)),
            ("picture", Bind::Picture(picture)),
        ];
        BindGroup::new(self.0.layout(), &binds).map(Some)
    }

    /// Binds another picture of the same kind.
    pub fn rebind(&self, group: &mut BindGroup, picture: &YcbcrImage) {
        group.rebind(self.0.layout(), "picture", &Bind::Picture(picture));
    }
}

#[cfg(test)]
mod tests;
