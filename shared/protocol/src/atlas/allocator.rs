//! The shading atlas's memory: superblocks of side max(64, block side), each cut into blocks of one size.
//!
//! Blocks keep their address while patch and size stay. The allocator is deterministic: the lowest free address
//! wins. It knows nothing of patches, LODs or time.

use super::{AtlasExtent, Block, BlockAddress, BlockSize};
use crate::bit_set::BitSet;
use crate::limits::{BLOCK_MAX_LOG2, BLOCK_MIN_LOG2, SUPERBLOCK_MIN_LOG2};

const CELL_LOG2: u32 = SUPERBLOCK_MIN_LOG2;
const SUPERBLOCK_SIDES: usize = (BLOCK_MAX_LOG2 - SUPERBLOCK_MIN_LOG2 + 1) as usize;
/// Sides that a block may have.
const SIDES: usize = (BLOCK_MAX_LOG2 - BLOCK_MIN_LOG2 + 1) as usize;
/// Blocks of the smallest size in the smallest superblock: 16 x 16.
const MAX_PLACES_WORDS: usize = 4;
/// Sizes that a block may have.
pub(crate) const SIZES: usize = SIDES * SIDES;

/// Which blocks of an atlas are free.
#[derive(Clone, Debug)]
pub struct Atlas {
    extent: AtlasExtent,
    /// Cells of free superblock corners by size: 64, 128, 256, 512.
    free: [BitSet; SUPERBLOCK_SIDES],
    /// Superblocks in use, by the cell of their corner.
    used: Vec<Option<Superblock>>,
    /// Cells of superblocks that have a block free, by the size of their blocks.
    open: [BitSet; SIZES],
    used_texels: u64,
    /// By cell of the smallest superblock's side, in rows.
    cell_extents: Vec<u32>,
}

#[derive(Clone, Debug)]
struct Superblock {
    side_log2: u32,
    size: BlockSize,
    taken: [u64; MAX_PLACES_WORDS],
    count: u32,
}

impl Superblock {
    fn columns(&self) -> u32 {
        1 << (self.side_log2 - u32::from(self.size.width_log2))
    }

    fn places(&self) -> u32 {
        self.columns() << (self.side_log2 - u32::from(self.size.height_log2))
    }

    /// The place of a block of this superblock, whose corner (y, x) is given.
    fn place_of(&self, corner: (u32, u32), block: Block) -> u32 {
        let column = (u32::from(block.address.x) - corner.1) >> block.size.width_log2;
        let row = (u32::from(block.address.y) - corner.0) >> block.size.height_log2;
        row * self.columns() + column
    }

    fn is_taken(&self, place: u32) -> bool {
        self.taken[place as usize / 64] >> (place % 64) & 1 != 0
    }

    fn free_places(&self) -> u32 {
        self.places() - self.count
    }

    /// The free place that has so many before it.
    fn nth_free(&self, number: u32) -> Option<u32> {
        (0..self.places()).filter(|place| !self.is_taken(*place)).nth(number as usize)
    }

    fn free_before(&self, place: u32) -> u32 {
        (0..place).filter(|place| !self.is_taken(*place)).count() as u32
    }
}

impl Atlas {
    /// An empty atlas.
    pub fn new(extent: AtlasExtent) -> Self {
        let largest = 1 << BLOCK_MAX_LOG2;
        let cells = extent.texels().map(|side| side >> CELL_LOG2).iter().product::<u32>() as usize;
        let smallest = BlockSize::new(BLOCK_MIN_LOG2 as u8, BLOCK_MIN_LOG2 as u8).expect("a size");
        let mut atlas = Self {
            extent,
            free: std::array::from_fn(|_| BitSet::none(cells)),
            used: (0..cells).map(|_| None).collect(),
            open: std::array::from_fn(|_| BitSet::none(cells)),
            used_texels: 0,
            cell_extents: vec![packed_extent(smallest); cells],
        };
        for y in (0..extent.height()).step_by(largest) {
            for x in (0..extent.width()).step_by(largest) {
                let cell = atlas.cell((y, x));
                atlas.free[SUPERBLOCK_SIDES - 1].insert(cell);
            }
        }
        atlas
    }

    /// The cell of a corner (y, x). Lower ones come first, row by row.
    fn cell(&self, (y, x): (u32, u32)) -> usize {
        ((y >> CELL_LOG2) * (self.extent.width() >> CELL_LOG2) + (x >> CELL_LOG2)) as usize
    }

