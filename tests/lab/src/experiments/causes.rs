//! `shadecast-lab causes`: the cost of each cause of error. A shipped run is repeated once without each cause, with the same
//! head, display frames and truth. The cost of a cause is the run's gain by its absence.

use super::run::{Report, run};
use crate::report::stats::{RegionStats, Stats};
use crate::report::text_table::table;
use crate::session::options::{RunOptions, Spared, StageMs};
use crate::session::originals::Arrival;
use anyhow::Context;
use serde::{Deserialize, Serialize};
use shadecast_client::draw::stages::atlas_draw::Reconstruction;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use shadecast_server::scene::SceneOptions;
use shadecast_server::shading::filter::Filter;
use shadecast_server::update::policy::UpdatePolicy;
use shadecast_transport::LinkProfile;
use std::fmt;
use std::path::PathBuf;

/// What can be wrong with a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Cause {
    /// Blocks have about a texel for a pixel.
    Density,
    /// A texel is shaded at one place, its middle.
    Filter,
    /// Colours between texels lie on straight lines.
    Reconstruction,
    /// Surfaces and shadows are shaded for a time on the grid near the one at which they are seen.
    ShadowTime,
    /// The shadow map's texels.
    ShadowResolution,
    /// Outlines are where other triangles' pixels begin.
    Outlines,
    /// Four texels share a hue.
    Chroma,
    /// The codec.
    Quantisation,
    /// Pictures are of an earlier time, for a head that was expected elsewhere.
    Delay,
    /// The two clocks are not known to be equal to the last bit.
    Jitter,
    /// What is far has fewer triangles.
    LevelsOfDetail,
}

/// All of them, in the order in which they are measured.
pub const CAUSES: [Cause; 11] = [
    Cause::Density,
    Cause::Filter,
    Cause::Reconstruction,
    Cause::ShadowTime,
    Cause::ShadowResolution,
    Cause::Outlines,
    Cause::Chroma,
    Cause::Quantisation,
    Cause::Delay,
    Cause::Jitter,
    Cause::LevelsOfDetail,
];

/// Display frames from one that is compared to the next: of 72 a second, in every phase of 30 updates.
const COMPARE_EVERY: u32 = 5;
/// The first display frame that is compared, at 72 a second: detail, texels and bits have settled.
const COMPARE_FROM: u64 = 72;
/// Virtual seconds of each run, unless told otherwise.
pub const SECONDS: f64 = 2.0;
/// Texels for a pixel where density is no cause.
const DENSE: f32 = 2.0;
/// One way of a link that is as good as none, nanoseconds.
const NO_WAY_NS: i64 = 100_000;

impl Cause {
    /// What is done in its absence, for who reads the table.
    pub fn without(self) -> &'static str {
        match self {
            Self::Density => "two texels a pixel instead of one, in an atlas of 4096x2048",
            Self::Filter => "16 samples of each texel",
            Self::Reconstruction => "luma between texels by a cubic instead of lines",
            Self::ShadowTime => "surfaces and shadows shaded for the very time of display",
            Self::ShadowResolution => "a shadow map of twice the side, in atlas and truth",
            Self::Outlines => "pixels at outlines and holes taken from the truth",
            Self::Chroma => "a hue for each texel instead of every fourth (beside: uncoded)",
            Self::Quantisation => "the atlas uncoded, at the same times",
            Self::Delay => "no latency, no stage takes time",
            Self::LevelsOfDetail => "everything in full detail",
            Self::Jitter => "a link whose ways are always as long: the clock is exact",
        }
    }

    /// What it is measured beside: chroma has to be measured without the codec, which has no other.
    fn beside(self) -> Option<Self> {
        (self == Self::Chroma).then_some(Self::Quantisation)
    }

    /// The run without it, by the run with it, which `shipped` tells of.
    fn leave_out(self, run: &RunOptions, shipped: &Report) -> RunOptions {
        let spared = |spared: Spared| RunOptions { spared, ..run.clone() };
        let arrival = |arrival| spared(Spared { arrival, ..Spared::default() });
        let policy = |policy| spared(Spared { policy, ..Spared::default() });
        match self {
            Self::Density => RunOptions {
                atlas_extent_texels: AtlasExtent::MAX,
                ..policy(UpdatePolicy { texels_per_pixel: DENSE, ..UpdatePolicy::default() })
            },
            Self::Filter => policy(UpdatePolicy { filter: Filter::Supersampled, ..UpdatePolicy::default() }),
            Self::Reconstruction => RunOptions { reconstruction: Reconstruction::Bicubic, ..run.clone() },
            Self::ShadowTime => {
                let shading_times = shipped.compared.iter().copied().collect();
                let exact = policy(UpdatePolicy { shading_times, ..UpdatePolicy::default() });
                RunOptions { blends: false, ..exact } // what is shaded for its frame is not mixed
            }
            Self::ShadowResolution => RunOptions {
                scene_options: SceneOptions { shadow_doublings: 1, ..run.scene_options },
                ..run.clone()
            },
            Self::LevelsOfDetail => RunOptions { detail_pixels: 0.0, ..run.clone() },
            Self::Outlines => spared(Spared { outlines: true, ..Spared::default() }),
            Self::Chroma => arrival(Arrival::FullChroma),
            Self::Quantisation => arrival(Arrival::Uncoded),
            Self::Jitter => RunOptions {
                link: LinkProfile { jitter_ns: 0, ..run.link.at(0).clone() }.into(),
                ..run.clone()
            },
            Self::Delay => RunOptions {
                link: LinkProfile { latency_ns: NO_WAY_NS, ..LinkProfile::default() }.into(),
                stages: StageMs { server: 0.0, encode: 0.0, decode: 0.0, steps: None },
                ..run.clone()
            },
        }
    }
}

