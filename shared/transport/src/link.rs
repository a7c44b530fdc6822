//! A seeded network between two endpoints, at the level of UDP datagrams.
//!
//! Kernels without a network emulator, and every test that must repeat, need the network as a value: bytes go in with a time,
//! and come out later, or never. The link does not know QUIC and holds no clock.
//!
//! Each direction is a bottleneck with a bounded queue (tail drop), followed by random loss and a delay: `arrival = departure +
//! latency + uniform(-jitter, +jitter)`. Order is kept unless `reorder` asks otherwise. The fate of a datagram depends only on
//! the seed, its direction and its number, so two runs lose the same ones.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use crate::rng;

/// What IPv4 and UDP add to each datagram on a real wire; counted against `rate`. Bytes.
const UDP_IP_OVERHEAD_BYTES: u64 = 28;
/// Queue of the bottleneck when `queue` is not given: 200 ms, as a common home router.
const DEFAULT_QUEUE_NS: i64 = 200_000_000;
/// More datagrams than this under way in one link are dropped, so that an unlimited link stays bounded.
const MAX_IN_FLIGHT: usize = 1 << 17;
/// Keys of a link description, as listed in error messages.
const KEYS: &str = "latency, jitter, loss, rate, queue, reorder, mtu";

/// Which way a datagram travels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Direction {
    /// From the server to the client.
    ToClient,
    /// From the client to the server.
    ToServer,
}

/// The properties of a link at one time, the same in both directions.
#[derive(Clone, Debug, PartialEq)]
pub struct LinkProfile {
    /// One-way delay, nanoseconds, not negative.
    pub latency_ns: i64,
    /// Delay varies by up to this much both ways, nanoseconds, at most `latency_ns`.
    pub jitter_ns: i64,
    /// Probability of random loss, 0 to 1.
    pub loss: f64,
    /// Rate of the bottleneck in bits per second; `None` is unlimited.
    pub rate_bit_per_s: Option<u64>,
    /// How long a datagram may wait at the bottleneck before it is dropped, nanoseconds.
    pub queue_ns: i64,
    /// Probability that a datagram is held back so that later ones overtake it, 0 to 1.
    pub reorder: f64,
    /// Largest UDP payload that passes, bytes; `None` is unlimited.
    pub mtu_bytes: Option<usize>,
}

impl Default for LinkProfile {
    fn default() -> Self {
        Self {
            latency_ns: 0,
            jitter_ns: 0,
            loss: 0.0,
            rate_bit_per_s: None,
            queue_ns: DEFAULT_QUEUE_NS,
            reorder: 0.0,
            mtu_bytes: None,
        }
    }
}

/// Why a link description was refused.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// A part of the description is not `key=value`.
    #[error(
        "link \"{text}\": \"{part}\" is not of the form key=value; write for example latency=20ms,loss=1%"
    )]
    NotKeyValue {
        /// The whole description.
        text: String,
        /// The part at fault.
        part: String,
    },
    /// An unknown key.
    #[error("link \"{text}\": there is no key \"{key}\"; the keys are {KEYS}")]
    UnknownKey {
        /// The whole description.
        text: String,
        /// The key at fault.
        key: String,
    },
    /// A key given twice.
    #[error("link \"{text}\": {key} is given twice; keep one")]
    Duplicate {
        /// The whole description.
        text: String,
        /// The key at fault.
        key: String,
    },
    /// A value that cannot be used.
    #[error("link \"{text}\": {key}={value}: {wrong}; write for example {key}={example}")]
    Value {
        /// The whole description.
        text: String,
        /// The key at fault.
        key: String,
        /// Its value.
        value: String,
        /// What is wrong with it.
        wrong: String,
        /// A value that would do.
        example: &'static str,
    },
    /// The schedule file could not be read.
    #[error("reading the link schedule {path}: {reason}")]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        reason: std::io::Error,
    },
    /// The schedule file is not what it should be.
    #[error(
        "link schedule {path}: {wrong}; a schedule is a list of [[step]] with start = \"2s\" and link = \"latency=20ms\", in order of start"
    )]
    Schedule {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        wrong: String,
    },
}

/// Splits `20ms` into 20.0 and `ms`.
fn split_unit(value: &str) -> Option<(f64, &str)> {
    let end = value.find(|c: char| !(c.is_ascii_digit() || c == '.')).unwrap_or(value.len());
    let (number, unit) = value.split_at(end);
    let number: f64 = number.parse().ok()?;
    Some((number, unit.trim()))
}

