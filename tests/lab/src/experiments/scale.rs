//! `shadecast-lab scale`: how device time and bytes grow with what there is: triangles, instances, joints, animated vertices, texels of
//! the atlas, pixels of a view, viewers.
//!
//! Axes enter. A row a value leaves, and by axis the exponent that fits best. Each axis changes one thing; the rest stays as it is.

use super::costs::{Cost, cost};
use super::run::mock_config;
use crate::measure::fit::exponent;
use crate::report::text_table::table;
use crate::scenes::sheets::{Sheets, write_sheets};
use crate::session::options::{RunOptions, USUAL_LINK, ViewerOptions};
use anyhow::Context;
use serde::{Deserialize, Serialize};
use shadecast_mock_runtime::config::ClockKind;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use shadecast_server::pacing::quality::{DEFAULT_QP, QualityOptions};
use std::fmt;
use std::path::Path;

/// Seconds of a run, and those before anything is measured.
const SECONDS: f64 = 1.5;
const SETTLING_S: f64 = 0.5;
/// What stays as it is on the other axes.
const USUAL_PIXELS: u32 = 256;
const USUAL_QUADS: u32 = 96;
const USUAL_JOINTS: u32 = 16;

/// What grows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Axis {
    /// Of one still instance
    Triangles,
    /// With as many triangles together
    Instances,
    /// Of one instance with as many vertices
    Joints,
    /// Of one instance with as many joints
    AnimatedVertices,
    /// Texels of the atlas
    Atlas,
    /// Pixels of both eyes
    Views,
    /// Of one world
    Viewers,
}

impl Axis {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::Triangles,
        Self::Instances,
        Self::Joints,
        Self::AnimatedVertices,
        Self::Atlas,
        Self::Views,
        Self::Viewers,
    ];

    /// As a person calls it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Triangles => "triangles",
            Self::Instances => "instances",
            Self::Joints => "joints",
            Self::AnimatedVertices => "animated vertices",
            Self::Atlas => "texels of the atlas",
            Self::Views => "pixels of both eyes",
            Self::Viewers => "viewers",
        }
    }

    /// Runs of so much each, the least first.
    fn runs(self) -> Vec<Point> {
        let still = |count, quads| Point::of(Sheets { count, quads, joints: 0 });
        let moving = |quads, joints| Point::of(Sheets { count: 1, quads, joints });
        match self {
            Self::Triangles => [32, 64, 128, 250].map(|quads| still(1, quads).at(2 * quads * quads)).into(),
            Self::Instances => [1, 4, 16, 64].map(|root| still(root, 128 / root.isqrt()).at(root)).into(),
            Self::Joints => [4, 16, 64, 240].map(|joints| moving(USUAL_QUADS, joints).at(joints)).into(),
            Self::AnimatedVertices => [24, 48, 96, 192]
                .map(|quads| moving(quads, USUAL_JOINTS).at((quads + 1) * (quads + 1)))
                .into(),
            Self::Atlas => [[1024, 1024], [2048, 1024], [2048, 2048], [4096, 2048]]
                .map(|atlas| Point { atlas, ..still(1, USUAL_QUADS) }.at(atlas[0] * atlas[1]))
                .into(),
            Self::Views => [128, 256, 512, 1024]
                .map(|pixels| Point { pixels, ..still(1, USUAL_QUADS) }.at(2 * pixels * pixels))
                .into(),
            // More that come at once, and have said nothing yet, are turned away.
            Self::Viewers => [1, 2, 3, 4]
                .map(|viewers| Point { viewers, ..moving(USUAL_QUADS, USUAL_JOINTS) }.at(viewers))
                .into(),
        }
    }
}

/// One run.
#[derive(Clone, Copy, Debug)]
struct Point {
    /// How much there is of the axis.
    amount: u32,
    sheets: Sheets,
    atlas: [u32; 2],
    pixels: u32,
    viewers: u32,
}

impl Point {
    fn of(sheets: Sheets) -> Self {
        Self { amount: 0, sheets, atlas: [2048, 1024], pixels: USUAL_PIXELS, viewers: 1 }
    }

    fn at(self, amount: u32) -> Self {
        Self { amount, ..self }
    }

