//! Framing, the one error type of all decoders, and the reader that they share.

use crate::ids::FrameId;
use crate::time::ServerTime;
use thiserror::Error;

/// Bytes that are not what they should be. The message names what was being read and what is wrong with it.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum WireError {
    /// The bytes end too early.
    #[error("{what} is cut off: {needed} more bytes needed, {left} left")]
    Truncated {
        /// What was being read.
        what: &'static str,
        /// Bytes needed.
        needed: usize,
        /// Bytes left.
        left: usize,
    },
    /// More than a limit allows.
    #[error("{what} is {value}, above the limit of {limit}")]
    TooMany {
        /// What was being read.
        what: &'static str,
        /// What the bytes say.
        value: u64,
        /// What is allowed.
        limit: u64,
    },
    /// A value outside its range, or one that contradicts what is known.
    #[error("{what} is not valid: {reason}")]
    Invalid {
        /// What was being read.
        what: &'static str,
        /// What is wrong.
        reason: String,
    },
    /// Bytes after the end.
    #[error("{what} is followed by {left} bytes that do not belong to it")]
    Trailing {
        /// What was being read.
        what: &'static str,
        /// Bytes left over.
        left: usize,
    },
}

/// What identifies a coded picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PictureHeader {
    /// The update; its placements belong to this picture.
    pub frame: FrameId,
    /// The time for which the update was made.
    pub time: ServerTime,
    /// True where the picture needs no earlier one.
    pub is_refresh: bool,
}

/// What one unidirectional stream holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StreamMessage<'a> {
    /// A geometry delta, for [`crate::delta::decode`] in the order of frames.
    Geometry {
        /// The delta's frame.
        frame: FrameId,
        /// The delta's bytes.
        payload: &'a [u8],
    },
    /// A coded picture.
    Picture {
        /// Which one.
        header: PictureHeader,
        /// Its bytes for the decoder.
        access_unit: &'a [u8],
    },
}
