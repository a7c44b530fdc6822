//! `shadecast-lab quality`: the atlas beside a video of both eyes, at the same bit rate over the same links.
//!
//! Enters: a run's options, links, and which videos. Leaves: a row a method. A video has free settings: pictures a second, a margin,
//! and whether it has depth. They are searched one after the other, or all of them are run; the least FLIP counts.

use super::run::run;
use crate::report::text_table::table;
use crate::session::options::{Head, Renderer, RunOptions};
use anyhow::Context;
use serde::{Deserialize, Serialize};
use shadecast_scene::animation::sampling::{DEFAULT_INTERVAL_S, Sampling};
use shadecast_scene::load::SceneSource;
use shadecast_server::pacing::quality::QualityOptions;
use shadecast_server::scene::SceneOptions;
use shadecast_server::scene::motion_library::MotionOption;
use shadecast_server::scene::skins::Skinning;
use shadecast_transport::LinkProfile;
use std::fmt;
use std::path::PathBuf;

/// Settings of a video.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Video {
    /// Pictures a second.
    pub rate_hz: f64,
    /// What pictures show beyond each side of an eye's field of view, degrees.
    pub margin_degrees: f32,
    /// Pictures have depth, by which they are shown to a head that moved.
    pub has_depth: bool,
}

/// Margins of videos, degrees.
const MARGINS_DEGREES: [f32; 4] = [0.0, 5.0, 10.0, 15.0];
/// The margin that a search begins with, by its number.
const FIRST_MARGIN: usize = 2;
const USUAL_HZ: f64 = 30.0;
const FAST_HZ: f64 = 72.0;

/// All that may be run at once: each without depth and with it.
pub fn videos() -> Vec<Video> {
    let usual = MARGINS_DEGREES.map(|margin_degrees| (USUAL_HZ, margin_degrees));
    let fast = [0, 1].map(|number| (FAST_HZ, MARGINS_DEGREES[number]));
    let settings = [usual.as_slice(), &fast].concat();
    let with = |has_depth| {
        let video = move |&(rate_hz, margin_degrees): &_| Video { rate_hz, margin_degrees, has_depth };
        settings.iter().map(video).collect::<Vec<_>>()
    };
    [with(false), with(true)].concat()
}

/// Runs videos until no setting can be changed for the better: the margin in steps from 10 degrees, with depth at 30 Hz; then the best
/// without depth, and at 72 Hz. All that were run, the least FLIP first.
fn search(mut run: impl FnMut(Video) -> anyhow::Result<Row>) -> anyhow::Result<Vec<Row>> {
    let mut rows = Vec::new();
    let mut flip = |video: Video| -> anyhow::Result<f64> {
        let row = run(video)?;
        let flip = row.flip;
        rows.push(row);
        Ok(flip)
    };
    let with =
        |margin: usize| Video { rate_hz: USUAL_HZ, margin_degrees: MARGINS_DEGREES[margin], has_depth: true };
    let (mut best, mut least) = (FIRST_MARGIN, flip(with(FIRST_MARGIN))?);
    // Wider, and where that is worse narrower.
    let wider: Vec<usize> = (FIRST_MARGIN + 1..MARGINS_DEGREES.len()).collect();
    let narrower: Vec<usize> = (0..FIRST_MARGIN).rev().collect();
    for way in [wider, narrower] {
        for margin in way {
            let found = flip(with(margin))?;
            if found >= least {
                break;
            }
            (best, least) = (margin, found);
        }
        if best != FIRST_MARGIN {
            break;
        }
    }
    flip(Video { has_depth: false, ..with(best) })?;
    flip(Video { rate_hz: FAST_HZ, ..with(best) })?;
    rows.sort_by(|a, b| a.flip.total_cmp(&b.flip));
    Ok(rows)
}

/// What a row shows.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// The atlas as it ships.
    Atlas,
    /// Its updates are made for where the head was, and for the world at their begin.
    AtlasWithoutPrediction,
    /// Three predicted positions a vertex with every update, on lines between them; constant samples of clips, skinned by chains;
    /// each update is shaded whole, nothing is kept in a store, nothing blends.
    AtlasAsPaper,
    /// A video of both eyes.
    Video(Video),
}

impl Method {
    /// What the atlas is compared with beside videos.
    pub const OTHERS: [Self; 2] = [Self::AtlasWithoutPrediction, Self::AtlasAsPaper];

