//! The layout of the atlas: block sizes from projected extents, with hysteresis, and the places of the blocks. Pure and total: a full atlas coarsens, it never fails.
//!
//! It coarsens before it is full, a few blocks with each update; only what comes into view faster than that makes it coarsen at
//! once, and then as few blocks as will do.

mod around;
mod density;
mod served;

use crate::atlas::capacity::{Candidate, Chooser};
use crate::atlas::layout::density::{DensityStep, Sizes};
use crate::atlas::placement::{Placed, PlacementChange};
use crate::atlas::sizing::{Shape, Turn, have_their_turn, least_turns};
use crate::atlas::store::Store;
use crate::atlas::surround::{Kept, Surround};
use crate::pacing::pressure::Pressure;
use crate::pacing::room::Room;
use crate::scene::geometry::Geometry;
use crate::scene::numbering::ScenePatch;
use crate::support::merged::merged;
use crate::visibility::holding::HOLD_UPDATES;
use crate::visibility::lod_set::{LodInstance, LodSet};
use shadecast_protocol::atlas::allocator::Atlas;
use shadecast_protocol::atlas::{AtlasExtent, Block, BlockSize};
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::limits::BLOCK_MIN_LOG2;
use shadecast_protocol::pose::Pose;
use shadecast_shaders::generated::SeenGpu;
use std::collections::VecDeque;

/// Where not all can be shown, a patch seen within this many updates counts as in view: one that flickers in the ID
/// buffer does not come and go.
const IN_VIEW_UPDATES: u32 = 3;

/// Which patch has which block.
#[derive(Clone, Debug)]
pub struct Layout {
    atlas: Atlas,
    chooser: Chooser,
    states: Vec<State>,
    /// Patches that were seen within the last [`HOLD_UPDATES`], ascending: those of LODs too that are not shown yet.
    recent: Vec<ScenePatch>,
    /// Patches with a block, ascending: what is in view, or was lately.
    live: Vec<ScenePatch>,
    /// What could come into view.
    surround: Surround,
    /// Of that, the patches with a block, or that are to have one, and its size; ascending.
    around: Vec<(ScenePatch, BlockSize)>,
    /// Copies of blocks that the client keeps.
    store: Store,
    /// What is shown from there, ascending.
    served: Vec<Placed>,
    /// Blocks of the atlas whose patches have been shown from the store since, the oldest first.
    vacated: VecDeque<Block>,
    /// Of those, what becomes grey with this update.
    cleared: Vec<Block>,
    /// Texels for a pixel that views are measured with.
    asked: f32,
    /// The part of what a block is to have that it has at first.
    new_part: f32,
    /// Texels at most of the blocks that change with an update, when it is their turn.
    most_resized_texels: u64,
    /// Of those, the part that blocks are to have.
    pressure: Pressure<DensityStep>,
    /// Part of the atlas that blocks take when all have had their turn.
    settled_share: f32,
    /// What part of the atlas the blocks would have taken that found no place when density fell last.
    overflow_share: f32,
    /// What part of the atlas blocks took when density rose last.
    share_at_rise: f32,
    /// The head that the update is shaded for.
    world_from_head: Pose,
    update: u32,
    coarsened: u32,
    dropped: usize,
    scratch: Scratch,
}

/// Lists of one update, kept for their memory.
#[derive(Clone, Debug, Default)]
struct Scratch {
    seen: Vec<(ScenePatch, [u16; 2])>,
    held: Vec<ScenePatch>,
    before: Vec<(ScenePatch, Block)>,
    candidates: Vec<Candidate>,
    kept: Vec<Kept>,
    turns: Vec<Turn>,
    chosen: Vec<Turn>,
    sizes: Vec<BlockSize>,
    waiting: Vec<(ScenePatch, BlockSize)>,
    old: Vec<Option<Block>>,
}

