//! Which grid points are computed on the GPU, for what is drawn here; and the scene as residency sees it.

use crate::animation::timeline::Timeline;
use crate::scene::SceneGpu;
use crate::scene::drawing::FULL_DETAIL;
use crate::scene::geometry::Geometry;
use crate::scene::numbering::{ScenePatch, SceneVertex};
use crate::skinning::gpu::{Animation, SampleJob};
use crate::skinning::posing::CpuPose;
use crate::time::RingPlace;
use crate::time::VIEW_TIMES;
use crate::time::view_time::HeldTimes;
use crate::visibility::clusters::Clusters;
use crate::visibility::culling::Needed;
use crate::world::{SampleTimes, Sampled};
use glam::Vec3;
use shadecast_gpu::Recorder;
use shadecast_protocol::ids::MeshId;
use shadecast_protocol::time::{Grid, WorldTime};
use shadecast_scene::patches::Patch;
use std::sync::Arc;

/// Samples on the GPU, each at its time's place of the ring.
pub struct SampleWindow {
    scene: Arc<SceneGpu>,
    /// Positions of the vertices of instances that do not move, metres, one after the other.
    statics: Vec<Vec3>,
    times: HeldTimes,
    jobs: Vec<SampleJob>,
}

impl SampleWindow {
    /// An empty window on what an animation of `scene` keeps.
    pub fn new(scene: &Arc<SceneGpu>, animation: &Animation) -> Self {
        Self {
            times: HeldTimes::new(animation.places()),
            jobs: Vec::new(),
            statics: static_positions(scene),
            scene: scene.clone(),
        }
    }

    /// What stands still, in clusters.
    pub fn clusters(&self) -> Clusters {
        let (scene, mut clusters) = (&self.scene, Clusters::default());
        for (index, place) in scene.numbering.instances.iter().enumerate() {
            if place.is_animated {
                clusters.add_moving();
                continue;
            }
            let model = &scene.scene.models[place.model];
            let lods = (0..scene.mesh(index).lods.len()).map(|lod| model.triangles(lod));
            let statics = &self.statics[place.saved_base as usize..];
            clusters
                .add_still(lods.map(|lod| (lod.primitives, lod.indices)), |vertex| statics[vertex as usize]);
        }
        clusters
    }

    /// Records the samples that the instances in `needed` lack, at the middle of `times`, at those that `looks` names, and at `shaded`.
    /// Gives where those of each time are; a time without any has the middle's.
    pub fn record(
        &mut self,
        recorder: &mut Recorder,
        animation: &mut Animation,
        grid: Grid,
        SampleTimes { times, looks, shaded }: SampleTimes,
        needed: &Needed,
    ) -> Sampled {
        let times: [_; VIEW_TIMES] =
            std::array::from_fn(|time| times[if looks[time] { time } else { VIEW_TIMES / 2 }]);
        let [first, middle, last] = times;
        // The update is shaded while the next one looks already.
        let all = [first, last, middle, shaded];
        let places = self.times.take(all);
        self.list_jobs(animation, places, all.map(|at| at.time(grid)), needed);
        let statics = SampleJob { instance: 0, lod: FULL_DETAIL, place: places[0], time: first.time(grid) };
        animation.record(recorder, &self.jobs, statics);
        let [first, last, middle, shaded] = places;
        Sampled { places: [first, middle, last], shaded }
    }

    fn list_jobs(
        &mut self,
        animation: &Animation,
        places: [RingPlace; VIEW_TIMES + 1],
        times: [WorldTime; VIEW_TIMES + 1],
        needed: &Needed,
    ) {
        self.jobs.clear();
        for number in 0..places.len() {
            if places[..number].contains(&places[number]) {
                continue;
            }
            let (place, time) = (places[number], times[number]);
            for (instance, of_scene) in self.scene.numbering.instances.iter().enumerate() {
                let lod = needed.lod(instance).filter(|_| of_scene.is_animated);
                let job = lod.map(|lod| SampleJob { instance, lod, place, time });
                self.jobs.extend(job.filter(|job| !animation.has(*job)));
            }
        }
    }
}

/// Instances that do not move, in their order; each pose once.
fn static_positions(scene: &SceneGpu) -> Vec<Vec3> {
    let timeline = Timeline::new(&scene.scene);
    let mut positions = vec![Vec3::ZERO; scene.numbering.totals.static_vertices as usize];
    for (index, place) in scene.numbering.instances.iter().enumerate().filter(|(_, p)| !p.is_animated) {
        let shown = timeline.at(index, WorldTime(0));
        let pose = CpuPose::at(scene, index, &shown, WorldTime(0));
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

    fn mesh_of(&self, instance: u16) -> (MeshId, ScenePatch) {
        let (place, instance) =
            (&self.scene.numbering.instances[usize::from(instance)], usize::from(instance));
        (MeshId(place.model as u32), self.scene.numbering.first_patch(instance))
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
}
