//! FLIP (Andersson et al. 2020): visibility of the difference to someone who flips between two pictures.
//!
//! NVIDIA's own implementation through `nv-flip`, for low dynamic range. It expects sRGB bytes and linearises them itself.
//! Visibility depends on the pixels per degree of the view, so every figure needs that number.

use crate::image::Rgb8Image;

/// Pixels per degree that FLIP figures are usually given for: a monitor at 0.7 m.
pub const DEFAULT_PIXELS_PER_DEGREE: f32 = nv_flip::DEFAULT_PIXELS_PER_DEGREE;

/// The visible difference at every pixel, 0 (none) to 1. The pictures have one extent.
pub fn flip_map(truth: &Rgb8Image, client: &Rgb8Image, pixels_per_degree: f32) -> Vec<f32> {
    assert_eq!(
        (truth.width, truth.height),
        (client.width, client.height),
        "pictures to compare have one extent"
    );
    nv_flip::flip(flip_image(truth), flip_image(client), pixels_per_degree).to_vec()
}

fn flip_image(image: &Rgb8Image) -> nv_flip::FlipImageRgb8 {
    nv_flip::FlipImageRgb8::with_data(image.width, image.height, &image.data)
}

/// Pixels per degree at the centre of a view of `width` pixels that spans the horizontal angles from `left_rad`
/// (negative) to `right_rad`, drawn on a plane: 11.3 for 1300 pixels and 90 degrees.
pub fn pixels_per_degree(width: u32, left_rad: f32, right_rad: f32) -> f32 {
    let pixels_per_radian = width as f32 / (right_rad.tan() - left_rad.tan());
    pixels_per_radian * std::f32::consts::PI / 180.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measure::metrics::known;

    fn mean(map: &[f32]) -> f64 {
        map.iter().map(|&error| f64::from(error)).sum::<f64>() / map.len() as f64
    }

    #[test]
    fn a_picture_does_not_differ_from_itself() {
        let map = flip_map(&known::truth(), &known::truth(), DEFAULT_PIXELS_PER_DEGREE);
        assert!(map.iter().all(|&error| error == 0.0));
    }

    /// Computed with flip-evaluator 1.7 (LDR, pictures as sRGB in 0..1): mean of the map, and one pixel of it.
    #[test]
    fn the_map_is_the_one_of_the_reference_implementation() {
        let middle = 24 * known::WIDTH as usize + 32;
        for (ppd, want_mean, want_middle) in
            [(67.0, 0.30539849443448475, 0.27550754), (11.3, 0.3766054055619558, 0.31059802)]
        {
            let map = flip_map(&known::truth(), &known::client(), ppd);
            assert!((mean(&map) - want_mean).abs() < 1e-4, "{ppd} pixels per degree: {}", mean(&map));
            assert!((map[middle] - want_middle).abs() < 1e-3, "{ppd} pixels per degree: {}", map[middle]);
        }
    }

    #[test]
    fn a_view_of_1300_pixels_and_90_degrees_has_11_pixels_per_degree() {
        let quarter = std::f32::consts::FRAC_PI_4;
        assert!((pixels_per_degree(1300, -quarter, quarter) - 11.344).abs() < 1e-3);
    }
}
