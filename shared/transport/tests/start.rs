//! What the first update of a session makes of links that carry little and of links that carry much, in virtual time.

use shadecast_protocol::limits::PADDING_BYTES;
use shadecast_transport::{
    Direction, Endpoint, EndpointConfig, Event, LinkProfile, Pair, PeerId, ServerIdentity,
};

const MS: i64 = 1_000_000;
const S: i64 = 1_000 * MS;
const PERIOD_NS: i64 = 33_333_333;
/// Most that the geometry of a scene takes, bytes.
const SCENE_BYTES: usize = 250_000;
/// Geometry that a first update brings in any case, bytes.
const LEAST_GEOMETRY_BYTES: usize = 131_072;
/// From the pose's arrival to the first geometry, and from there to the first picture.
const UPDATE_NS: i64 = 12 * MS;
const ENCODE_NS: i64 = 8 * MS;
/// What a stream takes where the link carries it, Mbit/s.
const STREAM_MBIT_S: f64 = 20.0;

/// The beginning of a session.
struct Start {
    pair: Pair,
    peer: PeerId,
    arrived: usize,
    /// The longest that something waited before the bottleneck so far.
    queue_ns: i64,
}

/// What came of it.
#[derive(Debug)]
struct Seen {
    /// From the welcome's departure until the first update was there whole.
    first_ms: i64,
    queue_ms: i64,
    dropped: u64,
    /// Later pictures that had come whole 5 s after the first one left.
    later: usize,
}

impl Start {
    fn play(link: &str, picture_bytes: usize, seed: u64) -> Seen {
        let config = |salt| EndpointConfig { seed: Some(seed ^ salt), ..EndpointConfig::default() };
        let server = Endpoint::server(&ServerIdentity::from_seed(seed).unwrap(), config(1 << 20)).unwrap();
        let link: LinkProfile = link.parse().unwrap();
        let mut pair = Pair::new(server, Endpoint::client(config(2 << 20)), link.clone(), seed);
        let peer = pair.connect();
        let mut start = Self { pair, peer, arrived: 0, queue_ns: 0 };
        let welcome_ns = start.pair.now_ns();
        start.pair.server.send_control(peer, &[0; PADDING_BYTES]).unwrap();
        // The welcome is first, so the pose comes a round trip later.
        start.until(welcome_ns + 2 * link.latency_ns + UPDATE_NS, 0);
        let told = start.pair.server.stats(peer).unwrap().delivered_bit_per_s as usize / 8;
        start.send(told.clamp(LEAST_GEOMETRY_BYTES, SCENE_BYTES));
        start.until(start.pair.now_ns() + ENCODE_NS, 0);
        start.send(picture_bytes);
        let left_ns = start.pair.now_ns();
        start.until(left_ns + 60 * S, 2);
        let first_ms = (start.pair.now_ns() - welcome_ns) / MS;
        assert_eq!(start.arrived, 2, "nothing whole after a minute");
        start.stream(left_ns + 5 * S);
        let dropped = start.pair.link().counts(Direction::ToClient).dropped;
        Seen { first_ms, queue_ms: start.queue_ns / MS, dropped, later: start.arrived - 2 }
    }

    /// Goes on until a time, or until so many streams have arrived, where that is more than none.
    fn until(&mut self, until_ns: i64, streams: usize) {
        while self.pair.now_ns() < until_ns && (streams == 0 || self.arrived < streams) {
            let events = self.pair.step_to_events(until_ns.min(self.pair.now_ns() + MS));
            self.arrived += events.iter().filter(|(_, event)| matches!(event, Event::Stream { .. })).count();
            let queue_ns = self.pair.link().queue_ns(Direction::ToClient, self.pair.now_ns());
            self.queue_ns = self.queue_ns.max(queue_ns);
        }
    }

    /// Updates that follow the target.
    fn stream(&mut self, until_ns: i64) {
        while self.pair.now_ns() < until_ns {
            let stats = self.pair.server.stats(self.peer).unwrap();
            let most_mbit_s = (stats.target_bit_per_s as f64 * 1e-6).min(STREAM_MBIT_S);
            let bytes = (most_mbit_s * 1e6 / 8.0 * PERIOD_NS as f64 * 1e-9) as usize;
            if stats.streams_under_way <= 2 {
                self.send(bytes.max(1000));
            }
            self.until(self.pair.now_ns() + PERIOD_NS, 0);
        }
    }

    fn send(&mut self, bytes: usize) {
        self.pair.server.send_stream(self.peer, vec![0; bytes], 0).unwrap();
    }
}

/// The worst of four seeds: the first update, milliseconds; the queue, milliseconds; packets dropped; and the fewest later pictures.
fn worst(link: &str, picture_bytes: usize) -> Seen {
    let seen: Vec<_> = (0..4).map(|seed| Start::play(link, picture_bytes, seed)).collect();
    let worst = Seen {
        first_ms: seen.iter().map(|seen| seen.first_ms).max().unwrap(),
        queue_ms: seen.iter().map(|seen| seen.queue_ms).max().unwrap(),
        dropped: seen.iter().map(|seen| seen.dropped).max().unwrap(),
        later: seen.iter().map(|seen| seen.later).min().unwrap(),
    };
    println!("{link}, {} kB: {worst:?}", picture_bytes / 1000);
    worst
}

const PICTURES_BYTES: [usize; 2] = [60_000, 400_000];

#[test]
fn a_first_update_overflows_no_narrow_link_for_long() {
    for (rate, bars_ms) in [("1mbit", [2200, 5000]), ("3mbit", [1200, 2100])] {
        for latency in ["20ms", "110ms"] {
            for (picture_bytes, bar_ms) in PICTURES_BYTES.into_iter().zip(bars_ms) {
                let link = format!("latency={latency},rate={rate},queue=250ms");
                let seen = worst(&link, picture_bytes);
                assert!(seen.first_ms < bar_ms && seen.dropped < 230, "{link}: {seen:?}, bar {bar_ms} ms");
            }
        }
    }
}

#[test]
fn a_first_update_makes_no_long_queue_before_a_narrow_link() {
    for (rate, bar_ms) in [("1mbit", 1000), ("3mbit", 600)] {
        for latency in ["20ms", "110ms"] {
            let link = format!("latency={latency},rate={rate},queue=2s");
            let seen = worst(&link, PICTURES_BYTES[0]);
            assert!(seen.queue_ms < bar_ms, "{link}: {seen:?}");
        }
    }
}

#[test]
fn a_first_update_crosses_a_wide_link_at_once() {
    for (latency_ms, jitter, bars_ms) in
        [(20, "", [100, 130]), (110, "", [370, 400]), (20, ",jitter=10ms", [200, 250])]
    {
        for (picture_bytes, bar_ms) in PICTURES_BYTES.into_iter().zip(bars_ms) {
            let link = format!("latency={latency_ms}ms,rate=100mbit{jitter}");
            let seen = worst(&link, picture_bytes);
            assert!(seen.first_ms <= bar_ms && seen.dropped == 0, "{link}: {seen:?}, bar {bar_ms} ms");
        }
    }
}
