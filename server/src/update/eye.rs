//! The eyes of a client, and the densities that follow from them. Pure.

use crate::visibility::frusta::{Frusta, MIN_MARGIN, widened};
use shadecast_protocol::limits::ATLAS_MAX_EXTENT;
use shadecast_protocol::message::Capabilities;
use shadecast_protocol::pose::Fov;

/// Pixels of the ID buffer, each eye: as many as the largest atlas has texels. Two images of 4 bytes a pixel and eye.
const MAX_ID_BUFFER_PIXELS: u32 = ATLAS_MAX_EXTENT[0] * ATLAS_MAX_EXTENT[1];
/// Pixels of a side of the ID buffer: every device draws to as many.
const MAX_ID_BUFFER_SIDE: f32 = 8192.0;

/// Extent and fields of view of a client's eyes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct EyeSize {
    extent_pixels: [u32; 2],
    /// Left and right, as the display shows them.
    pub fovs: [Fov; 2],
}

impl EyeSize {
    /// As a client tells them.
    pub(crate) fn of(capabilities: &Capabilities) -> Self {
        Self { extent_pixels: capabilities.eye_extent_pixels, fovs: capabilities.eyes.map(|eye| eye.fov) }
    }

    /// In the middle of the picture, along the denser side of the denser eye.
    pub(crate) fn pixels_per_radian(&self) -> f32 {
        self.pixels_per_tangent().into_iter().fold(0.0, f32::max)
    }

    /// Pixels of the picture across which the tangent of the view angle grows by 1, x and y, of the denser eye.
    pub(crate) fn pixels_per_tangent(&self) -> [f32; 2] {
        let eyes = self.fovs.map(|fov| self.pixels_per_tangent_of(fov));
        [0, 1].map(|axis| eyes[0][axis].max(eyes[1][axis]))
    }

    /// The same of an eye with this field of view.
    pub(crate) fn pixels_per_tangent_of(&self, fov: Fov) -> [f32; 2] {
        let [width, height] = span_tangents(fov);
        [self.extent_pixels[0] as f32 / width, self.extent_pixels[1] as f32 / height]
    }

    /// Pixels that all frusta of an eye with this field of view can be seen with.
    fn extent_of(&self, fov: Fov) -> [f32; 2] {
        let frusta = Frusta::of(widened(fov, MIN_MARGIN));
        let extents =
            frusta.all().iter().map(|frustum| frustum.extent_pixels(fov, self.pixels_per_tangent_of(fov)));
        extents.fold([0.0, 0.0], |most, extent| [0, 1].map(|axis: usize| most[axis].max(extent[axis])))
    }

    /// Large enough for the widest field of view that a steady head needs; a wider one is seen more coarsely, and so is one
    /// that would need more than [`MAX_ID_BUFFER_PIXELS`].
    pub(crate) fn id_buffer_extent(&self) -> [u32; 2] {
        let widest = self.fovs.map(|fov| self.extent_of(fov));
        let side = |axis: usize| widest[0][axis].max(widest[1][axis]);
        let sides =
            [side(0), side(1)].map(|side| if side > 1.0 { side.min(MAX_ID_BUFFER_SIDE) } else { 1.0 });
        let most = MAX_ID_BUFFER_PIXELS as f32;
        // Each side by the same factor; a long and narrow buffer is bounded by its sides already.
        let scale = (most / (sides[0] * sides[1])).sqrt().min(1.0);
        sides.map(|side| ((side * scale).ceil() as u32).next_multiple_of(8))
    }
}

/// Of the whole width and height.
fn span_tangents(fov: Fov) -> [f32; 2] {
    [fov.right.tan() - fov.left.tan(), fov.up.tan() - fov.down.tan()]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn eye(extent_pixels: [u32; 2], left: f32, right: f32) -> EyeSize {
        EyeSize { extent_pixels, fovs: [Fov { left, right, up: right, down: left }; 2] }
    }

    #[test]
    fn a_usual_eye_has_an_id_buffer_of_its_own_density() {
        let [width, height] = eye([1024, 1024], -0.785, 0.785).id_buffer_extent();
        assert!((1130..1152).contains(&width) && width == height, "{width}x{height}");
    }

    #[test]
    fn the_id_buffer_is_bounded_whatever_a_client_says_of_its_eyes() {
        let angles = [-1.55f32, -1.2, -0.7, -0.02, -1e-40, 0.0, 1e-40, 0.02, 0.7, 1.2, 1.55, f32::NAN];
        for (left, right) in angles.into_iter().flat_map(|left| angles.map(|right| (left, right))) {
            for extent in [[1, 1], [8192, 8192], [1, 8192], [8192, 1]] {
                let [width, height] = eye(extent, left, right).id_buffer_extent();
                let pixels = u64::from(width) * u64::from(height);
                let most = u64::from(MAX_ID_BUFFER_PIXELS) + 8 * 2 * MAX_ID_BUFFER_SIDE as u64;
                assert!(
                    width > 0 && height > 0 && pixels <= most,
                    "{left} {right} {extent:?}: {width}x{height}"
                );
            }
        }
    }
}
