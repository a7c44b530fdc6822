//! Pairing with six digits: a headset has no keyboard, so it shows a code, and the code is typed at the server.
//!
//! Random bytes, time and the bytes that bind to a connection enter; what to send leaves. Nothing here knows sockets, files
//! and messages. [`Panel`] is the client's half, [`Desk`] the server's.
//!
//! SPAKE2 makes a strong key of the weak code, with both fingerprints as identities. Each side then proves over the TLS
//! exporter's bytes that it has that key. Someone between the two ends has two connections, hence two exporters and two keys,
//! and gets one guess out of a million at a code that is used once.

mod code;
mod desk;
mod exchange;
mod lockout;
mod panel;

pub use code::{Code, CodeError};
pub use desk::{Desk, Judgement, Overdue, TurnedAway, TypingError, Unasked};
pub use exchange::{Answer, Ends, WrongCode};
pub use lockout::{Closed, FREE_FAILURES};
pub use panel::{AnswerError, Panel};

/// How long a code may be typed, nanoseconds.
pub const PATIENCE_NS: i64 = 60_000_000_000;
/// How long a client may take to prove that it has the typed code, nanoseconds.
const PROOF_NS: i64 = 10_000_000_000;

/// Bytes of a group element and of a proof.
pub type Word = [u8; 32];

#[cfg(test)]
mod tests;
