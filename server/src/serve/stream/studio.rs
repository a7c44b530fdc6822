//! The pipeline's studio on the real device: the world while somebody looks, and a [`ViewerUpdates`] a viewer.

use super::backstage::{Backstage, Opening, Order};
use super::encoder::{PictureEncoder, Pictures};
use super::pipeline::{OpenError, Opened, Studio};
use super::rehearsal::rehearse;
use super::{StreamOptions, ViewerStats};
use crate::animation::timeline::SharedTimeline;
use crate::encode::openh264::EncoderSettings;
use crate::encode::{self, EncodeError, Encoder};
use crate::motion::delta::UpdateDelta;
use crate::motion::sender::SharedMotion;
use crate::pacing::density::Spare;
use crate::pacing::overlap::{Flight, Step};
use crate::pacing::quality::QualityOptions;
use crate::pacing::relief::Measures;
use crate::pacing::shade_rate::ShadeRate;
use crate::pacing::share::Budget;
use crate::scene::SceneGpu;
use crate::serve::viewer::Updates;
use crate::update::ready::ReadyUpdates;
use crate::update::{Shaded, ViewerUpdates};
use crate::world::{Site, ViewerId, World};
use shadecast_gpu::{Gpu, GpuError, HeldPipelines};
use shadecast_protocol::delta::EncodedDelta;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::message::{Capabilities, Codec, Displayed, HeadState, Welcome};
use shadecast_protocol::time::ServerTime;
use shadecast_protocol::world_clock::Steering;
use shadecast_scene::Scene;
use shadecast_system::monotonic_now_ns;
use std::sync::Arc;
use std::time::Duration;

/// A device, and the scene on it.
pub struct Device {
    /// The device.
    pub gpu: Arc<Gpu>,
    /// The scene.
    pub scene: Arc<SceneGpu>,
}

/// Opens the device, and brings the scene to it: again, after it was lost.
pub type Reopen<'a> = dyn Fn(Scene) -> anyhow::Result<Device> + 'a;

/// Pipelines on the real device.
pub(super) struct GpuStudio<'a> {
    /// `None` only while it is opened again.
    device: Option<Device>,
    /// How the world moves, whichever device it is on.
    timeline: SharedTimeline,
    /// While somebody looks.
    world: Option<World>,
    viewers: u64,
    looking: usize,
    /// Pipelines of the rehearsal, for viewers that come.
    pipelines: Option<HeldPipelines>,
    rehearsal_s: f64,
    /// How long its last update took, nanoseconds: the first guess of what a viewer's take.
    rehearsed_update_ns: i64,
    /// How fast the device shades.
    shade_rate: ShadeRate,
    /// Kept for that.
    scene: Option<Scene>,
    reopen: &'a Reopen<'a>,
    options: &'a StreamOptions,
    /// Of this device; anew with each.
    backstage: Backstage,
}

impl<'a> GpuStudio<'a> {
    /// Before anybody looks, with all pipelines made.
    pub(super) fn rehearsed(
        device: Device,
        timeline: SharedTimeline,
        reopen: &'a Reopen<'a>,
        options: &'a StreamOptions,
    ) -> anyhow::Result<Self> {
        let mut studio = Self {
            device: Some(device),
            timeline,
            world: None,
            viewers: 0,
            looking: 0,
            pipelines: None,
            shade_rate: ShadeRate::default(),
            scene: None,
            rehearsal_s: 0.0,
            rehearsed_update_ns: 0,
            reopen,
            options,
            backstage: Backstage::start()?,
        };
        studio.rehearse()?;
        Ok(studio)
    }

    /// Seconds that the last rehearsal took.
    pub(super) fn rehearsal_s(&self) -> f64 {
        self.rehearsal_s
    }

