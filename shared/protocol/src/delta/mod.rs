//! The bytes of an update: geometry ([`crate::geometry`]) and samples ([`crate::motion`]).
//!
//! A header has the lengths of its sections; the sections follow: explicit little-endian blocks and varints. Patches, vertices and
//! placements are one section of coded bits (`coding.rs`): both sides know the meshes told so far, and where the atlas has room.
//! Both sides keep the client's memory and the history of its samples. So samples need no slots, and a delta that contradicts
//! the memory is refused.

mod batches;
mod coding;
mod entering;
mod known;
mod parts;
mod placing;
mod sections;
mod slots;

pub use parts::{Part, PartBytes};

use crate::atlas::AtlasExtent;
use crate::geometry::GeometryDelta;
use crate::ids::UpdateId;
use crate::limits::MAX_DELTA_BYTES;
use crate::memory::ClientMemory;
use crate::message::MotionMemory;
use crate::motion::predicted::{put_predictions, take_predictions};
use crate::motion::rest::{PlacedRest, put_rests, take_rests};
use crate::motion::samples::{SampleEncoder, SampleHistory};
use crate::motion::{PositionBatch, SampleBatch};
use crate::range::{RangeDecoder, RangeEncoder};
use crate::time::WorldTime;
use crate::wire::{
    DeltaHead, GEOMETRY_MAGIC, Reader, WireError, check_count, invalid, peek_delta, put_varint,
};
use batches::{put_samples, take_samples};
use coding::GeometryCoding;
use sections::{
    put_coverage, put_instances, put_settled, put_skinned, take_coverage, take_instances, take_settled,
    take_skinned,
};

const SECTIONS: usize = 8;

/// What an update tells the client beside its picture, or what it is told of samples between two updates.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Delta {
    /// What changes in its memory; between updates nothing, and the update is the last one.
    pub geometry: GeometryDelta,
    /// False between updates.
    pub is_update: bool,
    /// New samples. They count from arrival on, not from the update's display.
    pub samples: Vec<SampleBatch>,
}

impl Delta {
    /// How much there is to take in: samples, vertices, patches and placements.
    pub fn records(&self) -> usize {
        self.samples.iter().map(|batch| batch.values.len()).sum::<usize>() + self.geometry.records()
    }
}

impl From<GeometryDelta> for Delta {
    fn from(geometry: GeometryDelta) -> Self {
        Self { geometry, is_update: true, samples: Vec::new() }
    }
}

/// A delta in the order of updates, as the client takes it in.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ReceivedDelta {
    /// What changes in its memory.
    pub geometry: GeometryDelta,
    /// False between updates.
    pub is_update: bool,
    /// New samples, in metres.
    pub positions: Vec<PositionBatch>,
    /// New vertices before skinning, in units of their meshes.
    pub rests: Vec<PlacedRest>,
}

impl ReceivedDelta {
    /// As [`Delta::records`].
    pub fn records(&self) -> usize {
        self.positions.iter().map(|batch| batch.positions.len()).sum::<usize>() + self.geometry.records()
    }
}

/// A delta's bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EncodedDelta {
    /// The update; between updates `None`.
    pub update: Option<UpdateId>,
    /// For [`DeltaDecoder::decode`].
    pub bytes: Vec<u8>,
    /// Where they went.
    pub sizes: DeltaSizes,
}

/// Where the bytes of a delta went.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DeltaSizes {
    /// All bytes.
    pub total_bytes: usize,
    /// The same by part.
    pub parts: PartBytes,
    /// New vertices, and instances of them.
    pub vertex_bytes: usize,
    /// Skeletons, meshes, and instances of them.
    pub skeleton_bytes: usize,
    /// Vertices before skinning.
    pub rest_bytes: usize,
    /// New patches, and evictions.
    pub patch_bytes: usize,
    /// Placements.
    pub placement_bytes: usize,
    /// Which texels of blocks are covered.
    pub coverage_bytes: usize,
    /// Blocks that settle.
    pub settled_bytes: usize,
    /// Samples, first ones included.
    pub sample_bytes: usize,
    /// Vertex samples coded in `sample_bytes`.
    pub samples: usize,
    /// Predictions.
    pub prediction_bytes: usize,
    /// Vertices that enter.
    pub new_vertices: usize,
    /// Vertices before skinning that are told.
    pub new_rests: usize,
}

