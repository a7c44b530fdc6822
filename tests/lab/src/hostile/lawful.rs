//! A well-behaved client that draws nothing: it reports its head at 72 Hz and its display, and notes the arrival of pictures.
//! It reconnects after a refusal, like the real one.

use anyhow::Context;
use glam::{Quat, Vec3};
use shadecast_protocol::ids::{DiscontinuityId, UpdateId};
use shadecast_protocol::message::{Capabilities, ClientHello, Displayed, HeadState, ResumeSecret};
use shadecast_protocol::pose::{Eye, Fov, Pose};
use shadecast_protocol::session::{ClientEvent, ClientSession, Out};
use shadecast_protocol::time::ClientTime;
use shadecast_system::monotonic_now_ns;
use shadecast_transport::{
    ClientIdentity, Driver, Endpoint, EndpointConfig, Event, Events, ExpectedIdentity, Handle, IdentityError,
    PeerId, spawn,
};
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// From one display frame to the next.
const DISPLAY_PERIOD_NS: i64 = 13_888_889;
/// How far ahead of now the head's state is told.
const AHEAD_NS: i64 = 30_000_000;
/// The first wait before another attempt to connect; each is twice the one before, as in the real client.
const FIRST_BACK_OFF: Duration = Duration::from_millis(250);
/// The longest wait between two attempts.
const LONGEST_BACK_OFF: Duration = Duration::from_secs(4);

/// The eyes of a headset of 64 mm between the pupils.
pub(crate) fn eyes() -> [Eye; 2] {
    [-0.032, 0.032].map(|x| Eye {
        head_from_eye: Pose { position: Vec3::new(x, 0.0, 0.0), orientation: Quat::IDENTITY },
        fov: Fov::symmetric_degrees(90.0),
    })
}

/// What a client with a small display says first.
pub(crate) fn hello() -> ClientHello {
    let capabilities = Capabilities::most(eyes(), [128, 128], DISPLAY_PERIOD_NS);
    ClientHello::new(env!("CARGO_PKG_VERSION"), capabilities)
}

/// A head at eye height that turns slowly from side to side.
pub(crate) fn head(sequence: u32, seconds: f32) -> HeadState {
    let angle = 0.3 * seconds.sin();
    HeadState {
        sequence,
        time: shadecast_protocol::time::ServerTime(0),
        world_from_head: Pose {
            position: Vec3::new(0.0, 1.6, 0.0),
            orientation: Quat::from_rotation_y(angle),
        },
        linear_velocity: Vec3::ZERO,
        angular_velocity: Vec3::new(0.0, 0.3 * seconds.cos(), 0.0),
        eyes: eyes(),
        discontinuity: DiscontinuityId(0),
    }
}

/// What became of a lawful client.
#[derive(Clone, Debug, Default)]
pub(crate) struct Log {
    /// When each picture came.
    pub(crate) pictures: Vec<Instant>,
    /// Sessions that stood.
    pub(crate) welcomes: u32,
    /// When and why connections ended.
    pub(crate) ends: Vec<(Instant, String)>,
}

impl Log {
    /// The longest time without a picture between two instants, their ends included.
    pub(crate) fn longest_pause(&self, from: Instant, to: Instant) -> Duration {
        let mut last = from;
        let mut longest = Duration::ZERO;
        let within = self.pictures.iter().copied().filter(|at| (from..to).contains(at));
        for at in within.chain([to]) {
            longest = longest.max(at.duration_since(last));
            last = at;
        }
        longest
    }

    /// Pictures a second between two instants.
    pub(crate) fn pictures_per_s(&self, from: Instant, to: Instant) -> f64 {
        let count = self.pictures.iter().filter(|at| (from..to).contains(*at)).count();
        count as f64 / to.duration_since(from).as_secs_f64().max(1e-3)
    }

    /// Why connections ended between two instants.
    pub(crate) fn losses(&self, from: Instant, to: Instant) -> Vec<String> {
        let within = self.ends.iter().filter(|(at, _)| (from..to).contains(at));
        within.map(|(_, reason)| reason.clone()).collect()
    }

    /// The first picture at or after an instant.
    pub(crate) fn first_picture_since(&self, from: Instant) -> Option<Instant> {
        self.pictures.iter().copied().find(|at| *at >= from)
    }
}

/// What went over the wire, without framing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Recorded {
    /// A control message of the client.
    ClientControl(Vec<u8>),
    /// A datagram of the client.
    ClientDatagram(Vec<u8>),
    /// A control message of the server.
    ServerControl(Vec<u8>),
    /// A stream of the server.
    ServerStream(Vec<u8>),
    /// A datagram of the server.
    ServerDatagram(Vec<u8>),
}

impl Recorded {
    fn of(out: &Out) -> Option<Self> {
        match out {
            Out::Control(message) => Some(Self::ClientControl(message.clone())),
            Out::Datagram(bytes) => Some(Self::ClientDatagram(bytes.clone())),
            Out::Stream { .. } => None, // clients have none
        }
    }
}