#[derive(Clone, Copy, Debug, Default)]
struct State {
    block: Option<Block>,
    last_seen: u32,
    /// The latest extents, width and height in texels, and the texels for a pixel that they were measured with.
    extent: [u16; 2],
    extent_density: f32,
    /// The texels for a pixel that its block follows, where it is in view.
    follows: Option<f32>,
    /// For its size its extent counts as so large at least, pixels, where it takes the place of a copy.
    copied_pixels: [f32; 2],
}

/// What the predicted views show of what was looked at.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Visible<'a> {
    /// Whose entries these are.
    pub lods: &'a LodSet,
    /// What is visible, ascending by entry: with the patch's largest extent, width | height << 16 in texels.
    pub seen: &'a [SeenGpu],
}

impl<'a> Visible<'a> {
    /// The patches that are visible, ascending, with width and height in texels, and their instance.
    fn patches(self) -> impl Iterator<Item = (usize, ScenePatch, [u16; 2])> + 'a {
        let mut lods = self.lods.all().iter().peekable();
        self.seen.iter().map(move |SeenGpu { entry, extent_texels }| {
            while lods.next_if(|lod| lod.entries().end <= *entry as usize).is_some() {}
            let lod = lods.peek().expect("an entry of the LOD set");
            let patch = ScenePatch(lod.patches.first.0 + entry - lod.first_entry);
            (lod.instance, patch, [*extent_texels as u16, (extent_texels >> 16) as u16])
        })
    }
}

impl Layout {
    /// For `patches` patches in an empty atlas.
    pub(crate) fn new(atlas_extent: AtlasExtent, patches: usize) -> Self {
        Self {
            atlas: Atlas::new(atlas_extent),
            chooser: Chooser::default(),
            states: vec![State::default(); patches],
            recent: Vec::new(),
            live: Vec::new(),
            surround: Surround::new(0.0),
            around: Vec::new(),
            store: Store::default(),
            served: Vec::new(),
            vacated: VecDeque::new(),
            cleared: Vec::new(),
            asked: 1.0,
            new_part: 1.0,
            most_resized_texels: u64::MAX,
            pressure: Pressure::new(DensityStep(1.0)),
            settled_share: 0.0,
            overflow_share: 1.0,
            share_at_rise: 1.0,
            world_from_head: Pose::IDENTITY,
            update: 0,
            coarsened: 0,
            dropped: 0,
            scratch: Scratch::default(),
        }
    }

    /// With a surround that may take so large a part of the room and of the atlas, 0..1.
    #[must_use]
    pub(crate) fn with_surround(mut self, share: f32) -> Self {
        self.surround = Surround::new(share);
        self
    }

    /// With so many pages of the client's for what does not change.
    #[must_use]
    pub(crate) fn with_store(mut self, pages: u32) -> Self {
        self.store = Store::new(pages, self.states.len(), self.atlas.extent());
        self
    }

    /// At the coarsest every block is of the smallest size; more patches than that cannot have one.
    pub(crate) fn most_blocks(atlas_extent: AtlasExtent) -> u32 {
        (atlas_extent.width() * atlas_extent.height()) >> (2 * BLOCK_MIN_LOG2)
    }

    /// A new update begins, whose views are measured with so many texels for a pixel.
    pub(crate) fn begin(&mut self, asked: f32) {
        self.update += 1;
        self.asked = asked;
    }

    /// New blocks begin with this part of the texels for a pixel that are asked for, 0 to 1; then each waits for its turn.
    pub(crate) fn begin_blocks_with(&mut self, part: f32) {
        self.new_part = part;
    }

    /// Blocks that change when it is their turn have so many texels with an update at most, or are one.
    pub(crate) fn resize_by(&mut self, most_texels: u64) {
        self.most_resized_texels = most_texels;
    }

    /// Where the head is that this update is shaded for.
    pub(crate) fn look_from(&mut self, world_from_head: Pose) {
        self.world_from_head = world_from_head;
    }

