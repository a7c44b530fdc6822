//! The client's estimate of the server's clock, from pings and pongs.
//!
//! Delay is never negative, so that each way of each exchange bounds the offset between the clocks from one side, and
//! the fastest packets bound it best. Over a window, the two ways' lower envelopes are fitted separately (a ping that
//! was fast on one way alone still counts) by parallel lines whose slope is the drift; the offset lies in the middle of
//! them, as if the fastest packets took equally long both ways. The error so falls with the number of exchanges, where
//! that of a mean falls with its root. Source: Moon, Skelly and Towsley, INFOCOM 1999, for the envelope.
//!
//! What callers see follows the estimate smoothly, so that animation never jumps because of a better one.

use crate::time::{ClientTime, ServerTime};
use std::collections::VecDeque;

/// Exchanges kept, at most.
const WINDOW: usize = 640;
/// Exchanges older than this count no more.
const WINDOW_NS: i64 = 60_000_000_000;
/// A drift of this size is held against a fit as much as [`DRIFT_COST_NS`] of delay, so that a short window does not
/// take jitter for drift. Quartz is within 100 parts per million.
const DRIFT_SCALE: f64 = 100e-6;
/// See [`DRIFT_SCALE`].
const DRIFT_COST_NS: f64 = 100_000.0;
/// Drift beyond this is not believed.
const MAX_DRIFT: f64 = 500e-6;
/// Steps of the search for the drift; each leaves two thirds of the interval, in the end less than 1e-10.
const DRIFT_STEPS: u32 = 40;
/// A correction is spread over this time ..
const SLEW_NS: i64 = 200_000_000;
/// .. unless it is larger than this: then something broke, and smoothness would only prolong it.
const JUMP_NS: i64 = 50_000_000;
/// An estimate that says that a packet travelled this much less than no time is given up.
const CONTRADICTION_NS: i64 = 2_000_000;
/// Exchanges slower than this tell nothing.
const MAX_RTT_NS: i64 = 10_000_000_000;
/// Clocks that read more than this (146 years) are nonsense, and would overflow.
const MAX_CLOCK_NS: i64 = 1 << 62;

/// Offset and drift between the client's clock and the server's.
#[derive(Clone, Debug, Default)]
pub struct ClockEstimator {
    exchanges: VecDeque<Exchange>,
    mapping: Option<Mapping>,
    /// Exchanges have come that the mapping does not know.
    is_behind: bool,
}

#[derive(Clone, Copy, Debug)]
struct Exchange {
    client_send: ClientTime,
    client_receive: ClientTime,
    /// Offset plus the delay of the way to the server.
    up_ns: i64,
    /// Delay of the way back less the offset.
    down_ns: i64,
}

/// `server = display + offset + drift * (display - origin)`.
#[derive(Clone, Copy, Debug)]
struct Line {
    origin: ClientTime,
    offset_ns: i64,
    drift: f64,
}

/// The line, and what is left of the last correction.
#[derive(Clone, Copy, Debug)]
struct Mapping {
    line: Line,
    since: ClientTime,
    /// Added to the line at `since`, nothing `SLEW_NS` later.
    error_ns: i64,
}

impl ClockEstimator {
    /// Knows nothing yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes in one exchange, and follows it; see [`Self::note_pong`].
    pub fn on_pong(
        &mut self,
        client_send: ClientTime,
        server_receive: ServerTime,
        server_send: ServerTime,
        client_receive: ClientTime,
    ) {
        self.note_pong(client_send, server_receive, server_send, client_receive);
        self.settle();
    }

    /// Takes in one exchange: a ping that left at `client_send`, was received and answered by the server's clock, and
    /// whose answer came at `client_receive`. Exchanges that contradict themselves are ignored. The first counts at once,
    /// later ones when [`Self::settle`] is called: a fit costs so much that one a display frame must do.
    pub fn note_pong(
        &mut self,
        client_send: ClientTime,
        server_receive: ServerTime,
        server_send: ServerTime,
        client_receive: ClientTime,
    ) {
        let clocks = [client_send.0, server_receive.0, server_send.0, client_receive.0];
        if clocks.iter().any(|clock| clock.unsigned_abs() > MAX_CLOCK_NS as u64 / 4) {
            return;
        }
        let served_ns = server_send.since(server_receive);
        let rtt_ns = client_receive.since(client_send) - served_ns;
        if served_ns < 0 || !(0..=MAX_RTT_NS).contains(&rtt_ns) {
            return;
        }
        self.remember(Exchange {
            client_send,
            client_receive,
            up_ns: server_receive.0 - client_send.0,
            down_ns: client_receive.0 - server_send.0,
        });
        self.is_behind = true;
        if self.mapping.is_none() {
            self.settle();
        }
    }

