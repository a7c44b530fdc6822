//! Summary of a run: `stats.json`, the same from the demo and from the lab, and a few lines for people.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shadecast_client::present::stats::ClientStats;
use shadecast_gpu::Gpu;
use shadecast_server::serve::cause_bits::CauseBits;
use thiserror::Error;

use crate::image::Rgb8Image;
use crate::measure::flicker::flicker;
use crate::measure::metrics::{FrameMetrics, PictureMetrics, RegionMetrics};
use crate::session::options::StageMs;

/// Payload rates, in megabits (10^6) per second of the run, from the first frame on that may be compared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MbitPerS {
    /// Video access units.
    pub atlas: f64,
    /// Geometry deltas and vertex samples.
    pub geometry: f64,
}

/// What was counted while the run went on, everything but the pictures.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Counted {
    /// The Vulkan device, as its driver names it.
    pub device: String,
    /// Whether that device is a CPU.
    pub device_is_cpu: bool,
    /// `forward`, `local` or `stream`.
    pub renderer: String,
    /// Updates per second of the run.
    pub server_fps: f64,
    /// Displayed frames per second of the run.
    pub client_fps: f64,
    /// Payload rates.
    pub mbit_per_s: MbitPerS,
    /// Where the bits of the atlas went; none where no H.264 was coded.
    pub bits_by_cause: Option<CauseBits>,
    /// That of geometry by part; empty where it was not counted.
    pub geometry_mbit_per_s: BTreeMap<String, f64>,
    /// Bytes on the wire for one vertex at one grid time, headers included; none if nothing animated was sent.
    pub bytes_per_animated_vertex_sample: Option<f64>,
    /// Mean quantiser of all pictures; none where none was coded.
    pub mean_qp: Option<f64>,
    /// Mean milliseconds per update that each GPU stage of the server took.
    pub gpu_ms: BTreeMap<String, f64>,
    /// Messages of the validation layers, warnings and errors; none where they are off.
    pub validation_messages: Option<u64>,
    /// Patches that were visible but had no room, summed over all updates.
    pub dropped_patches: u64,
    /// Triangles that an update shows, on average.
    pub triangles: f64,
    /// Level of detail of an instance in an update, on average.
    pub mean_level: f64,
    /// Mean of the texels that blocks are asked to have along a pixel.
    pub texels_per_pixel: f64,
    /// Part of the blocks' texels that updates did not shade again.
    pub reused_share: f64,
    /// Blocks in the client's store at the end.
    pub stored_blocks: u32,
    /// Differences of the client's estimate of the server's clock from the truth, milliseconds, one for each display
    /// frame; empty where there is nothing to estimate.
    pub clock_errors_ms: Vec<f64>,
    /// How far the client knew that estimate could be off at most, milliseconds; none where it showed nothing.
    pub clock_error_bound_ms: Option<f64>,
    /// Durations of stages in virtual time; none in real time.
    pub stage_ms: Option<StageMs>,
}

