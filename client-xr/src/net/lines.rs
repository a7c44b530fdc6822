//! The sockets of a client, and its choice among a server's addresses. The module does not know the messages.
//!
//! A name may have several addresses, and the server may not listen on the first: `localhost` is `::1` before `127.0.0.1`. The
//! [`Dialler`] orders the attempts. The first answer wins.

use super::dialler::Dialler;
use shadecast_protocol::close::CloseCode;
use shadecast_protocol::time::ClientTime;
use shadecast_transport::mio::{DriverError, any_address_for};
use shadecast_transport::{
    Binding, ClientIdentity, CloseKind, Driver, Endpoint, EndpointConfig, Event, Events, ExpectedIdentity,
    Fingerprint, Handle, PeerId, spawn,
};
use std::net::SocketAddr;
use std::sync::Arc;

/// What has happened on the lines.
#[derive(Debug)]
pub(super) enum LineEvent {
    /// The server has answered at this address; the other attempts are given up.
    Connected {
        /// Which address it was.
        address: SocketAddr,
        /// Who answered.
        fingerprint: Option<Fingerprint>,
        /// What only the ends of this connection know.
        binding: Binding,
    },
    /// One address does not lead to the server.
    Failed {
        /// Why, for programs.
        kind: CloseKind,
        /// Why, for users; it names the address.
        reason: String,
    },
    /// The connection has ended.
    Lost {
        /// Why, for programs.
        kind: CloseKind,
        /// Why, for users.
        reason: String,
    },
    /// Nothing comes over the connection, which stands.
    Away,
    /// Something comes again.
    Back,
    /// Something came over the connection.
    Arrived(Event),
}

/// A socket of one family of addresses, with its thread.
struct Socket {
    is_ipv4: bool,
    handle: Handle,
    events: Events,
}

/// A connection, or the attempt to make one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Line {
    socket: usize,
    peer: PeerId,
    address: SocketAddr,
}

/// All ways to one server, of which at most one is a connection.
pub(super) struct Lines {
    /// Who we are to whoever answers.
    identity: Arc<ClientIdentity>,
    sockets: Vec<Socket>,
    dialler: Dialler,
    attempts: Vec<Line>,
    live: Option<Line>,
}

impl Lines {
    /// For a server with these addresses.
    pub(super) fn new(identity: &Arc<ClientIdentity>, addresses: Vec<SocketAddr>) -> Self {
        Self {
            identity: identity.clone(),
            sockets: Vec::new(),
            dialler: Dialler::new(addresses),
            attempts: Vec::new(),
            live: None,
        }
    }

    /// The thread and the peer of the connection, if there is one.
    pub(super) fn live(&self) -> Option<(&Handle, PeerId)> {
        self.live.map(|line| (&self.sockets[line.socket].handle, line.peer))
    }

    /// What has happened next, until there is nothing more.
    pub(super) fn poll(&mut self, now: ClientTime) -> Option<LineEvent> {
        for socket in 0..self.sockets.len() {
            while let Some(event) = self.sockets[socket].events.try_next() {
                if let Some(event) = self.sort(now, socket, event) {
                    return Some(event);
                }
            }
        }
        None
    }

    /// Tries the next address where it is time to. `expected` says who is to answer there.
    pub(super) fn dial(
        &mut self,
        now: ClientTime,
        expected: impl FnOnce(SocketAddr) -> ExpectedIdentity,
    ) -> Option<LineEvent> {
        if self.live.is_some() {
            return None;
        }
        let address = self.dialler.dial(now, self.attempts.len())?;
        let reason = match self.try_dial(address, expected(address)) {
            Ok(line) => {
                self.attempts.push(line);
                return None;
            }
            Err(reason) => reason,
        };
        self.dialler.failed(now);
        Some(LineEvent::Failed { kind: CloseKind::Error, reason })
    }

    fn try_dial(&mut self, address: SocketAddr, expected: ExpectedIdentity) -> Result<Line, String> {
        let socket = self.socket_for(address).map_err(|error| error.to_string())?;
        let dialled = self.sockets[socket].handle.connect(address, expected);
        let peer = dialled.map_err(|error| format!("{address}: {error}"))?;
        Ok(Line { socket, peer, address })
    }

    /// A socket reaches addresses of its own family only.
    fn socket_for(&mut self, address: SocketAddr) -> Result<usize, DriverError> {
        let is_ipv4 = address.is_ipv4();
        if let Some(place) = self.sockets.iter().position(|socket| socket.is_ipv4 == is_ipv4) {
            return Ok(place);
        }
        let endpoint = Endpoint::client_as(self.identity.clone(), EndpointConfig::default());
        let (handle, events) = spawn(Driver::bind(endpoint, any_address_for(address))?)?;
        events.wake(std::thread::current());
        self.sockets.push(Socket { is_ipv4, handle, events });
        Ok(self.sockets.len() - 1)
    }

    /// What an event means for who uses the connection; `None` where it belongs to a line that was given up.
    fn sort(&mut self, now: ClientTime, socket: usize, event: Event) -> Option<LineEvent> {
        match event {
            Event::Connected { peer, fingerprint, binding, .. } => {
                let line = self.take_attempt(socket, peer)?;
                self.keep(line);
                Some(LineEvent::Connected { address: line.address, fingerprint, binding })
            }
            Event::Closed { peer, kind, reason } => self.closed(now, (socket, peer), kind, reason),
            Event::Away { peer, .. } => self.is_live(socket, peer).then_some(LineEvent::Away),
            Event::Back { peer, .. } => self.is_live(socket, peer).then_some(LineEvent::Back),
            Event::Control { peer, .. }
            | Event::Stream { peer, .. }
            | Event::StreamReset { peer, .. }
            | Event::Datagram { peer, .. } => self.is_live(socket, peer).then_some(LineEvent::Arrived(event)),
        }
    }

