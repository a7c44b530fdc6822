//! The client's end of the session: messages, the decoding of pictures, and reports of the head and of the display.
//!
//! It knows neither scenes nor the GPU. An ended connection leaves nothing here except the start of the next one.

use super::watch::Watch;
use crate::decode::decoding::{self, DecodeTiming, Decoded, Decoding};
use crate::decode::{Decoder, Picture};
use crate::report::FrameReport;
use shadecast_protocol::clock::ClockEstimate;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::message::{
    Capabilities, ClientHello, Displayed, HeadState, ResumeSecret, Welcome, sayable_period_ns,
};
use shadecast_protocol::pose::Eye;
use shadecast_protocol::session::{ClientEvent, ClientSession, Out};
use shadecast_protocol::time::ClientTime;
use shadecast_protocol::wire::WireError;

/// What is on display is reported at least this often.
const REPORT_NS: i64 = 250_000_000;

/// See the module.
#[derive(Default)]
pub(crate) struct Link {
    connection: Option<Connection>,
    /// The driver is connected; the session begins when the eyes are known, since the hello names them.
    is_connected: bool,
    /// Of the newest connection.
    serial: u64,
    /// What lets this client come back to its place at the server.
    resume: Option<ResumeSecret>,
    watch: Watch,
    /// The eyes, and the display's period in nanoseconds, of the last display frame.
    eyes: Option<([Eye; 2], i64)>,
    reports: Reports,
}

/// A connection, from the moment that bytes can flow.
struct Connection {
    serial: u64,
    session: ClientSession,
    /// From the welcome on.
    decoding: Option<Decoding>,
}

/// What is on display as the server is told of it.
#[derive(Default)]
struct Reports {
    next: Displayed,
    sent: Option<ClientTime>,
}

impl Link {
    /// Bytes can flow.
    pub(crate) fn open(&mut self) {
        self.is_connected = true;
    }

    /// Bytes flow no more. Gives the serial of the connection that has ended.
    pub(crate) fn close(&mut self) -> Option<u64> {
        self.is_connected = false;
        self.connection.take().map(|connection| connection.serial)
    }

    /// Begins the session that is due, if one is, with what `capabilities` makes of eyes and display period.
    pub(crate) fn begin(
        &mut self,
        now: ClientTime,
        capabilities: impl FnOnce([Eye; 2], i64) -> Capabilities,
    ) {
        let (Some((eyes, period_ns)), true, None) = (self.eyes, self.is_connected, &self.connection) else {
            return;
        };
        let hello = ClientHello {
            resume: self.resume,
            ..ClientHello::new(env!("CARGO_PKG_VERSION"), capabilities(eyes, period_ns))
        };
        self.serial += 1;
        let session = ClientSession::start(hello, now);
        self.connection = Some(Connection { serial: self.serial, session, decoding: None });
    }

    /// The session stands, and its pictures will be decoded by `decoder`. Gives the connection's serial.
    pub(crate) fn welcomed(
        &mut self,
        welcome: &Welcome,
        decoder: Box<dyn Decoder>,
        timing: DecodeTiming,
    ) -> Option<u64> {
        let connection = self.connection.as_mut()?;
        connection.decoding = Some(Decoding::new(decoder, timing));
        self.watch.begin_session();
        self.resume = Some(welcome.resume);
        Some(connection.serial)
    }

    /// The session, to be given what has come.
    pub(crate) fn session(&mut self) -> Option<&mut ClientSession> {
        self.connection.as_mut().map(|connection| &mut connection.session)
    }

    /// The decoding of the session's pictures, once it stands.
    pub(crate) fn decoding(&mut self) -> Option<&mut Decoding> {
        self.connection.as_mut().and_then(|connection| connection.decoding.as_mut())
    }

    /// Ends the session: what came contradicts what is on display.
    pub(crate) fn fail(&mut self, error: WireError) {
        if let Some(session) = self.session() {
            session.fail(error);
        }
    }

    /// The server gave up a stream of which `head` had come.
    pub(crate) fn stream_was_reset(&mut self, head: &[u8]) {
        if let Some(decoding) = self.decoding() {
            decoding.given_up(decoding::frame_of_head(head));
        }
    }

    /// What has happened in the session.
    pub(crate) fn poll_event(&mut self) -> Option<ClientEvent> {
        self.session()?.poll_event()
    }

    /// The next bytes to carry to the server.
    pub(crate) fn poll_out(&mut self) -> Option<Out> {
        self.session()?.poll_out()
    }

    /// When something is due by itself.
    pub(crate) fn next_tick(&self) -> Option<ClientTime> {
        self.connection.as_ref().and_then(|connection| connection.session.next_tick())
    }

