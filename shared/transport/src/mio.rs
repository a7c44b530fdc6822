//! The endpoint on a real UDP socket, driven by one thread.
//!
//! This is the only module with a socket, and the only one that reads the clock. The driver moves datagrams between socket and endpoint in
//! batches (segmentation offload both ways), sleeps until the socket, a timer or another thread wants something, and
//! never waits for anything else: what the socket does not take is kept, one piece, and what the application does not
//! take stays in the inbox, and flow control then makes the peer wait. What the application sends waits in the outbox, by peer.
//!
//! Reads and writes go through mio, which must see the socket refuse: on Windows it asks the system only then for the next
//! readiness.

use std::collections::BTreeMap;
use std::io::{self, IoSliceMut};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{JoinHandle, Thread};
use std::time::Duration;

use ::mio::net::UdpSocket;
use ::mio::{Interest, Poll, Token, Waker};
use bytes::BytesMut;
use quinn_udp::{RecvMeta, UdpSockRef, UdpSocketState};

use crate::endpoint::{Counters, Endpoint, IdSource, PeerStats};
use crate::event::{Event, PeerId, SendError, StreamId};
use crate::identity::ExpectedIdentity;
use crate::inbox::{Inbox, Next};
use crate::link::{Direction, Link, LinkCounts, LinkSchedule};
use crate::outbox::{Command, Outbox};
use crate::transmit::Transmit;
use shadecast_protocol::close::CloseCode;
use shadecast_system::monotonic_now_ns;

const SOCKET: Token = Token(0);
const WAKER: Token = Token(1);
/// Largest UDP datagram, or train of datagrams that the kernel coalesced, bytes.
const MAX_DATAGRAM_TRAIN_BYTES: usize = 65_535;
/// Asked of the kernel for both socket buffers, bytes; it may give less.
const SOCKET_BUFFER_BYTES: usize = 4 << 20;
/// Commands taken before the socket has its turn.
const COMMANDS_PER_TURN: usize = 1024;
/// Under load what is known of the connections is told this often, nanoseconds.
const PUBLISH_NS: i64 = 1_000_000;
/// The thread looks at its channels at least this often.
const MAX_WAIT: Duration = Duration::from_millis(100);
/// Errors of the socket, one after the other, after which it is opened anew, and the least time between two openings, nanoseconds.
const MANY_FAILURES: u32 = 16;
const REOPEN_NS: i64 = 1_000_000_000;
/// The poll waits at least this long while the socket takes no more, nanoseconds.
const PENDING_WAIT_NS: i64 = 1_000_000;
/// How long a stopping thread tries to tell its peers.
const FAREWELL: Duration = Duration::from_millis(200);

/// The address to bind for reaching `remote`: any of the same family, any port.
pub fn any_address_for(remote: SocketAddr) -> SocketAddr {
    let ip: IpAddr =
        if remote.is_ipv4() { Ipv4Addr::UNSPECIFIED.into() } else { Ipv6Addr::UNSPECIFIED.into() };
    SocketAddr::new(ip, 0)
}

/// Why a driver could not be made.
#[derive(Debug, thiserror::Error)]
pub enum DriverError {
    /// The socket could not be opened.
    #[error("opening UDP socket {address}: {reason}{hint}")]
    Bind {
        /// The address asked for.
        address: SocketAddr,
        /// What the system said.
        reason: io::Error,
        /// What to do.
        hint: &'static str,
    },
    /// The event loop or its thread could not be set up.
    #[error("setting up the network thread: {0}")]
    SetUp(#[from] io::Error),
}

fn bind_error(address: SocketAddr, reason: io::Error) -> DriverError {
    let hint = match reason.kind() {
        io::ErrorKind::AddrInUse => {
            "; another program uses this port: stop it, or choose another with --listen"
        }
        io::ErrorKind::AddrNotAvailable => {
            "; this machine has no such address: use 0.0.0.0 or one of its own"
        }
        io::ErrorKind::PermissionDenied => "; ports below 1024 need privileges: choose a higher one",
        _ => "",
    };
    DriverError::Bind { address, reason, hint }
}

/// What a socket of this machine can do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SocketTrial {
    /// Bytes of its receive and send buffers, as the kernel counts them.
    pub buffer_bytes: [usize; 2],
    /// What was asked for.
    pub wanted_bytes: usize,
}

