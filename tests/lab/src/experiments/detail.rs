//! Visibility of LOD switches, and the client's drawn geometry.
//!
//! Display frames with a new update are divided by LOD changes of an instance. The change of the picture beyond the truth's
//! change is the visible part of the switch. The other updates give the level without a switch.

use super::run::{comparer, into_probe, mock_config};
use crate::image::Rgb8Image;
use crate::measure::compare::{Comparer, Shown};
use crate::measure::flip::{flip_map, pixels_per_degree};
use crate::session::Lab;
use crate::session::options::RunOptions;
use anyhow::Context;
use serde::Serialize;
use shadecast_client::client::Step;
use shadecast_mock_runtime::config::ClockKind;
use shadecast_mock_runtime::record::{Side, picture_path, read_frames};
use shadecast_protocol::ids::UpdateId;
use std::fmt;

/// Every so many display frames holes are looked for.
const HOLES_EVERY: u64 = 6;

/// Mean and worst of a figure.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Figure {
    /// Over all that were looked at.
    pub mean: f64,
    /// The largest.
    pub worst: f64,
    count: u64,
}

impl Figure {
    fn add(&mut self, value: f64) {
        self.worst = if self.count == 0 { value } else { self.worst.max(value) };
        self.count += 1;
        self.mean += (value - self.mean) / self.count as f64;
    }
}

impl fmt::Display for Figure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.4} (worst {:.4})", self.mean, self.worst)
    }
}

/// The picture as updates come on display: FLIP at the display's own density.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Changes {
    /// How many there were.
    pub count: u64,
    /// The last picture before, against the truth.
    pub before: Figure,
    /// The first picture after, against the truth.
    pub after: Figure,
    /// The difference of the two pictures, less that of the two truths.
    pub beyond_truth: Figure,
}

/// What was found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct DetailReport {
    /// Display frames with a bundle.
    pub frames: u64,
    /// Updates with which an instance changed its level.
    pub switches: Changes,
    /// Those with which none did.
    pub others: Changes,
    /// Share of the truth's geometry that is missing.
    pub holes: Figure,
    /// Triangles that the client draws for an eye, those of two sides twice.
    pub triangles: Figure,
    /// Patches that an update shows.
    pub patches: Figure,
    /// Level of detail of the instances that an update needs, on average.
    pub level: Figure,
    /// Patches in view that were not shown.
    pub dropped_patches: u64,
    /// Warnings and errors of the validation layers; none where they are off.
    pub validation_messages: Option<u64>,
}

impl fmt::Display for DetailReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { frames, triangles, patches, level, holes, dropped_patches, .. } = self;
        writeln!(f, "{frames} frames; triangles {triangles}; patches {patches}; level {level}")?;
        writeln!(f, "holes {holes}; {dropped_patches} patches dropped")?;
        for (what, changes) in [("switches", self.switches), ("other updates", self.others)] {
            let Changes { count, before, after, beyond_truth } = changes;
            writeln!(
                f,
                "{count} {what}: FLIP before {before}, after {after}, change beyond the truth's {beyond_truth}"
            )?;
        }
        Ok(())
    }
}

/// What was on display last.
struct Displayed {
    update: UpdateId,
    client: Rgb8Image,
    truth: Rgb8Image,
}

struct Watch {
    report: DetailReport,
    comparer: Comparer,
    last: Option<Displayed>,
}

/// Runs `options` in virtual time and looks at every display frame of the left eye. To be called where [`crate::experiments::run::run`] may be.
///
/// # Errors
/// Anything that keeps the run from going on.
pub fn measure(options: &RunOptions) -> anyhow::Result<DetailReport> {
    let capture = options.out.join("capture");
    if capture.exists() {
        std::fs::remove_dir_all(&capture).with_context(|| format!("clearing {}", capture.display()))?;
    }
    let config = mock_config(options, ClockKind::Virtual, 1)?;
    // SAFETY: the caller's promise, as for `run`.
    let mut lab = unsafe { Lab::open(options, &config) }?;
    let comparer = comparer(&lab.server, options)?;
    let mut watch = Watch { report: DetailReport::default(), comparer, last: None };
    while let Step::Frame(frame) = lab.step()? {
        let Some(update) = frame.update else { continue };
        let records = read_frames(&capture).context("reading the runtime's frame log")?;
        let record = records.last().filter(|record| record.captured).context("every frame is captured")?;
        let client = Rgb8Image::read_png(&picture_path(&capture, record.frame, Side::Left))?;
        let view = record.views.first().context("a captured frame has two views")?;
        let (world_from_stage, fov) = (lab.server.scene.scene.world_from_stage, view.frustum());
        let world_from_eye = world_from_stage.then(view.stage_pose.into());
        let time = lab.server.world_time(record.predicted_display_time_ns);
        let ppd = pixels_per_degree(client.width, fov.left, fov.right);
        let truth = if watch.report.frames.is_multiple_of(HOLES_EVERY) {
            let probe = lab.client.presenter.probe()?.map(into_probe);
            let shown = Shown { world_from_eye, fov, time, picture: &client, probe: Some(&probe[0]) };
            let (truth, metrics) = watch.comparer.measure(&shown)?;
            watch.report.holes.add(metrics.holes.strict);
            truth
        } else {
            watch.comparer.picture(world_from_eye, fov, time)?
        };
        watch.report.triangles.add(lab.client.presenter.drawn_triangles().len() as f64);
        watch.see(&lab, Displayed { update, client, truth }, ppd);
    }
    let Watch { mut report, .. } = watch;
    report.dropped_patches = lab.seat().dropped_patches();
    report.validation_messages =
        crate::report::stats::messages_of_both(&lab.server.gpu, &lab.client.presenter.stats());
    Ok(report)
}

impl Watch {
    fn see(&mut self, lab: &Lab, now: Displayed, ppd: f32) {
        self.report.frames += 1;
        let shows = &lab.seat().shows;
        let at = |update: UpdateId| &shows[update.0 as usize];
        let levels = &at(now.update).lods;
        self.report.patches.add(f64::from(at(now.update).patches));
        self.report.level.add(levels.iter().sum::<usize>() as f64 / levels.len().max(1) as f64);
        if let Some(last) = self.last.as_ref().filter(|last| last.update < now.update) {
            let difference = |a: &Rgb8Image, b: &Rgb8Image| {
                let map = flip_map(a, b, ppd);
                map.iter().map(|error| f64::from(*error)).sum::<f64>() / map.len() as f64
            };
            let is_switch = at(last.update).lods != *levels;
            let changes = if is_switch { &mut self.report.switches } else { &mut self.report.others };
            changes.count += 1;
            changes.before.add(difference(&last.truth, &last.client));
            changes.after.add(difference(&now.truth, &now.client));
            let (client, truth) =
                (difference(&last.client, &now.client), difference(&last.truth, &now.truth));
            changes.beyond_truth.add(client - truth);
        }
        self.last = Some(now);
    }
}
