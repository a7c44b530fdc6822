//! The client's estimate of the server's clock, from pings and pongs, and from stamps sent just before an update.
//!
//! Delay is never negative. So each way of each exchange bounds the offset between the clocks from one side, and the fastest
//! packets bound it best. Over a window, the lower envelopes of both ways are fitted separately (a ping that was fast on one
//! way only still counts) by parallel lines whose slope is the drift. The offset lies in the middle of them, as if the fastest
//! packets took equally long both ways. The error falls with the number of exchanges; that of a mean falls with its root.
//! Source: Moon, Skelly and Towsley, INFOCOM 1999, for the envelope.
//!
//! Where packets keep their order, an answer that leaves soon after an update's hundred packets waits for the slowest of them.
//! Hardly any way back would be as fast as possible. A stamp leaves before the packets, so its way is free. It bounds the way
//! back only.
//!
//! The error bound of the estimate is known too: see [`ClockEstimator::error_bound_ns`].
//!
//! Before the first display, callers see the estimate. Afterwards the visible time follows the estimate by at most
//! [`MAX_STEP_NS`] a display frame, however far apart the two are: a slightly fast second is invisible, a jump is not. Only a
//! reset clock is followed at once.

use crate::time::{ClientTime, ServerTime};
use std::collections::VecDeque;

/// Exchanges kept, at most, and as many stamps.
const WINDOW: usize = 640;
/// Exchanges and stamps older than this count no more.
const WINDOW_NS: i64 = 60_000_000_000;
/// A drift of this size is held against a fit as much as [`DRIFT_COST_NS`] of delay, and as twice the distance from one of the
/// fastest packets to the next, so that a short window does not take jitter for drift. Quartz is within 100 parts per million.
///
/// Where `n` packets are spread evenly over a delay `w`, a fit whose lines are `g` further apart is `exp(n * g / w)` times as
/// likely, and `w / n` is that distance; a drift with a deviation of half this size is `exp(-2 * (drift / scale)^2)` as likely.
const DRIFT_SCALE: f64 = 100e-6;
/// See [`DRIFT_SCALE`].
const DRIFT_COST_NS: f64 = 100_000.0;
/// Packets from whose delays the distance is taken, beside the fastest.
const NEAR_FASTEST: usize = 4;
/// Drift beyond this is not believed.
const MAX_DRIFT: f64 = 500e-6;
/// Steps of the search for the drift; each leaves two thirds of the interval, in the end less than 1e-10.
const DRIFT_STEPS: u32 = 40;
/// From one display frame to the next, the server's time goes on by what passes on the client's clock, give or take at most
/// so many nanoseconds. An estimate that is 3 ms off is caught up with in 0.5 s at 60 Hz.
pub const MAX_STEP_NS: i64 = 100_000;
/// Where drift alone takes up more than the other half of a step, in frames of more than 0.1 s, corrections have this.
const LEAST_STEP_NS: i64 = MAX_STEP_NS / 2;
/// Corrections are at most one part in so many of the time between two frames, so that frames in quick succession correct no
/// more than those at 100 Hz.
const STEP_SHARE: i64 = 100;
/// Two estimates that are further apart than this are of two clocks.
const SAME_CLOCK_NS: i64 = 50_000_000;
/// Exchanges that leave the offset this much less than no room are of different clocks: one was set anew.
const CONTRADICTION_NS: i64 = 2_000_000;
/// Exchanges slower than this tell nothing.
const MAX_RTT_NS: i64 = 10_000_000_000;
/// Clocks that read more than this (146 years) are nonsense, and would overflow.
const MAX_CLOCK_NS: i64 = 1 << 62;

/// Offset and drift between the client's clock and the server's.
#[derive(Clone, Debug, Default)]
pub struct ClockEstimator {
    exchanges: VecDeque<Exchange>,
    stamps: VecDeque<Stamp>,
    estimate: Option<ClockEstimate>,
    /// What callers see of it.
    seen: ShownClock,
    /// Exchanges or stamps have come that the estimate does not know.
    is_behind: bool,
    /// They contradict those before.
    is_set_anew: bool,
}

/// What exchanges and stamps say of the server's clock at a moment, small enough to be handed to another thread.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClockEstimate {
    line: Line,
    /// What the exchanges that the line knows leave possible.
    room: Room,
    /// Rises with each clock that was set anew.
    times_set: u32,
}