    /// Makes first small updates for nobody, so that the first viewer's find their pipelines compiled.
    fn rehearse(&mut self) -> Result<(), GpuError> {
        let began_ns = monotonic_now_ns();
        let Device { gpu, scene } = self.device()?;
        let (gpu, mut world) = (gpu.clone(), World::of_timeline(gpu, scene, self.timeline.clone())?);
        // In use until the world and the viewer of the rehearsal are gone.
        let mut held = None;
        self.rehearsed_update_ns = rehearse(&mut world, self.options, || held = Some(gpu.hold_pipelines()))?;
        self.pipelines = held;
        gpu.keep_pipelines();
        self.rehearsal_s = (monotonic_now_ns() - began_ns) as f64 * 1e-9;
        Ok(())
    }

    /// What it works on.
    pub(super) fn device(&self) -> Result<&Device, GpuError> {
        let closed = || GpuError::NoDevice("it was lost and is not open again yet".into());
        self.device.as_ref().ok_or_else(closed)
    }

    /// The world takes in what was made for a viewer; it is made where nobody else looks.
    fn take_in(&mut self, ready: ReadyUpdates) -> Result<ViewerUpdates, GpuError> {
        let world = match self.world.take() {
            Some(world) => world,
            None => {
                let Device { gpu, scene } = self.device()?;
                World::of_timeline(gpu, scene, self.timeline.clone())?
            }
        };
        self.viewers += 1;
        let mut updates = ready.join(&world, ViewerId(self.viewers));
        updates.iter_mut().for_each(|updates| updates.note_rehearsal(self.rehearsed_update_ns));
        if self.looking > 0 || updates.is_ok() {
            self.world = Some(world);
        }
        self.looking += usize::from(updates.is_ok());
        updates
    }
}

/// Makes the encoder of a session, on any thread.
fn encoder_of(
    StreamOptions { quality, rate_hz, encoders, .. }: &StreamOptions,
    welcome: &Welcome,
) -> impl FnOnce() -> Result<Box<dyn Encoder>, EncodeError> + Send + 'static {
    let settings = EncoderSettings::for_stream(welcome.atlas_extent_texels, quality.first_qp(), *rate_hz);
    let (codec, encoders) = (welcome.codec, encoders.clone());
    move || match codec {
        Codec::H264 => encoders.encoder(settings),
        codec => encode::encoder(codec, settings),
    }
}

