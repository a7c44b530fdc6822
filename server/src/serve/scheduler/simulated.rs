//! A device and the thread that drives it, in virtual time: each does one thing after the other, for all viewers. For drivers
//! whose stages take parameters instead of time.

use crate::pacing::overlap::{Flight, Step};
use std::collections::BTreeMap;

/// How long the steps of an update take, nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StepsNs {
    /// What the device needs to see.
    pub visibility: i64,
    /// What the thread needs to place that.
    pub placement: i64,
    /// What the device needs to shade it.
    pub shading: i64,
}

/// See the module. `V` names viewers.
#[derive(Clone, Debug)]
pub struct SimulatedDevice<V> {
    steps: StepsNs,
    /// When the device has done all that was submitted.
    device_ns: i64,
    /// When the thread has placed what it places.
    thread_ns: i64,
    in_flight: BTreeMap<V, InFlight>,
}

/// Updates of a viewer.
#[derive(Clone, Copy, Debug, Default)]
struct InFlight {
    seen_ns: Option<i64>,
    is_placed: bool,
    shaded_ns: Option<i64>,
}

impl<V: Copy + Ord> SimulatedDevice<V> {
    /// Idle; the steps of updates take so long.
    pub fn new(steps: StepsNs) -> Self {
        Self { steps, device_ns: 0, thread_ns: 0, in_flight: BTreeMap::new() }
    }

    /// When the thread can make the next step.
    pub fn thread_ns(&self) -> i64 {
        self.thread_ns
    }

    /// How far a viewer's updates have come.
    pub fn flight(&self, viewer: V, now_ns: i64) -> Flight {
        let InFlight { seen_ns, is_placed, shaded_ns } =
            self.in_flight.get(&viewer).copied().unwrap_or_default();
        let is_past = |at_ns: Option<i64>| at_ns.is_some_and(|at_ns| at_ns <= now_ns);
        Flight {
            is_begun: seen_ns.is_some(),
            is_seen: is_past(seen_ns),
            is_placed,
            is_in_work: shaded_ns.is_some(),
            is_shaded: is_past(shaded_ns),
        }
    }

    /// A step is made; gives what it takes of the thread, nanoseconds.
    pub fn made(&mut self, viewer: V, step: Step, now_ns: i64) -> i64 {
        let mut of = self.in_flight.get(&viewer).copied().unwrap_or_default();
        match step {
            Step::Begin => of.seen_ns = Some(self.submit(self.steps.visibility, now_ns)),
            Step::Place => (of.seen_ns, of.is_placed) = (None, true),
            Step::Collect => of.shaded_ns = None,
            Step::Shade | Step::Wait => {}
        }
        // What was placed before is shaded behind an update that begins.
        if matches!(step, Step::Begin | Step::Shade) && std::mem::take(&mut of.is_placed) {
            of.shaded_ns = Some(self.submit(self.steps.shading, now_ns));
        }
        self.in_flight.insert(viewer, of);
        let took_ns = if step == Step::Place { self.steps.placement } else { 0 };
        self.thread_ns = now_ns + took_ns;
        took_ns
    }

    /// What the device does for an update, nanoseconds.
    pub fn update_ns(&self) -> i64 {
        self.steps.visibility + self.steps.shading
    }

    /// A viewer has gone.
    pub fn leave(&mut self, viewer: V) {
        self.in_flight.remove(&viewer);
    }

    /// When the device comes further next.
    pub fn next_ns(&self, now_ns: i64) -> Option<i64> {
        let events = self.in_flight.values().flat_map(|of| [of.seen_ns, of.shaded_ns]);
        events.flatten().filter(|at_ns| *at_ns > now_ns).min()
    }

    fn submit(&mut self, took_ns: i64, now_ns: i64) -> i64 {
        self.device_ns = self.device_ns.max(now_ns) + took_ns;
        self.device_ns
    }
}
