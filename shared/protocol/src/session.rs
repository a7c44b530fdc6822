//! The two ends of a session as state machines without I/O: bytes and time go in, bytes and events come out.
//!
//! Whoever drives them carries three kinds of messages: control messages each way (in order, each whole),
//! unidirectional streams from the server (each whole), and datagrams (lossy). What they do not know is framing, sockets,
//! QUIC, clocks, pictures and GPUs.
//!
//! An error ends a session: after [`ClientEvent::Failed`] or [`ServerEvent::Failed`] nothing more comes out.

use crate::clock::ClockEstimator;
use crate::delta::{DeltaDecoder, EncodedDelta, ReceivedDelta};
use crate::ids::UpdateId;
use crate::limits::{
    MAX_ACCESS_UNIT_BYTES, MAX_FRAMES_AHEAD, MAX_QUEUED_STREAM_BYTES, MAX_QUEUED_STREAMS,
    RECORDS_PER_SLOT_AND_TURN,
};
use crate::message::{
    ClientDatagram, ClientHello, ClientMessage, Codec, Displayed, HeadState, HelloVersions, MotionMemory,
    Refused, ServerDatagram, ServerMessage, ServerOffer, Welcome, negotiate, negotiate_version,
};
use crate::motion::message::{MotionMessage, MotionNews};
use crate::time::{ClientTime, ServerTime};
use crate::wire::{
    DeltaHead, PictureHeader, StreamMessage, WireError, check_count, encode_geometry, encode_motion,
    encode_picture, invalid, parse_stream,
};
use crate::world_clock::{Steer, Steering};
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

/// Pings: every display frame in the first seconds, then 40 a second. A clock that is off by 1 ms puts a fast wing 0.3 % of its
/// range off its place, and the envelope of jitter is only as good as it is often sampled.
const QUICK_PINGS: u32 = 500;
/// What a message about motion takes while it waits, beside its bytes.
const MOTION_OVERHEAD_BYTES: usize = 64;
/// What may be taken in of them at once where there is no arena: each counts for a word at least.
const LEAST_MOTION_WORDS: u32 = 64;
const QUICK_PING_NS: i64 = 10_000_000;
const PING_NS: i64 = 25_000_000;
/// Pings that wait for their answer, on a server whose driver is late; the oldest are dropped.
const MAX_WAITING_PINGS: usize = 16;
/// Pings whose answers are awaited: those of more than two seconds.
const MAX_OUTSTANDING_PINGS: usize = 256;

/// Bytes to be carried to the other end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Out {
    /// One message for the control stream, without framing.
    Control(Vec<u8>),
    /// Send as one unidirectional stream, then finish it.
    Stream {
        /// All of the stream.
        bytes: Vec<u8>,
        /// Higher goes first.
        priority: i32,
    },
    /// Send unreliably.
    Datagram(Vec<u8>),
}

impl Out {
    /// Bytes of what is sent.
    pub fn bytes(&self) -> usize {
        match self {
            Self::Control(bytes) | Self::Datagram(bytes) | Self::Stream { bytes, .. } => bytes.len(),
        }
    }
}

/// What a client learns.
#[derive(Clone, Debug, PartialEq)]
pub enum ClientEvent {
    /// The session stands.
    Welcome(Welcome),
    /// There will be no session.
    Refused(Refused),
    /// The next delta, in order of frames.
    Delta(ReceivedDelta),
    /// News of motion, in order of arrival.
    Motion(MotionMessage),
    /// A picture, in order of arrival.
    Picture {
        /// Which one.
        header: PictureHeader,
        /// Its bytes for the decoder.
        access_unit: Vec<u8>,
    },
    /// The server ends the session.
    Goodbye,
    /// The server said what makes no sense: drop the connection, then connect anew.
    Failed(WireError),
}

/// What a server learns.
#[derive(Clone, Debug, PartialEq)]
pub enum ServerEvent {
    /// A client asks for a session: answer by [`ServerSession::accept`] or [`ServerSession::refuse`].
    Asked {
        /// Who is there.
        hello: ClientHello,
        /// Under which terms the session would stand.
        welcome: Box<Welcome>,
    },
    /// There will be no session; the client has been told why. Flush, then close.
    Refused(Refused),
    /// The newest head state; older ones that come late are left out.
    Pose(HeadState),
    /// What the client shows: of several reports the latest, with the counts of all.
    Displayed(Displayed),
    /// The client needs a picture that needs no other.
    RefreshRequest {
        /// The last frame whose picture decoded, if any.
        after: Option<UpdateId>,
    },
    /// Whether somebody looks; before it is said, somebody does.
    Watching(bool),
    /// Somebody wants the world to stand, or to go on.
    Steer(Steering),
    /// The user left.
    Goodbye,
    /// The client said what makes no sense: drop the connection.
    Failed(WireError),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// Hello sent, or awaited.
    Greeting,
    Running,
    Ended,
}

/// The client's end.
#[derive(Debug)]
pub struct ClientSession {
    phase: Phase,
    /// What was announced.
    codecs: Vec<Codec>,
    motion: MotionMemory,
    clock: ClockEstimator,
    pings: u32,
    next_ping: ClientTime,
    /// When the pings left that have not been answered, in order.
    outstanding: VecDeque<ClientTime>,
    decoder: Option<DeltaDecoder>,
    next_delta: u32,
    /// The last update's delta that was handed on, and one more.
    next_update: UpdateId,
    waiting: Waiting,
    /// What may still be decoded before the next [`Self::on_tick`].
    records_left: usize,
    records_per_turn: usize,
    /// Words of the arena that news of motion may still fill before the next [`Self::on_tick`]; all that it has.
    motion_words_left: u32,
    motion_words: u32,
    is_held_back: bool,
    out: VecDeque<Out>,
    events: VecDeque<ClientEvent>,
}

/// Streams that cannot be handed on yet.
#[derive(Debug, Default)]
struct Waiting {
    /// By sequence.
    deltas: BTreeMap<u32, Vec<u8>>,
    /// Pictures that came before the welcome.
    pictures: Vec<(PictureHeader, Vec<u8>)>,
    /// Messages about motion that did, or that are more than can be taken in at once.
    motion: VecDeque<Vec<u8>>,
    bytes: usize,
}

impl Waiting {
    const WHAT: &str = "the queue of streams that wait for an earlier delta";

    fn admit(&mut self, bytes: usize) -> Result<(), WireError> {
        let streams = self.deltas.len() + self.pictures.len() + 1;
        check_count(Self::WHAT, streams, MAX_QUEUED_STREAMS)?;
        self.admit_bytes(bytes)
    }

    /// News of motion are many and small: their bytes count alone.
    fn admit_motion(&mut self, message: &[u8]) -> Result<(), WireError> {
        self.admit_bytes(message.len() + MOTION_OVERHEAD_BYTES)?;
        self.motion.push_back(message.to_vec());
        Ok(())
    }

    fn next_motion(&mut self) -> Option<Vec<u8>> {
        let message = self.motion.pop_front()?;
        self.bytes -= message.len() + MOTION_OVERHEAD_BYTES;
        Some(message)
    }

    fn admit_bytes(&mut self, bytes: usize) -> Result<(), WireError> {
        self.bytes = check_count(Self::WHAT, self.bytes + bytes, MAX_QUEUED_STREAM_BYTES)?;
        Ok(())
    }
}

