//! Attacks on a server, one file each. Every attack is bounded in count and in time, and goes to an address of this machine
//! only.
//!
//! A target's address enters, and a time to end. Counts of connections and answers leave ([`Effort`]). Nothing here knows other
//! viewers and bars.

mod connects;
mod empty_messages;
mod flood;
mod garbage;
mod guesses;
mod half_open;
mod hellos;
mod holding;
mod reconnects;
mod small_messages;
mod streams;

use crate::hostile::lawful;
use crate::hostile::stranger::{Manners, Stranger};
use flood::{Flood, Kind};
use serde::Serialize;
use shadecast_protocol::message::{ClientHello, ClientMessage};
use shadecast_protocol::wire::frame_control;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Connections that one attack makes at most.
const MAX_CONNECTIONS: u64 = 20_000;
/// How long the answer to a hello is waited for.
const ANSWER_PATIENCE: Duration = Duration::from_millis(500);
/// How long an attacker waits for a handshake before it tries another.
const HANDSHAKE_PATIENCE: Duration = Duration::from_secs(2);
/// A refusal costs an attacker next to nothing: without a pause it would only measure how fast it can be refused.
pub(crate) const REFUSED_PAUSE: Duration = Duration::from_millis(5);

/// One way to be hostile.
#[derive(Clone, Copy, Debug)]
pub struct Attack {
    /// What it is called on the command line.
    pub name: &'static str,
    /// What it does.
    pub what: &'static str,
    /// Whether a lawful client that comes during the attack must be served: the attackers have no claim to the place.
    pub leaves_place: bool,
    /// Whether it takes all of one core of this machine, as [`CONTROL`] does.
    pub burns_core: bool,
    /// Whether the server asks strangers for a code, those of this machine too.
    pub asks_for_codes: bool,
    run: fn(&Target) -> anyhow::Result<Effort>,
}

/// What the others are compared with that take a core of this machine.
pub const CONTROL: &str = "to-nobody";

/// All of them.
pub const ATTACKS: &[Attack] = &[
    Attack {
        name: "hellos",
        what: "hellos and heads whose numbers cannot be served",
        leaves_place: false,
        burns_core: false,
        asks_for_codes: false,
        run: hellos::attack,
    },
    Attack {
        name: "empty-messages",
        what: "15 MB of empty control messages before any hello",
        leaves_place: true,
        burns_core: true,
        asks_for_codes: false,
        run: empty_messages::attack,
    },
    Attack {
        name: "small-messages",
        what: "control messages of a few bytes at full speed, instead of a hello",
        leaves_place: true,
        burns_core: true,
        asks_for_codes: false,
        run: small_messages::before_hello,
    },
    Attack {
        name: "small-messages-after-hello",
        what: "control messages of a few bytes at full speed, after a lawful hello",
        leaves_place: false,
        burns_core: true,
        asks_for_codes: false,
        run: small_messages::after_hello,
    },
    Attack {
        name: "holding",
        what: "connections without a hello that say one byte every 200 ms",
        leaves_place: true,
        burns_core: false,
        asks_for_codes: false,
        run: holding::attack,
    },
    Attack {
        name: "half-open",
        what: "200 handshakes a second that are never finished",
        leaves_place: true,
        burns_core: false,
        asks_for_codes: false,
        run: half_open::unproven,
    },
    Attack {
        name: "half-open-proven",
        what: "200 handshakes a second that prove their address and are never finished",
        leaves_place: false,
        burns_core: false,
        asks_for_codes: false,
        run: half_open::proven,
    },
    Attack {
        name: "reconnects",
        what: "lawful hellos on one connection after the other, each left at once",
        leaves_place: false,
        burns_core: true,
        asks_for_codes: false,
        run: reconnects::attack,
    },
    Attack {
        name: "streams",
        what: "256 large streams that a client has no business to send",
        leaves_place: false,
        burns_core: true,
        asks_for_codes: false,
        run: streams::attack,
    },
    Attack {
        name: "garbage",
        what: "datagrams that are no QUIC, or pretend to be",
        leaves_place: true,
        burns_core: false,
        asks_for_codes: false,
        run: garbage::attack,
    },
    Attack {
        name: CONTROL,
        what: "the control: datagrams at full speed to a socket that nobody reads",
        leaves_place: true,
        burns_core: true,
        asks_for_codes: false,
        run: flood::to_nobody,
    },
    Attack {
        name: "garbage-unpaced",
        what: "datagrams that are no QUIC, or pretend to be, at full speed",
        leaves_place: true,
        burns_core: true,
        asks_for_codes: false,
        run: garbage::unpaced,
    },
    Attack {
        name: "pings-slow",
        what: "201 pings a second on one connection, before any hello",
        leaves_place: true,
        burns_core: false,
        asks_for_codes: false,
        run: |target| flood::attack(target, &Flood { connections: 1, per_s: Some(201), ..PINGS }),
    },
    Attack {
        name: "pings",
        what: "pings at full speed on eight connections, before any hello",
        leaves_place: true,
        burns_core: true,
        asks_for_codes: false,
        run: |target| flood::attack(target, &PINGS),
    },
    Attack {
        name: "pings-greedy",
        what: "the same without regard to congestion",
        leaves_place: true,
        burns_core: true,
        asks_for_codes: false,
        run: |target| flood::attack(target, &Flood { manners: Manners::Greedy, ..PINGS }),
    },
    Attack {
        name: "junk-slow",
        what: "20 datagrams a second that cannot be decoded, on each of eight connections",
        leaves_place: true,
        burns_core: false,
        asks_for_codes: false,
        run: |target| flood::attack(target, &Flood { kind: Kind::Junk, per_s: Some(20), ..PINGS }),
    },
    Attack {
        name: "junk-greedy",
        what: "datagrams that cannot be decoded at full speed on eight connections, without regard to congestion",
        leaves_place: true,
        burns_core: true,
        asks_for_codes: false,
        run: |target| flood::attack(target, &Flood { kind: Kind::Junk, manners: Manners::Greedy, ..PINGS }),
    },
    Attack {
        name: "pings-after-hello",
        what: "pings at full speed without regard to congestion, after a lawful hello",
        leaves_place: false,
        burns_core: true,
        asks_for_codes: false,
        run: |target| {
            let kind = Kind::PingsAfterHello;
            flood::attack(target, &Flood { kind, connections: 1, manners: Manners::Greedy, ..PINGS })
        },
    },
    Attack {
        name: "connects",
        what: "1,000 handshakes a second, each left as soon as it is done",
        leaves_place: true,
        burns_core: true,
        asks_for_codes: false,
        run: connects::attack,
    },
    Attack {
        name: "guesses",
        what: "strangers that guess at codes, while codes are typed",
        leaves_place: true,
        burns_core: false,
        asks_for_codes: true,
        run: guesses::attack,
    },
];

