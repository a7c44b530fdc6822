//! Time on the server's clock and on the client's, world time, and the absolute sample grid.
//!
//! Nothing here converts between them. In the wire crate, `clock` converts between the two clocks, and `world_clock` between
//! the server's clock and world time.

use serde::{Deserialize, Serialize};

/// Nanoseconds on the server's clock; 0 is the start of the session's scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct ServerTime(pub i64);

/// Nanoseconds of the world in motion: what animation, paths and light are functions of. It goes on with the server's clock, except
/// while the world is paused.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct WorldTime(pub i64);

/// Nanoseconds on the client's monotonic clock (on Linux and Android `CLOCK_MONOTONIC`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct ClientTime(pub i64);

/// Number of a sample on the absolute grid: sample `g` is the pose at `g * spacing`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct GridIndex(pub i32);

/// Spacing of the sample grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Grid {
    /// Nanoseconds between two samples; positive.
    pub spacing_ns: i64,
}

/// 33.3 ms: three samples cover the paper's 100 ms.
pub const DEFAULT_GRID: Grid = Grid { spacing_ns: 33_333_333 };

macro_rules! points_in_time {
    ($($name:ident),*) => {
        $(impl $name {
            /// This time, moved by `ns` nanoseconds.
            pub fn plus_ns(self, ns: i64) -> Self {
                Self(self.0.saturating_add(ns))
            }

            /// Nanoseconds from `earlier` to this time; negative when `earlier` is later.
            pub fn since(self, earlier: Self) -> i64 {
                self.0.saturating_sub(earlier.0)
            }
        })*
    };
}

points_in_time!(ServerTime, WorldTime, ClientTime);

impl ServerTime {
    /// Seconds since the session's start.
    pub fn seconds(self) -> f64 {
        self.0 as f64 * 1e-9
    }
}

impl WorldTime {
    /// Seconds since the scene's start.
    pub fn seconds(self) -> f64 {
        self.0 as f64 * 1e-9
    }
}

impl GridIndex {
    /// The sample `n` places later.
    pub fn plus(self, n: i32) -> Self {
        Self(self.0.saturating_add(n))
    }
}

impl Grid {
    /// When sample `g` is.
    pub fn time_of(self, g: GridIndex) -> WorldTime {
        WorldTime(i64::from(g.0) * self.spacing_ns)
    }

    /// The last sample at or before `t`; at the ends of what an index can name, the last or first there is.
    pub fn floor(self, t: WorldTime) -> GridIndex {
        clamped(t.0.div_euclid(self.spacing_ns))
    }

    /// The first sample at or after `t`; at the ends of what an index can name, the last or first there is.
    pub fn ceil(self, t: WorldTime) -> GridIndex {
        let is_between = t.0.rem_euclid(self.spacing_ns) != 0;
        clamped(t.0.div_euclid(self.spacing_ns) + i64::from(is_between))
    }

    /// The sample nearest to `t`.
    pub fn nearest(self, t: WorldTime) -> GridIndex {
        self.floor(t.plus_ns(self.spacing_ns / 2))
    }
}

fn clamped(index: i64) -> GridIndex {
    GridIndex(index.clamp(i64::from(i32::MIN), i64::from(i32::MAX)) as i32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grid_rounds_towards_the_named_side_also_before_zero() {
        let grid = Grid { spacing_ns: 10 };
        assert_eq!(grid.floor(WorldTime(-1)), GridIndex(-1));
        assert_eq!(grid.ceil(WorldTime(-1)), GridIndex(0));
        assert_eq!(grid.floor(WorldTime(19)), GridIndex(1));
        assert_eq!(grid.ceil(WorldTime(11)), GridIndex(2));
        assert_eq!(grid.ceil(WorldTime(20)), GridIndex(2));
        assert_eq!(grid.nearest(WorldTime(14)), GridIndex(1));
        assert_eq!(grid.nearest(WorldTime(15)), GridIndex(2));
    }

    #[test]
    fn times_beyond_the_grid_fall_on_its_ends_instead_of_overflowing() {
        let grid = Grid { spacing_ns: 1_000_000 };
        for (time, end) in [(i64::MIN, i32::MIN), (i64::MAX, i32::MAX)] {
            assert_eq!(grid.floor(WorldTime(time)), GridIndex(end));
            assert_eq!(grid.ceil(WorldTime(time)), GridIndex(end));
            assert_eq!(grid.nearest(WorldTime(time)), GridIndex(end));
        }
    }
}
