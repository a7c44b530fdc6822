//! Level selection's second half: from projected extents to block sizes, with hysteresis, and the placement of the
//! resulting blocks in the atlas. Pure and total: a full atlas coarsens, it never fails.
//!
//! It coarsens before it is full, a few blocks with each update; only what comes into view faster than that makes it coarsen at
//! once, and then as few blocks as will do.

use crate::atlas::allocator::Atlas;
use crate::atlas::capacity::{Candidate, Chooser};
use crate::atlas::placement::Placed;
use crate::atlas::placement::PlacementChange;
use crate::atlas::sizing::{Shape, Turn, have_their_turn, least_turns, wanted_size};
use crate::atlas::surround::{Kept, SURROUND_DENSITY, Surround};
use crate::pacing::pressure::{Level, Pressure};
use crate::pacing::room::Room;
use crate::scene::geometry::Geometry;
use crate::scene::numbering::ScenePatch;
use crate::support::merged::merged;
use crate::visibility::holding::HOLD_UPDATES;
use crate::visibility::lod_set::{Look, Looks};
use shadecast_protocol::atlas::{AtlasExtent, Block, BlockSize};
use shadecast_protocol::limits::BLOCK_MIN_LOG2;
use shadecast_shaders::generated::SeenGpu;

/// Where not all can be shown, a patch seen within this many updates counts as in view: one that flickers in the ID
/// buffer does not come and go.
const IN_VIEW_UPDATES: u32 = 3;
/// Densities under pressure: each is this part of the one above.
const COARSEN: f32 = 0.96;
/// Blocks in view may take this part of the atlas: beyond it density falls.
const WELL_FILLED: f32 = 0.9;
/// A higher density must leave the blocks at most this part of what found no place when density fell. Far enough from
/// 1 that extents which tremble by a few percent stay on one density.
const ROOMY: f32 = 0.85;
/// What found no place because free texels were scattered says little: it counts as at least this part of the atlas.
const LEAST_OVERFLOW_SHARE: f32 = 0.8;

/// Of the texels for a pixel that are asked for, a part.
#[derive(Clone, Copy, Debug, PartialEq)]
struct DensityLevel(f32);

impl DensityLevel {
    fn coarser(self) -> Self {
        Self(self.0 * COARSEN)
    }
}

impl Level for DensityLevel {
    fn finer(self) -> Option<Self> {
        (self.0 < 1.0).then(|| Self((self.0 / COARSEN).min(1.0)))
    }
}

/// Which patch has which block.
#[derive(Clone, Debug)]
pub struct Layout {
    atlas: Atlas,
    chooser: Chooser,
    states: Vec<State>,
    /// Patches that were seen within the last [`HOLD_UPDATES`], ascending: those of levels too that are not shown yet.
    recent: Vec<ScenePatch>,
    /// Patches with a block, ascending: what is in view, or was lately.
    live: Vec<ScenePatch>,
    /// What could come into view.
    surround: Surround,
    /// Of that, the patches with a block, or that are to have one, and its size; ascending.
    around: Vec<(ScenePatch, BlockSize)>,
    /// Texels for a pixel that views are measured with.
    asked: f32,
    /// Of those, the part that blocks are to have.
    pressure: Pressure<DensityLevel>,
    /// Part of the atlas that blocks take when all have had their turn.
    settled_share: f32,
    /// What part of the atlas the blocks would have taken that found no place when density fell last.
    overflow_share: f32,
    /// What part of the atlas blocks took when density rose last.
    share_at_rise: f32,
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
}

/// Whether a block keeps its size while that will do, or takes the size that its extent alone asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sizes {
    Kept,
    Exact,
}

/// What the predicted views show of what was looked at.
#[derive(Clone, Copy, Debug)]
pub struct Visible<'a> {
    /// Whose entries these are.
    pub looks: &'a Looks,
    /// What is visible, ascending by entry: with the patch's largest extent, width | height << 16 in texels.
    pub seen: &'a [SeenGpu],
}

impl<'a> Visible<'a> {
    /// The patches that are visible, ascending, with width and height in texels, and their instance.
    fn patches(self) -> impl Iterator<Item = (usize, ScenePatch, [u16; 2])> + 'a {
        let mut looks = self.looks.all().iter().peekable();
        self.seen.iter().map(move |SeenGpu { entry, extent_texels }| {
            while looks.next_if(|look| look.entries().end <= *entry as usize).is_some() {}
            let look = looks.peek().expect("an entry of what is looked at");
            let patch = ScenePatch(look.patches.first.0 + entry - look.first_entry);
            (look.instance, patch, [*extent_texels as u16, (extent_texels >> 16) as u16])
        })
    }
}

