//! Motion of vertices on the client: arrived samples ([`arrivals`]), the times that can be evaluated and the displayed one
//! ([`pace`]); skeletons, clips and their players (`received`, [`arena`], [`skinned`]).
//!
//! Motion messages enter, by world time and slot. Writes for the GPU's memory leave, and the time at which all of it is
//! complete. Nothing here knows pictures, GPUs and networks.
//!
//! A message applies from its arrival, whatever bundle is on display: the server never reuses a slot that the bundle on display
//! still needs.

pub mod arena;
pub mod arrivals;
mod early;
pub mod pace;
pub mod skinned;
pub mod state;
mod received;

use arena::ArenaWrites;
use arrivals::VertexWrites;
use pace::Span;
use shadecast_protocol::geometry::{self, NewVertex};
use shadecast_protocol::ids::{InstanceId, UpdateId, VertexSlot};
use shadecast_protocol::limits::RECORDS_PER_SLOT_AND_TURN;
use shadecast_protocol::motion::PositionBatch;
use shadecast_protocol::motion::predicted::PredictedVertex;
use shadecast_protocol::time::{GridIndex, WorldTime};
use shadecast_shaders::records::{
    Rest, RestId, predicted_entry, prediction_write, rest_writes, sample_write, sampled_entry, skinned_entry,
    static_entry,
};
use skinned::{Drawn, DrawnInstances, SkinCapacity, Skinned, SkinnedChange};
use state::{MotionState, Tally};

/// See the module.
#[derive(Debug)]
pub struct Motion {
    /// By vertex slot.
    vertices: Vec<Availability>,
    /// Steps of the time grid that are kept of each.
    sample_ring: u32,
    /// Slots below this have been used.
    vertex_count: u32,
    writes: VertexWrites,
    arena: ArenaWrites,
    skinned: Skinned,
    /// What has changed in `skinned` since it was last handed on.
    changes: Vec<SkinnedChange>,
    received: received::ReceivedMotion,
    early: early::EarlyPoses,
    /// Skinned instances of the draw list.
    drawn: DrawnInstances,
    /// Vertices with samples of the draw list, each once.
    used: Vec<u32>,
    /// The same with predictions.
    predicted: Vec<u32>,
    /// Of each vertex slot, how the draw list uses it.
    uses: Vec<Use>,
    /// The first step at which the list can be evaluated, where samples of a vertex of it have had a gap.
    first: GridIndex,
    /// How far samples and predictions of the list reach, unless that is out of date.
    ends: Option<(Tally<GridIndex>, Tally<WorldTime>)>,
    /// A slot that was given anew while it was on display.
    contradiction: Option<VertexSlot>,
}

/// What moves a vertex, and which samples of it are there.
#[derive(Clone, Copy, Debug)]
struct Availability {
    moved_by: Mover,
    /// Grid steps for which the ring holds samples without a gap, both ends included; `first > last` before the first.
    first: GridIndex,
    last: GridIndex,
}

/// What moves a vertex.
#[derive(Clone, Copy, Debug)]
enum Mover {
    Nothing,
    Samples,
    /// The skeleton of an instance.
    Skeleton(InstanceId),
    /// What updates predict: until then.
    Predictions(WorldTime),
}

/// How the draw list uses a vertex.
#[derive(Clone, Copy, Debug, Default)]
struct Use {
    /// Patches that have it.
    patches: u32,
    counted: Counted,
}

/// Where a vertex of the draw list is counted.
#[derive(Clone, Copy, Debug, Default)]
enum Counted {
    #[default]
    Nowhere,
    /// In the list of those with samples: its place.
    Samples(u32),
    /// The same with predictions.
    Predictions(u32),
    /// Among those of its instance.
    Instance(InstanceId),
}

/// Notes which vertices the draw list uses.
pub struct Users<'a>(&'a mut Motion);

impl Availability {
    /// Of a vertex that has just entered.
    fn none(moved_by: Mover) -> Self {
        Self { moved_by, first: GridIndex(i32::MAX), last: GridIndex(i32::MIN) }
    }

