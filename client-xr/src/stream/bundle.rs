//! The drawable bundles: pixels and placements of the same update, never a mixture.
//!
//! Deltas arrive in the order of updates, pictures whenever they are decoded. A delta's vertices apply at once
//! ([`crate::motion`]), so motion continues while a picture is late. Its patches wait for the picture of its update, or of a
//! later one. A delta whose picture never arrived applies all the same. The module does not know vertices, GPUs and networks.

use crate::draw::coverage::CoverageMap;
use shadecast_protocol::atlas::{AtlasExtent, Block};
use shadecast_protocol::coverage::Coverage;
use shadecast_protocol::geometry::{GeometryDelta, NewPatch};
use shadecast_protocol::ids::{PatchSlot, UpdateId};
use shadecast_protocol::limits::DEFAULT_PATCH_SLOTS;
use shadecast_protocol::memory::Patches;
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
    /// The update on display.
    current: Option<UpdateId>,
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
    evicted: Vec<PatchSlot>,
    new: Vec<NewPatch>,
    placements: Vec<(PatchSlot, Option<Block>)>,
    coverage: Vec<(PatchSlot, Coverage)>,
}

impl PatchChanges {
    fn records(&self) -> usize {
        let coverage_bytes: usize = self.coverage.iter().map(|(_, coverage)| coverage.byte_count()).sum();
        let of_coverage = self.coverage.len() + coverage_bytes / size_of::<NewPatch>();
        1 + self.evicted.len() + self.new.len() + self.placements.len() + of_coverage
    }

    fn apply_to(&self, patches: &mut Patches, map: &mut CoverageMap) -> Result<(), WireError> {
        patches.evict(&self.evicted)?;
        patches.insert(&self.new)?;
        patches.place(&self.placements)?;
        patches.cover(&self.coverage)?;
        for (slot, coverage) in &self.coverage {
            let block = patches.get(*slot).and_then(|patch| patch.block);
            block.iter().for_each(|block| map.cover(*block, coverage));
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
            current: None,
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
            evicted: delta.evicted_patches,
            new: delta.new_patches,
            placements: delta.placements,
            coverage: delta.coverage,
        };
        self.pending_records += changes.records();
        self.pending.push_back(changes);
        while self.pending.len() > MAX_PENDING || self.pending_records > MAX_PENDING_RECORDS {
            self.apply_next();
        }
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
            return self.pictures.pop_front().map(|(_, picture)| picture);
        }
        None
    }

    fn shown_or_past(&self, update: UpdateId) -> bool {
        self.applied.is_some_and(|applied| update <= applied)
    }

    /// Switches to the newest update that has its picture, and its vertices in the GPU's memory: all up to `complete` have
    /// them. Pictures that it makes superfluous go to `drop_picture`.
    pub fn take_newest_complete(
        &mut self,
        complete: UpdateId,
        mut drop_picture: impl FnMut(P),
    ) -> Option<(UpdateId, P)> {
        while self.pictures.front().is_some_and(|(update, _)| self.shown_or_past(*update)) {
            self.pictures.pop_front().into_iter().for_each(|(_, picture)| drop_picture(picture));
        }
        let count = self.pictures.partition_point(|(update, _)| *update <= complete);
        (1..count).filter_map(|_| self.pictures.pop_front()).for_each(|(_, picture)| drop_picture(picture));
        // Those behind them wait for their vertices.
        let (update, picture) = self.pictures.pop_front_if(|(update, _)| *update <= complete)?;
        while self.pending.front().is_some_and(|changes| changes.update <= update) {
            self.apply_next();
        }
        self.current = Some(update);
        Some((update, picture))
    }

    fn apply_next(&mut self) {
        let Some(changes) = self.pending.pop_front() else { return };
        self.pending_records -= changes.records();
        self.applied = Some(changes.update);
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
    }
}

#[cfg(test)]
mod tests;