    fn corner(&self, cell: usize) -> (u32, u32) {
        let across = self.extent.width() >> CELL_LOG2;
        ((cell as u32 / across) << CELL_LOG2, (cell as u32 % across) << CELL_LOG2)
    }

    /// What it was made for.
    pub fn extent(&self) -> AtlasExtent {
        self.extent
    }

    /// Width and height in texels.
    pub fn extent_texels(&self) -> [u32; 2] {
        self.extent.texels()
    }

    /// Texels inside blocks that are in use.
    pub fn used_texels(&self) -> u64 {
        self.used_texels
    }

    /// What the blocks are like in each cell of the smallest superblock's side, in rows: width | height << 16, in texels. All
    /// blocks of a cell are alike, and lie at multiples of their sides. What is free is as it was.
    pub fn cell_extents(&self) -> &[u32] {
        &self.cell_extents
    }

    /// A block of this size, or `None` where the atlas is full.
    pub fn allocate(&mut self, size: BlockSize) -> Option<Block> {
        let corner = match self.open[index_of(size)].first() {
            Some(cell) => self.corner(cell),
            None => self.open_superblock(size)?,
        };
        let superblock = self.superblock(corner).expect("it is in use");
        let place = superblock.nth_free(0).expect("open superblocks have a block free");
        self.take_place(corner, place);
        Some(Self::block_at(corner, place, size))
    }

    /// The block at a place of a superblock in use.
    fn block_at(corner: (u32, u32), place: u32, size: BlockSize) -> Block {
        let columns = 1 << (side_log2(size) - u32::from(size.width_log2));
        let (column, row) = (place % columns, place / columns);
        let address = BlockAddress {
            page: 0,
            x: (corner.1 + column * size.width()) as u16,
            y: (corner.0 + row * size.height()) as u16,
        };
        Block { address, size }
    }

    /// Whether a block is one that could be allocated here: within the atlas, at multiples of its sides.
    pub fn can_have(&self, block: Block) -> bool {
        let is_multiple = |at: u16, log2: u8| u32::from(at) & ((1 << log2) - 1) == 0;
        !block.is_stored()
            && block.fits(self.extent.texels())
            && is_multiple(block.address.x, block.size.width_log2)
            && is_multiple(block.address.y, block.size.height_log2)
    }

    /// This very block, where it is free. It must be one that [`Self::can_have`] allows.
    pub fn take(&mut self, block: Block) -> bool {
        let (corner, side_log2) = (self.superblock_of(block), side_log2(block.size));
        if self.superblock(corner).is_none() {
            if !self.take_superblock_at(corner, (side_log2 - CELL_LOG2) as usize) {
                return false;
            }
            self.use_superblock(corner, side_log2, block.size);
        }
        let superblock = self.superblock(corner).expect("it is in use");
        if superblock.size != block.size {
            return false;
        }
        let place = superblock.place_of(corner, block);
        let is_free = !superblock.is_taken(place);
        if is_free {
            self.take_place(corner, place);
        }
        is_free
    }

    /// Takes a place that is free, of a superblock in use.
    fn take_place(&mut self, corner: (u32, u32), place: u32) {
        let cell = self.cell(corner);
        let superblock = self.used[cell].as_mut().expect("it is in use");
        superblock.taken[place as usize / 64] |= 1 << (place % 64);
        superblock.count += 1;
        self.used_texels += u64::from(superblock.size.texels());
        if superblock.count == superblock.places() {
            self.open[index_of(superblock.size)].remove(cell);
        }
    }

    /// How many free places for blocks of its size come before this one, in superblocks that are in use; `None` where it is none. It must be
    /// one that [`Self::can_have`] allows.
    pub fn rank(&self, block: Block) -> Option<u32> {
        let corner = self.superblock_of(block);
        let superblock = self.superblock(corner).filter(|superblock| superblock.size == block.size)?;
        let place = superblock.place_of(corner, block);
        let before = self.open[index_of(block.size)].iter().take_while(|cell| *cell < self.cell(corner));
        let before: u32 =
            before.filter_map(|cell| self.used[cell].as_ref()).map(Superblock::free_places).sum();
        (!superblock.is_taken(place)).then(|| before + superblock.free_before(place))
    }

