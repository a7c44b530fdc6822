//! The input of a display frame's one draw: corners and indices of every patch with a block.
//!
//! Corners lie by patch slot, and a patch keeps its place among the indices. The newest list changes by differences. Each
//! bundle's memory is updated by the differences since its last write.

use super::index_places::IndexPlaces;
use crate::motion::{Motion, Users};
use arrayvec::ArrayVec;
use shadecast_protocol::ids::{PatchSlot, VertexSlot};
use shadecast_protocol::limits::{ATLAS_MAX_EXTENT, PATCH_MAX_VERTICES, STORE_PAGE_SIDE};
use shadecast_protocol::memory::{Patches, ResidentPatch};
use shadecast_protocol::time::GridIndex;
use shadecast_shaders::constants::{BLOCK_END_BITS, IS_KEPT, IS_MASKED, STORED_PIXEL_BIT};
use shadecast_shaders::generated::CornerGpu;

/// Corners of a patch of three triangles, and its indices.
pub const MAX_CORNERS_PER_PATCH: usize = PATCH_MAX_VERTICES as usize;
/// Indices of a patch of three triangles, both sides.
pub const MAX_INDICES_PER_PATCH: usize = 18;

/// Corners, and indices, that are copied together: about 500 bytes.
const CORNERS_PER_CHUNK: usize = 4 * MAX_CORNERS_PER_PATCH;
const INDICES_PER_CHUNK: usize = 128;

/// Indices of patches that can be drawn from the same grid step on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Group {
    first: GridIndex,
    /// Of it and those before it: from the list's first index on, or, of cutouts, back from its last.
    index_count: u32,
    patches: u32,
}

/// What can be drawn of a list, and when: what covers all of its block from the first index on, and cutouts back from the last; of
/// both what waits for no samples, then the others in the order of the steps from which all their vertices have some.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DrawList {
    opaque: Vec<Group>,
    cutouts: Vec<Group>,
    /// Indices that there is room for.
    capacity: u32,
}

/// What of a list can be drawn at a time: indices. Some are of triangles without area.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Drawable {
    /// Of patches that cover all of their block, from the list's first on.
    pub opaque: u32,
    /// The first of a cutout, and how many there are.
    pub cutouts: [u32; 2],
    /// Patches that have to wait for their samples.
    pub withheld_patches: u32,
}

impl Drawable {
    /// Both ranges: first and count.
    pub fn ranges(&self) -> [[u32; 2]; 2] {
        [[0, self.opaque], self.cutouts]
    }
}

impl DrawList {
    /// With room for so many patches.
    pub fn of_capacity(patch_slots: u32) -> Self {
        let room = || Vec::with_capacity(patch_slots as usize + 1);
        let capacity = patch_slots * MAX_INDICES_PER_PATCH as u32;
        Self { opaque: room(), cutouts: room(), capacity }
    }

    /// What can be drawn when the last grid step at or before the display time is `step`.
    pub fn at(&self, step: GridIndex) -> Drawable {
        let until = |groups: &[Group]| groups.partition_point(|group| group.first <= step);
        let count = |groups: &[Group]| groups.last().map_or(0, |group| group.index_count);
        let (opaque, cutouts) = (until(&self.opaque), until(&self.cutouts));
        let cutout_count = count(&self.cutouts[..cutouts]);
        let late = self.opaque[opaque..].iter().chain(&self.cutouts[cutouts..]);
        Drawable {
            opaque: count(&self.opaque[..opaque]),
            cutouts: [self.capacity - cutout_count, cutout_count],
            withheld_patches: late.map(|group| group.patches).sum(),
        }
    }

    /// Whether some of it waits for samples, so that time alone changes it.
    pub fn waits(&self) -> bool {
        let last = |groups: &[Group]| groups.last().is_some_and(|group| group.first > GridIndex(i32::MIN));
        last(&self.opaque) || last(&self.cutouts)
    }

    /// The first step at which all can be drawn that can be at `step`.
    pub fn ready_at(&self, step: GridIndex) -> GridIndex {
        let firsts = self.opaque.iter().chain(&self.cutouts).map(|group| group.first);
        firsts.filter(|first| *first <= step).max().unwrap_or(GridIndex(i32::MIN))
    }

