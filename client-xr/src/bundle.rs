//! What may be drawn: pixels and placements of the same update, never a mixture.
//!
//! Deltas come in the order of frames, pictures whenever they are decoded. What a delta says about vertices is handed
//! on at once ([`VertexWrites`]), so that motion goes on while a picture is late: the server never reuses a slot that
//! the bundle on display still needs. What it says about patches waits until the picture of its frame, or of a later
//! one, is there. A delta whose picture never came applies all the same. Knows nothing of GPUs and networks.

use crate::pace::Span;
use shadecast_protocol::atlas::{Block, PatchKind};
use shadecast_protocol::delta::{GeometryDelta, Motion, NewPatch};
use shadecast_protocol::ids::{InstanceId, PatchSlot, UpdateId, VertexSlot};
use shadecast_protocol::limits::{
    MAX_INSTANCES, MAX_PATCH_SLOTS, PATCH_MAX_VERTICES, RECORDS_PER_SLOT_AND_TURN, SAMPLE_RING,
};
use shadecast_protocol::time::GridIndex;
use shadecast_shaders::generated::{CornerGpu, VertexWriteGpu};
use shadecast_shaders::records::{sample_write, sampled_entry, static_entry};
use std::collections::VecDeque;

/// Deltas whose patches wait for a picture; beyond it the oldest are applied, and their pictures are not shown.
const MAX_PENDING: usize = 256;
/// The same, by what they say: every patch comes, gets a block, loses it and goes.
const MAX_PENDING_RECORDS: usize = 4 * MAX_PATCH_SLOTS as usize;
/// Decoded pictures that wait for their delta; beyond it the oldest is dropped.
const MAX_PICTURES: usize = 3;
/// Corners of a patch of three triangles, and its indices.
pub const MAX_CORNERS_PER_PATCH: usize = PATCH_MAX_VERTICES as usize;
/// Indices of a patch of three triangles, both sides.
pub const MAX_INDICES_PER_PATCH: usize = 18;

/// Everything that deltas and pictures add up to. `P` is a decoded picture.
#[derive(Debug)]
pub struct Bundler<P> {
    vertices: Vec<Vertex>,
    step_m_of_instance: Vec<f32>,
    patches: Vec<Option<Patch>>,
    pending: VecDeque<PatchChanges>,
    /// What all of `pending` says.
    pending_records: usize,
    pictures: VecDeque<(UpdateId, P)>,
    writes: VertexWrites,
    /// The newest delta taken in.
    newest_delta: Option<UpdateId>,
    /// The frame whose patches `patches` holds.
    applied: Option<UpdateId>,
    /// The frame on display.
    current: Option<UpdateId>,
    /// Slots below this have been used.
    vertex_count: u32,
    /// Sampled vertices of the draw list, each once.
    used: Vec<u32>,
    /// Of each vertex slot, the draw list that last used it.
    used_by: Vec<u32>,
    draw_lists: u32,
    /// Steps at which all of the draw list can be evaluated that is drawn.
    span: Span,
    /// A slot that was given anew while it was on display.
    contradiction: Option<VertexSlot>,
    late: Vec<(GridIndex, PatchSlot)>,
}

#[derive(Clone, Copy, Debug)]
struct Vertex {
    instance: InstanceId,
    is_sampled: bool,
    /// Grid steps for which the ring holds samples without a gap, both ends included; `first > last` before the first.
    first: GridIndex,
    last: GridIndex,
}

impl Vertex {
    fn has_samples(&self) -> bool {
        self.first <= self.last
    }

