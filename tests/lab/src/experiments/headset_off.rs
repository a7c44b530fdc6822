//! A headset taken off for a while: its cost in memory, and the return of the picture.

use super::run::mock_config;
use crate::session::Lab;
use crate::session::options::{Renderer, RunOptions};
use anyhow::{Context, bail, ensure};
use serde::{Deserialize, Serialize};
use shadecast_client::client::Step;
use shadecast_mock_runtime::config::{ClockKind, EventKind, MockConfig, ScriptedEvent};
use shadecast_system::process::resident_bytes;
use std::fmt;

/// What becomes of the session meanwhile.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Absence {
    /// Frames go on and are not to be rendered.
    Hidden,
    /// The session is ended, and begins again.
    Resting,
}

/// How it went.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct HeadsetOffReport {
    /// How long nobody looked.
    pub off_s: f64,
    /// What the memory grew by meanwhile, MB: the difference of the next two.
    pub grown_mb: f64,
    /// Resident memory of the process (server, link and client) a second into the absence, MB.
    pub rss_before_mb: f64,
    /// The same at its end.
    pub rss_after_mb: f64,
    /// Bytes that waited in the client at most, from a second into the absence on.
    pub most_waiting_bytes: usize,
    /// Updates that the server made from a second into the absence to its end.
    pub updates_while_off: u64,
    /// From the first frame that is seen again to the first with an update made after it, seconds of virtual time.
    pub picture_back_s: f64,
}

impl fmt::Display for HeadsetOffReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "  headset off     {:.0} s: memory {:+.1} MB, {} bytes waited at most, {} updates, picture back after {:.3} s",
            self.off_s, self.grown_mb, self.most_waiting_bytes, self.updates_while_off, self.picture_back_s
        )
    }
}

/// The headset is taken off after this time.
const ON_S: f64 = 1.5;
/// What is on its way when it is taken off has arrived after this time, and the server knows.
const SETTLED_S: f64 = 1.0;
/// A picture that is not back by then will not come.
const PATIENCE_S: f64 = 5.0;

/// Runs `options` in virtual time with the headset off for `off_s` seconds. To be called where [`crate::experiments::run::run`] may be.
///
/// # Errors
/// Anything that keeps the run from going on, and a picture that does not come back.
pub fn measure(options: &RunOptions, absence: Absence, off_s: f64) -> anyhow::Result<HeadsetOffReport> {
    ensure!(options.renderer == Renderer::Stream, "the headset is taken off a server behind a link");
    ensure!(off_s > SETTLED_S, "{off_s} s are too short an absence");
    let config = script(options, absence, off_s)?;
    // SAFETY: the caller's promise, as for `run`.
    let mut lab = unsafe { Lab::open(options, &config) }?;
    let turns = |seconds: f64| (seconds * options.refresh_hz).round() as u64;
    (0..turns(ON_S + SETTLED_S)).try_for_each(|_| lab.turn().map(|_| ()))?;
    let mut report = HeadsetOffReport { off_s, rss_before_mb: rss_mb()?, ..HeadsetOffReport::default() };
    let updates = lab.seat().sent.updates;
    ensure!(updates > 0, "there was no picture before the headset was taken off");
    for _ in 0..turns(off_s - SETTLED_S) {
        lab.turn()?;
        report.most_waiting_bytes = report.most_waiting_bytes.max(lab.client.intake.waiting_bytes());
    }
    report.rss_after_mb = rss_mb()?;
    report.grown_mb = report.rss_after_mb - report.rss_before_mb;
    report.updates_while_off = lab.seat().sent.updates - updates;
    report.picture_back_s = until_picture(&mut lab, turns(PATIENCE_S))?;
    Ok(report)
}

fn script(options: &RunOptions, absence: Absence, off_s: f64) -> anyhow::Result<MockConfig> {
    let frame = |seconds: f64| (seconds * options.refresh_hz).round() as u64;
    let event = |seconds: f64, kind| ScriptedEvent { frame: frame(seconds), kind };
    let events = match absence {
        Absence::Hidden => vec![event(ON_S, EventKind::Hide), event(ON_S + off_s, EventKind::Show)],
        Absence::Resting => vec![event(ON_S, EventKind::Pause { ms: (off_s * 1000.0) as u32 })],
    };
    let config = mock_config(options, ClockKind::Virtual, 0)?;
    Ok(MockConfig { events, seconds: 0.0, capture_dir: None, ..config })
}

/// Seconds from the first frame that is seen to the first that shows an update made after it.
fn until_picture(lab: &mut Lab, turns: u64) -> anyhow::Result<f64> {
    let mut back = None;
    for _ in 0..turns {
        let Step::Frame(frame) = lab.turn()? else { continue };
        if !frame.is_rendered {
            continue;
        }
        let (since, made) = *back.get_or_insert((frame.display_time, lab.seat().sent.updates));
        if frame.update.is_some_and(|id| u64::from(id.0) >= made) {
            return Ok(frame.display_time.since(since) as f64 * 1e-9);
        }
    }
    bail!("the picture did not come back within {PATIENCE_S} s")
}

/// Resident memory of this process.
fn rss_mb() -> anyhow::Result<f64> {
    let resident = resident_bytes(std::process::id()).context("reading this process's memory")?;
    Ok(resident as f64 / 1_024_000.0)
}
