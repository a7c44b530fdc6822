//! Discovery of servers on the local network: DNS-SD over multicast DNS (RFC 6762 and 6763). A server announces itself
//! ([`announce`]); a client asks once and takes the answers ([`search`]). An answer is not trusted: the server at the address
//! must have the announced key, or the known one.

#[cfg(feature = "announce")]
pub mod announce;
pub mod packet;
pub mod search;

pub use packet::FoundServer;

/// The service, without the domain.
pub const SERVICE: &str = "_shadecast._udp";
/// Key of the server's fingerprint in its TXT record.
const FINGERPRINT_KEY: &str = "id";
