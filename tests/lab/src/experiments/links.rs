//! `shadecast-lab links`: links that are bad in one way each, in virtual time. What is queued before the bottleneck, how old pictures are,
//! and how long the longest pause is, held against bars. Where packets are lost, how far pictures are from the truth too.
//!
//! A run's options enter; their link is replaced. A table leaves.

use super::run::{self, clear, compare, comparer, into_probe, mock_config};
use crate::measure::compare::Comparer;
use crate::measure::percentiles::median;
use crate::report::stats::Summary;
use crate::session::options::RunOptions;
use crate::session::{Lab, START_NS};
use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use shadecast_client::client::Step;
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use shadecast_mock_runtime::record::read_frames;
use shadecast_protocol::ids::UpdateId;
use shadecast_transport::neighbour::{Neighbour, Traffic};
use shadecast_transport::{LinkProfile, LinkSchedule};
use std::fmt;
use std::net::SocketAddr;
use std::path::PathBuf;
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

/// Those who share a link of 20 Mbit/s, from so long after its first use on, seconds.
const NEIGHBOURS: [(&str, Traffic); 2] =
    [("beside a viewer", Traffic::Pictures(20.0)), ("beside a download", Traffic::Download)];
const NEIGHBOUR_AT_S: f64 = 4.0;
/// They share it for so long, and figures count from so much later on, seconds.
const SHARED_S: f64 = 30.0;
const SHARED_SETTLING_S: f64 = 8.0;

/// Short bursts of loss: a part of the packets for so long, once in so long, seconds.
const BURST_LOSS: f64 = 0.5;
const BURST_S: f64 = 0.04;
const BURST_EVERY_S: f64 = 0.7;

/// Bars. Of a link that changes: its queue, the age of pictures, pauses, milliseconds.
const QUEUE_BAR_MS: f64 = 60.0;
const AGE_BAR_MS: f64 = 400.0;
const PAUSE_BAR_MS: f64 = 1000.0;
/// Part of a better link's bits and pictures.
const RATE_BAR: f64 = 0.8;
/// Pauses on a link that loses packets, and after an outage: these and a round trip, milliseconds.
const LOSS_PAUSE_BAR_MS: f64 = 250.0;
const OUTAGE_PAUSE_BAR_MS: f64 = 300.0;
/// FLIP on a link that loses packets, as a factor on that of the same link without losses.
const LOSS_FLIP_BAR: f64 = 1.15;
/// Picture gap after a change of address, and after a server's restart, milliseconds.
const ADDRESS_PAUSE_BAR_MS: f64 = 300.0;
const RESTART_PAUSE_BAR_MS: f64 = 1000.0;
/// Part of an equal share, or of what is taken alone where that is less.
const SHARE_BAR: f64 = 0.75;

/// What a row must reach; what is `None` has no bar.
#[derive(Clone, Debug, Default)]
struct RowBars {
    queue_median_ms: Option<f64>,
    age_worst_ms: Option<f64>,
    pause_ms: Option<f64>,
    /// At least this part of the bits a second of another row, which shows the same.
    rate_of: Option<(f64, String)>,
    /// At least this part of the pictures a second of another row.
    pictures_of: Option<(f64, String)>,
    /// At most so many times the FLIP of another row.
    flip_of: Option<(f64, String)>,
    /// No pictures that need no other.
    no_refresh: bool,
    /// Both take this part at least of an equal share, or of what the other row says that it takes alone.
    share_of: Option<(f64, String)>,
}

