//! The part of the scene in one client's memory: a cache that only the server writes.
//!
//! Visible patches enter; the delta of each update leaves. [`ClientMemory`](shadecast_protocol::memory::ClientMemory) defines
//! the memory's contents; this folder knows the place of each patch and vertex of the scene, and the free slots. Eviction is
//! lazy, because visible geometry tends to return. Only geometry with samples or predictions leaves with its block, because
//! each of them costs bytes. A freed slot is reused only after the client has displayed the update that freed it.

mod retained;
mod slots;

use crate::atlas::placement::PlacementChange;
use crate::motion::delta::{UpdateDelta, UpdateStamp};
use crate::motion::sampled::{Coder, SharedCoder};
use crate::motion::skinning::Skinning;
use crate::motion::steps::Steps;
use crate::pacing::share::Budget;
use crate::residency::retained::Retained;
use crate::residency::slots::Slots;
use crate::scene::geometry::{Geometry, vertices_of_patch};
use crate::scene::numbering::{ScenePatch, SceneVertex};
use crate::support::lock::lock;
use crate::support::merged::merged;
use crate::support::pool::Pool;
use shadecast_protocol::atlas::{AtlasExtent, Block};
use shadecast_protocol::bit_set::BitSet;
use shadecast_protocol::delta::{DeltaEncoder, EncodedDelta};
use shadecast_protocol::geometry::{GeometryDelta, Motion, NewPatch, NewVertex, on_static_grid};
use shadecast_protocol::ids::{InstanceId, PatchSlot, UpdateId, VertexSlot};
use shadecast_protocol::message::MotionMemory;
use shadecast_protocol::motion::predicted::PREDICTED_BYTES;
use std::collections::HashSet;
use std::sync::{Arc, Mutex, PoisonError};

/// A patch without a block, of vertices that cost nothing while they stay, is forgotten after this many updates.
const RETAIN_UPDATES: u32 = 300;
/// One of so many slots stays free of what is brought ahead.
const AHEAD_WATER: usize = 16;
/// What is put behind may take one of so many bytes that are left.
const BEHIND_PART: usize = 4;
/// What geometry takes on the wire, about, bytes: a patch, and a vertex that does not move.
const PATCH_BYTES: usize = 4;
const STATIC_VERTEX_BYTES: usize = 5;
/// The first samples of a vertex.
const SAMPLED_VERTEX_BYTES: usize = 30;

/// What an update can still bring.
#[derive(Clone, Debug, Default)]
pub(crate) struct Allowance {
    bytes: usize,
    patches: usize,
    vertices: usize,
    /// Vertices that it brings, as far as is known.
    brings: HashSet<SceneVertex>,
    /// Those of what is being reserved.
    newest: Vec<SceneVertex>,
}

impl Allowance {
    /// Whether any number of bytes may come.
    pub(crate) fn is_unlimited(&self) -> bool {
        self.bytes == usize::MAX
    }
}

/// Where a vertex of the scene lies.
#[derive(Clone, Copy, Debug)]
struct Resident {
    slot: VertexSlot,
    /// Resident patches that use it.
    users: u32,
}

/// See the module.
#[derive(Debug)]
pub struct Residency {
    /// The client's memory, and the pasts of its samples.
    coder: SharedCoder,
    /// Slots of its vertices that move.
    moving: BitSet,
    /// By slot, the vertex that is or was there.
    vertex_of_slot: Vec<SceneVertex>,
    /// How finely samples are rounded, of instances that the client was told of.
    steps: Steps,
    /// What the client skins by itself.
    skinning: Option<Skinning>,
    patch_slots: Slots,
    vertex_slots: Slots,
    /// By [`ScenePatch`].
    slot_of_patch: Vec<Option<PatchSlot>>,
    /// By [`SceneVertex`].
    vertices: Vec<Option<Resident>>,
    /// Resident patches without a block, by the update since when.
    retained: Retained,
    /// Patches with a block that found no slot free, ascending; they try again with each update.
    waiting: Vec<(ScenePatch, Block)>,
    /// A list of one update, kept for its memory.
    coming: Vec<(ScenePatch, Block)>,
    /// Patches that the next update brings ahead, without a block, as far as it can.
    ahead: Vec<ScenePatch>,
    /// Patches that have a block in case that they come into view, ascending: all others go before them.
    behind: Vec<ScenePatch>,
    /// Of those that wait, how many are such.
    behind_waiting: usize,
    /// Memory of deltas that are not needed any more.
    spare: Pool<UpdateDelta>,
    /// What an update may take.
    budget: Budget,
    /// Of those that wait, how many do so because of it alone.
    held_back: usize,
}

