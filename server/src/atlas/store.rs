//! The store: copies of settled blocks in the client's memory, which the server alone manages. Pure.
//!
//! A block in view whose colours have not changed for some updates is copied by the client from the atlas of an update's picture. From the
//! next update on its patch is shown from the store, and its room in the atlas is another's. Copies stay when their patches leave the view,
//! until their place is needed: those go first that were not shown for longest. A place is given to another copy once the client shows no
//! update any more that names it.

use crate::atlas::sizing::wanted_size;
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
/// The same where pictures are not yet fine enough for it to stay: it would be made anew twice.
const MUCH_FINER_STEPS: u8 = 10;
/// A copy made with this quantiser or a finer one stays.
const FINE_QP: u8 = 20;
/// Part of the texels of the atlas that settle with an update at most: the client copies them in one display frame.
const MOST_SETTLED_PART: u64 = 20;
/// The same for copies that are given up in view with an update, for a finer one.
const MOST_RENEWED_PART: u64 = 32;
/// Steps of width and height together by which a block would be larger than its copy for another to take its place: of pictures coded with
/// [`FINE_QP`] or finer, and of others, where a new block costs more than it shows.
const OUTGROWN_STEPS: u8 = 1;
const OUTGROWN_STEPS_COARSE: u8 = 2;
/// Where there is no place, so many texels are given up at once: a quarter of a page.
const EVICTED_TEXELS: u64 = STORE_PAGE_SIDE as u64 * STORE_PAGE_SIDE as u64 / 4;
/// Beyond this part of its texels the store is crowded.
const CROWDED_PART: f64 = 0.95;
/// What was shown within so many updates may come back soon: a head that looks around takes ten seconds.
const RECENT_UPDATES: u32 = 300;
/// Texels for a pixel that blocks may have at most for the store's sake; the first: as many as they ask for.
const DENSITIES: [f32; 7] =
    [2.0, std::f32::consts::SQRT_2, 1.0, 0.92, 0.84, 0.77, std::f32::consts::FRAC_1_SQRT_2];
/// The coarsest one that is taken before the store is full, where what comes would take this part of it, if it went on so.
const USUAL_DENSITY: usize = 2;
const MOST_COMING_PART: f64 = 1.5;
/// The part of the store that recent copies may take, and the same for a density to rise.
const MOST_RECENT_PART: f64 = 0.9;
const ROOMY_PART: f64 = 0.75;
/// The density follows what is recent once in so many updates.
const MEASURED_EACH: u32 = 8;

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
    /// With this update there is hardly a place left: a copy is outgrown late.
    is_crowded: bool,
    /// Where the next update begins to look for what may settle.
    next: ScenePatch,
    atlas_texels: u64,
    /// Of [`DENSITIES`], the one for which there is room.
    density_step: usize,
    /// Texels that settled of patches without a copy before, since that was measured, and the part of the store that do with an update.
    come_texels: u64,
    comes_part: f64,
    /// By patch: whether there was a copy of it.
    was_copied: Vec<bool>,
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
    /// The largest extent that was seen of its patch, pixels.
    pixels: [f32; 2],
}

/// What a patch is shown from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Served {
    /// Its copy in the store.
    Copy(Block),
    /// A block in the atlas, for an extent of so many pixels at least where it takes the place of a copy: other views will need them again.
    Atlas(Option<[f32; 2]>),
}

/// A block in view that may settle.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Settling {
    /// Whose.
    pub patch: ScenePatch,
    /// Where it lies in the atlas.
    pub block: Block,
    /// The largest extent that was seen of it, pixels.
    pub pixels: [f32; 2],
    /// The last update that had it in view.
    pub seen: UpdateId,
}

