//! One QUIC endpoint as messages, without sockets and without a clock.
//!
//! Time and datagrams are arguments, so that the same code runs on real sockets ([`crate::mio`]) and on a virtual
//! clock ([`crate::pair`]). Between two peers there are
//! - one control stream of length-prefixed messages, both ways, in order;
//! - unidirectional streams from the server, each a message of its own, none of which waits for another;
//! - datagrams, which may be lost.
//!
//! With a seed, two runs that are fed the same times and bytes produce the same sequence of datagrams by time and
//! size: connection ids and all choices of the protocol come from the seed, keys and signatures have fixed sizes, and
//! the congestion controller draws no random numbers.
//!
//! # Congestion control
//!
//! Chosen by measurement (`cargo run --release -p shadecast-transport --example link_bench`, virtual time). Mbit/s and
//! round trip are those of a sender that always has something to send, over 10 s. The rest is the time in
//! milliseconds from sending to complete arrival of 60 KB pictures at 30 Hz with 20 KB of geometry beside each; the
//! first picture has 500 KB and finds a new connection. 20 ms each way, 100 Mbit/s, a queue of 200 ms.
//!
//! | link | controller | Mbit/s | round trip | first | p50 | p95 | p99 |
//! | --- | --- | --- | --- | --- | --- | --- | --- |
//! | no loss | ours | 95 | 80 | 62 | 25 | 25 | 25 |
//! | | Cubic | 95 | 203 | 83 | 25 | 25 | 25 |
//! | | BBR | 95 | 80 | 83 | 25 | 25 | 25 |
//! | 1 % loss, 5 ms jitter | ours | 93 | 69 | 98 | 29 | 74 | 77 |
//! | | Cubic | 4 | 45 | 145 | stalls | | |
//! | | BBR | 89 | 235 | 359 | 36 | 85 | 167 |
//! | 5 % loss, 5 ms jitter | ours | 89 | 70 | 107 | 71 | 130 | 164 |
//! | | Cubic | 1 | 39 | 262 | stalls | | |
//! | | BBR | 83 | 209 | 582 | 72 | 131 | 267 |
//!
//! Most pictures need 65 ms and more at 5 % because each has 50 packets, and a lost one costs another round trip.
//! Asking the receiver to acknowledge after 5 instead of 25 ms changed none of these figures by more than 2 ms, and is
//! not done.
//!
//! # Failures
//!
//! A connection outlives an outage of up to [`IDLE_TIMEOUT`]: neither side forgets it, and what was on its way is sent again, in
//! order, when the path carries something. A silent path is asked ten times a second, past the congestion window, which is full
//! of what was lost (module `silence`). After [`AWAY_AFTER`] the application learns that the peer is away. A client whose
//! address changes is answered at the new one, where its congestion state starts anew. A server that was restarted with the same identity
//! answers the packets of connections it does not know with a reset, so that its clients notice at once.
//!
//! # Hostile peers
//!
//! What one peer sends or has waiting costs another its fair share at most:
//! - what waits at the application is bounded for each peer by itself (module `inbox`), and so is what waits to be sent (module `outbox`);
//! - a client may open the control stream and no other, with a window of [`SERVER_WINDOW_BYTES`]; its messages and datagrams a second are
//!   bounded, and ten times as many datagrams end the connection;
//! - a handshake has [`HANDSHAKE_DEADLINE`]. As soon as one is under way, every other address must show by a round trip more that it is its
//!   own; a lone client does not pay for that. Too many handshakes push out the oldest of their own crowd (module `arrivals`);
//! - connections on their way out are few, and only peers that may have something to send are visited.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use bytes::{Bytes, BytesMut};
use quinn_proto as proto;
use quinn_proto::{
    ConnectionError, ConnectionHandle, ConnectionId, ConnectionIdGenerator, DatagramEvent, EcnCodepoint,
    TransportConfig, ValidationTokenConfig, VarInt, congestion,
};
use ring::rand::SecureRandom;
use shadecast_protocol::close::CloseCode;
use shadecast_protocol::limits::{
    MAX_CONTROL_PER_SECOND, MAX_DATAGRAM_BYTES, MAX_DATAGRAMS_PER_SECOND, MAX_STREAM_BYTES,
};
use shadecast_protocol::text::printable;

use crate::arrivals::{Arrivals, Network, given_up_for};
use crate::congestion::{INITIAL_WINDOW_BYTES, Probing, SteadyConfig, TargetRate};
use crate::event::{Binding, CloseKind, Event, PeerId, SendError, StreamId};
use crate::identity::tls::{self, PinVerifier};
use crate::identity::{ClientIdentity, ExpectedIdentity, IdentityError, ServerIdentity};
use crate::inbox::Inbox;
use crate::peer::{Peer, PeerLimits, Violation};
use crate::rng;
pub use crate::silence::AWAY_AFTER;
use crate::transmit::Transmit;

