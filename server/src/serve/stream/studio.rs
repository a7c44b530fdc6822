//! The pipeline's studio on the real device: the world while somebody looks, and a [`ViewerUpdates`] a viewer.

use super::pipeline::Studio;
use super::{StreamOptions, ViewerStats};
use crate::animation::timeline::SharedTimeline;
use crate::encode::openh264::EncoderSettings;
use crate::encode::{self, EncodeError, Encoder};
use crate::motion::delta::UpdateDelta;
use crate::motion::sender::SharedMotion;
use crate::pacing::density::Spare;
use crate::pacing::gate::Budget;
use crate::pacing::overlap::{Flight, Step};
use crate::pacing::quality::QualityOptions;
use crate::pacing::shade_rate::ShadeRate;
use crate::scene::SceneGpu;
use crate::serve::viewer::Updates;
use crate::update::{Shaded, ViewerUpdates};
use crate::world::{ViewerId, World};
use shadecast_gpu::{Gpu, GpuError};
use shadecast_protocol::delta::EncodedDelta;
use shadecast_protocol::message::{Capabilities, Codec, Displayed, HeadState, Welcome};
use shadecast_protocol::time::ServerTime;
use shadecast_protocol::world_clock::Steering;
use shadecast_scene::Scene;
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
    /// How fast the device shades.
    shade_rate: ShadeRate,
    /// Kept for that.
    scene: Option<Scene>,
    reopen: &'a Reopen<'a>,
    options: &'a StreamOptions,
}

impl<'a> GpuStudio<'a> {
    /// Before anybody looks.
    pub(super) fn new(
        device: Device,
        timeline: SharedTimeline,
        reopen: &'a Reopen<'a>,
        options: &'a StreamOptions,
    ) -> Self {
        Self {
            device: Some(device),
            timeline,
            world: None,
            viewers: 0,
            looking: 0,
            shade_rate: ShadeRate::default(),
            scene: None,
            reopen,
            options,
        }
    }

    /// What it works on.
    pub(super) fn device(&self) -> Result<&Device, GpuError> {
        let closed = || GpuError::NoDevice("it was lost and is not open again yet".into());
        self.device.as_ref().ok_or_else(closed)
    }
}

impl Studio for GpuStudio<'_> {
    type Updates = ViewerUpdates;

    fn open(&mut self, welcome: &Welcome, capabilities: &Capabilities) -> Result<ViewerUpdates, GpuError> {
        let world = match self.world.take() {
            Some(world) => world,
            None => {
                let Device { gpu, scene } = self.device()?;
                World::of_timeline(gpu, scene, self.timeline.clone())?
            }
        };
        self.viewers += 1;
        let frame =
            ViewerUpdates::new(&world, ViewerId(self.viewers), welcome, capabilities, self.options.show);
        if self.looking > 0 || frame.is_ok() {
            self.world = Some(world);
        }
        self.looking += usize::from(frame.is_ok());
        frame
    }

    fn flight(&self, frame: &ViewerUpdates) -> Result<Flight, GpuError> {
        self.world.as_ref().map_or(Ok(Flight::default()), |world| frame.flight(world))
    }

    fn advance(
        &mut self,
        frame: &mut ViewerUpdates,
        step: Step,
        now: ServerTime,
    ) -> Result<Option<Shaded>, GpuError> {
        let Some(world) = &mut self.world else { return Ok(None) };
        // Who looks at the same time has a part of it.
        let period_ms = 1e3 / self.options.rate_hz / self.looking.max(1) as f64;
        frame.set_shading_budget(self.shade_rate.budget_texels(self.options.shade_ms, period_ms));
        match step {
            Step::Begin => frame.begin(world, now).map(|_| None),
            Step::Place => frame.place_seen(world).map(|()| None),
            Step::Shade => frame.shade(world).map(|()| None),
            Step::Collect => {
                let shaded = frame.collect(world)?;
                let texels = frame.reused().shaded_texels;
                shaded.iter().for_each(|shaded| self.shade_rate.note(&shaded.timings, texels));
                Ok(shaded)
            }
            Step::Wait => Ok(None),
        }
    }

    fn rest(&self, frame: &ViewerUpdates, at_most: Duration) -> Result<bool, GpuError> {
        self.world.as_ref().map_or(Ok(false), |world| frame.rest(world, at_most))
    }

    fn close(&mut self, frame: ViewerUpdates, has_failed: bool) {
        self.looking -= 1;
        let Some(world) = &mut self.world else { return };
        frame.leave(world);
        if has_failed {
            world.forget();
        }
        if self.looking == 0 {
            self.world = None;
        }
    }

    fn account(&self, frame: &ViewerUpdates, stats: &mut ViewerStats) {
        stats.coarsened = frame.layout().coarsened();
        stats.dropped_patches = frame.dropped_patches();
        let Some(world) = &self.world else { return };
        let shows = frame.shows(world);
        (stats.triangles, stats.detail_pixels) = (shows.triangles, shows.detail_pixels);
        stats.texels_per_pixel = shows.texels_per_pixel;
        stats.reused_share = frame.reused_share();
        stats.levels = shows.levels;
    }

    fn quality(&self) -> QualityOptions {
        self.options.quality
    }

    fn encoder(&mut self, welcome: &Welcome) -> Result<Box<dyn Encoder>, EncodeError> {
        let StreamOptions { quality, rate_hz, encoders, .. } = self.options;
        let settings = EncoderSettings::for_stream(welcome.atlas_extent_texels, quality.first_qp(), *rate_hz);
        match welcome.codec {
            Codec::H264 => encoders.encoder(settings),
            codec => encode::encoder(codec, settings),
        }
    }

    fn steer(&mut self, wanted: Steering, now: ServerTime) {
        if self.options.viewers_steer {
            let at = self.timeline.lock().steer(wanted, now);
            tracing::debug!("a viewer steers the world: {wanted:?} at {:.3} s", at.seconds());
        }
    }

    fn reopen(&mut self) -> anyhow::Result<()> {
        (self.world, self.looking) = (None, 0);
        self.shade_rate = ShadeRate::default();
        if let Some(Device { scene, .. }) = self.device.take() {
            self.scene = Some(scene.scene.clone());
        }
        let scene = self.scene.clone().ok_or_else(|| anyhow::anyhow!("the scene is gone"))?;
        self.device = Some((self.reopen)(scene)?);
        self.scene = None;
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
