//! The bytes of an update: geometry ([`crate::geometry`]) and samples ([`crate::motion`]).
//!
//! A header has the lengths of its sections; the sections follow: explicit little-endian blocks and varints, small because
//! slots come in runs. Both sides keep the client's memory and the history of its samples. So samples need no slots, and a
//! delta that contradicts the memory is refused.

mod batches;
mod parts;
mod sections;

pub use parts::{Part, PartBytes};

use crate::geometry::GeometryDelta;
use crate::ids::{PatchSlot, UpdateId, VertexSlot};
use crate::limits::MAX_DELTA_BYTES;
use crate::memory::ClientMemory;
use crate::message::MotionMemory;
use crate::motion::predicted::{put_predictions, take_predictions};
use crate::motion::rest::{PlacedRest, put_rests, take_rests};
use crate::motion::samples::{SampleEncoder, SampleHistory};
use crate::motion::{PositionBatch, SampleBatch};
use crate::time::WorldTime;
use crate::wire::{DeltaHead, GEOMETRY_MAGIC, Reader, WireError, check_count, invalid, peek_delta};
use batches::{put_samples, take_samples};
use sections::{
    put_coverage, put_evictions, put_instances, put_patches, put_placements, put_settled, put_skinned,
    put_vertices, take_coverage, take_evictions, take_instances, take_patches, take_placements, take_settled,
    take_skinned, take_vertices,
};

const SECTIONS: usize = 12;

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
    /// New vertices and evictions of vertices.
    pub vertex_bytes: usize,
    /// Skeletons, meshes, and instances of them.
    pub skeleton_bytes: usize,
    /// Vertices before skinning.
    pub rest_bytes: usize,
    /// New patches and evictions of patches.
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
    /// Of the delta in the making, kept for their memory.
    sections: [Vec<u8>; SECTIONS],
}

/// The client's side of its memory, as the deltas so far have made it.
#[derive(Clone, Debug)]
pub struct DeltaDecoder {
    memory: ClientMemory,
    history: SampleHistory,
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
            sections: Default::default(),
        }
    }

    /// With so much memory to skin.
    #[must_use]
    pub fn with_motion(mut self, motion: MotionMemory) -> Self {
        self.memory = self.memory.with_motion(motion);
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
        let entered =
            self.memory.apply(geometry).unwrap_or_else(|error| panic!("delta {}: {error}", update.0));
        self.history.follow(&entered);
        let mut sections = std::mem::take(&mut self.sections);
        sections.iter_mut().for_each(Vec::clear);
        put_evictions(&mut sections[0], geometry.evicted_patches.iter().map(|slot| slot.0));
        put_evictions(&mut sections[1], geometry.evicted_vertices.iter().map(|slot| slot.0));
        put_instances(&mut sections[2], &geometry.instances);
        put_skinned(&mut sections[3], &geometry.skinned);
        put_rests(&mut sections[4], &geometry.new_rests);
        put_vertices(&mut sections[5], &geometry.new_vertices);
        let [kinds, corners] = put_patches(&mut sections[6], &geometry.new_patches);
        let blocks = put_placements(&mut sections[7], &geometry.placements);
        let code = |batch: &SampleBatch, out: &mut Vec<u8>| {
            self.encoder.encode_batch(batch, &mut self.history, out);
        };
        put_samples(&mut sections[8], samples, &entered.sampled, &self.memory.sampled_slots(), code);
        put_predictions(&mut sections[9], &geometry.predictions);
        put_coverage(&mut sections[10], &geometry.coverage);
        put_settled(&mut sections[11], &geometry.settled);
        let bytes = put_header_and([self.next, u32::from(is_update)], geometry, &sections);
        self.next = self.next.saturating_add(1);
        assert!(bytes.len() <= MAX_DELTA_BYTES, "delta {} has {} bytes", update.0, bytes.len());
        let length = |indices: &[usize]| indices.iter().map(|&index| sections[index].len()).sum();
        let sizes = DeltaSizes {
            total_bytes: bytes.len(),
            parts: part_bytes(&sections, bytes.len(), [kinds, corners, blocks]),
            vertex_bytes: length(&[1, 2, 5]),
            skeleton_bytes: length(&[3]),
            rest_bytes: length(&[4]),
            patch_bytes: length(&[0, 6]),
            placement_bytes: length(&[7]),
            sample_bytes: length(&[8]),
            prediction_bytes: length(&[9]),
            coverage_bytes: length(&[10]),
            settled_bytes: length(&[11]),
            new_vertices: geometry.new_vertices.len(),
            new_rests: geometry.new_rests.len(),
            samples: samples.iter().map(|batch| batch.values.len()).sum(),
        };
        self.sections = sections;
        EncodedDelta { update: is_update.then_some(update), bytes, sizes }
    }
}