impl Residency {
    /// An empty client memory, for a scene of so many patches and vertices.
    pub(crate) fn new([patches, vertices]: [u32; 2], patch_slots: u32, vertex_slots: u32) -> Self {
        Self {
            coder: Arc::new(Mutex::new(Coder::new(DeltaEncoder::new(vertex_slots, patch_slots)))),
            moving: BitSet::none(vertex_slots as usize),
            vertex_of_slot: vec![SceneVertex(0); vertex_slots as usize],
            steps: Steps::default(),
            skinning: None,
            patch_slots: Slots::new(patch_slots),
            vertex_slots: Slots::new(vertex_slots),
            slot_of_patch: vec![None; patches as usize],
            vertices: vec![None; vertices as usize],
            retained: Retained::new(patches as usize),
            waiting: Vec::new(),
            coming: Vec::new(),
            ahead: Vec::new(),
            behind: Vec::new(),
            behind_waiting: 0,
            spare: Pool::default(),
            budget: Budget::UNLIMITED,
            held_back: 0,
        }
    }

    /// With blocks in an atlas of this extent.
    #[must_use]
    pub(crate) fn with_atlas(self, extent: AtlasExtent) -> Self {
        self.coding_with(|encoder| encoder.with_atlas(extent))
    }

    /// With so many pages of the store.
    #[must_use]
    pub(crate) fn with_store(self, pages: u32) -> Self {
        self.coding_with(|encoder| encoder.with_store(pages))
    }

    /// With what the client skins by itself.
    #[must_use]
    pub(crate) fn with_skinning(self, skinning: Skinning, memory: MotionMemory) -> Self {
        let residency = self.coding_with(|encoder| encoder.with_motion(memory));
        lock(skinning.sender()).code_with(&residency.coder);
        Self { skinning: Some(skinning), ..residency }
    }

    /// With this change to the encoder, while nobody else has it.
    fn coding_with(mut self, change: impl FnOnce(DeltaEncoder) -> DeltaEncoder) -> Self {
        let coder = Arc::into_inner(self.coder).expect("it is shared once there is motion");
        let coder = coder.into_inner().unwrap_or_else(PoisonError::into_inner);
        self.coder = Arc::new(Mutex::new(coder.with(change)));
        self
    }

    /// The coarsest steps of samples that will do from the next update on, by instance, metres.
    pub(crate) fn want_steps(&mut self, wanted_m: impl IntoIterator<Item = f32>) {
        self.steps.want(wanted_m);
    }

    /// Whether updates predict the vertices that move.
    pub(crate) fn predicts(&self) -> bool {
        self.skinning.as_ref().is_some_and(Skinning::predicts_others)
    }

    /// The client has displayed `update`: slots freed up to it can be used again.
    pub(crate) fn displayed(&mut self, update: UpdateId) {
        self.patch_slots.displayed(update);
        self.vertex_slots.displayed(update);
    }

    /// What each update may take from now on.
    pub(crate) fn set_budget(&mut self, budget: Budget) {
        self.budget = budget;
        if let Some(skinning) = &self.skinning {
            lock(skinning.sender()).set_budget(budget);
        }
    }