    /// Takes the free place that has so many before it: [`Self::rank`].
    pub fn take_nth(&mut self, size: BlockSize, rank: u32) -> Option<Block> {
        let mut before = rank;
        let open = self.open[index_of(size)].iter();
        let (cell, place) = open.filter_map(|cell| Some((cell, self.used[cell].as_ref()?))).find_map(
            |(cell, superblock)| match superblock.free_places() {
                free if before < free => Some((cell, superblock.nth_free(before)?)),
                free => {
                    before -= free;
                    None
                }
            },
        )?;
        let corner = self.corner(cell);
        self.take_place(corner, place);
        Some(Self::block_at(corner, place, size))
    }

    /// Gives a block back.
    ///
    /// # Panics
    /// The block was not allocated here: a mistake of ours.
    pub fn free(&mut self, block: Block) {
        let corner = self.superblock_of(block);
        let cell = self.cell(corner);
        let superblock = self.used[cell].as_mut().expect("a block of this atlas");
        assert_eq!(superblock.size, block.size, "freed with the size it was allocated with");
        let place = superblock.place_of(corner, block);
        assert!(superblock.is_taken(place), "{block:?} is freed twice");
        superblock.taken[place as usize / 64] &= !(1 << (place % 64));
        superblock.count -= 1;
        self.used_texels -= u64::from(block.size.texels());
        let (empty, side_log2) = (superblock.count == 0, superblock.side_log2);
        if empty {
            self.used[cell] = None;
            self.open[index_of(block.size)].remove(cell);
            self.return_superblock(corner, side_log2);
        } else {
            self.open[index_of(block.size)].insert(cell);
        }
    }

    /// That in use at a corner.
    fn superblock(&self, corner: (u32, u32)) -> Option<&Superblock> {
        self.used[self.cell(corner)].as_ref()
    }

    fn superblock_of(&self, block: Block) -> (u32, u32) {
        let side_log2 = side_log2(block.size);
        let mask = !((1u32 << side_log2) - 1);
        (u32::from(block.address.y) & mask, u32::from(block.address.x) & mask)
    }

    fn open_superblock(&mut self, size: BlockSize) -> Option<(u32, u32)> {
        let side_log2 = side_log2(size);
        let corner = self.take_superblock((side_log2 - CELL_LOG2) as usize)?;
        self.use_superblock(corner, side_log2, size);
        Some(corner)
    }

    /// A superblock that was taken has blocks of this size from now on.
    fn use_superblock(&mut self, corner: (u32, u32), side_log2: u32, size: BlockSize) {
        let ((y, x), cells) = (corner, 1 << (side_log2 - CELL_LOG2));
        for row in (y >> CELL_LOG2)..(y >> CELL_LOG2) + cells {
            let first = (row * (self.extent.width() >> CELL_LOG2) + (x >> CELL_LOG2)) as usize;
            self.cell_extents[first..first + cells as usize].fill(packed_extent(size));
        }
        let cell = self.cell(corner);
        self.used[cell] = Some(Superblock { side_log2, size, taken: [0; MAX_PLACES_WORDS], count: 0 });
        self.open[index_of(size)].insert(cell);
    }

    /// The lowest free superblock of a side, split from the smallest larger one where there is none.
    fn take_superblock(&mut self, side_index: usize) -> Option<(u32, u32)> {
        if let Some(cell) = self.free[side_index].pop_first() {
            return Some(self.corner(cell));
        }
        if side_index + 1 == SUPERBLOCK_SIDES {
            return None;
        }
        let (y, x) = self.take_superblock(side_index + 1)?;
        let side = 1 << (CELL_LOG2 + side_index as u32);
        self.give(side_index, [(y, x + side), (y + side, x), (y + side, x + side)]);
        Some((y, x))
    }

    /// The superblock of a side at this very corner, split from a larger one where that is free.
    fn take_superblock_at(&mut self, corner: (u32, u32), side_index: usize) -> bool {
        let cell = self.cell(corner);
        if self.free[side_index].remove(cell) {
            return true;
        }
        let side = 1u32 << (CELL_LOG2 + side_index as u32);
        let parent = (corner.0 & !(2 * side - 1), corner.1 & !(2 * side - 1));
        if side_index + 1 == SUPERBLOCK_SIDES || !self.take_superblock_at(parent, side_index + 1) {
            return false;
        }
        let (y, x) = parent;
        self.give(side_index, [(y, x), (y, x + side), (y + side, x), (y + side, x + side)]);
        self.free[side_index].remove(cell)
    }

    /// Superblocks of a side are free.
    fn give<const N: usize>(&mut self, side_index: usize, corners: [(u32, u32); N]) {
        for cell in corners.map(|corner| self.cell(corner)) {
            self.free[side_index].insert(cell);
        }
    }