    /// Follows the exchanges taken in since the last call.
    pub fn settle(&mut self) {
        let newest = self.exchanges.back().map(|exchange| exchange.client_receive);
        if let (true, Some(now)) = (std::mem::take(&mut self.is_behind), newest) {
            self.follow(now);
        }
    }

    fn remember(&mut self, exchange: Exchange) {
        if self.mapping.is_some_and(|mapping| mapping.line.contradicts(exchange)) {
            self.exchanges.clear();
        }
        if self.exchanges.len() == WINDOW {
            self.exchanges.pop_front();
        }
        self.exchanges.push_back(exchange);
        let is_old = |old: &Exchange| exchange.client_receive.since(old.client_receive) > WINDOW_NS;
        while self.exchanges.front().is_some_and(is_old) {
            self.exchanges.pop_front();
        }
    }

    /// Fits a new line and turns towards it.
    fn follow(&mut self, now: ClientTime) {
        let Some(line) = self.fit() else { return };
        let error_ns = self.mapping.map_or(0, |old| old.offset_at(now).saturating_sub(line.offset_at(now)));
        let error_ns = if (-JUMP_NS..=JUMP_NS).contains(&error_ns) { error_ns } else { 0 };
        self.mapping = Some(Mapping { line, since: now, error_ns });
    }

    /// The drift that leaves the two envelopes furthest apart fits them most tightly; that distance is concave in the
    /// drift, so that a ternary search finds it.
    fn fit(&self) -> Option<Line> {
        let newest = self.exchanges.back()?;
        let (origin, base_ns) = (newest.client_receive, newest.offset_ns());
        let up =
            lower_hull(self.exchanges.iter().map(|exchange| {
                (exchange.client_send.since(origin) as f64, (exchange.up_ns - base_ns) as f64)
            }));
        let down = lower_hull(self.exchanges.iter().map(|exchange| {
            (exchange.client_receive.since(origin) as f64, (exchange.down_ns + base_ns) as f64)
        }));
        let gap = |drift: f64| {
            least(&up, drift) + least(&down, -drift) - DRIFT_COST_NS * (drift / DRIFT_SCALE).powi(2)
        };
        let (mut low, mut high) = (-MAX_DRIFT, MAX_DRIFT);
        for _ in 0..DRIFT_STEPS {
            let third = (high - low) / 3.0;
            if gap(low + third) < gap(high - third) { low += third } else { high -= third }
        }
        let drift = (low + high) * 0.5;
        let offset = (least(&up, drift) - least(&down, -drift)) * 0.5;
        Some(Line { origin, offset_ns: base_ns + offset as i64, drift })
    }

    /// The server's clock when the client's reads `at`; `None` before the first exchange.
    pub fn server_time(&self, at: ClientTime) -> Option<ServerTime> {
        let mapping = self.mapping?;
        Some(ServerTime(at.0.saturating_add(mapping.offset_at(at))))
    }

    /// The client's clock when the server's reads `at`; `None` before the first exchange.
    pub fn display_time(&self, at: ServerTime) -> Option<ClientTime> {
        let mapping = self.mapping?;
        let mut display = ClientTime(at.0.saturating_sub(mapping.line.offset_ns));
        // The offset changes by less than a third of a nanosecond per nanosecond, so that each step gains half a digit.
        for _ in 0..32 {
            let next = ClientTime(at.0.saturating_sub(mapping.offset_at(display)));
            if next == display {
                break;
            }
            display = next;
        }
        Some(display)
    }

    /// The fastest round trip of the window in nanoseconds, the server's own time not counted.
    pub fn rtt_ns(&self) -> Option<i64> {
        self.exchanges.iter().map(Exchange::rtt_ns).min()
    }

