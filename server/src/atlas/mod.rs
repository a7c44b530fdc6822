//! Which patch has which block of the atlas. Pure.
//!
//! Seen patches with their extents enter; placements leave. Nothing here knows the device or the client's slots.

pub mod placement;
pub mod capacity;
pub mod allocator;
pub mod sizing;
pub mod surround;
pub mod layout;
