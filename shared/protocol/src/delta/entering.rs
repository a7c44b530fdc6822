//! Patches and vertices that enter. Of a patch that the client knows from its mesh, the number says everything: kind, corners,
//! and so which vertices enter with it. Slots and numbers mostly follow those before.

use super::Part;
use super::known::{CORNERS, Known, MeshPatch, VertexKey};
use super::slots::{Slots, code_slot};
use crate::atlas::PatchKind;
use crate::geometry::{GeometryDelta, Motion, NewPatch, NewVertex, grid_steps};
use crate::ids::{InstanceId, MeshId, PatchSlot, RestId, VertexSlot};
use crate::limits::{MAX_COORDINATE_M, MAX_INSTANCES, STATIC_STEPS_PER_M};
use crate::range::{Chance, Coder, Number, Symbol};
use crate::wire::{WireError, invalid};
use glam::Vec3;

/// Corners told lately that a new one may repeat.
const RECENT: usize = 14;
/// None of those.
const NOT_RECENT: u32 = 15;
const STATIC: u32 = 0;
const SAMPLED: u32 = 1;
const SKINNED: u32 = 2;
const PREDICTED: u32 = 3;

/// Slots that are taken one after the other, mostly.
#[derive(Clone, Debug, Default)]
struct SlotModel {
    is_later: Chance,
    gap: [Number; 2],
    has_gap: bool,
    any: Number,
}

#[derive(Clone, Debug, Default)]
struct PatchModel {
    count: Number,
    slot: SlotModel,
    is_same_instance: Chance,
    instance: Number,
    is_same_mesh: Chance,
    mesh: Number,
    number: [Number; 4],
    class: usize,
    is_known: Chance,
    kind: Symbol<4>,
    is_double_sided: Chance,
}

#[derive(Clone, Debug, Default)]
struct CornerModel {
    by_number: Chance,
    recent: [Symbol<16>; CORNERS],
    step: Number,
    slot: Number,
}

/// Where vertices that do not move lie: on a grid, each near the one before.
#[derive(Clone, Debug, Default)]
struct PlaceModel {
    is_on_grid: Chance,
    axes: [Number; 3],
    before: [i32; 3],
}

#[derive(Clone, Debug, Default)]
struct VertexModel {
    others: Number,
    slot: SlotModel,
    instance: Number,
    number: Number,
    motion: Symbol<4>,
    is_rest_foreseen: Chance,
    rest: Number,
    place: PlaceModel,
}

/// See the module. Sized at connection.
#[derive(Clone, Debug)]
pub(super) struct Entering {
    patch: PatchModel,
    corner: CornerModel,
    vertex: VertexModel,
    /// By instance: the number of the patch that entered last.
    last_patch: Vec<u32>,
    /// By instance: its vertices' rest numbers are those in the mesh and this.
    rest_base: Vec<u32>,
    /// Numbers of corners told lately, the latest first.
    recent: Vec<u32>,
    /// Of one delta, kept for its memory: vertices that no patch brings, by their place in the list to tell.
    others: Vec<usize>,
}

/// What a delta says so far of what enters.
#[derive(Debug)]
pub(super) struct Entered {
    pub patches: Vec<NewPatch>,
    pub vertices: Vec<NewVertex>,
    patch_cursor: u32,
    vertex_cursor: u32,
}

/// What enters, what is known of meshes, and the slots that are taken.
pub(super) struct Scene<'a> {
    pub known: &'a mut Known,
    pub patches: &'a mut Slots,
    pub vertices: &'a mut Slots,
    /// Of an encoder: what to tell. Of a decoder empty.
    pub told: &'a GeometryDelta,
    pub out: Entered,
}

impl SlotModel {
    /// A free slot from the cursor on, or any other.
    fn code(
        &mut self,
        coder: &mut impl Coder,
        slots: &Slots,
        cursor: &mut u32,
        told: u32,
    ) -> Result<u32, WireError> {
        if coder.bit(&mut self.is_later, told < *cursor || slots.contains(told)) {
            return Ok(self.any.code(coder, told));
        }
        let first = *cursor;
        let number = &mut self.gap[usize::from(self.has_gap)];
        let slot = code_slot(coder, number, slots.others(), (cursor, slots.count()), told)?;
        self.has_gap = slot != first;
        Ok(slot)
    }
}

