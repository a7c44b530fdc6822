//! Who gets what of a link: the one place that decides it. Pure.
//!
//! The transport tells a target, which is how much to send so that no queue stands. The gate tells what a link carries where something has
//! waited for it: a *slow* link. In this order:
//!
//! 1. **Motion.** What is shown next leaves at once. On a slow link, poses and samples take at most three fifths, and what is shown later
//!    at most a tenth.
//! 2. **A picture at a useful quantiser**, as often as the link allows. Pictures have a quarter at least. Where the link carries less than a
//!    stream takes, there are fewer of them, down to ten a second, before they get coarser. No update is made where what is under way takes a
//!    slow link another quarter of a second.
//! 3. **Geometry.** An update brings what a slow link carries in 100 ms, or 16 kB where that is more: the largest blocks first, the rest with later updates. The first
//!    update brings a second of what the way has delivered, since nothing is shown before.
//! 4. **Finer quantisers**, to the end of the target.
//! 5. **Texels and levels of detail**, once quantisers are fine.
//!
//! On other links motion and geometry are small beside pictures, and wait for nothing.

use crate::pacing::density::Spare;
use shadecast_transport::PeerStats;
use std::time::Duration;

/// What all of a client's streams usually take together, Mbit/s.
pub const USUAL_MBIT_S: f64 = 20.0;

/// Samples of one step of the time grid have what a slow link carries in so many seconds: three fifths of a step.
const SAMPLES_S: f64 = 0.02;
/// The same for what is shown later: a tenth.
const LATER_S: f64 = 0.0033;
/// What is under way may take this long to arrive, and a round trip, when another update is made, seconds.
const MOST_WAIT_S: f64 = 0.25;
/// Pictures have at least this part of the bits, however many geometry takes.
const LEAST_PICTURE_SHARE: f64 = 0.25;
/// Where the link carries too little there are fewer updates rather than worse ones, down to so many a second.
const SLOW_UPDATES_HZ: f64 = 10.0;
/// New geometry of an update is what a slow link carries in so many seconds.
const GEOMETRY_S: f64 = 0.1;
/// New geometry of the first update is what the way has delivered in so many seconds.
const FIRST_GEOMETRY_S: f64 = 1.0;
/// New geometry that an update may bring in any case, bytes: the scene must enter even over the slowest link.
const LEAST_GEOMETRY_BYTES: f64 = 16_384.0;
/// The same for the first update.
const LEAST_FIRST_GEOMETRY_BYTES: f64 = 131_072.0;
/// With this quantiser, or a finer one, there are bits for more texels; with that, or a coarser one, too few for those there are.
const QP_WITH_ROOM: u8 = 20;
const QP_WITHOUT: u8 = 28;
/// Of what a slow link carries, streams take this part.
const LINK_SHARE: f64 = 0.8;
/// A longer round trip is not believed.
const LONGEST_ROUND_TRIP: Duration = Duration::from_secs(1);

/// What the transport knows of the way to a client.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WayState {
    /// Streams handed over that have not arrived whole.
    pub streams_under_way: u64,
    /// Bytes that may be under way at once: on a new connection far more than a slow link takes.
    pub window_bytes: u64,
    /// Round trip from which on something is late, nanoseconds: the shortest so far, and the usual one beside a flow that fills the queue.
    pub round_trip_ns: i64,
    /// The usual one, nanoseconds.
    pub smoothed_ns: i64,
    /// It has delivered so many bytes a second, and may carry more; 0 before anything is known.
    pub delivered_bytes_s: u64,
    /// How much to send, bytes a second, so that no queue stands; 0 before anything is known.
    pub target_bytes_s: u64,
}

impl From<PeerStats> for WayState {
    fn from(stats: PeerStats) -> Self {
        let expected = if stats.is_competing { stats.rtt } else { stats.min_rtt };
        Self {
            streams_under_way: stats.streams_under_way,
            window_bytes: stats.window_bytes,
            round_trip_ns: expected.min(LONGEST_ROUND_TRIP).as_nanos() as i64,
            smoothed_ns: stats.rtt.min(LONGEST_ROUND_TRIP).as_nanos() as i64,
            delivered_bytes_s: stats.delivered_bit_per_s / 8,
            target_bytes_s: stats.target_bit_per_s / 8,
        }
    }
}

