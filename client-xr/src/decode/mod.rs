//! The seam between the video stream and the atlas texture.
//!
//! What is above (the bundle) hands in access units in the order they were encoded and gets planes; what is below is
//! [`openh264`] on desktops and the platform's decoder on Android. A decoder never conceals: after a broken or lost
//! unit the picture on display stays, and the decoder refuses everything but a refresh, because a picture that
//! refers to one that is missing would look plausible and be wrong.
//!
//! Whatever bytes come in, a decoder gives a picture of the agreed extent or an error; [`sps`] looks at every sequence header before the decoder does.

use shadecast_protocol::limits::{MAX_ACCESS_UNIT_BYTES, MAX_PICTURE_EXTENT_TEXELS, MIN_PICTURE_SIDE_TEXELS};
use shadecast_protocol::picture::I420;
use thiserror::Error;

#[cfg(feature = "desktop")]
pub mod openh264;
pub mod sps;

/// Turns access units into pictures, one for one and in order, without delay.
pub trait Decoder: Send {
    /// Decodes one access unit (Annex B) into `picture`.
    ///
    /// On an error `picture` is unchanged, and every further unit gives [`DecodeError::NeedsRefresh`] until one with
    /// a refresh decodes without error.
    fn decode(&mut self, access_unit: &[u8], picture: &mut I420) -> Result<(), DecodeError>;

    /// Tells the decoder that a unit was lost on the way: it then waits for a refresh, as after an error.
    fn unit_lost(&mut self);

    /// Whether only a refresh can be decoded now.
    fn needs_refresh(&self) -> bool;
}

/// Why an access unit gave no picture, or a decoder could not be made.
#[derive(Debug, Error)]
pub enum DecodeError {
    /// An extent outside what decoders take.
    #[error(
        "cannot decode pictures of {}x{} texels: width and height must be even, at least {MIN_PICTURE_SIDE_TEXELS} and \
         at most {}x{}; the server must choose another atlas size",
        .0[0], .0[1], MAX_PICTURE_EXTENT_TEXELS[0], MAX_PICTURE_EXTENT_TEXELS[1]
    )]
    Extent([u32; 2]),
    /// The stream says that it has another size than was agreed.
    #[error("the video is {}x{} texels, but {}x{} were agreed on: the server must start a new session when the atlas \
             changes size", .got[0], .got[1], .want[0], .want[1])]
    ExtentMismatch {
        /// The agreed extent, in texels.
        want: [u32; 2],
        /// The stream's extent, in texels.
        got: [u32; 2],
    },
    /// A sequence header that cannot be read, or that asks for something other than 4:2:0 with 8 bits.
    #[error("the video's sequence header is unusable: {0}; a refresh must be requested")]
    SequenceHeader(#[from] sps::SpsError),
    /// The unit is longer than any picture.
    #[error(
        "an access unit of {got} bytes exceeds the limit of {MAX_ACCESS_UNIT_BYTES}; a refresh must be requested"
    )]
    TooLong {
        /// Its length in bytes.
        got: usize,
    },
    /// The unit holds a kind of NAL unit that no atlas stream has.
    #[error("the video holds an unexpected NAL unit of type {nal_type}; a refresh must be requested")]
    UnexpectedUnit {
        /// Its type, 0 to 31.
        nal_type: u8,
    },
    /// The unit is broken.
    #[error("the video is broken (decoder state {state:#x}); a refresh must be requested")]
    Corrupt {
        /// The decoder's own account of it.
        state: i32,
    },
    /// The unit depends on a picture that is missing.
    #[error("waiting for a refresh: this access unit depends on a picture that is missing")]
    NeedsRefresh,
    /// The decoder library refused.
    #[error("openh264 failed while {doing} (code {code})")]
    Library {
        /// What was being done.
        doing: &'static str,
        /// The library's result.
        code: std::ffi::c_long,
    },
}
