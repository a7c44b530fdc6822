//! A stranger on the network: QUIC on its own socket, with an attack's bytes on its streams.
//!
//! It uses `quinn-proto` itself, because the project's own transport would refuse to send invalid data. It trusts any server,
//! and it sends to this machine only.

use anyhow::{Context, ensure};
use bytes::{Bytes, BytesMut};
use quinn_proto as proto;
use quinn_proto::congestion::{Controller, ControllerFactory};
use quinn_proto::crypto::rustls::QuicClientConfig;
use quinn_proto::{ConnectionHandle, DatagramEvent, Dir, VarInt};
use shadecast_transport::{SERVER_NAME, believing_client_crypto};
use std::any::Any;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

/// Datagrams received in one go before others have their turn.
const RECEIVE_TURN: usize = 64;
/// Datagrams sent in one go before others have their turn.
const SEND_TURN: usize = 64;
/// Bytes of the server's control stream that are kept to be looked at.
const HEARD_BYTES: usize = 4096;
/// Bytes that may wait or be under way on this side.
const SEND_WINDOW_BYTES: u64 = 256 << 10;
/// The longest sleep of a wait, so that what comes is answered soon.
const NAP: Duration = Duration::from_micros(500);

/// How a stranger takes the network's hints.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Manners {
    /// Sends less where packets are lost.
    Polite,
    /// Sends as if nothing were ever lost.
    Greedy,
}

/// A congestion controller that controls nothing.
struct Unbounded;

/// A window that is never full, bytes.
const UNBOUNDED_BYTES: u64 = 1 << 40;

impl Controller for Unbounded {
    fn on_congestion_event(&mut self, _now: Instant, _sent: Instant, _is_persistent: bool, _lost_bytes: u64) {
    }

    fn on_mtu_update(&mut self, _new_mtu: u16) {}

    fn window(&self) -> u64 {
        UNBOUNDED_BYTES
    }

    fn clone_box(&self) -> Box<dyn Controller> {
        Box::new(Self)
    }

    fn initial_window(&self) -> u64 {
        UNBOUNDED_BYTES
    }

    fn into_any(self: Box<Self>) -> Box<dyn Any> {
        self
    }
}

impl ControllerFactory for Unbounded {
    fn build(self: Arc<Self>, _now: Instant, _current_mtu: u16) -> Box<dyn Controller> {
        Box::new(Self)
    }
}

fn client_config(manners: Manners) -> anyhow::Result<proto::ClientConfig> {
    static CRYPTO: OnceLock<Arc<QuicClientConfig>> = OnceLock::new();
    let crypto = match CRYPTO.get() {
        Some(crypto) => crypto.clone(),
        None => {
            let made = believing_client_crypto()?;
            CRYPTO.get_or_init(|| made).clone()
        }
    };
    let mut transport = proto::TransportConfig::default();
    // Never idle, and with little buffered here, so that what was taken was sent.
    transport.send_window(SEND_WINDOW_BYTES).initial_rtt(Duration::from_millis(20)).max_idle_timeout(None);
    if manners == Manners::Greedy {
        transport.congestion_controller_factory(Arc::new(Unbounded));
    }
    let mut config = proto::ClientConfig::new(crypto);
    config.transport_config(Arc::new(transport));
    Ok(config)
}

/// One connection from a socket of its own.
pub(crate) struct Stranger {
    socket: UdpSocket,
    server: SocketAddr,
    endpoint: proto::Endpoint,
    handle: ConnectionHandle,
    conn: proto::Connection,
    control: Option<proto::StreamId>,
    heard: Vec<u8>,
    connected: bool,
    ended: Option<String>,
    receive_buffer: Vec<u8>,
}

impl Stranger {
    /// Begins a connection to a server on this machine.
    pub(crate) fn connect(server: SocketAddr) -> anyhow::Result<Self> {
        Self::connect_with(server, Manners::Polite)
    }

    /// The same with other manners.
    pub(crate) fn connect_with(server: SocketAddr, manners: Manners) -> anyhow::Result<Self> {
        Self::begin(server, Ipv4Addr::LOCALHOST, manners)
    }