/// A peer from which nothing was heard for this long, and a moment more, is given up.
pub const IDLE_TIMEOUT: Duration = Duration::from_secs(60);
/// Round trip assumed before one was measured: of a home network, not of the Internet.
const INITIAL_RTT: Duration = Duration::from_millis(100);
/// How long either side waits for a handshake to end.
pub const HANDSHAKE_DEADLINE: Duration = Duration::from_secs(3);
/// Connections that a server keeps at all, those included that have ended and whose end the application has not taken.
const MAX_CONNECTIONS: usize = 512;
/// Connections on their way out; beyond that the oldest is forgotten, and its packets are answered like a stranger's.
const MAX_DRAINING: usize = 64;
/// Unidirectional streams that a server may have open at once.
const MAX_OPEN_STREAMS: u32 = 256;
/// Bytes that one of the server's streams, and all of them, may have under way: never the limit, the congestion window is.
const STREAM_WINDOW_BYTES: u32 = 16 << 20;
const CONNECTION_WINDOW_BYTES: u32 = 64 << 20;
/// Bytes that a client's control stream may have under way: what a server reads ahead.
pub const SERVER_WINDOW_BYTES: u32 = 256 << 10;
/// Bytes of datagrams that wait to be sent; the oldest are dropped.
const DATAGRAM_BUFFER_BYTES: usize = 64 << 10;
/// Received bytes of one peer that wait for the application; beyond them its streams are not read on, and its flow control
/// makes it wait. A server's streams bring much to its client, a client's messages little.
const CLIENT_WAITING_BYTES: usize = 64 << 20;
const SERVER_WAITING_BYTES: usize = 256 << 10;
/// Datagrams that are handed to the kernel at once: together no more than one UDP datagram may have, 65,507 bytes,
/// at the largest size that path discovery tries, 1452 bytes.
const MAX_SEGMENTS: usize = 40;
/// Room for one of them, bytes.
const TRANSMIT_BYTES_PER_SEGMENT: usize = 1500;

/// Which congestion controller to use. The module [`crate::congestion`] says why there is one of our own.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Congestion {
    /// [`crate::congestion::Steady`].
    #[default]
    Steady,
    /// quinn's Cubic.
    Cubic,
    /// quinn's BBR; its random numbers make runs differ.
    Bbr,
}

/// Settings of an endpoint.
#[derive(Clone, Debug)]
pub struct EndpointConfig {
    /// Makes runs repeatable; for tests and virtual time only, since connection ids become predictable.
    pub seed: Option<u64>,
    /// The congestion controller.
    pub congestion: Congestion,
    /// Connected peers that a server has at once; the next one is refused.
    pub max_peers: usize,
    /// Largest unidirectional stream accepted, bytes.
    pub max_stream_bytes: usize,
    /// Control messages a second, and at once after a pause, that a peer may send.
    pub control_per_s: u32,
    /// Datagrams a second, and at once after a pause, that are taken from a peer. Ten times as many end its connection.
    pub datagrams_per_s: u32,
    /// A server's packets leave twice on a path that loses some and carries more than is sent.
    pub repeats: bool,
}

impl Default for EndpointConfig {
    fn default() -> Self {
        Self {
            seed: None,
            congestion: Congestion::Steady,
            max_peers: 8,
            max_stream_bytes: MAX_STREAM_BYTES,
            control_per_s: MAX_CONTROL_PER_SECOND,
            datagrams_per_s: MAX_DATAGRAMS_PER_SECOND,
            repeats: true,
        }
    }
}

/// What is known of a connection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PeerStats {
    /// Smoothed round trip.
    pub rtt: Duration,
    /// Shortest round trip so far.
    pub min_rtt: Duration,
    /// UDP payload sent, bytes.
    pub sent_bytes: u64,
    /// UDP payload received, bytes.
    pub received_bytes: u64,
    /// Packets sent.
    pub sent_packets: u64,
    /// Packets taken for lost and sent again where they mattered.
    pub lost_packets: u64,
    /// UDP payload that was sent a second time because the path loses packets, bytes; not in `sent_bytes`.
    pub repeated_bytes: u64,
    /// What may be under way, bytes.
    pub window_bytes: u64,
    /// Largest UDP payload that the path is known to carry, bytes.
    pub mtu_bytes: u16,
    /// Messages and streams that wait for the network to take them, bytes.
    pub queued_bytes: u64,
    /// Streams that are not yet acknowledged to their end.
    pub streams_under_way: u64,
    /// Bytes of these streams, the whole of each.
    pub unacknowledged_bytes: u64,
    /// The best rate at which bytes were delivered in the last round trips, bit/s; 0 before anything is known.
    pub delivered_bit_per_s: u64,
    /// How fast to send, so that no queue stands, bit/s; 0 before anything is known.
    pub target_bit_per_s: u64,
    /// True while another flow fills the queue: packets wait as long as it makes them.
    pub is_competing: bool,
    /// True once the network, not what there was to send, has set that rate.
    pub bottleneck_known: bool,
}

/// What overflowed, since the endpoint was made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Received datagrams dropped because the application did not take them.
    pub datagrams_dropped: u64,
    /// Received datagrams dropped because their sender sends more than it may.
    pub datagrams_excess: u64,
    /// Datagrams that could not be sent: not connected, or larger than the path carries.
    pub datagrams_refused: u64,
    /// Messages and streams refused because the queue was full.
    pub sends_refused: u64,
    /// Connections refused because there were `max_peers` already.
    pub peers_refused: u64,
    /// Strangers who were asked to show that their address is their own.
    pub retries: u64,
    /// Handshakes given up: too slow, or too many at once.
    pub handshakes_given_up: u64,
    /// Peers whose connection was closed because they broke the rules.
    pub violations: u64,
}

/// Nanoseconds on the caller's clock as `Instant`s, which QUIC wants.
struct Clock {
    base: Instant,
}

impl Clock {
    fn instant(&self, ns: i64) -> Instant {
        let offset = Duration::from_nanos(ns.unsigned_abs());
        let moved = if ns >= 0 { self.base.checked_add(offset) } else { self.base.checked_sub(offset) };
        moved.unwrap_or(self.base)
    }

    fn ns(&self, instant: Instant) -> i64 {
        let clamp = |d: Duration| i64::try_from(d.as_nanos()).unwrap_or(i64::MAX);
        match instant.checked_duration_since(self.base) {
            Some(after) => clamp(after),
            None => -clamp(self.base.duration_since(instant)),
        }
    }
}

/// Connection ids: from the system's random numbers, or from a seed.
struct CidGenerator {
    seed: Option<u64>,
}

/// Bytes of a connection id.
const CID_BYTES: usize = 8;

