//! Packets of a connection that leave twice, on a path that loses some, or three times where it loses many. Pure.
//!
//! A lost packet costs a round trip and more, whatever it held: deltas are taken in order, so all later updates wait for it. The same
//! packet lost again costs another. A copy that leaves a little later costs only bytes: QUIC drops the second of two equal packets, so
//! the receiver needs to know nothing of it, and both copies are lost as seldom as the square of one.
//!
//! Copies take only what the path carries beside the packets themselves, as far as the target tells ([`crate::congestion`]). They are
//! no part of the congestion window: originals that are lost count as lost while their copies are still on the way, so the share of lost
//! packets stays visible.

use std::collections::VecDeque;
use std::net::SocketAddr;

use crate::transmit::Transmit;

/// A copy leaves so long after its packet or the copy before, nanoseconds: losses come in bursts.
const DELAY_NS: i64 = 10_000_000;
/// What a lost packet held has lost a round trip already. So many packets for each that was lost have a second copy; a packet is rarely full.
const URGENT_PER_LOST: u64 = 2;
/// Packets leave twice while more than this part of them was lost of late,
const LOSSY: f64 = 0.004;
/// three times while more than this part was,
const VERY_LOSSY: f64 = 0.02;
/// and not because of one loss alone,
const LEAST_LOST: f64 = 1.5;
/// and for so long after the last loss, nanoseconds.
const LINGER_NS: i64 = 10_000_000_000;
/// The weight of a packet in these counts falls by a factor of e in this time, nanoseconds.
const MEMORY_NS: f64 = 2e9;
/// Packets and copies together take at most this part of the target. Where there is no room for all copies there are none: some
/// would delay packets and save few.
const OF_TARGET: f64 = 0.8;
/// What is left of the target may be saved up for this long, seconds: some updates are larger than others.
const SAVED_S: f64 = 0.2;
/// Bytes of copies that wait for their time.
const MAX_WAITING_BYTES: usize = 256 << 10;

/// See the module.
#[derive(Debug, Default)]
pub(crate) struct Repeats {
    /// In the order of their times.
    waiting: VecDeque<Again>,
    waiting_bytes: usize,
    /// The next so many packets hold what was lost.
    urgent: u64,
    loss: Loss,
    spare: Spare,
    /// Where the last packet went: what is known is of that path alone.
    to: Option<SocketAddr>,
    /// Bytes of all copies.
    repeated_bytes: u64,
}

/// Packets that leave once more.
#[derive(Debug)]
struct Again {
    at_ns: i64,
    transmit: Transmit,
    /// And once more after that.
    has_another: bool,
}

/// What the path loses.
#[derive(Clone, Copy, Debug, Default)]
struct Loss {
    at_ns: i64,
    /// Totals of the connection at that time.
    total_sent: u64,
    total_lost: u64,
    /// The same of late, by [`MEMORY_NS`].
    sent: f64,
    lost: f64,
    lossy_until_ns: Option<i64>,
}

/// What the path carries beside the packets.
#[derive(Clone, Copy, Debug, Default)]
struct Spare {
    at_ns: i64,
    bytes: f64,
    /// Bytes of packets of late, by [`MEMORY_NS`].
    sent: f64,
}

impl Loss {
    /// Gives how many packets more are lost.
    fn note(&mut self, now_ns: i64, total_sent: u64, total_lost: u64) -> u64 {
        let kept = (-((now_ns - self.at_ns).max(0) as f64) / MEMORY_NS).exp();
        let new_lost = total_lost.saturating_sub(self.total_lost);
        self.sent = self.sent * kept + total_sent.saturating_sub(self.total_sent) as f64;
        self.lost = self.lost * kept + new_lost as f64;
        (self.at_ns, self.total_sent, self.total_lost) = (now_ns, total_sent, total_lost);
        let is_much = self.lost >= LEAST_LOST && self.lost >= LOSSY * self.sent;
        let goes_on = new_lost > 0 && self.is_lossy(now_ns);
        if is_much || goes_on {
            self.lossy_until_ns = Some(now_ns + LINGER_NS);
        }
        new_lost
    }

