//! What a stream of pictures makes of the queue before a bottleneck, in virtual time.

use shadecast_protocol::limits::PADDING_BYTES;
use shadecast_transport::neighbour::{Neighbour, Traffic};
use shadecast_transport::{
    Direction, Endpoint, EndpointConfig, Event, LinkProfile, LinkSchedule, Pair, PeerId, ServerIdentity,
};

const MS: i64 = 1_000_000;
const S: i64 = 1_000 * MS;
const PERIOD_NS: i64 = 33_333_333;

/// Pictures at 30 Hz, withheld where more than two would wait behind what may be under way, as the server does.
struct Stream {
    pair: Pair,
    peer: PeerId,
    picture_bytes: usize,
    /// Pictures take no more than the target, as an encoder makes them.
    follows_target: bool,
    /// By picture that was sent: the queue before the bottleneck then, milliseconds.
    queues_ms: Vec<f64>,
    arrived_bytes: u64,
}

impl Stream {
    fn start(link: impl Into<LinkSchedule>, mbit_s: f64, seed: u64) -> Self {
        let config = |salt| EndpointConfig { seed: Some(seed ^ salt), ..EndpointConfig::default() };
        let server = Endpoint::server(&ServerIdentity::from_seed(seed).unwrap(), config(1)).unwrap();
        let mut pair = Pair::new(server, Endpoint::client(config(2)), link, seed);
        let peer = pair.connect();
        let picture_bytes = (mbit_s * 1e6 / 8.0 * PERIOD_NS as f64 * 1e-9) as usize;
        Self { pair, peer, picture_bytes, follows_target: false, queues_ms: Vec::new(), arrived_bytes: 0 }
    }

    /// Goes on until `until_ns`; median and most of the queue from `settled_ns` on, milliseconds, and what arrived from then on, Mbit/s.
    fn until(&mut self, settled_ns: i64, until_ns: i64) -> (f64, f64, f64) {
        let mut settled_bytes = None;
        while self.pair.now_ns() < until_ns {
            let stats = self.pair.server.stats(self.peer).unwrap();
            if stats.unacknowledged_bytes <= stats.window_bytes + 2 * self.picture_bytes as u64 {
                let target_bytes = (stats.target_bit_per_s as f64 / 8.0 * PERIOD_NS as f64 * 1e-9) as usize;
                let most_bytes = if self.follows_target { target_bytes.max(1000) } else { usize::MAX };
                let bytes = self.picture_bytes.min(most_bytes);
                self.pair.server.send_stream(self.peer, vec![0; bytes], 0).unwrap();
            }
            let next_ns = self.pair.now_ns() + PERIOD_NS;
            while self.pair.now_ns() < next_ns {
                for (_, event) in self.pair.step_to_events(next_ns.min(self.pair.now_ns() + 5 * MS)) {
                    let Event::Stream { bytes, .. } = event else { continue };
                    self.arrived_bytes += bytes.len() as u64;
                }
                let queue_ns = self.pair.link().queue_ns(Direction::ToClient, self.pair.now_ns());
                if self.pair.now_ns() >= settled_ns {
                    settled_bytes.get_or_insert(self.arrived_bytes);
                    self.queues_ms.push(queue_ns as f64 / MS as f64);
                }
            }
        }
        let mut queues_ms = std::mem::take(&mut self.queues_ms);
        queues_ms.sort_by(f64::total_cmp);
        let mbit = (self.arrived_bytes - settled_bytes.unwrap_or(0)) as f64 * 8e-6
            / ((until_ns - settled_ns) as f64 * 1e-9);
        (queues_ms[queues_ms.len() / 2], queues_ms[queues_ms.len() - 1], mbit)
    }
}

