//! The seam between the shading atlas and its video stream.
//!
//! What is above (the frame) hands over planes and gets an access unit; it does not know which encoder made it.
//! What is below knows neither frames nor sockets, and has no clock: timestamps come in as arguments, so that the
//! same pictures always give the same bytes. [`openh264`] is the embedded encoder; a hardware one goes beside it.
//!
//! Every picture is I420, full range, BT.709 primaries, transfer and matrix, and the stream says so (VUI).

use shadecast_protocol::limits::{MAX_ACCESS_UNIT_BYTES, MAX_PICTURE_EXTENT_TEXELS, MIN_PICTURE_SIDE_TEXELS};
use thiserror::Error;

pub mod openh264;

/// One picture to encode: tightly packed planes, luma at full and chroma at half resolution in both directions.
#[derive(Clone, Copy, Debug)]
pub struct Planes<'a> {
    /// Width and height of the luma plane in texels; both even.
    pub extent_texels: [u32; 2],
    /// Luma, 0 (black) to 255 (white): `width * height` bytes, rows from the top.
    pub y: &'a [u8],
    /// Blue difference, 128 is grey: `width / 2 * height / 2` bytes.
    pub cb: &'a [u8],
    /// Red difference, 128 is grey: `width / 2 * height / 2` bytes.
    pub cr: &'a [u8],
}

impl Planes<'_> {
    /// Whether every plane holds exactly the texels that the extent promises.
    fn check(&self) -> Result<(), EncodeError> {
        let luma = byte_count(self.extent_texels);
        for (plane, got, want) in
            [("y", self.y.len(), luma), ("cb", self.cb.len(), luma / 4), ("cr", self.cr.len(), luma / 4)]
        {
            if got != want {
                return Err(EncodeError::PlaneSize { plane, got, want, extent_texels: self.extent_texels });
            }
        }
        Ok(())
    }
}

fn byte_count([width, height]: [u32; 2]) -> usize {
    width as usize * height as usize
}

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
    fn encode(
        &mut self,
        picture: &Planes<'_>,
        timestamp_ns: i64,
        refresh: bool,
    ) -> Result<AccessUnit, EncodeError>;

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
    /// A plane whose length does not fit the picture's extent.
    #[error("plane {plane} of a {}x{} picture has {got} bytes instead of {want}: planes are tightly packed I420",
            .extent_texels[0], .extent_texels[1])]
    PlaneSize {
        /// Which plane: y, cb or cr.
        plane: &'static str,
        /// Its length in bytes.
        got: usize,
        /// The length that the extent demands.
        want: usize,
        /// Extent of the picture, in texels.
        extent_texels: [u32; 2],
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