impl fmt::Display for Cause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Density => "texel density",
            Self::Filter => "filter",
            Self::Reconstruction => "reconstruction",
            Self::ShadowTime => "shadow time",
            Self::ShadowResolution => "shadow resolution",
            Self::Outlines => "outlines",
            Self::Chroma => "chroma",
            Self::Quantisation => "quantisation",
            Self::Delay => "delay",
            Self::Jitter => "jitter",
            Self::LevelsOfDetail => "levels of detail",
        })
    }
}

/// Which pixels a figure is of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mask {
    /// All that show geometry.
    All,
    /// Those that show what moves.
    Animated,
    /// Still surfaces on which a moving shadow falls, or has just fallen.
    Shadowed,
}

const MASKS: [Mask; 3] = [Mask::All, Mask::Animated, Mask::Shadowed];

/// How close pictures are to the truth over a mask, means over all that were compared.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// In dB.
    pub psnr_db: f64,
    /// 1 is identical.
    pub ssim: f64,
    /// 0 is identical.
    pub flip: f64,
}

/// The figures of the run as it ships over one mask.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Shipped {
    /// Which pixels.
    pub mask: Mask,
    /// The figures.
    #[serde(flatten)]
    pub figures: Figures,
}

/// One cause over one mask.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// What the run is without.
    pub cause: Cause,
    /// What else both runs are without.
    pub beside: Option<Cause>,
    /// Which pixels.
    pub mask: Mask,
    /// The run without the cause.
    #[serde(flatten)]
    pub figures: Figures,
    /// What that run gains, dB.
    pub psnr_gain_db: f64,
    /// What it gains.
    pub ssim_gain: f64,
    /// By how much its FLIP is lower.
    pub flip_gain: f64,
}

/// The table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Causes {
    /// The scene as a person calls it.
    pub scene: String,
    /// Pixels per eye.
    pub extent_pixels: [u32; 2],
    /// Virtual seconds of each run.
    pub seconds: f64,
    /// Views compared in each run: two to a display frame.
    pub views: u64,
    /// The device.
    pub device: String,
    /// The run as it ships.
    pub shipped: Vec<Shipped>,
    /// By mask, then the largest loss in FLIP first.
    pub rows: Vec<Row>,
}

/// The run as it ships, unless told otherwise.
pub fn usual(scene: SceneSource, out: PathBuf) -> RunOptions {
    RunOptions {
        seconds: SECONDS,
        extent_pixels: [256, 256],
        compare_every: COMPARE_EVERY,
        compare_from: COMPARE_FROM,
        ..RunOptions::new(scene, out)
    }
}