/// A number with a unit, times what the unit stands for. The names say what such a value is, what its units are of, and which to use.
fn in_units(value: &str, units: &[(&str, f64)], [what, of, usual]: [&str; 3]) -> Result<f64, String> {
    let (number, unit) = split_unit(value).ok_or_else(|| format!("this is not a {what}"))?;
    match units.iter().find(|(name, _)| *name == unit) {
        Some((_, scale)) => Ok(number * scale),
        None if unit.is_empty() => Err(format!("the unit is missing ({usual})")),
        None => Err(format!("\"{unit}\" is not a unit of {of} ({usual})")),
    }
}

/// Nanoseconds from `20ms`, `500us`, `2s`.
fn parse_duration(value: &str) -> Result<i64, String> {
    let units = [("ns", 1.0), ("us", 1e3), ("ms", 1e6), ("s", 1e9)];
    let ns = in_units(value, &units, ["duration", "time", "us, ms or s"])?;
    if ns > 60e9 { Err("more than 60 s".into()) } else { Ok(ns.round() as i64) }
}

/// A probability from `1%`.
fn parse_percent(value: &str) -> Result<f64, String> {
    match split_unit(value).ok_or("this is not a percentage")? {
        (number, "%") if number <= 100.0 => Ok(number / 100.0),
        (_, "%") => Err("more than 100 %".into()),
        _ => Err("the percent sign is missing".into()),
    }
}

/// Bits per second from `100mbit`.
fn parse_rate(value: &str) -> Result<u64, String> {
    let units = [("bit", 1.0), ("kbit", 1e3), ("mbit", 1e6), ("gbit", 1e9)];
    let rate = in_units(value, &units, ["rate", "rate", "kbit, mbit or gbit"])?;
    if !(1000.0..=1e12).contains(&rate) {
        return Err("a rate lies between 1kbit and 1000gbit".into());
    }
    Ok(rate as u64)
}

/// Bytes from `1400`.
fn parse_mtu(value: &str) -> Result<usize, String> {
    match value.parse() {
        // QUIC needs 1200 bytes of UDP payload (RFC 9000, section 14).
        Ok(mtu) if (1200..=65_527).contains(&mtu) => Ok(mtu),
        Ok(_) => Err("QUIC needs 1200 to 65527 bytes of UDP payload".into()),
        Err(_) => Err("this is not a number of bytes".into()),
    }
}

impl LinkProfile {
    fn set(&mut self, key: &str, value: &str) -> Option<Result<(), (String, &'static str)>> {
        fn store<T>(
            to: &mut T,
            parsed: Result<T, String>,
            example: &'static str,
        ) -> Result<(), (String, &'static str)> {
            *to = parsed.map_err(|wrong| (wrong, example))?;
            Ok(())
        }
        Some(match key {
            "latency" => store(&mut self.latency_ns, parse_duration(value), "20ms"),
            "jitter" => store(&mut self.jitter_ns, parse_duration(value), "5ms"),
            "queue" => store(&mut self.queue_ns, parse_duration(value), "200ms"),
            "loss" => store(&mut self.loss, parse_percent(value), "1%"),
            "reorder" => store(&mut self.reorder, parse_percent(value), "0.1%"),
            "rate" => store(&mut self.rate_bit_per_s, parse_rate(value).map(Some), "100mbit"),
            "mtu" => store(&mut self.mtu_bytes, parse_mtu(value).map(Some), "1400"),
            _ => return None,
        })
    }
}

impl FromStr for LinkProfile {
    type Err = LinkError;