#[test]
fn an_encoder_that_follows_the_target_uses_the_path_and_makes_no_queue() {
    const STEP: i64 = 10 * S;
    let rates = [100, 8, 50, 100];
    let steps =
        rates.iter().zip(0..).map(|(rate, n)| (n * STEP, profile(&format!("latency=10ms,rate={rate}mbit"))));
    for wanted_mbit in [20.0, 150.0] {
        let mut stream = Stream::start(LinkSchedule::of_steps(steps.clone().collect()), wanted_mbit, 1);
        stream.follows_target = true;
        stream.pair.server.send_control(stream.peer, &[0; PADDING_BYTES]).unwrap();
        for (rate, n) in rates.iter().zip(0..) {
            let (_, longest_ms, early_mbit) = stream.until(n * STEP, n * STEP + 5 * S);
            let (queue_ms, worst_ms, mbit) = stream.until(n * STEP + 5 * S, (n + 1) * STEP - S / 10);
            let context = format!(
                "{wanted_mbit} over {rate} Mbit/s: {queue_ms}, {worst_ms} ms, {mbit} Mbit/s; before {longest_ms} ms, {early_mbit} Mbit/s"
            );
            assert!(queue_ms < 25.0 && worst_ms < 100.0, "{context}");
            assert!(mbit > 0.8 * wanted_mbit.min(f64::from(*rate)), "{context}");
        }
    }
}

#[test]
fn a_target_is_not_starved_by_jitter_and_loss() {
    for (link, least_mbit) in [
        ("latency=23ms,jitter=20ms,rate=100mbit", 40.0),
        ("latency=10ms,jitter=10ms,rate=100mbit", 40.0),
        ("latency=20ms,jitter=5ms,loss=2%,rate=100mbit", 40.0),
        ("latency=110ms,jitter=5ms,loss=5%,rate=100mbit", 30.0),
    ] {
        for seed in [1, 2] {
            let mut stream = Stream::start(profile(link), 50.0, seed);
            stream.follows_target = true;
            stream.pair.server.send_control(stream.peer, &[0; PADDING_BYTES]).unwrap();
            stream.until(0, 5 * S);
            let (queue_ms, _, mbit) = stream.until(5 * S, 15 * S);
            assert!(mbit > least_mbit, "{link}: {queue_ms} ms, {mbit} Mbit/s");
        }
    }
}

#[test]
fn the_first_packets_tell_what_the_path_carries() {
    for rate_mbit in [0.4, 2.0, 8.0, 30.0, 100.0] {
        for (jitter, least, most) in [("", 0.8, 1.3), (",jitter=5ms", 0.1, 1.6)] {
            for loss in ["", ",loss=2%"] {
                let link = format!("latency=20ms,rate={rate_mbit}mbit{jitter}{loss}");
                let mut stream = Stream::start(profile(&link), 1.0, 1);
                stream.pair.server.send_control(stream.peer, &[0; PADDING_BYTES]).unwrap();
                let all_ns = (PADDING_BYTES as f64 * 8e3 / rate_mbit) as i64;
                let until_ns = stream.pair.now_ns() + 2 * 20 * MS + all_ns + 20 * MS;
                while stream.pair.now_ns() < until_ns {
                    stream.pair.step_to_events(until_ns);
                }
                let told = stream.pair.server.stats(stream.peer).unwrap().delivered_bit_per_s as f64 * 1e-6;
                assert!((least..most).contains(&(told / rate_mbit)), "{told} Mbit/s over {link}");
            }
        }
    }
}

fn profile(text: &str) -> LinkProfile {
    LinkProfile { queue_ns: 250 * MS, ..text.parse().unwrap() }
}

#[test]
fn a_router_queue_is_short_two_seconds_after_each_change_of_the_rate() {
    const STEP: i64 = 8 * S;
    let rates = [100, 8, 50, 100];
    let steps =
        rates.iter().zip(0..).map(|(rate, n)| (n * STEP, profile(&format!("latency=10ms,rate={rate}mbit"))));
    for wanted_mbit in [20.0, 60.0, 150.0] {
        let mut stream = Stream::start(LinkSchedule::of_steps(steps.clone().collect()), wanted_mbit, 1);
        for (rate, n) in rates.iter().zip(0..) {
            stream.until(n * STEP, n * STEP + 2 * S);
            let (queue_ms, _, mbit) = stream.until(n * STEP + 2 * S, (n + 1) * STEP);
            let context = format!("{wanted_mbit} over {rate} Mbit/s: {queue_ms} ms, {mbit} Mbit/s");
            assert!(queue_ms < 60.0, "{context}");
            assert!(mbit > 0.8 * wanted_mbit.min(f64::from(*rate)), "{context}");
        }
    }
}

