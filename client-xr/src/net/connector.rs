//! One server, and the wish to be connected to it: what the client and the lines say to each other, and what the user is
//! told about it.

use super::finder::{Choice, Finder, List, choose, described, names};
use super::lines::{LineEvent, Lines};
use super::{RunError, RunOptions, Server};
use crate::client::Notice;
use crate::intake::Intake;
use crate::platform::monotonic_now;
use crate::taking::Source;
use crate::traced::Traced;
use shadecast_protocol::close::CloseCode;
use shadecast_protocol::session::Out;
use shadecast_protocol::text::printable;
use shadecast_protocol::time::ClientTime;
use shadecast_transport::discovery::FoundServer;
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
    /// As the user writes it, or as it calls itself.
    server: String,
    search: Search,
    /// What the user was told since the session last stood.
    told: VecDeque<String>,
    traced: Traced,
}

/// The search for a server whose address nobody has typed.
#[derive(Default)]
struct Search {
    /// The address may be another one tomorrow: where the connection fails it is searched again.
    is_wanted: bool,
    /// While it goes on.
    finder: Option<Finder>,
    /// What it has found last.
    found: Option<FoundServer>,
    /// Where it has found several.
    list: List,
}

impl Search {
    fn begin(&mut self) {
        if self.is_wanted {
            self.finder.get_or_insert_with(Finder::start);
        }
    }
}

impl Connector {
    pub(super) fn new(
        options: &RunOptions,
        addresses: &[SocketAddr],
        traced: Traced,
    ) -> Result<Self, RunError> {
        let server = match &options.server {
            Server::At(server) => printable(server),
            Server::Found => "a server of this network".to_owned(),
        };
        let mut search = Search { is_wanted: options.server == Server::Found, ..Search::default() };
        search.begin();
        Ok(Self {
            lines: Lines::new(addresses.to_vec()),
            known: KnownServers::load(&options.identity_dir)?,
            required: options.fingerprint,
            server,
            search,
            told: VecDeque::with_capacity(REMEMBERED_SENTENCES),
            traced,
        })
    }

    pub(super) fn status(&self) -> String {
        match self.search.is_wanted && self.search.found.is_none() {
            true => "Searching for servers on this network".to_owned(),
            false => format!("Connecting to {}", self.server),
        }
    }

    /// Turns to the server that was found, or says why to none.
    fn take_found(&mut self, intake: &mut Intake) {
        let Some(found) = self.search.finder.as_ref().and_then(Finder::newest) else { return };
        match choose(found, &self.known, self.required) {
            Choice::One(found) => self.turn_to(intake, found),
            Choice::Several(found) => {
                let text = format!(
                    "Several servers: {}; choose one with --connect, or in the headset",
                    names(&found)
                );
                self.tell(intake, Tone::Trouble, &text);
                self.search.list.refill(found);
                self.show_list(intake);
            }
            // Of one that was found before the lines say why it does not answer.
            Choice::Nobody if self.search.found.is_some() => {}
            Choice::Nobody => {
                let text = "No server answers on this network yet: start one with --listen 0.0.0.0:7400";
                self.tell(intake, Tone::News, text);
            }
        }
    }

    fn turn_to(&mut self, intake: &mut Intake, found: FoundServer) {
        self.search.finder = None;
        self.search.list = List::default();
        if self.lines.live().is_some() || self.search.found.as_ref() == Some(&found) {
            return;
        }
        self.tell(intake, Tone::News, &format!("Found {}", described(&found)));
        self.server.clone_from(&found.name);
        self.lines.leave();
        self.lines = Lines::new(found.addresses.clone());
        self.search.found = Some(found);
    }

    /// Says in the headset which servers there are to choose from, while there are.
    fn show_list(&self, intake: &mut Intake) {
        let text = self.search.list.text().filter(|_| self.lines.live().is_none());
        text.into_iter().for_each(|text| intake.set_status(&text));
    }

    /// Does what the user does with the list.
    fn take_presses(&mut self, intake: &mut Intake) {
        let presses = intake.presses();
        if !self.search.list.has_news(presses) {
            return;
        }
        match self.search.list.pick(presses) {
            Some(taken) => self.turn_to(intake, taken),
            None => self.show_list(intake),
        }
    }

