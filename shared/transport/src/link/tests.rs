use super::*;

const MS: i64 = 1_000_000;

fn profile(text: &str) -> LinkProfile {
    text.parse().unwrap_or_else(|e| panic!("{e}"))
}

/// Sends `count` numbered datagrams of `size` bytes every `spacing_ns`; returns (number, arrival) in arrival order.
fn fates(text: &str, seed: u64, count: u32, size: usize, spacing_ns: i64) -> (Vec<(u32, i64)>, LinkCounts) {
    let mut link = Link::new(profile(text), seed);
    for n in 0..count {
        link.send(i64::from(n) * spacing_ns, Direction::ToClient, vec![0; size], n);
    }
    let arrived = std::iter::from_fn(|| link.poll(i64::MAX)).map(|d| (d.tag, d.at_ns)).collect();
    (arrived, link.counts(Direction::ToClient))
}

#[test]
fn all_keys_are_parsed() {
    let p = profile("latency=20ms, jitter=500us,loss=1.5%,rate=100mbit,queue=50ms,reorder=0.1%,mtu=1400");
    assert_eq!((p.latency_ns, p.jitter_ns, p.queue_ns), (20 * MS, MS / 2, 50 * MS));
    assert_eq!((p.loss, p.rate_bit_per_s, p.mtu_bytes), (0.015, Some(100_000_000), Some(1400)));
    assert!((p.reorder - 0.001).abs() < 1e-12);
    assert_eq!(profile("none"), LinkProfile::default());
}

#[test]
fn a_printed_profile_parses_to_itself() {
    for text in ["none", "latency=20ms,jitter=1500us,loss=1%,rate=100mbit,mtu=1400", "latency=7ns,queue=3ms"]
    {
        assert_eq!(profile(&profile(text).to_string()), profile(text));
    }
}

#[test]
fn errors_name_the_key_and_the_remedy() {
    for (text, expected) in [
        ("latency", ["\"latency\"", "key=value"]),
        ("latencies=20ms", ["\"latencies\"", "latency, jitter"]),
        ("latency=20", ["unit is missing", "latency=20ms"]),
        ("latency=fast", ["not a duration", "latency=20ms"]),
        ("latency=20ms,latency=30ms", ["latency", "twice"]),
        ("loss=0.01", ["percent sign", "loss=1%"]),
        ("loss=101%", ["more than 100 %", "loss=1%"]),
        ("loss=-1%", ["not a percentage", "loss=1%"]),
        ("rate=100", ["unit is missing", "rate=100mbit"]),
        ("rate=0mbit", ["between", "rate=100mbit"]),
        ("mtu=500", ["1200", "mtu=1400"]),
        ("latency=1ms,jitter=2ms", ["jitter=2ms", "more than the latency"]),
        ("", ["\"\"", "key=value"]),
    ] {
        let message = text.parse::<LinkProfile>().expect_err(text).to_string();
        for part in expected {
            assert!(message.contains(part), "{text}: {message}");
        }
    }
}

#[test]
fn a_schedule_changes_the_link_at_its_times() {
    let text =
        "[[step]]\nstart = \"2s\"\nlink = \"latency=20ms\"\n[[step]]\nstart = \"3s\"\nlink = \"loss=100%\"\n";
    let schedule = LinkSchedule::parse(text).unwrap();
    let mut link = Link::new(schedule, 1);
    for (send_ms, tag) in [(0, "perfect"), (2500, "slow"), (3500, "lost")] {
        link.send(send_ms * MS, Direction::ToServer, vec![1], tag);
    }
    assert_eq!(link.poll(0).unwrap().tag, "perfect");
    assert!(link.poll(2519 * MS).is_none());
    assert_eq!(link.poll(2520 * MS).unwrap().at_ns, 2520 * MS);
    assert!(link.poll(i64::MAX).is_none());
    assert_eq!(link.counts(Direction::ToServer).lost, 1);
}

#[test]
fn schedule_errors_name_the_step() {
    for (text, expected) in [
        ("", "no [[step]]"),
        ("[[step]]\nstart=\"1s\"\nlink=\"latency=1\"", "step 1"),
        ("[[step]]\nstart=\"soon\"\nlink=\"none\"", "step 1: start=soon"),
        ("[[step]]\nstart=\"2s\"\nlink=\"none\"\n[[step]]\nstart=\"1s\"\nlink=\"none\"", "step 2"),
        ("[[step]]\nbegin=\"2s\"", "begin"),
    ] {
        let message = LinkSchedule::parse(text).expect_err(text);
        assert!(message.contains(expected), "{text}: {message}");
    }
    let message = LinkSchedule::load("/nonexistent/link.toml").expect_err("no such file").to_string();
    assert!(message.contains("/nonexistent/link.toml"), "{message}");
}

