//! The display's clock: at which times frames begin and are shown. Arithmetic only; who sleeps is `frame.rs`.
//!
//! Time is a grid of display periods. Period `n` begins at `origin + n / refresh_hz`, rounded to a nanosecond from
//! the exact product, so that nothing drifts. A frame that is started in period `n` is displayed when period `n + 1`
//! begins: `predictedDisplayTime = begin(n + 1)`.
//!
//! * Virtual clock: the origin is `virtual_start_ns`, and the k-th `xrWaitFrame` (from 0) is period k.
//! * Real clock: the origin is the monotonic clock at the first `xrWaitFrame`. Each `xrWaitFrame` takes the next
//!   period; where that one is over already, it takes the period that is running, as a compositor does that misses
//!   a frame, and the skipped ones count as missed.
//!
//! The head path's time 0 is the origin, on both clocks.

/// Begin of display period `period`, nanoseconds of `XrTime`.
pub fn period_begin_ns(origin_ns: i64, refresh_hz: f64, period: u64) -> i64 {
    origin_ns.saturating_add((period as f64 * 1e9 / refresh_hz).round() as i64)
}

/// Length of a display period, rounded to nanoseconds.
pub fn period_ns(refresh_hz: f64) -> i64 {
    (1e9 / refresh_hz).round() as i64
}

/// Display periods of one length, numbered on from those before.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Grid {
    /// When the first of them begins, nanoseconds of `XrTime`, and its number.
    pub(crate) base_ns: i64,
    pub(crate) base_period: u64,
    /// Periods a second.
    pub(crate) hz: f64,
}

impl Grid {
    /// When a period begins that is one of them, or the end of the last before.
    pub(crate) fn begin_ns(self, period: u64) -> i64 {
        period_begin_ns(self.base_ns, self.hz, period.saturating_sub(self.base_period))
    }

    /// Of another length from the period after the last one on.
    pub(crate) fn with_rate(self, last: Option<u64>, hz: f64) -> Self {
        let base_period = last.map_or(0, |last| last + 1).max(self.base_period);
        Self { base_ns: self.begin_ns(base_period), base_period, hz }
    }

    /// The period in which the next frame starts on the real clock, at `now_ns`, after a frame in period `last`.
    pub(crate) fn next_real(self, last: Option<u64>, now_ns: i64) -> u64 {
        let last = last.and_then(|last| last.checked_sub(self.base_period));
        self.base_period + next_real_period(self.base_ns, self.hz, last, now_ns)
    }
}

/// The period in which the next frame starts on the real clock, at `now_ns`, after a frame in period `last`.
pub(crate) fn next_real_period(origin_ns: i64, refresh_hz: f64, last: Option<u64>, now_ns: i64) -> u64 {
    let running = ((now_ns - origin_ns).max(0) as f64 * refresh_hz / 1e9).floor() as u64;
    last.map_or(running, |last| running.max(last + 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seventy_two_periods_are_one_second() {
        assert_eq!(period_begin_ns(5, 72.0, 72), 1_000_000_005);
        assert_eq!(period_begin_ns(0, 72.0, 72 * 3600), 3_600_000_000_000);
    }

    #[test]
    fn an_application_in_time_gets_every_period() {
        assert_eq!(next_real_period(1000, 100.0, None, 1000), 0);
        assert_eq!(next_real_period(1000, 100.0, Some(0), 9_000_000), 1);
        assert_eq!(next_real_period(1000, 100.0, Some(1), 19_000_000), 2);
    }

    #[test]
    fn another_rate_begins_where_a_period_ends_and_goes_on_counting() {
        let slow = Grid { base_ns: 1000, base_period: 0, hz: 100.0 };
        let fast = slow.with_rate(Some(4), 200.0);
        assert_eq!((fast.begin_ns(5), fast.begin_ns(6)), (slow.begin_ns(5), slow.begin_ns(5) + 5_000_000));
        assert_eq!(fast.next_real(Some(5), slow.begin_ns(5)), 6);
        assert_eq!(fast.next_real(Some(4), fast.begin_ns(9) + 1), 9);
        assert_eq!(slow.with_rate(None, 50.0), Grid { hz: 50.0, ..slow });
    }

    #[test]
    fn a_late_application_skips_to_the_running_period() {
        assert_eq!(next_real_period(0, 100.0, Some(3), 75_000_000), 7);
    }
}
