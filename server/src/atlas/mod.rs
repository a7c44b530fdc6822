//! Which patch has which block of the atlas. Pure.
//!
//! Seen patches with their extents enter; placements leave. Nothing here knows the device or the client's slots.

pub(crate) mod placement;
pub(crate) mod capacity;
pub(crate) mod sizing;
pub(crate) mod store;
pub mod surround;
pub(crate) mod layout;