    /// As another one.
    pub fn copy(&mut self, other: &Self) {
        self.opaque.clone_from(&other.opaque);
        self.cutouts.clone_from(&other.cutouts);
        self.capacity = other.capacity;
    }
}

/// Where a patch is among the indices.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Place {
    /// It is not drawn.
    #[default]
    None,
    /// It waits for no samples: its place in its kind, and how many indices it has.
    Kept { place: u32, count: u32, is_masked: bool },
    /// Behind those that do not, anew in each list.
    Waits { is_masked: bool },
}

/// Parts of a list in which something has changed.
#[derive(Clone, Debug)]
struct Changed {
    corners: Vec<bool>,
    indices: Vec<bool>,
}

/// The newest list of a scene, and how each bundle's memory differs from it.
#[derive(Debug)]
pub struct NewestList {
    corners: Vec<CornerGpu>,
    indices: Vec<u32>,
    /// By patch slot.
    places: Vec<Place>,
    /// By patch slot: how many corners it has in the list.
    corner_counts: Vec<u8>,
    opaque: IndexPlaces,
    cutouts: IndexPlaces,
    /// Patches in kept places, opaque and cutouts.
    kept: [u32; 2],
    waiting: Vec<PatchSlot>,
    /// Patches with a block that they did not have in the list before, where the client blends.
    fresh: Vec<PatchSlot>,
    blends: bool,
    /// Those that wait, in the order in which they can be drawn.
    order: Vec<(bool, GridIndex, PatchSlot)>,
    list: DrawList,
    /// By bundle.
    changed: Vec<Changed>,
}

impl NewestList {
    /// Of so many patch slots, for so many bundles, of whose memory nothing is known. With `blends`, it says which blocks the list
    /// before has too.
    pub fn new(patch_slots: u32, bundles: usize, blends: bool) -> Self {
        let slots = patch_slots as usize;
        let (corners, indices) = (slots * MAX_CORNERS_PER_PATCH, slots * MAX_INDICES_PER_PATCH);
        let changed = Changed {
            corners: vec![true; corners.div_ceil(CORNERS_PER_CHUNK)],
            indices: vec![true; indices.div_ceil(INDICES_PER_CHUNK)],
        };
        Self {
            corners: vec![bytemuck::Zeroable::zeroed(); corners],
            indices: vec![0; indices],
            places: vec![Place::None; slots],
            corner_counts: vec![0; slots],
            opaque: IndexPlaces::default(),
            cutouts: IndexPlaces::default(),
            kept: [0; 2],
            waiting: Vec::with_capacity(slots),
            fresh: Vec::with_capacity(if blends { slots } else { 0 }),
            blends,
            order: Vec::with_capacity(slots),
            list: DrawList::of_capacity(patch_slots),
            changed: vec![changed; bundles],
        }
    }

    /// What can be drawn of it, and when.
    pub fn list(&self) -> &DrawList {
        &self.list
    }

    /// Whether the next list differs from this one though nothing changes: what is new in this one is not in that.
    pub fn has_fresh(&self) -> bool {
        !self.fresh.is_empty()
    }

    /// Takes in what has become of some patches; of each that waits for samples, from when on it can be drawn. Tells `motion` what
    /// the list uses.
    pub fn update(&mut self, patches: &Patches, changed: &[PatchSlot], motion: &mut Motion) {
        let mut users = motion.users();
        let drawn = |slot: PatchSlot| patches.get(slot).filter(|patch| patch.block.is_some());
        self.keep_fresh();
        for slot in changed {
            if !drawn(*slot).is_some_and(|patch| self.moves(*slot, patch)) {
                self.remove(*slot, &mut users);
            }
        }
        for slot in changed {
            if let Some(patch) = drawn(*slot).filter(|_| self.places[slot.index()] == Place::None) {
                self.insert(*slot, patch, &mut users);
            }
        }
        self.place_waiting(patches, &users);
        users.end();
    }