/// The contents of `stats.json`. Figures that could not be measured are null.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stats {
    /// The Vulkan device, as its driver names it.
    pub device: String,
    /// Whether that device is a CPU, so that rates say little.
    pub device_is_cpu: bool,
    /// `forward`, `local` or `stream`.
    pub renderer: String,
    /// Updates per second of the run.
    pub server_fps: f64,
    /// Displayed frames per second of the run.
    pub client_fps: f64,
    /// Payload rates.
    pub mbit_per_s: MbitPerS,
    /// Where the bits of the atlas went, over the same time: they add up to it. None where no H.264 was coded.
    #[serde(default)]
    pub bits_by_cause: Option<CauseBits>,
    /// That of geometry by part of the deltas, and of motion beside them; their sum is `mbit_per_s.geometry`. Empty where it was not
    /// counted.
    #[serde(default)]
    pub geometry_mbit_per_s: BTreeMap<String, f64>,
    /// Bytes on the wire for one vertex at one grid time, headers included.
    pub bytes_per_animated_vertex_sample: Option<f64>,
    /// Mean quantiser of all pictures, 0 (finest) to 51; none where none was coded.
    #[serde(default)]
    pub mean_qp: Option<f64>,
    /// Mean over the compared views in dB.
    pub psnr_db: Option<f64>,
    /// Mean over the compared views, 1 is identical.
    pub ssim: Option<f64>,
    /// Mean over the compared views at 67 pixels per degree, 0 is identical.
    pub flip: Option<f64>,
    /// Mean over the compared views at the display's own pixels per degree.
    pub flip_at_view: Option<f64>,
    /// Mean change of the error of luma from one display frame to the next, 0..1; none where no pairs were compared.
    #[serde(default)]
    pub flicker: Option<f64>,
    /// Mean share of the truth's geometry that is missing.
    pub hole_fraction: Option<f64>,
    /// The same without holes along outlines that a shift by one pixel explains.
    pub hole_fraction_beyond_outlines: Option<f64>,
    /// PSNR of the worst compared view, in dB.
    pub psnr_db_worst: Option<f64>,
    /// Share of holes of the worst compared view.
    pub hole_fraction_worst: Option<f64>,
    /// The same over the pixels whose truth shows an animated instance.
    #[serde(default)]
    pub animated: RegionStats,
    /// The same over still surfaces on which a moving shadow falls, or has fallen within the last second.
    #[serde(default)]
    pub shadowed: RegionStats,
    /// Views whose figures are in the means: one for each eye of each dumped frame with enough geometry.
    pub frames_compared: u64,
    /// Views left out, because the truth shows geometry in less than 40 % of the picture.
    pub frames_too_empty: u64,
    /// Compared views that the client displayed without a bundle.
    pub frames_without_bundle: u64,
    /// Messages of the validation layers, warnings and errors; none where they are off.
    pub validation_messages: Option<u64>,
    /// Mean milliseconds per update that each GPU stage of the server took.
    pub gpu_ms: BTreeMap<String, f64>,
    /// Patches that were visible but had no room in the atlas or the client's memory, summed over all updates.
    #[serde(default)]
    pub dropped_patches: u64,
    /// Triangles that an update shows on average, those of two sides twice.
    #[serde(default)]
    pub triangles: f64,
    /// Level of detail of an instance in an update on average; 0 is full detail.
    #[serde(default)]
    pub mean_level: f64,
    /// Mean over updates of the texels that blocks are asked to have along a pixel of the display, before sides are rounded up.
    #[serde(default)]
    pub texels_per_pixel: f64,
    /// Part of the texels in blocks that updates did not shade again, 0 to 1.
    #[serde(default)]
    pub reused_share: f64,
    /// Blocks in the client's store at the end.
    #[serde(default)]
    pub stored_blocks: u32,
    /// Largest difference of the client's estimate of the server's clock from the truth at a display frame; null where both
    /// have one clock, and in real time, where nobody knows.
    #[serde(default)]
    pub clock_error_ms: Option<f64>,
    /// 99 of 100 display frames have no larger difference.
    #[serde(default)]
    pub clock_error_p99_ms: Option<f64>,
    /// How far the client itself knew at worst that its estimate could be off, without knowing the truth.
    #[serde(default)]
    pub clock_error_bound_ms: Option<f64>,
    /// Milliseconds that stages took in virtual time; null in real time.
    #[serde(default)]
    pub stage_ms: Option<StageMs>,
}

/// The picture figures of a part of the pixels, means over the compared views that have enough of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RegionStats {
    /// In dB.
    pub psnr_db: Option<f64>,
    /// 1 is identical.
    pub ssim: Option<f64>,
    /// At 67 pixels per degree, 0 is identical.
    pub flip: Option<f64>,
    /// Share of it that is missing.
    pub hole_fraction: Option<f64>,
    /// PSNR of the worst view, in dB.
    pub psnr_db_worst: Option<f64>,
    /// Its pixels as a share of all compared pixels.
    pub share: Option<f64>,
    /// Views that have enough of it.
    pub views: u64,
}

/// Why `stats.json` could not be written.
#[derive(Debug, Error)]
#[error("cannot write {path}: {reason}")]
pub struct WriteStatsError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong.
    pub reason: std::io::Error,
}

impl Stats {
    /// Writes the statistics as indented JSON.
    pub fn write_json(&self, path: &Path) -> Result<(), WriteStatsError> {
        let write = || {
            let mut json = serde_json::to_string_pretty(self)?;
            json.push('\n');
            shadecast_system::write_atomically(path, json.as_bytes())
        };
        write().map_err(|reason| WriteStatsError { path: path.into(), reason })
    }
}

