//! Where an update looks from, and what it sees.
//!
//! Head poses and instances enter; predicted views, needed instances, LODs and seen patches leave. Nothing here
//! knows blocks, the client's memory or colours.

pub mod predict;
pub mod view_plan;
pub(crate) mod frusta;
pub mod culling;
pub mod clusters;
pub(crate) mod sweep;
pub(crate) mod holding;
pub(crate) mod nearness;
pub mod detail;
pub mod lod_set;
pub mod passes;
