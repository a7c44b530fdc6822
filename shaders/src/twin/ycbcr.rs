//! Twin of `ycbcr.comp`: the planes of an atlas, with chroma from the texels of the same block only.

use crate::color::{byte, ycbcr};
use crate::constants::{CHROMA_REACH, CHROMA_TAPS};
use shadecast_protocol::limits::SUPERBLOCK_MIN_LOG2;
use shadecast_protocol::picture::I420;

const REACH: usize = CHROMA_REACH as usize;

/// The picture of `rgba8` (tight rows, sides even), with the extent of the blocks in each cell: width | height << 16.
pub fn picture(rgba8: &[u8], [width, height]: [u32; 2], cell_extents: &[u32]) -> I420 {
    let texels: Vec<[f32; 3]> = rgba8.chunks_exact(4).map(|rgba| ycbcr(&rgba[..3])).collect();
    let luma: Vec<u8> = texels.iter().map(|texel| byte(texel[0])).collect();
    let cells_across = width.div_ceil(1 << SUPERBLOCK_MIN_LOG2);
    let chroma = |component: usize, x: u32, y: u32| {
        let cell = (y >> SUPERBLOCK_MIN_LOG2) * cells_across + (x >> SUPERBLOCK_MIN_LOG2);
        let extent = cell_extents[cell as usize];
        let (across, down) = (taps(x, extent & 0xffff), taps(y, extent >> 16));
        let mut sum = 0.0;
        for (i, j) in (0..REACH).flat_map(|j| (0..REACH).map(move |i| (i, j))) {
            let weight = across[i] * down[j];
            if weight != 0.0 {
                let (x, y) = (x as usize + i + 1 - REACH / 2, y as usize + j + 1 - REACH / 2);
                sum += weight * texels[y * width as usize + x][component];
            }
        }
        byte(sum)
    };
    let samples = || (0..height).step_by(2).flat_map(|y| (0..width).step_by(2).map(move |x| (x, y)));
    let [blue, red] = [1, 2].map(|component| samples().map(|(x, y)| chroma(component, x, y)).collect());
    I420::new([width, height], [luma, blue, red].concat()).expect("sides are even")
}

/// What texels along a side count for the sample whose own two begin at `at`, in blocks of `side` texels.
fn taps(at: u32, side: u32) -> [f32; REACH] {
    let from_first = at % side / 2;
    let from_last = side / 2 - 1 - from_first;
    let row = if side == 4 { 0 } else { 1 + from_first.min(from_last).min(2) as usize };
    let mut taps = CHROMA_TAPS[row];
    if from_first > from_last {
        taps.reverse();
    }
    taps
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng, rngs::SmallRng};

    /// At how many places what is between samples is compared.
    const PLACES_PER_TEXEL: u32 = 8;

    /// Between samples that lie `spacing` texels apart, the first in the middle of its own.
    fn between(samples: &[f32], spacing: f32, place: f32) -> f32 {
        let at = (place / spacing - 0.5).clamp(0.0, samples.len() as f32 - 1.0);
        let first = (at as usize).min(samples.len() - 2);
        let f = at - first as f32;
        samples[first] * (1.0 - f) + samples[first + 1] * f
    }

    fn sharp(texels: &[f32]) -> Vec<f32> {
        let side = texels.len() as u32;
        let sample = |at: u32| -> f32 {
            let taps = taps(at, side).into_iter().enumerate().filter(|(_, tap)| *tap != 0.0);
            taps.map(|(i, tap)| tap * texels[at as usize + i + 1 - REACH / 2]).sum()
        };
        (0..side).step_by(2).map(sample).collect()
    }

    fn mean(texels: &[f32]) -> Vec<f32> {
        texels.chunks(2).map(|two| (two[0] + two[1]) / 2.0).collect()
    }

    /// Sum of the squares of what samples miss of the texels, where lookups go.
    fn missed(texels: &[f32], samples: &[f32]) -> f32 {
        let places = PLACES_PER_TEXEL * (texels.len() as u32 - 2);
        let place = |number: u32| 1.0 + number as f32 / PLACES_PER_TEXEL as f32;
        (0..=places).map(place).map(|at| (between(samples, 2.0, at) - between(texels, 1.0, at)).powi(2)).sum()
    }

    #[test]
    fn an_even_slope_stays_one_up_to_the_borders() {
        for side in (2..=9).map(|log2| 1u32 << log2) {
            let texels: Vec<f32> = (0..side).map(|x| 3.0 + 0.5 * x as f32).collect();
            for (found, expected) in sharp(&texels).into_iter().zip(mean(&texels)) {
                assert!((found - expected).abs() < 1e-3 * expected, "{found} for {expected} of {side}");
            }
        }
    }

    /// Of noise, the hardest to follow; most gain where borders are near.
    #[test]
    fn chroma_comes_nearer_to_the_texels_than_means_do() {
        let mut dice = SmallRng::seed_from_u64(3);
        for (side, most) in [(4, 0.40), (8, 0.75), (16, 0.85), (64, 0.92)] {
            let (mut of_mean, mut of_sharp) = (0.0, 0.0);
            for _ in 0..1000 {
                let texels: Vec<f32> = (0..side).map(|_| dice.random_range(0.0..1.0)).collect();
                of_mean += missed(&texels, &mean(&texels));
                of_sharp += missed(&texels, &sharp(&texels));
            }
            assert!(of_sharp < most * of_mean, "{of_sharp} for {of_mean} of {side}");
        }
    }

    #[test]
    fn a_neighbours_texels_count_nothing() {
        let extent = [64, 64];
        let picture_beside = |other: u8, [width, height]: [u32; 2]| {
            let own = |x: u32, y: u32| x / width == 1 && y / height == 1;
            let texel =
                |x: u32, y: u32| if own(x, y) { [200, (x * 37 + y * 11) as u8, 30, 255] } else { [other; 4] };
            let rgba8: Vec<u8> = (0..64).flat_map(|y| (0..64).flat_map(move |x| texel(x, y))).collect();
            let picture = picture(&rgba8, extent, &[width | height << 16]);
            let [_, blue, red] = picture.planes();
            let inside = (0..32 * 32).filter(|at| own(at % 32 * 2, at / 32 * 2)).map(|at| at as usize);
            inside.map(|at| [blue[at], red[at]]).collect::<Vec<_>>()
        };
        for sides in [[4, 4], [4, 16], [8, 4], [16, 8], [32, 32]] {
            assert!(!picture_beside(0, sides).is_empty());
            assert_eq!(picture_beside(0, sides), picture_beside(255, sides), "{sides:?}");
        }
    }
}
