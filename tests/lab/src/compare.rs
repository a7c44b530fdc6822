//! Compares what an eye was shown with what the forward renderer shows for the same pose, field of view and time of
//! display.

use crate::flip::pixels_per_degree;
use crate::image::Rgb8Image;
use crate::metrics::{FrameMetrics, ProbeView, View};
use anyhow::Context;
use shadecast_gpu::Gpu;
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_protocol::time::ServerTime;
use shadecast_server::scene_gpu::SceneGpu;
use shadecast_server::stages::forward::{Forward, Truth};
use std::sync::Arc;

/// One eye of one displayed frame.
pub struct Shown<'a> {
    /// Takes eye coordinates to the world's, as the client drew it.
    pub world_from_eye: Pose,
    /// The eye's frustum.
    pub fov: Fov,
    /// When it is displayed, on the server's true clock.
    pub time: ServerTime,
    /// The picture.
    pub picture: &'a Rgb8Image,
    /// What is where in it; `None` for a frame without a bundle.
    pub probe: Option<&'a ProbeView>,
}

/// Renders truths and measures against them.
pub struct Comparer {
    forward: Forward,
}

impl Comparer {
    /// For pictures of `extent_pixels`.
    pub fn new(gpu: &Arc<Gpu>, scene: &Arc<SceneGpu>, extent_pixels: [u32; 2]) -> anyhow::Result<Self> {
        let forward = Forward::new(gpu, scene, extent_pixels).context("making the ground-truth renderer")?;
        Ok(Self { forward })
    }

    /// The truth's picture and what it says of the shown one.
    pub fn measure(&mut self, shown: &Shown<'_>) -> anyhow::Result<(Rgb8Image, FrameMetrics)> {
        let truth = self.forward.render(shown.world_from_eye, shown.fov, shown.time)?;
        let (picture, probe) = split(truth)?;
        let width = shown.picture.width;
        let metrics = FrameMetrics::measure(&View {
            truth: &picture,
            truth_probe: &probe,
            client: shown.picture,
            client_probe: shown.probe,
            pixels_per_degree: pixels_per_degree(width, shown.fov.left, shown.fov.right),
        })?;
        Ok((picture, metrics))
    }
}

fn split(truth: Truth) -> anyhow::Result<(Rgb8Image, ProbeView)> {
    let [width, height] = truth.extent_pixels;
    let picture = Rgb8Image::new(width, height, truth.rgb8)?;
    let probe = ProbeView { width, height, instance: truth.instance, depth_m: truth.distance_m };
    Ok((picture, probe))
}
