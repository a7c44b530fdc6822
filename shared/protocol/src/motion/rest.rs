//! Vertices before skinning: position, joints, weights and morph targets, sent once for each vertex of a mesh, however many
//! instances show it.
//!
//! Positions are fixed-point in the mesh's space, with a step that the server chooses by the drawn size of the mesh. Weights
//! are whole units of 1/65,535, as in a scene's vertices, so blending is exact.

use super::bits::{BitReader, BitWriter, Packing};
use crate::ids::RestId;
use crate::limits::{MAX_ARENA_WORDS, MAX_REST_VERTICES, MAX_STEP_M, MAX_VERTEX_MORPHS, MIN_STEP_M};
use crate::wire::{Reader, WireError, check_count, invalid, put_varint, put_zigzag};

/// Vertices that share widths.
const GROUP: usize = 32;
/// Bits of the number of influences less one.
const COUNT_BITS: u32 = 2;
/// Bits of a joint; also of the largest number of palette entries.
const JOINT_BITS: u32 = 12;
const WEIGHT_BITS: u32 = 16;

/// The rest vertices of a mesh.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeshInfo {
    /// The first of them.
    pub first_rest: RestId,
    /// How many the mesh has.
    pub count: u32,
    /// Step of positions and of morph targets in units of the mesh, `MIN_STEP_M..=MAX_STEP_M`.
    pub step: f32,
}

/// A vertex before skinning.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RestVertex {
    /// Its number.
    pub rest: RestId,
    /// In steps of its mesh.
    pub position: [i32; 3],
    /// Entries of the skeleton's palette; those of weight 0 repeat the first.
    pub joints: [u16; 4],
    /// Units of 1/65,535, in all 65,535; those of 0 come last.
    pub weights: [u16; 4],
    /// First word of its morphs in the client's arena; 0 where it has none.
    pub morph_word: u32,
    /// Morph targets that move it, and by how much at a weight of 1, in steps of its mesh.
    pub morphs: Vec<(u16, [i32; 3])>,
}

impl RestVertex {
    fn influences(&self) -> usize {
        self.weights.iter().filter(|weight| **weight > 0).count().max(1)
    }
}

impl MeshInfo {
    pub(crate) fn put(&self, out: &mut Vec<u8>) {
        put_varint(out, self.first_rest.0);
        put_varint(out, self.count);
        out.extend_from_slice(&self.step.to_le_bytes());
    }

    pub(crate) fn take(reader: &mut Reader<'_>) -> Result<Self, WireError> {
        let (first, count, step) = (reader.varint()?, reader.varint()?, reader.f32()?);
        let what = "the vertices of a mesh";
        check_count(what, first as usize + count as usize, MAX_REST_VERTICES as usize)?;
        if !(MIN_STEP_M..=MAX_STEP_M).contains(&step) {
            return Err(invalid(what, format!("their step {step} is out of range")));
        }
        Ok(Self { first_rest: RestId(first), count, step })
    }

    /// Whether a rest vertex is one of its.
    pub fn has(&self, rest: RestId) -> bool {
        rest.0.wrapping_sub(self.first_rest.0) < self.count
    }

    /// A position in units of the mesh.
    pub fn dequantise(&self, value: [i32; 3]) -> [f32; 3] {
        value.map(|steps| (f64::from(steps) * f64::from(self.step)) as f32)
    }

    /// A position in steps.
    pub fn quantise(&self, position: [f32; 3]) -> [i32; 3] {
        position.map(|value| (f64::from(value) / f64::from(self.step)).round() as i32)
    }
}

/// The same in units of its mesh.
#[derive(Clone, Debug, PartialEq)]
pub struct PlacedRest {
    /// Its number.
    pub rest: RestId,
    /// In the mesh's space.
    pub position: [f32; 3],
    /// See [`RestVertex::joints`].
    pub joints: [u16; 4],
    /// See [`RestVertex::weights`].
    pub weights: [u16; 4],
    /// See [`RestVertex::morph_word`].
    pub morph_word: u32,
    /// Morph targets, and by how much they move it at a weight of 1.
    pub morphs: Vec<(u16, [f32; 3])>,
}

impl PlacedRest {
    /// Of a vertex of this mesh.
    pub fn of(rest: &RestVertex, mesh: &MeshInfo) -> Self {
        Self {
            rest: rest.rest,
            position: mesh.dequantise(rest.position),
            joints: rest.joints,
            weights: rest.weights,
            morph_word: rest.morph_word,
            morphs: rest.morphs.iter().map(|(morph, delta)| (*morph, mesh.dequantise(*delta))).collect(),
        }
    }
}