impl PlaceModel {
    /// On the grid the distance to the vertex before, anywhere else all bits.
    fn code(&mut self, coder: &mut impl Coder, told: Option<Motion>) -> Result<Vec3, WireError> {
        let told = match told {
            Some(Motion::Static { position }) => position,
            _ => Vec3::ZERO,
        };
        let on_grid = grid_steps(told);
        let position = if coder.bit(&mut self.is_on_grid, on_grid.is_some()) {
            let steps = on_grid.unwrap_or_default();
            for (axis, model) in self.axes.iter_mut().enumerate() {
                let apart = model.code_signed(coder, steps[axis].wrapping_sub(self.before[axis]));
                self.before[axis] = self.before[axis].wrapping_add(apart);
            }
            Vec3::from_array(self.before.map(|steps| steps as f32 / STATIC_STEPS_PER_M))
        } else {
            Vec3::from_array(told.to_array().map(|c| f32::from_bits(coder.raw(32, c.to_bits()))))
        };
        // Written so that a NaN fails too.
        if position.to_array().iter().all(|c| c.abs() <= MAX_COORDINATE_M) {
            return Ok(position);
        }
        Err(invalid("a vertex's position", format!("{position} is not within {MAX_COORDINATE_M} m")))
    }
}

impl Entered {
    /// Nothing yet, in the memory of these lists.
    pub(super) fn into_lists_of(geometry: &mut GeometryDelta) -> Self {
        Self {
            patches: std::mem::take(&mut geometry.new_patches),
            vertices: std::mem::take(&mut geometry.new_vertices),
            patch_cursor: 0,
            vertex_cursor: 0,
        }
    }
}

impl Scene<'_> {
    /// The vertex to tell that enters this slot, where it has not entered yet.
    fn told_vertex(&self, slot: u32) -> Option<NewVertex> {
        let at = self.told.new_vertices.binary_search_by_key(&slot, |vertex| vertex.slot.0).ok()?;
        Some(self.told.new_vertices[at]).filter(|_| !self.vertices.contains(slot))
    }

    /// Whether a corner's number says which slot is meant.
    fn is_meant(&self, key: VertexKey, slot: u32) -> bool {
        match self.known.slot(key) {
            Some(known) => known == slot,
            None => self.told_vertex(slot).is_some_and(|told| key_of(&told) == key),
        }
    }

    /// The number of the vertex in a slot, where that says which slot is meant.
    fn number_of(&self, instance: InstanceId, slot: u32) -> Option<u32> {
        let key = match self.told_vertex(slot) {
            Some(told) => key_of(&told),
            None => self.known.vertex(slot)?,
        };
        (key.instance == instance && self.is_meant(key, slot)).then_some(key.number)
    }
}

fn key_of(vertex: &NewVertex) -> VertexKey {
    VertexKey { instance: vertex.instance, number: vertex.number }
}

fn kind_of(motion: Motion) -> u32 {
    match motion {
        Motion::Static { .. } => STATIC,
        Motion::Sampled => SAMPLED,
        Motion::Skinned { .. } => SKINNED,
        Motion::Predicted => PREDICTED,
    }
}

impl Entering {
    pub(super) fn new() -> Self {
        Self {
            patch: PatchModel::default(),
            corner: CornerModel::default(),
            vertex: VertexModel::default(),
            last_patch: vec![u32::MAX; MAX_INSTANCES as usize],
            rest_base: vec![0; MAX_INSTANCES as usize],
            recent: Vec::with_capacity(RECENT + 1),
            others: Vec::new(),
        }
    }

    /// All that enters: patches with the vertices that they bring, then other vertices.
    pub(super) fn code(&mut self, coder: &mut impl Coder, scene: &mut Scene<'_>) -> Result<(), WireError> {
        coder.count_for(Part::PatchSlots as usize);
        let told = scene.told;
        let count = self.patch.count.code(coder, told.new_patches.len() as u32);
        check_room("new patches", count, scene.patches)?;
        let mut before = None;
        for index in 0..count as usize {
            let patch = self.patch(coder, scene, before, told.new_patches.get(index))?;
            before = Some(patch.instance);
            scene.out.patches.push(patch);
            check_intact(coder)?;
        }
        coder.count_for(Part::Vertices as usize);
        let is_other = |index: &usize| !scene.vertices.contains(told.new_vertices[*index].slot.0);
        self.others.clear();
        self.others.extend((0..told.new_vertices.len()).filter(is_other));
        let count = self.vertex.others.code(coder, self.others.len() as u32);
        check_room("new vertices", count, scene.vertices)?;
        let mut before = VertexKey::default();
        for index in 0..count as usize {
            let other = self.others.get(index).map(|index| told.new_vertices[*index]);
            let told = other.map(|other| key_of(&other)).unwrap_or_default();
            let instance = instance(self.vertex.instance.code(coder, told.instance.0.into()))?;
            let step = told.number.wrapping_sub(before.number).wrapping_sub(1) as i32;
            let step = self.vertex.number.code_signed(coder, step);
            let number = before.number.wrapping_add(1).wrapping_add(step as u32);
            before = VertexKey { instance, number };
            self.vertex(coder, scene, before, other.map_or(0, |other| other.slot.0))?;
            check_intact(coder)?;
        }
        scene.out.vertices.sort_unstable_by_key(|vertex| vertex.slot);
        scene.out.patches.sort_unstable_by_key(|patch| patch.slot);
        Ok(())
    }

