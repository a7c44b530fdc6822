//! The geometry delta: what a client must learn and forget with one update, and its bytes.
//!
//! A delta's bytes are a header with the lengths of seven sections, then the sections: explicit little-endian blocks
//! and varints, small because slots come in runs. Both sides keep a mirror of the client's memory ([`DeltaEncoder`],
//! [`DeltaDecoder`]), so that samples need no slots, and so that a delta which contradicts the memory is refused.

use crate::atlas::{Block, PatchKind};
use crate::ids::{InstanceId, PatchSlot, UpdateId, VertexSlot};
use crate::limits::{
    MAX_COORDINATE_M, MAX_DELTA_BYTES, MAX_INSTANCES, MAX_NEW_SAMPLE_GRIDS, MAX_SAMPLE_BATCHES, NO_BLOCK,
};
use crate::samples::{SampleEncoder, SampleHistory, SlotSet, decode_batch};
use crate::time::{GridIndex, ServerTime};
use crate::wire::{Reader, WireError, check_count, invalid, put_varint, put_zigzag};
use glam::Vec3;

/// First bytes of a delta: "Shadecast geometry", layout 1.
const MAGIC: [u8; 4] = *b"SCG1";
const SECTIONS: usize = 7;
/// Samples of every animated vertex.
const COVER_ALL: u8 = 0;
/// Samples of the animated vertices that enter with this delta.
const COVER_NEW: u8 = 1;
/// Samples of vertices that are listed.
const COVER_LIST: u8 = 2;

/// What one update changes in the client's memory. Applied in the order: patch evictions, vertex evictions, instances,
/// new vertices, new patches, placements, samples. Deltas follow each other without a gap, starting at frame 0.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GeometryDelta {
    /// The update.
    pub frame: UpdateId,
    /// The time for which the update was made.
    pub time: ServerTime,
    /// Instances seen for the first time, or with a new quantisation step.
    pub instances: Vec<InstanceInfo>,
    /// Vertices that enter; their slots are free.
    pub new_vertices: Vec<NewVertex>,
    /// Patches that enter; their slots are free, their vertices present.
    pub new_patches: Vec<NewPatch>,
    /// Patches to forget.
    pub evicted_patches: Vec<PatchSlot>,
    /// Vertices to forget; no patch uses them any more.
    pub evicted_vertices: Vec<VertexSlot>,
    /// Patches whose block changes with this update's picture; `None`: it has none, do not draw it.
    pub placements: Vec<(PatchSlot, Option<Block>)>,
    /// New samples of animated vertices. They count from arrival on, not from the update's display.
    pub samples: Vec<SampleBatch>,
}

impl GeometryDelta {
    /// How much there is to take in: samples, vertices, patches and placements.
    pub fn records(&self) -> usize {
        let samples: usize = self.samples.iter().map(|batch| batch.values.len()).sum();
        let patches = self.new_patches.len() + self.evicted_patches.len() + self.placements.len();
        samples + self.new_vertices.len() + self.evicted_vertices.len() + patches
    }
}

/// An instance, as far as a client needs to know it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InstanceInfo {
    /// The instance.
    pub instance: InstanceId,
    /// Quantisation step of its vertices' samples in metres, `MIN_STEP_M..=MAX_STEP_M`.
    pub step_m: f32,
}

/// A vertex that enters the client's memory.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NewVertex {
    /// Its place.
    pub slot: VertexSlot,
    /// Whose it is.
    pub instance: InstanceId,
    /// How it moves.
    pub motion: Motion,
}

/// How a vertex moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Motion {
    /// Not at all.
    Static {
        /// In the world, metres.
        position: Vec3,
    },
    /// By samples on the grid, in [`GeometryDelta::samples`].
    Sampled,
}

/// A patch that enters the client's memory. It has no block until a placement gives it one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NewPatch {
    /// Its place.
    pub slot: PatchSlot,
    /// Whose it is.
    pub instance: InstanceId,
    /// Number and arrangement of its triangles.
    pub kind: PatchKind,
    /// Its vertices; entries that the kind does not use repeat the first.
    pub vertices: [VertexSlot; 5],
    /// Seen from behind too. Others are not drawn from there: behind a thin surface lies its other side.
    pub double_sided: bool,
}

/// Quantised world positions by slot: metres are `value * step_m` of the vertex's instance.
pub type SampleValues = Vec<(VertexSlot, [i32; 3])>;

/// Samples of some vertices at one grid step.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SampleBatch {
    /// The grid step.
    pub grid: GridIndex,
    /// In ascending order of slots.
    pub values: SampleValues,
}

/// The encoder's mirror of one client's memory.
#[derive(Clone, Debug)]
pub struct DeltaEncoder {
    mirror: Mirror,
    encoder: SampleEncoder,
    sizes: DeltaSizes,
}

/// The decoder's mirror of its own memory, as the deltas so far have made it.
#[derive(Clone, Debug)]
pub struct DeltaDecoder {
    mirror: Mirror,
    /// True after a delta failed half-way: nothing after it can be understood.
    broken: bool,
}

