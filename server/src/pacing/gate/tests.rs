use super::*;

const PERIOD_NS: i64 = 33_333_333;

/// A link in virtual time: so many bytes a second, and so many under way.
struct SlowLink {
    bytes_s: f64,
    window_bytes: u64,
    /// Bytes left of each stream, the oldest first.
    streams: VecDeque<f64>,
    now_ns: i64,
}

impl SlowLink {
    fn new(bytes_s: f64) -> Self {
        Self { bytes_s, window_bytes: 20_000, streams: VecDeque::new(), now_ns: 0 }
    }

    fn pass(&mut self, ns: i64) {
        self.now_ns += ns;
        let mut carried = self.bytes_s * ns as f64 * 1e-9;
        while let Some(left) = self.streams.front_mut() {
            if *left > carried {
                *left -= carried;
                return;
            }
            carried -= *left;
            self.streams.pop_front();
        }
    }

    fn way(&self) -> WayState {
        WayState {
            streams_under_way: self.streams.len() as u64,
            window_bytes: self.window_bytes,
            round_trip_ns: 40_000_000,
            smoothed_ns: 40_000_000,
            ..WayState::default()
        }
    }

    fn send(&mut self, gate: &mut UpdateGate, frame: u32, bytes: [usize; 2]) {
        for (kind, bytes) in [Kind::Delta, Kind::Picture].into_iter().zip(bytes) {
            gate.sent(UpdateId(frame), kind, bytes, self.now_ns);
            self.streams.push_back(bytes as f64);
        }
    }
}

/// So many seconds of updates of so many bytes, whenever the gate allows one; gives when each was made.
fn run(gate: &mut UpdateGate, link: &mut SlowLink, seconds: i64, bytes: [usize; 2]) -> Vec<i64> {
    let mut made = Vec::new();
    for _ in 0..seconds * 1_000_000_000 / PERIOD_NS {
        if gate.may_update(&link.way(), link.now_ns) {
            link.send(gate, made.len() as u32, bytes);
            made.push(link.now_ns);
        }
        link.pass(PERIOD_NS);
    }
    made
}

#[test]
fn a_link_that_carries_the_scene_never_holds_an_update_back() {
    let (mut gate, mut link) = (UpdateGate::new(PERIOD_NS), SlowLink::new(12.5e6));
    link.window_bytes = 500_000;
    assert_eq!(run(&mut gate, &mut link, 10, [20_000, 60_000]).len() as i64, 10_000_000_000 / PERIOD_NS);
    assert_eq!(
        (gate.budget(&link.way(), link.now_ns), gate.shortfall(30, link.now_ns)),
        (Budget::UNLIMITED, None)
    );
}

#[test]
fn a_slow_link_gets_as_many_updates_as_it_carries_and_none_waits_long() {
    let (mut gate, mut link) = (UpdateGate::new(PERIOD_NS), SlowLink::new(125_000.0));
    let made = run(&mut gate, &mut link, 30, [40_000, 20_000]);
    let carried = 30.0 * 125_000.0 / 60_000.0;
    assert!((made.len() as f64 - carried).abs() < 6.0, "{} updates, {carried} fit", made.len());
    let queued: f64 = link.streams.iter().sum();
    assert!(queued < 60_000.0 + 20_000.0 + 0.3 * 125_000.0, "{queued} bytes wait at the end");
    let longest = made.windows(2).map(|pair| pair[1] - pair[0]).max();
    assert!(longest < Some(2_000_000_000), "{longest:?}");
}

#[test]
fn at_the_start_no_more_than_three_updates_go_before_the_link_is_known() {
    let (mut gate, mut link) = (UpdateGate::new(PERIOD_NS), SlowLink::new(1000.0));
    assert_eq!(run(&mut gate, &mut link, 5, [400_000, 100_000]).len(), MAX_WAITING_UPDATES + 1);
}

#[test]
fn one_update_waits_for_a_link_that_is_known_to_be_slow() {
    let (mut gate, mut link) = (UpdateGate::new(PERIOD_NS), SlowLink::new(1e6));
    run(&mut gate, &mut link, 5, [10_000, 50_000]);
    let waiting = gate.before_the_link(&link.way(), link.now_ns);
    assert!((1..=MAX_WAITING_FOR_SLOW + 1).contains(&waiting.updates), "{waiting:?}");
}

#[test]
fn a_slow_link_is_noticed_though_the_window_of_a_new_connection_takes_everything() {
    let (mut gate, mut link) = (UpdateGate::new(PERIOD_NS), SlowLink::new(50_000.0));
    link.window_bytes = 256 << 10;
    let made = run(&mut gate, &mut link, 2, [10_000, 5_000]);
    assert!(made.len() <= 14, "{} updates before the first seconds are over, 6.7 fit", made.len());
    let queued: f64 = link.streams.iter().sum();
    assert!(queued < 3.0 * 15_000.0, "{queued} bytes wait");
}

#[test]
fn the_first_picture_does_not_wait_for_the_whole_scene() {
    let (mut gate, mut link) = (UpdateGate::new(PERIOD_NS), SlowLink::new(12.5e6));
    link.window_bytes = 500_000;
    assert!(gate.may_update(&link.way(), link.now_ns));
    let first = gate.budget(&link.way(), link.now_ns);
    assert!(first.geometry_bytes < 200_000 && first.sample_bytes == usize::MAX, "{first:?}");
    link.send(&mut gate, 0, [first.geometry_bytes, 20_000]);
    link.pass(PERIOD_NS);
    assert!(gate.may_update(&link.way(), link.now_ns));
    assert_eq!(gate.budget(&link.way(), link.now_ns), Budget::UNLIMITED, "it has arrived");
}

