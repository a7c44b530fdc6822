//! Pictures to video files: Y4M with the planes themselves, and MP4 with the embedded encoder's H.264.
//!
//! A video file appears when it is finished. Before that, and after a failure, there is none.
//!
//! Both hold the atlas's own colour coding, full-range BT.709 4:2:0 with chroma in the middle of its four pixels, and declare
//! it: Y4M by its tags, H.264 by its VUI.

use crate::encode::nal::{PICTURE_PARAMETERS, SEQUENCE_PARAMETERS, units};
use crate::encode::openh264::{EncoderSettings, OpenH264Encoder};
use crate::encode::{EncodeError, Source, encode_one};
use mp4::{AvcConfig, MediaConfig, Mp4Config, Mp4Sample, Mp4Writer, TrackConfig, TrackType};
use shadecast_protocol::picture::I420;
use shadecast_shaders::color;
use shadecast_system::PendingFile;
use std::io::{self, BufWriter, StdoutLock, Write};
use std::path::{Path, PathBuf};

/// Units of time in an MP4 second: whole frames at every usual rate.
const TIMESCALE: u32 = 90_000;

/// Why a video could not be written.
#[derive(Debug, thiserror::Error)]
pub enum VideoError {
    /// 4:2:0 has one chroma sample for two pixels and two rows.
    #[error("a video of {}x{} pixels cannot be written: both sides must be even; choose another --size", .0[0], .0[1])]
    OddExtent([u32; 2]),
    /// The file.
    #[error("writing {}: {reason}", file.display())]
    File {
        /// Which.
        file: PathBuf,
        /// What was wrong; not called source, since who prints the chain of causes would print it twice.
        reason: io::Error,
    },
    /// The container.
    #[error("writing {}: {problem}", file.display())]
    Container {
        /// Which.
        file: PathBuf,
        /// What was wrong.
        problem: String,
    },
    /// The encoder.
    #[error(transparent)]
    Encode(#[from] EncodeError),
}

/// A video being written. [`Video::finish`] completes it; dropped without, a file is not left behind.
pub enum Video {
    /// Y4M to a file or a pipe.
    Y4m(Y4m<Y4mOutput>),
    /// H.264 in MP4.
    Mp4(Box<Mp4>),
}

impl Video {
    /// Whether a path asks for a video: `-` (Y4M to standard output), or a name that ends in `.y4m` or `.mp4`.
    pub fn is_asked_for(path: &Path) -> bool {
        is_standard_output(path) || matches!(extension(path).as_str(), "y4m" | "mp4")
    }

    /// Starts a video of `extent` pixels and `fps` pictures a second. `qp` is the quantiser of MP4, 0 to 51.
    pub fn create(path: &Path, extent: [u32; 2], fps: f64, qp: u8) -> Result<Self, VideoError> {
        if extent.iter().any(|side| side % 2 != 0) {
            return Err(VideoError::OddExtent(extent));
        }
        if extension(path) == "mp4" {
            return Ok(Self::Mp4(Box::new(Mp4::create(path, extent, fps, qp)?)));
        }
        let named = |reason| VideoError::File { file: path.to_owned(), reason };
        let output = match is_standard_output(path) {
            true => Y4mOutput::Pipe(io::stdout().lock()),
            false => Y4mOutput::File(BufWriter::new(PendingFile::create(path).map_err(named)?)),
        };
        Ok(Self::Y4m(Y4m::new(output, extent, fps).map_err(named)?))
    }

    /// Adds a picture: tight RGB rows, sRGB-coded.
    pub fn add(&mut self, rgb8: &[u8]) -> Result<(), VideoError> {
        match self {
            Self::Y4m(y4m) => {
                y4m.add(rgb8).map_err(|reason| VideoError::File { file: "the video".into(), reason })
            }
            Self::Mp4(mp4) => mp4.add(rgb8),
        }
    }

    /// Writes what is left.
    pub fn finish(self) -> Result<(), VideoError> {
        match self {
            Self::Y4m(y4m) => {
                y4m.output.finish().map_err(|reason| VideoError::File { file: "the video".into(), reason })
            }
            Self::Mp4(mp4) => mp4.finish(),
        }
    }
}

/// Where a Y4M goes.
pub enum Y4mOutput {
    /// To whoever reads standard output.
    Pipe(StdoutLock<'static>),
    /// To a file, once it is finished.
    File(BufWriter<PendingFile>),
}

impl Y4mOutput {
    fn finish(self) -> io::Result<()> {
        match self {
            Self::Pipe(mut pipe) => pipe.flush(),
            Self::File(file) => file.into_inner().map_err(io::IntoInnerError::into_error)?.commit(),
        }
    }
}

impl Write for Y4mOutput {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Self::Pipe(pipe) => pipe.write(bytes),
            Self::File(file) => file.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::Pipe(pipe) => pipe.flush(),
            Self::File(file) => file.flush(),
        }
    }
}

fn is_standard_output(path: &Path) -> bool {
    path.as_os_str() == "-"
}

fn extension(path: &Path) -> String {
    path.extension().map_or_else(String::new, |e| e.to_string_lossy().to_lowercase())
}