/// Opens a socket at `address` for a moment, and says what it got.
///
/// # Errors
/// There can be none.
pub fn try_socket(address: SocketAddr) -> Result<SocketTrial, DriverError> {
    let socket = open(address).map_err(|e| bind_error(address, e))?;
    let state = open_wide(&socket)?;
    let socket = || UdpSockRef::from(&socket);
    Ok(SocketTrial {
        buffer_bytes: [state.recv_buffer_size(socket())?, state.send_buffer_size(socket())?],
        wanted_bytes: SOCKET_BUFFER_BYTES,
    })
}

/// A socket at an address. At that of every IPv6 network it takes IPv4 too, whatever the system's usual way is.
fn open(address: SocketAddr) -> io::Result<UdpSocket> {
    if address.is_ipv4() || !address.ip().is_unspecified() {
        return UdpSocket::bind(address);
    }
    let socket = socket2::Socket::new(socket2::Domain::IPV6, socket2::Type::DGRAM, None)?;
    socket.set_only_v6(false)?;
    socket.set_nonblocking(true)?;
    socket.bind(&address.into())?;
    Ok(UdpSocket::from_std(socket.into()))
}

fn open_wide(socket: &UdpSocket) -> io::Result<UdpSocketState> {
    let state = UdpSocketState::new(UdpSockRef::from(socket))?;
    // The kernel's default is a fraction of one picture; a refusal only costs throughput.
    let _ = state.set_recv_buffer_size(UdpSockRef::from(socket), SOCKET_BUFFER_BYTES);
    let _ = state.set_send_buffer_size(UdpSockRef::from(socket), SOCKET_BUFFER_BYTES);
    Ok(state)
}

/// Where a datagram on the simulated link goes to or comes from.
#[derive(Clone, Copy, Debug)]
struct LinkTag {
    remote: SocketAddr,
    local_ip: Option<IpAddr>,
    ecn: Option<u8>,
}

/// An endpoint with its socket.
pub struct Driver {
    endpoint: Endpoint,
    socket: UdpSocket,
    state: UdpSocketState,
    poll: Poll,
    readiness: ::mio::Events,
    waker: Arc<Waker>,
    /// What the socket did not take.
    pending: Option<Transmit>,
    /// The poll wakes when the socket takes more, which is asked for only while something is pending.
    waits_to_write: bool,
    link: Option<Link<LinkTag>>,
    receive_buffers: Vec<Vec<u8>>,
    /// The socket may have more than was read.
    more_to_read: bool,
    /// Where the socket belongs, and whether it had to be opened elsewhere.
    address: SocketAddr,
    is_elsewhere: bool,
    opened_ns: i64,
    /// Errors since the last datagram that was received or sent.
    failures: u32,
}

impl Driver {
    /// Opens a socket at `address` for `endpoint`.
    pub fn bind(endpoint: Endpoint, address: SocketAddr) -> Result<Self, DriverError> {
        let mut socket = open(address).map_err(|e| bind_error(address, e))?;
        let address = socket.local_addr()?;
        let state = open_wide(&socket)?;
        let poll = Poll::new()?;
        poll.registry().register(&mut socket, SOCKET, Interest::READABLE)?;
        let waker = Arc::new(Waker::new(poll.registry(), WAKER)?);
        let receive_buffers = vec![vec![0; MAX_DATAGRAM_TRAIN_BYTES]; quinn_udp::BATCH_SIZE];
        Ok(Self {
            endpoint,
            socket,
            state,
            poll,
            readiness: ::mio::Events::with_capacity(16),
            waker,
            pending: None,
            waits_to_write: false,
            link: None,
            receive_buffers,
            more_to_read: false,
            address,
            is_elsewhere: false,
            opened_ns: monotonic_now_ns(),
            failures: 0,
        })
    }

