//! The part of the scene in one client's memory: a cache that only the server writes.
//!
//! Visible patches enter; the delta of each update leaves. [`ClientMemory`](shadecast_protocol::memory::ClientMemory) defines
//! the memory's contents; this folder knows the place of each patch and vertex of the scene, and the free slots. Eviction is
//! lazy, because visible geometry tends to return. Only geometry with samples or predictions leaves with its block, because
//! each of them costs bytes. A freed slot is reused only after the client has displayed the update that freed it.

mod retained;

use crate::atlas::placement::PlacementChange;
use crate::motion::delta::{UpdateDelta, UpdateStamp};
use crate::motion::sampled::{Coder, SharedCoder};
use crate::motion::skinning::Skinning;
use crate::motion::steps::Steps;
use crate::pacing::gate::Budget;
use crate::residency::retained::Retained;
use crate::scene::geometry::{Geometry, vertices_of_patch};
use crate::scene::numbering::{ScenePatch, SceneVertex};
use crate::support::bit_set::BitSet;
use crate::support::lock::lock;
use crate::support::merged::merged;
use crate::support::pool::Pool;
use shadecast_protocol::atlas::Block;
use shadecast_protocol::delta::{DeltaEncoder, EncodedDelta};
use shadecast_protocol::geometry::{GeometryDelta, Motion, NewPatch, NewVertex};
use shadecast_protocol::ids::{InstanceId, PatchSlot, UpdateId, VertexSlot};
use shadecast_protocol::message::MotionMemory;
use shadecast_protocol::motion::predicted::PREDICTED_BYTES;
use std::collections::{HashSet, VecDeque};
use std::sync::{Arc, Mutex};

/// A patch without a block, of vertices that cost nothing while they stay, is forgotten after this many updates.
const RETAIN_UPDATES: u32 = 300;
/// While less than one of so many slots is free, retained patches go at once.
const LOW_WATER: u32 = 8;
/// One of so many slots stays free of what is brought ahead.
const AHEAD_WATER: usize = 16;
/// What is put behind may take one of so many bytes that are left.
const BEHIND_PART: usize = 4;
/// What geometry takes on the wire, about, bytes: a patch, and a vertex that does not move.
const PATCH_BYTES: usize = 12;
const STATIC_VERTEX_BYTES: usize = 14;
/// The first samples of a vertex.
const SAMPLED_VERTEX_BYTES: usize = 30;

/// What an update can still bring.
#[derive(Clone, Debug, Default)]
pub struct Allowance {
    bytes: usize,
    patches: usize,
    vertices: usize,
    /// Vertices that it brings, as far as is known.
    brings: HashSet<SceneVertex>,
    /// Those of what is being reserved.
    newest: Vec<SceneVertex>,
}

/// Slots handed out from the lowest on, and taken back once a frame has been displayed.
#[derive(Debug)]
struct Slots {
    count: u32,
    free: BitSet,
    leaving: VecDeque<(UpdateId, u32)>,
}

impl Slots {
    fn new(count: u32) -> Self {
        Self { count, free: BitSet::all(count as usize), leaving: VecDeque::new() }
    }

    fn are_short(&self) -> bool {
        self.free.count() < (self.count / LOW_WATER) as usize
    }

    fn take(&mut self) -> Option<u32> {
        self.free.pop_first().map(|slot| slot as u32)
    }

    fn leave(&mut self, update: UpdateId, slot: u32) {
        self.leaving.push_back((update, slot));
    }