    /// Parses `latency=20ms,jitter=5ms,loss=1%,rate=100mbit,queue=200ms,reorder=0.1%,mtu=1400`; every key may be
    /// left out, and `none` is a perfect link.
    fn from_str(text: &str) -> Result<Self, LinkError> {
        let mut profile = Self::default();
        if text.trim() == "none" {
            return Ok(profile);
        }
        let mut seen: Vec<&str> = Vec::new();
        for part in text.split(',').map(str::trim) {
            let Some((key, value)) = part.split_once('=') else {
                return Err(LinkError::NotKeyValue { text: text.into(), part: part.into() });
            };
            let (key, value) = (key.trim(), value.trim());
            if seen.contains(&key) {
                return Err(LinkError::Duplicate { text: text.into(), key: key.into() });
            }
            seen.push(key);
            match profile.set(key, value) {
                Some(Ok(())) => {}
                Some(Err((wrong, example))) => {
                    let (key, value) = (key.into(), value.into());
                    return Err(LinkError::Value { text: text.into(), key, value, wrong, example });
                }
                None => return Err(LinkError::UnknownKey { text: text.into(), key: key.into() }),
            }
        }
        if profile.jitter_ns > profile.latency_ns {
            return Err(LinkError::Value {
                text: text.into(),
                key: "jitter".into(),
                value: fmt_ns(profile.jitter_ns),
                wrong: format!("more than the latency of {}", fmt_ns(profile.latency_ns)),
                example: "5ms",
            });
        }
        Ok(profile)
    }
}

/// Nanoseconds as the shortest exact text that [`parse_duration`] reads.
fn fmt_ns(ns: i64) -> String {
    match ns {
        ns if ns % 1_000_000 == 0 => format!("{}ms", ns / 1_000_000),
        ns if ns % 1_000 == 0 => format!("{}us", ns / 1_000),
        ns => format!("{ns}ns"),
    }
}

impl fmt::Display for LinkProfile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut parts = Vec::new();
        for (key, ns, usual) in [
            ("latency", self.latency_ns, 0),
            ("jitter", self.jitter_ns, 0),
            ("queue", self.queue_ns, DEFAULT_QUEUE_NS),
        ] {
            if ns != usual {
                parts.push(format!("{key}={}", fmt_ns(ns)));
            }
        }
        for (key, p) in [("loss", self.loss), ("reorder", self.reorder)] {
            if p != 0.0 {
                parts.push(format!("{key}={}%", p * 100.0));
            }
        }
        parts.extend(self.rate_bit_per_s.map(|rate| format!("rate={rate}bit")));
        parts.extend(self.mtu_bytes.map(|mtu| format!("mtu={mtu}")));
        f.write_str(if parts.is_empty() { "none".into() } else { parts.join(",") }.as_str())
    }
}

/// Link profiles with the times from which they hold. Never empty.
#[derive(Clone, Debug, PartialEq)]
pub struct LinkSchedule {
    /// Start in nanoseconds since the link's first use, ascending; the first starts at 0.
    steps: Vec<(i64, LinkProfile)>,
}

impl From<LinkProfile> for LinkSchedule {
    fn from(profile: LinkProfile) -> Self {
        Self { steps: vec![(0, profile)] }
    }
}

impl FromStr for LinkSchedule {
    type Err = LinkError;

    /// A link description that holds for ever, or the path of a schedule when the text ends in `.toml`.
    fn from_str(text: &str) -> Result<Self, LinkError> {
        if text.ends_with(".toml") { Self::load(text) } else { Ok(text.parse::<LinkProfile>()?.into()) }
    }
}

#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct ScheduleFile {
    #[serde(default)]
    step: Vec<ScheduleStep>,
}

#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct ScheduleStep {
    start: String,
    link: String,
}

impl LinkSchedule {
    /// Reads a schedule: `[[step]]` tables with `start = "2s"` and `link = "latency=20ms"`, in order. Before the
    /// first start the link is perfect.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, LinkError> {
        let path = path.as_ref();
        let text =
            std::fs::read_to_string(path).map_err(|reason| LinkError::Read { path: path.into(), reason })?;
        Self::parse(&text).map_err(|wrong| LinkError::Schedule { path: path.into(), wrong })
    }

    /// A link that changes at these times, nanoseconds after its first use: ascending, the first one 0.
    pub fn of_steps(steps: Vec<(i64, LinkProfile)>) -> Self {
        assert!(steps.first().is_some_and(|(start_ns, _)| *start_ns == 0), "a link begins at 0");
        assert!(steps.is_sorted_by(|a, b| a.0 < b.0), "a link changes from step to step");
        Self { steps }
    }

    /// A link that carries nothing for `length_ns` nanoseconds from `start_ns` on, both after its first use and more than 0.
    pub fn interrupted(profile: LinkProfile, start_ns: i64, length_ns: i64) -> Self {
        let silent = LinkProfile { loss: 1.0, ..profile.clone() };
        Self { steps: vec![(0, profile.clone()), (start_ns, silent), (start_ns + length_ns, profile)] }
    }

    fn parse(text: &str) -> Result<Self, String> {
        let file: ScheduleFile = toml::from_str(text).map_err(|e| e.to_string())?;
        if file.step.is_empty() {
            return Err("there is no [[step]]".into());
        }
        let mut steps = Vec::new();
        for (i, step) in file.step.iter().enumerate() {
            let at = |wrong: String| format!("step {}: {wrong}", i + 1);
            let start = parse_duration(&step.start).map_err(|e| at(format!("start={}: {e}", step.start)))?;
            let link = step.link.parse().map_err(|e: LinkError| at(e.to_string()))?;
            if steps.last().is_some_and(|&(previous, _)| start <= previous) {
                return Err(at(format!("start={} is not later than the step before", step.start)));
            }
            steps.push((start, link));
        }
        if steps[0].0 > 0 {
            steps.insert(0, (0, LinkProfile::default()));
        }
        Ok(Self { steps })
    }

    /// The profile that holds `since_start_ns` nanoseconds after the link's first use.
    pub fn at(&self, since_start_ns: i64) -> &LinkProfile {
        let after = self.steps.partition_point(|(start, _)| *start <= since_start_ns);
        &self.steps[after.saturating_sub(1)].1
    }
}

