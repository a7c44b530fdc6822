//! World time from the server's clock: it advances with the clock, except while the world is halted. Both sides convert by the
//! same halts, so they cannot disagree. World time never jumps, and never goes back.

use crate::time::{ServerTime, WorldTime};
use crate::wire::{WireError, invalid};
use serde::{Deserialize, Serialize};

/// Halts that are remembered; older ones are only counted.
pub const MAX_HALTS: usize = 16;
/// By how much a step lets a halted world go on, nanoseconds: a thirtieth of a second.
pub const STEP_NS: i64 = 33_333_333;
/// Steps in a row that count, until they are done.
const MAX_STEPS: u8 = 30;
/// A change that comes late is blended in within this time, nanoseconds.
const BLEND_NS: i64 = 200_000_000;
/// Later than that and it is followed at once, nanoseconds.
const MAX_BLENDED_NS: i64 = 2_000_000_000;
/// Times beyond these (36 years) are nonsense, and sums of them would overflow.
const MAX_TIME_NS: i64 = 1 << 60;

/// What a person wants of the world's time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Steer {
    /// That it stands.
    Halt,
    /// That it goes on.
    GoOn,
    /// That it stands, if it goes, and otherwise goes on by [`STEP_NS`].
    Step,
}

/// What a person has wanted in a row, as far as it counts: of a fixed size, however much it was.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Steering {
    /// That the world goes on, or stands, before the steps.
    goes: Option<bool>,
    steps: u8,
}

impl From<Steer> for Steering {
    fn from(steer: Steer) -> Self {
        match steer {
            Steer::Halt => Self { goes: Some(false), steps: 0 },
            Steer::GoOn => Self { goes: Some(true), steps: 0 },
            Steer::Step => Self { goes: None, steps: 1 },
        }
    }
}

impl Steering {
    /// This, and then `later`.
    #[must_use]
    pub fn then(self, later: Self) -> Self {
        match later.goes {
            Some(_) => later,
            None => Self { steps: self.steps.saturating_add(later.steps).min(MAX_STEPS), ..self },
        }
    }

    /// Each of them.
    fn all(self) -> impl Iterator<Item = Steer> {
        let first = self.goes.map(|goes| if goes { Steer::GoOn } else { Steer::Halt });
        first.into_iter().chain((0..self.steps).map(|_| Steer::Step))
    }
}

/// A time in which the world stands still.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Halt {
    from: ServerTime,
    /// `None`: until somebody lets it go on.
    until: Option<ServerTime>,
}

/// See the module. Two that are equal give equal times; the opposite need not be so.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorldClock {
    /// By how much the world was behind the server's clock before the first of the halts, nanoseconds.
    behind_ns: i64,
    /// By rising times, none within another; only the last may be without an end. Those that are `None` come last.
    halts: [Option<Halt>; MAX_HALTS],
}

impl WorldClock {
    /// The world's time when the server's clock says `at`.
    pub fn world_time(&self, at: ServerTime) -> WorldTime {
        let stood_ns = |halt: &Halt| halt.until.map_or(at, |until| until.min(at)).since(halt.from).max(0);
        let halted_ns = self.halts().map(stood_ns).fold(0, i64::saturating_add);
        WorldTime(at.0.saturating_sub(self.behind_ns).saturating_sub(halted_ns))
    }

    /// Whether the world stands once all has come that is known to come.
    pub fn will_stand(&self) -> bool {
        self.halts().last().is_some_and(|halt| halt.until.is_none())
    }

    /// Does what a person wants, from `at` on. What was to come at `at` or later counts no more, except of steps: they add up.
    pub fn steer(&mut self, wanted: impl Into<Steering>, at: ServerTime) {
        wanted.into().all().for_each(|steer| self.steer_once(steer, at));
    }

    fn steer_once(&mut self, steer: Steer, at: ServerTime) {
        match steer {
            Steer::Halt => self.halt(at),
            Steer::GoOn => self.go_on(at),
            Steer::Step if self.will_stand() => self.step(at),
            Steer::Step => self.halt(at),
        }
    }

    fn halt(&mut self, at: ServerTime) {
        match self.last() {
            Some(Halt { until: None, .. }) => {}
            // It was to go on just then, or later.
            Some(Halt { until: Some(until), .. }) if *until >= at => {
                self.last().into_iter().for_each(|halt| halt.until = None);
            }
            _ => self.push(at),
        }
    }

