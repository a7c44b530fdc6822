//! Conversion of colours to a picture's planes: full-range BT.709 (ITU-R BT.709-6, item 3), 4:2:0, chroma centre-sited. On the
//! CPU, for pictures that never were on the device.

use glam::Vec3;
use shadecast_protocol::picture::I420;

/// The picture of `rgba8` (tight rows, sides even).
pub fn picture(rgba8: &[u8], [width, height]: [u32; 2]) -> I420 {
    let (w, h) = (width as usize, height as usize);
    let (mut luma, mut blue, mut red) = (Vec::new(), Vec::new(), Vec::new());
    let at = |x: usize, y: usize| ycbcr(&rgba8[(y * w + x) * 4..][..3]);
    for y in 0..h {
        luma.extend((0..w).map(|x| byte(at(x, y)[0])));
    }
    for y in (0..h).step_by(2) {
        for x in (0..w).step_by(2) {
            let four = [at(x, y), at(x + 1, y), at(x, y + 1), at(x + 1, y + 1)];
            let mean = |channel: usize| four.iter().map(|c| c[channel]).sum::<f32>() / 4.0;
            blue.push(byte(mean(1)));
            red.push(byte(mean(2)));
        }
    }
    I420::new([width, height], [luma, blue, red].concat()).expect("sides are even")
}

/// The three planes of `rgba8` with chroma for each texel, one behind the other.
pub fn full_chroma(rgba8: &[u8]) -> Vec<u8> {
    let texels = rgba8.len() / 4;
    let mut planes = vec![0; 3 * texels];
    for (index, rgba) in rgba8.chunks_exact(4).enumerate() {
        for (plane, value) in ycbcr(&rgba[..3]).into_iter().enumerate() {
            planes[plane * texels + index] = byte(value);
        }
    }
    planes
}

pub(crate) fn ycbcr(rgb8: &[u8]) -> [f32; 3] {
    let [r, g, b] = [0, 1, 2].map(|c| f32::from(rgb8[c]) / 255.0);
    let y = 0.2126 * r + 0.7152 * g + 0.0722 * b;
    [y, (b - y) / 1.8556 + 128.0 / 255.0, (r - y) / 1.5748 + 128.0 / 255.0]
}

/// Red, green and blue of full-range BT.709 as planes hold it; all 0..1, red, green and blue also beyond.
pub fn rgb_from_ycbcr([y, cb, cr]: [f32; 3]) -> Vec3 {
    let (blue, red) = (y + 1.8556 * (cb - 128.0 / 255.0), y + 1.5748 * (cr - 128.0 / 255.0));
    Vec3::new(red, (y - 0.2126 * red - 0.0722 * blue) / 0.7152, blue)
}

pub(crate) fn byte(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// Of a channel, 0..1 (IEC 61966-2-1).
pub fn linear_from_srgb(c: f32) -> f32 {
    if c > 0.04045 { ((c + 0.055) / 1.055).powf(2.4) } else { c / 12.92 }
}

/// Its inverse.
pub fn srgb_from_linear(c: f32) -> f32 {
    if c > 0.003_130_8 { 1.055 * c.powf(1.0 / 2.4) - 0.055 } else { 12.92 * c }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn full_chroma_is_that_of_each_texel() {
        let planes = full_chroma(&[255, 0, 0, 255, 0, 0, 255, 255]);
        assert_eq!(planes, [54, 18, 99, 255, 255, 116]);
    }

    #[test]
    fn grey_has_no_chroma_and_primaries_have_their_weights() {
        let solid =
            |rgb: [u8; 3]| picture(&[[rgb[0], rgb[1], rgb[2], 255]; 4].concat(), [2, 2]).bytes().to_vec();
        assert_eq!(solid([77; 3]), [77, 77, 77, 77, 128, 128]);
        assert_eq!(solid([255, 0, 0]), [54, 54, 54, 54, 99, 255]);
        assert_eq!(solid([0, 255, 0]), [182, 182, 182, 182, 30, 12]);
        assert_eq!(solid([0, 0, 255]), [18, 18, 18, 18, 255, 116]);
    }
}
