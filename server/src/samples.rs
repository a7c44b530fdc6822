//! Which grid points are computed on the GPU, for what is drawn here; and the scene as residency sees it.

use crate::animation::RING;
use crate::animation::gpu::{Animation, SampleJob};
use crate::animation::posing::CpuPose;
use crate::animation::timeline::Timeline;
use crate::culling::Needed;
use crate::geometry::Geometry;
use crate::predict::PredictedViews;
use crate::scene::SceneGpu;
use crate::scene::numbering::{ScenePatch, SceneVertex};
use crate::view_time::ViewTime;
use glam::Vec3;
use shadecast_gpu::Recorder;
use shadecast_protocol::time::{Grid, ServerTime};
use shadecast_scene::patches::Patch;
use std::sync::Arc;

/// Samples on the GPU, each at its time's place of the ring.
pub struct SampleWindow {
    scene: Arc<SceneGpu>,
    /// Positions of the vertices of instances that do not move, metres, one after the other.
    statics: Vec<Vec3>,
    /// By instance: which time each place of the ring holds.
    held: Vec<[Option<ViewTime>; RING as usize]>,
    jobs: Vec<SampleJob>,
}

impl SampleWindow {
    /// An empty window.
    pub fn new(scene: &Arc<SceneGpu>) -> Self {
        Self {
            held: vec![[None; RING as usize]; scene.numbering.instances.len()],
            jobs: Vec::new(),
            statics: static_positions(scene),
            scene: scene.clone(),
        }
    }

    /// Nothing that was computed is believed any more.
    pub fn forget(&mut self) {
        self.held.iter_mut().for_each(|of_instance| of_instance.fill(None));
    }

    /// Records the samples at the times of `views` that the instances in `needed` lack.
    pub fn record(
        &mut self,
        recorder: &mut Recorder,
        animation: &mut Animation,
        grid: Grid,
        views: &PredictedViews,
        needed: &Needed,
    ) {
        self.list_jobs(&views.times, grid, needed);
        let statics =
            SampleJob { instance: 0, place: views.times[0].place(), time: views.times[0].time(grid) };
        animation.record(recorder, &self.jobs, statics);
    }

    fn list_jobs(&mut self, times: &[ViewTime], grid: Grid, needed: &Needed) {
        self.jobs.clear();
        for at in times.iter().copied() {
            let ring_place = at.place();
            for (instance, place) in self.scene.numbering.instances.iter().enumerate() {
                let held = &mut self.held[instance][ring_place.index()];
                if place.is_animated && needed.has(instance) && *held != Some(at) {
                    *held = Some(at);
                    self.jobs.push(SampleJob { instance, place: ring_place, time: at.time(grid) });
                }
            }
        }
    }
}

/// Instances that do not move, in their order; each pose once.
fn static_positions(scene: &SceneGpu) -> Vec<Vec3> {
    let timeline = Timeline::new(&scene.scene);
    let mut positions = vec![Vec3::ZERO; scene.numbering.totals.static_vertices as usize];
    for (index, place) in scene.numbering.instances.iter().enumerate().filter(|(_, p)| !p.is_animated) {
        let shown = timeline.at(index, ServerTime(0));
        let pose = CpuPose::at(scene, index, &shown, ServerTime(0));
        let model = &scene.scene.models[place.model];
        let first = place.saved_base as usize;
        for (number, position) in positions[first..first + model.vertices.len()].iter_mut().enumerate() {
            *position = pose.vertex(model, number);
        }
    }
    positions
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
        let place = &self.scene.numbering.instances[self.scene.numbering.instance_of_vertex(vertex)];
        let number = vertex.0 - place.first_vertex.0;
        (!place.is_animated).then(|| self.statics[(place.saved_base + number) as usize])
    }

    fn is_masked(&self, patch: ScenePatch) -> bool {
        self.scene.is_masked(patch)
    }

    fn vertex_count(&self) -> usize {
        self.scene.numbering.totals.vertices as usize
    }

    fn patch_count(&self) -> usize {
        self.scene.numbering.totals.patches as usize
    }
}
