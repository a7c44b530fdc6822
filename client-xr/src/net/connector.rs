//! One server, and the wish to be connected to it: what the client and the lines say to each other, and what the user is
//! told about it.

use super::lines::{LineEvent, Lines};
use super::{RunError, RunOptions};
use crate::client::{Client, ClientError, Notice};
use crate::platform::monotonic_now;
use crate::traced::Traced;
use shadecast_protocol::close::CloseCode;
use shadecast_protocol::session::Out;
use shadecast_protocol::text::printable;
use shadecast_protocol::time::ClientTime;
use shadecast_transport::{CloseKind, Event, ExpectedIdentity, Fingerprint, KnownServers, Meeting};
use std::collections::VecDeque;
use std::net::SocketAddr;

/// Sentences that are not said again until the session stands: a round of attempts says the same as the one before.
const REMEMBERED_SENTENCES: usize = 8;

/// How a sentence is meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Tone {
    /// As it should be.
    News,
    /// As it should not be: said even to who wants to hear only what goes wrong.
    Trouble,
}

/// One server, and the wish to be connected to it.
pub(super) struct Connector {
    lines: Lines,
    known: KnownServers,
    /// The only identity that will do, if the user named one.
    required: Option<Fingerprint>,
    /// As the user writes it.
    server: String,
    /// What the user was told since the session last stood.
    told: VecDeque<String>,
    pub(super) traced: Traced,
}

impl Connector {
    pub(super) fn new(
        options: &RunOptions,
        addresses: &[SocketAddr],
        traced: Traced,
    ) -> Result<Self, RunError> {
        Ok(Self {
            lines: Lines::new(addresses.to_vec()),
            known: KnownServers::load(&options.identity_dir)?,
            required: options.fingerprint,
            server: printable(&options.server),
            told: VecDeque::with_capacity(REMEMBERED_SENTENCES),
            traced,
        })
    }

    pub(super) fn status(&self) -> String {
        format!("Connecting to {}", self.server)
    }

    /// Hands in what has arrived, connects where it is time to, and lets the client do what is due.
    pub(super) fn pump(&mut self, client: &mut Client) -> Result<(), ClientError> {
        while let Some(event) = self.lines.poll(monotonic_now()) {
            self.take(client, event)?;
        }
        let now = monotonic_now();
        let (known, required, server) = (&self.known, self.required, &self.server);
        if let Some(event) = self.lines.dial(now, |address| expected(known, required, server, address)) {
            self.take(client, event)?;
        }
        client.advance(now)?;
        while let Some(notice) = client.poll_notice() {
            self.act_on(client, notice, now);
        }
        self.flush(client);
        Ok(())
    }

    fn take(&mut self, client: &mut Client, event: LineEvent) -> Result<(), ClientError> {
        match event {
            LineEvent::Connected { address, fingerprint } => {
                if let Some(fingerprint) = fingerprint {
                    self.meet(address, fingerprint);
                }
                client.on_connected(monotonic_now());
            }
            LineEvent::Failed { kind, reason } => self.tell_closed(client, kind, &reason),
            LineEvent::Lost { kind, reason } => {
                client.on_closed(monotonic_now());
                self.tell_closed(client, kind, &reason);
            }
            LineEvent::Arrived(event) => {
                if let Event::Stream { bytes, at_ns, .. } = &event {
                    self.traced.arrived(bytes, ClientTime(*at_ns));
                }
                arrived(client, event)?;
            }
        }
        Ok(())
    }

    /// Pins who answered, and tells the user once who that is.
    fn meet(&mut self, address: SocketAddr, fingerprint: Fingerprint) {
        let place = self.place(address);
        match self.known.remember(&self.server, address, fingerprint) {
            Ok(Meeting::Again) => tracing::debug!("{place} has answered"),
            Ok(Meeting::KnownAs(name)) => tracing::info!("{place} is the server that is known as {name}"),
            Ok(Meeting::First) => {
                tracing::info!("first connection to {place}: its identity is {fingerprint}; pinned");
            }
            Err(error) => tracing::warn!("{error}; the server will not be recognised next time"),
        }
    }

