//! Whether an update begins while the one before is placed and shaded, and which step of those in flight is next. Pure: times and
//! the device's progress come in.
//!
//! Where they overlap, the device has the order visibility n + 1, shading n: update n + 1 is placed while n is shaded, and the
//! device waits for no placement. Shading goes to a queue of its own where the device has one, and runs beside visibility there. The
//! price is that a head pose is older by one visibility when its picture is made.

/// How far the updates in flight have come: at most one of each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Flight {
    /// The device looks for one.
    pub is_begun: bool,
    /// It has found what that one shows.
    pub is_seen: bool,
    /// One is placed; its shading waits to be submitted.
    pub is_placed: bool,
    /// The device has the shading of one.
    pub is_in_work: bool,
    /// It has shaded it.
    pub is_shaded: bool,
}

impl Flight {
    /// Whether there are any.
    pub(crate) fn is_any(self) -> bool {
        self.is_begun || self.is_placed || self.is_in_work
    }
}

/// What is to be done next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Begin an update; what is placed is shaded behind it.
    Begin,
    /// Place what is seen, as far as that goes without another look.
    Place,
    /// Have what is placed shaded.
    Shade,
    /// Take what is shaded.
    Collect,
    /// Nothing until the device has come further, or an update may begin.
    Wait,
}

impl Step {
    /// What it is called in a trace.
    pub fn name(self) -> &'static str {
        match self {
            Self::Begin => "begin",
            Self::Place => "place",
            Self::Shade => "shade",
            Self::Collect => "collect",
            Self::Wait => "wait",
        }
    }
}

/// How long the steps of an update took, nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct StepTimes {
    /// What the device did for visibility and shading.
    pub device_ns: i64,
    /// What the CPU did: placement, for the most part.
    pub placement_ns: i64,
    /// The encoder.
    pub encode_ns: i64,
}

/// Weight of the newest update in the smoothed times.
const NEWEST: f64 = 0.25;
/// Updates that must not have fitted, one after the other, before the first that overlaps.
const UPDATES_BEHIND: u32 = 4;
/// Of the time that there is for an update, so much may its steps take in a row for updates to be made in a row again.
const FITS_AGAIN: f64 = 0.9;
/// By so much more often updates must come for their latency's sake, and so much more for them to go on overlapping: a device that is
/// busy all the time in a row gains nothing.
const WORTH: f64 = 1.08;
const STILL_WORTH: f64 = 1.03;

/// Decides for one client.
#[derive(Clone, Debug)]
pub(crate) struct Overlap {
    period_ns: f64,
    /// Of device, placement and encoder, smoothed.
    times_ns: Option<[f64; 3]>,
    behind: u32,
    is_on: bool,
}

impl Overlap {
    /// For updates that are wanted once in `period_ns`: in a row, until they are measured.
    pub(crate) fn new(period_ns: i64) -> Self {
        Self { period_ns: period_ns as f64, times_ns: None, behind: 0, is_on: false }
    }

    /// Whether updates overlap: where those in a row are slower than is wanted, than the encoder, and than they then are.
    pub(crate) fn is_on(&self) -> bool {
        self.is_on
    }

    /// An update was made.
    pub(crate) fn note(&mut self, StepTimes { device_ns, placement_ns, encode_ns }: StepTimes) {
        let newest_ns = [device_ns, placement_ns, encode_ns].map(|time_ns| time_ns as f64);
        let before_ns = self.times_ns.unwrap_or(newest_ns);
        let times_ns = [0, 1, 2].map(|of| smoothed(before_ns[of], newest_ns[of]));
        self.times_ns = Some(times_ns);
        let [device_ns, placement_ns, encoding_ns] = times_ns;
        let (row_ns, there_is_ns) = (device_ns + placement_ns, self.period_ns.max(encoding_ns));
        let gain = row_ns / there_is_ns.max(device_ns);
        self.behind = if row_ns > there_is_ns && gain > WORTH { self.behind + 1 } else { 0 };
        if self.is_on {
            self.is_on = row_ns > FITS_AGAIN * there_is_ns && gain > STILL_WORTH;
        } else {
            self.is_on = self.behind >= UPDATES_BEHIND;
        }
    }

    /// What to do next. `is_alone`: no other viewer's updates take the places of samples that wait to be shaded. `may_begin`: an
    /// update is due, its link is open, and it would not wait for an encoder.
    pub(crate) fn step(&self, flight: Flight, is_alone: bool, may_begin: bool) -> Step {
        if flight.is_shaded {
            return Step::Collect;
        }
        if flight.is_begun {
            return if flight.is_seen && !flight.is_placed { Step::Place } else { Step::Wait };
        }
        // Lists of the device's are written anew with each update.
        if flight.is_in_work {
            return Step::Wait;
        }
        match flight.is_placed {
            true if self.is_on && is_alone && may_begin => Step::Begin,
            true => Step::Shade,
            false if may_begin => Step::Begin,
            false => Step::Wait,
        }
    }
}

