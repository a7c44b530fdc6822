//! Floods of datagrams of one kind over several connections: slow ones and such as take all that this machine has, of senders that heed
//! congestion and of such that do not. And what costs this machine as much and the server nothing.

use super::{Effort, MAX_CONNECTIONS, REFUSED_PAUSE, Target, hello_bytes};
use crate::hostile::stranger::{Manners, Stranger};
use shadecast_protocol::message::ClientDatagram;
use shadecast_protocol::time::ClientTime;
use std::hint::black_box;
use std::net::UdpSocket;
use std::time::{Duration, Instant};

/// Datagrams of one connection before the next has its turn.
const BURST: u64 = 64;
/// From one turn of a slow flood to the next.
const TURN: Duration = Duration::from_millis(2);
/// A connection that does not stand after this long is given up.
const PATIENCE: Duration = Duration::from_secs(2);
/// A datagram that is none of the protocol's.
const JUNK: [u8; 1000] = [0xee; 1000];

/// What the datagrams are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// Pings before any hello.
    Pings,
    /// Pings after a lawful hello.
    PingsAfterHello,
    /// Bytes that cannot be decoded, before any hello.
    Junk,
}

/// A flood.
#[derive(Clone, Copy, Debug)]
pub(super) struct Flood {
    pub(super) kind: Kind,
    pub(super) connections: usize,
    /// Datagrams a second of each connection; `None`: as many as can be.
    pub(super) per_s: Option<u32>,
    pub(super) manners: Manners,
}

struct Flooder {
    stranger: Stranger,
    since: Instant,
    /// When it began to send.
    sending: Option<Instant>,
    sent: u64,
}

impl Flooder {
    fn begin(target: &Target, flood: &Flood) -> anyhow::Result<Self> {
        let stranger = Stranger::connect_with(target.server, flood.manners)?;
        Ok(Self { stranger, since: Instant::now(), sending: None, sent: 0 })
    }

    /// Sends what is due. Gives the bytes.
    fn send(&mut self, flood: &Flood) -> u64 {
        if !self.stranger.is_connected() {
            return 0;
        }
        if self.sending.is_none() && flood.kind == Kind::PingsAfterHello {
            self.stranger.write_control(&hello_bytes(|_| {}));
        }
        let elapsed = self.sending.get_or_insert_with(Instant::now).elapsed();
        let due = match flood.per_s {
            Some(per_s) => (elapsed.as_secs_f64() * f64::from(per_s)) as u64 - self.sent,
            None => BURST,
        };
        let bytes = (0..due.min(BURST)).map(|_| self.send_one(flood.kind)).sum();
        self.sent += due.min(BURST);
        bytes
    }

    fn send_one(&mut self, kind: Kind) -> u64 {
        let ping = || ClientDatagram::ClockPing { client_send: ClientTime(self.sent as i64) }.encode();
        let bytes = if kind == Kind::Junk { JUNK.to_vec() } else { ping() };
        if self.stranger.send_datagram(&bytes) { bytes.len() as u64 } else { 0 }
    }

    fn is_done(&self) -> bool {
        let is_late = !self.stranger.was_connected() && self.since.elapsed() > PATIENCE;
        self.stranger.ended().is_some() || is_late
    }
}

pub(super) fn attack(target: &Target, flood: &Flood) -> anyhow::Result<Effort> {
    let mut effort = Effort::default();
    let begin = || (0..flood.connections).map(|_| Flooder::begin(target, flood));
    let mut all = begin().collect::<anyhow::Result<Vec<_>>>()?;
    effort.connections += all.len() as u64;
    while !target.is_over() {
        for flooder in &mut all {
            effort.bytes += flooder.send(flood);
            flooder.stranger.pump()?;
            let is_rested = flooder.since.elapsed() > REFUSED_PAUSE;
            if flooder.is_done() && is_rested && effort.connections < MAX_CONNECTIONS {
                effort.note(&flooder.stranger);
                *flooder = Flooder::begin(target, flood)?;
                effort.connections += 1;
            }
        }
        if flood.per_s.is_some() {
            target.sleep(TURN);
        }
    }
    all.iter().for_each(|flooder| effort.note(&flooder.stranger));
    Ok(effort)
}

/// The control: sends as fast as it can to a socket of this machine that nobody reads.
pub(super) fn to_nobody(target: &Target) -> anyhow::Result<Effort> {
    let nobody = UdpSocket::bind("127.0.0.1:0")?;
    let socket = UdpSocket::bind("127.0.0.1:0")?;
    let to = nobody.local_addr()?;
    let mut effort = Effort::default();
    while !target.is_over() {
        let sent = socket.send_to(black_box(&JUNK), to);
        effort.datagrams += u64::from(sent.is_ok());
    }
    Ok(effort)
}
