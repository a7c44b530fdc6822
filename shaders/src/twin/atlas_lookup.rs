//! Twin of `atlas_lookup.glsl`: a colour from the atlas's texels.

use glam::Vec2;
use shadecast_protocol::limits::{BLOCK_INSET_TEXELS, CHROMA_INSET_TEXELS};

/// One plane of an atlas, rows from the top.
pub struct Plane {
    /// Texels in a row.
    pub width: usize,
    /// By texel.
    pub values: Vec<f32>,
}

/// Left, top, right and bottom of a block, texels.
pub type BlockRect = [f32; 4];

impl Plane {
    /// What the texel at a column and a row holds; beyond the plane's edge, what the edge does.
    fn texel(&self, x: f32, y: f32) -> f32 {
        let height = self.values.len() / self.width;
        let (x, y) = (x.clamp(0.0, (self.width - 1) as f32), y.clamp(0.0, (height - 1) as f32));
        self.values[y as usize * self.width + x as usize]
    }

    /// Between the four nearest texels, whose middles are at +0.5.
    pub fn linear(&self, at: Vec2) -> f32 {
        let first = (at - 0.5).floor();
        let f = at - 0.5 - first;
        let row = |y: f32| {
            // A texel without weight is not looked at.
            let next = if f.x > 0.0 { self.texel(first.x + 1.0, y) } else { 0.0 };
            (1.0 - f.x) * self.texel(first.x, y) + f.x * next
        };
        let below = if f.y > 0.0 { row(first.y + 1.0) } else { 0.0 };
        (1.0 - f.y) * row(first.y) + f.y * below
    }

    /// By Catmull and Rom's cubic without the four corners, inside a block.
    pub fn cubic(&self, at: Vec2, block: BlockRect) -> f32 {
        let second = (at - 0.5).floor() + 0.5;
        let f = at - second;
        let w0 = f * (-0.5 + f * (1.0 - 0.5 * f));
        let w1 = 1.0 + f * f * (1.5 * f - 2.5);
        let w2 = f * (0.5 + f * (2.0 - 1.5 * f));
        let w3 = f * f * (0.5 * f - 0.5);
        let inner = w1 + w2;
        let [low, high] = [Vec2::new(block[0], block[1]) + 0.5, Vec2::new(block[2], block[3]) - 0.5];
        let (first, last) = ((second - 1.0).max(low), (second + 2.0).min(high));
        let middle = second + w2 / inner;
        let taps = [
            (middle, inner.x * inner.y),
            (Vec2::new(first.x, middle.y), w0.x * inner.y),
            (Vec2::new(last.x, middle.y), w3.x * inner.y),
            (Vec2::new(middle.x, first.y), inner.x * w0.y),
            (Vec2::new(middle.x, last.y), inner.x * w3.y),
        ];
        let sum: f32 = taps.iter().map(|(place, weight)| self.linear(*place) * weight).sum();
        sum / taps.iter().map(|(_, weight)| weight).sum::<f32>()
    }
}

/// The nearest place that a patch's triangles map to.
pub fn inside_block(at: Vec2, block: BlockRect) -> Vec2 {
    less_inset(at, block, BLOCK_INSET_TEXELS)
}

/// The nearest place where no lookup of chroma leaves the block.
pub fn inside_chroma(at: Vec2, block: BlockRect) -> Vec2 {
    less_inset(at, block, CHROMA_INSET_TEXELS)
}

fn less_inset(at: Vec2, [left, top, right, bottom]: BlockRect, inset: f32) -> Vec2 {
    at.clamp(Vec2::new(left, top) + inset, Vec2::new(right, bottom) - inset)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng, rngs::SmallRng};

    const BLOCK: BlockRect = [8.0, 4.0, 16.0, 8.0];

    fn plane(value: impl Fn(usize, usize) -> f32) -> Plane {
        let (width, height) = (32, 16);
        let texels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        Plane { width, values: texels.map(|(x, y)| value(x, y)).collect() }
    }

    #[test]
    fn a_texels_middle_has_its_value_and_a_slope_stays_one() {
        let slope = plane(|x, y| 3.0 * x as f32 - 2.0 * y as f32);
        let wide = [0.0, 0.0, 32.0, 16.0];
        let mut dice = SmallRng::seed_from_u64(1);
        for _ in 0..500 {
            let at = Vec2::new(dice.random_range(2.0..30.0), dice.random_range(2.0..14.0));
            let expected = 3.0 * (at.x - 0.5) - 2.0 * (at.y - 0.5);
            let off = |found: f32| (found - expected).abs();
            assert!(off(slope.linear(at)) < 1e-3, "{at}");
            // Without its corners the cubic bends a slope by less than a hundredth of a texel.
            assert!(
                off(slope.cubic(at, wide)) < 0.01 * (3.0 + 2.0),
                "{at}: {} for {expected}",
                off(slope.cubic(at, wide))
            );
        }
        let noise = plane(|x, y| (7 * x + 13 * y) as f32 % 17.0);
        let middle = Vec2::new(10.5, 6.5);
        assert!((noise.cubic(middle, wide) - noise.linear(middle)).abs() < 1e-5);
    }

    #[test]
    fn a_cubic_is_sharper_than_a_line() {
        let edge = plane(|x, _| if x < 12 { 0.0 } else { 1.0 });
        let wide = [0.0, 0.0, 32.0, 16.0];
        let at = |x: f32| Vec2::new(x, 6.5);
        assert!(edge.cubic(at(11.75), wide) < edge.linear(at(11.75)));
        assert!(edge.cubic(at(12.25), wide) > edge.linear(at(12.25)));
    }

    /// Whatever a block's neighbours hold, its lookups do not tell: from any place, inside and outside.
    #[test]
    fn no_lookup_reaches_a_neighbours_texels() {
        let inside = |x: usize, y: usize| (8..16).contains(&x) && (4..8).contains(&y);
        let own = |x: usize, y: usize| ((x + y) % 5) as f32 * 0.2;
        let alone = plane(|x, y| if inside(x, y) { own(x, y) } else { 0.0 });
        let beside = plane(|x, y| if inside(x, y) { own(x, y) } else { 1e6 });
        let mut dice = SmallRng::seed_from_u64(2);
        for round in 0..2000 {
            let anywhere = Vec2::new(dice.random_range(-5.0..40.0), dice.random_range(-5.0..20.0));
            let corners = [[9.0, 5.0], [15.0, 5.0], [15.0, 7.0], [9.0, 7.0], [9.5, 5.5]];
            let at = inside_block(corners.get(round).map_or(anywhere, |c| Vec2::from(*c)), BLOCK);
            assert_eq!(alone.linear(at), beside.linear(at), "{at}");
            assert_eq!(alone.cubic(at, BLOCK), beside.cubic(at, BLOCK), "{at}");
        }
    }
}
