//! Servers of the network that somebody is in, found without typing an address: DNS-SD over multicast DNS (RFC 6762 and
//! 6763). A server announces itself ([`announce`]), a client asks once and takes the answers ([`search`]). What an answer
//! says is a stranger's word: who answers at the address must have the key that was announced, or that is known.

#[cfg(feature = "announce")]
pub mod announce;
pub mod packet;
pub mod search;

pub use packet::FoundServer;

/// The service, without the domain.
pub const SERVICE: &str = "_shadecast._udp";
/// Key of the server's fingerprint in its TXT record.
const FINGERPRINT_KEY: &str = "id";
