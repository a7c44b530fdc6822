//! Mip chains by a 2x2 box in linear light, so that minified textures keep their brightness.

use crate::Texture;

/// All levels of a texture from the full size to 1x1, RGBA8 in the texture's own coding.
pub fn chain(texture: &Texture) -> Vec<Vec<u8>> {
    let coding = Coding::new(texture.srgb);
    let mut extent = texture.extent_texels;
    let mut levels = vec![texture.rgba8.clone()];
    while extent != [1, 1] {
        let last = &levels[levels.len() - 1];
        let (next, next_extent) = half(last, extent, &coding);
        levels.push(next);
        extent = next_extent;
    }
    levels
}

fn half(texels: &[u8], [width, height]: [u32; 2], coding: &Coding) -> (Vec<u8>, [u32; 2]) {
    let [w, h] = [(width / 2).max(1), (height / 2).max(1)];
    let mut out = Vec::with_capacity((w * h * 4) as usize);
    for y in 0..h {
        let rows = [2 * y, (2 * y + 1).min(height - 1)]
            .map(|y| &texels[(y * width * 4) as usize..][..(width * 4) as usize]);
        for x in 0..w {
            let columns = [2 * x, (2 * x + 1).min(width - 1)].map(|x| 4 * x as usize);
            for channel in 0..4 {
                let [a, b] = columns.map(|column| rows.map(|row| row[column + channel]));
                let four = [a[0], b[0], a[1], b[1]];
                out.push(if channel == 3 {
                    four.map(u32::from).iter().sum::<u32>().div_ceil(4) as u8
                } else {
                    coding.mean(four)
                });
            }
        }
    }
    (out, [w, h])
}

/// Between codes and light, by tables: textures have millions of texels.
struct Coding {
    light_of_code: [f32; 256],
    /// Light above which the next code is nearer.
    upper: [f32; 256],
    /// A code that is not too large for light from n/1024 on.
    first_code: [u8; 1025],
}

impl Coding {
    fn new(srgb: bool) -> Self {
        let light_of_code = std::array::from_fn(|code| decode(code as f32, srgb));
        let upper = std::array::from_fn(|code| decode(code as f32 + 0.5, srgb));
        let first = |n: usize| upper.partition_point(|upper: &f32| *upper < n as f32 / 1024.0).min(255) as u8;
        let first_code = std::array::from_fn(first);
        Self { light_of_code, upper, first_code }
    }

    /// The code of the mean light of four.
    fn mean(&self, four: [u8; 4]) -> u8 {
        let light = four.iter().map(|code| self.light_of_code[usize::from(*code)]).sum::<f32>() * 0.25;
        let mut code = self.first_code[(light * 1024.0) as usize];
        while code < 255 && self.upper[usize::from(code)] <= light {
            code += 1;
        }
        code
    }
}

/// IEC 61966-2-1, of a code from 0 to 255 and beyond.
fn decode(code: f32, srgb: bool) -> f32 {
    let value = code / 255.0;
    match srgb {
        false => value,
        true if value <= 0.04045 => value / 12.92,
        true => ((value + 0.055) / 1.055).powf(2.4),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Wrap;

    fn checker(srgb: bool) -> Texture {
        let texel = |i: u32| if (i % 4 + i / 4).is_multiple_of(2) { [255; 4] } else { [0, 0, 0, 255] };
        Texture {
            name: "checker".into(),
            extent_texels: [4, 2],
            rgba8: (0..8).flat_map(texel).collect(),
            srgb,
            wrap: [Wrap::Repeat; 2],
        }
    }

    #[test]
    fn the_chain_ends_at_one_texel_and_has_every_level() {
        let sizes: Vec<_> = chain(&checker(false)).iter().map(Vec::len).collect();
        assert_eq!(sizes, [32, 8, 4]);
    }

    #[test]
    fn every_code_is_its_own_mean_and_means_are_the_nearest_codes() {
        for srgb in [false, true] {
            let coding = Coding::new(srgb);
            for a in 0..=255u8 {
                assert_eq!(coding.mean([a; 4]), a);
                let b = a.wrapping_mul(37);
                let light = (decode(f32::from(a), srgb) + decode(f32::from(b), srgb)) * 0.5;
                let off = |code: u8| (decode(f32::from(code), srgb) - light).abs();
                let found = coding.mean([a, b, b, a]);
                let near = [found.saturating_sub(1), found.saturating_add(1)].map(off);
                assert!(near.iter().all(|other| off(found) <= other * 1.2 + 1e-6), "{a} {b} {found}");
            }
        }
    }

    #[test]
    fn a_checker_becomes_half_the_light_not_half_the_code() {
        assert_eq!(chain(&checker(false))[2], [128, 128, 128, 255]);
        assert_eq!(chain(&checker(true))[2], [188, 188, 188, 255]);
    }
}