    fn remove(&mut self, slot: PatchSlot, users: &mut Users<'_>) {
        match std::mem::take(&mut self.places[slot.index()]) {
            Place::None => return,
            // It is left out where those that wait are placed.
            Place::Waits { .. } => {}
            Place::Kept { place, count, is_masked } => {
                self.put(place, is_masked, &[0; MAX_INDICES_PER_PATCH][..count as usize]);
                self.places_of(is_masked).give(place, count);
                self.kept[usize::from(is_masked)] -= 1;
            }
        }
        users.remove(&self.vertices(slot));
    }

    /// Where a patch that is in the list has got nothing but another block, writes its corners; false where there is more to it.
    fn moves(&mut self, slot: PatchSlot, patch: &ResidentPatch) -> bool {
        let Place::Kept { place, count, is_masked } = self.places[slot.index()] else { return false };
        let indices = indices_of(patch, (slot.index() * MAX_CORNERS_PER_PATCH) as u32);
        let start = self.start(place, count, is_masked);
        let is_same = is_masked == patch.is_masked
            && self.indices[start..][..count as usize] == indices[..]
            && self.vertices(slot)[..] == patch.vertices[..patch.kind.vertex_count()];
        if is_same {
            self.put_corners(slot, patch);
        }
        is_same
    }

    /// Blocks that were new in the list are kept now.
    fn keep_fresh(&mut self) {
        let mut fresh = std::mem::take(&mut self.fresh);
        for slot in fresh.drain(..) {
            let (first, count) =
                (slot.index() * MAX_CORNERS_PER_PATCH, usize::from(self.corner_counts[slot.index()]));
            self.corners[first..][..count].iter_mut().for_each(|corner| corner.block[0] |= IS_KEPT);
            self.changed.iter_mut().for_each(|changed| changed.note_corners(first, count));
        }
        self.fresh = fresh;
    }

    fn put_corners(&mut self, slot: PatchSlot, patch: &ResidentPatch) {
        let first = slot.index() * MAX_CORNERS_PER_PATCH;
        let corners = corners_of(patch);
        self.corner_counts[slot.index()] = corners.len() as u8;
        self.corners[first..][..corners.len()].copy_from_slice(&corners);
        self.changed.iter_mut().for_each(|changed| changed.note_corners(first, corners.len()));
        if self.blends && patch.block.is_some_and(|block| !block.is_stored()) {
            self.fresh.push(slot);
        }
    }

    fn insert(&mut self, slot: PatchSlot, patch: &ResidentPatch, users: &mut Users<'_>) {
        let first_corner = slot.index() * MAX_CORNERS_PER_PATCH;
        self.put_corners(slot, patch);
        let is_masked = patch.is_masked;
        if users.add(&self.vertices(slot)) > GridIndex(i32::MIN) {
            self.places[slot.index()] = Place::Waits { is_masked };
            return self.waiting.push(slot);
        }
        let indices = indices_of(patch, first_corner as u32);
        self.make_room(indices.len() as u32);
        let place = self.places_of(is_masked).take(indices.len() as u32);
        self.put(place, is_masked, &indices);
        self.kept[usize::from(is_masked)] += 1;
        self.places[slot.index()] = Place::Kept { place, count: indices.len() as u32, is_masked };
    }

    /// Writes those that wait behind those that do not, and says from when on what can be drawn.
    fn place_waiting(&mut self, patches: &Patches, users: &Users<'_>) {
        let mut order = std::mem::take(&mut self.order);
        order.clear();
        for slot in &self.waiting {
            if let Place::Waits { is_masked } = self.places[slot.index()] {
                order.push((is_masked, users.ready(&self.vertices(*slot)), *slot));
            }
        }
        order.sort_unstable();
        order.dedup();
        self.waiting.clear();
        self.waiting.extend(order.iter().map(|(_, _, slot)| *slot));
        let waiting = self.waiting.len() * MAX_INDICES_PER_PATCH;
        if self.opaque.is_sparse() || self.cutouts.is_sparse() {
            self.pack();
        }
        self.make_room(waiting as u32);
        self.begin_groups();
        for (is_masked, first, slot) in &order {
            let Some(patch) = patches.get(*slot) else { continue };
            let indices = indices_of(patch, (slot.index() * MAX_CORNERS_PER_PATCH) as u32);
            let groups = self.groups_of(*is_masked);
            let place = groups.last().map_or(0, |group| group.index_count);
            let index_count = place + indices.len() as u32;
            match groups.last_mut().filter(|group| group.first == *first) {
                Some(group) => (group.index_count, group.patches) = (index_count, group.patches + 1),
                None => groups.push(Group { first: *first, index_count, patches: 1 }),
            }
            self.put(place, *is_masked, &indices);
        }
        self.order = order;
    }