    /// Takes in what this update's views show; of several visibility passes the last counts.
    pub(crate) fn see(&mut self, visible: Visible<'_>) {
        let (update, asked, states) = (self.update, self.asked, &mut self.states);
        let is_held = |patch: &ScenePatch| {
            let unseen_updates = update - states[patch.index()].last_seen;
            (1..=HOLD_UPDATES).contains(&unseen_updates)
        };
        let Scratch { seen, held, .. } = &mut self.scratch;
        held.clear();
        held.extend(self.recent.iter().copied().filter(is_held));
        seen.clear();
        seen.extend(visible.patches().map(|(_, patch, extent)| (patch, extent)));
        for (patch, extent) in &*seen {
            let state = &mut states[patch.index()];
            (state.last_seen, state.extent, state.extent_density) = (update, *extent, asked);
        }
        self.recent.clear();
        self.recent
            .extend(merged(held.iter().copied(), seen.iter().map(|(patch, _)| *patch), |a, b| a.cmp(b)));
    }

    /// Takes in what a glance around shows of those instances that may be in the surround.
    pub(crate) fn see_around(&mut self, visible: Visible<'_>, may_be: impl Fn(usize) -> bool) {
        let seen = visible.patches().filter(|(instance, ..)| may_be(*instance));
        self.surround.see(self.update, seen.map(|(_, patch, extent)| (patch, extent)));
    }

    /// The patches of an LOD that must be there before it is shown, ascending.
    pub(crate) fn seen_of(&self, lod: &LodInstance) -> &[ScenePatch] {
        let at = |number: u32| self.recent.partition_point(|patch| patch.0 < number);
        &self.recent[at(lod.patches.first.0)..at(lod.patches.end())]
    }

    /// Of what is shown, the patches that were seen lately, ascending, with their instance.
    pub(crate) fn shown<'a>(&'a self, lods: &'a LodSet) -> impl Iterator<Item = (usize, ScenePatch)> + 'a {
        lods.shown_of(&self.recent)
    }

    /// Texels of the extent with which a patch was seen last.
    pub(crate) fn seen_texels(&self, patch: ScenePatch) -> u64 {
        let [width, height] = self.states[patch.index()].extent;
        u64::from(width) * u64::from(height)
    }

    /// Whether a client with this room can be shown all that this update's views see of what is shown.
    pub(crate) fn has_room(&mut self, geometry: &impl Geometry, lods: &LodSet, room: Room) -> bool {
        let (states, update) = (&self.states, self.update);
        let in_view = lods.shown_of(&self.recent).map(|(_, patch)| patch);
        let in_view = in_view.filter(|patch| states[patch.index()].last_seen == update);
        self.chooser.all_fit(geometry, room, in_view)
    }

    /// Places the patches of what is shown that are visible, and those seen within the last
    /// [`HOLD_UPDATES`]; where these are too many for the client's room, those that matter most on screen. `room` has no more patches
    /// than [`Layout::most_blocks`]. `changes` becomes what changed, in patch order.
    pub(crate) fn place(
        &mut self,
        geometry: &impl Geometry,
        lods: &LodSet,
        (room, update): (Room, UpdateId),
        changes: &mut Vec<PlacementChange>,
    ) {
        let mut before = std::mem::take(&mut self.scratch.before);
        before.clear();
        before.extend(self.all_placed().map(|placed| (placed.patch, placed.block)));
        self.choose(geometry, lods, room);
        self.choose_around(geometry, lods, room);
        self.serve(geometry, update);
        self.release(&before);
        self.recover();
        self.place_live();
        self.place_around(&before);
        changes.clear();
        changes.extend(self.changes(&before));
        self.note_placed(changes, update);
        self.clear_vacated(&before);
        self.scratch.before = before;
    }