impl ConnectionIdGenerator for CidGenerator {
    fn generate_cid(&mut self) -> ConnectionId {
        let mut bytes = [0; CID_BYTES];
        match &mut self.seed {
            Some(state) => bytes = rng::next(state).to_le_bytes(),
            None => fill_random(&mut bytes),
        }
        ConnectionId::new(&bytes)
    }

    fn cid_len(&self) -> usize {
        CID_BYTES
    }

    fn cid_lifetime(&self) -> Option<Duration> {
        None
    }
}

/// Bytes that nobody can guess, from the system's random numbers.
pub fn random_bytes<const N: usize>() -> [u8; N] {
    let mut bytes = [0; N];
    fill_random(&mut bytes);
    bytes
}

fn fill_random(bytes: &mut [u8]) {
    let filled = ring::rand::SystemRandom::new().fill(bytes);
    assert!(filled.is_ok(), "the system has no random numbers");
}

/// 32 bytes from the seed, or from the system's random numbers.
fn key_bytes(seed: Option<u64>, purpose: u64) -> [u8; 32] {
    seed.map_or_else(
        || {
            let mut bytes = [0; 32];
            fill_random(&mut bytes);
            bytes
        },
        |seed| rng::bytes32(seed, purpose),
    )
}

fn transport_config(congestion: Congestion, is_server: bool, steady: SteadyConfig) -> TransportConfig {
    let mut config = TransportConfig::default();
    let (stream_window, connection_window) = if is_server {
        (SERVER_WINDOW_BYTES, SERVER_WINDOW_BYTES)
    } else {
        (STREAM_WINDOW_BYTES, CONNECTION_WINDOW_BYTES)
    };
    // The idle time counts from the last sign of life or, if later, from our next question after it.
    let idle_ms = VarInt::from_u32(IDLE_TIMEOUT.as_millis() as u32);
    config
        .max_idle_timeout(Some(idle_ms.into()))
        .initial_rtt(INITIAL_RTT)
        // The control stream, which the client opens, and which is all that it opens.
        .max_concurrent_bidi_streams(VarInt::from_u32(u32::from(is_server)))
        .max_concurrent_uni_streams(VarInt::from_u32(if is_server { 0 } else { MAX_OPEN_STREAMS }))
        .stream_receive_window(VarInt::from_u32(stream_window))
        .receive_window(VarInt::from_u32(connection_window))
        .send_window(u64::from(CONNECTION_WINDOW_BYTES))
        // Of two pictures with the same priority the older one is to arrive first, not both late.
        .send_fairness(false)
        .datagram_receive_buffer_size(Some(DATAGRAM_BUFFER_BYTES))
        .datagram_send_buffer_size(DATAGRAM_BUFFER_BYTES);
    match congestion {
        Congestion::Steady => config.congestion_controller_factory(Arc::new(steady)),
        Congestion::Cubic => {
            let mut cubic = congestion::CubicConfig::default();
            cubic.initial_window(INITIAL_WINDOW_BYTES);
            config.congestion_controller_factory(Arc::new(cubic))
        }
        Congestion::Bbr => {
            let mut bbr = congestion::BbrConfig::default();
            bbr.initial_window(INITIAL_WINDOW_BYTES);
            config.congestion_controller_factory(Arc::new(bbr))
        }
    };
    config
}

/// Hands out ids that are never used twice, to the endpoint and to the handles of its thread.
#[derive(Clone, Debug, Default)]
pub(crate) struct IdSource(Arc<AtomicU64>);

impl IdSource {
    pub(crate) fn next(&self) -> u64 {
        self.0.fetch_add(1, Ordering::Relaxed)
    }
}

/// What becomes of a stranger's first packet.
enum Admission {
    Accept,
    /// The address must be shown to be the stranger's own.
    Retry,
    /// There are as many peers as there may be.
    Refuse,
    Ignore,
}

/// A QUIC endpoint: a server, or a client of any number of servers.
pub struct Endpoint {
    clock: Clock,
    config: EndpointConfig,
    proto: proto::Endpoint,
    /// What connections to a server begin with.
    server: Option<proto::ServerConfig>,
    probing: Probing,
    peers: BTreeMap<PeerId, Peer>,
    by_handle: HashMap<ConnectionHandle, PeerId>,
    inbox: Arc<Inbox>,
    /// Who a client says it is; a server's key is in `proto`. Why there is none is told when a connection is wanted.
    own: Option<Result<Arc<ClientIdentity>, String>>,
    responses: VecDeque<Transmit>,
    arrivals: Arrivals,
    /// Peers that may have something to send: something has happened to them since they had nothing.
    ready: BTreeSet<PeerId>,
    /// The peer that may send next, so that none starves the others.
    next_turn: PeerId,
    /// What the last transmit's bytes lay in.
    spare: Vec<u8>,
    is_server: bool,
    max_segments: usize,
    last_now_ns: i64,
    peer_ids: IdSource,
    stream_ids: IdSource,
    connects: u64,
    counters: Counters,
}

impl Endpoint {
    /// A server with this identity.
    pub fn server(identity: &ServerIdentity, config: EndpointConfig) -> Result<Self, IdentityError> {
        // The same after a restart: then connections of the time before can be told that they are gone.
        let reset_key = identity.derived_key("stateless reset");
        let mut server = proto::ServerConfig::with_crypto(tls::server_config(identity)?);
        let mut tokens = ValidationTokenConfig::default();
        tokens.sent(0);
        server.validation_token_config(tokens).max_incoming(64);
        Ok(Self::new(config, reset_key, Some(server)))
    }

    /// A client with this identity.
    pub fn client_as(identity: Arc<ClientIdentity>, config: EndpointConfig) -> Self {
        Self::new_client(Ok(identity), config)
    }

