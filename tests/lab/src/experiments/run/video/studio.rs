//! The server's side of a video: renders what two eyes see, and encodes it at the rate.

use super::HEADER_BYTES;
use super::depth::{self, Depth};
use super::rate::Rate;
use super::warp::Decoded;
use crate::image::Rgb8Image;
use crate::measure::compare::Comparer;
use crate::session::Server;
use crate::session::options::RunOptions;
use anyhow::{Context, bail};
use shadecast_client::decode::openh264::OpenH264Decoder;
use shadecast_client::decode::{Decoder, Picture as Arrived};
use shadecast_protocol::limits::SUPERBLOCK_MIN_LOG2;
use shadecast_protocol::picture::I420;
use shadecast_protocol::pose::{Fov, MAX_VIEW_ANGLE, Pose};
use shadecast_protocol::time::WorldTime;
use shadecast_server::encode::choice::Encoders;
use shadecast_server::encode::openh264::EncoderSettings;
use shadecast_server::encode::{AccessUnit, Encoder, Source, encode_one};
use shadecast_server::pacing::quality::QualityOptions;
use shadecast_shaders::twin::ycbcr;
use std::time::Duration;

/// Places a side of a pixel of the pictures that are sent, where the truth has more than one.
const MOST_PLACES: u32 = 2;
/// H.264 has sides of whole macroblocks, pixels.
const MACROBLOCK: u32 = 16;
/// Depth is coded as finely as colours, and no more coarsely than this: what is nearly flat takes few bits.
const COARSEST_DEPTH_QP: u8 = 28;

/// Renders and encodes; decodes too, since nothing that leaves is lost.
pub(super) struct Studio {
    renderer: Comparer,
    eyes: [Coder; 2],
    /// Of depth, where it is sent.
    depths: Option<[Coder; 2]>,
    rate: Rate,
    keeps_qp: bool,
    fov: Fov,
}

impl Studio {
    /// For a run's pictures, widened by its margin.
    ///
    /// # Errors
    /// A size that the encoder does not take, or a rate that is no number.
    pub(super) fn new(options: &RunOptions, server: &Server) -> anyhow::Result<Self> {
        let fov = Fov::symmetric_degrees(options.fov_degrees);
        let wide = fov.widened(options.video_margin_degrees.to_radians(), MAX_VIEW_ANGLE);
        // As many pixels to a tangent as the display has.
        let part = [wide.right.tan() / fov.right.tan(), wide.up.tan() / fov.up.tan()];
        let unit = if options.video_has_depth { depth::PIXELS * MACROBLOCK } else { MACROBLOCK };
        let side = |axis: usize| {
            let pixels = (options.extent_pixels[axis] as f32 * part[axis]).ceil() as u32;
            pixels.next_multiple_of(unit)
        };
        let extent = [side(0), side(1)];
        let quality = options.quality;
        let (mbit_per_s, keeps_qp) = match quality {
            QualityOptions::Bitrate(mbit_per_s) => (mbit_per_s, false),
            QualityOptions::Constant(_) => (1.0, true),
            QualityOptions::Auto => bail!("--renderer video needs --bitrate with a number, or --qp"),
        };
        let coder = |extent_texels: [u32; 2]| {
            let settings = EncoderSettings {
                qp: quality.first_qp(),
                fps: options.rate_hz.round().clamp(1.0, 60.0) as u32,
                threads: 1,
                loop_filter: true,
                extent_texels,
            };
            Coder::new(&server.encoders, settings)
        };
        let depth_extent = extent.map(|side| side / depth::PIXELS);
        let depths = || anyhow::Ok([coder(depth_extent)?, coder(depth_extent)?]);
        let places = options.truth_places.min(MOST_PLACES);
        Ok(Self {
            renderer: Comparer::with_places(&server.gpu, &server.scene, extent, places)?,
            eyes: [coder(extent)?, coder(extent)?],
            depths: options.video_has_depth.then(depths).transpose()?,
            rate: Rate::new(mbit_per_s, options.rate_hz, quality.first_qp()),
            keeps_qp,
            fov: wide,
        })
    }

    /// Of the next picture.
    pub(super) fn qp(&self) -> u8 {
        self.rate.qp()
    }

    /// What two eyes see at a time: as it is decoded, and its coded bytes.
    pub(super) fn picture(
        &mut self,
        world_from_eyes: [Pose; 2],
        time: WorldTime,
        at_ns: i64,
    ) -> anyhow::Result<([Decoded; 2], [Vec<u8>; 2])> {
        let (mut eyes, mut coded, mut is_refresh) = (Vec::new(), Vec::new(), false);
        let qp = self.rate.qp();
        for (eye, world_from_eye) in world_from_eyes.into_iter().enumerate() {
            let (picture, probe) = self.renderer.seen(world_from_eye, self.fov, time)?;
            let (unit, decoded) = self.eyes[eye].code(planes(&picture), qp, at_ns)?;
            is_refresh |= unit.is_refresh;
            let mut bytes = unit.bytes;
            let depth = match &mut self.depths {
                Some(coders) => {
                    let planes = depth::coded(&probe, [picture.width, picture.height])?;
                    let (unit, decoded) = coders[eye].code(planes, qp.min(COARSEST_DEPTH_QP), at_ns)?;
                    bytes.extend(unit.bytes);
                    Some(Depth::new(&decoded))
                }
                None => None,
            };
            eyes.push(Decoded::new(&decoded, depth, world_from_eye, self.fov));
            coded.push(bytes);
        }
        if !self.keeps_qp {
            self.rate.note(coded.iter().map(Vec::len).sum::<usize>() + HEADER_BYTES, is_refresh);
        }
        let eyes = eyes.try_into().ok().context("two eyes")?;
        Ok((eyes, coded.try_into().ok().context("two eyes")?))
    }
}

/// Encodes a stream, and decodes it as the client does.
struct Coder {
    encoder: Box<dyn Encoder>,
    decoder: OpenH264Decoder,
}

impl Coder {
    fn new(encoders: &Encoders, settings: EncoderSettings) -> anyhow::Result<Self> {
        let [width, height] = settings.extent_texels;
        let problem = || format!("a video of {width}x{height} pixels an eye");
        Ok(Self {
            encoder: encoders.encoder(settings).with_context(problem)?,
            decoder: OpenH264Decoder::new(settings.extent_texels).with_context(problem)?,
        })
    }

    fn code(&mut self, planes: I420, qp: u8, at_ns: i64) -> anyhow::Result<(AccessUnit, I420)> {
        self.encoder.set_qp(qp)?;
        let unit = encode_one(self.encoder.as_mut(), Source::Planes(planes), at_ns, false)?;
        self.decoder.submit(&unit.bytes);
        let decoded = self.decoder.poll(Duration::ZERO).context("the decoder answers at once")??;
        let Arrived::Planes(decoded) = decoded else { bail!("the decoder gives planes") };
        Ok((unit, decoded))
    }
}

/// With hues as the atlas has them: its chroma is what lines between its samples need. The picture is one block.
fn planes(picture: &Rgb8Image) -> I420 {
    let extent = [picture.width, picture.height];
    let rgba: Vec<u8> = picture.data.chunks_exact(3).flat_map(|rgb| [rgb[0], rgb[1], rgb[2], 255]).collect();
    let cells = extent.map(|side| side.div_ceil(1 << SUPERBLOCK_MIN_LOG2)).iter().product::<u32>();
    ycbcr::picture(&rgba, extent, &vec![extent[0] | extent[1] << 16; cells as usize])
}
