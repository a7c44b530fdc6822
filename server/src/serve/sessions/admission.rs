//! Who is let in, with which rights, and who is to be paired first. Without I/O and clocks: the list of paired devices is behind
//! [`Register`], and codes come as text from whoever reads them.

use shadecast_protocol::message::Refused;
use shadecast_transport::identity::Rights;
use shadecast_transport::identity::pairing::{
    Answer, Code, Desk, Ends, Judgement, Overdue, PATIENCE_NS, TurnedAway, Word, WrongCode,
};
use shadecast_transport::{Binding, Fingerprint, Network, PeerId};
use std::net::SocketAddr;

/// What the client is to do after a code was wrong or too late; it shows the new one by itself.
const NEW_CODE: &str = "type the new code that the headset shows";

/// Which clients a server serves.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Admit {
    /// Paired devices, and programs of this machine.
    #[default]
    Paired,
    /// Paired devices, and nobody else: programs of this machine are paired, too.
    PairedOnly,
    /// Whoever comes.
    Anyone,
}

/// The list of paired devices.
pub trait Register: Send {
    /// What the device with this key may do, if it was paired.
    fn rights(&mut self, fingerprint: Fingerprint) -> Option<Rights>;
    /// Keeps a device; gives its name.
    ///
    /// # Errors
    /// It cannot be kept; the text says why.
    fn keep(&mut self, fingerprint: Fingerprint) -> Result<String, String>;
}

/// Nobody was ever paired, and nobody can be.
struct Nobody;

impl Register for Nobody {
    fn rights(&mut self, _: Fingerprint) -> Option<Rights> {
        None
    }

    fn keep(&mut self, _: Fingerprint) -> Result<String, String> {
        Err("this server keeps no list of devices".to_owned())
    }
}

/// A connected client, as far as its admission is concerned.
#[derive(Clone, Copy, Debug)]
pub(super) struct Caller {
    pub(super) peer: PeerId,
    pub(super) remote: SocketAddr,
    pub(super) fingerprint: Option<Fingerprint>,
    pub(super) binding: Binding,
}

/// What became of a typed code or of a pairing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outcome {
    /// Whether a device is paired now.
    pub is_paired: bool,
    /// In words for whoever typed the code.
    pub text: String,
}

impl Outcome {
    fn failed(text: &str) -> Self {
        Self { is_paired: false, text: text.to_owned() }
    }
}

/// See the module.
pub struct Admission {
    admit: Admit,
    /// What those may do who come in without being known.
    strangers: Rights,
    own: Fingerprint,
    register: Box<dyn Register>,
    desk: Desk,
}

impl Admission {
    /// Everybody is admitted, and may do everything: for a server whose clients are all its own.
    pub(super) fn open() -> Self {
        let strangers = Rights::ALL;
        Self { strangers, ..Self::new(Admit::Anyone, Fingerprint([0; 32]), Box::new(Nobody)) }
    }

    /// A server whose own key is `own`.
    pub fn new(admit: Admit, own: Fingerprint, register: Box<dyn Register>) -> Self {
        Self { admit, strangers: Rights::LOOK, own, register, desk: Desk::new() }
    }

    /// What a client may do; `None` where it is to be paired first.
    pub(super) fn rights(&mut self, caller: &Caller) -> Option<Rights> {
        let is_local = caller.remote.ip().to_canonical().is_loopback();
        let known = caller.fingerprint.and_then(|fingerprint| self.register.rights(fingerprint));
        match self.admit {
            Admit::Paired | Admit::Anyone if is_local => Some(known.unwrap_or(Rights::ALL)),
            Admit::Anyone => Some(known.unwrap_or(self.strangers)),
            Admit::Paired | Admit::PairedOnly => known,
        }
    }

    /// A stranger is to show a code: for how long, milliseconds.
    pub(super) fn begin(&mut self, caller: &Caller, now_ns: i64) -> Result<u32, Refused> {
        let Some(client) = caller.fingerprint else {
            return Err(Refused::new("the client has shown no key", "update it to this server's version"));
        };
        let ends = Ends { client, server: self.own, binding: caller.binding };
        let network = Network::of(caller.remote.ip());
        match self.desk.begin(caller.peer, network, ends, now_ns) {
            Ok(()) => Ok((PATIENCE_NS / 1_000_000) as u32),
            Err(turned_away) => Err(refusal(turned_away)),
        }
    }

    /// Who is being paired.
    pub(super) fn pairing(&self) -> Option<PeerId> {
        self.desk.turn()
    }

    /// A client shows a code.
    pub(super) fn offered(&mut self, peer: PeerId, element: Word) {
        // The session lets no other step through.
        let _ = self.desk.offered(peer, element);
    }

    /// Somebody has typed something: what to send to whom, or why not.
    pub(super) fn typed(
        &mut self,
        text: &str,
        random: &[u8; 64],
        now_ns: i64,
    ) -> Result<(PeerId, Result<Answer, WrongCode>), Outcome> {
        let code: Code = text.parse().map_err(|error| Outcome::failed(&format!("{error}")))?;
        self.desk.typed(code, random, now_ns).map_err(|error| Outcome::failed(&error.to_string()))
    }

    /// A client has judged the typed code: by a proof, or by saying that it is wrong. What is to be said of it; `None` where
    /// nothing was asked.
    pub(super) fn judged(&mut self, peer: PeerId, proof: Option<&Word>, now_ns: i64) -> Option<Outcome> {
        let Some(proof) = proof else {
            return self.desk.denied(peer, now_ns).ok().map(|()| wrong());
        };
        let outcome = match self.desk.proved(peer, proof, now_ns).ok()? {
            Judgement::Wrong(_) => wrong(),
            Judgement::Paired(fingerprint) => match self.register.keep(fingerprint) {
                Ok(name) => Outcome { is_paired: true, text: format!("Paired with \"{name}\"") },
                Err(why) => Outcome::failed(&format!("the device cannot be kept: {why}")),
            },
        };
        Some(outcome)
    }

    /// Whose time is over, and what is to be said of it.
    pub(super) fn overdue(&mut self, now_ns: i64) -> Option<(PeerId, Outcome)> {
        let (peer, overdue) = self.desk.overdue(now_ns)?;
        let text = match overdue {
            Overdue::Untyped => format!("no code was typed within {} s", PATIENCE_NS / 1_000_000_000),
            Overdue::Unproved => "the device has not answered to the typed code".to_owned(),
        };
        Some((peer, Outcome::failed(&text)))
    }

    /// The client that is being paired has gone.
    pub(super) fn gone(&mut self, peer: PeerId, now_ns: i64) {
        self.desk.gone(peer, now_ns);
    }
}

/// What a client is told when nothing came of its pairing.
pub(super) fn told(outcome: &Outcome) -> Refused {
    Refused::new(&outcome.text, NEW_CODE)
}

/// A code that is not the one shown.
pub(super) fn wrong() -> Outcome {
    Outcome::failed(&WrongCode.to_string())
}

fn refusal(turned_away: TurnedAway) -> Refused {
    Refused::new(&turned_away.to_string(), &format!("try again in {} s", turned_away.wait_s()))
}
