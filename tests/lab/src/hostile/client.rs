//! A server that attacks the real client, on the mock runtime. The client must keep displaying frames, keep its memory bounded,
//! and display a well-behaved server's pictures soon after.

use crate::experiments::run::mock_config;
use crate::hostile::process::Program;
use crate::hostile::report::{Bars, ClientReport};
use crate::hostile::rogue::{Conduct, Rogue};
use crate::process::program;
use crate::session::options::RunOptions;
use crate::session::runtime::prepare_runtime;
use anyhow::{Context, ensure};
use shadecast_mock_runtime::config::ClockKind;
use shadecast_mock_runtime::record::read_frames;
use shadecast_scene::load::SceneSource;
use shadecast_system::monotonic_now_ns;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

/// How long a client may take to start, or to come back.
const PATIENCE: Duration = Duration::from_secs(60);
/// Of peace, before each attack, this much is watched at most.
const LONGEST_QUIET: Duration = Duration::from_secs(5);
/// Display frames per second that the headset asks for.
const REFRESH_HZ: f64 = 30.0;

/// What a rogue does, and what it is called.
pub(crate) const ATTACKS: &[(&str, &str, Conduct)] = &[
    ("far-pictures", "pictures four thousand million frames ahead", Conduct::FarPictures),
    ("last-pictures", "pictures of the last frame there is", Conduct::LastPictures),
    ("hollow-deltas", "250 deltas of two million samples of no bits each", Conduct::HollowDeltas),
    ("pongs", "30,000 answers a second to pings that were never sent", Conduct::Pongs),
    ("broken-units", "streams and pictures that are cut, of no kind, or huge", Conduct::BrokenUnits),
];

/// The client, and the log of its frames.
struct Headset {
    program: Program,
    capture: PathBuf,
}

/// Attacks a client in each of the ways whose names are wanted.
pub(crate) fn attack_all(
    names: &dyn Fn(&str) -> bool,
    seconds: f64,
    bars: &Bars,
    folder: &Path,
    verbose: bool,
) -> anyhow::Result<Vec<ClientReport>> {
    if !ATTACKS.iter().any(|(name, ..)| names(name)) {
        return Ok(Vec::new());
    }
    let rogue = Rogue::start(&folder.join("rogue"))?;
    let mut headset: Option<Headset> = None;
    let mut reports = Vec::new();
    for (number, &(name, what, conduct)) in ATTACKS.iter().enumerate().filter(|(_, it)| names(it.0)) {
        if headset.as_mut().is_none_or(|it| !it.program.is_running()) {
            headset = Some(Headset::start(&rogue, &folder.join(format!("headset-{number}")))?);
        }
        let Some(running) = &mut headset else { continue };
        let mut report = running.attack(&rogue, conduct, Duration::from_secs_f64(seconds))?;
        (report.attack, report.what) = (name, what);
        report.judge(bars);
        if verbose {
            println!("{report}");
        }
        // One that was frozen is not asked to go on.
        if !report.misses.is_empty() {
            headset = None;
        }
        reports.push(report);
    }
    Ok(reports)
}

impl Headset {
    fn start(rogue: &Rogue, out: &Path) -> anyhow::Result<Self> {
        let options = RunOptions {
            extent_pixels: [64, 64],
            refresh_hz: REFRESH_HZ,
            seconds: 0.0, // until it is ended
            ..RunOptions::new(SceneSource::Dragons(1), out.to_owned())
        };
        let config = mock_config(&options, ClockKind::Real, 0)?;
        let runtime = prepare_runtime(&config, out)?;
        let mut command = Command::new(program("shadecast-client")?);
        command.args(["--connect", &rogue.address.to_string(), "--quiet", "--msaa", "1"]);
        command.arg("--identity").arg(out.join("client"));
        command.envs(runtime.iter().map(|(name, value)| (name, value)));
        let before = rogue.welcomes();
        rogue.behave(Conduct::Silent);
        let mut program = Program::start(&mut command)?;
        let deadline = Instant::now() + PATIENCE;
        while rogue.welcomes() == before {
            ensure!(program.is_running(), "the client ended: {}", program.last_words());
            ensure!(Instant::now() < deadline, "the client did not connect: {}", program.last_words());
            std::thread::sleep(Duration::from_millis(20));
        }
        Ok(Self { program, capture: out.join("capture") })
    }

