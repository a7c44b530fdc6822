//! Arrivals about vertices, on their way to the GPU's memory.

use shadecast_protocol::ids::UpdateId;
use shadecast_shaders::generated::VertexWriteGpu;
use std::collections::VecDeque;

/// Records for the GPU's vertex memory, in the order in which they must be written.
#[derive(Debug, Default)]
pub struct VertexWrites {
    pub(super) records: Vec<VertexWriteGpu>,
    segments: VecDeque<Segment>,
    /// Records at the front that are already on their way.
    taken: usize,
    /// The last frame all of whose records are on their way.
    complete: Option<UpdateId>,
}

/// Records that do not depend on each other; a barrier lies between two segments.
#[derive(Clone, Copy, Debug)]
struct Segment {
    update: UpdateId,
    /// Into `records`, exclusive.
    end: usize,
    ends_frame: bool,
}

impl VertexWrites {
    pub(super) fn push(&mut self, record: VertexWriteGpu) {
        self.records.push(record);
    }

    /// Takes memory for so many more at once: growing bit by bit would leave holes behind that nothing fits into.
    pub(super) fn reserve(&mut self, records: usize) {
        self.records.reserve(records);
    }

    pub(super) fn end_segment(&mut self, update: UpdateId) {
        let start = self.segments.back().map_or(self.taken, |segment| segment.end);
        if self.records.len() > start {
            self.segments.push_back(Segment { update, end: self.records.len(), ends_frame: false });
        }
    }

    pub(super) fn end_frame(&mut self, update: UpdateId) {
        self.end_segment(update);
        match self.segments.back_mut() {
            Some(segment) if segment.update == update => segment.ends_frame = true,
            // Nothing to write: complete as soon as all before it is.
            _ => self.segments.push_back(Segment { update, end: self.records.len(), ends_frame: true }),
        }
    }

    /// Moves records into `staging`, as far as it reaches, and calls `segment` with the range of records that each
    /// run of independent ones takes there.
    pub fn drain_into(
        &mut self,
        staging: &mut [VertexWriteGpu],
        mut segment: impl FnMut(std::ops::Range<u32>),
    ) {
        let mut used = 0;
        while let Some(next) = self.segments.front().copied() {
            let count = (next.end - self.taken).min(staging.len() - used);
            staging[used..used + count].copy_from_slice(&self.records[self.taken..self.taken + count]);
            if count > 0 {
                segment(used as u32..(used + count) as u32);
            }
            self.taken += count;
            used += count;
            if self.taken < next.end {
                return self.forget_taken();
            }
            self.segments.pop_front();
            if next.ends_frame {
                self.complete = Some(next.update);
            }
        }
        self.records.clear();
        self.records.shrink_to(staging.len());
        self.taken = 0;
    }

    /// Frees the place of what is on its way, so that a queue which never gets empty does not grow for that.
    fn forget_taken(&mut self) {
        self.records.drain(..self.taken);
        self.segments.iter_mut().for_each(|segment| segment.end -= self.taken);
        self.taken = 0;
    }

    /// Records that have not been handed on.
    pub(super) fn waiting(&self) -> usize {
        self.records.len() - self.taken
    }

    /// True where nothing waits.
    pub(super) fn is_empty(&self) -> bool {
        self.segments.is_empty()
    }

    /// Bytes that it takes.
    pub(super) fn capacity_bytes(&self) -> usize {
        self.records.capacity() * size_of::<VertexWriteGpu>()
    }

    /// The last frame all of whose vertices have been handed on.
    pub fn complete(&self) -> Option<UpdateId> {
        self.complete
    }
}
