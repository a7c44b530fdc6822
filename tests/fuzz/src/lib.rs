//! What must hold of the readers of what peers send, as functions of the bytes that they send.
//!
//! The fuzz targets call them with what libFuzzer makes of the seeds; `tests/seeds.rs` calls them with the seeds
//! themselves, on the ordinary compiler. Each says how far it got, so that seeds that are turned away at the first bytes
//! are noticed. The seeds of the state machines are recorded traffic in the form of [`script`]; `shadecast-lab
//! record-traffic` makes them anew.

pub mod client_session;
#[cfg(feature = "decoder")]
pub mod decoder;
pub mod deltas;
pub mod framing;
pub mod messages;
pub mod pairing;
pub mod pictures;
pub mod script;
pub mod server_session;
pub mod sps;
