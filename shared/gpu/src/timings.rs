//! Device times of a recording's scopes, for the owner of its ticket only.

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

/// The timings of finished recordings.
#[derive(Default)]
pub(crate) struct KeptTimings {
    /// By their serial, ascending.
    kept: VecDeque<(u64, Timings)>,
    /// Memory of those that were taken.
    spare: Vec<Timings>,
}

impl Timings {
    /// Names of scopes with their milliseconds, in the order of recording. A scope that was recorded twice is there twice.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, f64)> + '_ {
        self.0.iter().map(|timing| (timing.scope, timing.took_ns as f64 * 1e-6))
    }

    /// The same, and when each began.
    pub fn scopes(&self) -> &[Timing] {
        &self.0
    }

    /// Forgets them; their memory stays.
    pub fn clear(&mut self) {
        self.0.clear();
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
        let oldest = if self.kept.len() < MAX_KEPT { None } else { self.kept.pop_front() };
        let forgotten = oldest.map(|(_, forgotten)| forgotten);
        let mut timings = forgotten.or_else(|| self.spare.pop()).unwrap_or_default();
        timings.0.clear();
        timings.0.extend(scopes);
        // Two queues do not finish in the order of their serials.
        let place = self.kept.partition_point(|(kept, _)| *kept < serial);
        self.kept.insert(place, (serial, timings));
    }

    /// Adds those of a recording to others, once; none where it had no scopes.
    pub(crate) fn take(&mut self, serial: u64, into: &mut Timings) {
        let Ok(place) = self.kept.binary_search_by_key(&serial, |(kept, _)| *kept) else { return };
        if let Some((_, found)) = self.kept.remove(place) {
            into.0.extend_from_slice(&found.0);
            self.spare.push(found);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn timing(scope: &'static str, ms: i64) -> Timing {
        Timing { scope, began_ns: 0, took_ns: ms * 1_000_000 }
    }

    fn taken(kept: &mut KeptTimings, serial: u64) -> Timings {
        let mut taken = Timings::default();
        kept.take(serial, &mut taken);
        taken
    }

    #[test]
    fn timings_are_told_once_and_to_who_has_the_ticket() {
        let mut kept = KeptTimings::default();
        kept.keep(3, [timing("skin", 1)].into_iter());
        kept.keep(5, [timing("mark", 2), timing("mark", 3)].into_iter());
        assert_eq!(taken(&mut kept, 4), Timings::default());
        assert_eq!(taken(&mut kept, 3).iter().collect::<Vec<_>>(), [("skin", 1.0)]);
        assert_eq!(taken(&mut kept, 3), Timings::default());
        kept.keep(6, [timing("skin", 4)].into_iter());
        let mut both = taken(&mut kept, 5);
        kept.take(6, &mut both);
        assert_eq!(both.iter().collect::<Vec<_>>(), [("mark", 2.0), ("mark", 3.0), ("skin", 4.0)]);
    }

    #[test]
    fn recordings_that_finish_in_another_order_have_their_timings_too() {
        let mut kept = KeptTimings::default();
        [4, 2, 3, 1]
            .into_iter()
            .for_each(|serial| kept.keep(serial, [timing("skin", serial as i64)].into_iter()));
        for serial in 1..=4 {
            assert_eq!(taken(&mut kept, serial).iter().collect::<Vec<_>>(), [("skin", serial as f64)]);
        }
    }

    #[test]
    fn where_nobody_asks_the_oldest_are_forgotten() {
        let mut kept = KeptTimings::default();
        (0..1000).for_each(|serial| kept.keep(serial, [timing("skin", serial as i64)].into_iter()));
        assert_eq!(kept.kept.len(), MAX_KEPT);
        assert_eq!(taken(&mut kept, 999 - MAX_KEPT as u64), Timings::default());
        assert_eq!(taken(&mut kept, 999).iter().collect::<Vec<_>>(), [("skin", 999.0)]);
    }
}
