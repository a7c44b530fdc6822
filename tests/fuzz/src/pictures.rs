//! Pictures in any order, lost, and given up: what is decoded comes in order, and nothing is decoded that needs a picture
//! that is missing.

use crate::script::{number, steps};
use shadecast_client::decode::decoding::{DecodeTiming, Decoding};
use shadecast_client::decode::{DecodeError, Decoder, Picture};
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::picture::I420;
use shadecast_protocol::time::ClientTime;
use shadecast_protocol::wire::{StreamMessage, parse_stream};
use std::collections::VecDeque;
use std::time::Duration;

/// A picture's stream.
pub const PICTURE: u8 = 0;
/// A picture that the server gave up: its frame, or nothing where that is not known.
pub const GIVEN_UP: u8 = 1;
/// Time passes: microseconds, at most a second.
pub const WAIT: u8 = 2;

/// From one operation to the next, nanoseconds.
const STEP_NS: i64 = 1_000_000;
/// What decoding takes, nanoseconds.
const DELAY_NS: i64 = 3_000_000;

/// Decodes nothing, and insists on the contract of decoders. The last byte of a unit says whether it is a refresh.
#[derive(Default)]
struct Toy {
    has_reference: bool,
    done: VecDeque<Result<Picture, DecodeError>>,
}

impl Toy {
    fn decode(&mut self, access_unit: &[u8]) -> Result<Picture, DecodeError> {
        match access_unit.last() {
            Some(kind) if kind % 4 == 3 => {
                self.has_reference = false;
                return Err(DecodeError::Corrupt { state: 1 });
            }
            Some(kind) if kind % 4 == 1 => self.has_reference = true,
            _ if !self.has_reference => return Err(DecodeError::NeedsRefresh),
            _ => {}
        }
        Ok(Picture::Planes(I420::default()))
    }
}

impl Decoder for Toy {
    fn submit(&mut self, access_unit: &[u8]) {
        let result = self.decode(access_unit);
        self.done.push_back(result);
    }

    fn poll(&mut self, _: Duration) -> Option<Result<Picture, DecodeError>> {
        self.done.pop_front()
    }

    fn recycle(&mut self, _: Picture) {}

    fn unit_lost(&mut self) {
        self.has_reference = false;
    }

    fn needs_refresh(&self) -> bool {
        !self.has_reference
    }
}

/// The number of pictures that were decoded.
pub fn check(script: &[u8]) -> usize {
    let mut decoding = Decoding::new(Box::<Toy>::default(), DecodeTiming::Virtual { delay_ns: DELAY_NS });
    let mut now = ClientTime(0);
    let mut frames: Vec<UpdateId> = Vec::new();
    for step in steps(script) {
        now = now.plus_ns(STEP_NS);
        match step.operation {
            PICTURE => {
                if let Ok(StreamMessage::Picture { header, access_unit }) = parse_stream(step.bytes) {
                    // As it says itself: the toy has no other way to know.
                    let unit = [access_unit, &[u8::from(header.is_refresh)]].concat();
                    decoding.add(header, unit, now);
                }
            }
            GIVEN_UP => {
                let frame = (!step.bytes.is_empty()).then(|| UpdateId(number(step.bytes) as u32));
                decoding.given_up(frame);
            }
            _ => now = now.plus_ns((number(step.bytes) % 1_000_000) as i64 * 1000),
        }
        let mut unused = Vec::new();
        decoding.advance(now, |decoded| {
            frames.push(decoded.update);
            unused.push(decoded.picture);
        });
        unused.into_iter().for_each(|picture| decoding.recycle(picture));
        decoding.refresh_request(now);
        decoding.take_lost();
    }
    assert!(frames.is_sorted_by(|a, b| a < b), "pictures came out of order: {frames:?}");
    frames.len()
}
