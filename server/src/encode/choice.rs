//! Choice of a stream's H.264 encoder: the one named by the user, or the first one that works here. If it fails while a client
//! is served, the next one replaces it.

use super::openh264::{EncoderSettings, OpenH264Encoder};
use super::{EncodeError, Encoded, Encoder, Source};
use std::collections::VecDeque;
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;
use thiserror::Error;

/// The encoder that is built in.
pub const OPENH264: &str = "openh264";

/// What a user asks for.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Wanted {
    /// The first that works.
    #[default]
    Auto,
    /// This one.
    Named(String),
}

impl FromStr for Wanted {
    type Err = std::convert::Infallible;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(if text == "auto" { Self::Auto } else { Self::Named(text.to_owned()) })
    }
}

/// The encoder that a user names is not to be had.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("--encoder {name}: {reason}; available: {}, or auto", there.join(", "))]
pub struct NoSuchEncoder {
    name: String,
    reason: String,
    there: Vec<&'static str>,
}

/// Makes an encoder.
pub(crate) type Make = Arc<dyn Fn(EncoderSettings) -> Result<Box<dyn Encoder>, EncodeError> + Send + Sync>;

/// An encoder that can be made.
#[derive(Clone)]
pub struct Kind {
    /// As its library calls it.
    pub name: &'static str,
    make: Make,
}

impl fmt::Debug for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name)
    }
}

impl Kind {
    /// One that `make` makes.
    pub fn new(name: &'static str, make: Make) -> Self {
        Self { name, make }
    }

    /// An encoder of it.
    ///
    /// # Errors
    /// The settings are outside of their ranges, or it cannot be made.
    pub fn encoder(&self, settings: EncoderSettings) -> Result<Box<dyn Encoder>, EncodeError> {
        (self.make)(settings)
    }
}

fn openh264() -> Kind {
    let make = |settings| Ok(Box::new(OpenH264Encoder::new(settings)?) as Box<dyn Encoder>);
    Kind { name: OPENH264, make: Arc::new(make) }
}

/// All that this program could have, best first, each with why it is of no use here.
pub fn survey() -> Vec<(Kind, Result<(), String>)> {
    let mut all = of_libavcodec();
    all.push((openh264(), Ok(())));
    all
}

#[cfg(not(feature = "libavcodec"))]
fn of_libavcodec() -> Vec<(Kind, Result<(), String>)> {
    Vec::new()
}

#[cfg(feature = "libavcodec")]
fn of_libavcodec() -> Vec<(Kind, Result<(), String>)> {
    use super::libavcodec::{CANDIDATES, LibavEncoder};
    let kind = |candidate: super::libavcodec::Candidate| {
        let make = move |settings| Ok(Box::new(LibavEncoder::new(candidate, settings)?) as Box<dyn Encoder>);
        let tried = candidate.try_out().map_err(|error| error.to_string());
        (Kind { name: candidate.name, make: Arc::new(make) }, tried)
    };
    CANDIDATES.into_iter().map(kind).collect()
}

/// Encoders of one program, best first. Clones know of each other which of them have broken.
#[derive(Clone, Debug)]
pub struct Encoders {
    kinds: Arc<[Kind]>,
    /// Those before it have broken.
    first: Arc<AtomicUsize>,
}

impl Encoders {
    /// Tries what this machine has.
    ///
    /// # Errors
    /// The named one is unknown, or does not work.
    pub fn choose(wanted: &Wanted) -> Result<Self, NoSuchEncoder> {
        Self::among(survey(), wanted)
    }

    fn among(all: Vec<(Kind, Result<(), String>)>, wanted: &Wanted) -> Result<Self, NoSuchEncoder> {
        let works = |(kind, tried): &(Kind, Result<(), String>)| tried.is_ok().then(|| kind.clone());
        let mut kinds: Vec<Kind> = all.iter().filter_map(works).collect();
        if let Wanted::Named(name) = wanted {
            let found = all.iter().find(|(kind, _)| kind.name == name);
            let there = kinds.iter().map(|kind| kind.name).collect();
            let no = |reason: &str| NoSuchEncoder { name: name.clone(), reason: reason.to_owned(), there };
            match found {
                None => return Err(no("this program has no encoder of that name")),
                Some((_, Err(reason))) => return Err(no(reason)),
                Some((_, Ok(()))) => kinds.retain(|kind| kind.name == name || kind.name == OPENH264),
            }
        }
        Ok(Self { kinds: kinds.into(), first: Arc::default() })
    }

