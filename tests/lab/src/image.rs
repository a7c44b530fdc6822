//! Pictures as metrics and reports see them: sRGB bytes, no alpha, and PNG files in and out.

use shadecast_system::PendingFile;
use std::fs::File;
use std::io::{BufReader, BufWriter, Write};
use std::path::{Path, PathBuf};

use thiserror::Error;

/// The largest width and height that a picture may have, in pixels.
pub const MAX_EXTENT_PIXELS: u32 = 16_384;

/// A picture of sRGB bytes: red, green, blue, row by row from the top left.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rgb8Image {
    /// Pixels in a row, at least 1.
    pub width: u32,
    /// Rows, at least 1.
    pub height: u32,
    /// Three bytes for every pixel, tightly packed.
    pub data: Vec<u8>,
}

/// Why a picture could not be made, read or written.
#[derive(Debug, Error)]
pub enum ImageError {
    /// The extent is empty or beyond what is sensible.
    #[error("a picture of {width}x{height} pixels is not possible: both must be 1 to {MAX_EXTENT_PIXELS}")]
    Extent {
        /// Pixels in a row.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// The data does not fit the extent.
    #[error("a picture of {width}x{height} pixels needs {want} bytes, but got {got}")]
    Length {
        /// Pixels in a row.
        width: u32,
        /// Rows.
        height: u32,
        /// Bytes that the extent demands.
        want: usize,
        /// Bytes that were given.
        got: usize,
    },
    /// The file could not be opened or created.
    #[error("cannot open {path}: {reason}")]
    Open {
        /// The file.
        path: PathBuf,
        /// What the system says.
        reason: std::io::Error,
    },
    /// The file is no usable PNG.
    #[error("cannot read {path} as a PNG: {reason}")]
    Decode {
        /// The file.
        path: PathBuf,
        /// What the PNG reader says.
        reason: png::DecodingError,
    },
    /// The file could not be written.
    #[error("cannot write {path} as a PNG: {reason}")]
    Encode {
        /// The file.
        path: PathBuf,
        /// What the PNG writer says.
        reason: png::EncodingError,
    },
}

impl Rgb8Image {
    /// A picture of these bytes: three for every pixel.
    pub fn new(width: u32, height: u32, data: Vec<u8>) -> Result<Self, ImageError> {
        let want = byte_count(width, height)?;
        if data.len() != want {
            return Err(ImageError::Length { width, height, want, got: data.len() });
        }
        Ok(Self { width, height, data })
    }

    /// A picture of one colour.
    pub fn filled(width: u32, height: u32, rgb: [u8; 3]) -> Result<Self, ImageError> {
        Ok(Self { width, height, data: rgb.repeat(byte_count(width, height)? / 3) })
    }

    /// A picture whose pixels are a function of their column and row.
    pub fn from_fn(
        width: u32,
        height: u32,
        mut rgb: impl FnMut(u32, u32) -> [u8; 3],
    ) -> Result<Self, ImageError> {
        byte_count(width, height)?;
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        Ok(Self { width, height, data: pixels.flat_map(|(x, y)| rgb(x, y)).collect() })
    }

    /// A picture of four bytes for every pixel, without its last channel.
    pub fn from_rgba(width: u32, height: u32, rgba: &[u8]) -> Result<Self, ImageError> {
        let want = byte_count(width, height)? / 3 * 4;
        if rgba.len() != want {
            return Err(ImageError::Length { width, height, want, got: rgba.len() });
        }
        let data = rgba.chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
        Ok(Self { width, height, data })
    }

