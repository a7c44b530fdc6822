//! Connections, their sessions, pings, and who is served. Without I/O and clocks; it encodes nothing and draws nothing, so
//! that a ping is answered when it comes. The server's network thread and the lab drive the same.

pub mod mailbox;
mod place;
#[cfg(test)]
pub(crate) mod testing;

use crate::support::lock::lock;
use mailbox::{Accepted, Mailbox};
use place::{Greeting, Places};
use shadecast_protocol::close::CloseCode;
use shadecast_protocol::message::{ClientHello, Refused, ServerOffer, Welcome};
use shadecast_protocol::session::{Out, ServerEvent, ServerSession};
use shadecast_protocol::text::printable;
use shadecast_protocol::time::ServerTime;
use shadecast_transport::{CloseKind, Event, Handle, PeerId, SendError};
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
    pub fn refuse(&self, peer: PeerId, refused: Refused) {
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
    pub fn goodbye(&mut self, now_ns: i64, around: &Surroundings<'_>) {
        for peer in self.places.served().collect::<Vec<_>>() {
            if let Some(guest) = self.guests.get_mut(&peer) {
                guest.session.goodbye();
            }
            self.flush(peer, now_ns, around);
        }
    }

    fn connected(&mut self, peer: PeerId, remote: SocketAddr, now_ns: i64, around: &Surroundings<'_>) {
        if let Some(oldest) = self.greeting.connected(peer, now_ns) {
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
        let taken = match self.places.ask(peer, hello.resume, welcome.resume, now_ns) {
            Ok(taken) => taken,
            Err(refused) => return self.refuse(peer, refused, now_ns, around),
        };
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
        let why = printable(&format!("{}; {}", refused.reason, refused.remedy));
        (around.say)(&format!("Client refused: {} ({why})", guest.remote));
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
mod tests {
    use super::mailbox::{Client, News};
    use super::place::HELLO_DEADLINE_NS;
    use super::*;
    use shadecast_protocol::delta::DeltaEncoder;
    use shadecast_protocol::message::{
        ClientDatagram, ClientMessage, Displayed, ResumeSecret, ServerDatagram, ServerMessage,
    };
    use shadecast_protocol::time::ClientTime;
    use shadecast_test_support::peers::{head, hello, offer};
    use std::cell::RefCell;

    const SECOND: i64 = 1_000_000_000;

    /// What was sent and closed.
    #[derive(Default)]
    struct Recorder {
        messages: RefCell<Vec<(PeerId, ServerMessage)>>,
        datagrams: RefCell<Vec<(PeerId, ServerDatagram)>>,
        closed: RefCell<Vec<(PeerId, CloseCode)>>,
        /// Nothing is taken.
        is_full: bool,
    }

    impl Carrier for Recorder {
        fn send(&self, peer: PeerId, out: Out) -> Result<(), SendError> {
            if self.is_full {
                return Err(SendError::QueueFull);
            }
            match out {
                Out::Control(message) => {
                    let message = ServerMessage::decode(&message).expect("a message");
                    self.messages.borrow_mut().push((peer, message));
                }
                Out::Datagram(bytes) => {
                    self.datagrams.borrow_mut().push((peer, ServerDatagram::decode(&bytes).expect("a pong")));
                }
                Out::Stream { .. } => panic!("the network's thread sends no updates"),
            }
            Ok(())
        }

        fn close(&self, peer: PeerId, code: CloseCode, _: &str) {
            self.closed.borrow_mut().push((peer, code));
        }
    }

    impl Recorder {
        /// The secret of the last welcome that `peer` got.
        fn secret(&self, peer: PeerId) -> Option<ResumeSecret> {
            self.messages.borrow().iter().rev().find_map(|(to, message)| match message {
                ServerMessage::Welcome(welcome) if *to == peer => Some(welcome.resume),
                _ => None,
            })
        }

        fn refusal(&self, peer: PeerId) -> Option<String> {
            self.messages.borrow().iter().rev().find_map(|(to, message)| match message {
                ServerMessage::Refused(refused) if *to == peer => Some(refused.reason.clone()),
                _ => None,
            })
        }
    }

    struct Desk {
        carrier: Recorder,
        mailbox: Mailbox,
        verdicts: Verdicts,
    }

    impl Desk {
        fn new() -> Self {
            Self { carrier: Recorder::default(), mailbox: Mailbox::default(), verdicts: Verdicts::default() }
        }

        /// What is new of a client; of others it is forgotten.
        fn news(&self, peer: PeerId) -> Option<News> {
            self.mailbox.take().remove(&peer)
        }

        fn is_gone(&self, peer: PeerId) -> bool {
            self.news(peer).is_some_and(|news| matches!(news.client, Client::Gone))
        }

        fn surroundings(&self) -> Surroundings<'_> {
            let Self { carrier, mailbox, verdicts } = self;
            Surroundings { carrier, mailbox, verdicts, say: &|_| {} }
        }

        fn network(&self) -> Network<'_> {
            self.network_for(1)
        }

        fn network_for(&self, viewers: usize) -> Network<'_> {
            let terms = |session| ServerOffer { resume: ResumeSecret([session as u8; 16]), ..offer() };
            Network { sessions: Sessions::new(Box::new(terms), viewers, 0), desk: self }
        }
    }

    /// Sessions, and the desk that they work at.
    struct Network<'a> {
        sessions: Sessions,
        desk: &'a Desk,
    }

    impl Network<'_> {
        fn take(&mut self, event: Event, now_ns: i64) {
            self.sessions.take(event, now_ns, &self.desk.surroundings());
        }

        fn tick(&mut self, now_ns: i64) {
            self.sessions.tick(now_ns, &self.desk.surroundings());
        }
    }

    fn connect(network: &mut Network<'_>, peer: u64, at_ns: i64) -> PeerId {
        let remote = "127.0.0.1:9".parse().expect("an address");
        network.take(Event::Connected { peer: PeerId(peer), remote, fingerprint: None }, at_ns);
        PeerId(peer)
    }

    fn say(network: &mut Network<'_>, peer: PeerId, message: &ClientMessage, at_ns: i64) {
        network.take(Event::Control { peer, message: message.encode(), at_ns }, at_ns);
    }

    /// Connects and says hello.
    fn greet(network: &mut Network<'_>, peer: u64, resume: Option<ResumeSecret>, at_ns: i64) -> PeerId {
        let peer = connect(network, peer, at_ns);
        say(network, peer, &ClientMessage::Hello(ClientHello { resume, ..hello() }), at_ns);
        peer
    }

    /// A client that was greeted shows the first update, which the pipeline has sent.
    fn show_first(network: &mut Network<'_>, desk: &Desk, peer: PeerId, at_ns: i64) {
        let Some(Client::Accepted(mut accepted)) = desk.news(peer).map(|news| news.client) else {
            panic!("nobody was accepted")
        };
        accepted.sender.stream(
            &DeltaEncoder::new(1, 1).encode(&shadecast_protocol::geometry::GeometryDelta::default().into()),
        );
        say(network, peer, &ClientMessage::Displayed(Displayed::default()), at_ns);
        assert!(desk.news(peer).is_some_and(|news| news.reported.displayed.is_some()));
    }

    #[test]
    fn a_connection_without_a_hello_holds_nothing_and_ends_after_two_seconds() {
        let desk = Desk::new();
        let mut network = desk.network();
        let idle = connect(&mut network, 1, 0);
        let served = greet(&mut network, 2, None, SECOND);
        assert!(desk.carrier.secret(served).is_some(), "the other one does not wait for it");
        network.tick(HELLO_DEADLINE_NS + 1);
        assert_eq!(*desk.carrier.closed.borrow(), [(idle, CloseCode::NotUnderstood)]);
    }

    #[test]
    fn junk_neither_takes_nor_keeps_a_place() {
        let desk = Desk::new();
        let mut network = desk.network();
        let junk = greet(&mut network, 1, None, 0);
        for step in 1..30 {
            let at_ns = step * SECOND / 5;
            network.take(Event::Datagram { peer: junk, bytes: vec![0xee], at_ns }, at_ns);
        }
        let lawful = greet(&mut network, 2, None, 6 * SECOND);
        assert!(desk.carrier.secret(lawful).is_some());
        assert_eq!(*desk.carrier.closed.borrow(), [(junk, CloseCode::Displaced)]);
        let babbler = connect(&mut network, 3, 6 * SECOND);
        network.take(Event::Control { peer: babbler, message: vec![9], at_ns: 0 }, 6 * SECOND);
        assert_eq!(desk.carrier.closed.borrow().last(), Some(&(babbler, CloseCode::NotUnderstood)));
    }

    #[test]
    fn a_second_client_is_told_why_before_its_connection_ends() {
        let desk = Desk::new();
        let mut network = desk.network();
        greet(&mut network, 1, None, 0);
        let second = greet(&mut network, 2, None, 1);
        assert_eq!(desk.carrier.refusal(second).as_deref(), Some("another client is being served"));
        network.tick(FAREWELL_NS);
        assert!(desk.carrier.closed.borrow().is_empty(), "its reason may still be on its way");
        network.tick(FAREWELL_NS + 1);
        assert_eq!(*desk.carrier.closed.borrow(), [(second, CloseCode::Refused)]);
    }

    #[test]
    fn a_client_that_was_served_comes_back_before_a_stranger_does() {
        let desk = Desk::new();
        let mut network = desk.network();
        let first = greet(&mut network, 1, None, 0);
        let secret = desk.carrier.secret(first);
        show_first(&mut network, &desk, first, SECOND);
        network.take(
            Event::Closed { peer: first, kind: CloseKind::TimedOut, reason: "lost".into() },
            2 * SECOND,
        );
        assert!(desk.is_gone(first));
        let stranger = greet(&mut network, 2, None, 3 * SECOND);
        assert!(desk.carrier.refusal(stranger).is_some_and(|reason| reason.contains("kept")));
        let back = greet(&mut network, 3, secret, 4 * SECOND);
        assert!(desk.carrier.secret(back).is_some_and(|next| Some(next) != secret));
        assert!(desk.news(back).is_some_and(|news| matches!(news.client, Client::Accepted(_))));
    }

    #[test]
    fn a_client_that_comes_back_ends_its_own_old_connection() {
        let desk = Desk::new();
        let mut network = desk.network();
        let first = greet(&mut network, 1, None, 0);
        let back = greet(&mut network, 2, desk.carrier.secret(first), 1);
        assert_eq!(*desk.carrier.closed.borrow(), [(first, CloseCode::Displaced)]);
        network.take(Event::Closed { peer: first, kind: CloseKind::Local, reason: "closed here".into() }, 2);
        assert!(network.sessions.places.has(back), "the old one's end is nobody's loss");
    }

    #[test]
    fn one_that_left_leaves_its_place_at_once() {
        let desk = Desk::new();
        let mut network = desk.network();
        let first = greet(&mut network, 1, None, 0);
        show_first(&mut network, &desk, first, 1);
        say(&mut network, first, &ClientMessage::Goodbye, 2);
        assert!(desk.is_gone(first));
        let next = greet(&mut network, 2, None, 3);
        assert!(desk.carrier.secret(next).is_some());
    }

    #[test]
    fn what_the_pipeline_refuses_is_refused_with_its_reason_and_the_place_is_free() {
        let desk = Desk::new();
        let mut network = desk.network();
        let first = greet(&mut network, 1, None, 0);
        desk.verdicts.refuse(first, Refused::new("no memory for its eyes", "choose smaller ones"));
        network.tick(1);
        assert_eq!(desk.carrier.refusal(first).as_deref(), Some("no memory for its eyes"));
        let next = greet(&mut network, 2, None, 2);
        assert!(desk.carrier.secret(next).is_some());
    }

    #[test]
    fn pings_are_answered_and_only_the_served_client_reaches_the_pipeline() {
        let desk = Desk::new();
        let mut network = desk.network();
        let first = greet(&mut network, 1, None, 0);
        desk.mailbox.take();
        let ping = ClientDatagram::ClockPing { client_send: ClientTime(5) }.encode();
        network.take(Event::Datagram { peer: first, bytes: ping, at_ns: 7 }, 8);
        assert_eq!(desk.carrier.datagrams.borrow().len(), 1);
        let pose = ClientDatagram::Pose(head(3, ServerTime(0))).encode();
        network.take(Event::Datagram { peer: first, bytes: pose.clone(), at_ns: 9 }, 9);
        assert!(desk.news(first).is_some_and(|news| news.reported.head.is_some()));
        let second = greet(&mut network, 2, None, 10);
        network.take(Event::Datagram { peer: second, bytes: pose, at_ns: 11 }, 11);
        assert!(desk.news(second).is_none());
    }

    #[test]
    fn a_flood_of_connections_and_refusals_is_bounded() {
        let desk = Desk::new();
        let mut network = desk.network();
        greet(&mut network, 0, None, 0);
        for peer in 1..1000 {
            if peer % 2 == 0 {
                greet(&mut network, peer, None, 1)
            } else {
                connect(&mut network, peer, 1)
            };
        }
        assert!(network.sessions.guests.len() <= 1 + MAX_LEAVING + place::MAX_GREETING);
        assert!(network.sessions.leaving.len() <= MAX_LEAVING);
    }

    #[test]
    fn a_welcome_that_cannot_be_sent_ends_the_session() {
        let desk = Desk { carrier: Recorder { is_full: true, ..Recorder::default() }, ..Desk::new() };
        let mut network = desk.network();
        let first = greet(&mut network, 1, None, 0);
        assert_eq!(*desk.carrier.closed.borrow(), [(first, CloseCode::NotUnderstood)]);
        assert!(desk.news(first).is_none(), "the pipeline never hears of it");
    }

    #[test]
    fn several_clients_are_served_at_once_and_one_more_is_refused() {
        let desk = Desk::new();
        let mut network = desk.network_for(2);
        let (first, second) = (greet(&mut network, 1, None, 0), greet(&mut network, 2, None, 1));
        let third = greet(&mut network, 3, None, 2);
        assert!(desk.carrier.refusal(third).is_some_and(|reason| reason.contains("2 other clients")));
        desk.mailbox.take();
        let pose = ClientDatagram::Pose(head(3, ServerTime(0))).encode();
        for peer in [first, second, third] {
            network.take(Event::Datagram { peer, bytes: pose.clone(), at_ns: 9 }, 9);
        }
        assert_eq!(desk.mailbox.take().into_keys().collect::<Vec<_>>(), [first, second]);
        network.sessions.goodbye(10, &desk.surroundings());
        let said = |peer| {
            desk.carrier
                .messages
                .borrow()
                .iter()
                .any(|(to, message)| *to == peer && *message == ServerMessage::Goodbye)
        };
        assert!(said(first) && said(second));
    }
}