    /// About how many bytes so many patches and vertices of an instance take that are all new to the client.
    pub(crate) fn new_bytes(
        &self,
        geometry: &impl Geometry,
        instance: u16,
        (patches, vertices): (usize, usize),
    ) -> usize {
        let skinning = self.skinning.as_ref().filter(|skinning| skinning.is_skinned(instance));
        let vertex_bytes = match (geometry.static_position(geometry.first_vertex(instance)), skinning) {
            (Some(_), _) => STATIC_VERTEX_BYTES,
            (None, Some(skinning)) => skinning.new_vertex_bytes(instance),
            (None, None) if self.predicts() => PREDICTED_BYTES,
            (None, None) => SAMPLED_VERTEX_BYTES,
        };
        patches * PATCH_BYTES + vertices * vertex_bytes
    }

    /// Bytes of geometry that the next update may bring.
    pub(crate) fn budget_bytes(&self) -> usize {
        self.budget.geometry_bytes
    }

    /// Makes an allowance, in the memory of another, what the next update can bring.
    pub(crate) fn allow(&self, allowance: &mut Allowance) {
        allowance.bytes = self.budget.geometry_bytes;
        allowance.patches = self.patch_slots.free.count();
        allowance.vertices = self.vertex_slots.free.count();
        allowance.brings.clear();
    }

    /// Takes off what it takes to bring those of `patches` that are not there. False, and nothing is taken off, where there is
    /// not so much.
    pub(crate) fn reserve(
        &self,
        geometry: &impl Geometry,
        patches: impl IntoIterator<Item = ScenePatch>,
        allowance: &mut Allowance,
    ) -> bool {
        let Allowance { bytes, patches: slots, vertices, .. } = *allowance;
        let mut newest = std::mem::take(&mut allowance.newest);
        newest.clear();
        let fits = patches.into_iter().all(|patch| self.reserve_one(geometry, patch, allowance, &mut newest));
        if !fits {
            for vertex in &newest {
                allowance.brings.remove(vertex);
            }
            (allowance.bytes, allowance.patches, allowance.vertices) = (bytes, slots, vertices);
        }
        allowance.newest = newest;
        fits
    }

    /// The same for as many of the patches as fit.
    pub(crate) fn reserve_what_fits(
        &self,
        geometry: &impl Geometry,
        patches: impl IntoIterator<Item = ScenePatch>,
        allowance: &mut Allowance,
    ) {
        for patch in patches {
            self.reserve(geometry, [patch], allowance);
        }
    }

    fn reserve_one(
        &self,
        geometry: &impl Geometry,
        patch: ScenePatch,
        left: &mut Allowance,
        newest: &mut Vec<SceneVertex>,
    ) -> bool {
        if self.slot_of_patch[patch.index()].is_some() {
            return true;
        }
        let instance = geometry.instance_of_patch(patch);
        let (mut bytes, before) = (PATCH_BYTES, newest.len());
        for vertex in vertices_of_patch(geometry, patch) {
            if self.vertices[vertex.index()].is_none() && left.brings.insert(vertex) {
                bytes += self.vertex_bytes(geometry, instance, vertex);
                newest.push(vertex);
            }
        }
        let vertices = newest.len() - before;
        let fits = left.patches > 0 && left.vertices >= vertices && left.bytes >= bytes;
        if fits {
            (left.patches, left.vertices, left.bytes) =
                (left.patches - 1, left.vertices - vertices, left.bytes - bytes);
        }
        fits
    }

    /// The slot of a patch whose client has been told its newest block.
    pub(crate) fn slot_with_block(&self, patch: ScenePatch) -> Option<PatchSlot> {
        let waits = self.waiting.binary_search_by_key(&patch, |(patch, _)| *patch).is_ok();
        self.slot_of_patch[patch.index()].filter(|_| !waits)
    }

