//! Blocks of patches: sizes against those of before, addresses against those that the allocator would give.
//!
//! The server frees what leaves or changes, then allocates the blocks in view and those of the surround, each in the order of
//! [`BlockSize::allocation_order`], then of the scene. So most addresses are foreseen in one bit. The others are told among the free places for their size.

use super::Part;
use super::known::Known;
use super::slots::{Gaps, Slots};
use crate::atlas::allocator::{Atlas, SIZES, index_of};
use crate::atlas::{AtlasExtent, Block, BlockAddress, BlockSize};
use crate::ids::PatchSlot;
use crate::limits::{ATLAS_MAX_EXTENT, BLOCK_MAX_LOG2, BLOCK_MIN_LOG2};
use crate::memory::ClientMemory;
use crate::range::{Chance, Coder, Number, Symbol};
use crate::wire::{WireError, invalid};

/// Of nine steps of a size, none is meant.
const ANOTHER_SIZE: u32 = 9;
const WORD_BITS: u32 = 31;

/// What is coded of a patch's block.
#[derive(Clone, Copy, Debug)]
pub(super) struct Placed {
    pub slot: PatchSlot,
    pub block: Option<Block>,
    /// Its address follows.
    is_open: bool,
}

/// Ways in which a block's size is foreseen.
#[derive(Clone, Debug, Default)]
struct SizeModel {
    is_none: [Chance; 2],
    was_none: bool,
    is_stored: Chance,
    step: [Symbol<16>; 3],
    class: usize,
    sides: [Symbol<8>; 2],
}

/// See the module. Sized at connection.
#[derive(Clone, Debug)]
pub(super) struct Placing {
    /// As the server's, as far as the client knows its blocks.
    atlas: Option<Atlas>,
    /// Patch slots whose block is in `atlas`.
    held: Slots,
    /// Patch slots with a block.
    placed: Slots,
    /// By slot, the last size.
    sizes: Vec<BlockSize>,
    gaps: [Gaps; 2],
    size_models: [SizeModel; 2],
    has_block: [Chance; 2],
    says_none: Chance,
    new_area: Number,
    new_width: [Number; 2],
    is_foreseen: [Chance; 4],
    is_ranked: Chance,
    rank: Number,
    /// By size, how many free places came before the last that was not foreseen.
    ranks: Vec<u32>,
    /// Lists of one delta, kept for their memory: what has an address to come, and what is told.
    open: Vec<usize>,
    told: Vec<(PatchSlot, Option<Block>)>,
    is_aligned: Chance,
}

impl Placing {
    pub(super) fn new(patch_slots: u32) -> Self {
        let smallest = BlockSize { width_log2: BLOCK_MIN_LOG2 as u8, height_log2: BLOCK_MIN_LOG2 as u8 };
        Self {
            atlas: None,
            held: Slots::none(patch_slots),
            placed: Slots::none(patch_slots),
            sizes: vec![smallest; patch_slots as usize],
            gaps: Default::default(),
            size_models: Default::default(),
            has_block: Default::default(),
            says_none: Chance::default(),
            new_area: Number::default(),
            new_width: Default::default(),
            is_foreseen: Default::default(),
            is_ranked: Chance::default(),
            rank: Number::default(),
            ranks: vec![0; SIZES],
            open: Vec::new(),
            told: Vec::new(),
            is_aligned: Chance::default(),
        }
    }

    /// With blocks in an atlas of this extent.
    pub(super) fn with_atlas(mut self, extent: AtlasExtent) -> Self {
        self.atlas = Some(Atlas::new(extent));
        self
    }

    /// A patch loses its block, or gets another.
    pub(super) fn release(&mut self, memory: &ClientMemory, slot: PatchSlot) {
        self.placed.remove(slot.0);
        if !self.held.contains(slot.0) {
            return;
        }
        self.held.remove(slot.0);
        let block = memory.patches().get(slot).and_then(|patch| patch.block);
        if let (Some(atlas), Some(block)) = (&mut self.atlas, block) {
            atlas.free(block);
        }
    }