impl RowBars {
    /// The bars that `row` misses, in words. Rows before it are `others`; what was not measured is not held against it.
    fn misses(&self, row: &LinkRow, others: &[LinkRow]) -> Vec<String> {
        let most = [
            ("queue at the median", row.queue_median_ms, self.queue_median_ms),
            ("age at worst", row.age_worst_ms, self.age_worst_ms),
            ("pause", row.longest_pause_ms, self.pause_ms),
        ];
        let over = most.into_iter().filter_map(|(what, ms, bar_ms)| {
            let bar_ms = bar_ms.filter(|bar_ms| ms > *bar_ms)?;
            Some(format!("{what} {ms:.0} ms, bar {bar_ms:.0} ms"))
        });
        let other = |name: &str| others.iter().find(|other| other.link == name);
        let rate = |name: &str| other(name).map(|row| row.delivered_mbit_s);
        let rare = self.pictures_of.iter().filter_map(|(part, name)| {
            let bar = part * other(name)?.pictures_per_s;
            let is_missed = row.pictures_per_s < bar;
            is_missed.then(|| format!("{:.1} pictures/s, bar {bar:.1}", row.pictures_per_s))
        });
        let slow = self.rate_of.iter().filter_map(|(part, name)| {
            let bar = part * rate(name)?;
            let is_missed = row.delivered_mbit_s < bar;
            is_missed.then(|| format!("{:.1} Mbit/s, bar {bar:.1} Mbit/s", row.delivered_mbit_s))
        });
        let unlike = self.flip_of.iter().filter_map(|(factor, name)| {
            let (flip, bar) = (row.flip?, factor * other(name)?.flip?);
            (flip > bar).then(|| format!("FLIP {flip:.4}, bar {bar:.4}"))
        });
        let refreshed =
            (self.no_refresh && row.refreshes > 0).then(|| format!("{} refreshes", row.refreshes));
        let unfair = self.share_of.iter().filter_map(|(part, alone)| {
            let (own, rival) = (row.delivered_mbit_s, row.others_mbit_s?);
            let equal = (own + rival) / 2.0;
            let [own_share, rival_share] = [own / equal.min(rate(alone)?), rival / equal];
            let is_missed = own_share.min(rival_share) < *part;
            is_missed.then(|| format!("{own_share:.2} and {rival_share:.2} of their share, bar {part}"))
        });
        over.chain(slow).chain(rare).chain(unlike).chain(refreshed).chain(unfair).collect()
    }
}

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
    /// What the link delivered, Mbit/s; without what it delivered to others.
    pub delivered_mbit_s: f64,
    /// What it delivered to others, Mbit/s.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub others_mbit_s: Option<f64>,
    /// Packets that found the queue full.
    pub dropped: u64,
    /// Pictures that need no other, which the server sent.
    #[serde(default)]
    pub refreshes: u64,
    /// Distance of pictures from the truth, 0..1, the worse of both eyes: the mean over the frames that were compared.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flip: Option<f64>,
    /// The bars that it misses.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub misses: Vec<String>,
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
    others_bytes: u64,
    dropped: u64,
    refreshes: u64,
    flip: Option<f64>,
}

/// A part of a run: since when, seconds, what it is called, and what it must reach.
struct Part {
    from_s: f64,
    name: String,
    bars: RowBars,
}

impl Part {
    fn new(from_s: f64, name: impl Into<String>, bars: RowBars) -> Self {
        Self { from_s, name: name.into(), bars }
    }
}

/// A link with the parts of a run on it.
struct Case {
    name: String,
    schedule: LinkSchedule,
    parts: Vec<Part>,
    /// What happens after [`OUTAGE_AT_S`].
    happens: Option<Happens>,
    /// Who takes it too, from [`NEIGHBOUR_AT_S`] on.
    neighbour: Option<Traffic>,
    /// Whether pictures are compared with the truth.
    compares: bool,
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
    fn new(name: &str, schedule: LinkSchedule, parts: Vec<Part>, seconds: f64) -> Self {
        let (happens, neighbour, compares) = (None, None, false);
        Self { name: name.to_owned(), schedule, parts, happens, neighbour, compares, seconds }
    }

