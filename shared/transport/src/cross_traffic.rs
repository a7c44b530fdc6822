//! Cross traffic that fills the router's queue, as a download with Cubic does, and a window that competes with it.
//!
//! A target that avoids queues leaves all to a neighbour that keeps one. Such a neighbour shows by a queue that stands although the
//! application follows a falling target: whatever one leaves the other takes. Then the window is that of a Cubic (RFC 9438), which shares as
//! downloads share with each other, and the queue is accepted. Copa's competitive mode (Arun and Balakrishnan, 2018) and Nimbus (Goyal et
//! al., 2018) do alike.
//!
//! Every [`LOOKS`] the window is halved for three round trips. A round trip's own part of the queue halves too, so it tells whose queue it is.
//! A flow that is alone avoids queues again. Two that compete with each other would never be alone. So each stops after [`LONGEST`] in any
//! case, and the other's look then finds itself alone.

use std::sync::Arc;
use std::time::{Duration, Instant};

use quinn_proto::RttEstimator;
use quinn_proto::congestion::{Controller, Cubic, CubicConfig};

/// Flows that avoid queues keep shorter ones than this.
const LONG_QUEUE: Duration = Duration::from_millis(75);
/// A queue that has stood for so long is another's, if the target was followed meanwhile. Else it may be the application's own.
const STANDS: Duration = Duration::from_secs(2);
/// The target is followed where no more than this part of it is sent in so long.
const FOLLOWED_PART: f64 = 1.1;
const PERIOD: Duration = Duration::from_millis(500);
/// Beside that it may send so much: motion and acknowledgements know no target, bytes per second.
const BESIDE_BYTES_S: f64 = 8_000.0;
/// A queue that has stood for so long may be another's. Later a path that has become longer is as likely.
const SUSPECTED: std::ops::Range<Duration> = Duration::from_secs(1)..Duration::from_secs(12);
/// From one look to the next, and until queues are avoided again in any case.
const LOOKS: Duration = Duration::from_secs(8);
const LONGEST: Duration = Duration::from_secs(40);
/// So many looks in a row must find the flow alone, the second so soon after the first: the other may just have halved its window.
const LOOKS_ALONE: u32 = 2;
const SECOND_LOOK: Duration = Duration::from_secs(1);
/// Competing again so soon after begins with half of the window of before.
const REMEMBERED: Duration = Duration::from_secs(10);
/// A flow is alone where no more than this part of the queue is another's: jitter, or a path that has become longer.
const ALONE_PART: f64 = 0.2;

/// Whether another flow fills the queue, and the window that competes with it.
#[derive(Clone, Debug, Default)]
pub(crate) struct CrossTraffic {
    stands: Option<Stands>,
    competing: Option<Competing>,
    /// When it last avoided queues again, and the window of before, bytes.
    left: Option<(Instant, u64)>,
}

/// A queue that stands.
#[derive(Clone, Copy, Debug)]
struct Stands {
    since: Instant,
    /// When the present [`PERIOD`] began, and what had been sent by then, bytes.
    period: Instant,
    sent_bytes: u64,
    /// What the application may have sent since, bytes.
    allowed_bytes: f64,
    /// The last round trip's end, and its target.
    noted: Instant,
    target_bytes_s: f64,
}

impl Stands {
    fn begin(now: Instant, seen: Seen) -> Self {
        let (sent_bytes, target_bytes_s) = (seen.sent_bytes, seen.target_bytes_s);
        Self { since: now, period: now, sent_bytes, allowed_bytes: 0.0, noted: now, target_bytes_s }
    }

    /// Whether a period has ended in which the application followed the target.
    fn note(&mut self, now: Instant, seen: Seen) -> bool {
        // What falls is followed a round trip later.
        let last_bytes_s = std::mem::replace(&mut self.target_bytes_s, seen.target_bytes_s);
        let elapsed = now.saturating_duration_since(std::mem::replace(&mut self.noted, now));
        let allowed_bytes_s = FOLLOWED_PART * seen.target_bytes_s.max(last_bytes_s) + BESIDE_BYTES_S;
        self.allowed_bytes += allowed_bytes_s * elapsed.as_secs_f64();
        if now.saturating_duration_since(self.period) < PERIOD {
            return false;
        }
        let is_followed = (seen.sent_bytes - self.sent_bytes) as f64 <= self.allowed_bytes;
        (self.period, self.sent_bytes, self.allowed_bytes) = (now, seen.sent_bytes, 0.0);
        is_followed
    }
}

