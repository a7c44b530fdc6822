//! The client's memory: its vertices and patches, by slot.
//!
//! One model serves both sides. The server's residency keeps it for each client; the client's decoder keeps its own. Both
//! refuse a delta that contradicts it; the memory is unusable afterwards.

use crate::atlas::{Block, BlockAddress, PatchKind, PixelTexels};
use crate::coverage::Coverage;
use crate::geometry::{GeometryDelta, InstanceInfo, Motion, NewPatch, NewVertex, Settled, Skinned};
use crate::ids::{InstanceId, PatchSlot, RestId, SkeletonId, VertexSlot};
use crate::limits::{
    BLOCK_MIN_LOG2, MAX_INSTANCES, MAX_REST_VERTICES, MAX_STEP_M, MIN_STEP_M, STORE_PAGE_SIDE,
};
use crate::message::MotionMemory;
use crate::motion::clip::ClipChunk;
use crate::motion::predicted::check_predictions;
use crate::motion::rest::{MeshInfo, PlacedRest, RestVertex};
use crate::motion::skeleton::{PoseSource, SkeletonInfo, SkinnedInstance, ring_words};
use crate::motion::{PositionBatch, SampleBatch, dequantise};
use crate::wire::{WireError, check_count, invalid};
use std::collections::BTreeMap;

/// See the module. Sized once, at connection.
#[derive(Clone, Debug, PartialEq)]
pub struct ClientMemory {
    /// By instance, metres; 0 where not announced.
    steps_m: Vec<f32>,
    /// By vertex slot: whose vertex was there last.
    instances: Vec<InstanceId>,
    /// Slots in use, by any vertex.
    occupied: SlotSet,
    /// Slots in use by vertices with samples.
    sampled: SlotSet,
    /// Slots in use by vertices that updates predict.
    predicted: SlotSet,
    /// Instances that are skinned by the client.
    skinned: BTreeMap<InstanceId, SkeletonSize>,
    /// Vertices before skinning that were told.
    rests: SlotSet,
    /// Their meshes, by rising numbers.
    meshes: Vec<ToldMesh>,
    skeletons: BTreeMap<SkeletonId, SkeletonSize>,
    /// Words of the arena that hold one thing for good: skeletons, morph targets, rings of poses.
    fixed_words: SlotSet,
    /// What was agreed.
    motion: MotionMemory,
    patches: Patches,
    /// Pages of the store: 1 to this.
    store_pages: u32,
}

/// What a skeleton has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct SkeletonSize {
    bones: u32,
    entries: u32,
    morphs: u32,
}

/// A mesh, and as far as its vertices that were told reach: the ends of the palette entries and of the morph targets that they
/// name.
#[derive(Clone, Copy, Debug, PartialEq)]
struct ToldMesh {
    info: MeshInfo,
    entries_end: u32,
    morphs_end: u32,
}

/// What a delta has changed, as far as the pasts of samples depend on it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Entered {
    /// Vertices with samples that are new, ascending.
    pub sampled: Vec<VertexSlot>,
    /// Vertices that were there, whose step is another one: old step by new step.
    pub rescaled: Vec<(VertexSlot, f64)>,
}

/// What lies in which patch slot.
#[derive(Clone, Debug, PartialEq)]
pub struct Patches {
    slots: Vec<Option<ResidentPatch>>,
    /// What copies in the store are filtered for: by page, and by its places of the smallest block, row by row. Empty until one settles there.
    pixels: Vec<Vec<PixelTexels>>,
}

/// A patch in its slot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ResidentPatch {
    /// Whose it is.
    pub instance: InstanceId,
    /// Number and arrangement of its triangles.
    pub kind: PatchKind,
    /// Its vertices; entries that the kind does not use repeat the first.
    pub vertices: [VertexSlot; 5],
    /// Seen from behind too.
    pub double_sided: bool,
    /// Where it lies in the atlas; `None`: it is not drawn.
    pub block: Option<Block>,
    /// What its block is filtered for, where that lies in the store.
    pub pixel: PixelTexels,
    /// It does not cover all of its block.
    pub is_masked: bool,
}

