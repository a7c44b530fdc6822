//! The platform's decoder behind the seam: asynchronous, with input buffers at its own pace, and pictures in its own images.
//!
//! This half is plain logic: the place of each unit, the unit of each picture, the number of lent images, the cost of an error.
//! A [`PlatformCodec`] calls the platform; tests have a scripted one.
//!
//! A codec reports events from its own threads, through a channel. A codec is discarded after an error or a skipped unit. The
//! next refresh starts a new one, so no state or number of the old one survives.

use super::inspect::{check_picture_extent, inspect};
use super::{DecodeError, Decoder, DevicePicture, Picture, sps};
use shadecast_gpu::YcbcrImage;
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

/// Images that may be with the client at once: those that wait for their patches, those of bundles, the one that was on display before,
/// and two on their way.
pub const MAX_LENT: usize = 9;
/// Images of a codec: besides, one that it writes, and one that is written and not taken.
pub const IMAGES: usize = MAX_LENT + 2;
/// From one unit's time to the next one's, in a codec's microseconds. Far enough that codecs that round keep them apart.
const UNIT_US: u64 = 10_000;
/// A codec that has room for its pictures and gives none for so long has failed.
const PATIENCE: Duration = Duration::from_secs(1);
/// Before the first byte of a NAL unit.
const START_CODE: [u8; 4] = [0, 0, 0, 1];

/// What a codec says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CodecEvent {
    /// An input buffer can be filled.
    Input(usize),
    /// The unit of this time is decoded, in an output buffer.
    Output(usize, u64),
    /// A picture has been written to an image.
    Image,
    /// It has failed.
    Failed(String),
}

/// A decoder of the platform, for one stream from a refresh on.
pub trait PlatformCodec: Send {
    /// Copies a unit to an input buffer that it offered, and has it decoded.
    fn queue(&mut self, input: usize, unit: &[u8], time_us: u64) -> Result<(), DecodeError>;

    /// Writes an output buffer that it announced to an image, or forgets it.
    fn release(&mut self, output: usize, is_shown: bool) -> Result<(), DecodeError>;

    /// The oldest image that is written and not taken, with its unit's time.
    fn take_image(&mut self) -> Result<Option<(u64, LentImage)>, DecodeError>;
}

/// A picture in an image that must be given back.
pub struct LentImage {
    /// The image.
    pub image: Arc<YcbcrImage>,
    /// Gives it back when it is dropped.
    pub lease: Box<dyn Send>,
}

/// What codecs want to know before all else: the headers of a refresh, each behind a start code.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Headers {
    /// Of the sequence (SPS).
    pub sequence: Vec<u8>,
    /// Of pictures (PPS).
    pub picture: Vec<u8>,
}

/// Makes a codec for pictures of an extent that says what happens through the sender.
pub type MakeCodec<C> =
    Box<dyn FnMut([u32; 2], &Headers, Sender<CodecEvent>) -> Result<C, DecodeError> + Send>;

/// A [`Decoder`] on a platform's.
pub struct PlatformDecoder<C> {
    extent_texels: [u32; 2],
    make: MakeCodec<C>,
    /// From the first refresh on, until it fails.
    stream: Option<Stream<C>>,
    /// Not come out yet, in order.
    units: VecDeque<Unit>,
    next_time_us: u64,
    needs_refresh: bool,
    lent: Arc<AtomicUsize>,
    /// For how long the oldest unit was waited for in vain.
    waited: Duration,
}

/// A codec with what it has said.
struct Stream<C> {
    codec: C,
    events: Receiver<CodecEvent>,
    inputs: VecDeque<usize>,
    /// Decoded, and not written to images: with their times, in order.
    outputs: VecDeque<(usize, u64)>,
    /// Being written to images, or written and not taken: one at most.
    writing: usize,
}

/// A unit that was submitted.
struct Unit {
    time_us: u64,
    is_refresh: bool,
    state: UnitState,
}

enum UnitState {
    /// Waits for an input buffer.
    Waiting(Vec<u8>),
    /// Is with the codec.
    InCodec,
    Done(Result<Picture, DecodeError>),
}

/// Counts the images that are lent.
struct Counted {
    lent: Arc<AtomicUsize>,
    _lease: Box<dyn Send>,
}