    /// The same from another of the loopback network's addresses.
    pub(crate) fn connect_from(server: SocketAddr, from: Ipv4Addr) -> anyhow::Result<Self> {
        Self::begin(server, from, Manners::Polite)
    }

    fn begin(server: SocketAddr, from: Ipv4Addr, manners: Manners) -> anyhow::Result<Self> {
        ensure!(server.ip().is_loopback() && from.is_loopback(), "{server} is not on this machine");
        let socket = UdpSocket::bind((from, 0)).context("opening a stranger's socket")?;
        socket.set_nonblocking(true)?;
        let endpoint_config = Arc::new(proto::EndpointConfig::default());
        let mut endpoint = proto::Endpoint::new(endpoint_config, None, true, None);
        let (handle, conn) =
            endpoint.connect(Instant::now(), client_config(manners)?, server, SERVER_NAME)?;
        Ok(Self {
            socket,
            server,
            endpoint,
            handle,
            conn,
            control: None,
            heard: Vec::new(),
            connected: false,
            ended: None,
            receive_buffer: vec![0; 65_535],
        })
    }

    /// The handshake is done and the connection has not ended.
    pub(crate) fn is_connected(&self) -> bool {
        self.connected && self.ended.is_none()
    }

    /// Whether the handshake was ever done.
    pub(crate) fn was_connected(&self) -> bool {
        self.connected
    }

    /// Why the connection ended, if it has.
    pub(crate) fn ended(&self) -> Option<&str> {
        self.ended.as_deref()
    }

    /// The first bytes of the server's control stream.
    pub(crate) fn heard(&self) -> &[u8] {
        &self.heard
    }

    /// Receives and sends what there is, and returns.
    pub(crate) fn pump(&mut self) -> anyhow::Result<()> {
        for _ in 0..RECEIVE_TURN {
            let Some(datagram) = self.receive()? else { break };
            self.take(&datagram);
        }
        let now = Instant::now();
        if self.conn.poll_timeout().is_some_and(|at| at <= now) {
            self.conn.handle_timeout(now);
        }
        self.settle();
        self.listen();
        self.transmit()?;
        self.settle();
        Ok(())
    }

    /// Pumps until `done` or the deadline; true where it was `done`.
    pub(crate) fn pump_until(
        &mut self,
        deadline: Instant,
        done: impl Fn(&Self) -> bool,
    ) -> anyhow::Result<bool> {
        loop {
            self.pump()?;
            if done(self) {
                return Ok(true);
            }
            if Instant::now() >= deadline {
                return Ok(false);
            }
            std::thread::sleep(NAP);
        }
    }

    /// Sends the first flight of the handshake and hears nothing; if the server asks to prove the address, that is done
    /// where `proves_address`. Gives the number of datagrams sent.
    pub(crate) fn begin_only(&mut self, proves_address: bool) -> anyhow::Result<u64> {
        let mut sent = self.transmit()?;
        let deadline = Instant::now() + Duration::from_millis(20);
        while proves_address && Instant::now() < deadline {
            match self.receive()? {
                // A long header of type Retry (RFC 9000, section 17.2.5).
                Some(datagram) if datagram.first().is_some_and(|first| first & 0xf0 == 0xf0) => {
                    self.take(&datagram);
                    sent += self.transmit()?;
                    break;
                }
                Some(_) => break,
                None => std::thread::sleep(NAP),
            }
        }
        Ok(sent)
    }

    fn receive(&mut self) -> anyhow::Result<Option<BytesMut>> {
        match self.socket.recv(&mut self.receive_buffer) {
            Ok(length) => Ok(Some(BytesMut::from(&self.receive_buffer[..length]))),
            Err(error) if is_passing(&error) => Ok(None),
            Err(error) => Err(error).context("receiving as a stranger"),
        }
    }

