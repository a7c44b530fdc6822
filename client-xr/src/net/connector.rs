//! The connection to one server: messages between the client and the lines, and messages for the user.

use super::address::{Address, Resolver};
use super::consent::{self, Consent};
use super::finder::Finder;
use super::heard::{Choice, Heard, Wish};
use super::lines::{LineEvent, Lines};
use super::list::{List, described, names};
use super::traced::Traced;
use super::trust::{Met, Trust, question};
use super::wording::for_headset;
use super::{RunError, RunOptions, Server};
use crate::client::Notice;
use crate::display::Presses;
use crate::platform::monotonic_now;
use crate::stream::intake::Intake;
use crate::stream::taking::Source;
use shadecast_protocol::close::CloseCode;
use shadecast_protocol::pairing::ClientPairing;
use shadecast_protocol::session::Out;
use shadecast_protocol::text::printable;
use shadecast_protocol::time::ClientTime;
use shadecast_transport::discovery::FoundServer;
use shadecast_transport::identity::pairing::Answer;
use shadecast_transport::{
    ClientIdentity, CloseKind, Event, ExpectedIdentity, Fingerprint, KnownServers, LastServer, Meeting,
};
use std::collections::VecDeque;
use std::net::SocketAddr;
use std::sync::Arc;

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

/// What the connector tells and asks the client's half that takes in. Tests have one without a device.
trait Listener {
    /// Says something in the headset.
    fn set_status(&mut self, text: &str);
    /// What somebody has pressed.
    fn presses(&self) -> Presses;
    /// Bytes can flow.
    fn on_connected(&mut self, now: ClientTime);
    /// No longer.
    fn on_closed(&mut self, now: ClientTime);
    /// No longer, and nothing that came is to be shown.
    fn on_discarded(&mut self, now: ClientTime);
    /// Something came.
    fn on_arrived(&mut self, event: Event);
    /// Says a step of pairing to the server.
    fn pair(&mut self, step: ClientPairing);
}

impl Listener for Intake {
    fn set_status(&mut self, text: &str) {
        self.set_status(text);
    }

    fn presses(&self) -> Presses {
        self.presses()
    }

    fn on_connected(&mut self, now: ClientTime) {
        self.on_connected(now);
    }

    fn on_closed(&mut self, now: ClientTime) {
        self.on_closed(now);
    }

    fn on_discarded(&mut self, now: ClientTime) {
        self.on_discarded(now);
    }

    fn on_arrived(&mut self, event: Event) {
        match event {
            Event::Control { message, at_ns, .. } => self.receive_control(ClientTime(at_ns), &message),
            Event::Stream { bytes, at_ns, .. } => self.receive_stream(ClientTime(at_ns), &bytes),
            Event::StreamReset { head, .. } => self.receive_reset(monotonic_now(), &head),
            Event::Datagram { bytes, at_ns, .. } => self.receive_datagram(ClientTime(at_ns), &bytes),
            // Told by the lines.
            Event::Connected { .. } | Event::Away { .. } | Event::Back { .. } | Event::Closed { .. } => {}
        }
    }

    fn pair(&mut self, step: ClientPairing) {
        self.pair(step);
    }
}

/// One server, and the wish to be connected to it.
pub(super) struct Connector {
    lines: Lines,
    /// Who we are to servers.
    identity: Arc<ClientIdentity>,
    known: KnownServers,
    trust: Trust,
    /// The only identity that will do, if the user named one.
    required: Option<Fingerprint>,
    /// The user's, where another app has named the server.
    consent: Consent,
    /// As the user writes it, or as it calls itself.
    server: String,
    naming: Naming,
    search: Search,
    /// What the user is to know of the start, until something comes of it.
    notice: Option<String>,
    /// What the user was told since the session last stood.
    told: VecDeque<String>,
    /// What the connection has brought so far.
    received_bytes: u64,
    traced: Traced,
}

/// The machines that a name leads to.
#[derive(Default)]
struct Naming {
    /// `host:port`, where the user has written a name.
    name: Option<String>,
    /// While it is asked for.
    resolver: Option<Resolver>,
    /// What it led to last.
    addresses: Vec<SocketAddr>,
}

impl Naming {
    /// Where the connection fails the name may lead elsewhere by now.
    fn begin(&mut self) {
        if let Some(name) = &self.name {
            self.resolver.get_or_insert_with(|| Resolver::start(name.clone()));
        }
    }

    fn is_unknown(&self) -> bool {
        self.name.is_some() && self.addresses.is_empty()
    }
}

