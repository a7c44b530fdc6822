//! Rounding of samples: as fine as the client can see at its distance, and no finer. Pure.
//!
//! Steps are powers of two of a metre, so a change to a finer step is exact. A step becomes finer at once, and coarser only
//! with room to spare: an instance at a threshold distance does not flicker between two steps.

use crate::visibility::predict::View;
use glam::Vec3;
use shadecast_protocol::geometry::InstanceInfo;
use shadecast_protocol::ids::InstanceId;
use shadecast_protocol::limits::{MAX_STEP_M, MIN_STEP_M};
use shadecast_scene::animation::bounds::Bounds;
use std::collections::BTreeMap;

/// The finest step, metres: 0.06 mm.
pub(crate) const FINEST_STEP_M: f32 = 1.0 / 16_384.0;
/// The coarsest, metres: 3.9 mm.
pub(crate) const COARSEST_STEP_M: f32 = 1.0 / 256.0;
/// What an instance has of whose distance nothing was said, metres: 0.49 mm.
pub(crate) const START_STEP_M: f32 = 1.0 / 2048.0;
/// A step is at most so many pixels of the client.
const STEP_PIXELS: f32 = 0.25;
/// A step is doubled only where that many times as coarse a one would do.
const ROOM_TO_COARSEN: f32 = 3.0;
/// No picture is taken to be coarser, pixels per radian in its middle: the paper's 1300 over 90 degrees. Headsets have more; what has
/// less is a window or a test that may be looked at enlarged.
const LEAST_PIXELS_PER_RADIAN: f32 = 650.0;

const _: () = assert!(MIN_STEP_M <= FINEST_STEP_M && COARSEST_STEP_M <= MAX_STEP_M);

/// The steps of one client's instances.
#[derive(Clone, Debug, Default)]
pub(crate) struct Steps {
    /// By instance: the coarsest that will do, metres.
    wanted_m: Vec<f32>,
    /// What the client was told, or will be with the update in the making.
    told_m: BTreeMap<InstanceId, f32>,
}

impl Steps {
    /// The coarsest steps that will do from now on, by instance, metres.
    pub(crate) fn want(&mut self, wanted_m: impl IntoIterator<Item = f32>) {
        self.wanted_m.clear();
        self.wanted_m.extend(wanted_m);
    }

    /// What the client must be told before the first sample of an instance; `None` where it was.
    pub(crate) fn announce(&mut self, instance: InstanceId) -> Option<InstanceInfo> {
        if self.told_m.contains_key(&instance) {
            return None;
        }
        let step_m = floor_power_of_two(wanted_of(&self.wanted_m, instance));
        self.told_m.insert(instance, step_m);
        Some(InstanceInfo { instance, step_m })
    }

    /// Instances that the client was told of and whose step is another one now, each given once.
    pub(crate) fn changes(&mut self) -> impl Iterator<Item = InstanceInfo> + '_ {
        let wanted_m = &self.wanted_m;
        self.told_m.iter_mut().filter_map(|(instance, told_m)| {
            let step_m = next_step(*told_m, wanted_of(wanted_m, *instance));
            (std::mem::replace(told_m, step_m) != step_m)
                .then_some(InstanceInfo { instance: *instance, step_m })
        })
    }
}

/// The coarsest steps that will do for instances with these bounds in the world, seen from `views`, metres. `pixels_per_radian` in
/// the middle of the client's picture.
pub(crate) fn wanted_steps_m<'a>(
    bounds: &[Bounds],
    views: impl Iterator<Item = &'a View> + Clone,
    pixels_per_radian: f32,
) -> impl Iterator<Item = f32> {
    let radians = STEP_PIXELS / pixels_per_radian.max(LEAST_PIXELS_PER_RADIAN);
    let eyes = views.map(|view| view.world_from_eye.position);
    let nearest_m =
        move |bounds: &Bounds| eyes.clone().map(|eye| distance_m(*bounds, eye)).fold(f32::INFINITY, f32::min);
    bounds.iter().map(move |bounds| (nearest_m(bounds) * radians).clamp(FINEST_STEP_M, COARSEST_STEP_M))
}

fn wanted_of(wanted_m: &[f32], instance: InstanceId) -> f32 {
    wanted_m.get(instance.index()).copied().unwrap_or(START_STEP_M)
}

/// 0 inside.
fn distance_m(bounds: Bounds, eye: Vec3) -> f32 {
    (bounds.low - eye).max(eye - bounds.high).max(Vec3::ZERO).length()
}

