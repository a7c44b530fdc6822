//! Twin of `extents.comp`: the largest extent on the display of a patch over all predicted views.

use crate::constants::{MAX_PATCH_EXTENT_TEXELS, PATCH_ONE};
use glam::{Mat4, Vec2, Vec4, Vec4Swizzles};
use shadecast_protocol::limits::PATCH_MAX_VERTICES;

const CORNERS: usize = PATCH_MAX_VERTICES as usize;

/// A view: its projection, and the display that it is for.
#[derive(Clone, Copy, Debug)]
pub struct View {
    /// Takes world coordinates to clip coordinates, w being the distance along the view axis.
    pub clip_from_world: Mat4,
    /// Of x and y over w: factors, and what is added; tangents of the view angle grow rightwards and upwards.
    pub tangents_from_clip: Vec4,
    /// The display's own field of view: left, down, right, up; positive.
    pub shown_tangents: Vec4,
    /// Along x and y.
    pub pixels_per_tangent: Vec2,
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
        let at = c.map(|c| place_pixels(c, view));
        let mut size =
            Vec2::new(at[0].distance(at[1]), at[0].distance(at[if kind == PATCH_ONE { 2 } else { 3 }]));
        if kind != PATCH_ONE {
            size = size.max(Vec2::new(at[3].distance(at[2]), at[1].distance(at[2])));
        }
        extent = extent.max(size);
    }
    extent.to_array().map(|side| side.ceil().clamp(1.0, MAX_PATCH_EXTENT_TEXELS) as u32)
}

/// Whether any of the views has a patch within it, as far as one side of its frustum tells.
pub fn is_within(views: &[View], world: &[[Vec4; CORNERS]]) -> bool {
    views.iter().zip(world).any(|(view, p)| !outside_one_side(&p.map(|p| view.clip_from_world * p)))
}

fn outside_one_side(c: &[Vec4; CORNERS]) -> bool {
    let all = |outside: fn(&Vec4) -> bool| c.iter().all(outside);
    all(|p| p.x < -p.w) || all(|p| p.x > p.w) || all(|p| p.y < -p.w) || all(|p| p.y > p.w)
}

/// Where a point stands on the display, in pixels from the optical axis; see the shader for what it does not show.
fn place_pixels(c: Vec4, view: &View) -> Vec2 {
    let (factors, added) = (view.tangents_from_clip.xy(), view.tangents_from_clip.zw());
    let beside = c.xy() * factors + c.w * added;
    let distance_beside = beside.length();
    if distance_beside < 1e-12 {
        return Vec2::ZERO;
    }
    let way = beside / distance_beside;
    let border = Vec2::select(way.cmpgt(Vec2::ZERO), view.shown_tangents.zw(), view.shown_tangents.xy());
    let edge = (way.abs() / border).max_element().recip();
    let tangent = if distance_beside < c.w * edge {
        distance_beside / c.w
    } else {
        edge + (1.0 + edge * edge) * (distance_beside.atan2(c.w) - edge.atan())
    };
    way * tangent * view.pixels_per_tangent
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_protocol::pose::Fov;

    /// A display of 512 pixels over 90 degrees, and a predicted view that is wider by 20 degrees on each side.
    fn view() -> View {
        let wide = 65f32.to_radians().tan();
        View {
            clip_from_world: Fov::symmetric_degrees(130.0).clip_from_eye(),
            tangents_from_clip: Vec4::new(wide, -wide, 0.0, 0.0),
            shown_tangents: Vec4::ONE,
            pixels_per_tangent: Vec2::splat(256.0),
        }
    }

    fn quad(z: f32) -> [Vec4; CORNERS] {
        let p = |x: f32, y: f32, z: f32| Vec4::new(x, y, z, 1.0);
        [p(-0.5, 0.0, z), p(0.5, 0.0, z), p(0.5, 0.25, z), p(-0.5, 0.25, z), p(-0.5, 0.0, z)]
    }

    #[test]
    fn a_metre_quad_at_two_metres_has_128_texels() {
        assert_eq!(extent_texels(2, &[view()], &[quad(-2.0)]), [128, 32]);
    }

    #[test]
    fn what_is_behind_or_beside_the_view_counts_as_one_texel() {
        assert_eq!(extent_texels(2, &[view()], &[quad(2.0)]), [1, 1]);
        let beside = quad(-1.0).map(|p| p + Vec4::new(9.0, 0.0, 0.0, 0.0));
        assert_eq!(extent_texels(2, &[view()], &[beside]), [1, 1]);
    }

    /// A square of 4 cm, 2 m away, so many degrees to the side, which looks at the eye.
    fn aside(degrees: f32) -> [Vec4; CORNERS] {
        let turn = Mat4::from_rotation_y(-degrees.to_radians());
        let p = |x: f32, y: f32| turn * Vec4::new(x * 0.04, y * 0.04, -2.0, 1.0);
        [p(-0.5, -0.5), p(0.5, -0.5), p(0.5, 0.5), p(-0.5, 0.5), p(-0.5, -0.5)]
    }

    #[test]
    fn a_patch_beside_the_display_keeps_its_border_texels() {
        let width = |degrees: f32| extent_texels(2, &[view()], &[aside(degrees)])[0];
        let in_the_middle = 0.04f32 / 2.0 * 256.0;
        assert_eq!(width(0.0), in_the_middle.ceil() as u32);
        assert_eq!(width(44.9), (in_the_middle * 2.0).ceil() as u32, "tangents grow with the square");
        for degrees in [46.0, 55.0, 64.0] {
            assert_eq!(width(degrees), width(44.9), "{degrees}");
        }
    }

    #[test]
    fn a_patch_behind_the_eye_counts_its_visible_part_only() {
        let mut corners = quad(-2.0);
        corners[1].z = 3.0;
        corners[2].z = 3.0;
        let [width, _] = extent_texels(2, &[view()], &[corners]);
        assert!((128..2000).contains(&width), "{width}");
        let mut c = view().clip_from_world * Vec4::new(0.3, 0.2, -1e-7, 1.0);
        assert!(place_pixels(c, &view()).is_finite());
        c = Vec4::ZERO;
        assert!(place_pixels(c, &view()).is_finite());
    }

    #[test]
    fn places_go_on_across_the_border_without_a_step() {
        let at = |degrees: f32, turn: f32| {
            let (sine, cosine) = degrees.to_radians().sin_cos();
            let way = Vec2::from_angle(turn);
            place_pixels(view().clip_from_world * (way * sine).extend(-cosine).extend(1.0), &view()).length()
        };
        for turn in [0.0, 0.3, 0.8, 2.0, 4.0] {
            let mut last = at(0.0, turn);
            for tenth in 1..1790 {
                let now = at(tenth as f32 * 0.1, turn);
                assert!(now > last && now - last < 2.5, "{tenth}: {last} to {now}");
                last = now;
            }
        }
    }
}
