//! The store: copies of settled blocks in the client's memory, which the server alone manages. Pure.
//!
//! A block in view whose colours have not changed for some updates is copied by the client from the atlas of an update's picture. From the
//! next update on its patch is shown from the store, and its room in the atlas is another's. Copies stay when their patches leave the view,
//! until their place is needed: those go first that were not shown for longest. A place is given to another copy once the client shows no
//! update any more that names it.

use crate::scene::numbering::ScenePatch;
use shadecast_protocol::atlas::allocator::Atlas;
use shadecast_protocol::atlas::{AtlasExtent, Block, BlockAddress, BlockSize};
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::limits::STORE_PAGE_SIDE;
use std::collections::{BTreeMap, VecDeque};

/// Updates since a block was shaded before it settles: a head that turns sees each block anew, and soon.
const SETTLES_AFTER_UPDATES: u32 = 1;
/// The wait doubles each time that a copy turns out stale, so often at most: what keeps changing is cheaper in the atlas.
const MOST_DOUBLED: u8 = 6;
/// Updates whose quantisers are remembered.
const REMEMBERED_UPDATES: usize = 64;
/// A copy is made anew where pictures are finer than when it was made, by so many steps of the quantiser: its error is two thirds.
const FINER_STEPS: u8 = 4;
/// A copy made with this quantiser or a finer one stays.
const FINE_QP: u8 = 20;
/// Part of the texels of the atlas that settle with an update at most: the client copies them in one display frame.
const MOST_SETTLED_PART: u64 = 20;
/// The same for copies that are given up in view with an update, for a finer one.
const MOST_RENEWED_PART: u64 = 16;
/// Steps of width and height together by which a block would be larger than its copy for another to take its place: of pictures coded with
/// [`FINE_QP`] or finer, and of others, where a new block costs more than it shows.
const OUTGROWN_STEPS: u8 = 1;
const OUTGROWN_STEPS_COARSE: u8 = 2;
/// Where there is no place, room is made for so many copies at once.
const EVICTED_TOGETHER: usize = 256;

/// See the module.
#[derive(Clone, Debug, Default)]
pub(crate) struct Store {
    pages: Vec<Atlas>,
    copies: BTreeMap<ScenePatch, Copy>,
    /// Places to be free once an update later than this one is on display.
    leaving: VecDeque<(UpdateId, Block)>,
    /// By patch: the update with which it was shaded last, and one; 0: never.
    shaded: Vec<u32>,
    /// By patch: how often its copy was stale.
    stale: Vec<u8>,
    /// Quantisers of the newest pictures, the last one first.
    qps: VecDeque<(UpdateId, u8)>,
    /// Texels that may still be renewed with this update.
    renewable_texels: u64,
    /// Where the next update begins to look for what may settle.
    next: ScenePatch,
    atlas_texels: u64,
}

/// A block in the store.
#[derive(Clone, Copy, Debug)]
struct Copy {
    block: Block,
    /// The update whose picture it is of.
    settled: UpdateId,
    /// The last update that showed it.
    shown: UpdateId,
    /// The finest quantiser that it was coded with.
    qp: u8,
}

impl Store {
    /// Of so many pages, for a scene of so many patches and an atlas of this extent.
    pub(crate) fn new(pages: u32, patches: usize, atlas: AtlasExtent) -> Self {
        let page =
            AtlasExtent::new(STORE_PAGE_SIDE, STORE_PAGE_SIDE).expect("a page is as large as some atlas");
        Self {
            pages: vec![Atlas::new(page); pages as usize],
            shaded: vec![0; if pages > 0 { patches } else { 0 }],
            stale: vec![0; if pages > 0 { patches } else { 0 }],
            atlas_texels: u64::from(atlas.width()) * u64::from(atlas.height()),
            ..Self::default()
        }
    }

    /// An update begins to be placed.
    pub(crate) fn begin(&mut self) {
        self.renewable_texels = self.atlas_texels / MOST_RENEWED_PART;
    }

    /// The copy that a patch in view is shown from with this update, where there is one. `wanted` says what its block would be, given the
    /// size of the copy. One that is too coarse, or coded coarsely for today, is given up, a few with each update.
    pub(crate) fn serve(
        &mut self,
        patch: ScenePatch,
        update: UpdateId,
        wanted: impl Fn(BlockSize) -> BlockSize,
    ) -> Option<Block> {
        let newest_qp = self.qps.front().map(|(_, qp)| *qp);
        let copy = self.copies.get(&patch)?;
        let (size, wanted) = (copy.block.size, wanted(copy.block.size));
        let [wider, higher] = [
            wanted.width_log2.saturating_sub(size.width_log2),
            wanted.height_log2.saturating_sub(size.height_log2),
        ];
        let is_fine = newest_qp.is_none_or(|qp| qp <= FINE_QP);
        let outgrown = wider + higher >= if is_fine { OUTGROWN_STEPS } else { OUTGROWN_STEPS_COARSE };
        let is_coarse = copy.qp > FINE_QP && newest_qp.is_some_and(|qp| copy.qp >= qp + FINER_STEPS);
        let texels = u64::from(wanted.texels());
        if copy.settled < update && (outgrown || is_coarse) && texels <= self.renewable_texels {
            self.renewable_texels -= texels;
            self.give_up(patch);
            return None;
        }
        self.show(patch, update)
    }

    /// The same of one that is not in view, as it is.
    pub(crate) fn show(&mut self, patch: ScenePatch, update: UpdateId) -> Option<Block> {
        let copy = self.copies.get_mut(&patch).filter(|copy| copy.settled < update)?;
        copy.shown = update;
        Some(copy.block)
    }