/// Measures `causes` in a run of `options`; `scene` is the scene as a person calls it. To be called where [`run`] may be.
///
/// # Errors
/// Anything that keeps a run from going on.
pub fn measure(options: &RunOptions, scene: &str, causes: &[Cause]) -> anyhow::Result<Causes> {
    let shipped = run(options).context("the run as it ships")?;
    let mut runs: Vec<(Cause, Report)> = Vec::new();
    let needed = causes.iter().flat_map(|cause| [cause.beside(), Some(*cause)]).flatten();
    for cause in needed {
        if runs.iter().all(|(done, _)| *done != cause) {
            let without = run(&cause.leave_out(options, &shipped)).with_context(|| format!("{cause}"))?;
            runs.push((cause, without));
        }
    }
    let report = |cause: Option<Cause>| {
        cause.and_then(|cause| runs.iter().find(|(done, _)| *done == cause)).map_or(&shipped, |(_, r)| r)
    };
    let mut rows = Vec::new();
    for mask in MASKS {
        let of_mask = causes.iter().filter_map(|cause| {
            let (with, without) = (report(cause.beside()), report(Some(*cause)));
            Some(row(*cause, mask, figures(&with.stats, mask)?, figures(&without.stats, mask)?))
        });
        let mut of_mask: Vec<Row> = of_mask.collect();
        of_mask.sort_by(|a, b| b.flip_gain.total_cmp(&a.flip_gain));
        rows.append(&mut of_mask);
    }
    let of_shipped = |mask| Some(Shipped { mask, figures: figures(&shipped.stats, mask)? });
    Ok(Causes {
        scene: scene.to_owned(),
        extent_pixels: options.extent_pixels,
        seconds: options.seconds,
        views: shipped.stats.frames_compared,
        device: shipped.stats.device.clone(),
        shipped: MASKS.into_iter().filter_map(of_shipped).collect(),
        rows,
    })
}

fn row(cause: Cause, mask: Mask, with: Figures, without: Figures) -> Row {
    Row {
        cause,
        beside: cause.beside(),
        mask,
        figures: without,
        psnr_gain_db: without.psnr_db - with.psnr_db,
        ssim_gain: without.ssim - with.ssim,
        flip_gain: with.flip - without.flip,
    }
}

/// `None` where no picture shows enough of the mask.
fn figures(stats: &Stats, mask: Mask) -> Option<Figures> {
    let of = |psnr_db: Option<f64>, ssim: Option<f64>, flip: Option<f64>| {
        Some(Figures { psnr_db: psnr_db?, ssim: ssim?, flip: flip? })
    };
    let of_region = |region: &RegionStats| of(region.psnr_db, region.ssim, region.flip);
    match mask {
        Mask::All => of(stats.psnr_db, stats.ssim, stats.flip),
        Mask::Animated => of_region(&stats.animated),
        Mask::Shadowed => of_region(&stats.shadowed),
    }
}

impl Mask {
    fn in_words(self) -> &'static str {
        match self {
            Self::All => "all that shows geometry",
            Self::Animated => "what moves",
            Self::Shadowed => "still surfaces under moving shadows",
        }
    }
}

impl fmt::Display for Causes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [width, height] = self.extent_pixels;
        writeln!(
            f,
            "{}, {width}x{height} pixels an eye, {} views of {} s.",
            self.scene, self.views, self.seconds
        )?;
        writeln!(f, "What each cause costs: what the run gains without it, the largest first by FLIP.")?;
        for shipped in &self.shipped {
            let Figures { psnr_db, ssim, flip } = shipped.figures;
            writeln!(
                f,
                "\nOf {}; as it ships {psnr_db:.2} dB, SSIM {ssim:.4}, FLIP {flip:.4}",
                shipped.mask.in_words()
            )?;
            let rows = self.rows.iter().filter(|row| row.mask == shipped.mask).map(|row| {
                [
                    row.cause.to_string(),
                    format!("{:+.2}", row.psnr_gain_db),
                    format!("{:+.4}", row.ssim_gain),
                    format!("{:+.4}", -row.flip_gain),
                    row.cause.without().to_owned(),
                ]
            });
            f.write_str(&table(["cause", "PSNR dB", "SSIM", "FLIP", "without it"], rows))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn figures_of(psnr_db: f64, flip: f64) -> Figures {
        Figures { psnr_db, ssim: 0.9, flip }
    }

    #[test]
    fn a_gain_is_positive_for_a_better_picture() {
        let found = row(Cause::Chroma, Mask::All, figures_of(30.0, 0.05), figures_of(31.5, 0.03));
        assert_eq!((found.psnr_gain_db, found.ssim_gain), (1.5, 0.0));
        assert!((found.flip_gain - 0.02).abs() < 1e-12);
        assert_eq!(found.beside, Some(Cause::Quantisation));
    }
}
