//! Datagrams on their way from an endpoint to a socket or a simulated link.

use std::net::{IpAddr, SocketAddr};

/// One or more datagrams to be sent to one address.
#[derive(Clone, Debug)]
pub struct Transmit {
    /// Where to.
    pub to: SocketAddr,
    /// From which of the machine's addresses, where that matters.
    pub from_ip: Option<IpAddr>,
    /// The payload of the datagrams, one after the other.
    pub bytes: Vec<u8>,
    /// Size of each datagram but the last, bytes; `None` for a single datagram.
    pub segment_size: Option<usize>,
    /// Congestion mark for the IP header, as the two bits of RFC 3168.
    pub ecn: Option<u8>,
}

impl Transmit {
    /// The payload of each datagram.
    pub fn datagrams(&self) -> impl Iterator<Item = &[u8]> {
        self.bytes.chunks(self.segment_size.unwrap_or(self.bytes.len()).max(1))
    }
}
