//! Asks all networks of this machine once, and takes the unicast answers (RFC 6762, 5.1 and 6.7). It needs neither port 5353
//! nor the permission to receive multicast.

use super::packet::{FoundServer, MAX_ADDRESSES, question, servers};
use crate::endpoint::random_bytes;
use socket2::{Domain, Protocol, Socket, Type};
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddrV4, UdpSocket};
use std::time::{Duration, Instant};

/// Where questions go.
const GROUP: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(224, 0, 0, 251), 5353);
/// Datagrams of a search that are looked at; a flood ends it.
const MAX_DATAGRAMS: usize = 256;
/// Servers that a search finds at most: more than a household has, and than anybody chooses from.
const MAX_FOUND: usize = 64;
/// From one look at a socket to the next, also at one that has nothing but errors.
const TURN: Duration = Duration::from_millis(20);
/// The largest answer, bytes.
const MAX_DATAGRAM_BYTES: usize = 9000;

/// Asks on every IPv4 network of this machine, and waits `patience` for answers: each server once.
///
/// # Errors
/// There is no network to ask on.
pub fn search(patience: Duration) -> io::Result<Vec<FoundServer>> {
    let id = u16::from_be_bytes(random_bytes());
    Ok(collect(&ask(&question(id))?, id, patience))
}

/// Where datagrams come from.
trait Receives {
    /// The next one's length; an error after [`TURN`] without any.
    fn receive(&self, datagram: &mut [u8]) -> io::Result<usize>;
}

impl Receives for UdpSocket {
    fn receive(&self, datagram: &mut [u8]) -> io::Result<usize> {
        self.recv_from(datagram).map(|(length, _)| length)
    }
}

/// Whom the answers to question `id` name that come within `patience`.
fn collect(sockets: &[impl Receives], id: u16, patience: Duration) -> Vec<FoundServer> {
    let deadline = Instant::now() + patience;
    let mut found = Vec::new();
    let mut buffer = [0; MAX_DATAGRAM_BYTES];
    let mut datagrams = 0;
    while Instant::now() < deadline && datagrams < MAX_DATAGRAMS {
        for socket in sockets {
            match socket.receive(&mut buffer) {
                Ok(length) => {
                    datagrams += 1;
                    servers(&buffer[..length], id).into_iter().for_each(|server| add(&mut found, server));
                }
                Err(error) if is_timeout(&error) => {}
                // One network's affair, such as a cable that was pulled; it comes without a wait, and perhaps again.
                Err(_) => std::thread::sleep(TURN),
            }
        }
    }
    found
}

fn is_timeout(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut)
}

/// The same server on two networks is one with two addresses. What is more than anybody has is a liar's, and is left out.
fn add(found: &mut Vec<FoundServer>, server: FoundServer) {
    let Some(known) = found.iter_mut().find(|known| known.is_same(&server)) else {
        if found.len() < MAX_FOUND {
            found.push(server);
        }
        return;
    };
    for address in server.addresses {
        if known.addresses.len() < MAX_ADDRESSES && !known.addresses.contains(&address) {
            known.addresses.push(address);
        }
    }
}

/// A socket on each network that has taken the question.
fn ask(question: &[u8]) -> io::Result<Vec<UdpSocket>> {
    let interfaces = if_addrs::get_if_addrs()?;
    let mut last = io::Error::new(io::ErrorKind::NotFound, "this machine has no IPv4 network");
    let mut sockets = Vec::new();
    for interface in interfaces {
        let IpAddr::V4(address) = interface.ip() else { continue };
        let asked = || {
            let socket = socket_on(address)?;
            socket.send_to(question, GROUP)?;
            Ok(socket)
        };
        match asked() {
            Ok(socket) => sockets.push(socket),
            Err(error) => last = error,
        }
    }
    if sockets.is_empty() { Err(last) } else { Ok(sockets) }
}

fn socket_on(address: Ipv4Addr) -> io::Result<UdpSocket> {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    socket.bind(&SocketAddrV4::new(address, 0).into())?;
    socket.set_multicast_if_v4(&address)?;
    socket.set_multicast_ttl_v4(255)?;
    // A server on this machine hears it too.
    socket.set_multicast_loop_v4(true)?;
    socket.set_read_timeout(Some(TURN))?;
    Ok(socket.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::Cell;
    use std::net::SocketAddr;

    /// A socket of a network that is gone.
    #[derive(Default)]
    struct Broken {
        looks: Cell<u32>,
    }

    impl Receives for Broken {
        fn receive(&self, _: &mut [u8]) -> io::Result<usize> {
            self.looks.set(self.looks.get() + 1);
            Err(io::ErrorKind::NetworkDown.into())
        }
    }

    #[test]
    fn a_socket_that_only_fails_is_looked_at_once_a_turn() {
        let socket = [Broken::default()];
        assert_eq!(collect(&socket, 1, 4 * TURN), []);
        let looks = socket[0].looks.get();
        assert!((1..=5).contains(&looks), "{looks} looks in four turns");
    }

    fn server(name: usize, host: u8) -> FoundServer {
        let address = SocketAddr::from(([10, 0, 0, host], 7400));
        FoundServer { name: name.to_string(), addresses: vec![address], fingerprint: None }
    }

    #[test]
    fn one_server_on_two_networks_is_one_and_lies_are_bounded() {
        let mut found = Vec::new();
        for host in [1, 2, 1] {
            add(&mut found, server(0, host));
        }
        assert_eq!((found.len(), found[0].addresses.len()), (1, 2));
        (0..=255).for_each(|host| add(&mut found, server(0, host)));
        assert_eq!(found[0].addresses.len(), MAX_ADDRESSES);
        (0..1000).for_each(|name| add(&mut found, server(name, 1)));
        assert_eq!(found.len(), MAX_FOUND);
    }
}
