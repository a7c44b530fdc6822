//! Two endpoints joined by a simulated link, in virtual time.
//!
//! Nothing happens by itself: [`Pair::step_until`] plays all events up to a time, in order. A slow machine gives exactly the
//! results of a fast one.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use bytes::BytesMut;

use crate::endpoint::Endpoint;
use crate::event::{Event, PeerId};
use crate::identity::ExpectedIdentity;
use crate::link::{Direction, Link, LinkSchedule};
use crate::neighbour::Neighbour;

/// Most time that is played at once while a connection is made, nanoseconds.
const CONNECT_STEP_NS: i64 = 5_000_000_000;
/// The server's address in every pair.
pub const SERVER_ADDR: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::new(10, 0, 0, 1)), 47_800);
/// The client's address in every pair, until it moves.
pub const CLIENT_ADDR: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::new(10, 0, 0, 2)), 50_000);

/// What a datagram has beside its bytes.
#[derive(Clone, Copy, Debug)]
pub struct Envelope {
    ecn: Option<u8>,
    /// The client's address when it was sent.
    client_addr: SocketAddr,
    /// Of this neighbour; `None`: of the pair itself.
    neighbour: Option<usize>,
}

/// A server, a client and the network between them.
pub struct Pair {
    /// The server's end.
    pub server: Endpoint,
    /// The client's end.
    pub client: Endpoint,
    link: Link<Envelope>,
    client_addr: SocketAddr,
    neighbours: Vec<Neighbour>,
    now_ns: i64,
    trace: Option<Vec<(i64, Direction, usize)>>,
}

impl Pair {
    /// Joins two endpoints at time 0.
    pub fn new(server: Endpoint, client: Endpoint, link: impl Into<LinkSchedule>, seed: u64) -> Self {
        let mut link = Link::new(link, seed);
        link.start_at(0);
        Self {
            server,
            client,
            link,
            client_addr: CLIENT_ADDR,
            neighbours: Vec::new(),
            now_ns: 0,
            trace: None,
        }
    }

    /// The virtual time, nanoseconds.
    pub fn now_ns(&self) -> i64 {
        self.now_ns
    }

    /// The link, for its counters.
    pub fn link(&self) -> &Link<Envelope> {
        &self.link
    }

    /// Somebody else takes the same link from now on.
    pub fn add_neighbour(&mut self, neighbour: Neighbour) {
        self.neighbours.push(neighbour);
    }

    /// Those who take the same link.
    pub fn neighbours(&self) -> &[Neighbour] {
        &self.neighbours
    }

    /// The client dials the server and takes its key; plays until it is connected. Gives the client as the server knows it.
    pub fn connect(&mut self) -> PeerId {
        self.client.connect(self.now_ns, SERVER_ADDR, ExpectedIdentity::TrustOnFirstUse);
        loop {
            let seen = self.step_to_events(self.now_ns + CONNECT_STEP_NS);
            let connected = seen.into_iter().find_map(|(end, event)| match (end, event) {
                (Direction::ToServer, Event::Connected { peer, .. }) => Some(peer),
                _ => None,
            });
            if let Some(peer) = connected {
                return peer;
            }
        }
    }

    /// Replaces one end by another endpoint, as when a program is killed and started again.
    pub fn restart(&mut self, end: Direction, endpoint: Endpoint) {
        match end {
            Direction::ToServer => self.server = endpoint,
            Direction::ToClient => self.client = endpoint,
        }
    }

    /// The client has another address from now on, as in another network, or behind a router that has forgotten it. What is under
    /// way to the old one is lost; what left it arrives.
    pub fn move_client(&mut self, to: SocketAddr) {
        self.flush();
        self.client_addr = to;
    }

    /// Replaces the link from now on; what is under way on the old one is lost.
    pub fn set_link(&mut self, link: impl Into<LinkSchedule>, seed: u64) {
        self.link = Link::new(link, seed);
        self.link.start_at(self.now_ns);
    }

    /// Notes the time, direction and size of each datagram from now on.
    pub fn start_trace(&mut self) {
        self.trace = Some(Vec::new());
    }

    /// The datagrams noted so far.
    pub fn trace(&self) -> &[(i64, Direction, usize)] {
        self.trace.as_deref().unwrap_or_default()
    }

    /// When something happens next by itself, nanoseconds; never before [`Self::now_ns`].
    pub fn next_event_ns(&mut self) -> Option<i64> {
        self.flush();
        let times = [self.link.next_event_ns(), self.server.poll_timeout(), self.client.poll_timeout()];
        let of_neighbours = self.neighbours.iter_mut().filter_map(Neighbour::next_event_ns);
        times.into_iter().flatten().chain(of_neighbours).min().map(|at| at.max(self.now_ns))
    }