    /// Sends everything, both ways, through a simulated link first.
    pub fn with_link(mut self, schedule: impl Into<LinkSchedule>, seed: u64) -> Self {
        self.link = Some(Link::new(schedule, seed));
        self
    }

    /// The socket's own address.
    pub fn local_addr(&self) -> io::Result<SocketAddr> {
        self.socket.local_addr()
    }

    /// The endpoint; call [`Self::poll`] after using it.
    pub fn endpoint(&mut self) -> &mut Endpoint {
        &mut self.endpoint
    }

    /// Ends a [`Self::poll`] that waits, from any thread.
    pub fn waker(&self) -> Arc<Waker> {
        self.waker.clone()
    }

    /// Direction of what this side sends.
    fn outward(&self) -> Direction {
        if self.endpoint.is_server() { Direction::ToClient } else { Direction::ToServer }
    }

    /// Sends and receives; waits up to `max_wait` when there is nothing to do.
    pub fn poll(&mut self, max_wait: Duration) -> io::Result<()> {
        let now_ns = monotonic_now_ns();
        if self.is_elsewhere && now_ns >= self.opened_ns + REOPEN_NS {
            self.reopen(now_ns)?;
        }
        self.advance(now_ns)?;
        self.watch_for_room()?;
        let wait = self.wait(max_wait);
        match self.poll.poll(&mut self.readiness, Some(wait)) {
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            result => result?,
        }
        self.receive()?;
        self.advance(monotonic_now_ns())
    }

    /// Wants to know that the socket takes more exactly while something is pending: it nearly always does.
    fn watch_for_room(&mut self) -> io::Result<()> {
        let waits_to_write = self.pending.is_some();
        if waits_to_write != self.waits_to_write {
            let also = if waits_to_write { Some(Interest::WRITABLE) } else { None };
            let interest = also.map_or(Interest::READABLE, |also| Interest::READABLE | also);
            self.poll.registry().reregister(&mut self.socket, SOCKET, interest)?;
            self.waits_to_write = waits_to_write;
        }
        Ok(())
    }

    fn wait(&mut self, max_wait: Duration) -> Duration {
        if self.more_to_read {
            return Duration::ZERO;
        }
        let link = self.link.as_ref().and_then(Link::next_event_ns);
        match self.endpoint.poll_timeout().into_iter().chain(link).min() {
            None => max_wait,
            Some(at_ns) => {
                // Copies that are due cannot leave while something is pending; the socket tells when it can.
                let least_ns = if self.pending.is_some() { PENDING_WAIT_NS } else { 0 };
                let ns = (at_ns - monotonic_now_ns()).max(least_ns);
                max_wait.min(Duration::from_nanos(ns as u64))
            }
        }
    }

    /// Handles what is due, and sends what there is.
    fn advance(&mut self, now_ns: i64) -> io::Result<()> {
        self.deliver_from_link(now_ns)?;
        if self.endpoint.poll_timeout().is_some_and(|at_ns| at_ns <= now_ns) {
            self.endpoint.handle_timeout(now_ns);
        }
        self.transmit(now_ns)?;
        self.deliver_from_link(now_ns)
    }

    /// Reads one batch of what the socket has: commands, timers and sending have their turn before the next one.
    fn receive(&mut self) -> io::Result<()> {
        let mut buffers = std::mem::take(&mut self.receive_buffers);
        let result = self.receive_into(&mut buffers);
        self.receive_buffers = buffers;
        result
    }

