use super::*;
use crate::testing::Dice;

const MS: i64 = 1_000_000;

/// Two clocks and a link between them, with the pings of a session, for `seconds`.
struct Path {
    offset_ns: i64,
    drift: f64,
    one_way_ns: i64,
    jitter_up_ns: i64,
    jitter_down_ns: i64,
}

impl Path {
    fn server_clock(&self, display_ns: i64) -> i64 {
        display_ns + self.offset_ns + (self.drift * display_ns as f64) as i64
    }

    /// The drift that is found within `seconds`.
    fn drift(&self, seed: u64, seconds: i64) -> f64 {
        let mut dice = Dice::new(seed);
        let mut clock = ClockEstimator::new();
        for now in (0..seconds * 1000 / 25).map(|n| n * 25 * MS) {
            let up = self.one_way_ns + dice.below(self.jitter_up_ns as u64 + 1) as i64;
            let down = self.one_way_ns + dice.below(self.jitter_down_ns as u64 + 1) as i64;
            let received = ServerTime(self.server_clock(now + up));
            clock.on_pong(ClientTime(now), received, received, ClientTime(now + up + down));
        }
        clock.drift().expect("exchanges")
    }

    /// The largest error in nanoseconds after `settle_s`, at display times up to 50 ms ahead.
    fn worst_error_ns(&self, seed: u64, seconds: i64, settle_s: i64) -> i64 {
        let mut dice = Dice::new(seed);
        let mut clock = ClockEstimator::new();
        let (mut now, mut worst, mut pings) = (0, 0, 0);
        while now < seconds * 1000 * MS {
            let up = self.one_way_ns + dice.below(self.jitter_up_ns as u64 + 1) as i64;
            let down = self.one_way_ns + dice.below(self.jitter_down_ns as u64 + 1) as i64;
            let received = ServerTime(self.server_clock(now + up));
            clock.on_pong(ClientTime(now), received, received, ClientTime(now + up + down));
            pings += 1;
            now += if pings < 40 { 50 * MS } else { 100 * MS };
            if now > settle_s * 1000 * MS {
                for ahead in [0, 25, 50] {
                    let at = now + ahead * MS;
                    let seen = clock.server_time(ClientTime(at)).unwrap().0;
                    worst = worst.max((seen - self.server_clock(at)).abs());
                }
            }
        }
        worst
    }
}

#[test]
fn symmetric_jitter_and_drift_leave_less_than_a_millisecond() {
    for seed in 0..50 {
        for drift in [-100e-6, 0.0, 100e-6] {
            let path = Path {
                offset_ns: 123_456 * MS,
                drift,
                one_way_ns: 15 * MS,
                jitter_up_ns: 10 * MS,
                jitter_down_ns: 10 * MS,
            };
            let worst = path.worst_error_ns(seed, 120, 6);
            assert!(worst < MS, "seed {seed}, drift {drift}: {worst} ns");
        }
    }
}

#[test]
fn two_seconds_of_jitter_are_no_drift() {
    let path = Path {
        offset_ns: 0,
        drift: 0.0,
        one_way_ns: 10 * MS,
        jitter_up_ns: 20 * MS,
        jitter_down_ns: 20 * MS,
    };
    let drifts = (0..50).map(|seed| path.drift(seed, 2).abs());
    let (mean, worst) = (drifts.clone().sum::<f64>() / 50.0, drifts.fold(0.0, f64::max));
    assert!(mean < 15e-6 && worst < 60e-6, "{mean}, at worst {worst}");
}

#[test]
fn the_first_exchange_already_bounds_the_error_by_half_the_jitter() {
    for seed in 0..200 {
        let path = Path {
            offset_ns: -7 * MS,
            drift: 100e-6,
            one_way_ns: 15 * MS,
            jitter_up_ns: 10 * MS,
            jitter_down_ns: 10 * MS,
        };
        let worst = path.worst_error_ns(seed, 2, 0);
        assert!(worst < 5 * MS + MS / 10, "seed {seed}: {worst} ns");
    }
}

#[test]
fn the_fastest_exchanges_outweigh_one_way_jitter() {
    for seed in 0..50 {
        let path = Path {
            offset_ns: 0,
            drift: 50e-6,
            one_way_ns: 10 * MS,
            jitter_up_ns: 0,
            jitter_down_ns: 20 * MS,
        };
        let worst = path.worst_error_ns(seed, 60, 6);
        assert!(worst < MS, "seed {seed}: {worst} ns, where the mean would be off by 5 ms");
    }
}

