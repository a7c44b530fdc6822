//! `shadecast-lab links`: links that are bad in one way each, in virtual time. What is queued before the bottleneck, how old pictures are,
//! and how long the longest pause is.
//!
//! A run's options enter; their link is replaced. A table leaves. Nothing here knows pictures' quality.

use super::run::mock_config;
use crate::measure::percentiles::median;
use crate::session::options::RunOptions;
use crate::session::{Lab, START_NS};
use anyhow::Result;
use serde::{Deserialize, Serialize};
use shadecast_client::client::Step;
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use shadecast_protocol::ids::UpdateId;
use shadecast_transport::{LinkProfile, LinkSchedule};
use std::fmt;
use std::net::SocketAddr;
use std::time::Duration;

/// After a change of the link, figures count from then on, seconds.
const SETTLING_S: f64 = 2.0;
/// Queue of a home router.
const ROUTER_QUEUE: Duration = Duration::from_millis(250);
/// Rates of the link that changes, Mbit/s.
const STEPS_MBIT: [u64; 4] = [100, 8, 50, 100];
/// Ways and losses of the table of losses.
const LATENCIES_MS: [u64; 5] = [5, 20, 50, 110, 200];
const LOSSES: [f64; 3] = [0.0, 0.01, 0.05];
/// Outages, seconds; they begin after [`OUTAGE_AT_S`].
const OUTAGES_S: [f64; 5] = [1.0, 2.5, 5.0, 13.0, 30.0];
const OUTAGE_AT_S: f64 = 4.0;
/// After an outage a run goes on for so long, seconds.
const AFTER_OUTAGE_S: f64 = 4.0;
/// How long a server that was killed does not run, seconds.
const DOWN_S: f64 = 2.0;
/// Another port of the same router, and another network.
const ADDRESSES: [(&str, &str); 2] =
    [("another port", "10.0.0.2:50001"), ("another network", "192.168.7.9:40000")];

/// All links.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Links {
    /// What was shown.
    pub scene: String,
    /// Pixels per eye.
    pub extent_pixels: [u32; 2],
    /// One a link, in parts where it changes.
    pub rows: Vec<LinkRow>,
}

/// A link for some time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LinkRow {
    /// The link.
    pub link: String,
    /// Seconds of the run that these figures are of; the first after a change do not count.
    pub from_s: f64,
    /// See `from_s`.
    pub to_s: f64,
    /// New pictures on display a second.
    pub pictures_per_s: f64,
    /// Longest time between two of them, milliseconds; it counts from the change on.
    pub longest_pause_ms: f64,
    /// How long a packet waits before the bottleneck, milliseconds: median over the frames.
    pub queue_median_ms: f64,
    /// The most.
    pub queue_worst_ms: f64,
    /// From the beginning of an update to a frame that shows it, milliseconds: median over the frames.
    pub age_median_ms: f64,
    /// The most.
    pub age_worst_ms: f64,
    /// What the link delivered, Mbit/s.
    pub delivered_mbit_s: f64,
    /// Packets that found the queue full.
    pub dropped: u64,
}

/// What one display frame shows.
#[derive(Clone, Copy, Debug)]
struct Look {
    at_s: f64,
    is_new: bool,
    /// `None`: nothing is shown yet.
    age_ms: Option<f64>,
    queue_ms: f64,
    delivered_bytes: u64,
    dropped: u64,
}

/// A link with the times at which it changes, seconds.
struct Case {
    name: String,
    schedule: LinkSchedule,
    changes_s: Vec<(f64, String)>,
    /// What happens after [`OUTAGE_AT_S`].
    happens: Option<Happens>,
    seconds: f64,
}

/// What happens to an end of a link.
#[derive(Clone, Copy, Debug)]
enum Happens {
    /// The client has another address.
    Move(SocketAddr),
    /// The server is killed and runs again.
    Restart,
}

impl Case {
    fn new(name: &str, schedule: LinkSchedule, changes_s: Vec<(f64, String)>, seconds: f64) -> Self {
        Self { name: name.to_owned(), schedule, changes_s, happens: None, seconds }
    }

    /// A usual link that carries nothing for `outage_s`, if that is more than 0.
    fn with_outage(name: &str, outage_s: f64) -> Result<Self> {
        let usual =
            LinkProfile { queue_ns: ROUTER_QUEUE.as_nanos() as i64, ..profile("latency=20ms,rate=100mbit")? };
        let schedule = match outage_s {
            0.0 => usual.into(),
            _ => LinkSchedule::interrupted(usual, link_ns(OUTAGE_AT_S), (outage_s * 1e9) as i64),
        };
        let back_s = OUTAGE_AT_S + outage_s;
        let mut changes_s = vec![(0.0, format!("before: {name}")), (OUTAGE_AT_S, name.to_owned())];
        if outage_s > 0.0 {
            changes_s.push((back_s, format!("after: {name}")));
        }
        Ok(Self::new(name, schedule, changes_s, back_s + AFTER_OUTAGE_S))
    }
}

