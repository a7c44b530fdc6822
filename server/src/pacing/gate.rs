//! When the next update may be made, on a link that may be slower than the scene. Pure: what was sent, what the transport
//! knows and the time come in; decisions come out.
//!
//! A link that carries less than the scene needs gets fewer updates, each of them whole. What would wait before the link
//! is not made at all, since it would be old when it leaves.
//!
//! The gate measures a link while something waits for it. The transport's target cannot say that a link is slow: where little is sent, it is
//! what a first train told, and jitter of 5 ms makes that a tenth of 100 Mbit/s.

use crate::pacing::share::{Budget, Share, WayState};
use shadecast_protocol::ids::UpdateId;
use std::collections::VecDeque;

/// Updates that may wait for the link when another one is made, and for a link that is known to be slow.
const MAX_WAITING_UPDATES: usize = 2;
const MAX_WAITING_FOR_SLOW: usize = 1;
/// An update that has not arrived after two round trips and this, nanoseconds, waits: one loss and its repair take less.
const LATE_NS: i64 = 100_000_000;
/// The link is measured only over at least this long a time in which something waited for it, nanoseconds.
const MEASURE_NS: i64 = 300_000_000;
/// A measured rate counts for so long after something last waited, nanoseconds. Meanwhile the link is taken to carry so many times as much
/// with each second: where it does not, something waits again, and where it does, what is sent grows with it and not at once.
const RATE_LIFETIME_NS: i64 = 10_000_000_000;
const RATE_GROWTH: f64 = 1.25;
/// The person is told of a slow link at most this often, and when updates have been withheld for this long, nanoseconds: a
/// new connection on a long way needs some round trips until it is as fast as it can be.
const TELL_NS: i64 = 10_000_000_000;
const TELL_AFTER_NS: i64 = 2_000_000_000;
/// Updates that are withheld within this time belong together, nanoseconds.
const TOGETHER_NS: i64 = 1_000_000_000;
/// Weight of the newest update in what an update is taken to need.
const NEWEST: f64 = 0.25;
/// Longest time whose geometry one update is taken to bring, nanoseconds: after a longer pause it brings no more.
const LONGEST_COVERED_NS: i64 = 1_000_000_000;

/// Stands for what leaves after all updates, so that none waits for it.
pub(crate) const AFTER_ALL: UpdateId = UpdateId(u32::MAX);

/// What a stream holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A geometry delta.
    Delta,
    /// A picture.
    Picture,
    /// News of motion.
    Motion,
}

/// The link carries less than the scene needs, Mbit/s.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shortfall {
    /// What it carries.
    pub carries_mbit_s: f64,
    /// What updates at the wanted rate would take.
    pub needs_mbit_s: f64,
    /// Updates a second that are wanted.
    pub wanted_hz: f64,
    /// The quantiser of pictures, 0 to 51.
    pub qp: u8,
}

impl std::fmt::Display for Shortfall {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { carries_mbit_s, needs_mbit_s, wanted_hz, qp } = self;
        let shown_hz = wanted_hz * carries_mbit_s / needs_mbit_s;
        write!(
            f,
            "the link carries {carries_mbit_s:.1} of {needs_mbit_s:.1} Mbit/s that the scene needs: about {shown_hz:.0} of {wanted_hz:.0} updates a second are sent, at quantiser {qp} of 51"
        )
    }
}

/// Decides for one client when an update is made.
#[derive(Clone, Debug)]
pub(crate) struct UpdateGate {
    period_ns: i64,
    /// Not known to have arrived, in the order in which they leave.
    under_way: VecDeque<Sent>,
    /// Something has arrived whole.
    has_arrived: bool,
    /// Since when something waits for the link, and the bytes that have arrived since.
    waiting: Option<(i64, u64)>,
    /// The link's rate in bytes per second, and when something last waited for it.
    rate: Option<(f64, i64)>,
    needs: Needs,
    /// When updates began to be withheld, and the last one that was.
    withheld_ns: Option<[i64; 2]>,
    told_ns: Option<i64>,
}

#[derive(Clone, Copy, Debug)]
struct Sent {
    update: UpdateId,
    bytes: u64,
    at_ns: i64,
}

/// What updates at the wanted rate take, bytes per second; without the first one, which brings the scene.
#[derive(Clone, Copy, Debug, Default)]
struct Needs {
    geometry: Option<f64>,
    pictures: Option<f64>,
    last_delta_ns: i64,
}

/// What waits before the link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Waiting {
    updates: usize,
    bytes: u64,
}

impl UpdateGate {
    /// For updates that are wanted once in `period_ns`.
    pub(crate) fn new(period_ns: i64) -> Self {
        Self {
            period_ns: period_ns.max(1),
            under_way: VecDeque::new(),
            has_arrived: false,
            waiting: None,
            rate: None,
            needs: Needs::default(),
            withheld_ns: None,
            told_ns: None,
        }
    }

    /// A stream of an update was handed to the transport.
    pub(crate) fn sent(&mut self, update: UpdateId, kind: Kind, bytes: usize, now_ns: i64) {
        // An update's streams leave before those of later ones.
        let place = self.under_way.partition_point(|other| other.update <= update);
        self.under_way.insert(place, Sent { update, bytes: bytes as u64, at_ns: now_ns });
        self.needs.note(update, kind, bytes as f64, now_ns, self.period_ns);
    }

    /// The way carries something again after it carried nothing: the time between says nothing of its rate.
    pub(crate) fn resumed(&mut self) {
        self.waiting = None;
    }