/// Of sessions over a link that keeps its packets' order, each of them up to 20 ms late, the errors in nanoseconds after
/// `seconds`, sorted: two bursts an update take the way back, and poses the way there.
fn errors_of_bursts_ns(are_stamped: bool, seconds: i64) -> Vec<i64> {
    const UPDATE_NS: i64 = 33_333_333;
    let mut errors: Vec<_> = (0..40)
        .map(|seed| {
            let mut dice = Dice::new(seed);
            let mut arrivals = |mut sent: Vec<(i64, Option<i64>)>| {
                sent.sort_by_key(|(at, _)| *at);
                let mut last = 0;
                let late = |(at, what): (i64, Option<i64>)| {
                    last = last.max(at + 10 * MS + dice.below(20 * MS as u64) as i64);
                    (at, last, what)
                };
                sent.into_iter().map(late).collect::<Vec<_>>()
            };
            let every = |period_ns: i64, from_ns: i64| {
                (0..seconds * 1000 * MS / period_ns).map(move |i| from_ns + i * period_ns)
            };
            let pings = every(25 * MS, 0).map(|at| (at, Some(at)));
            let others = every(14 * MS, 200 * MS).map(|at| (at, None));
            let there = arrivals(pings.chain(others).collect());
            let pongs = there.iter().filter_map(|(_, came, ping)| ping.map(|_| (*came, Some(*came))));
            let stamps = every(UPDATE_NS, 200 * MS).map(|at| (at - 1, are_stamped.then_some(-1)));
            let bursts = every(UPDATE_NS, 200 * MS).flat_map(|at| {
                let packets = (0..60).chain(80..140).map(move |tenth| at + tenth * MS / 10);
                packets.map(|at| (at, None))
            });
            let back = arrivals(pongs.chain(stamps).chain(bursts).collect());
            let mut clock = ClockEstimator::new();
            let mut up = there.iter().filter_map(|(sent, came, ping)| ping.map(|_| (*sent, *came)));
            for (left, came, what) in back.into_iter().filter(|(_, came, _)| *came < seconds * 1000 * MS) {
                match what {
                    Some(-1) => clock.note_stamp(ServerTime(left), ClientTime(came)),
                    Some(_) => {
                        let (sent, received) = up.next().expect("a ping for each pong");
                        let received = ServerTime(received);
                        clock.note_pong(ClientTime(sent), received, ServerTime(left), ClientTime(came));
                    }
                    None => {}
                }
            }
            clock.settle();
            let now = seconds * 1000 * MS;
            (clock.server_time(ClientTime(now)).expect("known").0 - now).abs()
        })
        .collect();
    errors.sort_unstable();
    errors
}

#[test]
fn stamps_before_bursts_halve_the_error() {
    let [pings, stamped] = [false, true].map(|are_stamped| errors_of_bursts_ns(are_stamped, 4));
    let (median, worst) = (stamped.len() / 2, stamped.len() - 1);
    assert!(2 * stamped[median] < pings[median], "{} of {} ns", stamped[median], pings[median]);
    assert!(stamped[worst] < pings[worst], "{} of {} ns", stamped[worst], pings[worst]);
}

#[test]
fn a_stamp_of_another_clock_is_ignored() {
    let mut clock = ClockEstimator::new();
    clock.note_stamp(ServerTime(0), ClientTime(0));
    clock.settle();
    assert_eq!(clock.server_time(ClientTime(0)), None);
    let exchange = |clock: &mut ClockEstimator, at: i64, offset_ns: i64| {
        let server = ServerTime(at + offset_ns + 10 * MS);
        clock.on_pong(ClientTime(at), server, server, ClientTime(at + 20 * MS));
    };
    exchange(&mut clock, 0, 0);
    let before = clock.server_time(ClientTime(0));
    clock.note_stamp(ServerTime(5000 * MS), ClientTime(30 * MS));
    clock.settle();
    assert_eq!(clock.server_time(ClientTime(0)), before);
    clock.note_stamp(ServerTime(22 * MS), ClientTime(30 * MS));
    clock.settle();
    let bound_ns = clock.error_bound_ns(ClientTime(30 * MS)).expect("known");
    assert!(bound_ns < 10 * MS, "a way of 8 ms takes a part of the room: {bound_ns} ns");
    exchange(&mut clock, 40 * MS, 1000 * MS);
    assert!(clock.stamps.is_empty(), "they are of the clock before");
}