    /// Chooses who is to have a block.
    fn choose(&mut self, geometry: &impl Geometry, lods: &LodSet, room: Room) {
        let candidate = |(_, patch): (usize, ScenePatch)| {
            let state = &self.states[patch.index()];
            Candidate {
                patch,
                is_in_view: self.update - state.last_seen < IN_VIEW_UPDATES,
                area_texels: u32::from(state.extent[0]) * u32::from(state.extent[1]),
                is_shown: state.block.is_some(),
            }
        };
        let mut candidates = std::mem::take(&mut self.scratch.candidates);
        candidates.clear();
        candidates.extend(lods.shown_of(&self.recent).map(candidate));
        let is_visible =
            |candidate: &&Candidate| self.states[candidate.patch.index()].last_seen == self.update;
        let visible = candidates.iter().filter(is_visible).count();
        self.chooser.choose(geometry, room, &mut candidates);
        self.dropped = visible - candidates.iter().filter(is_visible).count();
        self.live.clear();
        self.live.extend(candidates.iter().map(|candidate| candidate.patch));
        self.scratch.candidates = candidates;
    }

    /// Frees the blocks of what has left, and those in the surround that are to have another size.
    fn release(&mut self, before: &[(ScenePatch, Block)]) {
        let around = |patch: &ScenePatch| {
            let at = self.around.binary_search_by_key(patch, |(patch, _)| *patch);
            at.ok().map(|at| self.around[at].1)
        };
        let mut live = self.live.iter().peekable();
        for (patch, block) in before {
            while live.next_if(|live| *live < patch).is_some() {}
            let is_live = live.next_if(|live| *live == patch).is_some();
            if !is_live {
                let state = &mut self.states[patch.index()];
                (state.follows, state.copied_pixels) = (None, [0.0; 2]);
            }
            if block.is_stored() {
                continue;
            }
            let stays = is_live || around(patch).is_some_and(|size| block.size == size);
            if !stays {
                self.states[patch.index()].block = None;
                self.atlas.free(*block);
            }
        }
    }

    fn shape(&self, patch: ScenePatch) -> Shape {
        let state = &self.states[patch.index()];
        let block = state.block.map(|block| block.size).zip(state.follows);
        Shape { extent: state.sized_extent(), extent_density: state.extent_density, block }
    }

    /// What becomes of each block in view, in patch order.
    fn turns(&mut self) -> Vec<Turn> {
        let density = self.sized_for();
        let mut turns = std::mem::take(&mut self.scratch.turns);
        turns.clear();
        turns.extend(self.live.iter().map(|patch| self.shape(*patch).turn(*patch, density, self.new_part)));
        turns
    }

    /// Gives every patch in view a block. Those whose turn it is have what is asked for; where that finds no place, who has its
    /// turn gives up texels instead.
    fn place_live(&mut self) {
        let turns = self.turns();
        let (mut chosen, mut sizes) =
            (std::mem::take(&mut self.scratch.chosen), std::mem::take(&mut self.scratch.sizes));
        let are_all = have_their_turn(&turns, self.most_resized_texels, &mut chosen);
        let mut have_turn = chosen.iter().peekable();
        let mut has_turn = |turn: &Turn| have_turn.next_if(|chosen| chosen.patch == turn.patch).is_some();
        sizes.clear();
        sizes.extend(turns.iter().map(|turn| if has_turn(turn) { turn.after } else { turn.before }));
        let texels = |size: &BlockSize| u64::from(size.texels());
        let settled = self.share(turns.iter().map(|turn| texels(&turn.after)).sum());
        self.settled_share = 1.0 - self.limit() + settled;
        let fits =
            self.share(sizes.iter().map(texels).sum()) <= self.limit() && self.try_sizes(&turns, &sizes);
        (self.scratch.turns, self.scratch.chosen, self.scratch.sizes) = (turns, chosen, sizes);
        if !fits {
            return self.make_room();
        }
        let coarser = || self.share_at(self.pressure.step().coarser(), Sizes::Exact);
        if are_all && settled > self.well_filled() && coarser() < settled {
            self.fall(settled);
        }
    }

