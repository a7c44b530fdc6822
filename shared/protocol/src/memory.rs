//! The client's memory: which vertices and patches lie in which slots.
//!
//! One model for both sides. The server's residency keeps it for each client, the client's decoder keeps its own; a delta
//! that contradicts it is refused by both, and leaves it of no further use.

use crate::atlas::{Block, PatchKind};
use crate::geometry::{GeometryDelta, InstanceInfo, Motion, NewPatch, NewVertex};
use crate::ids::{InstanceId, PatchSlot, VertexSlot};
use crate::limits::{MAX_INSTANCES, MAX_STEP_M, MIN_STEP_M};
use crate::motion::{PositionBatch, SampleBatch, dequantise};
use crate::wire::{WireError, invalid};

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
    patches: Patches,
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
pub struct Patches(Vec<Option<ResidentPatch>>);

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
}

impl ClientMemory {
    /// Empty, for the capacities of [`crate::message::Welcome`].
    pub fn new(vertex_slots: u32, patch_slots: u32) -> Self {
        Self {
            steps_m: vec![0.0; MAX_INSTANCES as usize],
            instances: vec![InstanceId(0); vertex_slots as usize],
            occupied: SlotSet::new(vertex_slots),
            sampled: SlotSet::new(vertex_slots),
            patches: Patches::new(patch_slots),
        }
    }

    /// Vertex slots that exist.
    pub fn vertex_slots(&self) -> u32 {
        self.instances.len() as u32
    }

    /// Patch slots that exist.
    pub fn patch_slots(&self) -> u32 {
        self.patches.0.len() as u32
    }

    /// True where a vertex lies in the slot.
    pub fn is_occupied(&self, slot: VertexSlot) -> bool {
        self.occupied.contains(slot.0)
    }

    /// True where a vertex with samples lies in the slot.
    pub fn is_sampled(&self, slot: VertexSlot) -> bool {
        self.sampled.contains(slot.0)
    }

    /// The slots of all vertices with samples, ascending.
    pub fn sampled_slots(&self) -> Vec<VertexSlot> {
        self.sampled.iter().map(VertexSlot).collect()
    }

    /// Quantisation step of an instance's samples in metres, once it was announced.
    pub fn step_m(&self, instance: InstanceId) -> Option<f32> {
        self.steps_m.get(instance.index()).copied().filter(|step_m| *step_m > 0.0)
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
        delta.new_vertices.iter().try_for_each(|vertex| self.insert_vertex(vertex))?;
        for patch in &delta.new_patches {
            let free = patch.vertices.iter().find(|slot| !self.is_occupied(**slot));
            if let Some(slot) = free {
                return Err(invalid("a new patch", format!("its vertex slot {} is free", slot.0)));
            }
        }
        self.patches.insert(&delta.new_patches)?;
        self.patches.place(&delta.placements)?;
        let sampled = delta.new_vertices.iter().filter(|vertex| vertex.motion == Motion::Sampled);
        let mut sampled: Vec<_> = sampled.map(|vertex| vertex.slot).collect();
        sampled.sort_unstable();
        Ok(Entered { sampled, rescaled })
    }

    /// Samples in metres, as of the last delta taken in.
    pub fn positions(&self, batches: &[SampleBatch]) -> Vec<PositionBatch> {
        let step_m = |slot: VertexSlot| self.steps_m[self.instances[slot.index()].index()];
        let batch = |batch: &SampleBatch| PositionBatch {
            grid: batch.grid,
            positions: batch
                .values
                .iter()
                .map(|(slot, value)| (*slot, dequantise(*value, step_m(*slot))))
                .collect(),
        };
        batches.iter().map(batch).collect()
    }

    fn insert_vertex(&mut self, vertex: &NewVertex) -> Result<(), WireError> {
        const WHAT: &str = "a new vertex";
        let NewVertex { slot, instance, motion } = *vertex;
        if slot.0 >= self.vertex_slots() {
            return Err(invalid(WHAT, format!("slot {} of {} does not exist", slot.0, self.vertex_slots())));
        }
        if !self.occupied.insert(slot.0) {
            return Err(invalid(WHAT, format!("slot {} is taken", slot.0)));
        }
        if motion == Motion::Sampled {
            if self.step_m(instance).is_none() {
                return Err(invalid(WHAT, format!("its instance {} was not announced", instance.0)));
            }
            self.sampled.insert(slot.0);
        }
        self.instances[slot.index()] = instance;
        Ok(())
    }

