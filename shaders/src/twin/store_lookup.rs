//! Twin of `store_lookup.glsl`: a colour from a page of the store.

use super::atlas_lookup::{BlockRect, Plane};
use crate::constants::STORED_FILTER_PIXELS;
use glam::Vec2;
use shadecast_protocol::limits::BLOCK_INSET_TEXELS;

/// One channel of a page, linear: its mip levels, the finest first.
pub struct Levels(pub Vec<Plane>);

/// The level that filters for a pixel of now what was shaded for one of `pixel` texels. `across` and `down`: how far its neighbours lie, texels.
pub fn level(across: Vec2, down: Vec2, highest: f32, pixel: Vec2) -> f32 {
    let by_filter = |side: Vec2| (side / (STORED_FILTER_PIXELS * pixel)).length_squared();
    let [by_filter_across, by_filter_down] = [across, down].map(by_filter);
    let longer = if by_filter_across > by_filter_down { across } else { down };
    let lacking = longer.length_squared() * (1.0 - 1.0 / by_filter_across.max(by_filter_down).max(1.0));
    (0.5 * lacking.max(1.0).log2()).min(highest)
}

/// The nearest place from which a lookup in a level has no texel of another block.
pub fn inside_level(at: Vec2, [left, top, right, bottom]: BlockRect, level: f32) -> Vec2 {
    let inset = (0.5 * level.exp2()).max(BLOCK_INSET_TEXELS);
    at.clamp(Vec2::new(left, top) + inset, Vec2::new(right, bottom) - inset)
}

impl Levels {
    /// On a straight line between texels and levels.
    pub fn linear(&self, at: Vec2, block: BlockRect, level: f32) -> f32 {
        let fine = self.texel(inside_level(at, block, level.floor()), level.floor());
        self.mixed(fine, at, block, level)
    }

    /// By Catmull and Rom's cubic in the finest level.
    pub fn cubic(&self, at: Vec2, block: BlockRect, level: f32) -> f32 {
        if level >= 1.0 {
            return self.linear(at, block, level);
        }
        let fine = self.0[0].cubic(inside_level(at, block, 0.0), block).clamp(0.0, 1.0);
        self.mixed(fine, at, block, level)
    }

    fn texel(&self, at: Vec2, level: f32) -> f32 {
        self.0[level as usize].linear(at / level.exp2())
    }

    fn mixed(&self, fine: f32, at: Vec2, block: BlockRect, level: f32) -> f32 {
        let first = level.floor();
        if level == first {
            return fine;
        }
        let coarse = self.texel(inside_level(at, block, first + 1.0), first + 1.0);
        fine + (coarse - fine) * (level - first)
    }
}

#[cfg(test)]
mod tests {
    use super::super::settle::highest_level;
    use super::*;
    use rand::{Rng, SeedableRng, rngs::SmallRng};
    use shadecast_protocol::atlas::{Block, BlockAddress, BlockSize};

    /// A page with a block of its own values, and one value in all levels of all others.
    fn levels(block: Block, other: f32) -> Levels {
        let side = 128usize;
        let plane = |level: usize| {
            let width = side >> level;
            let [left, top, right, bottom] = block.rect_texels().map(|at| at as usize >> level);
            let is_own = |x: usize, y: usize| (left..right).contains(&x) && (top..bottom).contains(&y);
            let value = |at: usize| match is_own(at % width, at / width) {
                true => ((at * 7 + level) % 5) as f32 * 0.2,
                false => other,
            };
            Plane { width, values: (0..width * width).map(value).collect() }
        };
        Levels((0..=highest_level(block) as usize).map(plane).collect())
    }

    /// From any place, inside and outside, at every level, of blocks of all sizes.
    #[test]
    fn no_lookup_reaches_a_neighbours_texels() {
        let mut dice = SmallRng::seed_from_u64(2);
        for (width_log2, height_log2) in (2..6).flat_map(|w| (2..6).map(move |h| (w, h))) {
            let size = BlockSize::new(width_log2, height_log2).expect("a size");
            for (x, y) in [(64, 64), (36, 64), (48, 72)] {
                let block = Block { address: BlockAddress { page: 1, x, y }, size };
                let (alone, beside) = (levels(block, 0.0), levels(block, 1e6));
                let (rect, highest) =
                    (block.rect_texels().map(|side| side as f32), highest_level(block) as f32);
                for _ in 0..200 {
                    let at = Vec2::new(dice.random_range(-5.0..140.0), dice.random_range(-5.0..140.0));
                    let level = [dice.random_range(0.0..=highest), highest][dice.random_range(0..2)];
                    assert_eq!(alone.linear(at, rect, level), beside.linear(at, rect, level), "{block:?}");
                    assert_eq!(alone.cubic(at, rect, level), beside.cubic(at, rect, level), "{block:?}");
                }
            }
        }
    }

    #[test]
    fn the_level_is_that_of_the_longer_side_of_a_pixel() {
        let one = Vec2::ONE;
        // What lacks to it from the filter that is there.
        let lacks = |texels: f32| Vec2::new(0.0, texels.hypot(STORED_FILTER_PIXELS));
        assert_eq!(level(Vec2::new(0.2, 0.1), lacks(1.0), 4.0, one), 0.0);
        assert!((level(Vec2::new(0.5, 0.0), lacks(4.0), 4.0, one) - 2.0).abs() < 1e-5);
        assert_eq!(level(Vec2::new(128.0, 0.0), Vec2::new(0.0, 1.0), 3.0, one), 3.0);
    }

    #[test]
    fn what_is_filtered_for_a_pixel_of_now_has_the_finest_level() {
        for pixel in [[1.0, 1.0], [2.0, 1.2], [4.0, 8.0]].map(Vec2::from) {
            assert_eq!(level(Vec2::new(pixel.x, 0.0), Vec2::new(0.0, pixel.y), 4.0, pixel), 0.0);
            assert_eq!(level(Vec2::new(0.5 * pixel.x, 0.0), Vec2::ZERO, 4.0, pixel), 0.0, "magnified");
        }
        // Filters of 2 pixels' and of 4 texels make one of both.
        let across = Vec2::new(4.0_f32.hypot(2.0 * STORED_FILTER_PIXELS), 0.0);
        let level = level(across, Vec2::new(0.0, 1.0), 4.0, Vec2::new(2.0, 1.0));
        assert!((level - 2.0).abs() < 1e-5, "{level}");
    }

    #[test]
    fn colours_are_continuous_from_level_to_level() {
        let size = BlockSize::new(5, 5).expect("a size");
        let block = Block { address: BlockAddress { page: 1, x: 32, y: 32 }, size };
        let (levels, rect) = (levels(block, 0.5), block.rect_texels().map(|side| side as f32));
        for place in [[33.0, 33.0], [40.3, 61.0], [47.7, 50.1]].map(Vec2::from) {
            for step in 0..4000 {
                let [here, there] = [step, step + 1].map(|step| step as f32 * 0.001);
                let apart = levels.cubic(place, rect, here) - levels.cubic(place, rect, there);
                assert!(apart.abs() < 0.005, "{apart} at {place} from level {here}");
            }
        }
    }
}
