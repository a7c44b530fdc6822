//! Connections, their sessions, pings, and who is served. Without I/O and clocks; it encodes nothing and draws nothing, so
//! that a ping is answered when it comes. The server's network thread and the lab drive the same.

mod lines;
pub mod mailbox;
mod place;
#[cfg(test)]
pub(crate) mod testing;

use crate::support::lock::lock;
use lines::Sparse;
use mailbox::{Accepted, Mailbox};
use place::{Greeting, Places, Starts};
use shadecast_protocol::close::CloseCode;
use shadecast_protocol::message::{ClientHello, Refused, ServerOffer, Welcome};
use shadecast_protocol::session::{Out, ServerEvent, ServerSession};
use shadecast_protocol::text::printable;
use shadecast_protocol::time::ServerTime;
use shadecast_transport::{CloseKind, Event, Handle, Network, PeerId, SendError};
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Mutex;

/// A client that was told why it is refused may close the connection itself within this time, nanoseconds.
const FAREWELL_NS: i64 = 500_000_000;
/// Refused clients that are given that time.
const MAX_LEAVING: usize = 8;

/// Says a line to the person who started the server. It must not wait.
pub(crate) type Say<'a> = dyn Fn(&str) + Send + Sync + 'a;

/// Sessions that whoever makes the updates wants to end.
#[derive(Debug, Default)]
pub struct Verdicts {
    refused: Mutex<Vec<(PeerId, Refused)>>,
}

impl Verdicts {
    /// Ends a session; the client is told why.
    pub(crate) fn refuse(&self, peer: PeerId, refused: Refused) {
        lock(&self.refused).push((peer, refused));
    }

    fn take(&self) -> Vec<(PeerId, Refused)> {
        std::mem::take(&mut *lock(&self.refused))
    }
}

/// What carries bytes to clients.
pub trait Carrier {
    /// Sends what a session has to say.
    fn send(&self, peer: PeerId, out: Out) -> Result<(), SendError>;
    /// Ends a connection.
    fn close(&self, peer: PeerId, code: CloseCode, reason: &str);
}

impl Carrier for Handle {
    fn send(&self, peer: PeerId, out: Out) -> Result<(), SendError> {
        match out {
            Out::Control(message) => self.send_control(peer, message),
            Out::Stream { bytes, priority } => self.send_stream(peer, bytes, priority).map(|_| ()),
            Out::Datagram(bytes) => self.send_datagram(peer, bytes),
        }
    }

    fn close(&self, peer: PeerId, code: CloseCode, reason: &str) {
        // A thread that has ended has closed everything.
        let _ = Self::close(self, peer, code.code(), reason);
    }
}

/// Where sessions send to, and whom they tell.
pub struct Surroundings<'a> {
    /// The way to the clients.
    pub carrier: &'a dyn Carrier,
    /// What is new of clients that are served.
    pub mailbox: &'a Mailbox,
    /// Sessions that are to be ended.
    pub verdicts: &'a Verdicts,
    /// The person who started the server.
    pub say: &'a Say<'a>,
}

/// All clients that are connected.
pub struct Sessions {
    /// The terms of the session of a number, with a secret of its own.
    offer: Box<dyn Fn(u64) -> ServerOffer + Send>,
    epoch_ns: i64,
    greeting: Greeting,
    starts: Starts,
    refusal_lines: Sparse,
    places: Places,
    guests: BTreeMap<PeerId, Guest>,
    /// Refused clients, and when their connection is ended if they do not do it.
    leaving: Vec<(PeerId, i64)>,
    sessions: u64,
}

/// A connected client.
struct Guest {
    session: ServerSession,
    remote: SocketAddr,
}

impl Sessions {
    /// Nobody is connected; `viewers` are served at once. `offer` gives the terms of a session by its number. The server's
    /// clock reads 0 at `epoch_ns`.
    pub fn new(offer: Box<dyn Fn(u64) -> ServerOffer + Send>, viewers: usize, epoch_ns: i64) -> Self {
        Self {
            offer,
            epoch_ns,
            greeting: Greeting::default(),
            starts: Starts::default(),
            refusal_lines: Sparse::default(),
            places: Places::new(viewers),
            guests: BTreeMap::new(),
            leaving: Vec::new(),
            sessions: 0,
        }
    }

