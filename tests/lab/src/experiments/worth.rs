//! What each measure of a slow device saves: the same run with the first measures in force, one more each time, in several rounds.
//!
//! A run's options enter. A table leaves: the device's time of an update, with a measure over without it. Virtual time keeps
//! the rate of updates equal, so rings and view times are those of a slow device. Time of the CPU is not counted.

use super::costs::{Cost, cost};
use super::run::mock_config;
use crate::measure::percentiles::median;
use crate::session::options::{RunOptions, StageMs};
use serde::{Deserialize, Serialize};
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use shadecast_scene::load::SceneSource;
use shadecast_server::atlas::surround::DEFAULT_SURROUND;
use shadecast_server::pacing::quality::{DEFAULT_QP, QualityOptions};
use shadecast_server::pacing::relief::{Measure, Measures};
use std::fmt;
use std::path::PathBuf;

/// The window of a slow device: 1280x800 pixels, eight updates a second.
const EXTENT_PIXELS: [u32; 2] = [1280, 800];
const UPDATE_HZ: f64 = 8.0;
const STAGES: StageMs = StageMs { server: 120.0, encode: 20.0, decode: 10.0, steps: None };
/// Frames cost time and change nothing of what is measured.
const REFRESH_HZ: f64 = 16.0;
/// LODs change one after the other; from then on all is as the measures say. Seconds.
const SETTLING_S: f64 = 4.0;
const SECONDS: f64 = 7.0;
/// Texels that an update may shade again: what such a device shades in 30 ms.
const SHADE_TEXELS: u64 = 200_000;

/// All measures.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Worth {
    /// What was shown.
    pub scene: String,
    /// Rounds of all runs.
    pub rounds: usize,
    /// The device's time of an update without measures, milliseconds.
    pub without_ms: f64,
    /// A row a measure, in the order in which they are taken.
    pub rows: Vec<Row>,
}

/// A measure, taken after those before it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Its name.
    pub measure: String,
    /// The device's time of an update with it and those before it, median of the rounds, milliseconds.
    pub with_ms: f64,
    /// The part of an update's time that it saves: median, least and most of the rounds.
    pub saved: [f64; 3],
    /// The median of each update's bytes but for its picture, with it over without it.
    pub other_bytes_ratio: f64,
}

impl fmt::Display for Worth {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { scene, rounds, without_ms, rows } = self;
        writeln!(
            f,
            "{scene}, {rounds} rounds; without measures an update takes the device {without_ms:.1} ms"
        )?;
        writeln!(
            f,
            "{:<22} {:>9} {:>8} {:>18} {:>15}",
            "measure", "update", "saved", "least, most", "geometry"
        )?;
        for Row { measure, with_ms, saved: [median, least, most], other_bytes_ratio } in rows {
            let range = format!("{:.1} %, {:.1} %", 100.0 * least, 100.0 * most);
            writeln!(
                f,
                "{measure:<22} {with_ms:>6.1} ms {:>6.1} % {range:>18} {other_bytes_ratio:>14.2}x",
                100.0 * median
            )?;
        }
        Ok(())
    }
}

/// Runs `dragons` dragons with 0, 1 and up to all measures, `rounds` times. `out`: a folder for what runs write. To be called where
/// [`super::run::run`] may be.
///
/// # Errors
/// Anything that keeps a run from going on.
pub fn measure(dragons: u32, rounds: usize, out: PathBuf) -> anyhow::Result<Worth> {
    let options = RunOptions {
        extent_pixels: EXTENT_PIXELS,
        rate_hz: UPDATE_HZ,
        refresh_hz: REFRESH_HZ,
        seconds: SECONDS,
        stages: STAGES,
        surround: DEFAULT_SURROUND,
        shade_texels: Some(SHADE_TEXELS),
        quality: QualityOptions::Constant(DEFAULT_QP),
        ..RunOptions::new(SceneSource::Dragons(dragons), out)
    };
    // Two equal eyes are one: see `Part` in `shared/gpu/src/pass.rs`.
    let headset = MockConfig { ipd_m: 0.0, ..mock_config(&options, ClockKind::Virtual, 0)? };
    let mut found: Vec<Vec<Cost>> = Vec::new();
    for _ in 0..rounds {
        let with_first = |count| {
            let mut options = options.clone();
            options.spared.policy.measures = Some(Measures::first(count));
            cost(&options, &headset, SETTLING_S).map(|(cost, _)| cost)
        };
        found.push((0..=Measure::ALL.len()).map(with_first).collect::<anyhow::Result<_>>()?);
    }
    let median_of = |value: &dyn Fn(&[Cost]) -> f64| median(found.iter().map(|round| value(round)));
    let rows = Measure::ALL.iter().enumerate().map(|(before, measure)| {
        let saved = |round: &Vec<Cost>| 1.0 - round[before + 1].server_ms / round[before].server_ms;
        let saved = || found.iter().map(saved);
        Row {
            measure: format!("{measure:?}"),
            with_ms: median_of(&|round| round[before + 1].server_ms),
            saved: [
                median(saved()),
                saved().fold(f64::INFINITY, f64::min),
                saved().fold(f64::NEG_INFINITY, f64::max),
            ],
            other_bytes_ratio: median_of(&|round| round[before + 1].other_bytes / round[before].other_bytes),
        }
    });
    Ok(Worth {
        scene: options.scene.to_string(),
        rounds,
        without_ms: median_of(&|round| round[0].server_ms),
        rows: rows.collect(),
    })
}
