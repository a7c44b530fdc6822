//! The pixel that textures are filtered for in a block.

/// What textures are filtered for when a block is shaded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Filter {
    /// A pixel of the display, no less than a texel of the block: the product's.
    #[default]
    Pixel,
    /// A texel of the block.
    Texel,
    /// As the product's, at many places of a texel, which has their mean.
    Supersampled,
}