/// The server's clock as display frames see it: it follows estimates, by at most [`MAX_STEP_NS`] a frame.
#[derive(Clone, Copy, Debug, Default)]
pub struct ShownClock {
    mapping: Option<Mapping>,
    room: Room,
    times_set: u32,
    /// The display frame that was shown last.
    shown: Option<ClientTime>,
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

/// One way back without a way there.
#[derive(Clone, Copy, Debug)]
struct Stamp {
    client_receive: ClientTime,
    /// Delay of the way back less the offset.
    down_ns: i64,
}

/// `server = display + offset + drift * (display - origin)`.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Line {
    origin: ClientTime,
    offset_ns: i64,
    drift: f64,
}

/// The line, and what is left of the last correction.
#[derive(Clone, Copy, Debug)]
struct Mapping {
    line: Line,
    /// Added to the line; display frames take it away.
    left_ns: i64,
}

/// The offsets that are possible at a time of the client's clock, both ends included.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Room {
    at: ClientTime,
    low_ns: i64,
    high_ns: i64,
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
        if !are_clocks([client_send.0, server_receive.0, server_send.0, client_receive.0]) {
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
        if self.estimate.is_none() {
            self.settle();
        }
    }

    /// Takes in a stamp: the server's clock read `server_send` when it left, and it came at `client_receive`. Before the first
    /// exchange it tells nothing, and one that contradicts the exchanges is ignored: the next of those says which clock it is.
    pub fn note_stamp(&mut self, server_send: ServerTime, client_receive: ClientTime) {
        let Some(estimate) = self.estimate.filter(|_| are_clocks([server_send.0, client_receive.0])) else {
            return;
        };
        let stamp = Stamp { client_receive, down_ns: client_receive.0 - server_send.0 };
        if estimate.room.contradicts_down(stamp) {
            return;
        }
        if self.stamps.len() == WINDOW {
            self.stamps.pop_front();
        }
        self.stamps.push_back(stamp);
        self.is_behind = true;
    }

    /// Follows the exchanges and stamps taken in since the last call.
    pub fn settle(&mut self) {
        if std::mem::take(&mut self.is_behind) {
            self.follow();
        }
    }

    fn remember(&mut self, exchange: Exchange) {
        if self.estimate.is_some_and(|estimate| estimate.room.contradicts(exchange)) {
            self.exchanges.clear();
            self.stamps.clear();
            self.is_set_anew = true;
        }
        if self.exchanges.len() == WINDOW {
            self.exchanges.pop_front();
        }
        self.exchanges.push_back(exchange);
        let is_old = |received: ClientTime| exchange.client_receive.since(received) > WINDOW_NS;
        while self.exchanges.front().is_some_and(|old| is_old(old.client_receive)) {
            self.exchanges.pop_front();
        }
        while self.stamps.front().is_some_and(|old| is_old(old.client_receive)) {
            self.stamps.pop_front();
        }
    }

    /// Fits a new line, and lets callers turn towards it.
    fn follow(&mut self) {
        let Some(line) = self.fit() else { return };
        let times_set = self.estimate.map_or(0, |estimate| estimate.times_set);
        let times_set = times_set.wrapping_add(std::mem::take(&mut self.is_set_anew).into());
        let estimate = ClockEstimate { line, room: self.room_at(line.origin), times_set };
        self.estimate = Some(estimate);
        self.seen.follow(estimate);
    }

    /// What is known; `None` before the first exchange.
    pub fn estimate(&self) -> Option<ClockEstimate> {
        self.estimate
    }

    /// The ways back that are known.
    fn ways_down(&self) -> impl Iterator<Item = Stamp> {
        self.exchanges.iter().map(Exchange::way_down).chain(self.stamps.iter().copied())
    }

    /// What is known leaves this possible at `now`: each exchange bounds the offset by its two ways, less sharply the older it is,
    /// and all bounds hold at once. Source: Marzullo and Owicki 1983 for the intersection; RFC 5905, section 11.2, for the
    /// dispersion by age, there with 15 parts per million.
    fn room_at(&self, now: ClientTime) -> Room {
        let mut room = Room { at: now, low_ns: i64::MIN, high_ns: i64::MAX };
        for exchange in &self.exchanges {
            room.high_ns = room.high_ns.min(exchange.up_ns + dispersion_ns(now, exchange.client_send));
        }
        for Stamp { client_receive, down_ns } in self.ways_down() {
            room.low_ns = room.low_ns.max(-down_ns - dispersion_ns(now, client_receive));
        }
        room
    }

    /// The drift that leaves the two envelopes furthest apart fits them most tightly; that distance is concave in the
    /// drift, so that a ternary search finds it.
    fn fit(&self) -> Option<Line> {
        let newest = self.exchanges.back()?;
        let stamped = self.stamps.back().map_or(newest.client_receive, |stamp| stamp.client_receive);
        let (origin, base_ns) = (newest.client_receive.max(stamped), newest.offset_ns());
        let up =
            lower_hull(self.exchanges.iter().map(|exchange| {
                (exchange.client_send.since(origin) as f64, (exchange.up_ns - base_ns) as f64)
            }));
        let down = lower_hull(self.ways_down().map(|Stamp { client_receive, down_ns }| {
            (client_receive.since(origin) as f64, (down_ns + base_ns) as f64)
        }));
        let cost_ns = DRIFT_COST_NS.max(2.0 * self.spacing_ns(origin));
        let gap =
            |drift: f64| least(&up, drift) + least(&down, -drift) - cost_ns * (drift / DRIFT_SCALE).powi(2);
        let (mut low, mut high) = (-MAX_DRIFT, MAX_DRIFT);
        for _ in 0..DRIFT_STEPS {
            let third = (high - low) / 3.0;
            if gap(low + third) < gap(high - third) { low += third } else { high -= third }
        }
        let drift = (low + high) * 0.5;
        let offset = (least(&up, drift) - least(&down, -drift)) * 0.5;
        Some(Line { origin, offset_ns: base_ns + offset as i64, drift })
    }

    /// From one of the fastest packets to the next, nanoseconds of delay, as the mean of both ways and without the drift that is
    /// known so far. So much the envelope of a way is off.
    fn spacing_ns(&self, origin: ClientTime) -> f64 {
        let drift = self.drift().unwrap_or(0.0);
        let up = self
            .exchanges
            .iter()
            .map(|exchange| exchange.up_ns as f64 - drift * exchange.client_send.since(origin) as f64);
        let down = self.ways_down().map(|Stamp { client_receive, down_ns }| {
            down_ns as f64 + drift * client_receive.since(origin) as f64
        });
        (spacing(up.collect()) + spacing(down.collect())) * 0.5
    }

    /// See [`ShownClock::show`].
    pub fn show(&mut self, at: ClientTime) {
        self.seen.show(at);
    }

    /// See [`ShownClock::server_time`].
    pub fn server_time(&self, at: ClientTime) -> Option<ServerTime> {
        self.seen.server_time(at)
    }

    /// See [`ShownClock::display_time`].
    pub fn display_time(&self, at: ServerTime) -> Option<ClientTime> {
        self.seen.display_time(at)
    }

    /// See [`ShownClock::error_bound_ns`].
    pub fn error_bound_ns(&self, at: ClientTime) -> Option<i64> {
        self.seen.error_bound_ns(at)
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
        self.estimate.map(|estimate| estimate.line.drift)
    }
}

