//! The Shadecast server: scenes, animation, visibility, atlas, shading, encoding.

pub mod encode;