    /// Hands the pictures that are decoded by `now` to `take`, with the connection's serial; what that gives back is not
    /// needed. Asks for a refresh where only that helps. Gives the pictures lost, and whether it asked.
    pub(crate) fn decode(
        &mut self,
        now: ClientTime,
        mut take: impl FnMut(u64, Decoded) -> Option<Picture>,
    ) -> (u32, bool) {
        let Some(Connection { serial, session, decoding: Some(decoding) }) = &mut self.connection else {
            return (0, false);
        };
        let mut unused = Vec::new();
        decoding.set_round_trip(session.clock().rtt_ns().unwrap_or(0));
        decoding.advance(now, |decoded| unused.extend(take(*serial, decoded)));
        unused.into_iter().for_each(|picture| decoding.recycle(picture));
        // What is missing may be under way since before an outage.
        let request = if session.is_quiet() { None } else { decoding.refresh_request(now) };
        let has_asked = request.is_some();
        request.into_iter().for_each(|after| session.request_refresh(after));
        let lost = decoding.take_lost();
        self.reports.next.lost_pictures = self.reports.next.lost_pictures.saturating_add(lost);
        (lost, has_asked)
    }

    /// Why the session's pictures cannot be shown, once that is known.
    pub(crate) fn take_trouble(&mut self) -> Option<String> {
        self.decoding()?.take_trouble()
    }

    /// A picture that is not needed any more goes back to the decoder.
    pub(crate) fn recycle(&mut self, picture: Picture) {
        if let Some(decoding) = self.decoding() {
            decoding.recycle(picture);
        }
    }

    /// The blocks of an update could not settle: the server is to know with the next refresh request.
    pub(crate) fn note_unsettled(&mut self, update: UpdateId) {
        if let Some(decoding) = self.decoding() {
            decoding.note_unsettled(update);
        }
    }

    /// What the live connection knows of its server's clock, and its serial.
    pub(crate) fn clock_estimate(&self) -> Option<(ClockEstimate, u64)> {
        let connection = self.connection.as_ref()?;
        Some((connection.session.clock().estimate()?, connection.serial))
    }

    /// Bytes of what has come and waits for an earlier one.
    pub(crate) fn waiting_bytes(&self) -> usize {
        let Some(Connection { session, decoding, .. }) = &self.connection else { return 0 };
        session.waiting_bytes() + decoding.as_ref().map_or(0, Decoding::waiting_bytes)
    }

    /// Notes whether this turn of the runtime is seen, and tells the server where it must know.
    pub(crate) fn watch(&mut self, is_seen: bool, now: ClientTime) {
        let Some(connection) = self.connection.as_mut().filter(|c| c.decoding.is_some()) else { return };
        if let Some(is_watched) = self.watch.turn(is_seen, now) {
            connection.session.report_watching(is_watched);
        }
    }

    /// Notes the eyes of a display frame: the next hello names them.
    pub(crate) fn note_eyes(&mut self, eyes: [Eye; 2], display_period_ns: i64) {
        self.eyes = Some((eyes, sayable_period_ns(display_period_ns)));
    }

    /// Tells the server of a connection where the head will be.
    pub(crate) fn report_head(&mut self, serial: u64, head: HeadState) {
        if let Some(connection) = self.of_serial(serial) {
            connection.session.send_pose(head);
        }
    }

    /// Counts a display frame. What it shows, if anything, is of connection `shown`, which is told where that is new or due.
    pub(crate) fn report(
        &mut self,
        shown: Option<u64>,
        frame: &FrameReport,
        picture_arrived: Option<ClientTime>,
    ) {
        let next = &mut self.reports.next;
        next.display_frames += u32::from(frame.is_seen());
        next.frames_without_bundle += u32::from(frame.is_seen() && frame.update.is_none());
        next.frozen_vertices = next.frozen_vertices.saturating_add(frame.frozen_vertices);
        next.withheld_patches = next.withheld_patches.saturating_add(frame.withheld_patches);
        let (Some(serial), Some(id), Some(time)) = (shown, frame.update, frame.server_time) else { return };
        if frame.is_new {
            next.update = id;
            next.display_time = time;
            next.decode_to_display_ns =
                picture_arrived.map_or(0, |arrived| frame.display_time.since(arrived));
        }
        let is_due = self.reports.sent.is_none_or(|sent| frame.display_time.since(sent) >= REPORT_NS);
        if frame.is_new || is_due {
            self.send_report(serial, frame.display_time);
        }
    }

    fn send_report(&mut self, serial: u64, now: ClientTime) {
        let report = self.reports.next;
        // One report says as much as many that wait.
        let Some(connection) = self.of_serial(serial).filter(|c| !c.session.is_quiet()) else { return };
        connection.session.send_displayed(report);
        let Displayed { update: frame, display_time, decode_to_display_ns, .. } = report;
        let next = Displayed { update: frame, display_time, decode_to_display_ns, ..Displayed::default() };
        self.reports = Reports { next, sent: Some(now) };
    }

    /// The live connection, if it is this one.
    fn of_serial(&mut self, serial: u64) -> Option<&mut Connection> {
        self.connection.as_mut().filter(|connection| connection.serial == serial)
    }
}