    fn go_on(&mut self, at: ServerTime) {
        let count = self.halts().count();
        match self.last() {
            Some(Halt { from, until: None }) if *from >= at => self.halts[count - 1] = None,
            Some(Halt { until: until @ None, .. }) => *until = Some(at),
            _ => {}
        }
    }

    /// The world stands from some time on.
    fn step(&mut self, at: ServerTime) {
        let Some(last) = self.last() else { return };
        if last.from >= at {
            last.from = last.from.plus_ns(STEP_NS);
        } else {
            last.until = Some(at);
            self.push(at.plus_ns(STEP_NS));
        }
    }

    /// Halts that are over by `time` are only counted from now on: times before it are not asked for any more.
    pub fn forget_before(&mut self, time: ServerTime) {
        while self.first_end().is_some_and(|until| until <= time) {
            self.forget_first();
        }
    }

    fn first_end(&self) -> Option<ServerTime> {
        self.halts[0].and_then(|halt| halt.until)
    }

    fn forget_first(&mut self) {
        if let Some(Halt { from, until: Some(until) }) = self.halts[0] {
            self.behind_ns = self.behind_ns.saturating_add(until.since(from));
            self.halts.rotate_left(1);
            self.halts[MAX_HALTS - 1] = None;
        }
    }

    fn push(&mut self, from: ServerTime) {
        if self.halts().count() == MAX_HALTS {
            self.forget_first();
        }
        let count = self.halts().count();
        self.halts[count] = Some(Halt { from, until: None });
    }

    fn halts(&self) -> impl Iterator<Item = &Halt> {
        self.halts.iter().flatten()
    }

    fn last(&mut self) -> Option<&mut Halt> {
        self.halts.iter_mut().flatten().last()
    }

    /// That it can be evaluated.
    pub(crate) fn check(&self) -> Result<(), WireError> {
        let is_time = |ns: i64| (-MAX_TIME_NS..=MAX_TIME_NS).contains(&ns);
        let count = self.halts.iter().take_while(|halt| halt.is_some()).count();
        let gaps = self.halts[count..].iter().all(Option::is_none);
        let mut free = ServerTime(-MAX_TIME_NS);
        let mut is_good = gaps && is_time(self.behind_ns);
        for (number, Halt { from, until }) in (1..).zip(self.halts()) {
            let end = until.unwrap_or(ServerTime(MAX_TIME_NS));
            is_good &= is_time(from.0) && is_time(end.0) && free <= *from && *from < end;
            is_good &= until.is_some() || number == count;
            free = end;
        }
        let reason = "its halts do not follow each other, or a time in it makes no sense";
        if is_good { Ok(()) } else { Err(invalid("the world's clock", reason)) }
    }
}

/// The world's time as display frames see it: news that come too late are not seen as a jump.
#[derive(Clone, Copy, Debug, Default)]
pub struct ShownWorldClock {
    clock: WorldClock,
    /// Added to the clock's time at `since`, and less and less of it later, nanoseconds.
    left_ns: i64,
    since: ServerTime,
    /// The display frame that was shown last.
    shown: Option<ServerTime>,
}

impl ShownWorldClock {
    /// The world's time when the server's clock says `at`.
    pub fn world_time(&self, at: ServerTime) -> WorldTime {
        let to_go_ns = (BLEND_NS - at.since(self.since)).clamp(0, BLEND_NS);
        let left_ns = i128::from(self.left_ns) * i128::from(to_go_ns) / i128::from(BLEND_NS);
        self.clock.world_time(at).plus_ns(left_ns as i64)
    }

    /// The same, for a display frame that is seen then.
    pub fn show(&mut self, at: ServerTime) -> WorldTime {
        self.shown = Some(at);
        self.world_time(at)
    }

    /// Follows the server's news.
    pub fn follow(&mut self, clock: WorldClock) {
        let seen = self.shown.map(|shown| (shown, self.world_time(shown)));
        *self = Self { clock, shown: self.shown, ..Self::default() };
        let Some((shown, seen)) = seen else { return };
        let left_ns = seen.since(clock.world_time(shown));
        if left_ns.abs() <= MAX_BLENDED_NS {
            (self.left_ns, self.since) = (left_ns, shown);
        }
    }
}

#[cfg(test)]
mod tests;
