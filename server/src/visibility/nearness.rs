//! How large what is in the scene can look, and how much a person looks at it: what is near, in the middle of the view, or moves.

use crate::scene::SceneGpu;
use crate::time::VIEW_TIMES;
use crate::visibility::predict::PredictedViews;
use glam::{Affine3A, Vec3};
use shadecast_protocol::pose::{NEAR_M, Pose};
use shadecast_protocol::time::Grid;
use shadecast_scene::animation::bounds::Bounds;
use shadecast_scene::animation::sampling::longest_axis;

/// Radians from the view's axis within which people mostly look: eyes turn by about 15 degrees before the head does.
const MIDDLE_RAD: f32 = 0.26;
/// Radians from the axis beyond which nothing is looked at: 45 degrees.
const RIM_RAD: f32 = 0.79;
/// What moves draws looks as if it were so many times as near.
const OF_MOTION: f32 = 2.0;

/// How an instance looks to the predicted eyes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Nearness {
    /// Pixels of the client's display that a metre of its model has, as near as any eye comes.
    pub pixels_per_metre: f32,
    /// The same, weighed by how much a person looks at it: halved at the rim of the view, doubled where it moves.
    pub attention: f32,
}

/// By instance. The nearest point is that of the box around all that the instance can play, where its path has taken it at each of
/// the view times.
pub(crate) fn nearness(
    scene: &SceneGpu,
    grid: Grid,
    views: &PredictedViews,
    pixels_per_radian: f32,
    nearness: &mut Vec<Nearness>,
) {
    let paths = &scene.animation.manager.paths;
    let times_s = views.times.map(|at| at.time(grid).seconds());
    let of = |instance: usize| {
        let of_motion = if scene.numbering.instances[instance].is_animated { OF_MOTION } else { 1.0 };
        let at_time = |time: usize| {
            let world_from_model = paths.world_from_model(&scene.scene, instance, times_s[time]);
            let eyes = views.eyes[time].map(|eye| eye.world_from_eye);
            let bounds = in_world(scene.played_bounds[instance], &world_from_model);
            bounds.map_or([0.0; 2], |bounds| {
                let seen = longest_axis(&world_from_model) * seen_per_metre(bounds, eyes);
                [seen, seen * of_motion * in_the_middle(bounds, eyes)]
            })
        };
        let largest = |a: [f32; 2], b: [f32; 2]| [a[0].max(b[0]), a[1].max(b[1])];
        let [seen, attention] = (0..VIEW_TIMES).map(at_time).fold([0.0; 2], largest);
        Nearness { pixels_per_metre: pixels_per_radian * seen, attention: pixels_per_radian * attention }
    };
    nearness.clear();
    nearness.extend((0..scene.played_bounds.len()).map(of));
}

/// The box in the world around a model's box; `None` for an empty one.
fn in_world(of_model: Bounds, world_from_model: &Affine3A) -> Option<Bounds> {
    let corners = || of_model.corners().map(|corner| world_from_model.transform_point3(corner));
    (!of_model.is_empty()).then(|| Bounds::around(corners()))
}

/// Radians of a metre at the point of a box that is nearest to the nearer of two eyes.
fn seen_per_metre(bounds: Bounds, world_from_eyes: [Pose; 2]) -> f32 {
    let distance_m = |eye: Vec3| eye.distance(eye.clamp(bounds.low, bounds.high));
    let nearest_m = world_from_eyes.map(|eye| distance_m(eye.position)).into_iter().fold(f32::MAX, f32::min);
    1.0 / nearest_m.max(NEAR_M)
}

/// 1 for a box that reaches into the middle of the view of either eye, falling to a half at its rim. The box counts as the ball
/// around it.
fn in_the_middle(bounds: Bounds, world_from_eyes: [Pose; 2]) -> f32 {
    let (centre, radius_m) = (0.5 * (bounds.low + bounds.high), 0.5 * bounds.low.distance(bounds.high));
    let off_axis_rad = |world_from_eye: Pose| {
        let towards = centre - world_from_eye.position;
        let distance_m = towards.length();
        if distance_m <= radius_m {
            return 0.0;
        }
        (world_from_eye.orientation * Vec3::NEG_Z).angle_between(towards) - (radius_m / distance_m).asin()
    };
    let off_axis_rad = world_from_eyes.map(off_axis_rad).into_iter().fold(f32::MAX, f32::min);
    1.0 - 0.5 * ((off_axis_rad - MIDDLE_RAD) / (RIM_RAD - MIDDLE_RAD)).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;

    fn eyes_at(x: [f32; 2]) -> [Pose; 2] {
        x.map(|x| Pose { position: Vec3::new(x, 0.0, 0.0), orientation: Quat::IDENTITY })
    }

    #[test]
    fn the_nearer_eye_and_the_nearest_point_of_the_box_count() {
        let of_model = Bounds { low: Vec3::splat(-1.0), high: Vec3::splat(1.0) };
        let placed = Affine3A::from_scale_rotation_translation(
            Vec3::splat(2.0),
            Quat::IDENTITY,
            Vec3::new(0.0, 0.0, -12.0),
        );
        let bounds = in_world(of_model, &placed).expect("not empty");
        assert!((seen_per_metre(bounds, eyes_at([0.0, 0.1])) - 1.0 / 10.0).abs() < 1e-6);
        let past_its_side = seen_per_metre(bounds, eyes_at([50.0, 2.0 + 7.5]));
        assert!((past_its_side - 1.0 / 12.5).abs() < 1e-6);
        let inside = [Pose { position: Vec3::new(0.0, 0.0, -12.0), orientation: Quat::IDENTITY }; 2];
        assert_eq!((seen_per_metre(bounds, inside), in_the_middle(bounds, inside)), (1.0 / NEAR_M, 1.0));
        assert_eq!(in_world(Bounds::EMPTY, &placed), None);
    }

    #[test]
    fn the_middle_of_the_view_counts_twice_as_much_as_its_rim() {
        let at = |degrees: f32| {
            let centre = Quat::from_rotation_y(degrees.to_radians()) * Vec3::new(0.0, 0.0, -10.0);
            let half = Vec3::splat(0.1);
            in_the_middle(Bounds { low: centre - half, high: centre + half }, eyes_at([-0.03, 0.03]))
        };
        assert_eq!((at(0.0), at(14.0), at(60.0), at(180.0)), (1.0, 1.0, 0.5, 0.5));
        assert!((0.6..0.9).contains(&at(30.0)) && (at(30.0) - at(-30.0)).abs() < 1e-4, "{}", at(30.0));
        let wide = Bounds { low: Vec3::new(-9.0, -1.0, -11.0), high: Vec3::new(-1.0, 1.0, -9.0) };
        assert_eq!(in_the_middle(wide, eyes_at([0.0, 0.0])), 1.0, "its side reaches into the middle");
    }
}
