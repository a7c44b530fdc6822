//! The congestion window: a controller for a stream of pictures over radio.
//!
//! Cubic and `NewReno` take each lost packet for congestion; at 1 % random loss and 40 ms of round trip they settle at a few
//! Mbit/s. quinn's BBR copes with loss, but draws its phase from the thread's random numbers, so no two runs are alike.
//! [`Steady`] keeps BBR's model, the product of the delivery rate measured at the bottleneck and the shortest round trip. It
//! has no random gain cycle, and answers loss only above the level of a radio link. A router's mark (RFC 3168) is congestion, and is answered
//! once a round trip. The deciding measurements are in the
//! documentation of [`crate::endpoint`].
//!
//! A stream of pictures seldom fills the path. Its delivery rate is then that of the sender, not of the bottleneck. Only
//! packets sent with a full window are evidence for a rate below the best one, and only they end the startup phase. Until then
//! a burst of [`BURST_BYTES`] may leave at [`BURST_RATE`]: a moving head needs its new geometry now, not after three round
//! trips of growth. On a narrow path the first such burst is queued or partly lost, once; from then on the bottleneck is known.
//! Where a train of packets has gone ahead (`train`), the burst waits behind [`START_PACKETS`] until the train has told what the path
//! carries, and a path that is narrow by its word gets what keeps it busy.

use std::any::Any;
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use quinn_proto::RttEstimator;
use quinn_proto::congestion::{Controller, ControllerFactory, ControllerMetrics};

use crate::cross_traffic::{CrossTraffic, Seen};
use crate::target::{RoundTrip, Target};
use crate::train::Trains;

/// Window of the other controllers before anything is known of the path, bytes.
pub const INITIAL_WINDOW_BYTES: u64 = 256 << 10;
/// Window until the bottleneck is known, bytes: the geometry of a room that comes into view at once, with its picture.
pub const BURST_BYTES: u64 = 2 << 20;
/// Window while a train is awaited that tells what the path carries.
pub const START_PACKETS: u64 = 32;
/// A path is narrow up to here, bytes per second: 3.6 Mbit/s. Jitter of 10 ms either way seldom spreads a train so far.
const NARROW_BYTES_S: f64 = 0.45e6;
/// What may wait before a narrow path at the start takes so long, beside two round trips, s.
const START_QUEUE_S: f64 = 0.1;
/// How fast a burst leaves until the bottleneck is known, bytes per second: 1 MB in 20 ms.
pub const BURST_RATE: f64 = 50e6;
/// quinn sends a window in this part of a round trip: its pacer divides by it.
const PACER_GAIN: f64 = 1.25;
/// The window never falls below this many packets.
const MIN_WINDOW_PACKETS: u64 = 16;
/// Largest window of the startup phase, in products of measured rate and shortest round trip: 2 would double it.
const STARTUP_GAIN: f64 = 4.0;
/// Window in steady state, in products of bandwidth and shortest round trip.
const STEADY_GAIN: f64 = 2.0;
/// Round trips for which a measured delivery rate counts.
const RATE_ROUNDS: u64 = 10;
/// Round trips at full load without a quarter more throughput after which the bottleneck counts as found.
const PLATEAU_ROUNDS: u32 = 3;
/// A queue that delays a whole round trip's packets by this much more than half of the shortest one ends startup.
const STARTUP_QUEUE: Duration = Duration::from_millis(10);
/// Window for a probe, bytes: more than can be under way, and so much that quinn does not pace it.
const PROBE_WINDOW_BYTES: u64 = 1 << 40;
/// Largest window, bytes.
const MAX_WINDOW_BYTES: u64 = 64 << 20;
/// Round trips count as at least this: on a shorter path delayed acknowledgements and late threads rule.
const MIN_ROUND_TRIP: Duration = Duration::from_millis(5);
/// Where round trips stay longer than a full window explains, the queue is drained to see whether it is one: at most so often.
const QUESTION_PERIOD: Duration = Duration::from_secs(2);
/// A window that draining leaves so much of tells nothing.
const MOST_DRAINED_PART: f64 = 0.6;
/// A round trip that draining did not shorten counts for so long.
const LOADED_RTT_LIFETIME: Duration = Duration::from_secs(5);
/// And is no longer than the shortest by more than this.
const LONGEST_LOADED: Duration = Duration::from_millis(40);
/// How long a shortest round trip counts before it is measured anew.
const MIN_RTT_LIFETIME: Duration = Duration::from_secs(10);
/// A shortest round trip that has become longer by this has a queue in it.
const STANDING_QUEUE: Duration = Duration::from_millis(10);
/// Share of lost bytes above which loss counts as congestion: radio links lose up to 5 %, in bursts.
const CONGESTION_LOSS: f64 = 0.12;
/// Bytes acknowledged or lost over which the share of loss is taken.
const LOSS_SAMPLE_BYTES: u64 = 100 * 1200;
/// What remains of the window after congestion.
const BACKOFF: f64 = 0.8;
/// Nothing acknowledged for so long, and for [`OUTAGE_ROUNDS`] round trips, of what was sent meanwhile: an outage.
const OUTAGE: Duration = Duration::from_millis(250);
const OUTAGE_ROUNDS: u32 = 3;
/// What remains of a known window after one.
const OUTAGE_PART: f64 = 0.5;
/// Growth of a reduced window per round trip without congestion.
const CAP_GROWTH: f64 = 1.1;