impl Layout {
    /// For `patches` patches in an empty atlas.
    pub fn new(atlas_extent: AtlasExtent, patches: usize) -> Self {
        Self {
            atlas: Atlas::new(atlas_extent),
            chooser: Chooser::default(),
            states: vec![State::default(); patches],
            recent: Vec::new(),
            live: Vec::new(),
            surround: Surround::new(0.0),
            around: Vec::new(),
            asked: 1.0,
            pressure: Pressure::new(DensityLevel(1.0)),
            settled_share: 0.0,
            overflow_share: 1.0,
            share_at_rise: 1.0,
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

    /// At the coarsest every block is of the smallest size; more patches than that cannot have one.
    pub(crate) fn most_blocks(atlas_extent: AtlasExtent) -> u32 {
        (atlas_extent.width() * atlas_extent.height()) >> (2 * BLOCK_MIN_LOG2)
    }

    /// A new update begins, whose views are measured with so many texels for a pixel.
    pub fn begin(&mut self, asked: f32) {
        self.update += 1;
        self.asked = asked;
    }

    /// Takes in what this update's views show; if it looks more than once, the last time counts.
    pub fn see(&mut self, visible: Visible<'_>) {
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

    /// Of a level that was looked at, the patches that should be there before it is shown, ascending.
    pub(crate) fn seen_of(&self, look: &Look) -> &[ScenePatch] {
        let at = |number: u32| self.recent.partition_point(|patch| patch.0 < number);
        &self.recent[at(look.patches.first.0)..at(look.patches.end())]
    }

    /// Of what is shown, the patches that were seen lately, ascending, with their instance.
    pub fn shown<'a>(&'a self, looks: &'a Looks) -> impl Iterator<Item = (usize, ScenePatch)> + 'a {
        looks.shown_of(&self.recent)
    }

    /// Whether a client with this room can be shown all that this update's views see of what is shown.
    pub(crate) fn has_room(&mut self, geometry: &impl Geometry, looks: &Looks, room: Room) -> bool {
        let (states, update) = (&self.states, self.update);
        let in_view = looks.shown_of(&self.recent).map(|(_, patch)| patch);
        let in_view = in_view.filter(|patch| states[patch.index()].last_seen == update);
        self.chooser.all_fit(geometry, room, in_view)
    }

    /// Places the patches of what is shown that are visible, and those seen within the last
    /// [`HOLD_UPDATES`]; where these are too many for the client's room, those that matter most on screen. `room` has no more patches
    /// than [`Layout::most_blocks`]. `changes` becomes what changed, in patch order.
    pub fn place(
        &mut self,
        geometry: &impl Geometry,
        looks: &Looks,
        room: Room,
        changes: &mut Vec<PlacementChange>,
    ) {
        let mut before = std::mem::take(&mut self.scratch.before);
        before.clear();
        before.extend(self.all_placed().map(|placed| (placed.patch, placed.block)));
        self.choose(geometry, looks, room);
        self.choose_around(geometry, looks, room);
        self.release(&before);
        self.recover();
        self.place_live();
        self.place_around(&before);
        changes.clear();
        changes.extend(self.changes(&before));
        self.scratch.before = before;
    }

    /// Chooses who is to have a block.
    fn choose(&mut self, geometry: &impl Geometry, looks: &Looks, room: Room) {
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
        candidates.extend(looks.shown_of(&self.recent).map(candidate));
        let is_visible =
            |candidate: &&Candidate| self.states[candidate.patch.index()].last_seen == self.update;
        let visible = candidates.iter().filter(is_visible).count();
        self.chooser.choose(geometry, room, &mut candidates);
        self.dropped = visible - candidates.iter().filter(is_visible).count();
        self.live.clear();
        self.live.extend(candidates.iter().map(|candidate| candidate.patch));
        self.scratch.candidates = candidates;
    }

    /// Chooses what of the surround is to have a block, of levels that are shown.
    fn choose_around(&mut self, geometry: &impl Geometry, looks: &Looks, room: Room) {
        self.around.clear();
        if !self.surround.is_kept() {
            return;
        }
        let left = self.chooser.left_beside(geometry, room, self.live.iter().copied());
        let Scratch { kept, .. } = &mut self.scratch;
        kept.clear();
        let shown = looks.shown_among(self.surround.seen().iter(), |seen| seen.patch);
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
            kept.push(Kept { candidate, texels: u64::from(size.texels()) });
            self.around.push((seen.patch, size));
        }
        let [width, height] = self.atlas.extent_texels();
        let chosen = self.surround.choose(geometry, kept, room, left, u64::from(width) * u64::from(height));
        self.around.retain(|(patch, _)| chosen.binary_search_by_key(patch, |chosen| chosen.patch).is_ok());
    }

    /// Frees the blocks of what has left, and those in the surround that are to have another size.
    fn release(&mut self, before: &[(ScenePatch, Block)]) {
        let around = |patch: &ScenePatch| {
            let at = self.around.binary_search_by_key(patch, |(patch, _)| *patch);
            at.ok().map(|at| self.around[at].1)
        };
        for (patch, block) in before {
            let is_live = self.live.binary_search(patch).is_ok();
            if !is_live {
                self.states[patch.index()].follows = None;
            }
            let stays = is_live || around(patch).is_some_and(|size| block.size == size);
            if !stays {
                self.states[patch.index()].block = None;
                self.atlas.free(*block);
            }
        }
    }

    /// Places what of the surround has no block, where it was if that is free still; what finds no place is left out.
    fn place_around(&mut self, before: &[(ScenePatch, Block)]) {
        let Scratch { waiting, .. } = &mut self.scratch;
        waiting.clone_from(&self.around);
        waiting.retain(|(patch, size)| {
            let at = before.binary_search_by_key(patch, |(patch, _)| *patch);
            let was = at.ok().map(|at| before[at].1).filter(|block| block.size == *size);
            let state = &mut self.states[patch.index()];
            if state.block.is_none() {
                state.block = was.filter(|block| self.atlas.take(*block));
            }
            state.block.is_none()
        });
        waiting.sort_unstable_by_key(|(patch, size)| (std::cmp::Reverse(size.texels()), *size, *patch));
        for (patch, size) in waiting {
            self.states[patch.index()].block = self.atlas.allocate(*size);
        }
        let states = &self.states;
        self.around.retain(|(patch, _)| states[patch.index()].block.is_some());
    }

    /// Frees all blocks of the surround: what is in view goes before it.
    fn release_around(&mut self) {
        for (patch, _) in &self.around {
            let block = self.states[patch.index()].block.take();
            block.into_iter().for_each(|block| self.atlas.free(block));
        }
    }

    /// Part of the atlas that what is in view may take.
    fn limit(&self) -> f32 {
        1.0 - self.share(self.around.iter().map(|(_, size)| u64::from(size.texels())).sum())
    }

    /// Of that, what density is chosen for.
    fn well_filled(&self) -> f32 {
        self.limit().min(WELL_FILLED)
    }

    /// Part of the atlas inside blocks of what is in view.
    fn in_view_share(&self) -> f32 {
        let block = |patch: &ScenePatch| self.states[patch.index()].block;
        self.share(self.live.iter().filter_map(block).map(|block| u64::from(block.size.texels())).sum())
    }

    /// Takes the highest density that leaves room, once there has been room for a higher one for a while.
    fn recover(&mut self) {
        let mut pressure = self.pressure;
        if pressure.recover(self.update, |density| self.is_roomy(density)) {
            self.share_at_rise = self.share_at(pressure.level(), Sizes::Kept);
        }
        self.pressure = pressure;
    }

    fn is_roomy(&self, density: DensityLevel) -> bool {
        let allowed = ROOMY * self.overflow_share.min(self.well_filled());
        let fits = |sizes| self.share_at(density, sizes) <= allowed;
        // Blocks that keep their size now may still grow to the exact one.
        self.in_view_share() <= allowed && fits(Sizes::Kept) && fits(Sizes::Exact)
    }

    /// Part of the atlas that what is in view would take at a density.
    fn share_at(&self, density: DensityLevel, sizes: Sizes) -> f32 {
        let texels = |patch: &ScenePatch| {
            let shape = self.shape(*patch);
            let now = shape.block.filter(|_| sizes == Sizes::Kept).map(|(size, _)| size);
            u64::from(wanted_size(shape.extent_at(self.asked * density.0), now).texels())
        };
        self.share(self.live.iter().map(texels).sum())
    }

    fn shape(&self, patch: ScenePatch) -> Shape {
        let State { block, extent, extent_density, follows, .. } = self.states[patch.index()];
        Shape { extent, extent_density, block: block.map(|block| block.size).zip(follows) }
    }

    /// What becomes of each block in view, in patch order.
    fn turns(&mut self) -> Vec<Turn> {
        let density = self.asked * self.density();
        let mut turns = std::mem::take(&mut self.scratch.turns);
        turns.clear();
        turns.extend(self.live.iter().map(|patch| self.shape(*patch).turn(*patch, density)));
        turns
    }

    /// Gives every patch in view a block. Those whose turn it is have what is asked for; where that finds no place, who has its
    /// turn gives up texels instead.
    fn place_live(&mut self) {
        let turns = self.turns();
        let (mut chosen, mut sizes) =
            (std::mem::take(&mut self.scratch.chosen), std::mem::take(&mut self.scratch.sizes));
        let are_all = have_their_turn(&turns, &mut chosen);
        let has_turn = |turn: &Turn| chosen.binary_search_by_key(&turn.patch, |turn| turn.patch).is_ok();
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
        let coarser = || self.share_at(self.pressure.level().coarser(), Sizes::Exact);
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

    /// Density falls; sizes follow in turn.
    fn fall(&mut self, share: f32) {
        self.coarsened += 1;
        let is_within_trial = self.pressure.rise(self.update, self.pressure.level().coarser());
        self.overflow_share = share.clamp(LEAST_OVERFLOW_SHARE, 1.0);
        if is_within_trial {
            self.overflow_share = self.overflow_share.min(self.share_at_rise);
        }
    }

    /// Places blocks of these sizes, or changes nothing. Blocks that keep their size keep their place.
    fn try_sizes(&mut self, turns: &[Turn], sizes: &[BlockSize]) -> bool {
        let size_now = |patch: ScenePatch| self.states[patch.index()].block.map(|block| block.size);
        let all = turns.iter().zip(sizes).map(|(turn, size)| (turn.patch, *size));
        let mut waiting = std::mem::take(&mut self.scratch.waiting);
        waiting.clear();
        waiting.extend(all.filter(|(patch, size)| size_now(*patch) != Some(*size)));
        // Large ones first: they are the hardest to place. Ties go in patch order, neighbours side by side.
        waiting.sort_unstable_by_key(|(patch, size)| (std::cmp::Reverse(size.texels()), *size, *patch));
        let mut fits = self.try_allocate(&waiting);
        if !fits && !self.around.is_empty() {
            self.release_around();
            fits = self.try_allocate(&waiting);
        }
        self.scratch.waiting = waiting;
        if fits {
            let density = self.asked * self.density();
            let has_turned = |(turn, size): &(&Turn, &BlockSize)| turn.after == **size || turn.now.is_none();
            for (turn, _) in turns.iter().zip(sizes).filter(has_turned) {
                self.states[turn.patch.index()].follows = Some(density);
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
        let was = before.iter().map(|(patch, block)| (*patch, *block, false));
        let is = self.all_placed().map(|placed| (placed.patch, placed.block, true));
        // Of a patch that is in both lists the second is given.
        let old = |patch: ScenePatch| {
            before.binary_search_by_key(&patch, |(p, _)| *p).ok().map(|index| before[index].1)
        };
        let change = move |(patch, block, is_placed): (ScenePatch, Block, bool)| PlacementChange {
            patch,
            block: is_placed.then_some(block),
        };
        merged(was, is, |a, b| a.0.cmp(&b.0))
            .map(change)
            .filter(move |change| old(change.patch) != change.block)
    }

    /// The surround's patches with their blocks, ascending.
    pub fn around(&self) -> impl Iterator<Item = (ScenePatch, Block)> + '_ {
        self.around.iter().filter_map(|(patch, _)| Some((*patch, self.states[patch.index()].block?)))
    }

    /// Patches in view, and those held, with their blocks, ascending.
    pub fn live(&self) -> impl Iterator<Item = (ScenePatch, Block)> + '_ {
        self.live.iter().filter_map(|patch| Some((*patch, self.states[patch.index()].block?)))
    }

    /// Both, ascending.
    pub(crate) fn all_placed(&self) -> impl Iterator<Item = Placed> + '_ {
        let placed = |is_around| move |(patch, block)| Placed { patch, block, is_around };
        merged(self.live().map(placed(false)), self.around().map(placed(true)), |a, b| a.patch.cmp(&b.patch))
    }

    /// Patches in view, and those held, with a block.
    #[cfg(test)]
    pub(crate) fn live_count(&self) -> usize {
        self.live.len()
    }

    /// What the blocks are like in each cell of the atlas: [`Atlas::cell_extents`].
    pub fn cell_extents(&self) -> &[u32] {
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
    pub fn density(&self) -> f32 {
        self.pressure.level().0
    }

    /// How often the atlas was full and everything became coarser.
    pub(crate) fn coarsened(&self) -> u32 {
        self.coarsened
    }

    /// Patches that a view of the last update shows and that have no block, because there is no room for so many.
    pub fn dropped(&self) -> usize {
        self.dropped
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pacing::pressure::RECOVER_AFTER_UPDATES;
    use crate::scene::geometry::test_geometry::Loose;
    use crate::scene::numbering::{InstanceSize, Numbering};
    use crate::visibility::lod_set::Levels;
    use std::collections::BTreeMap;

    const ROOM: Room = Room { patches: 100_000, vertices: 100_000, triangles: 600_000 };

    fn layout([width, height]: [u32; 2], patches: usize) -> Layout {
        Layout::new(AtlasExtent::new(width, height).expect("an atlas"), patches)
    }

    fn placed(layout: &mut Layout, geometry: &impl Geometry, looks: &Looks) -> Vec<PlacementChange> {
        let [width, height] = layout.atlas.extent_texels();
        let patches = ROOM.patches.min((width * height) >> (2 * BLOCK_MIN_LOG2));
        placed_in(Room { patches, ..ROOM }, layout, geometry, looks)
    }

    fn placed_in(
        room: Room,
        layout: &mut Layout,
        geometry: &impl Geometry,
        looks: &Looks,
    ) -> Vec<PlacementChange> {
        let mut changes = Vec::new();
        layout.place(geometry, looks, room, &mut changes);
        changes
    }

    fn place(layout: &mut Layout, extents: &[u32]) -> Vec<PlacementChange> {
        let looks = Looks::of_one(extents.len() as u32);
        layout.begin(1.0);
        layout.see(Visible { looks: &looks, seen: &seen(extents) });
        placed(layout, &Loose { patches: extents.len() as u32 }, &looks)
    }

    /// By entry an extent, 0 where it is not visible.
    fn seen(extents: &[u32]) -> Vec<SeenGpu> {
        let all = (0..).zip(extents.iter().copied());
        let visible = all.filter(|(_, extent)| *extent != 0);
        visible.map(|(entry, extent_texels)| SeenGpu { entry, extent_texels }).collect()
    }

    fn pack(width: u32, height: u32) -> u32 {
        width | height << 16
    }

    fn random_extents(seed: u64, patches: usize, largest: u64) -> Vec<u32> {
        let mut state = seed;
        (0..patches)
            .map(|_| {
                state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                let visible = state >> 60 > 4;
                let side = |shift: u32| (1 + (state >> shift) % largest) as u32;
                if visible { pack(side(20), side(36)) } else { 0 }
            })
            .collect()
    }

    fn assert_sound(layout: &Layout, extents: &[u32]) {
        let blocks: Vec<_> = layout.live().collect();
        assert_eq!(blocks.len(), layout.live_count(), "every live patch has a block");
        for (patch, packed) in extents.iter().enumerate() {
            let has = blocks.binary_search_by_key(&ScenePatch::at(patch), |(p, _)| *p).is_ok();
            assert!(*packed == 0 || has, "patch {patch} is visible and has no block");
        }
        let used: u64 = blocks.iter().map(|(_, b)| u64::from(b.size.texels())).sum();
        assert_eq!(used, layout.atlas.used_texels());
    }

    #[test]
    fn unchanged_patch_and_level_keep_their_block() {
        let mut layout = layout([512, 512], 200);
        let mut extents = random_extents(3, 200, 20);
        place(&mut layout, &extents);
        let before: Vec<_> = layout.live().filter(|(patch, _)| *patch != ScenePatch(7)).collect();
        extents[7] = pack(60, 3);
        place(&mut layout, &extents);
        assert!(before.iter().all(|b| layout.live().any(|now| now == *b)));
    }

    /// An instance of two levels: 40 patches, of which it shows those, and then 20 more.
    fn two_levels(shown: usize, next: Option<usize>) -> Looks {
        let size = InstanceSize { patches: vec![40, 20], ..InstanceSize::default() };
        Looks::new(&Numbering::new(&[size]), [Some(Levels { shown, next })])
    }

    fn live(layout: &Layout) -> Vec<u32> {
        layout.live().map(|(patch, _)| patch.0).collect()
    }

    #[test]
    fn levels_take_turns_with_one_update_and_never_lie_beside_each_other() {
        let (mut layout, geometry) = (layout([512, 512], 60), Loose { patches: 60 });
        let mut update = |looks: &mut Looks, switches: bool| {
            layout.begin(1.0);
            let extents = vec![pack(9, 9); looks.entries()];
            layout.see(Visible { looks, seen: &seen(&extents) });
            if switches {
                looks.switch(0);
            }
            let changes = placed(&mut layout, &geometry, looks);
            (live(&layout), changes.len())
        };
        let (fine, coarse): (Vec<u32>, Vec<u32>) = ((0..40).collect(), (40..60).collect());
        assert_eq!(update(&mut two_levels(0, None), false), (fine.clone(), 40));
        assert_eq!(update(&mut two_levels(0, Some(1)), false), (fine.clone(), 0), "it is only looked at");
        assert_eq!(update(&mut two_levels(0, Some(1)), true), (coarse.clone(), 60), "all at once");
        assert_eq!(update(&mut two_levels(1, None), false), (coarse, 0), "nothing is held of the other");
        assert_eq!(update(&mut two_levels(1, Some(0)), true), (fine, 60));
    }

    #[test]
    fn a_level_that_is_not_shown_yet_gathers_what_several_updates_see() {
        let (mut layout, geometry) = (layout([512, 512], 60), Loose { patches: 60 });
        let looks = two_levels(0, Some(1));
        for patch in 0..3 {
            layout.begin(1.0);
            let mut extents = vec![pack(9, 9); 60];
            extents[40..].fill(0);
            extents[45 + patch] = pack(5, 5);
            layout.see(Visible { looks: &looks, seen: &seen(&extents) });
            placed(&mut layout, &geometry, &looks);
        }
        let next = looks.next().next().expect("the other level");
        assert_eq!(layout.seen_of(next), [45, 46, 47].map(ScenePatch));
        assert!(layout.has_room(&geometry, &looks, ROOM));
    }

    #[test]
    fn a_full_atlas_coarsens_and_places_everything_that_is_visible() {
        let mut layout = layout([512, 512], 3000);
        for seed in 0..12 {
            let extents = random_extents(seed, 3000, 90);
            place(&mut layout, &extents);
            assert_sound(&layout, &extents);
        }
        assert!(layout.coarsened() > 0 && layout.density() < 1.0);
    }

    #[test]
    fn the_first_forced_coarsening_finds_the_atlas_well_used() {
        let mut layout = layout([1024, 1024], 4000);
        let mut share = 0.0;
        for count in (100..4000).step_by(20) {
            let mut extents = random_extents(5, 4000, 40);
            extents[count..].fill(0);
            place(&mut layout, &extents);
            if layout.coarsened() > 0 {
                break;
            }
            share = layout.used_share();
        }
        println!("atlas use before the first coarsening: {:.1} %", share * 100.0);
        assert!(layout.coarsened() > 0 && share >= 0.85, "{share}");
    }

    #[test]
    fn a_patch_out_of_sight_stays_for_the_hold_and_then_goes() {
        let mut layout = layout([512, 512], 3);
        place(&mut layout, &[pack(9, 9), 0, 0]);
        for _ in 0..HOLD_UPDATES {
            assert!(place(&mut layout, &[0, 0, 0]).is_empty());
        }
        assert_eq!(place(&mut layout, &[0, 0, 0]), [PlacementChange { patch: ScenePatch(0), block: None }]);
        assert_eq!(layout.live_count(), 0);
    }

    #[test]
    fn an_extent_that_trembles_at_a_power_of_two_does_not_change_its_block() {
        let mut layout = layout([512, 512], 1);
        place(&mut layout, &[pack(14, 15)]);
        for step in 0..20 {
            let extent = if step % 2 == 0 { 14 } else { 13 };
            assert!(place(&mut layout, &[pack(extent, 15 - step % 3)]).is_empty());
        }
        assert_eq!(place(&mut layout, &[pack(4, 4)]).len(), 1, "clearly smaller shrinks");
    }

    #[test]
    fn what_changed_is_exactly_what_the_blocks_say() {
        let mut layout = layout([512, 512], 1500);
        let mut mirror: BTreeMap<ScenePatch, Block> = Default::default();
        for seed in 0..40 {
            for change in place(&mut layout, &random_extents(seed, 1500, 60)) {
                match change.block {
                    Some(block) => mirror.insert(change.patch, block),
                    None => mirror.remove(&change.patch),
                };
            }
            assert!(layout.live().eq(mirror.iter().map(|(p, b)| (*p, *b))), "seed {seed}");
        }
    }

    /// Extents that differ from `base` by at most 4 %, each patch in its own rhythm.
    fn trembling(base: &[u32], update: usize) -> Vec<u32> {
        let side = |texels: u32, phase: usize| {
            let swing = (((update + phase) % 7) as f32 - 3.0) / 3.0;
            (texels as f32 * (1.0 + 0.04 * swing)).round().max(1.0) as u32
        };
        let one = |(patch, packed): (usize, &u32)| match packed {
            0 => 0,
            _ => pack(side(packed & 0xffff, 3 * patch), side(packed >> 16, 5 * patch + 1)),
        };
        base.iter().enumerate().map(one).collect()
    }

    fn sizes(layout: &Layout) -> Vec<(ScenePatch, Block)> {
        layout.live().collect()
    }

    #[test]
    fn under_pressure_extents_that_tremble_change_no_block() {
        for (seed, largest) in [(1, 90), (2, 60), (3, 150), (4, 30)] {
            let (mut layout, base) = (layout([512, 512], 3000), random_extents(seed, 3000, largest));
            // Two rounds of the rhythm, so that each extent was at its largest, and the wait for room after that.
            let settled = 14 + RECOVER_AFTER_UPDATES as usize;
            let mut last = Vec::new();
            for update in 0..300 {
                let extents = trembling(&base, update);
                let changes = place(&mut layout, &extents);
                assert_sound(&layout, &extents);
                if update > settled {
                    assert_eq!(changes, [], "seed {seed}, update {update}, density {}", layout.density());
                    assert_eq!(sizes(&layout), last);
                }
                last = sizes(&layout);
            }
            assert!(layout.density() < 1.0, "seed {seed}: there is pressure");
            assert!(layout.used_share() > 0.6, "seed {seed}: {}", layout.used_share());
        }
    }

    #[test]
    fn under_pressure_a_real_change_changes_its_block_and_few_others() {
        let (mut layout, mut base) = (layout([512, 512], 3000), random_extents(6, 3000, 60));
        for update in 0..40 {
            place(&mut layout, &trembling(&base, update));
        }
        let (patch, _) = layout.live().next().expect("some are live");
        let before = layout.states[patch.index()].block.expect("it is live").size;
        base[patch.index()] = pack(1, 400);
        let changes = place(&mut layout, &trembling(&base, 40));
        let after = layout.states[patch.index()].block.expect("it is live").size;
        assert!(layout.density() < 1.0 && after.height() > before.height(), "{before:?} {after:?}");
        assert!(changes.iter().any(|change| change.patch == patch));
    }

    #[test]
    fn density_falls_at_once_rises_after_a_while_and_does_not_swing() {
        for seed in 8..14 {
            let (mut layout, base) = (layout([1024, 1024], 3000), random_extents(seed, 3000, 90));
            place(&mut layout, &base);
            let crowded = layout.density();
            assert!(crowded < 0.8, "seed {seed}: at once, {crowded}");
            // Three quarters of the patches go for good.
            let mut fewer = base.clone();
            fewer.iter_mut().enumerate().filter(|(i, _)| i % 4 > 0).for_each(|(_, extent)| *extent = 0);
            let mut densities = vec![crowded];
            for update in 0..200 {
                place(&mut layout, &trembling(&fewer, update));
                densities.push(layout.density());
            }
            println!("seed {seed}: {crowded} to {}, {} used", layout.density(), layout.used_share());
            assert!(densities[200] > 1.3 * crowded, "seed {seed}: {densities:?}");
            let changes = densities.windows(2).filter(|pair| pair[0] != pair[1]).count();
            assert!(changes <= 4, "seed {seed}: {densities:?}");
            assert!(densities[120..].iter().all(|density| *density == densities[120]), "seed {seed}");
        }
    }

    #[test]
    fn coarsening_moves_no_block_that_keeps_its_size() {
        let mut layout = layout([512, 512], 3000);
        let mut coarsened = 0;
        for seed in 0..30 {
            let before = sizes(&layout);
            place(&mut layout, &random_extents(seed, 3000, 20 + 4 * seed));
            for (patch, block) in before {
                let now = layout.states[patch.index()].block;
                assert!(now.is_none_or(|now| now.size != block.size || now == block), "seed {seed}");
            }
            coarsened = layout.coarsened();
        }
        assert!(coarsened > 1);
    }

    #[test]
    fn the_same_extents_give_the_same_blocks() {
        let run = || {
            let mut layout = layout([512, 512], 3000);
            (0..30).map(|seed| place(&mut layout, &random_extents(seed, 3000, 90))).collect::<Vec<_>>()
        };
        assert_eq!(run(), run());
    }

    /// An update in which views see some patches, and a glance others.
    fn place_both(layout: &mut Layout, in_view: &[u32], around: &[u32]) -> Vec<PlacementChange> {
        let looks = Looks::of_one(in_view.len() as u32);
        layout.begin(1.0);
        layout.see(Visible { looks: &looks, seen: &seen(in_view) });
        layout.see_around(Visible { looks: &looks, seen: &seen(around) }, |_| true);
        placed(layout, &Loose { patches: in_view.len() as u32 }, &looks)
    }

    #[test]
    fn what_is_around_has_small_blocks_until_it_is_in_view() {
        let mut layout = layout([512, 512], 20).with_surround(0.25);
        let (mut in_view, around) = (vec![0; 20], vec![pack(60, 60); 20]);
        in_view[3] = pack(60, 60);
        place_both(&mut layout, &in_view, &around);
        assert!(layout.live().map(|(patch, _)| patch.0).eq([3]));
        let small: Vec<_> = layout.around().collect();
        assert_eq!(small.len(), 19);
        assert!(small.iter().all(|(patch, block)| patch.0 != 3 && block.size.width() == 16));
        in_view[4] = pack(60, 60);
        let changes = place_both(&mut layout, &in_view, &around);
        assert!(
            matches!(changes[..], [PlacementChange { patch: ScenePatch(4), block: Some(block) }] if block.size.width() == 64)
        );
        assert_eq!((layout.live_count(), layout.around().count()), (2, 18));
        let used: u64 = layout.live().chain(layout.around()).map(|(_, b)| u64::from(b.size.texels())).sum();
        assert_eq!(used, layout.atlas.used_texels());
    }

    #[test]
    fn what_is_in_view_loses_no_more_than_the_share_to_what_is_around() {
        for seed in 40..44 {
            let alone = random_extents(seed, 3000, 90);
            let in_view: Vec<u32> = alone
                .iter()
                .enumerate()
                .map(|(patch, extent)| if patch % 2 == 0 { *extent } else { 0 })
                .collect();
            let around: Vec<u32> = vec![pack(200, 200); 3000];
            let (mut without, mut with) =
                (layout([512, 512], 3000), layout([512, 512], 3000).with_surround(0.25));
            for _ in 0..60 {
                place(&mut without, &in_view);
                place_both(&mut with, &in_view, &around);
                assert!(
                    in_view
                        .iter()
                        .enumerate()
                        .all(|(patch, extent)| *extent == 0 || with.states[patch].block.is_some()),
                    "seed {seed}"
                );
            }
            let texels: u64 = with.around().map(|(_, block)| u64::from(block.size.texels())).sum();
            assert!(texels > 0 && texels <= 512 * 512 / 4, "seed {seed}: {texels}");
            // Sides go by powers of two, and densities by steps.
            assert!(
                with.density() > 0.75 * without.density(),
                "seed {seed}: {} {}",
                with.density(),
                without.density()
            );
        }
    }

    #[test]
    fn what_is_around_moves_only_where_what_is_in_view_takes_its_place() {
        let mut layout = layout([512, 512], 3000).with_surround(0.25);
        let (mut stayed, mut moved) = (0, 0);
        for seed in 0..120 {
            let mut in_view = random_extents(seed / 4, 3000, 60);
            in_view.iter_mut().step_by(2).for_each(|extent| *extent = 0);
            let before: BTreeMap<ScenePatch, Block> = layout.around().collect();
            place_both(&mut layout, &in_view, &vec![pack(200, 200); 3000]);
            for (patch, block) in layout.around() {
                if let Some(was) = before.get(&patch).filter(|was| was.size == block.size) {
                    (stayed, moved) =
                        (stayed + usize::from(*was == block), moved + usize::from(*was != block));
                }
            }
        }
        println!("{stayed} stayed, {moved} moved");
        assert!(20 * moved < stayed, "{stayed} stayed, {moved} moved");
    }

    #[test]
    fn a_surround_of_patches_that_are_not_of_the_shown_level_has_no_blocks() {
        let size = InstanceSize { patches: vec![20, 10], ..InstanceSize::default() };
        let numbering = Numbering::new(&[size]);
        let mut layout = layout([512, 512], 30).with_surround(0.25);
        let mut show = |level: usize| {
            let looks = Looks::new(&numbering, [Some(Levels { shown: level, next: None })]);
            layout.begin(1.0);
            layout.see(Visible { looks: &looks, seen: &[] });
            layout.see_around(
                Visible { looks: &looks, seen: &seen(&vec![pack(9, 9); looks.entries()]) },
                |_| true,
            );
            placed(&mut layout, &Loose { patches: 30 }, &looks);
            layout.around().map(|(patch, _)| patch.0).collect::<Vec<_>>()
        };
        assert_eq!(show(0), (0..20).collect::<Vec<_>>());
        assert_eq!(show(1), (20..30).collect::<Vec<_>>());
    }

    #[test]
    fn with_too_little_room_the_ground_near_the_viewer_stays_and_what_is_missing_is_counted() {
        let mut layout = Layout::new(AtlasExtent::MIN, 100);
        let room = Room { patches: 20, vertices: 1000, triangles: 1000 };
        let place = |layout: &mut Layout, extents: &[u32]| {
            let looks = Looks::of_one(extents.len() as u32);
            layout.begin(1.0);
            layout.see(Visible { looks: &looks, seen: &seen(extents) });
            placed_in(room, layout, &Loose { patches: 100 }, &looks)
        };
        let mut extents: Vec<u32> = (0..100).map(|patch| pack(3 + patch / 20, 3)).collect();
        extents[0] = pack(300, 200);
        place(&mut layout, &extents);
        assert_eq!((layout.live_count(), layout.dropped()), (20, 80));
        assert!(
            layout.live().any(|(patch, _)| patch.0 == 0) && !layout.live().any(|(patch, _)| patch.0 == 1)
        );
        place(&mut layout, &[vec![extents[0]], vec![0; 99]].concat());
        assert_eq!(layout.dropped(), 0);
    }

    /// Patches all around at 3 m and more, towards which a head walks with 1 m/s: extents of an update, at so many texels for a
    /// pixel.
    fn walking(base: &[u32], update: usize, texels_per_pixel: f32) -> Vec<u32> {
        let one = |(patch, packed): (usize, &u32)| {
            let distance_m = 3.0 + (patch * 37 % 100) as f32 / 20.0 + 40.0 / 30.0;
            let nearer = distance_m / (distance_m - update as f32 / 30.0) * texels_per_pixel;
            // Not all a whole number of texels at the same moment.
            let part = (patch * 61 % 97) as f32 / 97.0;
            let side = |texels: u32| ((texels as f32 - part) * nearer).ceil().max(1.0) as u32;
            if *packed == 0 { 0 } else { pack(side(packed & 0xffff), side(packed >> 16)) }
        };
        base.iter().enumerate().map(one).collect()
    }

    /// An update of these extents, and the part of the blocks that stay in view of which the size changes.
    fn changed_share(layout: &mut Layout, extents: &[u32], asked: f32) -> f32 {
        let before: BTreeMap<ScenePatch, Block> = layout.live().collect();
        let looks = Looks::of_one(extents.len() as u32);
        layout.begin(asked);
        layout.see(Visible { looks: &looks, seen: &seen(extents) });
        placed(layout, &Loose { patches: extents.len() as u32 }, &looks);
        assert_sound(layout, extents);
        let stayed: Vec<_> =
            layout.live().filter_map(|(patch, now)| Some((now, *before.get(&patch)?))).collect();
        assert!(stayed.iter().all(|(now, before)| now.size != before.size || now == before), "it has moved");
        stayed.iter().filter(|(now, before)| now.size != before.size).count() as f32
            / stayed.len().max(1) as f32
    }

    #[test]
    fn few_blocks_change_their_size_in_an_update_while_walking_whatever_is_asked_and_however_full_the_atlas_is()
     {
        for (side, largest, is_full) in
            [(512, 60, true), (512, 90, true), (1024, 60, true), (2048, 20, false)]
        {
            let (mut layout, base) = (layout([side, side], 3000), random_extents(21, 3000, largest));
            let mut shares = Vec::new();
            for update in 0..40 {
                let asked = if (10..25).contains(&update) { std::f32::consts::SQRT_2 } else { 1.0 };
                shares.push(changed_share(&mut layout, &walking(&base, update, asked), asked));
            }
            let (mean, worst) =
                (shares[1..].iter().sum::<f32>() / 39.0, shares[1..].iter().fold(0.0f32, |a, b| a.max(*b)));
            let (density, used) = (layout.density(), layout.used_share());
            println!(
                "{side}, {largest}: mean {:.2} %, worst {:.2} %, density {density}, {used} used",
                100.0 * mean,
                100.0 * worst
            );
            assert!(worst <= 0.05, "{side}, {largest}: {shares:?}");
            assert_eq!(density < 1.0, is_full, "{side}, {largest}: {density}");
        }
    }

    #[test]
    fn what_is_asked_for_is_there_after_a_while() {
        let (mut layout, base) = (layout([2048, 2048], 1000), random_extents(22, 1000, 40));
        let finer: Vec<u32> = base.iter().map(|packed| 2 * packed).collect();
        changed_share(&mut layout, &base, 1.0);
        let coarse_share = layout.used_share();
        let first = changed_share(&mut layout, &finer, 2.0);
        assert!(first > 0.0 && first <= 0.05, "{first}");
        let settled = layout.settled_share();
        assert!(settled > 2.5 * coarse_share, "it says at once what it will come to");
        for _ in 0..40 {
            changed_share(&mut layout, &finer, 2.0);
        }
        assert_eq!(layout.used_share(), settled);
        let mut at_once = Layout::new(AtlasExtent::new(2048, 2048).expect("an atlas"), 1000);
        changed_share(&mut at_once, &finer, 2.0);
        let is_as_large = |(patch, block): (ScenePatch, Block)| {
            let now = layout.states[patch.index()].block.expect("it is in view");
            now.size.texels() >= block.size.texels() / 2
        };
        assert!(at_once.live().all(is_as_large));
    }

    #[test]
    fn a_surround_gives_way_where_what_is_in_view_takes_all_blocks_of_the_smallest_size() {
        let patches = Layout::most_blocks(AtlasExtent::MIN) as usize;
        let mut layout = layout([512, 512], patches).with_surround(0.25);
        let (mut in_view, around) = (vec![pack(1, 1); patches], vec![pack(500, 500); patches]);
        in_view[patches * 9 / 10..].fill(0);
        for _ in 0..3 {
            place_both(&mut layout, &in_view, &around);
        }
        assert_eq!(layout.live_count(), patches * 9 / 10);
        assert!(layout.live().count() == layout.live_count(), "each has a block");
    }
}
