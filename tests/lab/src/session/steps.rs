//! The steps of a viewer's updates in virtual time, on a device that does one thing after the other and a CPU beside it.

use super::options::StepMs;
use shadecast_server::pacing::overlap::{Flight, Overlap, Step, StepTimes};

/// See the module.
pub(super) struct Steps {
    overlap: Overlap,
    ms: StepMs,
    encode_ns: i64,
    /// When the device has done all that was submitted.
    device_ns: i64,
    /// When the CPU has placed what it does.
    placed_ns: i64,
    seen_ns: Option<i64>,
    is_placed: bool,
    shaded_ns: Option<i64>,
    /// When the encoder has coded all that it was given.
    encoded_ns: i64,
}

impl Steps {
    /// Of updates that are wanted once in `period_ns`.
    pub(super) fn new(ms: StepMs, encode_ns: i64, period_ns: i64) -> Self {
        Self {
            overlap: Overlap::new(period_ns),
            ms,
            encode_ns,
            device_ns: 0,
            placed_ns: 0,
            seen_ns: None,
            is_placed: false,
            shaded_ns: None,
            encoded_ns: 0,
        }
    }

    /// What is next, if anything is before the device or the CPU has come further.
    pub(super) fn step(&self, now_ns: i64, may_begin: bool, is_alone: bool) -> Step {
        if now_ns < self.placed_ns {
            return Step::Wait;
        }
        let is_past = |at_ns: Option<i64>| at_ns.is_some_and(|at_ns| at_ns <= now_ns);
        let flight = Flight {
            is_begun: self.seen_ns.is_some(),
            is_seen: is_past(self.seen_ns),
            is_placed: self.is_placed,
            is_in_work: self.shaded_ns.is_some(),
            is_shaded: is_past(self.shaded_ns),
            is_alone,
        };
        self.overlap.step(flight, may_begin)
    }

    /// Whether an update that begins now would be shaded long before the encoder has its turn.
    pub(super) fn would_wait(&self, now_ns: i64) -> bool {
        let StepMs { visibility, placement, shading } = self.ms;
        now_ns + [visibility, placement, shading].map(ns).iter().sum::<i64>() < self.encoded_ns
    }

    /// The encoder is given a picture; when it is done with it.
    pub(super) fn encode(&mut self, now_ns: i64) -> i64 {
        self.encoded_ns = self.encoded_ns.max(now_ns) + self.encode_ns;
        self.encoded_ns
    }

    /// A step is made.
    pub(super) fn made(&mut self, step: Step, now_ns: i64) {
        match step {
            Step::Begin => {
                self.seen_ns = Some(self.submit(self.ms.visibility, now_ns));
                self.shade(now_ns);
            }
            Step::Place => {
                (self.seen_ns, self.is_placed) = (None, true);
                self.placed_ns = now_ns + ns(self.ms.placement);
            }
            Step::Shade => self.shade(now_ns),
            Step::Collect => {
                self.shaded_ns = None;
                self.overlap.note(StepTimes {
                    device_ns: ns(self.ms.visibility) + ns(self.ms.shading),
                    placement_ns: ns(self.ms.placement),
                    encode_ns: self.encode_ns,
                });
            }
            Step::Wait => {}
        }
    }

    /// When the device or the CPU comes further.
    pub(super) fn next_ns(&self, now_ns: i64) -> Option<i64> {
        let events = [self.seen_ns, self.shaded_ns, Some(self.placed_ns)];
        events.into_iter().flatten().filter(|at_ns| *at_ns > now_ns).min()
    }

    fn shade(&mut self, now_ns: i64) {
        if std::mem::take(&mut self.is_placed) {
            self.shaded_ns = Some(self.submit(self.ms.shading, now_ns));
        }
    }

    fn submit(&mut self, ms: f64, now_ns: i64) -> i64 {
        self.device_ns = self.device_ns.max(now_ns) + ns(ms);
        self.device_ns
    }
}

fn ns(ms: f64) -> i64 {
    (ms * 1e6) as i64
}
