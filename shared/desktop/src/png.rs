//! Pictures to PNG files.

use shadecast_system::PendingFile;
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
