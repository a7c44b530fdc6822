//! A view as the shaders have it.

use glam::{Mat4, Vec3};
use shadecast_protocol::pose::Fov;
use shadecast_shaders::generated::ViewGpu;

/// Of a border, for a field of view beside the optical axis.
const LEAST_TANGENT: f32 = 1e-3;

/// A view as the shaders have it, from which nothing is measured.
pub fn view_gpu(clip_from_world: Mat4, world_eye: Vec3) -> ViewGpu {
    ViewGpu {
        clip_from_world: clip_from_world.to_cols_array_2d(),
        world_eye: world_eye.extend(1.0).to_array(),
        tangents_from_clip: [0.0; 4],
        shown_tangents: [0.0; 4],
        pixels_per_tangent: [0.0; 4],
    }
}

/// A predicted view, from which extents are measured: it sees `fov`, for a display that shows `shown` of that, with so many pixels
/// along x and y for a tangent of 1.
pub fn predicted_view_gpu(
    clip_from_world: Mat4,
    world_eye: Vec3,
    fov: Fov,
    shown: Fov,
    pixels_per_tangent: [f32; 2],
) -> ViewGpu {
    let [left, right, up, down] = [fov.left, fov.right, fov.up, fov.down].map(f32::tan);
    let shown = [-shown.left, -shown.down, shown.right, shown.up];
    ViewGpu {
        tangents_from_clip: [
            0.5 * (right - left),
            0.5 * (down - up),
            0.5 * (right + left),
            0.5 * (up + down),
        ],
        // Beyond a border that is on the other side of the axis nothing is shown.
        shown_tangents: shown.map(|angle| angle.tan().max(LEAST_TANGENT)),
        pixels_per_tangent: [pixels_per_tangent[0], pixels_per_tangent[1], 0.0, 0.0],
        ..view_gpu(clip_from_world, world_eye)
    }
}