impl ClientMemory {
    /// Empty, for the capacities of [`crate::message::Welcome`].
    pub fn new(vertex_slots: u32, patch_slots: u32) -> Self {
        Self {
            steps_m: vec![0.0; MAX_INSTANCES as usize],
            instances: vec![InstanceId(0); vertex_slots as usize],
            occupied: SlotSet::new(vertex_slots),
            sampled: SlotSet::new(vertex_slots),
            predicted: SlotSet::new(vertex_slots),
            skinned: BTreeMap::new(),
            rests: SlotSet::new(MAX_REST_VERTICES),
            meshes: Vec::new(),
            skeletons: BTreeMap::new(),
            fixed_words: SlotSet::new(MotionMemory::MAX.arena_words),
            motion: MotionMemory::MAX,
            patches: Patches::new(patch_slots),
            store_pages: 0,
        }
    }

    /// With so much memory to skin.
    #[must_use]
    pub fn with_motion(self, motion: MotionMemory) -> Self {
        Self { motion, fixed_words: SlotSet::new(motion.arena_words), ..self }
    }

    /// With so many pages of the store.
    #[must_use]
    pub fn with_store(self, store_pages: u32) -> Self {
        Self { store_pages, ..self }
    }

    /// Vertices before skinning in units of their meshes, as of the last delta taken in.
    pub fn rests(&self, rests: &[RestVertex]) -> Vec<PlacedRest> {
        rests.iter().filter_map(|rest| Some(PlacedRest::of(rest, self.mesh_of(rest.rest)?))).collect()
    }

    /// Vertex slots that exist.
    pub fn vertex_slots(&self) -> u32 {
        self.instances.len() as u32
    }

    /// Patch slots that exist.
    pub fn patch_slots(&self) -> u32 {
        self.patches.slots.len() as u32
    }

    /// True where a vertex lies in the slot.
    pub fn is_occupied(&self, slot: VertexSlot) -> bool {
        self.occupied.contains(slot.0)
    }

    /// True where a vertex with samples lies in the slot.
    pub fn is_sampled(&self, slot: VertexSlot) -> bool {
        self.sampled.contains(slot.0)
    }

    /// True where a vertex lies in the slot that updates predict.
    pub fn is_predicted(&self, slot: VertexSlot) -> bool {
        self.predicted.contains(slot.0)
    }

    /// The slots of all vertices with samples, ascending.
    pub fn sampled_slots(&self) -> Vec<VertexSlot> {
        self.sampled.iter().map(VertexSlot).collect()
    }

    /// Quantisation step of an instance's samples in metres, once it was announced.
    pub fn step_m(&self, instance: InstanceId) -> Option<f32> {
        self.steps_m.get(instance.index()).copied().filter(|step_m| *step_m > 0.0)
    }

    /// Quantisation step of the samples of the vertex in a slot in metres; `None` where its instance has none.
    pub fn step_of(&self, slot: VertexSlot) -> Option<f32> {
        self.instances.get(slot.index()).and_then(|instance| self.step_m(*instance))
    }

    /// Its patches.
    pub fn patches(&self) -> &Patches {
        &self.patches
    }

    /// Takes in a delta.
    ///
    /// # Errors
    /// The delta contradicts what is there, or a limit.
    pub fn apply(&mut self, delta: &GeometryDelta) -> Result<Entered, WireError> {
        self.patches.evict(&delta.evicted_patches)?;
        delta.evicted_vertices.iter().try_for_each(|slot| self.evict_vertex(*slot))?;
        let rescaled = self.announce(&delta.instances)?;
        self.learn(&delta.skinned)?;
        delta.new_rests.iter().try_for_each(|rest| self.insert_rest(rest))?;
        delta.new_vertices.iter().try_for_each(|vertex| self.insert_vertex(vertex))?;
        for patch in &delta.new_patches {
            let free = patch.vertices.iter().find(|slot| !self.is_occupied(**slot));
            if let Some(slot) = free {
                return Err(invalid("a new patch", format!("its vertex slot {} is free", slot.0)));
            }
        }
        self.patches.insert(&delta.new_patches)?;
        let placed = delta.placements.iter().filter_map(|(_, block)| *block);
        placed.chain(delta.settled.iter().map(|settled| settled.to)).try_for_each(|b| self.check_page(b))?;
        self.patches.place(&delta.placements)?;
        self.patches.cover(&delta.coverage)?;
        self.patches.settle(&delta.settled)?;
        check_predictions(&delta.predictions, |slot| self.is_predicted(slot))?;
        let sampled = delta.new_vertices.iter().filter(|vertex| vertex.motion == Motion::Sampled);
        let mut sampled: Vec<_> = sampled.map(|vertex| vertex.slot).collect();
        sampled.sort_unstable();
        Ok(Entered { sampled, rescaled })
    }

