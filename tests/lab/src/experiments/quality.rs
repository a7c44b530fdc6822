//! `shadecast-lab quality`: the atlas beside a video of both eyes, at the same bit rate over the same links.
//!
//! A video has free settings: pictures a second, a margin, and whether it has depth. All that are asked for are run; the one with the least FLIP counts.

use super::run::run;
use crate::report::text_table::table;
use crate::session::options::{Head, Renderer, RunOptions};
use anyhow::Context;
use serde::Serialize;
use shadecast_scene::load::SceneSource;
use shadecast_server::pacing::quality::QualityOptions;
use shadecast_transport::LinkProfile;
use std::fmt;
use std::path::PathBuf;

/// Settings of a video.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Video {
    /// Pictures a second.
    pub rate_hz: f64,
    /// What pictures show beyond each side of an eye's field of view, degrees.
    pub margin_degrees: f32,
    /// Pictures have depth, by which they are shown to a head that moved.
    pub has_depth: bool,
}

/// Those that are tried unless others are asked for: each without depth and with it.
pub fn videos() -> Vec<Video> {
    let settings = [(30.0, 0.0), (30.0, 5.0), (30.0, 10.0), (30.0, 15.0), (72.0, 0.0), (72.0, 5.0)];
    let of =
        |has_depth| settings.map(|(rate_hz, margin_degrees)| Video { rate_hz, margin_degrees, has_depth });
    [false, true].into_iter().flat_map(of).collect()
}

/// Latencies of the links unless others are asked for, milliseconds one way.
pub const LATENCIES_MS: [f64; 5] = [5.0, 20.0, 50.0, 110.0, 200.0];
const MOST_JITTER_MS: f64 = 10.0;

/// A link of so much latency, as a run takes it: with a jitter of a half of it, and at most 10 ms.
pub fn link(latency_ms: f64) -> String {
    format!("latency={latency_ms}ms,jitter={}ms", (latency_ms / 2.0).min(MOST_JITTER_MS))
}

/// Small pictures, since there are a dozen ways: with as many bits a pixel as 730x730 have at 20 Mbit/s.
pub fn usual(scene: SceneSource, out: PathBuf) -> RunOptions {
    RunOptions {
        extent_pixels: [400; 2],
        head: Head::Named("stride".to_owned()),
        quality: QualityOptions::Bitrate(6.0),
        seconds: 3.0,
        compare_from: 110,
        truth_places: 2,
        ..RunOptions::new(scene, out)
    }
}

/// What a way showed over a link.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// Its settings, where it is a video; the atlas otherwise.
    pub video: Option<Video>,
    /// What repeats the run.
    pub command: String,
    /// Bits that were sent, pictures and all else.
    pub mbit_per_s: f64,
    /// Mean quantiser.
    pub qp: Option<f64>,
    /// Mean over all compared views, 0..1.
    pub flip: f64,
    /// The worst view's.
    pub flip_worst: f64,
    /// At the display's own pixels per degree.
    pub flip_at_view: f64,
    /// Decibels, mean and of the worst view.
    pub psnr_db: [f64; 2],
    /// Mean.
    pub ssim: f64,
    /// Mean change of the error of luma from one display frame to the next, 0..1.
    pub flicker: Option<f64>,
    /// Of what is animated, where there is enough of it.
    pub animated_flip: Option<f64>,
}

/// All ways over a link.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct OverLink {
    /// As a run takes it.
    pub link: String,
    /// The atlas.
    pub ours: Row,
    /// Videos, the least FLIP first.
    pub videos: Vec<Row>,
    /// FLIP of the atlas over that of the best video.
    pub flip_ratio: f64,
}

/// A scene over all its links.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Quality {
    /// As a person calls it.
    pub scene: String,
    /// By link, in the order that was asked for.
    pub links: Vec<OverLink>,
}

