//! The Shadecast server: scenes, animation, visibility, atlas, shading, encoding.

pub mod animation;
pub mod atlas;
pub mod encode;
pub mod frame;
pub mod generate;
pub mod levels;
pub mod mips;
pub mod patches;
pub mod picture;
pub mod predict;
pub mod residency;
pub mod samples;
pub mod scene;
pub mod scene_gpu;
pub mod stages;
pub mod stream;
