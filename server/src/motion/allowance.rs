//! Allowed bytes over time. Pure: the frequency of the requests changes nothing.

use shadecast_protocol::time::{DEFAULT_GRID, ServerTime};

/// More than any link carries in a step of the time grid, bytes.
const UNLIMITED_BYTES: i64 = 1 << 40;

/// So many bytes a step of the time grid, saved for a few steps. What was sent beyond that is owed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Allowance {
    step_bytes: i64,
    saved_steps: i64,
    left_bytes: i64,
    /// Until when time was counted.
    counted: Option<ServerTime>,
}

impl Allowance {
    /// Without a limit until one is set; then saved for so many steps.
    pub(crate) fn new(saved_steps: i64) -> Self {
        let step_bytes = UNLIMITED_BYTES;
        Self { step_bytes, saved_steps, left_bytes: step_bytes * saved_steps, counted: None }
    }

    /// What each step brings from now on.
    pub(crate) fn set_step_bytes(&mut self, bytes: usize) {
        self.step_bytes = i64::try_from(bytes).unwrap_or(UNLIMITED_BYTES).min(UNLIMITED_BYTES);
        self.left_bytes = self.left_bytes.min(self.most_bytes());
    }

    /// Adds what the time until `now` brings.
    pub(crate) fn pass(&mut self, now: ServerTime) {
        let most_ns = self.saved_steps * DEFAULT_GRID.spacing_ns;
        let passed_ns = self.counted.map_or(DEFAULT_GRID.spacing_ns, |counted| now.since(counted));
        self.counted = self.counted.max(Some(now));
        let more = i128::from(self.step_bytes) * i128::from(passed_ns.clamp(0, most_ns))
            / i128::from(DEFAULT_GRID.spacing_ns);
        self.left_bytes = (self.left_bytes + more as i64).min(self.most_bytes());
    }

    /// Whether so many bytes may be sent now: all of them are there, or as many as are ever saved.
    pub(crate) fn affords(&self, bytes: usize) -> bool {
        self.left_bytes > 0
            && self.left_bytes >= i64::try_from(bytes).unwrap_or(i64::MAX).min(self.most_bytes())
    }

    /// Bytes that may be sent now.
    pub(crate) fn left_bytes(&self) -> usize {
        self.left_bytes.max(0) as usize
    }

    /// So many bytes were sent.
    pub(crate) fn take(&mut self, bytes: usize) {
        self.left_bytes -= bytes as i64;
    }

    fn most_bytes(&self) -> i64 {
        self.step_bytes * self.saved_steps
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(step: i64, part: i64) -> ServerTime {
        ServerTime(step * DEFAULT_GRID.spacing_ns + part * DEFAULT_GRID.spacing_ns / 8)
    }

    /// Bytes of messages of `message` bytes in 300 steps, asked so many times a step.
    fn sent(asked: i64, message: usize) -> usize {
        let mut allowance = Allowance::new(8);
        allowance.set_step_bytes(1000);
        allowance.take(8000);
        let mut sent = 0;
        for step in 0..300 {
            for part in 0..asked {
                allowance.pass(at(step, part));
                if allowance.affords(message) {
                    allowance.take(message);
                    sent += message;
                }
            }
        }
        sent
    }

    #[test]
    fn allowance_of_a_second_is_independent_of_requests() {
        for (asked, message) in [(1, 100), (2, 900), (5, 900), (8, 900), (3, 5000), (1, 20_000), (8, 20_000)]
        {
            let (sent, most) = (sent(asked, message), 1000 * 300);
            // One that asks once a step for less than a step brings takes less.
            let least = most.min(300 * asked as usize * message) - message.max(9000);
            assert!((least..=most + message).contains(&sent), "{asked} times, {message} bytes: {sent}");
        }
    }

    #[test]
    fn no_more_is_saved_than_for_a_few_steps() {
        let mut allowance = Allowance::new(8);
        allowance.set_step_bytes(1000);
        allowance.pass(at(0, 0));
        allowance.pass(at(5000, 0));
        assert_eq!(allowance.left_bytes(), 8000);
    }

    #[test]
    fn a_clock_that_goes_back_brings_nothing() {
        let mut allowance = Allowance::new(8);
        allowance.set_step_bytes(1000);
        allowance.pass(at(10, 0));
        allowance.take(8000);
        allowance.pass(at(3, 0));
        allowance.pass(at(10, 0));
        assert_eq!(allowance.left_bytes(), 0);
    }

    #[test]
    fn without_a_limit_everything_may_be_sent() {
        let mut allowance = Allowance::new(8);
        allowance.set_step_bytes(usize::MAX);
        for step in 0..100 {
            allowance.pass(at(step, 0));
            assert!(allowance.affords(1 << 30));
            allowance.take(1 << 30);
        }
    }
}