    /// A usual link that carries nothing for `outage_s`, if that is more than 0. The pause after it, or after what happens instead, may
    /// be `pause_ms` long.
    fn with_outage(name: &str, outage_s: f64, pause_ms: f64) -> Result<Self> {
        let usual = queued("latency=20ms,rate=100mbit")?;
        let schedule = match outage_s {
            0.0 => usual.into(),
            _ => LinkSchedule::interrupted(usual, link_ns(OUTAGE_AT_S), (outage_s * 1e9) as i64),
        };
        let bars = RowBars { pause_ms: Some(pause_ms), ..RowBars::default() };
        let (back_s, before) = (OUTAGE_AT_S + outage_s, format!("before: {name}"));
        let mut parts = vec![Part::new(0.0, before, RowBars::default())];
        if outage_s > 0.0 {
            parts.push(Part::new(OUTAGE_AT_S, name, RowBars::default()));
            parts.push(Part::new(back_s, format!("after: {name}"), bars));
        } else {
            parts.push(Part::new(OUTAGE_AT_S, name, bars));
        }
        Ok(Self::new(name, schedule, parts, back_s + AFTER_OUTAGE_S))
    }

    /// A link of 20 Mbit/s that somebody else takes too, from [`NEIGHBOUR_AT_S`] on.
    fn beside(name: &str, traffic: Traffic) -> Result<Self> {
        let alone = format!("alone: {name}");
        let parts = vec![
            Part::new(0.0, alone.clone(), RowBars::default()),
            Part::new(NEIGHBOUR_AT_S, format!("begins: {name}"), RowBars::default()),
            Part::new(
                NEIGHBOUR_AT_S + SHARED_SETTLING_S,
                name,
                RowBars { share_of: Some((SHARE_BAR, alone)), ..RowBars::default() },
            ),
        ];
        let link = queued("latency=10ms,rate=20mbit")?.into();
        let case = Self::new(name, link, parts, NEIGHBOUR_AT_S + SHARED_S);
        Ok(Self { neighbour: Some(traffic), ..case })
    }
}

fn profile(text: &str) -> Result<LinkProfile> {
    Ok(text.parse::<LinkProfile>()?)
}

/// Behind a home router.
fn queued(text: &str) -> Result<LinkProfile> {
    Ok(LinkProfile { queue_ns: ROUTER_QUEUE.as_nanos() as i64, ..profile(text)? })
}

/// Seconds after the client's start as the link's time, which begins with the virtual clock.
fn link_ns(seconds: f64) -> i64 {
    if seconds == 0.0 { 0 } else { START_NS + (seconds * 1e9) as i64 }
}

/// A link whose rate changes between [`STEPS_MBIT`].
fn steps(seconds: f64) -> Result<Case> {
    let (mut steps, mut parts) = (Vec::new(), Vec::new());
    for (number, rate) in STEPS_MBIT.iter().enumerate() {
        let at_s = seconds * number as f64 / STEPS_MBIT.len() as f64;
        let has_risen = number > 0 && *rate > STEPS_MBIT[number - 1];
        let pictures_of = has_risen.then(|| (RATE_BAR, format!("{} Mbit/s", STEPS_MBIT[0])));
        let bars = RowBars {
            queue_median_ms: Some(QUEUE_BAR_MS),
            age_worst_ms: Some(AGE_BAR_MS),
            pause_ms: Some(PAUSE_BAR_MS),
            pictures_of,
            ..RowBars::default()
        };
        steps.push((link_ns(at_s), queued(&format!("latency=10ms,rate={rate}mbit"))?));
        parts.push(Part::new(at_s, format!("{rate} Mbit/s"), bars));
    }
    Ok(Case::new("steps", LinkSchedule::of_steps(steps), parts, seconds))
}