    /// How many of these patches are not there.
    pub(crate) fn lacking(&self, patches: &[ScenePatch]) -> usize {
        patches.iter().filter(|patch| self.slot_of_patch[patch.index()].is_none()).count()
    }

    /// The next update brings these ahead of their block as far as it can, and keeps those that are there.
    pub(crate) fn bring_ahead(&mut self, patches: &[ScenePatch]) {
        self.ahead.clear();
        self.ahead.extend_from_slice(patches);
    }

    /// Of those with a block these, ascending, come after all others, and as far as slots are not short.
    pub(crate) fn put_behind(&mut self, patches: impl IntoIterator<Item = ScenePatch>) {
        self.behind.clear();
        self.behind.extend(patches);
    }

    /// Whether an instance that stays in the client's memory is told only once.
    pub(crate) fn is_told_once(&self, geometry: &impl Geometry, instance: u16) -> bool {
        let is_skinned = self.skinning.as_ref().is_some_and(|skinning| skinning.is_skinned(instance));
        is_skinned || geometry.static_position(geometry.first_vertex(instance)).is_some()
    }

    /// The bytes of what [`Self::update`] gave, in the same order.
    pub(crate) fn encode(&self, delta: &UpdateDelta) -> EncodedDelta {
        lock(&self.coder).update(delta)
    }

    /// What an update has changed is not needed any more: its memory is used for the next.
    pub(crate) fn recycle(&mut self, delta: UpdateDelta) {
        self.spare.give(delta);
    }

    /// What brings the client from the last update to this one.
    pub(crate) fn update(
        &mut self,
        geometry: &impl Geometry,
        changes: &[PlacementChange],
        UpdateStamp { update, time }: UpdateStamp,
    ) -> UpdateDelta {
        let mut made = self.spare.take();
        made.clear();
        let delta = &mut made;
        (delta.geometry.update, delta.geometry.time) = (update, time);
        for change in changes.iter().filter(|c| c.block.is_none()) {
            self.lose_block(geometry, change.patch, update, &mut delta.geometry);
        }
        self.keep(changes, update);
        self.forget_old(geometry, update, &mut delta.geometry);
        delta.geometry.instances.extend(self.steps.changes());
        let mut left_bytes = self.budget.geometry_bytes;
        (self.held_back, self.behind_waiting) = (0, 0);
        let coming = self.coming(changes);
        for (patch, block) in coming.iter().copied() {
            if self.is_behind(patch) {
                continue;
            }
            let bytes = self.entry_bytes(geometry, patch);
            if bytes > left_bytes {
                self.held_back += 1;
                self.waiting.push((patch, block));
                continue;
            }
            left_bytes -= bytes;
            match self.admit(geometry, patch, &mut delta.geometry) {
                Some(slot) => place(geometry, (patch, slot), block, delta),
                None => self.waiting.push((patch, block)),
            }
        }
        self.bring(geometry, &mut left_bytes, &mut delta.geometry);
        let left_bytes = if self.held_back == 0 { left_bytes / BEHIND_PART } else { 0 };
        self.bring_behind(geometry, &coming, left_bytes, delta);
        self.coming = coming;
        self.waiting.sort_unstable_by_key(|(patch, _)| *patch);
        sort(&mut delta.geometry);
        delta.masked.sort_unstable_by_key(|(slot, _)| *slot);
        let is_sampled = |vertex: &&NewVertex| vertex.motion == Motion::Sampled;
        let entering = delta.geometry.new_vertices.iter().filter(is_sampled);
        delta.sampled.extend(entering.map(|vertex| (vertex.slot, self.vertex_of_slot[vertex.slot.index()])));
        made
    }

    /// What gets a block with this update, or is brought ahead, is not forgotten with it.
    fn keep(&mut self, changes: &[PlacementChange], update: UpdateId) {
        for change in changes.iter().filter(|change| change.block.is_some()) {
            self.retained.remove(change.patch);
        }
        self.ahead.iter().for_each(|patch| self.retained.renew(*patch, update));
    }

