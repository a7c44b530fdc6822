//! Comparison of an eye's displayed picture with the forward renderer's for the same pose, field of view and display time, with
//! vertices posed by [`crate::measure::truth`].

use super::flip::pixels_per_degree;
use super::metrics::{FrameMetrics, Holes, ProbeView, Regions, View, with_true_outlines};
use super::truth::SceneTruth;
use super::truth::moving_shadow::MovingShadow;
use crate::image::Rgb8Image;
use anyhow::Context;
use shadecast_gpu::Gpu;
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_protocol::time::WorldTime;
use shadecast_server::scene::SceneGpu;
use shadecast_server::truth::forward::{Forward, Truth};
use std::sync::Arc;

/// One eye of one displayed frame.
pub struct Shown<'a> {
    /// Takes eye coordinates to the world's, as the client drew it.
    pub world_from_eye: Pose,
    /// The eye's frustum.
    pub fov: Fov,
    /// When it is displayed, on the server's true clock.
    pub time: WorldTime,
    /// The picture.
    pub picture: &'a Rgb8Image,
    /// What is where in it; `None` for a frame without a bundle.
    pub probe: Option<&'a ProbeView>,
}

/// Renders truths and measures against them.
pub struct Comparer {
    scene: Arc<SceneGpu>,
    forward: Forward,
    truth: SceneTruth,
    moving_shadow: MovingShadow,
    has_true_outlines: bool,
}

impl Comparer {
    /// For pictures of `extent_pixels`.
    pub fn new(gpu: &Arc<Gpu>, scene: &Arc<SceneGpu>, extent_pixels: [u32; 2]) -> anyhow::Result<Self> {
        let forward = Forward::new(gpu, scene, extent_pixels).context("making the ground-truth renderer")?;
        let moves = scene.numbering.instances.iter().map(|instance| instance.is_animated).collect();
        let moving_shadow = MovingShadow::new(&scene.scene, moves, &scene.world_bounds);
        Ok(Self {
            scene: scene.clone(),
            forward,
            truth: SceneTruth::new(scene),
            moving_shadow,
            has_true_outlines: false,
        })
    }

    /// That takes outlines for true, where it is so: see [`with_true_outlines`].
    pub fn with_true_outlines(self, has_true_outlines: bool) -> Self {
        Self { has_true_outlines, ..self }
    }

    /// What an eye should see at a time.
    pub fn picture(&mut self, world_from_eye: Pose, fov: Fov, time: WorldTime) -> anyhow::Result<Rgb8Image> {
        Ok(self.render(world_from_eye, fov, time)?.0)
    }

    /// The truth's picture and what it says of the shown one.
    pub fn measure(&mut self, shown: &Shown<'_>) -> anyhow::Result<(Rgb8Image, FrameMetrics)> {
        let &Shown { world_from_eye, fov, time, .. } = shown;
        let (picture, probe) = self.render(world_from_eye, fov, time)?;
        let regions = Regions {
            animated: probe.instance.iter().map(|instance| self.moves(*instance)).collect(),
            shadowed: self.moving_shadow.mask(&self.scene.scene, &probe, world_from_eye, fov, time),
        };
        let view = View {
            truth: &picture,
            truth_probe: &probe,
            client: shown.picture,
            client_probe: shown.probe,
            pixels_per_degree: pixels_per_degree(shown.picture.width, fov.left, fov.right),
            regions: &regions,
        };
        let metrics = match self.has_true_outlines {
            true => FrameMetrics::measure(&View { client: &with_true_outlines(&view)?, ..view })?,
            false => FrameMetrics::measure(&view)?,
        };
        Ok((picture, metrics))
    }

    /// What is missing in a view: of all geometry, and of what is animated.
    pub fn missing(
        &mut self,
        world_from_eye: Pose,
        fov: Fov,
        time: WorldTime,
        client: &ProbeView,
    ) -> anyhow::Result<[Holes; 2]> {
        let (_, truth) = self.render(world_from_eye, fov, time)?;
        let animated: Vec<bool> = truth.instance.iter().map(|instance| self.moves(*instance)).collect();
        Ok([Holes::measure(&truth, client)?, Holes::within(&truth, client, &animated)?])
    }

    fn moves(&self, instance: u32) -> bool {
        self.scene.numbering.instances.get(instance as usize).is_some_and(|place| place.is_animated)
    }

    fn render(
        &mut self,
        world_from_eye: Pose,
        fov: Fov,
        time: WorldTime,
    ) -> anyhow::Result<(Rgb8Image, ProbeView)> {
        let posed = self.truth.posed(time);
        split(self.forward.render_posed(world_from_eye, fov, time, posed)?)
    }
}

fn split(truth: Truth) -> anyhow::Result<(Rgb8Image, ProbeView)> {
    let [width, height] = truth.extent_pixels;
    let picture = Rgb8Image::new(width, height, truth.rgb8)?;
    let probe = ProbeView { width, height, instance: truth.instance, depth_m: truth.distance_m };
    Ok((picture, probe))
}
