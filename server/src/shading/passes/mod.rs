//! The GPU passes of shading, in pipeline order: the sun's shadow map, the atlas, its planes for the encoder.

pub mod shadow;
pub mod shading;
pub mod ycbcr;
