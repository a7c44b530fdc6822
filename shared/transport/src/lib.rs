//! QUIC on mio, identities and the simulated link.
//!
//! Three layers, so that the same connection runs on real sockets and on a virtual clock:
//! - [`endpoint`] is the connection as messages, without sockets and without a clock, and [`event`] what it tells;
//! - [`link`] is a seeded network with latency, jitter, loss, a bottleneck and reordering, and [`pair`] joins two
//!   endpoints with it in virtual time;
//! - [`mio`], [`discovery`] and [`identity`] are the only modules that touch sockets and files.

mod allowance;
mod arrivals;
pub mod congestion;
mod cross_traffic;
pub mod discovery;
pub mod endpoint;
pub mod event;
pub mod identity;
mod inbox;
pub mod link;
pub mod mio;
pub mod neighbour;
mod outbox;
pub mod pair;
mod peer;
mod repeats;
mod rng;
mod silence;
mod target;
mod train;
mod transmit;

pub use arrivals::{Network, crowded};
pub use endpoint::{Congestion, Counters, Endpoint, EndpointConfig, PeerStats, random_bytes};
pub use event::{Binding, CloseKind, Event, PeerId, SendError, StreamId};
pub use identity::tls::{SERVER_NAME, believing_client_crypto};
pub use identity::{
    ClientIdentity, ExpectedIdentity, Fingerprint, IdentityError, KnownServers, LastServer, Meeting,
    ServerIdentity,
};
pub use link::{Direction, Link, LinkError, LinkProfile, LinkSchedule};
pub use mio::{Driver, Events, Handle, SocketTrial, spawn, try_socket};
pub use pair::Pair;
pub use transmit::Transmit;
