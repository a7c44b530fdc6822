//! What a client is sent of how its vertices move: samples on the time grid, for every animated vertex in its memory.

use crate::geometry::{Geometry, UpdateWindow};
use crate::scene::numbering::SceneVertex;
use shadecast_protocol::ids::VertexSlot;
use shadecast_protocol::motion::{SampleBatch, quantise};
use shadecast_protocol::time::GridIndex;
use std::collections::BTreeMap;

/// Quantisation step of vertex samples: a quarter pixel at 1 m for a 500-pixel view of 90 degrees, an eighth at 2 m.
pub const STEP_M: f32 = 0.0005;
/// What a sample takes on the wire, about, bytes.
const SAMPLE_BYTES: usize = 2;
/// Steps of the grid for which samples are sent, whatever the budget.
const LEAST_STEPS: usize = 2;

/// The animated vertices in one client's memory, and how far their samples were sent.
#[derive(Debug, Default)]
pub struct SampledMotion {
    /// By slot: the vertex there.
    vertices: BTreeMap<VertexSlot, SceneVertex>,
    /// Vertices that enter with the update in the making.
    fresh: Vec<VertexSlot>,
    /// Last grid point sent for every one of them.
    sent_until: Option<GridIndex>,
}

impl SampledMotion {
    /// An animated vertex enters the client's memory.
    pub fn enter(&mut self, slot: VertexSlot, vertex: SceneVertex) {
        self.vertices.insert(slot, vertex);
        self.fresh.push(slot);
    }

    /// A vertex leaves; nothing happens where it is none with samples.
    pub fn leave(&mut self, slot: VertexSlot) {
        self.vertices.remove(&slot);
    }

    /// All of them: slot and scene-wide number, ascending by slot.
    pub fn vertices(&self) -> impl ExactSizeIterator<Item = (VertexSlot, SceneVertex)> + '_ {
        self.vertices.iter().map(|(slot, vertex)| (*slot, *vertex))
    }

    /// About how many bytes a vertex takes that enters with an update.
    pub fn entry_bytes(window: UpdateWindow) -> usize {
        let first = window.first_sample.max(window.oldest);
        (window.horizon.0 - first.0 + 1).max(0) as usize * SAMPLE_BYTES
    }

    /// The window without the first steps of a pause, where samples may take only so many bytes.
    pub fn within(&self, window: UpdateWindow, budget_bytes: usize) -> UpdateWindow {
        let step_bytes = (self.vertices.len() * SAMPLE_BYTES).max(1);
        let most = (window.horizon.0 - window.oldest.0).max(0) as usize + 1;
        let steps = (budget_bytes / step_bytes).max(LEAST_STEPS).min(most);
        let first_that_fits = window.horizon.plus(1 - steps as i32);
        UpdateWindow { oldest: window.oldest.max(first_that_fits), ..window }
    }

    /// What an update sends: vertices that enter get every grid point from the earliest that can be displayed, all get the
    /// new ones.
    pub fn samples(&mut self, geometry: &impl Geometry, window: UpdateWindow) -> Vec<SampleBatch> {
        let first_sample = window.first_sample.max(window.oldest);
        let first_new = self.sent_until.map_or(window.first_sample, |g| g.plus(1)).max(window.oldest);
        let mut fresh = std::mem::take(&mut self.fresh);
        fresh.sort_unstable();
        let mut batches = Vec::new();
        for grid in (first_sample.0..first_new.0).map(GridIndex) {
            batches.push(batch(geometry, grid, fresh.iter().map(|slot| (*slot, self.vertices[slot]))));
        }
        for grid in (first_new.0..=window.horizon.0).map(GridIndex) {
            batches.push(batch(geometry, grid, self.vertices()));
        }
        batches.retain(|batch| !batch.values.is_empty());
        self.sent_until = Some(self.sent_until.map_or(window.horizon, |g| g.max(window.horizon)));
        batches
    }
}

fn batch(
    geometry: &impl Geometry,
    grid: GridIndex,
    vertices: impl Iterator<Item = (VertexSlot, SceneVertex)>,
) -> SampleBatch {
    let value = |vertex| quantise(geometry.sample(grid, vertex), STEP_M);
    SampleBatch { grid, values: vertices.map(|(slot, vertex)| (slot, value(vertex))).collect() }
}