    /// Of the patches that stay, those with another block: which they are, and its size. First those that have one.
    pub(super) fn stay<C: Coder>(
        &mut self,
        coder: &mut C,
        (memory, taken): (&ClientMemory, &Slots),
        told: &[(PatchSlot, Option<Block>)],
        out: &mut Vec<Placed>,
    ) -> Result<(), WireError> {
        let Self { placed, gaps, size_models, sizes, told: list, .. } = self;
        for (class, (gaps, model)) in gaps.iter_mut().zip(size_models).enumerate() {
            let is_one = |(slot, _): &&(PatchSlot, Option<Block>)| {
                taken.contains(slot.0) && placed.contains(slot.0) == (class == 0)
            };
            list.clear();
            list.extend(told.iter().filter(is_one));
            let mut blocks = list.iter().map(|(_, block)| *block);
            let each = |coder: &mut C, slot: u32| {
                let told = blocks.next().flatten();
                coder.count_for(Part::Blocks as usize);
                let (block, is_open) = model.code(coder, sizes[slot as usize], told)?;
                coder.count_for(Part::PlacedSlots as usize);
                out.push(Placed { slot: PatchSlot(slot), block, is_open });
                Ok(())
            };
            coder.count_for(Part::PlacedSlots as usize);
            let slots = list.iter().map(|(slot, _)| slot.0);
            match class {
                0 => gaps.code(coder, (placed.these(), taken.count()), slots, each)?,
                _ => gaps.code(coder, (taken.without(placed), taken.count()), slots, each)?,
            }
        }
        out.iter().for_each(|placed| self.release(memory, placed.slot));
        Ok(())
    }

    /// The same of patches that enter. They come with falling sizes, mostly.
    pub(super) fn enter(
        &mut self,
        coder: &mut impl Coder,
        known: &Known,
        slots: impl Iterator<Item = PatchSlot>,
        told: &[(PatchSlot, Option<Block>)],
        out: &mut Vec<Placed>,
    ) -> Result<(), WireError> {
        let (mut before, mut has_block) = (14, true);
        for slot in slots {
            coder.count_for(Part::PlacedSlots as usize);
            let at = told.binary_search_by_key(&slot, |(slot, _)| *slot);
            let told = at.ok().map(|at| told[at].1);
            let chance = &mut self.has_block[usize::from(has_block)];
            has_block = coder.bit(chance, matches!(told, Some(Some(_))));
            if !has_block {
                // Said to have none, though it has none as it enters: not lost, so that lists come back as they were.
                if coder.bit(&mut self.says_none, told.is_some()) {
                    out.push(Placed { slot, block: None, is_open: false });
                }
                continue;
            }
            coder.count_for(Part::Blocks as usize);
            let told = told.flatten();
            let (block, is_open) = if coder.bit(&mut self.size_models[0].is_stored, is_stored(told)) {
                (Some(stored(coder, told)?), false)
            } else {
                let size = self.new_size(coder, (&mut before, known.aspect(slot)), told)?;
                (Some(told.unwrap_or(Block { address: BlockAddress::default(), size })), true)
            };
            out.push(Placed { slot, block, is_open });
        }
        Ok(())
    }