/// A local network, as it should be and not.
fn lans(seconds: f64) -> Result<Vec<Case>> {
    let good = queued("latency=3ms,rate=100mbit")?;
    let mut bursts = vec![(0, good.clone())];
    for burst in 1..(seconds / BURST_EVERY_S) as u32 {
        let at_s = f64::from(burst) * BURST_EVERY_S;
        bursts.push((link_ns(at_s), LinkProfile { loss: BURST_LOSS, ..good.clone() }));
        bursts.push((link_ns(at_s + BURST_S), good.clone()));
    }
    let of_good = || Some((RATE_BAR, "LAN".to_owned()));
    let bad =
        || RowBars { rate_of: of_good(), pictures_of: of_good(), no_refresh: true, ..RowBars::default() };
    let case = |name: &str, schedule: LinkSchedule, bars: RowBars| {
        Case::new(name, schedule, vec![Part::new(0.0, name, bars)], seconds)
    };
    Ok(vec![
        case("LAN", good.into(), RowBars::default()),
        case("LAN, jitter 40 ms", queued("latency=23ms,jitter=20ms,rate=100mbit")?.into(), bad()),
        case("LAN, reordering 2 %", queued("latency=3ms,jitter=1ms,reorder=2%,rate=100mbit")?.into(), bad()),
        case("LAN, bursts of loss", LinkSchedule::of_steps(bursts), bad()),
    ])
}

/// The links that are measured over `seconds` each.
fn cases(seconds: f64) -> Result<Vec<Case>> {
    let mut cases = vec![steps(seconds)?];
    cases.extend(lans(seconds)?);
    for latency in LATENCIES_MS {
        for loss in LOSSES {
            let name_of = |loss: f64| format!("{latency} ms, {:.0} % lost", loss * 100.0);
            let name = name_of(loss);
            let link = LinkProfile { loss, ..queued(&format!("latency={latency}ms,rate=100mbit"))? };
            let pause_ms = LOSS_PAUSE_BAR_MS + 2.0 * latency as f64;
            let flip_of = (loss > 0.0).then(|| (LOSS_FLIP_BAR, name_of(0.0)));
            let bars = RowBars { pause_ms: Some(pause_ms), flip_of, ..RowBars::default() };
            let case = Case::new(&name, link.into(), vec![Part::new(0.0, &*name, bars)], seconds);
            cases.push(Case { compares: true, ..case });
        }
    }
    for outage_s in OUTAGES_S {
        let round_trip_ms = 40.0;
        let pause_ms = round_trip_ms + OUTAGE_PAUSE_BAR_MS;
        cases.push(Case::with_outage(&format!("nothing for {outage_s} s"), outage_s, pause_ms)?);
    }
    for (name, address) in ADDRESSES {
        let happens = Some(Happens::Move(address.parse()?));
        cases.push(Case { happens, ..Case::with_outage(name, 0.0, ADDRESS_PAUSE_BAR_MS)? });
    }
    let restart = Case::with_outage(&format!("restart, {DOWN_S} s"), DOWN_S, RESTART_PAUSE_BAR_MS)?;
    cases.push(Case { happens: Some(Happens::Restart), ..restart });
    for (name, traffic) in NEIGHBOURS {
        cases.push(Case::beside(name, traffic)?);
    }
    Ok(cases)
}

/// Measures all links whose names are wanted. To be called where [`crate::experiments::run::run`] may be.
///
/// # Errors
/// Anything that keeps a run from going on.
pub fn measure(options: &RunOptions, scene: &str, is_wanted: impl Fn(&str) -> bool) -> Result<Links> {
    let mut links = Links { scene: scene.to_owned(), extent_pixels: options.extent_pixels, rows: Vec::new() };
    for case in cases(options.seconds)?.into_iter().filter(|case| is_wanted(&case.name)) {
        let (link, seconds) = (case.schedule.clone(), case.seconds);
        let options = RunOptions { link, seconds, reconnects: true, ..options.clone() };
        let looks = looks(&options, &case)?;
        for (number, Part { from_s, name, bars }) in case.parts.iter().enumerate() {
            let to_s = case.parts.get(number + 1).map_or(seconds, |next| next.from_s);
            let mut row = row(name, [*from_s, to_s], &looks);
            row.misses = bars.misses(&row, &links.rows);
            println!("{row}");
            links.rows.push(row);
        }
    }
    Ok(links)
}

