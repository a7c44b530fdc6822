//! Addressing of the shading atlas and of the store: the place of a patch's block, and the area that a lookup may reach.
//!
//! Server (shading), client (lookup) and the shaders of both agree here to the texel. Which block a patch has is the server's
//! choice; [`allocator`] says which are free.

pub mod allocator;

pub use shadecast_model::patch::PatchKind;

use crate::limits::{
    ATLAS_DEFAULT_EXTENT, ATLAS_MAX_EXTENT, ATLAS_MIN_SIDE, BLOCK_INSET_TEXELS, BLOCK_MAX_LOG2,
    BLOCK_MIN_LOG2, MAX_STORE_PAGES, STORE_PAGE_SIDE,
};
use serde::{Deserialize, Serialize};
use std::cmp::Reverse;
use std::fmt;
use std::str::FromStr;
use thiserror::Error;

/// Bits of one address coordinate in a packed block, in units of the smallest block side.
const ADDRESS_BITS: u32 = 10;
/// Bits of one size exponent in a packed block.
const SIZE_BITS: u32 = 3;
/// Bits of the page.
const PAGE_BITS: u32 = 5;
const PAGE_SHIFT: u32 = 2 * ADDRESS_BITS + 2 * SIZE_BITS;
const USED_BITS: u32 = PAGE_SHIFT + PAGE_BITS;

/// The page of blocks in the atlas of an update's picture. Those of the store begin with 1.
pub const ATLAS_PAGE: u8 = 0;

/// Width and height of a shading atlas: powers of two within the limits.
///
/// There is one way to make one, and everything that names an atlas's extent names it by this type: options, offer, terms,
/// pipeline, encoder and decoder. What one side accepts the other one does too.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(try_from = "[u32; 2]", into = "[u32; 2]")]
pub struct AtlasExtent {
    width: u32,
    height: u32,
}

/// What cannot be the extent of an atlas.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum AtlasExtentError {
    /// No two numbers.
    #[error("\"{0}\" is not WIDTHxHEIGHT in texels, such as {default}", default = AtlasExtent::DEFAULT)]
    Syntax(String),
    /// Numbers that no atlas has.
    #[error(
        "an atlas cannot be {width}x{height}: its width must be a power of two from {ATLAS_MIN_SIDE} to {max_width}, \
         its height one from {ATLAS_MIN_SIDE} to {max_height}, such as {default}",
        max_width = ATLAS_MAX_EXTENT[0], max_height = ATLAS_MAX_EXTENT[1], default = AtlasExtent::DEFAULT
    )]
    Sides {
        /// The width.
        width: u32,
        /// The height.
        height: u32,
    },
}

impl AtlasExtent {
    /// What is taken unless asked otherwise.
    pub const DEFAULT: Self = Self::of_limit(ATLAS_DEFAULT_EXTENT);
    /// The largest.
    pub const MAX: Self = Self::of_limit(ATLAS_MAX_EXTENT);
    /// The smallest.
    pub const MIN: Self = Self::of_limit([ATLAS_MIN_SIDE; 2]);

    /// An extent of `width` by `height` texels.
    ///
    /// # Errors
    /// No atlas has such sides.
    pub fn new(width: u32, height: u32) -> Result<Self, AtlasExtentError> {
        Self::checked([width, height]).ok_or(AtlasExtentError::Sides { width, height })
    }

    const fn checked([width, height]: [u32; 2]) -> Option<Self> {
        let fits = ATLAS_MIN_SIDE <= width
            && width <= ATLAS_MAX_EXTENT[0]
            && ATLAS_MIN_SIDE <= height
            && height <= ATLAS_MAX_EXTENT[1];
        if fits && width.is_power_of_two() && height.is_power_of_two() {
            Some(Self { width, height })
        } else {
            None
        }
    }

    const fn of_limit(sides: [u32; 2]) -> Self {
        Self::checked(sides).expect("the limits are extents")
    }

    /// Texels from side to side.
    pub const fn width(self) -> u32 {
        self.width
    }

    /// Texels from top to bottom.
    pub const fn height(self) -> u32 {
        self.height
    }

    /// Width and height, for images and pictures.
    pub const fn texels(self) -> [u32; 2] {
        [self.width, self.height]
    }

