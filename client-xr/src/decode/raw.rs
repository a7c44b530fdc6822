//! No coding: an access unit is the picture's bytes and needs no other unit.

use super::{DecodeError, Decoder, Picture, Spare};
use std::collections::VecDeque;
use std::time::Duration;

/// A [`Decoder`] that copies. A unit of another length than the agreed extent's is an error, which hurts no other unit.
pub struct RawDecoder {
    extent_texels: [u32; 2],
    done: VecDeque<Result<Picture, DecodeError>>,
    spare: Spare,
}

impl RawDecoder {
    /// Makes a decoder for a stream of the agreed extent.
    pub fn new(extent_texels: [u32; 2]) -> Self {
        Self { extent_texels, done: VecDeque::new(), spare: Spare::default() }
    }
}

impl Decoder for RawDecoder {
    fn submit(&mut self, access_unit: &[u8]) {
        let mut picture = self.spare.take();
        let filled = picture.refill(self.extent_texels, |bytes| bytes.extend_from_slice(access_unit));
        self.done.push_back(filled.map(|()| Picture::Planes(picture)).map_err(DecodeError::from));
    }

    fn poll(&mut self, _: Duration) -> Option<Result<Picture, DecodeError>> {
        self.done.pop_front()
    }

    fn recycle(&mut self, picture: Picture) {
        let Picture::Planes(picture) = picture else { return };
        self.spare.give(picture);
    }

    fn unit_lost(&mut self) {}

    fn needs_refresh(&self) -> bool {
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_protocol::picture::I420;

    #[test]
    fn bytes_of_the_agreed_extent_are_a_picture_and_others_an_error() {
        let mut decoder = RawDecoder::new([4, 2]);
        for length in (0..40).chain([12]) {
            decoder.submit(&vec![7; length]);
            let result = decoder.poll(Duration::ZERO).expect("done");
            match result {
                Ok(picture) => {
                    let want = I420::new([4, 2], vec![7; 12]).expect("a picture");
                    assert_eq!((length, &picture), (12, &Picture::Planes(want)));
                    decoder.recycle(picture);
                }
                Err(error) => assert!(length != 12, "{error}"),
            }
            assert!(!decoder.needs_refresh() && decoder.poll(Duration::ZERO).is_none());
        }
    }
}