    /// Whether there is a copy to show a patch from.
    pub(crate) fn has(&self, patch: ScenePatch) -> bool {
        self.copies.contains_key(&patch)
    }

    /// Every copy, ascending by patch.
    pub(crate) fn copies(&self) -> impl Iterator<Item = (ScenePatch, Block)> + '_ {
        self.copies.iter().map(|(patch, copy)| (*patch, copy.block))
    }

    /// How many there are.
    pub(crate) fn count(&self) -> usize {
        self.copies.len()
    }

    /// Texels of all copies.
    pub(crate) fn texels(&self) -> u64 {
        self.pages.iter().map(Atlas::used_texels).sum()
    }

    /// A patch was shaded with an update: what is in the store is not what it looks like.
    pub(crate) fn shaded(&mut self, patch: ScenePatch, update: UpdateId) {
        if let Some(shaded) = self.shaded.get_mut(patch.index()) {
            *shaded = update.0 + 1;
        }
    }

    /// A copy is not what its patch looks like any more.
    pub(crate) fn stale(&mut self, patch: ScenePatch) {
        if let Some(times) = self.stale.get_mut(patch.index()) {
            *times = (*times + 1).min(MOST_DOUBLED);
        }
        self.give_up(patch);
    }

    /// A copy is not shown any more.
    fn give_up(&mut self, patch: ScenePatch) {
        if let Some(Copy { block, shown, settled, .. }) = self.copies.remove(&patch) {
            self.leaving.push_back((shown.max(settled), block));
        }
    }

    /// An update's picture is coded with this quantiser.
    pub(crate) fn coded(&mut self, update: UpdateId, qp: u8) {
        self.qps.push_front((update, qp));
        self.qps.truncate(REMEMBERED_UPDATES);
    }

    /// Pictures of updates later than `after` were lost: so were copies of them.
    pub(crate) fn lost_after(&mut self, after: Option<UpdateId>) {
        let is_lost = |copy: &Copy| after.is_none_or(|after| copy.settled > after);
        let lost: Vec<ScenePatch> =
            self.copies.iter().filter(|(_, copy)| is_lost(copy)).map(|(patch, _)| *patch).collect();
        lost.into_iter().for_each(|patch| self.give_up(patch));
    }

    /// The client shows no update before this one any more.
    pub(crate) fn displayed(&mut self, update: UpdateId) {
        let Self { pages, leaving, .. } = self;
        leaving.retain(|(last, block)| {
            let is_free = *last < update;
            if is_free {
                pages[usize::from(block.address.page) - 1].free(in_page(*block));
            }
            !is_free
        });
    }

    /// The blocks in view that settle with an update: given with their blocks in the atlas, ascending. Each update goes on where the one
    /// before had no room. They are `most_blocks` at most. `put` takes each with its place.
    pub(crate) fn settle(
        &mut self,
        (update, most_blocks): (UpdateId, usize),
        live: impl Iterator<Item = (ScenePatch, Block)> + Clone,
        mut put: impl FnMut(ScenePatch, Block),
    ) {
        if self.pages.is_empty() {
            return;
        }
        let (mut left_texels, mut left_blocks) = (self.atlas_texels / MOST_SETTLED_PART, most_blocks);
        let first = std::mem::take(&mut self.next);
        let from_first = live.clone().filter(|(patch, _)| *patch >= first);
        for (patch, block) in from_first.chain(live.filter(|(patch, _)| *patch < first)) {
            let texels = u64::from(block.size.texels());
            let shaded = self.shaded[patch.index()];
            let after = SETTLES_AFTER_UPDATES << self.stale[patch.index()];
            if shaded == 0 || update.0 < shaded - 1 + after || self.copies.contains_key(&patch) {
                continue;
            }
            if texels > left_texels || left_blocks == 0 {
                self.next = if self.next == ScenePatch(0) { patch } else { self.next };
                continue;
            }
            let Some(qp) = self.finest_qp_since(UpdateId(shaded - 1)) else { continue };
            let Some(to) = self.take(block.size, update) else { break };
            (left_texels, left_blocks) = (left_texels - texels, left_blocks - 1);
            self.copies.insert(patch, Copy { block: to, settled: update, shown: update, qp });
            put(patch, to);
        }
    }

    /// The finest quantiser of the pictures from an update on, as far as they are remembered.
    fn finest_qp_since(&self, update: UpdateId) -> Option<u8> {
        self.qps.iter().take_while(|(of, _)| *of >= update).map(|(_, qp)| *qp).min()
    }

    /// A place for a copy; where there is none, copies that were not shown for longest are given up for those that come later.
    fn take(&mut self, size: BlockSize, update: UpdateId) -> Option<Block> {
        let in_pages = self.pages.iter_mut().zip(1..);
        let place = in_pages.filter_map(|(page, number)| Some((page.allocate(size)?, number))).next();
        if let Some((block, page)) = place {
            return Some(Block { address: BlockAddress { page, ..block.address }, ..block });
        }
        if self.leaving.is_empty() {
            self.evict(update);
        }
        None
    }

    /// Gives up the copies that were not shown for longest.
    fn evict(&mut self, update: UpdateId) {
        let mut oldest: Vec<(UpdateId, ScenePatch)> = self
            .copies
            .iter()
            .filter(|(_, copy)| copy.shown < update && copy.settled < update)
            .map(|(patch, copy)| (copy.shown, *patch))
            .collect();
        oldest.sort_unstable();
        oldest.into_iter().take(EVICTED_TOGETHER).for_each(|(_, patch)| self.give_up(patch));
    }
}

/// The same block as its page's allocator knows it.
fn in_page(block: Block) -> Block {
    Block { address: BlockAddress { page: 0, ..block.address }, ..block }
}

#[cfg(test)]
mod tests;
