//! The two ends of a session as state machines without I/O: bytes and time enter, bytes and events leave.
//!
//! Their driver carries three kinds of messages: control messages each way (in order, each whole), unidirectional streams from
//! the server (each whole), and datagrams (lossy). The state machines do not know framing, sockets, QUIC, clocks, pictures and
//! GPUs.
//!
//! An error ends a session: after [`ClientEvent::Failed`] or [`ServerEvent::Failed`] nothing more comes out.

use crate::clock::ClockEstimator;
use crate::delta::{DeltaDecoder, EncodedDelta, ReceivedDelta};
use crate::ids::UpdateId;
use crate::limits::{
    MAX_ACCESS_UNIT_BYTES, MAX_FRAMES_AHEAD, MAX_QUEUED_STREAM_BYTES, MAX_QUEUED_STREAMS, PADDING_BYTES,
    RECORDS_PER_SLOT_AND_TURN,
};
use crate::memory::ClientMemory;
use crate::message::{
    ClientDatagram, ClientHello, ClientMessage, Codec, Displayed, HeadState, HelloVersions, MotionMemory,
    Refused, ServerDatagram, ServerMessage, ServerOffer, Welcome, negotiate, negotiate_version,
};
use crate::motion::message::{MotionMessage, MotionNews};
use crate::pairing::{ClientPairing, ServerPairing, Word};
use crate::time::{ClientTime, ServerTime};
use crate::wire::{
    DeltaHead, PictureHeader, StreamMessage, WireError, check_count, encode_geometry, encode_motion,
    encode_picture, invalid, parse_stream,
};
use crate::world_clock::{Steer, Steering};
use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

/// Pings: with every head state in the first seconds, then 40 a second. A clock that is off by 1 ms puts a fast wing 0.3 % of its
/// range off its place, and the envelope of jitter is only as good as it is often sampled. Where packets keep their order, more
/// of them wait for each other and tell no more.
const QUICK_PINGS: u32 = 500;
/// What a message about motion takes while it waits, beside its bytes.
const MOTION_OVERHEAD_BYTES: usize = 64;
/// What may be taken in of them at once where there is no arena: each counts for a word at least.
const LEAST_MOTION_WORDS: u32 = 64;
const QUICK_PING_NS: i64 = 14_000_000;
const PING_NS: i64 = 25_000_000;
/// A ping that is due this soon leaves with a head state, in the same packet: at 72 Hz with each, later with every second.
const QUICK_EARLY_NS: i64 = 6_000_000;
const EARLY_NS: i64 = 10_500_000;
/// A stamp is answered by a ping, unless one left within this time.
const STAMP_PING_NS: i64 = 4_000_000;
/// Pings that wait for their answer, on a server whose driver is late; the oldest are dropped.
const MAX_WAITING_PINGS: usize = 16;
/// Pings whose answers are awaited: those of more than two seconds.
const MAX_OUTSTANDING_PINGS: usize = 256;
/// Pings that are answered before the hello was judged good: whoever says none has no claim to more.
const PINGS_BEFORE_HELLO: u32 = 32;
/// A server that has answered none of so many pings for so long, over a connection that brought something within the last second, does
/// not serve this client.
const SILENCE_NS: i64 = 2_000_000_000;
const SILENCE_PINGS: u32 = 12;
const ALIVE_NS: i64 = 1_000_000_000;

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
#[allow(clippy::large_enum_variant, reason = "most are deltas, and each is taken at once")]
#[derive(Clone, Debug, PartialEq)]
pub enum ClientEvent {
    /// The session stands.
    Welcome(Welcome),
    /// There will be no session.
    Refused(Refused),
    /// The server does not know this client: show a code, then [`ClientSession::pair`].
    PairingNeeded {
        /// How long the code may be typed, milliseconds.
        patience_ms: u32,
    },
    /// A code was typed at the server.
    PairingAnswer {
        /// The server's part of the exchange.
        element: Word,
        /// That it has the code.
        proof: Word,
    },
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
    /// The connection stands, and the server answers no pings: drop it, then connect anew.
    Silent,
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
    Head(HeadState),
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
    /// A step of pairing, after [`ServerSession::ask_to_pair`].
    Pairing(ClientPairing),
    /// The user left.
    Goodbye,
    /// The client said what makes no sense: drop the connection.
    Failed(WireError),
}