    /// Puts a superblock back and joins it with its three siblings while all are free.
    fn return_superblock(&mut self, corner: (u32, u32), side_log2: u32) {
        let side_index = (side_log2 - CELL_LOG2) as usize;
        let (side, parent) = (1u32 << side_log2, !((2u32 << side_log2) - 1));
        let (y, x) = (corner.0 & parent, corner.1 & parent);
        if side_index + 1 == SUPERBLOCK_SIDES {
            return self.give(side_index, [corner]);
        }
        let siblings = [(y, x), (y, x + side), (y + side, x), (y + side, x + side)].map(|at| self.cell(at));
        let cell = self.cell(corner);
        if !siblings.iter().all(|sibling| *sibling == cell || self.free[side_index].contains(*sibling)) {
            return self.give(side_index, [corner]);
        }
        for sibling in siblings {
            self.free[side_index].remove(sibling);
        }
        self.return_superblock((y, x), side_log2 + 1);
    }

    /// Texels of free superblocks and of free blocks inside superblocks in use.
    #[cfg(test)]
    pub fn free_texels(&self) -> u64 {
        let whole: u64 = (0..SUPERBLOCK_SIDES)
            .map(|side_index| {
                (self.free[side_index].count() as u64) << (2 * (CELL_LOG2 as usize + side_index))
            })
            .sum();
        let used = self.used.iter().flatten();
        let partial: u64 = used.map(|s| u64::from(s.places() - s.count) * u64::from(s.size.texels())).sum();
        whole + partial
    }
}

fn packed_extent(size: BlockSize) -> u32 {
    size.width() | size.height() << 16
}

/// The place of a size among all [`SIZES`].
pub(crate) fn index_of(size: BlockSize) -> usize {
    let side = |log2: u8| usize::from(log2) - BLOCK_MIN_LOG2 as usize;
    side(size.width_log2) * SIDES + side(size.height_log2)
}

