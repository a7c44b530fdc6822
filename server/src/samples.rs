//! The window of grid samples: which grid points are computed, and their positions where the CPU can read them.

use crate::animation::gpu::Animation;
use crate::predict::PredictedViews;
use crate::residency::{Geometry, InstanceRange};
use crate::scene_gpu::SceneGpu;
use glam::Vec3;
use shadecast_gpu::{Access, Buffer, Gpu, GpuError, Memory, Recorder};
use shadecast_protocol::time::{Grid, GridIndex};
use shadecast_scene::patches::Patch;
use std::sync::Arc;

/// Grid points kept on the server: as many as on the client.
pub const RING: u32 = shadecast_protocol::limits::SAMPLE_RING;

/// Samples `oldest..=newest`, each in the slot of its number modulo [`RING`].
pub struct SampleWindow {
    scene: Arc<SceneGpu>,
    /// A mirror of the animation's saved vertices.
    mirror: Buffer,
    /// By scene-wide vertex number: its place among the static or the animated saved vertices, and which of them.
    places: Vec<(u32, bool)>,
    oldest: GridIndex,
    newest: Option<GridIndex>,
}

impl SampleWindow {
    /// An empty window.
    pub fn new(gpu: &Arc<Gpu>, scene: &Arc<SceneGpu>, animation: &Animation) -> Result<Self, GpuError> {
        let mirror =
            Buffer::new(gpu, "positions for the CPU", animation.saved_vertices().size(), Memory::Readback)?;
        let mut places = Vec::with_capacity(scene.totals.vertices as usize);
        for instance in &scene.instances {
            let count = scene.models[instance.model].vertex_count;
            places.extend((0..count).map(|v| (instance.saved_base + v, instance.is_animated)));
        }
        Ok(Self { scene: scene.clone(), mirror, places, oldest: GridIndex(0), newest: None })
    }

    /// The slot of a grid point.
    pub fn slot(g: GridIndex) -> u32 {
        g.0.rem_euclid(RING as i32) as u32
    }

    /// Oldest grid point that is computed and not overwritten.
    pub fn oldest(&self) -> GridIndex {
        self.oldest
    }

    /// Records the samples that `views` need and the window lacks. A server that fell behind skips the grid points that
    /// nobody can display any more.
    pub fn record(
        &mut self,
        recorder: &mut Recorder,
        animation: &mut Animation,
        grid: Grid,
        views: &PredictedViews,
    ) {
        let earliest = views.horizon.plus(1 - RING as i32).max(views.first_sample.min(views.times[0]));
        let first = self.newest.map_or(views.first_sample, |g| g.plus(1)).max(earliest);
        let is_first = self.newest.is_none();
        if is_first || self.newest.is_some_and(|newest| newest < first.plus(-1)) {
            self.oldest = first;
        }
        for g in (first.0..=views.horizon.0).map(GridIndex) {
            animation.record_sample(recorder, Self::slot(g), grid.time_of(g));
        }
        recorder.barrier(Access::COMPUTE_WRITE, Access::COPY_READ);
        if is_first {
            let statics = u64::from(self.scene.totals.static_vertices) * 16;
            recorder.copy_buffer(animation.saved_vertices(), 0, &self.mirror, 0, statics);
        }
        for g in (first.0..=views.horizon.0).map(GridIndex) {
            let run = u64::from(self.scene.totals.animated_vertices) * 16;
            let at = u64::from(self.scene.totals.static_vertices) * 16 + u64::from(Self::slot(g)) * run;
            recorder.copy_buffer(animation.saved_vertices(), at, &self.mirror, at, run);
        }
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
        self.newest = self.newest.max(Some(views.horizon));
        self.oldest = self.oldest.max(views.horizon.plus(1 - RING as i32));
    }

    fn saved(&self, index: u32) -> Vec3 {
        let [x, y, z, _] = self.mirror.values::<[f32; 4]>()[index as usize];
        Vec3::new(x, y, z)
    }
}

impl Geometry for SampleWindow {
    fn instance_of_patch(&self, patch: u32) -> u16 {
        self.scene.instance_of_patch(patch) as u16
    }

    fn instance(&self, instance: u16) -> InstanceRange {
        let place = &self.scene.instances[usize::from(instance)];
        InstanceRange { first_patch: place.first_patch, first_vertex: place.first_vertex }
    }

    fn patch(&self, patch: u32) -> Patch {
        let place = &self.scene.instances[self.scene.instance_of_patch(patch)];
        self.scene.models[place.model].patches[(patch - place.first_patch) as usize]
    }

    fn static_position(&self, vertex: u32) -> Option<Vec3> {
        match self.places[vertex as usize] {
            (_, true) => None,
            (place, false) => Some(self.saved(place)),
        }
    }

    fn sample(&self, grid: GridIndex, vertex: u32) -> Vec3 {
        debug_assert!(grid >= self.oldest && Some(grid) <= self.newest, "{grid:?} is not in the window");
        let totals = self.scene.totals;
        let (place, _) = self.places[vertex as usize];
        self.saved(totals.static_vertices + Self::slot(grid) * totals.animated_vertices + place)
    }

    fn vertex_count(&self) -> usize {
        self.places.len()
    }

    fn patch_count(&self) -> usize {
        self.scene.totals.patches as usize
    }
}