    fn receive_into(&mut self, buffers: &mut [Vec<u8>]) -> io::Result<()> {
        let mut metas = [RecvMeta::default(); quinn_udp::BATCH_SIZE];
        let mut slices: Vec<IoSliceMut<'_>> = buffers.iter_mut().map(|b| IoSliceMut::new(b)).collect();
        let (socket, state) = (&self.socket, &self.state);
        let received = socket.try_io(|| state.recv(UdpSockRef::from(socket), &mut slices, &mut metas));
        let count = match received {
            Ok(count) => count,
            Err(e) if e.kind() == io::ErrorKind::WouldBlock => {
                self.more_to_read = false;
                return Ok(());
            }
            Err(e) => {
                // There may be datagrams behind an error.
                self.more_to_read = self.failures < MANY_FAILURES;
                return self.failed("receiving", &e);
            }
        };
        (self.more_to_read, self.failures) = (true, 0);
        let now_ns = monotonic_now_ns();
        for (buffer, meta) in buffers.iter().zip(&metas[..count]) {
            for datagram in buffer[..meta.len].chunks(meta.stride.max(1)) {
                self.take_datagram(now_ns, meta, datagram);
            }
        }
        Ok(())
    }

    /// A datagram was not received or sent. One error says nothing about the socket, whatever it is; after many without a success
    /// between them it is opened anew.
    fn failed(&mut self, doing: &str, error: &io::Error) -> io::Result<()> {
        if is_passing(error) {
            return Ok(());
        }
        self.failures += 1;
        let now_ns = monotonic_now_ns();
        if self.failures < MANY_FAILURES || now_ns < self.opened_ns + REOPEN_NS {
            tracing::debug!("{doing} failed: {error}");
            return Ok(());
        }
        tracing::warn!("{doing} keeps failing; the socket is opened anew: {error}");
        self.reopen(now_ns)
    }

    /// Opens the socket anew at its address; while another program has that, at any.
    fn reopen(&mut self, now_ns: i64) -> io::Result<()> {
        (self.opened_ns, self.failures) = (now_ns, 0);
        // The old one goes first: it has the port.
        self.socket = UdpSocket::bind(any_address_for(self.address))?;
        let reopened = open(self.address);
        self.is_elsewhere = reopened.is_err();
        match reopened {
            Ok(socket) => self.socket = socket,
            Err(error) => tracing::warn!("opening UDP socket {}: {error}; it is tried again", self.address),
        }
        self.state = open_wide(&self.socket)?;
        self.poll.registry().register(&mut self.socket, SOCKET, Interest::READABLE)?;
        (self.waits_to_write, self.more_to_read) = (false, true);
        Ok(())
    }

    fn take_datagram(&mut self, now_ns: i64, meta: &RecvMeta, datagram: &[u8]) {
        let ecn = meta.ecn.map(|ecn| ecn as u8);
        let inward = match self.outward() {
            Direction::ToClient => Direction::ToServer,
            Direction::ToServer => Direction::ToClient,
        };
        match &mut self.link {
            None => self.endpoint.handle_udp(now_ns, meta.addr, meta.dst_ip, ecn, BytesMut::from(datagram)),
            Some(link) => {
                let tag = LinkTag { remote: meta.addr, local_ip: meta.dst_ip, ecn };
                link.send(now_ns, inward, datagram.to_vec(), tag);
            }
        }
    }

    /// Sends what the endpoint has, until the socket takes no more.
    fn transmit(&mut self, now_ns: i64) -> io::Result<()> {
        loop {
            // The kernel may have turned out not to support segmentation.
            let segments = if self.link.is_some() { 1 } else { self.state.max_gso_segments() };
            self.endpoint.set_max_segments(segments);
            let Some(transmit) = self.pending.take().or_else(|| self.endpoint.poll_transmit(now_ns)) else {
                return Ok(());
            };
            let direction = self.outward();
            if let Some(link) = &mut self.link {
                let tag = LinkTag { remote: transmit.to, local_ip: transmit.from_ip, ecn: transmit.ecn };
                for datagram in transmit.datagrams() {
                    link.send(now_ns, direction, datagram.to_vec(), tag);
                }
            } else if !self.send(&transmit)? {
                self.pending = Some(transmit);
                return Ok(());
            }
            self.endpoint.recycle(transmit);
        }
    }

