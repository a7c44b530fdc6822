//! Samples on the time grid, of every vertex whose motion the client cannot evaluate itself. The bytes of deltas are made here
//! too, because samples are coded against the client's memory after each delta: an update's geometry and the samples between
//! two updates, in one order.

use crate::motion::delta::UpdateDelta;
use crate::scene::numbering::SceneVertex;
use glam::Vec3;
use shadecast_protocol::delta::{Delta, DeltaEncoder, EncodedDelta};
use shadecast_protocol::geometry::GeometryDelta;
use shadecast_protocol::ids::{UpdateId, VertexSlot};
use shadecast_protocol::limits::MAX_NEW_SAMPLE_GRIDS;
use shadecast_protocol::motion::{SampleBatch, quantise};
use shadecast_protocol::time::GridIndex;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

/// What a sample takes on the wire, about, bytes.
const SAMPLE_BYTES: usize = 2;
/// Steps of the grid for which samples are sent, whatever the budget.
const LEAST_STEPS: usize = 2;

/// Which samples may be sent now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct SampleWindow {
    /// Earliest grid point that a vertex which enters now can be displayed with.
    pub first: GridIndex,
    /// Oldest grid point that is of use after a pause.
    pub oldest: GridIndex,
    /// Last grid point to send.
    pub horizon: GridIndex,
}

/// What the client's pipeline and the thread of motion both code with.
pub(crate) type SharedCoder = Arc<Mutex<Coder>>;

/// See the module.
#[derive(Debug)]
pub struct Coder {
    /// The client's memory, and the pasts of its samples.
    encoder: DeltaEncoder,
    sampled: SampledVertices,
    last: UpdateId,
}

/// The vertices with samples in one client's memory, and how far their samples were sent.
#[derive(Debug, Default)]
struct SampledVertices {
    /// By slot: the vertex there.
    vertices: BTreeMap<VertexSlot, SceneVertex>,
    /// Vertices that have entered since samples were sent.
    fresh: Vec<VertexSlot>,
    /// Last grid point sent for every other one.
    sent_until: Option<GridIndex>,
}

impl Coder {
    /// Of an empty memory.
    pub(crate) fn new(encoder: DeltaEncoder) -> Self {
        Self { encoder, sampled: SampledVertices::default(), last: UpdateId(0) }
    }

    /// The same with another encoder of an empty memory.
    pub(crate) fn with(self, change: impl FnOnce(DeltaEncoder) -> DeltaEncoder) -> Self {
        Self { encoder: change(self.encoder), ..self }
    }

    /// The client's memory, and what it takes to code for it.
    pub fn encoder(&self) -> &DeltaEncoder {
        &self.encoder
    }

    /// Vertices with samples.
    pub(crate) fn vertex_count(&self) -> usize {
        self.sampled.vertices.len()
    }

    /// An update's geometry.
    pub(crate) fn update(&mut self, delta: &UpdateDelta) -> EncodedDelta {
        self.last = delta.geometry.update;
        delta.geometry.evicted_vertices.iter().for_each(|slot| self.sampled.leave(*slot));
        delta.sampled.iter().for_each(|(slot, vertex)| self.sampled.enter(*slot, *vertex));
        self.encoder.encode_update(&delta.geometry)
    }

    /// Bytes of the samples of one step, about.
    pub(crate) fn step_bytes(&self) -> usize {
        self.sampled.vertices.len() * SAMPLE_BYTES
    }

    /// The samples of a window that were not sent, as far as they take no more than so many bytes, about: the last ones, since
    /// after a pause the first are those of the pause.
    pub(crate) fn samples(
        &mut self,
        window: SampleWindow,
        budget_bytes: usize,
        mut position: impl FnMut(GridIndex, SceneVertex) -> Vec3,
    ) -> Vec<EncodedDelta> {
        let window = self.sampled.within(window, budget_bytes);
        let most = (self.encoder.memory().vertex_slots() * MAX_NEW_SAMPLE_GRIDS) as usize;
        let mut deltas: Vec<(usize, Vec<SampleBatch>)> = Vec::new();
        // As of the last update: steps change with updates only.
        let memory = self.encoder.memory();
        let step_m = |slot| memory.step_of(slot).expect("instances with samples are announced");
        let value = |grid, (slot, vertex)| (slot, quantise(position(grid, vertex), step_m(slot)));
        for batch in self.sampled.samples(window, value) {
            match deltas.last_mut().filter(|(count, _)| count + batch.values.len() <= most) {
                Some((count, batches)) => {
                    *count += batch.values.len();
                    batches.push(batch);
                }
                None => deltas.push((batch.values.len(), vec![batch])),
            }
        }
        let geometry = GeometryDelta { update: self.last, ..GeometryDelta::default() };
        let delta = |samples| Delta { geometry: geometry.clone(), is_update: false, samples };
        deltas.into_iter().map(|(_, samples)| self.encoder.encode(&delta(samples))).collect()
    }
}