/// Eight polite connections that know no pause.
const PINGS: Flood = Flood { kind: Kind::Pings, connections: 8, per_s: None, manners: Manners::Polite };

/// Whom to attack, and until when.
pub(crate) struct Target {
    pub(crate) server: SocketAddr,
    /// Folder of the server's identity.
    pub(crate) identity: PathBuf,
    pub(crate) until: Instant,
}

/// What an attacker did, and how it fared.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Effort {
    /// Connections begun.
    pub connections: u64,
    /// Connections whose handshake was done.
    pub established: u64,
    /// Connections on which the server said something on the control stream.
    pub answered: u64,
    /// Connections that the server ended.
    pub ended_by_server: u64,
    /// Bytes on streams and in datagrams that the server's flow control took.
    pub bytes: u64,
    /// Datagrams that are no part of a connection.
    pub datagrams: u64,
    /// Why the server ended the last connection.
    pub last_word: String,
}

impl Attack {
    /// Attacks until the target's time is over.
    pub(crate) fn run(&self, target: &Target) -> anyhow::Result<Effort> {
        (self.run)(target)
    }
}

impl Target {
    pub(crate) fn is_over(&self) -> bool {
        Instant::now() >= self.until
    }

    pub(crate) fn sleep(&self, wait: Duration) {
        std::thread::sleep(wait.min(self.until.saturating_duration_since(Instant::now())));
    }
}

impl Effort {
    fn note(&mut self, stranger: &Stranger) {
        self.established += u64::from(stranger.was_connected());
        self.answered += u64::from(!stranger.heard().is_empty());
        if let Some(reason) = stranger.ended() {
            self.ended_by_server += 1;
            reason.clone_into(&mut self.last_word);
        }
    }
}

/// Whether an attacker goes on with its connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Then {
    GoOn,
    /// Vanish without a word, and begin another.
    Leave,
}

/// Makes one connection after the other. `begin` gives, for each that stands, what is called between two turns of the
/// network for as long as it does; that says whether to go on, and how many bytes were taken.
fn one_after_the_other<Act>(target: &Target, mut begin: impl FnMut() -> Act) -> anyhow::Result<Effort>
where
    Act: FnMut(&mut Stranger) -> (Then, u64),
{
    let mut effort = Effort::default();
    while !target.is_over() && effort.connections < MAX_CONNECTIONS {
        let mut stranger = Stranger::connect(target.server)?;
        effort.connections += 1;
        let deadline = target.until.min(Instant::now() + HANDSHAKE_PATIENCE);
        stranger.pump_until(deadline, |it| it.is_connected() || it.ended().is_some())?;
        let mut act = begin();
        while stranger.is_connected() && !target.is_over() {
            let (then, bytes) = act(&mut stranger);
            effort.bytes += bytes;
            stranger.pump()?;
            if then == Then::Leave {
                break;
            }
        }
        effort.note(&stranger);
        if !stranger.was_connected() {
            target.sleep(REFUSED_PAUSE);
        }
    }
    Ok(effort)
}

/// A client's message as the bytes of the control stream.
pub(crate) fn control_bytes(message: &ClientMessage) -> Vec<u8> {
    frame_control(&message.encode())
}

/// A hello as the bytes of the control stream, lawful or not.
pub(crate) fn hello_bytes(change: impl FnOnce(&mut ClientHello)) -> Vec<u8> {
    let mut hello = lawful::hello();
    change(&mut hello);
    control_bytes(&ClientMessage::Hello(hello))
}

/// The same message again and again.
pub(crate) struct Repeated {
    unit: Vec<u8>,
    at: usize,
}

impl Repeated {
    pub(crate) fn new(message: &[u8]) -> Self {
        Self { unit: message.repeat((64 << 10) / message.len() + 1), at: 0 }
    }

    /// Writes as much as is taken at once, some 64 kB at most, and gives its size.
    pub(crate) fn write(&mut self, stranger: &mut Stranger) -> u64 {
        let taken = stranger.write_control(&self.unit[self.at..]);
        self.at = (self.at + taken) % self.unit.len();
        taken as u64
    }
}
