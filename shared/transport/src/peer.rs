//! One connection as messages: framing on the control stream, whole unidirectional streams, datagrams.
//!
//! Every store has a limit. Excess from the peer closes the connection; our own excess is refused and counted.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::net::SocketAddr;
use std::sync::Arc;

use bytes::Bytes;
use quinn_proto as proto;
use quinn_proto::{Connection, ConnectionHandle, Dir, VarInt};
use shadecast_protocol::limits::{MAX_CONTROL_BYTES, MAX_INSTANCES, MAX_STREAM_BYTES};
use shadecast_protocol::wire::{ControlReader, WireError, frame_control};

use crate::allowance::Allowance;
use crate::congestion::TargetRate;
use crate::event::{Event, PeerId, SendError, StreamId};
use crate::identity::tls::PinVerifier;
use crate::repeats::Repeats;
use crate::silence::Silence;

/// Bytes of messages and streams that wait for the network to take them, per peer.
const MAX_QUEUED_BYTES: usize = 96 << 20;
/// Streams that are not yet acknowledged to their end, per peer: changes of each instance that there may be, twice.
const MAX_OUTGOING_STREAMS: usize = 2 * MAX_INSTANCES as usize;
/// Of a stream that the sender gave up, this many bytes are handed on, so that its header can be read.
const RESET_HEAD_BYTES: usize = 64;
/// The control stream goes before all other streams.
const CONTROL_PRIORITY: i32 = i32::MAX;
/// Reset code of a stream that is given up.
const CANCELLED: VarInt = VarInt::from_u32(1);

/// What the peer did that ends the connection.
pub(crate) struct Violation(pub(crate) String);

impl From<WireError> for Violation {
    fn from(error: WireError) -> Self {
        Self(error.to_string())
    }
}

/// What a peer may do.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PeerLimits {
    /// Largest stream that this side accepts, bytes.
    pub(crate) max_stream_bytes: usize,
    /// Control messages a second, and at once after a pause.
    pub(crate) control_per_s: u32,
    /// Datagrams a second that are handed on, and at once after a pause. [`FLOOD`] times as many end the connection.
    pub(crate) datagrams_per_s: u32,
}

/// So many times the datagrams that are handed on are no mishap.
const FLOOD: u32 = 10;

/// A unidirectional stream that we send.
struct Outgoing {
    /// `None` while the peer allows no more streams.
    quic: Option<proto::StreamId>,
    priority: i32,
    /// Of the whole stream.
    bytes: usize,
    /// What QUIC has not taken yet.
    rest: Bytes,
}

/// One connection and what belongs to it.
pub(crate) struct Peer {
    pub(crate) id: PeerId,
    pub(crate) handle: ConnectionHandle,
    pub(crate) conn: Connection,
    /// How fast to send to it.
    pub(crate) target: Arc<TargetRate>,
    pub(crate) remote: SocketAddr,
    /// The client's view of the server's identity; `None` on the server.
    pub(crate) verifier: Option<Arc<PinVerifier>>,
    pub(crate) connected: bool,
    /// When the connection was begun, nanoseconds.
    pub(crate) since_ns: i64,
    /// A `Closed` event was emitted: nothing more is told about this peer.
    pub(crate) closed: bool,
    /// Whether the path to it carries anything.
    pub(crate) silence: Silence,
    /// Packets to it that leave twice.
    pub(crate) repeats: Repeats,
    limits: PeerLimits,
    control: Option<proto::StreamId>,
    control_allowance: Allowance,
    datagram_allowance: Allowance,
    flood_allowance: Allowance,
    control_in: ControlReader,
    control_out: VecDeque<Bytes>,
    outgoing: BTreeMap<StreamId, Outgoing>,
    /// Those of them that wait until the peer allows more streams, the most urgent and oldest first.
    unopened: BTreeSet<(Reverse<i32>, StreamId)>,
    by_quic: BTreeMap<proto::StreamId, StreamId>,
    queued_bytes: usize,
    unacknowledged_bytes: usize,
    incoming: BTreeMap<proto::StreamId, Vec<u8>>,
    incoming_bytes: usize,
    /// Streams that may have something to read.
    readable: BTreeSet<proto::StreamId>,
}