/// What an update may take on the wire, about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Budget {
    /// Bytes of patches and vertices that the client does not have; the largest blocks come first, the rest waits.
    pub geometry_bytes: usize,
    /// Bytes of samples that one step of motion may bring.
    pub sample_bytes: usize,
    /// Bytes that one step of motion may bring of what is shown later.
    pub later_bytes: usize,
}

impl Budget {
    /// As much as there is.
    pub(crate) const UNLIMITED: Self =
        Self { geometry_bytes: usize::MAX, sample_bytes: usize::MAX, later_bytes: usize::MAX };
}

/// What a link gives to one client.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Share {
    /// `None` before anything is known.
    target_bytes_s: Option<f64>,
    /// What a slow link carries.
    slow_bytes_s: Option<f64>,
    delivered_bytes_s: f64,
}

impl Share {
    /// Of this way; `slow_bytes_s`: what it carries, where something has waited for it.
    pub(crate) fn of(way: &WayState, slow_bytes_s: Option<f64>) -> Self {
        let target_bytes_s = Some(way.target_bytes_s as f64).filter(|target| *target > 0.0);
        Self { target_bytes_s, slow_bytes_s, delivered_bytes_s: way.delivered_bytes_s as f64 }
    }

    /// What all streams may take together, bytes a second; `None` before anything is known.
    pub(crate) fn streams_bytes_s(&self) -> Option<f64> {
        let of_slow = self.slow_bytes_s.map(|carries| LINK_SHARE * carries);
        self.target_bytes_s.into_iter().chain(of_slow).reduce(f64::min)
    }

    /// Most bytes that may be under way when another update is made, where there is a bound.
    pub(crate) fn most_under_way_bytes(&self, round_trip_ns: i64) -> Option<f64> {
        self.slow_bytes_s.map(|carries| carries * (MOST_WAIT_S + round_trip_ns as f64 * 1e-9))
    }

    /// What the next update may take. `is_first`: nothing has arrived yet.
    pub(crate) fn budget(&self, is_first: bool) -> Budget {
        match self.slow_bytes_s {
            Some(carries) => Budget {
                geometry_bytes: (carries * GEOMETRY_S).max(LEAST_GEOMETRY_BYTES) as usize,
                sample_bytes: (carries * SAMPLES_S) as usize,
                later_bytes: (carries * LATER_S) as usize,
            },
            None if is_first => {
                let delivered_bytes = self.delivered_bytes_s * FIRST_GEOMETRY_S;
                let geometry_bytes = delivered_bytes.max(LEAST_FIRST_GEOMETRY_BYTES) as usize;
                // What is shown later can wait for the first picture.
                Budget { geometry_bytes, later_bytes: 0, ..Budget::UNLIMITED }
            }
            None => Budget::UNLIMITED,
        }
    }
}

/// What a picture may take, bytes. All streams together have `all_bytes_s`, of which others take `others_bytes_s`; updates are wanted once
/// in `period_s`, and the link carries `shortness` times less than a stream takes.
pub(crate) fn picture_bytes(all_bytes_s: f64, others_bytes_s: f64, period_s: f64, shortness: f64) -> f64 {
    let slow_period_s = period_s.max(1.0 / SLOW_UPDATES_HZ);
    let left_bytes_s = (all_bytes_s - others_bytes_s).max(LEAST_PICTURE_SHARE * all_bytes_s);
    left_bytes_s * (period_s * shortness).min(slow_period_s)
}

/// Whether a quantiser leaves bits for more texels and finer levels of detail.
pub(crate) fn spare_at(qp: u8) -> Spare {
    match qp {
        ..=QP_WITH_ROOM => Spare::Room,
        QP_WITHOUT.. => Spare::Short,
        _ => Spare::Enough,
    }
}