    /// Whether an update may be made now.
    pub(crate) fn may_update(&mut self, way: &WayState, now_ns: i64) -> bool {
        self.observe(way, now_ns);
        let waiting = self.before_the_link(way, now_ns);
        let under_way: u64 = self.before_updates().map(|sent| sent.bytes).sum();
        let most_bytes = self.share(way, now_ns).most_under_way_bytes(way.round_trip_ns);
        let leaves_soon = most_bytes.is_none_or(|most| under_way as f64 <= most);
        let is_slow = self.rate_bytes_s(now_ns).is_some();
        let may_wait = if is_slow { MAX_WAITING_FOR_SLOW } else { MAX_WAITING_UPDATES };
        let may = waiting.updates <= may_wait && leaves_soon;
        if !may {
            let together = self.withheld_ns.filter(|[_, last_ns]| now_ns - last_ns <= TOGETHER_NS);
            self.withheld_ns = Some([together.map_or(now_ns, |[first_ns, _]| first_ns), now_ns]);
        }
        may
    }

    /// What the next update may take.
    pub(crate) fn budget(&self, way: &WayState, now_ns: i64) -> Budget {
        self.share(way, now_ns).budget(!self.has_arrived)
    }

    /// What the link gives.
    pub(crate) fn share(&self, way: &WayState, now_ns: i64) -> Share {
        Share::of(way, self.rate_bytes_s(now_ns))
    }

    /// What to tell the person, now and then, where updates are withheld; pictures have this quantiser.
    pub(crate) fn shortfall(&mut self, qp: u8, now_ns: i64) -> Option<Shortfall> {
        let carries = self.rate_bytes_s(now_ns)?;
        let needs = self.needs.geometry? + self.needs.pictures?;
        let [first_ns, last_ns] = self.withheld_ns?;
        let is_lasting = last_ns - first_ns >= TELL_AFTER_NS && now_ns - last_ns <= TOGETHER_NS;
        let is_due = self.told_ns.is_none_or(|told_ns| now_ns - told_ns >= TELL_NS);
        if !(is_lasting && is_due && needs > carries) {
            return None;
        }
        self.told_ns = Some(now_ns);
        let wanted_hz = 1e9 / self.period_ns as f64;
        Some(Shortfall { carries_mbit_s: carries * 8e-6, needs_mbit_s: needs * 8e-6, wanted_hz, qp })
    }

    /// What the link is taken to carry, bytes a second, where it was too slow a moment ago.
    pub(crate) fn rate_bytes_s(&self, now_ns: i64) -> Option<f64> {
        let (rate, at_ns) = self.rate.filter(|(_, at_ns)| now_ns - at_ns <= RATE_LIFETIME_NS)?;
        Some(rate * RATE_GROWTH.powf((now_ns - at_ns) as f64 * 1e-9))
    }

    /// Takes note of what has arrived, and measures the link while something waits for it.
    fn observe(&mut self, way: &WayState, now_ns: i64) {
        let arrived = self.under_way.len().saturating_sub(way.streams_under_way as usize);
        self.has_arrived |= arrived > 0;
        let bytes: u64 = self.under_way.drain(..arrived).map(|sent| sent.bytes).sum();
        if let Some((since_ns, so_far)) = &mut self.waiting {
            *so_far += bytes;
            let elapsed_ns = now_ns - *since_ns;
            if bytes > 0 && elapsed_ns >= MEASURE_NS {
                self.rate = Some((*so_far as f64 / (elapsed_ns as f64 * 1e-9), now_ns));
                if elapsed_ns >= 4 * MEASURE_NS {
                    (*since_ns, *so_far) = (now_ns, 0); // links change
                }
            }
        }
        match self.before_the_link(way, now_ns).bytes {
            0 => self.waiting = None,
            _ => drop(self.waiting.get_or_insert((now_ns, 0))),
        }
    }

    /// What updates have to wait for, in the order in which it leaves.
    fn before_updates(&self) -> impl Iterator<Item = &Sent> {
        self.under_way.iter().filter(|sent| sent.update != AFTER_ALL)
    }

    /// What does not fit into the window any more, the oldest being inside; all of it where the oldest is late.
    fn before_the_link(&self, way: &WayState, now_ns: i64) -> Waiting {
        let late_ns = LATE_NS + 2 * way.round_trip_ns;
        let is_late = self.before_updates().next().is_some_and(|oldest| now_ns - oldest.at_ns > late_ns);
        let window_bytes = if is_late { 0 } else { way.window_bytes };
        let (mut sum, mut updates, mut last) = (0, 0, None);
        for sent in self.before_updates() {
            sum += sent.bytes;
            if sum > window_bytes && last != Some(sent.update) {
                last = Some(sent.update);
                updates += 1;
            }
        }
        Waiting { updates, bytes: sum.saturating_sub(window_bytes) }
    }
}

impl Needs {
    fn note(&mut self, update: UpdateId, kind: Kind, bytes: f64, now_ns: i64, period_ns: i64) {
        let (mean, covered_ns) = match kind {
            // What comes once says nothing of what updates need.
            Kind::Motion => return,
            Kind::Picture => (&mut self.pictures, period_ns),
            Kind::Delta => {
                // After a pause a delta has what has come into view in all of it.
                let since_ns = now_ns - std::mem::replace(&mut self.last_delta_ns, now_ns);
                (&mut self.geometry, since_ns.clamp(period_ns, LONGEST_COVERED_NS.max(period_ns)))
            }
        };
        if update > UpdateId(0) {
            let newest = bytes / (covered_ns as f64 * 1e-9);
            *mean = Some(mean.map_or(newest, |mean| mean + NEWEST * (newest - mean)));
        }
    }
}

#[cfg(test)]
mod tests;