    /// Its texels against those of the one before, its width against that which the patch had elsewhere.
    fn new_size(
        &mut self,
        coder: &mut impl Coder,
        (before, aspect): (&mut i32, Option<i8>),
        told: Option<Block>,
    ) -> Result<BlockSize, WireError> {
        let told =
            told.map_or([0; 2], |block| [block.size.width_log2, block.size.height_log2].map(i32::from));
        let area =
            before.wrapping_add(self.new_area.code_signed(coder, (told[0] + told[1]).wrapping_sub(*before)));
        let foreseen = (area.wrapping_add(i32::from(aspect.unwrap_or(0)))) >> 1;
        let model = &mut self.new_width[usize::from(aspect.is_some())];
        let width = foreseen.wrapping_add(model.code_signed(coder, told[0].wrapping_sub(foreseen)));
        let height = area.wrapping_sub(width);
        *before = area;
        let side = |log2: i32| u8::try_from(log2).unwrap_or(u8::MAX);
        BlockSize::new(side(width), side(height))
            .ok_or_else(|| invalid("the size of a block", format!("{width} and {height} are no exponents")))
    }

    /// The addresses of all that is placed in the atlas.
    pub(super) fn addresses(
        &mut self,
        coder: &mut impl Coder,
        known: &mut Known,
        placed: &mut [Placed],
    ) -> Result<(), WireError> {
        coder.count_for(Part::Blocks as usize);
        let mut open = std::mem::take(&mut self.open);
        open.clear();
        open.extend((0..placed.len()).filter(|index| placed[*index].is_open));
        open.sort_unstable_by_key(|index| {
            let Placed { slot, block, .. } = placed[*index];
            (block.map(|block| (block.size.allocation_order(), known.place(slot))), slot)
        });
        let mut history = 0;
        open.retain(|index| {
            let is_foreseen = self.foresee(coder, history, &mut placed[*index]);
            history = history << 1 & 3 | usize::from(is_foreseen);
            !is_foreseen
        });
        for index in &open {
            self.search(coder, &mut placed[*index])?;
        }
        self.open = open;
        for Placed { slot, block, .. } in &*placed {
            let Some(block) = block else { continue };
            self.placed.insert(slot.0);
            if let Some(size) = self.sizes.get_mut(slot.index()) {
                *size = block.size;
            }
            known.note_aspect(*slot, block.size);
        }
        Ok(())
    }

    /// Where the allocator would put it; false where it lies elsewhere.
    fn foresee(&mut self, coder: &mut impl Coder, history: usize, placed: &mut Placed) -> bool {
        let Some((atlas, block)) = self.atlas.as_mut().zip(placed.block) else { return false };
        let Some(foreseen) = atlas.allocate(block.size) else { return false };
        let is_foreseen = coder.bit(&mut self.is_foreseen[history], foreseen == block);
        if is_foreseen {
            placed.block = Some(foreseen);
            self.held.insert(placed.slot.0);
        } else {
            atlas.free(foreseen);
        }
        is_foreseen
    }

    /// The rest lie beside blocks that the client does not know: at another free place for their size, mostly one that has as many
    /// before it as the last had, or anywhere.
    fn search<C: Coder>(&mut self, coder: &mut C, placed: &mut Placed) -> Result<(), WireError> {
        let Some(block) = placed.block else { return Ok(()) };
        let atlas = self.atlas.as_ref().filter(|atlas| C::TELLS && atlas.can_have(block));
        let rank = atlas.and_then(|atlas| atlas.rank(block));
        if coder.bit(&mut self.is_ranked, rank.is_some()) {
            let before = &mut self.ranks[index_of(block.size)];
            let further = self.rank.code_signed(coder, rank.unwrap_or(0).wrapping_sub(*before) as i32);
            *before = before.wrapping_add(further as u32);
            placed.block = self.atlas.as_mut().and_then(|atlas| atlas.take_nth(block.size, *before));
            self.held.insert(placed.slot.0);
            return match placed.block {
                Some(_) => Ok(()),
                None => Err(invalid("the place of a block", format!("there are not {before} before it"))),
            };
        }
        let block = Block { address: self.anywhere(coder, block), ..block };
        if !block.fits(ATLAS_MAX_EXTENT) {
            return Err(invalid("a placement", "it reaches beyond its page"));
        }
        placed.block = Some(block);
        if self.atlas.as_mut().is_some_and(|atlas| atlas.can_have(block) && atlas.take(block)) {
            self.held.insert(placed.slot.0);
        }
        Ok(())
    }