/// A session as a headset has it: answers come over a link that is as uneven as the dice say, every frame is displayed
/// some while after it was begun, and there is something on display from some frame on.
struct Headset {
    path: Path,
    rate_hz: f64,
    ahead_ns: i64,
    first_shown: i64,
}

/// One frame of it, on the true clocks.
struct Seen {
    is_displayed: bool,
    display_ns: i64,
    server_ns: i64,
    true_ns: i64,
    bound_ns: i64,
}

impl Headset {
    fn throw(dice: &mut Dice, rate_hz: f64) -> Self {
        let mut ms = |most: u64| dice.below(most * 1000) as i64 * 1000;
        let path = Path {
            offset_ns: ms(1_000_000),
            drift: (ms(1000) - 500 * MS) as f64 / (500 * MS) as f64 * 500e-6,
            one_way_ns: 1000 + ms(100),
            jitter_up_ns: ms(40),
            jitter_down_ns: ms(40),
        };
        Self { path, rate_hz, ahead_ns: ms(50), first_shown: ms(2000) / MS / 10 }
    }

    /// What is seen in `seconds`; later answers may overtake earlier ones.
    fn see(&self, dice: &mut Dice, seconds: f64) -> Vec<Seen> {
        let mut clock = ClockEstimator::new();
        let (mut under_way, mut seen) = (Vec::new(), Vec::new());
        for frame in 0..(seconds * self.rate_hz) as i64 {
            let now = (frame as f64 * 1e9 / self.rate_hz) as i64;
            let mut way = |jitter_ns| self.path.one_way_ns + dice.below(jitter_ns as u64 + 1) as i64;
            let (up, down) = (way(self.path.jitter_up_ns), way(self.path.jitter_down_ns));
            under_way.push((now + up + down, now, now + up));
            for (came, sent, received) in under_way.extract_if(.., |(came, ..)| *came <= now) {
                let server = ServerTime(self.path.server_clock(received));
                clock.note_pong(ClientTime(sent), server, server, ClientTime(came));
            }
            clock.settle();
            let (display_ns, is_displayed) = (now + self.ahead_ns, frame >= self.first_shown);
            let display = ClientTime(display_ns);
            if is_displayed {
                clock.show(display);
            }
            let Some(ServerTime(server_ns)) = clock.server_time(display) else { continue };
            let bound_ns = clock.error_bound_ns(display).expect("as the time");
            let true_ns = self.path.server_clock(display_ns);
            seen.push(Seen { is_displayed, display_ns, server_ns, true_ns, bound_ns });
        }
        seen
    }
}

const RATES_HZ: [f64; 5] = [36.0, 60.0, 72.0, 90.0, 120.0];

#[test]
fn a_displayed_clock_steps_by_at_most_100_microseconds() {
    for (seed, rate_hz) in (0..60).flat_map(|seed| RATES_HZ.map(|rate_hz| (seed, rate_hz))) {
        let mut dice = Dice::new(seed);
        let headset = Headset::throw(&mut dice, rate_hz);
        let seen = headset.see(&mut dice, 6.0);
        for pair in seen.windows(2).filter(|pair| pair[0].is_displayed) {
            let period_ns = pair[1].display_ns - pair[0].display_ns;
            let step_ns = pair[1].server_ns - pair[0].server_ns;
            let off_ns = (step_ns - period_ns).abs();
            // Both offsets are rounded to nanoseconds.
            assert!(off_ns <= MAX_STEP_NS + 2 && step_ns > 0, "seed {seed}, {rate_hz} Hz: {off_ns} ns");
        }
    }
}

