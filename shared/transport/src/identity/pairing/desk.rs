//! The server's half: whom it pairs with, one at a time.

use super::exchange::{Answered, Stream};
use super::lockout::{Closed, Lockout};
use super::{Answer, Code, Ends, PATIENCE_NS, PROOF_NS, Word, WrongCode};
use crate::arrivals::Network;
use crate::event::PeerId;
use crate::identity::Fingerprint;

/// A network that was turned away within this time goes before the one whose turn has just ended, nanoseconds.
const REMEMBERED_NS: i64 = 15_000_000_000;

/// Why a client cannot be paired now.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TurnedAway {
    /// Another one has its turn.
    #[error("another device is being paired")]
    Busy {
        /// Seconds until its turn is over at the latest.
        wait_s: u32,
    },
    /// After wrong codes.
    #[error(transparent)]
    Closed(#[from] Closed),
}

impl TurnedAway {
    /// Seconds after which it may be tried again.
    pub fn wait_s(self) -> u32 {
        match self {
            Self::Busy { wait_s } | Self::Closed(Closed { wait_s, .. }) => wait_s,
        }
    }
}

/// Why a typed code leads to nothing. It is not used up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TypingError {
    /// No client waits for a code.
    #[error("no device waits to be paired; connect one first: it shows a code")]
    Nobody,
    /// A code was typed for this client already.
    #[error("a code was typed already, and the device has yet to answer")]
    Typed,
}

/// The client said what it was not asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("a step of pairing comes out of turn")]
pub struct Unasked;

/// What a client's proof has shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Judgement {
    /// The client with this key shows the code that was typed.
    Paired(Fingerprint),
    /// It does not.
    Wrong(WrongCode),
}

/// Why a client's turn is over without a result.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Overdue {
    /// Nobody has typed a code.
    Untyped,
    /// A code was typed, and the client has proved nothing: that counts as a wrong one.
    Unproved,
}

enum Stage {
    /// The client is about to show a code.
    Asked,
    /// It shows one.
    Offered(Word),
    /// One was typed.
    Answered(Answered),
}

/// A client's turn.
struct Turn {
    peer: PeerId,
    network: Network,
    ends: Ends,
    until_ns: i64,
    stage: Stage,
}

/// See the module.
#[derive(Default)]
pub struct Desk {
    lockout: Lockout,
    turn: Option<Turn>,
    /// Who had the last turn and was not paired.
    last: Option<Network>,
    /// Who else was turned away, and when.
    turned_away: Option<(Network, i64)>,
}

impl Desk {
    /// Nobody is being paired.
    pub fn new() -> Self {
        Self::default()
    }

    /// Whose turn it is.
    pub fn turn(&self) -> Option<PeerId> {
        self.turn.as_ref().map(|turn| turn.peer)
    }

    /// A stranger wants to be paired.
    ///
    /// # Errors
    /// It is not its turn, or pairing is closed.
    pub fn begin(
        &mut self,
        peer: PeerId,
        network: Network,
        ends: Ends,
        now_ns: i64,
    ) -> Result<(), TurnedAway> {
        self.lockout.check(now_ns)?;
        let others = |&(other, at_ns): &(Network, i64)| other != network && now_ns - at_ns < REMEMBERED_NS;
        let busy_until_ns = match &self.turn {
            Some(turn) => Some(turn.until_ns),
            // Whoever keeps coming back leaves a gap for whoever else has asked.
            None if self.last == Some(network) => {
                self.turned_away.filter(others).map(|(_, at_ns)| at_ns + REMEMBERED_NS)
            }
            None => None,
        };
        if let Some(until_ns) = busy_until_ns {
            if self.turn.as_ref().is_some_and(|turn| turn.network != network) {
                self.turned_away = Some((network, now_ns));
            }
            let wait_s = ((until_ns - now_ns).max(0) / 1_000_000_000 + 1) as u32;
            return Err(TurnedAway::Busy { wait_s });
        }
        self.turned_away = None;
        let until_ns = now_ns + PATIENCE_NS;
        self.turn = Some(Turn { peer, network, ends, until_ns, stage: Stage::Asked });
        Ok(())
    }

