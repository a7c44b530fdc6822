//! The client in real time: a socket on a thread of its own, the real clock, and connecting again for as long as the user
//! wants. When the server goes away its last bundle stays on display.

use crate::client::{Client, ClientError, ClientOptions, FrameReport, Notice, Step};
use crate::platform::{Platform, monotonic_now};
use crate::stats::ClientStats;
use crate::xr::{Xr, XrError, XrOptions};
use shadecast_protocol::session::Out;
use shadecast_protocol::time::DisplayTime;
use shadecast_transport::mio::{DriverError, any_address_for};
use shadecast_transport::{
    CloseKind, Driver, Endpoint, EndpointConfig, Event, Events, Handle, IdentityError, KnownServers, PeerId,
    spawn,
};
use std::net::{SocketAddr, ToSocketAddrs};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Wait before the second attempt to connect; each further one waits twice as long as the one before.
const FIRST_BACK_OFF_NS: i64 = 250_000_000;
/// Longest wait between two attempts.
const LONGEST_BACK_OFF_NS: i64 = 4_000_000_000;
/// How often the headset is opened again after it was lost, and how long to wait in between.
const REOPEN_ATTEMPTS: u32 = 30;
const REOPEN_WAIT: Duration = Duration::from_secs(1);
/// How long to sleep where the headset wants no frames.
const IDLE_WAIT: Duration = Duration::from_millis(10);
/// Close code of a client that leaves.
const CODE_LEAVING: u32 = 0;
/// Close code of a client that cannot make sense of the server.
const CODE_FAILED: u32 = 1;

/// What to run.
#[derive(Clone, Debug)]
pub struct RunOptions {
    /// The server, as the user writes it: `host:port`.
    pub server: String,
    /// Where the fingerprints of known servers are kept.
    pub identity_dir: PathBuf,
    /// How the client behaves.
    pub client: ClientOptions,
    /// How the headset is opened.
    pub xr: XrOptions,
    /// Seconds after the first display frame at which the session is asked to end; 0: never.
    pub seconds: f64,
}

