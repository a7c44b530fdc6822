//! The world that all viewers look at: the scene in motion and under its light, each thing once for a time, however many look.

use crate::animation::gpu::{Animation, AnimationCounts};
use crate::predict::PredictedViews;
use crate::samples::{RING, SampleWindow};
use crate::scene::SceneGpu;
use crate::stages::shadow::Shadow;
use shadecast_gpu::{Access, Gpu, GpuError, Recorder};
use shadecast_protocol::time::{DEFAULT_GRID, Grid, GridIndex};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Who looks at the world.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ViewerId(pub u64);

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

/// See the module. A viewer asks it for what its update needs; what is there already, for another viewer or from an update
/// before, is not made again.
pub struct World {
    gpu: Arc<Gpu>,
    scene: Arc<SceneGpu>,
    grid: Grid,
    /// Positions on the time grid.
    pub animation: Animation,
    /// Which grid points those are.
    pub samples: SampleWindow,
    /// Light and the sun's map.
    pub shadow: Shadow,
    /// By instance, what each viewer needs.
    needs: BTreeMap<ViewerId, Vec<bool>>,
    /// By instance, whether any viewer needs it.
    needed: Vec<bool>,
    /// Whose time light, shadow map and tangents are, and for which instances.
    lit: Option<(GridIndex, Vec<bool>)>,
    shadow_maps: u64,
    tangents: u64,
}

impl World {
    /// The scene before its first update.
    pub fn new(gpu: &Arc<Gpu>, scene: &Arc<SceneGpu>) -> Result<Self, GpuError> {
        let animation = Animation::new(gpu, scene, RING)?;
        Ok(Self {
            samples: SampleWindow::new(gpu, scene, &animation)?,
            shadow: Shadow::new(gpu, scene, &animation)?,
            animation,
            grid: DEFAULT_GRID,
            needs: BTreeMap::new(),
            needed: vec![false; scene.numbering.instances.len()],
            lit: None,
            shadow_maps: 0,
            tangents: 0,
            gpu: gpu.clone(),
            scene: scene.clone(),
        })
    }

    /// Its device.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// Its scene.
    pub fn scene(&self) -> &Arc<SceneGpu> {
        &self.scene
    }

    /// The times at which vertices are sampled.
    pub fn grid(&self) -> Grid {
        self.grid
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
    pub fn forget(&mut self) {
        self.samples.forget();
        self.animation.forget();
        self.shadow.forget();
        self.lit = None;
    }

    /// A viewer has gone: what only it needed is animated no longer.
    pub fn leave(&mut self, viewer: ViewerId) {
        self.needs.remove(&viewer);
        self.unite();
    }

    /// Records the samples that an update for `views` lacks, of the instances that `viewer` needs and those that others do.
    /// Gives the oldest grid point that is there afterwards.
    pub fn animate(
        &mut self,
        recorder: &mut Recorder,
        viewer: ViewerId,
        views: &PredictedViews,
        needs: &[bool],
    ) -> GridIndex {
        self.needs.insert(viewer, needs.to_vec());
        self.unite();
        self.samples.record(recorder, &mut self.animation, self.grid, views, &self.needed)
    }

    /// Records light, shadow map and tangents as they are at `at`, which [`Self::animate`] has sampled, unless they are.
    pub fn light(&mut self, recorder: &mut Recorder, at: GridIndex) {
        let is_lit = |(lit, of): &(GridIndex, Vec<bool>)| {
            *lit == at && of.iter().zip(&self.needed).all(|(is_there, is_needed)| *is_there || !is_needed)
        };
        if self.lit.as_ref().is_some_and(is_lit) {
            return;
        }
        let place = SampleWindow::ring_place(at);
        self.shadow.write(&self.scene, self.grid.time_of(at));
        self.animation.record_tangents(recorder, place, |instance| self.needed[instance]);
        recorder.barrier(Access::COMPUTE_WRITE, Access::GRAPHICS_READ);
        let is_drawn = recorder
            .scope("shadow", |r| self.shadow.record(r, &self.scene, &self.animation, &self.needed, place));
        recorder.barrier(Access::DEPTH_WRITE, Access::FRAGMENT_READ);
        self.shadow_maps += u64::from(is_drawn);
        self.tangents += 1;
        self.lit = Some((at, self.needed.clone()));
    }

    fn unite(&mut self) {
        self.needed.fill(false);
        for needs in self.needs.values() {
            self.needed.iter_mut().zip(needs).for_each(|(all, one)| *all |= *one);
        }
    }
}