    /// How far 95 % of the round trips of the window stay above the fastest, in nanoseconds.
    pub fn jitter_ns(&self) -> Option<i64> {
        let mut rtts: Vec<_> = self.exchanges.iter().map(Exchange::rtt_ns).collect();
        rtts.sort_unstable();
        let p95 = rtts.get((rtts.len() * 95 / 100).min(rtts.len().checked_sub(1)?))?;
        Some(p95 - rtts[0])
    }

    /// How much faster the server's clock runs than the client's, as a fraction.
    pub fn drift(&self) -> Option<f64> {
        self.mapping.map(|mapping| mapping.line.drift)
    }
}

/// The corners of the lower convex hull, by rising abscissa: no line can touch the points from below elsewhere.
fn lower_hull(points: impl Iterator<Item = (f64, f64)>) -> Vec<(f64, f64)> {
    let mut points: Vec<_> = points.collect();
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut hull: Vec<(f64, f64)> = Vec::new();
    for point in points {
        while let [.., a, b] = hull[..] {
            let turns_left = (b.0 - a.0) * (point.1 - a.1) > (b.1 - a.1) * (point.0 - a.0);
            if turns_left {
                break;
            }
            hull.pop();
        }
        hull.push(point);
    }
    hull
}

/// Where the highest line of this slope that lies under the hull crosses zero.
fn least(hull: &[(f64, f64)], slope: f64) -> f64 {
    hull.iter().fold(f64::MAX, |least, point| least.min(point.1 - slope * point.0))
}

impl Exchange {
    /// The offset if both ways took equally long.
    fn offset_ns(&self) -> i64 {
        (self.up_ns - self.down_ns) / 2
    }

    fn rtt_ns(&self) -> i64 {
        self.up_ns + self.down_ns
    }
}

impl Line {
    /// True where a way of the exchange would have taken less than no time: a clock was set anew.
    fn contradicts(&self, exchange: Exchange) -> bool {
        exchange.up_ns.saturating_sub(self.offset_at(exchange.client_send)) < -CONTRADICTION_NS
            || exchange.down_ns.saturating_add(self.offset_at(exchange.client_receive)) < -CONTRADICTION_NS
    }

    fn offset_at(&self, at: ClientTime) -> i64 {
        let drifted = self.drift * at.since(self.origin) as f64;
        self.offset_ns.saturating_add(drifted as i64)
    }
}

impl Mapping {
    fn offset_at(&self, at: ClientTime) -> i64 {
        let left_ns = SLEW_NS - at.since(self.since).clamp(0, SLEW_NS);
        self.line.offset_at(at).saturating_add(self.error_ns * left_ns / SLEW_NS)
    }
}

#[cfg(test)]
mod tests {
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
    fn jitter_on_one_way_alone_is_outweighed_by_the_fastest_exchanges() {
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

    #[test]
    fn time_never_runs_backwards_nor_jumps_while_corrections_are_small() {
        for seed in 0..50 {
            let mut dice = Dice::new(seed);
            let mut clock = ClockEstimator::new();
            let mut last = None;
            for frame in 0..2000i64 {
                let now = frame * 11 * MS;
                if frame % 5 == 0 {
                    let (up, down) = (dice.below(20) as i64 * MS, dice.below(20) as i64 * MS);
                    let server = ServerTime(now - down + 500 * MS);
                    clock.on_pong(ClientTime(now - up - down), server, server, ClientTime(now));
                }
                let seen = clock.server_time(ClientTime(now + 30 * MS)).unwrap();
                if let Some(last) = last {
                    let step = seen.since(last);
                    assert!(
                        (5 * MS..=17 * MS).contains(&step),
                        "seed {seed}, frame {frame}: {step} ns in 11 ms"
                    );
                }
                last = Some(seen);
            }
        }
    }

    #[test]
    fn a_clock_that_was_set_anew_is_followed_at_once() {
        let mut clock = ClockEstimator::new();
        let exchange = |clock: &mut ClockEstimator, at_ms: i64, offset_ms: i64| {
            let server = ServerTime((at_ms + 10 + offset_ms) * MS);
            clock.on_pong(ClientTime(at_ms * MS), server, server, ClientTime((at_ms + 20) * MS));
        };
        exchange(&mut clock, 0, 0);
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
}