/// Mbit/s as bytes a second.
pub(crate) fn bytes_s(mbit_s: f64) -> f64 {
    mbit_s * 1e6 / 8.0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slow(mbit_s: f64) -> Share {
        Share::of(&WayState::default(), Some(bytes_s(mbit_s)))
    }

    #[test]
    fn geometry_of_an_update_takes_a_tenth_of_a_second_of_a_slow_link() {
        for mbit_s in [4.0, 8.0, 20.0] {
            let bytes = slow(mbit_s).budget(false).geometry_bytes;
            assert_eq!(bytes, (0.1 * bytes_s(mbit_s)) as usize, "{mbit_s} Mbit/s");
        }
        assert_eq!(slow(0.2).budget(false).geometry_bytes, LEAST_GEOMETRY_BYTES as usize);
    }

    #[test]
    fn motion_goes_before_what_is_shown_later() {
        let Budget { sample_bytes, later_bytes, .. } = slow(8.0).budget(false);
        let of_a_step = bytes_s(8.0) / 30.0;
        assert!((0.55..0.65).contains(&(sample_bytes as f64 / of_a_step)), "{sample_bytes}");
        assert!((0.08..0.12).contains(&(later_bytes as f64 / of_a_step)), "{later_bytes}");
    }

    #[test]
    fn a_first_update_brings_what_was_delivered_in_a_second_and_later_ones_all() {
        for (delivered, first) in [(0.0, 131_072), (0.4, 131_072), (16.0, 2_000_000)] {
            let delivered_bytes_s = bytes_s(delivered) as u64;
            let share = Share::of(&WayState { delivered_bytes_s, ..WayState::default() }, None);
            assert_eq!(share.budget(true).geometry_bytes, first, "{delivered} Mbit/s");
            assert_eq!(share.budget(true).later_bytes, 0);
            assert_eq!(share.budget(false), Budget::UNLIMITED);
            assert_eq!(share.most_under_way_bytes(0), None);
        }
    }

    #[test]
    fn streams_take_the_target_and_no_more_than_a_slow_link_carries() {
        let streams = |target_bytes_s, slow| {
            Share::of(&WayState { target_bytes_s, ..WayState::default() }, slow).streams_bytes_s()
        };
        assert_eq!(streams(0, None), None);
        assert_eq!(streams(5000, None), Some(5000.0));
        assert_eq!(streams(5000, Some(10_000.0)), Some(5000.0));
        assert_eq!(streams(5000, Some(5000.0)), Some(4000.0));
    }

    #[test]
    fn pictures_have_a_quarter_and_a_short_link_gets_fewer_larger_ones() {
        let period_s = 1.0 / 30.0;
        assert_eq!(picture_bytes(1000.0, 2000.0, period_s, 1.0), 250.0 * period_s);
        assert_eq!(picture_bytes(1000.0, 200.0, period_s, 2.0), 800.0 * 2.0 * period_s);
        assert_eq!(picture_bytes(1000.0, 200.0, period_s, 50.0), 80.0, "ten a second");
        assert_eq!(picture_bytes(1000.0, 0.0, 0.5, 50.0), 500.0, "as seldom as they are wanted");
    }

    #[test]
    fn beside_a_flow_that_fills_the_queue_nothing_is_late_before_its_wait() {
        let (min_rtt, rtt) = (Duration::from_millis(20), Duration::from_millis(240));
        let expected_ms = |is_competing| {
            let stats = PeerStats { min_rtt, rtt, is_competing, ..PeerStats::default() };
            WayState::from(stats).round_trip_ns / 1_000_000
        };
        assert_eq!([false, true].map(expected_ms), [20, 240]);
    }

    #[test]
    fn texels_and_levels_come_after_quantisers() {
        assert_eq!([10, 20, 21, 27, 28, 34].map(spare_at), {
            use Spare::{Enough, Room, Short};
            [Room, Room, Enough, Enough, Short, Short]
        });
    }
}