/// The server's side of one client's memory.
#[derive(Clone, Debug)]
pub struct DeltaEncoder {
    next: u32,
    memory: ClientMemory,
    history: SampleHistory,
    encoder: SampleEncoder,
    coding: GeometryCoding,
    /// Of the delta in the making, kept for their memory.
    coded: GeometryDelta,
    sections: [Vec<u8>; SECTIONS],
}

/// The client's side of its memory, as the deltas so far have made it.
#[derive(Clone, Debug)]
pub struct DeltaDecoder {
    memory: ClientMemory,
    history: SampleHistory,
    coding: GeometryCoding,
    /// True after a delta failed half-way: nothing after it can be understood.
    broken: bool,
}

impl DeltaEncoder {
    /// For the capacities of [`crate::message::Welcome`], with an empty memory.
    pub fn new(vertex_slots: u32, patch_slots: u32) -> Self {
        Self {
            next: 0,
            memory: ClientMemory::new(vertex_slots, patch_slots),
            history: SampleHistory::new(vertex_slots),
            encoder: SampleEncoder::new(),
            coding: GeometryCoding::new(vertex_slots, patch_slots),
            coded: GeometryDelta::default(),
            sections: Default::default(),
        }
    }

    /// With so much memory to skin.
    #[must_use]
    pub fn with_motion(mut self, motion: MotionMemory) -> Self {
        self.memory = self.memory.with_motion(motion);
        self
    }

    /// With blocks in an atlas of this extent, that of [`crate::message::Welcome`].
    #[must_use]
    pub fn with_atlas(mut self, extent: AtlasExtent) -> Self {
        self.coding = self.coding.with_atlas(extent);
        self
    }

    /// With so many pages of the store.
    #[must_use]
    pub fn with_store(mut self, pages: u32) -> Self {
        self.memory = self.memory.with_store(pages);
        self
    }

    /// The next delta is this one of the session.
    #[must_use]
    pub fn from_delta(mut self, sequence: u32) -> Self {
        self.next = sequence;
        self
    }

    /// The client's memory after all deltas so far.
    pub fn memory(&self) -> &ClientMemory {
        &self.memory
    }

    /// The delta's bytes; brings the memory up to date. A delta that contradicts it or a limit is a bug of the caller and
    /// panics.
    pub fn encode(&mut self, delta: &Delta) -> EncodedDelta {
        self.encode_parts(&delta.geometry, delta.is_update, &delta.samples)
    }

    /// The same of an update, which brings no samples.
    pub fn encode_update(&mut self, geometry: &GeometryDelta) -> EncodedDelta {
        self.encode_parts(geometry, true, &[])
    }

    fn encode_parts(
        &mut self,
        geometry: &GeometryDelta,
        is_update: bool,
        samples: &[SampleBatch],
    ) -> EncodedDelta {
        let update = geometry.update;
        let mut sections = std::mem::take(&mut self.sections);
        sections.iter_mut().for_each(Vec::clear);
        let bits = self.encode_geometry(geometry, &mut sections[4]);
        let entered =
            self.memory.apply(geometry).unwrap_or_else(|error| panic!("delta {}: {error}", update.0));
        self.history.follow(&entered);
        put_instances(&mut sections[0], &geometry.instances);
        put_skinned(&mut sections[1], &geometry.skinned);
        put_rests(&mut sections[2], &geometry.new_rests);
        let code = |batch: &SampleBatch, out: &mut Vec<u8>| {
            self.encoder.encode_batch(batch, &mut self.history, out);
        };
        put_samples(&mut sections[3], samples, &entered.sampled, &self.memory.sampled_slots(), code);
        put_predictions(&mut sections[5], &geometry.predictions);
        put_coverage(&mut sections[6], &geometry.coverage);
        put_settled(&mut sections[7], &geometry.settled);
        let bytes = put_header_and([self.next, u32::from(is_update)], geometry, &sections);
        self.next = self.next.saturating_add(1);
        assert!(bytes.len() <= MAX_DELTA_BYTES, "delta {} has {} bytes", update.0, bytes.len());
        let parts = part_bytes(&sections, bytes.len(), bits);
        let sum = |of: &[Part]| of.iter().map(|part| parts.of(*part) as usize).sum();
        let sizes = DeltaSizes {
            total_bytes: bytes.len(),
            parts,
            vertex_bytes: sum(&[Part::Vertices]) + sections[0].len(),
            skeleton_bytes: sections[1].len(),
            rest_bytes: sections[2].len(),
            patch_bytes: sum(&[Part::Evicted, Part::PatchSlots, Part::PatchKinds, Part::Corners]),
            placement_bytes: sum(&[Part::PlacedSlots, Part::Blocks]),
            sample_bytes: sections[3].len(),
            prediction_bytes: sections[5].len(),
            coverage_bytes: sections[6].len(),
            settled_bytes: sections[7].len(),
            new_vertices: geometry.new_vertices.len(),
            new_rests: geometry.new_rests.len(),
            samples: samples.iter().map(|batch| batch.values.len()).sum(),
        };
        self.sections = sections;
        EncodedDelta { update: is_update.then_some(update), bytes, sizes }
    }

