//! Time-warp: a decoded picture as another head sees it that turned since, and where there is depth also moved. Pure.

use super::depth::{Change, Depth, pixels};
use crate::image::Rgb8Image;
use glam::{Mat3, Vec2, Vec3};
use shadecast_protocol::picture::I420;
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_shaders::color::rgb_from_ycbcr;
use shadecast_shaders::twin::atlas_lookup::Plane;

/// A decoded picture of one eye, and what it shows.
pub(super) struct Decoded {
    luma: Plane,
    chroma: [Plane; 2],
    extent_pixels: Vec2,
    depth: Option<Depth>,
    /// Where the eye was.
    world_from_eye: Pose,
    /// What it saw.
    fov: Fov,
}

impl Decoded {
    /// Of a picture with an eye's pose and field of view.
    pub(super) fn new(picture: &I420, depth: Option<Depth>, world_from_eye: Pose, fov: Fov) -> Self {
        let [width, height] = picture.extent_texels();
        let plane = |values: &[u8], width: u32| Plane {
            width: width as usize,
            values: values.iter().map(|value| f32::from(*value) / 255.0).collect(),
        };
        let [luma, cb, cr] = picture.planes();
        Self {
            luma: plane(luma, width),
            chroma: [plane(cb, width / 2), plane(cr, width / 2)],
            extent_pixels: Vec2::new(width as f32, height as f32),
            depth,
            world_from_eye,
            fov,
        }
    }

    /// What an eye elsewhere sees of it. Beyond its border it goes on as the border is.
    pub(super) fn warped(&self, world_from_eye: Pose, fov: Fov, extent_pixels: [u32; 2]) -> Rgb8Image {
        let now_from_then = world_from_eye.inverse().then(self.world_from_eye);
        let change = Change { now_from_then, fov_then: self.fov, fov_now: fov, extent_pixels };
        let sources = self.depth.as_ref().map(|depth| depth.sources(change));
        let then_from_now = Mat3::from_quat(now_from_then.orientation.inverse());
        let (low, high) = tangents(fov);
        let (low_then, high_then) = tangents(self.fov);
        let extent = pixels(extent_pixels);
        let pixel = |x: u32, y: u32| {
            let at = (y * extent_pixels[0] + x) as usize;
            if let Some(source) = sources.as_ref().and_then(|sources| sources[at]) {
                return self.rgb8(source * self.extent_pixels);
            }
            let part = (Vec2::new(x as f32, y as f32) + 0.5) / extent;
            let tangent = low + part * (high - low);
            let then = then_from_now * Vec3::new(tangent.x, -tangent.y, -1.0);
            // What lies behind the picture's eye is beyond its border, whichever way.
            let tangent_then = Vec2::new(then.x, -then.y) / (-then.z).max(1e-3);
            let part_then = ((tangent_then - low_then) / (high_then - low_then)).clamp(Vec2::ZERO, Vec2::ONE);
            self.rgb8(part_then * self.extent_pixels)
        };
        let [width, height] = extent_pixels;
        let data = (0..height)
            .flat_map(|y| (0..width).map(move |x| (x, y)))
            .flat_map(|(x, y)| pixel(x, y))
            .collect();
        Rgb8Image::new(width, height, data).expect("as many bytes as pixels have")
    }

    fn rgb8(&self, at: Vec2) -> [u8; 3] {
        let [cb, cr] = [0, 1].map(|channel| self.chroma[channel].linear(at * 0.5));
        let rgb = rgb_from_ycbcr([self.luma.linear(at), cb, cr]);
        (rgb * 255.0).round().clamp(Vec3::ZERO, Vec3::splat(255.0)).to_array().map(|channel| channel as u8)
    }
}

/// Of the left and upper side, and of the right and lower one; down is positive.
pub(super) fn tangents(fov: Fov) -> (Vec2, Vec2) {
    (Vec2::new(fov.left.tan(), -fov.up.tan()), Vec2::new(fov.right.tan(), -fov.down.tan()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;
    use shadecast_shaders::color;

    const SIDE: u32 = 64;

    /// A column of white in an even ground, at an angle to the right of the middle.
    fn column(angle: f32, fov: Fov) -> Decoded {
        let at = ((angle.tan() - fov.left.tan()) / (fov.right.tan() - fov.left.tan()) * SIDE as f32) as u32;
        let rgba = (0..SIDE * SIDE).flat_map(|pixel| {
            let is_white = (pixel % SIDE).abs_diff(at) <= 1;
            if is_white { [255, 255, 255, 255] } else { [20, 60, 90, 255] }
        });
        let picture = color::picture(&rgba.collect::<Vec<_>>(), [SIDE, SIDE]);
        Decoded::new(&picture, None, Pose::IDENTITY, fov)
    }

    fn brightest_column(picture: &Rgb8Image) -> u32 {
        let light = |x: u32| (0..picture.height).map(|y| u32::from(picture.pixel(x, y)[0])).sum::<u32>();
        (0..picture.width).max_by_key(|x| light(*x)).expect("it has columns")
    }

    #[test]
    fn an_eye_that_looks_the_same_way_sees_the_picture() {
        let fov = Fov::symmetric_degrees(90.0);
        let picture = column(0.2, fov).warped(Pose::IDENTITY, fov, [SIDE, SIDE]);
        assert_eq!(picture.pixel(3, 3).map(|channel| channel.abs_diff([20, 60, 90][0])).len(), 3);
        let expected = column(0.2, fov);
        for x in 0..SIDE {
            let own = expected.rgb8(Vec2::new(x as f32 + 0.5, 10.5));
            assert_eq!(picture.pixel(x, 10), own, "column {x}");
        }
    }

    #[test]
    fn what_lies_straight_ahead_is_in_the_middle_for_an_eye_that_turns_there() {
        let fov = Fov::symmetric_degrees(90.0);
        for angle in [-0.3f32, 0.1, 0.4] {
            // To the right is about -y.
            let turned = Pose { orientation: Quat::from_rotation_y(-angle), ..Pose::IDENTITY };
            let seen = column(angle, fov).warped(turned, fov, [SIDE, SIDE]);
            assert!(brightest_column(&seen).abs_diff(SIDE / 2) <= 1, "{angle}: {}", brightest_column(&seen));
        }
    }

    #[test]
    fn a_margin_is_left_out_where_the_head_came_as_expected() {
        let (wide, narrow) = (Fov::symmetric_degrees(110.0), Fov::symmetric_degrees(90.0));
        let seen = column(0.3, wide).warped(Pose::IDENTITY, narrow, [SIDE, SIDE]);
        let expected = ((0.3f32.tan() + 1.0) / 2.0 * SIDE as f32) as u32;
        assert!(brightest_column(&seen).abs_diff(expected) <= 1);
    }

    #[test]
    fn beyond_its_border_a_picture_goes_on() {
        let fov = Fov::symmetric_degrees(90.0);
        let seen = column(0.0, fov).warped(
            Pose { orientation: Quat::from_rotation_y(2.5), ..Pose::IDENTITY },
            fov,
            [SIDE, SIDE],
        );
        assert_eq!(seen.pixel(0, 0), seen.pixel(SIDE - 1, 0));
    }
}