    /// With sides halved until they are within `max` texels; `None` where no atlas is that small.
    pub fn halved_to_fit(self, max: [u32; 2]) -> Option<Self> {
        let mut sides = self.texels();
        for (side, max) in sides.iter_mut().zip(max) {
            while *side > max {
                *side /= 2;
            }
        }
        Self::try_from(sides).ok()
    }
}

const _: () = assert!(MAX_STORE_PAGES < 1 << PAGE_BITS);

impl TryFrom<[u32; 2]> for AtlasExtent {
    type Error = AtlasExtentError;

    fn try_from([width, height]: [u32; 2]) -> Result<Self, AtlasExtentError> {
        Self::new(width, height)
    }
}

impl From<AtlasExtent> for [u32; 2] {
    fn from(extent: AtlasExtent) -> Self {
        extent.texels()
    }
}

impl FromStr for AtlasExtent {
    type Err = AtlasExtentError;

    fn from_str(text: &str) -> Result<Self, AtlasExtentError> {
        let sides = text.split_once('x').and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
        sides.map_or_else(|| Err(AtlasExtentError::Syntax(text.to_owned())), Self::try_from)
    }
}

impl fmt::Display for AtlasExtent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}", self.width, self.height)
    }
}

impl fmt::Debug for AtlasExtent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// Corner of a block nearest to the origin of its page, in texels from the upper left; multiples of 4.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct BlockAddress {
    /// [`ATLAS_PAGE`], or a page of the store, at most [`MAX_STORE_PAGES`].
    pub page: u8,
    /// Texels from the left.
    pub x: u16,
    /// Texels from the top.
    pub y: u16,
}

/// Side lengths of a block as powers of two, each exponent in `BLOCK_MIN_LOG2..=BLOCK_MAX_LOG2`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct BlockSize {
    /// Width is `1 << width_log2` texels.
    pub width_log2: u8,
    /// Height is `1 << height_log2` texels.
    pub height_log2: u8,
}

/// A patch's rectangle in the atlas, or in a page of the store.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Block {
    /// Where it lies.
    pub address: BlockAddress,
    /// How large it is.
    pub size: BlockSize,
}

/// A word that is no block.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
#[error("{word:#010x} is not a block of the atlas: {reason}")]
pub struct BlockError {
    /// The word.
    pub word: u32,
    /// What is wrong with it.
    pub reason: &'static str,
}

impl BlockSize {
    /// A size from its exponents; `None` outside `BLOCK_MIN_LOG2..=BLOCK_MAX_LOG2`.
    pub fn new(width_log2: u8, height_log2: u8) -> Option<Self> {
        let allowed = BLOCK_MIN_LOG2 as u8..=BLOCK_MAX_LOG2 as u8;
        (allowed.contains(&width_log2) && allowed.contains(&height_log2))
            .then_some(Self { width_log2, height_log2 })
    }

    /// Width in texels, 4..=512.
    pub fn width(self) -> u32 {
        1 << self.width_log2
    }

    /// Height in texels, 4..=512.
    pub fn height(self) -> u32 {
        1 << self.height_log2
    }

    /// Texels in the block.
    pub fn texels(self) -> u32 {
        self.width() * self.height()
    }

    /// The order in which blocks are allocated: large ones first, since they are the hardest to place. A client foresees addresses by it.
    pub fn allocation_order(self) -> impl Ord + Copy {
        (Reverse(self.texels()), self)
    }
}

impl Block {
    /// As one word, from bit 0: x/4 (10 bits), y/4 (10), width_log2 - 2 (3), height_log2 - 2 (3), page (5); the rest is 0.
    pub fn pack(self) -> u32 {
        debug_assert!(
            [self.address.x, self.address.y].iter().all(|c| c.is_multiple_of(1 << BLOCK_MIN_LOG2)),
            "{self:?}"
        );
        (u32::from(self.address.x) >> BLOCK_MIN_LOG2)
            | (u32::from(self.address.y) >> BLOCK_MIN_LOG2) << ADDRESS_BITS
            | (u32::from(self.size.width_log2) - BLOCK_MIN_LOG2) << (2 * ADDRESS_BITS)
            | (u32::from(self.size.height_log2) - BLOCK_MIN_LOG2) << (2 * ADDRESS_BITS + SIZE_BITS)
            | u32::from(self.address.page) << PAGE_SHIFT
    }