    fn take(&mut self, datagram: &BytesMut) {
        let mut response = Vec::new();
        let (now, server) = (Instant::now(), self.server);
        let event = self.endpoint.handle(now, server, None, None, datagram.clone(), &mut response);
        if let Some(DatagramEvent::ConnectionEvent(_, event)) = event {
            self.conn.handle_event(event);
        }
    }

    fn transmit(&mut self) -> anyhow::Result<u64> {
        let mut sent = 0;
        let mut bytes = Vec::with_capacity(2048);
        for _ in 0..SEND_TURN {
            bytes.clear();
            let Some(transmit) = self.conn.poll_transmit(Instant::now(), 1, &mut bytes) else { break };
            match self.socket.send_to(&bytes[..transmit.size], self.server) {
                // What the kernel does not take is lost, as on any network.
                Ok(_) => sent += 1,
                Err(error) if is_passing(&error) => {}
                Err(error) => return Err(error).context("sending as a stranger"),
            }
        }
        Ok(sent)
    }

    /// Moves events between connection and endpoint, and notes what they mean.
    fn settle(&mut self) {
        while let Some(event) = self.conn.poll_endpoint_events() {
            if let Some(answer) = self.endpoint.handle_event(self.handle, event) {
                self.conn.handle_event(answer);
            }
        }
        while let Some(event) = self.conn.poll() {
            match event {
                proto::Event::Connected => self.connected = true,
                proto::Event::ConnectionLost { reason } => self.ended = Some(reason.to_string()),
                _ => {}
            }
        }
    }

    /// Reads the server's control stream; its other streams are left unread.
    fn listen(&mut self) {
        let Some(id) = self.control else { return };
        let mut stream = self.conn.recv_stream(id);
        let Ok(mut chunks) = stream.read(true) else { return };
        while let Ok(Some(chunk)) = chunks.next(HEARD_BYTES) {
            let room = HEARD_BYTES.saturating_sub(self.heard.len()).min(chunk.bytes.len());
            self.heard.extend_from_slice(&chunk.bytes[..room]);
        }
        let _ = chunks.finalize(); // transmits are polled anyway
    }

    /// Appends to the control stream, which is opened where that is yet to be done. Gives the bytes taken.
    pub(crate) fn write_control(&mut self, bytes: &[u8]) -> usize {
        if self.control.is_none() {
            self.control = self.conn.streams().open(Dir::Bi);
        }
        self.control.map_or(0, |id| self.conn.send_stream(id).write(bytes).unwrap_or(0))
    }

    /// Opens a unidirectional stream, if the server allows one more.
    pub(crate) fn open_uni(&mut self) -> Option<proto::StreamId> {
        self.conn.streams().open(Dir::Uni)
    }

    /// Appends to a unidirectional stream. Gives the bytes taken.
    pub(crate) fn write_uni(&mut self, id: proto::StreamId, bytes: &[u8]) -> usize {
        self.conn.send_stream(id).write(bytes).unwrap_or(0)
    }

    /// Sends a datagram; whether it was taken.
    pub(crate) fn send_datagram(&mut self, bytes: &[u8]) -> bool {
        self.conn.datagrams().send(Bytes::copy_from_slice(bytes), true).is_ok()
    }

    /// Closes as a polite client does; the next turn says so to the server.
    pub(crate) fn close(&mut self) {
        self.conn.close(Instant::now(), VarInt::from_u32(0), Bytes::from_static(b"leaving"));
    }
}

/// Nothing there, or a word about an earlier datagram.
fn is_passing(error: &io::Error) -> bool {
    use io::ErrorKind::{ConnectionRefused, ConnectionReset, Interrupted, OutOfMemory, WouldBlock};
    [ConnectionRefused, ConnectionReset, Interrupted, OutOfMemory, WouldBlock].contains(&error.kind())
}

/// A socket that sends raw datagrams from one of the loopback network's addresses.
pub(crate) fn raw_socket(from: IpAddr) -> anyhow::Result<UdpSocket> {
    ensure!(from.is_loopback(), "{from} is not of this machine");
    let socket = UdpSocket::bind((from, 0)).context("opening a raw socket")?;
    socket.set_nonblocking(true)?;
    Ok(socket)
}
