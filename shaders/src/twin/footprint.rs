//! Twin of `footprint.glsl`: the area of a block under a pixel of the display.

use crate::constants::{EDGE_COSINE, MAX_TEXELS_PER_PIXEL, MIN_TEXELS_PER_PIXEL};
use glam::{Mat2, Vec2, Vec3};
use shadecast_protocol::pose::NEAR_M;

/// Pixels that the picture of a head at `at` moves by as the surface moves by `step_m`, both in the space of the head, which
/// looks along -z.
pub fn pixels_of(at: Vec3, step_m: Vec3, pixels_per_tangent: Vec2) -> Vec2 {
    let (distance_m, depth_m) = (at.length(), -at.z);
    if depth_m > EDGE_COSINE * distance_m {
        return pixels_per_tangent * (step_m.truncate() + at.truncate() / depth_m * step_m.z) / depth_m;
    }
    let n = if distance_m > NEAR_M { at / distance_m } else { Vec3::Z };
    let a = n.cross(if n.y.abs() < 0.9 { Vec3::Y } else { Vec3::X }).normalize();
    let density = pixels_per_tangent.max_element() / (EDGE_COSINE * distance_m.max(NEAR_M));
    density * Vec2::new(a.dot(step_m), n.cross(a).dot(step_m))
}

/// The inverse of the change of pixels with texels, with singular values from [`MIN_TEXELS_PER_PIXEL`] to
/// [`MAX_TEXELS_PER_PIXEL`].
pub fn texels_per_pixel(pixels_per_texel: Mat2) -> Mat2 {
    let (x, y) = (pixels_per_texel.x_axis, pixels_per_texel.y_axis);
    let (xx, yy, xy) = (x.dot(x), y.dot(y), x.dot(y));
    let half_difference = 0.5 * (xx - yy);
    let spread = (half_difference * half_difference + xy * xy).sqrt();
    let largest = (0.5 * (xx + yy) + spread).max(1e-20).sqrt();
    let smallest = pixels_per_texel.determinant().abs() / largest;
    let along = if half_difference >= 0.0 {
        Vec2::new(half_difference + spread, xy)
    } else {
        Vec2::new(xy, spread - half_difference)
    };
    let along = if along.dot(along) > 1e-20 * largest * largest { along.normalize() } else { Vec2::X };
    let u = pixels_per_texel * along / largest;
    let v = u.perp() * if pixels_per_texel.determinant() < 0.0 { -1.0 } else { 1.0 };
    let texels = Vec2::new(largest, smallest)
        .max(Vec2::splat(1e-10))
        .recip()
        .clamp(Vec2::splat(MIN_TEXELS_PER_PIXEL), Vec2::splat(MAX_TEXELS_PER_PIXEL));
    outer(along * texels.x, u) + outer(along.perp() * texels.y, v)
}

fn outer(column: Vec2, row: Vec2) -> Mat2 {
    Mat2::from_cols(column * row.x, column * row.y)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng, rngs::SmallRng};

    fn vec2(dice: &mut SmallRng) -> Vec2 {
        Vec2::from_array([0; 2].map(|_| dice.random_range(-1.0..1.0f32)))
    }

    fn vec3(dice: &mut SmallRng) -> Vec3 {
        vec2(dice).extend(dice.random_range(-1.0..1.0f32))
    }

    /// Largest and smallest, by turning a unit vector round.
    fn reach(matrix: Mat2) -> [f32; 2] {
        let lengths =
            (0..720).map(|step| (matrix * Vec2::from_angle(step as f32 * 0.25f32.to_radians())).length());
        lengths.fold([0.0, f32::MAX], |[most, least], length| [most.max(length), least.min(length)])
    }

    #[test]
    fn within_the_view_pixels_move_as_the_projection_does() {
        let mut dice = SmallRng::seed_from_u64(1);
        let density = Vec2::new(300.0, 200.0);
        let seen = |at: Vec3| density * at.truncate() / -at.z;
        for _ in 0..1000 {
            let at = vec3(&mut dice) * Vec3::new(2.0, 2.0, 0.5) - Vec3::Z * 3.0;
            let step = vec3(&mut dice) * 1e-3;
            let [moved, expected] = [pixels_of(at, step, density), seen(at + step) - seen(at - step)];
            assert!((2.0 * moved).distance(expected) < 0.01, "{at} {step}: {moved} {expected}");
        }
    }

    #[test]
    fn outside_the_view_a_pixel_is_as_small_as_in_its_corner() {
        let density = Vec2::new(300.0, 200.0);
        for at in [Vec3::Z, Vec3::X, -Vec3::X, Vec3::Y, Vec3::new(1.0, 2.0, 3.0), Vec3::new(-3.0, 0.0, -0.1)]
        {
            let at = at * 2.0;
            let n = at.normalize();
            let [a, b] = [n.any_orthonormal_vector(), n.cross(n.any_orthonormal_vector())];
            for step in [a, b, a + b] {
                let pixels = pixels_of(at, step * 0.01, density).length();
                let expected = step.length() * 0.01 * 300.0 / (EDGE_COSINE * at.length());
                assert!((pixels / expected - 1.0).abs() < 1e-4, "{at} {step}: {pixels} {expected}");
            }
        }
        assert!(pixels_of(Vec3::ZERO, Vec3::X, density).is_finite(), "the eye itself");
    }

    #[test]
    fn a_footprint_that_is_neither_small_nor_long_is_the_inverse() {
        let mut dice = SmallRng::seed_from_u64(2);
        let mut looked_at = 0;
        for _ in 0..2000 {
            let matrix = Mat2::from_cols(vec2(&mut dice), vec2(&mut dice));
            let [most, least] = reach(matrix);
            if most < 0.99 / MIN_TEXELS_PER_PIXEL && least > 1.01 / MAX_TEXELS_PER_PIXEL {
                looked_at += 1;
                let product = texels_per_pixel(matrix) * matrix;
                assert!((product - Mat2::IDENTITY).abs_diff_eq(Mat2::ZERO, 1e-3), "{matrix}: {product}");
            }
        }
        assert!(looked_at > 500);
    }

    #[test]
    fn a_pixel_covers_at_least_a_texel_and_is_bounded() {
        let mut dice = SmallRng::seed_from_u64(3);
        for round in 0..2000 {
            let scale = 10f32.powi(round % 13 - 6);
            let x = vec2(&mut dice) * scale;
            let y = match round % 4 {
                0 => x * 0.5,
                1 => Vec2::ZERO,
                _ => vec2(&mut dice) * 10f32.powi(dice.random_range(-6..=6)),
            };
            let [most, least] = reach(texels_per_pixel(Mat2::from_cols(x, y)));
            assert!(least > 0.99 * MIN_TEXELS_PER_PIXEL, "{x} {y}: {least}");
            assert!(most < 1.01 * MAX_TEXELS_PER_PIXEL, "{x} {y}: {most}");
        }
        let nothing = texels_per_pixel(Mat2::ZERO);
        assert!(nothing.is_finite(), "a triangle without area: {nothing}");
    }

    #[test]
    fn each_direction_is_bounded_by_itself() {
        // A texel is half a pixel wide and three pixels high.
        let footprint = texels_per_pixel(Mat2::from_diagonal(Vec2::new(0.5, 3.0)));
        assert!(
            (footprint - Mat2::from_diagonal(Vec2::new(2.0, 1.0))).abs_diff_eq(Mat2::ZERO, 1e-5),
            "{footprint}"
        );
    }
}
