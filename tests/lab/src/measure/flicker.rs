//! Flicker: how much the error of a picture changes from one display frame to the next. Pure.
//!
//! What is wrong alike in both frames does not flicker; what is wrong in one of them does, and an edge whose error goes with it.

use crate::image::Rgb8Image;

/// Luma of an sRGB pixel (Rec. 709), 0..1.
fn luma(rgb: &[u8]) -> f64 {
    [0.2126, 0.7152, 0.0722].iter().zip(rgb).map(|(weight, code)| weight * f64::from(*code) / 255.0).sum()
}

/// Mean over all pixels of the difference of two consecutive errors of luma, 0..1. Each frame is what a client showed and the truth.
///
/// # Panics
/// The pictures differ in size.
pub fn flicker(before: [&Rgb8Image; 2], now: [&Rgb8Image; 2]) -> f64 {
    let [first, rest @ ..] = [before[0], before[1], now[0], now[1]];
    assert!(rest.iter().all(|picture| [picture.width, picture.height] == [first.width, first.height]));
    let errors = |[client, truth]: [&'_ Rgb8Image; 2]| -> Vec<f64> {
        client.data.chunks_exact(3).zip(truth.data.chunks_exact(3)).map(|(a, b)| luma(a) - luma(b)).collect()
    };
    let (before, now) = (errors(before), errors(now));
    let sum: f64 = before.iter().zip(&now).map(|(before, now)| (now - before).abs()).sum();
    sum / first.pixel_count() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grey(codes: &[u8]) -> Rgb8Image {
        let data = codes.iter().flat_map(|code| [*code; 3]).collect();
        Rgb8Image::new(codes.len() as u32, 1, data).unwrap()
    }

    #[test]
    fn what_is_wrong_alike_in_both_frames_does_not_flicker() {
        let (before, now) = (grey(&[10, 20, 30]), grey(&[50, 60, 70]));
        let (truth_before, truth_now) = (grey(&[0, 20, 35]), grey(&[40, 60, 75]));
        assert!(flicker([&before, &truth_before], [&now, &truth_now]) < 1e-12);
    }

    #[test]
    fn an_error_of_one_frame_counts_by_its_size_and_area() {
        let truth = grey(&[0, 0, 0, 0]);
        let spot = grey(&[51, 0, 0, 0]);
        assert!((flicker([&truth, &truth], [&spot, &truth]) - 0.2 / 4.0).abs() < 1e-12);
        assert!((flicker([&spot, &truth], [&truth, &truth]) - 0.2 / 4.0).abs() < 1e-12);
    }
}
