//! The sections of geometry.

use crate::atlas::{Block, PatchKind};
use crate::coverage::Coverage;
use crate::geometry::{InstanceInfo, Motion, NewPatch, NewVertex, Settled, Skinned};
use crate::ids::{InstanceId, PatchSlot, RestId, VertexSlot};
use crate::limits::{MAX_COORDINATE_M, MAX_COVERED_TEXELS, MAX_INSTANCES, NO_BLOCK};
use crate::motion::rest::MeshInfo;
use crate::motion::skeleton::{SkeletonInfo, SkinnedInstance};
use crate::wire::{Reader, WireError, check_count, invalid, put_varint, put_zigzag};
use glam::Vec3;
use std::collections::BTreeMap;

/// Appends `value` as its distance from what follows `previous`; runs of successors are zeros.
pub(super) fn put_successor(out: &mut Vec<u8>, previous: &mut u32, value: u32) {
    put_zigzag(out, value.wrapping_sub(*previous).wrapping_sub(1) as i32);
    *previous = value;
}

pub(super) fn take_successor(reader: &mut Reader<'_>, previous: &mut u32) -> Result<u32, WireError> {
    *previous = previous.wrapping_add(1).wrapping_add(reader.zigzag()? as u32);
    Ok(*previous)
}

/// Before the first of a list: its successor is 0.
pub(super) const BEFORE_FIRST: u32 = u32::MAX;

pub(super) fn put_evictions(out: &mut Vec<u8>, slots: impl ExactSizeIterator<Item = u32>) {
    put_varint(out, slots.len() as u32);
    let mut previous = BEFORE_FIRST;
    slots.for_each(|slot| put_successor(out, &mut previous, slot));
}