/// Where the bytes of a delta went.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DeltaSizes {
    /// All bytes.
    pub total_bytes: usize,
    /// New vertices and evictions of vertices.
    pub vertex_bytes: usize,
    /// New patches and evictions of patches.
    pub patch_bytes: usize,
    /// Placements.
    pub placement_bytes: usize,
    /// Samples, first ones included.
    pub sample_bytes: usize,
    /// Vertex samples coded in `sample_bytes`.
    pub samples: usize,
}

/// What both sides know of the client's memory.
#[derive(Clone, Debug)]
struct Mirror {
    history: SampleHistory,
    patch_slots: u32,
    patches: SlotSet,
}

impl DeltaEncoder {
    /// For the capacities of [`crate::message::Welcome`], with an empty memory.
    pub fn new(vertex_slots: u32, patch_slots: u32) -> Self {
        Self {
            mirror: Mirror::new(vertex_slots, patch_slots),
            encoder: SampleEncoder::new(),
            sizes: DeltaSizes::default(),
        }
    }

    /// What the client knows of its vertices after all deltas so far.
    pub fn history(&self) -> &SampleHistory {
        &self.mirror.history
    }

    /// Where the bytes of the last delta went.
    pub fn last_sizes(&self) -> DeltaSizes {
        self.sizes
    }
}

impl DeltaDecoder {
    /// For the capacities of [`crate::message::Welcome`], with an empty memory.
    pub fn new(vertex_slots: u32, patch_slots: u32) -> Self {
        Self { mirror: Mirror::new(vertex_slots, patch_slots), broken: false }
    }

    /// What is known of the vertices after all deltas so far.
    pub fn history(&self) -> &SampleHistory {
        &self.mirror.history
    }
}

impl Mirror {
    fn new(vertex_slots: u32, patch_slots: u32) -> Self {
        Self { history: SampleHistory::new(vertex_slots), patch_slots, patches: SlotSet::new(patch_slots) }
    }

    /// Applies all but the samples. Gives the animated vertices that enter, ascending.
    fn apply(&mut self, delta: &GeometryDelta) -> Result<Vec<VertexSlot>, WireError> {
        for &patch in &delta.evicted_patches {
            if !self.patches.remove(patch.0) {
                return Err(invalid("the eviction of a patch", format!("slot {} is free", patch.0)));
            }
        }
        delta.evicted_vertices.iter().try_for_each(|&slot| self.history.evict(slot))?;
        let steps: Vec<_> = delta.instances.iter().map(|info| (info.instance, info.step_m)).collect();
        self.history.set_steps(&steps)?;
        for vertex in &delta.new_vertices {
            self.history.insert(vertex.slot, vertex.instance, vertex.motion == Motion::Sampled)?;
        }
        delta.new_patches.iter().try_for_each(|patch| self.insert_patch(patch))?;
        for (patch, _) in &delta.placements {
            if !self.patches.contains(patch.0) {
                return Err(invalid("a placement", format!("there is no patch in slot {}", patch.0)));
            }
        }
        let sampled = delta.new_vertices.iter().filter(|vertex| vertex.motion == Motion::Sampled);
        let mut fresh: Vec<_> = sampled.map(|vertex| vertex.slot).collect();
        fresh.sort_unstable();
        Ok(fresh)
    }

    fn insert_patch(&mut self, patch: &NewPatch) -> Result<(), WireError> {
        const WHAT: &str = "a new patch";
        let slot = patch.slot.0;
        if slot >= self.patch_slots {
            return Err(invalid(WHAT, format!("slot {slot} of {} does not exist", self.patch_slots)));
        }
        if let Some(vertex) = patch.vertices.iter().find(|vertex| !self.history.is_occupied(**vertex)) {
            return Err(invalid(WHAT, format!("its vertex slot {} is free", vertex.0)));
        }
        if !self.patches.insert(slot) {
            return Err(invalid(WHAT, format!("slot {slot} is taken")));
        }
        Ok(())
    }
}

/// The delta's bytes; brings the coder's mirror up to date. A delta that contradicts the mirror or a limit is a bug of
/// the caller and panics.
pub fn encode(delta: &GeometryDelta, coder: &mut DeltaEncoder) -> Vec<u8> {
    let fresh = coder.mirror.apply(delta).unwrap_or_else(|error| panic!("delta {}: {error}", delta.frame.0));
    let mut sections: [Vec<u8>; SECTIONS] = Default::default();
    put_evictions(&mut sections[0], delta.evicted_patches.iter().map(|slot| slot.0));
    put_evictions(&mut sections[1], delta.evicted_vertices.iter().map(|slot| slot.0));
    put_instances(&mut sections[2], &delta.instances);
    put_vertices(&mut sections[3], &delta.new_vertices);
    put_patches(&mut sections[4], &delta.new_patches);
    put_placements(&mut sections[5], &delta.placements);
    put_samples(&mut sections[6], &delta.samples, &fresh, coder);
    let out = put_header_and(delta, &sections);
    assert!(out.len() <= MAX_DELTA_BYTES, "delta {} has {} bytes", delta.frame.0, out.len());
    let length = |indices: &[usize]| indices.iter().map(|&index| sections[index].len()).sum();
    coder.sizes = DeltaSizes {
        total_bytes: out.len(),
        vertex_bytes: length(&[1, 2, 3]),
        patch_bytes: length(&[0, 4]),
        placement_bytes: length(&[5]),
        sample_bytes: length(&[6]),
        samples: delta.samples.iter().map(|batch| batch.values.len()).sum(),
    };
    out
}

