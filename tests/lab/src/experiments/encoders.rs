//! `shadecast-lab encoders`: openh264 beside libx264 on the shipped server's atlases of nine dragons in flight, from a walking
//! head. Each picture goes to all encoders in turn, so other load falls on all alike. The client's decoder decodes the output,
//! which is compared with the input.

use super::run::mock_config;
use crate::session::Lab;
use crate::session::heard::What;
use crate::session::options::{Renderer, RunOptions};
use anyhow::{Context, bail};
use serde::{Deserialize, Serialize};
use shadecast_client::client::Step;
use shadecast_client::decode::openh264::OpenH264Decoder;
use shadecast_client::decode::{Decoder, Picture};
use shadecast_mock_runtime::config::ClockKind;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::picture::I420;
use shadecast_protocol::wire::{StreamMessage, parse_stream};
use shadecast_scene::load::SceneSource;
use shadecast_server::encode::libavcodec::{LibavEncoder, X264_PRESETS};
use shadecast_server::encode::openh264::{EncoderSettings, OpenH264Encoder};
use shadecast_server::encode::{Encoder, Source, encode_one};
use std::fmt;
use std::path::Path;
use std::time::{Duration, Instant};

/// Pictures a second, of the run and for the bits a second.
const RATE_HZ: f64 = 30.0;
/// Pixels of an eye's side.
const SIDE_PIXELS: u32 = 1300;
/// Of virtual time.
const SECONDS: f64 = 1.6;
/// Atlases: small, the server's own choice, and its largest. Texels.
const EXTENTS: [[u32; 2]; 3] = [[1024, 1024], [2048, 2048], [4096, 2048]];
/// The quantiser of the table's times, and others, so that encoders can be compared at the same quality.
const QP: u8 = 22;
const QPS: [u8; 4] = [18, QP, 26, 30];

/// What an encoder made of the pictures of one extent at one quantiser.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Coded {
    /// With its preset.
    pub encoder: String,
    /// Quantiser.
    pub qp: u8,
    /// Milliseconds for a picture after the first: on average, and the worst.
    pub mean_ms: f64,
    /// See [`Self::mean_ms`].
    pub worst_ms: f64,
    /// Megabits a second of those pictures.
    pub mbit_per_s: f64,
    /// Peak signal to noise over all three planes, of the mean square error of all pictures, dB.
    pub psnr_db: f64,
    /// The first picture, which depends on no other: milliseconds, and kilobytes.
    pub refresh_ms: f64,
    /// See [`Self::refresh_ms`].
    pub refresh_kb: f64,
}

/// The pictures of one extent.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct OfExtent {
    /// Texels.
    pub extent_texels: [u32; 2],
    /// Pictures.
    pub pictures: usize,
    /// By quantiser, and in it by encoder.
    pub coded: Vec<Coded>,
}

/// What was measured.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EncoderTable {
    /// Pictures a second.
    pub rate_hz: f64,
    /// By size.
    pub extents: Vec<OfExtent>,
}

impl OfExtent {
    fn of<'a>(&'a self, encoder: &'a str) -> impl Iterator<Item = &'a Coded> {
        self.coded.iter().filter(move |coded| coded.encoder == encoder)
    }

    /// Megabits a second that an encoder needs for so many dB: on the line between the nearest quantisers, of its logarithm.
    pub fn mbit_at(&self, encoder: &str, psnr_db: f64) -> Option<f64> {
        let mut known: Vec<(f64, f64)> =
            self.of(encoder).map(|coded| (coded.psnr_db, coded.mbit_per_s.ln())).collect();
        known.sort_by(|a, b| a.0.total_cmp(&b.0));
        let between = known.windows(2).find(|pair| (pair[0].0..=pair[1].0).contains(&psnr_db))?;
        let [(low, from), (high, to)] = [between[0], between[1]];
        Some((from + (to - from) * (psnr_db - low) / (high - low)).exp())
    }
}