/// The search for a server whose address nobody has typed.
struct Search {
    /// The address may be another one tomorrow: where the connection fails it is searched again.
    is_wanted: bool,
    start: fn() -> Finder,
    /// While it goes on.
    finder: Option<Finder>,
    /// Whom it has heard of.
    heard: Heard,
    /// The server that is taken whoever else is there, with its last address: connected last, or taken by the user.
    preferred: Option<FoundServer>,
    /// The lines lead to where the preferred one was last, since it was not found yet.
    is_trying_preferred: bool,
    /// Whom the lines lead to since it was found.
    found: Option<FoundServer>,
    /// Somebody was refused, which the user is to read.
    is_shut_out: bool,
    /// Where it has found several.
    list: List,
}

impl Search {
    fn new(is_wanted: bool, preferred: Option<FoundServer>, start: fn() -> Finder) -> Self {
        Self {
            is_wanted,
            start,
            finder: None,
            heard: Heard::default(),
            preferred,
            is_trying_preferred: false,
            found: None,
            is_shut_out: false,
            list: List::default(),
        }
    }

    fn begin(&mut self) {
        if self.is_wanted && self.finder.is_none() {
            self.heard = Heard::default();
            self.finder = Some((self.start)());
        }
    }

    /// The key of who is to answer, by its own word or by what is remembered.
    fn announced(&self) -> Option<Fingerprint> {
        let tried = self.preferred.as_ref().filter(|_| self.is_trying_preferred);
        self.found.as_ref().or(tried)?.fingerprint
    }
}

/// A server that was met, as if it had just announced itself.
fn announced_by(last: &LastServer) -> FoundServer {
    FoundServer {
        name: last.name.clone(),
        addresses: vec![last.address],
        fingerprint: Some(last.fingerprint),
    }
}

impl Connector {
    pub(super) fn new(options: &RunOptions, traced: Traced) -> Result<Self, RunError> {
        Self::asking(options, traced, Finder::start)
    }

    /// The same with another way to begin a search.
    fn asking(options: &RunOptions, traced: Traced, start: fn() -> Finder) -> Result<Self, RunError> {
        let identity = Arc::new(ClientIdentity::load_or_create(&options.identity_dir)?);
        let mut known = KnownServers::load(&options.identity_dir)?;
        if let Some(remedy) = options.forgetting {
            known = known.with_remedy(remedy);
        }
        let last = known.last().map(announced_by);
        let mut search = Search::new(options.server == Server::Found, last, start);
        let mut naming = Naming::default();
        let server = match &options.server {
            Server::At(server) => {
                match Address::parse(server)? {
                    Address::Of(address) => naming.addresses = vec![address],
                    Address::Named(name) => naming.name = Some(name),
                }
                printable(server)
            }
            Server::Found => "a server of this network".to_owned(),
        };
        search.begin();
        naming.begin();
        Ok(Self {
            lines: Lines::new(&identity, naming.addresses.clone()),
            identity,
            known,
            trust: Trust::default(),
            required: options.fingerprint,
            consent: Consent::new(options.asks_first),
            server,
            naming,
            search,
            notice: options.notice.clone(),
            told: VecDeque::with_capacity(REMEMBERED_SENTENCES),
            received_bytes: 0,
            traced,
        })
    }

    /// What the headset says at first.
    pub(super) fn first_status(&self) -> String {
        for_headset(&self.with_notice(&self.status()))
    }

    fn status(&self) -> String {
        if self.consent.is_lacking() {
            return consent::question(&self.server);
        }
        if self.search.is_wanted && self.search.found.is_none() {
            return "Searching for servers on this network".to_owned();
        }
        let doing = if self.naming.is_unknown() { "Looking for" } else { "Connecting to" };
        format!("{doing} {}", self.server)
    }

    /// What was wrong at the start is read before what came of it.
    fn with_notice(&self, text: &str) -> String {
        self.notice.as_ref().map_or(text.to_owned(), |notice| format!("{notice}\n{text}"))
    }

    /// Does what is due for a connection: everything but what is said over it.
    fn seek(&mut self, listener: &mut impl Listener) {
        while let Some(event) = self.lines.poll(monotonic_now()) {
            self.take(listener, event);
        }
        self.take_addresses(listener);
        while let Some(round) = self.search.finder.as_ref().and_then(Finder::poll) {
            self.take_round(listener, round);
        }
        if self.lacks_consent(listener) {
            return;
        }
        self.take_presses(listener);
        if self.trust.is_asking() {
            return; // nobody is dialled before the user has said whether it may be
        }
        let (known, required, server) = (&self.known, self.required, &self.server);
        let announced = self.search.announced();
        let whom = |address| expected(known, required, announced, server, address);
        if let Some(event) = self.lines.dial(monotonic_now(), whom) {
            self.take(listener, event);
        }
    }