impl ShownClock {
    /// Turns towards an estimate. Before anything is on display, and where a clock was set anew, it is followed at once.
    pub fn follow(&mut self, estimate: ClockEstimate) {
        let ClockEstimate { line, room, times_set } = estimate;
        let is_free = std::mem::replace(&mut self.times_set, times_set) != times_set;
        let left_ns = match (self.mapping, self.shown) {
            (Some(old), Some(shown)) if !is_free => {
                old.offset_at(shown).saturating_sub(line.offset_at(shown))
            }
            _ => 0,
        };
        self.mapping = Some(Mapping { line, left_ns });
        self.room = room;
    }

    /// A display frame is shown that is seen at `at`: the correction that is under way goes on by what one frame may.
    pub fn show(&mut self, at: ClientTime) {
        let Some(mapping) = &mut self.mapping else { return };
        let elapsed_ns = at.since(self.shown.unwrap_or(at)).clamp(0, WINDOW_NS);
        let drifted_ns = (mapping.line.drift.abs() * elapsed_ns as f64).ceil() as i64;
        let step_ns = (MAX_STEP_NS - drifted_ns).max(LEAST_STEP_NS).min(elapsed_ns / STEP_SHARE);
        mapping.left_ns -= mapping.left_ns.clamp(-step_ns, step_ns);
        self.shown = Some(at);
    }