#[test]
fn a_path_that_takes_longer_under_load_is_not_starved() {
    for (link, rate_mbit) in [
        ("latency=23ms,jitter=20ms,rate=100mbit", 100.0),
        ("latency=5ms,jitter=5ms,rate=100mbit", 100.0),
        ("latency=25ms,jitter=25ms,loss=1%,rate=300mbit", 150.0),
    ] {
        for (wanted_mbit, seed) in [(20.0_f64, 1), (150.0, 1), (150.0, 2), (150.0, 3)] {
            let mut stream = Stream::start(profile(link), wanted_mbit, seed);
            stream.until(0, 2 * S);
            let (queue_ms, _, mbit) = stream.until(2 * S, 12 * S);
            let context = format!("{wanted_mbit} over {link}: {queue_ms} ms, {mbit} Mbit/s");
            assert!(mbit > 0.8 * wanted_mbit.min(rate_mbit), "{context}");
            assert!(queue_ms < 100.0, "{context}");
        }
    }
}

/// A viewer that follows the target beside a neighbour that comes later, behind 20 Mbit/s: what both get, Mbit/s, and the queue, milliseconds.
fn beside(traffic: Traffic, latency_ms: u32, seed: u64) -> ([f64; 2], f64) {
    let mut stream = Stream::start(profile(&format!("latency={latency_ms}ms,rate=20mbit")), 20.0, seed);
    stream.follows_target = true;
    stream.pair.server.send_control(stream.peer, &[0; PADDING_BYTES]).unwrap();
    stream.pair.add_neighbour(Neighbour::new(traffic, 3 * S, seed ^ 77).unwrap());
    stream.until(0, 15 * S);
    let before_bytes = stream.pair.neighbours()[0].arrived_bytes();
    let (queue_ms, _, mbit) = stream.until(15 * S, 45 * S);
    let theirs = (stream.pair.neighbours()[0].arrived_bytes() - before_bytes) as f64 * 8e-6 / 30.0;
    ([mbit, theirs], queue_ms)
}

#[test]
fn two_viewers_behind_one_bottleneck_share_it() {
    for latency_ms in [5, 20] {
        for seed in [1, 2] {
            let ([own, theirs], queue_ms) = beside(Traffic::Pictures(20.0), latency_ms, seed);
            let context = format!("{latency_ms} ms: {own:.1} and {theirs:.1} Mbit/s, queue {queue_ms:.0} ms");
            println!("{context}");
            assert!(own.min(theirs) > 0.75 * (own + theirs) / 2.0, "{context}");
            assert!(own + theirs > 0.8 * 20.0 && queue_ms < 60.0, "{context}");
        }
    }
}

/// A Cubic fills the router's queue: the viewer shares as Cubics share with each other.
#[test]
fn a_viewer_and_a_download_have_fair_shares() {
    for latency_ms in [5, 20] {
        for seed in [1, 2] {
            let ([own, theirs], queue_ms) = beside(Traffic::Download, latency_ms, seed);
            let context = format!("{latency_ms} ms: {own:.1} and {theirs:.1} Mbit/s, queue {queue_ms:.0} ms");
            println!("{context}");
            assert!(own.min(theirs) > 0.75 * (own + theirs) / 2.0, "{context}");
            assert!(own + theirs > 0.9 * 20.0, "{context}");
        }
    }
}

#[test]
fn viewers_that_a_download_has_left_make_no_queue() {
    for seed in [1, 2] {
        let mut stream = Stream::start(profile("latency=10ms,rate=20mbit"), 20.0, seed);
        stream.follows_target = true;
        stream.pair.server.send_control(stream.peer, &[0; PADDING_BYTES]).unwrap();
        stream.pair.add_neighbour(Neighbour::new(Traffic::Pictures(20.0), 2 * S, seed ^ 77).unwrap());
        stream.pair.add_neighbour(Neighbour::new(Traffic::Download, 5 * S, seed ^ 78).unwrap().until(30 * S));
        let (beside_ms, ..) = stream.until(15 * S, 30 * S);
        stream.until(30 * S, 90 * S);
        let (queue_ms, _, mbit) = stream.until(90 * S, 110 * S);
        println!("queue {beside_ms:.0}, then {queue_ms:.0} ms, {mbit:.1} Mbit/s");
        assert!(beside_ms > 100.0, "the download fills the queue: {beside_ms} ms");
        assert!(queue_ms < 60.0, "{queue_ms} ms, {mbit} Mbit/s");
    }
}
