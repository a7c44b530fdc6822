//! The sections of geometry that are not coded in bits.

use crate::atlas::{Block, PixelTexels};
use crate::coverage::Coverage;
use crate::geometry::{InstanceInfo, Settled, Skinned};
use crate::ids::{InstanceId, PatchSlot};
use crate::limits::{MAX_COVERED_TEXELS, MAX_INSTANCES};
use crate::motion::rest::MeshInfo;
use crate::motion::skeleton::{SkeletonInfo, SkinnedInstance};
use crate::wire::{Reader, WireError, check_count, invalid, put_varint, put_zigzag};
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

pub(super) fn put_slots(out: &mut Vec<u8>, slots: impl ExactSizeIterator<Item = u32>) {
    put_varint(out, slots.len() as u32);
    let mut previous = BEFORE_FIRST;
    slots.for_each(|slot| put_successor(out, &mut previous, slot));
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

/// Slot, then where to, then what it is filtered for.
pub(super) fn put_settled(out: &mut Vec<u8>, settled: &[Settled]) {
    put_varint(out, settled.len() as u32);
    let mut previous = BEFORE_FIRST;
    for Settled { slot, to, pixel } in settled {
        put_successor(out, &mut previous, slot.0);
        out.extend_from_slice(&to.pack().to_le_bytes());
        out.push(pixel.bits());
    }
}

pub(super) fn take_settled(section: &[u8], patch_slots: usize) -> Result<Vec<Settled>, WireError> {
    const WHAT: &str = "settled blocks";
    let mut reader = Reader::new(WHAT, section);
    let count = reader.count(patch_slots, 6)?;
    let mut settled = Vec::with_capacity(count);
    let mut previous = BEFORE_FIRST;
    for _ in 0..count {
        let slot = PatchSlot(take_successor(&mut reader, &mut previous)?);
        let to = Block::unpack(reader.u32()?).map_err(|error| invalid(WHAT, error.to_string()))?;
        let pixel = PixelTexels::from_bits(reader.u8()?);
        settled.push(Settled { slot, to, pixel });
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
