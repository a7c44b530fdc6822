//! Steps 6 and 7 of an update: blocks whose inputs have changed are shaded, and their colours become the encoder's planes.
//!
//! A [`Placed`] update and the layout enter. A recording leaves, and once the device has run it the picture and the coverage of
//! masked blocks. Visibility and the client's memory are unknown here.

use crate::atlas::layout::Layout;
use crate::encode::Source;
use crate::pacing::relief::{Measure, Measures};
use crate::scene::SceneGpu;
use crate::shading::passes::shading::{Shading, ShadingMemory};
use crate::shading::passes::ycbcr::Ycbcr;
use crate::shading::reuse::{Moment, Reason, Reuse};
use crate::support::pool::Pool;
use crate::update::Shaded;
use crate::update::eye::EyeSize;
use crate::update::in_flight::Placed;
use crate::update::policy::UpdatePolicy;
use crate::world::World;
use crate::world::moment::Stance;
use shadecast_gpu::{Access, Gpu, GpuError, Image, Recorder};
use shadecast_protocol::atlas::{AtlasExtent, Block};
use shadecast_protocol::picture::I420;
use shadecast_protocol::time::WorldTime;
use std::sync::Arc;

/// Owner of the atlas image and of the planes, for one viewer.
pub(crate) struct ShadingStep {
    eye: EyeSize,
    policy: Arc<UpdatePolicy>,
    shading: Shading,
    reuse: Reuse<Stance>,
    /// Texels that an update may shade beside new blocks.
    budget_texels: u64,
    measures: Measures,
    /// What the last picture that was recorded is shaded for.
    shaded_time: WorldTime,
    ycbcr: Ycbcr,
    /// Memory for the pictures of updates that come.
    pictures: Pool<I420>,
    /// The same for their lists of shaded blocks.
    lists: Pool<Vec<(Block, Reason)>>,
}

/// What it has on the device, in no world.
pub(crate) struct ColourMemory {
    shading: ShadingMemory,
    ycbcr: Ycbcr,
}

impl ColourMemory {
    /// For an atlas of this extent in `scene`. Any thread makes it.
    pub(crate) fn new(
        gpu: &Arc<Gpu>,
        scene: &SceneGpu,
        extent: AtlasExtent,
        policy: &UpdatePolicy,
    ) -> Result<Self, GpuError> {
        let shading = ShadingMemory::new(gpu, scene, extent, policy.filter)?;
        let ycbcr = Ycbcr::new(gpu, &shading.atlas, scene.has_masks())?;
        Ok(Self { shading, ycbcr })
    }

    /// As it was when it was made: nothing of what was shaded is left.
    pub(crate) fn wipe(&mut self, gpu: &Arc<Gpu>) -> Result<(), GpuError> {
        self.shading.wipe(gpu)?;
        self.ycbcr.wipe(gpu)
    }
}

impl ShadingStep {
    /// For a viewer of `world`.
    pub(crate) fn new(
        world: &World,
        eye: EyeSize,
        policy: &Arc<UpdatePolicy>,
        ColourMemory { shading, ycbcr }: ColourMemory,
    ) -> Result<Self, GpuError> {
        Ok(Self {
            eye,
            policy: policy.clone(),
            ycbcr,
            shading: shading.bind(world.scene(), world.animation(), world.shadow())?,
            reuse: Reuse::new(policy.reuse),
            budget_texels: u64::MAX,
            measures: Measures::default(),
            shaded_time: WorldTime(0),
            pictures: Pool::default(),
            lists: Pool::default(),
        })
    }

    /// Leaves the world. No submitted work still uses it.
    pub(crate) fn into_memory(self) -> ColourMemory {
        ColourMemory { shading: self.shading.unbind(), ycbcr: self.ycbcr }
    }

    /// Texels that an update may shade from now on, beside those of new blocks.
    pub(crate) fn set_budget(&mut self, texels: u64) {
        self.budget_texels = texels;
    }

    /// Pictures are coded with this quantiser.
    pub(crate) fn coded(&mut self, qp: u8) {
        self.reuse.coded(qp);
    }

    /// What updates do without from now on.
    pub(crate) fn set_measures(&mut self, measures: Measures) {
        self.measures = measures;
    }

    /// Texels that may be shaded again.
    fn allowed_texels(&self) -> u64 {
        self.measures.shaded_again(self.budget_texels)
    }

    /// Takes back a picture and its list of blocks, for their memory.
    pub(crate) fn recycle(&mut self, picture: I420, blocks: Vec<(Block, Reason)>) {
        self.pictures.give(picture);
        self.lists.give(blocks);
    }

    /// The blocks that are shaded again, and those that are not.
    pub(crate) fn reuse(&self) -> &Reuse<Stance> {
        &self.reuse
    }

    /// The atlas, as shaders read it.
    pub(crate) fn atlas(&self) -> &Image {
        self.shading.atlas()
    }

    /// Texels of the atlas that the last update converted for the encoder.
    pub(crate) fn converted_texels(&self) -> u64 {
        self.ycbcr.converted_texels()
    }

    /// Records the blocks whose inputs have changed, as they are at the time that the update is shaded for, and their conversion.
    pub(crate) fn record(
        &mut self,
        world: &mut World,
        Placed { update, views, sampled, .. }: &Placed,
        layout: &Layout,
    ) -> Result<Recorder, GpuError> {
        let place = sampled.shaded;
        let mut recorder = world.gpu().record()?;
        let time = self.policy.light(world, &mut recorder, *update, (views.shaded, place));
        self.shaded_time = time;
        let (surfaces, placed) = (world.surfaces(time, place), layout.remembered());
        let moment = |now: &mut Moment<Stance>| world.moment(time, now);
        let due = self.reuse.due(moment, views.world_from_head, placed, &surfaces, self.allowed_texels());
        let blocks = due.iter().map(|due| (due.patch, due.block));
        self.shading.write_blocks(world.scene(), world.animation(), place, blocks);
        let cleared = layout.cleared();
        self.ycbcr.note_changed(due.iter().map(|due| due.block).chain(cleared.iter().copied()));
        self.ycbcr.write_cells(layout.cell_extents());
        recorder.barrier(Access::COMPUTE_READ, Access::COLOR_WRITE); // the last conversion has read the atlas
        let pixels_per_tangent = self.eye.pixels_per_tangent();
        let samples_a_side = self.policy.filter.samples_a_side(self.measures.has(Measure::OneSample));
        recorder.scope("shading", |r| {
            self.shading.record(r, views.world_from_head, pixels_per_tangent, samples_a_side, cleared);
        });
        recorder.barrier(Access::COLOR_WRITE, Access::COMPUTE_READ);
        recorder.scope("ycbcr", |r| self.ycbcr.record(r));
        Ok(recorder)
    }

    /// Reads the picture of a shaded update, the coverage of its masked blocks, and why blocks were shaded.
    pub(crate) fn read(&mut self, shaded: &mut Shaded) {
        let blocks = shaded.delta.masked.iter();
        let covered = blocks.map(|(slot, block)| (*slot, self.ycbcr.coverage(*block)));
        shaded.delta.geometry.shaded = self.shaded_time;
        shaded.delta.geometry.coverage.extend(covered.filter(|(_, coverage)| !coverage.is_whole()));
        let mut picture = self.pictures.take();
        self.ycbcr.read(&mut picture);
        shaded.picture = Source::Planes(picture);
        // The next update is recorded after this one is read.
        shaded.blocks = self.lists.take();
        shaded.blocks.clear();
        shaded.blocks.extend(self.reuse.shaded().iter().map(|due| (due.block, due.reason)));
    }
}
