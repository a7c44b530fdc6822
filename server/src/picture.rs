//! Pictures to files.

use shadecast_protocol::picture::I420;
use shadecast_transport::PendingFile;
use std::io::{self, BufWriter};
use std::path::Path;

/// Writes tight RGB rows, sRGB-coded, as a PNG, which is there whole or not at all.
///
/// # Errors
/// The file cannot be written; the error names it.
pub fn write_png(path: &Path, [width, height]: [u32; 2], rgb8: &[u8]) -> io::Result<()> {
    let named =
        |error: io::Error| io::Error::new(error.kind(), format!("writing {}: {error}", path.display()));
    let mut file = PendingFile::create(path).map_err(named)?;
    let mut encoder = png::Encoder::new(BufWriter::new(&mut file), width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    let written = encoder.write_header().and_then(|mut writer| {
        writer.write_image_data(rgb8)?;
        // Not left to the drop, which hides errors.
        writer.finish()
    });
    written.map_err(|error| named(io::Error::other(error)))?;
    file.commit().map_err(named)
}

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
