//! How long pairing is closed after wrong codes. Pure: time is an argument.

/// Wrong codes that cost nothing but a new code.
pub const FREE_FAILURES: u32 = 2;
/// How long pairing is closed after the next one, and at most, nanoseconds.
const FIRST_NS: i64 = 60_000_000_000;
const LONGEST_NS: i64 = 3_600_000_000_000;
/// Failures are forgotten when there was none for so long, nanoseconds.
const FORGOTTEN_NS: i64 = 24 * LONGEST_NS;

/// Pairing is closed for a while; whoever is paired already is not concerned.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("pairing is closed for {wait_s} s after {failures} wrong codes")]
pub struct Closed {
    /// Seconds until it is open again, 1 to 3600.
    pub wait_s: u32,
    /// Wrong codes in a row.
    pub failures: u32,
}

/// Wrong codes in a row.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Lockout {
    failures: u32,
    failed_ns: i64,
}

impl Lockout {
    /// Whether a pairing may begin at `now_ns`.
    pub(super) fn check(&self, now_ns: i64) -> Result<(), Closed> {
        let closed_ns = self.closed_ns();
        let left_ns = self.failed_ns.saturating_add(closed_ns).saturating_sub(now_ns);
        if closed_ns == 0 || left_ns <= 0 {
            return Ok(());
        }
        let wait_s = (left_ns as u64).div_ceil(1_000_000_000).min(3600) as u32;
        Err(Closed { wait_s, failures: self.failures })
    }

    /// How long it is closed from the last failure on.
    fn closed_ns(&self) -> i64 {
        match self.failures.checked_sub(FREE_FAILURES + 1) {
            None => 0,
            Some(more) => FIRST_NS.saturating_mul(1 << more.min(20)).min(LONGEST_NS),
        }
    }

    /// A code was wrong.
    pub(super) fn failed(&mut self, now_ns: i64) {
        if now_ns.saturating_sub(self.failed_ns) > FORGOTTEN_NS {
            self.failures = 0;
        }
        self.failures = self.failures.saturating_add(1);
        self.failed_ns = now_ns;
    }

    /// A code was right.
    pub(super) fn succeeded(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: i64 = 1_000_000_000;

    #[test]
    fn the_third_failure_closes_for_a_minute_and_each_later_one_for_twice_as_long_up_to_an_hour() {
        let (mut lockout, mut now_ns, mut waits) = (Lockout::default(), 5 * S, Vec::new());
        for _ in 0..12 {
            lockout.failed(now_ns);
            let wait_s = lockout.check(now_ns).map_or_else(|closed| closed.wait_s, |()| 0);
            waits.push(wait_s);
            now_ns += i64::from(wait_s) * S;
            assert_eq!(lockout.check(now_ns), Ok(()), "it opens when it said so");
            assert_eq!(lockout.check(now_ns - 1).is_err(), wait_s > 0, "and not before");
        }
        assert_eq!(waits, [0, 0, 60, 120, 240, 480, 960, 1920, 3600, 3600, 3600, 3600]);
    }

    #[test]
    fn a_right_code_and_a_quiet_day_forgive() {
        let mut lockout = Lockout::default();
        (0..5).for_each(|_| lockout.failed(0));
        lockout.succeeded();
        lockout.failed(S);
        assert_eq!(lockout.check(S), Ok(()));
        (0..5).for_each(|_| lockout.failed(S));
        lockout.failed(2 * S + FORGOTTEN_NS);
        assert_eq!(lockout.check(2 * S + FORGOTTEN_NS), Ok(()), "the first of a new row");
    }

    #[test]
    fn no_time_and_no_number_of_failures_overflows() {
        let mut lockout = Lockout { failures: u32::MAX, failed_ns: i64::MAX };
        assert!(lockout.check(i64::MIN).is_err());
        lockout.failed(i64::MIN);
        assert!(lockout.check(i64::MIN).is_err() && lockout.check(i64::MAX).is_ok());
    }
}