impl Drop for Counted {
    fn drop(&mut self) {
        self.lent.fetch_sub(1, Ordering::AcqRel);
    }
}

fn failed(doing: &'static str, reason: impl Into<String>) -> DecodeError {
    DecodeError::Platform { doing, reason: reason.into() }
}

impl<C: PlatformCodec> PlatformDecoder<C> {
    /// Makes a decoder for a stream of the agreed extent. Its codec is made with the first refresh, which has its headers.
    ///
    /// # Errors
    /// No decoder takes pictures of this extent.
    pub fn new(extent_texels: [u32; 2], make: MakeCodec<C>) -> Result<Self, DecodeError> {
        check_picture_extent(extent_texels)?;
        Ok(Self {
            extent_texels,
            make,
            stream: None,
            units: VecDeque::new(),
            next_time_us: 0,
            needs_refresh: true,
            lent: Arc::default(),
            waited: Duration::ZERO,
        })
    }

    /// Whether the unit may be decoded, and whether it is a refresh. A refresh has a codec, if need be a new one.
    fn admit(&mut self, access_unit: &[u8]) -> Result<bool, DecodeError> {
        let is_refresh =
            inspect(access_unit, self.extent_texels).inspect_err(|_| self.needs_refresh = true)?;
        if self.needs_refresh && !is_refresh {
            return Err(DecodeError::NeedsRefresh);
        }
        if self.stream.is_none() {
            let (to_us, events) = channel();
            let codec = (self.make)(self.extent_texels, &Headers::of(access_unit), to_us)?;
            let (inputs, outputs) = (VecDeque::new(), VecDeque::new());
            self.stream = Some(Stream { codec, events, inputs, outputs, writing: 0 });
        }
        self.needs_refresh = false;
        Ok(is_refresh)
    }

    /// Does what can be done at once.
    fn pump(&mut self) {
        if let Err(error) = self.try_pump() {
            self.fail(error);
        }
    }

    fn try_pump(&mut self) -> Result<(), DecodeError> {
        let Self { stream: Some(stream), units, lent, .. } = self else { return Ok(()) };
        while let Ok(event) = stream.events.try_recv() {
            stream.note(event)?;
        }
        let waiting = units.iter_mut().filter(|unit| matches!(unit.state, UnitState::Waiting(_)));
        for (unit, input) in waiting.zip(std::iter::from_fn(|| stream.inputs.pop_front())) {
            if let UnitState::Waiting(bytes) = std::mem::replace(&mut unit.state, UnitState::InCodec) {
                stream.codec.queue(input, &bytes, unit.time_us)?;
            }
        }
        while stream.writing > 0
            && let Some((time_us, LentImage { image, lease })) = stream.codec.take_image()?
        {
            stream.writing -= 1;
            lent.fetch_add(1, Ordering::AcqRel);
            let lease = Box::new(Counted { lent: lent.clone(), _lease: lease });
            finish(units, time_us, DevicePicture { image, is_foreign: true, lease })?;
        }
        // One at a time: before Android 12 a window may write a picture over one that was not taken yet, whatever it is told.
        while !stream.outputs.is_empty() && stream.writing == 0 && lent.load(Ordering::Acquire) < MAX_LENT {
            let Some((output, time_us)) = stream.outputs.pop_front() else { break };
            // What nobody waits for any more needs no image.
            let is_shown = units.iter().any(|unit| unit.time_us == time_us);
            stream.codec.release(output, is_shown)?;
            stream.writing += usize::from(is_shown);
        }
        Ok(())
    }

    /// The codec is of no use any more: what is in it is lost, and a new one begins with a refresh.
    fn fail(&mut self, error: DecodeError) {
        tracing::warn!("{error}; the next refresh gets a new decoder");
        self.stream = None;
        self.needs_refresh = true;
        let mut error = Some(error);
        for unit in self.units.iter_mut().filter(|unit| !matches!(unit.state, UnitState::Done(_))) {
            unit.state = UnitState::Done(Err(error.take().unwrap_or(DecodeError::NeedsRefresh)));
        }
    }