impl Peer {
    pub(crate) fn new(
        id: PeerId,
        handle: ConnectionHandle,
        (conn, target): (Connection, Arc<TargetRate>),
        verifier: Option<Arc<PinVerifier>>,
        limits: PeerLimits,
        now_ns: i64,
    ) -> Self {
        let allowance = |per_s| Allowance::new(per_s, now_ns);
        Self {
            id,
            handle,
            target,
            remote: conn.remote_address(),
            conn,
            verifier,
            connected: false,
            since_ns: now_ns,
            closed: false,
            silence: Silence::new(now_ns),
            repeats: Repeats::default(),
            limits,
            control: None,
            control_allowance: allowance(limits.control_per_s),
            datagram_allowance: allowance(limits.datagrams_per_s),
            flood_allowance: allowance(FLOOD.saturating_mul(limits.datagrams_per_s)),
            control_in: ControlReader::default(),
            control_out: VecDeque::new(),
            outgoing: BTreeMap::new(),
            unopened: BTreeSet::new(),
            by_quic: BTreeMap::new(),
            queued_bytes: 0,
            unacknowledged_bytes: 0,
            incoming: BTreeMap::new(),
            incoming_bytes: 0,
            readable: BTreeSet::new(),
        }
    }

    /// Bytes that wait for the network to take them.
    pub(crate) fn queued_bytes(&self) -> usize {
        self.queued_bytes
    }

    /// Bytes of the streams that are not yet acknowledged to their end.
    pub(crate) fn unacknowledged_bytes(&self) -> usize {
        self.unacknowledged_bytes
    }

    /// Connected and not on the way out.
    pub(crate) fn is_in_use(&self) -> bool {
        self.connected && !self.closed
    }

    /// The handshake is under way.
    pub(crate) fn is_half_open(&self) -> bool {
        !self.connected && !self.closed
    }

    /// Streams that are not yet acknowledged to their end.
    pub(crate) fn streams_under_way(&self) -> usize {
        self.outgoing.len()
    }

    /// The handshake is done: the client opens the control stream, and what waited is sent.
    pub(crate) fn on_connected(&mut self) {
        self.connected = true;
        if self.conn.side().is_client()
            && let Some(id) = self.conn.streams().open(Dir::Bi)
        {
            self.set_control(id);
            // An empty message makes the stream known to the server, so that it can speak first.
            let opening = frame_control(&[]);
            self.queued_bytes += opening.len();
            self.control_out.push_front(opening.into());
        }
        self.write_control();
        self.open_waiting();
    }

    fn set_control(&mut self, id: proto::StreamId) {
        self.control = Some(id);
        // Fails for a closed stream only; writing tells.
        let _ = self.conn.send_stream(id).set_priority(CONTROL_PRIORITY);
    }

    pub(crate) fn send_control(&mut self, message: &[u8]) -> Result<(), SendError> {
        if message.is_empty() || message.len() > MAX_CONTROL_BYTES {
            return Err(SendError::Size { bytes: message.len(), limit: MAX_CONTROL_BYTES });
        }
        let frame = frame_control(message);
        self.reserve(frame.len())?;
        self.control_out.push_back(frame.into());
        self.write_control();
        Ok(())
    }

    pub(crate) fn send_stream(&mut self, id: StreamId, bytes: Bytes, priority: i32) -> Result<(), SendError> {
        if self.conn.side().is_client() {
            return Err(SendError::ClientStream);
        }
        let limit = MAX_STREAM_BYTES;
        if bytes.len() > limit {
            return Err(SendError::Size { bytes: bytes.len(), limit });
        }
        if self.outgoing.len() >= MAX_OUTGOING_STREAMS {
            return Err(SendError::QueueFull);
        }
        self.reserve(bytes.len())?;
        self.unacknowledged_bytes += bytes.len();
        self.outgoing.insert(id, Outgoing { quic: None, priority, bytes: bytes.len(), rest: bytes });
        self.unopened.insert((Reverse(priority), id));
        self.open_waiting();
        Ok(())
    }

    fn reserve(&mut self, bytes: usize) -> Result<(), SendError> {
        if self.closed {
            return Err(SendError::NotConnected);
        }
        if self.queued_bytes + bytes > MAX_QUEUED_BYTES {
            return Err(SendError::QueueFull);
        }
        self.queued_bytes += bytes;
        Ok(())
    }

