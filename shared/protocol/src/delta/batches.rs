//! The section of samples: batches, each with its grid step, its vertices, and the coded samples.

use super::sections::{BEFORE_FIRST, put_slots, put_successor, take_successor};
use crate::ids::VertexSlot;
use crate::limits::{MAX_NEW_SAMPLE_GRIDS, MAX_SAMPLE_BATCHES};
use crate::memory::ClientMemory;
use crate::motion::SampleBatch;
use crate::motion::samples::{SampleHistory, decode_batch};
use crate::time::GridIndex;
use crate::wire::{Reader, WireError, check_count, invalid, put_varint};

/// Samples of every vertex that has any.
const COVER_ALL: u8 = 0;
/// Samples of those that enter with this delta.
const COVER_NEW: u8 = 1;
/// Samples of vertices that are listed.
const COVER_LIST: u8 = 2;

/// `fresh`: the vertices with samples that enter; `all`: all that are there then. `code` appends the coded samples of a batch.
pub(super) fn put_samples(
    out: &mut Vec<u8>,
    batches: &[SampleBatch],
    fresh: &[VertexSlot],
    all: &[VertexSlot],
    mut code: impl FnMut(&SampleBatch, &mut Vec<u8>),
) {
    assert!(batches.len() <= MAX_SAMPLE_BATCHES as usize, "{} batches of samples", batches.len());
    put_varint(out, batches.len() as u32);
    let mut previous = BEFORE_FIRST;
    for batch in batches {
        let slots: Vec<_> = batch.values.iter().map(|(slot, _)| *slot).collect();
        assert!(
            slots.is_sorted_by(|a, b| a < b),
            "the samples of grid step {} are not in order",
            batch.grid.0
        );
        put_successor(out, &mut previous, batch.grid.0 as u32);
        put_coverage(out, &slots, all, fresh);
        code(batch, out);
    }
}

fn put_coverage(out: &mut Vec<u8>, slots: &[VertexSlot], all: &[VertexSlot], fresh: &[VertexSlot]) {
    if slots == all {
        out.push(COVER_ALL);
    } else if slots == fresh {
        out.push(COVER_NEW);
    } else {
        assert!(
            slots.iter().all(|slot| all.binary_search(slot).is_ok()),
            "a sample of a vertex that has none"
        );
        out.push(COVER_LIST);
        put_slots(out, slots.iter().map(|slot| slot.0));
    }
}

pub(super) fn take_samples(
    section: &[u8],
    fresh: &[VertexSlot],
    memory: &ClientMemory,
    history: &mut SampleHistory,
) -> Result<Vec<SampleBatch>, WireError> {
    let mut reader = Reader::new("batches of samples", section);
    let count = reader.count(MAX_SAMPLE_BATCHES as usize, 2)?;
    let all = memory.sampled_slots();
    // Samples can be coded in no bits at all: what they grow to is bounded, not what they come in.
    let most = (memory.vertex_slots() * MAX_NEW_SAMPLE_GRIDS) as usize;
    let mut batches = Vec::with_capacity(count);
    let (mut previous, mut total) = (BEFORE_FIRST, 0);
    for _ in 0..count {
        let grid = GridIndex(take_successor(&mut reader, &mut previous)? as i32);
        let listed;
        let slots: &[VertexSlot] = match reader.u8()? {
            COVER_ALL => &all,
            COVER_NEW => fresh,
            COVER_LIST => {
                listed = take_listed(&mut reader, memory)?;
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
fn take_listed(reader: &mut Reader<'_>, memory: &ClientMemory) -> Result<Vec<VertexSlot>, WireError> {
    let count = reader.count(memory.vertex_slots() as usize, 1)?;
    let mut slots: Vec<VertexSlot> = Vec::with_capacity(count);
    let mut previous = BEFORE_FIRST;
    for _ in 0..count {
        let slot = VertexSlot(take_successor(reader, &mut previous)?);
        if !memory.is_sampled(slot) || slots.last().is_some_and(|last| *last >= slot) {
            return Err(invalid(
                "a batch's list of vertices",
                format!("slot {} does not belong there", slot.0),
            ));
        }
        slots.push(slot);
    }
    Ok(slots)
}
