//! Motion state of the vertices of the newest draw list, for the evaluation at a display time. It is small enough to go with
//! each batch of arrivals.

use super::arena::ArenaSerial;
use super::pace::Span;
use arrayvec::ArrayVec;
use shadecast_protocol::time::{Grid, GridIndex, WorldTime};

/// Ends that a [`Tally`] tells apart. Vertices run dry together: when updates end, and when a message is lost.
const MOST_ENDS: usize = 32;

/// How a display frame stands with samples and predictions.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Motionless {
    /// Vertices that go on at their last velocity, for at most one grid step.
    pub held: u32,
    /// Vertices that have stopped.
    pub frozen: u32,
}

/// How many vertices have samples or predictions up to when.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tally<K>(ArrayVec<(K, u32), MOST_ENDS>);

impl<K> Default for Tally<K> {
    fn default() -> Self {
        Self(ArrayVec::new())
    }
}

impl<K: Copy + Ord> Tally<K> {
    /// Counts a vertex that has them up to `end`. Of more ends than there is room for, the earliest are taken for one.
    pub(super) fn count(&mut self, end: K) {
        // Neighbours mostly end together.
        if let Some((_, count)) = self.0.iter_mut().rfind(|(known, _)| *known == end) {
            *count += 1;
            return;
        }
        if self.0.is_full() {
            self.0.sort_unstable_by_key(|(end, _)| *end);
            let (_, earliest) = self.0.remove(0);
            self.0[0].1 += earliest;
        }
        self.0.push((end, 1));
    }

    /// The first end.
    pub(super) fn least(&self) -> Option<K> {
        self.0.iter().map(|(end, _)| *end).min()
    }

    /// Vertices whose end `is_meant`.
    fn sum(&self, mut is_meant: impl FnMut(K) -> bool) -> u32 {
        self.0.iter().filter(|(end, _)| is_meant(*end)).map(|(_, count)| count).sum()
    }
}

/// See the module.
#[derive(Clone, Debug)]
pub struct MotionState {
    /// Vertex slots from 0 on that have ever been used.
    pub vertex_count: u32,
    /// The last write that the arena has, once what is handed over with this is copied.
    pub written: ArenaSerial,
    /// Bytes that wait for the arena.
    pub arena_waiting_bytes: u64,
    /// Steps at which all of the list can be evaluated, as far as its patches wait for none.
    pub span: Span,
    /// Last steps of its vertices with samples.
    pub(super) lasts: Tally<GridIndex>,
    /// Last times of its vertices with predictions.
    pub(super) untils: Tally<WorldTime>,
}

impl Default for MotionState {
    /// Of no list.
    fn default() -> Self {
        Self {
            vertex_count: 0,
            written: ArenaSerial::default(),
            arena_waiting_bytes: 0,
            span: Span { first: GridIndex(i32::MIN), last: GridIndex(i32::MAX) },
            lasts: Tally::default(),
            untils: Tally::default(),
        }
    }
}

impl MotionState {
    /// Vertices of the list that have run out of samples or predictions at a display time.
    pub fn motionless(&self, grid: Grid, time: WorldTime) -> Motionless {
        let step = grid.floor(time);
        Motionless {
            held: self.lasts.sum(|last| last == step),
            frozen: self.lasts.sum(|last| last < step) + self.untils.sum(|until| until < time),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_vertex_is_left_out_however_many_ends_there_are() {
        let mut tally = Tally::default();
        (0..1000).for_each(|end| tally.count(end % 100));
        assert_eq!(tally.sum(|_| true), 1000);
        assert_eq!(tally.sum(|end| end == 99), 10, "the latest are told apart");
        assert_eq!(tally.0.len(), MOST_ENDS);
    }
}
