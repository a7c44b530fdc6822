//! Costs of parts of the picture: the same run with and without each, in turn, in several rounds, so a noisy machine disturbs
//! all alike.

use super::run::mock_config;
use crate::measure::percentiles::median;
use crate::session::options::RunOptions;
use crate::session::{Lab, START_NS};
use anyhow::Context;
use serde::{Deserialize, Serialize};
use shadecast_client::client::Step;
use shadecast_client::draw::stages::atlas_draw::Reconstruction;
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use shadecast_server::atlas::surround::DEFAULT_SURROUND;
use shadecast_server::pacing::quality::DEFAULT_QP;
use shadecast_server::pacing::quality::QualityOptions;
use shadecast_server::shading::filter::Filter;
use std::fmt;

/// Of each run, until the first picture and what follows it are there, seconds: not measured.
const SETTLING_S: f64 = 0.5;

/// Something that can be done without.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Part {
    /// Textures filtered for a pixel of the display instead of a texel of the block.
    Filter,
    /// What an abrupt turn of the head would show.
    Surround,
    /// Brightness between texels by a cubic.
    Cubic,
    /// Levels of detail.
    Detail,
    /// Blocks that are not shaded again.
    Reuse,
}

impl Part {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Filter, Self::Surround, Self::Cubic, Self::Detail, Self::Reuse];

    /// The same run with it and without it.
    fn switched(self, options: &RunOptions, is_on: bool) -> RunOptions {
        let mut options = options.clone();
        match self {
            Self::Surround => options.surround = if is_on { DEFAULT_SURROUND } else { 0.0 },
            Self::Filter if !is_on => options.spared.policy.filter = Filter::Texel,
            Self::Cubic if is_on => options.reconstruction = Reconstruction::Bicubic,
            Self::Detail if !is_on => options.detail_pixels = 0.0,
            Self::Reuse if !is_on => options.spared.policy.reuse = false,
            Self::Filter | Self::Cubic | Self::Detail | Self::Reuse => {}
        }
        options
    }

    fn name(self) -> &'static str {
        match self {
            Self::Filter => "filter",
            Self::Surround => "surround",
            Self::Cubic => "cubic",
            Self::Detail => "levels of detail",
            Self::Reuse => "reuse",
        }
    }
}

/// What one run takes, means of an update and of a display frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    /// Of the server's device an update, milliseconds.
    pub server_ms: f64,
    /// Of the client's device a display frame, milliseconds.
    pub client_ms: f64,
    /// Bytes of an update's picture, with a quantiser of 22.
    pub picture_bytes: f64,
    /// Bytes of all else between two updates.
    pub other_bytes: f64,
}

impl Cost {
    /// By its parts: `self` over `other`.
    fn over(self, other: Self) -> Self {
        Self {
            server_ms: self.server_ms / other.server_ms,
            client_ms: self.client_ms / other.client_ms,
            picture_bytes: self.picture_bytes / other.picture_bytes,
            other_bytes: self.other_bytes / other.other_bytes,
        }
    }

    /// The median of each part.
    pub(super) fn median(costs: &[Self]) -> Self {
        let of = |part: fn(&Self) -> f64| median(costs.iter().map(part));
        Self {
            server_ms: of(|cost| cost.server_ms),
            client_ms: of(|cost| cost.client_ms),
            picture_bytes: of(|cost| cost.picture_bytes),
            other_bytes: of(|cost| cost.other_bytes),
        }
    }
}

/// A part, and what it costs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// The part.
    pub part: Part,
    /// Medians with it.
    pub with: Cost,
    /// Medians without it.
    pub without: Cost,
    /// Medians of the ratios within a round, with it over without it.
    pub ratio: Cost,
}

/// All parts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Costs {
    /// Rounds of all runs.
    pub rounds: usize,
    /// A row a part.
    pub rows: Vec<Row>,
}

impl fmt::Display for Costs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "With it over without it, medians of {} rounds.", self.rounds)?;
        for Row { part, with, ratio, .. } in &self.rows {
            writeln!(
                f,
                "  {:<17} server {:.1} ms, {:.2}x; client {:.2} ms, {:.2}x; pictures {:.1} kB, {:.2}x; all else {:.1} kB, {:.2}x",
                part.name(),
                with.server_ms,
                ratio.server_ms,
                with.client_ms,
                ratio.client_ms,
                with.picture_bytes * 1e-3,
                ratio.picture_bytes,
                with.other_bytes * 1e-3,
                ratio.other_bytes,
            )?;
        }
        Ok(())
    }
}

/// Runs `options` with and without each part, as many rounds as asked for. To be called where [`crate::experiments::run::run`] may be.
///
/// # Errors
/// Anything that keeps a run from going on.
pub fn measure(options: &RunOptions, rounds: usize) -> anyhow::Result<Costs> {
    let options = RunOptions { quality: QualityOptions::Constant(DEFAULT_QP), ..options.clone() };
    let mut rows = Vec::new();
    for part in Part::ALL {
        let (mut with, mut without, mut ratios) = (Vec::new(), Vec::new(), Vec::new());
        for _ in 0..rounds {
            let [on, off] = [true, false].map(|is_on| {
                let options = part.switched(&options, is_on);
                cost(&options, &mock_config(&options, ClockKind::Virtual, 0)?, SETTLING_S)
            });
            let ((on, _), (off, _)) = (on?, off?);
            with.push(on);
            without.push(off);
            ratios.push(on.over(off));
        }
        let [with, without, ratio] = [&with, &without, &ratios].map(|costs| Cost::median(costs));
        rows.push(Row { part, with, without, ratio });
    }
    Ok(Costs { rounds, rows })
}

/// Runs `options` on a headset, and measures after so many seconds. The server's device counts all viewers; the bytes are the first
/// one's. Gives the device's name, too.
pub(super) fn cost(
    options: &RunOptions,
    headset: &MockConfig,
    settling_s: f64,
) -> anyhow::Result<(Cost, String)> {
    let config = MockConfig { capture_dir: None, ..headset.clone() };
    // SAFETY: the caller's promise, as for `run`.
    let mut lab = unsafe { Lab::open(options, &config) }?;
    let (mut frames, mut client_ms) = (0u32, 0.0);
    let mut before = None;
    while let Step::Frame(shown) = lab.step()? {
        let since_s = (shown.display_time.0 - START_NS) as f64 * 1e-9;
        if since_s < settling_s || shown.update.is_none() {
            continue;
        }
        before.get_or_insert_with(|| (lab.seat().sent, server_ms(&lab)));
        client_ms += lab.client.presenter.frame_timings()?.iter().map(|(_, ms)| ms).sum::<f64>();
        frames += 1;
    }
    let (before, server_ms_before) = before.context("nothing was shown; give the run more seconds")?;
    let sent = lab.seat().sent;
    let updates = (sent.updates - before.updates).max(1) as f64;
    let bytes = |now: u64, before: u64| (now - before) as f64 / updates;
    let device = lab.server.gpu.device_name();
    let cost = Cost {
        server_ms: (server_ms(&lab) - server_ms_before) / updates,
        client_ms: client_ms / f64::from(frames),
        picture_bytes: bytes(sent.atlas_bytes, before.atlas_bytes),
        other_bytes: bytes(
            sent.geometry_bytes + sent.motion.total(),
            before.geometry_bytes + before.motion.total(),
        ),
    };
    Ok((cost, device))
}

/// Of all viewers, since the start.
fn server_ms(lab: &Lab) -> f64 {
    lab.seats().flat_map(|seat| seat.gpu_ms.values()).sum()
}
