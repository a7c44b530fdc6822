use super::*;
use crate::client::ClientOptions;
use crate::net::heard::tests::{knowing, server};
use shadecast_transport::identity::pairing::{Code, Desk, Ends, Judgement};
use shadecast_transport::{Binding, Network, PeerId};
use shadecast_transport::{Driver, Endpoint, EndpointConfig, Events, Handle, ServerIdentity, spawn};
use std::time::{Duration, Instant};
use tempfile::TempDir;

const PATIENCE: Duration = Duration::from_secs(60);

/// A headset that notes what it is told.
#[derive(Default)]
struct Headset {
    said: Vec<String>,
    presses: Presses,
    is_connected: bool,
    has_discarded: bool,
    steps: Vec<ClientPairing>,
}

impl Headset {
    fn shows(&self) -> &str {
        self.said.last().map_or("", String::as_str)
    }
}

impl Listener for Headset {
    fn set_status(&mut self, text: &str) {
        self.said.push(text.to_owned());
    }

    fn presses(&self) -> Presses {
        self.presses
    }

    fn on_connected(&mut self, _: ClientTime) {
        self.is_connected = true;
    }

    fn on_closed(&mut self, _: ClientTime) {
        self.is_connected = false;
    }

    fn on_discarded(&mut self, _: ClientTime) {
        (self.is_connected, self.has_discarded) = (false, true);
    }

    fn on_arrived(&mut self, _: Event) {}

    fn pair(&mut self, step: ClientPairing) {
        self.steps.push(step);
    }
}

fn options(folder: &TempDir, server: &str) -> RunOptions {
    RunOptions {
        server: server.into(),
        fingerprint: None,
        asks_first: false,
        identity_dir: folder.path().to_owned(),
        forgetting: None,
        notice: None,
        client: ClientOptions::default(),
        seconds: 0.0,
        pipelines: None,
        trace: None,
    }
}

/// A client of these options; whom it finds is for the test to say.
fn connector(options: &RunOptions) -> Connector {
    Connector::asking(options, Traced::new(None), Finder::silent).expect("a connector")
}