    fn patch(
        &mut self,
        coder: &mut impl Coder,
        scene: &mut Scene<'_>,
        before: Option<InstanceId>,
        told: Option<&NewPatch>,
    ) -> Result<NewPatch, WireError> {
        coder.count_for(Part::PatchSlots as usize);
        let told_slot = told.map_or(0, |told| told.slot.0);
        let slot = self.patch.slot.code(coder, scene.patches, &mut scene.out.patch_cursor, told_slot)?;
        scene.patches.insert(slot);
        let (instance, mesh, number) = self.whose(coder, scene.known, before, told)?;
        scene.known.own(PatchSlot(slot), instance, mesh, number);
        let key = |number| VertexKey { instance, number };
        let known = scene.known.patch(mesh, number).copied();
        coder.count_for(Part::PatchKinds as usize);
        let is_known = known.is_some_and(|known| {
            let is_so = |told: &NewPatch| {
                let mut corners = known.used().iter().zip(told.vertices);
                known.kind == told.kind
                    && known.double_sided == told.double_sided
                    && corners.all(|(corner, slot)| scene.is_meant(key(*corner), slot.0))
            };
            coder.bit(&mut self.patch.is_known, told.is_some_and(is_so))
        });
        let mut vertices = [VertexSlot(0); CORNERS];
        let (kind, double_sided) = match known.filter(|_| is_known) {
            Some(known) => {
                for (index, corner) in known.used().iter().enumerate() {
                    let told = told.map_or(0, |told| told.vertices[index].0);
                    vertices[index] = VertexSlot(self.corner_slot(coder, scene, key(*corner), told)?);
                }
                (known.kind, known.double_sided)
            }
            None => self.tell(coder, scene, (instance, mesh, number), told, &mut vertices)?,
        };
        let first = vertices[0];
        vertices[kind.vertex_count()..].fill(first);
        Ok(NewPatch { slot: PatchSlot(slot), instance, mesh, number, kind, vertices, double_sided })
    }

    /// Instance, mesh and number of a patch.
    fn whose(
        &mut self,
        coder: &mut impl Coder,
        known: &Known,
        before: Option<InstanceId>,
        told: Option<&NewPatch>,
    ) -> Result<(InstanceId, MeshId, u32), WireError> {
        let model = &mut self.patch;
        let told_instance = told.map_or(InstanceId(0), |told| told.instance);
        let is_same = coder.bit(&mut model.is_same_instance, before == Some(told_instance));
        let instance = match before.filter(|_| is_same) {
            Some(instance) => instance,
            None => instance(model.instance.code(coder, told_instance.0.into()))?,
        };
        let told_mesh = told.map_or(MeshId(0), |told| told.mesh);
        let same_mesh = known.mesh(instance);
        let mesh = match same_mesh {
            Some(mesh) if coder.bit(&mut model.is_same_mesh, told_mesh == mesh) => mesh,
            _ => MeshId(model.mesh.code(coder, told_mesh.0)),
        };
        let last = &mut self.last_patch[instance.index()];
        let told_number = told.map_or(0, |told| told.number);
        let step = told_number.wrapping_sub(*last).wrapping_sub(1) as i32;
        let step = model.number[model.class].code_signed(coder, step);
        model.class = match step {
            0 => 0,
            1..16 => 1,
            16.. => 2,
            _ => 3,
        };
        *last = last.wrapping_add(1).wrapping_add(step as u32);
        Ok((instance, mesh, *last))
    }

