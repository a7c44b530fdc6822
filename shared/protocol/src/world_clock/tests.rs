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
fn a_future_halt_can_be_cancelled() {
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
fn a_step_halts_a_running_world_and_advances_a_halted_one() {
    let mut clock = WorldClock::default();
    clock.steer(Steer::Step, ms(1000));
    assert_eq!(world_ms(&clock, 2000), 1000);
    clock.steer(Steer::Step, ms(2000));
    assert_eq!([2000, 2010, 2033, 2034, 9000].map(|at| world_ms(&clock, at)), [1000, 1010, 1033, 1033, 1033]);
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
    assert!(of(&[halt(4, Some(4))]).is_err() && of(&[halt(4, Some(3))]).is_err(), "it ends before it begins");
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
