//! Which blocks an update shades, and the passes that do.
//!
//! Placed blocks and the state of the scene enter; the planes of the atlas leave. Nothing here decides what is visible or
//! where a block lies.

pub mod filter;
pub mod reuse;
pub mod shadow_change;
pub mod passes;
