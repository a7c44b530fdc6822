//! A link below the scene's needs: the time of the first picture, and its continuation.

use super::run::mock_config;
use crate::session::Lab;
use crate::session::options::RunOptions;
use anyhow::Result;
use serde::{Deserialize, Serialize};
use shadecast_client::client::Step;
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use std::fmt;

/// How it went.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SlowLinkReport {
    /// When the client showed each new update, seconds of virtual time since it began to connect.
    pub shown_s: Vec<f64>,
    /// The first of them; the run's length where there is none.
    pub first_picture_s: f64,
    /// Longest time from one to the next, the run's end included, seconds.
    pub longest_pause_s: f64,
    /// Updates that were made.
    pub updates: u64,
    /// Updates that were not made because the link was behind.
    pub withheld: u64,
    /// What was handed to the transport, Mbit/s.
    pub sent_mbit_s: f64,
}

impl fmt::Display for SlowLinkReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { first_picture_s, longest_pause_s, updates, withheld, sent_mbit_s, .. } = self;
        write!(
            f,
            "first picture after {first_picture_s:.2} s, pauses of up to {longest_pause_s:.2} s, {updates} updates made, {withheld} withheld, {sent_mbit_s:.2} Mbit/s"
        )
    }
}

/// Runs `options` in virtual time. To be called where [`crate::experiments::run::run`] may be.
///
/// # Errors
/// Anything that keeps the run from going on.
pub fn measure(options: &RunOptions) -> Result<SlowLinkReport> {
    let config = MockConfig { capture_dir: None, ..mock_config(options, ClockKind::Virtual, 0)? };
    // SAFETY: the caller's promise, as for `run`.
    let mut lab = unsafe { Lab::open(options, &config) }?;
    let mut report = SlowLinkReport::default();
    let mut frames = 0;
    while let Step::Frame(shown) = lab.step()? {
        frames += 1;
        if shown.is_new {
            report.shown_s.push(f64::from(frames) / options.refresh_hz);
        }
    }
    let sent = lab.seat().sent;
    (report.updates, report.withheld) = (sent.updates, sent.withheld);
    report.sent_mbit_s =
        (sent.atlas_bytes + sent.geometry_bytes + sent.motion.total()) as f64 * 8e-6 / options.seconds;
    report.first_picture_s = report.shown_s.first().copied().unwrap_or(options.seconds);
    let times: Vec<f64> = report.shown_s.iter().copied().chain([options.seconds]).collect();
    report.longest_pause_s = times.windows(2).map(|pair| pair[1] - pair[0]).fold(0.0, f64::max);
    Ok(report)
}
