//! Which pixels a triangle covers. Pure.

use glam::Vec2;

/// Calls `at` for each pixel of a picture whose middle lies in a triangle or on its border: its index, row by row, and the weights of the
/// corners there, which add up to 1. `corners` are in pixels, in either order. One without an area covers nothing.
pub(crate) fn for_each_pixel(
    corners: [Vec2; 3],
    [width, height]: [usize; 2],
    mut at: impl FnMut(usize, [f32; 3]),
) {
    let [a, b, c] = corners;
    let area = (b - a).perp_dot(c - a);
    if area == 0.0 || !area.is_finite() {
        return;
    }
    let (low, high) = (a.min(b).min(c), a.max(b).max(c));
    let range = |low: f32, high: f32, side: usize| {
        (low - 0.5).ceil().max(0.0) as usize..((high + 0.5).floor().clamp(0.0, side as f32)) as usize
    };
    for y in range(low.y, high.y, height) {
        for x in range(low.x, high.x, width) {
            let pixel = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
            let part = |from: Vec2, to: Vec2| (to - from).perp_dot(pixel - from) / area;
            let weights = [part(b, c), part(c, a), part(a, b)];
            if weights.iter().all(|weight| *weight >= 0.0) {
                at(y * width + x, weights);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_orders_of_corners_cover_the_same_pixels_with_weights_that_add_up() {
        let corners = [Vec2::new(-1.0, -1.0), Vec2::new(3.0, -1.0), Vec2::new(-1.0, 3.0)];
        let [a, b, c] = corners;
        let covered = |corners: [Vec2; 3]| {
            let mut pixels = Vec::new();
            for_each_pixel(corners, [4, 2], |pixel, weights| {
                assert!((weights.iter().sum::<f32>() - 1.0).abs() < 1e-6);
                pixels.push(pixel);
            });
            pixels
        };
        // Middles with x + y <= 2, row by row.
        assert_eq!(covered(corners), [0, 1, 4]);
        assert_eq!(covered([a, c, b]), covered(corners));
        assert!(covered([a, b, a]).is_empty());
    }
}
