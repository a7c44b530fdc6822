//! What the motion of vertices costs the server's processor. Whoever wants to know gives the clock; without one, nothing is
//! measured.

/// CPU time by part, summed over the updates of a world.
#[derive(Clone, Copy, Debug, Default)]
pub struct Effort {
    clock_ns: Option<fn() -> i64>,
    animation_ns: i64,
    delta_ns: i64,
}

/// When a part began, by the clock that was given.
#[derive(Clone, Copy, Debug)]
pub struct Began(i64);

impl Effort {
    /// Measures from now on by this clock, in nanoseconds: that of the calling thread's CPU time tells it from the device's
    /// where the device is a CPU.
    pub fn measure_by(&mut self, clock_ns: fn() -> i64) {
        self.clock_ns = Some(clock_ns);
    }

    /// A part begins.
    pub fn begin(&self) -> Began {
        Began(self.now_ns())
    }

    /// It was the posing of what moves, and the recording of its way through the device.
    pub(crate) fn add_animation(&mut self, Began(began_ns): Began) {
        self.animation_ns += self.now_ns() - began_ns;
    }

    /// It was the choice of what a client is told, predictions included.
    pub fn add_delta(&mut self, Began(began_ns): Began) {
        self.delta_ns += self.now_ns() - began_ns;
    }

    /// Milliseconds of animation so far.
    pub fn animation_ms(&self) -> f64 {
        self.animation_ns as f64 * 1e-6
    }

    /// Milliseconds of deltas so far, without their coding.
    pub fn delta_ms(&self) -> f64 {
        self.delta_ns as f64 * 1e-6
    }

    fn now_ns(&self) -> i64 {
        self.clock_ns.map_or(0, |clock_ns| clock_ns())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicI64, Ordering};

    static TICKS: AtomicI64 = AtomicI64::new(0);

    #[test]
    fn parts_are_counted_apart_and_only_by_a_clock() {
        let mut effort = Effort::default();
        effort.add_delta(effort.begin());
        assert_eq!((effort.animation_ms(), effort.delta_ms()), (0.0, 0.0));
        effort.measure_by(|| TICKS.fetch_add(1_000_000, Ordering::Relaxed));
        let (outer, inner) = (effort.begin(), effort.begin());
        effort.add_delta(inner);
        effort.add_animation(outer);
        assert_eq!((effort.animation_ms(), effort.delta_ms()), (3.0, 1.0));
    }
}
