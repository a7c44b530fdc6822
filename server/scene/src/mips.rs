//! Mip chains by a 2x2 box in linear light, so that minified textures keep their brightness.

use crate::Texture;

/// All levels of a texture from the full size to 1x1, RGBA8 in the texture's own coding.
pub fn chain(texture: &Texture) -> Vec<Vec<u8>> {
    let mut extent = texture.extent_texels;
    let mut levels = vec![texture.rgba8.clone()];
    while extent != [1, 1] {
        let last = &levels[levels.len() - 1];
        let (next, next_extent) = half(last, extent, texture.srgb);
        levels.push(next);
        extent = next_extent;
    }
    levels
}

fn half(texels: &[u8], [width, height]: [u32; 2], srgb: bool) -> (Vec<u8>, [u32; 2]) {
    let table: Vec<f32> = (0..=255u8).map(|byte| decode(byte, srgb)).collect();
    let [w, h] = [(width / 2).max(1), (height / 2).max(1)];
    let mut out = Vec::with_capacity((w * h * 4) as usize);
    for y in 0..h {
        for x in 0..w {
            for channel in 0..4usize {
                let at = |dx: u32, dy: u32| {
                    let (x, y) = ((2 * x + dx).min(width - 1), (2 * y + dy).min(height - 1));
                    texels[((y * width + x) * 4) as usize + channel]
                };
                let four = [at(0, 0), at(1, 0), at(0, 1), at(1, 1)];
                out.push(if channel == 3 {
                    (four.map(u32::from).iter().sum::<u32>().div_ceil(4)) as u8
                } else {
                    encode(four.iter().map(|byte| table[*byte as usize]).sum::<f32>() / 4.0, srgb)
                });
            }
        }
    }
    (out, [w, h])
}

/// IEC 61966-2-1.
fn decode(byte: u8, srgb: bool) -> f32 {
    let value = f32::from(byte) / 255.0;
    match srgb {
        false => value,
        true if value <= 0.04045 => value / 12.92,
        true => ((value + 0.055) / 1.055).powf(2.4),
    }
}

fn encode(value: f32, srgb: bool) -> u8 {
    let coded = match srgb {
        false => value,
        true if value <= 0.003_130_8 => value * 12.92,
        true => 1.055 * value.powf(1.0 / 2.4) - 0.055,
    };
    (coded * 255.0).round().clamp(0.0, 255.0) as u8
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
    fn a_checker_becomes_half_the_light_not_half_the_code() {
        assert_eq!(chain(&checker(false))[2], [128, 128, 128, 255]);
        assert_eq!(chain(&checker(true))[2], [188, 188, 188, 255]);
    }
}