/// What a connection's controller tells beside quinn's metrics: how fast to send.
#[derive(Debug, Default)]
pub struct TargetRate {
    bytes_s: AtomicU64,
    is_competing: AtomicBool,
}

impl TargetRate {
    /// Bytes per second; `None` before anything is known of the path.
    pub fn bytes_s(&self) -> Option<u64> {
        Some(self.bytes_s.load(Ordering::Relaxed)).filter(|rate| *rate > 0)
    }

    /// Whether another flow fills the queue, which is then accepted.
    pub fn is_competing(&self) -> bool {
        self.is_competing.load(Ordering::Relaxed)
    }

    fn set(&self, bytes_s: Option<f64>, is_competing: bool) {
        self.bytes_s.store(bytes_s.unwrap_or(0.0) as u64, Ordering::Relaxed);
        self.is_competing.store(is_competing, Ordering::Relaxed);
    }
}

/// Makes the [`Steady`] controllers of one connection, one for each path: for
/// [`quinn_proto::TransportConfig::congestion_controller_factory`].
#[derive(Debug, Default)]
pub struct SteadyConfig {
    /// What the newest path's controller tells.
    pub target: Arc<TargetRate>,
    probing: Probing,
}

impl SteadyConfig {
    /// Its controllers let a probe pass while `probing` says so.
    pub(crate) fn with_probing(probing: &Probing) -> Self {
        Self { probing: probing.clone(), target: Arc::default() }
    }
}

impl ControllerFactory for SteadyConfig {
    fn build(self: Arc<Self>, _now: Instant, current_mtu: u16) -> Box<dyn Controller> {
        self.target.set(None, false);
        let steady = Steady::new(current_mtu, self.target.clone());
        Box::new(Steady { probing: self.probing.clone(), ..steady })
    }
}

/// Whether the packet that is being made is a probe of a silent path. What was lost there still counts as under way until
/// something is acknowledged, and would keep every probe back. Shared by an endpoint and its controllers.
#[derive(Clone, Debug, Default)]
pub(crate) struct Probing(Arc<AtomicBool>);

impl Probing {
    pub(crate) fn set(&self, is_probe: bool) {
        self.0.store(is_probe, Ordering::Relaxed);
    }

