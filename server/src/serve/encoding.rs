//! Step 7 of an update: its picture through an encoder, which may have several and give each when it is done.

use crate::encode::{AccessUnit, EncodeError, Encoded, Encoder};
use crate::update::Shaded;
use shadecast_protocol::wire::PictureHeader;
use std::collections::VecDeque;
use std::time::Duration;

/// One viewer's encoder with the updates whose pictures are in it.
pub struct Encoding {
    encoder: Box<dyn Encoder>,
    /// Of the last picture that was submitted.
    qp: Option<u8>,
    /// In the order of submission, without their pictures.
    under_way: VecDeque<Box<Shaded>>,
}

/// An update whose picture is encoded.
pub struct Coded {
    /// The update, with its picture again.
    pub shaded: Box<Shaded>,
    /// What binds the access unit to the update's delta.
    pub header: PictureHeader,
    /// The picture as it is sent.
    pub unit: AccessUnit,
}

impl Encoding {
    /// By an encoder that has no picture.
    pub fn new(encoder: Box<dyn Encoder>) -> Self {
        Self { encoder, qp: None, under_way: VecDeque::new() }
    }

    /// Hands an update's picture to the encoder, to be coded with quantiser `qp`. With `refresh` it will need no other.
    ///
    /// # Errors
    /// The encoder does not take this quantiser; the picture is lost.
    pub fn submit(&mut self, mut shaded: Box<Shaded>, refresh: bool, qp: u8) -> Result<(), EncodeError> {
        if self.qp != Some(qp) {
            self.encoder.set_qp(qp)?;
            self.qp = Some(qp);
        }
        let source = std::mem::take(&mut shaded.picture);
        self.encoder.submit(source, shaded.time.0, refresh);
        self.under_way.push_back(shaded);
        Ok(())
    }

    /// The next update that is done, for which it waits at most for `timeout`.
    pub fn poll(&mut self, timeout: Duration) -> Option<Result<Coded, EncodeError>> {
        let Encoded { source, result } = self.encoder.poll(timeout)?;
        let mut shaded = self.under_way.pop_front().expect("an encoder gives what it was handed");
        shaded.picture = source;
        let coded = |unit: AccessUnit| {
            let header =
                PictureHeader { update: shaded.update, time: shaded.time, is_refresh: unit.is_refresh };
            Coded { shaded, header, unit }
        };
        Some(result.map(coded))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::encode::Source;
    use crate::motion::delta::UpdateDelta;
    use shadecast_protocol::ids::UpdateId;
    use shadecast_protocol::picture::I420;
    use shadecast_protocol::time::ServerTime;
    use std::sync::{Arc, Mutex};

    /// Gives each picture when so many others were polled for in vain; every third fails.
    struct Late {
        polls_left: u32,
        quantisers: Arc<Mutex<Vec<u8>>>,
        sources: VecDeque<(Source, i64)>,
    }

    impl Encoder for Late {
        fn submit(&mut self, source: Source, timestamp_ns: i64, _: bool) {
            self.sources.push_back((source, timestamp_ns));
        }

        fn poll(&mut self, _: Duration) -> Option<Encoded> {
            if self.polls_left > 0 {
                self.polls_left -= 1;
                return None;
            }
            let (source, at) = self.sources.pop_front()?;
            let unit = AccessUnit { bytes: vec![at as u8], is_refresh: at == 0 };
            let result = if at % 3 == 2 { Err(EncodeError::Stalled) } else { Ok(unit) };
            Some(Encoded { source, result })
        }

        fn set_qp(&mut self, qp: u8) -> Result<(), EncodeError> {
            self.quantisers.lock().expect("whole").push(qp);
            Ok(())
        }
    }

    fn shaded(number: u8) -> Box<Shaded> {
        let picture = Source::Planes(I420::new([2, 2], vec![number; 6]).expect("a picture"));
        let (frame, time) = (UpdateId(number.into()), ServerTime(number.into()));
        let delta = UpdateDelta::default();
        let (sharpness, blocks, timings) = Default::default();
        Box::new(Shaded { update: frame, time, sharpness, delta, picture, blocks, timings })
    }

    #[test]
    fn pictures_that_come_late_are_those_of_their_updates() {
        let quantisers = Arc::new(Mutex::new(Vec::new()));
        let late = Late { polls_left: 2, quantisers: quantisers.clone(), sources: VecDeque::new() };
        let mut encoding = Encoding::new(Box::new(late));
        for (number, qp) in [22, 22, 20, 22].into_iter().enumerate() {
            encoding.submit(shaded(number as u8), false, qp).expect("in range");
        }
        assert_eq!(*quantisers.lock().expect("whole"), [22, 20, 22], "where they change");
        assert!((0..2).all(|_| encoding.poll(Duration::ZERO).is_none()));
        for number in 0..4 {
            let result = encoding.poll(Duration::ZERO).expect("done");
            if number == 2 {
                assert!(result.is_err());
                continue;
            }
            let coded = result.expect("coded");
            assert_eq!(coded.header.update, UpdateId(number.into()));
            assert_eq!((coded.unit.bytes, coded.header.is_refresh), (vec![number], number == 0));
            assert_eq!(coded.shaded.picture, shaded(number).picture, "its memory comes back");
        }
        assert!(encoding.poll(Duration::ZERO).is_none());
    }
}
