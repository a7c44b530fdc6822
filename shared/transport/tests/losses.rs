//! How late updates are that must be taken in order, on paths that lose packets, in virtual time.

use shadecast_transport::{Endpoint, EndpointConfig, Event, LinkProfile, Pair, PeerId, ServerIdentity};
use std::collections::BTreeMap;

const MS: i64 = 1_000_000;
const S: i64 = 1_000 * MS;
/// From one update to the next.
const PERIOD_NS: i64 = 33_333_333;
/// Bytes of the streams of an update: its delta and its picture, or its delta and the slices of its picture.
const WHOLE_BYTES: &[usize] = &[3_000, 12_000];
const SLICED_BYTES: &[usize] = &[3_000, 3_000, 3_000, 3_000, 3_000];
/// Until then the connection has learnt what the path loses.
const SETTLED_NS: i64 = 3 * S;

/// Updates over a link.
struct Play {
    pair: Pair,
    peer: PeerId,
    streams_bytes: &'static [usize],
    /// When the update of each number left.
    sent_ns: Vec<i64>,
    /// Of these, how long after them each of their streams came, nanoseconds.
    came_ns: BTreeMap<usize, Vec<i64>>,
    /// Of each update in order: how long after it left it could be shown, nanoseconds.
    late_ns: Vec<i64>,
    /// The longest time without another update, nanoseconds, from [`SETTLED_NS`] on.
    pause_ns: i64,
    shown_ns: i64,
}

impl Play {
    fn new(link: &str, repeats: bool, seed: u64) -> Self {
        let config = |salt| EndpointConfig { seed: Some(seed ^ salt), repeats, ..EndpointConfig::default() };
        let server = Endpoint::server(&ServerIdentity::from_seed(seed).unwrap(), config(1 << 20)).unwrap();
        let link: LinkProfile = link.parse().unwrap();
        let mut pair = Pair::new(server, Endpoint::client(config(2 << 20)), link, seed);
        let peer = pair.connect();
        Self {
            pair,
            peer,
            streams_bytes: WHOLE_BYTES,
            sent_ns: Vec::new(),
            came_ns: BTreeMap::new(),
            late_ns: Vec::new(),
            pause_ns: 0,
            shown_ns: SETTLED_NS,
        }
    }

    fn until(mut self, until_ns: i64) -> Self {
        while self.pair.now_ns() < until_ns {
            for bytes in self.streams_bytes.iter().copied() {
                let mut stream = vec![0; bytes];
                stream[..8].copy_from_slice(&(self.sent_ns.len() as u64).to_le_bytes());
                self.pair.server.send_stream(self.peer, stream, 0).unwrap();
            }
            self.sent_ns.push(self.pair.now_ns());
            let due_ns = self.pair.now_ns() + PERIOD_NS;
            while self.pair.now_ns() < due_ns {
                for (_, event) in self.pair.step_to_events(due_ns) {
                    self.take(&event);
                }
            }
        }
        self
    }

    fn take(&mut self, event: &Event) {
        let Event::Stream { bytes, .. } = event else { return };
        let number = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        let now_ns = self.pair.now_ns();
        self.came_ns.entry(number).or_default().push(now_ns - self.sent_ns[number]);
        let whole = self.streams_bytes.len();
        while self.came_ns.get(&self.late_ns.len()).is_some_and(|came| came.len() == whole) {
            let sent_ns = self.sent_ns[self.late_ns.len()];
            self.late_ns.push(now_ns - sent_ns);
            if now_ns > SETTLED_NS {
                self.pause_ns = self.pause_ns.max(now_ns - self.shown_ns);
                self.shown_ns = now_ns;
            }
        }
    }

    /// Median and most of the lateness from [`SETTLED_NS`] on, and the longest pause, milliseconds.
    fn row(&self) -> [i64; 3] {
        let settled = self.sent_ns.iter().position(|at_ns| *at_ns >= SETTLED_NS).unwrap();
        let mut late_ns = self.late_ns[settled..].to_vec();
        late_ns.sort_unstable();
        [late_ns[late_ns.len() / 2], late_ns[late_ns.len() - 1], self.pause_ns].map(|ns| ns / MS)
    }