    /// Plays everything up to and including `until_ns`. Times before now only send what waits.
    pub fn step_until(&mut self, until_ns: i64) {
        while let Some(at_ns) = self.next_event_ns().filter(|&at_ns| at_ns <= until_ns) {
            self.now_ns = at_ns;
            self.step();
        }
        self.now_ns = self.now_ns.max(until_ns);
    }

    /// Plays until one end has an event for its application or `until_ns` is reached; the events seen, in order, with
    /// the end that saw each ([`Direction::ToServer`] is the server).
    pub fn step_to_events(&mut self, until_ns: i64) -> Vec<(Direction, Event)> {
        loop {
            let events = self.take_events();
            if !events.is_empty() {
                return events;
            }
            match self.next_event_ns().filter(|&at_ns| at_ns <= until_ns) {
                Some(at_ns) => self.now_ns = at_ns,
                None => {
                    self.now_ns = self.now_ns.max(until_ns);
                    return events;
                }
            }
            self.step();
        }
    }

    fn take_events(&mut self) -> Vec<(Direction, Event)> {
        let server =
            std::iter::from_fn(|| self.server.poll_event()).map(|event| (Direction::ToServer, event));
        let client =
            std::iter::from_fn(|| self.client.poll_event()).map(|event| (Direction::ToClient, event));
        server.chain(client).collect()
    }

    /// Handles what is due now.
    fn step(&mut self) {
        let now_ns = self.now_ns;
        while let Some(delivery) = self.link.poll(now_ns) {
            let Envelope { ecn, client_addr, neighbour } = delivery.tag;
            let neighbour = neighbour.and_then(|number| self.neighbours.get_mut(number));
            let (end, from) = match (delivery.direction, neighbour) {
                (Direction::ToServer, Some(neighbour)) => (&mut neighbour.server, client_addr),
                (Direction::ToClient, Some(neighbour)) => {
                    neighbour.delivered_bytes += delivery.bytes.len() as u64;
                    (&mut neighbour.client, SERVER_ADDR)
                }
                (Direction::ToServer, None) => (&mut self.server, client_addr),
                (Direction::ToClient, None) if client_addr != self.client_addr => continue,
                (Direction::ToClient, None) => (&mut self.client, SERVER_ADDR),
            };
            end.handle_udp(now_ns, from, None, ecn, BytesMut::from(&delivery.bytes[..]));
        }
        self.server.handle_timeout(now_ns);
        self.client.handle_timeout(now_ns);
        self.neighbours.iter_mut().for_each(|neighbour| neighbour.step(now_ns, SERVER_ADDR));
    }

    /// Puts what the endpoints want to send on the link.
    fn flush(&mut self) {
        let Self { server, client, link, client_addr, now_ns, trace, neighbours } = self;
        let mut own = Outflow { link, trace: trace.as_mut(), now_ns: *now_ns, neighbour: None };
        own.flush([server, client], *client_addr);
        for (number, Neighbour { server, client, .. }) in neighbours.iter_mut().enumerate() {
            Outflow { link, trace: None, now_ns: *now_ns, neighbour: Some(number) }
                .flush([server, client], CLIENT_ADDR);
        }
    }
}

/// What leaves the ends of one connection now.
struct Outflow<'a> {
    link: &'a mut Link<Envelope>,
    trace: Option<&'a mut Vec<(i64, Direction, usize)>>,
    now_ns: i64,
    neighbour: Option<usize>,
}

impl Outflow<'_> {
    fn flush(&mut self, [server, client]: [&mut Endpoint; 2], client_addr: SocketAddr) {
        for (direction, end) in [(Direction::ToClient, server), (Direction::ToServer, client)] {
            while let Some(transmit) = end.poll_transmit(self.now_ns) {
                let client_addr = match direction {
                    Direction::ToClient => transmit.to,
                    // Nobody lives at any other address.
                    Direction::ToServer if transmit.to != SERVER_ADDR => continue,
                    Direction::ToServer => client_addr,
                };
                for datagram in transmit.datagrams() {
                    if let Some(trace) = &mut self.trace {
                        trace.push((self.now_ns, direction, datagram.len()));
                    }
                    let envelope = Envelope { ecn: transmit.ecn, client_addr, neighbour: self.neighbour };
                    self.link.send(self.now_ns, direction, datagram.to_vec(), envelope);
                }
            }
        }
    }
}