    /// A client that is a stranger everywhere: its identity is made for it alone, by the seed where there is one.
    pub fn client(config: EndpointConfig) -> Self {
        let identity = config.seed.map_or_else(ClientIdentity::generate, ClientIdentity::from_seed);
        Self::new_client(identity.map(Arc::new).map_err(|error| error.to_string()), config)
    }

    fn new_client(identity: Result<Arc<ClientIdentity>, String>, config: EndpointConfig) -> Self {
        let reset_key = key_bytes(config.seed, 1);
        let mut endpoint = Self::new(config, reset_key, None);
        endpoint.own = Some(identity);
        endpoint
    }

    fn new(config: EndpointConfig, reset_key: [u8; 32], server: Option<proto::ServerConfig>) -> Self {
        let is_server = server.is_some();
        let max_waiting_bytes = if is_server { SERVER_WAITING_BYTES } else { CLIENT_WAITING_BYTES };
        let reset_key = ring::hmac::Key::new(ring::hmac::HMAC_SHA256, &reset_key);
        let mut endpoint = proto::EndpointConfig::new(Arc::new(reset_key));
        let cid_seed = config.seed.map(|seed| seed ^ if is_server { 0x5e } else { 0xc1 });
        endpoint
            .rng_seed(Some(key_bytes(config.seed, if is_server { 2 } else { 3 })))
            .cid_generator(move || Box::new(CidGenerator { seed: cid_seed }));
        Self {
            clock: Clock { base: Instant::now() },
            config,
            proto: proto::Endpoint::new(Arc::new(endpoint), server.clone().map(Arc::new), true, None),
            server,
            probing: Probing::default(),
            peers: BTreeMap::new(),
            by_handle: HashMap::new(),
            inbox: Arc::new(Inbox::new(is_server, max_waiting_bytes)),
            own: None,
            responses: VecDeque::new(),
            arrivals: Arrivals::default(),
            ready: BTreeSet::new(),
            next_turn: PeerId(0),
            spare: Vec::new(),
            is_server,
            max_segments: 1,
            last_now_ns: 0,
            peer_ids: IdSource::default(),
            stream_ids: IdSource::default(),
            connects: 0,
            counters: Counters::default(),
        }
    }

    pub(crate) fn id_sources(&self) -> (IdSource, IdSource) {
        (self.peer_ids.clone(), self.stream_ids.clone())
    }

    pub(crate) fn inbox(&self) -> Arc<Inbox> {
        self.inbox.clone()
    }

    /// Whether this endpoint accepts connections.
    pub fn is_server(&self) -> bool {
        self.is_server
    }

    /// How many datagrams one [`Transmit`] may hold; 1 unless set.
    pub fn set_max_segments(&mut self, max_segments: usize) {
        self.max_segments = max_segments.clamp(1, MAX_SEGMENTS);
    }

    /// Starts a connection. `Connected` or `Closed` follows. An address that cannot be reached is a `Closed` too.
    pub fn connect(&mut self, now_ns: i64, remote: SocketAddr, expected: ExpectedIdentity) -> PeerId {
        let id = PeerId(self.peer_ids.next());
        self.connect_as(now_ns, id, remote, expected);
        id
    }

    pub(crate) fn connect_as(
        &mut self,
        now_ns: i64,
        id: PeerId,
        remote: SocketAddr,
        expected: ExpectedIdentity,
    ) {
        if let Err(reason) = self.try_connect(now_ns, id, remote, expected) {
            let reason = format!("connecting to {remote}: {reason}");
            self.inbox.close(id, Event::Closed { peer: id, kind: CloseKind::Error, reason });
        }
    }

    fn try_connect(
        &mut self,
        now_ns: i64,
        id: PeerId,
        remote: SocketAddr,
        expected: ExpectedIdentity,
    ) -> Result<(), String> {
        let verifier = PinVerifier::new(expected);
        let own = self.own.as_ref().ok_or("a server does not connect")?;
        let own = own.as_ref().map_err(Clone::clone)?;
        let tls = tls::client_config(own, verifier.clone()).map_err(|e| e.to_string())?;
        let mut config = proto::ClientConfig::new(tls);
        let (transport, target) = self.path_config();
        config.transport_config(transport);
        self.connects += 1;
        let cid = key_bytes(self.config.seed.map(|seed| seed.wrapping_add(self.connects)), 4);
        config.initial_dst_cid_provider(Arc::new(move || ConnectionId::new(&cid[..16])));
        let (handle, conn) = self
            .proto
            .connect(self.clock.instant(now_ns), config, remote, tls::SERVER_NAME)
            .map_err(|e| e.to_string())?;
        self.add_peer(now_ns, id, handle, (conn, target), Some(verifier));
        Ok(())
    }

    /// Of a new connection, and what its controllers tell.
    fn path_config(&self) -> (Arc<TransportConfig>, Arc<TargetRate>) {
        let steady = SteadyConfig::with_probing(&self.probing);
        let target = steady.target.clone();
        (Arc::new(transport_config(self.config.congestion, self.is_server, steady)), target)
    }

    fn add_peer(
        &mut self,
        now_ns: i64,
        id: PeerId,
        handle: ConnectionHandle,
        (conn, target): (proto::Connection, Arc<TargetRate>),
        verifier: Option<Arc<PinVerifier>>,
    ) {
        let EndpointConfig { max_stream_bytes, control_per_s, datagrams_per_s, .. } = self.config;
        let limits = PeerLimits { max_stream_bytes, control_per_s, datagrams_per_s };
        self.peers.insert(id, Peer::new(id, handle, (conn, target), verifier, limits, now_ns));
        self.by_handle.insert(handle, id);
        self.ready.insert(id);
    }