/// The frame of a delta's bytes.
pub fn peek_frame(bytes: &[u8]) -> Result<UpdateId, WireError> {
    let mut reader = Reader::new("a delta's header", bytes);
    if reader.take(MAGIC.len())? != MAGIC {
        return Err(invalid("a delta's header", "its first bytes are not SCG1"));
    }
    Ok(UpdateId(reader.u32()?))
}

/// The delta of these bytes; brings the decoder's mirror up to date. Deltas must come in order. After an error the
/// decoder refuses everything: the connection has to be made anew.
pub fn decode(bytes: &[u8], decoder: &mut DeltaDecoder) -> Result<GeometryDelta, WireError> {
    if decoder.broken {
        return Err(invalid("a delta", "one before it could not be applied; connect again"));
    }
    decoder.broken = true;
    let delta = decode_into(bytes, &mut decoder.mirror)?;
    decoder.broken = false;
    Ok(delta)
}

fn decode_into(bytes: &[u8], mirror: &mut Mirror) -> Result<GeometryDelta, WireError> {
    check_count("a delta's length in bytes", bytes.len(), MAX_DELTA_BYTES)?;
    let (frame, time, sections) = split_sections(bytes)?;
    let [patches_out, vertices_out, instances, vertices, patches, placements, samples] = sections;
    let vertex_slots = mirror.history.vertex_slots() as usize;
    let patch_slots = mirror.patch_slots as usize;
    let mut delta = GeometryDelta {
        frame,
        time,
        evicted_patches: take_evictions("evicted patches", patches_out, patch_slots, PatchSlot)?,
        evicted_vertices: take_evictions("evicted vertices", vertices_out, vertex_slots, VertexSlot)?,
        instances: take_instances(instances)?,
        new_vertices: take_vertices(vertices, vertex_slots)?,
        new_patches: take_patches(patches, patch_slots)?,
        placements: take_placements(placements, patch_slots)?,
        samples: Vec::new(),
    };
    let fresh = mirror.apply(&delta)?;
    delta.samples = take_samples(samples, &fresh, &mut mirror.history)?;
    Ok(delta)
}

fn put_header_and(delta: &GeometryDelta, sections: &[Vec<u8>; SECTIONS]) -> Vec<u8> {
    let mut out = Vec::with_capacity(64 + sections.iter().map(Vec::len).sum::<usize>());
    out.extend_from_slice(&MAGIC);
    out.extend_from_slice(&delta.frame.0.to_le_bytes());
    out.extend_from_slice(&delta.time.0.to_le_bytes());
    for section in sections {
        out.extend_from_slice(&(section.len() as u32).to_le_bytes());
    }
    sections.iter().for_each(|section| out.extend_from_slice(section));
    out
}

fn split_sections(bytes: &[u8]) -> Result<(UpdateId, ServerTime, [&[u8]; SECTIONS]), WireError> {
    let frame = peek_frame(bytes)?;
    let mut reader = Reader::new("a delta's header", bytes);
    reader.take(MAGIC.len() + size_of::<u32>())?;
    let time = ServerTime(reader.i64()?);
    let mut lengths = [0; SECTIONS];
    for length in &mut lengths {
        *length = reader.u32()? as usize;
    }
    reader.what = "a delta's sections";
    let mut sections: [&[u8]; SECTIONS] = [&[]; SECTIONS];
    for (section, length) in sections.iter_mut().zip(lengths) {
        *section = reader.take(length)?;
    }
    reader.finish()?;
    Ok((frame, time, sections))
}

/// Appends `value` as its distance from what follows `previous`; runs of successors are zeros.
fn put_successor(out: &mut Vec<u8>, previous: &mut u32, value: u32) {
    put_zigzag(out, value.wrapping_sub(*previous).wrapping_sub(1) as i32);
    *previous = value;
}

fn take_successor(reader: &mut Reader<'_>, previous: &mut u32) -> Result<u32, WireError> {
    *previous = previous.wrapping_add(1).wrapping_add(reader.zigzag()? as u32);
    Ok(*previous)
}

/// Before the first of a list: its successor is 0.
const BEFORE_FIRST: u32 = u32::MAX;

fn put_evictions(out: &mut Vec<u8>, slots: impl ExactSizeIterator<Item = u32>) {
    put_varint(out, slots.len() as u32);
    let mut previous = BEFORE_FIRST;
    slots.for_each(|slot| put_successor(out, &mut previous, slot));
}

fn take_evictions<T>(
    what: &'static str,
    section: &[u8],
    slots: usize,
    new: impl Fn(u32) -> T,
) -> Result<Vec<T>, WireError> {
    let mut reader = Reader::new(what, section);
    let count = reader.count(slots, 1)?;
    let mut previous = BEFORE_FIRST;
    let evicted =
        (0..count).map(|_| take_successor(&mut reader, &mut previous).map(&new)).collect::<Result<_, _>>()?;
    reader.finish()?;
    Ok(evicted)
}