    /// The first that has not broken.
    pub fn name(&self) -> &'static str {
        self.kinds[self.first.load(Ordering::Relaxed)].name
    }

    /// An encoder for a stream. Where it breaks, the next of them takes its place.
    ///
    /// # Errors
    /// The settings are outside of their ranges, or none can be made.
    pub fn encoder(&self, settings: EncoderSettings) -> Result<Box<dyn Encoder>, EncodeError> {
        let (number, encoder) = self.make(self.first.load(Ordering::Relaxed), settings)?;
        if number + 1 == self.kinds.len() {
            return Ok(encoder);
        }
        Ok(Box::new(Replaceable {
            encoders: self.clone(),
            settings,
            number,
            encoder,
            under_way: VecDeque::new(),
        }))
    }

    /// The first from `number` on that can be made.
    fn make(
        &self,
        mut number: usize,
        settings: EncoderSettings,
    ) -> Result<(usize, Box<dyn Encoder>), EncodeError> {
        loop {
            match self.kinds[number].encoder(settings) {
                Ok(encoder) => return Ok((number, encoder)),
                Err(error) if number + 1 == self.kinds.len() || !is_its_own(&error) => return Err(error),
                Err(error) => self.give_up(number, &error),
            }
            number += 1;
        }
    }

    /// Nobody begins with an encoder that has broken.
    fn give_up(&self, number: usize, error: &EncodeError) {
        let (broken, next) = (self.kinds[number].name, self.kinds[number + 1].name);
        if self.first.fetch_max(number + 1, Ordering::Relaxed) <= number {
            tracing::warn!(
                "the encoder {broken} failed and is replaced by {next}: {error}; choose another with --encoder"
            );
        }
    }
}

/// Whether an error is the encoder's own fault, so that another one may do better.
fn is_its_own(error: &EncodeError) -> bool {
    match error {
        EncodeError::Stalled | EncodeError::Library { .. } => true,
        #[cfg(feature = "libavcodec")]
        EncodeError::Libavcodec { .. } => true,
        _ => false,
    }
}

/// An encoder in whose place another can come.
struct Replaceable {
    encoders: Encoders,
    settings: EncoderSettings,
    /// Which it is.
    number: usize,
    encoder: Box<dyn Encoder>,
    /// Times of the pictures that are with it.
    under_way: VecDeque<i64>,
}

impl Replaceable {
    /// The next encoder takes the place of one that has failed with `source`, and all pictures that are with it. False where
    /// there is none.
    fn replace(&mut self, source: Source, error: &EncodeError) -> Result<(), Source> {
        if self.number + 1 == self.encoders.kinds.len() {
            return Err(source);
        }
        self.encoders.give_up(self.number, error);
        let Ok((number, next)) = self.encoders.make(self.number + 1, self.settings) else {
            return Err(source);
        };
        let mut broken = std::mem::replace(&mut self.encoder, next);
        self.number = number;
        let others = std::iter::from_fn(|| broken.poll(Duration::ZERO)).map(|encoded| encoded.source);
        let sources = std::iter::once(source).chain(others);
        for (place, (source, timestamp_ns)) in sources.zip(&self.under_way).enumerate() {
            self.encoder.submit(source, *timestamp_ns, place == 0);
        }
        Ok(())
    }
}

impl Encoder for Replaceable {
    fn submit(&mut self, source: Source, timestamp_ns: i64, refresh: bool) {
        self.under_way.push_back(timestamp_ns);
        self.encoder.submit(source, timestamp_ns, refresh);
    }

    fn poll(&mut self, timeout: Duration) -> Option<Encoded> {
        loop {
            let Encoded { source, result } = self.encoder.poll(timeout)?;
            let (source, result) = match result {
                Err(error) if is_its_own(&error) => match self.replace(source, &error) {
                    Ok(()) => continue,
                    Err(source) => (source, Err(error)),
                },
                result => (source, result),
            };
            self.under_way.pop_front();
            return Some(Encoded { source, result });
        }
    }