    /// Lets as few blocks as will do have their turn, those first that give up most, and lowers density until that suffices.
    fn make_room(&mut self) {
        loop {
            let turns = self.turns();
            let mut givers: Vec<&Turn> = turns.iter().filter(|turn| turn.before != turn.least).collect();
            givers.sort_unstable_by_key(|turn| (std::cmp::Reverse(turn.spare_texels()), turn.patch));
            let mut texels: u64 = turns.iter().map(|turn| u64::from(turn.before.texels())).sum();
            let mut fewest = 0;
            while self.share(texels) > self.limit() && fewest < givers.len() {
                texels -= givers[fewest].spare_texels();
                fewest += 1;
            }
            if self.share(texels) <= self.limit() && self.place_with_turns(&turns, &givers, fewest) {
                return;
            }
            let is_coarsest = turns.iter().all(|turn| turn.least.texels() == 1 << (2 * BLOCK_MIN_LOG2));
            if is_coarsest && !self.around.is_empty() {
                self.release_around();
                self.around.clear();
            } else {
                self.fall(self.share(texels));
            }
        }
    }

    /// Places all blocks where so many of `givers` have their turn, or some more.
    fn place_with_turns(&mut self, turns: &[Turn], givers: &[&Turn], fewest: usize) -> bool {
        let mut count = fewest;
        loop {
            let mut giving: Vec<ScenePatch> = givers[..count].iter().map(|turn| turn.patch).collect();
            giving.sort_unstable();
            let gives = |turn: &Turn| giving.binary_search(&turn.patch).is_ok();
            let sizes: Vec<BlockSize> =
                turns.iter().map(|turn| if gives(turn) { turn.least } else { turn.before }).collect();
            if self.try_sizes(turns, &sizes) {
                return true;
            }
            if count == givers.len() {
                return false;
            }
            count = (2 * count).max(count + least_turns(turns.len())).min(givers.len());
        }
    }

    /// Places blocks of these sizes, or changes nothing. Blocks that keep their size keep their place.
    fn try_sizes(&mut self, turns: &[Turn], sizes: &[BlockSize]) -> bool {
        let size_now = |patch: ScenePatch| self.states[patch.index()].block.map(|block| block.size);
        let all = turns.iter().zip(sizes).map(|(turn, size)| (turn.patch, *size));
        let mut waiting = std::mem::take(&mut self.scratch.waiting);
        waiting.clear();
        waiting.extend(all.filter(|(patch, size)| size_now(*patch) != Some(*size)));
        // Ties go in patch order, neighbours side by side.
        waiting.sort_unstable_by_key(|(patch, size)| (size.allocation_order(), *patch));
        let mut fits = self.try_allocate(&waiting);
        if !fits && !self.around.is_empty() {
            self.release_around();
            fits = self.try_allocate(&waiting);
        }
        self.scratch.waiting = waiting;
        if fits {
            let density = self.sized_for();
            let has_turned = |(turn, size): &(&Turn, &BlockSize)| turn.after == **size || turn.now.is_none();
            for (turn, size) in turns.iter().zip(sizes).filter(has_turned) {
                let part = if turn.after == *size { 1.0 } else { self.new_part };
                self.states[turn.patch.index()].follows = Some(density * part);
            }
        }
        fits
    }

    /// Blocks of these sizes in place of what the patches have, in this order, or nothing at all.
    fn try_allocate(&mut self, waiting: &[(ScenePatch, BlockSize)]) -> bool {
        let Self { atlas, states, scratch: Scratch { old, .. }, .. } = self;
        old.clear();
        old.extend(waiting.iter().map(|(patch, _)| states[patch.index()].block.take()));
        old.iter().flatten().for_each(|block| atlas.free(*block));
        for (patch, size) in waiting {
            let block = &mut states[patch.index()].block;
            *block = atlas.allocate(*size);
            if block.is_none() {
                for (patch, _) in waiting {
                    states[patch.index()].block.take().into_iter().for_each(|block| atlas.free(block));
                }
                for ((patch, _), block) in waiting.iter().zip(old) {
                    assert!(block.is_none_or(|block| atlas.take(block)), "it was there before");
                    states[patch.index()].block = *block;
                }
                return false;
            }
        }
        true
    }