    fn is_live(&self, socket: usize, peer: PeerId) -> bool {
        self.live.is_some_and(|line| (line.socket, line.peer) == (socket, peer))
    }

    fn take_attempt(&mut self, socket: usize, peer: PeerId) -> Option<Line> {
        let place = self.attempts.iter().position(|line| (line.socket, line.peer) == (socket, peer))?;
        Some(self.attempts.remove(place))
    }

    fn keep(&mut self, line: Line) {
        for other in std::mem::take(&mut self.attempts) {
            // A thread that has ended needs no close.
            let handle = &self.sockets[other.socket].handle;
            let _ = handle.close(other.peer, CloseCode::Leaving.code(), "another address answered first");
        }
        self.live = Some(line);
        self.dialler.answered(line.address);
    }

    fn closed(
        &mut self,
        now: ClientTime,
        (socket, peer): (usize, PeerId),
        kind: CloseKind,
        reason: String,
    ) -> Option<LineEvent> {
        if self.is_live(socket, peer) {
            self.live = None;
            self.dialler.lost();
            return Some(LineEvent::Lost { kind, reason });
        }
        self.take_attempt(socket, peer)?;
        self.dialler.failed(now);
        Some(LineEvent::Failed { kind, reason })
    }

    /// The server has taken us.
    pub(super) fn succeeded(&mut self) {
        self.dialler.succeeded();
    }

    /// Ends the connection, to try again after a while.
    pub(super) fn give_up(&mut self, now: ClientTime, code: CloseCode, reason: &str) {
        self.close(code, reason);
        self.dialler.refused(now);
    }

    /// Ends the connection for good.
    pub(super) fn leave(&mut self) {
        self.close(CloseCode::Leaving, "the user left");
    }

    fn close(&mut self, code: CloseCode, reason: &str) {
        if let Some((handle, peer)) = self.live() {
            // A thread that has ended needs no close.
            let _ = handle.close(peer, code.code(), reason);
        }
        self.live = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_transport::ServerIdentity;
    use std::net::UdpSocket;
    use std::time::{Duration, Instant};

    const PATIENCE: Duration = Duration::from_secs(60);

    fn now() -> ClientTime {
        crate::platform::monotonic_now()
    }

    fn lines(addresses: Vec<SocketAddr>) -> Lines {
        Lines::new(&Arc::new(ClientIdentity::from_seed(1).expect("an identity")), addresses)
    }

    fn server() -> (SocketAddr, Handle, Events) {
        let identity = ServerIdentity::from_seed(1).expect("an identity");
        let endpoint = Endpoint::server(&identity, EndpointConfig::default()).expect("an endpoint");
        let driver = Driver::bind(endpoint, SocketAddr::from(([127, 0, 0, 1], 0))).expect("a socket");
        let address = driver.local_addr().expect("an address");
        let (handle, events) = spawn(driver).expect("a thread");
        (address, handle, events)
    }

    #[track_caller]
    fn next(lines: &mut Lines) -> LineEvent {
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            let expected = |_| ExpectedIdentity::TrustOnFirstUse;
            if let Some(event) = lines.poll(now()).or_else(|| lines.dial(now(), expected)) {
                return event;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        panic!("nothing happened");
    }

    #[track_caller]
    fn connected(lines: &mut Lines) -> SocketAddr {
        loop {
            match next(lines) {
                LineEvent::Connected { address, .. } => return address,
                LineEvent::Failed { .. } => {}
                other => panic!("{other:?}"),
            }
        }
    }

    #[test]
    fn the_address_that_answers_is_found_behind_one_that_does_not() {
        let silent = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        let (address, _handle, _events) = server();
        let mut lines = lines(vec![silent.local_addr().expect("an address"), address]);
        assert_eq!(connected(&mut lines), address);
        assert!(lines.live().is_some() && lines.attempts.is_empty());
    }

    #[test]
    fn an_unreachable_address_family_does_not_end_the_search() {
        let (address, _handle, _events) = server();
        // No machine has this address (RFC 6666, discard only); many have no way to any of its family.
        let nowhere = "[100::1]:7400".parse().expect("an address");
        let mut lines = lines(vec![nowhere, address]);
        assert_eq!(connected(&mut lines), address);
    }

    #[test]
    fn a_connection_that_breaks_is_told_once_and_dialled_again() {
        let (address, handle, events) = server();
        let mut lines = lines(vec![address]);
        connected(&mut lines);
        let deadline = Instant::now() + PATIENCE;
        let peer = loop {
            match events.try_next() {
                Some(Event::Connected { peer, .. }) => break peer,
                _ => assert!(Instant::now() < deadline, "the server was not reached"),
            }
            std::thread::sleep(Duration::from_millis(5));
        };
        handle.close(peer, 7, "the scene changed").expect("closed");
        match next(&mut lines) {
            LineEvent::Lost { kind: CloseKind::Peer(7), reason } => {
                assert!(reason.contains("the scene changed"), "{reason}");
            }
            other => panic!("{other:?}"),
        }
        assert_eq!(connected(&mut lines), address);
    }
}