    /// Takes in a sample. One that follows the last lengthens the run, and pushes out what the ring cannot hold; one after
    /// a gap begins another; earlier ones change none.
    fn take_sample(&mut self, grid: GridIndex) {
        if !self.has_samples() || grid > self.last.plus(1) {
            self.first = grid;
        }
        if !self.has_samples() || grid > self.last {
            self.last = grid;
        }
        self.first = self.first.max(self.last.plus(1 - SAMPLE_RING as i32));
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Patch {
    instance: InstanceId,
    kind: PatchKind,
    vertices: [VertexSlot; 5],
    double_sided: bool,
    block: Option<Block>,
}

/// The patch half of a delta.
#[derive(Debug)]
struct PatchChanges {
    frame: UpdateId,
    evicted: Vec<PatchSlot>,
    new: Vec<NewPatch>,
    placements: Vec<(PatchSlot, Option<Block>)>,
}

impl PatchChanges {
    fn records(&self) -> usize {
        1 + self.evicted.len() + self.new.len() + self.placements.len()
    }
}

/// Records for the GPU's vertex memory, in the order in which they must be written.
#[derive(Debug, Default)]
pub struct VertexWrites {
    records: Vec<VertexWriteGpu>,
    segments: VecDeque<Segment>,
    /// Records at the front that are already on their way.
    taken: usize,
    /// The last frame all of whose records are on their way.
    complete: Option<UpdateId>,
}

/// Records that do not depend on each other; a barrier lies between two segments.
#[derive(Clone, Copy, Debug)]
struct Segment {
    frame: UpdateId,
    /// Into `records`, exclusive.
    end: usize,
    ends_frame: bool,
}

/// What a draw list holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DrawList {
    /// Corners written.
    pub corners: u32,
    /// Indices of patches that can be drawn at any display time from now on.
    pub indices: u32,
    /// Patches of `indices`.
    pub patches: u32,
    /// The first grid step at which all of `indices` can be drawn.
    pub ready: GridIndex,
    /// Patches whose vertices have no samples before a grid step, in order of it: step, and indices up to the patch's
    /// end. They lie behind `indices`.
    pub late: Vec<(GridIndex, u32)>,
}

/// How a display frame stands with samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Motionless {
    /// Vertices that go on at their last velocity, for at most one grid step.
    pub held: u32,
    /// Vertices that have stopped.
    pub frozen: u32,
}

impl Default for DrawList {
    fn default() -> Self {
        Self { corners: 0, indices: 0, patches: 0, ready: GridIndex(i32::MIN), late: Vec::new() }
    }
}

impl DrawList {
    /// Indices to draw, and patches withheld, when the last grid step at or before the display time is `grid`.
    pub fn at(&self, grid: GridIndex) -> (u32, u32) {
        let ready = self.late.partition_point(|(first, _)| *first <= grid);
        let indices = self.late[..ready].last().map_or(self.indices, |(_, end)| *end);
        (indices, (self.late.len() - ready) as u32)
    }
}

impl<P> Bundler<P> {
    /// For the agreed capacities.
    pub fn new(vertex_slots: u32, patch_slots: u32) -> Self {
        let none = Vertex {
            instance: InstanceId(0),
            is_sampled: false,
            first: GridIndex(i32::MAX),
            last: GridIndex(i32::MIN),
        };
        Self {
            vertices: vec![none; vertex_slots as usize],
            step_m_of_instance: vec![0.0; MAX_INSTANCES as usize],
            patches: vec![None; patch_slots as usize],
            pending: VecDeque::new(),
            pending_records: 0,
            pictures: VecDeque::new(),
            writes: VertexWrites::default(),
            newest_delta: None,
            applied: None,
            current: None,
            vertex_count: 0,
            used: Vec::with_capacity(vertex_slots as usize),
            used_by: vec![0; vertex_slots as usize],
            draw_lists: 0,
            span: Span { first: GridIndex(i32::MIN), last: GridIndex(i32::MAX) },
            contradiction: None,
            late: Vec::with_capacity(patch_slots as usize),
        }
    }

    /// The frame on display.
    pub fn current(&self) -> Option<UpdateId> {
        self.current
    }

    /// The newest delta taken in.
    pub fn newest_delta(&self) -> Option<UpdateId> {
        self.newest_delta
    }

    /// Vertex slots from 0 on that have ever been used.
    pub fn vertex_count(&self) -> u32 {
        self.vertex_count
    }

    /// What the GPU's vertex memory has yet to be told.
    pub fn writes(&mut self) -> &mut VertexWrites {
        &mut self.writes
    }