    /// By how what is placed now differs from before, in patch order.
    fn changes<'a>(
        &'a self,
        before: &'a [(ScenePatch, Block)],
    ) -> impl Iterator<Item = PlacementChange> + 'a {
        let was = before.iter().map(|(patch, block)| PlacementChange { patch: *patch, block: Some(*block) });
        let is = self.all_placed().map(|placed| (placed.patch, placed.block));
        let mut before = was.clone().peekable();
        let gone = was.map(|change| PlacementChange { block: None, ..change });
        let placed = is.map(|(patch, block)| PlacementChange { patch, block: Some(block) });
        // Of a patch that is in both lists the second is given.
        merged(gone, placed, |a, b| a.patch.cmp(&b.patch)).filter(move |change| {
            while before.next_if(|old| old.patch < change.patch).is_some() {}
            before.next_if(|old| old.patch == change.patch).and_then(|old| old.block) != change.block
        })
    }

    /// The surround's patches with their blocks in the atlas, ascending.
    pub(crate) fn around(&self) -> impl Iterator<Item = (ScenePatch, Block)> + '_ {
        self.around.iter().filter_map(|(patch, _)| Some((*patch, self.states[patch.index()].block?)))
    }

    /// Patches in view, and those held, with their blocks in the atlas, ascending.
    pub fn live(&self) -> impl Iterator<Item = (ScenePatch, Block)> + '_ {
        self.live.iter().filter_map(|patch| Some((*patch, self.states[patch.index()].block?)))
    }

    /// Both, and what is shown from the store, ascending.
    pub(crate) fn all_placed(&self) -> impl Iterator<Item = Placed> + '_ {
        let placed = |is_around| move |(patch, block)| Placed { patch, block, is_around, is_hidden: false };
        let by_patch = |a: &Placed, b: &Placed| a.patch.cmp(&b.patch);
        let in_atlas = merged(self.live().map(placed(false)), self.around().map(placed(true)), by_patch);
        merged(in_atlas, self.served.iter().copied(), by_patch)
    }

    /// Patches in view, and those held, with a block.
    #[cfg(test)]
    pub(crate) fn live_count(&self) -> usize {
        self.live.len()
    }

    /// What the blocks are like in each cell of the atlas: [`Atlas::cell_extents`].
    pub(crate) fn cell_extents(&self) -> &[u32] {
        self.atlas.cell_extents()
    }

    /// Part of the atlas inside blocks, 0..1.
    pub fn used_share(&self) -> f32 {
        self.share(self.atlas.used_texels())
    }

    fn share(&self, texels: u64) -> f32 {
        let [width, height] = self.atlas.extent_texels();
        texels as f32 / (width * height) as f32
    }

    /// Part of the atlas that blocks take when all have had their turn, 0..1.
    pub(crate) fn settled_share(&self) -> f32 {
        self.settled_share
    }

    /// Of the texels for a pixel that are asked for, the part that blocks are sized for; below 1 under pressure.
    pub(crate) fn density(&self) -> f32 {
        self.pressure.step().0.min(self.most_growth())
    }

    /// Texels for a pixel that blocks are sized for.
    fn sized_for(&self) -> f32 {
        self.asked * self.density()
    }

    /// So many times the texels for a pixel that are asked for, and the store holds what was in view lately.
    pub(crate) fn most_growth(&self) -> f32 {
        self.store.most_density() / self.asked
    }

    /// How often the atlas was full and everything became coarser.
    pub(crate) fn coarsened(&self) -> u32 {
        self.coarsened
    }

    /// Patches that a view of the last update shows and that have no block, because there is no room for so many.
    pub(crate) fn dropped(&self) -> usize {
        self.dropped
    }
}

#[cfg(test)]
mod tests;
