//! Strangers, paired devices, and what each may do.

use super::*;
use crate::serve::sessions::admission::{Admit, Register};
use shadecast_protocol::pairing::ServerPairing;
use shadecast_protocol::world_clock::Steer;
use shadecast_transport::Fingerprint;
use shadecast_transport::identity::pairing::{Answer, Ends, Panel};
use std::sync::Arc;

const OWN: Fingerprint = Fingerprint([9; 32]);

/// A list of devices that the test can look into.
#[derive(Clone, Default)]
struct Book(Arc<Mutex<BTreeMap<Fingerprint, Rights>>>);

impl Register for Book {
    fn rights(&mut self, fingerprint: Fingerprint) -> Option<Rights> {
        lock(&self.0).get(&fingerprint).copied()
    }

    fn keep(&mut self, fingerprint: Fingerprint) -> Result<String, String> {
        lock(&self.0).insert(fingerprint, Rights::ALL);
        Ok("a headset".to_owned())
    }
}

fn key(peer: u64) -> Fingerprint {
    Fingerprint([peer as u8; 32])
}

fn binding(peer: u64) -> Binding {
    Binding([100 + peer as u8; 32])
}

fn admitting<'a>(desk: &'a Desk, admit: Admit, book: &Book) -> Network<'a> {
    let Network { sessions, desk } = desk.network_for(2);
    Network { sessions: sessions.admitting(Admission::new(admit, OWN, Box::new(book.clone()))), desk }
}

/// Somebody in the house says hello.
fn come(network: &mut Network<'_>, peer: u64, at_ns: i64) -> PeerId {
    come_from(network, peer, "192.168.1.7:9", at_ns)
}

fn come_from(network: &mut Network<'_>, peer: u64, remote: &str, at_ns: i64) -> PeerId {
    let (remote, fingerprint) = (remote.parse().expect("an address"), Some(key(peer)));
    let connected = Event::Connected { peer: PeerId(peer), remote, fingerprint, binding: binding(peer) };
    network.take(connected, at_ns);
    say(network, PeerId(peer), &ClientMessage::Hello(hello()), at_ns);
    PeerId(peer)
}

fn is_welcome(desk: &Desk, peer: PeerId) -> bool {
    desk.carrier.secret(peer).is_some()
}

/// The newest step of pairing that `peer` was told.
fn step(desk: &Desk, peer: PeerId) -> Option<ServerPairing> {
    desk.carrier.messages.borrow().iter().rev().find_map(|(to, message)| match message {
        ServerMessage::Pairing(step) if *to == peer => Some(*step),
        _ => None,
    })
}

impl Network<'_> {
    fn type_code(&mut self, text: &str, at_ns: i64) {
        self.sessions.type_code(text, &[7; 64], at_ns, &self.desk.surroundings());
    }
}

/// Shows a code for a client that was asked to.
fn show(network: &mut Network<'_>, panel: &mut Panel, peer: u64, at_ns: i64) -> String {
    let ends = Ends { client: key(peer), server: OWN, binding: binding(peer) };
    let (code, element) = panel.begin(ends, &[peer as u8; 64], at_ns).expect("open");
    let offer = ClientMessage::Pairing(ClientPairing::Offer { element });
    say(network, PeerId(peer), &offer, at_ns);
    code.to_string()
}

/// The client judges the code that was typed.
#[track_caller]
fn judge(network: &mut Network<'_>, panel: &mut Panel, peer: PeerId, at_ns: i64) {
    let Some(ServerPairing::Answer { element, proof }) = step(network.desk, peer) else {
        panic!("no answer")
    };
    let judged = match panel.answered(&Answer { element, proof }, at_ns) {
        Ok(proof) => ClientPairing::Proof { proof },
        Err(_) => ClientPairing::WrongCode,
    };
    say(network, peer, &ClientMessage::Pairing(judged), at_ns);
}