fn side_log2(size: BlockSize) -> u32 {
    u32::from(size.width_log2.max(size.height_log2)).max(SUPERBLOCK_MIN_LOG2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn free_places_are_numbered_and_taken_by_their_number() {
        let size = BlockSize::new(5, 3).expect("a size");
        let mut atlas = Atlas::new(AtlasExtent::MIN);
        let mut blocks: Vec<Block> = (0..40).map(|_| atlas.allocate(size).expect("room")).collect();
        // 16 places in each superblock: 40 fill two and a half.
        assert_eq!(atlas.rank(blocks[3]), None, "it is taken");
        [3, 17, 18, 35].into_iter().for_each(|index| atlas.free(blocks[index]));
        let free: Vec<Block> = [3, 17, 18, 35].map(|index| blocks[index]).to_vec();
        let ranks: Vec<_> = free.iter().map(|block| atlas.rank(*block)).collect();
        assert_eq!(ranks, [Some(0), Some(1), Some(2), Some(3)]);
        assert_eq!(atlas.take_nth(size, 2), Some(free[2]));
        assert_eq!((atlas.rank(free[2]), atlas.rank(free[3])), (None, Some(2)));
        assert_eq!(atlas.take_nth(size, 0), Some(free[0]));
        assert_eq!(atlas.take_nth(size, 10), None, "so many are not free");
        // Of another size, and of a superblock that is not in use.
        let other = Block { size: BlockSize::new(3, 3).expect("a size"), ..free[1] };
        assert_eq!(atlas.rank(other), None);
        blocks.push(Block { address: BlockAddress { page: 0, x: 256, y: 256 }, size });
        assert_eq!(atlas.rank(blocks[40]), None);
    }

    /// xorshift64*, so that the trace is the same everywhere.
    struct Random(u64);

    impl Random {
        fn below(&mut self, n: u32) -> u32 {
            self.0 ^= self.0 >> 12;
            self.0 ^= self.0 << 25;
            self.0 ^= self.0 >> 27;
            ((self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) as u32) % n
        }

        fn size(&mut self) -> BlockSize {
            // Small blocks are the most frequent, as in a real scene.
            let log2 = |r: u32| (2 + r.min(7)) as u8;
            let (a, b) = (self.below(9) * self.below(9) / 9, self.below(9) * self.below(9) / 9);
            BlockSize::new(log2(a), log2(b)).expect("in range")
        }
    }

    fn assert_no_overlap(blocks: &[Block], extent: [u32; 2]) {
        let width = (extent[0] / 4) as usize;
        let mut owner = vec![false; width * (extent[1] / 4) as usize];
        for block in blocks {
            let [l, t, r, b] = block.rect_texels();
            assert!(block.fits(extent), "{block:?}");
            for y in t / 4..b / 4 {
                for x in l / 4..r / 4 {
                    let cell = &mut owner[y as usize * width + x as usize];
                    assert!(!*cell, "{block:?} overlaps at {x},{y}");
                    *cell = true;
                }
            }
        }
    }

    #[track_caller]
    fn assert_cells_tell_blocks(atlas: &Atlas, blocks: &[Block]) {
        let cells_across = atlas.extent_texels()[0] / 64;
        for block in blocks {
            let [left, top, right, bottom] = block.rect_texels();
            let (width, height) = (right - left, bottom - top);
            assert!(left.is_multiple_of(width) && top.is_multiple_of(height), "{block:?}");
            for (x, y) in [(left, top), (right - 1, top), (left, bottom - 1), (right - 1, bottom - 1)] {
                let cell = y / 64 * cells_across + x / 64;
                assert_eq!(atlas.cell_extents()[cell as usize], width | height << 16, "{block:?} at {x},{y}");
            }
        }
    }

    #[test]
    fn blocks_never_overlap_and_free_plus_used_is_the_atlas_under_churn() {
        let extent = AtlasExtent::new(1024, 512).unwrap();
        let (mut atlas, mut live, mut random) = (Atlas::new(extent), Vec::new(), Random(7));
        let (mut gone, mut taken): (Vec<Block>, _) = (Vec::new(), 0);
        for step in 0..500 {
            for _ in 0..20 {
                let index = random.below(live.len().max(1) as u32) as usize;
                if random.below(100) < 45 && !live.is_empty() {
                    let block = live.swap_remove(index);
                    atlas.free(block);
                    gone.push(block);
                } else if let Some(block) = gone.pop().filter(|_| random.below(2) == 0) {
                    if atlas.take(block) {
                        live.push(block);
                        taken += 1;
                    }
                } else if let Some(block) = atlas.allocate(random.size()) {
                    live.push(block);
                }
            }
            assert_eq!(atlas.free_texels() + atlas.used_texels(), 1024 * 512, "seed 7, step {step}");
            if step % 25 == 0 {
                assert_no_overlap(&live, extent.texels());
                assert_cells_tell_blocks(&atlas, &live);
            }
        }
        live.drain(..).for_each(|block| atlas.free(block));
        assert_eq!(atlas.free[SUPERBLOCK_SIDES - 1].count(), 2, "everything joins again");
        assert!(taken > 500, "{taken} were free still");
    }

    #[test]
    fn a_block_is_taken_where_it_is_free_and_nowhere_else() {
        let size = |log2| BlockSize::new(log2, log2).unwrap();
        let mut atlas = Atlas::new(AtlasExtent::MIN);
        let [first, second, large] = [4, 4, 7].map(|log2| atlas.allocate(size(log2)).expect("room"));
        assert!(!atlas.take(first) && !atlas.take(large), "in use");
        [first, second, large].into_iter().for_each(|block| atlas.free(block));
        assert!(atlas.take(second) && !atlas.take(second) && atlas.take(large));
        assert_eq!(atlas.allocate(size(4)), Some(first));
        let inside = Block { size: size(6), ..large };
        assert!(!atlas.take(inside), "a larger one is there");
        atlas.free(large);
        assert!(atlas.take(inside) && !atlas.take(large), "a smaller one is there");
        let held = u64::from(2 * size(4).texels() + size(6).texels());
        assert_eq!((atlas.used_texels(), atlas.free_texels() + held), (held, 512 * 512));
    }

    #[test]
    fn the_same_calls_give_the_same_addresses() {
        let run = || {
            let (mut atlas, mut random) = (Atlas::new(AtlasExtent::MIN), Random(11));
            (0..300).map(|_| atlas.allocate(random.size())).collect::<Vec<_>>()
        };
        assert_eq!(run(), run());
    }

    #[test]
    fn one_size_fills_the_atlas_to_the_last_texel() {
        for log2 in [2, 5, 9] {
            let size = BlockSize::new(log2, log2).unwrap();
            let mut atlas = Atlas::new(AtlasExtent::new(1024, 1024).unwrap());
            let mut count = 0;
            while atlas.allocate(size).is_some() {
                count += 1;
            }
            assert_eq!(count * size.texels(), 1024 * 1024);
        }
    }
}
