//! Steadiness of the atlas between updates: whether it rests in a static scene, and the number of resized blocks in a moving
//! one.

use super::run::mock_config;
use crate::session::Lab;
use crate::session::options::RunOptions;
use anyhow::Context;
use serde::Serialize;
use shadecast_client::client::Step;
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use shadecast_protocol::atlas::BlockSize;
use shadecast_protocol::geometry::GeometryDelta;
use shadecast_protocol::ids::UpdateId;
use shadecast_server::encode::Source;
use shadecast_server::scene::numbering::ScenePatch;
use shadecast_server::update::{Shaded, ViewerUpdates};
use std::collections::BTreeMap;
use std::fmt;

/// One update, against the one before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Steadiness {
    /// The update.
    pub update: u32,
    /// Texels of the planes that differ, all planes together.
    pub changed_texels: usize,
    /// Records of the delta that say something new: all but what is forgotten.
    pub records: usize,
    /// Patches and vertices that the client is told to forget.
    pub forgotten: usize,
    /// Patches in view, or held, in both updates.
    pub stayed: usize,
    /// Those of them whose block has another size.
    pub resized: usize,
    /// Part of the atlas inside blocks, 0..1.
    pub used_share: f32,
    /// Texels asked for a pixel of the display.
    pub texels_per_pixel: f32,
}

/// All updates of a run but the first.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct SteadinessReport {
    /// In their order.
    pub updates: Vec<Steadiness>,
}

impl Steadiness {
    /// Whether nothing at all changed.
    pub fn is_at_rest(&self) -> bool {
        self.changed_texels + self.records + self.forgotten == 0
    }

    /// Part of the blocks that stayed in view whose size changed, 0..1.
    pub fn resized_share(&self) -> f64 {
        self.resized as f64 / self.stayed.max(1) as f64
    }
}

impl SteadinessReport {
    /// The first update from which on all to the end are as asked for; `None` where the last is not.
    pub fn from_which_on(&self, is_so: impl Fn(&Steadiness) -> bool) -> Option<u32> {
        let last_other = self.updates.iter().rposition(|update| !is_so(update));
        let first = last_other.map_or(0, |last| last + 1);
        self.updates.get(first).map(|update| update.update)
    }

    /// Mean and worst part of the blocks whose size changed, from an update on.
    pub fn resized(&self, from_update: u32) -> [f64; 2] {
        let shares =
            || self.updates.iter().filter(|u| u.update >= from_update).map(Steadiness::resized_share);
        let count = shares().count().max(1) as f64;
        [shares().sum::<f64>() / count, shares().fold(0.0, f64::max)]
    }
}

impl fmt::Display for SteadinessReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let from = |is_so: fn(&Steadiness) -> bool| {
            self.from_which_on(is_so).map_or("never".to_owned(), |update| format!("from update {update} on"))
        };
        writeln!(f, "{} updates", self.updates.len() + 1)?;
        writeln!(f, "  the same planes           {}", from(|update| update.changed_texels == 0))?;
        writeln!(f, "  nothing new in the delta  {}", from(|update| update.records == 0))?;
        writeln!(f, "  nothing forgotten         {}", from(|update| update.forgotten == 0))?;
        for skipped in [0, 30] {
            let [mean, worst] = self.resized(skipped).map(|share| 100.0 * share);
            writeln!(
                f,
                "  blocks of another size    {mean:.2} % an update, {worst:.2} % at worst, from {skipped} on"
            )?;
        }
        Ok(())
    }
}

/// What the last update looked like.
struct Last {
    update: UpdateId,
    planes: Vec<Vec<u8>>,
    sizes: BTreeMap<ScenePatch, BlockSize>,
}

/// Runs `options` in virtual time and looks at every update. To be called where [`crate::experiments::run::run`] may be.
///
/// # Errors
/// Anything that keeps the run from going on.
pub fn measure(options: &RunOptions) -> anyhow::Result<SteadinessReport> {
    let config = MockConfig { capture_dir: None, ..mock_config(options, ClockKind::Virtual, 0)? };
    // SAFETY: the caller's promise, as for `run`.
    let mut lab = unsafe { Lab::open(options, &config) }?;
    let mut report = SteadinessReport::default();
    let mut last: Option<Last> = None;
    while let Step::Frame(_) = lab.step()? {
        let Some(shaded) = &lab.seat().last else { continue };
        if last.as_ref().is_some_and(|last| last.update == shaded.update) {
            continue;
        }
        let updates = lab.seat().viewer.as_ref().context("a viewer has updates")?.updates();
        let (now, before) = (look(updates, shaded), last.take());
        if let Some(before) = before {
            anyhow::ensure!(shaded.update == before.update.next(), "an update was missed");
            let texels_per_pixel = lab.seat().shows[shaded.update.0 as usize].texels_per_pixel;
            report.updates.push(Steadiness { texels_per_pixel, ..compare(updates, shaded, &before, &now) });
        }
        last = Some(now);
    }
    Ok(report)
}

fn look(updates: &ViewerUpdates, shaded: &Shaded) -> Last {
    let Source::Planes(picture) = &shaded.picture;
    Last {
        update: shaded.update,
        planes: picture.planes().map(<[u8]>::to_vec).into(),
        sizes: updates.layout().live().map(|(patch, block)| (patch, block.size)).collect(),
    }
}

fn compare(updates: &ViewerUpdates, shaded: &Shaded, before: &Last, now: &Last) -> Steadiness {
    let differing = |(a, b): (&Vec<u8>, &Vec<u8>)| a.iter().zip(b).filter(|(a, b)| a != b).count();
    let geometry = &shaded.delta.geometry;
    let forgotten = geometry.evicted_patches.len() + geometry.evicted_vertices.len();
    let nothing = GeometryDelta {
        update: geometry.update,
        time: geometry.time,
        shaded: geometry.shaded,
        evicted_patches: geometry.evicted_patches.clone(),
        evicted_vertices: geometry.evicted_vertices.clone(),
        ..GeometryDelta::default()
    };
    let is_news = usize::from(*geometry != nothing);
    let stayed = now.sizes.iter().filter_map(|(patch, size)| Some((size, before.sizes.get(patch)?)));
    Steadiness {
        update: shaded.update.0,
        changed_texels: before.planes.iter().zip(&now.planes).map(differing).sum(),
        records: is_news.max(geometry.records() - forgotten),
        forgotten,
        stayed: stayed.clone().count(),
        resized: stayed.filter(|(now, before)| now != before).count(),
        used_share: updates.layout().used_share(),
        texels_per_pixel: 0.0,
    }
}