impl ClientSession {
    /// Begins a session: the hello is ready to go out, and the first ping with it, so that the clocks agree when the welcome
    /// comes.
    pub fn start(hello: ClientHello, now: ClientTime) -> Self {
        let mut session = Self {
            phase: Phase::Greeting,
            codecs: hello.capabilities.codecs.clone(),
            motion: hello.capabilities.motion,
            clock: ClockEstimator::new(),
            pings: 0,
            next_ping: now,
            outstanding: VecDeque::new(),
            decoder: None,
            next_delta: 0,
            next_update: UpdateId(0),
            waiting: Waiting::default(),
            records_left: 0,
            records_per_turn: 0,
            motion_words_left: 0,
            motion_words: 0,
            is_held_back: false,
            out: VecDeque::new(),
            events: VecDeque::new(),
        };
        session.say(&ClientMessage::Hello(hello));
        session.on_tick(now);
        session
    }

    /// Takes one message of the server's control stream.
    pub fn on_control(&mut self, message: &[u8]) {
        let result = self.try_control(message);
        self.end_on_error(result);
    }

    /// Takes one whole unidirectional stream.
    pub fn on_stream(&mut self, bytes: &[u8]) {
        let result = self.try_stream(bytes);
        self.end_on_error(result);
    }

    /// Takes a datagram that came at `now`. Damaged ones are dropped: they carry nothing that is not sent again. So are
    /// answers to what was not asked, or that come a second time.
    pub fn on_datagram(&mut self, bytes: &[u8], now: ClientTime) {
        if self.phase == Phase::Ended {
            return;
        }
        match ServerDatagram::decode(bytes) {
            Ok(ServerDatagram::ClockPong { client_send, server_receive, server_send }) => {
                if let Ok(place) = self.outstanding.binary_search(&client_send) {
                    self.outstanding.remove(place);
                    self.clock.note_pong(client_send, server_receive, server_send, now);
                }
            }
            Ok(ServerDatagram::ClockStamp { server_send }) => self.clock.note_stamp(server_send, now),
            Err(_) => {}
        }
    }

    /// Does what is due at `now`, once a display frame: follows the clock, hands on what has waited, pings.
    pub fn on_tick(&mut self, now: ClientTime) {
        if self.phase == Phase::Ended {
            return;
        }
        self.clock.settle();
        self.records_left = if self.is_held_back { 0 } else { self.records_per_turn };
        if !self.is_held_back {
            self.motion_words_left = self.motion_words;
        }
        let result = self.hand_on_motion().and_then(|()| self.hand_on_deltas());
        self.end_on_error(result);
        if self.phase != Phase::Ended && now >= self.next_ping {
            self.ping(now);
        }
    }

    fn ping(&mut self, now: ClientTime) {
        if self.outstanding.len() == MAX_OUTSTANDING_PINGS {
            self.outstanding.pop_front();
        }
        self.outstanding.push_back(now);
        self.pings = self.pings.saturating_add(1);
        let period_ns = if self.pings < QUICK_PINGS { QUICK_PING_NS } else { PING_NS };
        self.next_ping = now.plus_ns(period_ns);
        self.out.push_back(Out::Datagram(ClientDatagram::ClockPing { client_send: now }.encode()));
    }

    /// While it is true, deltas wait undecoded: what came of the last ones has yet to be taken in.
    pub fn hold_back(&mut self, is_held_back: bool) {
        self.is_held_back = is_held_back;
    }

    /// Bytes of the streams that wait.
    pub fn waiting_bytes(&self) -> usize {
        self.waiting.bytes
    }

    /// Ends the session, because what the server said contradicts what is on display.
    pub fn fail(&mut self, error: WireError) {
        if self.phase != Phase::Ended {
            self.end_on_error(Err(error));
        }
    }

    /// When [`Self::on_tick`] next has something to do.
    pub fn next_tick(&self) -> Option<ClientTime> {
        (self.phase != Phase::Ended).then_some(self.next_ping)
    }

    /// Sends the head's state.
    pub fn send_pose(&mut self, head: HeadState) {
        if self.phase == Phase::Running {
            self.out.push_back(Out::Datagram(ClientDatagram::Pose(head).encode()));
        }
    }

    /// Reports what is on display.
    pub fn send_displayed(&mut self, displayed: Displayed) {
        if self.phase == Phase::Running {
            self.say(&ClientMessage::Displayed(displayed));
        }
    }

    /// Asks for a picture that needs no other.
    pub fn request_refresh(&mut self, after: Option<UpdateId>) {
        if self.phase == Phase::Running {
            self.say(&ClientMessage::RefreshRequest { after });
        }
    }

    /// Tells whether somebody looks.
    pub fn tell_watching(&mut self, is_watched: bool) {
        if self.phase == Phase::Running {
            self.say(&ClientMessage::Watching { is_watched });
        }
    }

    /// Asks for the world to stand, or to go on.
    pub fn steer(&mut self, steer: Steer) {
        if self.phase == Phase::Running {
            self.say(&ClientMessage::Steer(steer));
        }
    }

    /// Takes leave; nothing comes out after it.
    pub fn goodbye(&mut self) {
        if self.phase != Phase::Ended {
            self.say(&ClientMessage::Goodbye);
            self.phase = Phase::Ended;
        }
    }

    /// The next thing that happened.
    pub fn poll_event(&mut self) -> Option<ClientEvent> {
        self.events.pop_front()
    }

    /// The next bytes to carry.
    pub fn poll_out(&mut self) -> Option<Out> {
        self.out.pop_front()
    }

    /// The estimate of the server's clock.
    pub fn clock(&self) -> &ClockEstimator {
        &self.clock
    }

    /// Notes that a display frame that is seen at `at` shows what this session brought; see [`crate::clock::ShownClock::show`].
    pub fn note_shown(&mut self, at: ClientTime) {
        self.clock.show(at);
    }

    /// True until the session is refused, failed or left.
    pub fn is_alive(&self) -> bool {
        self.phase != Phase::Ended
    }

    fn say(&mut self, message: &ClientMessage) {
        self.out.push_back(Out::Control(message.encode()));
    }

    fn end_on_error(&mut self, result: Result<(), WireError>) {
        if let Err(error) = result {
            self.phase = Phase::Ended;
            self.waiting = Waiting::default();
            self.events.push_back(ClientEvent::Failed(error));
        }
    }

    fn try_control(&mut self, message: &[u8]) -> Result<(), WireError> {
        if self.phase == Phase::Ended {
            return Ok(());
        }
        match (ServerMessage::decode(message)?, self.phase) {
            (ServerMessage::Welcome(welcome), Phase::Greeting) => self.begin(welcome)?,
            (ServerMessage::Welcome(_), _) => return Err(invalid("a welcome", "it comes a second time")),
            (ServerMessage::Refused(refused), _) => self.end_with(ClientEvent::Refused(refused)),
            (ServerMessage::Goodbye, _) => self.end_with(ClientEvent::Goodbye),
        }
        Ok(())
    }

    fn end_with(&mut self, event: ClientEvent) {
        self.phase = Phase::Ended;
        self.waiting = Waiting::default();
        self.events.push_back(event);
    }