#[test]
fn the_error_is_never_larger_than_its_bound() {
    for (seed, rate_hz) in (0..60).flat_map(|seed| RATES_HZ.map(|rate_hz| (seed, rate_hz))) {
        let mut dice = Dice::new(1000 + seed);
        let headset = Headset::throw(&mut dice, rate_hz);
        for Seen { display_ns, server_ns, true_ns, bound_ns, .. } in headset.see(&mut dice, 4.0) {
            let error_ns = (server_ns - true_ns).abs();
            // Four clocks were rounded to nanoseconds.
            assert!(
                error_ns <= bound_ns + 4,
                "seed {seed}, {rate_hz} Hz, {display_ns} ns: {error_ns} ns, bound {bound_ns} ns"
            );
        }
    }
}

#[test]
fn between_even_ways_the_bound_is_that_of_one_way() {
    let path = Path {
        offset_ns: 5 * MS,
        drift: 50e-6,
        one_way_ns: 20 * MS,
        jitter_up_ns: 10 * MS,
        jitter_down_ns: 10 * MS,
    };
    let headset = Headset { path, rate_hz: 90.0, ahead_ns: 30 * MS, first_shown: 30 };
    let seen = headset.see(&mut Dice::new(3), 10.0);
    let last = seen.last().expect("frames");
    assert!((20 * MS..=21 * MS).contains(&last.bound_ns), "{} ns", last.bound_ns);
    let worst_ns = seen.iter().filter(|seen| seen.is_displayed).map(|seen| seen.bound_ns).max();
    assert!(worst_ns < Some(23 * MS), "{worst_ns:?} ns after 30 exchanges");
}

/// A clock on which something is shown at 0, and which then finds out that it was `off_ns` slow.
fn slow_clock(off_ns: i64) -> ClockEstimator {
    let mut clock = ClockEstimator::new();
    clock.on_pong(ClientTime(-20 * MS), ServerTime(-10 * MS), ServerTime(-10 * MS), ClientTime(0));
    clock.show(ClientTime(0));
    // As long a way there, a shorter way back: the middle is larger by half the difference.
    let server = ServerTime(10 * MS);
    clock.on_pong(ClientTime(0), server, server, ClientTime(20 * MS - 2 * off_ns));
    clock
}

#[test]
fn a_3_ms_error_is_corrected_in_half_a_second() {
    for rate_hz in [60, 90, 120] {
        let mut clock = slow_clock(3 * MS);
        let wanted_ns = clock.seen.mapping.expect("known").line.offset_at(ClientTime(0));
        assert!((2 * MS..4 * MS).contains(&wanted_ns), "{wanted_ns} ns");
        let seen_ns = |clock: &ClockEstimator| clock.server_time(ClientTime(0)).expect("known").0;
        assert!(seen_ns(&clock).abs() < 100, "nothing changes between two frames");
        (1..rate_hz / 2 + 3).for_each(|frame| clock.show(ClientTime(frame * 1000 * MS / rate_hz)));
        assert_eq!(seen_ns(&clock), wanted_ns, "{rate_hz} Hz");
    }
}

#[test]
fn a_correction_goes_on_while_better_estimates_come() {
    let mut clock = slow_clock(3 * MS);
    let mut last_ns = clock.seen.mapping.expect("known").left_ns.abs();
    for frame in 1..20 {
        let now = ClientTime(frame * 11 * MS);
        let server = ServerTime(now.0 - 3 * MS);
        clock.on_pong(now.plus_ns(-30 * MS), server, server, now.plus_ns(5 * MS));
        clock.show(now);
        let left_ns = clock.seen.mapping.expect("known").left_ns.abs();
        assert!(left_ns < last_ns, "frame {frame}: {left_ns} ns of {last_ns} ns");
        last_ns = left_ns;
    }
}

#[test]
fn before_anything_is_on_display_an_estimate_counts_at_once() {
    let mut clock = ClockEstimator::new();
    for (up_ms, down_ms) in [(40, 10), (10, 40), (10, 10)] {
        let server = ServerTime(up_ms * MS);
        clock.on_pong(ClientTime(0), server, server, ClientTime((up_ms + down_ms) * MS));
    }
    let off_ns = clock.server_time(ClientTime(0)).expect("known").0;
    assert!(off_ns.abs() < 100, "{off_ns} ns");
}

