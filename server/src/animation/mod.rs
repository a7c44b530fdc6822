//! How the scene moves: samples of the whole scene on the GPU.

pub mod gpu;
