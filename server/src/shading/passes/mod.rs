//! The GPU passes of shading, in pipeline order: the sun's shadow map, the atlas, its planes for the encoder.

pub(crate) mod shadow;
pub(crate) mod shading;
pub mod ycbcr;