    /// Whether nobody may be dialled, since another app has named the server and the user has not agreed.
    fn lacks_consent(&mut self, listener: &mut impl Listener) -> bool {
        let is_pinned = |address: &SocketAddr| {
            matches!(self.known.expected(&self.server, *address), ExpectedIdentity::Pinned { .. })
        };
        let addresses = &self.naming.addresses;
        let is_known = match self.required {
            Some(required) => self.known.knows(required),
            None => !addresses.is_empty() && addresses.iter().all(is_pinned),
        };
        if self.consent.is_given(is_known, listener.presses()) {
            listener.set_status(&for_headset(&self.with_notice(&self.status())));
        }
        self.consent.is_lacking()
    }

    /// Turns to where the server's name leads, or says that it leads nowhere.
    fn take_addresses(&mut self, listener: &mut impl Listener) {
        let Some(answer) = self.naming.resolver.as_ref().and_then(Resolver::poll) else { return };
        match answer {
            Ok(addresses) => {
                self.naming.resolver = None;
                let is_new = addresses.iter().any(|address| !self.naming.addresses.contains(address));
                if is_new && self.lines.live().is_none() {
                    self.naming.addresses.clone_from(&addresses);
                    self.lines = Lines::new(&self.identity, addresses);
                    listener.set_status(&for_headset(&self.with_notice(&self.status())));
                }
            }
            Err(reason) if self.naming.is_unknown() => {
                let text = format!(
                    "{} is not known on this network; check the name, or write an address such as 192.168.1.5:7400 \
                     ({reason})",
                    self.server
                );
                self.report(listener, Tone::Trouble, &text);
            }
            Err(reason) => tracing::debug!("{}: {reason}", self.server),
        }
    }

    /// Turns to the server that was found, or says why to none.
    fn take_round(&mut self, listener: &mut impl Listener, round: Vec<FoundServer>) {
        self.search.heard.take(round);
        if self.lines.live().is_some() {
            return;
        }
        let wish = Wish {
            required: self.required,
            preferred: self.search.preferred.as_ref(),
            current: self.search.found.as_ref(),
            known: &self.known,
            is_listed: self.search.list.is_shown(),
        };
        match self.search.heard.choose(&wish) {
            Choice::One(found) => self.turn_to(listener, found),
            Choice::Several(found) => self.list(listener, found),
            Choice::Unsure => _ = self.try_preferred(),
            Choice::Nobody => {
                self.search.list.clear();
                let has_just_begun = self.try_preferred();
                // Of one that was found before, or was refused, the lines say why there is nothing to see.
                if has_just_begun || self.search.found.is_some() || self.search.is_shut_out {
                    return;
                }
                let text = "No server answers on this network yet: start one with --listen 0.0.0.0:7400";
                self.report(listener, Tone::News, text);
                listener.set_status(&for_headset(&self.with_notice(text)));
            }
        }
    }

    /// Lets the user choose. Who was dialled before has no say any more, but for the one that would be taken anyway.
    fn list(&mut self, listener: &mut impl Listener, found: Vec<FoundServer>) {
        if self.search.found.take().is_some() {
            self.lines = Lines::new(&self.identity, Vec::new());
        }
        self.search.is_shut_out = false;
        self.try_preferred();
        let text = match &found[..] {
            [one] => format!(
                "Another server answers: {}; take it with --connect, or in the headset",
                described(one)
            ),
            _ => format!("Several servers: {}; choose one with --connect, or in the headset", names(&found)),
        };
        self.report(listener, Tone::Trouble, &text);
        self.search.list.refill(found);
        self.show_list(listener);
    }

    /// Dials where the preferred server was last, while it is not found: a network may carry no multicast. Whether that
    /// begins now.
    fn try_preferred(&mut self) -> bool {
        let is_allowed = |last: &&FoundServer| {
            last.fingerprint.is_some() && (self.required.is_none() || last.fingerprint == self.required)
        };
        let Some(last) = self.search.preferred.as_ref().filter(is_allowed) else { return false };
        if self.search.found.is_some() || self.search.is_trying_preferred {
            return false;
        }
        tracing::debug!("trying {} as well", described(last));
        self.search.is_trying_preferred = true;
        self.server.clone_from(&last.name);
        self.lines = Lines::new(&self.identity, last.addresses.clone());
        true
    }

