//! The blocks that an update shades, and the shading passes.
//!
//! Placed blocks and the state of the scene enter; the planes of the atlas leave. Nothing here decides visibility or the places
//! of blocks.

pub mod filter;
pub mod reuse;
pub(crate) mod shadow_change;
pub mod passes;
