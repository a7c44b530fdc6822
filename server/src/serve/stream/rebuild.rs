//! How often, and how soon, a lost device is opened again. Pure.

use std::time::Duration;

/// Attempts before the server gives up.
const ATTEMPTS: u32 = 6;
/// Wait before the first attempt; each further one waits twice as long.
const FIRST_WAIT: Duration = Duration::from_millis(250);
/// A device that lasted this long starts the count anew, nanoseconds.
const GOOD_NS: i64 = 60_000_000_000;

/// Counts attempts.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Rebuild {
    attempts: u32,
    opened_ns: i64,
}

impl Rebuild {
    /// The device is lost, or could not be opened: how long to wait until it is tried again; `None`: no longer.
    pub(super) fn failed(&mut self, now_ns: i64) -> Option<Duration> {
        if now_ns - self.opened_ns >= GOOD_NS {
            self.attempts = 0;
        }
        self.attempts += 1;
        (self.attempts <= ATTEMPTS).then(|| FIRST_WAIT * (1 << (self.attempts - 1)))
    }

    /// The device was opened.
    pub(super) fn succeeded(&mut self, now_ns: i64) {
        self.opened_ns = now_ns;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attempts_come_slower_and_slower_and_end() {
        let mut rebuild = Rebuild::default();
        let waits: Vec<_> = std::iter::from_fn(|| rebuild.failed(5)).map(|wait| wait.as_millis()).collect();
        assert_eq!(waits, [250, 500, 1000, 2000, 4000, 8000]);
    }

    #[test]
    fn a_device_that_is_lost_as_soon_as_it_is_opened_is_given_up_and_one_that_lasted_is_not() {
        let mut rebuild = Rebuild::default();
        let mut now_ns = 0;
        while rebuild.failed(now_ns).is_some() {
            now_ns += 1_000_000_000;
            rebuild.succeeded(now_ns);
        }
        assert!(now_ns <= 10_000_000_000);
        let mut rebuild = Rebuild::default();
        for hour in 1..50 {
            assert_eq!(rebuild.failed(hour * 3_600_000_000_000), Some(FIRST_WAIT));
            rebuild.succeeded(hour * 3_600_000_000_000);
        }
    }
}
