//! How the world's time follows the server's clock: it goes on with it, except while the world is halted. Both sides turn one into
//! the other by the same halts, so that they cannot disagree. The world's time never jumps, and never goes back.

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
mod tests {
    use super::*;
    use crate::testing::Dice;

    fn ms(ms: i64) -> ServerTime {
        ServerTime(ms * 1_000_000)
    }

    fn world_ms(clock: &WorldClock, at_ms: i64) -> i64 {
        clock.world_time(ms(at_ms)).0 / 1_000_000
    }

    #[test]
    fn until_it_is_halted_the_worlds_time_is_the_servers() {
        let clock = WorldClock::default();
        for ns in [i64::MIN, -5, 0, 7, i64::MAX] {
            assert_eq!(clock.world_time(ServerTime(ns)), WorldTime(ns));
        }
        assert!(!clock.will_stand());
    }

    #[test]
    fn a_halted_world_stands_and_goes_on_from_where_it_stood() {
        let mut clock = WorldClock::default();
        clock.steer(Steer::Halt, ms(1000));
        assert!(clock.will_stand());
        assert_eq!([900, 1000, 5000].map(|at| world_ms(&clock, at)), [900, 1000, 1000]);
        clock.steer(Steer::Halt, ms(2000));
        clock.steer(Steer::GoOn, ms(3000));
        clock.steer(Steer::GoOn, ms(3500));
        assert!(!clock.will_stand());
        assert_eq!([900, 2000, 3000, 3100].map(|at| world_ms(&clock, at)), [900, 1000, 1000, 1100]);
    }

    #[test]
    fn a_halt_that_has_not_begun_can_be_taken_back_and_so_can_its_end() {
        let mut clock = WorldClock::default();
        clock.steer(Steer::Halt, ms(100));
        clock.steer(Steer::GoOn, ms(50));
        assert_eq!(clock, WorldClock::default());
        clock.steer(Steer::Halt, ms(100));
        clock.steer(Steer::GoOn, ms(200));
        clock.steer(Steer::Halt, ms(150));
        assert_eq!(world_ms(&clock, 500), 100);
    }

    #[test]
    fn a_step_halts_what_goes_and_lets_what_stands_go_on_for_a_moment() {
        let mut clock = WorldClock::default();
        clock.steer(Steer::Step, ms(1000));
        assert_eq!(world_ms(&clock, 2000), 1000);
        clock.steer(Steer::Step, ms(2000));
        assert_eq!(
            [2000, 2010, 2033, 2034, 9000].map(|at| world_ms(&clock, at)),
            [1000, 1010, 1033, 1033, 1033]
        );
        // Two at once are twice as long.
        clock.steer(Steer::Step, ms(3000));
        clock.steer(Steer::Step, ms(3000));
        assert_eq!(clock.world_time(ms(9000)).0, 1_000_000_000 + 3 * STEP_NS);
        assert!(clock.will_stand());
    }

    #[test]
    fn what_is_wanted_in_a_row_has_the_effect_of_each() {
        let mut dice = Dice::new(4);
        for _ in 0..300 {
            let (mut together, mut clock) = (Steering::default(), WorldClock::default());
            let mut each = clock;
            for _ in 0..dice.below(6) {
                let steer = [Steer::Halt, Steer::GoOn, Steer::Step][dice.below(3) as usize];
                // A halt of what stands says nothing of the steps before it; else they are undone by what comes after them.
                let is_told = steer != Steer::Halt || !each.will_stand();
                if is_told {
                    together = together.then(steer.into());
                    each.steer(steer, ms(10));
                }
            }
            clock.steer(together, ms(10));
            assert_eq!(clock.will_stand(), each.will_stand(), "{together:?}");
        }
        let many = (0..1000).fold(Steering::default(), |all, _| all.then(Steer::Step.into()));
        assert_eq!(many.all().count(), usize::from(MAX_STEPS));
    }

    /// Whatever is wanted when, the world's time is continuous, never faster than the server's, the same before the change, and
    /// the same without what is forgotten; and the clock is one that a client takes.
    #[test]
    fn no_change_is_seen_before_it_takes_effect_and_none_is_a_jump() {
        let mut dice = Dice::new(3);
        for _ in 0..200 {
            let (mut clock, mut now) = (WorldClock::default(), 0);
            for _ in 0..60 {
                now += dice.below(400) as i64;
                let steer = [Steer::Halt, Steer::GoOn, Steer::Step][dice.below(3) as usize];
                let mut after = clock;
                after.steer(steer, ms(now));
                assert_eq!(after.check(), Ok(()), "{after:?}");
                let before = (now - 100..=now).map(|at| (clock.world_time(ms(at)), after.world_time(ms(at))));
                before.for_each(|(clock, after)| assert_eq!(clock, after));
                let times: Vec<i64> = (now..now + 500).map(|at| after.world_time(ms(at)).0).collect();
                assert!(times.windows(2).all(|pair| (0..=1_000_000).contains(&(pair[1] - pair[0]))));
                let mut forgetful = after;
                forgetful.forget_before(ms(now - 50));
                (now - 50..now + 500)
                    .for_each(|at| assert_eq!(forgetful.world_time(ms(at)).0, after.world_time(ms(at)).0));
                clock = if dice.once_in(2) { forgetful } else { after };
            }
        }
    }

    #[test]
    fn clocks_that_cannot_be_are_refused() {
        let halt = |from: i64, until: Option<i64>| Some(Halt { from: ms(from), until: until.map(ms) });
        let of = |first: &[Option<Halt>]| {
            let mut halts = [None; MAX_HALTS];
            halts[..first.len()].copy_from_slice(first);
            WorldClock { behind_ns: 0, halts }.check()
        };
        assert!(of(&[halt(1, Some(2)), halt(2, Some(4)), halt(9, None)]).is_ok());
        assert!(of(&[None, halt(1, None)]).is_err(), "a gap");
        assert!(of(&[halt(1, None), halt(4, None)]).is_err(), "two without an end");
        assert!(of(&[halt(4, Some(5)), halt(1, Some(2))]).is_err(), "times do not rise");
        assert!(
            of(&[halt(4, Some(4))]).is_err() && of(&[halt(4, Some(3))]).is_err(),
            "it ends before it begins"
        );
        assert!(of(&[Some(Halt { from: ServerTime(i64::MIN), until: None })]).is_err());
        assert!(WorldClock { behind_ns: i64::MAX, ..WorldClock::default() }.check().is_err());
    }

    #[test]
    fn late_news_are_blended_in() {
        let mut shown = ShownWorldClock::default();
        let mut clock = WorldClock::default();
        clock.steer(Steer::Halt, ms(1000));
        // The display has shown 50 ms more.
        let mut last = shown.show(ms(1050));
        shown.follow(clock);
        for at in 1050..1300 {
            let now = shown.world_time(ms(at));
            assert!(now.since(last).abs() <= 300_000, "{at} ms");
            last = now;
        }
        assert_eq!(last, WorldTime(1_000_000_000));
        // A clock that is far away is followed at once, and so is one of which nothing has been seen.
        shown.follow(WorldClock { behind_ns: 60_000_000_000, ..clock });
        assert_eq!(shown.world_time(ms(1400)).0, -59_000_000_000);
        let mut shown = ShownWorldClock::default();
        shown.follow(clock);
        assert_eq!(shown.world_time(ms(1050)).0, 1_000_000_000);
    }
}