fn profile(text: &str) -> Result<LinkProfile> {
    Ok(text.parse::<LinkProfile>()?)
}

/// Seconds after the client's start as the link's time, which begins with the virtual clock.
fn link_ns(seconds: f64) -> i64 {
    if seconds == 0.0 { 0 } else { START_NS + (seconds * 1e9) as i64 }
}

/// The links that are measured over `seconds` each.
fn cases(seconds: f64) -> Result<Vec<Case>> {
    let queued = |text: &str| -> Result<LinkProfile> {
        Ok(LinkProfile { queue_ns: ROUTER_QUEUE.as_nanos() as i64, ..profile(text)? })
    };
    let whole = |name: &str, profile: LinkProfile| {
        Case::new(name, profile.into(), vec![(0.0, name.to_owned())], seconds)
    };
    let mut steps = Vec::new();
    let mut changes_s = Vec::new();
    for (number, rate) in STEPS_MBIT.iter().enumerate() {
        let at_s = seconds * number as f64 / STEPS_MBIT.len() as f64;
        steps.push((link_ns(at_s), queued(&format!("latency=10ms,rate={rate}mbit"))?));
        changes_s.push((at_s, format!("{rate} Mbit/s")));
    }
    let mut cases = vec![Case::new("steps", LinkSchedule::of_steps(steps), changes_s, seconds)];
    cases.push(whole("LAN", queued("latency=3ms,rate=100mbit")?));
    cases.push(whole("LAN, jitter 40 ms", queued("latency=23ms,jitter=20ms,rate=100mbit")?));
    cases.push(whole("LAN, reordering 2 %", queued("latency=3ms,jitter=1ms,reorder=2%,rate=100mbit")?));
    for latency in LATENCIES_MS {
        for loss in LOSSES {
            let name = format!("{latency} ms, {:.0} % lost", loss * 100.0);
            let link = queued(&format!("latency={latency}ms,rate=100mbit"))?;
            cases.push(whole(&name, LinkProfile { loss, ..link }));
        }
    }
    for outage_s in OUTAGES_S {
        cases.push(Case::with_outage(&format!("nothing for {outage_s} s"), outage_s)?);
    }
    for (name, address) in ADDRESSES {
        let happens = Some(Happens::Move(address.parse()?));
        cases.push(Case { happens, ..Case::with_outage(name, 0.0)? });
    }
    let name = format!("restart, {DOWN_S} s");
    cases.push(Case { happens: Some(Happens::Restart), ..Case::with_outage(&name, DOWN_S)? });
    Ok(cases)
}

/// Measures all links whose name begins with `only`. To be called where [`crate::experiments::run::run`] may be.
///
/// # Errors
/// Anything that keeps a run from going on.
pub fn measure(options: &RunOptions, scene: &str, only: &str) -> Result<Links> {
    let mut links = Links { scene: scene.to_owned(), extent_pixels: options.extent_pixels, rows: Vec::new() };
    for case in cases(options.seconds)?.into_iter().filter(|case| case.name.starts_with(only)) {
        let (link, seconds) = (case.schedule.clone(), case.seconds);
        let options = RunOptions { link, seconds, reconnects: true, ..options.clone() };
        let looks = looks(&options, case.happens)?;
        for (number, (from_s, name)) in case.changes_s.iter().enumerate() {
            let to_s = case.changes_s.get(number + 1).map_or(seconds, |(at_s, _)| *at_s);
            let row = row(name, [*from_s, to_s], &looks);
            println!("{row}");
            links.rows.push(row);
        }
    }
    Ok(links)
}

/// Runs `options`, and looks at each display frame. The updates of a server that was restarted have no ages.
fn looks(options: &RunOptions, mut happens: Option<Happens>) -> Result<Vec<Look>> {
    let is_restarted = matches!(happens, Some(Happens::Restart));
    let config = MockConfig { capture_dir: None, ..mock_config(options, ClockKind::Virtual, 0)? };
    // SAFETY: the caller's promise, as for `run`.
    let mut lab = unsafe { Lab::open(options, &config) }?;
    let mut shown: Vec<(Look, i64, Option<UpdateId>)> = Vec::new();
    while let Step::Frame(frame) = lab.step()? {
        let is_due = (frame.display_time.0 - START_NS) as f64 * 1e-9 >= OUTAGE_AT_S;
        match happens.take_if(|_| is_due) {
            None => {}
            Some(Happens::Move(to)) => lab.move_client(to),
            Some(Happens::Restart) => lab.restart_server(options.seed)?,
        }
        let counts = lab.link_counts();
        let look = Look {
            at_s: (frame.display_time.0 - START_NS) as f64 * 1e-9,
            is_new: frame.is_new,
            age_ms: None,
            queue_ms: lab.queue_ns() as f64 * 1e-6,
            delivered_bytes: counts.delivered_bytes,
            dropped: counts.dropped,
        };
        shown.push((look, frame.display_time.0, frame.update.filter(|_| !is_restarted)));
    }
    let begun_ns = lab.updates_begun_ns();
    let aged = |(look, display_ns, update): (Look, i64, Option<UpdateId>)| {
        let begun_ns = update.and_then(|update| begun_ns.get(update.0 as usize));
        Look { age_ms: begun_ns.map(|begun_ns| (display_ns - begun_ns) as f64 * 1e-6), ..look }
    };
    Ok(shown.into_iter().map(aged).collect())
}