/// Tight RGB rows as the formats have them.
fn i420_of(rgb8: &[u8], extent: [u32; 2]) -> I420 {
    let rgba8: Vec<u8> = rgb8.chunks_exact(3).flat_map(|p| [p[0], p[1], p[2], 255]).collect();
    color::picture(&rgba8, extent)
}

/// YUV4MPEG2 4:2:0.
pub struct Y4m<W> {
    output: W,
    extent: [u32; 2],
}

impl<W: Write> Y4m<W> {
    /// Writes the header.
    pub(crate) fn new(mut output: W, extent: [u32; 2], fps: f64) -> io::Result<Self> {
        let [width, height] = extent;
        let (number, divisor) = rational(fps);
        // The format has no tag for the matrix; X tags are free to say it.
        writeln!(
            output,
            "YUV4MPEG2 W{width} H{height} F{number}:{divisor} Ip A1:1 C420jpeg XCOLORRANGE=FULL XCOLORMATRIX=BT709"
        )?;
        Ok(Self { output, extent })
    }

    /// Adds a picture: tight RGB rows, sRGB-coded.
    pub(crate) fn add(&mut self, rgb8: &[u8]) -> io::Result<()> {
        self.output.write_all(b"FRAME\n")?;
        self.output.write_all(i420_of(rgb8, self.extent).bytes())
    }
}

/// A rate as a fraction; thousandths for what is not whole.
fn rational(fps: f64) -> (u32, u32) {
    if fps.fract() == 0.0 { (fps as u32, 1) } else { ((fps * 1000.0).round() as u32, 1000) }
}

/// H.264 in MP4. The track begins with the first picture, whose parameter sets it needs.
pub struct Mp4 {
    file: PathBuf,
    writer: Mp4Writer<BufWriter<PendingFile>>,
    encoder: OpenH264Encoder,
    extent: [u32; 2],
    fps: f64,
    pictures: u32,
}

impl Mp4 {
    fn create(path: &Path, extent: [u32; 2], fps: f64, qp: u8) -> Result<Self, VideoError> {
        let rate = fps.round().clamp(1.0, 60.0) as u32;
        let encoder =
            OpenH264Encoder::new(EncoderSettings { qp, fps: rate, ..EncoderSettings::new(extent) })?;
        let output =
            PendingFile::create(path).map_err(|reason| VideoError::File { file: path.to_owned(), reason })?;
        let brand = |name: &[u8; 4]| mp4::FourCC::from(*name);
        let config = Mp4Config {
            major_brand: brand(b"isom"),
            minor_version: 512,
            compatible_brands: vec![brand(b"isom"), brand(b"iso2"), brand(b"avc1"), brand(b"mp41")],
            timescale: 1000,
        };
        let writer =
            Mp4Writer::write_start(BufWriter::new(output), &config).map_err(|e| container(path, &e))?;
        Ok(Self { file: path.to_owned(), writer, encoder, extent, fps, pictures: 0 })
    }

    /// When picture `n` is shown, in units of the track.
    fn at(&self, n: u32) -> u64 {
        (f64::from(n) / self.fps * f64::from(TIMESCALE)).round() as u64
    }

    fn add(&mut self, rgb8: &[u8]) -> Result<(), VideoError> {
        let picture = Source::Planes(i420_of(rgb8, self.extent));
        let time_ns = (f64::from(self.pictures) / self.fps * 1e9) as i64;
        let unit = encode_one(&mut self.encoder, picture, time_ns, self.pictures == 0)?;
        let nals: Vec<&[u8]> = units(&unit.bytes).collect();
        if self.pictures == 0 {
            self.add_track(&nals)?;
        }
        let (start, end) = (self.at(self.pictures), self.at(self.pictures + 1));
        let sample = Mp4Sample {
            start_time: start,
            duration: (end - start) as u32,
            rendering_offset: 0,
            is_sync: unit.is_refresh,
            bytes: length_prefixed(&nals).into(),
        };
        self.writer.write_sample(1, &sample).map_err(|e| container(&self.file, &e))?;
        self.pictures += 1;
        Ok(())
    }

    fn add_track(&mut self, nals: &[&[u8]]) -> Result<(), VideoError> {
        let of_kind = |kind: u8| nals.iter().find(|nal| nal[0] & 31 == kind).map(|nal| nal.to_vec());
        let (Some(seq_param_set), Some(pic_param_set)) =
            (of_kind(SEQUENCE_PARAMETERS), of_kind(PICTURE_PARAMETERS))
        else {
            let problem = "the encoder's first picture has no parameter sets".into();
            return Err(VideoError::Container { file: self.file.clone(), problem });
        };
        let [width, height] = self.extent.map(|side| side as u16);
        let config = TrackConfig {
            track_type: TrackType::Video,
            timescale: TIMESCALE,
            language: "und".into(),
            media_conf: MediaConfig::AvcConfig(AvcConfig { width, height, seq_param_set, pic_param_set }),
        };
        self.writer.add_track(&config).map_err(|e| container(&self.file, &e))
    }

