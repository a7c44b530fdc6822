//! What the client does, told to a trace where one is asked for: in the server's time, once that is known. What happens before is
//! not told.

use crate::client::DecodedIn;
use crate::report::FrameReport;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::time::{ClientTime, ServerTime};
use shadecast_protocol::wire::{StreamMessage, parse_stream};
use shadecast_trace::{Process, Trace, Track};

/// See the module.
pub struct Traced {
    rows: Option<Rows>,
    /// What the server's time is ahead of the client's.
    ahead_ns: Option<i64>,
    /// The update on display, and since when.
    shown: Option<(UpdateId, ServerTime)>,
}

struct Rows {
    network: Track,
    decoder: Track,
    frames: Track,
    display: Track,
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
        });
        Self { rows, ahead_ns: None, shown: None }
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

    /// A display frame was made, from the end of the runtime's wait to its handing over.
    pub fn ended(&mut self, made: [ClientTime; 2], frame: &FrameReport) {
        let Some(rows) = &self.rows else { return };
        let Some(display_time) = frame.server_time else { return };
        self.ahead_ns = Some(display_time.0 - frame.display_time.0);
        let times = made.map(|at| self.server_time(at).unwrap_or(display_time));
        rows.frames.span("frame", times, frame.update);
        if self.shown.map(|(update, _)| update) == frame.update {
            return;
        }
        if let Some((update, since)) = self.shown {
            rows.display.span("on display", [since, display_time], Some(update));
        }
        self.shown = frame.update.map(|update| (update, display_time));
    }

    fn server_time(&self, at: ClientTime) -> Option<ServerTime> {
        self.ahead_ns.map(|ahead_ns| ServerTime(at.0 + ahead_ns))
    }
}