    fn attack(
        &mut self,
        rogue: &Rogue,
        conduct: Conduct,
        duration: Duration,
    ) -> anyhow::Result<ClientReport> {
        self.waits_for_a_picture(rogue)?;
        let quiet = self.watch(duration.min(LONGEST_QUIET))?;
        let memory_before_bytes = self.program.memory_bytes().unwrap_or(0);
        let memory = self.program.watch_memory();
        let sent_before = rogue.sent();
        rogue.behave(conduct);
        let attacked = self.watch(duration)?;
        let sent = rogue.sent() - sent_before;
        let end = Instant::now();
        rogue.behave(Conduct::Lawful);
        let back = rogue.wait_displayed(end, PATIENCE);
        let survived = self.program.is_running();
        Ok(ClientReport {
            attack: "",
            what: "",
            sent,
            quiet_fps: quiet.fps,
            attacked_fps: attacked.fps,
            attacked_pause_ms: attacked.longest_pause_ms,
            back_ms: back.map(|at| at.duration_since(end).as_millis() as u64),
            survived,
            last_words: if survived { String::new() } else { self.program.last_words() },
            memory_before_bytes,
            memory_peak_bytes: memory.peak_bytes(),
            misses: Vec::new(),
        })
    }

    fn waits_for_a_picture(&mut self, rogue: &Rogue) -> anyhow::Result<()> {
        let from = Instant::now();
        rogue.behave(Conduct::Lawful);
        let shown = rogue.wait_displayed(from, PATIENCE);
        let words = self.program.last_words();
        shown.map(|_| ()).with_context(|| format!("the client shows nothing in peace: {words}"))
    }

    /// How display frames come for a while.
    fn watch(&self, duration: Duration) -> anyhow::Result<Pace> {
        let from_ns = monotonic_now_ns();
        std::thread::sleep(duration);
        let to_ns = monotonic_now_ns();
        let frames = read_frames(&self.capture).context("reading the runtime's frame log")?;
        let times: Vec<i64> = frames.iter().map(|frame| frame.wait_time_ns).collect();
        Ok(Pace::of(&times, from_ns, to_ns))
    }
}

/// How fast display frames come.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Pace {
    fps: f64,
    longest_pause_ms: u64,
}

impl Pace {
    fn of(times_ns: &[i64], from_ns: i64, to_ns: i64) -> Self {
        let within = || times_ns.iter().copied().filter(|at| (from_ns..to_ns).contains(at));
        let (mut last_ns, mut longest_ns) = (from_ns, 0);
        for at_ns in within().chain([to_ns]) {
            longest_ns = longest_ns.max(at_ns - last_ns);
            last_ns = at_ns;
        }
        let seconds = (to_ns - from_ns).max(1) as f64 * 1e-9;
        Self { fps: within().count() as f64 / seconds, longest_pause_ms: longest_ns as u64 / 1_000_000 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pace_is_counted_within_the_time_that_was_watched() {
        let times: Vec<i64> = [0, 100, 200, 500, 900, 2000].map(|ms| ms * 1_000_000).into();
        let pace = Pace::of(&times, 100_000_000, 1_100_000_000);
        assert!((pace.fps - 4.0).abs() < 1e-9, "{pace:?}");
        assert_eq!(pace.longest_pause_ms, 400);
        assert_eq!(Pace::of(&[], 0, 1_000_000_000), Pace { fps: 0.0, longest_pause_ms: 1000 });
    }
}
