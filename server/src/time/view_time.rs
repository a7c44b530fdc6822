//! Times at which the scene is skinned on the GPU: those of the time grid, which updates share, and some between. Pure.

use crate::time::RingPlace;
use shadecast_protocol::time::{Grid, GridIndex, WorldTime};

/// Times from one point of the grid to the next, that of the first included.
const PARTS: i64 = 4;

/// A point of the time grid, or a part of the way to the next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ViewTime {
    grid: GridIndex,
    part: u8,
}

impl From<GridIndex> for ViewTime {
    fn from(grid: GridIndex) -> Self {
        Self { grid, part: 0 }
    }
}

impl ViewTime {
    /// The nearest to a time: no farther than an eighth of the grid's spacing.
    pub(crate) fn nearest(grid: Grid, time: WorldTime) -> Self {
        let before = grid.floor(time);
        let passed_ns = time.since(grid.time_of(before)).clamp(0, grid.spacing_ns);
        match (passed_ns * PARTS + grid.spacing_ns / 2) / grid.spacing_ns {
            PARTS => Self::from(before.plus(1)),
            part => Self { grid: before, part: part as u8 },
        }
    }

    /// When it is.
    pub(crate) fn time(self, grid: Grid) -> WorldTime {
        grid.time_of(self.grid).plus_ns(i64::from(self.part) * grid.spacing_ns / PARTS)
    }
}

/// Which time each place holds: the times that were used last.
#[derive(Clone, Debug)]
pub(crate) struct HeldTimes {
    held: Vec<Held>,
    uses: u64,
}

#[derive(Clone, Copy, Debug, Default)]
struct Held {
    time: Option<ViewTime>,
    /// The number of its last use.
    used: u64,
}

impl HeldTimes {
    /// So many places, in which nothing is.
    pub(crate) fn new(places: u32) -> Self {
        Self { held: vec![Held::default(); places as usize], uses: 0 }
    }

    /// The places of different times, of which there are no more than places: a time that is held has its place, the others those
    /// whose last use is longest ago. The last of the times is used last.
    pub(crate) fn take<const N: usize>(&mut self, times: [ViewTime; N]) -> [RingPlace; N] {
        let first_use = self.uses + 1;
        for time in times {
            self.uses += 1;
            if let Some(held) = self.held.iter_mut().find(|held| held.time == Some(time)) {
                held.used = self.uses;
            }
        }
        let mut used = first_use;
        times.map(|time| {
            let found = self.held.iter().position(|held| held.time == Some(time));
            let place = found.unwrap_or_else(|| {
                let all = self.held.iter().enumerate().filter(|(_, held)| held.used < first_use);
                let oldest = all.min_by_key(|(_, held)| held.used).map(|(place, _)| place);
                oldest.expect("no more times than places")
            });
            self.held[place] = Held { time: Some(time), used };
            used += 1;
            RingPlace(place as u32)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GRID: Grid = Grid { spacing_ns: 33_333_333 };

    #[test]
    fn no_time_is_farther_than_an_eighth_of_a_step() {
        for at in (-40_000_000..90_000_000).step_by(777_777).map(WorldTime) {
            let nearest = ViewTime::nearest(GRID, at);
            let apart_ns = nearest.time(GRID).since(at).abs();
            assert!(apart_ns <= GRID.spacing_ns / 8 + 2, "{at:?}: {apart_ns} ns");
        }
    }

    #[test]
    fn points_of_the_grid_are_themselves() {
        for point in (-3..40).map(GridIndex) {
            let nearest = ViewTime::nearest(GRID, GRID.time_of(point));
            assert_eq!((nearest, nearest.time(GRID)), (ViewTime::from(point), GRID.time_of(point)));
        }
    }

    #[test]
    fn a_held_time_keeps_its_place() {
        let at = |points: [i32; 3]| points.map(|point| ViewTime::from(GridIndex(point)));
        let mut times = HeldTimes::new(4);
        let first = times.take(at([10, 14, 12]));
        let again = times.take(at([10, 14, 12]));
        assert_eq!(first, again);
        let next = times.take(at([11, 15, 13]));
        assert!(!next.contains(&first[2]), "the last of an update's times outlives the next update's");
        assert_eq!(times.take(at([12, 15, 13]))[0], first[2]);
        let one = times.take(at([40, 40, 40]));
        assert_eq!(one, [one[0]; 3]);
        let three = times.take(at([40, 41, 42]));
        assert!(three[0] != three[1] && three[1] != three[2] && three[2] != three[0], "{three:?}");
    }

    #[test]
    fn times_beyond_the_grid_fall_on_its_ends() {
        for time in [i64::MIN, i64::MAX] {
            let nearest = ViewTime::nearest(Grid { spacing_ns: 1_000_000 }, WorldTime(time));
            assert!(usize::from(nearest.part) < PARTS as usize);
        }
    }
}