    fn take(&mut self, intake: &mut Intake, event: LineEvent) {
        match event {
            LineEvent::Connected { address, fingerprint } => {
                if let Some(fingerprint) = fingerprint {
                    self.meet(address, fingerprint);
                }
                intake.on_connected(monotonic_now());
            }
            LineEvent::Failed { kind, reason } => self.tell_closed(intake, kind, &reason),
            LineEvent::Lost { kind, reason } => {
                intake.on_closed(monotonic_now());
                self.tell_closed(intake, kind, &reason);
            }
            LineEvent::Arrived(event) => {
                if let Event::Stream { bytes, at_ns, .. } = &event {
                    self.traced.arrived(bytes, ClientTime(*at_ns));
                }
                arrived(intake, event);
            }
        }
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

    fn tell_closed(&mut self, intake: &mut Intake, kind: CloseKind, reason: &str) {
        self.search.begin();
        match kind {
            CloseKind::IdentityChanged => self.tell(intake, Tone::Trouble, reason),
            _ => self.tell(intake, Tone::Trouble, &format!("{}: {reason}", self.status())),
        }
    }

    fn act_on(&mut self, intake: &mut Intake, notice: Notice, now: ClientTime) {
        let text = match notice {
            Notice::Welcome(_) => {
                self.lines.succeeded();
                self.search.finder = None;
                self.told.clear();
                self.tell(intake, Tone::News, &format!("Connected to {}", self.server));
                return;
            }
            Notice::Refused(refused) => format!("{}: {}", refused.reason, refused.remedy),
            Notice::ServerLeft => format!("{} has ended the session", self.server),
            Notice::Failed(reason) => reason,
        };
        self.tell(intake, Tone::Trouble, &text);
        self.flush(intake);
        self.lines.give_up(now, CloseCode::NotUnderstood, &text);
        intake.on_closed(now);
    }

    /// Says something in the headset, and on stderr once.
    fn tell(&mut self, intake: &mut Intake, tone: Tone, text: &str) {
        intake.set_status(text);
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
    fn flush(&mut self, intake: &mut Intake) {
        while let Some(out) = intake.poll_out() {
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
}

impl Source for Connector {
    /// Connects where it is time to, too.
    fn pump(&mut self, intake: &mut Intake) {
        while let Some(event) = self.lines.poll(monotonic_now()) {
            self.take(intake, event);
        }
        self.take_found(intake);
        self.take_presses(intake);
        let now = monotonic_now();
        let (known, required, server) = (&self.known, self.required, &self.server);
        let announced = self.search.found.as_ref().and_then(|found| found.fingerprint);
        let whom = |address| expected(known, required, announced, server, address);
        if let Some(event) = self.lines.dial(now, whom) {
            self.take(intake, event);
        }
        intake.advance(now);
        self.traced.decoded(intake.take_decoded());
        while let Some(notice) = intake.poll_notice() {
            self.act_on(intake, notice, now);
        }
        self.flush(intake);
    }

    fn leave(&mut self, intake: &mut Intake) {
        intake.say_goodbye();
        self.flush(intake);
        self.lines.leave();
    }
}

/// Who is to answer at `address`: what the user demands counts before what is known.
fn expected(
    known: &KnownServers,
    required: Option<Fingerprint>,
    announced: Option<Fingerprint>,
    server: &str,
    address: SocketAddr,
) -> ExpectedIdentity {
    let pinned =
        |fingerprint, remedy: &str| ExpectedIdentity::Pinned { fingerprint, remedy: remedy.to_owned() };
    if let Some(fingerprint) = required {
        let remedy =
            "--fingerprint names another server; a server says its identity when it starts to listen";
        return pinned(fingerprint, remedy);
    }
    match (known.expected(server, address), announced) {
        (ExpectedIdentity::TrustOnFirstUse, Some(fingerprint)) => pinned(
            fingerprint,
            "who answers is not the server that has announced itself; name it with --connect",
        ),
        (expected, _) => expected,
    }
}

fn arrived(intake: &mut Intake, event: Event) {
    match event {
        Event::Control { message, at_ns, .. } => intake.receive_control(ClientTime(at_ns), &message),
        Event::Stream { bytes, at_ns, .. } => intake.receive_stream(ClientTime(at_ns), &bytes),
        Event::StreamReset { head, .. } => intake.receive_reset(monotonic_now(), &head),
        Event::Datagram { bytes, at_ns, .. } => intake.receive_datagram(ClientTime(at_ns), &bytes),
        Event::Connected { .. } | Event::Closed { .. } => {} // told by the lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
    fn what_the_user_demands_counts_before_what_is_known_and_that_before_what_is_announced() {
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
}
