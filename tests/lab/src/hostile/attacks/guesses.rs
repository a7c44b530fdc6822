//! A stranger that guesses at codes: it says hello, claims to show a code of its own, and hopes that just this one is typed. Somebody at
//! the server types codes meanwhile, one after the other, as fast as the server takes them: more than any person would.

use super::{Effort, REFUSED_PAUSE, Target};
use crate::hostile::lawful;
use anyhow::{Context, ensure};
use shadecast_protocol::message::{ClientMessage, ServerMessage};
use shadecast_protocol::pairing::{ClientPairing, ServerPairing};
use shadecast_server::serve::stream::pair;
use shadecast_system::monotonic_now_ns;
use shadecast_transport::identity::KnownDevices;
use shadecast_transport::identity::pairing::{Answer, Ends, FREE_FAILURES, Panel};
use shadecast_transport::{
    ClientIdentity, Driver, Endpoint, EndpointConfig, Event, Events, ExpectedIdentity, Handle, PeerId,
    random_bytes, spawn,
};
use std::net::{Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// What is typed.
const TYPED: &str = "123456";
const LOOK_UP: Duration = Duration::from_millis(20);
/// How long the first guess is waited for, however short the attack is.
const PATIENCE: Duration = Duration::from_secs(20);

/// Whether the attack goes on: without a guess it would show nothing.
struct Course<'a> {
    target: &'a Target,
    begun: Instant,
    has_guessed: AtomicBool,
}

impl Course<'_> {
    fn is_over(&self) -> bool {
        let waits = !self.has_guessed.load(Ordering::Relaxed) && self.begun.elapsed() < PATIENCE;
        self.target.is_over() && !waits
    }
}

pub(super) fn attack(target: &Target) -> anyhow::Result<Effort> {
    let course = Course { target, begun: Instant::now(), has_guessed: AtomicBool::new(false) };
    let devices = || anyhow::Ok(KnownDevices::load(&target.identity)?.iter().count());
    let before = devices()?;
    let effort = std::thread::scope(|scope| {
        let typist = scope.spawn(|| {
            while !course.is_over() {
                // Nearly all are wrong, or come while nobody waits.
                let _ = pair(&target.identity, TYPED);
            }
        });
        let guessed = Guesser::start().and_then(|guesser| guesser.guess(&course));
        typist.join().map_err(|_| anyhow::anyhow!("the typist panicked"))?;
        guessed
    })?;
    // One in a million each.
    ensure!(devices()? == before, "a guess was right, or was taken for right");
    let most = u64::from(FREE_FAILURES) + 1;
    ensure!(effort.answered <= most, "{} guesses were answered, and {most} may be", effort.answered);
    ensure!(effort.answered > 0, "no guess was answered: {}", effort.last_word);
    Ok(effort)
}

/// One stranger, whose key stays the same.
struct Guesser {
    own: Arc<ClientIdentity>,
    handle: Handle,
    events: Events,
    effort: Effort,
}

impl Guesser {
    fn start() -> anyhow::Result<Self> {
        let own = Arc::new(ClientIdentity::generate()?);
        let endpoint = Endpoint::client_as(own.clone(), EndpointConfig::default());
        let driver = Driver::bind(endpoint, SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))?;
        let (handle, events) = spawn(driver)?;
        Ok(Self { own, handle, events, effort: Effort::default() })
    }

    fn guess(mut self, course: &Course<'_>) -> anyhow::Result<Effort> {
        while !course.is_over() {
            let peer = self.handle.connect(course.target.server, ExpectedIdentity::TrustOnFirstUse)?;
            self.effort.connections += 1;
            self.attempt(course, peer)?;
            course.has_guessed.fetch_or(self.effort.answered > 0, Ordering::Relaxed);
            std::thread::sleep(REFUSED_PAUSE);
        }
        Ok(self.effort)
    }

    /// One connection, until its end.
    fn attempt(&mut self, course: &Course<'_>, peer: PeerId) -> anyhow::Result<()> {
        let (mut panel, mut ends) = (Panel::new(), None);
        while !course.is_over() {
            match self.events.next_timeout(LOOK_UP).context("guessing")? {
                Some(Event::Connected { peer: at, fingerprint: Some(server), binding, .. }) if at == peer => {
                    self.effort.established += 1;
                    ends = Some(Ends { client: self.own.fingerprint(), server, binding });
                    self.say(peer, &ClientMessage::Hello(lawful::hello()))?;
                }
                Some(Event::Control { peer: at, message, .. }) if at == peer => {
                    self.answer(peer, &message, &mut panel, ends)?;
                }
                Some(Event::Closed { peer: at, reason, .. }) if at == peer => {
                    self.effort.ended_by_server += 1;
                    self.effort.last_word = reason;
                    return Ok(());
                }
                _ => {}
            }
        }
        Ok(())
    }

    fn answer(
        &mut self,
        peer: PeerId,
        message: &[u8],
        panel: &mut Panel,
        ends: Option<Ends>,
    ) -> anyhow::Result<()> {
        match ServerMessage::decode(message)? {
            ServerMessage::Welcome(_) => anyhow::bail!("a stranger that guesses is welcomed"),
            ServerMessage::Refused(refused) => self.effort.last_word = refused.reason,
            ServerMessage::Pairing(ServerPairing::Needed { .. }) => {
                let ends = ends.context("a question before the connection")?;
                let (_, element) = panel.begin(ends, &random_bytes(), monotonic_now_ns())?;
                self.say(peer, &ClientMessage::Pairing(ClientPairing::Offer { element }))?;
            }
            ServerMessage::Pairing(ServerPairing::Answer { element, proof }) => {
                self.effort.answered += 1;
                // It would not say that it has failed, but try to be taken for right.
                let proof = panel.answered(&Answer { element, proof }, monotonic_now_ns()).unwrap_or(proof);
                self.say(peer, &ClientMessage::Pairing(ClientPairing::Proof { proof }))?;
            }
            ServerMessage::Goodbye | ServerMessage::Padding(_) => {}
        }
        Ok(())
    }

    fn say(&mut self, peer: PeerId, message: &ClientMessage) -> anyhow::Result<()> {
        let bytes = message.encode();
        self.effort.bytes += bytes.len() as u64;
        // A connection that has ended is noticed by its event.
        let _ = self.handle.send_control(peer, bytes);
        Ok(())
    }
}