    /// Brings what is to be there ahead of its block, in the order in which it was asked for.
    fn bring(&mut self, geometry: &impl Geometry, left_bytes: &mut usize, delta: &mut GeometryDelta) {
        let mut ahead = std::mem::take(&mut self.ahead);
        for patch in ahead.drain(..) {
            let bytes = self.entry_bytes(geometry, patch);
            let is_there = self.slot_of_patch[patch.index()].is_some();
            if is_there || bytes > *left_bytes || !self.has_slots_to_spare() {
                continue;
            }
            *left_bytes -= bytes;
            if self.admit(geometry, patch, delta).is_some() {
                self.retained.insert(patch, delta.update);
            }
        }
        self.ahead = ahead;
    }

    /// Brings those with a block that come after all others, as far as there is room; the others wait.
    fn bring_behind(
        &mut self,
        geometry: &impl Geometry,
        coming: &[(ScenePatch, Block)],
        mut left_bytes: usize,
        delta: &mut UpdateDelta,
    ) {
        for (patch, block) in coming.iter().copied() {
            if !self.is_behind(patch) {
                continue;
            }
            let bytes = self.entry_bytes(geometry, patch);
            let may_come = bytes == 0 || bytes <= left_bytes && self.has_slots_to_spare();
            match may_come.then(|| self.admit(geometry, patch, &mut delta.geometry)).flatten() {
                Some(slot) => {
                    left_bytes -= bytes;
                    place(geometry, (patch, slot), block, delta);
                }
                None => {
                    self.waiting.push((patch, block));
                    self.behind_waiting += 1;
                }
            }
        }
    }

    fn has_slots_to_spare(&self) -> bool {
        let has = |free: usize, count: u32| free > count as usize / AHEAD_WATER;
        has(self.patch_slots.free.count(), self.patch_slots.count)
            && has(self.vertex_slots.free.count(), self.vertex_slots.count)
    }

    /// Patches that get a block or another one, and those that still wait for a slot: large blocks first.
    fn coming(&mut self, changes: &[PlacementChange]) -> Vec<(ScenePatch, Block)> {
        let mut coming = std::mem::take(&mut self.coming);
        coming.clear();
        let waiting = self.waiting.drain(..).map(|(patch, block)| (patch, Some(block)));
        let changed = changes.iter().map(|change| (change.patch, change.block));
        let all = merged(waiting, changed, |a, b| a.0.cmp(&b.0));
        coming.extend(all.filter_map(|(patch, block)| Some((patch, block?))));
        coming.sort_unstable_by_key(|(patch, block)| (std::cmp::Reverse(block.size.texels()), *patch));
        coming
    }

    fn is_behind(&self, patch: ScenePatch) -> bool {
        self.behind.binary_search(&patch).is_ok()
    }

    /// About how many bytes it takes to bring a patch in, with the vertices that are not there yet.
    pub(crate) fn entry_bytes(&self, geometry: &impl Geometry, patch: ScenePatch) -> usize {
        if self.slot_of_patch[patch.index()].is_some() {
            return 0;
        }
        let instance = geometry.instance_of_patch(patch);
        let lacking = vertices_of_patch(geometry, patch).filter(|v| self.vertices[v.index()].is_none());
        PATCH_BYTES + lacking.map(|vertex| self.vertex_bytes(geometry, instance, vertex)).sum::<usize>()
    }

    /// About how many bytes a vertex takes that is not there yet.
    fn vertex_bytes(&self, geometry: &impl Geometry, instance: u16, vertex: SceneVertex) -> usize {
        let skinning = self.skinning.as_ref().filter(|skinning| skinning.is_skinned(instance));
        match (geometry.static_position(vertex), skinning) {
            (Some(_), _) => STATIC_VERTEX_BYTES,
            (None, Some(skinning)) => {
                skinning.entry_bytes(instance, vertex.0 - geometry.first_vertex(instance).0)
            }
            (None, None) if self.predicts() => PREDICTED_BYTES,
            (None, None) => SAMPLED_VERTEX_BYTES,
        }
    }