    /// The welcome is here: streams that overtook it can be handed on.
    fn begin(&mut self, welcome: Welcome) -> Result<(), WireError> {
        if !self.codecs.contains(&welcome.codec) {
            let reason = format!("its codec {:?} was not announced", welcome.codec);
            return Err(invalid("a welcome", reason));
        }
        if !self.motion.holds(welcome.motion) {
            let reason = format!("it says {:?}, and {:?} was announced", welcome.motion, self.motion);
            return Err(invalid("the memory of motion of a welcome", reason));
        }
        self.phase = Phase::Running;
        let decoder = DeltaDecoder::new(welcome.vertex_slots, welcome.patch_slots);
        self.decoder = Some(decoder.with_motion(welcome.motion));
        self.records_per_turn = (welcome.vertex_slots * RECORDS_PER_SLOT_AND_TURN) as usize;
        self.records_left = self.records_per_turn;
        // News of the world's time come without an arena, too.
        self.motion_words = welcome.motion.arena_words.max(LEAST_MOTION_WORDS);
        self.events.push_back(ClientEvent::Welcome(welcome));
        for (header, access_unit) in std::mem::take(&mut self.waiting.pictures) {
            self.waiting.bytes -= access_unit.len();
            self.events.push_back(ClientEvent::Picture { header, access_unit });
        }
        self.motion_words_left = self.motion_words;
        self.hand_on_motion()?;
        self.hand_on_deltas()
    }

    fn take_motion(&mut self, message: &[u8]) -> Result<(), WireError> {
        self.waiting.admit_motion(message)?;
        self.hand_on_motion()
    }

    /// In order of arrival, as many words of the arena as there are, until the next tick.
    fn hand_on_motion(&mut self) -> Result<(), WireError> {
        while self.phase == Phase::Running && self.motion_words_left > 0 {
            let Some(message) = self.waiting.next_motion() else { break };
            let message = MotionMessage::decode(&message)?;
            // A schedule takes place too, until it is taken in.
            let mut words = 1;
            if let (MotionNews::Chunk(chunk), Some(decoder)) = (&message.news, &self.decoder) {
                decoder.memory().check_chunk(chunk)?;
                words = chunk.words().max(1);
            }
            self.motion_words_left = self.motion_words_left.saturating_sub(words);
            self.events.push_back(ClientEvent::Motion(message));
        }
        Ok(())
    }

    fn try_stream(&mut self, bytes: &[u8]) -> Result<(), WireError> {
        if self.phase == Phase::Ended {
            return Ok(());
        }
        match parse_stream(bytes)? {
            StreamMessage::Picture { header, access_unit } => self.take_picture(header, access_unit),
            StreamMessage::Motion(message) => self.take_motion(message),
            StreamMessage::Geometry { head, payload } => self.take_geometry(head, payload),
        }
    }

    fn take_picture(&mut self, header: PictureHeader, access_unit: &[u8]) -> Result<(), WireError> {
        self.check_distance("a picture", header.update)?;
        if self.phase == Phase::Running {
            self.events.push_back(ClientEvent::Picture { header, access_unit: access_unit.to_vec() });
            return Ok(());
        }
        self.waiting.admit(access_unit.len())?;
        self.waiting.pictures.push((header, access_unit.to_vec()));
        Ok(())
    }

    fn take_geometry(&mut self, head: DeltaHead, payload: &[u8]) -> Result<(), WireError> {
        let DeltaHead { sequence, .. } = head;
        if sequence < self.next_delta || self.waiting.deltas.contains_key(&sequence) {
            return Err(invalid("a geometry delta", format!("number {sequence} comes a second time")));
        }
        if sequence > self.next_delta.saturating_add(MAX_FRAMES_AHEAD) {
            let reason = format!("number {sequence} is too far after {}, the next due", self.next_delta);
            return Err(invalid("a geometry delta", reason));
        }
        if sequence == self.next_delta && self.decoder.is_some() && self.records_left > 0 {
            self.hand_on(payload)?;
            return self.hand_on_deltas();
        }
        self.waiting.admit(payload.len())?;
        self.waiting.deltas.insert(sequence, payload.to_vec());
        Ok(())
    }

    /// Refuses a frame that is too far after the next one due.
    fn check_distance(&self, what: &'static str, update: UpdateId) -> Result<(), WireError> {
        match update.is_too_far_after(self.next_update) {
            true => Err(invalid(
                what,
                format!(
                    "its frame {} is more than {MAX_FRAMES_AHEAD} after frame {}, which is the next due",
                    update.0, self.next_update.0
                ),
            )),
            false => Ok(()),
        }
    }

    /// Hands on the waiting deltas whose turn it is, as far as what may be decoded now reaches.
    fn hand_on_deltas(&mut self) -> Result<(), WireError> {
        while self.records_left > 0
            && let Some(payload) = self.waiting.deltas.remove(&self.next_delta)
        {
            self.waiting.bytes -= payload.len();
            self.hand_on(&payload)?;
        }
        Ok(())
    }