/// What a round trip has shown, at its end.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen {
    /// How long the packet that waited least had to wait.
    pub(crate) queue: Duration,
    /// Bytes that were sent so far, of all round trips.
    pub(crate) sent_bytes: u64,
    /// Under way now, bytes.
    pub(crate) in_flight_bytes: u64,
    /// What avoids a queue, bytes per second.
    pub(crate) target_bytes_s: f64,
    /// Bytes of a packet, and of the smallest window.
    pub(crate) mtu: u64,
    pub(crate) min_window_bytes: u64,
}

#[derive(Clone, Debug)]
struct Competing {
    cubic: Cubic,
    since: Instant,
    next_look: Instant,
    /// Looks in a row that found nobody.
    looks_alone: u32,
}

impl CrossTraffic {
    /// Most bytes under way while competing; `None` where no other flow fills the queue.
    pub(crate) fn window_bytes(&self) -> Option<u64> {
        self.competing.as_ref().map(|competing| competing.cubic.window())
    }

    /// Whether a queue stands that may be another's. The round trip without it cannot be measured meanwhile.
    pub(crate) fn is_suspected(&self, now: Instant) -> bool {
        let has_stood = |stands: &Stands| SUSPECTED.contains(&now.saturating_duration_since(stands.since));
        self.stands.as_ref().is_some_and(has_stood) || self.competing.is_some()
    }

    /// A round trip has ended.
    pub(crate) fn note_round(&mut self, now: Instant, seen: Seen) {
        if seen.queue < LONG_QUEUE || self.competing.is_some() {
            self.stands = None;
            return;
        }
        let stands = self.stands.get_or_insert_with(|| Stands::begin(now, seen));
        let is_followed = stands.note(now, seen);
        if is_followed && now.saturating_duration_since(stands.since) >= STANDS {
            let was_away = |(left, _): &(Instant, u64)| now.saturating_duration_since(*left) < REMEMBERED;
            let remembered_bytes = self.left.filter(was_away).map_or(0, |(_, window)| window / 2);
            let least_bytes = seen.in_flight_bytes.max(seen.min_window_bytes);
            let mut config = CubicConfig::default();
            config.initial_window(least_bytes.max(remembered_bytes));
            let cubic = Cubic::new(Arc::new(config), now, u16::try_from(seen.mtu).unwrap_or(u16::MAX));
            let competing = Competing { cubic, since: now, next_look: now + LOOKS, looks_alone: 0 };
            *self = Self { stands: None, competing: Some(competing), left: None };
        }
    }

    /// Packets have arrived, of which so many bytes were under way before.
    pub(crate) fn on_ack(
        &mut self,
        now: Instant,
        sent: Instant,
        bytes: u64,
        in_flight_bytes: u64,
        rtt: &RttEstimator,
    ) {
        let Some(Competing { cubic, .. }) = &mut self.competing else { return };
        // Pictures come in bursts: a window that is filled by half is used.
        let is_unused = in_flight_bytes < cubic.window() / 2;
        cubic.on_ack(now, sent, bytes, is_unused, rtt);
    }

    pub(crate) fn on_congestion_event(
        &mut self,
        now: Instant,
        sent: Instant,
        is_persistent: bool,
        lost: u64,
    ) {
        if let Some(Competing { cubic, .. }) = &mut self.competing {
            cubic.on_congestion_event(now, sent, is_persistent, lost);
        }
    }

    /// Whether it is time to look whose queue it is.
    pub(crate) fn is_look_due(&self, now: Instant) -> bool {
        self.competing.as_ref().is_some_and(|competing| now >= competing.next_look)
    }