    /// Takes in the next delta. It comes from a decoder that has checked it against the same memory; slots that do not
    /// exist are ignored all the same.
    pub fn add_delta(&mut self, delta: GeometryDelta) {
        self.newest_delta = Some(delta.frame);
        self.take_vertices(&delta);
        self.take_samples(&delta);
        self.writes.end_frame(delta.frame);
        let changes = PatchChanges {
            frame: delta.frame,
            evicted: delta.evicted_patches,
            new: delta.new_patches,
            placements: delta.placements,
        };
        self.pending_records += changes.records();
        self.pending.push_back(changes);
        while self.pending.len() > MAX_PENDING || self.pending_records > MAX_PENDING_RECORDS {
            self.apply_next();
        }
    }

    /// True where the GPU's vertex memory has yet to be told something.
    pub fn has_writes(&self) -> bool {
        !self.writes.segments.is_empty()
    }

    /// True while so much waits for the GPU's vertex memory that no more should be taken in.
    pub fn is_full(&self) -> bool {
        self.writes.waiting() > self.vertices.len() * RECORDS_PER_SLOT_AND_TURN as usize
    }

    /// Bytes that wait: for the GPU's vertex memory, and for pictures.
    pub fn waiting_bytes(&self) -> usize {
        let writes = self.writes.records.capacity() * size_of::<VertexWriteGpu>();
        writes + self.pending_records * size_of::<NewPatch>()
    }

    /// The slot that the server gave anew while it was on display, if it did: what is seen is then not what it means.
    pub fn take_contradiction(&mut self) -> Option<VertexSlot> {
        self.contradiction.take()
    }

    /// Steps at which everything that is drawn can be evaluated.
    pub fn span(&self) -> Span {
        self.span
    }

    /// True where the draw list on display uses the slot.
    fn is_on_display(&self, slot: VertexSlot) -> bool {
        self.draw_lists > 0 && self.used_by[slot.index()] == self.draw_lists
    }

    fn take_vertices(&mut self, delta: &GeometryDelta) {
        for info in &delta.instances {
            if let Some(step_m) = self.step_m_of_instance.get_mut(info.instance.index()) {
                *step_m = info.step_m;
            }
        }
        for new in &delta.new_vertices {
            if new.slot.index() < self.vertices.len() && self.is_on_display(new.slot) {
                self.contradiction.get_or_insert(new.slot);
            }
            let Some(vertex) = self.vertices.get_mut(new.slot.index()) else { continue };
            *vertex = Vertex {
                instance: new.instance,
                is_sampled: new.motion == Motion::Sampled,
                first: GridIndex(i32::MAX),
                last: GridIndex(i32::MIN),
            };
            self.vertex_count = self.vertex_count.max(new.slot.0 + 1);
            self.writes.push(match new.motion {
                Motion::Static { position } => static_entry(new.slot.0, position.to_array()),
                Motion::Sampled => sampled_entry(new.slot.0),
            });
        }
        self.writes.end_segment(delta.frame);
    }

    fn take_samples(&mut self, delta: &GeometryDelta) {
        let newest = delta.samples.iter().map(|batch| batch.grid).max().unwrap_or_default();
        // Steps that share a place in the ring with a later one of the same delta could be seen by nobody, nor could
        // the step whose tag means that there is no sample.
        let oldest = newest.plus(1 - SAMPLE_RING as i32).max(GridIndex(i32::MIN + 1));
        for batch in delta.samples.iter().filter(|batch| batch.grid >= oldest) {
            batch.values.iter().for_each(|(slot, value)| self.take_sample(*slot, batch.grid, *value));
        }
        if !delta.samples.is_empty() {
            self.span.last = self.min_last();
        }
    }

    fn take_sample(&mut self, slot: VertexSlot, grid: GridIndex, value: [i32; 3]) {
        let Some(vertex) = self.vertices.get_mut(slot.index()) else { return };
        let step_m = self.step_m_of_instance.get(vertex.instance.index()).copied().unwrap_or(0.0);
        let before = *vertex;
        vertex.take_sample(grid);
        let first = vertex.first;
        self.writes.push(sample_write(slot.0, grid, value.map(|v| v as f32 * step_m)));
        if before.has_samples() && first > before.first && self.is_on_display(slot) {
            self.span.first = self.span.first.max(first);
        }
    }