    fn check_page(&self, block: Block) -> Result<(), WireError> {
        match u32::from(block.address.page) <= self.store_pages {
            true => Ok(()),
            false => {
                let reason = format!("it is in page {} of {}", block.address.page, self.store_pages);
                Err(invalid("a block of the store", reason))
            }
        }
    }

    /// Samples in metres, as of the last delta taken in. They lie where the samples lay: a delta may have two million.
    pub fn positions(&self, batches: Vec<SampleBatch>) -> Vec<PositionBatch> {
        let step_m = |slot: VertexSlot| self.steps_m[self.instances[slot.index()].index()];
        let batch = |SampleBatch { grid, values }| {
            let placed = values.into_iter().map(|(slot, value)| (slot, dequantise(value, step_m(slot))));
            PositionBatch { grid, positions: placed.collect() }
        };
        batches.into_iter().map(batch).collect()
    }

    /// The mesh of a vertex before skinning.
    pub fn mesh_of(&self, rest: RestId) -> Option<&MeshInfo> {
        self.mesh_place(rest).map(|place| &self.meshes[place].info)
    }

    fn mesh_place(&self, rest: RestId) -> Option<usize> {
        let after = self.meshes.partition_point(|mesh| mesh.info.first_rest <= rest);
        after.checked_sub(1).filter(|place| self.meshes[*place].info.has(rest))
    }

    /// True where an instance was told that is skinned by the client.
    pub fn is_skinned(&self, instance: InstanceId) -> bool {
        self.skinned.contains_key(&instance)
    }

    /// A chunk of a clip lies in the arena, and beside all that stays there for good.
    ///
    /// # Errors
    /// It does not.
    pub fn check_chunk(&self, chunk: &ClipChunk) -> Result<(), WireError> {
        self.check_free("a chunk of a clip", chunk.first_word, chunk.words())
    }

    fn check_free(&self, what: &'static str, first_word: u32, words: u32) -> Result<(), WireError> {
        let end = first_word as usize + words as usize;
        check_count(what, end, self.motion.arena_words as usize)?;
        match (first_word..end as u32).find(|word| self.fixed_words.contains(*word)) {
            None => Ok(()),
            Some(word) => Err(invalid(what, format!("word {word} of the arena holds something for good"))),
        }
    }

    /// Gives words of the arena away for good.
    fn fix_words(&mut self, what: &'static str, first_word: u32, words: u32) -> Result<(), WireError> {
        self.check_free(what, first_word, words)?;
        for word in first_word..first_word + words {
            self.fixed_words.insert(word);
        }
        Ok(())
    }

    fn learn(&mut self, skinned: &Skinned) -> Result<(), WireError> {
        skinned.skeletons.iter().try_for_each(|skeleton| self.learn_skeleton(skeleton))?;
        skinned.meshes.iter().try_for_each(|mesh| self.learn_mesh(mesh))?;
        skinned.instances.iter().try_for_each(|instance| self.learn_instance(instance))
    }

    fn learn_skeleton(&mut self, info: &SkeletonInfo) -> Result<(), WireError> {
        self.fix_words("a skeleton", info.first_word, info.words())?;
        let size = SkeletonSize {
            bones: info.bone_count(),
            entries: info.entries.len() as u32,
            morphs: info.morph_count,
        };
        match self.skeletons.insert(info.skeleton, size) {
            None => Ok(()),
            Some(_) => Err(invalid("a skeleton", format!("{} is told twice", info.skeleton.0))),
        }
    }

