//! Clients that are served: sessions, viewers, the scheduler of their updates, and the threads and sockets around them.
//!
//! Events of the transport enter; streams leave. Nothing here knows how an update is made.

pub mod cause_bits;
pub mod encoding;
pub mod scheduler;
pub mod sessions;
pub mod stream;
pub mod viewer;