    /// The server as the user writes it, with the address that it turned out to be.
    fn place(&self, address: SocketAddr) -> String {
        let address = address.to_string();
        if address == self.server { address } else { format!("{} ({address})", self.server) }
    }

    fn tell_closed(&mut self, client: &mut Client, kind: CloseKind, reason: &str) {
        match kind {
            CloseKind::IdentityChanged => self.tell(client, Tone::Trouble, reason),
            _ => self.tell(client, Tone::Trouble, &format!("{}: {reason}", self.status())),
        }
    }

    fn act_on(&mut self, client: &mut Client, notice: Notice, now: ClientTime) {
        let text = match notice {
            Notice::Welcome(_) => {
                self.lines.succeeded();
                self.told.clear();
                self.tell(client, Tone::News, &format!("Connected to {}", self.server));
                return;
            }
            Notice::Refused(refused) => format!("{}: {}", refused.reason, refused.remedy),
            Notice::ServerLeft => format!("{} has ended the session", self.server),
            Notice::Failed(reason) => reason,
        };
        self.tell(client, Tone::Trouble, &text);
        self.flush(client);
        self.lines.give_up(now, CloseCode::NotUnderstood, &text);
        client.on_closed(now);
    }

    /// Says something in the headset, and on stderr once.
    fn tell(&mut self, client: &mut Client, tone: Tone, text: &str) {
        client.set_status(text);
        if self.told.iter().any(|told| told == text) {
            return;
        }
        match tone {
            Tone::News => tracing::info!("{text}"),
            Tone::Trouble => tracing::warn!("{text}"),
        }
        self.told.truncate(REMEMBERED_SENTENCES - 1);
        self.told.push_front(text.to_owned());
    }

    /// Hands the client's bytes to the network thread. What it cannot take is lost, as on a bad network.
    pub(super) fn flush(&mut self, client: &mut Client) {
        while let Some(out) = client.poll_out() {
            let Some((handle, peer)) = self.lines.live() else { continue };
            let sent = match out {
                Out::Control(bytes) => handle.send_control(peer, bytes),
                Out::Datagram(bytes) => handle.send_datagram(peer, bytes),
                Out::Stream { bytes, priority } => handle.send_stream(peer, bytes, priority).map(|_| ()),
            };
            if let Err(error) = sent {
                tracing::debug!("{error}");
            }
        }
    }

    pub(super) fn leave(&mut self, client: &mut Client) {
        client.say_goodbye();
        self.flush(client);
        self.lines.leave();
    }
}

/// Who is to answer at `address`: what the user demands counts before what is known.
fn expected(
    known: &KnownServers,
    required: Option<Fingerprint>,
    server: &str,
    address: SocketAddr,
) -> ExpectedIdentity {
    required.map_or_else(
        || known.expected(server, address),
        |fingerprint| ExpectedIdentity::Pinned {
            fingerprint,
            remedy: "--fingerprint names another server; a server says its identity when it starts to listen"
                .to_owned(),
        },
    )
}

fn arrived(client: &mut Client, event: Event) -> Result<(), ClientError> {
    match event {
        Event::Control { message, at_ns, .. } => client.receive_control(ClientTime(at_ns), &message)?,
        Event::Stream { bytes, at_ns, .. } => client.receive_stream(ClientTime(at_ns), &bytes)?,
        Event::StreamReset { head, .. } => client.receive_reset(monotonic_now(), &head),
        Event::Datagram { bytes, at_ns, .. } => client.receive_datagram(ClientTime(at_ns), &bytes),
        Event::Connected { .. } | Event::Closed { .. } => {} // told by the lines
    }
    Ok(())
}