/// Gathers the figures of displayed frames.
#[derive(Clone, Debug, Default)]
pub struct Summary {
    compared: Vec<(PictureMetrics, FrameMetrics)>,
    /// Of both eyes of the last frame.
    last: Vec<FrameMetrics>,
    too_empty: u64,
    /// Of eyes' pairs of frames.
    flicker: Vec<f64>,
}

impl Summary {
    /// Takes the figures of one eye's view of one displayed frame.
    pub fn add(&mut self, metrics: FrameMetrics) {
        if self.last.len() == 2 {
            self.last.clear();
        }
        self.last.push(metrics);
        match metrics.picture {
            Some(picture) => self.compared.push((picture, metrics)),
            None => self.too_empty += 1,
        }
    }

    /// Takes two consecutive frames: each is what the client showed by eye, and the truth.
    pub fn add_flicker(&mut self, before: &[[Rgb8Image; 2]; 2], now: &[[Rgb8Image; 2]; 2]) {
        for eye in 0..2 {
            let [before, now] = [before, now].map(|[client, truth]| [&client[eye], &truth[eye]]);
            self.flicker.push(flicker(before, now));
        }
    }

    /// The figures that were added last, of both eyes of a frame.
    pub fn last_two(&self) -> &[FrameMetrics] {
        &self.last
    }

    /// How many views count.
    pub fn frames_compared(&self) -> u64 {
        self.compared.len() as u64
    }

    /// Joins the figures of all frames with what was counted beside them.
    pub fn finish(&self, counted: Counted) -> Stats {
        let (clock_error_ms, clock_error_p99_ms) = worst_and_p99(counted.clock_errors_ms);
        let without_bundle = self.compared.iter().filter(|(_, frame)| !frame.has_bundle).count();
        Stats {
            device: counted.device,
            device_is_cpu: counted.device_is_cpu,
            renderer: counted.renderer,
            server_fps: counted.server_fps,
            client_fps: counted.client_fps,
            mbit_per_s: counted.mbit_per_s,
            bits_by_cause: counted.bits_by_cause,
            geometry_mbit_per_s: counted.geometry_mbit_per_s,
            bytes_per_animated_vertex_sample: counted.bytes_per_animated_vertex_sample,
            mean_qp: counted.mean_qp,
            psnr_db: self.mean(|picture, _| picture.psnr_db),
            ssim: self.mean(|picture, _| picture.ssim),
            flip: self.mean(|picture, _| picture.flip),
            flip_at_view: self.mean(|picture, _| picture.flip_at_view),
            hole_fraction: self.mean(|_, frame| frame.holes.strict),
            hole_fraction_beyond_outlines: self.mean(|_, frame| frame.holes.beyond_outlines),
            flicker: (!self.flicker.is_empty())
                .then(|| self.flicker.iter().sum::<f64>() / self.flicker.len() as f64),
            psnr_db_worst: self.values(|picture, _| picture.psnr_db).reduce(f64::min),
            hole_fraction_worst: self.values(|_, frame| frame.holes.strict).reduce(f64::max),
            animated: self.region(|frame| frame.animated),
            shadowed: self.region(|frame| frame.shadowed),
            frames_compared: self.frames_compared(),
            frames_too_empty: self.too_empty,
            frames_without_bundle: without_bundle as u64,
            validation_messages: counted.validation_messages,
            gpu_ms: counted.gpu_ms,
            dropped_patches: counted.dropped_patches,
            triangles: counted.triangles,
            mean_level: counted.mean_level,
            texels_per_pixel: counted.texels_per_pixel,
            reused_share: counted.reused_share,
            stored_blocks: counted.stored_blocks,
            clock_error_ms,
            clock_error_p99_ms,
            clock_error_bound_ms: counted.clock_error_bound_ms,
            stage_ms: counted.stage_ms,
        }
    }

    fn region(&self, of: fn(&FrameMetrics) -> RegionMetrics) -> RegionStats {
        let regions = || self.compared.iter().map(|(_, frame)| of(frame));
        let counted: Vec<(PictureMetrics, f64)> =
            regions().filter_map(|region| Some((region.picture?, region.holes.strict))).collect();
        let mean = |figure: fn(&(PictureMetrics, f64)) -> f64| {
            (!counted.is_empty()).then(|| counted.iter().map(figure).sum::<f64>() / counted.len() as f64)
        };
        let all: usize = self.compared.iter().map(|(_, frame)| frame.pixels).sum();
        RegionStats {
            psnr_db: mean(|(picture, _)| picture.psnr_db),
            ssim: mean(|(picture, _)| picture.ssim),
            flip: mean(|(picture, _)| picture.flip),
            hole_fraction: mean(|(_, holes)| *holes),
            psnr_db_worst: counted.iter().map(|(picture, _)| picture.psnr_db).reduce(f64::min),
            share: (all > 0)
                .then(|| regions().map(|region| region.pixels).sum::<usize>() as f64 / all as f64),
            views: counted.len() as u64,
        }
    }