/// Appends vertices, by rising numbers: runs of numbers, then groups of positions and influences, then morphs.
pub(crate) fn put_rests(out: &mut Vec<u8>, rests: &[RestVertex]) {
    put_varint(out, rests.len() as u32);
    if rests.is_empty() {
        return;
    }
    let mut next = 0;
    for run in rests.chunk_by(|a, b| b.rest.0 == a.rest.0 + 1) {
        put_varint(out, run[0].rest.0 - next);
        put_varint(out, run.len() as u32 - 1);
        next = run[run.len() - 1].rest.0 + 1;
    }
    let has_morphs = rests.iter().any(|rest| !rest.morphs.is_empty());
    put_varint(out, u32::from(has_morphs));
    let mut bits = BitWriter::new(out);
    let (mut before, mut joints) = ([0; 3], [0; 4]);
    for group in rests.chunks(GROUP) {
        put_group(&mut bits, group, &mut before, &mut joints);
    }
    bits.finish();
    if has_morphs {
        rests.iter().for_each(|rest| put_morphs(out, rest));
    }
}

fn put_group(bits: &mut BitWriter<'_>, group: &[RestVertex], before: &mut [i32; 3], joints: &mut [u16; 4]) {
    let mut misses = [[0; 3]; GROUP];
    let misses = &mut misses[..group.len()];
    for (miss, rest) in misses.iter_mut().zip(group) {
        let before = std::mem::replace(before, rest.position);
        *miss = std::array::from_fn(|axis| rest.position[axis].wrapping_sub(before[axis]));
    }
    let packing = Packing::of_group(misses);
    packing.iter().for_each(|packing| packing.write(bits));
    for (rest, miss) in group.iter().zip(misses) {
        for (axis, packing) in packing.iter().enumerate() {
            bits.put(miss[axis].wrapping_sub(packing.base) as u32, packing.width);
        }
        let count = rest.influences();
        bits.put(count as u32 - 1, COUNT_BITS);
        let is_same = rest.joints[..count] == joints[..count];
        bits.put(u32::from(is_same), 1);
        if !is_same {
            rest.joints[..count].iter().for_each(|joint| bits.put(u32::from(*joint), JOINT_BITS));
        }
        rest.weights[1..count].iter().for_each(|weight| bits.put(u32::from(*weight), WEIGHT_BITS));
        *joints = rest.joints;
    }
}

fn put_morphs(out: &mut Vec<u8>, rest: &RestVertex) {
    put_varint(out, rest.morphs.len() as u32);
    if rest.morphs.is_empty() {
        return;
    }
    put_varint(out, rest.morph_word);
    let mut next = 0;
    for (morph, delta) in &rest.morphs {
        put_varint(out, u32::from(*morph) - next);
        next = u32::from(*morph) + 1;
        delta.iter().for_each(|axis| put_zigzag(out, *axis));
    }
}

/// Reads what [`put_rests`] wrote.
pub(crate) fn take_rests(section: &[u8]) -> Result<Vec<RestVertex>, WireError> {
    let mut reader = Reader::new("rest vertices", section);
    let count = check_count("rest vertices", reader.varint()? as usize, MAX_REST_VERTICES as usize)?;
    if count == 0 {
        return reader.finish().map(|()| Vec::new());
    }
    let numbers = take_numbers(&mut reader, count)?;
    let has_morphs = reader.varint()? != 0;
    let bytes = reader.rest();
    let mut bits = BitReader::new("rest vertices", bytes);
    let mut rests = Vec::with_capacity(count);
    let (mut before, mut joints) = ([0; 3], [0; 4]);
    for group in numbers.chunks(GROUP) {
        let packing = [Packing::read(&mut bits)?, Packing::read(&mut bits)?, Packing::read(&mut bits)?];
        for rest in group {
            rests.push(take_rest(&mut bits, *rest, &packing, &mut before, &mut joints)?);
        }
    }
    let mut reader = Reader::new("rest vertices", &bytes[bits.bytes_read()..]);
    if has_morphs {
        rests.iter_mut().try_for_each(|rest| take_morphs(&mut reader, rest))?;
    }
    reader.finish()?;
    Ok(rests)
}