fn put_instances(out: &mut Vec<u8>, instances: &[InstanceInfo]) {
    put_varint(out, instances.len() as u32);
    for info in instances {
        put_varint(out, u32::from(info.instance.0));
        out.extend_from_slice(&info.step_m.to_le_bytes());
    }
}

fn take_instances(section: &[u8]) -> Result<Vec<InstanceInfo>, WireError> {
    let mut reader = Reader::new("instances", section);
    let count = reader.count(MAX_INSTANCES as usize, 5)?;
    let instances = (0..count)
        .map(|_| Ok(InstanceInfo { instance: take_instance(&mut reader)?, step_m: reader.f32()? }))
        .collect::<Result<_, WireError>>()?;
    reader.finish()?;
    Ok(instances)
}

fn take_instance(reader: &mut Reader<'_>) -> Result<InstanceId, WireError> {
    let number =
        check_count("the number of an instance", reader.varint()? as usize, MAX_INSTANCES as usize - 1)?;
    Ok(InstanceId(number as u16))
}

/// True where `next` can join the run that ends with `last`: next slot, same instance, same way of moving.
fn continues(last: &NewVertex, next: &NewVertex) -> bool {
    next.slot.0 == last.slot.0.wrapping_add(1)
        && next.instance == last.instance
        && (next.motion == Motion::Sampled) == (last.motion == Motion::Sampled)
}

/// Runs of successive slots that share instance and motion: first slot, length and motion, instance, positions.
fn put_vertices(out: &mut Vec<u8>, vertices: &[NewVertex]) {
    put_varint(out, vertices.len() as u32);
    let mut previous = BEFORE_FIRST;
    for run in vertices.chunk_by(continues) {
        put_successor(out, &mut previous, run[0].slot.0);
        previous = run[run.len() - 1].slot.0;
        put_varint(out, (run.len() as u32 - 1) << 1 | u32::from(run[0].motion == Motion::Sampled));
        put_varint(out, u32::from(run[0].instance.0));
        for vertex in run {
            if let Motion::Static { position } = vertex.motion {
                position.to_array().iter().for_each(|c| out.extend_from_slice(&c.to_le_bytes()));
            }
        }
    }
}

fn take_vertices(section: &[u8], vertex_slots: usize) -> Result<Vec<NewVertex>, WireError> {
    let mut reader = Reader::new("new vertices", section);
    let count = check_count("new vertices", reader.varint()? as usize, vertex_slots)?;
    let mut vertices = Vec::with_capacity(count);
    let mut previous = BEFORE_FIRST;
    while vertices.len() < count {
        take_vertex_run(&mut reader, &mut previous, count, &mut vertices)?;
    }
    reader.finish()?;
    Ok(vertices)
}

fn take_vertex_run(
    reader: &mut Reader<'_>,
    previous: &mut u32,
    count: usize,
    vertices: &mut Vec<NewVertex>,
) -> Result<(), WireError> {
    let first = take_successor(reader, previous)?;
    let run = reader.varint()?;
    let (length, sampled) = ((run >> 1) as usize + 1, run & 1 == 1);
    check_count("a run of new vertices", length, count - vertices.len())?;
    let instance = take_instance(reader)?;
    for slot in (0..length as u32).map(|i| VertexSlot(first.wrapping_add(i))) {
        let motion =
            if sampled { Motion::Sampled } else { Motion::Static { position: take_position(reader)? } };
        vertices.push(NewVertex { slot, instance, motion });
    }
    *previous = first.wrapping_add(length as u32 - 1);
    Ok(())
}

fn take_position(reader: &mut Reader<'_>) -> Result<Vec3, WireError> {
    let position = Vec3::new(reader.f32()?, reader.f32()?, reader.f32()?);
    // Written so that a NaN fails too.
    if position.to_array().iter().all(|c| c.abs() <= MAX_COORDINATE_M) {
        return Ok(position);
    }
    Err(invalid("a vertex's position", format!("{position} is not within {MAX_COORDINATE_M} m")))
}

/// Slot, kind and whether the instance changes, instance, vertices as distances from the vertex before.
fn put_patches(out: &mut Vec<u8>, patches: &[NewPatch]) {
    put_varint(out, patches.len() as u32);
    let (mut previous, mut instance, mut vertex) = (BEFORE_FIRST, InstanceId(0), BEFORE_FIRST);
    for patch in patches {
        put_successor(out, &mut previous, patch.slot.0);
        let changes = patch.instance != instance;
        out.push(patch.kind as u8 | u8::from(changes) << 2 | u8::from(patch.double_sided) << 3);
        if changes {
            put_varint(out, u32::from(patch.instance.0));
            instance = patch.instance;
        }
        for slot in &patch.vertices[..patch.kind.vertex_count()] {
            put_successor(out, &mut vertex, slot.0);
        }
    }
}