    fn displayed(&mut self, update: UpdateId) {
        while self.leaving.front().is_some_and(|(left, _)| *left <= update) {
            if let Some((_, slot)) = self.leaving.pop_front() {
                self.free.insert(slot as usize);
            }
        }
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
    /// An empty client memory.
    pub fn new(geometry: &impl Geometry, patch_slots: u32, vertex_slots: u32) -> Self {
        Self {
            coder: Arc::new(Mutex::new(Coder::new(DeltaEncoder::new(vertex_slots, patch_slots)))),
            moving: BitSet::none(vertex_slots as usize),
            vertex_of_slot: vec![SceneVertex(0); vertex_slots as usize],
            steps: Steps::default(),
            skinning: None,
            patch_slots: Slots::new(patch_slots),
            vertex_slots: Slots::new(vertex_slots),
            slot_of_patch: vec![None; geometry.patch_count()],
            vertices: vec![None; geometry.vertex_count()],
            retained: Retained::new(geometry.patch_count()),
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

    /// With what the client skins by itself.
    #[must_use]
    pub(crate) fn with_skinning(mut self, skinning: Skinning, memory: MotionMemory) -> Self {
        let encoder = lock(&self.coder).encoder().clone().with_motion(memory);
        self.coder = Arc::new(Mutex::new(Coder::new(encoder)));
        lock(skinning.sender()).code_with(&self.coder);
        self.skinning = Some(skinning);
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
    pub fn displayed(&mut self, update: UpdateId) {
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

    /// Makes an allowance, in the memory of another, what the next update can bring.
    pub fn allow(&self, allowance: &mut Allowance) {
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
    pub fn encode(&self, delta: &UpdateDelta) -> EncodedDelta {
        lock(&self.coder).update(delta)
    }

    /// What an update has changed is not needed any more: its memory is used for the next.
    pub fn recycle(&mut self, delta: UpdateDelta) {
        self.spare.give(delta);
    }

    /// What brings the client from the last update to this one.
    pub fn update(
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
    fn entry_bytes(&self, geometry: &impl Geometry, patch: ScenePatch) -> usize {
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
        delta.new_patches.push(NewPatch {
            slot,
            instance: InstanceId(instance),
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
        let motion = match (geometry.static_position(vertex), skinning) {
            (Some(position), _) => Motion::Static { position },
            (None, Some(skinning)) => {
                skinning.enter(instance, vertex.0 - geometry.first_vertex(instance).0, delta)
            }
            (None, None) if predicts => Motion::Predicted,
            (None, None) => Motion::Sampled,
        };
        if !matches!(motion, Motion::Static { .. }) {
            self.moving.insert(slot.index());
        }
        delta.new_vertices.push(NewVertex { slot, instance: InstanceId(instance), motion });
        slot
    }

    /// What codes for the client.
    pub fn coder(&self) -> &SharedCoder {
        &self.coder
    }

    /// What the client skins by itself.
    pub fn skinning(&self) -> Option<&Skinning> {
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

    /// Patches with a block that are not shown, because the client's memory is full or not yet free again.
    pub fn waiting(&self) -> usize {
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
mod tests {
    use super::*;
    use crate::motion::sampled::SampleWindow;
    use crate::scene::numbering::SceneVertex;
    use glam::Vec3;
    use shadecast_protocol::atlas::{BlockSize, PatchKind};
    use shadecast_protocol::delta::{Delta, DeltaDecoder};
    use shadecast_protocol::memory::ClientMemory;
    use shadecast_protocol::time::{GridIndex, WorldTime};
    use shadecast_scene::patches::Patch;
    use std::collections::{BTreeMap, BTreeSet, HashMap};

    const PATCHES: u32 = 400;
    const SEED: u64 = 23;

    /// A strip of quads; the first half of the patches belongs to a static instance, the rest to a moving one.
    struct Strip;

    impl Geometry for Strip {
        fn instance_of_patch(&self, patch: ScenePatch) -> u16 {
            u16::from(patch.0 >= PATCHES / 2)
        }
        fn first_vertex(&self, instance: u16) -> SceneVertex {
            SceneVertex(u32::from(instance) * (PATCHES + 2))
        }
        fn patch(&self, patch: ScenePatch) -> Patch {
            let v = 2 * (patch.0 % (PATCHES / 2));
            Patch {
                vertices: [v, v + 1, v + 3, v + 2, v],
                kind: PatchKind::Two,
                material: 0,
                double_sided: false,
            }
        }
        fn static_position(&self, vertex: SceneVertex) -> Option<Vec3> {
            (vertex.0 < PATCHES + 2).then(|| Vec3::new(vertex.0 as f32, 0.0, 0.0))
        }
        fn is_masked(&self, patch: ScenePatch) -> bool {
            patch.0.is_multiple_of(3)
        }
        fn vertex_count(&self) -> usize {
            2 * (PATCHES as usize + 2)
        }
        fn patch_count(&self) -> usize {
            PATCHES as usize
        }
    }

    fn position(grid: GridIndex, vertex: SceneVertex) -> Vec3 {
        Vec3::new(vertex.0 as f32 * 0.01, (grid.0 as f32 * 0.2).sin(), 1.0)
    }

    /// What a client is told: its memory, and of each vertex the samples.
    struct Mirror {
        memory: ClientMemory,
        samples: HashMap<VertexSlot, BTreeSet<i32>>,
    }

    impl Mirror {
        fn apply(&mut self, Delta { geometry, samples, .. }: &Delta) {
            let entered = self.memory.apply(geometry).expect("what the server sends is valid");
            for slot in &geometry.evicted_vertices {
                let is_used = self.memory.patches().iter().any(|(_, patch)| patch.vertices.contains(slot));
                let is_given_anew = geometry.new_vertices.iter().any(|vertex| vertex.slot == *slot);
                assert!(!is_used || is_given_anew, "{slot:?} is still in use");
                self.samples.remove(slot);
            }
            entered.sampled.iter().for_each(|slot| drop(self.samples.insert(*slot, BTreeSet::new())));
            for batch in samples {
                for (slot, _) in &batch.values {
                    self.samples.get_mut(slot).expect("an animated vertex").insert(batch.grid.0);
                }
            }
        }
    }

    fn change(patch: u32, block: Option<Block>) -> PlacementChange {
        PlacementChange { patch: ScenePatch(patch), block }
    }

    fn block(patch: u32) -> Option<Block> {
        Some(Block::unpack(patch % 64).expect("in the atlas"))
    }

    struct Run {
        residency: Residency,
        decoder: DeltaDecoder,
        mirror: Mirror,
        live: BTreeSet<u32>,
        random: u64,
        frame: u32,
    }

    impl Run {
        fn new() -> Self {
            Self {
                residency: Residency::new(&Strip, 1024, 1024),
                decoder: DeltaDecoder::new(1024, 1024),
                mirror: Mirror { memory: ClientMemory::new(1024, 1024), samples: HashMap::new() },
                live: BTreeSet::new(),
                random: SEED,
                frame: 0,
            }
        }

        fn below(&mut self, n: u64) -> u64 {
            self.random = self.random.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (self.random >> 33) % n
        }

        /// Takes in what travels over the wire's coding.
        fn decode(&mut self, coded: &EncodedDelta) -> Delta {
            let decoded = self.decoder.decode(&coded.bytes).expect("what the server sends is valid");
            self.mirror.apply(&decoded);
            let coder = lock(self.residency.coder());
            assert!(self.mirror.memory == *coder.encoder().memory(), "seed {SEED}, frame {}", self.frame);
            decoded
        }

        /// Random patches come and go, then samples follow.
        fn step(&mut self) -> Delta {
            let mut changes: BTreeMap<u32, Option<Block>> = BTreeMap::new();
            for _ in 0..20 {
                let patch = self.below(u64::from(PATCHES)) as u32;
                let comes = self.live.insert(patch) || {
                    self.live.remove(&patch);
                    false
                };
                changes.insert(patch, if comes { block(patch) } else { None });
            }
            let changes: Vec<_> = changes.into_iter().map(|(patch, block)| change(patch, block)).collect();
            let delta = self.residency.update(&Strip, &changes, stamp(self.frame));
            let coded = self.residency.encode(&delta);
            let decoded = self.decode(&coded);
            assert_eq!(decoded.geometry, delta.geometry, "seed {SEED}, frame {}", self.frame);
            let now = GridIndex(self.frame as i32);
            let window = SampleWindow { first: now, oldest: now.plus(-5), horizon: now.plus(5) };
            let samples = lock(self.residency.coder()).samples(window, usize::MAX, position);
            samples.iter().for_each(|samples| drop(self.decode(samples)));
            self.frame += 1;
            decoded
        }
    }

    #[test]
    fn the_client_holds_every_live_patch_with_its_block_and_vertices() {
        let mut run = Run::new();
        for _ in 0..200 {
            run.step();
            let patches = run.mirror.memory.patches();
            let blocks = patches.iter().filter(|(_, patch)| patch.block.is_some()).count();
            assert_eq!(blocks, run.live.len(), "seed {SEED}, frame {}", run.frame);
            for patch in &run.live {
                let slot = run.residency.slot_of_patch[*patch as usize];
                let lies_there = slot.and_then(|slot| patches.get(slot));
                let lies_there = lies_there.expect("the index says so");
                assert_eq!(
                    lies_there.instance.0,
                    Strip.instance_of_patch(ScenePatch(*patch)),
                    "seed {SEED}: {patch}"
                );
                assert_eq!(lies_there.block, block(*patch), "seed {SEED}: {patch}");
            }
            run.residency.displayed(UpdateId(run.frame - 1));
        }
        assert_eq!(run.residency.waiting(), 0);
    }

    #[test]
    fn coverage_is_sent_with_blocks_of_cutouts_only() {
        let mut residency = Residency::new(&Strip, 8192, 8192);
        let all: Vec<_> = (0..30).map(|patch| change(patch, block(patch))).collect();
        for frame in 0..2 {
            let delta = residency.update(&Strip, &all, stamp(frame));
            let slot = |patch: u32| residency.slot_of_patch[patch as usize].expect("there is room");
            let cutouts = (0..30).filter(|patch| Strip.is_masked(ScenePatch(*patch)));
            let mut expected: Vec<_> =
                cutouts.map(|patch| (slot(patch), block(patch).expect("a block"))).collect();
            expected.sort_unstable();
            assert_eq!(delta.masked, expected, "update {frame}: new patches, then placements anew");
        }
    }

    #[test]
    fn every_animated_vertex_has_all_samples_of_its_window() {
        let mut run = Run::new();
        for _ in 0..100 {
            run.step();
            let now = run.frame as i32 - 1;
            assert!(!run.mirror.samples.is_empty());
            for (slot, samples) in &run.mirror.samples {
                let complete = (now..=now + 5).all(|g| samples.contains(&g));
                assert!(complete, "seed {SEED}, frame {now}: {slot:?} has {samples:?}");
            }
            run.residency.displayed(UpdateId(run.frame - 1));
        }
    }

    #[test]
    fn a_freed_slot_waits_for_the_display_of_its_update() {
        let mut run = Run::new();
        let mut freed: HashMap<VertexSlot, u32> = HashMap::new();
        let mut displayed = 0;
        for _ in 0..120 {
            let frame = run.frame;
            let delta = run.step().geometry;
            for vertex in &delta.new_vertices {
                let since = freed.remove(&vertex.slot);
                assert!(since.is_none_or(|since| since <= displayed), "frame {frame}: {:?}", vertex.slot);
            }
            freed.extend(delta.evicted_vertices.iter().map(|slot| (*slot, frame)));
            if frame % 7 == 6 {
                displayed = frame - 3;
                run.residency.displayed(UpdateId(displayed));
            }
        }
    }

    #[test]
    fn deferred_patches_get_the_remaining_budget() {
        let mut residency = Residency::new(&Strip, 1024, 1024);
        residency.put_behind((0..10).map(ScenePatch));
        let bytes = |patches: usize| patches * (PATCH_BYTES + 4 * STATIC_VERTEX_BYTES);
        residency.set_budget(Budget { geometry_bytes: bytes(14), ..Budget::UNLIMITED });
        let changes: Vec<_> = (0..20).map(|patch| change(2 * patch % 40, block(patch))).collect();
        let behind = changes.iter().filter(|change| change.patch.0 < 10).count();
        assert_eq!((behind, changes.len()), (5, 20));
        let first = residency.update(&Strip, &changes, stamp(0));
        assert_eq!(
            (first.geometry.new_patches.len(), residency.held_back(), residency.waiting()),
            (14, 1, 0)
        );
        assert!((0..10).all(|patch| residency.slot_of_patch[patch].is_none()));
        let mut brings = |update: u32| {
            let delta = residency.update(&Strip, &[], stamp(update));
            (delta.geometry.new_patches.len(), residency.held_back(), residency.waiting())
        };
        // 13 are left for them, of which they take a part.
        assert_eq!([brings(1), brings(2), brings(3)], [(1 + 3, 0, 0), (2, 0, 0), (0, 0, 0)]);
    }

    #[test]
    fn what_is_put_behind_leaves_slots_free() {
        let mut residency = Residency::new(&Strip, 64, 1024);
        let changes: Vec<_> = (0..80).map(|patch| change(patch, block(patch))).collect();
        residency.put_behind((0..80).map(ScenePatch));
        residency.update(&Strip, &changes, stamp(0));
        assert_eq!((residency.patch_slots.free.count(), residency.waiting()), (64 / AHEAD_WATER, 0));
    }

    #[test]
    fn hidden_static_geometry_stays_and_returns_free() {
        let mut residency = Residency::new(&Strip, 8192, 8192);
        let change = |block| [change(3, block)];
        residency.update(&Strip, &change(block(3)), stamp(0));
        let lost = residency.update(&Strip, &change(None), stamp(1)).geometry;
        assert!(lost.evicted_patches.is_empty() && lost.placements.len() == 1);
        let back = residency.update(&Strip, &change(block(3)), stamp(2)).geometry;
        assert!(back.new_patches.is_empty() && back.new_vertices.is_empty() && back.placements.len() == 1);
    }

    /// Steps that an instance is told on the way, and the largest distance of a decoded sample from where its vertex was, in steps.
    fn walk(wanted_m: &[f32]) -> (Vec<f32>, f32) {
        let mut residency = Residency::new(&Strip, 1024, 1024);
        let mut decoder = DeltaDecoder::new(1024, 1024);
        let (mut told_m, mut worst) = (Vec::new(), 0f32);
        for (frame, wanted_m) in (0..).zip(wanted_m) {
            residency.want_steps([*wanted_m; 2]);
            let changes = [change(210 + frame, block(3)), change(20, block(4))];
            let delta = residency.update(&Strip, &changes, stamp(frame));
            told_m.extend(delta.geometry.instances.iter().map(|info| info.step_m));
            assert!(delta.geometry.instances.iter().all(|info| info.instance == InstanceId(1)));
            decoder.decode(&residency.encode(&delta).bytes).expect("what the server sends is valid");
            let now = GridIndex(2 * frame as i32);
            let window = SampleWindow { first: now, oldest: now, horizon: now.plus(4) };
            let coded = lock(residency.coder()).samples(window, usize::MAX, position);
            let vertices: HashMap<VertexSlot, SceneVertex> = residency.moving().collect();
            for coded in coded {
                let received = decoder.receive(&coded.bytes).expect("what the server sends is valid");
                for (grid, (slot, shown)) in received
                    .positions
                    .iter()
                    .flat_map(|batch| batch.positions.iter().map(move |position| (batch.grid, position)))
                {
                    let error = (*shown - position(grid, vertices[slot])).abs().max_element();
                    worst = worst.max(error / told_m.last().expect("told before its samples"));
                }
            }
        }
        (told_m, worst)
    }

    #[test]
    fn samples_are_rounded_to_the_announced_step() {
        let (fine, usual) = (1.0 / 8192.0, 1.0 / 2048.0);
        let (told_m, worst) = walk(&[usual, usual, fine, fine, usual, usual * 0.9, fine]);
        assert_eq!(told_m, [usual, fine, usual, usual / 2.0, fine]);
        assert!((0.3..=0.51).contains(&worst), "{worst} steps");
    }

    fn stamp(frame: u32) -> UpdateStamp {
        UpdateStamp { update: UpdateId(frame), time: WorldTime(i64::from(frame) * 33) }
    }

    fn sized(patch: u32, log2: u8) -> PlacementChange {
        let size = BlockSize::new(log2, log2).expect("in range");
        change(patch, Some(Block { size, ..block(patch).expect("a block") }))
    }

    #[test]
    fn a_full_client_memory_takes_the_largest_blocks() {
        let mut residency = Residency::new(&Strip, 8, 8);
        let changes: Vec<_> = (0..50).map(|patch| sized(patch, if patch == 40 { 8 } else { 2 })).collect();
        let delta = residency.update(&Strip, &changes, stamp(0)).geometry;
        assert!(delta.new_vertices.len() <= 8 && residency.waiting() == 50 - delta.new_patches.len());
        assert!(residency.slot_of_patch[40].is_some(), "the largest is there");
        let gone: Vec<_> = changes.iter().map(|c| PlacementChange { block: None, ..*c }).collect();
        residency.update(&Strip, &gone, stamp(1));
        assert_eq!(residency.waiting(), 0, "what lost its block waits no longer");
    }

    #[test]
    fn limited_updates_bring_the_largest_blocks_first() {
        let mut residency = Residency::new(&Strip, 8192, 8192);
        let changes: Vec<_> =
            (0..PATCHES).map(|patch| sized(patch, if patch >= 390 { 8 } else { 2 })).collect();
        residency.set_budget(Budget { geometry_bytes: 1200, ..Budget::UNLIMITED });
        let first = residency.update(&Strip, &changes, stamp(0));
        let bytes = residency.encode(&first).bytes.len();
        let first = first.geometry;
        assert!(first.new_patches.len() >= 10 && residency.held_back() > 300 && residency.waiting() == 0);
        assert!((390..400).all(|patch| residency.slot_of_patch[patch].is_some()), "the largest are there");
        assert!(bytes < 2 * 1200);
        let mut updates = 1;
        while residency.held_back() > 0 {
            let next = residency.update(&Strip, &[], stamp(updates)).geometry;
            assert!(!next.new_patches.is_empty() && next.new_patches.len() == next.placements.len());
            updates += 1;
        }
        assert!((5..200).contains(&updates), "{updates}");
        assert!(residency.slot_of_patch.iter().all(Option::is_some));
    }

    #[test]
    fn reserved_patches_come_with_the_next_update() {
        for (geometry_bytes, slots) in [(2000, 8192), (usize::MAX, 60)] {
            let mut residency = Residency::new(&Strip, slots, slots);
            residency.set_budget(Budget { geometry_bytes, ..Budget::UNLIMITED });
            let level = |first: u32, count: u32| (first..first + count).map(ScenePatch);
            let mut left = Allowance::default();
            residency.allow(&mut left);
            assert!(residency.reserve(&Strip, level(0, 12), &mut left));
            assert!(!residency.reserve(&Strip, level(20, 100), &mut left), "so many do not fit");
            assert!(residency.reserve(&Strip, level(140, 8), &mut left), "what was refused takes nothing");
            assert_eq!(residency.lacking(&level(0, 12).collect::<Vec<_>>()), 12);
            let changes: Vec<_> = (0..12).chain(140..148).map(|patch| sized(patch, 4)).collect();
            let delta = residency.update(&Strip, &changes, stamp(0)).geometry;
            assert_eq!((delta.new_patches.len(), delta.placements.len()), (20, 20));
            assert_eq!((residency.waiting(), residency.held_back()), (0, 0));
        }
    }

    #[test]
    fn prefetched_patches_arrive_without_blocks_and_stay() {
        let mut residency = Residency::new(&Strip, 1024, 1024);
        residency.set_budget(Budget { geometry_bytes: 500, ..Budget::UNLIMITED });
        let ahead: Vec<ScenePatch> = (0..60).map(ScenePatch).collect();
        let (mut updates, mut came) = (0, 0);
        while residency.lacking(&ahead) > 0 {
            residency.bring_ahead(&ahead);
            let delta = residency.update(&Strip, &[], stamp(updates)).geometry;
            assert!(delta.placements.is_empty() && delta.evicted_patches.is_empty());
            assert!(!delta.new_patches.is_empty(), "each update brings some");
            (came, updates) = (came + delta.new_patches.len(), updates + 1);
        }
        assert!(came == 60 && (3..30).contains(&updates), "{came} in {updates}");
        let mut left = Allowance::default();
        residency.allow(&mut left);
        assert!(residency.reserve(&Strip, ahead.iter().copied(), &mut left), "all is there");
        let changes: Vec<_> = (0..60).map(|patch| sized(patch, 2)).collect();
        let shown = residency.update(&Strip, &changes, stamp(updates)).geometry;
        assert!(shown.new_patches.is_empty() && shown.placements.len() == 60);
    }

    #[test]
    fn a_pause_ends_with_the_samples_that_fit_the_budget() {
        let moving: Vec<_> = (200..400).map(|patch| sized(patch, 4)).collect();
        let after_a_pause = |budget_bytes| {
            let mut residency = Residency::new(&Strip, 8192, 8192);
            let delta = residency.update(&Strip, &moving, stamp(0));
            let mut decoder = DeltaDecoder::new(8192, 8192);
            decoder.decode(&residency.encode(&delta).bytes).expect("what the server sends is valid");
            let mut sent = |window, budget_bytes| {
                let coded = lock(residency.coder()).samples(window, budget_bytes, position);
                let decoded = coded.iter().map(|coded| decoder.decode(&coded.bytes).expect("valid").samples);
                decoded.flatten().map(|batch| batch.grid.0).collect::<Vec<_>>()
            };
            let first = SampleWindow { first: GridIndex(0), oldest: GridIndex(0), horizon: GridIndex(3) };
            assert_eq!(sent(first, usize::MAX), [0, 1, 2, 3]);
            let later = SampleWindow { first: GridIndex(25), oldest: GridIndex(15), horizon: GridIndex(30) };
            sent(later, budget_bytes)
        };
        assert_eq!(after_a_pause(usize::MAX), (15..=30).collect::<Vec<_>>());
        assert_eq!(after_a_pause(100), [29, 30]);
        let step_bytes = (PATCHES as usize + 2) * 2;
        assert_eq!(after_a_pause(5 * step_bytes), [26, 27, 28, 29, 30]);
    }

    #[test]
    fn waiting_patches_enter_as_soon_as_slots_are_free() {
        let mut residency = Residency::new(&Strip, 8, 8);
        residency.update(&Strip, &[sized(0, 4), sized(1, 4), sized(2, 4)], stamp(0));
        residency.update(&Strip, &[sized(10, 4)], stamp(1));
        assert_eq!(residency.waiting(), 1, "three quads side by side take eight vertices");
        let lost = [0, 1, 2].map(|patch| change(patch, None));
        let mut came = residency.update(&Strip, &lost, stamp(2)).geometry;
        for frame in 3..8 {
            assert!(came.new_patches.is_empty() || frame > 3);
            residency.displayed(UpdateId(frame - 1));
            came = residency.update(&Strip, &[], stamp(frame)).geometry;
            if !came.new_patches.is_empty() {
                break;
            }
        }
        assert_eq!((came.new_patches.len(), came.placements.len(), residency.waiting()), (1, 1, 0));
    }
}
