//! `shadecast-lab slow`: devices of falling speed in virtual time. How soon the first picture comes, how soon a whole one, and
//! what is missing afterwards.
//!
//! A run's options enter. A table leaves, and a sheet of pictures. Nothing here measures real time.

use crate::experiments::run::{Look, Report, run};
use crate::image::Rgb8Image;
use crate::report::sheet::Sheet;
use crate::session::options::{RunOptions, StageMs};
use anyhow::ensure;
use serde::{Deserialize, Serialize};
use std::fmt;

/// How many times slower each device is than the first.
pub const SLOWER: &[f64] = &[1.0, 2.0, 4.0, 8.0, 15.0, 30.0];
/// A picture with no more holes is whole, 0..1.
const WHOLE: f64 = 0.005;
/// Pictures a second that are compared.
const LOOKS_HZ: f64 = 6.0;
/// When the pictures on the sheet are taken, as parts of a run.
const SHEET: [f64; 5] = [0.1, 0.2, 0.3, 0.5, 0.95];

/// All devices.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Slow {
    /// What was shown.
    pub scene: String,
    /// Pixels per eye.
    pub extent_pixels: [u32; 2],
    /// Of each run.
    pub seconds: f64,
    /// By device, the fastest first.
    pub rows: Vec<SlowRow>,
}

/// One device.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SlowRow {
    /// How many times slower it is than the first.
    pub slower: f64,
    /// What an update takes it, milliseconds.
    pub update_ms: f64,
    /// From the client's start to its first picture, seconds.
    pub first_picture_s: f64,
    /// From there to the first picture with at most 0.5 % of holes, seconds; null where none has.
    pub whole_picture_s: Option<f64>,
    /// Updates a second.
    pub updates_per_s: f64,
    /// Part of the geometry that is missing, from the first picture on, 0..1.
    pub holes: Holes,
    /// The same of what is animated.
    pub animated_holes: Holes,
    /// Distance from the truth, mean from the start on, with the frames that show nothing, 0..1.
    pub flip: f64,
    /// The same from the first picture on.
    pub flip_shown: f64,
    /// Of each frame that was looked at: its time, seconds; holes, and animated holes where there is enough of it.
    pub looks: Vec<(f64, f64, Option<f64>)>,
}

/// Mean and worst.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Holes {
    /// Of all frames.
    pub mean: f64,
    /// Of one.
    pub worst: f64,
}

impl Holes {
    fn of(all: impl Iterator<Item = f64> + Clone) -> Self {
        let count = all.clone().count().max(1) as f64;
        Self { mean: all.clone().sum::<f64>() / count, worst: all.fold(0.0, f64::max) }
    }
}

impl SlowRow {
    fn of(slower: f64, stages: StageMs, refresh_hz: f64, report: &Report) -> Self {
        let first = report.frames_before_first_bundle;
        let shown: Vec<&Look> = report.looks.iter().filter(|look| look.frame >= first).collect();
        let seconds = |frame: u64| frame as f64 / refresh_hz;
        let mean = |looks: &mut dyn Iterator<Item = f64>| {
            let all: Vec<f64> = looks.collect();
            all.iter().sum::<f64>() / all.len().max(1) as f64
        };
        let whole = shown.iter().find(|look| look.holes <= WHOLE);
        Self {
            slower,
            update_ms: stages.server,
            first_picture_s: seconds(first),
            whole_picture_s: whole.map(|look| seconds(look.frame)),
            updates_per_s: report.stats.server_fps,
            holes: Holes::of(shown.iter().map(|look| look.holes)),
            animated_holes: Holes::of(shown.iter().filter_map(|look| look.animated_holes)),
            flip: mean(&mut report.looks.iter().filter_map(|look| look.flip)),
            looks: shown.iter().map(|look| (seconds(look.frame), look.holes, look.animated_holes)).collect(),
            flip_shown: mean(&mut shown.iter().filter_map(|look| look.flip)),
        }
    }
}

impl fmt::Display for Slow {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [width, height] = self.extent_pixels;
        writeln!(f, "{}, {width}x{height} pixels an eye, {} s each", self.scene, self.seconds)?;
        writeln!(
            f,
            "{:>7} {:>10} {:>10} {:>10} {:>10} {:>16} {:>16} {:>7} {:>7}",
            "slower",
            "update",
            "first",
            "whole",
            "updates/s",
            "holes, worst",
            "animated, worst",
            "FLIP",
            "shown"
        )?;
        let percent = |Holes { mean, worst }: Holes| format!("{:.2} %, {:.2} %", 100.0 * mean, 100.0 * worst);
        for row in &self.rows {
            let whole = row.whole_picture_s.map_or("never".to_owned(), |s| format!("{s:.2} s"));
            writeln!(
                f,
                "{:>6}x {:>7.0} ms {:>8.2} s {:>10} {:>10.1} {:>16} {:>16} {:>7.4} {:>7.4}",
                row.slower,
                row.update_ms,
                row.first_picture_s,
                whole,
                row.updates_per_s,
                percent(row.holes),
                percent(row.animated_holes),
                row.flip,
                row.flip_shown
            )?;
        }
        Ok(())
    }
}

/// Runs `options` on each device, and writes `sheet.png` into its folder. `scene`: what it is called.
///
/// # Errors
/// As [`run`].
pub fn measure(options: &RunOptions, scene: &str, slower: &[f64]) -> anyhow::Result<Slow> {
    ensure!(slower.iter().all(|times| *times >= 1.0), "a device must be 1 or more times slower");
    let every = (options.refresh_hz / LOOKS_HZ).round() as u32;
    let mut sheet = Sheet::new("Slow devices", SHEET.len() as u32, options.extent_pixels);
    let mut rows = Vec::new();
    for times in slower {
        let StageMs { server, encode, decode, .. } = options.stages;
        let [server, encode, decode] = [server, encode, decode].map(|ms| ms * times);
        let of_device = RunOptions {
            stages: StageMs { server, encode, decode, steps: None },
            compare_every: every,
            dump_every: every,
            compare_from: 0,
            compare_waiting: true,
            out: options.out.join(format!("slower-{times}")),
            ..options.clone()
        };
        let report = run(&of_device)?;
        let row = SlowRow::of(*times, of_device.stages, options.refresh_hz, &report);
        sheet.section(&format!("{times} times slower"), &format!("An update takes {server:.0} ms."));
        add_pictures(&mut sheet, &of_device, &report.looks)?;
        rows.push(row);
    }
    sheet.render()?.write_png(&options.out.join("sheet.png"))?;
    let (scene, extent_pixels) = (scene.to_owned(), options.extent_pixels);
    Ok(Slow { scene, extent_pixels, seconds: options.seconds, rows })
}

fn add_pictures(sheet: &mut Sheet, options: &RunOptions, looks: &[Look]) -> anyhow::Result<()> {
    let every = options.compare_every;
    for at_s in SHEET.map(|part| part * options.seconds) {
        let frame = (at_s * options.refresh_hz / f64::from(every)).round() as u64 * u64::from(every);
        let picture = Rgb8Image::read_png(&options.out.join(format!("client-{frame:06}-left.png")))?;
        let look = looks.iter().find(|look| look.frame == frame);
        let note = look.map_or(String::new(), |look| format!("{:.1} % missing", 100.0 * look.holes));
        sheet.add(&format!("{at_s:.1} s"), &picture, &note)?;
    }
    Ok(())
}
