//! The one evaluation time of all vertices of the draw list on display. No triangle has corners of two times.
//!
//! It is the display time while every drawn vertex has samples there, and for one more grid step by its last velocity. When
//! some vertices run out of samples, all stay, until those get samples or another list is displayed. Then the time catches up
//! with the display's, without a jump as far as samples reach back.

use shadecast_protocol::time::{Grid, GridIndex, ServerTime, WorldTime};

/// A jump is blended away within this time.
pub const BLEND_NS: i64 = 200_000_000;

/// A time on the sample grid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridTime {
    /// The last step at or before the time.
    pub step: GridIndex,
    /// The way from there to the next step, 0..=1.
    pub fraction: f32,
}

/// Grid steps, both ends included, at which every vertex drawn can be evaluated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Span {
    /// The first.
    pub first: GridIndex,
    /// The last; the one after it is reached by the last velocity.
    pub last: GridIndex,
}

/// A time to evaluate at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Evaluation {
    /// All vertices move here.
    pub at: WorldTime,
    /// Where they were.
    pub before: WorldTime,
    /// Nanoseconds by which this display frame is seen after the one before.
    pub elapsed_ns: i64,
}

/// See the module.
#[derive(Clone, Copy, Debug, Default)]
pub struct Pace {
    shown: Option<Shown>,
    /// When the display's time is to be caught up with.
    caught_up: ServerTime,
}

/// A display frame.
#[derive(Clone, Copy, Debug)]
struct Shown {
    /// The time that is shown.
    at: WorldTime,
    /// The time that was due.
    due: WorldTime,
    /// When it was seen.
    seen: ServerTime,
}

impl GridTime {
    /// Where `time` lies on `grid`.
    pub fn of(grid: Grid, time: WorldTime) -> Self {
        let step = grid.floor(time);
        let since_ns = time.since(grid.time_of(step));
        Self { step, fraction: (since_ns as f64 / grid.spacing_ns as f64).clamp(0.0, 1.0) as f32 }
    }
}

impl Pace {
    /// The time that is shown.
    pub fn shown(&self) -> Option<WorldTime> {
        self.shown.map(|shown| shown.at)
    }

    /// The time for a display frame that is seen at `now`, when `due` is the world's time; `None`: all stay where they are. `span`
    /// is that of the list on display, `has_switched` true in the frame in which it comes there.
    pub fn advance(
        &mut self,
        grid: Grid,
        (now, due): (ServerTime, WorldTime),
        span: Span,
        has_switched: bool,
    ) -> Option<Evaluation> {
        let Shown { at: before, seen, .. } = self.shown.unwrap_or(Shown { at: due, due, seen: now });
        let is_first = self.shown.is_none() || has_switched;
        let wanted = not_before(grid, span.first, due.plus_ns(-self.lag_ns(now)), due);
        let at = wanted.min(grid.time_of(span.last.plus(1)));
        let stays = !is_first && (at == before || GridTime::of(grid, at).step < span.first);
        // A world that stands is not behind.
        if at < wanted || (stays && before != due) {
            self.caught_up = now.plus_ns(BLEND_NS);
        }
        self.shown = Some(Shown { at: if stays { before } else { at }, due, seen: now });
        (!stays).then_some(Evaluation { at, before, elapsed_ns: now.since(seen).max(0) })
    }

    /// How far the vertices stay behind the display time `now` while they catch up with it.
    fn lag_ns(&self, now: ServerTime) -> i64 {
        let Some(Shown { at, due, seen }) = self.shown else { return 0 };
        let (lag_ns, left_ns) = (due.since(at).max(0), self.caught_up.since(now).max(0));
        let whole_ns = self.caught_up.since(seen).max(left_ns).max(1);
        (i128::from(lag_ns) * i128::from(left_ns) / i128::from(whole_ns)) as i64
    }
}