impl DeltaDecoder {
    /// For the capacities of [`crate::message::Welcome`], with an empty memory.
    pub fn new(vertex_slots: u32, patch_slots: u32) -> Self {
        Self {
            memory: ClientMemory::new(vertex_slots, patch_slots),
            history: SampleHistory::new(vertex_slots),
            broken: false,
        }
    }

    /// With so much memory to skin.
    #[must_use]
    pub fn with_motion(mut self, motion: MotionMemory) -> Self {
        self.memory = self.memory.with_motion(motion);
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
        let (head, time, sections) = split_sections(bytes)?;
        let [
            patches_out,
            vertices_out,
            instances,
            skinned,
            rests,
            vertices,
            patches,
            placements,
            samples,
            predicted,
            coverage,
            settled,
        ] = sections;
        let vertex_slots = self.memory.vertex_slots() as usize;
        let patch_slots = self.memory.patch_slots() as usize;
        let placements = take_placements(placements, patch_slots)?;
        let geometry = GeometryDelta {
            update: head.update,
            time,
            evicted_patches: take_evictions("evicted patches", patches_out, patch_slots, PatchSlot)?,
            evicted_vertices: take_evictions("evicted vertices", vertices_out, vertex_slots, VertexSlot)?,
            instances: take_instances(instances)?,
            skinned: take_skinned(skinned)?,
            new_rests: take_rests(rests)?,
            new_vertices: take_vertices(vertices, vertex_slots)?,
            new_patches: take_patches(patches, patch_slots)?,
            coverage: take_coverage(coverage, &placements)?,
            placements,
            settled: take_settled(settled, patch_slots)?,
            predictions: take_predictions(predicted, vertex_slots)?,
        };
        let entered = self.memory.apply(&geometry)?;
        self.history.follow(&entered);
        let samples = take_samples(samples, &entered.sampled, &self.memory, &mut self.history)?;
        Ok(Delta { geometry, is_update: head.is_update, samples })
    }
}

/// The last three: bytes of the kinds and corners of patches, and of the blocks of placements, in their sections.
fn part_bytes(
    sections: &[Vec<u8>; SECTIONS],
    total: usize,
    [kinds, corners, blocks]: [usize; 3],
) -> PartBytes {
    let mut parts = PartBytes::default();
    let of_sections = [
        (&[0, 1][..], Part::Evicted),
        (&[2, 3], Part::Skeletons),
        (&[4], Part::Rests),
        (&[5], Part::Vertices),
        (&[8], Part::Samples),
        (&[9], Part::Predictions),
        (&[10], Part::Coverage),
        (&[11], Part::Settled),
    ];
    for (indices, part) in of_sections {
        parts.add(part, indices.iter().map(|&index: &usize| sections[index].len()).sum());
    }
    parts.add(Part::PatchKinds, kinds);
    parts.add(Part::Corners, corners);
    parts.add(Part::PatchSlots, sections[6].len() - kinds - corners);
    parts.add(Part::Blocks, blocks);
    parts.add(Part::PlacedSlots, sections[7].len() - blocks);
    parts.add(Part::Head, total - sections.iter().map(Vec::len).sum::<usize>());
    parts
}

fn put_header_and(
    [sequence, is_update]: [u32; 2],
    geometry: &GeometryDelta,
    sections: &[Vec<u8>; SECTIONS],
) -> Vec<u8> {
    let mut out = Vec::with_capacity(80 + sections.iter().map(Vec::len).sum::<usize>());
    out.extend_from_slice(&GEOMETRY_MAGIC);
    out.extend_from_slice(&sequence.to_le_bytes());
    out.extend_from_slice(&geometry.update.0.to_le_bytes());
    out.push(is_update as u8);
    out.extend_from_slice(&geometry.time.0.to_le_bytes());
    for section in sections {
        out.extend_from_slice(&(section.len() as u32).to_le_bytes());
    }
    sections.iter().for_each(|section| out.extend_from_slice(section));
    out
}

fn split_sections(bytes: &[u8]) -> Result<(DeltaHead, WorldTime, [&[u8]; SECTIONS]), WireError> {
    let head = peek_delta(bytes)?;
    let mut reader = Reader::new("a delta's header", bytes);
    reader.take(DeltaHead::BYTES)?;
    let time = WorldTime(reader.i64()?);
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
    Ok((head, time, sections))
}

#[cfg(test)]
mod tests;
