//! Pictures as files in memory.

/// The bytes of a PNG file: `side` rows of as many texels, 8 bits a channel, RGB or RGBA by their number.
///
/// # Panics
/// The bytes are neither.
pub fn png(texels: &[u8], side: u32) -> Vec<u8> {
    let channels = texels.len() / (side as usize * side as usize);
    let color = if channels == 4 { png::ColorType::Rgba } else { png::ColorType::Rgb };
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, side, side);
    encoder.set_color(color);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    let written = encoder.write_header().and_then(|mut writer| writer.write_image_data(texels));
    written.expect("as many texels as the header says");
    bytes
}
