//! Pictures to files.

use shadecast_protocol::picture::I420;

pub use shadecast_desktop::png::write_png;

/// A picture as tight rows of RGB, chroma repeated.
pub fn rgb_of(picture: &I420) -> Vec<u8> {
    let w = picture.extent_texels()[0] as usize;
    let [luma, cb, cr] = picture.planes();
    let texel = |i: usize| {
        let chroma = (i / w / 2) * (w / 2) + i % w / 2;
        let y = f32::from(luma[i]);
        let (b, r) = (f32::from(cb[chroma]) - 128.0, f32::from(cr[chroma]) - 128.0);
        // ITU-R BT.709-6, item 3, solved for red, green and blue.
        [y + 1.5748 * r, y - 0.1873 * b - 0.4681 * r, y + 1.8556 * b]
            .map(|c| c.round().clamp(0.0, 255.0) as u8)
    };
    (0..luma.len()).flat_map(texel).collect()
}
