//! What an endpoint tells its application: which peer, what happened, and why something was not sent.

use std::net::SocketAddr;

use crate::identity::Fingerprint;

/// A connection, never used twice by one endpoint.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PeerId(pub u64);

/// What both ends of one connection can derive and others cannot (the TLS exporter's bytes).
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Binding(pub [u8; 32]);

impl std::fmt::Debug for Binding {
    /// Without the bytes: logs are read by others.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Binding(..)")
    }
}

/// A unidirectional stream that this endpoint sends, never used twice.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct StreamId(pub u64);

/// Why a connection ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CloseKind {
    /// This side closed it.
    Local,
    /// The peer's application closed it, with this code.
    Peer(u64),
    /// Nothing was heard from the peer for [`IDLE_TIMEOUT`](crate::endpoint::IDLE_TIMEOUT), or nobody answered.
    TimedOut,
    /// The peer does not know the connection: it was restarted.
    Restarted,
    /// The server is not the one that was pinned.
    IdentityChanged,
    /// The peer broke the rules, or the two speak different protocols.
    Error,
}

/// What happened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Event {
    /// A connection is ready for use.
    Connected {
        /// The peer.
        peer: PeerId,
        /// Its address.
        remote: SocketAddr,
        /// Whose key the peer has proved to have.
        fingerprint: Option<Fingerprint>,
        /// Bytes that this end and the peer derive from the keys of this connection, and nobody else: what is proved over them
        /// is proved for this connection alone.
        binding: Binding,
    },
    /// A message on the control stream; never empty.
    Control {
        /// The peer.
        peer: PeerId,
        /// The message.
        message: Vec<u8>,
        /// When its last byte was received, nanoseconds on the endpoint's clock.
        at_ns: i64,
    },
    /// A unidirectional stream, complete.
    Stream {
        /// The peer.
        peer: PeerId,
        /// All of its bytes.
        bytes: Vec<u8>,
        /// When its last byte was received, nanoseconds on the endpoint's clock.
        at_ns: i64,
    },
    /// The peer gave up a stream before it was complete.
    StreamReset {
        /// The peer.
        peer: PeerId,
        /// The first bytes of it, as far as they had come and at most 64.
        head: Vec<u8>,
    },
    /// A datagram.
    Datagram {
        /// The peer.
        peer: PeerId,
        /// Its bytes.
        bytes: Vec<u8>,
        /// When it was received, nanoseconds on the endpoint's clock.
        at_ns: i64,
    },
    /// Nothing was heard from a connected peer for [`AWAY_AFTER`](crate::endpoint::AWAY_AFTER). The connection stands: what
    /// is sent waits, and arrives when the peer is back.
    Away {
        /// The peer.
        peer: PeerId,
        /// When it was heard last, nanoseconds on the endpoint's clock.
        since_ns: i64,
    },
    /// A peer that was away is heard again.
    Back {
        /// The peer.
        peer: PeerId,
        /// Its address, which may be another one than before.
        remote: SocketAddr,
    },
    /// A connection ended, or could not be made. Nothing more is told about the peer.
    Closed {
        /// The peer.
        peer: PeerId,
        /// Why, for programs.
        kind: CloseKind,
        /// Why, for users.
        reason: String,
    },
}

/// Why something could not be sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SendError {
    /// The peer is unknown or its connection has ended.
    #[error("the peer is not connected")]
    NotConnected,
    /// The network thread has ended.
    #[error("the network thread has ended; its reason is in the log")]
    Stopped,
    /// Only a server sends streams.
    #[error("a client sends no streams; use a control message or a datagram")]
    ClientStream,
    /// The queue is full: the network takes less than is sent.
    #[error("the send queue is full: the network is slower than the sender; send less or cancel old streams")]
    QueueFull,
    /// The message is empty or too large.
    #[error("a message has {bytes} bytes; 1 to {limit} are allowed")]
    Size {
        /// Its size.
        bytes: usize,
        /// The largest allowed.
        limit: usize,
    },
}