    /// Takes in a decoded picture. Gives back one that will not be shown, for reuse.
    pub fn add_picture(&mut self, frame: UpdateId, picture: P) -> Option<P> {
        if self.shown_or_past(frame) {
            return Some(picture);
        }
        let at = self.pictures.partition_point(|(known, _)| *known < frame);
        self.pictures.insert(at, (frame, picture));
        if self.pictures.len() > MAX_PICTURES {
            return self.pictures.pop_front().map(|(_, picture)| picture);
        }
        None
    }

    fn shown_or_past(&self, frame: UpdateId) -> bool {
        self.applied.is_some_and(|applied| frame <= applied)
    }

    /// Switches to the newest frame that has its picture, its delta, and its vertices in the GPU's memory. Pictures
    /// that it makes superfluous go to `drop_picture`.
    pub fn take_newest_complete(&mut self, mut drop_picture: impl FnMut(P)) -> Option<(UpdateId, P)> {
        let complete = self.writes.complete?;
        while self.pictures.front().is_some_and(|(frame, _)| self.shown_or_past(*frame)) {
            self.pictures.pop_front().into_iter().for_each(|(_, picture)| drop_picture(picture));
        }
        let count = self.pictures.partition_point(|(frame, _)| *frame <= complete);
        (1..count).filter_map(|_| self.pictures.pop_front()).for_each(|(_, picture)| drop_picture(picture));
        let (frame, picture) = self.pictures.pop_front().filter(|_| count > 0)?;
        while self.pending.front().is_some_and(|changes| changes.frame <= frame) {
            self.apply_next();
        }
        self.current = Some(frame);
        Some((frame, picture))
    }

    fn apply_next(&mut self) {
        let Some(changes) = self.pending.pop_front() else { return };
        self.pending_records -= changes.records();
        self.applied = Some(changes.frame);
        for slot in changes.evicted {
            if let Some(patch) = self.patches.get_mut(slot.index()) {
                *patch = None;
            }
        }
        for new in changes.new {
            let known = new.vertices.iter().all(|slot| slot.index() < self.vertices.len());
            if let Some(patch) = self.patches.get_mut(new.slot.index()).filter(|_| known) {
                let NewPatch { instance, kind, vertices, double_sided, .. } = new;
                *patch = Some(Patch { instance, kind, vertices, double_sided, block: None });
            }
        }
        for (slot, block) in changes.placements {
            if let Some(Some(patch)) = self.patches.get_mut(slot.index()) {
                patch.block = block;
            }
        }
    }

    /// Writes what the current frame draws: patches that can be drawn from grid step `grid` on, then the others in the
    /// order of the steps from which they can. The slices hold what all patch slots can need.
    pub fn write_draw_list(
        &mut self,
        grid: GridIndex,
        corners: &mut [CornerGpu],
        indices: &mut [u32],
        list: &mut DrawList,
    ) {
        self.draw_lists += 1;
        self.used.clear();
        self.late.clear();
        let mut writer = ListWriter { corners, indices, corner_count: 0, index_count: 0 };
        (list.patches, list.ready) = (0, GridIndex(i32::MIN));
        for slot in 0..self.patches.len() {
            let Some(patch) = self.patches[slot].filter(|patch| patch.block.is_some()) else { continue };
            let first = self.first_drawable(&patch);
            self.note_use(&patch);
            if first <= grid {
                writer.write(&patch);
                list.patches += 1;
                list.ready = list.ready.max(first);
            } else {
                self.late.push((first, PatchSlot(slot as u32)));
            }
        }
        list.indices = writer.index_count as u32;
        self.late.sort_unstable();
        list.late.clear();
        for (first, slot) in &self.late {
            if let Some(patch) = &self.patches[slot.index()] {
                writer.write(patch);
                list.late.push((*first, writer.index_count as u32));
            }
        }
        list.corners = writer.corner_count as u32;
        self.span = Span { first: list.ready, last: self.min_last() };
    }