    /// What is coded in bits; nothing takes no bytes. Gives the bits by part, by 256.
    fn encode_geometry(&mut self, geometry: &GeometryDelta, out: &mut Vec<u8>) -> [u64; Part::ALL.len()] {
        let mut bits = [0; Part::ALL.len()];
        if is_coded(geometry) {
            let mut coder = RangeEncoder::new(out, &mut bits);
            self.coded.clear();
            let coded = self.coding.code(&mut coder, &self.memory, geometry, &mut self.coded);
            coder.finish();
            let is_whole = coded.is_ok() && has_same_lists(&self.coded, geometry);
            assert!(
                is_whole,
                "delta {}: its lists are not in order, or contradict the memory",
                geometry.update.0
            );
        }
        bits
    }
}

/// Whether there is anything that is coded in bits.
fn is_coded(geometry: &GeometryDelta) -> bool {
    !has_same_lists(geometry, &GeometryDelta::default())
}

fn has_same_lists(a: &GeometryDelta, b: &GeometryDelta) -> bool {
    a.evicted_patches == b.evicted_patches
        && a.evicted_vertices == b.evicted_vertices
        && a.new_vertices == b.new_vertices
        && a.new_patches == b.new_patches
        && a.placements == b.placements
}

impl DeltaDecoder {
    /// For the capacities of [`crate::message::Welcome`], with an empty memory.
    pub fn new(vertex_slots: u32, patch_slots: u32) -> Self {
        Self {
            memory: ClientMemory::new(vertex_slots, patch_slots),
            history: SampleHistory::new(vertex_slots),
            coding: GeometryCoding::new(vertex_slots, patch_slots),
            broken: false,
        }
    }

    /// With so much memory to skin.
    #[must_use]
    pub fn with_motion(mut self, motion: MotionMemory) -> Self {
        self.memory = self.memory.with_motion(motion);
        self
    }

    /// With blocks in an atlas of this extent, that of [`crate::message::Welcome`].
    #[must_use]
    pub fn with_atlas(mut self, extent: AtlasExtent) -> Self {
        self.coding = self.coding.with_atlas(extent);
        self
    }

    /// With so many pages of the store.
    #[must_use]
    pub fn with_store(mut self, pages: u32) -> Self {
        self.memory = self.memory.with_store(pages);
        self
    }

    /// The client's memory after all deltas so far.
    pub fn memory(&self) -> &ClientMemory {
        &self.memory
    }

    /// The delta of these bytes; brings the memory up to date. Deltas must come in order. After an error the decoder refuses
    /// everything: the connection has to be made anew.
    pub fn decode(&mut self, bytes: &[u8]) -> Result<Delta, WireError> {
        if self.broken {
            return Err(invalid("a delta", "one before it could not be applied; connect again"));
        }
        self.broken = true;
        let delta = self.decode_next(bytes)?;
        self.broken = false;
        Ok(delta)
    }

    /// The same, with samples in metres.
    pub fn receive(&mut self, bytes: &[u8]) -> Result<ReceivedDelta, WireError> {
        let Delta { geometry, is_update, samples } = self.decode(bytes)?;
        let (positions, rests) = (self.memory.positions(samples), self.memory.rests(&geometry.new_rests));
        Ok(ReceivedDelta { geometry, is_update, positions, rests })
    }