    /// A display frame that is seen at `at` is the first one that is on this clock. The one before was on another estimate of
    /// the same clock, by which it is `seen`: what callers see goes on from there, unless that is so far away that it was
    /// another clock.
    pub fn go_on_from(&mut self, at: ClientTime, seen: ServerTime) {
        let Some(mapping) = &mut self.mapping else { return };
        let left_ns = seen.since(ServerTime(at.0.saturating_add(mapping.line.offset_at(at))));
        if self.shown.is_none() && left_ns.saturating_abs() <= SAME_CLOCK_NS {
            mapping.left_ns = left_ns;
            self.shown = Some(at);
        }
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
        // The offset changes by at most `MAX_DRIFT` per nanosecond, so that each step gains three digits.
        for _ in 0..8 {
            let next = ClientTime(at.0.saturating_sub(mapping.offset_at(display)));
            if next == display {
                break;
            }
            display = next;
        }
        Some(display)
    }

    /// How far [`Self::server_time`] can be off at `at`, in nanoseconds; `None` before the first exchange.
    ///
    /// No way takes less than no time: an exchange says that the offset is at most what its way up shows and at least what
    /// its way down shows, give or take `MAX_DRIFT` times its age. The bound is the larger distance from what is seen,
    /// what is left of a correction included, to the two ends of what all exchanges leave possible. With equal ways both
    /// there and back, that is half the fastest round trip; nobody can know better from the exchanges alone.
    pub fn error_bound_ns(&self, at: ClientTime) -> Option<i64> {
        let offset_ns = self.mapping?.offset_at(at);
        let Room { at: known, low_ns, high_ns } = self.room;
        let off_ns = high_ns.saturating_sub(offset_ns).max(offset_ns.saturating_sub(low_ns)).max(0);
        Some(off_ns.saturating_add(dispersion_ns(at, known)))
    }
}

/// Mean distance between the least of these, up to [`NEAR_FASTEST`] of them beside the first. At least one there is.
fn spacing(mut values: Vec<f64>) -> f64 {
    let count = NEAR_FASTEST.min(values.len() - 1);
    let (below, at, _) = values.select_nth_unstable_by(count, f64::total_cmp);
    let least = below.iter().copied().fold(*at, f64::min);
    (*at - least) / count.max(1) as f64
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

/// Whether all these nanoseconds can be what clocks read.
fn are_clocks<const N: usize>(clocks: [i64; N]) -> bool {
    clocks.iter().all(|clock| clock.unsigned_abs() <= MAX_CLOCK_NS as u64 / 4)
}

impl Exchange {
    fn way_down(&self) -> Stamp {
        Stamp { client_receive: self.client_receive, down_ns: self.down_ns }
    }

    /// The offset if both ways took equally long.
    fn offset_ns(&self) -> i64 {
        (self.up_ns - self.down_ns) / 2
    }

    fn rtt_ns(&self) -> i64 {
        self.up_ns + self.down_ns
    }
}

impl Line {
    fn offset_at(&self, at: ClientTime) -> i64 {
        let drifted = self.drift * at.since(self.origin) as f64;
        self.offset_ns.saturating_add(drifted as i64)
    }
}

impl Mapping {
    fn offset_at(&self, at: ClientTime) -> i64 {
        self.line.offset_at(at).saturating_add(self.left_ns)
    }
}

impl Room {
    /// True where no offset fits the exchange and those before: a clock was set anew. That one way was faster than ever is
    /// no contradiction; it takes a part of the room away.
    fn contradicts(&self, exchange: Exchange) -> bool {
        exchange.up_ns < self.low_ns.saturating_sub(self.slack_ns(exchange.client_send))
            || self.contradicts_down(exchange.way_down())
    }

    /// The same of one way back.
    fn contradicts_down(&self, Stamp { client_receive, down_ns }: Stamp) -> bool {
        -down_ns > self.high_ns.saturating_add(self.slack_ns(client_receive))
    }

    fn slack_ns(&self, at: ClientTime) -> i64 {
        dispersion_ns(self.at, at) + CONTRADICTION_NS
    }
}

/// By how much clocks can part between two times.
fn dispersion_ns(a: ClientTime, b: ClientTime) -> i64 {
    (MAX_DRIFT * a.since(b).unsigned_abs() as f64).ceil() as i64
}

#[cfg(test)]
mod tests;
