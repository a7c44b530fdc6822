//! The seam between the shading atlas and its video stream.
//!
//! The caller ([`crate::serve::encoding`]) hands over pictures and gets access units; it does not know the encoder. Encoders
//! know neither updates nor sockets, and have no clock: timestamps are arguments, so the same pictures always give the same
//! bytes. [`openh264`] is the embedded encoder, `raw` codes nothing; hardware encoders stand beside them.
//!
//! Every picture is an [`I420`], and the stream declares its colours (VUI).

use openh264::{EncoderSettings, OpenH264Encoder};
use raw::RawEncoder;
use shadecast_protocol::limits::{MAX_ACCESS_UNIT_BYTES, MAX_PICTURE_EXTENT_TEXELS, MIN_PICTURE_SIDE_TEXELS};
use shadecast_protocol::message::Codec;
use shadecast_protocol::picture::{I420, I420Error};
use std::time::Duration;
use thiserror::Error;

pub mod choice;
#[cfg(feature = "libavcodec")]
pub mod libavcodec;
pub mod macroblocks;
pub(crate) mod nal;
pub mod openh264;
pub mod picture;
pub(crate) mod raw;

/// An encoder that gives nothing for so long is broken.
pub(crate) const PATIENCE: Duration = Duration::from_secs(2);

/// The coded form of one picture.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AccessUnit {
    /// As the codec has it: of H.264 a byte stream (Annex B, with start codes), with parameter sets in every refresh.
    pub bytes: Vec<u8>,
    /// Whether a decoder can start here, without anything that came before (of H.264 an IDR).
    pub is_refresh: bool,
}

/// A picture for an encoder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    /// In the CPU's memory.
    Planes(I420),
}

impl Default for Source {
    /// A picture of no texels.
    fn default() -> Self {
        Self::Planes(I420::default())
    }
}

/// What became of a picture that was submitted.
#[derive(Debug)]
pub struct Encoded {
    /// The picture, whose memory can be used again.
    pub source: Source,
    /// Its coded form, or why there is none.
    pub result: Result<AccessUnit, EncodeError>,
}

/// Turns pictures into access units.
///
/// Each picture that is submitted comes out of [`Encoder::poll`] once, in the order of submission, coded or with the reason why
/// it is not. It comes out by itself, however long that takes: an encoder waits for no later picture. Until then the picture is
/// the encoder's.
///
/// No access unit depends on a picture that failed. The first one that can be decoded after a failure may therefore be a
/// refresh that nobody asked for.
pub trait Encoder: Send {
    /// Hands over a picture. The first one, and one with `refresh`, will depend on no picture before it.
    ///
    /// `timestamp_ns` is the picture's time on any monotonic clock.
    fn submit(&mut self, source: Source, timestamp_ns: i64, refresh: bool);

    /// The next picture that is done, for which it waits at most for `timeout`; `None` where none is.
    fn poll(&mut self, timeout: Duration) -> Option<Encoded>;

    /// Changes the quantisation parameter, 0 (finest) to 51 (coarsest), from the next picture on that is submitted.
    fn set_qp(&mut self, qp: u8) -> Result<(), EncodeError>;
}

/// An encoder of the agreed codec.
///
/// # Errors
/// The settings are outside of their ranges, or the encoder cannot be made.
pub fn encoder(codec: Codec, settings: EncoderSettings) -> Result<Box<dyn Encoder>, EncodeError> {
    Ok(match codec {
        Codec::H264 => Box::new(OpenH264Encoder::new(settings)?),
        Codec::Raw => Box::new(RawEncoder::new(settings.extent_texels)),
    })
}

/// Encodes one picture with an encoder that has no other, and waits for it.
///
/// # Errors
/// The picture's own, or the encoder gives nothing.
pub fn encode_one(
    encoder: &mut dyn Encoder,
    source: Source,
    timestamp_ns: i64,
    refresh: bool,
) -> Result<AccessUnit, EncodeError> {
    encoder.submit(source, timestamp_ns, refresh);
    encoder.poll(PATIENCE).map_or(Err(EncodeError::Stalled), |encoded| encoded.result)
}

/// Why a picture could not be encoded, or an encoder not be made.
#[derive(Debug, Error)]
pub enum EncodeError {
    /// An extent that H.264 or the encoder cannot code.
    #[error(
        "cannot encode pictures of {}x{} texels: width and height must be even, at least {MIN_PICTURE_SIDE_TEXELS} \
         and at most {}x{}; choose another size",
        .0[0], .0[1], MAX_PICTURE_EXTENT_TEXELS[0], MAX_PICTURE_EXTENT_TEXELS[1]
    )]
    Extent([u32; 2]),
    /// A setting outside its range.
    #[error("encoder setting {name} is {value}, but must be in {range}")]
    Setting {
        /// The setting's name.
        name: &'static str,
        /// What it was set to.
        value: u32,
        /// What it may be.
        range: &'static str,
    },
    /// A picture of another extent than the encoder was made for.
    #[error("the encoder was made for {}x{} texels, but got a picture of {}x{}: make a new encoder when the atlas \
             changes size", .want[0], .want[1], .got[0], .got[1])]
    ExtentChanged {
        /// Extent of the encoder, in texels.
        want: [u32; 2],
        /// Extent of the picture, in texels.
        got: [u32; 2],
    },
    /// More bytes than a client takes; level 5.2 of H.264 does not allow so many.
    #[error(
        "the coded picture has {got} bytes, above the limit of {MAX_ACCESS_UNIT_BYTES}; the next picture starts a new stream"
    )]
    TooLong {
        /// Its length in bytes.
        got: usize,
    },
    /// Nothing came out.
    #[error("the encoder returned no picture within {} s", PATIENCE.as_secs())]
    Stalled,
    /// An encoder of libavcodec.
    #[error("{encoder} failed while {doing}: {reason}")]
    Libavcodec {
        /// Which.
        encoder: &'static str,
        /// What was being done.
        doing: &'static str,
        /// The library's words.
        reason: String,
    },
    /// A picture cannot be described.
    #[error("a picture does not have the bytes of its extent: {0}")]
    Picture(#[from] I420Error),
    /// The encoder library refused.
    #[error("openh264 failed while {doing} (code {code}); the next picture starts a new stream")]
    Library {
        /// What was being done.
        doing: &'static str,
        /// The library's result.
        code: i32,
    },
}