/// What ends a run.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The server's address cannot be understood.
    #[error(
        "the server's address \"{address}\" cannot be used: {reason}; write host:port, such as 192.168.1.5:7400"
    )]
    Address {
        /// What was given.
        address: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The list of known servers.
    #[error(transparent)]
    Identity(#[from] IdentityError),
    /// The socket.
    #[error(transparent)]
    Driver(#[from] DriverError),
    /// Headset or device.
    #[error(transparent)]
    Client(#[from] ClientError),
}

impl From<XrError> for RunError {
    fn from(error: XrError) -> Self {
        Self::Client(error.into())
    }
}

/// Who watches a run: called after each display frame.
pub type Observer<'a> = dyn FnMut(&mut Client, &FrameReport) -> Result<(), ClientError> + 'a;

/// Runs until the headset's session ends, `stop` is set, or something fails for good. A lost headset is opened anew.
pub fn run(
    platform: &Platform,
    options: &RunOptions,
    stop: &AtomicBool,
    observe: &mut Observer<'_>,
) -> Result<ClientStats, RunError> {
    let remote = resolve(&options.server)?;
    let mut xr = Xr::open(platform, options.xr)?;
    loop {
        let error = match run_headset(xr, options, remote, stop, observe) {
            Err(RunError::Client(error)) if error.is_lost() => error,
            ended => return ended,
        };
        tracing::warn!("{error}; opening the headset again");
        xr = reopen(platform, options, stop)?;
    }
}

fn resolve(server: &str) -> Result<SocketAddr, RunError> {
    let wrong = |reason: String| RunError::Address { address: server.to_owned(), reason };
    let mut addresses = server.to_socket_addrs().map_err(|error| wrong(error.to_string()))?;
    addresses.next().ok_or_else(|| wrong("it names no machine".to_owned()))
}

fn reopen(platform: &Platform, options: &RunOptions, stop: &AtomicBool) -> Result<Xr, RunError> {
    let mut attempt = 0;
    loop {
        match Xr::open(platform, options.xr) {
            Ok(xr) => return Ok(xr),
            Err(error) if attempt == REOPEN_ATTEMPTS || stop.load(Ordering::Relaxed) => {
                return Err(error.into());
            }
            Err(error) => tracing::debug!("{error}"),
        }
        attempt += 1;
        std::thread::sleep(REOPEN_WAIT);
    }
}

fn run_headset(
    xr: Xr,
    options: &RunOptions,
    remote: SocketAddr,
    stop: &AtomicBool,
    observe: &mut Observer<'_>,
) -> Result<ClientStats, RunError> {
    let mut client = Client::new(xr, options.client)?;
    let mut connector = Connector::new(&options.server, remote, &options.identity_dir)?;
    client.set_status(&connector.status());
    let mut first: Option<DisplayTime> = None;
    let mut leaving = false;
    loop {
        match client.step_with(|client| connector.pump(client))? {
            Step::Frame(report) => {
                connector.flush(&mut client);
                observe(&mut client, &report)?;
                let shown_ns = report.display_time.since(*first.get_or_insert(report.display_time));
                let is_over = options.seconds > 0.0 && shown_ns as f64 * 1e-9 >= options.seconds;
                if (is_over || stop.load(Ordering::Relaxed)) && !std::mem::replace(&mut leaving, true) {
                    client.request_exit();
                }
            }
            Step::Idle => {
                if stop.load(Ordering::Relaxed) && !std::mem::replace(&mut leaving, true) {
                    client.request_exit();
                }
                connector.flush(&mut client);
                std::thread::sleep(IDLE_WAIT);
            }
            Step::Exit => break,
        }
    }
    connector.leave(&mut client);
    Ok(client.stats())
}

/// One server, and the wish to be connected to it.
struct Connector {
    handle: Handle,
    events: Events,
    known: KnownServers,
    /// As the user writes it.
    server: String,
    remote: SocketAddr,
    peer: Option<PeerId>,
    next_attempt: DisplayTime,
    back_off_ns: i64,
    /// What the user was last told.
    told: String,
}

impl Connector {
    fn new(server: &str, remote: SocketAddr, identity_dir: &Path) -> Result<Self, RunError> {
        let known = KnownServers::load(identity_dir)?;
        let endpoint = Endpoint::client(EndpointConfig::default());
        let (handle, events) = spawn(Driver::bind(endpoint, any_address_for(remote))?)?;
        Ok(Self {
            handle,
            events,
            known,
            server: server.to_owned(),
            remote,
            peer: None,
            next_attempt: DisplayTime(i64::MIN),
            back_off_ns: FIRST_BACK_OFF_NS,
            told: String::new(),
        })
    }

    fn status(&self) -> String {
        format!("Connecting to {}", self.server)
    }

    /// Hands in what has arrived, connects where it is time to, and lets the client do what is due.
    fn pump(&mut self, client: &mut Client) -> Result<(), ClientError> {
        while let Some(event) = self.events.try_next() {
            self.take(client, event)?;
        }
        let now = monotonic_now();
        if self.peer.is_none() && now >= self.next_attempt {
            self.connect(client, now);
        }
        client.advance(now)?;
        while let Some(notice) = client.poll_notice() {
            self.heed(client, notice, now);
        }
        self.flush(client);
        Ok(())
    }

    fn connect(&mut self, client: &mut Client, now: DisplayTime) {
        self.next_attempt = now.plus_ns(self.back_off_ns);
        self.back_off_ns = (self.back_off_ns * 2).min(LONGEST_BACK_OFF_NS);
        match self.handle.connect(self.remote, self.known.expected(&self.server)) {
            Ok(peer) => self.peer = Some(peer),
            Err(error) => self.tell(client, &format!("Cannot connect to {}: {error}", self.server)),
        }
    }

    fn take(&mut self, client: &mut Client, event: Event) -> Result<(), ClientError> {
        match event {
            Event::Connected { peer, fingerprint, .. } if self.peer == Some(peer) => {
                let remembered = fingerprint.map_or(Ok(()), |it| self.known.remember(&self.server, it));
                if let Err(error) = remembered {
                    tracing::warn!("{error}; the server will not be recognised next time");
                }
                client.on_connected(monotonic_now());
            }
            Event::Control { peer, message, at_ns } if self.peer == Some(peer) => {
                client.receive_control(DisplayTime(at_ns), &message)?;
            }
            Event::Stream { peer, bytes, at_ns } if self.peer == Some(peer) => {
                client.receive_stream(DisplayTime(at_ns), &bytes)?;
            }
            Event::StreamReset { peer, head } if self.peer == Some(peer) => {
                client.receive_reset(monotonic_now(), &head);
            }
            Event::Datagram { peer, bytes, at_ns } if self.peer == Some(peer) => {
                client.receive_datagram(DisplayTime(at_ns), &bytes);
            }
            Event::Closed { peer, kind, reason } if self.peer == Some(peer) => {
                self.closed(client, kind, &reason);
            }
            _ => {} // of a connection that was given up
        }
        Ok(())
    }

    fn closed(&mut self, client: &mut Client, kind: CloseKind, reason: &str) {
        self.peer = None;
        let now = monotonic_now();
        client.on_closed(now);
        self.next_attempt = self.next_attempt.max(now);
        match kind {
            CloseKind::IdentityChanged => self.tell(client, reason),
            _ => self.tell(client, &format!("{}: {reason}", self.status())),
        }
    }

    fn heed(&mut self, client: &mut Client, notice: Notice, now: DisplayTime) {
        let text = match notice {
            Notice::Welcome(_) => {
                self.back_off_ns = FIRST_BACK_OFF_NS;
                self.tell(client, &format!("Connected to {}", self.server));
                return;
            }
            Notice::Refused(refused) => format!("{}: {}", refused.reason, refused.remedy),
            Notice::ServerLeft => format!("{} has ended the session", self.server),
            Notice::Failed(reason) => reason,
        };
        self.tell(client, &text);
        self.flush(client);
        if let Some(peer) = self.peer.take() {
            // A thread that has ended needs no close.
            let _ = self.handle.close(peer, CODE_FAILED, &text);
        }
        client.on_closed(now);
        self.next_attempt = now.plus_ns(self.back_off_ns);
    }

    /// Says something in the headset and on stderr, once.
    fn tell(&mut self, client: &mut Client, text: &str) {
        if self.told != text {
            tracing::info!("{text}");
            client.set_status(text);
            self.told = text.to_owned();
        }
    }

    /// Hands the client's bytes to the network thread. What it cannot take is lost, as on a bad network.
    fn flush(&mut self, client: &mut Client) {
        while let Some(out) = client.poll_out() {
            let Some(peer) = self.peer else { continue };
            let sent = match out {
                Out::Control(message) => self.handle.send_control(peer, message),
                Out::Datagram(bytes) => self.handle.send_datagram(peer, bytes),
                Out::Stream { bytes, priority } => self.handle.send_stream(peer, bytes, priority).map(|_| ()),
            };
            if let Err(error) = sent {
                tracing::debug!("{error}");
            }
        }
    }

    fn leave(&mut self, client: &mut Client) {
        client.say_goodbye();
        self.flush(client);
        if let Some(peer) = self.peer.take() {
            let _ = self.handle.close(peer, CODE_LEAVING, "the user left");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_without_a_port_is_refused_with_an_example() {
        let error = resolve("192.168.1.5").expect_err("no port").to_string();
        assert!(error.contains("192.168.1.5:7400"), "{error}");
        assert_eq!(resolve("127.0.0.1:7400").ok(), "127.0.0.1:7400".parse().ok());
    }
}
