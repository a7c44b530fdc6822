//! Times at which the scene is skinned on the GPU: those of the time grid, which updates share, and some between. Pure.

use crate::animation::{RING, RingPlace};
use shadecast_protocol::time::{Grid, GridIndex, ServerTime};

/// Times from one point of the grid to the next, that of the first included.
const PARTS: i64 = 4;
/// Places of the ring for times between points of the grid: this update's, and another viewer's.
const PLACES_BETWEEN: u32 = 2;
/// Places of the ring for points of the grid: one is at its number modulo this.
pub const GRID_PLACES: u32 = RING - PLACES_BETWEEN;

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
    pub fn nearest(grid: Grid, time: ServerTime) -> Self {
        let before = grid.floor(time);
        let passed_ns = time.since(grid.time_of(before)).clamp(0, grid.spacing_ns);
        match (passed_ns * PARTS + grid.spacing_ns / 2) / grid.spacing_ns {
            PARTS => Self::from(before.plus(1)),
            part => Self { grid: before, part: part as u8 },
        }
    }

    /// When it is.
    pub fn time(self, grid: Grid) -> ServerTime {
        grid.time_of(self.grid).plus_ns(i64::from(self.part) * grid.spacing_ns / PARTS)
    }

    /// Where in the ring its samples are.
    pub fn place(self) -> RingPlace {
        match self.part {
            0 => RingPlace(self.grid.0.rem_euclid(GRID_PLACES as i32) as u32),
            _ => RingPlace(GRID_PLACES + self.grid.0.rem_euclid(PLACES_BETWEEN as i32) as u32),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GRID: Grid = Grid { spacing_ns: 33_333_333 };

    #[test]
    fn no_time_is_farther_than_an_eighth_of_a_step() {
        for at in (-40_000_000..90_000_000).step_by(777_777).map(ServerTime) {
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
    fn what_one_update_needs_has_places_of_its_own() {
        for first in -20..20 {
            let between = ViewTime { grid: GridIndex(first + 5), part: 2 };
            let mut places: Vec<u32> =
                (first..first + GRID_PLACES as i32).map(|g| ViewTime::from(GridIndex(g)).place().0).collect();
            places.push(between.place().0);
            places.push(ViewTime { grid: GridIndex(first + 6), part: 1 }.place().0);
            places.sort_unstable();
            assert_eq!(places, (0..RING).collect::<Vec<_>>());
        }
    }

    #[test]
    fn times_beyond_the_grid_fall_on_its_ends() {
        for time in [i64::MIN, i64::MAX] {
            let nearest = ViewTime::nearest(Grid { spacing_ns: 1_000_000 }, ServerTime(time));
            assert!(nearest.place().0 < RING);
        }
    }
}