/// Runs `options` as the atlas and as each of `videos` over each link. To be called where [`run`] may be.
///
/// # Errors
/// A run fails, or compares nothing.
pub fn measure(
    options: &RunOptions,
    scene: &str,
    links: &[String],
    videos: &[Video],
) -> anyhow::Result<Quality> {
    let over = |link: &String| -> anyhow::Result<OverLink> {
        let profile: LinkProfile = link.parse()?;
        let options = RunOptions { link: profile.into(), ..options.clone() };
        let ours = row(&options, scene, link, None)?;
        let mut videos = videos
            .iter()
            .map(|video| row(&options, scene, link, Some(*video)))
            .collect::<anyhow::Result<Vec<_>>>()?;
        videos.sort_by(|a, b| a.flip.total_cmp(&b.flip));
        let best = videos.first().context("there is a video to compare with")?;
        Ok(OverLink { link: link.clone(), flip_ratio: ours.flip / best.flip, ours, videos })
    };
    Ok(Quality { scene: scene.to_owned(), links: links.iter().map(over).collect::<anyhow::Result<_>>()? })
}

fn row(options: &RunOptions, scene: &str, link: &str, video: Option<Video>) -> anyhow::Result<Row> {
    let mut options = RunOptions { renderer: Renderer::Stream, compare_pairs: true, ..options.clone() };
    if let Some(Video { rate_hz, margin_degrees, has_depth }) = video {
        options = RunOptions {
            renderer: Renderer::Video,
            rate_hz,
            video_margin_degrees: margin_degrees,
            video_has_depth: has_depth,
            ..options
        };
    }
    let report = run(&options)?;
    let stats = report.stats;
    let compared = || format!("{scene} over {link}: no view was compared");
    Ok(Row {
        video,
        command: format!("{} --link {link}", options.command_line(scene)),
        mbit_per_s: stats.mbit_per_s.atlas + stats.mbit_per_s.geometry,
        qp: stats.mean_qp,
        flip: stats.flip.with_context(compared)?,
        flip_worst: report.looks.iter().filter_map(|look| look.flip).fold(0.0, f64::max),
        flip_at_view: stats.flip_at_view.with_context(compared)?,
        psnr_db: [stats.psnr_db.with_context(compared)?, stats.psnr_db_worst.with_context(compared)?],
        ssim: stats.ssim.with_context(compared)?,
        flicker: stats.flicker,
        animated_flip: stats.animated.flip,
    })
}

impl Row {
    fn cells(&self) -> [String; 9] {
        let name = match self.video {
            Some(Video { rate_hz, margin_degrees, has_depth }) => {
                let depth = if has_depth { ", depth" } else { "" };
                format!("video, {rate_hz:.0} Hz, {margin_degrees:.0} degrees{depth}")
            }
            None => "atlas".to_owned(),
        };
        [
            name,
            format!("{:.2}", self.mbit_per_s),
            self.qp.map_or_else(|| "-".to_owned(), |qp| format!("{qp:.1}")),
            format!("{:.4}", self.flip),
            format!("{:.4}", self.flip_worst),
            format!("{:.1}, {:.1} dB", self.psnr_db[0], self.psnr_db[1]),
            format!("{:.4}", self.ssim),
            self.flicker.map_or_else(|| "-".to_owned(), |flicker| format!("{flicker:.4}")),
            self.animated_flip.map_or_else(|| "-".to_owned(), |flip| format!("{flip:.4}")),
        ]
    }
}

impl fmt::Display for Quality {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const HEADS: [&str; 9] = [
            "",
            "Mbit/s",
            "quantiser",
            "FLIP",
            "worst",
            "PSNR, worst",
            "SSIM",
            "flicker",
            "FLIP of animated",
        ];
        for OverLink { link, ours, videos, flip_ratio } in &self.links {
            writeln!(f, "{} over {link}: FLIP is {flip_ratio:.2} of the best video's", self.scene)?;
            let rows = std::iter::once(ours).chain(videos).map(Row::cells);
            writeln!(f, "{}", table(HEADS, rows))?;
        }
        Ok(())
    }
}