    /// Gives up a stream; `false` when it is unknown or already acknowledged to its end.
    pub(crate) fn cancel_stream(&mut self, id: StreamId) -> bool {
        let Some(outgoing) = self.outgoing.remove(&id) else { return false };
        self.queued_bytes -= outgoing.rest.len();
        self.unacknowledged_bytes -= outgoing.bytes;
        self.unopened.remove(&(Reverse(outgoing.priority), id));
        if let Some(quic) = outgoing.quic {
            self.by_quic.remove(&quic);
            // An already closed stream needs no reset.
            let _ = self.conn.send_stream(quic).reset(CANCELLED);
        }
        true
    }

    pub(crate) fn send_datagram(&mut self, bytes: Bytes) -> bool {
        !self.closed && self.conn.datagrams().send(bytes, true).is_ok()
    }

    fn write_control(&mut self) {
        let Some(id) = self.control.filter(|_| self.connected) else { return };
        while let Some(frame) = self.control_out.front_mut() {
            let Ok(written) = self.conn.send_stream(id).write(frame) else { return };
            self.queued_bytes -= written;
            if written == frame.len() {
                self.control_out.pop_front();
            } else {
                let _ = frame.split_to(written);
            }
        }
    }

    /// Opens as many waiting streams as the peer allows, the most urgent and oldest first.
    pub(crate) fn open_waiting(&mut self) {
        if !self.connected {
            return;
        }
        while let Some(&(Reverse(priority), id)) = self.unopened.first() {
            let Some(quic) = self.conn.streams().open(Dir::Uni) else { return };
            self.unopened.pop_first();
            let _ = self.conn.send_stream(quic).set_priority(priority);
            self.by_quic.insert(quic, id);
            if let Some(outgoing) = self.outgoing.get_mut(&id) {
                outgoing.quic = Some(quic);
            }
            self.write_stream(quic);
        }
    }

    /// Writes what QUIC takes of a stream, and ends it after its last byte.
    fn write_stream(&mut self, quic: proto::StreamId) {
        let Some(id) = self.by_quic.get(&quic) else { return };
        let Some(outgoing) = self.outgoing.get_mut(id) else { return };
        let before = outgoing.rest.len();
        let mut stream = self.conn.send_stream(quic);
        let mut chunks = [std::mem::take(&mut outgoing.rest)];
        // Until it is refused: only then is the stream told when there is room again.
        while !chunks[0].is_empty() && stream.write_chunks(&mut chunks).is_ok() {}
        [outgoing.rest] = chunks;
        self.queued_bytes -= before - outgoing.rest.len();
        if outgoing.rest.is_empty() {
            // Finishing twice or after a stop is refused, and harmless.
            let _ = stream.finish();
        }
    }

    /// The next datagram that is handed on; those beyond the allowance are dropped, and counted.
    ///
    /// # Errors
    /// They are so many that nothing but harm can be meant.
    pub(crate) fn next_datagram(
        &mut self,
        now_ns: i64,
        dropped: &mut u64,
    ) -> Result<Option<Bytes>, Violation> {
        while let Some(bytes) = self.conn.datagrams().recv() {
            if !self.flood_allowance.take(now_ns) {
                let most = FLOOD.saturating_mul(self.limits.datagrams_per_s);
                return Err(Violation(format!("more than {most} datagrams a second")));
            }
            if self.datagram_allowance.take(now_ns) {
                return Ok(Some(bytes));
            }
            *dropped += 1;
        }
        Ok(None)
    }

    /// Takes over what QUIC reports about streams.
    pub(crate) fn on_stream_event(&mut self, event: proto::StreamEvent) -> Result<(), Violation> {
        match event {
            proto::StreamEvent::Opened { dir: Dir::Bi } => self.accept_control()?,
            proto::StreamEvent::Opened { dir: Dir::Uni } => {
                while let Some(id) = self.conn.streams().accept(Dir::Uni) {
                    self.incoming.insert(id, Vec::new());
                    self.readable.insert(id);
                }
            }
            proto::StreamEvent::Readable { id } => {
                self.readable.insert(id);
            }
            proto::StreamEvent::Writable { id } if Some(id) == self.control => self.write_control(),
            proto::StreamEvent::Writable { id } => self.write_stream(id),
            proto::StreamEvent::Finished { id } => self.forget_outgoing(id),
            proto::StreamEvent::Stopped { id, .. } => {
                let _ = self.conn.send_stream(id).reset(CANCELLED);
                self.forget_outgoing(id);
            }
            proto::StreamEvent::Available { .. } => self.open_waiting(),
        }
        Ok(())
    }

