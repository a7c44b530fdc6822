//! What a path carries, from the first packets that it is given: a *train* of packets leaves at once and arrives as far apart as the
//! bottleneck has put them. Pure.
//!
//! A delivery rate that counts from the sending on says little before a round trip is full (`congestion`). A train of a few packets says it
//! within its own round trip: Dovrolis, Ramanathan, Moore, "Packet-dispersion techniques and a capacity-estimation methodology", 2004.
//! Jitter makes it too low, by as much as the train is shorter than the jitter.

use std::time::{Duration, Instant};

/// Packets of a train are no further apart when they leave.
const LARGEST_GAP: Duration = Duration::from_millis(2);
/// A shorter train tells nothing.
const LEAST_BYTES: u64 = 8 * 1200;
/// A train is measured when this part of it has arrived: its last packet may be acknowledged late, or be lost.
const MEASURED_PART: f64 = 0.85;
/// Acknowledgements that come closer together count as this far apart: so finely nobody reads a socket.
const SHORTEST: Duration = Duration::from_micros(500);
/// A longer train is no probe, and nothing waits for its word.
const PROBE_BYTES: u64 = 24 * 1200;
/// A train of which so long nothing has arrived any more is given up.
const GIVEN_UP: Duration = Duration::from_secs(2);

/// The trains of a connection, one after the other.
#[derive(Clone, Debug, Default)]
pub(crate) struct Trains {
    under_way: Option<Train>,
    bytes_s: Option<f64>,
    /// Something has left behind the first train, which has yet to be measured.
    is_awaited: bool,
}

/// Packets that leave together, and what has arrived of them.
#[derive(Clone, Debug)]
struct Train {
    first_sent: Instant,
    last_sent: Instant,
    sent_bytes: u64,
    acked_bytes: u64,
    /// When the first acknowledgement came, and for how many bytes.
    first_acked: Option<(Instant, u64)>,
    /// Something that left later has arrived: too much of the train is lost.
    is_overtaken: bool,
}

impl Train {
    fn of(now: Instant, bytes: u64) -> Self {
        Self {
            first_sent: now,
            last_sent: now,
            sent_bytes: bytes,
            acked_bytes: 0,
            first_acked: None,
            is_overtaken: false,
        }
    }

    /// Bytes a second, once enough of it has arrived. What the first acknowledgement is for arrived before the time that is measured.
    fn bytes_s(&self, now: Instant) -> Option<f64> {
        let (first_at, first_bytes) = self.first_acked?;
        let is_enough = self.acked_bytes as f64 >= MEASURED_PART * self.sent_bytes as f64;
        let elapsed = now.saturating_duration_since(first_at).max(SHORTEST);
        let spread_bytes = self.acked_bytes.saturating_sub(first_bytes).max(self.sent_bytes / 2);
        (is_enough && self.sent_bytes >= LEAST_BYTES).then(|| spread_bytes as f64 / elapsed.as_secs_f64())
    }
}

impl Trains {
    /// What the last train says that the path carries, bytes a second.
    pub(crate) fn bytes_s(&self) -> Option<f64> {
        self.bytes_s
    }

    /// Whether what leaves now leaves behind a first train that will soon tell what the path carries.
    pub(crate) fn is_awaited(&self) -> bool {
        self.is_awaited
    }

    /// A packet leaves. One that is no more of the train under way begins a new one, unless what is awaited is long enough.
    pub(crate) fn sent(&mut self, now: Instant, bytes: u64) {
        match &mut self.under_way {
            Some(train) if now.saturating_duration_since(train.last_sent) <= LARGEST_GAP => {
                train.last_sent = now;
                train.sent_bytes += bytes;
            }
            Some(train)
                if train.sent_bytes >= LEAST_BYTES
                    && now.saturating_duration_since(train.last_sent) <= GIVEN_UP =>
            {
                let is_probe = self.bytes_s.is_none() && train.sent_bytes <= PROBE_BYTES;
                self.is_awaited = is_probe && !train.is_overtaken;
            }
            _ => (self.under_way, self.is_awaited) = (Some(Train::of(now, bytes)), false),
        }
    }