    fn turn_to(&mut self, listener: &mut impl Listener, found: FoundServer) {
        self.search.finder = None;
        self.search.list.clear();
        if self.lines.live().is_some() || self.search.found.as_ref() == Some(&found) {
            return;
        }
        self.trust.forget_question();
        self.consent.use_up(); // it was for another one
        self.report(listener, Tone::News, &format!("Found {}", described(&found)));
        self.server.clone_from(&found.name);
        self.lines = Lines::new(&self.identity, found.addresses.clone());
        self.search.is_trying_preferred = false;
        self.search.is_shut_out = false;
        self.search.found = Some(found);
    }

    /// Says in the headset which servers there are to choose from, while there are.
    fn show_list(&self, listener: &mut impl Listener) {
        let text = self.search.list.text().filter(|_| self.lines.live().is_none());
        text.into_iter().for_each(|text| listener.set_status(&text));
    }

    /// Does what the user does with the list.
    fn take_presses(&mut self, listener: &mut impl Listener) {
        let presses = listener.presses();
        if let Some(taken) = self.trust.take(presses.takes) {
            self.pin(&taken);
            self.report(listener, Tone::News, &self.status());
        }
        if !self.search.list.has_news(presses) {
            return;
        }
        match self.search.list.pick(presses) {
            Some(taken) => {
                self.search.preferred = Some(taken.clone());
                self.turn_to(listener, taken);
            }
            None => self.show_list(listener),
        }
    }

    fn take(&mut self, listener: &mut impl Listener, event: LineEvent) {
        match event {
            LineEvent::Connected { address, fingerprint, binding } => {
                if let Some(fingerprint) = fingerprint {
                    self.meet(Met { address, fingerprint, binding });
                }
                listener.on_connected(monotonic_now());
            }
            LineEvent::Failed { kind, reason } => self.report_closed(listener, kind, &reason),
            LineEvent::Lost { kind, reason } => {
                self.trust.lost();
                listener.on_closed(monotonic_now());
                self.report_closed(listener, kind, &reason);
            }
            LineEvent::Away => {
                let text = format!("Nothing comes from {}; the session goes on when it does", self.server);
                self.report(listener, Tone::Trouble, &text);
            }
            LineEvent::Back => {
                self.told.clear();
                self.report(listener, Tone::News, &format!("{} is heard again", self.server));
            }
            LineEvent::Arrived(event) => {
                if let Event::Stream { bytes, at_ns, .. } = &event {
                    self.traced.arrived(bytes, ClientTime(*at_ns));
                }
                listener.on_arrived(event);
            }
        }
    }

    /// Somebody has answered. Who is trusted is pinned at once; a stranger only when it was paired or taken.
    fn meet(&mut self, met: Met) {
        self.trust.met(met);
        if self.trust.is_trusted(&self.known, self.required) {
            self.pin(&met);
        }
    }

    /// Pins a server, and tells the user once who that is. From now on it is the one that was connected last.
    fn pin(&mut self, met: &Met) {
        let Met { address, fingerprint, .. } = *met;
        let place = self.place(address);
        match self.known.remember(&self.server, address, fingerprint) {
            Ok(Meeting::Again) => tracing::debug!("{place} has answered"),
            Ok(Meeting::KnownAs(name)) => tracing::info!("{place} is the server known as {name}"),
            Ok(Meeting::First) => {
                tracing::info!("first connection to {place}: its identity is {fingerprint}; pinned");
            }
            Err(error) => tracing::warn!("{error}; the server will not be recognised next time"),
        }
        let last = LastServer { name: self.server.clone(), address, fingerprint };
        self.search.preferred = Some(announced_by(&last));
        self.search.list.clear();
        if std::mem::take(&mut self.search.is_trying_preferred) {
            self.search.found.clone_from(&self.search.preferred);
        }
    }

    /// Shows a code, for whoever stands at the server to type. What to say where there can be none.
    fn show_code(
        &mut self,
        listener: &mut impl Listener,
        random: &[u8; 64],
        now: ClientTime,
    ) -> Option<String> {
        let own = self.identity.fingerprint();
        match self.trust.show_code(own, random, now.0)? {
            Ok((code, element)) => {
                listener.pair(ClientPairing::Offer { element });
                let text = self.trust.instructions(code, &self.server);
                self.report(listener, Tone::Trouble, &text);
                None
            }
            Err(closed) => Some(format!("{}: {closed}", self.server)),
        }
    }