    fn learn_mesh(&mut self, mesh: &MeshInfo) -> Result<(), WireError> {
        let end = mesh.first_rest.0 as usize + mesh.count as usize;
        check_count("the end of a mesh's vertices", end, self.motion.rest_vertices as usize)?;
        let place = self.meshes.partition_point(|known| known.info.first_rest <= mesh.first_rest);
        let overlaps = |other: Option<&ToldMesh>| {
            other.is_some_and(|other| other.info.has(mesh.first_rest) || mesh.has(other.info.first_rest))
        };
        let before = place.checked_sub(1).map(|place| &self.meshes[place]);
        if overlaps(before) || overlaps(self.meshes.get(place)) {
            let reason = format!("its vertices from {} on are another's", mesh.first_rest.0);
            return Err(invalid("a mesh", reason));
        }
        self.meshes.insert(place, ToldMesh { info: *mesh, entries_end: 0, morphs_end: 0 });
        Ok(())
    }

    fn learn_instance(&mut self, told: &SkinnedInstance) -> Result<(), WireError> {
        const WHAT: &str = "an instance with a skeleton";
        let Some(size) = self.skeletons.get(&told.skeleton).copied() else {
            return Err(invalid(WHAT, format!("its skeleton {} was not told", told.skeleton.0)));
        };
        let SkeletonSize { bones, entries, morphs } = size;
        let ends = [told.bone_base + bones, told.palette_base + entries.max(morphs)];
        if ends.iter().any(|end| *end > self.motion.pose_places) {
            return Err(invalid(WHAT, format!("its pose ends at {ends:?}, beyond what was agreed")));
        }
        if let PoseSource::Grid { first_word } = told.source {
            self.fix_words(
                "a ring of poses",
                first_word,
                ring_words(self.motion.sample_ring, bones, morphs),
            )?;
        }
        let number = u32::from(told.instance.0);
        match number < MAX_INSTANCES && self.skinned.insert(told.instance, size).is_none() {
            true => Ok(()),
            false => Err(invalid(WHAT, format!("{number} is told twice, or there is none"))),
        }
    }

    fn insert_rest(&mut self, rest: &RestVertex) -> Result<(), WireError> {
        const WHAT: &str = "a rest vertex";
        let Some(place) = self.mesh_place(rest.rest) else {
            return Err(invalid(WHAT, format!("{} is of no mesh", rest.rest.0)));
        };
        if !self.rests.insert(rest.rest.0) {
            return Err(invalid(WHAT, format!("{} is told twice", rest.rest.0)));
        }
        self.fix_words("the morph targets of a vertex", rest.morph_word, rest.morphs.len() as u32)?;
        let mesh = &mut self.meshes[place];
        let end = |numbers: &mut dyn Iterator<Item = u16>| numbers.max().map_or(0, |n| u32::from(n) + 1);
        mesh.entries_end = mesh.entries_end.max(end(&mut rest.joints.iter().copied()));
        mesh.morphs_end = mesh.morphs_end.max(end(&mut rest.morphs.iter().map(|(morph, _)| *morph)));
        Ok(())
    }

    /// A vertex that an instance's skeleton moves.
    fn check_skinned(&self, instance: InstanceId, rest: RestId) -> Result<(), WireError> {
        const WHAT: &str = "a skinned vertex";
        let Some(place) = self.mesh_place(rest).filter(|_| self.rests.contains(rest.0)) else {
            return Err(invalid(WHAT, format!("its rest vertex {} was not told", rest.0)));
        };
        let mesh = &self.meshes[place];
        match self.skinned.get(&instance) {
            None => Err(invalid(WHAT, format!("its instance {} was not announced", instance.0))),
            Some(size) if mesh.entries_end > size.entries || mesh.morphs_end > size.morphs => {
                let reason =
                    format!("its mesh names joints or morph targets that instance {} lacks", instance.0);
                Err(invalid(WHAT, reason))
            }
            Some(_) => Ok(()),
        }
    }

    fn insert_vertex(&mut self, vertex: &NewVertex) -> Result<(), WireError> {
        const WHAT: &str = "a new vertex";
        let NewVertex { slot, instance, motion, .. } = *vertex;
        if slot.0 >= self.vertex_slots() {
            return Err(invalid(WHAT, format!("slot {} of {} does not exist", slot.0, self.vertex_slots())));
        }
        if !self.occupied.insert(slot.0) {
            return Err(invalid(WHAT, format!("slot {} is taken", slot.0)));
        }
        match motion {
            Motion::Static { .. } => {}
            Motion::Predicted => drop(self.predicted.insert(slot.0)),
            Motion::Sampled if self.step_m(instance).is_some() => drop(self.sampled.insert(slot.0)),
            Motion::Sampled => {
                return Err(invalid(WHAT, format!("its instance {} was not announced", instance.0)));
            }
            Motion::Skinned { rest } => self.check_skinned(instance, rest)?,
        }
        self.instances[slot.index()] = instance;
        Ok(())
    }

