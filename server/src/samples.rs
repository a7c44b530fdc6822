//! The window of grid samples: which grid points are computed, and their positions where the CPU can read them.

use crate::animation::RingPlace;
use crate::animation::gpu::{Animation, SampleJob};
use crate::culling::Needed;
use crate::geometry::Geometry;
use crate::predict::PredictedViews;
use crate::scene::SceneGpu;
use crate::scene::numbering::{ScenePatch, SceneVertex};
use glam::Vec3;
use shadecast_gpu::{Access, Buffer, Gpu, GpuError, Memory, Recorder};
use shadecast_protocol::time::{Grid, GridIndex};
use shadecast_scene::patches::Patch;
use std::sync::Arc;

/// Grid points kept on the server: as many as on the client.
pub const RING: u32 = shadecast_protocol::limits::SAMPLE_RING;

/// Samples `oldest..=newest`, each in the ring at its number modulo [`RING`].
pub struct SampleWindow {
    scene: Arc<SceneGpu>,
    /// A mirror of the animation's saved vertices.
    mirror: Buffer,
    /// By scene-wide vertex number: its index among the static or the animated saved vertices, and which of them.
    saved_indices: Vec<(u32, bool)>,
    /// By instance: which grid point each place of the ring holds.
    held: Vec<[Option<GridIndex>; RING as usize]>,
    jobs: Vec<SampleJob>,
    is_first: bool,
}

impl SampleWindow {
    /// An empty window.
    pub fn new(gpu: &Arc<Gpu>, scene: &Arc<SceneGpu>, animation: &Animation) -> Result<Self, GpuError> {
        let mirror =
            Buffer::new(gpu, "positions for the CPU", animation.saved_vertices().size(), Memory::Readback)?;
        let mut saved_indices = Vec::with_capacity(scene.numbering.totals.vertices as usize);
        for instance in &scene.numbering.instances {
            let count = scene.models[instance.model].vertex_count;
            saved_indices.extend((0..count).map(|v| (instance.saved_base + v, instance.is_animated)));
        }
        Ok(Self {
            held: vec![[None; RING as usize]; scene.numbering.instances.len()],
            jobs: Vec::new(),
            scene: scene.clone(),
            mirror,
            saved_indices,
            is_first: true,
        })
    }

    /// Where in the ring a grid point is.
    pub fn ring_place(g: GridIndex) -> RingPlace {
        RingPlace(g.0.rem_euclid(RING as i32) as u32)
    }

    /// Nothing that was computed is believed any more.
    pub fn forget(&mut self) {
        self.held.iter_mut().for_each(|of_instance| of_instance.fill(None));
        self.is_first = true;
    }

    /// Records the samples that `views` need of the instances in `needed` and the window lacks: of an instance that was
    /// needed before, the newest; of one that comes into view, all of the window. Gives the oldest grid point that is there.
    pub fn record(
        &mut self,
        recorder: &mut Recorder,
        animation: &mut Animation,
        grid: Grid,
        views: &PredictedViews,
        needed: &Needed,
    ) -> GridIndex {
        // A server that fell behind skips the grid points that nobody can display any more.
        let earliest = views.horizon.plus(1 - RING as i32).max(views.first_sample.min(views.times[0]));
        self.list_jobs(earliest, views.horizon, grid, needed);
        let statics = SampleJob {
            instance: 0,
            place: Self::ring_place(views.horizon),
            time: grid.time_of(views.horizon),
        };
        animation.record(recorder, &self.jobs, statics);
        recorder.barrier(Access::COMPUTE_WRITE, Access::COPY_READ);
        if std::mem::take(&mut self.is_first) {
            let statics = u64::from(self.scene.numbering.totals.static_vertices) * 16;
            recorder.copy_buffer(animation.saved_vertices(), 0, &self.mirror, 0, statics);
        }
        self.copy_back(recorder, animation);
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
        earliest
    }

    fn list_jobs(&mut self, earliest: GridIndex, horizon: GridIndex, grid: Grid, needed: &Needed) {
        self.jobs.clear();
        for g in (earliest.0..=horizon.0).map(GridIndex) {
            let ring_place = Self::ring_place(g);
            for (instance, place) in self.scene.numbering.instances.iter().enumerate() {
                let held = &mut self.held[instance][ring_place.index()];
                if place.is_animated && needed.has(instance) && *held != Some(g) {
                    *held = Some(g);
                    self.jobs.push(SampleJob { instance, place: ring_place, time: grid.time_of(g) });
                }
            }
        }
    }

    /// Copies what was skinned; neighbours in the buffer at once.
    fn copy_back(&self, recorder: &mut Recorder, animation: &Animation) {
        let mut run = 0..0;
        let mut copy = |run: &std::ops::Range<u64>| {
            let size = run.end - run.start;
            if size == 0 {
                return;
            }
            recorder.copy_buffer(animation.saved_vertices(), run.start, &self.mirror, run.start, size);
        };
        for job in &self.jobs {
            let place = &self.scene.numbering.instances[job.instance];
            let first = u64::from(animation.position_base(place, job.place)) * 16;
            let size = u64::from(self.scene.models[place.model].vertex_count) * 16;
            if first != run.end {
                copy(&run);
                run = first..first;
            }
            run.end += size;
        }
        copy(&run);
    }

    fn saved(&self, index: u32) -> Vec3 {
        let [x, y, z, _] = self.mirror.values::<[f32; 4]>()[index as usize];
        Vec3::new(x, y, z)
    }
}

impl Geometry for SampleWindow {
    fn instance_of_patch(&self, patch: ScenePatch) -> u16 {
        self.scene.numbering.instance_of_patch(patch) as u16
    }

    fn first_vertex(&self, instance: u16) -> SceneVertex {
        self.scene.numbering.instances[usize::from(instance)].first_vertex
    }

    fn patch(&self, patch: ScenePatch) -> Patch {
        self.scene.patch(patch)
    }

    fn static_position(&self, vertex: SceneVertex) -> Option<Vec3> {
        match self.saved_indices[vertex.index()] {
            (_, true) => None,
            (index, false) => Some(self.saved(index)),
        }
    }

    fn sample(&self, grid: GridIndex, vertex: SceneVertex) -> Vec3 {
        debug_assert_eq!(
            self.held[self.scene.numbering.instance_of_vertex(vertex)][Self::ring_place(grid).index()],
            Some(grid),
            "{vertex:?} is not skinned at this time"
        );
        let totals = self.scene.numbering.totals;
        let (index, _) = self.saved_indices[vertex.index()];
        self.saved(totals.static_vertices + Self::ring_place(grid).0 * totals.animated_vertices + index)
    }

    fn vertex_count(&self) -> usize {
        self.saved_indices.len()
    }

    fn patch_count(&self) -> usize {
        self.scene.numbering.totals.patches as usize
    }
}
