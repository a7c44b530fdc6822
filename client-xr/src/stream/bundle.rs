//! The drawable bundles: pixels and placements of the same update, never a mixture.
//!
//! Deltas arrive in the order of updates, pictures whenever they are decoded. A delta's vertices apply at once
//! ([`crate::motion`]), so motion continues while a picture is late. Its patches wait for the picture of its update, or of a
//! later one. A delta whose picture never arrived applies all the same. A picture with blocks that settle is not passed over:
//! it becomes a bundle, though perhaps none that is seen. The module does not know vertices, GPUs and networks.

use crate::draw::coverage::CoverageMap;
use shadecast_protocol::atlas::{AtlasExtent, Block};
use shadecast_protocol::coverage::Coverage;
use shadecast_protocol::geometry::{GeometryDelta, NewPatch, Settled};
use shadecast_protocol::ids::{PatchSlot, UpdateId};
use shadecast_protocol::limits::DEFAULT_PATCH_SLOTS;
use shadecast_protocol::memory::Patches;
use shadecast_protocol::time::WorldTime;
use shadecast_protocol::wire::WireError;
use std::collections::VecDeque;

/// Deltas whose patches wait for a picture; beyond it the oldest are applied, and their pictures are not shown.
const MAX_PENDING: usize = 256;
/// The same, by what they say: every patch of a usual client comes, gets a block, loses it and goes.
const MAX_PENDING_RECORDS: usize = 4 * DEFAULT_PATCH_SLOTS as usize;
/// Decoded pictures that wait for their delta; beyond it the oldest is dropped.
const MAX_PICTURES: usize = 3;

/// Everything that deltas and pictures add up to. `P` is a decoded picture.
#[derive(Debug)]
pub struct Bundler<P> {
    /// As of the update on display.
    patches: Patches,
    /// Of the same update.
    coverage: CoverageMap,
    pending: VecDeque<PatchChanges>,
    /// What all of `pending` says.
    pending_records: usize,
    pictures: VecDeque<(UpdateId, P)>,
    /// The update whose patches `patches` holds.
    applied: Option<UpdateId>,
    /// What its picture is shaded for.
    shaded: WorldTime,
    /// The update on display.
    current: Option<UpdateId>,
    /// What settles of its picture: where from, and where to.
    settled: Vec<(Block, Block)>,
    /// The first update whose blocks could not settle, for want of its picture.
    unsettled: Option<UpdateId>,
    revision: Revision,
    /// Patch slots that have changed since they were taken, each once.
    changed: Vec<PatchSlot>,
    is_changed: Vec<bool>,
}

/// How often patches and coverage have changed: what was made of either is still right while its number is the same.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Revision {
    /// Of patches and their places.
    pub patches: u64,
    /// Of what cutouts leave.
    pub coverage: u64,
}

/// The patch half of a delta.
#[derive(Debug)]
struct PatchChanges {
    update: UpdateId,
    shaded: WorldTime,
    evicted: Vec<PatchSlot>,
    new: Vec<NewPatch>,
    placements: Vec<(PatchSlot, Option<Block>)>,
    coverage: Vec<(PatchSlot, Coverage)>,
    settled: Vec<Settled>,
}

impl PatchChanges {
    fn records(&self) -> usize {
        let coverage_bytes: usize = self.coverage.iter().map(|(_, coverage)| coverage.byte_count()).sum();
        let of_coverage = self.coverage.len() + coverage_bytes / size_of::<NewPatch>();
        1 + self.evicted.len() + self.new.len() + self.placements.len() + self.settled.len() + of_coverage
    }

    fn apply_to(&self, patches: &mut Patches, map: &mut CoverageMap) -> Result<(), WireError> {
        patches.evict(&self.evicted)?;
        patches.insert(&self.new)?;
        patches.place(&self.placements)?;
        patches.settle(&self.settled)?;
        patches.cover(&self.coverage)?;
        for (slot, coverage) in &self.coverage {
            let block = patches.get(*slot).and_then(|patch| patch.block);
            // A cutout's block is in the atlas; of another server's there is no coverage.
            block.iter().filter(|block| !block.is_stored()).for_each(|block| map.cover(*block, coverage));
        }
        Ok(())
    }
}

impl<P> Bundler<P> {
    /// For the agreed capacity and atlas.
    pub fn new(patch_slots: u32, extent: AtlasExtent) -> Self {
        Self {
            patches: Patches::new(patch_slots),
            coverage: CoverageMap::new(extent),
            pending: VecDeque::new(),
            pending_records: 0,
            pictures: VecDeque::new(),
            applied: None,
            shaded: WorldTime(0),
            current: None,
            settled: Vec::new(),
            unsettled: None,
            revision: Revision::default(),
            changed: Vec::with_capacity(patch_slots as usize),
            is_changed: vec![false; patch_slots as usize],
        }
    }

    /// Whether a picture waits for its delta, its vertices, or who takes it.
    pub fn has_pictures(&self) -> bool {
        !self.pictures.is_empty()
    }

    /// How often both have changed.
    pub fn revision(&self) -> Revision {
        self.revision
    }

    /// Patch slots that have changed since this was asked last, each once, and what is in them.
    pub fn take_changed(&mut self) -> (std::vec::Drain<'_, PatchSlot>, &Patches) {
        self.changed.iter().for_each(|slot| self.is_changed[slot.index()] = false);
        (self.changed.drain(..), &self.patches)
    }