    /// Groups of what waits for nothing.
    fn begin_groups(&mut self) {
        let at_once = GridIndex(i32::MIN);
        let kept = [(&self.opaque, self.kept[0]), (&self.cutouts, self.kept[1])];
        let [opaque, cutouts] =
            kept.map(|(places, patches)| Group { first: at_once, index_count: places.end(), patches });
        let DrawList { opaque: of_opaque, cutouts: of_cutouts, .. } = &mut self.list;
        for (groups, kept) in [(of_opaque, opaque), (of_cutouts, cutouts)] {
            groups.clear();
            groups.extend((kept.index_count > 0).then_some(kept));
        }
    }

    /// So many more indices fit between both kinds, without holes if need be: there is room for all that patch slots can hold.
    fn make_room(&mut self, count: u32) {
        if self.opaque.end() + self.cutouts.end() + count > self.list.capacity {
            self.pack();
        }
    }

    /// Places all that wait for nothing anew, without holes.
    fn pack(&mut self) {
        let before = self.indices.clone();
        self.indices.fill(0);
        self.opaque.clear();
        self.cutouts.clear();
        for slot in 0..self.places.len() {
            let Place::Kept { place, count, is_masked } = self.places[slot] else { continue };
            let start = self.start(place, count, is_masked);
            let now = self.places_of(is_masked).take(count);
            self.put(now, is_masked, &before[start..][..count as usize]);
            self.places[slot] = Place::Kept { place: now, count, is_masked };
        }
        self.changed.iter_mut().for_each(|changed| changed.indices.fill(true));
    }

    fn places_of(&mut self, is_masked: bool) -> &mut IndexPlaces {
        if is_masked { &mut self.cutouts } else { &mut self.opaque }
    }

    fn groups_of(&mut self, is_masked: bool) -> &mut Vec<Group> {
        if is_masked { &mut self.list.cutouts } else { &mut self.list.opaque }
    }

    /// The first of so many indices in a place of their kind: cutouts lie back from the last.
    fn start(&self, place: u32, count: u32, is_masked: bool) -> usize {
        (if is_masked { self.list.capacity - place - count } else { place }) as usize
    }

    fn put(&mut self, place: u32, is_masked: bool, indices: &[u32]) {
        let start = self.start(place, indices.len() as u32, is_masked);
        let there = &mut self.indices[start..][..indices.len()];
        if there != indices {
            there.copy_from_slice(indices);
            self.changed.iter_mut().for_each(|changed| changed.note_indices(start, indices.len()));
        }
    }

    /// Of a patch that is in the list.
    fn vertices(&self, slot: PatchSlot) -> ArrayVec<VertexSlot, MAX_CORNERS_PER_PATCH> {
        let corners = &self.corners[slot.index() * MAX_CORNERS_PER_PATCH..];
        let count = usize::from(self.corner_counts[slot.index()]);
        corners[..count].iter().map(|corner| VertexSlot(corner.vertex_slot)).collect()
    }

    /// Brings a bundle's memory up to date, which nobody else has written since. Gives the bytes written.
    pub fn copy_to(&mut self, bundle: usize, (corners, indices): (&mut [CornerGpu], &mut [u32])) -> usize {
        let Changed { corners: of_corners, indices: of_indices } = &mut self.changed[bundle];
        copy_changed(of_corners, CORNERS_PER_CHUNK, &self.corners, corners)
            + copy_changed(of_indices, INDICES_PER_CHUNK, &self.indices, indices)
    }
}

impl Changed {
    fn note_corners(&mut self, first: usize, count: usize) {
        note(&mut self.corners, CORNERS_PER_CHUNK, first, count);
    }

    fn note_indices(&mut self, first: usize, count: usize) {
        note(&mut self.indices, INDICES_PER_CHUNK, first, count);
    }
}

fn note(chunks: &mut [bool], per_chunk: usize, first: usize, count: usize) {
    chunks[first / per_chunk..=(first + count - 1) / per_chunk].fill(true);
}