#[test]
fn a_first_picture_is_finer_over_a_link_that_has_been_fast() {
    let gate = UpdateGate::new(PERIOD_NS);
    let bytes = |delivered_bytes_s| {
        let way = WayState { delivered_bytes_s, ..WayState::default() };
        gate.budget(&way, 0).geometry_bytes
    };
    assert_eq!((bytes(0), bytes(50_000)), (131_072, 131_072));
    assert_eq!(bytes(2_000_000), 2_000_000);
}

#[test]
fn geometry_is_bounded_only_while_the_link_is_known_to_be_slow() {
    let (mut gate, mut link) = (UpdateGate::new(PERIOD_NS), SlowLink::new(125_000.0));
    run(&mut gate, &mut link, 10, [40_000, 20_000]);
    let Budget { geometry_bytes, sample_bytes, .. } = gate.budget(&link.way(), link.now_ns);
    assert_eq!(geometry_bytes, 16_384, "100 ms of 125 kB/s, and no less than lets the scene enter");
    assert!((2_000..3_000).contains(&sample_bytes), "{sample_bytes}");
    link.bytes_s = 50e6;
    link.window_bytes = 1 << 20;
    run(&mut gate, &mut link, 12, [40_000, 20_000]);
    assert_eq!(gate.budget(&link.way(), link.now_ns), Budget::UNLIMITED, "the link has recovered");
}

#[test]
fn a_link_that_gets_faster_is_used_a_quarter_more_with_each_second_and_never_at_once() {
    let (mut gate, mut link) = (UpdateGate::new(PERIOD_NS), SlowLink::new(1e6));
    run(&mut gate, &mut link, 10, [40_000, 80_000]);
    let slow = gate.rate_bytes_s(link.now_ns).expect("it is slow");
    assert!((0.8e6..1.2e6).contains(&slow), "{slow}");
    link.bytes_s = 10e6;
    // What waits goes first, and is measured.
    run(&mut gate, &mut link, 1, [10_000, 20_000]);
    let mut last = gate.rate_bytes_s(link.now_ns).expect("it was slow a moment ago");
    for second in 1..=5 {
        run(&mut gate, &mut link, 1, [10_000, 20_000]);
        let rate = gate.rate_bytes_s(link.now_ns).expect("it was slow a moment ago");
        assert!(rate > 1.1 * last && rate < 1.4 * last, "second {second}: {last}, then {rate}");
        last = rate;
    }
    assert!(last > 2.0 * slow, "{slow}, then {last}");
}

#[test]
fn the_time_in_which_nothing_came_says_nothing_of_the_rate() {
    let (mut gate, mut link) = (UpdateGate::new(PERIOD_NS), SlowLink::new(12.5e6));
    link.window_bytes = 500_000;
    run(&mut gate, &mut link, 3, [3_000, 12_000]);
    link.bytes_s = 0.0;
    run(&mut gate, &mut link, 3, [3_000, 12_000]);
    link.pass(2_000_000_000); // the client is away
    link.bytes_s = 12.5e6;
    gate.resumed();
    let made = run(&mut gate, &mut link, 3, [3_000, 12_000]).len() as i64;
    assert!(made >= 3_000_000_000 / PERIOD_NS - 3, "{made} updates");
    assert_eq!(gate.rate_bytes_s(link.now_ns), None);
}

#[test]
fn nobody_is_told_of_a_link_that_is_behind_for_a_moment() {
    let (mut gate, mut link) = (UpdateGate::new(PERIOD_NS), SlowLink::new(125_000.0));
    run(&mut gate, &mut link, 1, [40_000, 20_000]);
    assert!(gate.withheld_ns.is_some() && gate.shortfall(30, link.now_ns).is_none());
}

#[test]
fn the_person_is_told_what_the_link_carries_and_not_more_often_than_they_want_to_hear() {
    let (mut gate, mut link) = (UpdateGate::new(PERIOD_NS), SlowLink::new(125_000.0));
    let mut told = Vec::new();
    for _ in 0..25 {
        run_from(&mut gate, &mut link);
        told.extend(gate.shortfall(30, link.now_ns));
    }
    assert!((1..=3).contains(&told.len()), "{told:?}");
    assert!((0.8..1.2).contains(&told[0].carries_mbit_s) && told[0].needs_mbit_s > 2.0, "{told:?}");
    let text = Shortfall { carries_mbit_s: 1.0, needs_mbit_s: 6.34, wanted_hz: 30.0, qp: 30 }.to_string();
    assert_eq!(
        text,
        "the link carries 1.0 of 6.3 Mbit/s that the scene needs: about 5 of 30 updates a second are sent, at quantiser 30 of 51"
    );
}

/// A second of it, the frames counted on.
fn run_from(gate: &mut UpdateGate, link: &mut SlowLink) {
    let mut frame = (link.now_ns / 1_000_000) as u32;
    for _ in 0..30 {
        if gate.may_update(&link.way(), link.now_ns) {
            link.send(gate, frame, [40_000, 20_000]);
        }
        frame += 33;
        link.pass(PERIOD_NS);
    }
}