    /// Takes a datagram that was received. `ecn` are the two bits of its IP header, if known.
    pub fn handle_udp(
        &mut self,
        now_ns: i64,
        from: SocketAddr,
        to_ip: Option<IpAddr>,
        ecn: Option<u8>,
        bytes: BytesMut,
    ) {
        self.last_now_ns = now_ns;
        let now = self.clock.instant(now_ns);
        let mut response = Vec::new();
        let ecn = ecn.and_then(EcnCodepoint::from_bits);
        match self.proto.handle(now, from, to_ip, ecn, bytes, &mut response) {
            Some(DatagramEvent::ConnectionEvent(handle, event)) => {
                let Some(&id) = self.by_handle.get(&handle) else { return };
                if let Some(peer) = self.peers.get_mut(&id) {
                    peer.conn.handle_event(event);
                    self.heard(now_ns, id);
                }
                self.ready.insert(id);
                self.drive(now_ns, id);
            }
            Some(DatagramEvent::NewConnection(incoming)) => self.accept(now_ns, incoming),
            Some(DatagramEvent::Response(transmit)) => self.respond(transmit, response),
            None => {}
        }
    }

    /// Something came of a peer.
    fn heard(&mut self, now_ns: i64, id: PeerId) {
        let Some(peer) = self.peers.get_mut(&id) else { return };
        peer.remote = peer.conn.remote_address();
        if peer.silence.heard(now_ns) && peer.is_in_use() {
            self.inbox.push(id, Event::Back { peer: id, remote: peer.remote });
        }
    }

    /// Asks those who are silent whether they hear anything, and tells who is away.
    fn pass_silence(&mut self, now_ns: i64) {
        for peer in self.peers.values_mut().filter(|peer| peer.is_in_use()) {
            let (is_due, away_ns) = peer.silence.pass(now_ns);
            if is_due {
                self.ready.insert(peer.id);
            }
            if let Some(since_ns) = away_ns {
                self.inbox.push(peer.id, Event::Away { peer: peer.id, since_ns });
            }
        }
    }

    fn accept(&mut self, now_ns: i64, incoming: proto::Incoming) {
        let mut response = Vec::new();
        match self.admit(&incoming, now_ns) {
            Admission::Accept => {
                let half_open: Vec<_> = self.half_open().collect();
                if let Some(other) = given_up_for(incoming.remote_address().ip(), &half_open) {
                    self.give_up_handshake(now_ns, other);
                }
            }
            Admission::Retry => {
                self.counters.retries += 1;
                return match self.proto.retry(incoming, &mut response) {
                    Ok(transmit) => self.respond(transmit, response),
                    Err(error) => self.proto.ignore(error.into_incoming()),
                };
            }
            Admission::Refuse => {
                self.counters.peers_refused += 1;
                let transmit = self.proto.refuse(incoming, &mut response);
                return self.respond(transmit, response);
            }
            Admission::Ignore => return self.proto.ignore(incoming),
        }
        let (transport, target) = self.path_config();
        let config = self.server.clone().map(|mut server| {
            server.transport_config(transport);
            Arc::new(server)
        });
        match self.proto.accept(incoming, self.clock.instant(now_ns), &mut response, config) {
            Ok((handle, conn)) => {
                let id = PeerId(self.peer_ids.next());
                self.add_peer(now_ns, id, handle, (conn, target), None);
                self.drive(now_ns, id);
            }
            Err(refused) => {
                tracing::debug!("a connection attempt failed: {}", refused.cause);
                if let Some(transmit) = refused.response {
                    self.respond(transmit, response);
                }
            }
        }
    }

    fn admit(&mut self, incoming: &proto::Incoming, now_ns: i64) -> Admission {
        let network = Network::of(incoming.remote_address().ip());
        if self.connected_peers() >= self.config.max_peers {
            Admission::Refuse
        } else if !incoming.remote_address_validated() && self.half_open().next().is_some() {
            Admission::Retry
        } else if self.peers.len().max(self.inbox.waiting_peers()) >= MAX_CONNECTIONS {
            Admission::Ignore
        } else if self.arrivals.take(network, now_ns) {
            Admission::Accept
        } else {
            Admission::Ignore
        }
    }

    /// Those whose handshake is under way, from old to new.
    fn half_open(&self) -> impl Iterator<Item = (PeerId, IpAddr)> {
        self.peers.values().filter(|peer| peer.is_half_open()).map(|peer| (peer.id, peer.remote.ip()))
    }

    fn connected_peers(&self) -> usize {
        self.peers.values().filter(|peer| peer.is_in_use()).count()
    }

    fn give_up_handshake(&mut self, now_ns: i64, id: PeerId) {
        if !self.is_server {
            let Some(peer) = self.peers.get(&id) else { return };
            let (kind, reason) = explain(peer, ConnectionError::TimedOut);
            return self.end(now_ns, id, CloseCode::Leaving.code(), "no answer came", kind, reason);
        }
        self.counters.handshakes_given_up += 1;
        let why = "the handshake took too long, or others wait";
        self.end(now_ns, id, CloseCode::Full.code(), why, CloseKind::Local, why.into());
    }

    /// When the handshake of `peer` is given up, nanoseconds.
    fn handshake_deadline_ns(&self, peer: &Peer) -> Option<i64> {
        peer.is_half_open().then(|| peer.since_ns + HANDSHAKE_DEADLINE.as_nanos() as i64)
    }

    fn respond(&mut self, transmit: proto::Transmit, mut bytes: Vec<u8>) {
        bytes.truncate(transmit.size);
        // Answers to strangers: more than a few at once are an attack.
        if self.responses.len() < 64 {
            self.responses.push_back(to_transmit(&transmit, bytes));
        }
    }

