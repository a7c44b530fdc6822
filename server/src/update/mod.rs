//! One update for one viewer, from the head's pose to the picture and the delta: the design's steps 1 to 8 on one page.
//!
//! A step has an owner: `VisibilityStep`, `PlacementStep`, `ShadingStep`. Between two of them stands a type: `Start`,
//! `Begun`, `Seen`, `PlacementInput`, `Placed`, [`Shaded`]. Each step is a recording
//! of its own; barriers inside a recording stand in the step that owns it. What does not depend on the viewer is the [`World`]'s.

mod device_needs;
mod eye;
mod in_flight;
mod numbers;
mod placement_step;
pub mod policy;
pub(crate) mod ready;
mod reports;
mod shading_step;
mod views;
mod visibility_step;

pub use crate::update::device_needs::check_device;
pub use crate::update::ready::{LeftUpdates, ViewerMemory};

use crate::encode::Source;
use crate::motion::delta::UpdateDelta;
use crate::pacing::overlap::Flight;
use crate::shading::reuse::{Reason, Reused};
use crate::support::pool::Pool;
use crate::update::in_flight::{InFlight, Placed};
use crate::update::numbers::UpdateNumbers;
use crate::update::placement_step::PlacementStep;
use crate::update::policy::UpdatePolicy;
use crate::update::ready::{MemoryTerms, ReadyUpdates};
use crate::update::shading_step::ShadingStep;
use crate::update::visibility_step::{PlacementInput, Start, VisibilityStep};
use crate::visibility::predict::{HeadTrack, PredictedViews};
use crate::world::{ViewerId, World};
use shadecast_gpu::{GpuError, Recorder, Timings};
use shadecast_protocol::atlas::Block;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::message::{Capabilities, Welcome};
use shadecast_protocol::time::ServerTime;
use std::sync::Arc;
use std::time::Duration;

/// The updates of one viewer.
pub struct ViewerUpdates {
    id: ViewerId,
    terms: MemoryTerms,
    policy: Arc<UpdatePolicy>,
    head: HeadTrack,
    visibility: VisibilityStep,
    placement: PlacementStep,
    shading: ShadingStep,
    in_flight: InFlight,
    numbers: UpdateNumbers,
    /// Memory for the timings of updates that come.
    timings: Pool<Timings>,
    /// What an update took when nobody looked yet.
    rehearsed_s: Option<f64>,
}

/// How much of the scene a viewer is shown, and how.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShowOptions {
    /// Pixels of the display that an LOD may err by where bits and time suffice; 0: everything has full detail.
    pub detail_pixels: f32,
    /// Part of the client's slots and of the atlas for what an abrupt head could see, 0..1; 0: none.
    pub surround: f32,
}

/// What an update shows.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shows {
    /// Patches.
    pub patches: u32,
    /// Triangles that are drawn for them: those of two sides twice.
    pub triangles: u32,
    /// LODs of the instances that are needed, in their order.
    pub lods: Vec<usize>,
    /// Pixels of error that an LOD may have.
    pub detail_pixels: f32,
    /// Texels that blocks are asked to have for a pixel of the display, before sides are rounded up.
    pub texels_per_pixel: f32,
    /// Pairs of views with an ID buffer.
    pub pairs: usize,
    /// What was shaded, and what was not.
    pub reused: Reused,
    /// Texels of the atlas that were converted for the encoder.
    pub converted_texels: u64,
    /// Blocks in the store, shown or not.
    pub stored_blocks: u32,
    /// Their texels.
    pub stored_texels: u64,
}

/// How sharp an update is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sharpness {
    /// The largest error of an LOD on display, pixels of the nearest predicted eye.
    pub lod_error_pixels: f32,
    /// Texels that blocks are asked to have for a pixel of the display, before sides are rounded up.
    pub texels_per_pixel: f32,
}

/// One update, shaded and ready to be encoded.
#[derive(Clone, Debug)]
pub struct Shaded {
    /// The update.
    pub update: UpdateId,
    /// When it started.
    pub time: ServerTime,
    /// How sharp it is.
    pub sharpness: Sharpness,
    /// What changes in the client's memory.
    pub delta: UpdateDelta,
    /// The atlas; of no texels while an encoder has it.
    pub picture: Source,
    /// The blocks of the atlas that were shaded, and why.
    pub blocks: Vec<(Block, Reason)>,
    /// What its stages took on the device.
    pub timings: Timings,
}

impl ViewerUpdates {
    /// For a viewer of `world` that agreed to `welcome` and has told its `capabilities`.
    pub fn new(
        world: &World,
        id: ViewerId,
        welcome: &Welcome,
        capabilities: &Capabilities,
        show: ShowOptions,
    ) -> Result<Self, GpuError> {
        Self::with_policy(world, id, welcome, capabilities, show, UpdatePolicy::default())
    }

    /// The same with a measurement's policy.
    pub fn with_policy(
        world: &World,
        id: ViewerId,
        welcome: &Welcome,
        capabilities: &Capabilities,
        show: ShowOptions,
        policy: UpdatePolicy,
    ) -> Result<Self, GpuError> {
        ReadyUpdates::new(&world.site(), None, welcome, capabilities, show, policy)?.join(world, id)
    }

    /// The same as [`Self::new`] in the memory of a viewer that has gone, where that had the same eyes and atlas.
    ///
    /// # Errors
    /// The device has no memory for it, or is lost.
    pub fn in_memory(
        world: &World,
        kept: ViewerMemory,
        id: ViewerId,
        (welcome, capabilities): (&Welcome, &Capabilities),
        show: ShowOptions,
    ) -> Result<Self, GpuError> {
        let policy = UpdatePolicy::default();
        ReadyUpdates::new(&world.site(), Some(kept), welcome, capabilities, show, policy)?.join(world, id)
    }