    fn evict_vertex(&mut self, slot: VertexSlot) -> Result<(), WireError> {
        if !self.occupied.remove(slot.0) {
            return Err(invalid("the eviction of a vertex", format!("slot {} is free", slot.0)));
        }
        self.sampled.remove(slot.0);
        self.predicted.remove(slot.0);
        Ok(())
    }

    /// Sets the quantisation steps of some instances. Gives the vertices for which that changes something.
    fn announce(&mut self, instances: &[InstanceInfo]) -> Result<Vec<(VertexSlot, f64)>, WireError> {
        let mut ratios: Vec<Option<f64>> = Vec::new();
        for &InstanceInfo { instance, step_m } in instances {
            let known = self.steps_m.get_mut(instance.index()).ok_or_else(|| {
                invalid("an instance", format!("{} is not below {MAX_INSTANCES}", instance.0))
            })?;
            if !(MIN_STEP_M..=MAX_STEP_M).contains(&step_m) {
                let reason = format!("{step_m} m of instance {} is out of range", instance.0);
                return Err(invalid("a quantisation step", reason));
            }
            if *known != 0.0 && *known != step_m {
                ratios.resize(MAX_INSTANCES as usize, None);
                let ratio = ratios[instance.index()].get_or_insert(1.0);
                *ratio *= f64::from(*known) / f64::from(step_m);
            }
            *known = step_m;
        }
        if ratios.is_empty() {
            return Ok(Vec::new());
        }
        let ratio_of = |slot| Some((VertexSlot(slot), ratios[self.instances[slot as usize].index()]?));
        Ok(self.sampled.iter().filter_map(ratio_of).collect())
    }
}

/// Places of the smallest block along a side of a page.
const STORE_PLACES_SIDE: usize = (STORE_PAGE_SIDE >> BLOCK_MIN_LOG2) as usize;

fn store_place(address: BlockAddress) -> usize {
    let [x, y] = [address.x, address.y].map(|side| usize::from(side >> BLOCK_MIN_LOG2));
    y * STORE_PLACES_SIDE + x
}

fn pixel_of(pixels: &[Vec<PixelTexels>], block: Block) -> PixelTexels {
    let page = pixels.get(usize::from(block.address.page)).filter(|_| block.is_stored());
    page.and_then(|page| page.get(store_place(block.address))).copied().unwrap_or_default()
}

impl Patches {
    /// `patch_slots` free slots.
    pub fn new(patch_slots: u32) -> Self {
        Self { slots: vec![None; patch_slots as usize], pixels: Vec::new() }
    }

    /// What lies in a slot.
    pub fn get(&self, slot: PatchSlot) -> Option<&ResidentPatch> {
        self.slots.get(slot.index())?.as_ref()
    }

    /// All patches by slot, ascending.
    pub fn iter(&self) -> impl Iterator<Item = (PatchSlot, &ResidentPatch)> {
        let by_slot = self.slots.iter().enumerate();
        by_slot.filter_map(|(slot, patch)| Some((PatchSlot(slot as u32), patch.as_ref()?)))
    }

    /// Patches leave their slots.
    ///
    /// # Errors
    /// There is none.
    pub fn evict(&mut self, slots: &[PatchSlot]) -> Result<(), WireError> {
        slots.iter().try_for_each(|slot| match self.slots.get_mut(slot.index()).and_then(Option::take) {
            Some(_) => Ok(()),
            None => Err(invalid("the eviction of a patch", format!("slot {} is free", slot.0))),
        })
    }

    /// Patches enter free slots. They have no block.
    ///
    /// # Errors
    /// A slot does not exist, or is taken.
    pub fn insert(&mut self, patches: &[NewPatch]) -> Result<(), WireError> {
        const WHAT: &str = "a new patch";
        let slots = self.slots.len();
        for &NewPatch { slot, instance, kind, vertices, double_sided, .. } in patches {
            let place = self
                .slots
                .get_mut(slot.index())
                .ok_or_else(|| invalid(WHAT, format!("slot {} of {slots} does not exist", slot.0)))?;
            if place.is_some() {
                return Err(invalid(WHAT, format!("slot {} is taken", slot.0)));
            }
            let (block, pixel, is_masked) = (None, PixelTexels::default(), false);
            *place = Some(ResidentPatch { instance, kind, vertices, double_sided, block, pixel, is_masked });
        }
        Ok(())
    }