    /// Blocks lie at multiples of their sides, mostly.
    fn anywhere(&mut self, coder: &mut impl Coder, Block { address, size }: Block) -> BlockAddress {
        let sides = [size.width_log2, size.height_log2].map(u32::from);
        let at = [address.x, address.y].map(u32::from);
        let is_multiple = at.iter().zip(sides).all(|(at, side)| at & ((1 << side) - 1) == 0);
        let is_aligned = coder.bit(&mut self.is_aligned, is_multiple);
        let [x, y] = std::array::from_fn(|axis| {
            let unit = if is_aligned { sides[axis] } else { BLOCK_MIN_LOG2 };
            coder.raw((ATLAS_MAX_EXTENT[axis] >> unit).ilog2(), at[axis] >> unit) << unit
        });
        BlockAddress { page: 0, x: x as u16, y: y as u16 }
    }
}

fn is_stored(block: Option<Block>) -> bool {
    block.is_some_and(Block::is_stored)
}

/// A block of the store.
fn stored(coder: &mut impl Coder, told: Option<Block>) -> Result<Block, WireError> {
    let word = coder.raw(WORD_BITS, told.map_or(0, Block::pack));
    let block = Block::unpack(word).map_err(|error| invalid("a placement", error.to_string()))?;
    match block.is_stored() {
        true => Ok(block),
        false => Err(invalid("a placement", "it is not in the store")),
    }
}

impl SizeModel {
    /// The block with its size, and whether its address follows.
    fn code(
        &mut self,
        coder: &mut impl Coder,
        before: BlockSize,
        told: Option<Block>,
    ) -> Result<(Option<Block>, bool), WireError> {
        self.was_none = coder.bit(&mut self.is_none[usize::from(self.was_none)], told.is_none());
        if self.was_none {
            return Ok((None, false));
        }
        if coder.bit(&mut self.is_stored, is_stored(told)) {
            return Ok((Some(stored(coder, told)?), false));
        }
        let size = self.size(coder, before, told.map_or(before, |block| block.size))?;
        Ok((Some(told.unwrap_or(Block { address: BlockAddress::default(), size })), true))
    }

    fn size(
        &mut self,
        coder: &mut impl Coder,
        before: BlockSize,
        told: BlockSize,
    ) -> Result<BlockSize, WireError> {
        const LEAST: u8 = BLOCK_MIN_LOG2 as u8;
        const { assert!(BLOCK_MAX_LOG2 - BLOCK_MIN_LOG2 < 8) };
        let step = |before: u8, told: u8| {
            u32::try_from(i32::from(told) - i32::from(before) + 1).ok().filter(|step| *step < 3)
        };
        let steps = step(before.width_log2, told.width_log2).zip(step(before.height_log2, told.height_log2));
        let told_symbol = steps.map_or(ANOTHER_SIZE, |(width, height)| 3 * width + height);
        let symbol = self.step[self.class].code(coder, told_symbol);
        let [width, height] = if symbol < ANOTHER_SIZE {
            [(before.width_log2, symbol / 3), (before.height_log2, symbol % 3)]
                .map(|(before, step)| before + step as u8 - 1)
        } else {
            let sides = [told.width_log2, told.height_log2].map(|side| u32::from(side - LEAST));
            let [width, height] = &mut self.sides;
            [width.code(coder, sides[0]), height.code(coder, sides[1])].map(|side| side as u8 + LEAST)
        };
        self.class = match (symbol / 3 + symbol % 3).cmp(&2) {
            std::cmp::Ordering::Less => 0,
            std::cmp::Ordering::Equal => 1,
            std::cmp::Ordering::Greater => 2,
        };
        BlockSize::new(width, height)
            .ok_or_else(|| invalid("the size of a block", format!("{width} and {height} are no exponents")))
    }
}
