use super::*;

const MS: u64 = 1_000_000;

/// A path with a bottleneck, round trip by round trip, and an application that sends what it may.
struct Path {
    target: Target,
    bytes_s: f64,
    queued_bytes: f64,
    start: Instant,
    now_ns: u64,
}

impl Path {
    const ROUND_NS: u64 = 20 * MS;

    fn new(mbit_s: f64) -> Self {
        let bytes_s = mbit_s * 1e6 / 8.0;
        Self { target: Target::default(), bytes_s, queued_bytes: 0.0, start: Instant::now(), now_ns: 0 }
    }

    /// `wanted_mbit_s`: what there is to send. Gives what arrives, Mbit/s, and the median and the longest queue, milliseconds.
    fn run(&mut self, seconds: f64, wanted_mbit_s: f64) -> (f64, [f64; 2]) {
        let round_s = Self::ROUND_NS as f64 * 1e-9;
        let (mut arrived, mut queues_ms, rounds) = (0.0, Vec::new(), (seconds / round_s) as u64);
        for _ in 0..rounds {
            let may_s = self.target.bytes_s().unwrap_or(FAST_BYTES_S).min(wanted_mbit_s * 1e6 / 8.0);
            self.queued_bytes += may_s * round_s;
            let delivered = self.queued_bytes.min(self.bytes_s * round_s);
            self.queued_bytes -= delivered;
            arrived += delivered;
            let queue_s = self.queued_bytes / self.bytes_s;
            queues_ms.push(queue_s * 1e3);
            self.now_ns += Self::ROUND_NS;
            self.target.note(RoundTrip {
                end: self.start + Duration::from_nanos(self.now_ns),
                delivered_bytes: delivered as u64,
                queue: Duration::from_secs_f64(queue_s),
                path: Duration::from_nanos(Self::ROUND_NS),
                is_full: false,
                is_congested: false,
            });
        }
        queues_ms.sort_by(f64::total_cmp);
        (arrived * 8e-6 / seconds, [queues_ms[queues_ms.len() / 2], queues_ms[queues_ms.len() - 1]])
    }

    fn change(&mut self, mbit_s: f64) {
        self.bytes_s = mbit_s * 1e6 / 8.0;
    }
}

#[test]
fn what_a_path_carries_is_used_and_no_queue_stands() {
    for mbit_s in [2.0, 8.0, 30.0, 80.0] {
        let mut path = Path::new(mbit_s);
        path.run(5.0, 200.0);
        let (arrived, [queue_ms, longest_ms]) = path.run(20.0, 200.0);
        assert!(arrived > 0.8 * mbit_s, "{arrived} of {mbit_s} Mbit/s");
        assert!(queue_ms < 30.0 && longest_ms < 100.0, "{queue_ms}, {longest_ms} ms at {mbit_s} Mbit/s");
    }
}

#[test]
fn steps_of_the_rate_are_followed() {
    let mut path = Path::new(100.0);
    path.run(5.0, 60.0);
    path.change(8.0);
    path.run(2.0, 60.0);
    let (arrived, [queue_ms, longest_ms]) = path.run(13.0, 60.0);
    assert!(arrived > 6.4 && queue_ms < 40.0, "{arrived} Mbit/s, {queue_ms}, {longest_ms} ms");
    path.change(50.0);
    path.run(5.0, 60.0);
    let (arrived, [queue_ms, longest_ms]) = path.run(10.0, 60.0);
    assert!(arrived > 40.0 && queue_ms < 40.0, "{arrived} Mbit/s, {queue_ms}, {longest_ms} ms");
}

#[test]
fn what_is_not_used_does_not_grow() {
    let mut path = Path::new(100.0);
    path.run(5.0, 10.0);
    let target_mbit_s = path.target.bytes_s().unwrap_or(0.0) * 8e-6;
    assert!(target_mbit_s < 20.0, "{target_mbit_s} Mbit/s");
    let (arrived, _) = path.run(5.0, 10.0);
    assert!((9.9..10.1).contains(&arrived), "{arrived} Mbit/s");
}

#[test]
fn marks_and_much_loss_lower_it_without_a_queue() {
    let mut target = Target::default();
    target.begin(1_200_000.0);
    let start = Instant::now();
    let mut at_ms = 0;
    let mut note = |is_congested| {
        at_ms += 50;
        let end = start + Duration::from_millis(at_ms);
        let path = Duration::from_millis(50);
        let queue = Duration::ZERO;
        target.note(RoundTrip { end, delivered_bytes: 50_000, queue, path, is_full: false, is_congested });
        target.bytes_s()
    };
    let before = note(false).unwrap();
    (0..3).for_each(|_| {
        note(true);
    });
    let after = note(true).unwrap();
    assert!(after < 0.9 * before && after >= LEAST_PART * before, "{before} then {after}");
}

#[test]
fn a_train_begins_it() {
    let mut target = Target::default();
    target.begin(1_000_000.0);
    assert_eq!(target.bytes_s(), Some(OF_DELIVERED * 1_000_000.0));
    target.begin(9_000_000.0);
    assert_eq!(target.bytes_s(), Some(OF_DELIVERED * 1_000_000.0), "it goes on from there by itself");
    let mut fast = Target::default();
    fast.begin(FAST_TRAIN_BYTES_S);
    assert_eq!(fast.bytes_s(), Some(FAST_BYTES_S));
    let mut none = Target::default();
    none.begin(0.0);
    assert_eq!(none.bytes_s(), Some(LEAST_BYTES_S));
}

#[test]
fn little_traffic_says_nothing_of_the_path() {
    let mut target = Target::default();
    let start = Instant::now();
    for round in 1..20 {
        let end = start + Duration::from_millis(40 * round);
        let (queue, path) = (Duration::ZERO, Duration::from_millis(40));
        target.note(RoundTrip {
            end,
            delivered_bytes: 1000,
            queue,
            path,
            is_full: false,
            is_congested: false,
        });
    }
    assert_eq!(target.bytes_s(), None);
}
