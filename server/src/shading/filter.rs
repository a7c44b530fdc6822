//! The pixel that textures are filtered for in a block.

/// What textures are filtered for when a block is shaded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Filter {
    /// A pixel of the display, no less than a texel of the block, by a few samples: the product's.
    #[default]
    Pixel,
    /// A texel of the block, by one sample.
    Texel,
    /// As the product's, by many samples.
    Supersampled,
}

impl Filter {
    /// Samples across and down a pixel, where textures are finer than it. `is_fast`: one is to do.
    pub(crate) fn samples_a_side(self, is_fast: bool) -> u32 {
        match self {
            _ if is_fast => 1,
            Self::Pixel => 2,
            Self::Texel => 1,
            Self::Supersampled => 4,
        }
    }
}
