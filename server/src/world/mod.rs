//! The world that all viewers look at: the scene in motion and under its light, each thing once for a time, however many look.

pub(crate) mod effort;
pub(crate) mod moment;
pub mod samples;

use crate::animation::timeline::SharedTimeline;
use crate::scene::SceneGpu;
use crate::shading::passes::shadow::{Casters, Shadow};
use crate::shading::reuse::Moment;
use crate::skinning::gpu::{Animation, AnimationCounts};
use crate::time::RingPlace;
use crate::time::VIEW_TIMES;
use crate::time::view_time::ViewTime;
use crate::visibility::clusters::Clusters;
use crate::visibility::culling::Needed;
use crate::world::effort::Effort;
use crate::world::moment::{SceneSurfaces, Stance, stance};
use crate::world::samples::SampleWindow;
use shadecast_gpu::{Access, Gpu, GpuError, Recorder};
use shadecast_protocol::time::{DEFAULT_GRID, Grid, WorldTime};
use shadecast_protocol::world_clock::WorldClock;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Who looks at the world.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ViewerId(pub u64);

impl ViewerId {
    /// Of nobody.
    pub(crate) const REHEARSAL: Self = Self(0);
}

/// The samples that an update works with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sampled {
    /// Where those of each predicted time are in the ring.
    pub places: [RingPlace; VIEW_TIMES],
    /// Where those are that it is shaded with.
    pub shaded: RingPlace,
}

/// Times at which an update needs samples.
#[derive(Clone, Copy, Debug)]
pub struct SampleTimes {
    /// Those at which it may look.
    pub times: [ViewTime; VIEW_TIMES],
    /// At which of them it does.
    pub looks: [bool; VIEW_TIMES],
    /// What it is shaded for.
    pub shaded: ViewTime,
}

/// What the world has done so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WorldCounts {
    /// Poses and skinned vertices.
    pub animation: AnimationCounts,
    /// Shadow maps drawn.
    pub shadow_maps: u64,
    /// Times for which normals and tangents were skinned.
    pub tangents: u64,
}

/// What of a world is there before it, and after it: the device, the scene and its motion.
#[derive(Clone)]
pub(crate) struct Site {
    /// The device.
    pub gpu: Arc<Gpu>,
    /// The scene.
    pub scene: Arc<SceneGpu>,
    /// How it moves.
    pub timeline: SharedTimeline,
}

/// See the module. A viewer asks it for what its update needs; what is there already, for another viewer or from an update
/// before, is not made again.
pub struct World {
    gpu: Arc<Gpu>,
    scene: Arc<SceneGpu>,
    grid: Grid,
    /// Positions at the times of updates.
    animation: Animation,
    /// Which times those are.
    samples: SampleWindow,
    /// What stands still, in clusters.
    clusters: Clusters,
    /// Light and the sun's map.
    shadow: Shadow,
    /// What it costs.
    effort: Effort,
    /// What each viewer needs.
    needs: BTreeMap<ViewerId, Needed>,
    /// What any of them needs.
    needed: Needed,
    /// Whose time light, shadow map and tangents are, and for which instances.
    lit: Option<(ViewTime, Needed)>,
    shadow_maps: u64,
    tangents: u64,
}

impl World {
    /// The scene before its first update, moving as it says itself.
    pub fn new(gpu: &Arc<Gpu>, scene: &Arc<SceneGpu>) -> Result<Self, GpuError> {
        Self::of_timeline(gpu, scene, SharedTimeline::new(&scene.scene))
    }

    /// The scene before its first update, moving as a timeline says, which may have been another world's before.
    pub(crate) fn of_timeline(
        gpu: &Arc<Gpu>,
        scene: &Arc<SceneGpu>,
        timeline: SharedTimeline,
    ) -> Result<Self, GpuError> {
        let animation = Animation::of_timeline(gpu, scene, Animation::places_for(scene), timeline)?;
        let samples = SampleWindow::new(scene, &animation);
        Ok(Self {
            clusters: samples.clusters(),
            samples,
            shadow: Shadow::new(gpu, scene, &animation)?,
            animation,
            grid: DEFAULT_GRID,
            effort: Effort::default(),
            needs: BTreeMap::new(),
            needed: Needed::none(scene.numbering.instances.len()),
            lit: None,
            shadow_maps: 0,
            tangents: 0,
            gpu: gpu.clone(),
            scene: scene.clone(),
        })
    }

    /// What is there without it.
    pub(crate) fn site(&self) -> Site {
        let (gpu, scene, timeline) = (self.gpu.clone(), self.scene.clone(), self.timeline().clone());
        Site { gpu, scene, timeline }
    }

    /// Its device.
    pub(crate) fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// Its scene.
    pub(crate) fn scene(&self) -> &Arc<SceneGpu> {
        &self.scene
    }

    /// Positions at the times of updates.
    pub(crate) fn animation(&self) -> &Animation {
        &self.animation
    }

    /// Which times those are.
    pub(crate) fn samples(&self) -> &SampleWindow {
        &self.samples
    }

    /// What stands still, in clusters.
    pub(crate) fn clusters(&self) -> &Clusters {
        &self.clusters
    }

    /// Light and the sun's map.
    pub(crate) fn shadow(&self) -> &Shadow {
        &self.shadow
    }

    /// What it costs.
    pub fn effort(&self) -> &Effort {
        &self.effort
    }

    /// The same, for those who add to it.
    pub fn effort_mut(&mut self) -> &mut Effort {
        &mut self.effort
    }

