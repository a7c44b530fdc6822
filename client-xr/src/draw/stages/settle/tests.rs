//! The tiles of blocks that settle.

use super::*;
use shadecast_gpu::{DesktopDevice, GpuOptions, Needs};
use shadecast_protocol::atlas::{BlockAddress, BlockSize};
use shadecast_shaders::twin::settle::highest_level;
use std::collections::BTreeSet;

fn block(page: u8, [x, y]: [u16; 2], [width_log2, height_log2]: [u8; 2]) -> Block {
    let size = BlockSize::new(width_log2, height_log2).expect("a size");
    Block { address: BlockAddress { page, x, y }, size }
}

#[test]
fn tiles_cover_a_block_once_and_name_its_levels() {
    for sides in [[2, 2], [2, 9], [4, 4], [5, 3], [9, 9]] {
        let (from, to) = (block(0, [8, 4], sides), block(31, [16, 64], sides));
        let tiles: Vec<SettleTileGpu> = tiles_of(from, to).collect();
        let places: BTreeSet<_> =
            tiles.iter().map(|tile| [tile.shape >> 8 & 31, tile.shape >> 13 & 31]).collect();
        let [columns, rows] = [to.size.width(), to.size.height()].map(|side| side.div_ceil(SETTLE_TILE));
        assert_eq!((places.len(), tiles.len() as u32), (tiles.len(), columns * rows), "{sides:?}");
        assert_eq!(places.last(), Some(&[columns - 1, rows - 1]));
        let told = tiles.iter().map(|tile| [tile.shape & 15, tile.shape >> 4 & 15, tile.shape >> 18 & 31]);
        let expected = [u32::from(sides[0]), u32::from(sides[1]), 30];
        assert!(told.into_iter().all(|told| told == expected));
        assert!(tiles.iter().all(|tile| tile.shape >> 23 == highest_level(to)), "{sides:?}");
    }
}

#[test]
fn all_blocks_of_an_atlas_have_room() {
    let options = GpuOptions { needs: Needs::Client, validation: true, device_name: None };
    let gpu = Gpu::open(&options, &DesktopDevice).expect("a Vulkan device");
    let extent = AtlasExtent::MIN;
    for side in 2..=9 {
        let columns = extent.width() >> side;
        let blocks = columns * (extent.height() >> side);
        let mut tiles = SettleTiles::new(&gpu, extent, blocks).expect("memory");
        let all = (0..blocks).map(|_| (block(0, [0, 0], [side; 2]), block(1, [0, 0], [side; 2])));
        let expected = blocks * ((1 << side) as u32).div_ceil(SETTLE_TILE).pow(2);
        tiles.write(all);
        assert_eq!(tiles.count, expected, "blocks of {} texels a side", 1 << side);
    }
}