#[test]
fn a_stranger_is_paired_and_then_served_and_known() {
    let (desk, book) = (Desk::new(), Book::default());
    let mut network = admitting(&desk, Admit::Paired, &book);
    let (mut panel, peer) = (Panel::new(), come(&mut network, 1, 0));
    assert_eq!(step(&desk, peer), Some(ServerPairing::Needed { patience_ms: 60_000 }));
    assert!(!is_welcome(&desk, peer) && desk.news(peer).is_none(), "it holds no place");
    let code = show(&mut network, &mut panel, 1, SECOND);
    network.tick(30 * SECOND);
    network.type_code(&code, 30 * SECOND);
    assert!(!is_welcome(&desk, peer), "the client has yet to prove that it shows the code");
    judge(&mut network, &mut panel, peer, 31 * SECOND);
    assert!(is_welcome(&desk, peer));
    let outcome = network.sessions.take_outcome().expect("something came of it");
    assert!(outcome.is_paired && outcome.text.contains("a headset"), "{outcome:?}");
    let again = come(&mut network, 1, 32 * SECOND);
    assert!(is_welcome(&desk, again));
}

#[test]
fn a_wrong_code_is_said_at_both_ends_with_what_to_do() {
    let (desk, book) = (Desk::new(), Book::default());
    let mut network = admitting(&desk, Admit::Paired, &book);
    let (mut panel, peer) = (Panel::new(), come(&mut network, 1, 0));
    let code = show(&mut network, &mut panel, 1, 0);
    let other = if code == "000 000" { "000 001" } else { "000 000" };
    network.type_code(other, SECOND);
    judge(&mut network, &mut panel, peer, SECOND);
    assert!(!is_welcome(&desk, peer) && lock(&book.0).is_empty());
    let refusal = desk.carrier.refusal(peer).expect("it is told");
    let outcome = network.sessions.take_outcome().expect("so is whoever typed it");
    assert!(!outcome.is_paired && outcome.text == refusal && refusal.contains("not the one"), "{refusal}");
    network.type_code(&code, SECOND);
    assert!(!is_welcome(&desk, peer), "a code serves once");
}

#[test]
fn what_is_no_code_or_has_no_device_is_said_at_once_and_uses_nothing_up() {
    let (desk, book) = (Desk::new(), Book::default());
    let mut network = admitting(&desk, Admit::Paired, &book);
    network.type_code("123 456", 0);
    let outcome = network.sessions.take_outcome().expect("said");
    assert!(outcome.text.contains("no device waits"), "{outcome:?}");
    let (mut panel, peer) = (Panel::new(), come(&mut network, 1, 0));
    let code = show(&mut network, &mut panel, 1, 0);
    network.type_code("12345", 0);
    let outcome = network.sessions.take_outcome().expect("said");
    assert!(outcome.text.contains("six digits"), "{outcome:?}");
    network.type_code(&code, 0);
    judge(&mut network, &mut panel, peer, 0);
    assert!(is_welcome(&desk, peer));
}

#[test]
fn programs_of_this_machine_come_in_unless_they_are_to_be_paired_too() {
    for (admit, remote, is_served) in [
        (Admit::Paired, "127.0.0.1:9", true),
        (Admit::Paired, "[::1]:9", true),
        (Admit::Paired, "[::ffff:127.0.0.1]:9", true),
        (Admit::Paired, "192.168.1.7:9", false),
        (Admit::PairedOnly, "127.0.0.1:9", false),
        (Admit::Anyone, "192.168.1.7:9", true),
    ] {
        let (desk, book) = (Desk::new(), Book::default());
        let mut network = admitting(&desk, admit, &book);
        let peer = come_from(&mut network, 1, remote, 0);
        assert_eq!(is_welcome(&desk, peer), is_served, "{admit:?} {remote}");
    }
}

#[test]
fn a_client_that_shows_another_key_than_it_was_paired_with_is_a_stranger() {
    let (desk, book) = (Desk::new(), Book::default());
    lock(&book.0).insert(key(1), Rights::ALL);
    let mut network = admitting(&desk, Admit::Paired, &book);
    let (known, changed) = (come(&mut network, 1, 0), come(&mut network, 2, 0));
    assert!(is_welcome(&desk, known) && !is_welcome(&desk, changed));
    assert!(matches!(step(&desk, changed), Some(ServerPairing::Needed { .. })));
    let remote = "192.168.1.7:9".parse().expect("an address");
    let keyless = Event::Connected { peer: PeerId(3), remote, fingerprint: None, binding: binding(3) };
    network.take(keyless, 0);
    say(&mut network, PeerId(3), &ClientMessage::Hello(hello()), 0);
    assert!(desk.carrier.refusal(PeerId(3)).is_some_and(|reason| reason.contains("no key")));
}