fn smoothed(before: f64, newest: f64) -> f64 {
    before + NEWEST * (newest - before)
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    /// A device that does one thing after the other, and an encoder, in virtual time.
    struct Played {
        starts_ns: Vec<i64>,
        /// From an update's start until it is shaded.
        latencies_ns: Vec<i64>,
    }

    /// Updates for so long; visibility, placement, shading and encoding take `ms`.
    fn play(period_ns: i64, ms: [i64; 4], for_ns: i64) -> Played {
        let [visibility_ns, placement_ns, shading_ns, encode_ns] = ms.map(|ms| ms * MS);
        let mut overlap = Overlap::new(period_ns);
        let mut played = Played { starts_ns: Vec::new(), latencies_ns: Vec::new() };
        let (mut device_ns, mut encoder_ns, mut due_ns) = (0, 0, 0);
        let (mut begun, mut placed, mut in_work) = (None, None, None);
        let mut now_ns = 0;
        while now_ns < for_ns {
            let is_past = |at: Option<(i64, i64)>| at.is_some_and(|(_, at_ns)| at_ns <= now_ns);
            let flight = Flight {
                is_begun: begun.is_some(),
                is_seen: is_past(begun),
                is_placed: placed.is_some(),
                is_in_work: in_work.is_some(),
                is_shaded: is_past(in_work),
            };
            let row_ns = visibility_ns + placement_ns + shading_ns;
            let may_begin = due_ns <= now_ns && encoder_ns <= now_ns + row_ns;
            let step = overlap.step(flight, true, may_begin);
            let mut submit = |took_ns: i64| {
                device_ns = now_ns.max(device_ns) + took_ns;
                device_ns
            };
            if step == Step::Begin {
                played.starts_ns.push(now_ns);
                due_ns = (due_ns + period_ns).max(now_ns - period_ns);
                begun = Some((now_ns, submit(visibility_ns)));
            }
            match step {
                Step::Begin | Step::Shade => {
                    in_work = placed.take().map(|start_ns| (start_ns, submit(shading_ns)));
                }
                Step::Place => {
                    placed = begun.take().map(|(start_ns, _)| start_ns);
                    now_ns += placement_ns;
                }
                Step::Collect => {
                    let (start_ns, _) = in_work.take().expect("what is shaded is in work");
                    played.latencies_ns.push(now_ns - start_ns);
                    encoder_ns = encoder_ns.max(now_ns) + encode_ns;
                    let device_ns = visibility_ns + shading_ns;
                    overlap.note(StepTimes { device_ns, placement_ns, encode_ns });
                }
                Step::Wait => now_ns += MS / 4,
            }
        }
        played
    }

    /// Milliseconds from start to start, once it is settled.
    fn apart_ms(played: &Played) -> impl Iterator<Item = f64> + '_ {
        let settled = played.starts_ns.len() / 2;
        played.starts_ns[settled..].windows(2).map(|pair| (pair[1] - pair[0]) as f64 * 1e-6)
    }

    #[test]
    fn throughput_is_the_slowest_stage_and_latency_rises_by_less_than_one() {
        let played = play(13 * MS, [10, 3, 10, 20], 3000 * MS);
        assert!(apart_ms(&played).all(|ms| (20.0..=22.0).contains(&ms)), "{:?}", played.starts_ns);
        let worst_ms = played.latencies_ns.iter().max().expect("some") / MS;
        assert!(worst_ms <= 23 + 20, "{worst_ms} ms");
    }

    #[test]
    fn what_fits_is_made_in_a_row() {
        for ms in [[5, 2, 5, 10], [10, 3, 10, 30], [0, 0, 0, 0], [1, 1, 1, 60]] {
            let period_ns = 20 * MS;
            let played = play(period_ns, ms, 2000 * MS);
            let row_ns = ms[..3].iter().sum::<i64>() * MS;
            let late_ns = played.latencies_ns.iter().max().expect("some") - row_ns;
            assert!(late_ns <= MS, "{ms:?}: {late_ns} ns later than in a row");
        }
    }

    #[test]
    fn a_device_that_is_always_busy_makes_its_updates_in_a_row() {
        let played = play(33 * MS, [150, 6, 150, 20], 20_000 * MS);
        assert!(
            played.latencies_ns.iter().all(|latency_ns| *latency_ns <= 307 * MS),
            "{:?}",
            played.latencies_ns
        );
    }

    #[test]
    fn whatever_the_stages_take_updates_come_no_slower_than_in_a_row() {
        for seed in 0u64..200 {
            let part = |shift: u32| ((seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> shift) % 30) as i64;
            let ms = [part(8), part(20) / 4, part(32), part(44)];
            let played = play(11 * MS, ms, 4000 * MS);
            let row_ms = (ms[..3].iter().sum::<i64>()).max(ms[3]).max(11) as f64 + 1.0;
            let (count, sum) = apart_ms(&played).fold((0.0, 0.0), |(count, sum), ms| (count + 1.0, sum + ms));
            assert!(sum / count <= row_ms, "{ms:?}: {} instead of {row_ms}", sum / count);
        }
    }

    #[test]
    fn it_does_not_switch_to_and_fro() {
        let mut overlap = Overlap::new(20 * MS);
        let mut note = |row_ms: f64| {
            let [device_ns, placement_ns] = [0.8, 0.2].map(|part| (row_ms * part * 1e6) as i64);
            overlap.note(StepTimes { device_ns, placement_ns, encode_ns: 0 });
            overlap.is_on()
        };
        assert!(!note(30.0) && !note(15.0) && !note(15.0), "one slow update is none");
        let was_on: Vec<bool> = (0..100).map(|number| note([21.0, 23.5][number % 2])).collect();
        assert!(was_on.windows(2).filter(|pair| pair[0] != pair[1]).count() <= 1, "{was_on:?}");
        assert!((0..50).map(|_| note(12.0)).last() == Some(false));
    }
}