fn take_patches(section: &[u8], patch_slots: usize) -> Result<Vec<NewPatch>, WireError> {
    let mut reader = Reader::new("new patches", section);
    let count = reader.count(patch_slots, 5)?;
    let mut patches = Vec::with_capacity(count);
    let (mut previous, mut instance, mut vertex) = (BEFORE_FIRST, InstanceId(0), BEFORE_FIRST);
    for _ in 0..count {
        let slot = PatchSlot(take_successor(&mut reader, &mut previous)?);
        let flags = reader.u8()?;
        let kind = PatchKind::from_triangle_count(flags & 3)
            .filter(|_| flags < 16)
            .ok_or_else(|| invalid("a patch's kind", format!("{flags:#x} is none")))?;
        if flags & 4 != 0 {
            instance = take_instance(&mut reader)?;
        }
        let mut vertices = [VertexSlot(0); 5];
        for place in &mut vertices[..kind.vertex_count()] {
            *place = VertexSlot(take_successor(&mut reader, &mut vertex)?);
        }
        let first = vertices[0];
        vertices[kind.vertex_count()..].fill(first);
        patches.push(NewPatch { slot, instance, kind, vertices, double_sided: flags & 8 != 0 });
    }
    reader.finish()?;
    Ok(patches)
}

fn put_placements(out: &mut Vec<u8>, placements: &[(PatchSlot, Option<Block>)]) {
    put_varint(out, placements.len() as u32);
    let mut previous = BEFORE_FIRST;
    for (slot, block) in placements {
        put_successor(out, &mut previous, slot.0);
        out.extend_from_slice(&block.map_or(NO_BLOCK, Block::pack).to_le_bytes());
    }
}

fn take_placements(section: &[u8], patch_slots: usize) -> Result<Vec<(PatchSlot, Option<Block>)>, WireError> {
    let mut reader = Reader::new("placements", section);
    let count = reader.count(patch_slots, 5)?;
    let mut placements = Vec::with_capacity(count);
    let mut previous = BEFORE_FIRST;
    for _ in 0..count {
        let slot = PatchSlot(take_successor(&mut reader, &mut previous)?);
        let block = match reader.u32()? {
            NO_BLOCK => None,
            word => Some(Block::unpack(word).map_err(|error| invalid("a placement", error.to_string()))?),
        };
        placements.push((slot, block));
    }
    reader.finish()?;
    Ok(placements)
}

/// Batches: grid step, which vertices, the coded samples.
fn put_samples(out: &mut Vec<u8>, batches: &[SampleBatch], fresh: &[VertexSlot], coder: &mut DeltaEncoder) {
    assert!(batches.len() <= MAX_SAMPLE_BATCHES as usize, "{} batches of samples", batches.len());
    put_varint(out, batches.len() as u32);
    let active = coder.mirror.history.active_slots();
    let mut previous = BEFORE_FIRST;
    for batch in batches {
        let (slots, values): (Vec<_>, Vec<_>) = batch.values.iter().copied().unzip();
        assert!(
            slots.is_sorted_by(|a, b| a < b),
            "the samples of grid step {} are not in order",
            batch.grid.0
        );
        put_successor(out, &mut previous, batch.grid.0 as u32);
        put_coverage(out, &slots, &active, fresh);
        coder.encoder.encode_batch(batch.grid, &mut coder.mirror.history, &slots, &values, out);
    }
}

fn put_coverage(out: &mut Vec<u8>, slots: &[VertexSlot], active: &[VertexSlot], fresh: &[VertexSlot]) {
    if slots == active {
        out.push(COVER_ALL);
    } else if slots == fresh {
        out.push(COVER_NEW);
    } else {
        assert!(
            slots.iter().all(|slot| active.binary_search(slot).is_ok()),
            "a sample of a vertex that has none"
        );
        out.push(COVER_LIST);
        put_evictions(out, slots.iter().map(|slot| slot.0));
    }
}

fn take_samples(
    section: &[u8],
    fresh: &[VertexSlot],
    history: &mut SampleHistory,
) -> Result<Vec<SampleBatch>, WireError> {
    let mut reader = Reader::new("batches of samples", section);
    let count = reader.count(MAX_SAMPLE_BATCHES as usize, 2)?;
    let active = history.active_slots();
    // Samples can be coded in no bits at all: what they grow to is bounded, not what they come in.
    let most = (history.vertex_slots() * MAX_NEW_SAMPLE_GRIDS) as usize;
    let mut batches = Vec::with_capacity(count);
    let (mut previous, mut total) = (BEFORE_FIRST, 0);
    for _ in 0..count {
        let grid = GridIndex(take_successor(&mut reader, &mut previous)? as i32);
        let listed;
        let slots: &[VertexSlot] = match reader.u8()? {
            COVER_ALL => &active,
            COVER_NEW => fresh,
            COVER_LIST => {
                listed = take_listed(&mut reader, history)?;
                &listed
            }
            other => return Err(invalid("a batch's coverage", format!("{other} is none"))),
        };
        total = check_count("samples of a delta", total + slots.len(), most)?;
        let bytes = reader.rest();
        let (values, used) = decode_batch(grid, history, slots, bytes)?;
        reader = Reader::new("batches of samples", &bytes[used..]);
        batches.push(SampleBatch { grid, values });
    }
    reader.finish()?;
    Ok(batches)
}