    fn values(&self, figure: fn(&PictureMetrics, &FrameMetrics) -> f64) -> impl Iterator<Item = f64> {
        self.compared.iter().map(move |(picture, frame)| figure(picture, frame))
    }

    fn mean(&self, figure: fn(&PictureMetrics, &FrameMetrics) -> f64) -> Option<f64> {
        let count = self.compared.len();
        (count > 0).then(|| self.values(figure).sum::<f64>() / count as f64)
    }
}

fn worst_and_p99(mut errors: Vec<f64>) -> (Option<f64>, Option<f64>) {
    errors.iter_mut().for_each(|error| *error = error.abs());
    errors.sort_by(f64::total_cmp);
    let p99 = (errors.len() * 99).div_ceil(100).saturating_sub(1);
    (errors.last().copied(), errors.get(p99).copied())
}

/// The short summary that a run prints, one aligned line for each figure.
impl fmt::Display for Stats {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kind = if self.device_is_cpu { " (a CPU: rates say little)" } else { "" };
        line(f, "device", format_args!("{}{kind}", self.device))?;
        line(f, "renderer", format_args!("{}", self.renderer))?;
        line(f, "server", format_args!("{:.1} updates/s", self.server_fps))?;
        line(f, "client", format_args!("{:.1} frames/s", self.client_fps))?;
        let qp = self.mean_qp.map_or(String::new(), |qp| format!(", quantiser {qp:.1}"));
        line(f, "atlas", format_args!("{:.2} Mbit/s{qp}", self.mbit_per_s.atlas))?;
        if let Some(bits) = &self.bits_by_cause {
            line(f, "bits by cause", format_args!("{}", shares_in_words(bits)))?;
        }
        line(f, "geometry", format_args!("{:.2} Mbit/s{}", self.mbit_per_s.geometry, self.largest_parts()))?;
        let bytes = figure(self.bytes_per_animated_vertex_sample, 2, " bytes per vertex and sample");
        line(f, "animation", format_args!("{bytes}"))?;
        let worst = figure(self.psnr_db_worst, 1, " dB");
        line(f, "PSNR", format_args!("{} (worst {worst})", figure(self.psnr_db, 1, " dB")))?;
        line(f, "SSIM", format_args!("{}", figure(self.ssim, 4, "")))?;
        let at_view = figure(self.flip_at_view, 4, "");
        let flip = figure(self.flip, 4, "");
        line(f, "FLIP", format_args!("{flip} at 67 pixels per degree, {at_view} at the display's own"))?;
        if self.flicker.is_some() {
            line(f, "flicker", format_args!("{}", figure(self.flicker, 4, "")))?;
        }
        self.fmt_holes(f)?;
        self.fmt_region(f, "animated", &self.animated)?;
        self.fmt_region(f, "moving shadows", &self.shadowed)?;
        self.fmt_compared(f)?;
        let p99 = figure(self.clock_error_p99_ms, 2, " ms");
        let (worst, bound) =
            (figure(self.clock_error_ms, 2, " ms"), figure(self.clock_error_bound_ms, 2, " ms"));
        line(f, "clock error", format_args!("{worst} (99 %: {p99}; known to be below {bound})"))?;
        let (triangles, level) = (self.triangles, self.mean_level);
        let texels = self.texels_per_pixel;
        line(
            f,
            "detail",
            format_args!("{triangles:.0} triangles, mean level {level:.2}, {texels:.2} texels a pixel"),
        )?;
        let percent = 100.0 * self.reused_share;
        line(f, "reused", format_args!("{percent:.1} % of the texels in blocks were not shaded again"))?;
        if self.stored_blocks > 0 {
            line(f, "store", format_args!("{} blocks", self.stored_blocks))?;
        }
        line(f, "dropped patches", format_args!("{}", self.dropped_patches))?;
        line(f, "validation", format_args!("{}", messages_in_words(self.validation_messages)))?;
        let stages: Vec<_> = self.gpu_ms.iter().map(|(stage, ms)| format!("{stage} {ms:.1}")).collect();
        line(f, "GPU ms/update", format_args!("{}", stages.join(", ")))
    }
}