/// Lets it do what is due until then.
#[track_caller]
fn seek_until(connector: &mut Connector, headset: &mut Headset, is_over: impl Fn(&Headset) -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !is_over(headset) {
        connector.seek(headset);
        assert!(Instant::now() < deadline, "{:?}", headset.said);
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A server on loopback that says nothing.
fn mute_server(seed: u64) -> (SocketAddr, Fingerprint, (Handle, Events)) {
    let identity = ServerIdentity::from_seed(seed).expect("an identity");
    let endpoint = Endpoint::server(&identity, EndpointConfig::default()).expect("an endpoint");
    let driver = Driver::bind(endpoint, SocketAddr::from(([127, 0, 0, 1], 0))).expect("a socket");
    let address = driver.local_addr().expect("an address");
    (address, identity.fingerprint(), spawn(driver).expect("a thread"))
}

fn key(byte: u8) -> Fingerprint {
    format!("{byte:02x}").repeat(32).parse().expect("64 digits")
}

/// The key that is demanded, and whether it is at all.
fn demanded(expected: &ExpectedIdentity) -> Option<Fingerprint> {
    match expected {
        ExpectedIdentity::Pinned { fingerprint, .. } => Some(*fingerprint),
        _ => None,
    }
}

#[test]
fn demanded_precedes_known_precedes_announced() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut known = KnownServers::load(folder.path()).expect("an empty list");
    let address: SocketAddr = "192.168.1.5:7400".parse().expect("an address");
    let [asked, pinned, announced] = [1, 2, 3].map(key);
    let whom = |known: &KnownServers, required, announced| {
        demanded(&expected(known, required, announced, "desk", address))
    };
    assert_eq!(whom(&known, None, None), None, "a stranger whose address was typed");
    assert_eq!(whom(&known, None, Some(announced)), Some(announced), "a stranger keeps its word");
    known.remember("desk", address, pinned).expect("pinned");
    assert_eq!(whom(&known, None, Some(announced)), Some(pinned), "nobody takes a name by announcing it");
    assert_eq!(whom(&known, Some(asked), Some(announced)), Some(asked));
}

#[test]
fn a_server_that_another_app_names_is_dialled_once_it_is_known_or_the_user_agrees() {
    let folder = tempfile::tempdir().expect("a folder");
    let (address, _, _server) = mute_server(77);
    let asking = RunOptions { asks_first: true, ..options(&folder, &address.to_string()) };
    let (mut stranger, mut headset) = (connector(&asking), Headset::default());
    assert!(stranger.first_status().contains("Another app asks to connect to 127.0.0.1"));
    (0..40).for_each(|_| {
        stranger.seek(&mut headset);
        std::thread::sleep(Duration::from_millis(5));
    });
    assert!(!headset.is_connected && stranger.lines.live().is_none(), "{:?}", headset.said);
    headset.presses.takes += 1;
    seek_until(&mut stranger, &mut headset, |headset| headset.is_connected);
    assert!(headset.said[0].contains("Connecting to"), "{:?}", headset.said);
    let (mut known, mut headset) = (connector(&asking), Headset::default());
    seek_until(&mut known, &mut headset, |headset| headset.is_connected);
    // With a key of that app's choice even a known address is a stranger's.
    let other = RunOptions { fingerprint: Some(key(9)), ..asking };
    let (mut other, mut headset) = (connector(&other), Headset::default());
    (0..40).for_each(|_| other.seek(&mut headset));
    assert!(other.consent.is_lacking());
}

#[test]
fn the_last_server_wins_among_known_ones_at_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let [desk, attic] = [server("desk", 1), server("attic", 2)];
    for last in [&attic, &desk] {
        knowing(&folder, &[&desk, &attic, last]);
        let (mut connector, mut headset) = (connector(&options(&folder, "find")), Headset::default());
        connector.take_round(&mut headset, vec![desk.clone(), attic.clone()]);
        assert_eq!(connector.search.found.as_ref(), Some(last));
    }
}

#[test]
fn an_unfound_last_server_is_reached_at_its_last_address() {
    let folder = tempfile::tempdir().expect("a folder");
    let (address, fingerprint, _server) = mute_server(81);
    KnownServers::load(folder.path())
        .and_then(|mut known| known.remember("desk", address, fingerprint))
        .expect("known");
    let (mut connector, mut headset) = (connector(&options(&folder, "find")), Headset::default());
    connector.seek(&mut headset);
    assert!(connector.search.announced().is_none(), "the search goes first");
    connector.take_round(&mut headset, vec![]);
    assert_eq!(connector.search.announced(), Some(fingerprint));
    seek_until(&mut connector, &mut headset, |headset| headset.is_connected);
    assert_eq!(connector.search.found.map(|found| found.name), Some("desk".to_owned()));
}

#[test]
fn a_stranger_at_the_last_address_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let (address, _, _server) = mute_server(82);
    KnownServers::load(folder.path())
        .and_then(|mut known| known.remember("desk", address, key(1)))
        .expect("known");
    let (mut connector, mut headset) = (connector(&options(&folder, "find")), Headset::default());
    connector.take_round(&mut headset, vec![]);
    seek_until(&mut connector, &mut headset, |headset| headset.shows().contains("another identity"));
    connector.take_round(&mut headset, vec![]);
    assert!(!headset.is_connected && headset.shows().contains("another identity"), "{:?}", headset.said);
    assert!(connector.search.finder.is_some());
    let moved = FoundServer { fingerprint: Some(key(1)), ..server("desk", 5) };
    connector.take_round(&mut headset, vec![moved.clone()]);
    assert_eq!(connector.search.found, Some(moved));
}

