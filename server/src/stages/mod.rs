//! The GPU stages, in pipeline order. A stage is one file with its layout, pipeline and `record`; its shader carries
//! the same stem. Stages know nothing of each other: the barriers between them stand in `frame.rs` and `world.rs`.

pub mod palette;
pub mod skin;
pub mod id_buffer;
pub mod mark;
pub mod level_selection;
pub mod shadow;
pub mod shading;
pub mod ycbcr;

pub(crate) mod geometry;

use glam::{Mat4, Vec3};
use shadecast_shaders::generated::ViewGpu;

/// A view as the shaders have it.
pub fn view_gpu(clip_from_world: Mat4, world_eye: Vec3, extent_pixels: [u32; 2]) -> ViewGpu {
    ViewGpu {
        clip_from_world: clip_from_world.to_cols_array_2d(),
        world_eye: world_eye.extend(1.0).to_array(),
        extent_pixels: [extent_pixels[0] as f32, extent_pixels[1] as f32, 0.0, 0.0],
    }
}
