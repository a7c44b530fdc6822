//! How long the scopes of a recording took on the device: told to whoever waits for its ticket, and to nobody else.

use std::collections::VecDeque;

/// Recordings whose timings are kept until they are asked for. Of more the oldest are forgotten: nobody wants them.
const MAX_KEPT: usize = 64;

/// What a scope took on the device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Timing {
    /// Its name.
    pub scope: &'static str,
    /// By the device's clock, nanoseconds from a moment of its own.
    pub began_ns: i64,
    /// How long it took, nanoseconds.
    pub took_ns: i64,
}

/// What scopes took on the device.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Timings(Vec<Timing>);

/// The timings of finished recordings by their serial, ascending.
#[derive(Default)]
pub(crate) struct KeptTimings(VecDeque<(u64, Timings)>);

impl Timings {
    /// Names of scopes with their milliseconds, in the order of recording. A scope that was recorded twice is there twice.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, f64)> + '_ {
        self.0.iter().map(|timing| (timing.scope, timing.took_ns as f64 * 1e-6))
    }

    /// The same, and when each began.
    pub fn scopes(&self) -> &[Timing] {
        &self.0
    }

    /// Those of a later recording behind its own.
    pub fn append(&mut self, later: Self) {
        self.0.extend(later.0);
    }
}

impl FromIterator<Timing> for Timings {
    fn from_iter<T: IntoIterator<Item = Timing>>(timings: T) -> Self {
        Self(timings.into_iter().collect())
    }
}

impl KeptTimings {
    /// Keeps the timings of a recording that has just finished. Nothing is allocated once there are as many as are kept.
    pub(crate) fn keep(&mut self, serial: u64, scopes: impl Iterator<Item = Timing>) {
        let oldest = if self.0.len() < MAX_KEPT { None } else { self.0.pop_front() };
        let mut timings = oldest.map_or_else(Timings::default, |(_, forgotten)| forgotten);
        timings.0.clear();
        timings.0.extend(scopes);
        self.0.push_back((serial, timings));
    }

    /// Those of a recording, once; none where it had no scopes.
    pub(crate) fn take(&mut self, serial: u64) -> Timings {
        let place = self.0.binary_search_by_key(&serial, |(kept, _)| *kept);
        place.ok().and_then(|place| self.0.remove(place)).map_or_else(Timings::default, |(_, found)| found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn timing(scope: &'static str, ms: i64) -> Timing {
        Timing { scope, began_ns: 0, took_ns: ms * 1_000_000 }
    }

    #[test]
    fn timings_are_told_once_and_to_who_has_the_ticket() {
        let mut kept = KeptTimings::default();
        kept.keep(3, [timing("skin", 1)].into_iter());
        kept.keep(5, [timing("mark", 2), timing("mark", 3)].into_iter());
        assert_eq!(kept.take(4), Timings::default());
        assert_eq!(kept.take(3).iter().collect::<Vec<_>>(), [("skin", 1.0)]);
        assert_eq!(kept.take(3), Timings::default());
        assert_eq!(kept.take(5).iter().collect::<Vec<_>>(), [("mark", 2.0), ("mark", 3.0)]);
    }

    #[test]
    fn where_nobody_asks_the_oldest_are_forgotten() {
        let mut kept = KeptTimings::default();
        (0..1000).for_each(|serial| kept.keep(serial, [timing("skin", serial as i64)].into_iter()));
        assert_eq!(kept.0.len(), MAX_KEPT);
        assert_eq!(kept.take(999 - MAX_KEPT as u64), Timings::default());
        assert_eq!(kept.take(999).iter().collect::<Vec<_>>(), [("skin", 999.0)]);
    }
}