    /// `false` when the socket takes no more for now.
    fn send(&mut self, transmit: &Transmit) -> io::Result<bool> {
        let datagrams = quinn_udp::Transmit {
            destination: transmit.to,
            ecn: transmit.ecn.and_then(quinn_udp::EcnCodepoint::from_bits),
            contents: &transmit.bytes,
            segment_size: transmit.segment_size,
            src_ip: transmit.from_ip,
        };
        match self.socket.try_io(|| self.state.send(UdpSockRef::from(&self.socket), &datagrams)) {
            Ok(()) => {
                self.failures = 0;
                Ok(true)
            }
            Err(e) if e.kind() == io::ErrorKind::WouldBlock => Ok(false),
            // It is lost, as in a network.
            Err(e) => self.failed("sending", &e).map(|()| true),
        }
    }

    fn deliver_from_link(&mut self, now_ns: i64) -> io::Result<()> {
        let outward = self.outward();
        while let Some(delivery) = self.link.as_mut().and_then(|link| link.poll(now_ns)) {
            let LinkTag { remote, local_ip, ecn } = delivery.tag;
            if delivery.direction != outward {
                self.endpoint.handle_udp(now_ns, remote, local_ip, ecn, BytesMut::from(&delivery.bytes[..]));
                continue;
            }
            let bytes = delivery.bytes;
            // A socket that takes no more loses the datagram, as a network does.
            self.send(&Transmit { to: remote, from_ip: local_ip, bytes, segment_size: None, ecn })?;
        }
        Ok(())
    }

    /// Tells all peers that this side ends, as far as that is possible in a short time.
    fn farewell(&mut self) -> io::Result<()> {
        self.endpoint.close_all(monotonic_now_ns(), 0, "the program ended");
        let deadline_ns = monotonic_now_ns() + FAREWELL.as_nanos() as i64;
        loop {
            self.advance(monotonic_now_ns())?;
            let unsent =
                self.pending.is_some() || self.link.as_ref().is_some_and(|l| l.next_event_ns().is_some());
            if !unsent || monotonic_now_ns() > deadline_ns {
                return Ok(());
            }
            self.poll(Duration::from_millis(5))?;
        }
    }
}

/// Errors of single datagrams that say nothing about the socket: the network or the other host is away for now.
fn is_passing(error: &io::Error) -> bool {
    use io::ErrorKind::{
        ConnectionRefused, ConnectionReset, HostUnreachable, Interrupted, NetworkDown, NetworkUnreachable,
    };
    let kinds =
        [ConnectionRefused, ConnectionReset, HostUnreachable, Interrupted, NetworkDown, NetworkUnreachable];
    kinds.contains(&error.kind())
}

/// What the network thread tells about itself.
#[derive(Debug, Default)]
struct Published {
    stats: BTreeMap<PeerId, PeerStats>,
    counters: Counters,
    link: Option<[LinkCounts; 2]>,
}

fn lock(published: &Mutex<Published>) -> MutexGuard<'_, Published> {
    published.lock().unwrap_or_else(PoisonError::into_inner)
}

struct Inner {
    outbox: Arc<Outbox>,
    waker: Arc<Waker>,
    thread: Option<JoinHandle<()>>,
    published: Arc<Mutex<Published>>,
    peer_ids: IdSource,
    stream_ids: IdSource,
    local_addr: SocketAddr,
}

impl Drop for Inner {
    fn drop(&mut self) {
        self.outbox.abandon();
        // Failing only means that the thread notices at its next look.
        let _ = self.waker.wake();
        if let Some(thread) = self.thread.take() {
            // A panic was already reported by its own thread.
            let _ = thread.join();
        }
    }
}

/// Commands the network thread, from any thread. When the last one is dropped the thread closes all connections and
/// ends.
#[derive(Clone)]
pub struct Handle {
    inner: Arc<Inner>,
}

impl Handle {
    fn command(&self, peer: PeerId, command: Command) -> Result<(), SendError> {
        self.inner.outbox.push(peer, command)?;
        // Failing only means that the thread notices at its next look.
        let _ = self.inner.waker.wake();
        Ok(())
    }

