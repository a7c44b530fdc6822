//! What the client knows of meshes: the corners and kinds of their patches, told once for all instances.

use crate::atlas::{BlockSize, PatchKind};
use crate::ids::{InstanceId, MeshId, PatchSlot};
use crate::limits::{MAX_INSTANCES, PATCH_MAX_VERTICES};
use std::collections::HashMap;

/// Patches of meshes that are remembered, for each patch slot.
const KNOWN_PER_SLOT: usize = 2;
/// Corners of a patch at most.
pub(super) const CORNERS: usize = PATCH_MAX_VERTICES as usize;

/// A vertex of an instance, by its number in the mesh.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub(super) struct VertexKey {
    pub instance: InstanceId,
    pub number: u32,
}

/// A patch as all instances of its mesh have it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct MeshPatch {
    pub kind: PatchKind,
    pub double_sided: bool,
    /// Numbers of vertices; what the kind does not use repeats the first.
    pub corners: [u32; CORNERS],
    /// By how many powers of two its last block was wider than high, where it had any.
    aspect: Option<i8>,
}

/// Whose a patch slot's patch is.
#[derive(Clone, Copy, Debug, Default)]
struct Owner {
    instance: InstanceId,
    mesh: MeshId,
    number: u32,
}

/// See the module. Bounded by the slots.
#[derive(Clone, Debug)]
pub(super) struct Known {
    patches: HashMap<(MeshId, u32), MeshPatch>,
    most: usize,
    /// By instance.
    meshes: Vec<Option<MeshId>>,
    /// By patch slot: the last that entered.
    owners: Vec<Owner>,
    /// By vertex slot: the last that entered.
    vertices: Vec<VertexKey>,
    slots: HashMap<VertexKey, u32>,
}

impl MeshPatch {
    pub(super) fn new(kind: PatchKind, double_sided: bool, corners: [u32; CORNERS]) -> Self {
        Self { kind, double_sided, corners, aspect: None }
    }

    /// The corners that its kind has.
    pub(super) fn used(&self) -> &[u32] {
        &self.corners[..self.kind.vertex_count()]
    }
}

impl Known {
    pub(super) fn new(vertex_slots: u32, patch_slots: u32) -> Self {
        Self {
            patches: HashMap::new(),
            most: KNOWN_PER_SLOT * patch_slots as usize,
            meshes: vec![None; MAX_INSTANCES as usize],
            owners: vec![Owner::default(); patch_slots as usize],
            vertices: vec![VertexKey::default(); vertex_slots as usize],
            slots: HashMap::new(),
        }
    }

    /// The mesh of an instance, as far as any patch of it was told.
    pub(super) fn mesh(&self, instance: InstanceId) -> Option<MeshId> {
        self.meshes.get(instance.index()).copied().flatten()
    }

    pub(super) fn patch(&self, mesh: MeshId, number: u32) -> Option<&MeshPatch> {
        self.patches.get(&(mesh, number))
    }

    /// A patch was told. Beyond the bound nothing is learnt.
    pub(super) fn learn(&mut self, mesh: MeshId, number: u32, patch: MeshPatch) {
        if self.patches.len() < self.most {
            self.patches.insert((mesh, number), patch);
        }
    }

    /// A patch lies in this slot from now on.
    pub(super) fn own(&mut self, slot: PatchSlot, instance: InstanceId, mesh: MeshId, number: u32) {
        if let Some(known) = self.meshes.get_mut(instance.index()) {
            *known = Some(mesh);
        }
        if let Some(owner) = self.owners.get_mut(slot.index()) {
            *owner = Owner { instance, mesh, number };
        }
    }

    /// The instance of the patch in a slot, and its number.
    pub(super) fn place(&self, slot: PatchSlot) -> (InstanceId, u32) {
        self.owners.get(slot.index()).map_or_else(Default::default, |owner| (owner.instance, owner.number))
    }

    /// See [`MeshPatch`].
    pub(super) fn aspect(&self, slot: PatchSlot) -> Option<i8> {
        let owner = self.owners.get(slot.index())?;
        self.patch(owner.mesh, owner.number)?.aspect
    }

    pub(super) fn note_aspect(&mut self, slot: PatchSlot, size: BlockSize) {
        let Some(owner) = self.owners.get(slot.index()) else { return };
        if let Some(patch) = self.patches.get_mut(&(owner.mesh, owner.number)) {
            patch.aspect = Some(size.width_log2 as i8 - size.height_log2 as i8);
        }
    }

    /// The slot of a vertex.
    pub(super) fn slot(&self, key: VertexKey) -> Option<u32> {
        self.slots.get(&key).copied()
    }

    /// The vertex that entered a slot last.
    pub(super) fn vertex(&self, slot: u32) -> Option<VertexKey> {
        self.vertices.get(slot as usize).copied()
    }

    /// A vertex enters. Of two with one number the first is known.
    pub(super) fn enter(&mut self, slot: u32, key: VertexKey) {
        if let Some(vertex) = self.vertices.get_mut(slot as usize) {
            *vertex = key;
            self.slots.entry(key).or_insert(slot);
        }
    }

    /// A vertex leaves.
    pub(super) fn leave(&mut self, slot: u32) {
        let Some(key) = self.vertex(slot) else { return };
        if self.slot(key) == Some(slot) {
            self.slots.remove(&key);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_memory_of_meshes_learns_no_more() {
        let mut known = Known::new(1, 2);
        let patch = MeshPatch::new(PatchKind::One, false, [0; CORNERS]);
        (0..9).for_each(|number| known.learn(MeshId(0), number, patch));
        let learnt = (0..9).filter(|number| known.patch(MeshId(0), *number).is_some()).count();
        assert_eq!(learnt, 2 * KNOWN_PER_SLOT);
    }

    #[test]
    fn of_two_vertices_with_one_number_the_first_is_known() {
        let mut known = Known::new(4, 1);
        let key = VertexKey { instance: InstanceId(1), number: 7 };
        (0..4).rev().for_each(|slot| known.enter(slot, key));
        assert_eq!(known.slot(key), Some(3));
        known.leave(0);
        assert_eq!(known.slot(key), Some(3), "another one left");
        known.leave(3);
        assert_eq!(known.slot(key), None);
    }
}