    fn is_very_lossy(&self) -> bool {
        self.lost >= LEAST_LOST && self.lost >= VERY_LOSSY * self.sent
    }

    fn is_lossy(&self, now_ns: i64) -> bool {
        self.lossy_until_ns.is_some_and(|until_ns| now_ns < until_ns)
    }
}

impl Spare {
    /// Packets of so many bytes leave. How many copies of them may, `most` at most.
    fn take(&mut self, now_ns: i64, bytes: usize, target_bytes_s: f64, most: u8) -> u8 {
        let (elapsed_ns, rate) = ((now_ns - self.at_ns).max(0) as f64, OF_TARGET * target_bytes_s);
        let (bytes, most_saved) = (bytes as f64, SAVED_S * rate);
        self.at_ns = now_ns;
        self.sent = self.sent * (-elapsed_ns / MEMORY_NS).exp() + bytes;
        self.bytes = (self.bytes + elapsed_ns * 1e-9 * rate).min(most_saved) - bytes;
        let fit = |copies: f64| {
            (1.0 + copies) * self.sent <= rate * MEMORY_NS * 1e-9 && self.bytes >= copies * bytes
        };
        let copies = (1..=most).rev().find(|copies| fit(f64::from(*copies))).unwrap_or(0);
        self.bytes -= f64::from(copies) * bytes;
        // What is sent beyond the target is made up for within the same time.
        self.bytes = self.bytes.max(-most_saved);
        copies
    }
}

impl Repeats {
    /// The connection has sent and lost so many packets in all. Of a path to `to`; another one is judged anew.
    pub(crate) fn note(&mut self, now_ns: i64, to: SocketAddr, [total_sent, total_lost]: [u64; 2]) {
        if self.to.replace(to).is_some_and(|before| before != to) {
            let loss = Loss { at_ns: now_ns, total_sent, total_lost, ..Loss::default() };
            *self = Self { to: self.to, repeated_bytes: self.repeated_bytes, loss, ..Self::default() };
        }
        let lost = self.loss.note(now_ns, total_sent, total_lost);
        if lost > 0 {
            self.urgent = lost.saturating_mul(URGENT_PER_LOST);
        }
    }

    /// These packets leave now. The target is in bytes per second; without one there are no copies.
    pub(crate) fn sent(&mut self, now_ns: i64, transmit: &Transmit, target_bytes_s: Option<f64>) {
        let (bytes, packets) = (transmit.bytes.len(), transmit.datagrams().count() as u64);
        let is_urgent = self.urgent > 0;
        self.urgent = self.urgent.saturating_sub(packets);
        let most = if self.loss.is_very_lossy() { 2 } else { 1 };
        let copies = target_bytes_s.map_or(0, |target| self.spare.take(now_ns, bytes, target, most));
        if copies > 0 && self.loss.is_lossy(now_ns) && self.waiting_bytes + bytes <= MAX_WAITING_BYTES {
            let (at_ns, has_another) = (now_ns + DELAY_NS, is_urgent || copies > 1);
            self.wait(Again { at_ns, transmit: transmit.clone(), has_another });
        }
    }

    fn wait(&mut self, copy: Again) {
        self.waiting_bytes += copy.transmit.bytes.len();
        self.waiting.push_back(copy);
    }

    /// When the next copy leaves, nanoseconds.
    pub(crate) fn next_ns(&self) -> Option<i64> {
        self.waiting.front().map(|copy| copy.at_ns)
    }

    /// The next copy that leaves at `now_ns` or has to have left.
    pub(crate) fn take_due(&mut self, now_ns: i64) -> Option<Transmit> {
        let Again { transmit, has_another, .. } = self.waiting.pop_front_if(|copy| copy.at_ns <= now_ns)?;
        self.waiting_bytes -= transmit.bytes.len();
        self.repeated_bytes += transmit.bytes.len() as u64;
        if has_another {
            self.wait(Again { at_ns: now_ns + DELAY_NS, transmit: transmit.clone(), has_another: false });
        }
        Some(transmit)
    }

    /// Bytes of all copies so far.
    pub(crate) fn repeated_bytes(&self) -> u64 {
        self.repeated_bytes
    }
}

#[cfg(test)]
mod tests;