    /// Starts a connection; `Connected` or `Closed` follows.
    pub fn connect(&self, remote: SocketAddr, expected: ExpectedIdentity) -> Result<PeerId, SendError> {
        let peer = PeerId(self.inner.peer_ids.next());
        self.command(peer, Command::Connect { remote, expected }).map(|()| peer)
    }

    /// Sends a message on the control stream. Where the connection cannot take it, the connection ends.
    ///
    /// # Errors
    /// [`SendError::QueueFull`] where too much waits for this peer; what waits for others does not matter.
    pub fn send_control(&self, peer: PeerId, message: Vec<u8>) -> Result<(), SendError> {
        self.command(peer, Command::Control(message))
    }

    /// Sends `bytes` as a stream of its own; higher `priority` first.
    ///
    /// # Errors
    /// As [`Self::send_control`].
    pub fn send_stream(&self, peer: PeerId, bytes: Vec<u8>, priority: i32) -> Result<StreamId, SendError> {
        let stream = StreamId(self.inner.stream_ids.next());
        self.command(peer, Command::Stream { stream, bytes, priority }).map(|()| stream)
    }

    /// Gives up a stream.
    pub fn cancel_stream(&self, peer: PeerId, stream: StreamId) -> Result<(), SendError> {
        self.command(peer, Command::Cancel(stream))
    }

    /// Sends a datagram, which may be lost.
    pub fn send_datagram(&self, peer: PeerId, bytes: Vec<u8>) -> Result<(), SendError> {
        self.command(peer, Command::Datagram(bytes))
    }

    /// Closes a connection after what was sent before; the peer learns `code` and `reason`. However much waits, this is done.
    pub fn close(&self, peer: PeerId, code: u32, reason: &str) -> Result<(), SendError> {
        self.command(peer, Command::Close { code, reason: reason.to_owned() })
    }

    fn published(&self) -> MutexGuard<'_, Published> {
        lock(&self.inner.published)
    }

    /// What is known of a connection, as of the network thread's last turn. What waits to be sent is exact: it counts from
    /// the moment in which it was handed over. `None` before the first turn and after the connection's end.
    pub fn stats(&self, peer: PeerId) -> Option<PeerStats> {
        let published = self.published();
        let mut stats = *published.stats.get(&peer)?;
        // Under the same lock as the thread's own counts: a byte is in one of both.
        let load = self.inner.outbox.load(peer);
        stats.queued_bytes += load.bytes;
        stats.streams_under_way += load.streams;
        stats.unacknowledged_bytes += load.stream_bytes;
        Some(stats)
    }

    /// What overflowed so far, as of the network thread's last turn.
    pub fn counters(&self) -> Counters {
        let counters = self.published().counters;
        let refused = counters.datagrams_refused + self.inner.outbox.datagrams_dropped();
        Counters { datagrams_refused: refused, ..counters }
    }

    /// What became of the datagrams on the simulated link, if there is one.
    pub fn link_counts(&self, direction: Direction) -> Option<LinkCounts> {
        self.published().link.map(|[to_client, to_server]| match direction {
            Direction::ToClient => to_client,
            Direction::ToServer => to_server,
        })
    }

    /// The socket's own address.
    pub fn local_addr(&self) -> SocketAddr {
        self.inner.local_addr
    }
}

/// The events of the network thread.
pub struct Events {
    inbox: Arc<Inbox>,
    waker: Arc<Waker>,
}

impl Drop for Events {
    fn drop(&mut self) {
        self.inbox.abandon();
        let _ = self.waker.wake();
    }
}

impl Events {
    /// Unparks a thread with each event from now on, for one that waits for other things too. The first that is named counts.
    pub fn wake(&self, thread: Thread) {
        self.inbox.wake(thread);
    }

    /// The next event, if there is one already.
    pub fn try_next(&self) -> Option<Event> {
        self.next_timeout(Duration::ZERO).ok().flatten()
    }

