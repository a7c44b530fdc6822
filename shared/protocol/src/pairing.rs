//! The messages by which a client becomes known to a server. What their bytes mean is not the protocol's affair: the transport
//! has the exchange.

use serde::{Deserialize, Serialize};

/// Bytes of a group element and of a proof.
pub type Word = [u8; 32];

/// A client's steps, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ClientPairing {
    /// A code is shown.
    Offer {
        /// The client's part of the exchange.
        element: Word,
    },
    /// The typed code is the one that is shown.
    Proof {
        /// That the client has it.
        proof: Word,
    },
    /// The typed code is another one.
    WrongCode,
}

/// A server's steps, in order. A welcome follows, or a refusal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ServerPairing {
    /// The client is not known here: it is to show a code.
    Needed {
        /// How long the code may be typed, milliseconds.
        patience_ms: u32,
    },
    /// A code was typed.
    Answer {
        /// The server's part of the exchange.
        element: Word,
        /// That the server has the code.
        proof: Word,
    },
}