/// `wanted`, or the first time at which all can be evaluated, where that has been reached.
fn not_before(grid: Grid, first: GridIndex, wanted: WorldTime, now: WorldTime) -> WorldTime {
    let start = grid.time_of(first);
    if start <= now { wanted.max(start) } else { wanted }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GRID: Grid = Grid { spacing_ns: 30_000_000 };
    const MS: i64 = 1_000_000;

    fn at(ms: i64) -> WorldTime {
        WorldTime(ms * MS)
    }

    /// A display frame of a world that goes on.
    fn seen(ms: i64) -> (ServerTime, WorldTime) {
        (ServerTime(ms * MS), at(ms))
    }

    fn span(first: i32, last: i32) -> Span {
        Span { first: GridIndex(first), last: GridIndex(last) }
    }

    /// What is shown at a display time, milliseconds.
    fn shown_ms(pace: &mut Pace, now_ms: i64, span: Span, has_switched: bool) -> i64 {
        pace.advance(GRID, seen(now_ms), span, has_switched);
        pace.shown().expect("shown").0 / MS
    }

    #[test]
    fn with_samples_the_time_is_that_of_the_display() {
        let mut pace = Pace::default();
        for ms in (1000..1300).step_by(11) {
            let evaluation = pace.advance(GRID, seen(ms), span(30, 50), ms % 3 == 0).expect("it moves");
            assert_eq!(evaluation.at, at(ms));
            assert_eq!(evaluation.before, at(if ms == 1000 { 1000 } else { ms - 11 }));
        }
    }

    #[test]
    fn without_samples_all_go_on_for_one_step_and_then_stay() {
        let mut pace = Pace::default();
        let mut see = |ms| shown_ms(&mut pace, ms, span(30, 34), false);
        assert_eq!([1020, 1040, 1051, 1070, 5000].map(&mut see), [1020, 1040, 1050, 1050, 1050]);
        assert_eq!(pace.advance(GRID, seen(5010), span(30, 34), false), None, "nothing has moved");
    }

    #[test]
    fn with_samples_again_the_time_catches_up_without_a_jump() {
        let mut pace = Pace::default();
        let mut last = shown_ms(&mut pace, 1040, span(30, 34), false);
        for ms in (1050..=1150).step_by(10) {
            last = shown_ms(&mut pace, ms, span(30, 34), false);
        }
        assert_eq!(last, 1050);
        for ms in (1160..=1360).step_by(10) {
            let now = shown_ms(&mut pace, ms, span(30, 60), false);
            assert!((10..=16).contains(&(now - last)), "{last} to {now} at {ms}");
            last = now;
        }
        assert_eq!(last, 1360, "caught up within 200 ms of the last frame that stood still");
    }

    #[test]
    fn in_a_halted_world_late_samples_catch_up() {
        let mut pace = Pace::default();
        let mut see = |ms: i64, world_ms: i64, last: i32| {
            let evaluation = pace.advance(GRID, (ServerTime(ms * MS), at(world_ms)), span(30, last), false);
            (evaluation.is_some(), pace.shown().expect("shown").0 / MS)
        };
        see(1040, 1040, 60);
        assert_eq!(see(1050, 1045, 60), (true, 1045));
        assert_eq!([1060, 2000].map(|ms| see(ms, 1045, 60)), [(false, 1045); 2]);
        assert_eq!(see(2010, 1055, 60), (true, 1055), "it goes on from there, not behind");
        // Samples end at 1080 ms while it goes on to 1140, where it stands; then they come.
        for ms in (2020..=2100).step_by(10) {
            see(ms, (ms - 955).min(1140), 35);
        }
        assert_eq!(see(2110, 1140, 35), (false, 1080));
        for ms in (2120..=2310).step_by(10) {
            see(ms, 1140, 60);
        }
        assert_eq!(see(2320, 1140, 60).1, 1140, "caught up within 200 ms");
    }

    #[test]
    fn a_new_list_is_shown_from_where_all_of_it_has_samples() {
        let mut pace = Pace::default();
        shown_ms(&mut pace, 1000, span(30, 30), false);
        assert_eq!(shown_ms(&mut pace, 1200, span(30, 30), false), 930);
        // The samples of what is new reach back to step 38: 1140 ms.
        assert_eq!(shown_ms(&mut pace, 1210, span(38, 60), true), 1140);
        assert!((1150..1160).contains(&shown_ms(&mut pace, 1220, span(38, 60), false)));
        assert_eq!(shown_ms(&mut pace, 1410, span(38, 60), false), 1410);
    }

    #[test]
    fn where_old_samples_are_gone_and_new_ones_begin_later_all_stay() {
        let mut pace = Pace::default();
        shown_ms(&mut pace, 1000, span(30, 40), false);
        assert_eq!(shown_ms(&mut pace, 1010, span(36, 40), false), 1000, "step 36 is at 1080 ms");
        assert_eq!(shown_ms(&mut pace, 1085, span(36, 40), false), 1080);
    }

    #[test]
    fn a_list_without_animated_vertices_never_stays() {
        let mut pace = Pace::default();
        let all = span(i32::MIN, i32::MAX);
        assert_eq!([5, 10, 1_000_000].map(|ms| shown_ms(&mut pace, ms, all, false)), [5, 10, 1_000_000]);
    }

    #[test]
    fn times_at_the_ends_of_what_a_clock_can_say_do_not_overflow() {
        let mut pace = Pace::default();
        let ends = [i32::MIN, -1, 0, i32::MAX];
        for now in [i64::MIN, -1, 0, 1, i64::MAX, i64::MIN] {
            for (first, last) in ends.into_iter().flat_map(|first| ends.map(|last| (first, last))) {
                for has_switched in [false, true] {
                    pace.advance(GRID, (ServerTime(now), WorldTime(now)), span(first, last), has_switched);
                }
            }
        }
    }
}
