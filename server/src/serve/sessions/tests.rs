use super::mailbox::{Client, News};
use super::place::HELLO_DEADLINE_NS;
use super::*;
use shadecast_protocol::delta::DeltaEncoder;
use shadecast_protocol::message::{
    ClientDatagram, ClientMessage, Displayed, ResumeSecret, ServerDatagram, ServerMessage,
};
use shadecast_protocol::time::ClientTime;
use shadecast_test_support::peers::{head, hello, offer};
use shadecast_transport::Binding;
use std::cell::RefCell;

mod pairing;

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
    let binding = Binding([0; 32]);
    network.take(Event::Connected { peer: PeerId(peer), remote, fingerprint: None, binding }, at_ns);
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
    network.take(Event::Closed { peer: first, kind: CloseKind::TimedOut, reason: "lost".into() }, 2 * SECOND);
    assert!(desk.is_gone(first));
    let stranger = greet(&mut network, 2, None, 3 * SECOND);
    assert!(desk.carrier.refusal(stranger).is_some_and(|reason| reason.contains("kept")));
    let back = greet(&mut network, 3, secret, 4 * SECOND);
    assert!(desk.carrier.secret(back).is_some_and(|next| Some(next) != secret));
    assert!(desk.news(back).is_some_and(|news| matches!(news.client, Client::Accepted(_))));
}

#[test]
fn a_client_that_is_away_is_waited_for_until_another_one_wants_its_place() {
    let desk = Desk::new();
    let mut network = desk.network();
    let first = greet(&mut network, 1, None, 0);
    show_first(&mut network, &desk, first, SECOND);
    let (away, moved) =
        (Event::Away { peer: first, since_ns: SECOND }, "[::1]:8".parse().expect("an address"));
    let is_away = |desk: &Desk| desk.news(first).and_then(|news| news.reported.away);
    network.take(away.clone(), 4 * SECOND);
    assert_eq!(is_away(&desk), Some(true));
    let stranger = greet(&mut network, 2, None, 5 * SECOND);
    assert!(desk.carrier.refusal(stranger).is_some_and(|reason| reason.contains("kept")), "not yet");
    network.take(Event::Back { peer: first, remote: moved }, 50 * SECOND);
    assert_eq!((is_away(&desk), network.sessions.guests[&first].caller.remote), (Some(false), moved));
    assert!(desk.carrier.closed.borrow().is_empty());
    network.take(away, 60 * SECOND);
    let next = greet(&mut network, 3, None, 61 * SECOND);
    assert!(desk.carrier.secret(next).is_some());
    assert_eq!(*desk.carrier.closed.borrow(), [(first, CloseCode::Displaced)]);
}

#[test]
fn one_that_has_shown_nothing_is_not_waited_for() {
    let desk = Desk::new();
    let mut network = desk.network_for(2);
    let (unproven, hasty) = (greet(&mut network, 1, None, 0), connect(&mut network, 2, 0));
    for peer in [unproven, hasty] {
        network.take(Event::Away { peer, since_ns: 0 }, 3 * SECOND);
    }
    let closed: Vec<PeerId> = desk.carrier.closed.borrow().iter().map(|(peer, _)| *peer).collect();
    assert_eq!((closed, network.sessions.places.served().next()), (vec![unproven, hasty], None));
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
