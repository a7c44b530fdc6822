//! Structural similarity (Wang et al. 2004) as a map, for averages over regions.
//!
//! The figures equal those of scikit-image's `structural_similarity(a, b, gaussian_weights=True, sigma=1.5,
//! use_sample_covariance=False, data_range=255, channel_axis=2, full=True)`, whose map this is: an 11x11 Gaussian window,
//! pictures mirrored at their borders.

use crate::image::Rgb8Image;

const SIGMA_PIXELS: f64 = 1.5;
/// scikit-image cuts the window at 3.5 sigma, rounded.
const RADIUS: usize = 5;
const DATA_RANGE: f64 = 255.0;

/// The similarity around every pixel, -1 to 1, averaged over the three channels. The pictures have one extent.
pub fn ssim_map(a: &Rgb8Image, b: &Rgb8Image) -> Vec<f64> {
    assert_eq!((a.width, a.height), (b.width, b.height), "pictures to compare have one extent");
    let mut map = vec![0.0; a.pixel_count()];
    for channel in 0..3 {
        let maps = channel_map(&plane(a, channel), &plane(b, channel), a.width as usize);
        map.iter_mut().zip(maps).for_each(|(sum, similarity)| *sum += similarity / 3.0);
    }
    map
}

fn plane(image: &Rgb8Image, channel: usize) -> Vec<f64> {
    image.data.iter().skip(channel).step_by(3).map(|&byte| f64::from(byte)).collect()
}

fn channel_map(a: &[f64], b: &[f64], width: usize) -> Vec<f64> {
    let c1 = (0.01 * DATA_RANGE).powi(2);
    let c2 = (0.03 * DATA_RANGE).powi(2);
    // Only the sum of the two variances is needed, so the squares share a blur.
    let squares: Vec<f64> = a.iter().zip(b).map(|(a, b)| a * a + b * b).collect();
    let products: Vec<f64> = a.iter().zip(b).map(|(a, b)| a * b).collect();
    let [mean_a, mean_b] = [a, b].map(|plane| blur(plane, width));
    let [squares, products] = [squares, products].map(|plane| blur(&plane, width));
    let similarity = |at: usize| {
        let (mean_product, mean_squares) = (mean_a[at] * mean_b[at], mean_a[at].powi(2) + mean_b[at].powi(2));
        let (covariance, variances) = (products[at] - mean_product, squares[at] - mean_squares);
        (2.0 * mean_product + c1) * (2.0 * covariance + c2) / ((mean_squares + c1) * (variances + c2))
    };
    (0..a.len()).map(similarity).collect()
}

/// A Gaussian blur: rows, then columns.
fn blur(plane: &[f64], width: usize) -> Vec<f64> {
    let height = plane.len() / width;
    let weights = weights();
    let mut rows = vec![0.0; plane.len()];
    let mut padded = vec![0.0; width + 2 * RADIUS];
    for (from, to) in plane.chunks_exact(width).zip(rows.chunks_exact_mut(width)) {
        for (at, sample) in padded.iter_mut().enumerate() {
            *sample = from[mirrored(at, width)];
        }
        for (shift, weight) in weights.iter().enumerate() {
            add_weighted(to, &padded[shift..shift + width], *weight);
        }
    }
    let mut out = vec![0.0; plane.len()];
    for (y, to) in out.chunks_exact_mut(width).enumerate() {
        for (shift, weight) in weights.iter().enumerate() {
            let from = mirrored(y + shift, height) * width;
            add_weighted(to, &rows[from..from + width], *weight);
        }
    }
    out
}

fn add_weighted(to: &mut [f64], from: &[f64], weight: f64) {
    for (sum, sample) in to.iter_mut().zip(from) {
        *sum += weight * sample;
    }
}

/// The sample that stands at position `at` of a line padded by [`RADIUS`] on both sides. Lines are mirrored at their
/// ends, which count twice: `d c b a | a b c d | d c b a`.
fn mirrored(at: usize, length: usize) -> usize {
    let period = (at + 2 * length * RADIUS - RADIUS) % (2 * length);
    period.min(2 * length - 1 - period)
}

fn weights() -> [f64; 2 * RADIUS + 1] {
    let bell: [f64; 2 * RADIUS + 1] = std::array::from_fn(|at| {
        let distance = at as f64 - RADIUS as f64;
        (-0.5 * (distance / SIGMA_PIXELS).powi(2)).exp()
    });
    let sum: f64 = bell.iter().sum();
    bell.map(|weight| weight / sum)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measure::metrics::known;

    #[test]
    fn a_picture_is_wholly_similar_to_itself() {
        let map = ssim_map(&known::truth(), &known::truth());
        assert!(map.iter().all(|similarity| (similarity - 1.0).abs() < 1e-9));
    }

    /// Computed with scikit-image 0.26.0: mean of the full map, and its mean over the channels at two pixels.
    #[test]
    fn the_map_is_the_one_of_scikit_image() {
        let map = ssim_map(&known::truth(), &known::client());
        let mean = map.iter().sum::<f64>() / map.len() as f64;
        assert!((mean - 0.8244088701959728).abs() < 1e-9, "{mean}");
        let corner = (0.84621002 + 0.85684497 + 0.3103996) / 3.0;
        assert!((map[0] - corner).abs() < 1e-7, "{}", map[0]);
        let middle = (0.99360748 + 0.87397915 + 0.56350821) / 3.0;
        let at = 24 * known::WIDTH as usize + 32;
        assert!((map[at] - middle).abs() < 1e-7, "{}", map[at]);
    }

    #[test]
    fn pictures_smaller_than_the_window_are_mirrored_more_than_once() {
        let tiny = Rgb8Image::from_fn(2, 1, |x, _| [200 * x as u8; 3]).expect("a small picture");
        let map = ssim_map(&tiny, &tiny);
        assert!(map.iter().all(|similarity| (similarity - 1.0).abs() < 1e-9), "{map:?}");
        let positions: Vec<_> = (0..12).map(|at| mirrored(at, 2)).collect();
        assert_eq!(positions, [0, 0, 1, 1, 0, 0, 1, 1, 0, 0, 1, 1]);
    }
}
