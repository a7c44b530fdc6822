//! Twin of `client_settle.comp` and `client_settle_mip.comp`: a block of a picture, and its mip levels, as the store keeps them.

use super::atlas_lookup::{Plane, inside_chroma};
use crate::color::{linear_from_srgb, rgb_from_ycbcr};
use crate::constants::STORE_LEVELS;
use glam::{UVec3, Vec2, Vec3};
use shadecast_protocol::atlas::Block;
use shadecast_protocol::picture::I420;

/// Linear red, green and blue by texel of a level of a block, from 0 to 1, rows from the top. Not rounded as [`packed_light`] does.
pub type LevelTexels = Vec<Vec3>;

/// The levels of a block of `picture` that lies at `to` in the store, the finest first.
pub fn settled(picture: &I420, from: Block, to: Block) -> Vec<LevelTexels> {
    let mut levels = vec![finest(picture, from)];
    let width = from.size.width() as usize;
    for level in 1..=highest_level(to) {
        let next = coarser(&levels[level as usize - 1], width >> (level - 1));
        levels.push(next);
    }
    levels
}

/// The highest mip level that a block of the store has: no larger than the block, and at its address.
pub fn highest_level(block: Block) -> u32 {
    let bits = u32::from(block.address.x | block.address.y) | block.size.width() | block.size.height();
    bits.trailing_zeros().min(STORE_LEVELS - 1)
}

/// Light as the store keeps it: nine bits a channel, five of a common exponent. Components from 0 to 1.
pub fn packed_light(light: Vec3) -> u32 {
    let largest = light.max_element().max(2f32.powi(-16));
    let of_largest = (largest.to_bits() >> 23) - 111;
    let scale = |exponent: u32| (24.0 - exponent as f32).exp2();
    let exponent = of_largest + u32::from((largest * scale(of_largest)).round() == 512.0);
    let [r, g, b] = (light * scale(exponent)).round().as_uvec3().to_array();
    r | g << 9 | b << 18 | exponent << 27
}

/// The inverse: a multiple of the second, which is the step between two values, linear.
pub fn unpacked_light(word: u32) -> (Vec3, f32) {
    let step = ((word >> 27) as f32 - 24.0).exp2();
    (UVec3::new(word & 511, word >> 9 & 511, word >> 18 & 511).as_vec3() * step, step)
}

fn finest(picture: &I420, from: Block) -> LevelTexels {
    let [width, height] = picture.extent_texels().map(|side| side as usize);
    let plane = |plane: &[u8], width| Plane {
        width,
        values: plane.iter().map(|value| f32::from(*value) / 255.0).collect(),
    };
    let [luma, cb, cr] = picture.planes();
    let (luma, cb, cr) = (plane(luma, width), plane(cb, width / 2), plane(cr, width / 2));
    debug_assert_eq!(luma.values.len(), width * height, "a whole picture");
    let rect = from.rect_texels();
    let [left, top, ..] = rect;
    let texel = |at: u32| {
        let (x, y) = (left + at % from.size.width(), top + at / from.size.width());
        let middle = Vec2::new(x as f32, y as f32) + 0.5;
        let of_chroma = inside_chroma(middle, rect.map(|side| side as f32)) * 0.5;
        let ycbcr = [luma.linear(middle), cb.linear(of_chroma), cr.linear(of_chroma)];
        rgb_from_ycbcr(ycbcr).clamp(Vec3::ZERO, Vec3::ONE).map(linear_from_srgb)
    };
    (0..from.size.texels()).map(texel).collect()
}

fn coarser(finer: &[Vec3], width: usize) -> LevelTexels {
    let rows = finer.chunks_exact(2 * width);
    let mean = |two_rows: &[Vec3], x: usize| {
        let [a, b] = [2 * x, 2 * x + width];
        [a, a + 1, b, b + 1].into_iter().map(|at| two_rows[at]).sum::<Vec3>() * 0.25
    };
    rows.flat_map(|two_rows| (0..width / 2).map(move |x| mean(two_rows, x))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::color;
    use shadecast_protocol::atlas::{BlockAddress, BlockSize};

    fn block(page: u8, [x, y]: [u16; 2], [width_log2, height_log2]: [u8; 2]) -> Block {
        let size = BlockSize::new(width_log2, height_log2).expect("a size");
        Block { address: BlockAddress { page, x, y }, size }
    }

    #[test]
    fn an_even_colour_is_that_of_all_levels() {
        let picture = color::picture(&[200, 40, 90, 255].repeat(64 * 64), [64, 64]);
        let levels = settled(&picture, block(0, [8, 16], [4, 5]), block(1, [32, 64], [4, 5]));
        assert_eq!(levels.iter().map(Vec::len).collect::<Vec<_>>(), [512, 128, 32, 8, 2]);
        let expected = Vec3::new(200.0, 40.0, 90.0);
        for texel in levels.concat() {
            let texel = texel.map(color::srgb_from_linear);
            assert!((texel * 255.0 - expected).abs().max_element() < 2.0, "{texel}");
        }
    }

    #[test]
    fn packed_light_is_the_nearest_that_nine_bits_of_the_largest_channel_tell() {
        let channel = (0..=64).map(|step| (f32::from(step as u8) / 64.0).powi(4));
        let channels: Vec<f32> = channel.chain([511.4 / 512.0, 511.6 / 512.0, 1e-7]).collect();
        let all = channels.iter().flat_map(|r| channels.iter().map(move |g| [*r, *g]));
        for (place, [r, g]) in all.enumerate() {
            let light = Vec3::new(r, g, channels[place * 7 % channels.len()]);
            let (unpacked, step) = unpacked_light(packed_light(light));
            assert!((unpacked - light).abs().max_element() <= 0.5 * step, "{light} became {unpacked}");
            assert!(step <= (light.max_element() / 255.5).max(2f32.powi(-24)), "{light}: {step}");
        }
        assert_eq!(
            [0.0, 1.0].map(|grey| unpacked_light(packed_light(Vec3::splat(grey))).0),
            [Vec3::ZERO, Vec3::ONE]
        );
    }

    #[test]
    fn levels_end_with_the_blocks_shorter_side_and_its_address() {
        let highest = |at, size| highest_level(block(1, at, size));
        assert_eq!(highest([0, 0], [9, 9]), 4);
        assert_eq!(highest([0, 0], [9, 2]), 2);
        assert_eq!(highest([4, 0], [9, 9]), 2);
        assert_eq!(highest([16, 8], [5, 5]), 3);
    }

    #[test]
    fn a_neighbours_texels_count_nothing() {
        let beside = |other: [u8; 4]| {
            let own = |x: u32, y: u32| (8..16).contains(&x) && (4..8).contains(&y);
            let texel = |at: u32| if own(at % 32, at / 32) { [(at * 7) as u8, 30, 90, 255] } else { other };
            // The server makes chroma of a block's own texels; here both are even to the sample.
            let picture = color::picture(&(0..32 * 32).flat_map(texel).collect::<Vec<_>>(), [32, 32]);
            settled(&picture, block(0, [8, 4], [3, 2]), block(1, [8, 4], [3, 2]))
        };
        assert_eq!(beside([0, 0, 0, 255]), beside([255, 0, 255, 255]));
    }
}