    /// Tells the endpoint that time has passed; to be called when [`Self::poll_timeout`]'s time has come.
    pub fn handle_timeout(&mut self, now_ns: i64) {
        self.last_now_ns = now_ns;
        let now = self.clock.instant(now_ns);
        let late = self
            .peers
            .values()
            .filter(|peer| self.handshake_deadline_ns(peer).is_some_and(|at| at <= now_ns));
        for id in late.map(|peer| peer.id).collect::<Vec<_>>() {
            self.give_up_handshake(now_ns, id);
        }
        self.pass_silence(now_ns);
        let due: Vec<PeerId> = self
            .peers
            .iter_mut()
            .filter_map(|(&id, peer)| peer.conn.poll_timeout().is_some_and(|at| at <= now).then_some(id))
            .collect();
        for id in due {
            if let Some(peer) = self.peers.get_mut(&id) {
                peer.conn.handle_timeout(now);
            }
            self.ready.insert(id);
            self.drive(now_ns, id);
        }
    }

    /// When [`Self::handle_timeout`] wants to be called, nanoseconds.
    pub fn poll_timeout(&mut self) -> Option<i64> {
        let deadline_ns = self.peers.values().filter_map(|peer| self.handshake_deadline_ns(peer)).min();
        let in_use = self.peers.values().filter(|peer| peer.is_in_use());
        let silence_ns = in_use.map(|peer| peer.silence.next_ns()).min();
        let next = self.peers.values_mut().filter_map(|peer| peer.conn.poll_timeout()).min();
        let repeat_ns = self.peers.values().filter_map(|peer| peer.repeats.next_ns()).min();
        let others_ns = deadline_ns.into_iter().chain(silence_ns).chain(repeat_ns);
        next.map(|at| self.clock.ns(at)).into_iter().chain(others_ns).min()
    }

    /// The next thing to be sent.
    pub fn poll_transmit(&mut self, now_ns: i64) -> Option<Transmit> {
        self.last_now_ns = now_ns;
        if let Some(response) = self.responses.pop_front() {
            return Some(response);
        }
        if let Some(repeat) = self.next_repeat(now_ns) {
            return Some(repeat);
        }
        let now = self.clock.instant(now_ns);
        let mut bytes = std::mem::take(&mut self.spare);
        while let Some(id) = self.next_ready() {
            let Some(peer) = self.peers.get_mut(&id) else {
                self.ready.remove(&id);
                continue;
            };
            bytes.clear();
            bytes.reserve(TRANSMIT_BYTES_PER_SEGMENT * self.max_segments);
            let is_question = peer.silence.take_question();
            if is_question {
                peer.conn.ping();
            }
            self.probing.set(is_question);
            let max_segments = if is_question { 1 } else { self.max_segments };
            let transmit = peer.conn.poll_transmit(now, max_segments, &mut bytes);
            self.probing.set(false);
            if transmit.is_none() {
                self.ready.remove(&id);
            }
            self.drive(now_ns, id);
            if let Some(transmit) = transmit {
                self.next_turn = PeerId(id.0 + 1);
                bytes.truncate(transmit.size);
                let transmit = to_transmit(&transmit, bytes);
                if !is_question {
                    self.may_repeat(now_ns, id, &transmit);
                }
                return Some(transmit);
            }
            self.forget_oldest_draining();
        }
        self.spare = bytes;
        None
    }

    /// The next copy that is due.
    fn next_repeat(&mut self, now_ns: i64) -> Option<Transmit> {
        self.peers.values_mut().find_map(|peer| peer.repeats.take_due(now_ns))
    }

    /// Has packets of a server leave again where their path loses some.
    fn may_repeat(&mut self, now_ns: i64, id: PeerId, transmit: &Transmit) {
        let may_repeat = self.config.repeats && self.is_server;
        let Some(peer) = self.peers.get_mut(&id).filter(|peer| may_repeat && peer.is_in_use()) else {
            return;
        };
        let path = peer.conn.stats().path;
        peer.repeats.note(now_ns, transmit.to, [path.sent_packets, path.lost_packets]);
        peer.repeats.sent(now_ns, transmit, peer.target.bytes_s().map(|bytes_s| bytes_s as f64));
    }

    /// Whose turn it is of those that may have something to send.
    fn next_ready(&self) -> Option<PeerId> {
        self.ready.range(self.next_turn..).chain(self.ready.range(..self.next_turn)).next().copied()
    }

    /// Takes back the bytes of what has been sent, for the next.
    pub fn recycle(&mut self, sent: Transmit) {
        if sent.bytes.capacity() > self.spare.capacity() {
            self.spare = sent.bytes;
        }
    }

    /// Forgets the oldest connection on its way out where there are too many. Its last packet has been sent.
    fn forget_oldest_draining(&mut self) {
        let draining = self.peers.values().filter(|peer| peer.closed);
        let mut told = draining.clone().filter(|peer| !self.ready.contains(&peer.id));
        if draining.clone().count() <= MAX_DRAINING {
            return;
        }
        let Some((id, handle)) = told.next().map(|peer| (peer.id, peer.handle)) else { return };
        // The connection itself goes with its peer: no answer is for it.
        let _ = self.proto.handle_event(handle, proto::EndpointEvent::drained());
        self.forget(id);
    }

    /// The next event.
    pub fn poll_event(&mut self) -> Option<Event> {
        let event = self.inbox.pop();
        self.read_on();
        event.or_else(|| self.inbox.pop())
    }

    /// Reads what was left for want of room.
    pub(crate) fn read_on(&mut self) {
        let waiting: Vec<PeerId> =
            self.peers.values().filter(|peer| peer.has_readable()).map(|peer| peer.id).collect();
        for id in waiting {
            self.read(self.last_now_ns, id);
        }
    }

