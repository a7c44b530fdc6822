//! The agreement of server and client: ids, time, limits, atlas addressing, messages, the vertex codec and the session state
//! machines. Pure: no GPU, no socket, no clock; time and bytes are arguments.
#![forbid(unsafe_code)]

pub mod atlas;
pub mod bit_set;
pub mod clock;
pub mod close;
pub mod coverage;
pub mod delta;
pub mod geometry;
pub mod ids;
pub mod limits;
pub mod memory;
pub mod message;
pub mod motion;
pub mod pairing;
pub mod picture;
mod range;
pub mod session;
pub mod wire;
pub mod world_clock;

pub use shadecast_model::{pose, text, time};

#[cfg(test)]
mod goldens;
#[cfg(test)]
mod testing;

/// Version of the wire format. A change of the bytes without a change of this number fails the wire goldens.
pub const PROTOCOL_VERSION: u32 = 10;