fn row(name: &str, [from_s, to_s]: [f64; 2], looks: &[Look]) -> LinkRow {
    let within = |from_s: f64| looks.iter().filter(move |look| (from_s..to_s).contains(&look.at_s));
    let settled_s = from_s + SETTLING_S.min((to_s - from_s) / 2.0);
    let settled = || within(settled_s);
    let ages = || settled().filter_map(|look| look.age_ms);
    let worst = |values: &mut dyn Iterator<Item = f64>| values.fold(0.0, f64::max);
    let new_s: Vec<f64> = within(from_s).filter(|look| look.is_new).map(|look| look.at_s).collect();
    // Until something is shown there is no pause; the wait for the first picture is another figure.
    let begin_s = if from_s == 0.0 { new_s.first().copied() } else { Some(from_s) };
    let times: Vec<f64> = begin_s.into_iter().chain(new_s.iter().copied()).chain([to_s]).collect();
    let pauses = times.windows(2).map(|pair| (pair[1] - pair[0]) * 1e3);
    let counted = |count: fn(&Look) -> u64| {
        let (first, last) = (settled().next().map_or(0, count), settled().next_back().map_or(0, count));
        last.saturating_sub(first)
    };
    let settled_length_s = (to_s - settled_s).max(1e-3);
    LinkRow {
        link: name.to_owned(),
        from_s: settled_s,
        to_s,
        pictures_per_s: settled().filter(|look| look.is_new).count() as f64 / settled_length_s,
        longest_pause_ms: pauses.fold(0.0, f64::max),
        queue_median_ms: median(settled().map(|look| look.queue_ms)),
        queue_worst_ms: worst(&mut settled().map(|look| look.queue_ms)),
        age_median_ms: median(ages()),
        age_worst_ms: worst(&mut ages()),
        delivered_mbit_s: counted(|look| look.delivered_bytes) as f64 * 8e-6 / settled_length_s,
        dropped: counted(|look| look.dropped),
    }
}

impl fmt::Display for Links {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { scene, extent_pixels: [width, height], rows } = self;
        writeln!(f, "{scene}, {width}x{height} pixels an eye, virtual time")?;
        rows.iter().try_for_each(|row| writeln!(f, "{row}"))
    }
}

impl fmt::Display for LinkRow {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:<26} {:>5.1} pictures/s, pause {:>5.0} ms, age {:>4.0} (worst {:>4.0}) ms, queue {:>4.0} (worst {:>4.0}) ms, {:>5.1} Mbit/s, {} dropped",
            self.link,
            self.pictures_per_s,
            self.longest_pause_ms,
            self.age_median_ms,
            self.age_worst_ms,
            self.queue_median_ms,
            self.queue_worst_ms,
            self.delivered_mbit_s,
            self.dropped,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn look(at_s: f64, is_new: bool) -> Look {
        Look {
            at_s,
            is_new,
            age_ms: Some(at_s),
            queue_ms: 2.0,
            delivered_bytes: (at_s * 1e6) as u64,
            dropped: 0,
        }
    }

    #[test]
    fn a_row_counts_pauses_from_the_change_and_the_rest_from_two_seconds_later() {
        let looks: Vec<Look> =
            (0..100).map(|n| look(f64::from(n) / 10.0, n % 2 == 0 && !(40..50).contains(&n))).collect();
        let row = row("x", [4.0, 10.0], &looks);
        assert!((row.longest_pause_ms - 1000.0).abs() < 1.0, "{row:?}");
        assert!((row.pictures_per_s - 5.0).abs() < 0.1, "{row:?}");
        assert!((row.age_worst_ms - 9.9).abs() < 1e-6 && row.queue_median_ms == 2.0);
        assert!((row.delivered_mbit_s - 8.0).abs() < 0.5, "{row:?}");
    }

    #[test]
    fn every_link_has_a_name_of_its_own() {
        let cases = cases(60.0).expect("they are links");
        let names: std::collections::BTreeSet<_> = cases.iter().map(|case| case.name.clone()).collect();
        assert_eq!(names.len(), cases.len());
    }
}
