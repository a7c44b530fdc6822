//! Reports of a viewer, settings of its updates, and figures about them. None of it touches the device.

use super::{Shaded, Shows, ViewerUpdates};
use crate::atlas::layout::Layout;
use crate::encode::Source;
use crate::motion::delta::UpdateDelta;
use crate::pacing::density::Spare;
use crate::pacing::relief::Measures;
use crate::pacing::share::Budget;
use crate::residency::Residency;
use crate::shading::reuse::Reused;
use crate::world::World;
use shadecast_gpu::Image;
use shadecast_protocol::delta::EncodedDelta;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::message::{Displayed, HeadState};

/// A viewer's first update takes about so many times as long as the rehearsal's, whose picture is small.
const FIRST_LONGER: i64 = 4;

impl ViewerUpdates {
    /// The client's head, as reported.
    pub fn head(&mut self, state: HeadState) {
        self.head.head(state);
    }

    /// Updates pause or go on: how long the last one stays on display says nothing about the way.
    pub(crate) fn interrupted(&mut self) {
        self.head.interrupted();
    }

    /// The client shows an update: frees slots, and teaches the prediction how long the way is.
    pub fn displayed(&mut self, report: &Displayed) {
        self.placement.displayed(report.update);
        if let Some(begun) = self.numbers.displayed(report.update) {
            self.head.displayed(begun, report.display_time);
        }
    }

    /// What each update may take on the wire from now on.
    pub(crate) fn set_budget(&mut self, budget: Budget) {
        self.placement.residency.set_budget(budget);
    }

    /// Whether bits and time are left over by the updates that it makes.
    pub(crate) fn set_spare(&mut self, spare: Spare) {
        self.placement.set_spare(spare);
    }

    /// An update's picture is coded with this quantiser.
    pub(crate) fn coded(&mut self, update: UpdateId, qp: u8) {
        self.placement.coded(update, qp);
        self.shading.coded(qp);
    }

    /// The client has no picture of updates later than this one, if it has that.
    pub(crate) fn lost_after(&mut self, after: Option<UpdateId>) {
        self.placement.lost_after(after);
    }

    /// An update takes about so many nanoseconds.
    pub fn note_update(&mut self, took_ns: i64) {
        self.head.note_update(took_ns);
    }

    /// An update took so many nanoseconds when nobody looked yet.
    pub(crate) fn note_rehearsal(&mut self, took_ns: i64) {
        self.note_update(FIRST_LONGER * took_ns);
        self.rehearsed_s = Some(took_ns as f64 * 1e-9);
    }

    /// The same, seconds.
    pub(crate) fn rehearsed_s(&self) -> Option<f64> {
        self.rehearsed_s
    }

    /// What updates do without from now on, where the policy does not say it.
    pub(crate) fn set_measures(&mut self, measures: Measures) {
        let measures = self.policy.measures.unwrap_or(measures);
        self.visibility.set_measures(measures);
        self.placement.set_measures(measures);
        self.shading.set_measures(measures);
    }

    /// How many texels an update may shade from now on, beside those of new blocks.
    pub fn set_shading_budget(&mut self, texels: u64) {
        self.placement.set_shading_budget(texels);
        self.shading.set_budget(texels);
    }

    /// The bytes of an update's delta, in the order of updates.
    pub fn encode(&self, delta: &UpdateDelta) -> EncodedDelta {
        self.placement.residency.encode(delta)
    }

    /// An update that is not needed any more: its memory is used for those that come.
    pub fn recycle(&mut self, shaded: Shaded) {
        let Shaded { delta, picture: Source::Planes(picture), blocks, timings, .. } = shaded;
        self.placement.residency.recycle(delta);
        self.shading.recycle(picture, blocks);
        self.timings.give(timings);
    }

    /// Which patch has which block.
    pub fn layout(&self) -> &Layout {
        self.placement.layout()
    }

    /// The client's memory.
    pub fn residency(&self) -> &Residency {
        &self.placement.residency
    }

    /// The atlas of the last update, as shaders read it.
    pub fn atlas(&self) -> &Image {
        self.shading.atlas()
    }

    /// Patches in view that were not shown, for want of a block or of a free slot, summed over all updates.
    pub fn dropped_patches(&self) -> u64 {
        self.placement.dropped_patches()
    }

    /// What the last update shaded, and what it did not have to.
    pub(crate) fn reused(&self) -> Reused {
        self.shading.reuse().reused()
    }

    /// Part of the blocks' texels that was not shaded again, over all updates, 0..1.
    pub(crate) fn reused_share(&self) -> f32 {
        self.shading.reuse().total_share()
    }

    /// What the last update shows.
    pub fn shows(&self, world: &World) -> Shows {
        let (layout, detail) = (self.placement.layout(), self.visibility.detail());
        let drawn = || layout.all_placed().map(|placed| placed.patch);
        Shows {
            patches: drawn().count() as u32,
            triangles: drawn().map(|patch| world.scene().patch(patch).drawn_triangles()).sum(),
            lods: detail.lods().flatten().map(|lods| lods.shown).collect(),
            detail_pixels: detail.allowed_pixels(),
            texels_per_pixel: self.placement.texels_per_pixel(),
            pairs: self.visibility.pairs(),
            reused: self.reused(),
            converted_texels: self.shading.converted_texels(),
            stored_blocks: layout.store().count() as u32,
            stored_texels: layout.store().texels(),
        }
    }
}