    fn evict_vertex(&mut self, slot: VertexSlot) -> Result<(), WireError> {
        if !self.occupied.remove(slot.0) {
            return Err(invalid("the eviction of a vertex", format!("slot {} is free", slot.0)));
        }
        self.sampled.remove(slot.0);
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

impl Patches {
    /// `patch_slots` free slots.
    pub fn new(patch_slots: u32) -> Self {
        Self(vec![None; patch_slots as usize])
    }

    /// What lies in a slot.
    pub fn get(&self, slot: PatchSlot) -> Option<&ResidentPatch> {
        self.0.get(slot.index())?.as_ref()
    }

    /// All patches by slot, ascending.
    pub fn iter(&self) -> impl Iterator<Item = (PatchSlot, &ResidentPatch)> {
        let by_slot = self.0.iter().enumerate();
        by_slot.filter_map(|(slot, patch)| Some((PatchSlot(slot as u32), patch.as_ref()?)))
    }

    /// Patches leave their slots.
    ///
    /// # Errors
    /// There is none.
    pub fn evict(&mut self, slots: &[PatchSlot]) -> Result<(), WireError> {
        slots.iter().try_for_each(|slot| match self.0.get_mut(slot.index()).and_then(Option::take) {
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
        let slots = self.0.len();
        for &NewPatch { slot, instance, kind, vertices, double_sided } in patches {
            let place = self
                .0
                .get_mut(slot.index())
                .ok_or_else(|| invalid(WHAT, format!("slot {} of {slots} does not exist", slot.0)))?;
            if place.is_some() {
                return Err(invalid(WHAT, format!("slot {} is taken", slot.0)));
            }
            *place = Some(ResidentPatch { instance, kind, vertices, double_sided, block: None });
        }
        Ok(())
    }

    /// Patches get another block, or lose theirs.
    ///
    /// # Errors
    /// There is no such patch.
    pub fn place(&mut self, placements: &[(PatchSlot, Option<Block>)]) -> Result<(), WireError> {
        placements.iter().try_for_each(|(slot, block)| match self.0.get_mut(slot.index()) {
            Some(Some(patch)) => {
                patch.block = *block;
                Ok(())
            }
            _ => Err(invalid("a placement", format!("there is no patch in slot {}", slot.0))),
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
mod tests {
    use super::*;
    use crate::motion::quantise;
    use crate::time::GridIndex;
    use glam::Vec3;

    const SLOT: VertexSlot = VertexSlot(5);
    const INSTANCE: InstanceId = InstanceId(9);

    fn enters(step_m: f32) -> GeometryDelta {
        GeometryDelta {
            instances: vec![InstanceInfo { instance: INSTANCE, step_m }],
            new_vertices: vec![NewVertex { slot: SLOT, instance: INSTANCE, motion: Motion::Sampled }],
            ..GeometryDelta::default()
        }
    }

    #[test]
    fn a_position_comes_back_within_half_a_step_as_of_the_delta_in_hand() {
        let position = Vec3::new(1.234_567, -7.654_321, 0.000_2);
        let mut memory = ClientMemory::new(8, 1);
        for step_m in [0.0005, 0.01] {
            memory.apply(&enters(step_m)).unwrap();
            let batch = SampleBatch { grid: GridIndex(3), values: vec![(SLOT, quantise(position, step_m))] };
            let received = memory.positions(&[batch]);
            let error = received[0].positions[0].1 - position;
            assert!(error.abs().max_element() <= step_m * 0.501, "{error} at {step_m}");
            let leaves = GeometryDelta { evicted_vertices: vec![SLOT], ..GeometryDelta::default() };
            memory.apply(&leaves).unwrap();
        }
        assert_eq!(quantise(Vec3::new(1e30, f32::NAN, -1e30), 1e-6), [i32::MAX, 0, i32::MIN]);
    }

    #[test]
    fn a_new_step_concerns_the_vertices_that_are_there() {
        let mut memory = ClientMemory::new(8, 1);
        assert_eq!(memory.apply(&enters(0.0005)).unwrap(), Entered { sampled: vec![SLOT], rescaled: vec![] });
        let step = InstanceInfo { instance: INSTANCE, step_m: 0.00025 };
        let other = NewVertex { slot: VertexSlot(6), instance: INSTANCE, motion: Motion::Sampled };
        let delta =
            GeometryDelta { instances: vec![step], new_vertices: vec![other], ..GeometryDelta::default() };
        let entered = memory.apply(&delta).unwrap();
        assert_eq!(entered, Entered { sampled: vec![VertexSlot(6)], rescaled: vec![(SLOT, 2.0)] });
        assert_eq!(memory.step_m(INSTANCE), Some(0.00025));
    }

    #[test]
    fn the_set_of_slots_iterates_in_order() {
        let mut set = SlotSet::new(200);
        let slots = [0, 1, 63, 64, 127, 128, 199];
        slots.iter().rev().for_each(|slot| assert!(set.insert(*slot)));
        assert!(!set.insert(63) && set.remove(1) && !set.remove(1) && !set.remove(1000));
        assert_eq!(set.iter().collect::<Vec<_>>(), [0, 63, 64, 127, 128, 199]);
    }
}
