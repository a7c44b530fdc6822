//! The seam between the shading atlas and its video stream.
//!
//! What is above (the frame) hands over planes and gets an access unit; it does not know which encoder made it.
//! What is below knows neither frames nor sockets, and has no clock: timestamps come in as arguments, so that the
//! same pictures always give the same bytes. [`openh264`] is the embedded encoder; a hardware one goes beside it.
//!
//! Every picture is an [`I420`], and the stream says what that is (VUI).

use shadecast_protocol::limits::{MAX_ACCESS_UNIT_BYTES, MAX_PICTURE_EXTENT_TEXELS, MIN_PICTURE_SIDE_TEXELS};
use shadecast_protocol::picture::I420;
use thiserror::Error;

pub mod openh264;

/// The coded form of one picture.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AccessUnit {
    /// An H.264 byte stream (Annex B, with start codes); parameter sets come with every refresh.
    pub bytes: Vec<u8>,
    /// Whether a decoder can start here, without anything that came before (IDR).
    pub is_refresh: bool,
}

/// Turns pictures into access units, one for one and in order, without delay.
pub trait Encoder: Send {
    /// Encodes one picture. The first one, and one with `refresh`, depends on no picture before it.
    ///
    /// `timestamp_ns` is the picture's time on any monotonic clock. After an error the next picture is a refresh.
    fn encode(&mut self, picture: &I420, timestamp_ns: i64, refresh: bool)
    -> Result<AccessUnit, EncodeError>;

    /// Changes the quantisation parameter, 0 (finest) to 51 (coarsest), from the next picture on.
    fn set_qp(&mut self, qp: u8) -> Result<(), EncodeError>;
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
    /// The encoder library refused.
    #[error("openh264 failed while {doing} (code {code}); the next picture starts a new stream")]
    Library {
        /// What was being done.
        doing: &'static str,
        /// The library's result.
        code: i32,
    },
}