    /// Takes an event of the transport.
    pub fn take(&mut self, event: Event, now_ns: i64, around: &Surroundings<'_>) {
        match event {
            Event::Connected { peer, remote, .. } => self.connected(peer, remote, now_ns, around),
            Event::Control { peer, message, at_ns } => {
                self.handle(peer, [at_ns, now_ns], around, |session| session.on_control(&message));
            }
            Event::Datagram { peer, bytes, at_ns } => {
                let received = ServerTime(at_ns - self.epoch_ns);
                self.handle(peer, [at_ns, now_ns], around, |session| session.on_datagram(&bytes, received));
            }
            Event::Closed { peer, kind, reason } => self.closed(peer, kind, &reason, around),
            // Clients have nothing to send on streams.
            Event::Stream { .. } | Event::StreamReset { .. } => {}
        }
    }

    /// Does what is due: deadlines, and what the pipeline has decided.
    pub fn tick(&mut self, now_ns: i64, around: &Surroundings<'_>) {
        while let Some(peer) = self.greeting.overdue(now_ns) {
            self.drop_guest(peer, CloseCode::NotUnderstood, "no hello came; connect again", around);
        }
        for (peer, refused) in around.verdicts.take() {
            self.refuse(peer, refused, now_ns, around);
        }
        while let Some(at) = self.leaving.iter().position(|(_, until_ns)| *until_ns <= now_ns) {
            let (peer, _) = self.leaving.swap_remove(at);
            self.drop_guest(peer, CloseCode::Refused, "refused; the reason was sent before", around);
        }
    }

    /// Takes leave of the clients that are served.
    pub(crate) fn goodbye(&mut self, now_ns: i64, around: &Surroundings<'_>) {
        for peer in self.places.served().collect::<Vec<_>>() {
            if let Some(guest) = self.guests.get_mut(&peer) {
                guest.session.goodbye();
            }
            self.flush(peer, now_ns, around);
        }
    }

    fn connected(&mut self, peer: PeerId, remote: SocketAddr, now_ns: i64, around: &Surroundings<'_>) {
        if let Some(oldest) = self.greeting.connected(peer, Network::of(remote.ip()), now_ns) {
            self.drop_guest(
                oldest,
                CloseCode::NotUnderstood,
                "others came and no hello; connect again",
                around,
            );
        }
        self.sessions += 1;
        let session = ServerSession::new((self.offer)(self.sessions));
        self.guests.insert(peer, Guest { session, remote });
    }

    /// Hands something to a client's session, and does what comes of it.
    fn handle(
        &mut self,
        peer: PeerId,
        [at_ns, now_ns]: [i64; 2],
        around: &Surroundings<'_>,
        say: impl FnOnce(&mut ServerSession),
    ) {
        let Some(guest) = self.guests.get_mut(&peer) else { return };
        let before = guest.session.understood();
        say(&mut guest.session);
        if guest.session.understood() > before {
            self.places.heard(peer, at_ns);
        }
        while let Some(event) = self.guests.get_mut(&peer).and_then(|guest| guest.session.poll_event()) {
            self.happened(peer, event, now_ns, around);
        }
        self.flush(peer, now_ns, around);
    }

    fn happened(&mut self, peer: PeerId, event: ServerEvent, now_ns: i64, around: &Surroundings<'_>) {
        match event {
            ServerEvent::Asked { hello, welcome } => self.asked(peer, &hello, *welcome, now_ns, around),
            ServerEvent::Refused(refused) => self.sent_away(peer, &refused, now_ns, around),
            ServerEvent::Goodbye => {
                self.leave(peer, "it said goodbye", around);
                self.drop_guest(peer, CloseCode::Leaving, "goodbye", around);
            }
            ServerEvent::Failed(error) => {
                let reason = printable(&error.to_string());
                self.lose(peer, &reason, around);
                self.drop_guest(peer, CloseCode::NotUnderstood, &reason, around);
            }
            event if self.places.has(peer) => {
                if matches!(event, ServerEvent::Displayed(_)) {
                    self.places.shown(peer);
                }
                around.mailbox.reported(peer, event);
            }
            _ => {}
        }
    }

