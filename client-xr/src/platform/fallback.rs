//! A fallback for the system's decoder. Its failure shows late: a codec is set up with the first refresh, and may refuse the
//! pictures' extent only then.

use crate::decode::{DecodeError, Decoder, Picture};
use std::time::Duration;

/// Makes the decoder that takes the place.
pub(super) type Make = Box<dyn FnOnce() -> Result<Box<dyn Decoder>, DecodeError> + Send>;

/// A decoder that may be replaced as long as it has given no picture.
struct Replaceable {
    decoder: Box<dyn Decoder>,
    /// `None` from the first picture on, or where it has taken the place.
    second: Option<Make>,
    /// Units in the decoder.
    units: usize,
    /// Units that were in the one that was replaced, and have not come out: the next one knows nothing of them.
    lost: usize,
}

/// The system's decoder, or `second` in its place: at once where there is none, and at its first failure where it never gave a
/// picture. A broken video is no failure of a decoder.
///
/// # Errors
/// Neither can be had.
pub(super) fn decoder(
    own: Result<Box<dyn Decoder>, DecodeError>,
    second: Make,
) -> Result<Box<dyn Decoder>, DecodeError> {
    match own {
        Ok(decoder) => Ok(Box::new(Replaceable { decoder, second: Some(second), units: 0, lost: 0 })),
        Err(error) => {
            say(&error);
            second()
        }
    }
}

fn say(error: &DecodeError) {
    tracing::warn!("{error}; pictures are decoded on the CPU, which is slower and uses more power");
}

impl Replaceable {
    /// What there is of the next unit may say what the decoder is good for.
    fn judge(&mut self, result: &Result<Picture, DecodeError>) {
        match result {
            Ok(_) => self.second = None,
            Err(error) if error.is_the_decoders() => {
                let Some(make) = self.second.take() else { return };
                say(error);
                match make() {
                    Ok(decoder) => {
                        self.decoder = decoder;
                        self.lost = std::mem::take(&mut self.units);
                    }
                    Err(error) => tracing::warn!("{error}"),
                }
            }
            Err(_) => {}
        }
    }
}

impl Decoder for Replaceable {
    fn submit(&mut self, access_unit: &[u8]) {
        self.units += 1;
        self.decoder.submit(access_unit);
    }

    fn poll(&mut self, timeout: Duration) -> Option<Result<Picture, DecodeError>> {
        if self.lost > 0 {
            self.lost -= 1;
            return Some(Err(DecodeError::NeedsRefresh));
        }
        let result = self.decoder.poll(timeout)?;
        self.units -= 1;
        self.judge(&result);
        Some(result)
    }

    fn recycle(&mut self, picture: Picture) {
        self.decoder.recycle(picture);
    }

    fn unit_lost(&mut self) {
        self.decoder.unit_lost();
    }

    fn needs_refresh(&self) -> bool {
        self.decoder.needs_refresh()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_protocol::picture::I420;
    use std::collections::VecDeque;

    /// What the next units become.
    struct Scripted(VecDeque<Result<(), DecodeError>>);

    impl Decoder for Scripted {
        fn submit(&mut self, _: &[u8]) {}

        fn poll(&mut self, _: Duration) -> Option<Result<Picture, DecodeError>> {
            self.0.pop_front().map(|result| result.map(|()| Picture::Planes(I420::default())))
        }

        fn recycle(&mut self, _: Picture) {}

        fn unit_lost(&mut self) {}

        fn needs_refresh(&self) -> bool {
            false
        }
    }

    fn scripted(script: impl IntoIterator<Item = Result<(), DecodeError>>) -> Box<dyn Decoder> {
        Box::new(Scripted(script.into_iter().collect()))
    }

    fn refused() -> DecodeError {
        DecodeError::Platform { doing: "setting the decoder up", reason: "no such extent".into() }
    }

    /// Whether each of so many units gives a picture, of this decoder with one that always does in reserve.
    fn pictures(own: Result<Box<dyn Decoder>, DecodeError>, units: usize) -> Vec<bool> {
        let second = || Ok(scripted(std::iter::repeat_with(|| Ok(())).take(100)));
        let mut decoder = decoder(own, Box::new(second)).expect("one of them");
        let mut unit = |_| {
            decoder.submit(&[]);
            decoder.poll(Duration::ZERO).expect("a result").is_ok()
        };
        (0..units).map(&mut unit).collect()
    }

    #[test]
    fn without_a_system_decoder_the_fallback_is_made_at_once() {
        assert_eq!(pictures(Err(refused()), 2), [true, true]);
    }

    #[test]
    fn a_decoder_that_refuses_the_first_picture_is_replaced() {
        assert_eq!(pictures(Ok(scripted([Err(refused())])), 3), [false, true, true]);
    }

    #[test]
    fn a_working_decoder_stays_despite_later_failures() {
        let script = [Ok(()), Err(refused()), Err(refused()), Ok(())];
        assert_eq!(pictures(Ok(scripted(script)), 4), [true, false, false, true]);
    }

    #[test]
    fn a_broken_video_replaces_nobody() {
        let script = [Err(DecodeError::Corrupt { state: 1 }), Err(DecodeError::NeedsRefresh), Ok(())];
        assert_eq!(pictures(Ok(scripted(script)), 3), [false, false, true]);
    }

    #[test]
    fn units_of_a_replaced_decoder_come_out_once_in_order() {
        let own = scripted([Err(refused()), Ok(())]);
        let mut decoder = decoder(Ok(own), Box::new(|| Ok(scripted([Ok(())])))).expect("a decoder");
        (0..3).for_each(|_| decoder.submit(&[]));
        assert!(matches!(decoder.poll(Duration::ZERO), Some(Err(DecodeError::Platform { .. }))));
        decoder.submit(&[]);
        for _ in 0..2 {
            assert!(matches!(decoder.poll(Duration::ZERO), Some(Err(DecodeError::NeedsRefresh))));
        }
        assert!(matches!(decoder.poll(Duration::ZERO), Some(Ok(_))));
        assert!(decoder.poll(Duration::ZERO).is_none());
    }
}