    /// Part of the updates that had not so many of their streams 30 ms after the way itself, `0..=1`.
    fn late(&self, latency_ms: i64, streams: usize) -> f64 {
        let settled = self.came_ns.iter().filter(|(number, _)| self.sent_ns[**number] >= SETTLED_NS);
        let (late, all) = settled.fold((0, 0), |(late, all), (_, came_ns)| {
            let is_late = came_ns.get(streams - 1).is_none_or(|ns| *ns > (latency_ms + 30) * MS);
            (late + usize::from(is_late), all + 1)
        });
        late as f64 / all as f64
    }
}

fn link(latency_ms: i64, loss_percent: u32) -> String {
    format!("latency={latency_ms}ms,loss={loss_percent}%,rate=100mbit")
}

#[test]
fn a_lost_packet_makes_no_update_late_by_more_than_a_round_trip() {
    for latency_ms in [5, 20, 50, 110, 200] {
        for loss_percent in [1, 5] {
            for seed in 0..3 {
                let play = Play::new(&link(latency_ms, loss_percent), true, seed).until(20 * S);
                let [_, most_ms, pause_ms] = play.row();
                let case = format!("{latency_ms} ms, {loss_percent} %, seed {seed}: {:?}", play.row());
                assert!(most_ms <= 3 * latency_ms + 80, "{case}");
                assert!(pause_ms <= 2 * latency_ms + 120, "{case}");
            }
        }
    }
}

#[test]
fn most_updates_are_not_late_at_all() {
    for loss_percent in [1, 5] {
        let row = |repeats| Play::new(&link(110, loss_percent), repeats, 5).until(20 * S).row();
        let ([median_ms, ..], [once_ms, ..]) = (row(true), row(false));
        assert!(median_ms <= 110 + 20, "{median_ms} ms");
        assert!(once_ms > median_ms, "without copies {once_ms} ms");
    }
}

#[test]
fn a_path_without_loss_has_everything_once() {
    let play = Play::new(&link(20, 0), true, 1).until(10 * S);
    assert_eq!(play.pair.server.stats(play.peer).unwrap().repeated_bytes, 0);
}

#[test]
fn copies_take_no_room_from_updates() {
    let slow = "latency=20ms,loss=3%,rate=5mbit";
    let play = |repeats| Play::new(slow, repeats, 3).until(20 * S);
    let (twice, once) = (play(true), play(false));
    let [with_ms, without_ms] = [&twice, &once].map(|play| play.row()[0]);
    assert!(with_ms <= without_ms + 10, "{with_ms} ms, without copies {without_ms} ms");
    let stats = twice.pair.server.stats(twice.peer).unwrap();
    assert!(stats.repeated_bytes < stats.sent_bytes / 3, "{stats:?}");
}

/// What a stream for each slice could gain at most: pictures of which all but one stream is there in time.
#[test]
fn few_pictures_wait_for_one_slice() {
    for latency_ms in [20, 50, 110] {
        let played = |streams_bytes, seed| {
            let play = Play::new(&link(latency_ms, 5), true, seed);
            Play { streams_bytes, ..play }.until(20 * S)
        };
        let mean = |late: &dyn Fn(u64) -> f64| (0..2).map(late).sum::<f64>() / 2.0;
        let whole = mean(&|seed| played(WHOLE_BYTES, seed).late(latency_ms, WHOLE_BYTES.len()));
        let but_one = mean(&|seed| played(SLICED_BYTES, seed).late(latency_ms, SLICED_BYTES.len() - 1));
        let percent = [whole, but_one].map(|part| format!("{:.1} %", 100.0 * part));
        println!(
            "{latency_ms} ms, 5 %: whole pictures late {}, all but one slice late {}",
            percent[0], percent[1]
        );
        assert!(whole < 0.1 && whole - but_one < 0.07, "{latency_ms} ms: {percent:?}");
    }
}