/// Slots of animated vertices, strictly ascending.
fn take_listed(reader: &mut Reader<'_>, history: &SampleHistory) -> Result<Vec<VertexSlot>, WireError> {
    let count = reader.count(history.vertex_slots() as usize, 1)?;
    let mut slots: Vec<VertexSlot> = Vec::with_capacity(count);
    let mut previous = BEFORE_FIRST;
    for _ in 0..count {
        let slot = VertexSlot(take_successor(reader, &mut previous)?);
        if !history.is_active(slot) || slots.last().is_some_and(|last| *last >= slot) {
            return Err(invalid(
                "a batch's list of vertices",
                format!("slot {} does not belong there", slot.0),
            ));
        }
        slots.push(slot);
    }
    Ok(slots)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::atlas::{BlockAddress, BlockSize};
    use crate::testing::{Dice, damaged};
    use std::collections::BTreeMap;

    const VERTEX_SLOTS: u32 = 600;
    const PATCH_SLOTS: u32 = 300;

    /// A server that does random but lawful things, and so makes deltas of every kind.
    struct Chaos {
        dice: Dice,
        frame: u32,
        grid: i32,
        instances: Vec<InstanceId>,
        vertices: BTreeMap<u32, Motion>,
        patches: BTreeMap<u32, NewPatch>,
        curve: BTreeMap<u32, ([f64; 3], [f64; 3])>,
    }

    impl Chaos {
        fn new(seed: u64) -> Self {
            Self {
                dice: Dice::new(seed),
                frame: 0,
                grid: -5,
                instances: Vec::new(),
                vertices: BTreeMap::new(),
                patches: BTreeMap::new(),
                curve: BTreeMap::new(),
            }
        }

        fn delta(&mut self) -> GeometryDelta {
            let mut delta = GeometryDelta {
                frame: UpdateId(self.frame),
                time: ServerTime(i64::from(self.frame) * 33_333_333 - 7),
                ..GeometryDelta::default()
            };
            self.frame += 1;
            self.evict(&mut delta);
            self.announce(&mut delta);
            self.add_vertices(&mut delta);
            self.add_patches(&mut delta);
            self.place(&mut delta);
            self.sample(&mut delta);
            delta
        }

        fn evict(&mut self, delta: &mut GeometryDelta) {
            let gone: Vec<u32> = self.patches.keys().copied().filter(|_| self.dice.once_in(9)).collect();
            self.patches.retain(|slot, _| !gone.contains(slot));
            delta.evicted_patches = gone.into_iter().map(PatchSlot).collect();
            let used: Vec<u32> =
                self.patches.values().flat_map(|patch| patch.vertices).map(|slot| slot.0).collect();
            let unused = self.vertices.keys().copied().filter(|slot| !used.contains(slot));
            let gone: Vec<u32> = unused.filter(|_| self.dice.once_in(3)).collect();
            for slot in &gone {
                self.vertices.remove(slot);
                self.curve.remove(slot);
            }
            delta.evicted_vertices = gone.into_iter().rev().map(VertexSlot).collect();
        }

        fn announce(&mut self, delta: &mut GeometryDelta) {
            if self.instances.is_empty() || self.dice.once_in(4) {
                let instance = InstanceId(self.dice.below(u64::from(MAX_INSTANCES)) as u16);
                self.instances.push(instance);
                let step_m = 0.0001 * (1 + self.dice.below(20)) as f32;
                delta.instances.push(InstanceInfo { instance, step_m });
            }
            if self.dice.once_in(7) {
                let instance = self.instances[self.dice.below(self.instances.len() as u64) as usize];
                delta.instances.push(InstanceInfo { instance, step_m: 0.003 });
            }
        }

        fn add_vertices(&mut self, delta: &mut GeometryDelta) {
            let first = self.dice.below(u64::from(VERTEX_SLOTS)) as u32;
            let last = (first + self.dice.below(90) as u32).min(VERTEX_SLOTS);
            let instance = self.instances[self.dice.below(self.instances.len() as u64) as usize];
            for slot in first..last {
                if self.vertices.contains_key(&slot) || self.dice.once_in(10) {
                    continue;
                }
                let mut at = || self.dice.signed_unit() * 3.0;
                let (position, velocity) = ([at(), at(), at()], [at(), at(), at()]);
                let motion = if self.dice.once_in(3) {
                    Motion::Static { position: Vec3::from_array(position.map(|c| c as f32)) }
                } else {
                    self.curve.insert(slot, (position, velocity));
                    Motion::Sampled
                };
                self.vertices.insert(slot, motion);
                delta.new_vertices.push(NewVertex { slot: VertexSlot(slot), instance, motion });
            }
        }

        fn add_patches(&mut self, delta: &mut GeometryDelta) {
            let vertices: Vec<u32> = self.vertices.keys().copied().collect();
            for _ in 0..self.dice.below(20) {
                let slot = self.dice.below(u64::from(PATCH_SLOTS)) as u32;
                if vertices.is_empty() || self.patches.contains_key(&slot) {
                    continue;
                }
                let kind = PatchKind::ALL[self.dice.below(3) as usize];
                let mut any = || VertexSlot(vertices[self.dice.below(vertices.len() as u64) as usize]);
                let mut corners = [any(), any(), any(), any(), any()];
                let first = corners[0];
                corners[kind.vertex_count()..].fill(first);
                let instance = self.instances[self.dice.below(self.instances.len() as u64) as usize];
                let double_sided = self.dice.once_in(3);
                let patch =
                    NewPatch { slot: PatchSlot(slot), instance, kind, vertices: corners, double_sided };
                self.patches.insert(slot, patch);
                delta.new_patches.push(patch);
            }
        }

        fn place(&mut self, delta: &mut GeometryDelta) {
            for &slot in self.patches.keys() {
                if self.dice.once_in(2) {
                    let address = BlockAddress {
                        x: self.dice.below(500) as u16 * 4,
                        y: self.dice.below(300) as u16 * 4,
                    };
                    let (width_log2, height_log2) =
                        (2 + self.dice.below(6) as u8, 2 + self.dice.below(6) as u8);
                    let block = Block { address, size: BlockSize { width_log2, height_log2 } };
                    let block = (!self.dice.once_in(5)).then_some(block);
                    delta.placements.push((PatchSlot(slot), block));
                }
            }
        }

        fn sample(&mut self, delta: &mut GeometryDelta) {
            let fresh: Vec<u32> = delta.new_vertices.iter().map(|vertex| vertex.slot.0).collect();
            let is_fresh = |slot: &u32| fresh.contains(slot);
            let earlier = self.grid - self.dice.below(4) as i32;
            (earlier..self.grid).for_each(|grid| self.batch(delta, grid, is_fresh));
            if self.dice.once_in(6) {
                // The future changed for some: a few steps are sent again.
                let odd = self.dice.below(5) as u32;
                (self.grid - 2..self.grid).for_each(|grid| self.batch(delta, grid, |slot| slot % 5 == odd));
            }
            if self.dice.once_in(8) {
                self.grid += 1; // A step that nobody gets.
            }
            (0..self.dice.below(3)).for_each(|_| {
                self.batch(delta, self.grid, |_| true);
                self.grid += 1;
            });
        }

        fn batch(&mut self, delta: &mut GeometryDelta, grid: i32, wanted: impl Fn(&u32) -> bool) {
            let dice = &mut self.dice;
            let mut value =
                |c: f64, v: f64| ((c + v * f64::from(grid) * 0.033) * 2000.0) as i32 + dice.below(3) as i32;
            let values = self
                .curve
                .iter()
                .filter(|(slot, _)| wanted(slot))
                .map(|(slot, (c, v))| {
                    (VertexSlot(*slot), std::array::from_fn(|axis| value(c[axis], v[axis])))
                })
                .collect();
            delta.samples.push(SampleBatch { grid: GridIndex(grid), values });
        }
    }

    #[test]
    fn both_sides_stay_in_step_through_random_sessions() {
        for seed in 0..30 {
            let mut chaos = Chaos::new(seed);
            let mut coder = DeltaEncoder::new(VERTEX_SLOTS, PATCH_SLOTS);
            let mut decoder = DeltaDecoder::new(VERTEX_SLOTS, PATCH_SLOTS);
            for _ in 0..60 {
                let delta = chaos.delta();
                let bytes = encode(&delta, &mut coder);
                assert_eq!(peek_frame(&bytes), Ok(delta.frame));
                assert_eq!(decode(&bytes, &mut decoder).as_ref(), Ok(&delta), "seed {seed}");
                assert_eq!(coder.history().active_slots(), decoder.history().active_slots(), "seed {seed}");
                assert_eq!(coder.last_sizes().total_bytes, bytes.len());
            }
        }
    }

    #[test]
    fn damaged_deltas_give_values_or_errors() {
        for seed in 0..4 {
            let mut chaos = Chaos::new(seed);
            let mut coder = DeltaEncoder::new(VERTEX_SLOTS, PATCH_SLOTS);
            let mut decoder = DeltaDecoder::new(VERTEX_SLOTS, PATCH_SLOTS);
            for _ in 0..5 {
                let bytes = encode(&chaos.delta(), &mut coder);
                damaged(&bytes, seed, 400, |bytes| {
                    let mut victim = decoder.clone();
                    if decode(bytes, &mut victim).is_err() {
                        assert!(decode(bytes, &mut victim).is_err(), "a broken decoder stays so");
                    }
                });
                for length in 0..bytes.len() {
                    assert!(
                        decode(&bytes[..length], &mut decoder.clone()).is_err(),
                        "{length} of {}",
                        bytes.len()
                    );
                }
                decode(&bytes, &mut decoder).unwrap();
            }
        }
    }

    fn bytes_of(delta: GeometryDelta) -> Vec<u8> {
        // A coder that allows more than the decoder under test.
        let mut coder = DeltaEncoder::new(4 * VERTEX_SLOTS, 4 * PATCH_SLOTS);
        encode(&delta, &mut coder)
    }

    #[track_caller]
    fn assert_refused(bytes: &[u8], words: &str) {
        let error = decode(bytes, &mut DeltaDecoder::new(VERTEX_SLOTS, PATCH_SLOTS)).unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
    }

    fn static_vertex(slot: u32) -> NewVertex {
        let motion = Motion::Static { position: Vec3::ONE };
        NewVertex { slot: VertexSlot(slot), instance: InstanceId(0), motion }
    }

    #[test]
    fn slots_beyond_the_agreed_capacity_are_refused() {
        let vertex = GeometryDelta { new_vertices: vec![static_vertex(VERTEX_SLOTS)], ..Default::default() };
        assert_refused(&bytes_of(vertex), "slot 600 of 600 does not exist");
        let patch = NewPatch {
            slot: PatchSlot(PATCH_SLOTS),
            instance: InstanceId(0),
            kind: PatchKind::One,
            vertices: [VertexSlot(0); 5],
            double_sided: false,
        };
        let delta = GeometryDelta {
            new_vertices: vec![static_vertex(0)],
            new_patches: vec![patch],
            ..GeometryDelta::default()
        };
        assert_refused(&bytes_of(delta), "slot 300 of 300 does not exist");
    }

    #[test]
    fn a_slot_in_use_is_not_given_again_and_a_free_one_not_taken_back() {
        let delta = GeometryDelta { new_vertices: vec![static_vertex(7)], ..Default::default() };
        let bytes = bytes_of(delta);
        let mut decoder = DeltaDecoder::new(VERTEX_SLOTS, PATCH_SLOTS);
        decode(&bytes, &mut decoder).unwrap();
        assert!(decode(&bytes, &mut decoder).unwrap_err().to_string().contains("slot 7 is taken"));

        let mut section = Vec::new();
        put_evictions(&mut section, [3].into_iter());
        let header = GeometryDelta::default();
        let sections = [section, vec![0], vec![0], vec![0], vec![0], vec![0], vec![0]];
        assert_refused(&put_header_and(&header, &sections), "slot 3 is free");
    }

    #[test]
    fn samples_that_take_no_bits_grow_to_no_more_than_the_agreed_memory_holds() {
        let new_vertices: Vec<_> = (0..VERTEX_SLOTS)
            .map(|slot| NewVertex {
                slot: VertexSlot(slot),
                instance: InstanceId(0),
                motion: Motion::Sampled,
            })
            .collect();
        let instances = vec![InstanceInfo { instance: InstanceId(0), step_m: 0.001 }];
        let batch = |grid| SampleBatch {
            grid: GridIndex(grid),
            values: (0..VERTEX_SLOTS).map(|slot| (VertexSlot(slot), [0; 3])).collect(),
        };
        let with = |steps: u32| GeometryDelta {
            instances: instances.clone(),
            new_vertices: new_vertices.clone(),
            samples: (0..steps as i32).map(batch).collect(),
            ..GeometryDelta::default()
        };
        let mut decoder = DeltaDecoder::new(VERTEX_SLOTS, PATCH_SLOTS);
        assert!(decode(&bytes_of(with(MAX_NEW_SAMPLE_GRIDS)), &mut decoder).is_ok());
        assert_refused(&bytes_of(with(MAX_NEW_SAMPLE_GRIDS + 1)), "samples of a delta is 10200");
    }

    #[test]
    fn huge_counts_are_refused_before_anything_is_allocated() {
        for (section, words) in [
            (0, "evicted patches"),
            (1, "evicted vertices"),
            (2, "instances"),
            (3, "new vertices"),
            (4, "new patches"),
            (5, "placements"),
            (6, "batches of samples"),
        ] {
            let mut sections: [Vec<u8>; SECTIONS] = std::array::from_fn(|_| vec![0]);
            sections[section] = vec![0xff, 0xff, 0xff, 0xff, 0x0f];
            assert_refused(&put_header_and(&GeometryDelta::default(), &sections), words);
        }
    }

    #[test]
    fn positions_that_are_no_numbers_are_refused() {
        for bad in [f32::NAN, f32::INFINITY, -2e6] {
            let motion = Motion::Static { position: Vec3::new(0.0, bad, 0.0) };
            let vertex = NewVertex { slot: VertexSlot(0), instance: InstanceId(0), motion };
            assert_refused(
                &bytes_of(GeometryDelta { new_vertices: vec![vertex], ..Default::default() }),
                "a vertex's position is not valid",
            );
        }
    }

    #[test]
    fn runs_of_slots_cost_nothing_per_vertex() {
        let new_vertices = (0..1000)
            .map(|slot| NewVertex {
                slot: VertexSlot(slot),
                instance: InstanceId(0),
                motion: Motion::Sampled,
            })
            .collect();
        let instances = vec![InstanceInfo { instance: InstanceId(0), step_m: 0.001 }];
        let mut coder = DeltaEncoder::new(1000, 1);
        encode(&GeometryDelta { instances, new_vertices, ..Default::default() }, &mut coder);
        assert!(coder.last_sizes().vertex_bytes < 20, "{:?}", coder.last_sizes());
    }

    #[test]
    #[should_panic(expected = "slot 9 is free")]
    fn a_server_that_contradicts_itself_is_a_bug() {
        bytes_of(GeometryDelta { evicted_vertices: vec![VertexSlot(9)], ..Default::default() });
    }
}
