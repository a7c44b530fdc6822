//! No coding: an access unit is the picture's bytes and needs no other unit.
//!
//! It serves links of any rate, and pictures without a codec's losses. A server offers it only on request.

use super::{AccessUnit, EncodeError, Encoded, Encoder, Source};
use std::collections::VecDeque;
use std::time::Duration;

/// An [`Encoder`] that copies.
pub(crate) struct RawEncoder {
    extent_texels: [u32; 2],
    done: VecDeque<Encoded>,
}

impl RawEncoder {
    /// Makes an encoder for pictures of one extent.
    pub(crate) fn new(extent_texels: [u32; 2]) -> Self {
        Self { extent_texels, done: VecDeque::new() }
    }
}

impl Encoder for RawEncoder {
    fn submit(&mut self, source: Source, _: i64, _: bool) {
        let Source::Planes(picture) = &source;
        let (want, got) = (self.extent_texels, picture.extent_texels());
        let result = match got == want {
            true => Ok(AccessUnit { bytes: picture.bytes().to_vec(), is_refresh: true }),
            false => Err(EncodeError::ExtentChanged { want, got }),
        };
        self.done.push_back(Encoded { source, result });
    }

    fn poll(&mut self, _: Duration) -> Option<Encoded> {
        self.done.pop_front()
    }

    fn set_qp(&mut self, _: u8) -> Result<(), EncodeError> {
        Ok(())
    }
}
