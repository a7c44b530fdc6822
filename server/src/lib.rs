//! The Shadecast server: animation on the GPU, visibility, atlas, shading, encoding.

pub mod animation;
pub mod atlas;
pub mod choice;
pub mod culling;
pub mod encode;
pub mod encoding;
pub mod flags;
pub mod frame;
pub mod geometry;
pub mod inspect;
pub mod levels;
pub mod lights;
pub mod motion;
pub mod pacing;
pub mod picture;
pub mod predict;
pub mod residency;
pub mod samples;
pub mod scene;
pub mod sessions;
pub mod stages;
pub mod stream;
pub mod truth;
pub mod upload;
pub mod viewer;
pub mod world;