    /// Steps 1 to 8, one after the other. `None` before the first head state: no view is known.
    pub fn update(&mut self, world: &mut World, now: ServerTime) -> Result<Option<Shaded>, GpuError> {
        if !self.begin(world, now)? {
            return Ok(None);
        }
        self.place(world)?;
        self.shade(world)?;
        self.collect(world)
    }

    /// Steps 1 to 3 up to the device. A placed update is shaded behind them. Nobody waits for the device. False before the first
    /// head state. The update before that was collected.
    pub fn begin(&mut self, world: &mut World, now: ServerTime) -> Result<bool, GpuError> {
        let (clock, grid, margin) = (world.clock(), world.grid(), self.policy.views.margin());
        let views = match self.policy.predicts {
            true => self.head.predict(now, &clock, grid, margin),
            false => self.head.unpredicted(now, &clock, grid),
        };
        let Some(views) = views else { return Ok(false) }; // 1
        // What the next update does to world and layout is not for this one.
        let placed = self.record_shading(world)?;
        let start = self.start(now, views);
        let begun = self.visibility.begin(world, start)?; // 2, 3
        self.in_flight.begin(begun);
        self.submit_shading(placed)?;
        Ok(true)
    }

    /// Steps 4, 5 and 8 of the begun update: waits for its visibility passes.
    pub fn place(&mut self, world: &mut World) -> Result<(), GpuError> {
        while self.in_flight.is_begun() {
            self.place_seen(world)?;
        }
        Ok(())
    }

    /// The same up to the next visibility pass: waits for the one on the device, and submits the next, if there is one.
    pub(crate) fn place_seen(&mut self, world: &mut World) -> Result<(), GpuError> {
        let Some(mut begun) = self.in_flight.take_begun() else { return Ok(()) };
        let seen = self.visibility.see(world, &mut begun)?;
        let fit = self.placement.see(world, seen);
        if self.visibility.submit_next_pass(world, &mut begun, fit)? {
            self.in_flight.begin(begun);
            return Ok(());
        }
        let input = begun.finish();
        let delta = self.placement.place(world, &input); // 4, 5, 8
        let PlacementInput { start: Start { update, time, views, timings, .. }, sampled, lods } = input;
        self.visibility.recycle(lods);
        self.numbers.placed(time);
        let sharpness = Sharpness {
            lod_error_pixels: self.visibility.detail().shown_error_pixels(),
            texels_per_pixel: self.placement.texels_per_pixel(),
        };
        self.in_flight.place(Placed { update, time, views, sampled, sharpness, delta, timings });
        Ok(())
    }

    /// Step 6 of the placed update, up to the device. Nobody waits for it. The update before was collected.
    pub fn shade(&mut self, world: &mut World) -> Result<(), GpuError> {
        let placed = self.record_shading(world)?;
        self.submit_shading(placed)
    }

    /// Step 7: the update that the device shades, with its picture. Waits for it; `None` where there is none.
    pub fn collect(&mut self, world: &World) -> Result<Option<Shaded>, GpuError> {
        let mut shaded = self.in_flight.wait_shaded(world)?;
        shaded.iter_mut().for_each(|shaded| self.shading.read(shaded));
        Ok(shaded)
    }

    /// The update that is begun at `now`.
    fn start(&mut self, now: ServerTime, views: PredictedViews) -> Start {
        let mut timings = self.timings.take();
        timings.clear();
        Start {
            update: self.numbers.next(),
            time: now,
            views,
            texels_per_pixel: self.placement.asked_texels_per_pixel(),
            error: self.placement.error(),
            room: self.placement.room(),
            geometry_bytes: self.placement.residency.budget_bytes(),
            timings,
        }
    }

    fn record_shading(&mut self, world: &mut World) -> Result<Option<(Placed, Recorder)>, GpuError> {
        let Some(placed) = self.in_flight.take_placed() else { return Ok(None) };
        let recorder = self.shading.record(world, &placed, self.placement.layout())?;
        self.placement.shaded(placed.update, self.shading.reuse());
        Ok(Some((placed, recorder)))
    }

    fn submit_shading(&mut self, recorded: Option<(Placed, Recorder)>) -> Result<(), GpuError> {
        let Some((placed, recorder)) = recorded else { return Ok(()) };
        self.in_flight.shade(placed, recorder.submit_beside()?);
        Ok(())
    }

    /// How far the updates in flight have come.
    pub fn flight(&self, world: &World) -> Result<Flight, GpuError> {
        self.in_flight.flight(world)
    }

    /// Waits until the device has come further with what is in flight, at most so long; false where it has nothing to do.
    pub(crate) fn rest(&self, world: &World, at_most: Duration) -> Result<bool, GpuError> {
        for ticket in self.in_flight.tickets().into_iter().flatten() {
            if world.gpu().wait_at_most(ticket, at_most)? {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// The viewer goes. Whatever was in flight is left, once the device reads no more of the world for it. Gives what it had: to be
    /// dropped, or wiped and kept for another.
    pub fn leave(self, world: &mut World) -> LeftUpdates {
        for ticket in self.in_flight.tickets().into_iter().flatten() {
            let _ = world.gpu().wait(ticket); // a lost device reads nothing either
        }
        world.leave(self.id);
        LeftUpdates(self)
    }
}
