//! PNG and JPEG to 8-bit RGBA. The first bytes decide the kind; MIME types in files are often wrong.

use crate::limits::MAX_IMAGE_SIDE as MAX_SIDE;
use std::io::Cursor;
use zune_jpeg::zune_core::{bytestream::ZCursor, colorspace::ColorSpace, options::DecoderOptions};

/// A decoded image, rows from the top.
#[derive(Debug, PartialEq)]
pub(crate) struct Pixels {
    pub(crate) extent_texels: [u32; 2],
    /// `4 * width * height` bytes.
    pub(crate) rgba8: Vec<u8>,
}

/// Decodes, or says what is wrong.
pub(crate) fn decode(bytes: &[u8]) -> Result<Pixels, String> {
    if bytes.starts_with(b"\x89PNG") {
        decode_png(bytes).map_err(|error| format!("damaged PNG: {error}"))
    } else if bytes.starts_with(&[0xff, 0xd8]) {
        decode_jpeg(bytes).map_err(|error| format!("damaged JPEG: {error}"))
    } else {
        Err("neither PNG nor JPEG; convert it to one of them".into())
    }
}

fn check_extent(width: u32, height: u32) -> Result<(), String> {
    if width == 0 || height == 0 || width > MAX_SIDE || height > MAX_SIDE {
        return Err(format!("{width} x {height} texels; sides must be from 1 to {MAX_SIDE}"));
    }
    Ok(())
}

fn decode_png(bytes: &[u8]) -> Result<Pixels, String> {
    let limits = png::Limits { bytes: 4 * (MAX_SIDE as usize).pow(2) };
    let mut decoder = png::Decoder::new_with_limits(Cursor::new(bytes), limits);
    // Palette to RGB, fewer than 8 bits to 8, tRNS to alpha, 16 bits to 8.
    decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::STRIP_16);
    let mut reader = decoder.read_info().map_err(|error| error.to_string())?;
    let (width, height) = (reader.info().width, reader.info().height);
    check_extent(width, height)?;
    let mut raw = vec![0; reader.output_buffer_size().ok_or("too large")?];
    let frame = reader.next_frame(&mut raw).map_err(|error| error.to_string())?;
    let samples = raw.get(..frame.buffer_size()).ok_or("size of the picture is not as announced")?;
    let rgba8 = to_rgba(samples, frame.color_type.samples())?;
    if rgba8.len() != 4 * width as usize * height as usize {
        return Err("size of the picture is not as announced".into());
    }
    Ok(Pixels { extent_texels: [width, height], rgba8 })
}

/// Grey, grey and alpha, RGB or RGBA (1 to 4 samples a texel, 8 bits each) to RGBA.
fn to_rgba(samples: &[u8], per_texel: usize) -> Result<Vec<u8>, String> {
    let expand: fn(&[u8]) -> [u8; 4] = match per_texel {
        1 => |s| [s[0], s[0], s[0], 255],
        2 => |s| [s[0], s[0], s[0], s[1]],
        3 => |s| [s[0], s[1], s[2], 255],
        4 => |s| [s[0], s[1], s[2], s[3]],
        other => return Err(format!("{other} samples a texel")),
    };
    Ok(samples.chunks_exact(per_texel).flat_map(expand).collect())
}