#[test]
fn one_stranger_is_paired_at_a_time_and_known_devices_do_not_wait_for_it() {
    let (desk, book) = (Desk::new(), Book::default());
    lock(&book.0).insert(key(3), Rights::ALL);
    let mut network = admitting(&desk, Admit::Paired, &book);
    let (first, second) = (come(&mut network, 1, 0), come(&mut network, 2, SECOND));
    assert!(matches!(step(&desk, first), Some(ServerPairing::Needed { .. })));
    assert_eq!(desk.carrier.refusal(second).as_deref(), Some("another device is being paired"));
    let known = come(&mut network, 3, SECOND);
    assert!(is_welcome(&desk, known));
    network.tick(60 * SECOND);
    assert!(desk.carrier.refusal(first).is_some_and(|reason| reason.contains("within 60 s")));
    let second = come(&mut network, 4, 60 * SECOND);
    assert!(matches!(step(&desk, second), Some(ServerPairing::Needed { .. })));
}

#[test]
fn guesses_close_pairing_and_nothing_else() {
    let (desk, book) = (Desk::new(), Book::default());
    lock(&book.0).insert(key(99), Rights::ALL);
    let mut network = admitting(&desk, Admit::Paired, &book);
    for guess in 1..=3 {
        let peer = come(&mut network, guess, 0);
        let offer = ClientPairing::Offer { element: key(guess).0 };
        say(&mut network, peer, &ClientMessage::Pairing(offer), 0);
        network.type_code("123456", 0);
        // An element that is none has failed by now; of others the client leaves with the answer.
        network.take(Event::Closed { peer, kind: CloseKind::TimedOut, reason: "it left".into() }, 0);
        network.tick(0);
    }
    let guesser = come(&mut network, 4, 1);
    let refusal = desk.carrier.refusal(guesser).expect("refused");
    assert_eq!(refusal, "pairing is closed for 60 s after 3 wrong codes");
    let known = come(&mut network, 99, 1);
    assert!(is_welcome(&desk, known));
}

#[test]
fn only_those_who_may_halt_the_world_do() {
    let (desk, book) = (Desk::new(), Book::default());
    lock(&book.0).extend([(key(1), Rights::ALL), (key(2), Rights::LOOK)]);
    let mut network = admitting(&desk, Admit::Anyone, &book);
    let halts = |network: &mut Network<'_>, peer: PeerId| {
        desk.mailbox.take();
        say(network, peer, &ClientMessage::Steer(Steer::Halt), 0);
        desk.news(peer).is_some_and(|news| news.reported.steering.is_some())
    };
    let [may, may_not] = [1, 2].map(|peer| come(&mut network, peer, 0));
    assert!(halts(&mut network, may) && !halts(&mut network, may_not));
    lock(&book.0).insert(key(2), Rights::ALL);
    network.tick(2 * SECOND);
    assert!(halts(&mut network, may_not), "it may by now");
    network.take(Event::Closed { peer: may, kind: CloseKind::Peer(0), reason: "left".into() }, 0);
    let stranger = come(&mut network, 3, 3 * SECOND);
    assert!(is_welcome(&desk, stranger) && !halts(&mut network, stranger), "strangers look");
}

#[test]
fn a_device_that_is_forgotten_is_served_no_longer() {
    let (desk, book) = (Desk::new(), Book::default());
    lock(&book.0).insert(key(1), Rights::ALL);
    let mut network = admitting(&desk, Admit::Paired, &book);
    let peer = come(&mut network, 1, 0);
    network.tick(SECOND);
    assert!(is_welcome(&desk, peer) && desk.carrier.refusal(peer).is_none());
    lock(&book.0).clear();
    network.tick(3 * SECOND);
    assert!(desk.carrier.refusal(peer).is_some_and(|reason| reason.contains("forgotten")));
}