pub(super) fn take_evictions<T>(
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

pub(super) fn put_instances(out: &mut Vec<u8>, instances: &[InstanceInfo]) {
    put_varint(out, instances.len() as u32);
    for info in instances {
        put_varint(out, u32::from(info.instance.0));
        out.extend_from_slice(&info.step_m.to_le_bytes());
    }
}

pub(super) fn take_instances(section: &[u8]) -> Result<Vec<InstanceInfo>, WireError> {
    let mut reader = Reader::new("instances", section);
    let count = reader.count(MAX_INSTANCES as usize, 5)?;
    let instances = (0..count)
        .map(|_| Ok(InstanceInfo { instance: take_instance(&mut reader)?, step_m: reader.f32()? }))
        .collect::<Result<_, WireError>>()?;
    reader.finish()?;
    Ok(instances)
}

/// Skeletons, meshes, and the instances that they make up.
pub(super) fn put_skinned(out: &mut Vec<u8>, skinned: &Skinned) {
    put_varint(out, skinned.skeletons.len() as u32);
    skinned.skeletons.iter().for_each(|skeleton| skeleton.put(out));
    put_varint(out, skinned.meshes.len() as u32);
    skinned.meshes.iter().for_each(|mesh| mesh.put(out));
    put_varint(out, skinned.instances.len() as u32);
    skinned.instances.iter().for_each(|instance| instance.put(out));
}

pub(super) fn take_skinned(section: &[u8]) -> Result<Skinned, WireError> {
    let mut reader = Reader::new("skeletons and what they move", section);
    let most = MAX_INSTANCES as usize;
    let skeletons = (0..reader.count(most, 8)?).map(|_| SkeletonInfo::take(&mut reader));
    let skeletons = skeletons.collect::<Result<_, _>>()?;
    let meshes = (0..reader.count(most, 6)?).map(|_| MeshInfo::take(&mut reader));
    let meshes = meshes.collect::<Result<_, _>>()?;
    let instances = (0..reader.count(most, 8)?).map(|_| SkinnedInstance::take(&mut reader));
    let instances = instances.collect::<Result<_, _>>()?;
    reader.finish()?;
    Ok(Skinned { skeletons, meshes, instances })
}

fn take_instance(reader: &mut Reader<'_>) -> Result<InstanceId, WireError> {
    let number =
        check_count("the number of an instance", reader.varint()? as usize, MAX_INSTANCES as usize - 1)?;
    Ok(InstanceId(number as u16))
}

/// Ways of moving, as runs of vertices name them.
const STATIC: u32 = 0;
const SAMPLED: u32 = 1;
const SKINNED: u32 = 2;
const PREDICTED: u32 = 3;
const KIND_BITS: u32 = 2;

fn kind_of(motion: Motion) -> u32 {
    match motion {
        Motion::Static { .. } => STATIC,
        Motion::Sampled => SAMPLED,
        Motion::Skinned { .. } => SKINNED,
        Motion::Predicted => PREDICTED,
    }
}

/// True where `next` can join the run that ends with `last`: next slot, same instance, same way of moving.
fn continues(last: &NewVertex, next: &NewVertex) -> bool {
    next.slot.0 == last.slot.0.wrapping_add(1)
        && next.instance == last.instance
        && kind_of(next.motion) == kind_of(last.motion)
}

/// Runs of successive slots that share instance and motion: first slot, length and motion, instance, then positions, or rest
/// vertices as distances from the one before.
pub(super) fn put_vertices(out: &mut Vec<u8>, vertices: &[NewVertex]) {
    put_varint(out, vertices.len() as u32);
    let (mut previous, mut rest_before) = (BEFORE_FIRST, BEFORE_FIRST);
    for run in vertices.chunk_by(continues) {
        put_successor(out, &mut previous, run[0].slot.0);
        previous = run[run.len() - 1].slot.0;
        put_varint(out, (run.len() as u32 - 1) << KIND_BITS | kind_of(run[0].motion));
        put_varint(out, u32::from(run[0].instance.0));
        for vertex in run {
            match vertex.motion {
                Motion::Static { position } => {
                    position.to_array().iter().for_each(|c| out.extend_from_slice(&c.to_le_bytes()));
                }
                Motion::Sampled | Motion::Predicted => {}
                Motion::Skinned { rest } => put_successor(out, &mut rest_before, rest.0),
            }
        }
    }
}

pub(super) fn take_vertices(section: &[u8], vertex_slots: usize) -> Result<Vec<NewVertex>, WireError> {
    let mut reader = Reader::new("new vertices", section);
    let count = check_count("new vertices", reader.varint()? as usize, vertex_slots)?;
    let mut vertices = Vec::with_capacity(count);
    let mut before = [BEFORE_FIRST; 2];
    while vertices.len() < count {
        take_vertex_run(&mut reader, &mut before, count, &mut vertices)?;
    }
    reader.finish()?;
    Ok(vertices)
}

fn take_vertex_run(
    reader: &mut Reader<'_>,
    [previous, rest_before]: &mut [u32; 2],
    count: usize,
    vertices: &mut Vec<NewVertex>,
) -> Result<(), WireError> {
    let first = take_successor(reader, previous)?;
    let run = reader.varint()?;
    let (length, kind) = ((run >> KIND_BITS) as usize + 1, run & ((1 << KIND_BITS) - 1));
    check_count("a run of new vertices", length, count - vertices.len())?;
    let instance = take_instance(reader)?;
    for slot in (0..length as u32).map(|i| VertexSlot(first.wrapping_add(i))) {
        let motion = match kind {
            STATIC => Motion::Static { position: take_position(reader)? },
            SAMPLED => Motion::Sampled,
            PREDICTED => Motion::Predicted,
            SKINNED => Motion::Skinned { rest: RestId(take_successor(reader, rest_before)?) },
            other => return Err(invalid("a vertex's motion", format!("{other} is none"))),
        };
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

/// Slot, kind and whether the instance changes, instance, vertices as distances from the vertex before. Gives the bytes of kinds and
/// of vertices.
pub(super) fn put_patches(out: &mut Vec<u8>, patches: &[NewPatch]) -> [usize; 2] {
    let mut corner_bytes = 0;
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
        let before = out.len();
        for slot in &patch.vertices[..patch.kind.vertex_count()] {
            put_successor(out, &mut vertex, slot.0);
        }
        corner_bytes += out.len() - before;
    }
    [patches.len(), corner_bytes]
}

pub(super) fn take_patches(section: &[u8], patch_slots: usize) -> Result<Vec<NewPatch>, WireError> {
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

/// Slot, block. Gives the bytes of blocks.
pub(super) fn put_placements(out: &mut Vec<u8>, placements: &[(PatchSlot, Option<Block>)]) -> usize {
    put_varint(out, placements.len() as u32);
    let mut previous = BEFORE_FIRST;
    for (slot, block) in placements {
        put_successor(out, &mut previous, slot.0);
        out.extend_from_slice(&block.map_or(NO_BLOCK, Block::pack).to_le_bytes());
    }
    4 * placements.len()
}

pub(super) fn take_placements(
    section: &[u8],
    patch_slots: usize,
) -> Result<Vec<(PatchSlot, Option<Block>)>, WireError> {
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

/// Slot, then where to.
pub(super) fn put_settled(out: &mut Vec<u8>, settled: &[Settled]) {
    put_varint(out, settled.len() as u32);
    let mut previous = BEFORE_FIRST;
    for Settled { slot, to } in settled {
        put_successor(out, &mut previous, slot.0);
        out.extend_from_slice(&to.pack().to_le_bytes());
    }
}

pub(super) fn take_settled(section: &[u8], patch_slots: usize) -> Result<Vec<Settled>, WireError> {
    const WHAT: &str = "settled blocks";
    let mut reader = Reader::new(WHAT, section);
    let count = reader.count(patch_slots, 5)?;
    let mut settled = Vec::with_capacity(count);
    let mut previous = BEFORE_FIRST;
    for _ in 0..count {
        let slot = PatchSlot(take_successor(&mut reader, &mut previous)?);
        let to = Block::unpack(reader.u32()?).map_err(|error| invalid(WHAT, error.to_string()))?;
        settled.push(Settled { slot, to });
    }
    reader.finish()?;
    Ok(settled)
}

/// Slot, then the bits.
pub(super) fn put_coverage(out: &mut Vec<u8>, coverage: &[(PatchSlot, Coverage)]) {
    put_varint(out, coverage.len() as u32);
    let mut previous = BEFORE_FIRST;
    for (slot, coverage) in coverage {
        put_successor(out, &mut previous, slot.0);
        coverage.put(out);
    }
}

/// Each is of a block that the same delta places; all together are of no more texels than the largest atlas has.
pub(super) fn take_coverage(
    section: &[u8],
    placements: &[(PatchSlot, Option<Block>)],
) -> Result<Vec<(PatchSlot, Coverage)>, WireError> {
    const WHAT: &str = "coverage of blocks";
    let mut reader = Reader::new(WHAT, section);
    let count = reader.count(placements.len(), 3)?;
    let blocks: BTreeMap<PatchSlot, Option<Block>> =
        if count > 0 { placements.iter().copied().collect() } else { BTreeMap::new() };
    let mut left = MAX_COVERED_TEXELS;
    let mut covered = Vec::with_capacity(count);
    let mut previous = BEFORE_FIRST;
    for _ in 0..count {
        let slot = PatchSlot(take_successor(&mut reader, &mut previous)?);
        let Some(block) = blocks.get(&slot).copied().flatten() else {
            return Err(invalid(WHAT, format!("the patch in slot {} gets no block", slot.0)));
        };
        let texels = block.size.texels();
        left -= check_count("texels of covered blocks", texels as usize, left as usize)? as u32;
        covered.push((slot, Coverage::take(&mut reader, texels)?));
    }
    reader.finish()?;
    Ok(covered)
}