    fn lose_block(
        &mut self,
        geometry: &impl Geometry,
        patch: ScenePatch,
        update: UpdateId,
        delta: &mut GeometryDelta,
    ) {
        // Without one it waited for a slot.
        let Some(slot) = self.slot_of_patch[patch.index()] else { return };
        let instance = geometry.instance_of_patch(patch);
        let is_skinned = self.skinning.as_ref().is_some_and(|skinning| skinning.is_skinned(instance));
        let moves = vertices_of_patch(geometry, patch).any(|v| geometry.static_position(v).is_none());
        if moves && !is_skinned {
            self.evict(geometry, patch, update, delta);
        } else {
            self.retained.insert(patch, update);
            delta.placements.push((slot, None));
        }
    }

    /// Evicts retained patches that are too old, or the oldest while slots are short.
    fn forget_old(&mut self, geometry: &impl Geometry, update: UpdateId, delta: &mut GeometryDelta) {
        let short = self.patch_slots.are_short() || self.vertex_slots.are_short();
        let newest_kept = update.0.saturating_sub(if short { 0 } else { RETAIN_UPDATES });
        // Those that lost their block only now are in the delta as placements; they go next time.
        while let Some(patch) = self.retained.pop_before(UpdateId(newest_kept)) {
            self.evict(geometry, patch, update, delta);
        }
    }

    fn evict(
        &mut self,
        geometry: &impl Geometry,
        patch: ScenePatch,
        update: UpdateId,
        delta: &mut GeometryDelta,
    ) {
        let Some(slot) = self.slot_of_patch[patch.index()].take() else { return };
        delta.evicted_patches.push(slot);
        self.patch_slots.leave(update, slot.0);
        for vertex in vertices_of_patch(geometry, patch) {
            let place = &mut self.vertices[vertex.index()];
            let Some(Resident { slot, users }) = place else { continue };
            *users -= 1;
            if *users == 0 {
                delta.evicted_vertices.push(*slot);
                self.vertex_slots.leave(update, slot.0);
                self.moving.remove(slot.index());
                *place = None;
            }
        }
    }

    /// The slot of a patch that has a block, after bringing it and its vertices in where they are not there yet.
    /// `None` where the client's memory is full: the patch waits.
    fn admit(
        &mut self,
        geometry: &impl Geometry,
        patch: ScenePatch,
        delta: &mut GeometryDelta,
    ) -> Option<PatchSlot> {
        self.retained.remove(patch);
        if let Some(known) = self.slot_of_patch[patch.index()] {
            return Some(known);
        }
        let lacking =
            vertices_of_patch(geometry, patch).filter(|v| self.vertices[v.index()].is_none()).count();
        if self.vertex_slots.free.count() < lacking {
            return None;
        }
        let slot = PatchSlot(self.patch_slots.take()?);
        self.slot_of_patch[patch.index()] = Some(slot);
        let instance = geometry.instance_of_patch(patch);
        let first_vertex = geometry.first_vertex(instance);
        let is_skinned = self.skinning.as_ref().is_some_and(|skinning| skinning.is_skinned(instance));
        let is_sampled = !is_skinned && !self.predicts() && geometry.static_position(first_vertex).is_none();
        if is_sampled {
            delta.instances.extend(self.steps.announce(InstanceId(instance)));
        }
        let shape = geometry.patch(patch);
        let mut vertices = [VertexSlot(0); 5];
        for (place, corner) in vertices.iter_mut().zip(shape.vertices).take(shape.kind.vertex_count()) {
            let vertex = first_vertex.plus(corner);
            *place = self.admit_vertex(geometry, vertex, instance, delta);
        }
        let first = vertices[0];
        vertices[shape.kind.vertex_count()..].fill(first);
        let (mesh, first_patch) = geometry.mesh_of(instance);
        delta.new_patches.push(NewPatch {
            slot,
            instance: InstanceId(instance),
            mesh,
            number: patch.0 - first_patch.0,
            kind: shape.kind,
            vertices,
            double_sided: shape.double_sided,
        });
        Some(slot)
    }