    fn has_samples(&self) -> bool {
        self.first <= self.last
    }

    /// Takes in a sample. One that follows the last lengthens the run, and pushes out what a ring of so many steps cannot
    /// hold; one after a gap begins another; earlier ones change none.
    fn take_sample(&mut self, grid: GridIndex, sample_ring: u32) {
        if !self.has_samples() || grid > self.last.plus(1) {
            self.first = grid;
        }
        if !self.has_samples() || grid > self.last {
            self.last = grid;
        }
        self.first = self.first.max(self.last.plus(1 - sample_ring as i32));
    }
}

impl Motion {
    /// For the agreed capacities.
    pub fn new(vertex_slots: u32, capacity: SkinCapacity) -> Self {
        Self {
            vertices: vec![Availability::none(Mover::Nothing); vertex_slots as usize],
            sample_ring: capacity.sample_ring,
            vertex_count: 0,
            writes: VertexWrites::default(),
            arena: ArenaWrites::new(capacity.arena_words),
            skinned: Skinned::default(),
            changes: Vec::new(),
            received: received::ReceivedMotion::default(),
            early: early::EarlyPoses::new(capacity.sample_ring),
            drawn: DrawnInstances::default(),
            used: Vec::with_capacity(vertex_slots as usize),
            predicted: Vec::with_capacity(vertex_slots as usize),
            uses: vec![Use::default(); vertex_slots as usize],
            first: GridIndex(i32::MIN),
            ends: None,
            contradiction: None,
        }
    }

    /// What the GPU's vertex memory has not received yet.
    pub fn writes(&mut self) -> &mut VertexWrites {
        &mut self.writes
    }

    /// What the arena has not received yet.
    pub fn arena(&mut self) -> &mut ArenaWrites {
        &mut self.arena
    }

    /// Skeletons, clips, and the instances that they move.
    pub fn skinned(&mut self) -> &mut Skinned {
        &mut self.skinned
    }

    /// The skinned instances of the draw list.
    pub fn drawn(&self) -> &[Drawn] {
        self.drawn.all()
    }

    /// True where something has yet to be handed on.
    pub fn has_news(&self) -> bool {
        !self.writes.is_empty() || !self.arena.is_empty() || !self.changes.is_empty()
    }

    /// What has changed in the tables of [`Self::skinned`] goes behind `changes`.
    pub fn take_changes(&mut self, changes: &mut Vec<SkinnedChange>) {
        changes.append(&mut self.changes);
    }

    /// Changes the tables of [`Self::skinned`], here and in those that follow them.
    fn change(&mut self, change: SkinnedChange) {
        self.changes.push(change.clone());
        self.skinned.apply(change);
    }

    /// True while so much waits for the GPU's memory that no more should be taken in.
    pub fn is_full(&self) -> bool {
        let is_full = self.writes.waiting() > self.vertices.len() * RECORDS_PER_SLOT_AND_TURN as usize;
        is_full || self.arena.is_full()
    }

    /// Bytes that wait for the GPU's memory.
    pub fn waiting_bytes(&self) -> usize {
        self.writes.capacity_bytes() + self.arena.waiting_bytes()
    }

    /// The slot that the server gave anew while it was on display, if it did: what is seen is then not what it means.
    pub fn take_contradiction(&mut self) -> Option<VertexSlot> {
        self.contradiction.take()
    }

    /// Takes in what the next update says of vertices and their samples. It comes from a decoder that has checked it against
    /// the client's memory.
    pub fn take(
        &mut self,
        update: UpdateId,
        entering: &[NewVertex],
        positions: Vec<PositionBatch>,
        is_update: bool,
    ) {
        entering.iter().for_each(|vertex| self.enter(vertex));
        self.writes.end_segment(update);
        self.take_positions(positions);
        match is_update {
            true => self.writes.end_frame(update),
            false => self.writes.end_segment(update),
        }
    }

    /// A rest for skinned vertices. Belongs to the update that is taken next.
    pub fn write_rest(&mut self, number: RestId, rest: &Rest) {
        rest_writes(number, rest).into_iter().for_each(|half| self.writes.push(half));
    }