    /// The next event, waiting up to `timeout` for it. Peers come in turn.
    ///
    /// # Errors
    /// [`Stopped`] when the network thread has ended and no events are left.
    pub fn next_timeout(&self, timeout: Duration) -> Result<Option<Event>, Stopped> {
        match self.inbox.wait(timeout) {
            Next::Event { event, makes_room } => {
                if makes_room {
                    // Failing only means that the thread notices at its next look.
                    let _ = self.waker.wake();
                }
                Ok(Some(event))
            }
            Next::Nothing => Ok(None),
            Next::Ended => Err(Stopped),
        }
    }
}

/// The network thread has ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the network thread has ended; its reason is in the log")]
pub struct Stopped;

/// Runs a driver on a thread of its own.
pub fn spawn(driver: Driver) -> Result<(Handle, Events), DriverError> {
    let local_addr = driver.local_addr()?;
    let waker = driver.waker();
    let inbox = driver.endpoint.inbox();
    let (outbox, published) = (Arc::new(Outbox::default()), Arc::new(Mutex::default()));
    let (peer_ids, stream_ids) = driver.endpoint.id_sources();
    let worker = Worker {
        driver,
        outbox: outbox.clone(),
        inbox: inbox.clone(),
        published: published.clone(),
        published_ns: 0,
    };
    let thread = std::thread::Builder::new().name("network".into()).spawn(move || worker.run())?;
    let inner = Inner {
        outbox,
        waker: waker.clone(),
        thread: Some(thread),
        published,
        peer_ids,
        stream_ids,
        local_addr,
    };
    Ok((Handle { inner: Arc::new(inner) }, Events { inbox, waker }))
}

/// The network thread.
struct Worker {
    driver: Driver,
    outbox: Arc<Outbox>,
    inbox: Arc<Inbox>,
    published: Arc<Mutex<Published>>,
    published_ns: i64,
}

/// However the thread ends, nobody waits for its events, and nobody's commands wait.
impl Drop for Worker {
    fn drop(&mut self) {
        self.inbox.end();
        self.outbox.end();
    }
}

impl Worker {
    fn run(mut self) {
        let result = loop {
            self.take_commands();
            if self.outbox.is_done() || self.inbox.is_abandoned() {
                break self.driver.farewell();
            }
            self.driver.endpoint.read_on();
            if let Err(e) = self.turn() {
                break Err(e);
            }
        };
        if let Err(e) = result {
            tracing::error!("the network thread ends: {e}");
        }
    }

    /// Sends what there is, tells how that went, then waits for more.
    fn turn(&mut self) -> io::Result<()> {
        let now_ns = monotonic_now_ns();
        self.driver.advance(now_ns)?;
        // While there is more to read, turns are short and many.
        if !self.driver.more_to_read || now_ns - self.published_ns >= PUBLISH_NS {
            self.published_ns = now_ns;
            self.publish();
        }
        self.driver.poll(MAX_WAIT)
    }

    fn take_commands(&mut self) {
        // A bound, so that a busy application cannot keep the socket waiting.
        for _ in 0..COMMANDS_PER_TURN {
            let Some((peer, command)) = self.outbox.pop() else { return };
            self.execute(peer, command);
        }
        // Failing only means that the thread notices at its next look.
        let _ = self.driver.waker.wake();
    }

    fn execute(&mut self, peer: PeerId, command: Command) {
        let now_ns = monotonic_now_ns();
        let endpoint = self.driver.endpoint();
        let sent = match command {
            Command::Connect { remote, expected } => {
                endpoint.connect_as(now_ns, peer, remote, expected);
                Ok(())
            }
            Command::Control(message) => endpoint.send_control(peer, &message),
            Command::Stream { stream, bytes, priority } => {
                endpoint.send_stream_as(peer, stream, bytes, priority)
            }
            Command::Cancel(stream) => {
                endpoint.cancel_stream(peer, stream);
                Ok(())
            }
            Command::Datagram(bytes) => {
                endpoint.send_datagram(peer, &bytes);
                Ok(())
            }
            Command::Close { code, reason } => {
                endpoint.close(now_ns, peer, code, &reason);
                Ok(())
            }
        };
        match sent {
            // Its end is told already, or was never begun.
            Ok(()) | Err(SendError::NotConnected) => {}
            // The peer would wait for ever for what is missing.
            Err(error) => {
                tracing::warn!("a connection ends: {error}");
                let reason = format!("a message could not be sent: {error}");
                endpoint.close(now_ns, peer, CloseCode::NotUnderstood.code(), &reason);
            }
        }
    }

