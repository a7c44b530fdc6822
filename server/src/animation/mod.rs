//! How the scene moves: what the GPU needs of it, each once, and samples of it on the time grid.

pub mod buffers;
pub mod gpu;
pub mod manager;
pub mod skinning;