    /// A vertex enters that an instance's skeleton moves; `None`: the instance is not known. Belongs to the update that is
    /// taken next.
    pub fn enter_skinned(&mut self, slot: VertexSlot, instance: InstanceId, rest: RestId) -> Option<()> {
        let palette_base = self.skinned.palette_base(instance)?;
        self.occupy(slot, Availability::none(Mover::Skeleton(instance)));
        self.writes.push(skinned_entry(slot.0, rest, palette_base));
        Some(())
    }

    /// What the slot held is forgotten.
    fn occupy(&mut self, slot: VertexSlot, vertex: Availability) {
        if self.is_on_display(slot) {
            self.contradiction.get_or_insert(slot);
        }
        self.vertices[slot.index()] = vertex;
        self.vertex_count = self.vertex_count.max(slot.0 + 1);
    }

    fn enter(&mut self, vertex: &NewVertex) {
        let NewVertex { slot, instance, motion, .. } = *vertex;
        match motion {
            geometry::Motion::Static { position } => {
                self.occupy(slot, Availability::none(Mover::Nothing));
                self.writes.push(static_entry(slot.0, position.to_array()));
            }
            geometry::Motion::Sampled => {
                self.occupy(slot, Availability::none(Mover::Samples));
                self.writes.push(sampled_entry(slot.0));
            }
            geometry::Motion::Predicted => {
                // Until an update has said something it is not drawn.
                self.occupy(slot, Availability::none(Mover::Predictions(WorldTime(i64::MAX))));
                self.writes.push(predicted_entry(slot.0));
            }
            geometry::Motion::Skinned { rest } => {
                // The memory that both sides keep knows the instance.
                let entered = self.enter_skinned(slot, instance, RestId(rest.0));
                debug_assert!(entered.is_some(), "{instance:?} is not known");
            }
        }
    }

    /// Takes in what an update predicts, after [`Self::take`] has taken in which vertices enter with it.
    fn predict(&mut self, update: UpdateId, time: WorldTime, vertices: &[PredictedVertex]) {
        for PredictedVertex { slot, predictions } in vertices {
            for (number, prediction) in (0..).zip(predictions) {
                let at = prediction.time(time);
                self.writes.push(prediction_write(slot.0, number, at, prediction.position_m.to_array()));
            }
            let until = predictions.iter().map(|prediction| prediction.time(time)).max();
            self.vertices[slot.index()].moved_by = Mover::Predictions(until.unwrap_or(time));
        }
        self.writes.end_frame(update);
        self.ends = None;
    }

    /// Each batch is gone once it was taken in: of large ones not all are held twice.
    fn take_positions(&mut self, batches: Vec<PositionBatch>) {
        let is_empty = batches.is_empty();
        let newest = batches.iter().map(|batch| batch.grid).max().unwrap_or_default();
        // Steps that share a place in the ring with a later one of the same delta could be seen by nobody, nor could
        // the step whose tag means that there is no sample.
        let oldest = newest.plus(1 - self.sample_ring as i32).max(GridIndex(i32::MIN + 1));
        self.writes.reserve(batches.iter().map(|batch| batch.positions.len()).sum());
        for batch in batches.into_iter().filter(|batch| batch.grid >= oldest) {
            for (slot, position) in batch.positions {
                self.take_position(slot, batch.grid, position.to_array());
            }
        }
        if !is_empty {
            self.ends = None;
        }
    }

    fn take_position(&mut self, slot: VertexSlot, grid: GridIndex, position_m: [f32; 3]) {
        let vertex = &mut self.vertices[slot.index()];
        let before = *vertex;
        vertex.take_sample(grid, self.sample_ring);
        let first = vertex.first;
        self.writes.push(sample_write(slot.0, grid, position_m));
        if before.has_samples() && first > before.first && self.is_on_display(slot) {
            self.first = self.first.max(first);
        }
    }

    /// True where the draw list on display uses the slot.
    fn is_on_display(&self, slot: VertexSlot) -> bool {
        self.uses[slot.index()].patches > 0
    }