    fn finish(mut self) -> Result<(), VideoError> {
        self.writer.write_end().map_err(|e| container(&self.file, &e))?;
        let named = |reason| VideoError::File { file: self.file.clone(), reason };
        let file = self.writer.into_writer().into_inner().map_err(|error| named(error.into_error()))?;
        file.commit().map_err(named)
    }
}

fn container(file: &Path, error: &mp4::Error) -> VideoError {
    VideoError::Container { file: file.to_owned(), problem: error.to_string() }
}

/// Units as MP4 has them: each after its length, the parameter sets left to the track's description.
fn length_prefixed(nals: &[&[u8]]) -> Vec<u8> {
    let pictures = nals.iter().filter(|nal| !matches!(nal[0] & 31, SEQUENCE_PARAMETERS | PICTURE_PARAMETERS));
    pictures.flat_map(|nal| (nal.len() as u32).to_be_bytes().into_iter().chain(nal.iter().copied())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const EXTENT: [u32; 2] = [64, 32];

    /// A gradient with a step that moves.
    fn rgb(n: u8) -> Vec<u8> {
        let pixel = |i: u32| {
            let (x, y) = (i % EXTENT[0], i / EXTENT[0]);
            [x as u8 * 4, y as u8 * 8, if x > u32::from(n) * 8 { 200 } else { 40 }]
        };
        (0..EXTENT[0] * EXTENT[1]).flat_map(pixel).collect()
    }

    #[test]
    fn y4m_holds_header_frame_marks_and_the_planes_themselves() {
        let mut y4m = Y4m::new(Vec::new(), EXTENT, 29.97).expect("memory");
        for n in 0..2 {
            y4m.add(&rgb(n)).expect("memory");
        }
        let header_end = y4m.output.iter().position(|b| *b == b'\n').expect("a line") + 1;
        let header = std::str::from_utf8(&y4m.output[..header_end]).expect("text");
        assert!(
            header.starts_with("YUV4MPEG2 W64 H32 F29970:1000 Ip A1:1 C420jpeg XCOLORRANGE=FULL"),
            "{header}"
        );
        let frames: Vec<_> = y4m.output[header_end..].chunks_exact(6 + 64 * 32 * 3 / 2).collect();
        assert_eq!(frames.len(), 2);
        for (n, frame) in frames.into_iter().enumerate() {
            assert_eq!(&frame[..6], b"FRAME\n");
            let picture = I420::new(EXTENT, frame[6..].to_vec()).expect("a whole picture");
            let back = crate::encode::picture::rgb_of(&picture);
            // Inside the flat halves of blue, chroma is exact up to its rounding; red and green are slow ramps.
            let worst =
                back.iter().zip(&rgb(n as u8)).map(|(a, b)| a.abs_diff(*b)).filter(|d| *d > 12).count();
            assert!(worst * 20 < back.len(), "frame {n}: {worst} values are off");
        }
    }

    #[test]
    fn a_video_is_there_once_it_is_finished_and_not_before() {
        let folder = tempfile::tempdir().expect("a folder");
        let names = || -> Vec<_> {
            let items = std::fs::read_dir(folder.path()).expect("a folder");
            items
                .map(|item| item.expect("an item").file_name())
                .filter(|n| !n.as_encoded_bytes().starts_with(b"."))
                .collect()
        };
        for name in ["a.mp4", "a.y4m"] {
            let path = folder.path().join(name);
            let begin = || {
                let mut video = Video::create(&path, EXTENT, 30.0, 30).expect("begun");
                video.add(&rgb(0)).expect("added");
                video
            };
            drop(begin());
            assert_eq!(std::fs::read_dir(folder.path()).expect("a folder").count(), 0, "{name} is given up");
            let video = begin();
            assert!(names().is_empty(), "{name} is not there yet");
            video.finish().expect("finished");
            assert!(std::fs::metadata(&path).expect("there").len() > 100, "{name}");
            std::fs::remove_file(&path).expect("removed");
        }
    }

    #[test]
    fn names_choose_the_format_and_odd_sizes_are_refused() {
        for (name, video) in
            [("-", true), ("a.y4m", true), ("b/c.MP4", true), ("folder", false), ("x.png", false)]
        {
            assert_eq!(Video::is_asked_for(Path::new(name)), video, "{name}");
        }
        let odd = Video::create(Path::new("x.y4m"), [63, 32], 30.0, 20).err().expect("odd");
        assert!(odd.to_string().contains("63x32") && odd.to_string().contains("even"), "{odd}");
    }

    #[test]
    fn start_codes_of_both_lengths_part_units() {
        let stream = [0, 0, 0, 1, 0x67, 9, 0, 0, 1, 0x68, 8, 0, 0, 0, 1, 0x65, 0, 7];
        let nals: Vec<&[u8]> = units(&stream).collect();
        assert_eq!(nals, [&[0x67u8, 9][..], &[0x68, 8], &[0x65, 0, 7]]);
        assert_eq!(length_prefixed(&nals), [0, 0, 0, 3, 0x65, 0, 7]);
        assert!(units(&[0, 0]).next().is_none());
    }
}