    fn publish(&mut self) {
        let endpoint = &self.driver.endpoint;
        let stats = endpoint.peers().filter_map(|peer| Some((peer, endpoint.stats(peer)?))).collect();
        let link = self.driver.link.as_ref();
        let link = link.map(|link| [Direction::ToClient, Direction::ToServer].map(|d| link.counts(d)));
        let mut published = lock(&self.published);
        self.outbox.told();
        (published.stats, published.counters, published.link) = (stats, endpoint.counters(), link);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::endpoint::EndpointConfig;

    /// Whether the poll wakes because the socket takes more.
    fn wakes_for_room(driver: &mut Driver) -> bool {
        driver.watch_for_room().expect("registered");
        driver.poll.poll(&mut driver.readiness, Some(Duration::from_millis(20))).expect("polled");
        driver.readiness.iter().any(|event| event.token() == SOCKET && event.is_writable())
    }

    #[test]
    fn the_socket_is_watched_for_room_only_while_something_is_pending() {
        let any = "127.0.0.1:0".parse().expect("an address");
        let mut driver = Driver::bind(Endpoint::client(EndpointConfig::default()), any).expect("bound");
        assert!(!wakes_for_room(&mut driver), "an idle socket nearly always has room");
        let to = driver.local_addr().expect("bound");
        driver.pending = Some(Transmit { to, from_ip: None, bytes: vec![0], segment_size: None, ecn: None });
        assert!(wakes_for_room(&mut driver));
        driver.pending = None;
        assert!(!wakes_for_room(&mut driver));
    }

    #[test]
    fn a_socket_for_every_ipv6_address_hears_ipv4_too() {
        let any = "[::]:0".parse().expect("an address");
        let mut driver = Driver::bind(Endpoint::client(EndpointConfig::default()), any).expect("bound");
        let port = driver.local_addr().expect("bound").port();
        let sender = std::net::UdpSocket::bind("127.0.0.1:0").expect("bound");
        sender.send_to(b"not QUIC", ("127.0.0.1", port)).expect("sent");
        driver.poll(Duration::from_secs(2)).expect("polled");
        assert!(driver.more_to_read);
    }

    #[test]
    fn a_socket_that_keeps_failing_is_opened_anew_at_its_address() {
        let any = "127.0.0.1:0".parse().expect("an address");
        let mut driver = Driver::bind(Endpoint::client(EndpointConfig::default()), any).expect("bound");
        let address = driver.local_addr().expect("bound");
        let error = || io::Error::other("the adapter is gone");
        (1..MANY_FAILURES).for_each(|_| driver.failed("receiving", &error()).expect("it goes on"));
        assert_eq!(driver.failures, MANY_FAILURES - 1, "one error, or a few, say nothing");
        driver.failed("receiving", &error()).expect("it goes on");
        assert_eq!(driver.failures, MANY_FAILURES, "not so soon after it was opened");
        driver.opened_ns -= REOPEN_NS;
        driver.failed("receiving", &error()).expect("opened anew");
        assert_eq!((driver.failures, driver.local_addr().expect("bound")), (0, address));
        let sender = std::net::UdpSocket::bind(any).expect("bound");
        sender.send_to(b"not QUIC", address).expect("sent");
        driver.poll(Duration::from_secs(2)).expect("polled");
        assert!(driver.more_to_read, "it hears what is sent to its address");
    }
}