#[test]
fn the_list_chooses_nobody_by_itself_and_the_user_does() {
    let folder = tempfile::tempdir().expect("a folder");
    let [desk, attic] = [server("desk", 1), server("attic", 2)];
    let (mut connector, mut headset) = (connector(&options(&folder, "find")), Headset::default());
    connector.take_round(&mut headset, vec![desk.clone()]);
    assert_eq!(connector.search.found, None, "the other one's answer may be lost");
    connector.take_round(&mut headset, vec![desk.clone(), attic.clone()]);
    assert!(headset.shows().starts_with("2 servers answer."), "{:?}", headset.said);
    for _ in 0..8 {
        connector.take_round(&mut headset, vec![desk.clone()]);
        assert_eq!(connector.search.found, None);
    }
    assert!(headset.shows().starts_with("1 server answers."), "{:?}", headset.said);
    headset.presses.takes += 1;
    connector.take_presses(&mut headset);
    assert_eq!(connector.search.found.as_ref(), Some(&desk));
    assert_eq!(connector.search.preferred, Some(desk));
}

#[test]
fn failures_do_not_overwrite_the_server_list() {
    let folder = tempfile::tempdir().expect("a folder");
    let [desk, attic] = [server("desk", 1), server("attic", 2)];
    let (mut connector, mut headset) = (connector(&options(&folder, "find")), Headset::default());
    (0..2).for_each(|_| connector.take_round(&mut headset, vec![desk.clone()]));
    let failed = || LineEvent::Failed { kind: CloseKind::TimedOut, reason: "it did not answer".into() };
    connector.take(&mut headset, failed());
    assert_eq!(headset.shows(), "Connecting to desk: it did not answer");
    connector.take_round(&mut headset, vec![desk.clone(), attic.clone()]);
    assert_eq!(connector.search.found, None, "it is not dialled any more");
    connector.take(&mut headset, failed());
    assert!(headset.shows().starts_with("2 servers answer."), "{:?}", headset.said);
}

#[test]
fn an_outage_is_said_each_time_and_ends_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut connector, mut headset) = (connector(&options(&folder, "192.168.1.5:7400")), Headset::default());
    headset.is_connected = true;
    for _ in 0..2 {
        connector.take(&mut headset, LineEvent::Away);
        assert_eq!(headset.shows(), "Nothing comes from 192.168.1.5:7400; the session goes on when it does");
        connector.take(&mut headset, LineEvent::Back);
        assert_eq!(headset.shows(), "192.168.1.5:7400 is heard again");
        assert_eq!(connector.told.len(), 1, "the next outage is said again");
    }
    assert!(headset.is_connected);
}

#[test]
fn an_unknown_name_is_reported_with_its_remedy() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut connector, mut headset) =
        (connector(&options(&folder, "desk.invalid:7400")), Headset::default());
    assert_eq!(connector.first_status(), "Looking for desk.invalid:7400");
    let (says, answers) = std::sync::mpsc::channel();
    let answers = std::sync::Mutex::new(answers);
    let ask =
        move || answers.lock().expect("a lock").recv().unwrap_or_else(|_| Err("the test is over".into()));
    connector.naming.resolver = Some(Resolver::asking(ask, Duration::ZERO));
    says.send(Err("no such host".to_owned())).expect("said");
    seek_until(&mut connector, &mut headset, |headset| !headset.said.is_empty());
    for word in ["desk.invalid:7400 is not known on this network", "192.168.1.5:7400", "no such host"] {
        assert!(headset.shows().contains(word), "{:?}", headset.said);
    }
    let (address, _, _server) = mute_server(83);
    says.send(Ok(vec![address])).expect("said");
    seek_until(&mut connector, &mut headset, |headset| headset.is_connected);
    assert!(headset.said.contains(&"Connecting to desk.invalid:7400".to_owned()), "{:?}", headset.said);
}

