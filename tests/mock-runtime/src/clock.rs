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
    fn a_late_application_skips_to_the_running_period() {
        assert_eq!(next_real_period(0, 100.0, Some(3), 75_000_000), 7);
    }
}
