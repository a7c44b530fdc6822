//! Asks all networks of this machine once, and takes the answers that come to the asker alone (RFC 6762, 5.1 and 6.7): needs
//! neither port 5353 nor the permission to hear what is sent to all.

use super::packet::{FoundServer, question, servers};
use crate::endpoint::random_bytes;
use socket2::{Domain, Protocol, Socket, Type};
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};
use std::time::{Duration, Instant};

/// Where questions go.
const GROUP: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(224, 0, 0, 251), 5353);
/// Datagrams of a search that are looked at; a flood ends it.
const MAX_DATAGRAMS: usize = 256;
/// From one look at a socket to the next.
const TURN: Duration = Duration::from_millis(20);
/// The largest answer, bytes.
const MAX_DATAGRAM_BYTES: usize = 9000;

/// Asks on every IPv4 network of this machine, and waits `patience` for answers: each server once.
///
/// # Errors
/// There is no network to ask on.
pub fn search(patience: Duration) -> io::Result<Vec<FoundServer>> {
    let id = u16::from_be_bytes(random_bytes());
    let sockets = ask(&question(id))?;
    let deadline = Instant::now() + patience;
    let mut found: Vec<FoundServer> = Vec::new();
    let mut buffer = [0; MAX_DATAGRAM_BYTES];
    let mut datagrams = 0;
    while Instant::now() < deadline && datagrams < MAX_DATAGRAMS {
        for socket in &sockets {
            // An error is one network's: an answer that never came back, a cable that was pulled.
            let Ok((length, _)) = socket.recv_from(&mut buffer) else { continue };
            datagrams += 1;
            servers(&buffer[..length], id).into_iter().for_each(|server| add(&mut found, server));
        }
    }
    Ok(found)
}

/// The same server on two networks is one with two addresses.
fn add(found: &mut Vec<FoundServer>, server: FoundServer) {
    let is_same =
        |known: &&mut FoundServer| known.name == server.name && known.fingerprint == server.fingerprint;
    match found.iter_mut().find(is_same) {
        Some(known) => {
            let new = server.addresses.into_iter().filter(|address| !known.addresses.contains(address));
            let new: Vec<SocketAddr> = new.collect();
            known.addresses.extend(new);
        }
        None => found.push(server),
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