#[test]
fn the_first_failure_is_reported_until_a_connection() {
    let folder = tempfile::tempdir().expect("a folder");
    let notice = Some("server.txt:1: 'x' is no address".to_owned());
    let mut connector = connector(&RunOptions { notice, ..options(&folder, "find") });
    let is_noticed = |text: &str| text.starts_with("server.txt:1: 'x' is no address\n");
    assert!(is_noticed(&connector.first_status()));
    let mut headset = Headset::default();
    connector.take_round(&mut headset, vec![]);
    assert!(
        is_noticed(headset.shows()) && headset.shows().contains("No server answers"),
        "{:?}",
        headset.said
    );
}

/// Somebody outside of this machine who has answered.
fn met(byte: u8) -> Met {
    let address = "192.168.1.5:7400".parse().expect("an address");
    Met { address, fingerprint: key(byte), binding: Binding([byte; 32]) }
}

fn in_house(folder: &TempDir) -> (Connector, Headset) {
    (connector(&options(folder, "192.168.1.5:7400")), Headset::default())
}

fn known_in(folder: &TempDir) -> KnownServers {
    KnownServers::load(folder.path()).expect("a list")
}

const NOW: ClientTime = ClientTime(5_000_000_000);

#[test]
fn a_stranger_is_not_pinned_by_answering() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut connector, mut headset) = in_house(&folder);
    connector.meet(met(1));
    assert!(!connector.may_use(&mut headset, NOW), "it welcomes us, and that is not for it to say");
    assert!(!known_in(&folder).knows(key(1)) && headset.has_discarded);
    for word in ["192.168.1.5:7400 is not known", "010101010101", "Enter", "--fingerprint"] {
        assert!(headset.shows().contains(word), "{:?}", headset.said);
    }
    connector.seek(&mut headset);
    assert!(connector.trust.is_asking() && connector.lines.live().is_none());
    headset.presses.takes += 1;
    connector.take_presses(&mut headset);
    assert!(!connector.trust.is_asking() && known_in(&folder).knows(key(1)));
    connector.meet(met(1));
    assert!(connector.may_use(&mut headset, NOW), "the user has taken it");
    connector.meet(met(2));
    assert!(!connector.may_use(&mut headset, NOW), "and nobody else");
}

#[test]
fn agreeing_to_a_named_server_takes_the_one_that_answers() {
    let folder = tempfile::tempdir().expect("a folder");
    let asking = RunOptions { asks_first: true, ..options(&folder, "192.168.1.5:7400") };
    let (mut connector, mut headset) = (connector(&asking), Headset::default());
    assert!(connector.lacks_consent(&mut headset));
    headset.presses.takes += 1;
    assert!(!connector.lacks_consent(&mut headset));
    connector.meet(met(1));
    assert!(!known_in(&folder).knows(key(1)), "answering is not serving");
    assert!(connector.may_use(&mut headset, NOW) && !connector.trust.is_asking(), "{:?}", headset.said);
    assert!(known_in(&folder).knows(key(1)));
    connector.meet(met(2));
    assert!(!connector.may_use(&mut headset, NOW), "one server");
}

#[test]
fn agreeing_to_a_named_server_takes_none_of_the_list() {
    let folder = tempfile::tempdir().expect("a folder");
    let asking = RunOptions { asks_first: true, ..options(&folder, "192.168.1.5:7400") };
    let (mut connector, mut headset) = (connector(&asking), Headset::default());
    connector.lacks_consent(&mut headset);
    headset.presses.takes += 1;
    connector.lacks_consent(&mut headset);
    connector.turn_to(&mut headset, server("attic", 2));
    connector.meet(met(1));
    assert!(!connector.may_use(&mut headset, NOW) && connector.trust.is_asking());
}