impl fmt::Display for EncoderTable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let heads = ["ms", "worst", "Mbit/s", "dB", "Mbit/s*", "refresh ms", "kB"];
        write!(f, "{:<11} {:<20}", "texels", "encoder")?;
        heads.iter().try_for_each(|head| write!(f, " {head:>10}"))?;
        writeln!(f)?;
        for extent in &self.extents {
            let [width, height] = extent.extent_texels;
            let equal_db =
                extent.of("openh264").find(|coded| coded.qp == QP).map_or(0.0, |coded| coded.psnr_db);
            for coded in extent.coded.iter().filter(|coded| coded.qp == QP) {
                let Coded { encoder, mean_ms, worst_ms, mbit_per_s, psnr_db, refresh_ms, refresh_kb, .. } =
                    coded;
                let equal = extent.mbit_at(encoder, equal_db);
                let equal = equal.map_or_else(|| "-".to_owned(), |mbit| format!("{mbit:.1}"));
                writeln!(
                    f,
                    "{:<11} {encoder:<20} {mean_ms:>10.1} {worst_ms:>10.1} {mbit_per_s:>10.1} {psnr_db:>10.2} {equal:>10} \
                     {refresh_ms:>10.1} {refresh_kb:>10.0}",
                    format!("{width}x{height}")
                )?;
            }
        }
        Ok(())
    }
}

/// Measures; files go to `folder`. To be called where [`crate::experiments::run::run`] may be.
///
/// # Errors
/// Anything that keeps a run from going on, an encoder that is not there.
pub fn measure(folder: &Path) -> anyhow::Result<EncoderTable> {
    let mut extents = Vec::new();
    for extent_texels in EXTENTS {
        let pictures = record(extent_texels, folder)?;
        let mut coded = Vec::new();
        for qp in QPS {
            coded.extend(code_all(&pictures, extent_texels, qp)?);
        }
        let pictures = pictures.len();
        println!("{}x{}: {pictures} pictures", extent_texels[0], extent_texels[1]);
        extents.push(OfExtent { extent_texels, pictures, coded });
    }
    Ok(EncoderTable { rate_hz: RATE_HZ, extents })
}

/// The atlases of a run, uncoded.
fn record([width, height]: [u32; 2], folder: &Path) -> anyhow::Result<Vec<I420>> {
    let options = RunOptions {
        renderer: Renderer::Local,
        extent_pixels: [SIDE_PIXELS; 2],
        atlas_extent_texels: AtlasExtent::new(width, height)?,
        rate_hz: RATE_HZ,
        // As many display frames as pictures: what they show is of no use here.
        refresh_hz: RATE_HZ,
        seconds: SECONDS,
        ..RunOptions::new(SceneSource::Dragons(9), folder.join("run"))
    };
    let config = mock_config(&options, ClockKind::Virtual, 0)?;
    // SAFETY: the caller's promise, as for `run`.
    let mut lab = unsafe { Lab::open(&options, &config) }?;
    lab.recording = Some(Vec::new());
    while let Step::Frame(_) = lab.step()? {}
    let mut pictures = Vec::new();
    for heard in lab.recording.take().unwrap_or_default() {
        let What::Stream(bytes) = heard.what else { continue };
        if let Ok(StreamMessage::Picture { header, access_unit }) = parse_stream(&bytes) {
            pictures.push((header.update, I420::new([width, height], access_unit.to_vec())?));
        }
    }
    pictures.sort_by_key(|(update, _)| *update);
    Ok(pictures.into_iter().map(|(_, picture)| picture).collect())
}

/// An encoder with the decoder of what it makes.
struct Pair {
    name: String,
    encoder: Box<dyn Encoder>,
    decoder: OpenH264Decoder,
    took_ms: Vec<f64>,
    bytes: Vec<usize>,
    squares: f64,
}

