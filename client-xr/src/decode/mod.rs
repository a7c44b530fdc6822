//! Decoding: coded pictures to pictures of the agreed extent.
//!
//! Access units enter in any order. Pictures leave in encoding order, or an error, or the request for a refresh ([`decoding`]).
//! Nothing here knows the network, the atlas and the update on display.
//!
//! The codec is behind the seam [`Decoder`]: [`openh264`] on desktops, the platform's decoder on Android
//! ([`platform_decoder`]), and [`raw`] for uncompressed pictures. A decoder never conceals. After a broken or lost unit the
//! picture on display stays, and the decoder refuses everything but a refresh: a picture that refers to a missing one would
//! look plausible and be wrong.
//!
//! A decoder turns any bytes into a picture of the agreed extent or an error. [`sps`] checks every sequence header before the
//! decoder.

use shadecast_gpu::{GpuError, YcbcrImage};
use shadecast_protocol::limits::{MAX_ACCESS_UNIT_BYTES, MAX_PICTURE_EXTENT_TEXELS, MIN_PICTURE_SIDE_TEXELS};
use shadecast_protocol::picture::{I420, I420Error, I444};
use std::fmt;
use std::sync::Arc;
use std::time::Duration;
use thiserror::Error;

pub mod decoding;
mod inspect;
#[cfg(target_os = "android")]
pub mod media_codec;
#[cfg(feature = "openh264")]
pub mod openh264;
pub mod platform_decoder;
pub mod raw;
pub mod sps;

/// Decoded pictures that a decoder keeps at most to use their memory again.
const MAX_SPARE: usize = 4;

/// A decoded picture.
#[derive(Debug, PartialEq, Eq)]
pub enum Picture {
    /// In the CPU's memory.
    Planes(I420),
    /// The same with full chroma, from a measurement's decoder alone.
    FullChroma(I444),
    /// In the device's memory, where the platform's decoder has written it.
    OnDevice(DevicePicture),
}

/// A picture that the platform's decoder has written, and lends: it is given back when this is dropped.
pub struct DevicePicture {
    /// What it is in. The decoder uses the same image again and again.
    pub image: Arc<YcbcrImage>,
    /// Whether something else than the device has written it, so that the device must take it over first.
    pub is_foreign: bool,
    /// Gives the memory back to the decoder.
    pub lease: Box<dyn Send>,
}

impl fmt::Debug for DevicePicture {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("DevicePicture").field("format", &self.image.sampler.format()).finish_non_exhaustive()
    }
}

impl PartialEq for DevicePicture {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.image, &other.image)
    }
}

impl Eq for DevicePicture {}

/// Turns access units into pictures.
///
/// Each unit that is submitted comes out of [`Decoder::poll`] once, in the order of submission, as a picture or as an error. How
/// long that takes is the decoder's affair: it may even wait for later units. What came out is the caller's, for as long as it
/// likes.
///
/// After an error every unit gives [`DecodeError::NeedsRefresh`], until one that is a refresh decodes without error.
pub trait Decoder: Send {
    /// Hands over the next access unit, which is read before this returns.
    fn submit(&mut self, access_unit: &[u8]);

    /// What became of the next unit, for which it waits at most for `timeout`; `None` where that is not known yet.
    fn poll(&mut self, timeout: Duration) -> Option<Result<Picture, DecodeError>>;

    /// Takes back a picture that came out, to use its memory again. Others that came out before may come back later, or never.
    fn recycle(&mut self, picture: Picture);

    /// The unit after the last one that was submitted is lost: the decoder then waits for a refresh, as after an error.
    fn unit_lost(&mut self);

    /// Whether only a refresh can be submitted now.
    fn needs_refresh(&self) -> bool;
}

/// Memory of pictures that came back.
#[derive(Debug, Default)]
pub(crate) struct Spare(Vec<I420>);

impl Spare {
    /// Memory for a picture.
    pub(crate) fn take(&mut self) -> I420 {
        self.0.pop().unwrap_or_default()
    }

    /// Keeps a picture's memory, unless there is enough.
    pub(crate) fn give(&mut self, picture: I420) {
        if self.0.len() < MAX_SPARE {
            self.0.push(picture);
        }
    }
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
    /// A unit that is no picture as it is.
    #[error("an uncompressed picture is malformed: {0}")]
    NotRaw(#[from] I420Error),
    /// The device cannot read what the platform's decoder writes.
    #[error("a decoded picture cannot be read: {0}")]
    Device(#[from] GpuError),
    /// The platform's decoder has failed.
    #[error("the platform's decoder failed while {doing}: {reason}")]
    Platform {
        /// What was being done.
        doing: &'static str,
        /// Its answer.
        reason: String,
    },
    /// The decoder library refused.
    #[error("openh264 failed while {doing} (code {code})")]
    Library {
        /// What was being done.
        doing: &'static str,
        /// The library's result.
        code: std::ffi::c_long,
    },
}

impl DecodeError {
    /// Whether it is the decoder that cannot, and not the video that is broken or lacks what it refers to.
    pub(crate) fn is_the_decoders(&self) -> bool {
        matches!(self, Self::Device(_) | Self::Platform { .. } | Self::Library { .. })
    }
}