/// How far a pairing is. Both ends know, so no step can be left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum PairingStep {
    /// The client is to show a code.
    Needed,
    /// It shows one.
    Offered,
    /// One was typed.
    Answered,
    /// The client has said whether that is the one.
    Judged,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// Hello sent, or awaited.
    Greeting,
    /// The server wants to know first who this is.
    Pairing(PairingStep),
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
    /// A head state waits to leave since the last turn.
    has_pose: bool,
    /// When the pings left that have not been answered, in order.
    outstanding: VecDeque<ClientTime>,
    /// The first ping since the last answer, and how many there were.
    unanswered: Option<(ClientTime, u32)>,
    /// When the connection brought something last, whatever it was; `None` where nobody says.
    alive: Option<ClientTime>,
    /// It has brought nothing for a while: nothing is said that would be old when it arrives.
    is_quiet: bool,
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
            has_pose: false,
            outstanding: VecDeque::new(),
            unanswered: None,
            alive: None,
            is_quiet: false,
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
                    self.unanswered = None;
                    self.clock.note_pong(client_send, server_receive, server_send, now);
                }
            }
            Ok(ServerDatagram::ClockStamp { server_send }) => {
                self.clock.note_stamp(server_send, now);
                self.ping_before_acknowledgements(now);
            }
            Err(_) => {}
        }
    }

    /// Does what is due at `now`, once a display frame: follows the clock, hands on what has waited, pings.
    pub fn on_tick(&mut self, now: ClientTime) {
        if self.phase == Phase::Ended {
            return;
        }
        if matches!(self.phase, Phase::Pairing(_)) {
            return; // the server answers no pings to a stranger
        }
        self.clock.settle();
        self.listen(now);
        self.records_left = if self.is_held_back { 0 } else { self.records_per_turn };
        if !self.is_held_back {
            self.motion_words_left = self.motion_words;
        }
        let result = self.hand_on_motion().and_then(|()| self.hand_on_deltas());
        self.end_on_error(result);
        let early_ns = if std::mem::take(&mut self.has_pose) { self.ping_ns().1 } else { 0 };
        if self.phase != Phase::Ended && now.plus_ns(early_ns) >= self.next_ping && !self.is_quiet {
            self.ping(now);
        }
    }

    /// From one ping to the next, and how much earlier one may leave with a head state, nanoseconds.
    fn ping_ns(&self) -> (i64, i64) {
        if self.pings < QUICK_PINGS { (QUICK_PING_NS, QUICK_EARLY_NS) } else { (PING_NS, EARLY_NS) }
    }

    /// A stamp has come, with an update's packets behind it: what leaves now is ahead of their acknowledgements.
    fn ping_before_acknowledgements(&mut self, now: ClientTime) {
        let is_due = now.since(self.next_ping.plus_ns(-self.ping_ns().0)) >= STAMP_PING_NS;
        if self.phase == Phase::Running && is_due && !self.is_quiet {
            self.ping(now);
        }
    }

    /// The connection has brought something, if only an acknowledgement, at `now`. A network that carries nothing is the transport's to
    /// notice.
    pub fn note_alive(&mut self, now: ClientTime) {
        self.alive = Some(now);
    }

    /// Follows whether the connection brings anything. What was asked in an outage says nothing of the server.
    fn listen(&mut self, now: ClientTime) {
        self.is_quiet = self.alive.is_some_and(|alive| now.since(alive) >= ALIVE_NS);
        if self.is_quiet {
            (self.unanswered, self.next_ping) = (None, now);
        }
    }

    /// Whether the connection has brought nothing for a second: what is said now would be old when it arrives.
    pub fn is_quiet(&self) -> bool {
        self.is_quiet
    }

    /// Whether a server that has welcomed this client has stopped to answer. A client that slept has asked little meanwhile.
    fn is_unanswered(&self, now: ClientTime) -> bool {
        let is_alive = self.alive.is_some_and(|alive| now.since(alive) < ALIVE_NS);
        let is_long =
            |(since, pings): (ClientTime, u32)| pings >= SILENCE_PINGS && now.since(since) > SILENCE_NS;
        self.phase == Phase::Running && is_alive && self.unanswered.is_some_and(is_long)
    }

    fn ping(&mut self, now: ClientTime) {
        if self.is_unanswered(now) {
            return self.end_with(ClientEvent::Silent);
        }
        let (since, pings) = self.unanswered.unwrap_or((now, 0));
        self.unanswered = Some((since, pings + 1));
        if self.outstanding.len() == MAX_OUTSTANDING_PINGS {
            self.outstanding.pop_front();
        }
        self.outstanding.push_back(now);
        self.pings = self.pings.saturating_add(1);
        self.next_ping = now.plus_ns(self.ping_ns().0);
        self.out.push_back(Out::Datagram(ClientDatagram::ClockPing { client_send: now }.encode()));
    }

    /// While it is true, deltas wait undecoded: what came of the last ones has yet to be taken in.
    pub fn hold_back(&mut self, is_held_back: bool) {
        self.is_held_back = is_held_back;
    }

    /// The client's memory as of the last delta that was handed on; `None` before the welcome.
    pub fn memory(&self) -> Option<&ClientMemory> {
        self.decoder.as_ref().map(DeltaDecoder::memory)
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

    /// Sends the head's state, unless the connection is quiet.
    pub fn send_pose(&mut self, head: HeadState) {
        if self.phase == Phase::Running && !self.is_quiet {
            self.out.push_back(Out::Datagram(ClientDatagram::Pose(head).encode()));
            self.has_pose = true;
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
    pub fn report_watching(&mut self, is_watched: bool) {
        if self.phase == Phase::Running {
            self.say(&ClientMessage::Watching { is_watched });
        }
    }

    /// Says a step of pairing; steps out of turn are not said.
    pub fn pair(&mut self, step: ClientPairing) {
        let next = match (self.phase, step) {
            (Phase::Pairing(PairingStep::Needed), ClientPairing::Offer { .. }) => PairingStep::Offered,
            (
                Phase::Pairing(PairingStep::Answered),
                ClientPairing::Proof { .. } | ClientPairing::WrongCode,
            ) => PairingStep::Judged,
            _ => return,
        };
        self.phase = Phase::Pairing(next);
        self.say(&ClientMessage::Pairing(step));
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
            (ServerMessage::Welcome(welcome), Phase::Greeting | Phase::Pairing(PairingStep::Judged)) => {
                self.begin(welcome)?;
            }
            (ServerMessage::Welcome(_), Phase::Pairing(_)) => {
                return Err(invalid("a welcome", "it comes before the pairing is over"));
            }
            (ServerMessage::Pairing(step), phase) => self.take_pairing(step, phase)?,
            (ServerMessage::Welcome(_), _) => return Err(invalid("a welcome", "it comes a second time")),
            (ServerMessage::Refused(refused), _) => self.end_with(ClientEvent::Refused(refused)),
            (ServerMessage::Goodbye, _) => self.end_with(ClientEvent::Goodbye),
            (ServerMessage::Padding(_), _) => {}
        }
        Ok(())
    }

    fn end_with(&mut self, event: ClientEvent) {
        self.phase = Phase::Ended;
        self.waiting = Waiting::default();
        self.events.push_back(event);
    }

    fn take_pairing(&mut self, step: ServerPairing, phase: Phase) -> Result<(), WireError> {
        let (next, event) = match (step, phase) {
            (ServerPairing::Needed { patience_ms }, Phase::Greeting) => {
                (PairingStep::Needed, ClientEvent::PairingNeeded { patience_ms })
            }
            (ServerPairing::Answer { element, proof }, Phase::Pairing(PairingStep::Offered)) => {
                (PairingStep::Answered, ClientEvent::PairingAnswer { element, proof })
            }
            _ => return Err(invalid("a step of pairing", "it comes out of turn")),
        };
        self.phase = Phase::Pairing(next);
        self.events.push_back(event);
        Ok(())
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
        self.unanswered = None; // what was asked during a pairing is no silence
        let decoder = DeltaDecoder::new(welcome.vertex_slots, welcome.patch_slots);
        let decoder = decoder.with_motion(welcome.motion).with_store(welcome.store_pages);
        self.decoder = Some(decoder.with_atlas(welcome.atlas_extent_texels));
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
    /// It has come from somebody who is not known yet.
    Pairing(PairingStep),
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
    /// So many pings are still taken before the hello.
    early_pings_left: u32,
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
    pairing: Option<ClientPairing>,
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
            early_pings_left: PINGS_BEFORE_HELLO,
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

    /// Takes a datagram that came at `now`. Damaged ones are dropped: they carry nothing that is not sent again. A few pings
    /// are answered before the hello, too, so that the clocks agree a round trip earlier.
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
                if self.phase != ServerPhase::Running {
                    let Some(left) = self.early_pings_left.checked_sub(1) else { return };
                    self.early_pings_left = left;
                }
                self.pings.push_back((client_send, now));
                if self.pings.len() > MAX_WAITING_PINGS {
                    self.pings.pop_front();
                }
            }
        }
    }

    /// Tells the client that [`ServerEvent::Asked`] that it is to be paired first, within `patience_ms`; its steps are
    /// [`ServerEvent::Pairing`]. [`Self::accept`] or [`Self::refuse`] ends it.
    pub fn ask_to_pair(&mut self, patience_ms: u32) {
        if self.phase == ServerPhase::Asked {
            self.phase = ServerPhase::Pairing(PairingStep::Needed);
            self.say(&ServerMessage::Pairing(ServerPairing::Needed { patience_ms }));
        }
    }

    /// A code was typed: the server's part of the exchange, and its proof. Said once, to a client that shows a code.
    pub fn answer_pairing(&mut self, element: Word, proof: Word) {
        if self.phase == ServerPhase::Pairing(PairingStep::Offered) {
            self.phase = ServerPhase::Pairing(PairingStep::Answered);
            self.say(&ServerMessage::Pairing(ServerPairing::Answer { element, proof }));
        }
    }

    /// Says yes to the client that [`ServerEvent::Asked`]: the session stands. Gives its sending half; `None` where nobody
    /// asks any more.
    pub fn accept(&mut self) -> Option<DeltaSender> {
        let welcome = self.asked.take()?;
        self.phase = ServerPhase::Running;
        let sender = DeltaSender { sent: self.sent.clone() };
        self.say(&ServerMessage::Welcome(welcome));
        self.say(&ServerMessage::Padding(vec![0; PADDING_BYTES]));
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
        let pairing = || heard.pairing.take().map(ServerEvent::Pairing);
        let event = displayed.or_else(pairing).or_else(refresh).or_else(watching).or_else(steering);
        event.or_else(|| heard.pose.take().map(ServerEvent::Head)).or_else(|| heard.end.take())
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
            ServerPhase::Asked | ServerPhase::Running => self.handle(ClientMessage::decode(message)?),
            ServerPhase::Pairing(step) => self.pair(step, ClientMessage::decode(message)?),
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

    /// From a stranger only the steps of pairing are taken, each once.
    fn pair(&mut self, step: PairingStep, message: ClientMessage) -> Result<(), WireError> {
        let (next, said) = match (step, message) {
            (_, ClientMessage::Goodbye) => {
                self.end_with(ServerEvent::Goodbye);
                return Ok(());
            }
            (PairingStep::Needed, ClientMessage::Pairing(said @ ClientPairing::Offer { .. })) => {
                (PairingStep::Offered, said)
            }
            (
                PairingStep::Answered,
                ClientMessage::Pairing(said @ (ClientPairing::Proof { .. } | ClientPairing::WrongCode)),
            ) => (PairingStep::Judged, said),
            _ => return Err(invalid("a message of a client that is not paired", "it comes out of turn")),
        };
        self.phase = ServerPhase::Pairing(next);
        self.heard.pairing = Some(said);
        Ok(())
    }

    fn handle(&mut self, message: ClientMessage) -> Result<(), WireError> {
        match message {
            ClientMessage::Pairing(_) => return Err(invalid("a step of pairing", "none was asked for")),
            ClientMessage::Hello(_) => return Err(invalid("a hello", "it comes a second time")),
            ClientMessage::Displayed(displayed) => {
                if displayed.update.0 >= self.sent.load(Ordering::Acquire) {
                    let reason = format!("frame {} has not been sent", displayed.update.0);
                    return Err(invalid("a report of what is on display", reason));
                }
                let earlier = self.heard.displayed.take();
                self.heard.displayed = Some(earlier.map_or(displayed, |earlier| earlier.merged(displayed)));
            }
            // Of several the earliest counts: whoever asked for it lacks all that came after.
            ClientMessage::RefreshRequest { after } => {
                self.heard.refresh = Some(self.heard.refresh.map_or(after, |before| before.min(after)));
            }
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
mod tests;