    /// Judges the code that was typed at the server. A server that has the right one is pinned.
    fn judge_code(&mut self, listener: &mut impl Listener, answer: &Answer, now: ClientTime) {
        let step = match self.trust.judge(answer, now.0) {
            Ok(proof) => {
                self.trust.whom().iter().for_each(|met| self.pin(met));
                ClientPairing::Proof { proof }
            }
            Err(_) => ClientPairing::WrongCode,
        };
        listener.pair(step);
    }

    /// Whether the server that would serve us is trusted. Otherwise the user is asked, and the connection is not used.
    fn may_use(&mut self, listener: &mut impl Listener, now: ClientTime) -> bool {
        let is_agreed = self.consent.use_up();
        if self.trust.is_trusted(&self.known, self.required) {
            return true;
        }
        if let Some(met) = self.trust.whom().filter(|_| is_agreed) {
            self.pin(&met);
            return true;
        }
        if let Some(met) = self.trust.ask(listener.presses().takes) {
            let text = question(&self.place(met.address), met.fingerprint);
            self.report(listener, Tone::Trouble, &text);
        }
        self.lines.give_up(now, CloseCode::Leaving, "the server is not known here");
        self.trust.lost();
        listener.on_discarded(now);
        false
    }

    /// The server as the user writes it, with the address that it turned out to be.
    fn place(&self, address: SocketAddr) -> String {
        let address = address.to_string();
        if address == self.server { address } else { format!("{} ({address})", self.server) }
    }

    fn report_closed(&mut self, listener: &mut impl Listener, kind: CloseKind, reason: &str) {
        self.search.begin();
        self.naming.begin();
        let is_aside = self.search.is_trying_preferred && kind != CloseKind::IdentityChanged;
        if self.search.list.is_shown() || is_aside {
            return tracing::debug!("{}: {reason}", self.server); // something else is to be read
        }
        match kind {
            CloseKind::IdentityChanged => {
                self.search.is_shut_out = true;
                self.report(listener, Tone::Trouble, reason);
            }
            _ => self.report(listener, Tone::Trouble, &format!("{}: {reason}", self.status())),
        }
    }

    fn act_on(&mut self, intake: &mut Intake, notice: Notice, now: ClientTime) {
        let text = match notice {
            Notice::Welcome(_) => {
                if self.may_use(intake, now) {
                    self.welcomed(intake);
                }
                return;
            }
            Notice::PairingNeeded => {
                let random = shadecast_transport::random_bytes();
                let Some(trouble) = self.show_code(intake, &random, now) else { return };
                trouble
            }
            Notice::PairingAnswer { element, proof } => {
                return self.judge_code(intake, &Answer { element, proof }, now);
            }
            Notice::Refused(refused) => {
                let text = format!("{}: {}", refused.reason, refused.remedy);
                self.trust.refused(&text);
                text
            }
            Notice::ServerLeft => format!("{} ended the session", self.server),
            Notice::Failed(reason) => reason,
        };
        self.report(intake, Tone::Trouble, &text);
        self.flush(intake);
        self.lines.give_up(now, CloseCode::NotUnderstood, &text);
        self.trust.lost();
        intake.on_closed(now);
    }

    fn welcomed(&mut self, listener: &mut impl Listener) {
        self.lines.succeeded();
        self.search.finder = None;
        self.naming.resolver = None;
        self.notice = None;
        self.told.clear();
        self.report(listener, Tone::News, &format!("Connected to {}", self.server));
    }

    /// Says something in the headset, and on stderr once.
    fn report(&mut self, listener: &mut impl Listener, tone: Tone, text: &str) {
        listener.set_status(&for_headset(text));
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

    /// Tells the session that its connection brings something, if only acknowledgements.
    fn note_alive(&mut self, intake: &mut Intake, now: ClientTime) {
        let stats = self.lines.live().and_then(|(handle, peer)| handle.stats(peer));
        let received_bytes = stats.map_or(0, |stats| stats.received_bytes);
        if received_bytes != std::mem::replace(&mut self.received_bytes, received_bytes) {
            intake.note_alive(now);
        }
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
        self.seek(intake);
        let now = monotonic_now();
        self.note_alive(intake, now);
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
        let remedy = "--fingerprint names another server; a server prints its identity at its start";
        return pinned(fingerprint, remedy);
    }
    match (known.expected(server, address), announced) {
        (ExpectedIdentity::TrustOnFirstUse, Some(fingerprint)) => {
            pinned(fingerprint, "the answering server is not the announced one; name it with --connect")
        }
        (expected, _) => expected,
    }
}

#[cfg(test)]
mod tests;