    /// A run's options, changed to this.
    fn of(self, options: RunOptions) -> RunOptions {
        let mut options = RunOptions { renderer: Renderer::Stream, compare_pairs: true, ..options };
        match self {
            Self::Atlas => options,
            Self::AtlasWithoutPrediction => {
                options.spared.policy.predicts = false;
                options
            }
            Self::AtlasAsPaper => {
                options.spared.policy.reuse = false;
                let scene_options = SceneOptions {
                    sampling: Sampling::Constant { interval_s: DEFAULT_INTERVAL_S },
                    skinning: Skinning::PerVertexChain,
                    motion: MotionOption::Paper,
                    ..options.scene_options
                };
                RunOptions { scene_options, store_pages: 0, blends: false, ..options }
            }
            Self::Video(Video { rate_hz, margin_degrees, has_depth }) => RunOptions {
                renderer: Renderer::Video,
                rate_hz,
                video_margin_degrees: margin_degrees,
                video_has_depth: has_depth,
                ..options
            },
        }
    }
}

impl fmt::Display for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Atlas => f.pad("atlas"),
            Self::AtlasWithoutPrediction => f.pad("atlas without prediction"),
            Self::AtlasAsPaper => f.pad("atlas as in the paper"),
            Self::Video(Video { rate_hz, margin_degrees, has_depth }) => {
                let depth = if *has_depth { ", depth" } else { "" };
                f.pad(&format!("video, {rate_hz:.0} Hz, {margin_degrees:.0} degrees{depth}"))
            }
        }
    }
}

/// Latencies of the links unless others are asked for, milliseconds one way.
pub const LATENCIES_MS: [f64; 5] = [5.0, 20.0, 50.0, 110.0, 200.0];
const MOST_JITTER_MS: f64 = 10.0;

/// A link of so much latency, as a run takes it: with a jitter of a half of it, and at most 10 ms.
pub fn link(latency_ms: f64, lost_percent: f64) -> String {
    let lost = if lost_percent > 0.0 { format!(",loss={lost_percent}%") } else { String::new() };
    format!("latency={latency_ms}ms,jitter={}ms{lost}", (latency_ms / 2.0).min(MOST_JITTER_MS))
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

/// What a method showed over a link.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Which.
    pub method: Method,
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
    /// Part of the views that shows nothing though something is there; a video has none.
    pub hole_fraction: Option<f64>,
    /// Mean change of the error of luma from one display frame to the next, 0..1.
    pub flicker: Option<f64>,
    /// Of what is animated, where there is enough of it.
    pub animated_flip: Option<f64>,
}

/// All methods over a link.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OverLink {
    /// As a run takes it.
    pub link: String,
    /// The atlas.
    pub ours: Row,
    /// The atlas without what it has beyond the paper, where that was asked for.
    pub others: Vec<Row>,
    /// Videos, the least FLIP first.
    pub videos: Vec<Row>,
    /// FLIP of the atlas over that of the best video.
    pub flip_ratio: f64,
}

/// A scene over all its links.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// As a person calls it.
    pub scene: String,
    /// Where the head goes.
    pub head: String,
    /// By link, in the order that was asked for.
    pub links: Vec<OverLink>,
}

/// What is compared with the atlas.
#[derive(Clone, Debug, PartialEq)]
pub struct Compared {
    /// Beside videos.
    pub others: Vec<Method>,
    /// These videos; a search where there are none.
    pub videos: Vec<Video>,
}

impl Compared {
    /// The best video, and nothing else.
    pub fn with_videos_alone() -> Self {
        Self { others: Vec::new(), videos: Vec::new() }
    }
}

impl Default for Compared {
    fn default() -> Self {
        Self { others: Method::OTHERS.to_vec(), videos: Vec::new() }
    }
}

/// Runs `options` as the atlas and as all that it is compared with over each link. To be called where [`run`] may be.
///
/// # Errors
/// A run fails, or compares nothing.
pub fn measure(
    options: &RunOptions,
    scene: &str,
    links: &[String],
    compared: &Compared,
) -> anyhow::Result<Quality> {
    let over = |link: &String| -> anyhow::Result<OverLink> {
        let profile: LinkProfile = link.parse()?;
        let options = RunOptions { link: profile.into(), ..options.clone() };
        let of = |method| row(&options, scene, link, method);
        let ours = of(Method::Atlas)?;
        let mut videos = match compared.videos.as_slice() {
            [] => search(|video| of(Method::Video(video)))?,
            videos => videos.iter().map(|video| of(Method::Video(*video))).collect::<anyhow::Result<_>>()?,
        };
        videos.sort_by(|a, b| a.flip.total_cmp(&b.flip));
        let others = compared.others.iter().map(|method| of(*method)).collect::<anyhow::Result<_>>()?;
        let best = videos.first().context("there is a video to compare with")?;
        Ok(OverLink { link: link.clone(), flip_ratio: ours.flip / best.flip, ours, others, videos })
    };
    let head = match &options.head {
        Head::Walk => "a few steps".to_owned(),
        Head::File(path) => path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        Head::Named(name) => name.clone(),
    };
    let links = links.iter().map(over).collect::<anyhow::Result<_>>()?;
    Ok(Quality { scene: scene.to_owned(), head, links })
}