    fn pop_done(&mut self) -> Option<Result<Picture, DecodeError>> {
        let front = self.units.pop_front_if(|unit| matches!(unit.state, UnitState::Done(_)))?;
        self.waited = Duration::ZERO;
        match front.state {
            UnitState::Done(result) => Some(result),
            UnitState::Waiting(_) | UnitState::InCodec => unreachable!("it was asked for"),
        }
    }

    /// Whether the codec could give a picture: it has room for one.
    fn has_room(&self) -> bool {
        self.lent.load(Ordering::Acquire) < MAX_LENT
    }
}

impl<C> Stream<C> {
    fn note(&mut self, event: CodecEvent) -> Result<(), DecodeError> {
        match event {
            CodecEvent::Input(index) => self.inputs.push_back(index),
            CodecEvent::Output(index, time_us) => self.outputs.push_back((index, time_us)),
            CodecEvent::Image => {}
            CodecEvent::Failed(reason) => return Err(failed("decoding", reason)),
        }
        Ok(())
    }
}

/// The picture of the unit of `time_us`; of a time that nobody knows it is given back. Units come out in order: one that is passed over
/// gives none, and then those that refer to it would look plausible and be wrong.
fn finish(units: &mut VecDeque<Unit>, time_us: u64, picture: DevicePicture) -> Result<(), DecodeError> {
    let Some(at) = units.iter().position(|unit| unit.time_us == time_us) else { return Ok(()) };
    let passed_over = |unit: &Unit| matches!(unit.state, UnitState::InCodec);
    if units.iter().take(at).any(passed_over) {
        if !units[at].is_refresh {
            return Err(failed("decoding", "it left out a picture that others refer to"));
        }
        for unit in units.iter_mut().take(at).filter(|unit| passed_over(unit)) {
            unit.state = UnitState::Done(Err(failed("decoding", "no picture came of a unit")));
        }
    }
    units[at].state = UnitState::Done(Ok(Picture::OnDevice(picture)));
    Ok(())
}

impl Headers {
    fn of(access_unit: &[u8]) -> Self {
        let all = |nal_type: u8| {
            let of_type = sps::nal_units(access_unit).filter(|unit| sps::nal_type(unit) == nal_type);
            of_type.flat_map(|unit| START_CODE.iter().chain(unit).copied()).collect()
        };
        Self { sequence: all(sps::NAL_SPS), picture: all(sps::NAL_PPS) }
    }
}

/// Whether the platform's decoder of this name runs on the CPU: those are slower than what is built in, and cannot write to images that
/// the device reads without a copy.
pub fn is_software(name: &str) -> bool {
    ["omx.google.", "c2.android.", "c2.google.", "omx.ffmpeg."]
        .iter()
        .any(|prefix| name.to_ascii_lowercase().starts_with(prefix))
}

impl<C: PlatformCodec> Decoder for PlatformDecoder<C> {
    fn submit(&mut self, access_unit: &[u8]) {
        let time_us = self.next_time_us;
        self.next_time_us += UNIT_US;
        let admitted = self.admit(access_unit);
        let is_refresh = matches!(admitted, Ok(true));
        let state = match admitted {
            Ok(_) => UnitState::Waiting(access_unit.to_vec()),
            Err(error) => UnitState::Done(Err(error)),
        };
        self.units.push_back(Unit { time_us, is_refresh, state });
        self.pump();
    }

    fn poll(&mut self, timeout: Duration) -> Option<Result<Picture, DecodeError>> {
        self.pump();
        if let Some(done) = self.pop_done() {
            return Some(done);
        }
        let stream = self.stream.as_mut().filter(|_| !self.units.is_empty())?;
        match stream.events.recv_timeout(timeout) {
            Ok(event) => {
                if let Err(error) = stream.note(event) {
                    self.fail(error);
                }
            }
            Err(_) if self.has_room() => {
                self.waited += timeout;
                if self.waited > PATIENCE {
                    self.fail(failed("decoding", format!("nothing came of it for {PATIENCE:?}")));
                }
            }
            // The client has all images: it is not the codec that is slow.
            Err(_) => {}
        }
        self.pump();
        self.pop_done()
    }

    /// Images go back by being dropped.
    fn recycle(&mut self, _: Picture) {}

    fn unit_lost(&mut self) {
        self.needs_refresh = true;
    }

    fn needs_refresh(&self) -> bool {
        self.needs_refresh
    }
}

#[cfg(test)]
mod tests;