impl SampledVertices {
    fn enter(&mut self, slot: VertexSlot, vertex: SceneVertex) {
        self.vertices.insert(slot, vertex);
        self.fresh.push(slot);
    }

    fn leave(&mut self, slot: VertexSlot) {
        if self.vertices.remove(&slot).is_some() {
            self.fresh.retain(|fresh| *fresh != slot);
        }
    }

    fn within(&self, window: SampleWindow, budget_bytes: usize) -> SampleWindow {
        let step_bytes = (self.vertices.len() * SAMPLE_BYTES).max(1);
        let most = (window.horizon.0 - window.oldest.0).max(0) as usize + 1;
        let steps = (budget_bytes / step_bytes).max(LEAST_STEPS).min(most);
        let first_that_fits = window.horizon.plus(1 - steps as i32);
        SampleWindow { oldest: window.oldest.max(first_that_fits), ..window }
    }

    /// Vertices that have entered get every grid point from the earliest that can be displayed, all get the new ones.
    fn samples(
        &mut self,
        window: SampleWindow,
        mut value: impl FnMut(GridIndex, (VertexSlot, SceneVertex)) -> (VertexSlot, [i32; 3]),
    ) -> Vec<SampleBatch> {
        let first = window.first.max(window.oldest);
        let first_new = self.sent_until.map_or(window.first, |g| g.plus(1)).max(window.oldest);
        let mut fresh = std::mem::take(&mut self.fresh);
        fresh.sort_unstable();
        let mut batch = |grid, vertices: &mut dyn Iterator<Item = (VertexSlot, SceneVertex)>| SampleBatch {
            grid,
            values: vertices.map(|vertex| value(grid, vertex)).collect(),
        };
        let mut batches = Vec::new();
        // Those that were there may be ahead of the horizon, which comes nearer when the way gets shorter.
        for grid in (first.0..first_new.0).map(GridIndex) {
            batches.push(batch(grid, &mut fresh.iter().map(|slot| (*slot, self.vertices[slot]))));
        }
        for grid in (first_new.0..=window.horizon.0).map(GridIndex) {
            batches.push(batch(grid, &mut self.vertices.iter().map(|(slot, vertex)| (*slot, *vertex))));
        }
        batches.retain(|batch| !batch.values.is_empty());
        self.sent_until = Some(self.sent_until.map_or(window.horizon, |g| g.max(window.horizon)));
        batches
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The steps that a vertex is sent in a window.
    fn steps(sampled: &mut SampledVertices, first: i32, horizon: i32, slot: u32) -> Vec<i32> {
        let window =
            SampleWindow { first: GridIndex(first), oldest: GridIndex(-9), horizon: GridIndex(horizon) };
        let batches = sampled.samples(window, |_, (slot, _)| (slot, [0; 3]));
        let has = |batch: &&SampleBatch| batch.values.iter().any(|(of, _)| of.0 == slot);
        batches.iter().filter(has).map(|batch| batch.grid.0).collect()
    }

    #[test]
    fn a_vertex_entering_late_gets_every_step_of_the_others() {
        let mut sampled = SampledVertices::default();
        sampled.enter(VertexSlot(0), SceneVertex(0));
        assert_eq!(steps(&mut sampled, 0, 8, 0), (0..=8).collect::<Vec<_>>());
        sampled.enter(VertexSlot(1), SceneVertex(1));
        assert_eq!(steps(&mut sampled, 1, 5, 1), (1..=8).collect::<Vec<_>>());
        assert_eq!(steps(&mut sampled, 2, 9, 1), [9]);
    }
}