/// What became of the datagrams of one direction.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkCounts {
    /// Handed to the link.
    pub sent: u64,
    /// Came out at the other end.
    pub delivered: u64,
    /// Lost at random.
    pub lost: u64,
    /// Dropped because the queue of the bottleneck was full.
    pub dropped: u64,
    /// Dropped because they were larger than the MTU.
    pub oversized: u64,
    /// Bytes handed to the link.
    pub sent_bytes: u64,
    /// Bytes that came out.
    pub delivered_bytes: u64,
}

/// A datagram that arrives.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Delivery<T> {
    /// When it arrives, nanoseconds.
    pub at_ns: i64,
    /// Which way it travelled.
    pub direction: Direction,
    /// Its payload.
    pub bytes: Vec<u8>,
    /// What the sender attached.
    pub tag: T,
}

/// One direction of a link.
#[derive(Debug)]
struct Lane {
    rng: u64,
    /// When the bottleneck has sent everything that waits at it.
    busy_until_ns: i64,
    /// Arrival of the latest datagram that keeps the order.
    last_arrival_ns: i64,
    counts: LinkCounts,
}

impl Lane {
    fn new(seed: u64, salt: u64) -> Self {
        let mut rng = seed ^ salt;
        rng::next(&mut rng);
        Self { rng, busy_until_ns: i64::MIN, last_arrival_ns: i64::MIN, counts: LinkCounts::default() }
    }

    /// When a datagram of `size` bytes that is sent at `now_ns` arrives; `None` when it does not.
    fn arrival(&mut self, now_ns: i64, size: usize, profile: &LinkProfile) -> Option<i64> {
        // Four draws for each datagram whatever happens to it, so that the fates of later ones do not depend on it.
        let [loss, jitter, reorder, held] = std::array::from_fn(|_| rng::unit(&mut self.rng));
        self.counts.sent += 1;
        self.counts.sent_bytes += size as u64;
        if profile.mtu_bytes.is_some_and(|mtu| size > mtu) {
            self.counts.oversized += 1;
            return None;
        }
        let mut departure = now_ns;
        if let Some(rate) = profile.rate_bit_per_s {
            let start = self.busy_until_ns.max(now_ns);
            if start - now_ns > profile.queue_ns {
                self.counts.dropped += 1;
                return None;
            }
            departure = start + serialisation_ns(size, rate);
            self.busy_until_ns = departure;
        }
        if loss < profile.loss {
            self.counts.lost += 1;
            return None;
        }
        let jitter_ns = ((2.0 * jitter - 1.0) * profile.jitter_ns as f64) as i64;
        let arrival = departure + profile.latency_ns + jitter_ns;
        if reorder < profile.reorder {
            // Held back by up to twice the jitter, at least by a millisecond's worth, outside the order of the rest.
            return Some(arrival + ((0.5 + 1.5 * held) * profile.jitter_ns.max(1_000_000) as f64) as i64);
        }
        self.last_arrival_ns = self.last_arrival_ns.max(arrival);
        Some(self.last_arrival_ns)
    }
}

