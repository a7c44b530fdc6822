//! The Shadecast server: animation on the GPU, visibility, atlas, shading, encoding. Folders import downwards only, in the order below.

pub mod support;
pub mod time;
pub mod animation;
pub mod scene;
pub mod skinning;
pub mod pacing;
pub mod visibility;
pub mod motion;
pub mod atlas;
pub mod residency;
pub mod shading;
pub mod world;
pub mod encode;
pub mod update;
pub mod serve;
pub mod truth;
#[cfg(feature = "bench")]
pub mod bench;