    fn hand_on(&mut self, payload: &[u8]) -> Result<(), WireError> {
        if let Some(decoder) = &mut self.decoder {
            let delta = decoder.receive(payload)?;
            self.records_left = self.records_left.saturating_sub(delta.records());
            self.next_delta = self.next_delta.saturating_add(1);
            if delta.is_update {
                if delta.geometry.update != self.next_update {
                    let reason =
                        format!("{} comes instead of {}", delta.geometry.update.0, self.next_update.0);
                    return Err(invalid("the update of a geometry delta", reason));
                }
                self.next_update = self.next_update.next();
            }
            self.events.push_back(ClientEvent::Delta(delta));
        }
        Ok(())
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ServerPhase {
    /// The hello is awaited.
    Greeting,
    /// It has come, and waits for an answer.
    Asked,
    Running,
    Ended,
}

/// The server's end, for one client: what is heard and what is said beside updates. What it hears faster than it is asked
/// for coalesces, so that its size does not depend on the client.
#[derive(Debug)]
pub struct ServerSession {
    phase: ServerPhase,
    offer: ServerOffer,
    /// The terms that wait for an answer.
    asked: Option<Welcome>,
    /// Deltas sent, counted by the sending half.
    sent: Arc<AtomicU32>,
    understood: u64,
    newest_pose: Option<u32>,
    /// Pings to be answered: what they say, and when they came.
    pings: VecDeque<(ClientTime, ServerTime)>,
    control: VecDeque<Out>,
    heard: Heard,
}

/// What waits to be asked for, at most one of a kind.
#[derive(Debug, Default)]
struct Heard {
    asked: Option<(ClientHello, Welcome)>,
    displayed: Option<Displayed>,
    refresh: Option<Option<UpdateId>>,
    watching: Option<bool>,
    steering: Option<Steering>,
    pose: Option<HeadState>,
    end: Option<ServerEvent>,
}

/// The sending half of a session, for whoever makes the updates: making them holds up nobody who listens.
#[derive(Debug)]
pub struct DeltaSender {
    sent: Arc<AtomicU32>,
}

impl DeltaSender {
    /// The stream of an update's delta. The client may report its display from now on.
    pub fn stream(&mut self, delta: &EncodedDelta) -> Out {
        let update = delta.update.expect("the delta of an update");
        assert_eq!(update, self.next_update(), "deltas go out in the order of updates, without a gap");
        self.sent.store(update.next().0, Ordering::Release);
        Out::Stream { bytes: encode_geometry(&delta.bytes), priority: priority(update, 1) }
    }

    /// The update that the next delta must have.
    pub fn next_update(&self) -> UpdateId {
        UpdateId(self.sent.load(Ordering::Acquire))
    }
}

/// What goes right before an update's first stream, at `now`: what leaves before so much waits for none of it.
pub fn clock_stamp(now: ServerTime) -> Out {
    Out::Datagram(ServerDatagram::ClockStamp { server_send: now }.encode())
}

/// The stream of samples between two updates: they go before all updates.
pub fn sample_stream(delta: &EncodedDelta) -> Out {
    Out::Stream { bytes: encode_geometry(&delta.bytes), priority: i32::MAX }
}

/// The stream of a coded picture.
///
/// # Errors
/// The picture is larger than the wire allows.
pub fn picture_stream(header: PictureHeader, access_unit: &[u8]) -> Result<Out, WireError> {
    check_count("an access unit's length in bytes", access_unit.len(), MAX_ACCESS_UNIT_BYTES)?;
    Ok(Out::Stream { bytes: encode_picture(header, access_unit), priority: priority(header.update, 0) })
}

/// The stream of a message about motion: it goes right after the streams of an update, or after all updates where there is none.
pub fn motion_stream(message: &MotionMessage, after: Option<UpdateId>) -> Out {
    let priority = after.map_or(i32::MIN, |update| priority(update, 0) - 1);
    Out::Stream { bytes: encode_motion(&message.encode()), priority }
}

/// An update's streams go before those of later ones, so that no flood of geometry starves pictures; within an update
/// `urgency` 1 goes before 0.
fn priority(update: UpdateId, urgency: i64) -> i32 {
    let order = i64::from(i32::MAX) - 2 * (i64::from(update.0) + 1) + urgency;
    i32::try_from(order).unwrap_or(i32::MIN) // after a year at 30 updates a second
}

impl ServerSession {
    /// Waits for a client's hello.
    pub fn new(offer: ServerOffer) -> Self {
        Self {
            phase: ServerPhase::Greeting,
            offer,
            asked: None,
            sent: Arc::default(),
            understood: 0,
            newest_pose: None,
            pings: VecDeque::new(),
            control: VecDeque::new(),
            heard: Heard::default(),
        }
    }

    /// Takes one message of the client's control stream.
    pub fn on_control(&mut self, message: &[u8]) {
        match self.try_control(message) {
            Ok(()) => self.understood += 1,
            Err(error) => self.end_with(ServerEvent::Failed(error)),
        }
    }

    /// Takes a datagram that came at `now`. Damaged ones are dropped: they carry nothing that is not sent again. Pings are
    /// answered before the hello, too, so that the clocks agree a round trip earlier.
    pub fn on_datagram(&mut self, bytes: &[u8], now: ServerTime) {
        if self.phase == ServerPhase::Ended {
            return;
        }
        let Ok(datagram) = ClientDatagram::decode(bytes) else { return };
        self.understood += 1;
        match datagram {
            ClientDatagram::Pose(head) if self.phase == ServerPhase::Running => self.take_pose(head),
            ClientDatagram::Pose(_) => {}
            ClientDatagram::ClockPing { client_send } => {
                self.pings.push_back((client_send, now));
                if self.pings.len() > MAX_WAITING_PINGS {
                    self.pings.pop_front();
                }
            }
        }
    }

    /// Says yes to the client that [`ServerEvent::Asked`]: the session stands. Gives its sending half; `None` where nobody
    /// asks any more.
    pub fn accept(&mut self) -> Option<DeltaSender> {
        let welcome = self.asked.take()?;
        self.phase = ServerPhase::Running;
        let sender = DeltaSender { sent: self.sent.clone() };
        self.say(&ServerMessage::Welcome(welcome));
        Some(sender)
    }

    /// Tells the client that there is no session, or no longer one, and why; nothing is heard after it. Flush, then close.
    pub fn refuse(&mut self, refused: Refused) {
        if self.phase != ServerPhase::Ended {
            self.say(&ServerMessage::Refused(refused));
            self.phase = ServerPhase::Ended;
        }
    }

    /// Ends the session; nothing comes out after it.
    pub fn goodbye(&mut self) {
        if self.phase != ServerPhase::Ended {
            self.say(&ServerMessage::Goodbye);
            self.phase = ServerPhase::Ended;
        }
    }

    /// The next thing that happened.
    pub fn poll_event(&mut self) -> Option<ServerEvent> {
        let heard = &mut self.heard;
        if let Some((hello, welcome)) = heard.asked.take() {
            return Some(ServerEvent::Asked { hello, welcome: Box::new(welcome) });
        }
        let displayed = heard.displayed.take().map(ServerEvent::Displayed);
        let refresh = || heard.refresh.take().map(|after| ServerEvent::RefreshRequest { after });
        let watching = || heard.watching.take().map(ServerEvent::Watching);
        let steering = || heard.steering.take().map(ServerEvent::Steer);
        let event = displayed.or_else(refresh).or_else(watching).or_else(steering);
        event.or_else(|| heard.pose.take().map(ServerEvent::Pose)).or_else(|| heard.end.take())
    }

    /// The next bytes to carry. They are sent at `now`, which answers to pings say.
    pub fn poll_out(&mut self, now: ServerTime) -> Option<Out> {
        let Some((client_send, server_receive)) = self.pings.pop_front() else {
            return self.control.pop_front();
        };
        let pong = ServerDatagram::ClockPong { client_send, server_receive, server_send: now };
        Some(Out::Datagram(pong.encode()))
    }

    /// True until the session is refused, failed or left.
    pub fn is_alive(&self) -> bool {
        self.phase != ServerPhase::Ended
    }

    /// Messages and datagrams that made sense so far: a sign of life that noise does not give.
    pub fn understood(&self) -> u64 {
        self.understood
    }

    fn say(&mut self, message: &ServerMessage) {
        self.control.push_back(Out::Control(message.encode()));
    }

    fn end_with(&mut self, event: ServerEvent) {
        self.phase = ServerPhase::Ended;
        self.heard.asked = None;
        self.heard.end = Some(event);
    }

    fn try_control(&mut self, message: &[u8]) -> Result<(), WireError> {
        match self.phase {
            ServerPhase::Greeting => self.greet(message),
            ServerPhase::Asked | ServerPhase::Running => self.hear(ClientMessage::decode(message)?),
            ServerPhase::Ended => Ok(()),
        }
    }

    /// Judges the versions first: a hello of another version need not be readable beyond them.
    fn greet(&mut self, bytes: &[u8]) -> Result<(), WireError> {
        let Some(HelloVersions { protocol_version, min_protocol_version, app_version }) =
            ClientMessage::peek_versions(bytes)
        else {
            return Err(invalid("a client's first message", "it is not a hello"));
        };
        let version = negotiate_version(protocol_version, min_protocol_version, &app_version, &self.offer);
        let terms = version.and_then(|_| match ClientMessage::decode(bytes) {
            Ok(ClientMessage::Hello(hello)) => negotiate(&hello, &self.offer).map(|welcome| (hello, welcome)),
            Ok(_) => Err(Refused::new("the client's first message is not a hello", HELLO_REMEDY)),
            Err(error) => Err(Refused::new(&error.to_string(), HELLO_REMEDY)),
        });
        match terms {
            Ok((hello, welcome)) => self.ask(hello, welcome),
            Err(refused) => self.turn_away(refused),
        }
        Ok(())
    }

    fn ask(&mut self, hello: ClientHello, welcome: Welcome) {
        self.phase = ServerPhase::Asked;
        self.asked = Some(welcome.clone());
        self.heard.asked = Some((hello, welcome));
    }

    fn turn_away(&mut self, refused: Refused) {
        self.say(&ServerMessage::Refused(refused.clone()));
        self.end_with(ServerEvent::Refused(refused));
    }

    fn hear(&mut self, message: ClientMessage) -> Result<(), WireError> {
        match message {
            ClientMessage::Hello(_) => return Err(invalid("a hello", "it comes a second time")),
            ClientMessage::Displayed(displayed) => {
                if displayed.update.0 >= self.sent.load(Ordering::Acquire) {
                    let reason = format!("frame {} has not been sent", displayed.update.0);
                    return Err(invalid("a report of what is on display", reason));
                }
                let earlier = self.heard.displayed.take();
                self.heard.displayed = Some(earlier.map_or(displayed, |earlier| earlier.merged(displayed)));
            }
            ClientMessage::RefreshRequest { after } => self.heard.refresh = Some(after),
            ClientMessage::Watching { is_watched } => self.heard.watching = Some(is_watched),
            ClientMessage::Steer(steer) => {
                let earlier = self.heard.steering.unwrap_or_default();
                self.heard.steering = Some(earlier.then(steer.into()));
            }
            ClientMessage::Goodbye => self.end_with(ServerEvent::Goodbye),
        }
        Ok(())
    }

    fn take_pose(&mut self, head: HeadState) {
        // Half of the circle of sequence numbers lies before the newest.
        let is_newer = self.newest_pose.is_none_or(|newest| head.sequence.wrapping_sub(newest) as i32 > 0);
        if is_newer {
            self.newest_pose = Some(head.sequence);
            self.heard.pose = Some(head);
        }
    }
}

/// What to do about a hello that makes no sense.
const HELLO_REMEDY: &str = "update client and server to the same version";

#[cfg(test)]
mod tests {
    use super::*;
    use crate::delta::{Delta, DeltaEncoder};
    use crate::geometry::{GeometryDelta, Motion, NewVertex};
    use crate::ids::ClipId;
    use crate::ids::{InstanceId, VertexSlot};
    use crate::limits::MAX_DELTA_BYTES;
    use crate::motion::clip::ClipChunk;
    use crate::motion::keys::{ChunkTrack, TrackKind};
    use crate::testing::{Dice, damaged, displayed, head, hello, offer};

    /// Both ends, with what the client has been sent and has not yet been given.
    struct Pair {
        client: ClientSession,
        server: ServerSession,
        /// The server's sending half, once it has said yes.
        sender: Option<DeltaSender>,
        streams: Vec<Vec<u8>>,
    }

    const NOW: ClientTime = ClientTime(1_000);

    /// A delta that says nothing.
    fn encoded(update: UpdateId) -> EncodedDelta {
        let encoder = DeltaEncoder::new(1, 1);
        encoder.from_delta(update.0).encode(&GeometryDelta { update, ..Default::default() }.into())
    }

    impl Pair {
        fn new() -> Self {
            Self {
                client: ClientSession::start(hello(), NOW),
                server: ServerSession::new(offer()),
                sender: None,
                streams: Vec::new(),
            }
        }

        fn connected() -> Self {
            let mut pair = Self::new();
            pair.carry(ServerTime(0));
            pair.accept();
            pair.carry(ServerTime(0));
            assert!(matches!(pair.client.poll_event(), Some(ClientEvent::Welcome(_))));
            pair
        }

        #[track_caller]
        fn accept(&mut self) {
            assert!(matches!(self.server.poll_event(), Some(ServerEvent::Asked { .. })));
            self.sender = self.server.accept();
        }

        /// Carries control messages and datagrams both ways until none are left; keeps streams back.
        fn carry(&mut self, now: ServerTime) {
            loop {
                if let Some(out) = self.client.poll_out() {
                    match out {
                        Out::Control(bytes) => self.server.on_control(&bytes),
                        Out::Datagram(bytes) => self.server.on_datagram(&bytes, now),
                        Out::Stream { .. } => panic!("a client sends no streams"),
                    }
                } else if let Some(out) = self.server.poll_out(now) {
                    match out {
                        Out::Control(bytes) => self.client.on_control(&bytes),
                        Out::Datagram(bytes) => self.client.on_datagram(&bytes, NOW),
                        Out::Stream { bytes, .. } => self.streams.push(bytes),
                    }
                } else {
                    return;
                }
            }
        }

        fn send_delta(&mut self) {
            let sender = self.sender.as_mut().unwrap();
            let out = sender.stream(&encoded(sender.next_update()));
            self.keep(out);
        }

        fn send_picture(&mut self, frame: u32) {
            let out = picture_stream(picture(frame), b"coded").unwrap();
            self.keep(out);
        }

        fn keep(&mut self, out: Out) {
            let Out::Stream { bytes, .. } = out else { panic!("{out:?}") };
            self.streams.push(bytes);
        }

        fn client_events(&mut self) -> Vec<ClientEvent> {
            std::iter::from_fn(|| self.client.poll_event()).collect()
        }
    }

    fn picture(frame: u32) -> PictureHeader {
        PictureHeader { update: UpdateId(frame), time: ServerTime(1), is_refresh: frame == 0 }
    }

    #[test]
    fn deltas_come_out_in_order_however_their_streams_arrive() {
        for seed in 0..50 {
            let (mut pair, mut dice) = (Pair::connected(), Dice::new(seed));
            (0..40).for_each(|_| pair.send_delta());
            pair.carry(ServerTime(0));
            while !pair.streams.is_empty() {
                let next = dice.below(pair.streams.len() as u64) as usize;
                pair.client.on_stream(&pair.streams.swap_remove(next));
            }
            let frames: Vec<_> = pair
                .client_events()
                .into_iter()
                .map(|event| match event {
                    ClientEvent::Delta(delta) => delta.geometry.update.0,
                    other => panic!("seed {seed}: {other:?}"),
                })
                .collect();
            assert_eq!(frames, (0..40).collect::<Vec<_>>(), "seed {seed}");
            assert_eq!(pair.client.waiting.bytes, 0);
        }
    }

    #[test]
    fn pictures_come_out_at_once_though_a_delta_is_late() {
        let mut pair = Pair::connected();
        pair.send_delta();
        pair.send_picture(0);
        pair.carry(ServerTime(0));
        pair.client.on_stream(&pair.streams[1]);
        let expected = ClientEvent::Picture { header: picture(0), access_unit: b"coded".to_vec() };
        assert_eq!(pair.client_events(), [expected]);
    }

    #[test]
    fn streams_that_overtake_the_welcome_wait_for_it() {
        let mut pair = Pair::new();
        let Some(Out::Control(hello)) = pair.client.poll_out() else { panic!("no hello") };
        pair.server.on_control(&hello);
        pair.accept();
        let Some(Out::Control(welcome)) = pair.server.poll_out(ServerTime(0)) else { panic!("no welcome") };
        pair.send_delta();
        pair.send_picture(0);
        pair.carry(ServerTime(0));
        pair.streams.clone().iter().for_each(|stream| pair.client.on_stream(stream));
        assert_eq!(pair.client_events(), []);
        pair.client.on_control(&welcome);
        let events = pair.client_events();
        assert!(matches!(events[0], ClientEvent::Welcome(_)), "{events:?}");
        assert_eq!(events.len(), 3);
        assert_eq!(pair.client.waiting.bytes, 0);
    }

    #[test]
    fn a_mismatch_of_versions_tells_the_user_what_to_update() {
        let mut pair = Pair::new();
        pair.server.offer.protocol_version = 8;
        pair.server.offer.min_protocol_version = 7;
        pair.carry(ServerTime(0));
        let events = pair.client_events();
        let [ClientEvent::Refused(refused)] = &events[..] else { panic!("{events:?}") };
        assert_eq!(refused.remedy, "update the client to one that speaks protocol 7");
        assert!(!pair.client.is_alive() && !pair.server.is_alive());
    }

    #[test]
    fn a_hello_of_the_far_future_is_refused_by_its_versions_alone() {
        let mut server = ServerSession::new(offer());
        let hello = [vec![0, 40, 39, 3], b"9.0".to_vec(), vec![0xee; 30]].concat();
        server.on_control(&hello);
        let Some(ServerEvent::Refused(refused)) = server.poll_event() else { panic!("not refused") };
        assert_eq!(refused.remedy, "update the server to one that speaks protocol 39");
    }

    #[test]
    fn pings_make_the_clocks_agree() {
        let mut pair = Pair::connected();
        let later = NOW.plus_ns(QUICK_PING_NS);
        assert_eq!(pair.client.next_tick(), Some(later));
        pair.client.on_tick(NOW.plus_ns(1));
        assert_eq!(pair.client.poll_out(), None, "not yet due");
        pair.client.on_tick(later);
        pair.carry(ServerTime(QUICK_PING_NS));
        assert_eq!(pair.client.next_tick(), Some(later.plus_ns(QUICK_PING_NS)));
    }

    #[test]
    fn the_clocks_agree_when_the_welcome_comes() {
        let mut pair = Pair::new();
        pair.carry(ServerTime(5_000_000));
        pair.accept();
        pair.carry(ServerTime(5_000_000));
        let events = pair.client_events();
        assert!(matches!(events[..], [ClientEvent::Welcome(_)]), "{events:?}");
        assert_eq!(pair.client.clock().server_time(NOW), Some(ServerTime(5_000_000)));
    }

    #[test]
    fn a_ping_that_overtakes_the_hello_is_answered() {
        let mut server = ServerSession::new(offer());
        server.on_datagram(&ClientDatagram::ClockPing { client_send: NOW }.encode(), ServerTime(7));
        assert!(matches!(server.poll_out(ServerTime(7)), Some(Out::Datagram(_))));
    }

    #[test]
    fn a_pong_says_when_the_ping_came_and_when_the_pong_left() {
        let mut pair = Pair::connected();
        let ping = ClientDatagram::ClockPing { client_send: NOW }.encode();
        pair.server.on_datagram(&ping, ServerTime(1_000));
        // The driver was held up.
        let Some(Out::Datagram(pong)) = pair.server.poll_out(ServerTime(9_000)) else { panic!("no pong") };
        let expected = ServerDatagram::ClockPong {
            client_send: NOW,
            server_receive: ServerTime(1_000),
            server_send: ServerTime(9_000),
        };
        assert_eq!(ServerDatagram::decode(&pong), Ok(expected));
    }

    #[test]
    fn pings_that_nobody_answers_are_dropped_oldest_first() {
        let mut server = ServerSession::new(offer());
        for n in 0..1000 {
            let ping = ClientDatagram::ClockPing { client_send: ClientTime(n) };
            server.on_datagram(&ping.encode(), ServerTime(n));
        }
        assert_eq!(server.pings.len(), MAX_WAITING_PINGS);
        assert_eq!(server.pings.back(), Some(&(ClientTime(999), ServerTime(999))));
    }

    #[test]
    fn late_poses_are_left_out_also_when_the_sequence_wraps() {
        let mut pair = Pair::connected();
        let mut seen = Vec::new();
        for sequence in [u32::MAX - 1, u32::MAX, 1, 0, u32::MAX, 2] {
            pair.client.send_pose(head(sequence));
            pair.carry(ServerTime(0));
            seen.extend(pair.server.poll_event().map(|event| match event {
                ServerEvent::Pose(head) => head.sequence,
                other => panic!("{other:?}"),
            }));
        }
        assert_eq!(seen, [u32::MAX - 1, u32::MAX, 1, 2]);
    }

    #[test]
    fn reports_and_requests_reach_the_server() {
        let mut pair = Pair::connected();
        pair.send_delta();
        pair.client.send_displayed(displayed(0));
        pair.client.request_refresh(Some(UpdateId(0)));
        pair.client.tell_watching(false);
        pair.client.goodbye();
        pair.carry(ServerTime(0));
        let events: Vec<_> = std::iter::from_fn(|| pair.server.poll_event()).collect();
        let expected = [
            ServerEvent::Displayed(displayed(0)),
            ServerEvent::RefreshRequest { after: Some(UpdateId(0)) },
            ServerEvent::Watching(false),
            ServerEvent::Goodbye,
        ];
        assert_eq!(events, expected);
        assert!(!pair.server.is_alive());
    }

    #[track_caller]
    fn assert_failed(pair: &mut Pair, words: &str) {
        let events = pair.client_events();
        let Some(ClientEvent::Failed(error)) = events.last() else { panic!("{events:?}") };
        assert!(error.to_string().contains(words), "{error}");
        assert!(!pair.client.is_alive());
    }

    #[test]
    fn a_delta_that_comes_twice_ends_the_session() {
        let mut pair = Pair::connected();
        pair.send_delta();
        pair.carry(ServerTime(0));
        (0..2).for_each(|_| pair.client.on_stream(&pair.streams[0]));
        assert_failed(&mut pair, "a second time");
    }

    #[test]
    fn frames_far_ahead_end_the_session_and_near_ones_do_not() {
        let mut pair = Pair::connected();
        pair.client.on_stream(&encode_picture(picture(MAX_FRAMES_AHEAD), b"coded"));
        assert!(pair.client.is_alive());
        for far in [MAX_FRAMES_AHEAD + 1, 4_000_000_000, u32::MAX] {
            let mut pair = Pair::connected();
            pair.client.on_stream(&encode_picture(picture(far), b"coded"));
            assert_failed(&mut pair, "more than 256 after frame 0");
            let mut pair = Pair::connected();
            pair.client.on_stream(&encode_geometry(&encoded(UpdateId(far)).bytes));
            assert_failed(&mut pair, "too far after 0");
        }
    }

    #[test]
    fn the_last_frame_that_there_can_be_overflows_nothing() {
        let mut pair = Pair::connected();
        (pair.client.next_update, pair.client.next_delta) = (UpdateId(u32::MAX - 1), u32::MAX - 1);
        for frame in [u32::MAX - 1, u32::MAX] {
            pair.client.on_stream(&encode_geometry(&encoded(UpdateId(frame)).bytes));
            pair.client.on_stream(&encode_picture(picture(frame), b"coded"));
        }
        assert_eq!(pair.client_events().len(), 4);
    }

    #[test]
    fn deltas_wait_while_what_came_before_is_too_much_for_one_turn() {
        let mut pair = Pair::connected();
        pair.client.hold_back(true);
        pair.client.on_tick(NOW);
        (0..10).for_each(|_| pair.send_delta());
        pair.carry(ServerTime(0));
        pair.streams.clone().iter().for_each(|stream| pair.client.on_stream(stream));
        assert_eq!((pair.client_events().len(), pair.client.waiting_bytes() > 0), (0, true));
        pair.client.hold_back(false);
        pair.client.on_tick(NOW.plus_ns(1));
        assert_eq!((pair.client_events().len(), pair.client.waiting_bytes()), (10, 0));
    }

    /// A chunk of four words.
    fn chunk(sequence: u32) -> Vec<u8> {
        let (times_s, values) = (vec![0.0], vec![[0.5; 4]]);
        let track = ChunkTrack { kind: TrackKind::Step, times_s, values, tangents: Vec::new() };
        let chunk = ClipChunk { clip: ClipId(0), index: 0, first_word: 0, tracks: vec![track] };
        assert_eq!(chunk.words(), 4);
        encode_motion(&MotionMessage { sequence, news: MotionNews::Chunk(chunk) }.encode())
    }

    #[test]
    fn news_of_motion_wait_where_a_turn_brings_more_than_the_arena_holds() {
        let mut pair = Pair::connected();
        (pair.client.motion_words, pair.client.motion_words_left) = (10, 10);
        pair.client_events();
        (0..7).for_each(|sequence| pair.client.on_stream(&chunk(sequence)));
        assert_eq!(pair.client_events().len(), 3, "ten words: two chunks and a whole third one");
        pair.client.hold_back(true);
        pair.client.on_tick(NOW);
        assert_eq!(pair.client_events().len(), 0, "what came before has not been taken in");
        pair.client.hold_back(false);
        pair.client.on_tick(NOW);
        let numbers = pair.client_events().into_iter().map(|event| match event {
            ClientEvent::Motion(message) => message.sequence,
            other => panic!("{other:?}"),
        });
        assert_eq!(numbers.collect::<Vec<_>>(), [3, 4, 5], "in order of arrival");
        pair.client.on_tick(NOW);
        assert_eq!((pair.client_events().len(), pair.client.waiting_bytes()), (1, 0));
    }

    #[test]
    fn a_flood_of_news_of_motion_ends_the_session() {
        let mut pair = Pair::connected();
        pair.client_events();
        pair.client.motion_words_left = 0;
        let chunk = chunk(0);
        let most = MAX_QUEUED_STREAM_BYTES / MOTION_OVERHEAD_BYTES;
        let sent = (0..most).take_while(|_| {
            pair.client.on_stream(&chunk);
            pair.client.is_alive()
        });
        assert!(sent.count() > 1000, "more than streams of other kinds may wait");
        assert!(!pair.client.is_alive());
        assert_eq!(pair.client.waiting_bytes(), 0);
    }

    #[test]
    fn a_turn_takes_in_so_many_records_and_a_delta_always_whole() {
        let mut pair = Pair::connected();
        pair.client.records_left = 3;
        let mut encoder = DeltaEncoder::new(600, 300);
        for frame in 0..4 {
            let vertex = |slot| NewVertex {
                slot: VertexSlot(slot),
                instance: InstanceId(0),
                motion: Motion::Static { position: glam::Vec3::ONE },
            };
            let new_vertices = (frame * 2..frame * 2 + 2).map(vertex).collect();
            let delta =
                Delta::from(GeometryDelta { update: UpdateId(frame), new_vertices, ..Default::default() });
            let out = pair.sender.as_mut().unwrap().stream(&encoder.encode(&delta));
            pair.keep(out);
        }
        pair.carry(ServerTime(0));
        pair.streams.clone().iter().for_each(|stream| pair.client.on_stream(stream));
        assert_eq!(pair.client_events().len(), 2, "three records: one delta and a whole second one");
        pair.client.on_tick(NOW);
        assert_eq!(pair.client_events().len(), 2);
    }

    #[test]
    fn answers_to_what_was_not_asked_do_not_count_nor_do_second_ones() {
        let mut pair = Pair::connected();
        let pong = |client_send, server_ns| {
            let server = ServerTime(server_ns);
            let (server_receive, server_send) = (server, server);
            ServerDatagram::ClockPong { client_send, server_receive, server_send }.encode()
        };
        let known = pair.client.clock().server_time(NOW).expect("the hello's ping was answered");
        let flood = |pair: &mut Pair, at: ClientTime| {
            for i in 1..1000 {
                pair.client.on_datagram(&pong(at.plus_ns(-i), 77_000_000), at.plus_ns(i));
                pair.client.on_datagram(&pong(NOW, 77_000_000), at.plus_ns(i));
            }
        };
        flood(&mut pair, NOW);
        let later = NOW.plus_ns(PING_NS);
        pair.client.on_tick(later);
        assert_eq!(pair.client.clock().server_time(NOW), Some(known));
        // The one that was asked counts, and counts once.
        pair.client.on_datagram(&pong(later, later.0 - NOW.0), later);
        let asked = pair.client.outstanding.len();
        flood(&mut pair, later);
        pair.client.on_tick(later.plus_ns(PING_NS));
        assert_eq!((asked, pair.client.outstanding.len()), (0, 1));
        let seen = pair.client.clock().server_time(NOW).expect("known");
        assert!(seen.since(known).abs() < 1_000_000, "{seen:?} instead of {known:?}");
    }

    #[test]
    fn a_stamp_counts_once_the_clock_is_known_and_with_the_next_turn() {
        let stamp = |server_ns| match clock_stamp(ServerTime(server_ns)) {
            Out::Datagram(bytes) => bytes,
            other => panic!("{other:?}"),
        };
        let mut fresh = ClientSession::start(hello(), NOW);
        fresh.on_datagram(&stamp(1), NOW);
        fresh.on_tick(NOW);
        assert_eq!(fresh.clock().server_time(NOW), None, "there may be any way between");
        let mut pair = Pair::connected();
        let before = pair.client.clock().error_bound_ns(NOW).expect("known");
        pair.client.on_datagram(&stamp(-1_000_000_000), NOW);
        pair.client.on_tick(NOW);
        assert_eq!(pair.client.clock().error_bound_ns(NOW), Some(before), "a second late: it tells nothing");
    }

    #[test]
    fn however_many_answers_come_the_clock_is_fitted_once_a_turn() {
        let mut pair = Pair::connected();
        let ping = |pair: &mut Pair, i: i64| pair.client.on_tick(NOW.plus_ns(i * PING_NS));
        (0..4).for_each(|i| ping(&mut pair, i));
        let sent: Vec<_> = pair.client.outstanding.iter().copied().collect();
        let far = NOW.plus_ns(4 * PING_NS);
        let seen: Vec<_> = sent
            .iter()
            .zip([9_000_000, 2_000_000, 1_000_000, 3_000_000])
            .map(|(client_send, off_ns)| {
                let server = ServerTime(client_send.0 + off_ns);
                let (server_receive, server_send, client_send) = (server, server, *client_send);
                let pong = ServerDatagram::ClockPong { client_send, server_receive, server_send };
                pair.client.on_datagram(&pong.encode(), client_send.plus_ns(10_000_000));
                pair.client.clock().server_time(far)
            })
            .collect();
        assert!(seen.iter().all(|time| *time == seen[0]), "only the first counts at once: {seen:?}");
        ping(&mut pair, 4);
        assert_ne!(pair.client.clock().server_time(far.plus_ns(1_000_000_000)), seen[0]);
        assert!(pair.client.clock().server_time(far) < seen[0].map(|t| t.plus_ns(1)));
    }

    #[test]
    fn pings_without_answers_are_remembered_up_to_a_bound() {
        let mut pair = Pair::connected();
        (0..10_000).for_each(|i| pair.client.on_tick(NOW.plus_ns(i * PING_NS)));
        assert_eq!(pair.client.outstanding.len(), MAX_OUTSTANDING_PINGS);
    }

    #[test]
    fn a_server_that_never_sends_the_missing_delta_cannot_fill_the_clients_memory() {
        let mut pair = Pair::connected();
        (0..=MAX_QUEUED_STREAMS + 1).for_each(|_| pair.send_delta());
        pair.carry(ServerTime(0));
        pair.streams[1..].iter().for_each(|stream| pair.client.on_stream(stream));
        assert_failed(&mut pair, "above the limit of 128");

        let mut waiting = Waiting::default();
        assert!(waiting.admit(MAX_DELTA_BYTES).is_ok() && waiting.admit(MAX_DELTA_BYTES).is_ok());
        assert!(waiting.admit(1).is_err());
    }

    #[test]
    fn a_codec_that_was_not_announced_ends_the_session() {
        let mut pair = Pair::new();
        let welcome = Welcome { codec: Codec::Raw, ..crate::testing::welcome() };
        pair.client.on_control(&ServerMessage::Welcome(welcome).encode());
        assert_failed(&mut pair, "was not announced");
    }

    #[test]
    fn more_memory_of_motion_than_was_announced_ends_the_session() {
        let welcomed = |motion| {
            let mut pair = Pair::new();
            let welcome = Welcome { motion, ..crate::testing::welcome() };
            pair.client.on_control(&ServerMessage::Welcome(welcome).encode());
            pair
        };
        let announced = hello().capabilities.motion;
        assert!(welcomed(announced).client.is_alive());
        let longer = MotionMemory { sample_ring: 64, ..announced };
        assert_failed(&mut welcomed(longer), "sample_ring: 32 } was announced");
        let larger = MotionMemory { arena_words: announced.arena_words + 1, ..announced };
        assert_failed(&mut welcomed(larger), "the memory of motion of a welcome");
    }

    #[test]
    fn showing_a_frame_that_was_never_sent_ends_the_session() {
        let mut pair = Pair::connected();
        pair.client.send_displayed(displayed(0));
        pair.carry(ServerTime(0));
        let event = pair.server.poll_event();
        assert!(matches!(event, Some(ServerEvent::Failed(_))), "{event:?}");
    }

    #[test]
    fn nothing_is_taken_in_after_the_end() {
        let mut pair = Pair::connected();
        pair.server.goodbye();
        pair.carry(ServerTime(0));
        assert_eq!(pair.client_events(), [ClientEvent::Goodbye]);
        pair.client.on_control(b"anything");
        pair.client.on_stream(b"anything");
        pair.client.on_tick(NOW);
        assert_eq!((pair.client.poll_event(), pair.client.poll_out()), (None, None));
    }

    #[test]
    fn what_a_client_says_faster_than_it_is_heard_coalesces() {
        let mut pair = Pair::connected();
        (0..3).for_each(|_| pair.send_delta());
        for round in 0..10_000 {
            let frame = displayed(u32::min(round, 2)).update;
            pair.client.send_displayed(Displayed { update: frame, display_frames: 1, ..displayed(0) });
            pair.client.request_refresh(None);
            pair.client.steer(Steer::GoOn);
            pair.client.steer(Steer::Step);
            pair.client.send_pose(head(round));
            pair.client.on_tick(NOW.plus_ns(i64::from(round) * PING_NS));
            while let Some(out) = pair.client.poll_out() {
                match out {
                    Out::Control(message) => pair.server.on_control(&message),
                    Out::Datagram(bytes) => pair.server.on_datagram(&bytes, ServerTime(0)),
                    Out::Stream { .. } => panic!("a client sends no streams"),
                }
            }
        }
        assert!(pair.server.pings.len() <= MAX_WAITING_PINGS && pair.server.control.is_empty());
        assert!(pair.server.understood() > 3 * 10_000);
        let events: Vec<_> = std::iter::from_fn(|| pair.server.poll_event()).collect();
        let [
            ServerEvent::Displayed(shown),
            ServerEvent::RefreshRequest { .. },
            ServerEvent::Steer(steering),
            ServerEvent::Pose(pose),
        ] = events[..]
        else {
            panic!("{events:?}")
        };
        assert_eq!((shown.update, shown.display_frames, pose.sequence), (UpdateId(2), 10_000, 9_999));
        assert_eq!(steering, Steering::from(Steer::GoOn).then(Steer::Step.into()));
    }

    #[test]
    fn an_update_goes_before_all_later_ones_and_its_delta_before_its_picture() {
        let order: Vec<i32> = [(0, 1), (0, 0), (1, 1), (1, 0), (9, 1), (u32::MAX - 1, 0)]
            .map(|(frame, urgency)| priority(UpdateId(frame), urgency))
            .to_vec();
        assert!(order.windows(2).all(|pair| pair[0] > pair[1]), "{order:?}");
        assert!(order[0] < i32::MAX, "control goes before all");
    }

    #[test]
    fn a_picture_that_the_wire_does_not_allow_is_an_error_and_no_panic() {
        let error = picture_stream(picture(0), &vec![0; MAX_ACCESS_UNIT_BYTES + 1]);
        assert!(matches!(error, Err(WireError::TooMany { .. })));
    }

    #[test]
    fn a_client_that_asks_can_be_refused_and_so_can_one_that_is_served() {
        let refused = Refused::new("another client is being served", "try again later");
        for is_served in [false, true] {
            let mut pair = Pair::new();
            pair.carry(ServerTime(0));
            if is_served {
                pair.accept();
                pair.carry(ServerTime(0));
                assert!(matches!(pair.client.poll_event(), Some(ClientEvent::Welcome(_))));
            }
            pair.server.refuse(refused.clone());
            pair.carry(ServerTime(0));
            assert_eq!(pair.client_events(), [ClientEvent::Refused(refused.clone())]);
            assert!(!pair.server.is_alive());
        }
    }

    #[test]
    fn a_hello_that_cannot_be_served_is_refused_with_its_fault() {
        let mut bad = hello();
        bad.capabilities.eye_extent_pixels = [8192, 8192];
        let mut pair = Pair { client: ClientSession::start(bad, NOW), ..Pair::new() };
        pair.carry(ServerTime(0));
        let events = pair.client_events();
        let [ClientEvent::Refused(refused)] = &events[..] else { panic!("{events:?}") };
        assert!(refused.reason.contains("number of pixels"), "{refused:?}");
        assert!(matches!(pair.server.poll_event(), Some(ServerEvent::Refused(_))));
    }

    #[test]
    fn damaged_traffic_ends_sessions_and_nothing_worse() {
        let mut pair = Pair::new();
        let Some(Out::Control(greeting)) = pair.client.poll_out() else { panic!("no hello") };
        damaged(&greeting, 1, 3000, |bytes| ServerSession::new(offer()).on_control(bytes));
        pair.server.on_control(&greeting);
        pair.accept();
        let Some(Out::Control(welcome)) = pair.server.poll_out(ServerTime(0)) else { panic!("no welcome") };
        damaged(&welcome, 2, 1000, |bytes| ClientSession::start(hello(), NOW).on_control(bytes));
        pair.client.on_control(&welcome);
        let ping = ClientDatagram::ClockPing { client_send: NOW }.encode();
        damaged(&ping, 3, 1000, |bytes| pair.server.on_datagram(bytes, ServerTime(0)));
        pair.server.on_datagram(&ping, ServerTime(0));
        while let Some(out) = pair.server.poll_out(ServerTime(0)) {
            let Out::Datagram(pong) = out else { panic!("only pongs") };
            damaged(&pong, 4, 10, |bytes| pair.client.on_datagram(bytes, NOW));
        }
        assert!(pair.client.is_alive() && pair.server.is_alive(), "a damaged datagram is only dropped");
    }
}
