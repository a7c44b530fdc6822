//! How the scene moves: clips resampled to a constant interval, poses, bone palettes, skinning.

pub mod clip;
pub mod gpu;
pub mod pose;