#[test]
fn a_new_estimate_is_followed_slowly_and_a_new_clock_at_once() {
    let seen_ns = |from_ns| {
        let mut clock = ClockEstimator::new();
        let server = ServerTime(1000 * MS);
        clock.on_pong(ClientTime(0), server, server, ClientTime(0));
        clock.seen.go_on_from(ClientTime(0), ServerTime(from_ns));
        clock.show(ClientTime(0));
        let first = clock.server_time(ClientTime(0)).expect("known");
        clock.show(ClientTime(20 * MS));
        [first.0, clock.server_time(ClientTime(20 * MS)).expect("known").0 - 20 * MS]
    };
    let [first, later] = seen_ns(1003 * MS);
    assert_eq!(first, 1003 * MS);
    assert!((later - (1003 * MS - MAX_STEP_NS)).abs() <= 1, "{later}: less than a nanosecond is rounding");
    assert_eq!(seen_ns(3000 * MS), [1000 * MS; 2]);
}

#[test]
fn a_faster_path_is_not_mistaken_for_a_reset_clock() {
    let mut clock = ClockEstimator::new();
    let exchange = |clock: &mut ClockEstimator, at_ms: i64, up_ms: i64| {
        let server = ServerTime((at_ms + up_ms) * MS);
        clock.on_pong(ClientTime(at_ms * MS), server, server, ClientTime((at_ms + up_ms + 10) * MS));
    };
    (0..20).for_each(|i| exchange(&mut clock, i * 25, 150));
    clock.show(ClientTime(500 * MS));
    exchange(&mut clock, 510, 10);
    clock.show(ClientTime(511 * MS));
    assert_eq!(clock.exchanges.len(), 21);
    let off_ns = clock.server_time(ClientTime(511 * MS)).expect("known").0 - 511 * MS;
    assert!((69 * MS..=70 * MS).contains(&off_ns), "it is caught up with: {off_ns} ns");
}

#[test]
fn a_clock_that_was_set_anew_is_followed_at_once() {
    let mut clock = ClockEstimator::new();
    let exchange = |clock: &mut ClockEstimator, at_ms: i64, offset_ms: i64| {
        let server = ServerTime((at_ms + 10 + offset_ms) * MS);
        clock.on_pong(ClientTime(at_ms * MS), server, server, ClientTime((at_ms + 20) * MS));
    };
    exchange(&mut clock, 0, 0);
    clock.show(ClientTime(900 * MS));
    (0..100).for_each(|i| exchange(&mut clock, 1000 + i * 50, 1000));
    let seen = clock.server_time(ClientTime(6000 * MS)).unwrap();
    assert!((seen.0 - 7000 * MS).abs() < 25 * MS, "{seen:?}");
}

#[test]
fn display_time_inverts_server_time_also_during_a_correction() {
    let mut dice = Dice::new(5);
    let mut clock = ClockEstimator::new();
    for i in 0..40 {
        let now = i * 100 * MS;
        let server = ServerTime(now + 3_000_000 * MS + dice.below(40) as i64 * MS);
        clock.on_pong(ClientTime(now), server, server, ClientTime(now + 60 * MS));
        clock.show(ClientTime(now + 70 * MS));
        for ahead in [-50, 0, 30, 150, 500] {
            let at = ClientTime(now + ahead * MS);
            let back = clock.display_time(clock.server_time(at).unwrap()).unwrap();
            assert!(back.since(at).abs() <= 2, "{} ns", back.since(at));
        }
    }
}

#[test]
fn exchanges_that_contradict_themselves_are_ignored() {
    let mut clock = ClockEstimator::new();
    let extremes = [i64::MIN, i64::MIN + 1, -1, 0, 1, i64::MAX - 1, i64::MAX];
    for a in extremes {
        for b in extremes {
            for c in extremes {
                for d in extremes {
                    clock.on_pong(ClientTime(a), ServerTime(b), ServerTime(c), ClientTime(d));
                    for at in extremes {
                        clock.server_time(ClientTime(at));
                        clock.display_time(ServerTime(at));
                    }
                }
            }
        }
    }
    let mut fresh = ClockEstimator::new();
    fresh.on_pong(ClientTime(10), ServerTime(0), ServerTime(0), ClientTime(5));
    fresh.on_pong(ClientTime(0), ServerTime(5), ServerTime(4), ClientTime(10));
    assert_eq!(fresh.server_time(ClientTime(0)), None);
    assert_eq!((fresh.rtt_ns(), fresh.jitter_ns()), (None, None));
}