/// Whose key all lawful clients have: it is on the server's list of paired devices.
///
/// # Errors
/// No certificate can be made of it.
pub(crate) fn identity() -> Result<ClientIdentity, IdentityError> {
    ClientIdentity::from_seed(0x1a)
}

/// A lawful client on threads of its own.
pub(crate) struct Lawful {
    stop: Arc<AtomicBool>,
    log: Arc<Mutex<Log>>,
    thread: Option<JoinHandle<()>>,
}

impl Lawful {
    /// Starts one, which connects at once.
    pub(crate) fn start(server: SocketAddr) -> anyhow::Result<Self> {
        Self::start_as(server, hello(), None)
    }

    /// Starts one that says this hello, and notes what goes over the wire.
    pub(crate) fn start_as(
        server: SocketAddr,
        hello: ClientHello,
        record: Option<Arc<Mutex<Vec<Recorded>>>>,
    ) -> anyhow::Result<Self> {
        let endpoint = Endpoint::client_as(Arc::new(identity()?), EndpointConfig::default());
        let driver = Driver::bind(endpoint, SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))?;
        let (handle, events) = spawn(driver)?;
        let (stop, log) = (Arc::new(AtomicBool::new(false)), Arc::new(Mutex::new(Log::default())));
        let run = Run {
            server,
            hello,
            record,
            handle,
            peer: None,
            session: None,
            secret: None,
            next_attempt: Instant::now(),
            back_off: FIRST_BACK_OFF,
            next_frame_ns: monotonic_now_ns(),
            sequence: 0,
            world_from_stage: Pose::IDENTITY,
            newest: Newest::default(),
            log: log.clone(),
        };
        let flag = stop.clone();
        let thread = std::thread::Builder::new().name("lawful".into()).spawn(move || run.run(&events, &flag));
        Ok(Self { stop, log, thread: Some(thread.context("starting a lawful client")?) })
    }

    /// What became of it so far.
    pub(crate) fn log(&self) -> Log {
        locked(&self.log).clone()
    }

    /// Waits for a picture that comes at `from` or later.
    pub(crate) fn wait_picture(&self, from: Instant, patience: Duration) -> Option<Instant> {
        let deadline = Instant::now() + patience;
        loop {
            let found = locked(&self.log).first_picture_since(from);
            if found.is_some() || Instant::now() > deadline {
                return found;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Leaves politely.
    pub(crate) fn leave(mut self) -> Log {
        self.end();
        self.log()
    }

    fn end(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join(); // its panic was reported already
        }
    }
}

impl Drop for Lawful {
    fn drop(&mut self) {
        self.end();
    }
}

fn locked(log: &Mutex<Log>) -> MutexGuard<'_, Log> {
    log.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The newest of what has come, as far as reports need it.
#[derive(Default)]
struct Newest {
    delta: Option<UpdateId>,
    picture: Option<UpdateId>,
    displayed: Option<UpdateId>,
}

struct Run {
    server: SocketAddr,
    hello: ClientHello,
    record: Option<Arc<Mutex<Vec<Recorded>>>>,
    /// Of the last welcome.
    secret: Option<ResumeSecret>,
    handle: Handle,
    peer: Option<PeerId>,
    session: Option<ClientSession>,
    next_attempt: Instant,
    back_off: Duration,
    next_frame_ns: i64,
    sequence: u32,
    world_from_stage: Pose,
    newest: Newest,
    log: Arc<Mutex<Log>>,
}

impl Run {
    fn run(mut self, events: &Events, stop: &AtomicBool) {
        while !stop.load(Ordering::Relaxed) {
            let wait_ns = (self.next_frame_ns - monotonic_now_ns()).clamp(0, DISPLAY_PERIOD_NS);
            match events.next_timeout(Duration::from_nanos(wait_ns as u64)) {
                Ok(Some(event)) => self.take(event),
                Ok(None) => {}
                Err(_) => return self.lose("the network thread has ended".into()),
            }
            self.connect();
            self.frame();
            self.flush();
        }
        if let (Some(session), Some(peer)) = (&mut self.session, self.peer) {
            session.goodbye();
            self.flush();
            let _ = self.handle.close(peer, 0, "the user left");
        }
    }

    fn note(&self, recorded: Recorded) {
        if let Some(record) = &self.record {
            record.lock().unwrap_or_else(PoisonError::into_inner).push(recorded);
        }
    }

    fn connect(&mut self) {
        if self.peer.is_some() || Instant::now() < self.next_attempt {
            return;
        }
        self.next_attempt = Instant::now() + self.back_off;
        self.back_off = (self.back_off * 2).min(LONGEST_BACK_OFF);
        self.peer = self.handle.connect(self.server, ExpectedIdentity::TrustOnFirstUse).ok();
    }

    fn take(&mut self, event: Event) {
        match event {
            Event::Connected { peer, .. } if self.peer == Some(peer) => {
                self.newest = Newest::default();
                let hello = ClientHello { resume: self.secret, ..self.hello.clone() };
                self.session = Some(ClientSession::start(hello, ClientTime(monotonic_now_ns())));
            }
            Event::Closed { peer, reason, .. } if self.peer == Some(peer) => self.lose(reason),
            Event::Control { peer, message, .. } if self.peer == Some(peer) => {
                self.note(Recorded::ServerControl(message.clone()));
                self.with_session(|session| session.on_control(&message));
            }
            Event::Stream { peer, bytes, .. } if self.peer == Some(peer) => {
                self.note(Recorded::ServerStream(bytes.clone()));
                self.with_session(|session| session.on_stream(&bytes));
            }
            Event::Datagram { peer, bytes, at_ns } if self.peer == Some(peer) => {
                self.note(Recorded::ServerDatagram(bytes.clone()));
                self.with_session(|session| session.on_datagram(&bytes, ClientTime(at_ns)));
            }
            _ => {}
        }
    }

    fn with_session(&mut self, act: impl FnOnce(&mut ClientSession)) {
        let Some(session) = &mut self.session else { return };
        act(session);
        while let Some(event) = self.session.as_mut().and_then(ClientSession::poll_event) {
            self.learn(event);
        }
    }

    fn learn(&mut self, event: ClientEvent) {
        match event {
            ClientEvent::Welcome(welcome) => {
                self.world_from_stage = welcome.world_from_stage;
                self.secret = Some(welcome.resume);
                self.back_off = FIRST_BACK_OFF;
                locked(&self.log).welcomes += 1;
            }
            ClientEvent::Delta(delta) => self.newest.delta = Some(delta.geometry.update),
            ClientEvent::Picture { header, .. } => {
                self.newest.picture = self.newest.picture.max(Some(header.update));
                locked(&self.log).pictures.push(Instant::now());
            }
            ClientEvent::Motion(_) => {}
            ClientEvent::PairingNeeded { .. } | ClientEvent::PairingAnswer { .. } => {
                self.give_up("the server asks it to be paired".into());
            }
            ClientEvent::Refused(refused) => self.give_up(refused.reason),
            ClientEvent::Goodbye => self.give_up("the server said goodbye".into()),
            ClientEvent::Silent => self.give_up("the server answers no pings".into()),
            ClientEvent::Failed(error) => self.give_up(error.to_string()),
        }
    }

    fn give_up(&mut self, reason: String) {
        if let Some(peer) = self.peer {
            let _ = self.handle.close(peer, 1, &reason);
        }
        self.lose(reason);
    }

    fn lose(&mut self, reason: String) {
        self.peer = None;
        self.session = None;
        locked(&self.log).ends.push((Instant::now(), reason));
    }

    /// One display frame: the head's state, and a report of what would be shown.
    fn frame(&mut self) {
        let now_ns = monotonic_now_ns();
        let Some(session) = &mut self.session else { return };
        session.on_tick(ClientTime(now_ns));
        if now_ns < self.next_frame_ns {
            return;
        }
        self.next_frame_ns = (self.next_frame_ns + DISPLAY_PERIOD_NS).max(now_ns);
        let Some(time) = session.clock().server_time(ClientTime(now_ns + AHEAD_NS)) else { return };
        let stage = head(self.sequence, (now_ns % 1_000_000_000_000) as f32 * 1e-9);
        let world_from_head = self.world_from_stage.then(stage.world_from_head);
        session.send_pose(HeadState { time, world_from_head, ..stage });
        self.sequence = self.sequence.wrapping_add(1);
        let shown = self.newest.picture.min(self.newest.delta);
        if shown > self.newest.displayed {
            self.newest.displayed = shown;
            let frame = shown.unwrap_or_default();
            session.send_displayed(Displayed { update: frame, display_time: time, ..Displayed::default() });
        }
    }

    fn flush(&mut self) {
        let (Some(session), Some(peer)) = (&mut self.session, self.peer) else { return };
        while let Some(out) = session.poll_out() {
            if let Some(record) = &self.record {
                record.lock().unwrap_or_else(PoisonError::into_inner).extend(Recorded::of(&out));
            }
            // What the network thread does not take is lost, as on a bad network.
            let _ = match out {
                Out::Control(bytes) => self.handle.send_control(peer, bytes),
                Out::Datagram(bytes) => self.handle.send_datagram(peer, bytes),
                Out::Stream { bytes, priority } => self.handle.send_stream(peer, bytes, priority).map(|_| ()),
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_pause_counts_the_ends_too() {
        let start = Instant::now();
        let at = |ms| start + Duration::from_millis(ms);
        let log = Log { pictures: vec![at(50), at(100), at(130), at(400)], ..Log::default() };
        let pause = |from, to| log.longest_pause(at(from), at(to)).as_millis();
        assert_eq!(pause(100, 401), 270, "between two pictures");
        assert_eq!(pause(0, 120), 50, "before the first");
        assert_eq!(pause(60, 1000), 600, "after the last");
        assert_eq!(pause(500, 800), 300, "without any");
        assert_eq!(log.first_picture_since(at(101)), Some(at(130)));
        assert_eq!(log.first_picture_since(at(401)), None);
    }
}
