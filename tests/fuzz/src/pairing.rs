//! Pairing: whatever strangers say, and whatever is typed, and whenever.

use crate::script::{number, steps};
use shadecast_transport::identity::pairing::{
    Answer, Code, Desk, Ends, Judgement, PATIENCE_NS, Panel, TurnedAway, Word,
};
use shadecast_transport::{Binding, Fingerprint, Network, PeerId};

/// A stranger comes; the first byte says from which network.
pub const BEGIN: u8 = 0;
/// It says that it shows a code, with these bytes as its element.
pub const OFFER: u8 = 1;
/// A headset shows a code, of these random bytes, and says so.
pub const SHOW: u8 = 2;
/// This text is typed.
pub const TYPE: u8 = 3;
/// The shown code is typed.
pub const TYPE_SHOWN: u8 = 4;
/// The stranger sends these bytes as its proof.
pub const PROVE: u8 = 5;
/// The headset judges the server's answer.
pub const JUDGE: u8 = 6;
/// The stranger says that the code is wrong, or leaves; the first byte says which.
pub const GIVE_UP: u8 = 7;
/// Time passes: milliseconds, at most two hours.
pub const WAIT: u8 = 8;

const ENDS: Ends =
    Ends { client: Fingerprint([1; 32]), server: Fingerprint([2; 32]), binding: Binding([3; 32]) };

/// The number of devices that were paired.
pub fn check(script: &[u8]) -> usize {
    let mut run = Run::default();
    for step in steps(script) {
        run.step(step.operation, step.bytes);
        run.settle();
    }
    run.paired
}

#[derive(Default)]
struct Run {
    desk: Desk,
    panel: Panel,
    now_ns: i64,
    peer: PeerId,
    /// What the headset shows in this turn, and what the server has answered to it.
    shown: Option<Code>,
    answer: Option<Answer>,
    paired: usize,
}

fn bytes<const N: usize>(from: &[u8]) -> [u8; N] {
    std::array::from_fn(|at| from.get(at).copied().unwrap_or(0))
}

impl Run {
    fn step(&mut self, operation: u8, data: &[u8]) {
        let (peer, now_ns, word) = (self.peer, self.now_ns, bytes::<32>(data));
        match operation {
            BEGIN => self.begin(word[0]),
            OFFER => _ = self.desk.offered(peer, word),
            SHOW => self.show(&bytes(data)),
            TYPE => {
                let code = String::from_utf8_lossy(data).parse::<Code>();
                code.into_iter().for_each(|code| self.type_code(code));
            }
            TYPE_SHOWN => self.shown.into_iter().for_each(|code| self.type_code(code)),
            PROVE => {
                let judged = self.desk.proved(peer, &word, now_ns);
                assert!(!matches!(judged, Ok(Judgement::Paired(_))), "bytes of a stranger are a proof");
            }
            JUDGE => self.judge(),
            GIVE_UP if word[0].is_multiple_of(2) => _ = self.desk.denied(peer, now_ns),
            GIVE_UP => self.desk.gone(peer, now_ns),
            _ => self.now_ns += (number(data) % 7_200_000) as i64 * 1_000_000,
        }
    }

    fn begin(&mut self, network: u8) {
        let (before, stranger) = (self.desk.turn(), PeerId(self.peer.0 + 1));
        match self.desk.begin(stranger, Network::V4([10, 0, network % 2]), ENDS, self.now_ns) {
            Ok(()) => {
                assert_eq!(before, None, "one at a time");
                self.peer = stranger;
            }
            Err(TurnedAway::Busy { wait_s }) => {
                assert!((1..=61).contains(&wait_s), "{wait_s}");
                assert_eq!(self.desk.turn(), before);
            }
            Err(TurnedAway::Closed(closed)) => {
                assert!((1..=3600).contains(&closed.wait_s) && closed.failures > 2, "{closed:?}");
            }
        }
    }

    fn show(&mut self, random: &[u8; 64]) {
        (self.shown, self.answer) = (None, None);
        let Ok((code, element)) = self.panel.begin(ENDS, random, self.now_ns) else { return };
        match self.desk.offered(self.peer, element) {
            Ok(()) => self.shown = Some(code),
            Err(_) => self.panel.clear(),
        }
    }

    fn type_code(&mut self, code: Code) {
        if let Ok((peer, answer)) = self.desk.typed(code, &[9; 64], self.now_ns) {
            assert_eq!(peer, self.peer);
            self.answer = answer.ok().filter(|_| self.shown == Some(code));
        }
    }

    /// The headset and the server have the same code, on the same connection.
    fn judge(&mut self) {
        let Some(answer) = self.answer.take() else { return };
        let proof: Word = self.panel.answered(&answer, self.now_ns).expect("the code is the shown one");
        let judged = self.desk.proved(self.peer, &proof, self.now_ns);
        assert_eq!(judged, Ok(Judgement::Paired(ENDS.client)));
        self.paired += 1;
    }

    fn settle(&mut self) {
        while let Some((peer, _)) = self.desk.overdue(self.now_ns) {
            assert_eq!(peer, self.peer);
        }
        assert_eq!(self.desk.overdue(self.now_ns.saturating_sub(PATIENCE_NS)), None);
        if self.desk.turn().is_none() {
            (self.shown, self.answer) = (None, None);
            self.panel.clear();
        }
    }
}