    /// A hello that was judged good: the place is given, or not.
    fn asked(
        &mut self,
        peer: PeerId,
        hello: &ClientHello,
        welcome: Welcome,
        now_ns: i64,
        around: &Surroundings<'_>,
    ) {
        let Some(network) = self.guests.get(&peer).map(|guest| Network::of(guest.remote.ip())) else {
            return;
        };
        let may_start = self.starts.ask(network, now_ns);
        let taken = match may_start.and_then(|()| self.places.ask(peer, hello.resume, welcome.resume, now_ns))
        {
            Ok(taken) => taken,
            Err(refused) => return self.refuse(peer, refused, now_ns, around),
        };
        self.starts.began(network, now_ns);
        self.greeting.done(peer);
        if let Some(old) = taken.displaced {
            around.mailbox.gone(old);
            self.drop_guest(old, CloseCode::Displaced, "another connection has taken this place", around);
        }
        let Some(guest) = self.guests.get_mut(&peer) else { return };
        let Some(sender) = guest.session.accept() else { return };
        (around.say)(&format!("Client connected from {}", guest.remote));
        let capabilities = hello.capabilities.clone();
        around.mailbox.accepted(peer, Accepted { welcome, capabilities, sender });
    }

    /// Tells a client why it is not served, or no longer, and ends its connection once it knows.
    fn refuse(&mut self, peer: PeerId, refused: Refused, now_ns: i64, around: &Surroundings<'_>) {
        let Some(guest) = self.guests.get_mut(&peer).filter(|guest| guest.session.is_alive()) else { return };
        guest.session.refuse(refused.clone());
        self.sent_away(peer, &refused, now_ns, around);
        self.flush(peer, now_ns, around);
    }

    /// A client has been told that it is refused.
    fn sent_away(&mut self, peer: PeerId, refused: &Refused, now_ns: i64, around: &Surroundings<'_>) {
        let Some(guest) = self.guests.get(&peer) else { return };
        if let Some(unsaid) = self.refusal_lines.ask(now_ns) {
            let why = printable(&format!("{}; {}", refused.reason, refused.remedy));
            let more =
                if unsaid == 0 { String::new() } else { format!("; {unsaid} more since the last such line") };
            (around.say)(&format!("Client refused: {} ({why}){more}", guest.remote));
        }
        self.greeting.done(peer);
        if self.places.has(peer) {
            self.places.left(peer);
            around.mailbox.gone(peer);
        }
        if self.leaving.len() == MAX_LEAVING {
            let (first, _) = self.leaving.remove(0);
            self.drop_guest(first, CloseCode::Refused, "refused; the reason was sent before", around);
        }
        self.leaving.push((peer, now_ns + FAREWELL_NS));
    }

    fn closed(&mut self, peer: PeerId, kind: CloseKind, reason: &str, around: &Surroundings<'_>) {
        if kind == CloseKind::Peer(u64::from(CloseCode::Leaving.code())) {
            self.leave(peer, reason, around);
        } else {
            self.lose(peer, reason, around);
        }
        self.forget(peer);
    }

    /// A client has left of its own will.
    fn leave(&mut self, peer: PeerId, why: &str, around: &Surroundings<'_>) {
        if self.places.has(peer) {
            self.places.left(peer);
            self.gone(peer, why, around);
        }
    }

    /// A client has vanished, or is no longer understood.
    fn lose(&mut self, peer: PeerId, why: &str, around: &Surroundings<'_>) {
        if self.places.has(peer) {
            self.places.lost(peer);
            self.gone(peer, why, around);
        }
    }

    fn gone(&mut self, peer: PeerId, why: &str, around: &Surroundings<'_>) {
        around.mailbox.gone(peer);
        (around.say)(&format!("Client gone: {}", printable(why)));
    }

    fn drop_guest(&mut self, peer: PeerId, code: CloseCode, reason: &str, around: &Surroundings<'_>) {
        if self.guests.contains_key(&peer) {
            around.carrier.close(peer, code, reason);
            self.forget(peer);
        }
    }

    fn forget(&mut self, peer: PeerId) {
        self.guests.remove(&peer);
        self.greeting.done(peer);
        self.leaving.retain(|(other, _)| *other != peer);
    }

    /// Sends what the session of `peer` has to say, at `now_ns`.
    fn flush(&mut self, peer: PeerId, now_ns: i64, around: &Surroundings<'_>) {
        let Some(guest) = self.guests.get_mut(&peer) else { return };
        let mut failure = None;
        while let Some(out) = guest.session.poll_out(ServerTime(now_ns - self.epoch_ns)) {
            let is_datagram = matches!(out, Out::Datagram(_));
            match around.carrier.send(peer, out) {
                // What is sent unreliably may be lost here as well.
                Err(error) if !is_datagram => failure = Some(error),
                _ => {}
            }
        }
        if let Some(error) = failure {
            let reason = format!("what it must know could not be sent: {error}");
            self.lose(peer, &reason, around);
            self.drop_guest(peer, CloseCode::NotUnderstood, &reason, around);
        }
    }
}

#[cfg(test)]
mod tests;