fn row(options: &RunOptions, scene: &str, link: &str, method: Method) -> anyhow::Result<Row> {
    let options = method.of(options.clone());
    let report = run(&options)?;
    let stats = report.stats;
    let compared = || format!("{scene} over {link}: no view was compared");
    Ok(Row {
        method,
        command: format!("{} --link {link}", options.command_line(scene)),
        mbit_per_s: stats.mbit_per_s.atlas + stats.mbit_per_s.geometry,
        qp: stats.mean_qp,
        flip: stats.flip.with_context(compared)?,
        flip_worst: report.looks.iter().filter_map(|look| look.flip).fold(0.0, f64::max),
        flip_at_view: stats.flip_at_view.with_context(compared)?,
        psnr_db: [stats.psnr_db.with_context(compared)?, stats.psnr_db_worst.with_context(compared)?],
        ssim: stats.ssim.with_context(compared)?,
        hole_fraction: stats.hole_fraction,
        flicker: stats.flicker,
        animated_flip: stats.animated.flip,
    })
}

impl Row {
    fn cells(&self) -> [String; 9] {
        [
            self.method.to_string(),
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
        for OverLink { link, ours, others, videos, flip_ratio } in &self.links {
            writeln!(
                f,
                "{}, {}, over {link}: FLIP is {flip_ratio:.2} of the best video's",
                self.scene, self.head
            )?;
            let rows = std::iter::once(ours).chain(others).chain(videos).map(Row::cells);
            writeln!(f, "{}", table(HEADS, rows))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(video: Video, flip: f64) -> Row {
        Row {
            method: Method::Video(video),
            command: String::new(),
            mbit_per_s: 6.0,
            qp: None,
            flip,
            flip_worst: flip,
            flip_at_view: flip,
            psnr_db: [30.0, 29.0],
            ssim: 0.9,
            hole_fraction: None,
            flicker: None,
            animated_flip: None,
        }
    }

    #[test]
    fn a_search_finds_the_margin_with_the_least_error_then_tries_depth_and_rate() {
        for best in MARGINS_DEGREES {
            let mut runs = Vec::new();
            let found = search(|video| {
                runs.push(video);
                let worse = 0.01 * f64::from((video.margin_degrees - best).abs());
                let worse = worse + if video.has_depth { 0.0 } else { 0.02 };
                Ok(row(video, 0.1 + worse + if video.rate_hz > USUAL_HZ { 0.01 } else { 0.0 }))
            })
            .expect("found");
            let first = Video { rate_hz: USUAL_HZ, margin_degrees: best, has_depth: true };
            assert_eq!(found[0].method, Method::Video(first));
            assert!(runs.contains(&Video { has_depth: false, ..first }), "{runs:?}");
            assert!(runs.contains(&Video { rate_hz: FAST_HZ, ..first }), "{runs:?}");
            assert!(runs.len() <= 6 && runs.len() == found.len(), "{runs:?}");
        }
    }

    #[test]
    fn a_fast_video_without_depth_counts_where_it_is_best() {
        let flip = |video: Video| 0.1 - if video.has_depth { 0.0 } else { 0.02 };
        let found = search(|video| Ok(row(video, flip(video)))).expect("found");
        assert!(matches!(found[0].method, Method::Video(Video { has_depth: false, .. })));
        assert!(search(|_| anyhow::bail!("a device is lost")).is_err());
    }

    #[test]
    fn what_was_measured_is_read_again() {
        let video = Video { rate_hz: USUAL_HZ, margin_degrees: 5.0, has_depth: true };
        let row = row(video, 0.1);
        let link = OverLink {
            link: link(20.0, 0.0),
            ours: Row { method: Method::Atlas, ..row.clone() },
            others: vec![Row { method: Method::AtlasAsPaper, ..row.clone() }],
            videos: vec![row],
            flip_ratio: 1.0,
        };
        let found = Quality { scene: "dragons:9".into(), head: "stride".into(), links: vec![link] };
        let text = serde_json::to_string(&found).expect("written");
        assert_eq!(serde_json::from_str::<Quality>(&text).expect("read"), found);
        assert!(found.to_string().contains("atlas as in the paper"), "{found}");
    }
}
