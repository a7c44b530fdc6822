//! How a model moves, on the CPU: source curves, poses, skinning.

pub mod clip;
pub mod pose;