    /// A packet that left at `sent` was acknowledged.
    pub(crate) fn acked(&mut self, now: Instant, sent: Instant, bytes: u64) {
        let Some(train) = &mut self.under_way else { return };
        if !(train.first_sent..=train.last_sent).contains(&sent) {
            train.is_overtaken |= sent > train.last_sent;
            self.is_awaited &= !train.is_overtaken;
            return;
        }
        train.acked_bytes += bytes;
        match &mut train.first_acked {
            Some((at, first_bytes)) if *at == now => *first_bytes += bytes,
            Some(_) => {}
            first @ None => *first = Some((now, bytes)),
        }
        let measured = train.bytes_s(now);
        self.bytes_s = measured.or(self.bytes_s);
        if measured.is_some() || train.acked_bytes >= train.sent_bytes {
            (self.under_way, self.is_awaited) = (None, false);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A train of `packets` of 1200 bytes whose acknowledgements come by `each_ns`, two at a time.
    fn measured(packets: u64, each_ns: u64) -> Option<f64> {
        let sent = Instant::now();
        let mut trains = Trains::default();
        (0..packets).for_each(|_| trains.sent(sent, 1200));
        for number in 1..=packets {
            let at =
                sent + Duration::from_millis(40) + Duration::from_nanos(number.div_ceil(2) * 2 * each_ns);
            trains.acked(at, sent, 1200);
        }
        trains.bytes_s()
    }

    #[test]
    fn a_train_tells_what_the_path_carries() {
        for mbit_s in [0.4, 2.0, 8.0, 50.0] {
            let each_ns = 1200.0 * 8.0 / (mbit_s * 1e-3);
            let found = measured(16, each_ns as u64).expect("long enough") * 8e-6;
            assert!((0.8..1.25).contains(&(found / mbit_s)), "{found} of {mbit_s} Mbit/s");
        }
    }

    #[test]
    fn a_short_train_tells_nothing() {
        assert_eq!(measured(6, 1_000_000), None);
    }

    #[test]
    fn what_leaves_alone_before_a_train_does_not_hide_it() {
        let start = Instant::now();
        let mut trains = Trains::default();
        trains.sent(start, 1200);
        let later = start + Duration::from_millis(30);
        (0..16).for_each(|_| trains.sent(later, 1200));
        (1..=16).for_each(|n| trains.acked(later + Duration::from_millis(40 + n), later, 1200));
        assert!(trains.bytes_s().is_some());
    }

    #[test]
    fn a_train_that_arrives_at_once_is_no_infinite_rate() {
        let found = measured(16, 0).expect("long enough");
        assert!(found <= 16.0 * 1200.0 / SHORTEST.as_secs_f64(), "{found}");
    }

    #[test]
    fn a_lost_train_makes_room_for_the_next() {
        let start = Instant::now();
        let mut trains = Trains::default();
        (0..16).for_each(|_| trains.sent(start, 1200));
        let later = start + GIVEN_UP + LARGEST_GAP;
        (0..16).for_each(|_| trains.sent(later, 1200));
        (1..=16).for_each(|n| trains.acked(later + Duration::from_millis(40 + n), later, 1200));
        assert!(trains.bytes_s().is_some());
    }

    #[test]
    fn what_leaves_behind_a_short_first_train_awaits_its_word() {
        let start = Instant::now();
        let behind = start + 2 * LARGEST_GAP;
        for (packets, awaits) in [(6, false), (16, true), (200, false)] {
            let mut trains = Trains::default();
            (0..packets).for_each(|_| trains.sent(start, 1200));
            assert!(!trains.is_awaited(), "nothing is behind {packets} packets");
            trains.sent(behind, 1200);
            assert_eq!(trains.is_awaited(), awaits, "{packets} packets");
            (1..=packets).for_each(|n| trains.acked(behind + Duration::from_millis(n), start, 1200));
            trains.sent(behind + Duration::from_secs(1), 1200);
            assert!(!trains.is_awaited(), "{packets} packets have told");
        }
        let mut trains = Trains::default();
        (0..16).for_each(|_| trains.sent(start, 1200));
        trains.sent(behind, 1200);
        trains.acked(behind + Duration::from_millis(40), behind, 1200);
        assert!(!trains.is_awaited(), "it has arrived before the train: that is lost");
        trains.sent(behind + Duration::from_millis(50), 1200);
        assert!(!trains.is_awaited(), "and stays so");
    }
}
