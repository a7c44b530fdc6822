//! What is shown from the store, and what settles there.

use super::{Layout, State};
use crate::atlas::placement::{Placed, PlacementChange};
use crate::atlas::store::{Served, Settling, Store};
use crate::scene::geometry::{Geometry, vertices_of_patch};
use crate::scene::numbering::ScenePatch;
use crate::support::merged::merged;
use glam::Vec3;
use shadecast_protocol::atlas::{Block, PixelTexels};
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::pose::Pose;
use shadecast_shaders::constants::EDGE_COSINE;

/// Of the texels of the atlas, this part becomes grey with an update at most: grey takes bits once.
const CLEARED_PART: u32 = 32;

impl State {
    /// The extent that was seen last, pixels.
    fn pixels(&self) -> [f32; 2] {
        self.extent.map(|side| f32::from(side) / self.extent_density)
    }

    /// The extent that its size is for, in texels of the same density as [`Self::extent`].
    pub(super) fn sized_extent(&self) -> [u16; 2] {
        [0, 1]
            .map(|axis| self.extent[axis].max((self.copied_pixels[axis] * self.extent_density).ceil() as u16))
    }

    /// How many texels of a block a pixel of the display covers. Textures are never filtered for less than a texel.
    fn pixel(&self, block: Block) -> PixelTexels {
        let [left, top, right, bottom] = block.lookup_rect_texels();
        let pixels = self.extent.map(|side| f32::from(side).max(1.0) / self.extent_density);
        PixelTexels::new([(right - left) / pixels[0], (bottom - top) / pixels[1]])
    }
}

impl Layout {
    /// Takes out of what needs a block in the atlas what the store has.
    pub(super) fn serve(&mut self, geometry: &impl Geometry, update: UpdateId) {
        self.store.begin(update);
        let density = self.sized_for();
        let Self { live, around, store, served, states, world_from_head, .. } = self;
        served.clear();
        live.retain(|patch| {
            let state = &mut states[patch.index()];
            // While the head turns round, some of its views show what will soon be behind it. They say nothing of how large it is seen.
            let is_ahead = || is_ahead(*world_from_head, geometry, *patch);
            let served_from = store.serve(*patch, (update, density), state.pixels(), is_ahead);
            match served_from {
                Served::Copy(block) => {
                    served.push(Placed { patch: *patch, block, is_around: false, is_hidden: false });
                }
                Served::Atlas(Some(pixels)) => state.copied_pixels = pixels,
                Served::Atlas(None) => {}
            }
            matches!(served_from, Served::Atlas(_))
        });
        around.retain(|(patch, _)| {
            let served_from = store.show(*patch, update);
            let placed = |block| Placed { patch: *patch, block, is_around: true, is_hidden: false };
            served.extend(served_from.map(placed));
            served_from.is_none()
        });
        served.sort_unstable_by_key(|placed| placed.patch);
    }

    /// Blocks of the atlas that are new will be shaded.
    pub(super) fn note_placed(&mut self, changes: &[PlacementChange], update: UpdateId) {
        let in_atlas = |change: &&PlacementChange| change.block.is_some_and(|block| !block.is_stored());
        changes.iter().filter(in_atlas).for_each(|change| self.store.shaded(change.patch, update));
    }

    /// Chooses what becomes grey of the blocks that were left for the store, where nothing else has taken their place: their texels would be
    /// coded for nothing, with a refresh all of them.
    pub(super) fn clear_vacated(&mut self, before: &[(ScenePatch, Block)]) {
        let Self { served, vacated, cleared, atlas, .. } = self;
        let mut before = before.iter().peekable();
        for placed in served {
            while before.next_if(|(patch, _)| *patch < placed.patch).is_some() {}
            let was = before.next_if(|(patch, _)| *patch == placed.patch).map(|(_, block)| *block);
            vacated.extend(was.filter(|block| !block.is_stored()));
        }
        cleared.clear();
        let [width, height] = atlas.extent_texels();
        let mut left_texels = (width * height) / CLEARED_PART;
        while let Some(block) = vacated.pop_front_if(|block| block.size.texels() <= left_texels) {
            if atlas.take(block) {
                atlas.free(block);
                left_texels -= block.size.texels();
                cleared.push(block);
            }
        }
    }

    /// The blocks that become grey with this update.
    pub(crate) fn cleared(&self) -> &[Block] {
        &self.cleared
    }

    /// The blocks that settle with an update, of those in view that may: each patch with its place in the store, and what it is filtered for.
    /// They are `most_blocks` at most.
    pub(crate) fn settle(
        &mut self,
        (update, most_blocks): (UpdateId, usize),
        may: impl Fn(ScenePatch) -> bool,
        mut put: impl FnMut(ScenePatch, Block, PixelTexels),
    ) {
        let density = self.sized_for();
        let Self { live, states, store, update: newest, .. } = self;
        let with_pixel =
            |patch: ScenePatch, block: Block| put(patch, block, states[patch.index()].pixel(block));
        let in_atlas = live.iter().filter_map(|patch| {
            let state = &states[patch.index()];
            let pixels = [0, 1].map(|axis| state.pixels()[axis].max(state.copied_pixels[axis]));
            let seen = UpdateId(update.0.saturating_sub(*newest - state.last_seen));
            Some(Settling { patch: *patch, block: state.block?, pixels, seen })
        });
        let settling = in_atlas.filter(|settling| may(settling.patch));
        store.settle((update, most_blocks, density), settling, with_pixel);
    }

    /// All that has a block in the atlas or in the store, shown or not, ascending.
    pub(crate) fn remembered(&self) -> impl Iterator<Item = Placed> + '_ {
        let hidden = |(patch, block)| Placed { patch, block, is_around: false, is_hidden: true };
        merged(self.store.copies().map(hidden), self.all_placed(), |a, b| a.patch.cmp(&b.patch))
    }

    /// The store.
    pub(crate) fn store(&self) -> &Store {
        &self.store
    }

    /// The same, to tell it what has become of blocks.
    pub(crate) fn store_mut(&mut self) -> &mut Store {
        &mut self.store
    }
}

/// Whether a corner of a patch lies where shading filters for a pixel of the display (`footprint.glsl`). What moves counts as ahead.
fn is_ahead(world_from_head: Pose, geometry: &impl Geometry, patch: ScenePatch) -> bool {
    let axis = world_from_head.orientation * Vec3::NEG_Z;
    vertices_of_patch(geometry, patch).any(|vertex| {
        geometry.static_position(vertex).is_none_or(|place| {
            let way = place - world_from_head.position;
            axis.dot(way) >= EDGE_COSINE * way.length()
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_protocol::atlas::{BlockAddress, BlockSize};

    #[test]
    fn a_pixel_covers_a_blocks_texels_by_the_patchs_extent() {
        // 62 by 30 texels are looked up, for 15.5 by 30 pixels.
        let block = Block { address: BlockAddress::default(), size: BlockSize::new(6, 5).expect("a size") };
        let state = State { extent: [31, 60], extent_density: 2.0, ..State::default() };
        assert_eq!(state.pixel(block).texels(), [4.0, 1.0]);
        let finer = State { extent: [500, 60], ..state };
        assert_eq!(finer.pixel(block).texels(), [1.0, 1.0], "textures are filtered for a texel at least");
    }
}