    /// What cutouts among them leave of their blocks.
    pub fn coverage(&self) -> &CoverageMap {
        &self.coverage
    }

    /// Takes in the next delta. It comes from a decoder that has checked it against the client's memory.
    pub fn add_delta(&mut self, delta: GeometryDelta) {
        let changes = PatchChanges {
            update: delta.update,
            shaded: delta.shaded,
            evicted: delta.evicted_patches,
            new: delta.new_patches,
            placements: delta.placements,
            coverage: delta.coverage,
            settled: delta.settled,
        };
        self.pending_records += changes.records();
        self.pending.push_back(changes);
        while self.pending.len() > MAX_PENDING || self.pending_records > MAX_PENDING_RECORDS {
            self.apply_next();
        }
    }

    /// What the picture of the last update that was taken is shaded for.
    pub fn shaded(&self) -> WorldTime {
        self.shaded
    }

    /// Bytes that wait for pictures.
    pub fn waiting_bytes(&self) -> usize {
        self.pending_records * size_of::<NewPatch>()
    }

    /// Takes in a decoded picture. Gives back one that will not be shown, for reuse.
    pub fn add_picture(&mut self, update: UpdateId, picture: P) -> Option<P> {
        if self.shown_or_past(update) {
            return Some(picture);
        }
        let at = self.pictures.partition_point(|(known, _)| *known < update);
        self.pictures.insert(at, (update, picture));
        if self.pictures.len() > MAX_PICTURES {
            let unneeded = self.pictures.iter().position(|(update, _)| self.settles(*update) == Some(false));
            return self.pictures.remove(unneeded.unwrap_or(0)).map(|(_, picture)| picture);
        }
        None
    }

    /// Whether blocks settle with an update that waits; `None` where its delta has not come.
    fn settles(&self, update: UpdateId) -> Option<bool> {
        let place = self.pending.binary_search_by_key(&update, |changes| changes.update).ok()?;
        Some(!self.pending[place].settled.is_empty())
    }

    /// The next picture to take, of those up to `complete`: the first with blocks that settle, or the newest.
    fn next_picture(&self, complete: UpdateId) -> Option<usize> {
        let count = self.pictures.partition_point(|(update, _)| *update <= complete);
        let settles = |(update, _): &(UpdateId, P)| self.settles(*update) == Some(true);
        self.pictures.iter().take(count).position(settles).or(count.checked_sub(1))
    }

    /// Whether a picture waits for who takes it.
    pub fn has_complete(&self, complete: UpdateId) -> bool {
        self.pictures.iter().any(|(update, _)| *update <= complete && !self.shown_or_past(*update))
    }

    /// The blocks of the last picture taken that settle: where they are in it, and where they go in the store.
    pub fn settled(&self) -> &[(Block, Block)] {
        &self.settled
    }

    /// The first update whose blocks could not settle since this was asked last.
    pub fn take_unsettled(&mut self) -> Option<UpdateId> {
        self.unsettled.take()
    }

    fn shown_or_past(&self, update: UpdateId) -> bool {
        self.applied.is_some_and(|applied| update <= applied)
    }

    /// Switches to the newest update that has its picture, and its vertices in the GPU's memory: all up to `complete` have
    /// them. One with blocks that settle comes before newer ones. Pictures that it makes superfluous go to `drop_picture`.
    pub fn take_newest_complete(
        &mut self,
        complete: UpdateId,
        mut drop_picture: impl FnMut(P),
    ) -> Option<(UpdateId, P)> {
        while self.pictures.front().is_some_and(|(update, _)| self.shown_or_past(*update)) {
            self.pictures.pop_front().into_iter().for_each(|(_, picture)| drop_picture(picture));
        }
        // Those behind it wait for their vertices, or for it.
        let next = self.next_picture(complete)?;
        self.pictures.drain(..next).for_each(|(_, picture)| drop_picture(picture));
        let (update, picture) = self.pictures.pop_front()?;
        self.current = Some(update);
        self.settled.clear();
        while self.pending.front().is_some_and(|changes| changes.update <= update) {
            self.apply_next();
        }
        Some((update, picture))
    }

    fn apply_next(&mut self) {
        let Some(changes) = self.pending.pop_front() else { return };
        self.pending_records -= changes.records();
        self.applied = Some(changes.update);
        self.shaded = changes.shaded;
        self.revision.patches += u64::from(changes.records() > 1);
        self.revision.coverage += u64::from(!changes.coverage.is_empty());
        let new = changes.new.iter().map(|patch| patch.slot);
        let placed = changes.placements.iter().map(|(slot, _)| *slot);
        for slot in changes.evicted.iter().copied().chain(new).chain(placed) {
            if !std::mem::replace(&mut self.is_changed[slot.index()], true) {
                self.changed.push(slot);
            }
        }
        let applied = changes.apply_to(&mut self.patches, &mut self.coverage);
        applied.expect("the decoder has refused what contradicts the memory");
        self.settle(changes.update, &changes.settled);
    }

    /// Notes what settles with an update that was just applied.
    fn settle(&mut self, update: UpdateId, settled: &[Settled]) {
        if self.current == Some(update) {
            let places = settled.iter().filter_map(|Settled { slot, to, .. }| {
                let block = self.patches.get(*slot).and_then(|patch| patch.block)?;
                Some((block, *to))
            });
            self.settled.extend(places);
        } else if !settled.is_empty() {
            self.unsettled.get_or_insert(update);
        }
    }
}

#[cfg(test)]
mod tests;
