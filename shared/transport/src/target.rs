//! How fast the application should send: less than the path carries, so that no queue stands before the bottleneck. Pure.
//!
//! A congestion window bounds what is under way; it does not tell an encoder what to make. The target does, in the manner of SCReAM
//! (RFC 8298) and BBR: round trips tell the rate at which bytes arrive and the shortest wait of their packets. A burst's own packets wait for
//! each other, a standing queue keeps all of them waiting. While the target is used and nothing waits, it grows: content is the probe. A
//! standing queue, much loss or a router's mark take it below what arrives.

use std::time::{Duration, Instant};

/// Of what arrives while a queue stands, the target takes this part.
const OF_DELIVERED: f64 = 0.85;
/// A queue that stands longer than this is too long, s; over radio by so many times more as the wait usually varies, and at most so long.
const LONG_QUEUE_S: f64 = 0.025;
const VARIATIONS: f64 = 2.5;
const LONGEST_QUEUE_S: f64 = 0.05;
/// A full congestion window lets a queue grow to about a round trip and no further: this part of one is then too long.
const OF_ROUND_TRIP: f64 = 0.5;
/// Weight of the newest wait in what is usual.
const NEWEST: f64 = 0.125;
/// A queue that is longer by this halves what is left: it must drain first. It is never less than half.
const HALVING_QUEUE_S: f64 = 0.15;
/// The target falls to no less than this part of itself at once.
const LEAST_PART: f64 = 0.2;
/// What arrives is measured over at least this long: several pictures.
const WINDOW: Duration = Duration::from_millis(100);
/// Less of the target than this, and what arrives says only what was sent.
const USED: f64 = 0.7;
/// Until the first queue the target doubles in this time.
const DOUBLED_AT_FIRST: Duration = Duration::from_millis(500);
/// Near what arrived while a queue stood, it grows by a quarter in this time,
const QUARTER_MORE: Duration = Duration::from_millis(1500);
const NEAR: std::ops::RangeInclusive<f64> = 0.8..=1.1;
/// and beyond that, where the path has become faster, it doubles in this time.
const DOUBLED: Duration = Duration::from_millis(1000);
/// The target never falls below this, bytes per second: a head pose's answer and a coarse picture now and then.
const LEAST_BYTES_S: f64 = 25_000.0;
/// A train that arrives as fast as this is spread by jitter as much as by the bottleneck; then the target begins with no less than the
/// usual rate of a stream, bytes per second.
const FAST_TRAIN_BYTES_S: f64 = 1.25e6;
const FAST_BYTES_S: f64 = 2.5e6;

/// What one round trip has shown.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RoundTrip {
    /// When it ended.
    pub(crate) end: Instant,
    /// What arrived meanwhile, bytes.
    pub(crate) delivered_bytes: u64,
    /// How long the packet that waited least had to wait.
    pub(crate) queue: Duration,
    /// A round trip without a queue.
    pub(crate) path: Duration,
    /// The congestion window was full.
    pub(crate) is_full: bool,
    /// More was lost than a radio link loses, or a router has marked a packet.
    pub(crate) is_congested: bool,
}

/// The target of one path.
#[derive(Clone, Debug, Default)]
pub(crate) struct Target {
    bytes_s: Option<f64>,
    window: Option<Window>,
    /// What arrived when a queue last stood, bytes per second.
    found_bytes_s: Option<f64>,
    usual: Usual,
    queue: Duration,
}

/// How long packets usually wait, and how much that varies, seconds.
#[derive(Clone, Copy, Debug, Default)]
struct Usual {
    wait_s: f64,
    variation_s: f64,
}

impl Usual {
    /// The wait from which on a queue is too long, s.
    fn long_s(self) -> f64 {
        (LONG_QUEUE_S + VARIATIONS * self.variation_s).min(LONGEST_QUEUE_S)
    }

    fn note(&mut self, wait_s: f64) {
        self.variation_s += NEWEST * ((wait_s - self.wait_s).abs().min(LONG_QUEUE_S) - self.variation_s);
        self.wait_s += NEWEST * (wait_s - self.wait_s);
    }
}

/// What is measured at present.
#[derive(Clone, Copy, Debug)]
struct Window {
    begin: Instant,
    delivered_bytes: u64,
    queue: Duration,
    /// In each of its round trips.
    is_full: bool,
    is_congested: bool,
}

impl Window {
    fn at(begin: Instant) -> Self {
        Self { begin, delivered_bytes: 0, queue: Duration::MAX, is_full: true, is_congested: false }
    }
}

impl Target {
    /// Bytes per second; `None` before anything is known.
    pub(crate) fn bytes_s(&self) -> Option<f64> {
        self.bytes_s
    }

    /// The queue that was measured last.
    pub(crate) fn queue(&self) -> Duration {
        self.queue
    }

    /// A train says what the path carries, bytes per second: where the target begins.
    pub(crate) fn begin(&mut self, train_bytes_s: f64) {
        let least = if train_bytes_s >= FAST_TRAIN_BYTES_S { FAST_BYTES_S } else { LEAST_BYTES_S };
        self.bytes_s.get_or_insert((OF_DELIVERED * train_bytes_s).max(least));
    }

    /// A round trip has ended.
    pub(crate) fn note(&mut self, round: RoundTrip) {
        let Some(window) = &mut self.window else {
            self.window = Some(Window::at(round.end));
            return;
        };
        window.delivered_bytes += round.delivered_bytes;
        window.queue = window.queue.min(round.queue);
        window.is_full &= round.is_full;
        window.is_congested |= round.is_congested;
        let elapsed = round.end.saturating_duration_since(window.begin);
        if elapsed < WINDOW {
            return;
        }
        let (seen, delivered_bytes_s) = (*window, window.delivered_bytes as f64 / elapsed.as_secs_f64());
        self.window = Some(Window::at(round.end));
        let target = self.bytes_s.unwrap_or(FAST_BYTES_S);
        let most_s = if seen.is_full { OF_ROUND_TRIP * round.path.as_secs_f64() } else { f64::MAX };
        let over_s = seen.queue.as_secs_f64() - self.usual.long_s().min(most_s);
        self.usual.note(seen.queue.as_secs_f64());
        self.queue = seen.queue;
        let next = if over_s > 0.0 || seen.is_congested {
            self.found_bytes_s = Some(delivered_bytes_s);
            let halved = 0.5_f64.powf((over_s / HALVING_QUEUE_S).clamp(0.0, 1.0));
            let fallen = OF_DELIVERED * delivered_bytes_s * halved;
            fallen.clamp(LEAST_PART * target, target)
        } else if delivered_bytes_s >= USED * target {
            (target * self.growth(target, elapsed)).max(delivered_bytes_s)
        } else {
            // What little was sent says nothing.
            return;
        };
        self.bytes_s = Some(next.max(LEAST_BYTES_S));
    }

    /// How many times as much the target may be after `elapsed` more.
    fn growth(&self, target: f64, elapsed: Duration) -> f64 {
        let parts = |of: Duration| elapsed.as_secs_f64() / of.as_secs_f64();
        match self.found_bytes_s {
            None => 2_f64.powf(parts(DOUBLED_AT_FIRST)),
            Some(found) if NEAR.contains(&(target / found)) => 1.25_f64.powf(parts(QUARTER_MORE)),
            Some(_) => 2_f64.powf(parts(DOUBLED)),
        }
    }
}

#[cfg(test)]
mod tests;