#[test]
fn a_server_that_was_named_by_its_key_or_runs_here_is_pinned_at_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let named = RunOptions { fingerprint: Some(key(1)), ..options(&folder, "192.168.1.5:7400") };
    let mut named = connector(&named);
    named.meet(met(1));
    assert!(known_in(&folder).knows(key(1)) && named.may_use(&mut Headset::default(), NOW));
    let (mut local, mut headset) = in_house(&folder);
    local.meet(Met { address: "127.0.0.1:7400".parse().expect("an address"), ..met(3) });
    assert!(known_in(&folder).knows(key(3)) && local.may_use(&mut headset, NOW));
}

/// A code is shown for the server of `met`, and typed there, or another one; the connection as the server sees it is `at_server`.
fn paired(
    connector: &mut Connector,
    headset: &mut Headset,
    met: Met,
    at_server: Met,
    is_right: bool,
) -> Desk {
    connector.meet(met);
    assert_eq!(connector.show_code(headset, &[7; 64], NOW), None);
    let Some(ClientPairing::Offer { element }) = headset.steps.pop() else { panic!("{:?}", headset.steps) };
    let shown = headset.shows().lines().find(|line| line.parse::<Code>().is_ok());
    let shown: Code = shown.and_then(|line| line.parse().ok()).expect("a code is shown");
    let other: Code =
        if shown.to_string() == "000 000" { "000001" } else { "000000" }.parse().expect("a code");
    let (mut desk, client) = (Desk::new(), connector.identity.fingerprint());
    let ends = Ends { client, server: at_server.fingerprint, binding: at_server.binding };
    desk.begin(PeerId(1), Network::of(met.address.ip()), ends, 0).expect("its turn");
    desk.offered(PeerId(1), element).expect("asked");
    let (_, answer) = desk.typed(if is_right { shown } else { other }, &[8; 64], 0).expect("it waits");
    connector.judge_code(headset, &answer.expect("an element"), NOW);
    desk
}

#[test]
fn a_server_at_which_the_shown_code_was_typed_is_pinned() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut connector, mut headset) = in_house(&folder);
    let mut desk = paired(&mut connector, &mut headset, met(1), met(1), true);
    assert!(known_in(&folder).knows(key(1)));
    assert!(connector.may_use(&mut headset, NOW));
    let Some(ClientPairing::Proof { proof }) = headset.steps.pop() else { panic!("{:?}", headset.steps) };
    let judgement = desk.proved(PeerId(1), &proof, 0);
    assert_eq!(judgement, Ok(Judgement::Paired(connector.identity.fingerprint())));
}

#[test]
fn a_wrong_code_and_somebody_between_pin_nobody() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut connector, mut headset) = in_house(&folder);
    paired(&mut connector, &mut headset, met(1), met(1), false);
    assert_eq!(headset.steps.pop(), Some(ClientPairing::WrongCode));
    paired(&mut connector, &mut headset, met(1), Met { binding: Binding([9; 32]), ..met(1) }, true);
    assert_eq!(headset.steps.pop(), Some(ClientPairing::WrongCode));
    assert!(!known_in(&folder).knows(key(1)) && !connector.may_use(&mut headset, NOW));
}

#[test]
fn after_a_wrong_code_the_next_one_is_shown_with_the_reason_and_the_third_closes_pairing() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut connector, mut headset) = in_house(&folder);
    paired(&mut connector, &mut headset, met(1), met(1), false);
    connector.trust.refused("the code was another one: type the new code");
    paired(&mut connector, &mut headset, met(1), met(1), false);
    let shown = headset.said.last().expect("a code");
    assert!(shown.starts_with("the code was another one: type the new code\n"), "{shown}");
    paired(&mut connector, &mut headset, met(1), met(1), false);
    connector.meet(met(1));
    let closed = connector.show_code(&mut headset, &[7; 64], NOW).expect("closed");
    assert!(closed.contains("closed for 60 s"), "{closed}");
    assert!(!headset.steps.iter().any(|step| matches!(step, ClientPairing::Offer { .. })));
}