    /// Kind and corners of a patch that no instance of the mesh has shown yet.
    fn tell(
        &mut self,
        coder: &mut impl Coder,
        scene: &mut Scene<'_>,
        (instance, mesh, number): (InstanceId, MeshId, u32),
        told: Option<&NewPatch>,
        vertices: &mut [VertexSlot; CORNERS],
    ) -> Result<(PatchKind, bool), WireError> {
        let kind = self.patch.kind.code(coder, told.map_or(0, |told| told.kind as u32));
        let kind = PatchKind::from_triangle_count(kind as u8)
            .ok_or_else(|| invalid("a patch's kind", format!("{kind:#x} is none")))?;
        let double_sided =
            coder.bit(&mut self.patch.is_double_sided, told.is_some_and(|told| told.double_sided));
        let mut corners = Some([0; CORNERS]);
        for index in 0..kind.vertex_count() {
            coder.count_for(Part::Corners as usize);
            let told_slot = told.map_or(0, |told| told.vertices[index].0);
            let told_number = if told.is_some() { scene.number_of(instance, told_slot) } else { None };
            vertices[index] = if coder.bit(&mut self.corner.by_number, told_number.is_some()) {
                let corner = self.corner_number(coder, index, told_number.unwrap_or(0));
                corners.iter_mut().for_each(|corners| corners[index] = corner);
                VertexSlot(self.corner_slot(
                    coder,
                    scene,
                    VertexKey { instance, number: corner },
                    told_slot,
                )?)
            } else {
                corners = None;
                VertexSlot(self.corner.slot.code(coder, told_slot))
            };
        }
        if let Some(mut corners) = corners {
            let first = corners[0];
            corners[kind.vertex_count()..].fill(first);
            scene.known.learn(mesh, number, MeshPatch::new(kind, double_sided, corners));
        }
        Ok((kind, double_sided))
    }

    /// The number of a corner: one of those told lately, or its distance from the last of them.
    fn corner_number(&mut self, coder: &mut impl Coder, index: usize, told: u32) -> u32 {
        let rank = self.recent.iter().position(|recent| *recent == told).map_or(NOT_RECENT, |at| at as u32);
        let rank = self.corner.recent[index].code(coder, rank) as usize;
        let number = if rank < self.recent.len() {
            self.recent.remove(rank)
        } else {
            let last = self.recent.first().copied().unwrap_or(u32::MAX);
            let step = told.wrapping_sub(last).wrapping_sub(1) as i32;
            last.wrapping_add(1).wrapping_add(self.corner.step.code_signed(coder, step) as u32)
        };
        self.recent.insert(0, number);
        self.recent.truncate(RECENT);
        number
    }

    /// The slot of a vertex, which enters where it is not there yet.
    fn corner_slot(
        &mut self,
        coder: &mut impl Coder,
        scene: &mut Scene<'_>,
        key: VertexKey,
        told: u32,
    ) -> Result<u32, WireError> {
        match scene.known.slot(key) {
            Some(slot) => Ok(slot),
            None => self.vertex(coder, scene, key, told),
        }
    }

    /// A vertex enters.
    fn vertex(
        &mut self,
        coder: &mut impl Coder,
        scene: &mut Scene<'_>,
        key: VertexKey,
        told_slot: u32,
    ) -> Result<u32, WireError> {
        coder.count_for(Part::Vertices as usize);
        let told = scene.told_vertex(told_slot).map(|told| told.motion);
        let Scene { vertices, out, known, .. } = scene;
        let slot = self.vertex.slot.code(coder, vertices, &mut out.vertex_cursor, told_slot)?;
        let motion = match self.vertex.motion.code(coder, told.map_or(STATIC, kind_of)) {
            STATIC => Motion::Static { position: self.vertex.place.code(coder, told)? },
            SAMPLED => Motion::Sampled,
            PREDICTED => Motion::Predicted,
            _ => Motion::Skinned { rest: self.rest(coder, key, told) },
        };
        vertices.insert(slot);
        known.enter(slot, key);
        let VertexKey { instance, number } = key;
        out.vertices.push(NewVertex { slot: VertexSlot(slot), instance, number, motion });
        Ok(slot)
    }

    /// All rest numbers of an instance lie as far from those in the mesh.
    fn rest(&mut self, coder: &mut impl Coder, key: VertexKey, told: Option<Motion>) -> RestId {
        let base = &mut self.rest_base[key.instance.index()];
        let told = match told {
            Some(Motion::Skinned { rest }) => rest.0,
            _ => 0,
        };
        let foreseen = key.number.wrapping_add(*base);
        if coder.bit(&mut self.vertex.is_rest_foreseen, told == foreseen) {
            return RestId(foreseen);
        }
        let rest = self.vertex.rest.code(coder, told);
        *base = rest.wrapping_sub(key.number);
        RestId(rest)
    }
}

fn instance(number: u32) -> Result<InstanceId, WireError> {
    match number < MAX_INSTANCES {
        true => Ok(InstanceId(number as u16)),
        false => Err(WireError::TooMany {
            what: "the number of an instance",
            value: number.into(),
            limit: u64::from(MAX_INSTANCES) - 1,
        }),
    }
}

fn check_room(what: &'static str, count: u32, slots: &Slots) -> Result<(), WireError> {
    crate::wire::check_count(what, count as usize, slots.count() as usize).map(drop)
}

fn check_intact(coder: &impl Coder) -> Result<(), WireError> {
    match coder.is_intact() {
        true => Ok(()),
        false => Err(invalid("what enters", "it ends too early")),
    }
}