    /// The block of a packed word, if it lies within the largest atlas or a page of the store.
    pub fn unpack(word: u32) -> Result<Self, BlockError> {
        let field = |shift: u32, bits: u32| word >> shift & ((1 << bits) - 1);
        if word >> USED_BITS != 0 {
            return Err(BlockError { word, reason: "its uppermost bit must be zero" });
        }
        let address = BlockAddress {
            page: field(PAGE_SHIFT, PAGE_BITS) as u8,
            x: (field(0, ADDRESS_BITS) << BLOCK_MIN_LOG2) as u16,
            y: (field(ADDRESS_BITS, ADDRESS_BITS) << BLOCK_MIN_LOG2) as u16,
        };
        let size = BlockSize {
            width_log2: (field(2 * ADDRESS_BITS, SIZE_BITS) + BLOCK_MIN_LOG2) as u8,
            height_log2: (field(2 * ADDRESS_BITS + SIZE_BITS, SIZE_BITS) + BLOCK_MIN_LOG2) as u8,
        };
        let block = Self { address, size };
        let extent = if block.is_stored() { [STORE_PAGE_SIDE; 2] } else { ATLAS_MAX_EXTENT };
        if !block.fits(extent) {
            return Err(BlockError { word, reason: "it reaches beyond its page" });
        }
        Ok(block)
    }

    /// True where it lies in the store, not in the atlas.
    pub fn is_stored(self) -> bool {
        self.address.page != ATLAS_PAGE
    }

    /// True where the block lies wholly inside an atlas of this extent in texels.
    pub fn fits(self, extent_texels: [u32; 2]) -> bool {
        u32::from(self.address.x) + self.size.width() <= extent_texels[0]
            && u32::from(self.address.y) + self.size.height() <= extent_texels[1]
    }

    /// The whole block in texels: left, top, right, bottom; right and bottom exclusive.
    pub fn rect_texels(self) -> [u32; 4] {
        let (x, y) = (u32::from(self.address.x), u32::from(self.address.y));
        [x, y, x + self.size.width(), y + self.size.height()]
    }

    /// The rectangle to which the patch's unit square maps, in texel coordinates (a texel's centre is at +0.5): left,
    /// top, right, bottom. It goes from the middle of the first luma texel to that of the last, so that no bilinear lookup of
    /// luma leaves the block. Centre-sited half-resolution chroma is looked up within `CHROMA_INSET_TEXELS`.
    pub fn lookup_rect_texels(self) -> [f32; 4] {
        let [left, top, right, bottom] = self.rect_texels();
        let inset = BLOCK_INSET_TEXELS;
        [left as f32 + inset, top as f32 + inset, right as f32 - inset, bottom as f32 - inset]
    }

    /// True where the two blocks share a texel.
    pub fn overlaps(self, other: Self) -> bool {
        let (a, b) = (self.rect_texels(), other.rect_texels());
        self.address.page == other.address.page && a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3]
    }
}

/// How many texels of a block a pixel of the display covered when it was shaded, across and down: what its texels are filtered for. In
/// quarters of an octave, from 1 to 13.5 texels: 4 bits for each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PixelTexels(u8);

/// Steps of an octave.
pub const PIXEL_STEPS: f32 = 4.0;
/// Bits of the number of steps along a side.
pub const PIXEL_BITS: u32 = 4;

impl PixelTexels {
    /// The nearest to so many texels.
    pub fn new(texels: [f32; 2]) -> Self {
        let most = ((1u32 << PIXEL_BITS) - 1) as f32;
        let [across, down] =
            texels.map(|texels| (PIXEL_STEPS * texels.log2()).round().clamp(0.0, most) as u8);
        Self(across | down << PIXEL_BITS)
    }

    /// As [`Self::bits`] gives it.
    pub fn from_bits(bits: u8) -> Self {
        Self(bits)
    }

    /// Steps across from bit 0, down from bit 4.
    pub fn bits(self) -> u8 {
        self.0
    }

    /// Steps across and down, 0..16.
    pub fn steps(self) -> [u32; 2] {
        [self.0 & ((1 << PIXEL_BITS) - 1), self.0 >> PIXEL_BITS].map(u32::from)
    }

    /// Texels across and down.
    pub fn texels(self) -> [f32; 2] {
        self.steps().map(|steps| (steps as f32 / PIXEL_STEPS).exp2())
    }
}

#[cfg(test)]
mod tests;