fn take_numbers(reader: &mut Reader<'_>, count: usize) -> Result<Vec<RestId>, WireError> {
    let mut numbers = Vec::with_capacity(count);
    let mut next = 0u32;
    while numbers.len() < count {
        let (gap, length) = (reader.varint()?, reader.varint()? as usize);
        check_count("a run of rest vertices", length, count - numbers.len() - 1)?;
        let first = next.saturating_add(gap);
        let end = first as usize + length + 1;
        next = check_count("the number of a rest vertex", end, MAX_REST_VERTICES as usize)? as u32;
        numbers.extend((first..next).map(RestId));
    }
    Ok(numbers)
}

fn take_rest(
    bits: &mut BitReader<'_>,
    rest: RestId,
    packing: &[Packing; 3],
    before: &mut [i32; 3],
    joints: &mut [u16; 4],
) -> Result<RestVertex, WireError> {
    for (axis, packing) in packing.iter().enumerate() {
        let miss = packing.base.wrapping_add(bits.take(packing.width)? as i32);
        before[axis] = before[axis].wrapping_add(miss);
    }
    let count = bits.take(COUNT_BITS)? as usize + 1;
    if bits.take(1)? == 0 {
        for joint in &mut joints[..count] {
            *joint = bits.take(JOINT_BITS)? as u16;
        }
    }
    let first = joints[0];
    joints[count..].fill(first);
    let mut weights = [u16::MAX, 0, 0, 0];
    for index in 1..count {
        weights[index] = bits.take(WEIGHT_BITS)? as u16;
        weights[0] = weights[0]
            .checked_sub(weights[index])
            .ok_or_else(|| invalid("a rest vertex", "its weights are more than one"))?;
    }
    Ok(RestVertex { rest, position: *before, joints: *joints, weights, morph_word: 0, morphs: Vec::new() })
}

fn take_morphs(reader: &mut Reader<'_>, rest: &mut RestVertex) -> Result<(), WireError> {
    let count = reader.count(MAX_VERTEX_MORPHS as usize, 4)?;
    if count == 0 {
        return Ok(());
    }
    rest.morph_word = reader.varint()?;
    check_count("a vertex's morphs", rest.morph_word as usize + count, MAX_ARENA_WORDS as usize)?;
    let mut next = 0u32;
    for _ in 0..count {
        let morph = next.saturating_add(reader.varint()?);
        let morph = check_count("a morph target", morph as usize, usize::from(u16::MAX))? as u16;
        rest.morphs.push((morph, [reader.zigzag()?, reader.zigzag()?, reader.zigzag()?]));
        next = u32::from(morph) + 1;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Dice, damaged};

    fn rests(seed: u64, count: u32, has_morphs: bool) -> Vec<RestVertex> {
        let mut dice = Dice::new(seed);
        let mut number = 0;
        let mut one = |_| {
            number += 1 + if dice.below(10) == 0 { dice.below(300) as u32 } else { 0 };
            let count = 1 + dice.below(4) as usize;
            let mut joints = [dice.below(136) as u16; 4];
            let mut weights = [u16::MAX, 0, 0, 0];
            for index in 1..count {
                joints[index] = dice.below(136) as u16;
                weights[index] = 1 + dice.below(9000) as u16;
                weights[0] -= weights[index];
            }
            let morphs: Vec<_> = (0..if has_morphs { dice.below(4) as u16 } else { 0 })
                .map(|morph| (3 * morph, [0; 3].map(|_: i32| dice.below(2000) as i32 - 1000)))
                .collect();
            RestVertex {
                rest: RestId(number),
                position: [0; 3].map(|_: i32| dice.below(100_000) as i32 - 50_000),
                joints,
                weights,
                morph_word: if morphs.is_empty() { 0 } else { 40 * number },
                morphs,
            }
        };
        (0..count).map(&mut one).collect()
    }

    fn bytes_of(rests: &[RestVertex]) -> Vec<u8> {
        let mut bytes = Vec::new();
        put_rests(&mut bytes, rests);
        bytes
    }

    #[test]
    fn rest_vertices_come_back_as_they_were() {
        for seed in 0..40 {
            let rests = rests(seed, 1 + seed as u32 * 7, seed % 2 == 0);
            assert_eq!(take_rests(&bytes_of(&rests)), Ok(rests), "seed {seed}");
        }
        assert_eq!(take_rests(&bytes_of(&[])), Ok(Vec::new()));
    }

    #[test]
    fn damaged_rest_vertices_give_values_or_errors() {
        let bytes = bytes_of(&rests(1, 100, true));
        damaged(&bytes, 3, 5000, |bytes| drop(take_rests(bytes)));
        (0..bytes.len()).for_each(|length| assert!(take_rests(&bytes[..length]).is_err()));
    }
}