    fn is_set(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// What had been delivered when a batch of packets was sent.
#[derive(Clone, Copy, Debug)]
struct SentBatch {
    sent: Instant,
    delivered_bytes: u64,
    delivered_at: Instant,
    /// When the batch was sent whose acknowledgement was the last at that time.
    first_sent: Instant,
    /// The window was full: what is delivered after it tells of the path, not of the application.
    is_window_limited: bool,
}

/// A measured delivery rate.
#[derive(Clone, Copy, Debug)]
struct RateSample {
    round: u64,
    bytes_per_s: f64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Mode {
    /// Doubling the window each round trip until the delivery rate no longer follows.
    Startup { best_rate: f64, rounds_without_growth: u32 },
    /// Window from the model.
    Steady,
    /// Less than one product of rate and round trip, so that the queue drains and the round trip shows.
    Drain(Drain),
}

/// Draining a queue, to see what it has been.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Drain {
    /// What is sent from then on finds what the smaller window leaves of it.
    drained_from: Instant,
    until: Instant,
    /// A round trip with the window of before, and that window, bytes.
    before: Duration,
    before_bytes: u64,
    /// Round trips of what was sent since it was drained.
    rtt_sum: Duration,
    rtt_count: u32,
}

impl Drain {
    fn begin(now: Instant, before: Duration, before_bytes: u64) -> Self {
        let (drained_from, until) = (now + before, now + 3 * before);
        Self { drained_from, until, before, before_bytes, rtt_sum: Duration::ZERO, rtt_count: 0 }
    }

    fn note(&mut self, sent: Instant, rtt: Duration) {
        if sent >= self.drained_from {
            self.rtt_sum += rtt;
            self.rtt_count += 1;
        }
    }

    /// A round trip without a queue, seconds. A queue's part falls as the window does, the path's part stays: with the window's part `r`
    /// of before, `before = path + queue` and `mean = path + r * queue`. A window that is nearly the smallest makes no queue.
    fn path_s(&self, drained_bytes: u64) -> Option<f64> {
        let mean_s = self.rtt_sum.checked_div(self.rtt_count)?.as_secs_f64();
        let part = drained_bytes as f64 / self.before_bytes.max(1) as f64;
        if part > MOST_DRAINED_PART {
            return Some(mean_s);
        }
        Some(((mean_s - part * self.before.as_secs_f64()) / (1.0 - part)).max(0.0))
    }
}

/// The controller; see the module.
#[derive(Clone, Debug)]
pub struct Steady {
    mtu: u64,
    mode: Mode,
    /// Window of the startup phase, bytes.
    startup_window: u64,
    /// Upper bound of the window after congestion, bytes.
    cap: Option<f64>,
    /// The last sample of loss was too much.
    congested: bool,
    /// Packets sent until then were answered for: one burst that is lost is one reason to send less.
    backed_off_at: Option<Instant>,
    batches: VecDeque<SentBatch>,
    /// Sent, and neither acknowledged nor lost. Exact after each acknowledgement.
    in_flight_bytes: u64,
    sent_bytes: u64,
    /// The window was full at some time in this round trip.
    round_is_window_limited: bool,
    smoothed_rtt: Option<Duration>,
    delivered_bytes: u64,
    delivered_at: Option<Instant>,
    last_acked_sent: Option<Instant>,
    /// The newest batch acknowledged since the last `on_end_acks`.
    newest_acked: Option<SentBatch>,
    rates: VecDeque<RateSample>,
    round: u64,
    /// A round trip ends when a packet sent after this is acknowledged.
    round_end: Option<Instant>,
    min_rtt: Option<Duration>,
    min_rtt_at: Option<Instant>,
    /// What a round trip takes without a queue, where that is more than the shortest one, and when this was found.
    loaded_rtt: Option<(Duration, Instant)>,
    drained_at: Option<Instant>,
    /// Shortest round trip of the current round.
    round_min_rtt: Option<Duration>,
    sampled_acked: u64,
    sampled_lost: u64,
    trains: Trains,
    target: Target,
    cross_traffic: CrossTraffic,
    /// A router has marked a packet, or too many were lost, in this round trip.
    round_is_congested: bool,
    /// Delivered when this round trip began, bytes.
    round_delivered_bytes: u64,
    told: Arc<TargetRate>,
    probing: Probing,
}

impl Steady {
    fn new(mtu: u16, told: Arc<TargetRate>) -> Self {
        Self {
            mtu: u64::from(mtu),
            mode: Mode::Startup { best_rate: 0.0, rounds_without_growth: 0 },
            startup_window: BURST_BYTES,
            cap: None,
            congested: false,
            backed_off_at: None,
            batches: VecDeque::new(),
            in_flight_bytes: 0,
            sent_bytes: 0,
            round_is_window_limited: false,
            smoothed_rtt: None,
            delivered_bytes: 0,
            delivered_at: None,
            last_acked_sent: None,
            newest_acked: None,
            rates: VecDeque::new(),
            round: 0,
            round_end: None,
            min_rtt: None,
            min_rtt_at: None,
            loaded_rtt: None,
            drained_at: None,
            round_min_rtt: None,
            sampled_acked: 0,
            sampled_lost: 0,
            trains: Trains::default(),
            target: Target::default(),
            cross_traffic: CrossTraffic::default(),
            round_is_congested: false,
            round_delivered_bytes: 0,
            told,
            probing: Probing::default(),
        }
    }

    fn min_window(&self) -> u64 {
        MIN_WINDOW_PACKETS * self.mtu
    }

    /// Best delivery rate of the last round trips, bytes per second.
    fn rate(&self) -> f64 {
        self.rates.front().map_or(0.0, |best| best.bytes_per_s)
    }

    /// Bytes under way that keep the bottleneck busy without a queue.
    fn path_bytes(&self) -> Option<f64> {
        let round_trip = self.path_rtt()?.max(MIN_ROUND_TRIP);
        (self.rate() > 0.0).then(|| self.rate() * round_trip.as_secs_f64())
    }

    /// A round trip without a queue. Over radio packets wait for others and for the air, so that it is longer under load than the shortest
    /// one; the window would starve by that.
    fn path_rtt(&self) -> Option<Duration> {
        let loaded = self.loaded_rtt.map_or(Duration::ZERO, |(rtt, _)| rtt);
        self.min_rtt.map(|min| min.max(loaded))
    }

    /// Keeps `sample` in a queue that falls in rate and rises in round, so that its front is the best.
    fn add_rate(&mut self, sample: RateSample) {
        while self.rates.back().is_some_and(|last| last.bytes_per_s <= sample.bytes_per_s) {
            self.rates.pop_back();
        }
        self.rates.push_back(sample);
        while self.rates.front().is_some_and(|best| best.round + RATE_ROUNDS < sample.round) {
            self.rates.pop_front();
        }
    }

    /// Keeps those of the last two round trips, at least the newest.
    fn forget_old_rates(&mut self) {
        while self.rates.len() > 1 && self.rates.front().is_some_and(|best| best.round + 2 < self.round) {
            self.rates.pop_front();
        }
    }

    /// The delivery rate between the sending of `batch` and now, as in draft-cheng-iccrg-delivery-rate-estimation.
    fn measured_rate(&self, now: Instant, batch: &SentBatch) -> Option<f64> {
        let send_time = batch.sent.saturating_duration_since(batch.first_sent);
        let ack_time = now.saturating_duration_since(batch.delivered_at);
        let interval = send_time.max(ack_time);
        // Shorter than a round trip: acknowledgements came in a lump and would exaggerate.
        if interval.is_zero() || interval < self.min_rtt? {
            return None;
        }
        Some((self.delivered_bytes - batch.delivered_bytes) as f64 / interval.as_secs_f64())
    }

    fn note_rtt(&mut self, now: Instant, rtt: Duration) {
        let is_old = self.min_rtt_at.is_some_and(|at| now.saturating_duration_since(at) > MIN_RTT_LIFETIME);
        let expired = is_old && !self.cross_traffic.is_suspected(now);
        self.round_min_rtt = Some(self.round_min_rtt.map_or(rtt, |min| min.min(rtt)));
        let has_waited = self.min_rtt.is_some_and(|min| rtt > min + STANDING_QUEUE);
        if self.min_rtt.is_none_or(|min| rtt <= min) {
            (self.min_rtt, self.min_rtt_at) = (Some(rtt), Some(now));
        } else if expired {
            (self.min_rtt, self.min_rtt_at) = (Some(rtt), Some(now));
            // A path that is not full has no queue to drain, but for one that others keep: what all take for the path must not grow.
            if (self.round_is_window_limited || has_waited) && self.mode == Mode::Steady {
                self.drain(now, rtt);
            }
        }
    }

    fn drain(&mut self, now: Instant, rtt: Duration) {
        self.mode = Mode::Drain(Drain::begin(now, rtt, self.in_flight_bytes));
        self.drained_at = Some(now);
    }

    /// Whether draining would tell a queue from a path that takes so long. `fastest` is the shortest round trip of a round with a full window.
    fn is_questionable(&self, now: Instant, fastest: Duration) -> bool {
        let is_over = |since: Option<Instant>, period| since.is_none_or(|at| now.duration_since(at) > period);
        let explained = self.path_rtt().map(|path| path.mul_f64(STEADY_GAIN) + STARTUP_QUEUE);
        let is_unexplained = explained.is_some_and(|explained| fastest > explained);
        let is_old = self.loaded_rtt.is_some_and(|(_, at)| now.duration_since(at) > LOADED_RTT_LIFETIME);
        self.mode == Mode::Steady && (is_unexplained || is_old) && is_over(self.drained_at, QUESTION_PERIOD)
    }

    fn end_drain(&mut self, now: Instant, drain: Drain) {
        let path_s = drain.path_s(self.limit());
        self.mode = Mode::Steady;
        let Some(path_s) = path_s else { return };
        if let Some(path) = self.path_rtt().filter(|_| self.cross_traffic.window_bytes().is_some()) {
            if let Some(path) =
                self.cross_traffic.end_look(now, Duration::from_secs_f64(path_s), path, drain.before)
            {
                (self.min_rtt, self.min_rtt_at) = (Some(path), Some(now));
            }
            return;
        }
        let path = Duration::from_secs_f64(path_s).min(drain.before);
        if path < drain.before / 2 {
            // It was a queue: older rates are those of another path.
            self.forget_old_rates();
        }
        self.loaded_rtt =
            self.min_rtt.filter(|min| path > *min).map(|min| (path.min(min + LONGEST_LOADED), now));
    }

    fn end_round(&mut self, now: Instant) {
        self.round += 1;
        let is_window_limited = std::mem::take(&mut self.round_is_window_limited);
        let rate = self.rate();
        let fastest = self.round_min_rtt.take();
        self.note_round(now, fastest, is_window_limited);
        let queued = match (fastest, self.min_rtt) {
            (Some(now), Some(min)) => now > min.mul_f64(1.5) + STARTUP_QUEUE,
            _ => false,
        };
        let is_drained = |fastest: &Duration| match self.cross_traffic.window_bytes() {
            Some(_) => self.mode == Mode::Steady && self.cross_traffic.is_look_due(now),
            None => is_window_limited && self.is_questionable(now, *fastest),
        };
        if let Some(fastest) = fastest.filter(is_drained) {
            self.drain(now, fastest);
        }
        if let Mode::Startup { best_rate, rounds_without_growth } = &mut self.mode
            && is_window_limited
        {
            *rounds_without_growth += 1;
            if rate > *best_rate * 1.25 {
                (*best_rate, *rounds_without_growth) = (rate, 0);
            }
            if queued || *rounds_without_growth >= PLATEAU_ROUNDS {
                self.mode = Mode::Steady;
            }
        }
        let model = self.model_window() as f64;
        // After an outage the path is known: only its last half is approached with care.
        let growth = |cap: f64| cap * if cap < model / 2.0 { 2.0 } else { CAP_GROWTH };
        if !self.congested {
            self.cap = self.cap.map(growth).filter(|&cap| cap < model);
        }
    }

    /// What this round trip says of how fast to send. One with a drained window says nothing.
    fn note_round(&mut self, end: Instant, fastest: Option<Duration>, is_full: bool) {
        let delivered_bytes = self.delivered_bytes - self.round_delivered_bytes;
        self.round_delivered_bytes = self.delivered_bytes;
        let is_congested = std::mem::take(&mut self.round_is_congested);
        let Some((fastest, path)) = fastest.zip(self.path_rtt()) else { return };
        if !matches!(self.mode, Mode::Drain(_)) {
            let queue = fastest.saturating_sub(path);
            self.target.note(RoundTrip { end, delivered_bytes, queue, path, is_full, is_congested });
            let seen = Seen {
                queue: self.target.queue(),
                sent_bytes: self.sent_bytes,
                in_flight_bytes: self.in_flight_bytes,
                target_bytes_s: self.target.bytes_s().unwrap_or(0.0),
                mtu: self.mtu,
                min_window_bytes: self.min_window(),
            };
            self.cross_traffic.note_round(end, seen);
        }
        self.tell();
    }

    /// Tells how fast to send: what avoids a queue, or what the window that competes allows.
    fn tell(&self) {
        let round_trip_s = self.smoothed_rtt.map_or(f64::MAX, |rtt| rtt.as_secs_f64());
        let competing = self.cross_traffic.window_bytes().map(|_| self.limit() as f64 / round_trip_s);
        let bytes_s = self.target.bytes_s().into_iter().chain(competing).reduce(f64::max);
        self.told.set(bytes_s, competing.is_some());
    }

    /// The window without the bound that congestion sets, bytes.
    fn model_window(&self) -> u64 {
        let steady = self.path_bytes().map(|bytes| (bytes * STEADY_GAIN) as u64);
        match self.mode {
            Mode::Startup { .. } if self.trains.is_awaited() => START_PACKETS * self.mtu,
            Mode::Startup { .. } => self.startup_window,
            Mode::Steady => steady.unwrap_or(INITIAL_WINDOW_BYTES),
            Mode::Drain(_) => self.path_bytes().map_or(INITIAL_WINDOW_BYTES, |bytes| (bytes * 0.5) as u64),
        }
    }

    /// What may be under way, bytes.
    fn limit(&self) -> u64 {
        let model = self.model_window();
        let own = self.cap.map_or(model, |cap| model.min(cap as u64)).max(self.min_window());
        match (self.cross_traffic.window_bytes(), self.mode) {
            (Some(competing), Mode::Drain(_)) => (competing / 2).max(self.min_window()),
            (Some(competing), _) => own.max(competing),
            (None, _) => own,
        }
    }

    /// The window from which quinn's pacer makes the rate of a burst; `None` where the limit's own rate is right.
    fn pacing_window(&self) -> Option<u64> {
        let Mode::Startup { .. } = self.mode else { return None };
        let rate = BURST_RATE.max(self.rate() * STEADY_GAIN);
        let round_trip = self.smoothed_rtt?.as_secs_f64();
        Some((rate * round_trip / PACER_GAIN) as u64)
    }

    /// The first train says what the path carries, bytes per second.
    fn narrow(&mut self, train_bytes_s: f64, round_trip: Duration) {
        if train_bytes_s < NARROW_BYTES_S {
            let busy_s = STEADY_GAIN * round_trip.as_secs_f64() + START_QUEUE_S;
            self.startup_window = ((train_bytes_s * busy_s) as u64).max(START_PACKETS * self.mtu);
        }
    }

    fn is_full(&self) -> bool {
        // One more packet, and one that is being filled.
        self.in_flight_bytes + 2 * self.mtu >= self.limit()
    }

    /// Backs off when the last sample's worth of packets lost more than a radio link does.
    fn judge_loss(&mut self, now: Instant) {
        let sampled = self.sampled_acked + self.sampled_lost;
        if sampled < LOSS_SAMPLE_BYTES {
            return;
        }
        self.congested = self.sampled_lost as f64 > CONGESTION_LOSS * sampled as f64;
        if self.congested {
            self.back_off(now, self.limit() as f64 * BACKOFF);
        }
        (self.sampled_acked, self.sampled_lost) = (0, 0);
    }

    /// The first acknowledgement after an outage is here. What was lost in it says nothing of the rate, and the path is mostly the
    /// one of before.
    fn note_outage(&mut self, now: Instant) {
        let longest = OUTAGE.max(self.smoothed_rtt.unwrap_or_default() * OUTAGE_ROUNDS);
        let is_long = |since: Instant| now.saturating_duration_since(since) > longest;
        let waiting =
            self.batches.iter().find(|batch| self.last_acked_sent.is_none_or(|last| batch.sent > last));
        if !self.delivered_at.is_some_and(is_long) || !waiting.is_some_and(|batch| is_long(batch.sent)) {
            return;
        }
        self.backed_off_at = Some(now);
        if !matches!(self.mode, Mode::Startup { .. }) {
            self.cap = Some((self.model_window() as f64 * OUTAGE_PART).max(self.min_window() as f64));
        }
    }

    fn is_answered_for(&self, sent: Instant) -> bool {
        self.backed_off_at.is_some_and(|at| sent <= at)
    }

    fn back_off(&mut self, now: Instant, to_bytes: f64) {
        self.backed_off_at = Some(now);
        self.round_is_congested = true;
        if matches!(self.mode, Mode::Startup { .. }) {
            self.mode = Mode::Steady;
        }
        self.cap = Some(to_bytes.max(self.min_window() as f64));
    }
}

impl Controller for Steady {
    fn on_sent(&mut self, now: Instant, bytes: u64, _last_packet_number: u64) {
        if matches!(self.mode, Mode::Startup { .. }) {
            self.trains.sent(now, bytes);
        }
        self.in_flight_bytes += bytes;
        self.sent_bytes += bytes;
        let is_window_limited = self.is_full();
        self.round_is_window_limited |= is_window_limited;
        if let Some(last) = self.batches.back_mut().filter(|last| last.sent == now) {
            last.is_window_limited |= is_window_limited;
            return;
        }
        // After a pause the time without anything under way must not count as slow delivery.
        let idle = self.batches.is_empty();
        let delivered_at = self.delivered_at.filter(|_| !idle).unwrap_or(now);
        let first_sent = self.last_acked_sent.filter(|_| !idle).unwrap_or(now);
        let delivered_bytes = self.delivered_bytes;
        self.batches.push_back(SentBatch {
            sent: now,
            delivered_bytes,
            delivered_at,
            first_sent,
            is_window_limited,
        });
        self.round_end.get_or_insert(now);
    }

    fn on_ack(&mut self, now: Instant, sent: Instant, bytes: u64, _app_limited: bool, rtt: &RttEstimator) {
        self.note_outage(now);
        self.trains.acked(now, sent, bytes);
        if let Some(bytes_s) = self.trains.bytes_s().filter(|_| self.target.bytes_s().is_none()) {
            self.target.begin(bytes_s);
            self.tell();
            self.narrow(bytes_s, rtt.get());
        }
        self.cross_traffic.on_ack(now, sent, bytes, self.in_flight_bytes, rtt);
        self.in_flight_bytes = self.in_flight_bytes.saturating_sub(bytes);
        self.smoothed_rtt = Some(rtt.get());
        self.delivered_bytes += bytes;
        self.delivered_at = Some(now);
        if !self.is_answered_for(sent) {
            self.sampled_acked += bytes;
        }
        let round_trip = now.saturating_duration_since(sent);
        if let Mode::Drain(drain) = &mut self.mode {
            drain.note(sent, round_trip);
        }
        self.note_rtt(now, round_trip);
        if self.last_acked_sent.is_none_or(|last| last < sent) {
            self.last_acked_sent = Some(sent);
        }
        if let Ok(found) = self.batches.binary_search_by_key(&sent, |batch| batch.sent)
            && self.newest_acked.is_none_or(|newest| newest.sent <= sent)
        {
            self.newest_acked = Some(self.batches[found]);
        }
        if matches!(self.mode, Mode::Startup { .. }) && self.round_is_window_limited {
            let enough = self.path_bytes().map_or(0, |path| (path * STARTUP_GAIN) as u64);
            let limit = enough.clamp(BURST_BYTES, MAX_WINDOW_BYTES);
            self.startup_window = self.startup_window.max((self.startup_window + bytes).min(limit));
        }
    }

    fn on_end_acks(&mut self, now: Instant, in_flight: u64, _app_limited: bool, _largest_acked: Option<u64>) {
        self.in_flight_bytes = in_flight;
        let Some(batch) = self.newest_acked.take() else { return };
        if let Some(bytes_per_s) = self.measured_rate(now, &batch)
            // Less than the path would have taken proves a lower bound only.
            && (batch.is_window_limited || bytes_per_s > self.rate())
        {
            self.add_rate(RateSample { round: self.round, bytes_per_s });
        }
        // The batch itself stays: more of its packets may be acknowledged later.
        while self.batches.front().is_some_and(|first| first.sent < batch.sent || in_flight == 0) {
            self.batches.pop_front();
        }
        if self.round_end.is_some_and(|end| batch.sent >= end) {
            self.round_end = Some(now);
            self.end_round(now);
        }
        if let Mode::Drain(drain) = self.mode
            && now >= drain.until
        {
            self.end_drain(now, drain);
        }
        self.judge_loss(now);
    }

    fn on_congestion_event(
        &mut self,
        now: Instant,
        sent: Instant,
        is_persistent_congestion: bool,
        lost_bytes: u64,
    ) {
        if !self.is_answered_for(sent) {
            self.sampled_lost += lost_bytes;
        }
        self.in_flight_bytes = self.in_flight_bytes.saturating_sub(lost_bytes);
        self.cross_traffic.on_congestion_event(now, sent, is_persistent_congestion, lost_bytes);
        // A mark comes without lost bytes. Packets that left before the last answer say nothing new: one answer a round trip.
        if lost_bytes == 0 && !is_persistent_congestion && !self.is_answered_for(sent) {
            self.back_off(now, self.limit().min(self.in_flight_bytes) as f64 * BACKOFF);
            (self.sampled_acked, self.sampled_lost) = (0, 0);
        }
        if is_persistent_congestion && !self.is_answered_for(sent) {
            self.back_off(now, 0.0);
            self.congested = true;
            (self.sampled_acked, self.sampled_lost) = (0, 0);
        }
        self.judge_loss(now);
    }

    fn on_mtu_update(&mut self, new_mtu: u16) {
        self.mtu = u64::from(new_mtu);
    }

    /// quinn takes one number for what may be under way and for the pace. While there is room it is the pace that counts.
    fn window(&self) -> u64 {
        if self.probing.is_set() {
            return PROBE_WINDOW_BYTES;
        }
        let limit = self.limit();
        if self.is_full() { limit } else { self.pacing_window().map_or(limit, |pacing| pacing.max(limit)) }
    }

    /// The rate is the measured one, and at the start that of a train; the threshold is there once the bottleneck was found.
    fn metrics(&self) -> ControllerMetrics {
        let is_starting = matches!(self.mode, Mode::Startup { .. });
        let of_train = self.trains.bytes_s().filter(|_| is_starting);
        let mut metrics = ControllerMetrics::default();
        metrics.congestion_window = self.limit();
        metrics.ssthresh = (!is_starting).then(|| self.model_window());
        metrics.pacing_rate = Some((self.rate().max(of_train.unwrap_or(0.0)) * 8.0) as u64);
        metrics
    }

    fn clone_box(&self) -> Box<dyn Controller> {
        Box::new(self.clone())
    }

    fn initial_window(&self) -> u64 {
        BURST_BYTES
    }

    fn into_any(self: Box<Self>) -> Box<dyn Any> {
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A controller with ten packets of each of so many milliseconds under way.
    fn with_packets(milliseconds: u64, start: Instant) -> Steady {
        let mut steady = Steady::new(1200, Arc::default());
        for at in 0..milliseconds {
            (0..10).for_each(|n| steady.on_sent(start + Duration::from_millis(at), 1200, at * 10 + n));
        }
        steady
    }

    #[test]
    fn marks_of_one_round_trip_are_answered_once() {
        let start = Instant::now();
        let at = |ms: u64| start + Duration::from_millis(ms);
        let mut steady = with_packets(20, start);
        assert_eq!(steady.limit(), BURST_BYTES);
        (0..10).for_each(|sent| steady.on_congestion_event(at(40), at(sent), false, 0));
        let once = (20.0 * 10.0 * 1200.0 * BACKOFF) as u64;
        assert_eq!(steady.limit(), once, "what was under way, less a part");
        (10..20).for_each(|sent| steady.on_congestion_event(at(41 + sent), at(sent), false, 0));
        assert_eq!(steady.limit(), once, "these left before the answer");
        steady.on_sent(at(45), 1200, 200);
        steady.on_congestion_event(at(85), at(45), false, 0);
        assert!(steady.limit() < once, "this one left after it");
    }
}
