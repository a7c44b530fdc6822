//! How much somebody may still do: a bucket that fills in one second. Pure: time is an argument.

const SECOND_NS: i64 = 1_000_000_000;

/// So many a second, and as many at once after a pause.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Allowance {
    per_s: u32,
    /// When the bucket will be full again, nanoseconds.
    full_ns: i64,
}

impl Allowance {
    /// A full bucket.
    pub(crate) fn new(per_s: u32, now_ns: i64) -> Self {
        Self { per_s, full_ns: now_ns }
    }

    /// Takes one, if there is one.
    pub(crate) fn take(&mut self, now_ns: i64) -> bool {
        let full_ns = self.full_ns.max(now_ns) + SECOND_NS / i64::from(self.per_s.max(1));
        let is_there = full_ns - now_ns <= SECOND_NS;
        if is_there {
            self.full_ns = full_ns;
        }
        is_there
    }

    /// Nothing was taken that is not there again.
    pub(crate) fn is_full(&self, now_ns: i64) -> bool {
        self.full_ns <= now_ns
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_many_as_were_said_are_there_at_once_and_in_each_second() {
        let mut allowance = Allowance::new(10, 0);
        let taken = |allowance: &mut Allowance, now_ns| (0..100).filter(|_| allowance.take(now_ns)).count();
        assert_eq!(taken(&mut allowance, 0), 10);
        assert_eq!(taken(&mut allowance, SECOND_NS / 2), 5);
        assert!(!allowance.is_full(SECOND_NS));
        assert!(allowance.is_full(2 * SECOND_NS));
        assert_eq!(taken(&mut allowance, 100 * SECOND_NS), 10, "a pause saves up no more");
    }
}