impl Studio for GpuStudio<'_> {
    type Updates = ViewerUpdates;
    type Opening = Opening;

    fn open(
        &mut self,
        welcome: &Welcome,
        capabilities: &Capabilities,
        pictures: Pictures,
    ) -> Result<Opening, OpenError> {
        let Device { gpu, scene } = self.device().map_err(OpenError::Device)?;
        let (gpu, scene, timeline) = (gpu.clone(), scene.clone(), self.timeline.clone());
        Ok(self.backstage.open(Order {
            site: Site { gpu, scene, timeline },
            welcome: welcome.clone(),
            capabilities: capabilities.clone(),
            show: self.options.show,
            encoder: Box::new(encoder_of(self.options, welcome)),
            pictures,
        }))
    }

    fn opened(&mut self, opening: &mut Opening) -> Option<Result<Opened<ViewerUpdates>, OpenError>> {
        let made = opening.poll()?;
        Some(made.and_then(|(ready, encoder)| {
            let updates = self.take_in(ready).map_err(OpenError::Device)?;
            Ok((updates, Box::new(encoder) as Box<dyn PictureEncoder>))
        }))
    }

    fn flight(&self, updates: &ViewerUpdates) -> Result<Flight, GpuError> {
        self.world.as_ref().map_or(Ok(Flight::default()), |world| updates.flight(world))
    }

    fn advance(
        &mut self,
        updates: &mut ViewerUpdates,
        step: Step,
        now: ServerTime,
    ) -> Result<Option<Shaded>, GpuError> {
        let Some(world) = &mut self.world else { return Ok(None) };
        // Who looks at the same time has a part of it.
        let period_ms = 1e3 / self.options.rate_hz / self.looking.max(1) as f64;
        updates.set_shading_budget(self.shade_rate.budget_texels(self.options.shade_ms, period_ms));
        match step {
            Step::Begin => updates.begin(world, now).map(|_| None),
            Step::Place => updates.place_seen(world).map(|()| None),
            Step::Shade => updates.shade(world).map(|()| None),
            Step::Collect => {
                let shaded = updates.collect(world)?;
                let texels = updates.reused().shaded_texels;
                shaded.iter().for_each(|shaded| self.shade_rate.note(&shaded.timings, texels));
                Ok(shaded)
            }
            Step::Wait => Ok(None),
        }
    }

    fn rest(&self, updates: &ViewerUpdates, at_most: Duration) -> Result<bool, GpuError> {
        self.world.as_ref().map_or(Ok(false), |world| updates.rest(world, at_most))
    }

    fn close(&mut self, (updates, encoder): Opened<ViewerUpdates>, has_failed: bool) {
        self.looking -= 1;
        let Some(world) = &mut self.world else { return };
        let left = updates.leave(world);
        self.backstage.leave(world.gpu(), left, encoder.end(), !has_failed);
        if has_failed {
            world.forget();
        }
        if self.looking == 0 {
            self.world = None;
        }
    }

    fn account(&self, updates: &ViewerUpdates, stats: &mut ViewerStats) {
        stats.coarsened = updates.layout().coarsened();
        stats.dropped_patches = updates.dropped_patches();
        let Some(world) = &self.world else { return };
        let shows = updates.shows(world);
        (stats.triangles, stats.detail_pixels) = (shows.triangles, shows.detail_pixels);
        stats.texels_per_pixel = shows.texels_per_pixel;
        stats.reused_share = updates.reused_share();
        stats.levels = shows.lods;
    }

    fn quality(&self) -> QualityOptions {
        self.options.quality
    }

    fn encoder(&mut self, welcome: &Welcome) -> Result<Box<dyn Encoder>, EncodeError> {
        encoder_of(self.options, welcome)()
    }

    fn steer(&mut self, wanted: Steering, now: ServerTime) {
        if self.options.viewers_steer {
            let at = self.timeline.lock().steer(wanted, now);
            tracing::debug!("a viewer steers the world: {wanted:?} at {:.3} s", at.seconds());
        }
    }

    fn reopen(&mut self) -> anyhow::Result<()> {
        (self.world, self.looking, self.pipelines) = (None, 0, None);
        self.backstage = Backstage::start()?;
        self.shade_rate = ShadeRate::default();
        if let Some(Device { scene, .. }) = self.device.take() {
            self.scene = Some(scene.scene.clone());
        }
        let scene = self.scene.clone().ok_or_else(|| anyhow::anyhow!("the scene is gone"))?;
        self.device = Some((self.reopen)(scene)?);
        self.scene = None;
        self.rehearse()?;
        Ok(())
    }
}

impl Updates for ViewerUpdates {
    fn head(&mut self, state: HeadState) {
        Self::head(self, state);
    }

    fn displayed(&mut self, report: &Displayed) {
        Self::displayed(self, report);
    }

    fn interrupted(&mut self) {
        Self::interrupted(self);
    }

    fn set_budget(&mut self, budget: Budget) {
        Self::set_budget(self, budget);
    }

    fn set_spare(&mut self, spare: Spare) {
        Self::set_spare(self, spare);
    }

    fn rehearsed_s(&self) -> Option<f64> {
        Self::rehearsed_s(self)
    }

    fn set_measures(&mut self, measures: Measures) {
        Self::set_measures(self, measures);
    }

    fn note_update(&mut self, took_ns: i64) {
        Self::note_update(self, took_ns);
    }

    fn coded(&mut self, update: UpdateId, qp: u8) {
        Self::coded(self, update, qp);
    }

    fn lost_after(&mut self, after: Option<UpdateId>) {
        Self::lost_after(self, after);
    }

    fn encode(&mut self, delta: &UpdateDelta) -> EncodedDelta {
        Self::encode(self, delta)
    }

    fn motion(&self) -> Option<SharedMotion> {
        self.residency().skinning().map(|skinning| skinning.sender().clone())
    }

    fn recycle(&mut self, shaded: Shaded) {
        Self::recycle(self, shaded);
    }
}