/// Runs `options`, and looks at each display frame. The updates of a server that was restarted have no ages.
fn looks(options: &RunOptions, &Case { mut happens, neighbour, compares, .. }: &Case) -> Result<Vec<Look>> {
    let is_restarted = matches!(happens, Some(Happens::Restart));
    let config = mock_config(options, ClockKind::Virtual, options.compare_every)?;
    let config = if compares { config } else { MockConfig { capture_dir: None, capture_every: 0, ..config } };
    config.capture_dir.iter().try_for_each(|capture| clear(capture))?;
    // SAFETY: the caller's promise, as for `run`.
    let mut lab = unsafe { Lab::open(options, &config) }?;
    let mut pictures = config.capture_dir.map(|capture| Pictures::new(&lab, options, capture)).transpose()?;
    if let Some(traffic) = neighbour {
        lab.add_neighbour(Neighbour::new(traffic, link_ns(NEIGHBOUR_AT_S), options.seed + 1)?);
    }
    let mut shown: Vec<(Look, i64, Option<UpdateId>)> = Vec::new();
    let is_captured = |frame: usize| frame.is_multiple_of(options.compare_every as usize);
    while let Step::Frame(frame) = lab.step()? {
        let is_due = (frame.display_time.0 - START_NS) as f64 * 1e-9 >= OUTAGE_AT_S;
        match happens.take_if(|_| is_due) {
            None => {}
            Some(Happens::Move(to)) => lab.move_client(to),
            Some(Happens::Restart) => lab.restart_server(options.seed)?,
        }
        let counts = lab.link_counts();
        let flip = match &mut pictures {
            Some(pictures) if is_captured(shown.len()) && frame.update.is_some() => {
                pictures.flip(&mut lab)?
            }
            _ => None,
        };
        let look = Look {
            at_s: (frame.display_time.0 - START_NS) as f64 * 1e-9,
            is_new: frame.is_new,
            age_ms: None,
            queue_ms: lab.queue_ns() as f64 * 1e-6,
            others_bytes: lab.neighbours_bytes(),
            delivered_bytes: counts.delivered_bytes.saturating_sub(lab.neighbours_bytes()),
            dropped: counts.dropped,
            refreshes: lab.refreshes(),
            flip,
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

/// Pictures of a run beside the truth.
struct Pictures {
    capture: PathBuf,
    comparer: Comparer,
}

impl Pictures {
    /// Of a run that is captured into a folder.
    fn new(lab: &Lab, options: &RunOptions, capture: PathBuf) -> Result<Self> {
        let comparer = comparer(&lab.server, options)?;
        Ok(Self { capture, comparer })
    }

    /// How far the frame just shown is from the truth, the worse of both eyes; `None` where it was not captured.
    fn flip(&mut self, lab: &mut Lab) -> Result<Option<f64>> {
        let records = read_frames(&self.capture).context("reading the runtime's frame log")?;
        let Some(record) = records.last().filter(|record| record.captured) else { return Ok(None) };
        let probes = lab.client.presenter.probe()?.map(into_probe);
        let world_from_stage = lab.server.scene.scene.world_from_stage;
        let time = lab.server.world_time(record.predicted_display_time_ns);
        let mut eyes = Summary::default();
        let (comparer, capture) = (&mut self.comparer, &self.capture);
        compare(comparer, &mut eyes, record, capture, world_from_stage, time, Some(&probes))?;
        Ok(run::Look::of(record.frame, eyes.last_two()).flip)
    }
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
    let flips: Vec<f64> = settled().filter_map(|look| look.flip).collect();
    let settled_length_s = (to_s - settled_s).max(1e-3);
    let mbit_s = |bytes: u64| bytes as f64 * 8e-6 / settled_length_s;
    let (own_mbit_s, others_mbit_s) =
        (mbit_s(counted(|look| look.delivered_bytes)), mbit_s(counted(|look| look.others_bytes)));
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
        delivered_mbit_s: own_mbit_s,
        others_mbit_s: (others_mbit_s > 0.0).then_some(others_mbit_s),
        dropped: counted(|look| look.dropped),
        refreshes: counted(|look| look.refreshes),
        flip: (!flips.is_empty()).then(|| flips.iter().sum::<f64>() / flips.len() as f64),
        misses: Vec::new(),
    }
}

impl Links {
    /// How many bars all rows miss.
    pub fn missed_bars(&self) -> usize {
        self.rows.iter().map(|row| row.misses.len()).sum()
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
        )?;
        if let Some(others) = self.others_mbit_s {
            write!(f, ", others {others:.1} Mbit/s")?;
        }
        if let Some(flip) = self.flip {
            write!(f, ", FLIP {flip:.4}")?;
        }
        if self.refreshes > 0 {
            write!(f, ", {} refreshes", self.refreshes)?;
        }
        self.misses.iter().try_for_each(|miss| write!(f, "; MISSED: {miss}"))
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
            others_bytes: (at_s * 3e6) as u64,
            dropped: 0,
            refreshes: 0,
            flip: Some(0.02),
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
        assert!(row.others_mbit_s.is_some_and(|others| (others - 24.0).abs() < 1.0), "{row:?}");
    }

    #[test]
    fn a_row_says_which_bars_it_misses() {
        let looks: Vec<Look> = (0..100).map(|n| look(f64::from(n) / 10.0, n % 2 == 0)).collect();
        let [alone, shared] = ["alone", "shared"].map(|name| row(name, [0.0, 10.0], &looks));
        let misses = |bars: RowBars| bars.misses(&shared, std::slice::from_ref(&alone)).len();
        let pause = |ms: f64| RowBars { pause_ms: Some(ms), ..RowBars::default() };
        assert_eq!([misses(pause(150.0)), misses(pause(250.0))], [1, 0]);
        let rate = |part: f64| RowBars { rate_of: Some((part, "alone".to_owned())), ..RowBars::default() };
        assert_eq!([misses(rate(1.1)), misses(rate(0.9))], [1, 0]);
        let pictures =
            |part: f64| RowBars { pictures_of: Some((part, "alone".to_owned())), ..RowBars::default() };
        assert_eq!([misses(pictures(1.1)), misses(pictures(0.9))], [1, 0]);
        let share = |part: f64| RowBars { share_of: Some((part, "alone".to_owned())), ..RowBars::default() };
        // 8 Mbit/s of 32 are all that it takes alone.
        assert_eq!([misses(share(1.1)), misses(share(0.9))], [1, 0]);
        let flip =
            |factor: f64| RowBars { flip_of: Some((factor, "alone".to_owned())), ..RowBars::default() };
        assert_eq!([misses(flip(0.9)), misses(flip(1.1))], [1, 0]);
        let unknown = RowBars { rate_of: Some((9.0, "not measured".to_owned())), ..RowBars::default() };
        assert_eq!(misses(unknown), 0);
        let refreshed = LinkRow { refreshes: 2, ..shared.clone() };
        let bars = RowBars { no_refresh: true, ..RowBars::default() };
        assert_eq!([bars.misses(&shared, &[]).len(), bars.misses(&refreshed, &[]).len()], [0, 1]);
    }

    #[test]
    fn every_link_has_a_name_of_its_own() {
        let cases = cases(60.0).expect("they are links");
        let names: std::collections::BTreeSet<_> = cases.iter().map(|case| case.name.clone()).collect();
        assert_eq!(names.len(), cases.len());
    }
}
