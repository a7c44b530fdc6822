//! Twin of `level_selection.comp`: the largest projected extent of a patch over all predicted views.

use crate::constants::{MAX_PATCH_EXTENT_TEXELS, PATCH_ONE};
use glam::{Mat4, Vec2, Vec4};
use shadecast_protocol::limits::PATCH_MAX_VERTICES;
use shadecast_protocol::pose::NEAR_M;

const CORNERS: usize = PATCH_MAX_VERTICES as usize;

/// A view: its projection, and the pixels that its whole field of view would have on the display.
#[derive(Clone, Copy, Debug)]
pub struct View {
    /// Takes world coordinates to clip coordinates, w being the distance along the view axis.
    pub clip_from_world: Mat4,
    /// Width and height in pixels.
    pub extent_pixels: Vec2,
}

/// Width and height in texels of a patch of `kind` triangles, before any cap by its textures. `world[view]` holds its
/// five vertices (unused ones repeat the first) at the view's time.
pub fn extent_texels(kind: u32, views: &[View], world: &[[Vec4; CORNERS]]) -> [u32; 2] {
    let mut extent = Vec2::ONE;
    for (view, corners) in views.iter().zip(world) {
        let c = corners.map(|p| view.clip_from_world * p);
        if outside_one_side(&c) {
            continue;
        }
        let half = view.extent_pixels * 0.5;
        let mut size =
            Vec2::new(length(c[0], c[1], half), length(c[0], c[if kind == PATCH_ONE { 2 } else { 3 }], half));
        if kind != PATCH_ONE {
            size = size.max(Vec2::new(length(c[3], c[2], half), length(c[1], c[2], half)));
        }
        extent = extent.max(size);
    }
    extent.to_array().map(|side| side.ceil().clamp(1.0, MAX_PATCH_EXTENT_TEXELS) as u32)
}

fn outside_one_side(c: &[Vec4; CORNERS]) -> bool {
    let all = |outside: fn(&Vec4) -> bool| c.iter().all(outside);
    all(|p| p.x < -p.w) || all(|p| p.x > p.w) || all(|p| p.y < -p.w) || all(|p| p.y > p.w)
}

/// Length in pixels of the part of an edge in front of the near plane.
fn length(mut a: Vec4, mut b: Vec4, half_extent: Vec2) -> f32 {
    if a.w < NEAR_M && b.w < NEAR_M {
        return 0.0;
    }
    if a.w < NEAR_M {
        a = a.lerp(b, (NEAR_M - a.w) / (b.w - a.w));
    }
    if b.w < NEAR_M {
        b = b.lerp(a, (NEAR_M - b.w) / (a.w - b.w));
    }
    let ndc = |p: Vec4| Vec2::new(p.x, p.y) / p.w;
    ((ndc(a) - ndc(b)) * half_extent).length()
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_protocol::pose::Fov;

    fn view() -> View {
        View {
            clip_from_world: Fov::symmetric_degrees(90.0).clip_from_eye(),
            extent_pixels: Vec2::new(512.0, 512.0),
        }
    }

    fn quad(z: f32) -> [Vec4; CORNERS] {
        let p = |x: f32, y: f32, z: f32| Vec4::new(x, y, z, 1.0);
        [p(-0.5, 0.0, z), p(0.5, 0.0, z), p(0.5, 0.25, z), p(-0.5, 0.25, z), p(-0.5, 0.0, z)]
    }

    #[test]
    fn a_quad_of_one_metre_at_two_metres_has_128_texels_in_a_512_pixel_view() {
        assert_eq!(extent_texels(2, &[view()], &[quad(-2.0)]), [128, 32]);
    }

    #[test]
    fn what_is_behind_or_beside_the_view_counts_as_one_texel() {
        assert_eq!(extent_texels(2, &[view()], &[quad(2.0)]), [1, 1]);
        let beside = quad(-1.0).map(|p| p + Vec4::new(9.0, 0.0, 0.0, 0.0));
        assert_eq!(extent_texels(2, &[view()], &[beside]), [1, 1]);
    }

    #[test]
    fn an_edge_through_the_near_plane_is_clipped_there() {
        let mut corners = quad(-2.0);
        corners[1].z = 3.0;
        corners[2].z = 3.0;
        let [width, _] = extent_texels(2, &[view()], &[corners]);
        assert!(width > 128 && width < 65535, "{width}");
    }
}