    fn first_drawable(&self, patch: &Patch) -> GridIndex {
        let vertices =
            patch.vertices[..patch.kind.vertex_count()].iter().map(|slot| self.vertices[slot.index()]);
        let firsts = vertices.filter(|vertex| vertex.is_sampled).map(|vertex| vertex.first);
        firsts.max().unwrap_or(GridIndex(i32::MIN))
    }

    fn note_use(&mut self, patch: &Patch) {
        for slot in &patch.vertices[..patch.kind.vertex_count()] {
            let used_by = &mut self.used_by[slot.index()];
            if std::mem::replace(used_by, self.draw_lists) != self.draw_lists
                && self.vertices[slot.index()].is_sampled
            {
                self.used.push(slot.0);
            }
        }
    }

    /// The last step that all vertices of the draw list have which have any: what has none is not drawn.
    fn min_last(&self) -> GridIndex {
        let used = self.used.iter().map(|slot| self.vertices[*slot as usize]);
        let lasts = used.filter(Vertex::has_samples).map(|vertex| vertex.last);
        lasts.min().unwrap_or(GridIndex(i32::MAX))
    }

    /// Sampled vertices of the draw list that have run out of samples when the last grid step at or before the display
    /// time is `grid`.
    pub fn motionless(&self, grid: GridIndex) -> Motionless {
        let mut counts = Motionless::default();
        if grid < self.span.last {
            return counts;
        }
        for slot in &self.used {
            let vertex = self.vertices[*slot as usize];
            match grid.cmp(&vertex.last) {
                _ if !vertex.has_samples() => {} // withheld
                std::cmp::Ordering::Less => {}
                std::cmp::Ordering::Equal => counts.held += 1,
                std::cmp::Ordering::Greater => counts.frozen += 1,
            }
        }
        counts
    }
}

struct ListWriter<'a> {
    corners: &'a mut [CornerGpu],
    indices: &'a mut [u32],
    corner_count: usize,
    index_count: usize,
}

impl ListWriter<'_> {
    fn write(&mut self, patch: &Patch) {
        let Some(block) = patch.block else { return };
        let [left, top, right, bottom] = block.lookup_rect_texels();
        let base = self.corner_count as u32;
        for (uv, slot) in patch.kind.corner_uv().iter().zip(patch.vertices) {
            self.corners[self.corner_count] = CornerGpu {
                vertex_slot: slot.0,
                instance: u32::from(patch.instance.0),
                atlas_texel: [left + (right - left) * uv[0], top + (bottom - top) * uv[1]],
            };
            self.corner_count += 1;
        }
        for [a, b, c] in patch.kind.triangles() {
            self.write_triangle(base, [*a, *b, *c]);
            // Back faces are culled, so that one draw serves both kinds: what has two sides is there twice.
            if patch.double_sided {
                self.write_triangle(base, [*a, *c, *b]);
            }
        }
    }

    fn write_triangle(&mut self, base: u32, corners: [u8; 3]) {
        for corner in corners {
            self.indices[self.index_count] = base + u32::from(corner);
            self.index_count += 1;
        }
    }
}

impl VertexWrites {
    fn push(&mut self, record: VertexWriteGpu) {
        self.records.push(record);
    }

    fn end_segment(&mut self, frame: UpdateId) {
        let start = self.segments.back().map_or(self.taken, |segment| segment.end);
        if self.records.len() > start {
            self.segments.push_back(Segment { frame, end: self.records.len(), ends_frame: false });
        }
    }

    fn end_frame(&mut self, frame: UpdateId) {
        self.end_segment(frame);
        match self.segments.back_mut() {
            Some(segment) if segment.frame == frame => segment.ends_frame = true,
            // Nothing to write: complete as soon as all before it is.
            _ => self.segments.push_back(Segment { frame, end: self.records.len(), ends_frame: true }),
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
                self.complete = Some(next.frame);
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
    fn waiting(&self) -> usize {
        self.records.len() - self.taken
    }

    /// The last frame all of whose vertices have been handed on.
    pub fn complete(&self) -> Option<UpdateId> {
        self.complete
    }
}

#[cfg(test)]
#[path = "bundle_tests.rs"]
mod tests;
