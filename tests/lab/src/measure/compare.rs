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
use shadecast_shaders::color::{linear_from_srgb, srgb_from_linear};
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
    /// Places a side of a pixel, and what renders one place of each, where these are more.
    places: u32,
    middle: Option<Forward>,
}

impl Comparer {
    /// For pictures of `extent_pixels`.
    pub fn new(gpu: &Arc<Gpu>, scene: &Arc<SceneGpu>, extent_pixels: [u32; 2]) -> anyhow::Result<Self> {
        Self::with_places(gpu, scene, extent_pixels, 1)
    }

    /// The same, with the mean of `places` x `places` places of each pixel. Textures are filtered for one place.
    pub fn with_places(
        gpu: &Arc<Gpu>,
        scene: &Arc<SceneGpu>,
        extent_pixels: [u32; 2],
        places: u32,
    ) -> anyhow::Result<Self> {
        let renderer = |places: u32| {
            Forward::new(gpu, scene, extent_pixels.map(|side| side * places))
                .context("making the ground-truth renderer")
        };
        let moves = scene.numbering.instances.iter().map(|instance| instance.is_animated).collect();
        let moving_shadow = MovingShadow::new(&scene.scene, moves, &scene.world_bounds);
        Ok(Self {
            scene: scene.clone(),
            forward: renderer(places)?,
            truth: SceneTruth::new(scene),
            moving_shadow,
            has_true_outlines: false,
            places,
            middle: (places > 1).then(|| renderer(1)).transpose()?,
        })
    }

    /// That takes outlines for true, where it is so: see [`with_true_outlines`].
    pub fn with_true_outlines(self, has_true_outlines: bool) -> Self {
        Self { has_true_outlines, ..self }
    }

    /// What an eye should see at a time.
    pub fn picture(&mut self, world_from_eye: Pose, fov: Fov, time: WorldTime) -> anyhow::Result<Rgb8Image> {
        Ok(self.seen(world_from_eye, fov, time)?.0)
    }

    /// The truth's picture and what it says of the shown one.
    pub fn measure(&mut self, shown: &Shown<'_>) -> anyhow::Result<(Rgb8Image, FrameMetrics)> {
        self.measured(shown, false)
    }

    /// The same of a picture of which nobody says what is where: nothing counts as missing.
    pub fn measure_whole(&mut self, shown: &Shown<'_>) -> anyhow::Result<(Rgb8Image, FrameMetrics)> {
        self.measured(shown, true)
    }

    fn measured(&mut self, shown: &Shown<'_>, is_whole: bool) -> anyhow::Result<(Rgb8Image, FrameMetrics)> {
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
            client_probe: if is_whole { Some(&probe) } else { shown.probe },
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
        let (picture, probe) = self.seen(world_from_eye, fov, time)?;
        let Some(middle) = &mut self.middle else { return Ok((picture, probe)) };
        // What is where is that of a pixel's middle, whatever colour it has.
        let posed = self.truth.posed(time);
        let truth = middle.render_posed(world_from_eye, fov, time, posed)?;
        Ok((picture, probe_of(truth.extent_pixels, truth.instance, truth.distance_m)))
    }

    /// What an eye should see at a time, and what is where by place of a pixel.
    pub fn seen(
        &mut self,
        world_from_eye: Pose,
        fov: Fov,
        time: WorldTime,
    ) -> anyhow::Result<(Rgb8Image, ProbeView)> {
        let posed = self.truth.posed(time);
        let Truth { extent_pixels, rgb8, instance, distance_m } =
            self.forward.render_posed(world_from_eye, fov, time, posed)?;
        let [width, height] = extent_pixels.map(|side| side / self.places);
        let picture = Rgb8Image::new(width, height, mean_of_places(extent_pixels, rgb8, self.places))?;
        Ok((picture, probe_of(extent_pixels, instance, distance_m)))
    }
}

fn probe_of([width, height]: [u32; 2], instance: Vec<u32>, depth_m: Vec<f32>) -> ProbeView {
    ProbeView { width, height, instance, depth_m }
}

/// By pixel the mean light of `places` x `places` pixels of a picture.
fn mean_of_places(extent_pixels: [u32; 2], rgb8: Vec<u8>, places: u32) -> Vec<u8> {
    if places == 1 {
        return rgb8;
    }
    let [across, down] = extent_pixels.map(|side| side as usize);
    let places = places as usize;
    let pixels = (0..down / places).flat_map(|y| (0..across / places).map(move |x| [x * places, y * places]));
    let light_of_code: [f32; 256] = std::array::from_fn(|code| linear_from_srgb(code as f32 / 255.0));
    let mean = |[x, y]: [usize; 2], channel: usize| {
        let within = (y..y + places).flat_map(|y| (x..x + places).map(move |x| y * across + x));
        let light: f32 = within.map(|at| light_of_code[usize::from(rgb8[3 * at + channel])]).sum();
        (255.0 * srgb_from_linear(light / (places * places) as f32)).round() as u8
    };
    pixels.flat_map(|pixel| [0, 1, 2].map(|channel| mean(pixel, channel))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pixel_has_the_mean_light_of_its_places() {
        // Half of the places white: half of the light is 188 in sRGB.
        let white = |x: u32| if x.is_multiple_of(2) { 255 } else { 0 };
        let rgb8 = (0..4 * 2).flat_map(|at| [white(at % 4), 255, 0]).collect();
        assert_eq!(mean_of_places([4, 2], rgb8, 2), [188, 255, 0, 188, 255, 0]);
    }

    #[test]
    fn one_place_is_the_picture_itself() {
        let rgb8: Vec<u8> = (0..18).collect();
        assert_eq!(mean_of_places([3, 2], rgb8.clone(), 1), rgb8);
    }
}
