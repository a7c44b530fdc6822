//! Trace of the client, if requested, in the server's time. Nothing is traced before that time is known.

use crate::client::DecodedIn;
use crate::report::FrameReport;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::time::{ClientTime, ServerTime};
use shadecast_protocol::wire::{StreamMessage, parse_stream};
use shadecast_trace::{Process, Trace, Track};
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

/// See the module. Its copies, on whatever threads, know the server's time from the frames of any of them.
#[derive(Clone)]
pub struct Traced {
    rows: Option<Rows>,
    /// What the server's time is ahead of the client's; `UNKNOWN` at first.
    ahead_ns: Arc<AtomicI64>,
    /// The update on display, and since when.
    shown: Option<(UpdateId, ServerTime)>,
}

const UNKNOWN: i64 = i64::MIN;

#[derive(Clone)]
struct Rows {
    network: Track,
    decoder: Track,
    frames: Track,
    display: Track,
    cpu: Track,
}

impl Traced {
    /// Of a client whose rows come next.
    pub fn new(trace: Option<&Trace>) -> Self {
        let row = |trace: &Trace, name| trace.track(Process::Client, name);
        let rows = trace.map(|trace| Rows {
            network: row(trace, "network"),
            decoder: row(trace, "decoder"),
            frames: row(trace, "frames"),
            display: row(trace, "display"),
            cpu: row(trace, "render thread"),
        });
        Self { rows, ahead_ns: Arc::new(AtomicI64::new(UNKNOWN)), shown: None }
    }

    /// A whole stream has come.
    pub fn arrived(&self, bytes: &[u8], at: ClientTime) {
        let (Some(rows), Some(at)) = (&self.rows, self.server_time(at)) else { return };
        match parse_stream(bytes) {
            Ok(StreamMessage::Geometry { head, .. }) if head.is_update => {
                rows.network.instant("delta has come", at, Some(head.update));
            }
            Ok(StreamMessage::Picture { header, .. }) => {
                rows.network.instant("picture has come", at, Some(header.update));
            }
            _ => {}
        }
    }

    /// Pictures were decoded.
    pub fn decoded(&self, decoded: impl Iterator<Item = DecodedIn>) {
        for DecodedIn { update, times: [began, ended] } in decoded {
            let (Some(rows), Some(began), Some(ended)) =
                (&self.rows, self.server_time(began), self.server_time(ended))
            else {
                continue;
            };
            rows.decoder.span("decode", [began, ended], Some(update));
        }
    }

    /// A display frame was made, from the end of the runtime's wait to its handing over; how long the thread was on a processor
    /// for that, where that is known.
    pub fn ended(&mut self, made: [ClientTime; 2], cpu_ns: Option<i64>, frame: &FrameReport) {
        let Some(rows) = &self.rows else { return };
        let Some(display_time) = frame.server_time else { return };
        self.ahead_ns.store(display_time.0 - frame.display_time.0, Ordering::Relaxed);
        let times = made.map(|at| self.server_time(at).unwrap_or(display_time));
        rows.frames.span("frame", times, frame.update);
        if let Some(cpu_ns) = cpu_ns {
            rows.cpu.counter("milliseconds of a processor", times[1], cpu_ns as f64 * 1e-6);
        }
        if self.shown.map(|(update, _)| update) == frame.update {
            return;
        }
        if let Some((update, since)) = self.shown {
            rows.display.span("on display", [since, display_time], Some(update));
        }
        self.shown = frame.update.map(|update| (update, display_time));
    }

    fn server_time(&self, at: ClientTime) -> Option<ServerTime> {
        let ahead_ns = self.ahead_ns.load(Ordering::Relaxed);
        (ahead_ns != UNKNOWN).then(|| ServerTime(at.0 + ahead_ns))
    }
}