    fn set_qp(&mut self, qp: u8) -> Result<(), EncodeError> {
        self.settings.qp = qp;
        // One that cannot has broken, and will say so with the next picture.
        match self.encoder.set_qp(qp) {
            Err(error) if !is_its_own(&error) => Err(error),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::encode::{AccessUnit, encode_one};
    use shadecast_protocol::picture::I420;

    const EXTENT: [u32; 2] = [64, 32];

    /// Codes so many pictures, and then fails with each.
    struct Breaks {
        left: u32,
        done: VecDeque<Encoded>,
    }

    impl Encoder for Breaks {
        fn submit(&mut self, source: Source, _: i64, refresh: bool) {
            let result = match self.left.checked_sub(1) {
                Some(left) => {
                    self.left = left;
                    Ok(AccessUnit { bytes: vec![7], is_refresh: refresh })
                }
                None => Err(EncodeError::Stalled),
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

    fn breaks(name: &'static str, after: u32) -> Kind {
        let make = move |_| Ok(Box::new(Breaks { left: after, done: VecDeque::new() }) as Box<dyn Encoder>);
        Kind { name, make: Arc::new(make) }
    }

    fn unmade(name: &'static str) -> Kind {
        Kind { name, make: Arc::new(|_| Err(EncodeError::Stalled)) }
    }

    fn grey() -> Source {
        let bytes = vec![128; I420::byte_count(EXTENT) as usize];
        Source::Planes(I420::new(EXTENT, bytes).expect("its own extent"))
    }

    fn encoders(kinds: Vec<Kind>) -> Encoders {
        let all = kinds.into_iter().chain([openh264()]).map(|kind| (kind, Ok(())));
        Encoders::among(all.collect(), &Wanted::Auto).expect("openh264 is there")
    }

    #[test]
    fn a_failing_encoders_picture_returns_as_a_refresh() {
        let all = encoders(vec![breaks("first", 2), unmade("second")]);
        let mut encoder = all.encoder(EncoderSettings::new(EXTENT)).expect("an encoder");
        let mut units = Vec::new();
        for at in 0..4 {
            units.push(encode_one(&mut *encoder, grey(), at, at == 0).expect("each picture is coded"));
        }
        assert_eq!([&units[0].bytes, &units[1].bytes], [&[7], &[7]]);
        assert_eq!([units[2].is_refresh, units[3].is_refresh], [true, false], "though nobody asked");
        assert!(units[2].bytes.len() > 10, "of openh264");
        assert_eq!(all.name(), "openh264", "who comes next does not begin with one that has broken");
    }

    #[test]
    fn a_broken_encoders_pictures_return_in_order() {
        let all = encoders(vec![breaks("first", 1)]);
        let mut encoder = all.encoder(EncoderSettings::new(EXTENT)).expect("an encoder");
        (0..4).for_each(|at| encoder.submit(grey(), at * 33_000_000, false));
        let out: Vec<Encoded> = std::iter::from_fn(|| encoder.poll(Duration::ZERO)).collect();
        assert_eq!(out.len(), 4);
        let refreshes: Vec<bool> =
            out.iter().map(|one| one.result.as_ref().is_ok_and(|unit| unit.is_refresh)).collect();
        assert_eq!(refreshes, [false, true, false, false]);
    }

    #[test]
    fn what_is_wrong_with_a_picture_is_no_fault_of_the_encoder() {
        let all = encoders(vec![breaks("first", 9)]);
        let settings = EncoderSettings { qp: 99, ..EncoderSettings::new(EXTENT) };
        assert!(openh264_alone().encoder(settings).is_err());
        assert_eq!(all.name(), "first");
    }

    fn openh264_alone() -> Encoders {
        Encoders::among(vec![(openh264(), Ok(()))], &Wanted::Auto).expect("it is there")
    }

    #[test]
    fn the_last_encoders_failure_is_told() {
        let all = [breaks("first", 0), breaks("last", 0)].map(|kind| (kind, Ok(())));
        let all = Encoders::among(all.into(), &Wanted::Auto).expect("they are there");
        let mut encoder = all.encoder(EncoderSettings::new(EXTENT)).expect("an encoder");
        assert!(matches!(encode_one(&mut *encoder, grey(), 0, true), Err(EncodeError::Stalled)));
    }

    #[test]
    fn a_name_that_is_not_there_is_answered_with_those_that_are() {
        let all = || vec![(unmade("h264_nvenc"), Err("no card".to_owned())), (openh264(), Ok(()))];
        let ask = |name: &str| {
            Encoders::among(all(), &name.parse().expect("any text")).map(|all| all.kinds[0].name)
        };
        assert_eq!(ask("openh264"), Ok("openh264"));
        assert_eq!(ask("auto"), Ok("openh264"));
        let text = |name| ask(name).expect_err("not there").to_string();
        let unknown = text("h265");
        assert!(
            unknown.contains("h265: this program has no encoder of that name; available: openh264"),
            "{unknown}"
        );
        assert!(text("h264_nvenc").contains("no card"), "{}", text("h264_nvenc"));
    }
}
