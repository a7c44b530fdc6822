//! What the server does, told to a trace where one is asked for.

use crate::serve::cause_bits::CauseBits;
use crate::update::Sharpness;
use shadecast_gpu::Timings;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::session::Out;
use shadecast_protocol::time::ServerTime;
use shadecast_protocol::wire::{StreamMessage, parse_stream};
use shadecast_system::monotonic_now_ns;
use shadecast_trace::{Process, Trace, Track};
use std::sync::Arc;

/// A trace under way, or none.
#[derive(Clone)]
pub(super) struct Traced {
    trace: Option<Arc<Trace>>,
    /// When the server's time began, by the monotonic clock.
    epoch_ns: i64,
}

/// A row of the trace, or of none.
#[derive(Clone)]
pub(super) struct Row {
    track: Option<Track>,
    epoch_ns: i64,
}

/// The device's row. Its clock is another: how far the two are apart is the least that they ever seemed to be, since the news of
/// an end comes late at times, and never early.
pub(super) struct DeviceRow {
    row: Row,
    apart_ns: i64,
}

impl Traced {
    pub(super) fn new(trace: Option<Trace>, epoch_ns: i64) -> Self {
        Self { trace: trace.map(Arc::new), epoch_ns }
    }

    pub(super) fn epoch_ns(&self) -> i64 {
        self.epoch_ns
    }

    pub(super) fn row(&self, name: &str) -> Row {
        let track = self.trace.as_ref().map(|trace| trace.track(Process::Server, name));
        Row { track, epoch_ns: self.epoch_ns }
    }

    pub(super) fn device(&self) -> DeviceRow {
        DeviceRow { row: self.row("device"), apart_ns: i64::MAX }
    }
}

impl Row {
    /// Something that began at `began_ns` of the monotonic clock has just ended.
    pub(super) fn ended(&self, name: &'static str, began_ns: i64, update: Option<UpdateId>) {
        if let Some(track) = &self.track {
            track.span(name, [began_ns, monotonic_now_ns()].map(|ns| self.at(ns)), update);
        }
    }

    /// Something happens now.
    pub(super) fn happens(&self, name: &'static str, update: Option<UpdateId>) {
        if let Some(track) = &self.track {
            track.instant(name, self.at(monotonic_now_ns()), update);
        }
    }

    /// Whether anybody reads it.
    pub(super) fn is_traced(&self) -> bool {
        self.track.is_some()
    }

    /// Bits of the picture that has just been coded.
    pub(super) fn bits(&self, bits: &CauseBits) {
        if let Some(track) = &self.track {
            let named = bits.named().map(|(name, bits)| (name, bits as f64));
            track.counters("bits by cause", self.at(monotonic_now_ns()), &named);
        }
    }

    /// How sharp the update is that has just been made.
    pub(super) fn sharpness(&self, sharpness: Sharpness) {
        if let Some(track) = &self.track {
            let Sharpness { lod_error_pixels, texels_per_pixel } = sharpness;
            let named = [("lod error pixels", lod_error_pixels), ("texels per pixel", texels_per_pixel)];
            track.counters(
                "sharpness",
                self.at(monotonic_now_ns()),
                &named.map(|(name, of)| (name, of.into())),
            );
        }
    }

    /// A stream is handed to the transport.
    pub(super) fn leaves(&self, out: &Out) {
        let (Some(_), Out::Stream { bytes, .. }) = (&self.track, out) else { return };
        match parse_stream(bytes) {
            Ok(StreamMessage::Geometry { head, .. }) => self.happens("delta leaves", Some(head.update)),
            Ok(StreamMessage::Picture { header, .. }) => self.happens("picture leaves", Some(header.update)),
            Ok(StreamMessage::Motion(_)) => self.happens("motion leaves", None),
            Err(error) => debug_assert!(false, "{error}"),
        }
    }

    fn at(&self, monotonic_ns: i64) -> ServerTime {
        ServerTime(monotonic_ns - self.epoch_ns)
    }
}

impl DeviceRow {
    /// The scopes of an update that the device has just ended.
    pub(super) fn ended(&mut self, timings: &Timings, update: UpdateId) {
        let Some(track) = &self.row.track else { return };
        let ends_ns = timings.scopes().iter().map(|timing| timing.began_ns + timing.took_ns);
        let Some(end_ns) = ends_ns.max() else { return };
        self.apart_ns = self.apart_ns.min(monotonic_now_ns() - end_ns);
        for timing in timings.scopes() {
            let began_ns = timing.began_ns + self.apart_ns;
            let times = [began_ns, began_ns + timing.took_ns].map(|ns| self.row.at(ns));
            track.span(timing.scope, times, Some(update));
        }
    }

    /// Another device has another clock.
    pub(super) fn forget(&mut self) {
        self.apart_ns = i64::MAX;
    }
}