    fn decode_next(&mut self, bytes: &[u8]) -> Result<Delta, WireError> {
        check_count("a delta's length in bytes", bytes.len(), MAX_DELTA_BYTES)?;
        let (head, [time, shaded], sections) = split_sections(bytes)?;
        let [instances, skinned, rests, samples, coded, predicted, coverage, settled] = sections;
        let vertex_slots = self.memory.vertex_slots() as usize;
        let patch_slots = self.memory.patch_slots() as usize;
        let coded = self.decode_geometry(coded)?;
        let geometry = GeometryDelta {
            update: head.update,
            time,
            shaded,
            instances: take_instances(instances)?,
            skinned: take_skinned(skinned)?,
            new_rests: take_rests(rests)?,
            coverage: take_coverage(coverage, &coded.placements)?,
            settled: take_settled(settled, patch_slots)?,
            predictions: take_predictions(predicted, vertex_slots)?,
            ..coded
        };
        let entered = self.memory.apply(&geometry)?;
        self.history.follow(&entered);
        let samples = take_samples(samples, &entered.sampled, &self.memory, &mut self.history)?;
        Ok(Delta { geometry, is_update: head.is_update, samples })
    }

    fn decode_geometry(&mut self, section: &[u8]) -> Result<GeometryDelta, WireError> {
        if section.is_empty() {
            return Ok(GeometryDelta::default());
        }
        let mut coder = RangeDecoder::new(section);
        let (nothing, mut geometry) = (GeometryDelta::default(), GeometryDelta::default());
        self.coding.code(&mut coder, &self.memory, &nothing, &mut geometry)?;
        coder.finish("coded geometry")?;
        Ok(geometry)
    }
}

/// `bits`: those of the coded section by part, by 256.
fn part_bytes(sections: &[Vec<u8>; SECTIONS], total: usize, bits: [u64; Part::ALL.len()]) -> PartBytes {
    let mut parts = PartBytes::default();
    let of_sections = [
        (&[0, 1][..], Part::Skeletons),
        (&[2], Part::Rests),
        (&[3], Part::Samples),
        (&[5], Part::Predictions),
        (&[6], Part::Coverage),
        (&[7], Part::Settled),
    ];
    for (indices, part) in of_sections {
        parts.add(part, indices.iter().map(|&index: &usize| sections[index].len()).sum());
    }
    // Whole bytes in proportion to the bits, so that their sum is right.
    let (coded, all) = (sections[4].len() as u64, bits.iter().sum::<u64>().max(1));
    let (mut told, mut counted) = (0, 0);
    for part in Part::ALL {
        told += bits[part as usize];
        let bytes = coded * told / all - counted;
        counted += bytes;
        parts.add(part, bytes as usize);
    }
    parts.add(Part::Head, total - sections.iter().map(Vec::len).sum::<usize>());
    parts
}

fn put_header_and(
    [sequence, is_update]: [u32; 2],
    geometry: &GeometryDelta,
    sections: &[Vec<u8>; SECTIONS],
) -> Vec<u8> {
    let mut out = Vec::with_capacity(64 + sections.iter().map(Vec::len).sum::<usize>());
    out.extend_from_slice(&GEOMETRY_MAGIC);
    out.extend_from_slice(&sequence.to_le_bytes());
    out.extend_from_slice(&geometry.update.0.to_le_bytes());
    out.push(is_update as u8);
    out.extend_from_slice(&geometry.time.0.to_le_bytes());
    out.extend_from_slice(&geometry.shaded.0.to_le_bytes());
    for section in sections {
        put_varint(&mut out, section.len() as u32);
    }
    sections.iter().for_each(|section| out.extend_from_slice(section));
    out
}

/// A delta's head, when it was begun and what it is shaded for, and its sections.
type Split<'a> = (DeltaHead, [WorldTime; 2], [&'a [u8]; SECTIONS]);

fn split_sections(bytes: &[u8]) -> Result<Split<'_>, WireError> {
    let head = peek_delta(bytes)?;
    let mut reader = Reader::new("a delta's header", bytes);
    reader.take(DeltaHead::BYTES)?;
    let times = [WorldTime(reader.i64()?), WorldTime(reader.i64()?)];
    let mut lengths = [0; SECTIONS];
    for length in &mut lengths {
        *length = reader.varint()? as usize;
    }
    reader.what = "a delta's sections";
    let mut sections: [&[u8]; SECTIONS] = [&[]; SECTIONS];
    for (section, length) in sections.iter_mut().zip(lengths) {
        *section = reader.take(length)?;
    }
    reader.finish()?;
    Ok((head, times, sections))
}

#[cfg(test)]
mod herd_tests;
#[cfg(test)]
mod tests;