fn pairs(extent_texels: [u32; 2], qp: u8) -> anyhow::Result<Vec<Pair>> {
    let extent = AtlasExtent::new(extent_texels[0], extent_texels[1])?;
    let settings = EncoderSettings::for_stream(extent, qp, RATE_HZ);
    let mut encoders: Vec<(String, Box<dyn Encoder>)> =
        vec![("openh264".into(), Box::new(OpenH264Encoder::new(settings)?))];
    for (preset, candidate) in X264_PRESETS {
        encoders.push((format!("libx264 {preset}"), Box::new(LibavEncoder::new(candidate, settings)?)));
    }
    let pair = |(name, encoder)| {
        let decoder = OpenH264Decoder::new(extent_texels)?;
        Ok(Pair { name, encoder, decoder, took_ms: Vec::new(), bytes: Vec::new(), squares: 0.0 })
    };
    encoders.into_iter().map(pair).collect()
}

fn code_all(pictures: &[I420], extent_texels: [u32; 2], qp: u8) -> anyhow::Result<Vec<Coded>> {
    let mut pairs = pairs(extent_texels, qp)?;
    for (number, picture) in pictures.iter().enumerate() {
        for pair in &mut pairs {
            pair.code(number, picture)?;
        }
    }
    pairs.iter().map(|pair| pair.coded(qp, pictures)).collect()
}

impl Pair {
    fn code(&mut self, number: usize, picture: &I420) -> anyhow::Result<()> {
        let (source, at_ns) = (Source::Planes(picture.clone()), (number as f64 * 1e9 / RATE_HZ) as i64);
        let began = Instant::now();
        let unit = encode_one(&mut *self.encoder, source, at_ns, number == 0)?;
        self.took_ms.push(began.elapsed().as_secs_f64() * 1e3);
        self.bytes.push(unit.bytes.len());
        self.decoder.submit(&unit.bytes);
        let decoded = self.decoder.poll(Duration::from_secs(5)).context("the decoder answers")??;
        let Picture::Planes(decoded) = decoded else { bail!("the decoder gives planes") };
        let square = |(a, b): (&u8, &u8)| (f64::from(*a) - f64::from(*b)).powi(2);
        self.squares += picture.bytes().iter().zip(decoded.bytes()).map(square).sum::<f64>();
        Ok(())
    }

    fn coded(&self, qp: u8, pictures: &[I420]) -> anyhow::Result<Coded> {
        let (first_ms, later_ms) = self.took_ms.split_first().context("there are pictures")?;
        let (first_bytes, later_bytes) = self.bytes.split_first().context("there are pictures")?;
        let (later, all) = (later_ms.len() as f64, pictures.iter().map(|picture| picture.bytes().len()));
        let mean_square = self.squares / all.sum::<usize>() as f64;
        Ok(Coded {
            encoder: self.name.clone(),
            qp,
            mean_ms: later_ms.iter().sum::<f64>() / later,
            worst_ms: later_ms.iter().copied().fold(0.0, f64::max),
            mbit_per_s: later_bytes.iter().sum::<usize>() as f64 * 8e-6 / later * RATE_HZ,
            psnr_db: 10.0 * (255.0 * 255.0 / mean_square.max(1e-9)).log10(),
            refresh_ms: *first_ms,
            refresh_kb: *first_bytes as f64 * 1e-3,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_at_a_quality_lie_between_neighbouring_quantisers() {
        let at = |qp, psnr_db, mbit_per_s| Coded {
            encoder: "x".into(),
            qp,
            psnr_db,
            mbit_per_s,
            ..Coded::default()
        };
        let extent = OfExtent { coded: vec![at(18, 44.0, 40.0), at(22, 40.0, 10.0)], ..OfExtent::default() };
        let middle = extent.mbit_at("x", 42.0).expect("between them");
        assert!((middle - 20.0).abs() < 1e-9, "{middle}");
        assert_eq!((extent.mbit_at("x", 39.0), extent.mbit_at("y", 42.0)), (None, None));
    }
}