impl Copy {
    /// The size that its largest extent asks for where blocks have so many texels for a pixel.
    fn size_at(&self, density: f32) -> BlockSize {
        wanted_size(self.pixels.map(|side| side * density), Some(self.block.size))
    }
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
            was_copied: vec![false; if pages > 0 { patches } else { 0 }],
            atlas_texels: u64::from(atlas.width()) * u64::from(atlas.height()),
            ..Self::default()
        }
    }

    /// An update begins to be placed.
    pub(crate) fn begin(&mut self, update: UpdateId) {
        self.renewable_texels = self.atlas_texels / MOST_RENEWED_PART;
        self.is_crowded = self.texels() as f64 > CROWDED_PART * self.all_texels() as f64;
        if update.0.is_multiple_of(MEASURED_EACH) {
            self.follow(update);
        }
    }

    /// Part of the store that what was shown lately takes where blocks have so many texels for a pixel.
    fn recent_part(&self, update: UpdateId, density: f32) -> f64 {
        let recent = self.copies.values().filter(|copy| copy.shown.0 + RECENT_UPDATES >= update.0);
        let texels: u64 = recent.map(|copy| u64::from(copy.size_at(density).texels())).sum();
        texels as f64 / self.all_texels().max(1) as f64
    }

    /// Takes the highest density with room for what was shown lately, and for what comes if that goes on: all of a first view is new.
    fn follow(&mut self, update: UpdateId) {
        let now = DENSITIES[self.density_step];
        let part = self.recent_part(update, now);
        let (come, updates) = (std::mem::take(&mut self.come_texels), f64::from(MEASURED_EACH));
        self.comes_part = 0.5 * (self.comes_part + come as f64 / updates / self.all_texels().max(1) as f64);
        let soon = f64::from(RECENT_UPDATES) * self.comes_part;
        if self.density_step < USUAL_DENSITY && part + soon > MOST_COMING_PART {
            self.density_step = USUAL_DENSITY;
        } else if part > MOST_RECENT_PART && self.density_step + 1 < DENSITIES.len() {
            self.density_step += 1;
        } else if let Some(step) = self.density_step.checked_sub(1) {
            let growth = f64::from(DENSITIES[step] / now).powi(2);
            if self.recent_part(update, DENSITIES[step]) + growth * soon <= ROOMY_PART {
                self.density_step = step;
            }
        }
    }

    /// Texels for a pixel that blocks may have at most for the store to hold what was shown lately.
    pub(crate) fn most_density(&self) -> f32 {
        if self.density_step == 0 { f32::INFINITY } else { DENSITIES[self.density_step] }
    }

    fn all_texels(&self) -> u64 {
        self.pages.len() as u64 * u64::from(STORE_PAGE_SIDE) * u64::from(STORE_PAGE_SIDE)
    }

    /// What a patch in view is shown from with this update, where its extent is so many pixels and blocks have `density` texels for one. A
    /// copy that is too coarse, or coded coarsely for today, is given up, a few with each update, if its patch
    /// `is_ahead` of the head.
    pub(crate) fn serve(
        &mut self,
        patch: ScenePatch,
        (update, density): (UpdateId, f32),
        pixels: [f32; 2],
        is_ahead: impl FnOnce() -> bool,
    ) -> Served {
        let newest_qp = self.qps.front().map(|(_, qp)| *qp);
        let Some(copy) = self.copies.get_mut(&patch) else { return Served::Atlas(None) };
        copy.pixels = [0, 1].map(|axis| copy.pixels[axis].max(pixels[axis]));
        let now = copy.block.size;
        let wanted = wanted_size(pixels.map(|side| side * density), Some(now));
        let wider = wanted.width_log2.saturating_sub(now.width_log2);
        let higher = wanted.height_log2.saturating_sub(now.height_log2);
        let is_fine = newest_qp.is_none_or(|qp| qp <= FINE_QP);
        let most = if is_fine && !self.is_crowded { OUTGROWN_STEPS } else { OUTGROWN_STEPS_COARSE };
        let finer_steps = if is_fine { FINER_STEPS } else { MUCH_FINER_STEPS };
        let is_coarse = copy.qp > FINE_QP && newest_qp.is_some_and(|qp| copy.qp >= qp + finer_steps);
        let (pixels, texels) = (copy.pixels, u64::from(copy.size_at(density).texels()));
        let is_due = copy.settled < update && (wider + higher >= most || is_coarse);
        if is_due && texels <= self.renewable_texels && is_ahead() {
            self.renewable_texels -= texels;
            self.give_up(patch);
            return Served::Atlas(Some(pixels));
        }
        self.show(patch, update).map_or(Served::Atlas(None), Served::Copy)
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
    /// before had no room. They are `most_blocks` at most, and a part of the atlas at most, or one block. `density`: texels for a pixel that
    /// blocks have. `put` takes each with its place.
    pub(crate) fn settle(
        &mut self,
        (update, most_blocks, density): (UpdateId, usize, f32),
        live: impl Iterator<Item = Settling> + Clone,
        mut put: impl FnMut(ScenePatch, Block),
    ) {
        if self.pages.is_empty() {
            return;
        }
        let most_texels = self.atlas_texels / MOST_SETTLED_PART;
        let (mut left_texels, mut left_blocks) = (most_texels, most_blocks);
        let first = std::mem::take(&mut self.next);
        let from_first = live.clone().filter(|settling| settling.patch >= first);
        let before_first = live.filter(|settling| settling.patch < first);
        for Settling { patch, block, pixels, seen } in from_first.chain(before_first) {
            let texels = u64::from(block.size.texels());
            let shaded = self.shaded[patch.index()];
            let after = SETTLES_AFTER_UPDATES << self.stale[patch.index()];
            if shaded == 0 || update.0 < shaded - 1 + after || self.copies.contains_key(&patch) {
                continue;
            }
            // What was shaded out of view is filtered for no pixel of the display.
            if UpdateId(shaded - 1) > seen {
                continue;
            }
            // One that is larger than all of them settles alone.
            let has_room = texels <= left_texels || left_texels == most_texels;
            if !has_room || left_blocks == 0 {
                self.next = if self.next == ScenePatch(0) { patch } else { self.next };
                continue;
            }
            let Some(qp) = self.finest_qp_since(UpdateId(shaded - 1)) else { continue };
            let Some(to) = self.take(block.size, update, density) else { break };
            (left_texels, left_blocks) = (left_texels.saturating_sub(texels), left_blocks - 1);
            self.copies.insert(patch, Copy { block: to, settled: update, shown: update, qp, pixels });
            if !std::mem::replace(&mut self.was_copied[patch.index()], true) {
                self.come_texels += texels;
            }
            put(patch, to);
        }
    }

    /// The finest quantiser of the pictures from an update on, as far as they are remembered.
    fn finest_qp_since(&self, update: UpdateId) -> Option<u8> {
        self.qps.iter().take_while(|(of, _)| *of >= update).map(|(_, qp)| *qp).min()
    }

    /// A place for a copy; where there is none, others are given up for those that come later.
    fn take(&mut self, size: BlockSize, update: UpdateId, density: f32) -> Option<Block> {
        let in_pages = self.pages.iter_mut().zip(1..);
        let place = in_pages.filter_map(|(page, number)| Some((page.allocate(size)?, number))).next();
        if let Some((block, page)) = place {
            return Some(Block { address: BlockAddress { page, ..block.address }, ..block });
        }
        self.evict(update, density);
        None
    }

    /// Gives up copies until enough texels leave: first those with more texels than are asked for now, then those that were not shown for longest.
    fn evict(&mut self, update: UpdateId, density: f32) {
        let mut leaving: u64 = self.leaving.iter().map(|(_, block)| u64::from(block.size.texels())).sum();
        if leaving >= EVICTED_TEXELS {
            return;
        }
        let hidden = self.copies.iter().filter(|(_, copy)| copy.shown < update && copy.settled < update);
        let ranked = hidden.map(|(patch, copy)| {
            let texels = copy.block.size.texels();
            (copy.size_at(density).texels() >= texels, copy.shown, *patch, texels)
        });
        let mut ranked: Vec<_> = ranked.collect();
        ranked.sort_unstable();
        for (_, _, patch, texels) in ranked {
            if leaving >= EVICTED_TEXELS {
                break;
            }
            leaving += u64::from(texels);
            self.give_up(patch);
        }
    }
}

/// The same block as its page's allocator knows it.
fn in_page(block: Block) -> Block {
    Block { address: BlockAddress { page: 0, ..block.address }, ..block }
}

#[cfg(test)]
mod tests;