    fn options(self, folder: &Path) -> anyhow::Result<RunOptions> {
        std::fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))?;
        let scene = write_sheets(folder, self.sheets)?;
        let link = USUAL_LINK.parse()?;
        let other = ViewerOptions { link, head: None };
        Ok(RunOptions {
            seconds: SECONDS,
            extent_pixels: [self.pixels; 2],
            atlas_extent_texels: AtlasExtent::new(self.atlas[0], self.atlas[1]).context("an atlas")?,
            others: vec![other; self.viewers as usize - 1],
            detail_pixels: 0.0, // what there is, is drawn
            quality: QualityOptions::Constant(DEFAULT_QP),
            ..RunOptions::new(SceneSource::File(scene), folder.join("run"))
        })
    }
}

/// What a run took.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// How much there is of the axis.
    pub amount: u32,
    /// Medians of the rounds; the server's device counts all viewers.
    pub cost: Cost,
}

/// How cost grows along an axis.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Growth {
    /// What grows.
    pub axis: Axis,
    /// The least first.
    pub rows: Vec<Row>,
    /// Exponents of the device's time an update, its time a display frame, bytes of pictures, bytes of all else; where costs are above 0.
    pub exponents: [Option<f64>; 4],
}

/// All axes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scale {
    /// The server's device.
    pub device: String,
    /// Rounds of each run.
    pub rounds: usize,
    /// By axis.
    pub axes: Vec<Growth>,
}

/// Runs all of `axes`, so many rounds. To be called where [`super::run::run`] may be.
///
/// # Errors
/// Anything that keeps a run from going on.
pub fn measure(axes: &[Axis], rounds: usize, folder: &Path) -> anyhow::Result<Scale> {
    let mut device = String::new();
    let mut growth = |axis: &Axis| -> anyhow::Result<Growth> {
        let points = axis.runs();
        let mut costs = vec![Vec::new(); points.len()];
        // A noisy machine disturbs all alike.
        for _ in 0..rounds {
            for (point, costs) in points.iter().zip(&mut costs) {
                let options = point.options(&folder.join("scene"))?;
                let headset = mock_config(&options, ClockKind::Virtual, 0)?;
                let (found, name) = cost(&options, &headset, SETTLING_S)?;
                costs.push(found);
                device = name;
            }
        }
        let rows: Vec<Row> = points
            .iter()
            .zip(&costs)
            .map(|(point, costs)| Row { amount: point.amount, cost: Cost::median(costs) })
            .collect();
        let grows = |part: fn(&Cost) -> f64| {
            let points: Vec<_> = rows.iter().map(|row| (f64::from(row.amount), part(&row.cost))).collect();
            exponent(&points)
        };
        let exponents = [
            grows(|cost| cost.server_ms),
            grows(|cost| cost.client_ms),
            grows(|cost| cost.picture_bytes),
            grows(|cost| cost.other_bytes),
        ];
        Ok(Growth { axis: *axis, rows, exponents })
    };
    let axes = axes.iter().map(&mut growth).collect::<anyhow::Result<_>>()?;
    Ok(Scale { device, rounds, axes })
}

impl fmt::Display for Scale {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}, medians of {} rounds.\n", self.device, self.rounds)?;
        for Growth { axis, rows, exponents } in &self.axes {
            let heads =
                [axis.name(), "server, ms an update", "client, ms a frame", "picture, kB", "all else, kB"];
            let cells = rows.iter().map(|Row { amount, cost }| {
                [
                    amount.to_string(),
                    format!("{:.2}", cost.server_ms),
                    format!("{:.2}", cost.client_ms),
                    format!("{:.2}", cost.picture_bytes * 1e-3),
                    format!("{:.3}", cost.other_bytes * 1e-3),
                ]
            });
            let shown =
                exponents.map(|found| found.map_or_else(|| "-".to_owned(), |found| format!("{found:.2}")));
            let [server, client, picture, other] = shown;
            let last = ["grows with the power of".to_owned(), server, client, picture, other];
            writeln!(f, "{}", table(heads, cells.chain([last])))?;
        }
        Ok(())
    }
}