fn next_step(told_m: f32, wanted_m: f32) -> f32 {
    match told_m <= wanted_m && wanted_m < ROOM_TO_COARSEN * told_m {
        true => told_m,
        false => floor_power_of_two(wanted_m),
    }
}

/// The largest power of two that is not above a number within the bounds of steps.
fn floor_power_of_two(step_m: f32) -> f32 {
    // Whatever follows the exponent goes.
    f32::from_bits(step_m.clamp(FINEST_STEP_M, COARSEST_STEP_M).to_bits() & 0xff80_0000)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;
    use shadecast_protocol::pose::{Fov, Pose};

    const INSTANCE: InstanceId = InstanceId(0);
    const PIXELS_PER_RADIAN: f32 = 1000.0;

    fn views(distance_m: f32) -> [View; 2] {
        let fov = Fov { left: -0.7, right: 0.7, up: 0.7, down: -0.7 };
        let eye = |off_m| Pose {
            position: Vec3::new(0.0, 0.0, 1.0 + distance_m + off_m),
            orientation: Quat::IDENTITY,
        };
        [0.0, 0.5].map(|off_m| View { world_from_eye: eye(off_m), fov })
    }

    fn at(distance_m: f32) -> f32 {
        let bounds = Bounds { low: -Vec3::ONE, high: Vec3::ONE };
        wanted_steps_m(&[bounds], views(distance_m).iter(), PIXELS_PER_RADIAN).next().expect("of one")
    }

    /// What the client is told at each of these distances, one after the other.
    fn told_m(distances_m: &[f32]) -> Vec<f32> {
        let mut steps = Steps::default();
        let mut told = Vec::new();
        for distance_m in distances_m {
            steps.want([at(*distance_m)]);
            told.extend(steps.announce(INSTANCE));
            told.extend(steps.changes());
        }
        told.iter().map(|info| info.step_m).collect()
    }

    #[test]
    fn a_step_is_an_eighth_to_a_quarter_of_a_pixel() {
        for distance_m in [0.5, 1.0, 2.0, 3.7, 8.0, 15.0] {
            let pixels = told_m(&[distance_m])[0] / distance_m * PIXELS_PER_RADIAN;
            assert!((0.125..=0.25).contains(&pixels), "{pixels} at {distance_m} m");
        }
        assert_eq!([at(0.0), at(-0.5), at(1e9)], [FINEST_STEP_M, FINEST_STEP_M, COARSEST_STEP_M]);
        assert_eq!(at(f32::INFINITY), COARSEST_STEP_M);
    }

    #[test]
    fn steps_get_finer_at_once_and_coarser_with_distance() {
        let (one, two, four) = (1.0 / 4096.0, 1.0 / 2048.0, 1.0 / 1024.0);
        // A quarter of a pixel is 0.25 mm at 1 m.
        assert_eq!(told_m(&[2.0, 1.9, 0.98]), [two, one], "finer as soon as it is seen");
        assert_eq!(told_m(&[1.0, 2.0, 2.9, 3.0, 3.5, 7.0]), [one, two, four]);
        assert_eq!(told_m(&[1.0, 60.0]), [one, COARSEST_STEP_M]);
    }

    #[test]
    fn a_head_that_sways_changes_no_step() {
        let sway: Vec<f32> = (0..100).map(|n| 2.0 + if n % 2 == 0 { 0.0 } else { 0.4 }).collect();
        assert_eq!(told_m(&sway).len(), 1);
        let around_a_change: Vec<f32> = (0..100).map(|n| if n % 2 == 0 { 1.9 } else { 2.1 }).collect();
        assert_eq!(told_m(&around_a_change).len(), 1, "it was told the finer one first");
    }

    #[test]
    fn steps_are_powers_of_two_within_their_bounds() {
        assert_eq!(
            [0.0, 6.2e-5, 1e-3, 1.0].map(floor_power_of_two),
            [FINEST_STEP_M, FINEST_STEP_M, 1.0 / 1024.0, COARSEST_STEP_M]
        );
    }

    #[test]
    fn a_coarse_picture_is_taken_for_the_papers() {
        let bounds = [Bounds { low: -Vec3::ONE, high: Vec3::ONE }];
        let of = |pixels_per_radian| {
            wanted_steps_m(&bounds, views(2.0).iter(), pixels_per_radian).next().expect("of one")
        };
        assert_eq!([of(30.0), of(f32::NAN)], [of(650.0); 2]);
        assert!(of(2000.0) < of(1000.0));
    }
}