    fn accept_control(&mut self) -> Result<(), Violation> {
        while let Some(id) = self.conn.streams().accept(Dir::Bi) {
            if self.control.is_some() {
                return Err(Violation("a second control stream".into()));
            }
            self.set_control(id);
            self.readable.insert(id);
        }
        self.write_control();
        Ok(())
    }

    fn forget_outgoing(&mut self, quic: proto::StreamId) {
        if let Some(outgoing) = self.by_quic.remove(&quic).and_then(|id| self.outgoing.remove(&id)) {
            self.queued_bytes -= outgoing.rest.len();
            self.unacknowledged_bytes -= outgoing.bytes;
        }
    }

    /// Whether [`Self::read`] may find something.
    pub(crate) fn has_readable(&self) -> bool {
        !self.closed && !self.readable.is_empty()
    }

    /// Reads one stream as far as it goes, and emits what is complete.
    pub(crate) fn read(&mut self, at_ns: i64, emit: &mut impl FnMut(Event)) -> Result<(), Violation> {
        let Some(id) = self.readable.pop_first() else { return Ok(()) };
        if Some(id) == self.control {
            self.read_control(id, at_ns, emit)
        } else {
            self.read_uni(id, at_ns, emit)
        }
    }

    fn read_control(
        &mut self,
        id: proto::StreamId,
        at_ns: i64,
        emit: &mut impl FnMut(Event),
    ) -> Result<(), Violation> {
        let mut stream = self.conn.recv_stream(id);
        let Ok(mut chunks) = stream.read(true) else { return Ok(()) };
        loop {
            let chunk = match chunks.next(MAX_CONTROL_BYTES) {
                Ok(Some(chunk)) => chunk,
                Ok(None) | Err(proto::ReadError::Reset(_)) => {
                    return Err(Violation("the control stream was ended".into()));
                }
                Err(proto::ReadError::Blocked) => break,
            };
            for message in self.control_in.push(&chunk.bytes)? {
                if !self.control_allowance.take(at_ns) {
                    let most = self.limits.control_per_s;
                    return Err(Violation(format!("more than {most} control messages a second")));
                }
                emit(Event::Control { peer: self.id, message, at_ns });
            }
        }
        // The connection is polled for transmits after each call anyway.
        let _ = chunks.finalize();
        Ok(())
    }

    fn read_uni(
        &mut self,
        id: proto::StreamId,
        at_ns: i64,
        emit: &mut impl FnMut(Event),
    ) -> Result<(), Violation> {
        let Some(bytes) = self.incoming.get_mut(&id) else { return Ok(()) };
        let mut stream = self.conn.recv_stream(id);
        let Ok(mut chunks) = stream.read(true) else { return Ok(()) };
        let before = bytes.len();
        let ended = loop {
            match chunks.next(usize::MAX) {
                Ok(Some(chunk)) => bytes.extend_from_slice(&chunk.bytes),
                Ok(None) => break Some(true),
                Err(proto::ReadError::Reset(_)) => break Some(false),
                Err(proto::ReadError::Blocked) => break None,
            }
            let limit = self.limits.max_stream_bytes;
            if bytes.len() > limit {
                return Err(Violation(format!("a stream of more than {limit} bytes")));
            }
        };
        let _ = chunks.finalize();
        self.incoming_bytes += bytes.len() - before;
        if let Some(complete) = ended {
            let mut bytes = self.incoming.remove(&id).unwrap_or_default();
            self.incoming_bytes -= bytes.len();
            if complete {
                emit(Event::Stream { peer: self.id, bytes, at_ns });
            } else {
                bytes.truncate(RESET_HEAD_BYTES);
                emit(Event::StreamReset { peer: self.id, head: bytes });
            }
        }
        // As much again as one stream may hold: a large one beside many small ones.
        let limit = 2 * self.limits.max_stream_bytes;
        if self.incoming_bytes > limit {
            return Err(Violation(format!("more than {limit} bytes in incomplete streams")));
        }
        Ok(())
    }
}

/// What only a broken peer does.
#[cfg(test)]
impl Peer {
    pub(crate) fn send_raw_control(&mut self, bytes: &[u8]) {
        self.reserve(bytes.len()).expect("room in the queue");
        self.control_out.push_back(Bytes::copy_from_slice(bytes));
        self.write_control();
    }

    pub(crate) fn send_unfinished(&mut self, bytes: &[u8]) {
        let id = self.conn.streams().open(Dir::Uni).expect("a free stream");
        let written = self.conn.send_stream(id).write(bytes).expect("room in the window");
        assert_eq!(written, bytes.len());
    }
}
