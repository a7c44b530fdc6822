//! Asks all networks of this machine once, and takes the unicast answers (RFC 6762, 5.1 and 6.7). It needs neither port 5353
//! nor the permission to receive multicast.

use super::packet::{FoundServer, MAX_ADDRESSES, question, servers};
use crate::endpoint::random_bytes;
use socket2::{Domain, Protocol, Socket, Type};
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, SocketAddrV6, UdpSocket};
use std::time::{Duration, Instant};

/// Where questions go, by the version of IP.
const GROUP_V4: Ipv4Addr = Ipv4Addr::new(224, 0, 0, 251);
const GROUP_V6: Ipv6Addr = Ipv6Addr::new(0xff02, 0, 0, 0, 0, 0, 0, 0xfb);
const PORT: u16 = 5353;
/// The farthest that multicast DNS goes: RFC 6762, 11.
const HOPS: u32 = 255;
/// Datagrams of a search that are looked at; a flood ends it.
const MAX_DATAGRAMS: usize = 256;
/// Servers that a search finds at most: more than a household has, and than anybody chooses from.
const MAX_FOUND: usize = 64;
/// From one look at a socket to the next, also at one that has nothing but errors.
const TURN: Duration = Duration::from_millis(20);
/// The largest answer, bytes.
const MAX_DATAGRAM_BYTES: usize = 9000;

/// Asks on every network of this machine, by IPv4 and IPv6, and waits `patience` for answers: each server once.
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
    let mut last = io::Error::new(io::ErrorKind::NotFound, "this machine has no network");
    let mut sockets = Vec::new();
    for interface in if_addrs::get_if_addrs()? {
        match ask_on(interface.ip(), interface.index.unwrap_or(0), question) {
            Ok(socket) => sockets.push(socket),
            Err(error) => last = error,
        }
    }
    if sockets.is_empty() { Err(last) } else { Ok(sockets) }
}

/// A socket at an address of the machine's interface of that number, which has sent the question.
fn ask_on(address: IpAddr, interface: u32, question: &[u8]) -> io::Result<UdpSocket> {
    let socket = Socket::new(Domain::for_address((address, 0).into()), Type::DGRAM, Some(Protocol::UDP))?;
    // A server on this machine hears it too.
    let (own, group): (SocketAddr, SocketAddr) = match address {
        IpAddr::V4(address) => {
            socket.set_multicast_if_v4(&address)?;
            socket.set_multicast_ttl_v4(HOPS)?;
            socket.set_multicast_loop_v4(true)?;
            ((address, 0).into(), (GROUP_V4, PORT).into())
        }
        IpAddr::V6(address) => {
            socket.set_multicast_if_v6(interface)?;
            socket.set_multicast_hops_v6(HOPS)?;
            socket.set_multicast_loop_v6(true)?;
            let on_interface = |ip, port| SocketAddrV6::new(ip, port, 0, interface).into();
            (on_interface(address, 0), on_interface(GROUP_V6, PORT))
        }
    };
    socket.bind(&own.into())?;
    socket.set_read_timeout(Some(TURN))?;
    socket.send_to(question, &group.into())?;
    Ok(socket.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::Cell;

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
