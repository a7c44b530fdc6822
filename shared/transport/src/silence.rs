//! A path that carries nothing: when to ask whether it does again, and when its peer counts as away. Time is an argument.
//!
//! QUIC asks ever more seldom: after an outage of two seconds its next question may be two seconds away. Here the questions come
//! [`PROBE_PERIOD`] apart for as long as the outage lasts, so that its end is noticed at once.

use std::time::Duration;

/// After so long without a word the path is asked whether it carries anything.
pub(crate) const PROBE_AFTER: Duration = Duration::from_millis(300);
/// From one question to the next.
pub(crate) const PROBE_PERIOD: Duration = Duration::from_millis(100);
/// A connected peer of which nothing was heard for this long is away. Its connection stands.
pub const AWAY_AFTER: Duration = Duration::from_secs(3);

/// See the module.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Silence {
    heard_ns: i64,
    next_probe_ns: i64,
    is_away: bool,
    /// A question is to be sent.
    is_asking: bool,
}

impl Silence {
    /// Of a peer that was heard at `now_ns`.
    pub(crate) fn new(now_ns: i64) -> Self {
        let next_probe_ns = now_ns + PROBE_AFTER.as_nanos() as i64;
        Self { heard_ns: now_ns, next_probe_ns, is_away: false, is_asking: false }
    }

    /// Something came. True where the peer was away until now.
    pub(crate) fn heard(&mut self, now_ns: i64) -> bool {
        // What is asked already may go out: who was silent is to hear soon.
        let before = std::mem::replace(self, Self { is_asking: self.is_asking, ..Self::new(now_ns) });
        self.is_asking |= before.has_asked();
        before.is_away
    }

    fn has_asked(&self) -> bool {
        self.next_probe_ns > self.heard_ns + PROBE_AFTER.as_nanos() as i64
    }

    fn away_ns(&self) -> Option<i64> {
        (!self.is_away).then(|| self.heard_ns + AWAY_AFTER.as_nanos() as i64)
    }

    /// When [`Self::pass`] next has something to do, nanoseconds.
    pub(crate) fn next_ns(&self) -> i64 {
        self.away_ns().map_or(self.next_probe_ns, |away_ns| away_ns.min(self.next_probe_ns))
    }

    /// Time has passed. Gives whether a question is due, and since when the peer is away where that is new, nanoseconds.
    pub(crate) fn pass(&mut self, now_ns: i64) -> (bool, Option<i64>) {
        let is_due = now_ns >= self.next_probe_ns;
        if is_due {
            self.next_probe_ns = now_ns + PROBE_PERIOD.as_nanos() as i64;
            self.is_asking = true;
        }
        let is_new = self.away_ns().is_some_and(|away_ns| now_ns >= away_ns);
        self.is_away |= is_new;
        (is_due, is_new.then_some(self.heard_ns))
    }

    /// Whether the next packet is such a question; it is taken to be sent.
    pub(crate) fn take_question(&mut self) -> bool {
        std::mem::take(&mut self.is_asking)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    /// The times in milliseconds at which a silent peer is asked, and at which it is away, until `end_ms`.
    fn until(silence: &mut Silence, end_ms: i64) -> (Vec<i64>, Vec<i64>) {
        let (mut asked, mut away) = (Vec::new(), Vec::new());
        while silence.next_ns() <= end_ms * MS {
            let now_ns = silence.next_ns();
            let (is_due, since_ns) = silence.pass(now_ns);
            asked.extend(is_due.then_some(now_ns / MS));
            away.extend(since_ns.map(|_| now_ns / MS));
        }
        (asked, away)
    }

    #[test]
    fn a_silent_path_is_asked_ten_times_a_second_and_its_peer_is_away_once() {
        let mut silence = Silence::new(0);
        let (asked, away) = until(&mut silence, 60_000);
        assert_eq!(&asked[..3], [300, 400, 500]);
        assert!(asked.windows(2).all(|pair| pair[1] - pair[0] == 100), "never more seldom");
        assert_eq!(away, [3000]);
        assert!(silence.heard(60_010 * MS), "it was away");
        assert!(!silence.heard(60_020 * MS), "it is back");
        assert_eq!(silence.next_ns(), 60_320 * MS);
    }

    #[test]
    fn who_was_silent_is_answered_with_a_question_at_once() {
        let mut silence = Silence::new(0);
        until(&mut silence, 350);
        assert!(silence.take_question() && !silence.take_question());
        silence.heard(360 * MS);
        assert!(silence.take_question());
        silence.heard(370 * MS);
        assert!(!silence.take_question(), "one is enough");
    }
}
