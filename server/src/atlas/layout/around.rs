//! The surround's blocks: placed in the room that blocks in view leave, and the first to go.

use super::{Layout, Scratch};
use crate::atlas::capacity::Candidate;
use crate::atlas::sizing::wanted_size;
use crate::atlas::surround::{Kept, SURROUND_DENSITY};
use crate::pacing::room::Room;
use crate::scene::geometry::Geometry;
use crate::scene::numbering::ScenePatch;
use crate::visibility::lod_set::LodSet;
use shadecast_protocol::atlas::Block;

impl Layout {
    /// Chooses what of the surround is to have a block, of LODs that are shown.
    pub(super) fn choose_around(&mut self, geometry: &impl Geometry, lods: &LodSet, room: Room) {
        self.around.clear();
        if !self.surround.is_kept() {
            return;
        }
        let left = self.chooser.left_beside(geometry, room, self.live.iter().copied());
        let Scratch { kept, .. } = &mut self.scratch;
        kept.clear();
        let shown = lods.shown_among(self.surround.seen().iter(), |seen| seen.patch);
        for (_, seen) in shown.filter(|(_, seen)| self.recent.binary_search(&seen.patch).is_err()) {
            let block = self.states[seen.patch.index()].block;
            let extent = seen.extent.map(|side| f32::from(side) * SURROUND_DENSITY);
            let size = wanted_size(extent, block.map(|block| block.size));
            let candidate = Candidate {
                patch: seen.patch,
                is_in_view: false,
                area_texels: u32::from(seen.extent[0]) * u32::from(seen.extent[1]),
                is_shown: block.is_some(),
            };
            // A copy in the store takes nothing of the atlas.
            let texels = if self.store.has(seen.patch) { 0 } else { u64::from(size.texels()) };
            kept.push(Kept { candidate, texels });
            self.around.push((seen.patch, size));
        }
        let [width, height] = self.atlas.extent_texels();
        let chosen = self.surround.choose(geometry, kept, room, left, u64::from(width) * u64::from(height));
        self.around.retain(|(patch, _)| chosen.binary_search_by_key(patch, |chosen| chosen.patch).is_ok());
    }

    /// Places what of the surround has no block, where it was if that is free still; what finds no place is left out.
    pub(super) fn place_around(&mut self, before: &[(ScenePatch, Block)]) {
        let Scratch { waiting, .. } = &mut self.scratch;
        waiting.clone_from(&self.around);
        waiting.retain(|(patch, size)| {
            let at = before.binary_search_by_key(patch, |(patch, _)| *patch);
            let was = at.ok().map(|at| before[at].1);
            let was = was.filter(|block| block.size == *size && !block.is_stored());
            let state = &mut self.states[patch.index()];
            if state.block.is_none() {
                state.block = was.filter(|block| self.atlas.take(*block));
            }
            state.block.is_none()
        });
        waiting.sort_unstable_by_key(|(patch, size)| (size.allocation_order(), *patch));
        for (patch, size) in waiting {
            self.states[patch.index()].block = self.atlas.allocate(*size);
        }
        let states = &self.states;
        self.around.retain(|(patch, _)| states[patch.index()].block.is_some());
    }

    /// Frees all blocks of the surround: what is in view goes before it.
    pub(super) fn release_around(&mut self) {
        for (patch, _) in &self.around {
            let block = self.states[patch.index()].block.take();
            block.into_iter().for_each(|block| self.atlas.free(block));
        }
    }
}
