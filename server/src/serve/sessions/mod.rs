//! Connections, their sessions, pings, and who is served. Without I/O and clocks; it encodes nothing and draws nothing, so
//! that a ping is answered when it comes. The server's network thread and the lab drive the same.

pub mod admission;
mod lines;
pub mod mailbox;
mod place;
#[cfg(test)]
pub(crate) mod testing;

use crate::support::lock::lock;
use admission::{Admission, Caller, Outcome, told, wrong};
use lines::Sparse;
use mailbox::{Accepted, Mailbox};
use place::{Greeting, Places, Starts};
use shadecast_protocol::close::CloseCode;
use shadecast_protocol::message::{ClientHello, Refused, ServerOffer, Welcome};
use shadecast_protocol::pairing::ClientPairing;
use shadecast_protocol::session::{Out, ServerEvent, ServerSession};
use shadecast_protocol::text::printable;
use shadecast_protocol::time::ServerTime;
use shadecast_transport::identity::Rights;
use shadecast_transport::{CloseKind, Event, Handle, Network, PeerId, SendError};
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Mutex;

/// A client that was told why it is refused may close the connection itself within this time, nanoseconds.
const FAREWELL_NS: i64 = 500_000_000;
/// Refused clients that are given that time.
const MAX_LEAVING: usize = 8;
/// Whether those who are served may still be is looked at so often, nanoseconds.
const REVIEW_NS: i64 = 1_000_000_000;

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
    admission: Admission,
    greeting: Greeting,
    starts: Starts,
    refusal_lines: Sparse,
    halt_lines: Sparse,
    pairing_lines: Sparse,
    reviewed_ns: i64,
    /// What became of the last typed code, until it is asked for.
    outcome: Option<Outcome>,
    places: Places,
    guests: BTreeMap<PeerId, Guest>,
    /// Refused clients, and when their connection is ended if they do not do it.
    leaving: Vec<(PeerId, i64)>,
    sessions: u64,
}

/// A connected client.
struct Guest {
    session: ServerSession,
    caller: Caller,
    rights: Rights,
    /// What it has asked for, and is given once it is paired.
    waiting: Option<(ClientHello, Box<Welcome>)>,
}

impl Sessions {
    /// Nobody is connected; `viewers` are served at once. `offer` gives the terms of a session by its number. The server's
    /// clock reads 0 at `epoch_ns`.
    pub fn new(offer: Box<dyn Fn(u64) -> ServerOffer + Send>, viewers: usize, epoch_ns: i64) -> Self {
        Self {
            offer,
            epoch_ns,
            admission: Admission::open(),
            greeting: Greeting::default(),
            starts: Starts::default(),
            refusal_lines: Sparse::default(),
            halt_lines: Sparse::default(),
            pairing_lines: Sparse::default(),
            reviewed_ns: i64::MIN,
            outcome: None,
            places: Places::new(viewers),
            guests: BTreeMap::new(),
            leaving: Vec::new(),
            sessions: 0,
        }
    }

    /// The same, but only whom `admission` lets in is served.
    #[must_use]
    pub fn admitting(mut self, admission: Admission) -> Self {
        self.admission = admission;
        self
    }

    /// Takes an event of the transport.
    pub fn take(&mut self, event: Event, now_ns: i64, around: &Surroundings<'_>) {
        match event {
            Event::Connected { peer, remote, fingerprint, binding } => {
                self.connected(Caller { peer, remote, fingerprint, binding }, now_ns, around);
            }
            Event::Control { peer, message, at_ns } => {
                self.handle(peer, [at_ns, now_ns], around, |session| session.on_control(&message));
            }
            Event::Datagram { peer, bytes, at_ns } => {
                let received = ServerTime(at_ns - self.epoch_ns);
                self.handle(peer, [at_ns, now_ns], around, |session| session.on_datagram(&bytes, received));
            }
            Event::Closed { peer, kind, reason } => self.closed(peer, kind, &reason, around),
            Event::Away { peer, .. } => self.away(peer, around),
            Event::Back { peer, remote } => self.back(peer, remote, around),
            // Clients have nothing to send on streams.
            Event::Stream { .. } | Event::StreamReset { .. } => {}
        }
    }