/// Copies the chunks that have changed, which then have not. Gives the bytes copied.
fn copy_changed<T: Copy>(changed: &mut [bool], per_chunk: usize, from: &[T], to: &mut [T]) -> usize {
    let mut bytes = 0;
    let chunks = from.chunks(per_chunk).zip(to.chunks_mut(per_chunk));
    for (changed, (from, to)) in changed.iter_mut().zip(chunks).filter(|(changed, _)| **changed) {
        to[..from.len()].copy_from_slice(from);
        *changed = false;
        bytes += size_of_val(from);
    }
    bytes
}

const _: () = assert!(
    ATLAS_MAX_EXTENT[0] < 1 << BLOCK_END_BITS
        && ATLAS_MAX_EXTENT[1] < 1 << BLOCK_END_BITS
        && STORE_PAGE_SIDE < 1 << BLOCK_END_BITS
        && STORE_PAGE_SIDE <= 1 << STORED_PIXEL_BIT
);

/// Corners of a patch with a block; none of another.
fn corners_of(patch: &ResidentPatch) -> ArrayVec<CornerGpu, MAX_CORNERS_PER_PATCH> {
    let Some(block) = patch.block else { return ArrayVec::new() };
    let [left, top, right, bottom] = block.lookup_rect_texels();
    let [first_x, first_y, end_x, end_y] = block.rect_texels();
    // Coverage is of the atlas alone.
    let flag = if patch.is_masked && !block.is_stored() { IS_MASKED } else { 0 };
    let page = u32::from(block.address.page) << (2 * BLOCK_END_BITS);
    let pixel =
        patch.pixel.steps().map(|steps| if block.is_stored() { steps << STORED_PIXEL_BIT } else { 0 });
    let corner = |(uv, slot): (&[f32; 2], VertexSlot)| CornerGpu {
        vertex_slot: slot.0,
        instance: u32::from(patch.instance.0),
        atlas_texel: [left + (right - left) * uv[0], top + (bottom - top) * uv[1]],
        block: [
            first_x | pixel[0] | (first_y | pixel[1]) << 16 | flag,
            end_x | end_y << BLOCK_END_BITS | page,
        ],
    };
    patch.kind.corner_uv().iter().zip(patch.vertices).map(corner).collect()
}

/// Indices of a patch whose first corner is given.
fn indices_of(patch: &ResidentPatch, first_corner: u32) -> ArrayVec<u32, MAX_INDICES_PER_PATCH> {
    let mut indices = ArrayVec::new();
    for [a, b, c] in patch.kind.triangles() {
        indices.extend([a, b, c].map(|corner| first_corner + u32::from(*corner)));
        // Back faces are culled, so that one draw serves both kinds: what has two sides is there twice.
        if patch.double_sided {
            indices.extend([a, c, b].map(|corner| first_corner + u32::from(*corner)));
        }
    }
    indices
}

/// Writes patches one behind the other: for measurements of draws.
pub struct ListWriter<'a> {
    corners: &'a mut [CornerGpu],
    indices: &'a mut [u32],
    corner_count: usize,
    index_count: usize,
}

impl<'a> ListWriter<'a> {
    /// Into memory for as many patches as will be written.
    pub fn new(corners: &'a mut [CornerGpu], indices: &'a mut [u32]) -> Self {
        Self { corners, indices, corner_count: 0, index_count: 0 }
    }

    /// Corners written so far.
    pub fn corner_count(&self) -> usize {
        self.corner_count
    }

    /// Indices written so far.
    pub fn index_count(&self) -> u32 {
        self.index_count as u32
    }

    /// Adds a patch, if it has a block.
    pub fn write(&mut self, patch: &ResidentPatch) {
        let corners = corners_of(patch);
        let indices = indices_of(patch, self.corner_count as u32);
        if corners.is_empty() {
            return;
        }
        self.corners[self.corner_count..][..corners.len()].copy_from_slice(&corners);
        self.indices[self.index_count..][..indices.len()].copy_from_slice(&indices);
        self.corner_count += corners.len();
        self.index_count += indices.len();
    }
}

#[cfg(test)]
mod tests;
