//! Begin and display time of a window's frames. Pure; times are arguments.

use crate::display::rest::{MAX_FRAME_NS, rest_ns};
use shadecast_protocol::time::ClientTime;

/// Rate of a display that does not say its own, pictures a second.
const USUAL_HZ: f64 = 60.0;
/// Slower ones there are none: Windows says 0 or 1 for one whose rate it does not know.
const LEAST_HZ: f64 = 10.0;
/// Share of a new frame in the idea of how long frames take.
const NEWEST_SHARE: f64 = 0.1;

/// Paces frames: no faster than the display shows them, and seen when as long has passed as frames take.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pace {
    /// Between two pictures of the display.
    pub(super) period_ns: i64,
    frame_ns: f64,
    /// What the last one took.
    took_ns: i64,
    /// Whether others draw on the same device.
    is_shared: bool,
    began: Option<ClientTime>,
    seen: ClientTime,
}

impl Pace {
    /// For a display that says so many pictures in a thousand seconds.
    pub(super) fn of_display(millihertz: Option<u32>) -> Self {
        let said_hz = millihertz.map(|millihertz| f64::from(millihertz) * 1e-3);
        let rate_hz = said_hz.filter(|hz| *hz >= LEAST_HZ).unwrap_or(USUAL_HZ);
        Self::new((1e9 / rate_hz) as i64)
    }

    /// For a display that shows a picture each `period_ns`.
    pub(super) fn new(period_ns: i64) -> Self {
        Self {
            period_ns,
            frame_ns: period_ns as f64,
            took_ns: 0,
            is_shared: false,
            began: None,
            seen: ClientTime(i64::MIN),
        }
    }

    /// Rests after each frame: for a device without a GPU, on which others draw as well.
    pub(super) fn sharing(self, is_shared: bool) -> Self {
        Self { is_shared, ..self }
    }

    /// The frame that began last is on display. Gives how long it took, nanoseconds.
    pub(super) fn finished(&mut self, now: ClientTime) -> i64 {
        let Some(began) = self.began else { return 0 };
        let took_ns = now.since(began).max(0);
        self.took_ns = took_ns;
        self.frame_ns += (took_ns.min(MAX_FRAME_NS) as f64 - self.frame_ns) * NEWEST_SHARE;
        took_ns
    }

    /// How long to wait at `now` before the next frame begins, nanoseconds. A display that holds frames back by itself needs
    /// no wait: what it takes off is less than half of a period.
    pub(super) fn wait_ns(&self, now: ClientTime) -> i64 {
        let passed_ns = self.began.map_or(i64::MAX, |began| now.since(began));
        let of_display_ns = if passed_ns >= self.period_ns / 2 { 0 } else { self.period_ns - passed_ns };
        let rests = self.is_shared && self.began.is_some();
        if rests { of_display_ns.max(rest_ns(self.took_ns)) } else { of_display_ns }
    }

    /// A frame begins at `now`: when it will be seen, later than the one before.
    pub(super) fn begin(&mut self, now: ClientTime) -> ClientTime {
        self.began = Some(now);
        let soonest = now.plus_ns((self.frame_ns as i64).max(self.period_ns));
        self.seen = soonest.max(ClientTime(self.seen.0.saturating_add(1)));
        self.seen
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn a_display_that_does_not_know_its_rate_has_the_usual_one() {
        for millihertz in [None, Some(0), Some(1), Some(1000)] {
            assert_eq!(Pace::of_display(millihertz).period_ns, 16_666_666, "{millihertz:?}");
        }
        assert_eq!(Pace::of_display(Some(144_000)).period_ns, 6_944_444);
    }

    #[test]
    fn frames_of_an_unthrottled_window_keep_the_displays_rate() {
        let mut pace = Pace::new(16 * MS);
        assert_eq!(pace.wait_ns(ClientTime(0)), 0);
        pace.begin(ClientTime(0));
        assert_eq!(pace.wait_ns(ClientTime(3 * MS)), 13 * MS);
        assert_eq!(pace.wait_ns(ClientTime(15 * MS)), 0, "the display has held it back");
    }

    #[test]
    fn a_slow_device_is_left_to_others_for_a_part_of_the_time() {
        let waits_ns = |frame_ns: i64| {
            let mut pace = Pace::new(16 * MS).sharing(true);
            pace.begin(ClientTime(0));
            pace.finished(ClientTime(frame_ns));
            pace.wait_ns(ClientTime(frame_ns))
        };
        assert_eq!(waits_ns(80 * MS), rest_ns(80 * MS));
        assert_eq!(waits_ns(30 * MS), rest_ns(30 * MS));
        assert_eq!(waits_ns(4 * MS), 12 * MS, "a fast one keeps the display's rate");
    }

    #[test]
    fn frames_are_seen_when_they_are_done_and_never_out_of_order() {
        let mut pace = Pace::new(16 * MS);
        let mut seen = ClientTime(i64::MIN);
        for frame in 0..200 {
            let began = ClientTime(frame * 40 * MS);
            let next = pace.begin(began);
            assert!(next > seen);
            seen = next;
            pace.finished(began.plus_ns(40 * MS));
        }
        let lead_ns = seen.since(ClientTime(199 * 40 * MS));
        assert!((lead_ns - 40 * MS).abs() < MS, "{lead_ns}");
        pace.finished(ClientTime(3_600_000 * MS));
        let next = pace.begin(ClientTime(3_600_000 * MS));
        assert!(next.since(ClientTime(3_600_000 * MS)) < 70 * MS, "a program that was asleep");
        assert!(pace.begin(ClientTime(3_600_000 * MS)) > next, "the same time again");
    }
}