    /// The times at which vertices are sampled.
    pub(crate) fn grid(&self) -> Grid {
        self.grid
    }

    /// What moves, and how: for an application to change.
    pub fn timeline(&self) -> &SharedTimeline {
        self.animation.timeline()
    }

    /// How its time follows the server's clock, as of now.
    pub fn clock(&self) -> WorldClock {
        *self.timeline().lock().clock()
    }

    /// What was done so far.
    pub fn counts(&self) -> WorldCounts {
        WorldCounts {
            animation: self.animation.counts(),
            shadow_maps: self.shadow_maps,
            tangents: self.tangents,
        }
    }

    /// Nothing that was made is believed any more: an update was broken off in the middle.
    pub(crate) fn forget(&mut self) {
        self.animation.forget();
        self.shadow.forget();
        self.lit = None;
    }

    /// The samples that were made are not believed any more.
    pub fn forget_samples(&mut self) {
        self.animation.forget();
    }

    /// The shadow map that was drawn is not believed any more.
    pub fn forget_shadow_map(&mut self) {
        self.shadow.forget();
    }

    /// A viewer has gone: what only it needed is animated no longer.
    pub(crate) fn leave(&mut self, viewer: ViewerId) {
        self.needs.remove(&viewer);
        self.unite();
    }

    /// Records the samples that an update lacks which looks at some of its times, of the instances that `viewer` needs with casters so
    /// fine, and those that others do.
    pub(crate) fn animate(
        &mut self,
        recorder: &mut Recorder,
        viewer: ViewerId,
        times: SampleTimes,
        (needs, casters): (&Needed, Casters),
    ) -> Sampled {
        let instances = self.scene.numbering.instances.len();
        let of_viewer = self.needs.entry(viewer).or_insert_with(|| Needed::none(instances));
        of_viewer.copy(needs);
        of_viewer.refine(self.shadow.lods(casters));
        self.unite();
        self.samples.record(recorder, &mut self.animation, self.grid, times, &self.needed)
    }

    /// Records light, shadow map and tangents as they are at `at`, which [`Self::animate`] has sampled into `place`, unless they are.
    pub(crate) fn light(&mut self, recorder: &mut Recorder, at: ViewTime, place: RingPlace) {
        let known = self.lit.as_ref().filter(|(lit, _)| *lit == at).map(|(_, of)| of);
        match known {
            Some(of) if of.covers(&self.needed) => return,
            // Another viewer needs finer frames. A map of coarse casters stays until the next time.
            Some(of) if of.has_all(&self.needed) => {
                let lacks = |instance: usize| self.needed.lod(instance) < of.lod(instance);
                self.animation.record_tangents(recorder, place, |instance| {
                    self.needed.has(instance) && lacks(instance)
                });
                recorder.barrier(Access::COMPUTE_WRITE, Access::GRAPHICS_READ);
            }
            _ => self.record_light(recorder, place, at.time(self.grid)),
        }
        let (lit, of) = self.lit.get_or_insert_with(|| (at, self.needed.clone()));
        *lit = at;
        of.copy(&self.needed);
    }

    /// The same for any time, which vertices in `place` are moved to: for measurements, since no sample is kept by it.
    pub(crate) fn light_at(&mut self, recorder: &mut Recorder, place: RingPlace, time: WorldTime) {
        self.animation.record_sample(recorder, place, time);
        self.record_light(recorder, place, time);
        self.animation.forget();
        self.lit = None;
    }

    /// Writes what shading depends on at the time of the light that was recorded last.
    pub(crate) fn moment(&self, time: WorldTime, now: &mut Moment<Stance>) {
        moment::write(&self.scene, &self.animation, &self.shadow, time, now);
    }

    /// Its surfaces at a time, of which a place has the positions.
    pub(crate) fn surfaces(&self, time: WorldTime, place: RingPlace) -> SceneSurfaces<'_> {
        let Self { scene, samples, animation, shadow, .. } = self;
        SceneSurfaces { scene, samples, animation, sun: shadow.sun_view(), time, place }
    }

    /// Whether all that is in `needs` looks the same at several times.
    pub(crate) fn stands(&self, needs: &Needed, times: &[ViewTime]) -> bool {
        let mut needed = (0..self.scene.numbering.instances.len()).filter(|number| needs.has(*number));
        needed.all(|number| self.instance_stands(number, times))
    }

    /// The same of one instance.
    pub(crate) fn instance_stands(&self, number: usize, times: &[ViewTime]) -> bool {
        let timeline = self.animation.timeline().lock();
        let Some((first, others)) = times.split_first() else { return true };
        let stance = |at: &ViewTime| stance(&self.scene, &timeline, number, at.time(self.grid));
        let at_first = stance(first);
        others.iter().all(|other| stance(other) == at_first)
    }

    fn record_light(&mut self, recorder: &mut Recorder, place: RingPlace, time: WorldTime) {
        self.shadow.write(&self.scene, &self.animation, time);
        self.animation.forget_tangents();
        self.animation.record_tangents(recorder, place, |instance| self.needed.has(instance));
        recorder.barrier(Access::COMPUTE_WRITE, Access::GRAPHICS_READ);
        let is_drawn = recorder
            .scope("shadow", |r| self.shadow.record(r, &self.scene, &self.animation, &self.needed, place));
        recorder.barrier(Access::DEPTH_WRITE, Access::FRAGMENT_READ);
        self.shadow_maps += u64::from(is_drawn);
        self.tangents += 1;
    }

    fn unite(&mut self) {
        self.needed.clear();
        self.needs.values().for_each(|needs| self.needed.add(needs));
    }
}