    /// Moves events between the connection and the endpoint, and turns those for the application into ours.
    fn drive(&mut self, now_ns: i64, id: PeerId) {
        loop {
            let Some(peer) = self.peers.get_mut(&id) else { return };
            // The application's events first: the endpoint's may end the connection.
            if let Some(event) = peer.conn.poll() {
                self.on_quic_event(now_ns, id, event);
            } else if let Some(event) = peer.conn.poll_endpoint_events() {
                let (handle, drained) = (peer.handle, event.is_drained());
                if let Some(answer) = self.proto.handle_event(handle, event) {
                    peer.conn.handle_event(answer);
                }
                if drained {
                    self.forget(id);
                }
            } else {
                return self.read(now_ns, id);
            }
        }
    }

    fn forget(&mut self, id: PeerId) {
        if let Some(peer) = self.peers.remove(&id) {
            self.by_handle.remove(&peer.handle);
            self.ready.remove(&id);
        }
    }

    fn on_quic_event(&mut self, now_ns: i64, id: PeerId, event: proto::Event) {
        let (connected, is_server) = (self.connected_peers(), self.is_server);
        let Some(peer) = self.peers.get_mut(&id).filter(|peer| !peer.closed) else { return };
        match event {
            proto::Event::Connected if is_server && connected >= self.config.max_peers => {
                self.counters.peers_refused += 1;
                let why = "it serves as many clients as it can";
                self.end(now_ns, id, CloseCode::Full.code(), why, CloseKind::Local, why.into());
            }
            proto::Event::Connected => {
                peer.on_connected();
                let session = peer.conn.crypto_session();
                let fingerprint = tls::fingerprint_of(session);
                // The handshake is over: there is always one.
                let binding = Binding(tls::binding_of(session).unwrap_or_else(random_bytes));
                self.inbox.push(id, Event::Connected { peer: id, remote: peer.remote, fingerprint, binding });
            }
            proto::Event::ConnectionLost { reason } => {
                peer.closed = true;
                let (kind, reason) = explain(peer, reason);
                self.report_closed(id, kind, reason);
            }
            proto::Event::Stream(event) => {
                // It may have let more be written.
                self.ready.insert(id);
                if let Err(violation) = peer.on_stream_event(event) {
                    self.close_violator(now_ns, id, &violation);
                }
            }
            proto::Event::DatagramReceived => self.read_datagrams(now_ns, id),
            proto::Event::HandshakeDataReady | proto::Event::DatagramsUnblocked => {}
        }
    }

    fn read_datagrams(&mut self, at_ns: i64, id: PeerId) {
        loop {
            let Some(peer) = self.peers.get_mut(&id) else { return };
            match peer.next_datagram(at_ns, &mut self.counters.datagrams_excess) {
                Ok(Some(bytes)) => {
                    let fits = self.inbox.push(id, Event::Datagram { peer: id, bytes: bytes.into(), at_ns });
                    self.counters.datagrams_dropped += u64::from(!fits);
                }
                Ok(None) => return,
                Err(violation) => return self.close_violator(at_ns, id, &violation),
            }
        }
    }

    /// Reads the streams of a peer as long as there is room for what they bring.
    fn read(&mut self, at_ns: i64, id: PeerId) {
        let Some(peer) = self.peers.get_mut(&id) else { return };
        while peer.has_readable() && self.inbox.has_room(id) {
            // What is read makes room, which the peer must be told.
            self.ready.insert(id);
            let mut emit = |event| {
                self.inbox.push(id, event);
            };
            if let Err(violation) = peer.read(at_ns, &mut emit) {
                return self.close_violator(at_ns, id, &violation);
            }
        }
    }

    fn close_violator(&mut self, now_ns: i64, id: PeerId, Violation(what): &Violation) {
        self.counters.violations += 1;
        let reason = format!("the peer broke the protocol: {what}");
        self.end(
            now_ns,
            id,
            CloseCode::Violation.code(),
            &format!("protocol broken: {what}"),
            CloseKind::Error,
            reason,
        );
    }

    /// Closes a connection; the peer learns `code` and `reason`. `Closed` follows here too.
    pub fn close(&mut self, now_ns: i64, id: PeerId, code: u32, reason: &str) {
        self.end(now_ns, id, code, reason, CloseKind::Local, format!("closed here: {reason}"));
    }

    fn end(&mut self, now_ns: i64, id: PeerId, code: u32, told: &str, kind: CloseKind, reason: String) {
        let Some(peer) = self.peers.get_mut(&id).filter(|peer| !peer.closed) else { return };
        peer.closed = true;
        let told = Bytes::copy_from_slice(told.as_bytes());
        peer.conn.close(self.clock.instant(now_ns), VarInt::from_u32(code), told);
        self.ready.insert(id);
        self.report_closed(id, kind, reason);
    }

    /// Strangers who never became clients are no news to a server.
    fn report_closed(&self, id: PeerId, kind: CloseKind, reason: String) {
        if !self.is_server || self.peers.get(&id).is_some_and(|peer| peer.connected) {
            self.inbox.close(id, Event::Closed { peer: id, kind, reason });
        }
    }

    /// Closes all connections.
    pub fn close_all(&mut self, now_ns: i64, code: u32, reason: &str) {
        for id in self.peers.keys().copied().collect::<Vec<_>>() {
            self.close(now_ns, id, code, reason);
        }
    }

    /// A peer to which something is to be sent.
    fn peer_mut(&mut self, id: PeerId) -> Result<&mut Peer, SendError> {
        let peer = self.peers.get_mut(&id).filter(|peer| !peer.closed).ok_or(SendError::NotConnected)?;
        self.ready.insert(id);
        Ok(peer)
    }

    fn count<T>(&mut self, sent: Result<T, SendError>) -> Result<T, SendError> {
        if sent.is_err() {
            self.counters.sends_refused += 1;
        }
        sent
    }

    /// Sends a message on the control stream; before the connection is ready it waits.
    pub fn send_control(&mut self, id: PeerId, message: &[u8]) -> Result<(), SendError> {
        let sent = self.peer_mut(id).and_then(|peer| peer.send_control(message));
        self.count(sent)
    }