    fn admit_vertex(
        &mut self,
        geometry: &impl Geometry,
        vertex: SceneVertex,
        instance: u16,
        delta: &mut GeometryDelta,
    ) -> VertexSlot {
        if let Some(Resident { slot, users }) = &mut self.vertices[vertex.index()] {
            *users += 1;
            return *slot;
        }
        let slot = VertexSlot(self.vertex_slots.take().expect("checked by admit: there are enough"));
        self.vertices[vertex.index()] = Some(Resident { slot, users: 1 });
        self.vertex_of_slot[slot.index()] = vertex;
        let predicts = self.predicts();
        let skinning = self.skinning.as_mut().filter(|skinning| skinning.is_skinned(instance));
        let number = vertex.0 - geometry.first_vertex(instance).0;
        let motion = match (geometry.static_position(vertex), skinning) {
            (Some(position), _) => Motion::Static { position: on_static_grid(position) },
            (None, Some(skinning)) => skinning.enter(instance, number, delta),
            (None, None) if predicts => Motion::Predicted,
            (None, None) => Motion::Sampled,
        };
        if !matches!(motion, Motion::Static { .. }) {
            self.moving.insert(slot.index());
        }
        delta.new_vertices.push(NewVertex { slot, instance: InstanceId(instance), number, motion });
        slot
    }

    /// What codes for the client.
    pub fn coder(&self) -> &SharedCoder {
        &self.coder
    }

    /// What the client skins by itself.
    pub(crate) fn skinning(&self) -> Option<&Skinning> {
        self.skinning.as_ref()
    }

    /// The vertices in the client's memory that move: slot and scene-wide number, ascending by slot.
    pub fn moving(&self) -> impl Iterator<Item = (VertexSlot, SceneVertex)> + '_ {
        self.moving.iter().map(|slot| (VertexSlot(slot as u32), self.vertex_of_slot[slot]))
    }

    /// How many these are.
    pub fn moving_count(&self) -> usize {
        self.moving.count()
    }

    /// By slot: the vertex that is there, or was there last.
    pub fn vertex_of_slot(&self) -> &[SceneVertex] {
        &self.vertex_of_slot
    }

    /// Patches with a block that are not shown, because the client's memory is full or not yet free again.
    pub(crate) fn waiting(&self) -> usize {
        self.waiting.len() - self.held_back - self.behind_waiting
    }

    /// Patches with a block that are not shown yet, because updates may bring only so much.
    #[cfg(test)]
    pub(crate) fn held_back(&self) -> usize {
        self.held_back
    }
}

/// Tells the client of the block of a patch in its memory.
fn place(
    geometry: &impl Geometry,
    (patch, slot): (ScenePatch, PatchSlot),
    block: Block,
    delta: &mut UpdateDelta,
) {
    delta.geometry.placements.push((slot, Some(block)));
    delta.masked.extend(geometry.is_masked(patch).then_some((slot, block)));
}

/// The wire wants each list in ascending order of slots.
fn sort(delta: &mut GeometryDelta) {
    delta.evicted_patches.sort_unstable();
    delta.evicted_vertices.sort_unstable();
    delta.new_vertices.sort_unstable_by_key(|v| v.slot);
    delta.new_patches.sort_unstable_by_key(|p| p.slot);
    delta.placements.sort_unstable_by_key(|(slot, _)| *slot);
    delta.new_rests.sort_unstable_by_key(|rest| rest.rest);
    delta.instances.sort_unstable_by_key(|i| i.instance);
    delta.instances.dedup_by_key(|i| i.instance);
}

#[cfg(test)]
mod tests;