/// Parts of all bits, those that there are.
fn shares_in_words(bits: &CauseBits) -> String {
    let all = bits.total().max(1) as f64;
    let named = bits.named();
    let there = named.iter().filter(|(_, bits)| *bits > 0);
    let shares: Vec<String> =
        there.map(|(name, bits)| format!("{name} {:.1} %", 100.0 * *bits as f64 / all)).collect();
    shares.join(", ")
}

/// What the validation layers said; silence without them is no result.
fn messages_in_words(messages: Option<u64>) -> String {
    messages.map_or_else(|| "not checked".into(), |count| format!("{count} messages"))
}

/// Messages of the validation layers about both sides; `None` where one is not checked.
pub(crate) fn messages_of_both(server: &Gpu, client: &ClientStats) -> Option<u64> {
    let both = server.checked_messages().zip(client.validation_messages);
    both.map(|(server, client)| u64::from(server) + u64::from(client))
}

impl Stats {
    /// The parts of geometry that take more than a hundredth of it, the largest first, in parentheses.
    fn largest_parts(&self) -> String {
        let is_large = |(_, mbit): &(&String, &f64)| **mbit > 0.01 * self.mbit_per_s.geometry;
        let mut parts: Vec<_> = self.geometry_mbit_per_s.iter().filter(is_large).collect();
        parts.sort_by(|a, b| b.1.total_cmp(a.1));
        let parts: Vec<_> = parts.iter().map(|(part, mbit)| format!("{part} {mbit:.3}")).collect();
        if parts.is_empty() { String::new() } else { format!(" ({})", parts.join(", ")) }
    }

    /// The picture figures as a phrase.
    pub fn in_words(&self) -> String {
        let figures = |psnr_db, ssim, flip, holes: Option<f64>| {
            format!(
                "PSNR {}, SSIM {}, FLIP {}, holes {}",
                figure(psnr_db, 1, " dB"),
                figure(ssim, 4, ""),
                figure(flip, 3, ""),
                figure(holes.map(|fraction| 100.0 * fraction), 3, " %")
            )
        };
        let all = figures(self.psnr_db, self.ssim, self.flip, self.hole_fraction);
        let RegionStats { psnr_db, ssim, flip, hole_fraction, .. } = self.animated;
        match psnr_db {
            Some(_) => format!("Animated: {}. All: {all}", figures(psnr_db, ssim, flip, hole_fraction)),
            None => all,
        }
    }

    fn fmt_holes(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let percent = |fraction: Option<f64>| figure(fraction.map(|fraction| 100.0 * fraction), 3, " %");
        let beyond = percent(self.hole_fraction_beyond_outlines);
        let worst = percent(self.hole_fraction_worst);
        let holes = percent(self.hole_fraction);
        line(f, "holes", format_args!("{holes} of the geometry (worst {worst}; beyond outlines {beyond})"))
    }

    fn fmt_region(&self, f: &mut fmt::Formatter<'_>, name: &str, region: &RegionStats) -> fmt::Result {
        let percent = |fraction: Option<f64>| figure(fraction.map(|fraction| 100.0 * fraction), 3, " %");
        let (psnr, ssim) = (figure(region.psnr_db, 1, " dB"), figure(region.ssim, 4, ""));
        let (flip, holes, share) =
            (figure(region.flip, 4, ""), percent(region.hole_fraction), percent(region.share));
        line(f, name, format_args!("{psnr}, SSIM {ssim}, FLIP {flip}, holes {holes}; {share} of the pixels"))
    }

    fn fmt_compared(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (empty, bare) = (self.frames_too_empty, self.frames_without_bundle);
        let compared = self.frames_compared;
        line(
            f,
            "compared",
            format_args!("{compared} views ({bare} without a bundle; {empty} too empty, left out)"),
        )
    }
}

fn line(f: &mut fmt::Formatter<'_>, name: &str, value: fmt::Arguments<'_>) -> fmt::Result {
    writeln!(f, "  {name:<16}{value}")
}

fn figure(value: Option<f64>, decimals: usize, unit: &str) -> String {
    value.map_or_else(|| "not measured".to_owned(), |value| format!("{value:.decimals$}{unit}"))
}

#[cfg(test)]
mod tests;