    /// Sends `bytes` as a stream of its own. Streams of higher `priority` go first, of equal priority the older one.
    pub fn send_stream(&mut self, id: PeerId, bytes: Vec<u8>, priority: i32) -> Result<StreamId, SendError> {
        let stream = StreamId(self.stream_ids.next());
        self.send_stream_as(id, stream, bytes, priority).map(|()| stream)
    }

    pub(crate) fn send_stream_as(
        &mut self,
        id: PeerId,
        stream: StreamId,
        bytes: Vec<u8>,
        priority: i32,
    ) -> Result<(), SendError> {
        let sent = self.peer_mut(id).and_then(|peer| peer.send_stream(stream, bytes.into(), priority));
        self.count(sent)
    }

    /// Gives up a stream; the peer is told. `false` when there is nothing left to give up.
    pub fn cancel_stream(&mut self, id: PeerId, stream: StreamId) -> bool {
        self.peer_mut(id).is_ok_and(|peer| peer.cancel_stream(stream))
    }

    /// Sends a datagram of at most [`MAX_DATAGRAM_BYTES`], which may be lost; `false` when it cannot be sent at all.
    pub fn send_datagram(&mut self, id: PeerId, bytes: &[u8]) -> bool {
        let fits = bytes.len() <= MAX_DATAGRAM_BYTES;
        let bytes = Bytes::copy_from_slice(bytes);
        let sent = fits && self.peer_mut(id).is_ok_and(|peer| peer.send_datagram(bytes));
        self.counters.datagrams_refused += u64::from(!sent);
        sent
    }

    /// Smoothed round trip to a peer.
    pub fn rtt(&self, id: PeerId) -> Option<Duration> {
        self.peers.get(&id).map(|peer| peer.conn.rtt())
    }

    /// What is known of a connection.
    pub fn stats(&self, id: PeerId) -> Option<PeerStats> {
        let peer = self.peers.get(&id)?;
        let stats = peer.conn.stats();
        let congestion = peer.conn.congestion_state().metrics();
        Some(PeerStats {
            rtt: stats.path.rtt,
            min_rtt: stats.path.min_rtt,
            sent_bytes: stats.udp_tx.bytes,
            received_bytes: stats.udp_rx.bytes,
            sent_packets: stats.path.sent_packets,
            lost_packets: stats.path.lost_packets,
            repeated_bytes: peer.repeats.repeated_bytes(),
            window_bytes: congestion.congestion_window,
            mtu_bytes: stats.path.current_mtu,
            queued_bytes: peer.queued_bytes() as u64,
            streams_under_way: peer.streams_under_way() as u64,
            unacknowledged_bytes: peer.unacknowledged_bytes() as u64,
            delivered_bit_per_s: congestion.pacing_rate.unwrap_or(0),
            target_bit_per_s: peer.target.bytes_s().unwrap_or(0) * 8,
            is_competing: peer.target.is_competing(),
            bottleneck_known: congestion.ssthresh.is_some(),
        })
    }

    /// The peers whose connections are in use or being made.
    pub fn peers(&self) -> impl Iterator<Item = PeerId> {
        self.peers.values().filter(|peer| !peer.closed).map(|peer| peer.id)
    }

    /// What overflowed so far.
    pub fn counters(&self) -> Counters {
        self.counters
    }
}

fn to_transmit(transmit: &proto::Transmit, bytes: Vec<u8>) -> Transmit {
    Transmit {
        to: transmit.destination,
        from_ip: transmit.src_ip,
        bytes,
        segment_size: transmit.segment_size,
        ecn: transmit.ecn.map(|ecn| ecn as u8),
    }
}

/// TLS alert "no application protocol" as a QUIC error code (RFC 9001, section 4.8; RFC 7301).
const NO_APPLICATION_PROTOCOL: u64 = 0x100 + 120;

/// Why a connection was lost, for programs and for users.
fn explain(peer: &Peer, error: ConnectionError) -> (CloseKind, String) {
    let remote = peer.remote;
    if let Some(refusal) = peer.verifier.as_ref().and_then(|verifier| verifier.refusal()) {
        return (CloseKind::IdentityChanged, format!("{remote}: {refusal}"));
    }
    let other_protocol = || {
        format!(
            "{remote} speaks another protocol than Shadecast's; update the older side, or check the address"
        )
    };
    match error {
        ConnectionError::TimedOut if !peer.connected => (
            CloseKind::TimedOut,
            format!("{remote} did not answer: check that the server runs there and that UDP is not blocked"),
        ),
        ConnectionError::TimedOut => (
            CloseKind::TimedOut,
            format!(
                "nothing was heard from {remote} for {} s: it stopped or the network is down",
                IDLE_TIMEOUT.as_secs()
            ),
        ),
        ConnectionError::Reset => (
            CloseKind::Restarted,
            format!("{remote} was restarted and does not know this connection any more"),
        ),
        ConnectionError::ApplicationClosed(close) => (
            CloseKind::Peer(close.error_code.into_inner()),
            format!("{remote} closed the connection: {}", printable(&String::from_utf8_lossy(&close.reason))),
        ),
        ConnectionError::VersionMismatch => (CloseKind::Error, other_protocol()),
        ConnectionError::ConnectionClosed(close)
            if u64::from(close.error_code) == NO_APPLICATION_PROTOCOL =>
        {
            (CloseKind::Error, other_protocol())
        }
        ConnectionError::ConnectionClosed(close)
            if close.error_code == proto::TransportErrorCode::CONNECTION_REFUSED =>
        {
            (
                CloseKind::Error,
                format!("{remote} refused the connection: it serves as many clients as it can"),
            )
        }
        // It may quote the peer.
        other => (CloseKind::Error, format!("connection to {remote}: {}", printable(&other.to_string()))),
    }
}

#[cfg(test)]
mod tests;