    /// How many pixels there are.
    pub fn pixel_count(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// The colour of the pixel in column `x` and row `y`, both inside the picture.
    pub fn pixel(&self, x: u32, y: u32) -> [u8; 3] {
        let at = self.offset(x, y);
        [self.data[at], self.data[at + 1], self.data[at + 2]]
    }

    /// Changes the pixel in column `x` and row `y`, both inside the picture.
    pub fn set_pixel(&mut self, x: u32, y: u32, rgb: [u8; 3]) {
        let at = self.offset(x, y);
        self.data[at..at + 3].copy_from_slice(&rgb);
    }

    fn offset(&self, x: u32, y: u32) -> usize {
        assert!(x < self.width && y < self.height, "({x}, {y}) in {}x{}", self.width, self.height);
        (y as usize * self.width as usize + x as usize) * 3
    }

    /// Reads a PNG of any kind: grey and palettes become colour, 16 bits become 8, alpha is dropped.
    pub fn read_png(path: &Path) -> Result<Self, ImageError> {
        let file = File::open(path).map_err(|reason| ImageError::Open { path: path.into(), reason })?;
        let (info, bytes) =
            decode(file).map_err(|reason| ImageError::Decode { path: path.into(), reason })?;
        let channels = info.color_type.samples();
        let rgb = |pixel: &[u8]| match *pixel {
            [r, g, b, ..] => [r, g, b],
            [grey, ..] => [grey; 3],
            [] => [0; 3],
        };
        let data = bytes[..info.buffer_size()].chunks_exact(channels).flat_map(rgb).collect();
        Self::new(info.width, info.height, data)
    }

    /// Writes the picture as a PNG that says it is sRGB.
    pub fn write_png(&self, path: &Path) -> Result<(), ImageError> {
        let open = |reason| ImageError::Open { path: path.into(), reason };
        let mut file = PendingFile::create(path).map_err(open)?;
        self.encode(BufWriter::new(&mut file), png::Compression::Fast)
            .map_err(|reason| ImageError::Encode { path: path.into(), reason })?;
        file.commit().map_err(open)
    }

    /// The picture as a small PNG in memory.
    ///
    /// # Errors
    /// The extent is none that PNG has.
    pub fn png(&self) -> Result<Vec<u8>, png::EncodingError> {
        let mut bytes = Vec::new();
        self.encode(&mut bytes, png::Compression::High)?;
        Ok(bytes)
    }

    fn encode(&self, out: impl Write, compression: png::Compression) -> Result<(), png::EncodingError> {
        let mut encoder = png::Encoder::new(out, self.width, self.height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
        encoder.set_compression(compression);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&self.data)?;
        writer.finish()
    }
}

fn byte_count(width: u32, height: u32) -> Result<usize, ImageError> {
    let sensible = 1..=MAX_EXTENT_PIXELS;
    if !sensible.contains(&width) || !sensible.contains(&height) {
        return Err(ImageError::Extent { width, height });
    }
    Ok(width as usize * height as usize * 3)
}

fn decode(file: File) -> Result<(png::OutputInfo, Vec<u8>), png::DecodingError> {
    let mut decoder = png::Decoder::new(BufReader::new(file));
    decoder.set_transformations(png::Transformations::normalize_to_color8());
    let mut reader = decoder.read_info()?;
    let size = reader.output_buffer_size().ok_or(png::DecodingError::LimitsExceeded)?;
    let mut bytes = vec![0; size];
    let info = reader.next_frame(&mut bytes)?;
    Ok((info, bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gradient() -> Rgb8Image {
        let pixel = |x: u32, y: u32| [(x * 9) as u8, (y * 13) as u8, (x * y) as u8];
        Rgb8Image::from_fn(23, 17, pixel).expect("a small picture")
    }

    #[test]
    fn what_is_written_is_read_back() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let path = dir.path().join("gradient.png");
        gradient().write_png(&path).expect("it can be written");
        assert_eq!(Rgb8Image::read_png(&path).expect("it can be read"), gradient());
    }

    #[test]
    fn grey_and_alpha_become_colour() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        for (name, color, pixel, want) in [
            ("grey", png::ColorType::Grayscale, &[90][..], [90, 90, 90]),
            ("grey and alpha", png::ColorType::GrayscaleAlpha, &[90, 3], [90, 90, 90]),
            ("colour and alpha", png::ColorType::Rgba, &[1, 2, 3, 4], [1, 2, 3]),
        ] {
            let path = dir.path().join(name);
            let mut encoder = png::Encoder::new(File::create(&path).expect("a file"), 1, 1);
            encoder.set_color(color);
            encoder.write_header().expect("a header").write_image_data(pixel).expect("a pixel");
            let image = Rgb8Image::read_png(&path).expect("it can be read");
            assert_eq!(image.pixel(0, 0), want, "{name}");
        }
    }

    #[test]
    fn errors_name_the_file() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let missing = dir.path().join("missing.png");
        let error = Rgb8Image::read_png(&missing).expect_err("there is none").to_string();
        assert!(error.contains("missing.png") && error.contains("cannot open"), "{error}");
        let broken = dir.path().join("broken.png");
        std::fs::write(&broken, b"no picture at all").expect("it can be written");
        let error = Rgb8Image::read_png(&broken).expect_err("it is none").to_string();
        assert!(error.contains("broken.png") && error.contains("as a PNG"), "{error}");
    }

    #[test]
    fn data_that_does_not_fit_is_refused() {
        assert!(matches!(
            Rgb8Image::new(2, 2, vec![0; 11]),
            Err(ImageError::Length { want: 12, got: 11, .. })
        ));
        assert!(matches!(Rgb8Image::from_rgba(2, 2, &[0; 12]), Err(ImageError::Length { want: 16, .. })));
        for (width, height) in [(0, 1), (1, 0), (MAX_EXTENT_PIXELS + 1, 1)] {
            assert!(matches!(Rgb8Image::filled(width, height, [0; 3]), Err(ImageError::Extent { .. })));
        }
    }
}