    /// Patches get another block, or lose theirs.
    ///
    /// # Errors
    /// There is no such patch.
    pub fn place(&mut self, placements: &[(PatchSlot, Option<Block>)]) -> Result<(), WireError> {
        let Self { slots, pixels } = self;
        placements.iter().try_for_each(|(slot, block)| match slots.get_mut(slot.index()) {
            Some(Some(patch)) => {
                let pixel = block.map_or(PixelTexels::default(), |block| pixel_of(pixels, block));
                (patch.block, patch.pixel, patch.is_masked) = (*block, pixel, false);
                Ok(())
            }
            _ => Err(invalid("a placement", format!("there is no patch in slot {}", slot.0))),
        })
    }

    /// Blocks settle: patches that are placed there from now on have them.
    ///
    /// # Errors
    /// One does not lie in the atlas, or its copy is not as large, or not in the store.
    pub fn settle(&mut self, settled: &[Settled]) -> Result<(), WireError> {
        settled.iter().try_for_each(|Settled { slot, to, pixel }| {
            let block = self.get(*slot).and_then(|patch| patch.block).filter(|block| !block.is_stored());
            match block.is_some_and(|block| block.size == to.size && to.is_stored()) {
                true => {
                    let page = usize::from(to.address.page);
                    self.pixels.resize(self.pixels.len().max(page + 1), Vec::new());
                    self.pixels[page].resize(STORE_PLACES_SIDE * STORE_PLACES_SIDE, PixelTexels::default());
                    self.pixels[page][store_place(to.address)] = *pixel;
                    Ok(())
                }
                false => {
                    let reason =
                        format!("the patch in slot {} has no block of this size in the atlas", slot.0);
                    Err(invalid("a block that settles", reason))
                }
            }
        })
    }

    /// Patches cover only a part of the block that they have just got.
    ///
    /// # Errors
    /// There is no such patch, or its block has not as many texels.
    pub fn cover(&mut self, coverage: &[(PatchSlot, Coverage)]) -> Result<(), WireError> {
        coverage.iter().try_for_each(|(slot, coverage)| match self.slots.get_mut(slot.index()) {
            Some(Some(patch)) if patch.block.is_some_and(|b| b.size.texels() == coverage.texels()) => {
                patch.is_masked = true;
                Ok(())
            }
            _ => {
                let reason = format!("the patch in slot {} has no block of so many texels", slot.0);
                Err(invalid("coverage of a block", reason))
            }
        })
    }
}

/// A set of slots in one bit each.
#[derive(Clone, Debug, PartialEq)]
struct SlotSet {
    words: Vec<u64>,
}

impl SlotSet {
    fn new(slots: u32) -> Self {
        Self { words: vec![0; slots.div_ceil(64) as usize] }
    }

    fn contains(&self, slot: u32) -> bool {
        self.words.get(slot as usize / 64).is_some_and(|word| word >> (slot % 64) & 1 == 1)
    }

    /// True where it was not in the set. The slot must exist.
    fn insert(&mut self, slot: u32) -> bool {
        let word = &mut self.words[slot as usize / 64];
        let was_in = *word >> (slot % 64) & 1 == 1;
        *word |= 1 << (slot % 64);
        !was_in
    }

    /// True where it was in the set.
    fn remove(&mut self, slot: u32) -> bool {
        let was_in = self.contains(slot);
        if was_in {
            self.words[slot as usize / 64] &= !(1 << (slot % 64));
        }
        was_in
    }

    /// Ascending.
    fn iter(&self) -> impl Iterator<Item = u32> + '_ {
        self.words.iter().enumerate().flat_map(|(index, &word)| {
            let mut rest = word;
            std::iter::from_fn(move || {
                let bit = (rest != 0).then(|| rest.trailing_zeros())?;
                rest &= rest - 1;
                Some(index as u32 * 64 + bit)
            })
        })
    }
}

#[cfg(test)]
mod tests;
