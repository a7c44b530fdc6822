//! Measures congestion control on simulated links, in virtual time: the rate, and the delay of pictures.
//!
//! `cargo run --release -p shadecast-transport --example link_bench`

use shadecast_transport::pair::SERVER_ADDR;
use shadecast_transport::{
    Congestion, Direction, Endpoint, EndpointConfig, Event, ExpectedIdentity, LinkProfile, Pair, PeerId,
    ServerIdentity,
};

const MS: i64 = 1_000_000;
const LINKS: [&str; 7] = [
    "latency=20ms,rate=100mbit",
    "latency=20ms,jitter=5ms,rate=100mbit,loss=1%",
    "latency=20ms,jitter=5ms,rate=100mbit,loss=5%",
    "latency=20ms,rate=100mbit,queue=20ms,loss=1%",
    "latency=2ms,jitter=1ms,rate=400mbit,loss=1%",
    "latency=20ms,jitter=5ms,rate=30mbit,loss=1%",
    "latency=1ms,rate=1gbit",
];

struct Run {
    pair: Pair,
    peer: PeerId,
}

fn start(link: &str, congestion: Congestion) -> Result<Run, Box<dyn std::error::Error>> {
    let config = EndpointConfig { seed: Some(1), congestion, ..EndpointConfig::default() };
    let server = Endpoint::server(&ServerIdentity::from_seed(1)?, config.clone())?;
    let mut pair = Pair::new(server, Endpoint::client(config), link.parse::<LinkProfile>()?, 1);
    pair.client.connect(0, SERVER_ADDR, ExpectedIdentity::TrustOnFirstUse);
    loop {
        for (end, event) in pair.step_to_events(5_000 * MS) {
            if let (Direction::ToServer, Event::Connected { peer, .. }) = (end, event) {
                return Ok(Run { pair, peer });
            }
        }
    }
}

/// Megabits per second that pass when there is always something to send, and the smoothed round trip then.
fn saturated(run: &mut Run) -> (f64, f64) {
    let (start_ns, mut bytes) = (run.pair.now_ns(), 0);
    let end_ns = start_ns + 10_000 * MS;
    while run.pair.now_ns() < end_ns {
        while run.pair.server.stats(run.peer).is_some_and(|s| s.streams_under_way < 40) {
            if run.pair.server.send_stream(run.peer, vec![0; 200_000], 0).is_err() {
                break;
            }
        }
        for (_, event) in run.pair.step_to_events(end_ns) {
            if let Event::Stream { bytes: stream, .. } = event {
                bytes += stream.len();
            }
        }
    }
    let rtt = run.pair.server.rtt(run.peer).map_or(0.0, |rtt| rtt.as_secs_f64() * 1e3);
    (bytes as f64 * 8.0 / 10.0 / 1e6, rtt)
}

/// Milliseconds from sending to complete arrival of pictures at 30 Hz, sorted: the first of 500 KB, then 60 KB each
/// with 20 KB of geometry beside it.
fn pictures(run: &mut Run) -> (f64, Vec<f64>) {
    let start_ns = run.pair.now_ns();
    let mut sent_ns = Vec::new();
    let (mut first, mut delays) = (0.0, Vec::new());
    for frame in 0..900_u32 {
        let at_ns = start_ns + i64::from(frame) * 33_333_333;
        drain(run, at_ns, &sent_ns, &mut first, &mut delays);
        sent_ns.push(at_ns);
        let mut picture = vec![0; if frame == 0 { 500_000 } else { 60_000 }];
        picture[..4].copy_from_slice(&frame.to_le_bytes());
        let _ = run.pair.server.send_stream(run.peer, picture, 0);
        let _ = run.pair.server.send_stream(run.peer, vec![0; 20_000], 0);
    }
    drain(run, start_ns + 40_000 * MS, &sent_ns, &mut first, &mut delays);
    delays.sort_by(f64::total_cmp);
    (first, delays)
}

fn drain(run: &mut Run, until_ns: i64, sent_ns: &[i64], first: &mut f64, delays: &mut Vec<f64>) {
    while run.pair.now_ns() < until_ns {
        for (_, event) in run.pair.step_to_events(until_ns) {
            let Event::Stream { bytes, at_ns, .. } = event else { continue };
            if bytes.len() == 20_000 {
                continue;
            }
            let frame = u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]) as usize;
            let delay_ms = (at_ns - sent_ns[frame]) as f64 / 1e6;
            if frame == 0 { *first = delay_ms } else { delays.push(delay_ms) }
        }
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!(
        "{:44} {:8} {:>8} {:>7} | {:>7} {:>7} {:>7} {:>7} {:>7}",
        "link", "control", "Mbit/s", "rtt ms", "first", "p50", "p95", "p99", "max"
    );
    for link in LINKS {
        for congestion in [Congestion::Steady, Congestion::Cubic, Congestion::Bbr] {
            let (rate, rtt) = saturated(&mut start(link, congestion)?);
            let (first, delays) = pictures(&mut start(link, congestion)?);
            let at = |share: f64| {
                delays.get(((delays.len() - 1) as f64 * share) as usize).copied().unwrap_or(f64::NAN)
            };
            println!(
                "{link:44} {:8} {rate:8.1} {rtt:7.1} | {first:7.1} {:7.1} {:7.1} {:7.1} {:7.1}",
                format!("{congestion:?}"),
                at(0.5),
                at(0.95),
                at(0.99),
                at(1.0)
            );
        }
    }
    Ok(())
}