fn decode_jpeg(bytes: &[u8]) -> Result<Pixels, String> {
    let options = DecoderOptions::default()
        .set_max_width(MAX_SIDE as usize)
        .set_max_height(MAX_SIDE as usize)
        // Strict: a truncated file is an error, not a picture that is grey from some row on.
        .set_strict_mode(true)
        .jpeg_set_out_colorspace(ColorSpace::RGB);
    let mut decoder = zune_jpeg::JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(|error| error.to_string())?;
    if decoder.input_colorspace() == Some(ColorSpace::Luma) {
        // The decoder does not convert grey to RGB.
        decoder.set_options(options.jpeg_set_out_colorspace(ColorSpace::Luma));
    }
    let (width, height) = decoder.dimensions().ok_or("no dimensions")?;
    let (width, height) = (width as u32, height as u32);
    check_extent(width, height)?;
    let samples = decoder.decode().map_err(|error| error.to_string())?;
    let per_texel = decoder.output_colorspace().ok_or("no colour space")?.num_components();
    let rgba8 = to_rgba(&samples, per_texel)?;
    if rgba8.len() != 4 * width as usize * height as usize {
        return Err("size of the picture is not as announced".into());
    }
    Ok(Pixels { extent_texels: [width, height], rgba8 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use png::{BitDepth, ColorType};
    use rand::{Rng, SeedableRng, rngs::SmallRng};

    fn encode(
        color: ColorType,
        depth: BitDepth,
        extent: [u32; 2],
        data: &[u8],
        palette: Option<(&[u8], &[u8])>,
    ) -> Vec<u8> {
        let mut out = Vec::new();
        let mut encoder = png::Encoder::new(&mut out, extent[0], extent[1]);
        encoder.set_color(color);
        encoder.set_depth(depth);
        if let Some((rgb, alpha)) = palette {
            encoder.set_palette(rgb.to_vec());
            encoder.set_trns(alpha.to_vec());
        }
        let mut writer = encoder.write_header().expect("header");
        writer.write_image_data(data).expect("data");
        writer.finish().expect("end");
        out
    }

    #[test]
    fn every_png_colour_type_becomes_rgba() {
        let cases: [(ColorType, BitDepth, &[u8], [u8; 8]); 8] = [
            (ColorType::Grayscale, BitDepth::Eight, &[7, 200], [7, 7, 7, 255, 200, 200, 200, 255]),
            (ColorType::Grayscale, BitDepth::One, &[0b0100_0000], [0, 0, 0, 255, 255, 255, 255, 255]),
            (ColorType::Grayscale, BitDepth::Four, &[0x0f], [0, 0, 0, 255, 255, 255, 255, 255]),
            (ColorType::Grayscale, BitDepth::Sixteen, &[9, 1, 80, 2], [9, 9, 9, 255, 80, 80, 80, 255]),
            (ColorType::GrayscaleAlpha, BitDepth::Eight, &[1, 2, 3, 4], [1, 1, 1, 2, 3, 3, 3, 4]),
            (ColorType::Rgb, BitDepth::Eight, &[1, 2, 3, 4, 5, 6], [1, 2, 3, 255, 4, 5, 6, 255]),
            (ColorType::Rgba, BitDepth::Eight, &[1, 2, 3, 4, 5, 6, 7, 8], [1, 2, 3, 4, 5, 6, 7, 8]),
            (
                ColorType::Rgb,
                BitDepth::Sixteen,
                &[1, 0, 2, 0, 3, 0, 4, 0, 5, 0, 6, 0],
                [1, 2, 3, 255, 4, 5, 6, 255],
            ),
        ];
        for (color, depth, data, expected) in cases {
            let pixels = decode(&encode(color, depth, [2, 1], data, None)).expect("valid PNG");
            assert_eq!(pixels.rgba8, expected, "{color:?} {depth:?}");
        }
    }

    #[test]
    fn palette_with_transparency_becomes_rgba() {
        let palette: (&[u8], &[u8]) = (&[10, 20, 30, 40, 50, 60], &[255, 128]);
        let png = encode(ColorType::Indexed, BitDepth::Two, [2, 1], &[0b0100_0000], Some(palette));
        assert_eq!(decode(&png).expect("valid PNG").rgba8, [40, 50, 60, 128, 10, 20, 30, 255]);
    }

    #[test]
    fn truncated_png_is_an_error() {
        let mut rows = vec![0u8; 64 * 64 * 3];
        rows.iter_mut().enumerate().for_each(|(i, value)| *value = (i * 7919 % 251) as u8);
        let png = encode(ColorType::Rgb, BitDepth::Eight, [64, 64], &rows, None);
        for length in [3, 8, 20, 40, png.len() / 2, png.len() * 3 / 4] {
            assert!(decode(&png[..length]).is_err(), "{length} of {} bytes", png.len());
        }
    }

    /// A baseline JPEG of 8 x 8 texels of one colour, put together by hand: quantisation by 1, one Huffman code for
    /// "difference of 10 bits" and one for "no further coefficients", each a single 0 bit.
    fn flat_jpeg(components: &[u16]) -> Vec<u8> {
        let mut out = vec![0xff, 0xd8, 0xff, 0xdb, 0, 67, 0];
        out.extend([1; 64]);
        let count = components.len() as u8;
        out.extend([0xff, 0xc0, 0, 8 + 3 * count, 8, 0, 8, 0, 8, count]);
        (1..=count).for_each(|id| out.extend([id, 0x11, 0]));
        for (class, symbol) in [(0x00, 10), (0x10, 0)] {
            out.extend([0xff, 0xc4, 0, 20, class, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, symbol]);
        }
        out.extend([0xff, 0xda, 0, 6 + 2 * count, count]);
        (1..=count).for_each(|id| out.extend([id, 0x00]));
        out.extend([0, 63, 0]);
        // Each block: 0, ten bits of the difference from 128 times 8, 0.
        let bits: String = components.iter().map(|bits| format!("0{bits:010b}0")).collect();
        let padded = format!("{bits:1<width$}", width = bits.len().next_multiple_of(8));
        let byte = |at: usize| u8::from_str_radix(&padded[at..at + 8], 2).expect("bits");
        out.extend((0..padded.len()).step_by(8).map(byte));
        out.extend([0xff, 0xd9]);
        out
    }

    /// 8 * (200 - 128), and 8 * (56 - 128) in the one's complement that JPEG uses for negative numbers.
    const AT_200: u16 = 576;
    const AT_56: u16 = 447;

    #[test]
    fn grey_and_colour_jpegs_become_rgba() {
        let grey = decode(&flat_jpeg(&[AT_200])).expect("valid JPEG");
        assert_eq!(grey.extent_texels, [8, 8]);
        assert_eq!(grey.rgba8, [200, 200, 200, 255].repeat(64));
        // JFIF: r = y + 1.402 (cr - 128), g = y - 0.344 (cb - 128) - 0.714 (cr - 128), b = y + 1.772 (cb - 128).
        let colour = decode(&flat_jpeg(&[AT_200, AT_56, AT_200])).expect("valid JPEG");
        for texel in colour.rgba8.chunks_exact(4) {
            let errors = [255i32, 173, 72, 255].iter().zip(texel).map(|(a, b)| (a - i32::from(*b)).abs());
            assert!(errors.max() <= Some(2), "{texel:?}");
        }
    }

    #[test]
    fn damaged_images_are_errors_or_pictures_of_the_announced_size() {
        let png = encode(ColorType::Rgb, BitDepth::Eight, [5, 4], &[77; 60], None);
        for (name, original) in [("JPEG", flat_jpeg(&[AT_200, AT_56, AT_200])), ("PNG", png)] {
            for seed in 0..4000 {
                let mut rng = SmallRng::seed_from_u64(seed);
                let mut bytes = original.clone();
                for _ in 0..rng.random_range(1..6) {
                    let at = rng.random_range(2..bytes.len());
                    bytes[at] = if rng.random_bool(0.5) {
                        rng.random()
                    } else {
                        bytes[at] ^ 1 << rng.random_range(0..8)
                    };
                }
                if rng.random_bool(0.2) {
                    bytes.truncate(rng.random_range(2..bytes.len()));
                }
                if let Ok(pixels) = decode(&bytes) {
                    let [width, height] = pixels.extent_texels;
                    assert_eq!(
                        pixels.rgba8.len(),
                        4 * width as usize * height as usize,
                        "{name}, seed {seed}"
                    );
                }
            }
        }
    }

    #[test]
    fn other_formats_are_refused_with_advice() {
        assert!(decode(b"RIFF....WEBP").expect_err("WebP").contains("convert"));
    }
}