    /// Does what is due: deadlines, and what the pipeline has decided.
    pub fn tick(&mut self, now_ns: i64, around: &Surroundings<'_>) {
        while let Some(peer) = self.greeting.overdue(now_ns) {
            self.drop_guest(peer, CloseCode::NotUnderstood, "no hello came; connect again", around);
        }
        self.tend_pairing(now_ns, around);
        if now_ns.saturating_sub(self.reviewed_ns) >= REVIEW_NS {
            self.reviewed_ns = now_ns;
            self.review(now_ns, around);
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

    fn connected(&mut self, caller: Caller, now_ns: i64, around: &Surroundings<'_>) {
        let network = Network::of(caller.remote.ip());
        if let Some(oldest) = self.greeting.connected(caller.peer, network, now_ns) {
            self.drop_guest(
                oldest,
                CloseCode::NotUnderstood,
                "others came and no hello; connect again",
                around,
            );
        }
        self.sessions += 1;
        let session = ServerSession::new((self.offer)(self.sessions));
        let guest = Guest { session, caller, rights: Rights::LOOK, waiting: None };
        self.guests.insert(caller.peer, guest);
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
            ServerEvent::Asked { hello, welcome } => self.asked(peer, hello, welcome, now_ns, around),
            ServerEvent::Pairing(step) => self.take_pairing(peer, step, now_ns, around),
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
            ServerEvent::Steer(_) if !self.may_halt(peer) => {
                if let Some(guest) = self.guests.get(&peer).filter(|_| self.halt_lines.ask(now_ns).is_some())
                {
                    let who = guest.caller.remote;
                    (around.say)(&format!(
                        "{who} may not halt the world; shadecast-server devices allow lets it"
                    ));
                }
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

    fn may_halt(&self, peer: PeerId) -> bool {
        self.guests.get(&peer).is_some_and(|guest| guest.rights.halt)
    }

    /// A hello that was judged good: whoever may come in is seated, and a stranger is to be paired first.
    fn asked(
        &mut self,
        peer: PeerId,
        hello: ClientHello,
        welcome: Box<Welcome>,
        now_ns: i64,
        around: &Surroundings<'_>,
    ) {
        let Some(guest) = self.guests.get_mut(&peer) else { return };
        if let Some(rights) = self.admission.rights(&guest.caller) {
            guest.rights = rights;
            return self.seat(peer, &hello, *welcome, now_ns, around);
        }
        match self.admission.begin(&guest.caller, now_ns) {
            Ok(patience_ms) => {
                guest.waiting = Some((hello, welcome));
                guest.session.ask_to_pair(patience_ms);
                self.greeting.done(peer);
                let who = guest.caller.remote;
                if self.pairing_lines.ask(now_ns).is_none() {
                    return;
                }
                (around.say)(&format!(
                    "A device at {who} asks to be paired: type the six digits that it shows here, or give them to \
                     shadecast-server pair"
                ));
            }
            Err(refused) => self.refuse(peer, refused, now_ns, around),
        }
    }

    /// Who is being paired, if anybody is.
    pub fn pairing(&self) -> Option<PeerId> {
        self.admission.pairing()
    }

    /// Somebody at the server has typed a code. [`Self::take_outcome`] says what came of it, at once or later.
    pub fn type_code(&mut self, text: &str, random: &[u8; 64], now_ns: i64, around: &Surroundings<'_>) {
        match self.admission.typed(text, random, now_ns) {
            Ok((peer, Ok(answer))) => {
                if let Some(guest) = self.guests.get_mut(&peer) {
                    guest.session.answer_pairing(answer.element, answer.proof);
                }
                self.flush(peer, now_ns, around);
            }
            Ok((peer, Err(_))) => self.not_paired(peer, wrong(), now_ns, around),
            Err(outcome) => {
                (around.say)(&outcome.text);
                self.outcome = Some(outcome);
            }
        }
    }

    /// What became of the last typed code; once.
    pub fn take_outcome(&mut self) -> Option<Outcome> {
        self.outcome.take()
    }

    /// A step of a client that is being paired.
    fn take_pairing(&mut self, peer: PeerId, step: ClientPairing, now_ns: i64, around: &Surroundings<'_>) {
        let outcome = match step {
            ClientPairing::Offer { element } => return self.admission.offered(peer, element),
            ClientPairing::Proof { proof } => self.admission.judged(peer, Some(&proof), now_ns),
            ClientPairing::WrongCode => self.admission.judged(peer, None, now_ns),
        };
        let Some(outcome) = outcome else { return };
        if !outcome.is_paired {
            return self.not_paired(peer, outcome, now_ns, around);
        }
        let Some(guest) = self.guests.get_mut(&peer) else { return };
        let remote = guest.caller.remote;
        (around.say)(&format!("{}, at {remote}; shadecast-server devices names it otherwise", outcome.text));
        self.outcome = Some(outcome);
        let (Some((hello, welcome)), rights) = (guest.waiting.take(), self.admission.rights(&guest.caller))
        else {
            return;
        };
        guest.rights = rights.unwrap_or(Rights::LOOK);
        self.seat(peer, &hello, *welcome, now_ns, around);
    }

    /// Says at both ends that nothing came of a pairing.
    fn not_paired(&mut self, peer: PeerId, outcome: Outcome, now_ns: i64, around: &Surroundings<'_>) {
        (around.say)(&format!("Not paired: {}", outcome.text));
        self.refuse(peer, told(&outcome), now_ns, around);
        self.outcome = Some(outcome);
    }

    /// Ends pairings whose time is over or whose client has gone.
    fn tend_pairing(&mut self, now_ns: i64, around: &Surroundings<'_>) {
        if let Some(peer) = self.admission.pairing()
            && !self.guests.contains_key(&peer)
        {
            self.admission.gone(peer, now_ns);
            let text = "the device has gone before it was paired".to_owned();
            self.outcome = Some(Outcome { is_paired: false, text });
        }
        if let Some((peer, outcome)) = self.admission.overdue(now_ns) {
            self.refuse(peer, told(&outcome), now_ns, around);
            self.outcome = Some(outcome);
        }
    }

    /// Ends the sessions of devices that were forgotten meanwhile, and follows changes of their rights.
    fn review(&mut self, now_ns: i64, around: &Surroundings<'_>) {
        for peer in self.places.served().collect::<Vec<_>>() {
            let Some(guest) = self.guests.get_mut(&peer) else { continue };
            match self.admission.rights(&guest.caller) {
                Some(rights) => guest.rights = rights,
                None => {
                    let forgotten = Refused::new("this device was forgotten at the server", "pair it anew");
                    self.refuse(peer, forgotten, now_ns, around);
                }
            }
        }
    }

    /// A client that may come in: the place is given, or not.
    fn seat(
        &mut self,
        peer: PeerId,
        hello: &ClientHello,
        welcome: Welcome,
        now_ns: i64,
        around: &Surroundings<'_>,
    ) {
        let Some(network) = self.guests.get(&peer).map(|guest| Network::of(guest.caller.remote.ip())) else {
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
        (around.say)(&format!("Client connected from {}", guest.caller.remote));
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
            (around.say)(&format!("Client refused: {} ({why}){more}", guest.caller.remote));
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

    /// Nothing is heard of a client any more. One that was served and has shown something is waited for.
    fn away(&mut self, peer: PeerId, around: &Surroundings<'_>) {
        const WHY: &str = "nothing was heard from it for 3 s";
        let Some(guest) = self.guests.get(&peer) else { return };
        if self.places.away(peer, true) {
            around.mailbox.away(peer, true);
            return (around.say)(&format!(
                "Client away: {} ({WHY}); it may come back within 60 s",
                guest.caller.remote
            ));
        }
        self.lose(peer, WHY, around);
        self.drop_guest(peer, CloseCode::NotUnderstood, WHY, around);
    }

    /// A client is heard again, perhaps from another address.
    fn back(&mut self, peer: PeerId, remote: SocketAddr, around: &Surroundings<'_>) {
        let Some(guest) = self.guests.get_mut(&peer) else { return };
        guest.caller.remote = remote;
        if self.places.away(peer, false) {
            around.mailbox.away(peer, false);
            (around.say)(&format!("Client back: {remote}"));
        }
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