/// How long a datagram with `size` bytes of payload takes at `rate_bit_per_s`, nanoseconds.
fn serialisation_ns(size: usize, rate_bit_per_s: u64) -> i64 {
    let bits = u128::from((size as u64 + UDP_IP_OVERHEAD_BYTES) * 8);
    (bits * 1_000_000_000 / u128::from(rate_bit_per_s)) as i64
}

/// A datagram under way; ordered by arrival, then by the order of sending.
#[derive(Debug)]
struct InFlight<T> {
    order: (i64, u64),
    direction: Direction,
    bytes: Vec<u8>,
    tag: T,
}

impl<T> PartialEq for InFlight<T> {
    fn eq(&self, other: &Self) -> bool {
        self.order == other.order
    }
}
impl<T> Eq for InFlight<T> {}
impl<T> PartialOrd for InFlight<T> {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl<T> Ord for InFlight<T> {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.order.cmp(&other.order)
    }
}

/// A simulated network between a server and a client. `T` travels with each datagram unseen (addresses, for example).
#[derive(Debug)]
pub struct Link<T = ()> {
    schedule: LinkSchedule,
    start_ns: Option<i64>,
    to_client: Lane,
    to_server: Lane,
    in_flight: BinaryHeap<Reverse<InFlight<T>>>,
    sequence: u64,
}

impl<T> Link<T> {
    /// A link whose schedule starts with the first datagram. The same `seed` gives the same fates.
    pub fn new(schedule: impl Into<LinkSchedule>, seed: u64) -> Self {
        Self {
            schedule: schedule.into(),
            start_ns: None,
            to_client: Lane::new(seed, 0x5ca1_ab1e),
            to_server: Lane::new(seed, 0xc0ff_ee00_0000),
            in_flight: BinaryHeap::new(),
            sequence: 0,
        }
    }

    /// Sets the time at which the schedule starts, nanoseconds; otherwise it is that of the first datagram.
    pub fn start_at(&mut self, start_ns: i64) {
        self.start_ns = Some(start_ns);
    }

    /// Sends a datagram at `now_ns`; times do not decrease from call to call.
    pub fn send(&mut self, now_ns: i64, direction: Direction, bytes: Vec<u8>, tag: T) {
        let start_ns = *self.start_ns.get_or_insert(now_ns);
        let profile = self.schedule.at(now_ns - start_ns);
        let lane = match direction {
            Direction::ToClient => &mut self.to_client,
            Direction::ToServer => &mut self.to_server,
        };
        let Some(arrival_ns) = lane.arrival(now_ns, bytes.len(), profile) else { return };
        if self.in_flight.len() >= MAX_IN_FLIGHT {
            lane.counts.dropped += 1;
            return;
        }
        self.sequence += 1;
        let order = (arrival_ns, self.sequence);
        self.in_flight.push(Reverse(InFlight { order, direction, bytes, tag }));
    }

    /// The next datagram that has arrived by `now_ns`.
    pub fn poll(&mut self, now_ns: i64) -> Option<Delivery<T>> {
        if self.next_event_ns()? > now_ns {
            return None;
        }
        let Reverse(InFlight { order: (at_ns, _), direction, bytes, tag }) = self.in_flight.pop()?;
        let counts = match direction {
            Direction::ToClient => &mut self.to_client.counts,
            Direction::ToServer => &mut self.to_server.counts,
        };
        counts.delivered += 1;
        counts.delivered_bytes += bytes.len() as u64;
        Some(Delivery { at_ns, direction, bytes, tag })
    }

    /// When the next datagram arrives, nanoseconds.
    pub fn next_event_ns(&self) -> Option<i64> {
        self.in_flight.peek().map(|Reverse(packet)| packet.order.0)
    }

    /// How long what is sent at `now_ns` waits before the bottleneck of one direction, nanoseconds.
    pub fn queue_ns(&self, direction: Direction, now_ns: i64) -> i64 {
        let lane = match direction {
            Direction::ToClient => &self.to_client,
            Direction::ToServer => &self.to_server,
        };
        lane.busy_until_ns.saturating_sub(now_ns).max(0)
    }

    /// What became of the datagrams of one direction so far.
    pub fn counts(&self, direction: Direction) -> LinkCounts {
        match direction {
            Direction::ToClient => self.to_client.counts,
            Direction::ToServer => self.to_server.counts,
        }
    }
}

#[cfg(test)]
mod tests;