    /// The first step at which all of these vertices can be evaluated.
    pub fn ready(&self, vertices: &[VertexSlot]) -> GridIndex {
        let all = vertices.iter().map(|slot| self.vertices[slot.index()]);
        let sampled = all.filter(|vertex| matches!(vertex.moved_by, Mover::Samples));
        sampled.map(|vertex| vertex.first).max().unwrap_or(GridIndex(i32::MIN))
    }

    /// The draw list changes.
    pub fn users(&mut self) -> Users<'_> {
        Users(self)
    }

    /// How the draw list stands, with what has been handed on.
    pub fn state(&mut self) -> MotionState {
        let (lasts, untils) = self.ends.take().unwrap_or_else(|| self.count_ends());
        let state = MotionState {
            vertex_count: self.vertex_count,
            written: self.arena.written(),
            arena_waiting_bytes: self.arena.waiting_bytes() as u64,
            span: Span { first: self.first, last: lasts.least().unwrap_or(GridIndex(i32::MAX)) },
            lasts: lasts.clone(),
            untils: untils.clone(),
        };
        self.ends = Some((lasts, untils));
        state
    }

    /// How far the samples and predictions of its vertices reach. What has none yet is not drawn.
    fn count_ends(&self) -> (Tally<GridIndex>, Tally<WorldTime>) {
        let (mut lasts, mut untils) = (Tally::default(), Tally::default());
        let used = self.used.iter().map(|slot| self.vertices[*slot as usize]);
        used.filter(Availability::has_samples).for_each(|vertex| lasts.count(vertex.last));
        for slot in &self.predicted {
            if let Mover::Predictions(until) = self.vertices[*slot as usize].moved_by {
                untils.count(until);
            }
        }
        (lasts, untils)
    }
}

impl Users<'_> {
    /// A patch with these vertices is on the list. Gives the first step at which all of them can be evaluated.
    pub fn add(&mut self, vertices: &[VertexSlot]) -> GridIndex {
        for slot in vertices {
            let motion = &mut *self.0;
            let of = &mut motion.uses[slot.index()];
            of.patches += 1;
            if of.patches > 1 {
                continue;
            }
            of.counted = match motion.vertices[slot.index()].moved_by {
                Mover::Nothing => Counted::Nowhere,
                Mover::Skeleton(instance) => {
                    motion.drawn.add_vertex(instance);
                    Counted::Instance(instance)
                }
                Mover::Predictions(_) => Counted::Predictions(place_last(&mut motion.predicted, *slot)),
                Mover::Samples => Counted::Samples(place_last(&mut motion.used, *slot)),
            };
        }
        self.ready(vertices)
    }

    /// A patch with these vertices, which was on the list, is not any more.
    pub fn remove(&mut self, vertices: &[VertexSlot]) {
        let Motion { uses, used, predicted, drawn, .. } = &mut *self.0;
        for slot in vertices {
            let of = &mut uses[slot.index()];
            of.patches -= 1;
            if of.patches > 0 {
                continue;
            }
            let (list, place) = match std::mem::take(&mut of.counted) {
                Counted::Nowhere => continue,
                Counted::Instance(instance) => {
                    drawn.remove_vertex(instance);
                    continue;
                }
                Counted::Samples(place) => (&mut *used, place),
                Counted::Predictions(place) => (&mut *predicted, place),
            };
            list.swap_remove(place as usize);
            // The last has its place now.
            if let Some(moved) = list.get(place as usize)
                && let Counted::Samples(at) | Counted::Predictions(at) = &mut uses[*moved as usize].counted
            {
                *at = place;
            }
        }
    }

    /// As [`Motion::ready`].
    pub fn ready(&self, vertices: &[VertexSlot]) -> GridIndex {
        self.0.ready(vertices)
    }

    /// The list is complete.
    pub fn end(self) {
        (self.0.first, self.0.ends) = (GridIndex(i32::MIN), None);
    }
}

fn place_last(list: &mut Vec<u32>, slot: VertexSlot) -> u32 {
    list.push(slot.0);
    list.len() as u32 - 1
}

#[cfg(test)]
mod tests;