    /// The client shows a code, and sends its part of the exchange.
    ///
    /// # Errors
    /// It is not its turn, or it has done so before.
    pub fn offered(&mut self, peer: PeerId, element: Word) -> Result<(), Unasked> {
        let turn = self.turn.as_mut().filter(|turn| turn.peer == peer).ok_or(Unasked)?;
        if !matches!(turn.stage, Stage::Asked) {
            return Err(Unasked);
        }
        turn.stage = Stage::Offered(element);
        Ok(())
    }

    /// A code was typed: what to send, and to whom.
    ///
    /// # Errors
    /// No client waits for one.
    pub fn typed(
        &mut self,
        code: Code,
        random: &[u8; 64],
        now_ns: i64,
    ) -> Result<(PeerId, Result<Answer, WrongCode>), TypingError> {
        let turn = self.turn.as_mut().ok_or(TypingError::Nobody)?;
        let element = match turn.stage {
            Stage::Asked => return Err(TypingError::Nobody),
            Stage::Offered(element) => element,
            Stage::Answered(_) => return Err(TypingError::Typed),
        };
        let peer = turn.peer;
        match Answered::new(code, turn.ends, element, &mut Stream::new(random)) {
            Ok((answered, answer)) => {
                turn.stage = Stage::Answered(answered);
                turn.until_ns = turn.until_ns.min(now_ns + PROOF_NS);
                Ok((peer, Ok(answer)))
            }
            Err(wrong) => {
                self.fail(now_ns);
                Ok((peer, Err(wrong)))
            }
        }
    }

    /// The client proves that it shows the typed code. Its turn is over.
    ///
    /// # Errors
    /// It is not its turn, or no code was typed. Its turn, where it had it, goes on.
    pub fn proved(&mut self, peer: PeerId, proof: &Word, now_ns: i64) -> Result<Judgement, Unasked> {
        let is_due = |turn: &mut Turn| turn.peer == peer && matches!(turn.stage, Stage::Answered(_));
        let turn = self.turn.take_if(is_due).ok_or(Unasked)?;
        let Turn { stage: Stage::Answered(answered), ends, network, .. } = turn else { return Err(Unasked) };
        match answered.finish(proof) {
            Ok(()) => {
                self.lockout.succeeded();
                self.last = None;
                Ok(Judgement::Paired(ends.client))
            }
            Err(wrong) => {
                self.last = Some(network);
                self.lockout.failed(now_ns);
                Ok(Judgement::Wrong(wrong))
            }
        }
    }

    /// The client says that another code was typed than it shows. Its turn is over.
    ///
    /// # Errors
    /// It is not its turn, or no code was typed. Its turn, where it had it, goes on.
    pub fn denied(&mut self, peer: PeerId, now_ns: i64) -> Result<(), Unasked> {
        let is_due = |turn: &Turn| turn.peer == peer && matches!(turn.stage, Stage::Answered(_));
        self.turn.as_ref().filter(|turn| is_due(turn)).ok_or(Unasked)?;
        self.fail(now_ns);
        Ok(())
    }

    /// A client has gone. Whoever goes after a code was typed has seen the answer: that counts as a wrong code.
    pub fn gone(&mut self, peer: PeerId, now_ns: i64) {
        if self.turn() == Some(peer) {
            self.end(now_ns);
        }
    }

    /// Whose time is over at `now_ns`, and why. Its turn is over.
    pub fn overdue(&mut self, now_ns: i64) -> Option<(PeerId, Overdue)> {
        let turn = self.turn.as_ref().filter(|turn| turn.until_ns <= now_ns)?;
        Some((turn.peer, self.end(now_ns)?))
    }

    fn end(&mut self, now_ns: i64) -> Option<Overdue> {
        let turn = self.turn.take()?;
        self.last = Some(turn.network);
        if !matches!(turn.stage, Stage::Answered(_)) {
            return Some(Overdue::Untyped);
        }
        self.lockout.failed(now_ns);
        Some(Overdue::Unproved)
    }

    fn fail(&mut self, now_ns: i64) {
        if let Some(turn) = self.turn.take() {
            self.last = Some(turn.network);
            self.lockout.failed(now_ns);
        }
    }
}
