//! A client that looks and draws nothing: its head, its clock and its reports are those of a real one, so that a server with
//! several viewers is as busy as with several headsets. One process has one OpenXR runtime, and so one client that draws.

use super::SERVER_EPOCH_NS;
use anyhow::bail;
use glam::{Quat, Vec3};
use shadecast_mock_runtime::head_path::HeadPath;
use shadecast_protocol::ids::{DiscontinuityId, UpdateId};
use shadecast_protocol::message::{ClientHello, Displayed, HeadState, Welcome};
use shadecast_protocol::session::{ClientEvent, ClientSession, Out};
use shadecast_protocol::time::ClientTime;
use shadecast_transport::Event;
use std::collections::VecDeque;

/// Over this time a head's velocity is taken, seconds.
const STEP_S: f64 = 1e-3;
/// A report is due at least as often, nanoseconds.
const REPORT_NS: i64 = 100_000_000;

/// See the module.
pub struct Ghost {
    hello: ClientHello,
    head: HeadPath,
    start_ns: i64,
    decode_ns: i64,
    is_connected: bool,
    session: Option<ClientSession>,
    terms: Option<Welcome>,
    sequence: u32,
    newest_delta: Option<UpdateId>,
    /// Pictures that are being decoded, and when each is ready.
    pictures: VecDeque<(i64, UpdateId)>,
    shown: Option<UpdateId>,
    report: Displayed,
    reported_ns: i64,
    /// The largest error of its idea of the server's time while it showed something, nanoseconds.
    clock_error_ns: i64,
}

impl Ghost {
    /// One that says `hello`, whose head follows `head` from `start_ns` on, and that takes `decode_ns` for a picture.
    pub fn new(hello: ClientHello, head: HeadPath, start_ns: i64, decode_ns: i64) -> Self {
        Self {
            hello,
            head,
            start_ns,
            decode_ns,
            is_connected: false,
            session: None,
            terms: None,
            sequence: 0,
            newest_delta: None,
            pictures: VecDeque::new(),
            shown: None,
            report: Displayed::default(),
            reported_ns: i64::MIN,
            clock_error_ns: 0,
        }
    }

    /// The update that it shows.
    pub fn shown(&self) -> Option<UpdateId> {
        self.shown
    }

    /// The largest error of its idea of the server's time while it showed something, milliseconds.
    pub fn clock_error_ms(&self) -> f64 {
        self.clock_error_ns as f64 * 1e-6
    }

    /// Takes an event of its end of the link.
    ///
    /// # Errors
    /// The session or the connection has ended.
    pub fn take(&mut self, event: Event, now_ns: i64) -> anyhow::Result<()> {
        match (event, &mut self.session) {
            (Event::Connected { .. }, _) => self.is_connected = true,
            (Event::Control { message, .. }, Some(session)) => session.on_control(&message),
            (Event::Datagram { bytes, at_ns, .. }, Some(session)) => {
                session.on_datagram(&bytes, ClientTime(at_ns));
            }
            (Event::Stream { bytes, .. }, Some(session)) => session.on_stream(&bytes),
            (Event::Closed { reason, .. }, _) => bail!("a viewer's connection ended: {reason}"),
            _ => {}
        }
        self.listen(now_ns)
    }

    fn listen(&mut self, now_ns: i64) -> anyhow::Result<()> {
        while let Some(event) = self.session.as_mut().and_then(ClientSession::poll_event) {
            match event {
                ClientEvent::Welcome(welcome) => self.terms = Some(welcome),
                ClientEvent::Delta(delta) => self.newest_delta = Some(delta.geometry.update),
                ClientEvent::Picture { header, .. } => {
                    self.pictures.push_back((now_ns + self.decode_ns, header.update));
                }
                ClientEvent::Motion(_) => {}
                ClientEvent::PairingNeeded { .. } | ClientEvent::PairingAnswer { .. } => {
                    bail!("a viewer is asked to be paired")
                }
                ClientEvent::Refused(refused) => bail!("a viewer was refused: {}", refused.reason),
                ClientEvent::Goodbye => bail!("the server took leave of a viewer"),
                ClientEvent::Silent => bail!("the server answers a viewer no longer"),
                ClientEvent::Failed(error) => bail!("a viewer could not understand the server: {error}"),
            }
        }
        Ok(())
    }

    /// Bytes that it wants to send.
    pub fn poll_out(&mut self) -> Option<Out> {
        self.session.as_mut().and_then(ClientSession::poll_out)
    }

    /// A display frame begins at `now_ns` and is seen at `display_ns`.
    ///
    /// # Errors
    /// The session has ended.
    pub fn display(&mut self, now_ns: i64, display_ns: i64) -> anyhow::Result<()> {
        if !self.is_connected {
            return Ok(());
        }
        // A session begins with a frame, as the real client's.
        let begin = || ClientSession::start(self.hello.clone(), ClientTime(now_ns));
        self.session.get_or_insert_with(begin).on_tick(ClientTime(now_ns));
        self.listen(now_ns)?;
        self.look(display_ns);
        let newest = self.newest_delta;
        let is_ready = |&(at_ns, frame): &(i64, UpdateId)| at_ns <= now_ns && Some(frame) <= newest;
        let mut next = None;
        while let Some(picture) = self.pictures.front().copied().filter(is_ready) {
            self.pictures.pop_front();
            next = Some(picture.1);
        }
        self.show(next, display_ns);
        Ok(())
    }

    /// Tells where its head will be when the frame is seen.
    fn look(&mut self, display_ns: i64) {
        let (Some(session), Some(terms)) = (&mut self.session, &self.terms) else { return };
        let Some(time) = session.clock().server_time(ClientTime(display_ns)) else { return };
        let at_s = (display_ns - self.start_ns) as f64 * 1e-9;
        let pose = |at_s: f64| terms.world_from_stage.then(self.head.pose_at(at_s));
        let (head, before) = (pose(at_s), pose(at_s - STEP_S));
        let turn: Quat = head.orientation * before.orientation.inverse();
        let step: Vec3 = head.position - before.position;
        let turn = if turn.w < 0.0 { -turn } else { turn };
        session.send_pose(HeadState {
            sequence: self.sequence,
            time,
            world_from_head: head,
            linear_velocity: step / STEP_S as f32,
            angular_velocity: turn.to_scaled_axis() / STEP_S as f32,
            eyes: self.hello.capabilities.eyes,
            discontinuity: DiscontinuityId(0),
        });
        self.sequence = self.sequence.wrapping_add(1);
    }

    fn show(&mut self, next: Option<UpdateId>, display_ns: i64) {
        let Some(session) = &mut self.session else { return };
        let Some(time) = session.clock().server_time(ClientTime(display_ns)) else { return };
        self.report.display_frames += 1;
        if let Some(frame) = next {
            self.shown = Some(frame);
            (self.report.update, self.report.display_time) = (frame, time);
        }
        if self.shown.is_none() {
            return;
        }
        session.note_shown(ClientTime(display_ns));
        let error_ns = time.0 - (display_ns - SERVER_EPOCH_NS);
        self.clock_error_ns = self.clock_error_ns.max(error_ns.abs());
        if next.is_some() || display_ns - self.reported_ns >= REPORT_NS {
            session.send_displayed(self.report);
            self.report.display_frames = 0;
            self.reported_ns = display_ns;
        }
    }
}
