//! Coverage of the cutouts' blocks, by texel of the atlas, for the update on display.

use shadecast_protocol::atlas::{AtlasExtent, Block};
use shadecast_protocol::coverage::Coverage;

/// Bits of a word.
const WORD_BITS: u32 = u32::BITS;

/// See the module. As `coverage.glsl` reads it: a word with the atlas's width, then a bit a texel, row by row.
#[derive(Debug)]
pub struct CoverageMap {
    extent: AtlasExtent,
    /// Empty before the first cutout.
    words: Vec<u32>,
}

impl CoverageMap {
    /// Of an atlas without cutouts.
    pub fn new(extent: AtlasExtent) -> Self {
        Self { extent, words: Vec::new() }
    }

    /// Bytes of the map of an atlas.
    pub fn byte_count(extent: AtlasExtent) -> u64 {
        4 + u64::from(extent.width()) * u64::from(extent.height()) / 8
    }

    /// The map's words; none before the first cutout.
    pub fn words(&self) -> &[u32] {
        &self.words
    }

    /// Takes in what is left of a block. What lies beyond the atlas is nobody's.
    pub fn cover(&mut self, block: Block, coverage: &Coverage) {
        let [width, height] = self.extent.texels();
        if self.words.is_empty() {
            self.words = vec![0; Self::byte_count(self.extent) as usize / 4];
            self.words[0] = width;
        }
        let [left, top, right, bottom] = block.rect_texels();
        for y in top..bottom.min(height) {
            for x in left..right.min(width) {
                let bit = y * width + x;
                let word = &mut self.words[1 + (bit / WORD_BITS) as usize];
                let mask = 1 << (bit % WORD_BITS);
                let is_covered = coverage.is_covered((y - top) * block.size.width() + x - left);
                *word = if is_covered { *word | mask } else { *word & !mask };
            }
        }
    }
}
