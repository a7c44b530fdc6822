//! QUIC on mio, server identity and the simulated link.
//!
//! Three layers, so that the same connection runs on real sockets and on a virtual clock:
//! - [`endpoint`] is the connection as messages, without sockets and without a clock;
//! - [`link`] is a seeded network with latency, jitter, loss, a bottleneck and reordering, and [`pair`] joins two
//!   endpoints with it in virtual time;
//! - [`mio`], [`identity`] and [`files`] are the only modules that touch sockets and files.

pub mod congestion;
pub mod endpoint;
pub mod files;
pub mod identity;
mod inbox;
pub mod link;
pub mod mio;
pub mod pair;
mod peer;
mod rng;

pub use endpoint::{
    CloseKind, Congestion, Counters, Endpoint, EndpointConfig, Event, PeerId, PeerStats, SendError, StreamId,
    Transmit, random_bytes,
};
pub use files::{PendingFile, remove_pending_files, write_atomically};
pub use identity::tls::ALPN;
pub use identity::{ExpectedIdentity, Fingerprint, IdentityError, KnownServers, Meeting, ServerIdentity};
pub use link::{Direction, Link, LinkError, LinkProfile, LinkSchedule};
pub use mio::{Driver, Events, Handle, monotonic_now_ns, spawn};
pub use pair::Pair;