    /// A look has ended: of a round trip of `before`, which takes `path` without a queue, all but `without_own` was one's own queue.
    /// Gives a round trip without a queue, as far as it is known now, where queues are avoided again.
    pub(crate) fn end_look(
        &mut self,
        now: Instant,
        without_own: Duration,
        path: Duration,
        before: Duration,
    ) -> Option<Duration> {
        let competing = self.competing.as_mut()?;
        let others = without_own.saturating_sub(path);
        let is_alone = others.as_secs_f64() < ALONE_PART * before.saturating_sub(path).as_secs_f64();
        competing.looks_alone = if is_alone { competing.looks_alone + 1 } else { 0 };
        competing.next_look = now + if is_alone { SECOND_LOOK } else { LOOKS };
        if competing.looks_alone < LOOKS_ALONE && now.saturating_duration_since(competing.since) < LONGEST {
            return None;
        }
        self.left = Some((now, competing.cubic.window()));
        self.competing = None;
        Some(if is_alone { path.max(without_own) } else { path })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: fn(u64) -> Duration = Duration::from_millis;

    /// Round trips of 100 ms with a queue of so many milliseconds, in which so much of the target is sent.
    fn after(
        traffic: &mut CrossTraffic,
        begin: Instant,
        seconds: u64,
        queue_ms: u64,
        sent_part: f64,
    ) -> Instant {
        let target_bytes_s = 1e6;
        for round in 1..=seconds * 10 {
            let sent_bytes = (sent_part * target_bytes_s * round as f64 * 0.1) as u64;
            let seen = Seen {
                queue: MS(queue_ms),
                sent_bytes,
                in_flight_bytes: 50_000,
                target_bytes_s,
                mtu: 1200,
                min_window_bytes: 20_000,
            };
            traffic.note_round(begin + MS(100 * round), seen);
        }
        begin + MS(1000 * seconds)
    }

    #[test]
    fn a_queue_that_stands_though_the_target_is_followed_is_anothers() {
        for (queue_ms, sent_part, is_anothers) in [(200, 1.0, true), (200, 1.4, false), (50, 1.0, false)] {
            let mut traffic = CrossTraffic::default();
            after(&mut traffic, Instant::now(), 4, queue_ms, sent_part);
            assert_eq!(traffic.window_bytes().is_some(), is_anothers, "{queue_ms} ms, {sent_part}");
        }
    }

    #[test]
    fn a_flow_alone_in_two_looks_avoids_queues_again() {
        let mut traffic = CrossTraffic::default();
        let now = after(&mut traffic, Instant::now(), 4, 200, 1.0);
        assert!(!traffic.is_look_due(now) && traffic.is_look_due(now + LOOKS));
        let (path, before) = (MS(40), MS(240));
        let look = |traffic: &mut CrossTraffic, s: u64, own_ms: u64| {
            traffic.end_look(now + MS(1000 * s), MS(240 - own_ms), path, before)
        };
        assert_eq!(look(&mut traffic, 8, 195), None, "the other may have halved its window just then");
        assert_eq!(look(&mut traffic, 9, 100), None, "half of the queue is another's");
        assert_eq!(look(&mut traffic, 17, 195), None);
        assert_eq!(look(&mut traffic, 18, 195), Some(MS(45)), "alone; so long takes a round trip then");
        assert!(traffic.window_bytes().is_none());
    }

    #[test]
    fn queues_are_avoided_now_and_then_in_any_case_and_the_window_is_remembered() {
        let mut traffic = CrossTraffic::default();
        let now = after(&mut traffic, Instant::now(), 4, 200, 1.0);
        let look = |traffic: &mut CrossTraffic, s: u64| {
            traffic.end_look(now + MS(1000 * s), MS(140), MS(40), MS(240))
        };
        assert_eq!(look(&mut traffic, 8), None);
        assert_eq!(look(&mut traffic, LONGEST.as_secs()), Some(MS(40)));
        traffic.left.as_mut().expect("it was left").1 = 400_000;
        after(&mut traffic, now + LONGEST, 4, 200, 1.0);
        assert_eq!(traffic.window_bytes(), Some(200_000));
    }
}