#[test]
fn the_same_seed_gives_the_same_fates() {
    let text = "latency=20ms,jitter=5ms,loss=3%,rate=50mbit,reorder=2%";
    assert_eq!(fates(text, 7, 5000, 1000, MS / 5), fates(text, 7, 5000, 1000, MS / 5));
    assert_ne!(fates(text, 7, 5000, 1000, MS / 5).0, fates(text, 8, 5000, 1000, MS / 5).0);
}

#[test]
fn a_lost_datagram_does_not_change_the_fate_of_the_others() {
    let lossless: Vec<_> = fates("latency=20ms,jitter=5ms", 3, 2000, 100, 20 * MS).0;
    let lossy = fates("latency=20ms,jitter=5ms,loss=10%", 3, 2000, 100, 20 * MS).0;
    assert!(lossy.len() < lossless.len());
    assert!(lossy.iter().all(|arrived| lossless.contains(arrived)));
}

#[test]
fn loss_is_near_what_was_asked_for() {
    for seed in 0..8 {
        for percent in [1.0, 5.0, 50.0] {
            let (_, counts) = fates(&format!("loss={percent}%"), seed, 20_000, 100, MS);
            let measured = counts.lost as f64 / counts.sent as f64 * 100.0;
            // Five standard deviations of a binomial.
            let tolerance = 5.0 * (percent * (100.0 - percent) / 20_000.0_f64).sqrt();
            assert!((measured - percent).abs() < tolerance, "seed {seed}: {measured} % of {percent} %");
            assert_eq!(counts.sent, counts.delivered + counts.lost);
        }
    }
}

#[test]
fn order_is_kept_under_jitter_without_reorder() {
    for seed in 0..8 {
        let (arrived, _) = fates("latency=20ms,jitter=15ms,loss=2%", seed, 5000, 500, MS / 4);
        assert!(arrived.is_sorted_by(|a, b| a.0 < b.0 && a.1 <= b.1), "seed {seed}");
    }
}

#[test]
fn reorder_lets_later_datagrams_overtake() {
    let (arrived, counts) = fates("latency=20ms,jitter=2ms,reorder=5%", 4, 5000, 500, MS / 4);
    let overtaken = arrived.windows(2).filter(|w| w[1].0 < w[0].0).count();
    assert!((100..=400).contains(&overtaken), "{overtaken} of 5000 at 5 %");
    assert_eq!(counts.delivered, 5000);
}

#[test]
fn jitter_stays_in_its_range_and_fills_it() {
    let (arrived, _) = fates("latency=20ms,jitter=5ms", 5, 2000, 100, 50 * MS);
    let delays: Vec<i64> = arrived.iter().map(|&(n, at)| at - i64::from(n) * 50 * MS).collect();
    let (low, high) = (*delays.iter().min().unwrap(), *delays.iter().max().unwrap());
    assert!((15 * MS..16 * MS).contains(&low) && (24 * MS..=25 * MS).contains(&high), "{low} to {high}");
}

#[test]
fn the_bottleneck_holds_its_rate_and_drops_overflow() {
    // 20 ms of queue at 10 Mbit/s, offered 40 Mbit/s for a second.
    let (arrived, counts) = fates("latency=5ms,rate=10mbit,queue=20ms", 6, 5000, 972, MS / 5);
    let bits = (arrived.len() as u64) * (972 + UDP_IP_OVERHEAD_BYTES) * 8;
    let seconds = (arrived.last().unwrap().1 - 5 * MS) as f64 * 1e-9;
    let rate = bits as f64 / seconds;
    assert!((rate - 10e6).abs() < 0.01 * 10e6, "{rate} bit/s");
    assert_eq!(counts.sent, counts.delivered + counts.dropped);
    assert!(counts.dropped > 3000, "{counts:?}");
    let longest = arrived.iter().map(|&(n, at)| at - i64::from(n) * MS / 5).max().unwrap();
    assert!(longest <= 5 * MS + 20 * MS + 2 * serialisation_ns(972, 10_000_000), "{longest} ns");
}

#[test]
fn what_exceeds_the_mtu_does_not_pass() {
    assert_eq!(fates("mtu=1400", 1, 3, 1400, MS).1.delivered, 3);
    let counts = fates("mtu=1400", 1, 3, 1401, MS).1;
    assert_eq!((counts.delivered, counts.oversized), (0, 3));
}

#[test]
fn the_two_directions_have_fates_of_their_own() {
    let mut link = Link::new(profile("loss=50%"), 9);
    for n in 0..64 {
        link.send(0, Direction::ToClient, vec![0], n);
        link.send(0, Direction::ToServer, vec![0], n);
    }
    let arrived: Vec<_> = std::iter::from_fn(|| link.poll(0)).map(|d| (d.direction, d.tag)).collect();
    let of = |side| arrived.iter().filter(move |(d, _)| *d == side).map(|(_, n)| *n).collect::<Vec<i32>>();
    assert_ne!(of(Direction::ToClient), of(Direction::ToServer));
}
